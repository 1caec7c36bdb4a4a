"""Sensors that do not do their work: what a log's readings show of it, as findings for a verdict.

An IMU that stops answering, an axis that is stuck, a gyroscope that does not answer the accelerometer's
turns, axes with a wrong sign or in the wrong order, readings at the end of a sensor's range, a marker whose
place is held between pictures. `Watch` finds them block by block in a log that is streamed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, runs
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Finding, Severity
from calib.io.columns import ACCEL, GYRO, IMU, IN_PLANE, MARKER, MEASURED, ColumnMap
from calib.io.inferred_units import turning


class LogRows(Protocol):
    """The rows of a log, or of a block of it; see `calib.io.logs.Log`."""

    @property
    def t_s(self) -> FloatArray: ...

    @property
    def columns(self) -> Mapping[str, FloatArray]: ...

    @property
    def map(self) -> ColumnMap | None: ...

    def sampled(self, *names: str) -> IntArray: ...


_NEEDED = (*IN_PLANE, "u_px", "v_px")
"""What an estimate of the head takes; without the others it does as well."""
FEWEST = 20
"""With fewer readings a sensor that never changes may be one with coarse steps."""
_TURNED_RAD = 0.05
_AGREES, _CONTRADICTS = 0.3, 1.0
_WINDOW = 20_000
_CHECK_GYRO = "check the gyroscope and its wiring"
_CHECK_IMU = "check the IMU's wiring and the bus that reads it"
_HELD_S, _HELD_CHANCE, _OTHERS_REPEAT = 1.0, 1e-12, 0.5
"""Readings of a whole IMU that are the same for so long, and how likely that is by their steps alone; of one
axis, and the most that other axes of the sensor repeat theirs meanwhile."""
_BIN_S, _BINS, _DEAD = 0.5, 10, 3
_UPRIGHT, _LEAST_MPS2 = 0.75, 3.0
_FELT_RAD, _ANSWERED = 0.03, 0.1
"""2 degrees, RMS: for half a second 0.03 g, of which a gyroscope that works shows more than a tenth."""
_MOST_BIAS_RADPS = 0.35
"""20 deg/s, the zero-rate output that the MPU-6050's data sheet allows."""
_CARRIED_MPS = 0.3
"""What carries a rig without turning it is slower, RMS, and would feel the same as a turn."""
_STUCK_S, _SHAKEN_RAD = 1.0, 0.1
"""A reading that stays the same for so long while the accelerometer is shaken by 0.1 g."""


@dataclass
class Watch:
    """What the blocks of a log show of its sensors.

    Attributes
    ----------
    names : columns that are used, and so ought to have readings.
    held : rows of the last block, from and to, in which the whole IMU repeats one reading.
    """

    names: tuple[str, ...] = MEASURED
    held: list[tuple[int, int]] = field(default_factory=list)
    _seen: dict[str, tuple[int, float, float]] = field(default_factory=dict)
    _mirrored: Finding | None = None
    _sign_known: bool = False
    _silent: Finding | None = None
    _stopped: Finding | None = None
    _stuck: Finding | None = None

    def add(self, log: LogRows) -> None:
        """Rows that follow."""
        for name in set(self.names) & set(log.columns):
            count, least, most = self._seen.get(name, (0, math.inf, -math.inf))
            finite = log.columns[name][np.isfinite(log.columns[name])]
            if len(finite):
                least, most = min(least, float(finite.min())), max(most, float(finite.max()))
            self._seen[name] = count + len(finite), least, most
        self._stuck = self._stuck or _stuck_axis(log, self.names)
        if all(name in log.columns and name in self.names for name in IN_PLANE):
            if not self._sign_known:
                self._sign_known, self._mirrored = _mirrored_axes(log)
            self._silent = self._silent or _silent_gyro(log)
        self.held = _held_rows(log) if set(self.names) & set(IMU) else []
        self._stopped = self._stopped or _imu_stopped(log, self.held)

    def has(self, *names: str) -> bool:
        """Whether each of these columns has a reading."""
        return all(name in self._seen and self._seen[name][0] for name in names)

    def findings(self, stuck: bool = True) -> list[Finding]:
        """What is wrong about the sensors, with `stuck` those among them that never change."""
        out = []
        for name in (name for name in self.names if name in self._seen):
            count, least, most = self._seen[name]
            if not count:
                severity: Severity = "poor" if name in _NEEDED else "remark"
                out.append(Finding(severity, f"{name} has no reading in any row"))
            elif stuck and name in IMU and count >= FEWEST and least == most:
                text = f"{name} never changes, it is stuck at {least:.6g}"
                out.append(Finding("inconsistent", text, "check the sensor and its wiring"))
        # A reading that never changes is said as that.
        _, least, most = self._seen.get("gz_radps", (0, 0.0, 0.0))
        alive = least != most
        more = (
            self._stopped,
            self._stuck or self._mirrored,
            self._silent if alive and not self._stuck else None,
        )
        return [*out, *(one for one in more if one is not None)]


def _held_rows(log: LogRows) -> list[tuple[int, int]]:
    """Rows, from and to, in which the whole IMU repeats one reading for longer than chance and steps explain.

    Of an IMU with at least one axis of each sensor and three in all; the first of equal readings is not among
    them. A log that never changes has no such rows.
    """
    names = [name for name in IMU if name in log.columns]
    rows = log.sampled(*names)
    if len(names) < 3 or not set(names) & set(ACCEL) or not set(names) & set(GYRO) or len(rows) < FEWEST:
        return []
    same = np.logical_and.reduce(_repeats(log, names, rows))
    return [(int(rows[a + 1]), int(rows[b]) + 1) for a, b in _long_repeats(same, log.t_s[rows])]


def _repeats(log: LogRows, names: Sequence[str], rows: IntArray) -> BoolArray:
    """Whether each of these columns repeats its reading in a row, (names, rows - 1)."""
    values = np.stack([log.columns[name][rows] for name in names])
    return np.asarray(values[:, 1:] == values[:, :-1])


def _long_repeats(same: BoolArray, t_s: FloatArray) -> list[tuple[int, int]]:
    """Runs of repetitions, from and to, longer than chance and steps explain; none where all are."""
    share = float(same.mean())
    if not 0.0 < share < 1.0:
        return []
    least = max(math.log(_HELD_CHANCE) / math.log(share), FEWEST)
    return [(a, b) for a, b in runs(same) if b - a >= least and t_s[b] - t_s[a] >= _HELD_S]


def _stuck_axis(log: LogRows, names: Sequence[str]) -> Finding | None:
    """The first of these columns that repeats one reading while other axes of its sensor go on changing."""
    for sensor in (GYRO, ACCEL):
        axes = [name for name in sensor if name in log.columns]
        rows = log.sampled(*axes)
        if len(axes) < 2 or len(rows) < FEWEST:
            continue
        same = _repeats(log, axes, rows)
        for k, name in enumerate(axes):
            others = np.delete(same, k, axis=0)
            for a, b in _long_repeats(same[k], log.t_s[rows]) if name in names else ():
                if others[:, a:b].mean() < _OTHERS_REPEAT:
                    value, stamps = log.columns[name][rows[a]], log.t_s[rows]
                    text = f"{name} is stuck at {value:.6g} from {stamps[a]:.1f} to {stamps[b]:.1f} s"
                    return Finding("inconsistent", f"{text}, while other axes go on changing", _CHECK_IMU)
    return None


def _imu_stopped(log: LogRows, held: Sequence[tuple[int, int]]) -> Finding | None:
    """That the whole IMU stops answering, where it does."""
    if not held:
        return None
    (a, b), more = held[0], len(held) - 1
    text = f"all readings of the IMU stay the same from {log.t_s[a]:.1f} to {log.t_s[b - 1]:.1f} s"
    text += f" and {more} more time{'s' * (more > 1)}" if more else ""
    return Finding("poor", f"{text}; they tell nothing", _CHECK_IMU)


def _silent_gyro(log: LogRows) -> Finding | None:
    """Where the accelerometer moves and the gyroscope is stuck, or does not answer its turns.

    Of a sensor that tilts the angle turns about all three axes (`calib.stages.imu.tracks`); far out of the
    plane it is none.
    """
    tilts = "az_mps2" in log.columns
    if tilts and not all(name in log.columns for name in IMU):
        return None
    rows = log.sampled(*(IMU if tilts else IN_PLANE))
    if len(rows) < 2 * FEWEST:
        return None
    t_s = np.maximum.accumulate(log.t_s[rows])
    gz, ax, ay = (log.columns[name][rows] for name in IN_PLANE)
    leant, rate, across = np.unwrap(np.arctan2(ay, ax)), -gz, ax * ax + ay * ay
    upright = across > _LEAST_MPS2**2
    if tilts:
        gx, gy, az = (log.columns[name][rows] for name in ("gx_radps", "gy_radps", "az_mps2"))
        rate = rate + az * (gx * ax + gy * ay) / np.maximum(across, 1e-9)
        upright &= across > _UPRIGHT * (across + az * az)
    turned = np.cumsum(rate * np.diff(t_s, prepend=t_s[0]))
    return _stuck_gyro(t_s, gz, leant, upright) or _unanswered_turns(t_s, leant, turned, upright)


def _stuck_gyro(
    t_s: FloatArray, gz_radps: FloatArray, leant_rad: FloatArray, upright: BoolArray
) -> Finding | None:
    """Where rates (n,) stay the same for long while the accelerometer's angle (n,) shakes."""
    edges = np.flatnonzero(np.diff(gz_radps, prepend=np.nan, append=np.nan) != 0.0)
    long = np.flatnonzero(np.diff(edges) >= FEWEST)
    for a, b in zip(edges[long].tolist(), edges[long + 1].tolist(), strict=True):
        lasting = t_s[b - 1] - t_s[a] >= _STUCK_S and upright[a:b].mean() > 0.9
        if lasting and float(leant_rad[a:b].std()) > _SHAKEN_RAD:
            return Finding(
                "inconsistent",
                f"gz_radps is stuck at {gz_radps[a]:.6g} from {t_s[a]:.1f} to {t_s[b - 1]:.1f} s, where the "
                "accelerometer moves",
                _CHECK_GYRO,
            )
    return None


def _unanswered_turns(
    t_s: FloatArray, leant_rad: FloatArray, turned_rad: FloatArray, upright: BoolArray
) -> Finding | None:
    """Where the accelerometer's angle (n,) turns and the gyroscope's (n,) does not.

    Both are averaged over half a second and compared about their straight lines over five seconds, which take
    a bias out; a line that is steeper than a bias is a turn. A sensor that is carried without turning feels
    its acceleration, whose velocity stays small.
    """
    starts = np.flatnonzero(np.diff(np.floor((t_s - t_s[0]) / _BIN_S), prepend=-1.0))
    size = np.diff(np.append(starts, len(t_s)))
    if len(starts) < _BINS:
        return None
    bins = np.stack([np.add.reduceat(x, starts) / size for x in (t_s, leant_rad, turned_rad, upright)])
    windows = np.lib.stride_tricks.sliding_window_view(bins, _BINS, axis=1).transpose(1, 0, 2)
    t, angles, flat = windows[:, 0], windows[:, 1:3], windows[:, 3].min(axis=1) > 0.9
    flat &= t[:, -1] - t[:, 0] < 2.0 * _BINS * _BIN_S
    k = t - t.mean(axis=1, keepdims=True)
    angles = angles - angles.mean(axis=2, keepdims=True)
    slope = np.einsum("wt,wat->wa", k, angles) / np.maximum((k * k).sum(axis=1), 1e-12)[:, None]
    angles = angles - slope[:, :, None] * k[:, None, :]
    by_accel_rad, by_gyro_rad = angles.std(axis=2).T
    carried_mps = GRAVITY_MPS2 * _BIN_S * np.cumsum(angles[:, 0], axis=1).std(axis=1)
    felt, answered = flat & (by_accel_rad > _FELT_RAD), by_gyro_rad >= _ANSWERED * by_accel_rad
    still = (carried_mps > _CARRIED_MPS) & (np.abs(slope[:, 1]) < _MOST_BIAS_RADPS)
    dead = np.flatnonzero(felt & ~answered & still)
    # In hours of handling some push looks like a turn: in few windows, or between turns that are answered.
    if len(dead) < min(_DEAD, len(felt)):
        return None
    if np.count_nonzero((felt & answered)[dead[0] : dead[-1]]) > len(dead):
        return None
    most = dead[np.argmax(by_accel_rad[dead])]
    return Finding(
        "inconsistent",
        f"gz_radps does not turn from {t_s[starts[dead[0]]]:.1f} s on where the accelerometer's angle "
        f"turns, by {math.degrees(by_accel_rad[most]):.2g} deg at about {t[most].mean():.0f} s",
        _CHECK_GYRO,
    )


def _mirrored_axes(log: LogRows) -> tuple[bool, Finding | None]:
    """Whether a log turns far enough to tell which way, and what is wrong about it."""
    rows = log.sampled(*IN_PLANE)[:_WINDOW]
    if len(rows) < 2 * FEWEST:
        return False, None
    gz, ax, ay = (log.columns[name][rows] for name in IN_PLANE)
    t_s = np.maximum.accumulate(log.t_s[rows])
    if not t_s[-1] > t_s[0]:
        return False, None
    found = turning(t_s, np.stack([ax, ay], axis=1), -gz, [1.0, -1.0])
    if found.turned_rad < _TURNED_RAD:
        return False, None
    if found.misfit[-1.0] > _AGREES or found.misfit[1.0] < _CONTRADICTS:
        return found.misfit[1.0] < _AGREES, None
    middle = math.atan2(float(np.median(ay)), float(np.median(ax)))
    names = {n: log.map.sources[n].column if log.map is not None else n for n in IN_PLANE}
    if abs(abs(middle) - 0.5 * math.pi) < 0.25 * math.pi:
        what = "ax_mps2 and ay_mps2 are swapped"
        lines = f"ax_mps2: {names['ay_mps2']} and ay_mps2: {names['ax_mps2']}"
    else:
        what = "gz_radps, or one of ax_mps2 and ay_mps2, has the wrong sign"
        lines = f"gz_radps: {{column: {names['gz_radps']}, factor: -1}}"
    folder = log.map.folder if log.map is not None else "columns.yaml"
    return True, Finding(
        "inconsistent",
        f"the accelerometer's angle turns against the gyroscope's: {what}",
        f"if so, add to {folder} the line{'s' * (' and ' in lines)} {lines}",
    )


_GYRO_RANGES = tuple(math.radians(r) for r in (125.0, 245.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0))
_ACCEL_RANGES = tuple(g * GRAVITY_MPS2 for g in (2.0, 4.0, 8.0, 16.0, 32.0))
_CLIPPED_IN_A_ROW = 3


def at_range_end(values: FloatArray, gyro: bool) -> BoolArray:
    """Which readings (n,) are at the end of a range that sensors have, where some stay there in a row."""
    out = np.zeros(len(values), dtype=np.bool_)
    known = values[np.isfinite(values)]
    for extreme in (known.max(initial=0.0), known.min(initial=0.0)):
        ends = _GYRO_RANGES if gyro else _ACCEL_RANGES
        if any(0.999 * end <= abs(extreme) <= 1.0005 * end for end in ends):
            held = max((stop - start for start, stop in runs(known == extreme)), default=0)
            out |= (values == extreme) & (held >= _CLIPPED_IN_A_ROW)
    return out


def marker_places(log: LogRows) -> tuple[IntArray, FloatArray]:
    """Rows (n,) with the marker's place, and the places (n, 2)."""
    rows = log.sampled(*MARKER)
    at = np.stack([log.columns[name][rows] for name in MARKER], axis=1) if len(rows) else np.zeros((0, 2))
    return rows, at


_AROUND, _MOVING_PX = 4, 0.3
"""Pictures before and after one over which the marker's speed is taken, and pixels from one to the next."""
_FEWEST_CHANGES, _IN_PHASE, _REPEATING = 40, 0.97, 0.05
"""How many changes, or pictures in motion, tell that cells are held; share of the changes in one phase; and
share of pictures in motion that repeat above that of whole pixels: below 0 in 24 sound logs."""


def held_places(log: LogRows) -> str:
    """What shows that cells of the marker's place hold their last value between pictures; empty otherwise.

    Such places are late by up to a period of the camera.
    """
    _, at = marker_places(log)
    if len(at) <= 2 * _AROUND + _FEWEST_CHANGES:
        return ""
    same = np.concatenate([[False], (np.diff(at, axis=0) == 0.0).all(axis=1)])
    changes = np.flatnonzero(~same)[1:]
    for every in range(2, 11) if len(changes) >= _FEWEST_CHANGES else ():
        if np.bincount(changes % every).max() > _IN_PHASE * len(changes):
            return f"the marker's place changes in one of {every} cells alone, always in step; others hold it"
    before, after = at[_AROUND:-_AROUND] - at[: -2 * _AROUND], at[2 * _AROUND :] - at[_AROUND:-_AROUND]
    # A marker that goes half a pixel stays on its pixel half of the times, without any jitter.
    stays = np.maximum(1.0 - np.abs(before + after) / (2 * _AROUND), 0.0).prod(axis=1)
    # One picture of something else moves on one side of most.
    speed = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) / _AROUND
    moving, repeats = speed > _MOVING_PX, same[_AROUND:-_AROUND]
    if moving.sum() < _FEWEST_CHANGES or np.mean((repeats - stays)[moving]) < _REPEATING:
        return ""
    share = f"{100.0 * repeats[moving].mean():.0f} %"
    return f"{share} of the marker's places repeat where it moves; cells hold it"

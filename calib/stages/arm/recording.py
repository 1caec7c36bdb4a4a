"""What of an arm's log is used, and what is wrong with its recording: jumps, frozen signals, other units.

A quaternion maps the body to the world, or the world to the body; which of both is told by the frame
(`calib.stages.arm.frame`), so poses are held in either way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, runs
from calib.core.errors import BadInputError
from calib.core.verdict import Finding
from calib.io.columns import COMMANDED, POSITION, PRESSURES, PWM, QUATERNION
from calib.io.logs import Log, check_time

_PLANAR = ("tip_x_m", "tip_y_m", "tip_phi_rad")
_SHORTEST_S = 5.0
_JUMP_RAD, _ALONE = math.radians(0.7), 3.0
"""A step between neighbours that is a jump, where it is so many times the usual one about it: an arm that
turns at 60 deg/s makes as large ones at 90 Hz, one after the other."""
_JUMP_SHARE = 0.03
"""Of the chord, between neighbours."""
_BACK_S, _BACK = 0.3, 0.5
"""Motion capture that jumps and jumps back within this time, to less than this share of it, was wrong."""
_LONGEST_M, _MOST_KPA, _LEAST_KPA, _MOST_TURN_RAD = 3.0, 2000.0, 5.0, 2.0 * math.pi
"""No soft arm is so long, takes so much or rolls up twice; hardly one bends by so little a pressure."""
_AIR_KPA = (80.0, 110.0)
"""Pressure of the air, from 2000 m above the sea down to it, with what a vented chamber is off."""
_PSI = (0.08, 0.17)
"""Greatest pressure in psi over the greatest command: valves of a real arm reach .66 to .85 of it in kPa."""
_STILL, _MOVES = 1e-9, 0.2
_FROZEN_S = {"pressure": 1.0, "pose": 1.0, "command": 10.0}
"""A signal that keeps its value to the digit for so long, while what it follows goes through this share of
its range, is frozen; a command may be held, while what it drives settles."""
_BARRED = 0.5
"""Of the command's range, that a pump's dead zone or one past the supply may take: there a pressure rests."""
_UNKNOWN_S = 1.0
"""A gap over which nobody knows the command or the pressure."""
_LEAST_SHARE = 0.1
"""Of the greatest change of a chamber, below which the change of another is noise."""
_Distance = Callable[[FloatArray, FloatArray], FloatArray]
"""Distances (n,) between values (n, k)."""


@dataclass(frozen=True)
class Recording:
    """What of a log is used: rows (n,) of time, and the columns that it has.

    Attributes
    ----------
    command, pressure : (n,) kPa of the driven chamber, NaN where a cell is blank; None without. The command
        is a PWM value where `pwm`.
    turned, chord : (2, n, 4) quaternions of the tip, w last, and (2, n, 3) from base to tip [m], in the frame
        of the base: with the quaternions as they are, and conjugated. Both None for poses in the plane, or
        without motion capture.
    planar : (n, 2) angle [rad] and chord [m] in the plane, None without.
    findings : on the sensors.
    """

    name: str
    source: str
    t_s: FloatArray
    command: FloatArray | None
    pressure: FloatArray | None
    turned: FloatArray | None
    chord: FloatArray | None
    planar: FloatArray | None
    findings: tuple[Finding, ...]
    pwm: bool = False


def read_recording(log: Log, name: str) -> Recording:
    """The columns of an arm's log.

    Raises `BadInputError` for time that goes back, a log of less than 5 s, quaternions that are none, units
    that no arm has, and where not one chamber alone is driven.
    """
    check_time(log)
    t = log.t_s
    if len(t) < 2 or t[-1] - t[0] < _SHORTEST_S:
        raise BadInputError(f"{log.source}: is shorter than {_SHORTEST_S:g} s, expected a whole trial")
    driven = _driven_chamber(log)
    findings = [*_constant_pressures(log, name, driven)]
    turned = chord = planar = None
    if all(one in log.columns for one in (*POSITION, *QUATERNION)):
        turned, chord = _poses(log)
        wrong, jumps = _jumps(log, name, turned[0], chord[0], _rotations_between)
        turned[:, wrong], chord[:, wrong] = np.nan, np.nan
        findings += jumps
    elif all(one in log.columns for one in _PLANAR):
        x, y, phi = (log.columns[one] for one in _PLANAR)
        apart = np.stack([x - log.columns.get("base_x_m", 0.0), y - log.columns.get("base_y_m", 0.0)], axis=1)
        planar = np.stack([phi, np.hypot(*apart.T)], axis=1)
        wrong, jumps = _jumps(log, name, np.stack([np.cos(phi), np.sin(phi)], axis=1), apart)
        planar[wrong] = np.nan
        findings += jumps
    command, pressure = (log.columns.get(names[driven]) for names in (COMMANDED, PRESSURES))
    pwm = command is None and driven < len(PWM) and PWM[driven] in log.columns
    if pwm:
        command = log.columns[PWM[driven]]
    made = Recording(name, log.source, t, command, pressure, turned, chord, planar, tuple(findings), pwm)
    _check_sizes(made)
    return replace(
        made, findings=(*findings, *_odd_pressures(made), *_frozen_signals(made), *_unlogged(made))
    )


def _driven_chamber(log: Log) -> int:
    """Number of the driven chamber from 0. Raises `BadInputError` where none or several are."""
    for names in (COMMANDED, PWM, PRESSURES):
        change = [span(log.columns[n]) if n in log.columns else 0.0 for n in names]
        # A sensor of a chamber that nobody drives is noisy too.
        least = _LEAST_SHARE * max(change) if names is PRESSURES else 0.0
        moving = [k for k, one in enumerate(change) if one > least]
        if len(moving) == 1:
            return moving[0]
        if moving:
            raise BadInputError(
                f"{log.source}: {', '.join(names[k] for k in moving)} change, expected one driven chamber; "
                "an arm is not identified by several at once: record trials in which one is driven"
            )
    raise BadInputError(f"{log.source}: no command and no pressure changes, expected one driven chamber")


def _constant_pressures(log: Log, name: str, driven: int) -> Iterator[Finding]:
    """Pressures of chambers that are not driven, where they never change."""
    others = [n for k, n in enumerate(PRESSURES) if k != driven and n in log.columns]
    if constant := [n for n in others if span(log.columns[n]) == 0.0]:
        yield Finding("remark", f"{name}: {', '.join(constant)} never change: frozen, not used")


def span(values: FloatArray) -> float:
    """Greatest less least value (n,) or column (n, k) that is there; 0 without any."""
    seen = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
    return float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0


def _poses(log: Log) -> tuple[FloatArray, FloatArray]:
    """Quaternions and chords (2, n, ...) as in `Recording`, NaN in rows without a pose or of zeros.

    Raises `BadInputError` for quaternions that are none.
    """
    from scipy.spatial.transform import Rotation

    read = {name: log.columns[name] for name in (*POSITION, *QUATERNION)}
    base, tip = (np.stack([read[f"{of}_q{k}"] for k in "wxyz"], axis=1) for of in ("base", "tip"))
    for of, q in (("base", base), ("tip", tip)):
        # So says motion capture that it has lost a body.
        q[~q.any(axis=1)] = np.nan
        norm = np.linalg.norm(q, axis=1)
        wrong = np.nonzero(np.abs(norm - 1.0) > 0.02)[0]
        if len(wrong):
            raise BadInputError(
                f"{log.source}, line {log.lines[wrong[0]]}: the quaternion {of}_qw, ... has norm "
                f"{norm[wrong[0]]:.4g}, expected 1, or blanks where the body was not seen"
            )
    seen = np.isfinite(base).all(axis=1) & np.isfinite(tip).all(axis=1)
    if not seen.any():
        raise BadInputError(f"{log.source}: no row has poses of base and tip, expected both")
    turned, chord = (np.full((2, len(tip), size), np.nan) for size in (4, 3))
    first, last = (Rotation.from_quat(q[seen][:, [1, 2, 3, 0]]) for q in (base, tip))
    apart = np.stack([read[f"tip_{k}_m"] - read[f"base_{k}_m"] for k in "xyz"], axis=1)
    for way, (a, b) in enumerate([(first, last), (first.inv(), last.inv())]):
        turned[way, seen] = (a.inv() * b).as_quat()
        chord[way, seen] = a.inv().apply(apart[seen])
    return turned, chord


def _rotations_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (n,) [rad] between quaternions (n, 4), whatever their signs."""
    away = np.minimum(np.linalg.norm(first - second, axis=-1), np.linalg.norm(first + second, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(0.5 * away, 1.0)))


def _distances_between(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(first - second, axis=-1))


def _jumps(
    log: Log, name: str, turned: FloatArray, apart: FloatArray, turns: _Distance = _distances_between
) -> tuple[BoolArray, list[Finding]]:
    """Rows (n,) between jumps of rotations (n, k) or places (n, k) [m] there and back, and findings."""
    length = float(np.nanmedian(np.linalg.norm(apart, axis=1))) if np.isfinite(apart).any() else math.inf
    wrong, findings = np.zeros(len(apart), dtype=bool), []
    for values, between, least, scale, unit in (
        (turned, turns, _JUMP_RAD, math.degrees(1.0), "deg"),
        (apart, _distances_between, _JUMP_SHARE * length, 1e3, "mm"),
    ):
        seen = np.flatnonzero(np.isfinite(values).all(axis=1))
        steps = between(values[seen[1:]], values[seen[:-1]])
        # What moves fast does so for several samples.
        far = (steps > least) & (steps > _ALONE * _running_median(steps, 5)) & (np.diff(seen) == 1)
        if far.any():
            first = int(np.argmax(far))
            findings.append(
                Finding(
                    "remark",
                    f"{name}, line {log.lines[seen[first + 1]]}: motion capture jumps by "
                    f"{scale * steps[first]:.1f} {unit} from one sample to the next; {far.sum()} such jumps "
                    "in all",
                )
            )
        wrong[seen[_excursions(log.t_s[seen], values[seen], between, least)]] = True
    if wrong.any():
        findings.append(
            Finding(
                "remark",
                f"{name}: {wrong.sum()} poses are left out, as motion capture jumps there and back within "
                f"{_BACK_S:g} s",
            )
        )
    return wrong, findings


def _running_median(steps: FloatArray, size: int) -> FloatArray:
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(steps, min(size, max(len(steps), 1)), mode="nearest"))


def _excursions(t: FloatArray, values: FloatArray, between: _Distance, least: float) -> IntArray:
    """Rows between a jump away and one back to where values (n, k) were, within `_BACK_S`."""
    steps = between(values[1:], values[:-1])
    usual = _running_median(steps, 1 + 2 * round(0.5 * len(t) / max(t[-1] - t[0], 1.0)) if len(t) else 1)
    jump = (steps > least) & (steps > _ALONE * usual)
    out, after = [np.zeros(0, dtype=np.int64)], 0
    for k in np.flatnonzero(jump).tolist():
        if k < after:
            continue
        rows = np.arange(k + 1, int(np.searchsorted(t, t[k] + _BACK_S, side="right")))
        back = (between(values[rows], values[k]) < _BACK * steps[k]) & jump[rows - 1]
        if back.any():
            after = int(rows[np.argmax(back)])
            out.append(np.arange(k + 1, after))
    return np.concatenate(out)


def _check_sizes(recording: Recording) -> None:
    """Raise `BadInputError` for poses and pressures that no arm has, which are in other units."""
    source, poses = recording.source, recording.chord
    chord = None if poses is None else np.linalg.norm(poses[0], axis=1)
    if recording.planar is not None:
        chord = recording.planar[:, 1]
        most = float(np.nanmax(np.abs(recording.planar[:, 0]), initial=0.0))
        if most > _MOST_TURN_RAD:
            raise BadInputError(
                f"{source}: tip_phi_rad reaches {most:.4g} rad, expected at most {_MOST_TURN_RAD:.2f}; "
                "columns.yaml takes degrees, the column with unit: deg"
            )
    if chord is not None and np.nanmedian(chord) > _LONGEST_M:
        raise BadInputError(
            f"{source}: base and tip are {float(np.nanmedian(chord)):.4g} m apart, expected at most "
            f"{_LONGEST_M:g}; columns.yaml takes millimetres, each column with factor: 0.001"
        )
    most = max(_greatest_kpa(recording).values(), default=0.0)
    if most > _MOST_KPA:
        raise BadInputError(
            f"{source}: pressures reach {most:.4g} kPa, expected at most {_MOST_KPA:g}; columns.yaml takes "
            "Pa, each column with factor: 0.001, and hPa or mbar with factor: 0.1"
        )


def _greatest_kpa(recording: Recording) -> dict[str, float]:
    """Greatest command and pressure by these words, whatever the sign; none of a pump under PWM."""
    both = {} if recording.pwm else {"command": recording.command, "pressure": recording.pressure}
    read = {what: one for what, one in both.items() if one is not None and np.isfinite(one).any()}
    return {what: float(np.nanmax(np.abs(one))) for what, one in read.items()}


def _odd_pressures(recording: Recording) -> Iterator[Finding]:
    """Pressures that look as if they were in psi or bar, or counted from vacuum."""
    name, command, pressure = recording.name, recording.command, recording.pressure
    if command is not None and pressure is not None and not recording.pwm:
        (asked, greatest), (least, most) = (np.nanpercentile(one, (1.0, 99.0)) for one in (command, pressure))
        # A chamber that is never vented does not rise above its command.
        if _AIR_KPA[0] < least < _AIR_KPA[1] and least - asked > _AIR_KPA[0] and most > greatest:
            yield Finding(
                "poor",
                f"{name}: its pressure is {least:.4g} kPa at the least, where the command goes down to "
                f"{asked:.3g} kPa, as one that counts from vacuum",
                "columns.yaml takes off the air's from such a column with offset: 101.3",
            )
            return
        if _PSI[0] * greatest < most < _PSI[1] * greatest:
            yield Finding(
                "poor",
                f"{name}: its pressure is {most:.3g} kPa at most, where the command goes up to "
                f"{greatest:.3g} kPa, as psi would",
                "columns.yaml takes psi with factor: 6.895",
            )
            return
    for what, most in _greatest_kpa(recording).items():
        if 0.0 < most < _LEAST_KPA:
            yield Finding(
                "poor",
                f"{name}: its {what} is {most:.3g} kPa at most, as bar would",
                "look for its unit; columns.yaml takes bar with factor: 100",
            )


def _frozen_signals(recording: Recording) -> Iterator[Finding]:
    """Signals that keep their value while what they follow, or what follows them, moves."""
    t = recording.t_s
    poses = recording.planar
    if poses is None and recording.turned is not None:
        poses = recording.turned[0]
    signals = {"command": recording.command, "pressure": recording.pressure, "pose": poses}
    there = {name: values for name, values in signals.items() if values is not None and span(values) > 0.0}
    for name, values in there.items():
        least_s = _FROZEN_S[name]
        others = [other for other in there if other != name and (other != "pose" or name == "command")]
        steps = np.abs(np.diff(values.reshape(len(values), -1), axis=0)).max(axis=1)
        for first, last in runs(steps <= _STILL):
            if t[last] - t[first] < least_s:
                continue
            # What moved before the signal stood still may still arrive.
            rows = slice(int(np.searchsorted(t, t[first] + 0.5 * least_s)), last + 1)
            moves = _unsettled_range if name == "command" else span
            barred = name == "pressure" and values[first] in (np.nanmin(values), np.nanmax(values))
            least = _BARRED if barred else _MOVES
            moved = [other for other in others if moves(there[other][rows]) > least * span(there[other])]
            if moved:
                yield Finding(
                    "poor",
                    f"{recording.name}: its {name} stands still from {t[first] - t[0]:.1f} to "
                    f"{t[last] - t[0]:.1f} s while its {moved[0]} moves: frozen",
                    "leave that log out, or cut it before it freezes",
                )
                break


def _unsettled_range(values: FloatArray) -> float:
    """By how much values (n,) or columns (n, k) move that do not settle: go back, or move most later on."""
    columns = values.reshape(len(values), -1)
    seen = columns[np.isfinite(columns).all(axis=1)]
    if not len(seen):
        return 0.0
    falls, rises = np.maximum.accumulate(seen) - seen, seen - np.minimum.accumulate(seen)
    back = float(np.minimum(falls.max(axis=0), rises.max(axis=0)).max())
    early, late = (span(half) for half in np.array_split(seen, 2))
    return max(back, late if late > early else 0.0)


def _unlogged(recording: Recording) -> Iterator[Finding]:
    """Stretches in which nothing tells what drove the arm."""
    t = recording.t_s
    for name, values in (("command", recording.command), ("pressure", recording.pressure)):
        if values is None or not np.isfinite(values).any():
            continue
        there = np.isfinite(values)
        # What is logged where it changes, as a command, is known between.
        at = t[there] if there.mean() > 0.5 else t
        long = np.flatnonzero(np.diff(at) > _UNKNOWN_S)
        if len(long):
            first, last = at[long[0] : long[0] + 2] - t[0]
            yield Finding(
                "poor",
                f"{recording.name}: has no {name} from {first:.1f} to {last:.1f} s, which a free run needs",
                "split that log there",
            )

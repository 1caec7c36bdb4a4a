"""From logs and a rig to what the IMU's stages take."""

from __future__ import annotations

import gzip
import io
import math
import zlib
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray, integral
from calib.core.errors import BadInputError
from calib.core.files import as_text, read_bytes, shown
from calib.core.options import LogOptions
from calib.core.rig import Rig
from calib.core.verdict import Finding
from calib.io.columns import ACCEL, GYRO, IMU, IN_PLANE
from calib.io.logs import Log, Signals, log_from_cells
from calib.solve.clock import Part, time_axis
from calib.solve.delay import estimate_delay
from calib.stages.imu.drift import truth_late_s, turned_angles
from calib.stages.imu.levelling import GAP_S
from calib.stages.imu.sampling import (
    AXES,
    MOST_GYRO_RADPS,
    Readings,
    limit_findings,
    quiet_spread,
    regular_parts,
    sampling_findings,
    without_gaps,
)
from calib.stages.imu.tracks import angle_of, on_grid, rate_of
from calib.stages.imu.tuning import DATA_SHEET, SHORTEST_S, Noise, Piece, TuneLog, smooth_log

_AXIS = dict(zip(IMU, AXES, strict=True))
"""Axes by column."""


def _readings(log: Log, *needed: str, counts: bool = False) -> Signals:
    """Readings of an IMU: the columns needed and all others of it that the log has, in the order of `IMU`.

    Raises `BadInputError` for a log without them, and for readings that are all zero.
    """
    there = [name for name in IMU if name in needed or np.isfinite(log.columns.get(name, np.nan)).any()]
    if not any(name in log.columns for name in IMU):
        raise BadInputError(
            f"{log.source}: has no IMU, expected columns as gz_radps, ax_mps2 and ay_mps2 beside t_s"
        )
    if not there:
        raise BadInputError(f"{log.source}: the IMU's columns hold no number")
    signals = log.signals(*there, optional=IMU, counts=counts)
    if len(signals) < 2:
        raise BadInputError(f"{log.source}: has {len(signals)} IMU sample, expected a log of some seconds")
    if not signals.values.any():
        raise BadInputError(f"{log.source}: all IMU readings are zero, expected noise and gravity")
    return signals


def _angle(log: Log, name: str) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and readings (k,) of an angle, empty where it is not logged."""
    rows = log.sampled(name)
    if not len(rows):
        return np.zeros(0), np.zeros(0)
    # As those of the IMU: samples of a burst were not taken at the one time that they are stamped with.
    return time_axis(np.maximum.accumulate(log.t_s[rows])).t_s, log.columns[name][rows]


def rest_log(log: Log) -> Readings:
    """The IMU's readings of a log at rest. Raises `BadInputError` for readings that never change."""
    signals = _readings(log)
    if signals.stuck == signals.names:
        raise BadInputError(
            f"{log.source}: no IMU reading ever changes ({', '.join(signals.names)}), expected noise"
        )
    return _of(log, signals)


def _of(log: Log, signals: Signals, *findings: Finding) -> Readings:
    """Signals of a log with the angles beside them."""
    units = {_AXIS[name][0] for name in signals.names if log.unit(name) == "counts"}
    return Readings(
        log.source, tuple(_AXIS[name] for name in signals.names), signals.stamps_s, signals.values,
        *_angle(log, "onchip_phi_rad"), *_angle(log, "true_phi_rad"),
        signals.repeated_rows, (*findings, *signals.findings), "".join(sorted(units)),
    )  # fmt: skip


def drift_log(log: Log) -> Readings:
    """The IMU's readings and the angles of a log in which it may move.

    Raises `BadInputError` for a log without gz, ax and ay, and where one of these never changes.
    """
    signals = _readings(log, *IN_PLANE)
    signals.refuse_stuck(*IN_PLANE)
    left_out = tuple(
        Finding("remark", f"{name} never changes, it is stuck at {signals[name][0]:.6g}; left out")
        for name in signals.stuck
    )
    return _of(log, signals.without(*signals.stuck), *left_out)


# ----------------------------------------------------------------------
# Logs as `calib.stages.imu.tuning` takes them: angles and rates on an even grid, and what to judge them by.

_TUNELOGS_FEWEST = 20
_SHORTEST_S = 1.0
"""Pieces of less are passed over."""
_MOST_AT_LIMIT = 1e-3
_APART = 0.03
"""Share of the rate by which -gz may differ from the up vector's."""


@dataclass(frozen=True)
class Reading:
    """How logs are to be read.

    Attributes
    ----------
    tilted : take the rate from the up vector (`calib.stages.imu.tracks`) and not -gz.
    reference : auto, truth, camera, onchip or none; auto takes the camera where the log has it.
    angle_seen : from pixels (n, 2) to the bending angle (n,), None where the rig has no plane.
    """

    tilted: bool
    reference: str
    angle_seen: Callable[[FloatArray], FloatArray] | None = None


def sensor_noise(rig: Rig, logs: Sequence[TuneLog]) -> tuple[Noise, str]:
    """Densities of the gyroscope about z, and where they are from.

    From the section imu of the rig's file; else the noise of the quietest log where a second of it is
    at rest; what neither tells is that of a data sheet.
    """
    imu = rig.imu
    walk, walk_from = DATA_SHEET.walk, "a data sheet's walk of the bias"
    if imu is not None:
        found = imu.gyro_walk_radps2_per_sqrt_Hz[2]
        if found:
            walk, walk_from = found, "its walk of the bias"
        white = imu.gyro_noise_radps_per_sqrt_Hz[2]
        if white:
            return Noise(white, walk, DATA_SHEET.accel), f"imu in the rig's file, {walk_from}"
    quiet = [
        log.quiet_radps * math.sqrt(log.sampling.period_s)
        for log in logs
        if 0.0 < log.quiet_radps < MOST_GYRO_RADPS
    ]
    if quiet:
        return Noise(min(quiet), walk, DATA_SHEET.accel), f"the logs' rests, {walk_from}"
    return DATA_SHEET, "a data sheet"


def _reference(log: Log, read: Readings, how: Reading) -> tuple[str, FloatArray, FloatArray]:
    """Which reference the log is judged by, "" for none, its times (k,) and its angle (k,)."""
    rows, name, none = log.sampled("u_px", "v_px"), how.reference, np.zeros(0)
    seen = len(rows) >= _TUNELOGS_FEWEST
    if name == "auto":
        # A truth is for scores: gains that were chosen by it say nothing of a rig that has none.
        name = "camera" if seen and how.angle_seen is not None else "none"
    if name == "none":
        return "", none, none
    camera = "a camera, but the rig's file has no plane" if seen else "no columns u_px and v_px"
    times, phi, lacks = {
        "truth": (read.true_t_s, read.true_phi_rad, "no column true_phi_rad"),
        "onchip": (read.onchip_t_s, read.onchip_phi_rad, "no column onchip_phi_rad"),
        "camera": (none, none, camera),
    }[name]
    if name == "camera" and seen and how.angle_seen is not None:
        pixels = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
        phi = how.angle_seen(pixels)
        known = np.isfinite(phi)
        if int(known.sum()) < _TUNELOGS_FEWEST:
            raise BadInputError(
                f"{log.source}: the marker is not on the rig's plane, expected this rig's camera"
            )
        times, phi = log.t_s[rows][known], phi[known]
    if len(times) < _TUNELOGS_FEWEST:
        raise BadInputError(f"{log.source}: has {lacks}, expected one for --reference {name}")
    return name, times, phi


def _turns_in_plane(part: Part, axes: tuple[str, ...], quiet_radps: float) -> bool:
    """Whether -gz is the up vector's rate, as far as six axes show it; True where there are fewer."""
    if len(axes) < 6:
        return True
    plane = rate_of(part, axes, False)
    apart = float((rate_of(part, axes, True) - plane).std())
    least = 3.0 * quiet_radps if quiet_radps < MOST_GYRO_RADPS else 0.0
    return apart <= max(_APART * float(plane.std()), least)


def _lag(
    late_t_s: FloatArray,
    late_rad: FloatArray,
    parts: Sequence[Part],
    rates: Sequence[FloatArray],
    axes: tuple[str, ...],
    period_s: float,
) -> float:
    """By how much a reference is later than the longest part's own smoothed angle [s]."""
    k = max(range(len(parts)), key=lambda i: len(parts[i].values))
    part, rate = parts[k], rates[k]
    t = part.t_s
    turned = own = integral(t, rate)
    if len(rate) * period_s >= SHORTEST_S + period_s:
        own = smooth_log(t, angle_of(part, axes), rate, DATA_SHEET.gyro, DATA_SHEET.walk).phi_rad
    return estimate_delay(late_t_s, np.unwrap(late_rad), t, own, turned)


def tune_log(log: Log, how: Reading) -> TuneLog:
    """A log's angles and rates.

    Raises
    ------
    BadInputError as `drift_log`, for a reference that was asked for and is not
    there, for missing axes where the up vector is asked for, and for a log without a second of samples.
    """
    read = drift_log(log)
    said = [f"{log.source}: {one.text}" for one in read.findings if one.severity == "remark"]
    if how.tilted and read.lacks:
        raise BadInputError(
            f"{log.source}: has no readings of {', '.join(read.lacks)}, expected all six axes for --rate up"
        )
    sampling, parts = regular_parts(read)
    period = sampling.period_s
    said += [one.text for one in sampling_findings(sampling, source=log.source)]
    # The angle takes three of the axes; readings of a knock are too few to matter.
    limits = (
        one
        for one in limit_findings(sampling, read.axes, _MOST_AT_LIMIT)
        if one.text[:2] in ("gz", "ax", "ay")
    )
    whole = without_gaps(parts, period)
    if len(whole) > len(parts):
        said.append(f"{log.source}: judged in {len(whole)} parts, apart by gaps of more than {GAP_S:g} s")
    kept = [part for part in whole if len(part.values) * period >= _SHORTEST_S]
    if not kept:
        raise BadInputError(
            f"{log.source}: has {sampling.samples} IMU samples over {sampling.duration_s:.3g} s, expected "
            "some seconds without a gap"
        )
    gz = read.axes.index("gz")
    quiet = float(quiet_spread(tuple(kept), period)[gz])
    named, late_t_s, phi = _reference(log, read, how)
    lag, pieces = 0.0, []
    references: tuple[FloatArray | None, ...] = (None,) * len(kept)
    rates = [rate_of(part, read.axes, how.tilted) for part in kept]
    if named:
        if named == "truth":
            turned = turned_angles(kept, read.axes)
            lag = truth_late_s(turned, on_grid(late_t_s, phi, kept, period), period)
        else:
            lag = _lag(late_t_s, phi, kept, rates, read.axes, period)
        references = on_grid(late_t_s - lag, phi, kept, period)
    for part, rate, reference in zip(kept, rates, references, strict=True):
        t = part.t_s - part.t_s[0]
        known = reference is not None and int(np.isfinite(reference).sum()) >= _TUNELOGS_FEWEST
        flat = how.tilted or _turns_in_plane(part, read.axes, quiet)
        angles = angle_of(part, read.axes)
        pieces.append(Piece(log.source, t, angles, rate, reference if known else None, flat))
    if not all(piece.in_plane for piece in pieces):
        said.append(
            f"{log.source}: the sensor tilts out of the plane, where -gz is not the rate of the angle; "
            "--rate up takes it from the up vector"
        )
    findings = (*limits, *read.findings)
    return TuneLog(log.source, sampling, tuple(pieces), named, lag, quiet, tuple(said), findings)


# ----------------------------------------------------------------------
# Readings of an IMU in many poses: from a log, or from a file of each sensor as imu_tk keeps them.
#
# imu_tk's files have lines of four numbers, time in seconds and x, y, z, in raw counts or in SI, and may be
# compressed with gzip. The gyroscope's readings are put on the accelerometer's times by straight lines
# where they have others.

_MOST_BYTES = 1 << 25


def pose_log(log: Log, planar: bool = False) -> Readings:
    """The IMU's readings of a log in many poses, counts as they are; `planar` keeps what lies in the plane.

    Raises `BadInputError` for a log without an accelerometer, and with an axis that never changes.
    """
    signals = _readings(log, "ax_mps2", "ay_mps2", counts=True)
    if planar:
        # A lean of the plane is read from az; stuck, it tells nothing.
        signals = signals.without("gx_radps", "gy_radps", *({"az_mps2"} & set(signals.stuck)))
    hint = "" if planar else "; give --planar to do without az, gx and gy"
    signals.refuse_stuck(*signals.names, hint=hint)
    return _of(log, signals)


def _unpacked(path: Path) -> bytes:
    data = read_bytes(path, _MOST_BYTES)
    if data[:2] != b"\x1f\x8b":
        return data
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            out = stream.read(_MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInputError(f"{shown(path)}: is not a gzip file that can be read: {error}") from error
    if len(out) > _MOST_BYTES:
        raise BadInputError(f"{shown(path)}: unpacks to more than {_MOST_BYTES / 1e6:g} MB")
    return out


def _four_numbers(path: Path) -> FloatArray:
    """Lines of time, x, y, z as an array (n, 4); rows that say nan or inf are left out."""
    text = as_text(path, _unpacked(path))
    cells, at = array("d"), array("q")
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith(("#", "%")):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 4:
            where, found = f"{shown(path)}, line {number}", shown(line.strip()[:40])
            raise BadInputError(f"{where}: is {found!r}, expected four numbers: t, x, y, z")
        if all(map(math.isfinite, row)):
            cells.extend(row)
            at.append(number)
    if not at:
        raise BadInputError(f"{shown(path)}: has no readings, expected lines of t, x, y, z")
    values = np.array(cells).reshape(-1, 4)
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    if len(back):
        i = int(back[0])
        raise BadInputError(
            f"{shown(path)}, line {at[i + 1]}: the time goes back from {values[i, 0]:.6f} to "
            f"{values[i + 1, 0]:.6f}, expected time to run forward"
        )
    return values


def read_pose_files(accel: Path, gyro: Path | None, options: LogOptions) -> tuple[Log, list[str]]:
    """A log from a file of the accelerometer and one of the gyroscope, and sentences about them.

    Raises `BadInputError` for lines that are not four numbers, for files of different times, and for units as
    any log.
    """
    a = _four_numbers(accel)
    source = shown(accel)
    remarks: list[str] = []
    cells = {"t_s": a[:, 0]} | {name: a[:, 1 + k] for k, name in enumerate(ACCEL)}
    if gyro is not None:
        w = _four_numbers(gyro)
        if len(w) != len(a) or not np.array_equal(w[:, 0], a[:, 0]):
            inside = (a[:, 0] >= w[0, 0]) & (a[:, 0] <= w[-1, 0])
            if inside.sum() < 0.5 * len(a):
                raise BadInputError(
                    f"{shown(gyro)}: runs from {w[0, 0]:g} to {w[-1, 0]:g} s, expected the times of "
                    f"{source}, {a[0, 0]:g} to {a[-1, 0]:g} s"
                )
            cells = {name: column[inside] for name, column in cells.items()}
            w = np.stack([cells["t_s"], *(np.interp(cells["t_s"], w[:, 0], c) for c in w.T[1:])], axis=1)
            remarks.append(f"{shown(gyro)}: has other times than {source}; put on those by straight lines")
        cells |= {name: w[:, 1 + k] for k, name in enumerate(GYRO)}
    return log_from_cells(source, accel, cells, options), remarks

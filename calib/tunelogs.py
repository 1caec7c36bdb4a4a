"""Logs as `calib.imu.tuning` takes them: angles and rates on an even grid, and what to judge them by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.camera.model import Camera
from calib.driftlogs import drift_log
from calib.errors import BadInputError
from calib.imu.gains import DATA_SHEET, Noise
from calib.imu.mahony_batch import accelerometer_angles
from calib.imu.rate import planar_rate, up_vector
from calib.imu.rest import MOST_GYRO_RADPS, quiet_spread
from calib.imu.sampling import Part, Sampling, regular_parts
from calib.imu.smoother import SHORTEST_S, smooth_log
from calib.imu.static import is_gyro
from calib.imu.tracks import DriftLog, on_grid
from calib.imu.tuning import Piece
from calib.logs import ROWS_MISSING, Log, read_log
from calib.phi_reference import angle_from_pixels, lag_of
from calib.rig import Rig

__all__ = ["REFERENCES", "Reading", "TuneLog", "read_tune_log", "sensor_noise"]

REFERENCES = ("auto", "truth", "camera", "onchip", "none")
_FEWEST = 20
_SHORTEST_S = 1.0
"""Pieces of less are passed over."""
_APART = 0.03
"""Share of the rate by which -gz may differ from the up vector's."""


@dataclass(frozen=True)
class Reading:
    """How logs are to be read.

    Attributes
    ----------
    acc_unit, gyro_unit : of the columns.
    tilted : take the rate from the up vector (`calib.imu.rate`) and not -gz.
    reference : one of `REFERENCES`; auto takes the first of truth and camera that the log has.
    camera, A_inverse : of the rig, None where it has no plane.
    """

    acc_unit: str = "m/s2"
    gyro_unit: str = "rad/s"
    tilted: bool = False
    reference: str = "auto"
    camera: Camera | None = None
    A_inverse: FloatArray | None = None


@dataclass(frozen=True)
class TuneLog:
    """A log on an even grid.

    Attributes
    ----------
    pieces : without gaps of more than a second.
    reference : "truth", "camera", "onchip" or "" for none, and by how much it came late.
    quiet_radps : standard deviation of gz in the quiet windows.
    said : what is to be known about the log.
    """

    source: str
    sampling: Sampling
    pieces: tuple[Piece, ...]
    reference: str
    lag_s: float
    quiet_radps: float
    said: tuple[str, ...]


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


def _sampling_said(source: str, sampling: Sampling) -> list[str]:
    said = []
    if sampling.repeated_rows:
        share = sampling.repeated_rows / (sampling.samples + sampling.repeated_rows)
        said.append(f"{source}: {sampling.repeated_rows} rows ({share:.2%}) repeat the one before; dropped")
    if sampling.repeated_stamps:
        share = sampling.repeated_stamps / sampling.samples
        said.append(
            f"{source}: {sampling.repeated_stamps} samples ({share:.2%}) bear the stamp of the one before; "
            "put on an even grid"
        )
    filled = [gap for gap in sampling.gaps if not gap.split]
    if filled:
        longest = max(filled, key=lambda gap: gap.duration_s)
        said.append(
            f"{source}: {sampling.missing} samples missing in {len(filled)} gaps, the longest of "
            f"{longest.duration_s:.3g} s at {longest.at_s:.5g} s; filled with straight lines"
        )
    said += [
        f"{source}: split at a gap of {gap.duration_s:.5g} s after {gap.at_s:.5g} s"
        for gap in sampling.gaps
        if gap.split
    ]
    if any(sampling.at_limit):
        said.append(f"{source}: {int(sampling.at_limit.sum())} readings are at the end of the sensor's range")
    return said


def _wanted(log: Log, read: DriftLog, how: Reading) -> str:
    """Which reference the log is judged by."""
    seen = len(log.sampled("u_px", "v_px")) >= _FEWEST
    has = {
        "truth": len(read.true_t_s) >= _FEWEST,
        "camera": seen and how.A_inverse is not None,
        "onchip": len(read.onchip_t_s) >= _FEWEST,
    }
    if how.reference == "auto":
        return next((name for name in ("truth", "camera") if has[name]), "")
    if how.reference == "none":
        return ""
    if not has[how.reference]:
        lacks = {
            "truth": "no column true_phi_rad",
            "camera": "no columns u_px and v_px" if not seen else "a camera, but the rig's file has no plane",
            "onchip": "no column onchip_phi_rad",
        }[how.reference]
        raise BadInputError(f"{log.source}: has {lacks}, expected one for --reference {how.reference}")
    return how.reference


def _camera_angle(log: Log, how: Reading) -> tuple[FloatArray, FloatArray]:
    assert how.camera is not None
    assert how.A_inverse is not None
    rows = log.sampled("u_px", "v_px")
    pixels = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
    phi = angle_from_pixels(how.camera, how.A_inverse, pixels)
    known = np.isfinite(phi)
    if int(known.sum()) < _FEWEST:
        raise BadInputError(f"{log.source}: the marker is not on the rig's plane, expected this rig's camera")
    return log.t_s[rows][known], phi[known]


def _rate(part: Part, axes: tuple[str, ...], period_s: float, tilted: bool) -> FloatArray:
    def column(name: str) -> FloatArray:
        return part.values[:, axes.index(name)]

    if not tilted:
        return np.asarray(-column("gz"))
    gyro = np.stack([column(f"g{x}") for x in "xyz"], axis=1)
    force = np.stack([column(f"a{x}") for x in "xyz"], axis=1)
    return planar_rate(gyro, up_vector(force, gyro, period_s))


def _turns_in_plane(part: Part, axes: tuple[str, ...], period_s: float, quiet_radps: float) -> bool:
    """Whether -gz is the up vector's rate, as far as six axes show it; True where there are fewer."""
    if len(axes) < 6:
        return True
    plane = _rate(part, axes, period_s, tilted=False)
    apart = float((_rate(part, axes, period_s, tilted=True) - plane).std())
    least = 3.0 * quiet_radps if quiet_radps < MOST_GYRO_RADPS else 0.0
    return apart <= max(_APART * float(plane.std()), least)


def _lag(
    seen: tuple[FloatArray, FloatArray],
    parts: Sequence[Part],
    rates: Sequence[FloatArray],
    axes: tuple[str, ...],
    period_s: float,
) -> float:
    """By how much a reference is later than the longest part's own smoothed angle [s]."""
    k = max(range(len(parts)), key=lambda i: len(parts[i].values))
    part, rate = parts[k], rates[k]
    if len(rate) * period_s < SHORTEST_S + period_s:
        return 0.0
    t = period_s * np.arange(len(rate), dtype=np.float64)
    ax, ay = (np.ascontiguousarray(part.values[:, axes.index(name)]) for name in ("ax", "ay"))
    own = smooth_log(t, accelerometer_angles(ax, ay), rate, DATA_SHEET.gyro, DATA_SHEET.walk)
    # A rate that holds for the step before its sample is half a step ahead.
    return lag_of(seen[0], np.unwrap(seen[1]), part.start_s + t, own.phi_rad - 0.5 * period_s * rate)


def read_tune_log(path: Path, how: Reading) -> TuneLog:
    """A log's angles and rates.

    Raises
    ------
    BadInputError as `calib.driftlogs.drift_log`, for a reference that was asked for and is not there, for
    missing axes where the up vector is asked for, and for a log without a second of samples.
    """
    log = read_log(path)
    read, more = drift_log(log, how.acc_unit, how.gyro_unit)
    said = [*more, *log.passed_over(ROWS_MISSING)]
    lacking = [f"{k}{x}" for k in "ga" for x in "xyz" if f"{k}{x}" not in read.axes]
    if how.tilted and lacking:
        raise BadInputError(
            f"{log.source}: has no readings of {', '.join(lacking)}, expected all six axes for --rate up"
        )
    sampling, parts = regular_parts(read.t_s, read.values, is_gyro(read.axes), log.source)
    period = sampling.period_s
    said += _sampling_said(log.source, sampling)
    kept = [part for part in parts if len(part.values) * period >= _SHORTEST_S]
    if not kept:
        raise BadInputError(
            f"{log.source}: has {sampling.samples} IMU samples over {sampling.duration_s:.3g} s, expected "
            "some seconds without a gap"
        )
    gz = read.axes.index("gz")
    quiet = float(quiet_spread(tuple(kept), period)[gz])
    named = _wanted(log, read, how)
    lag = 0.0
    seen: tuple[FloatArray, FloatArray] | None = None
    if named == "truth":
        seen = (read.true_t_s, read.true_phi_rad)
    elif named == "onchip":
        seen = (read.onchip_t_s, read.onchip_phi_rad)
    elif named == "camera":
        seen = _camera_angle(log, how)
    pieces = []
    references: tuple[FloatArray | None, ...] = (None,) * len(kept)
    rates = [_rate(part, read.axes, period, how.tilted) for part in kept]
    if seen is not None:
        if named != "truth":
            lag = _lag(seen, kept, rates, read.axes, period)
        references = on_grid(seen[0] - lag, seen[1], kept, period)
    for part, rate, reference in zip(kept, rates, references, strict=True):
        ax, ay = (np.ascontiguousarray(part.values[:, read.axes.index(name)]) for name in ("ax", "ay"))
        t = period * np.arange(len(rate), dtype=np.float64)
        known = reference is not None and int(np.isfinite(reference).sum()) >= _FEWEST
        flat = how.tilted or _turns_in_plane(part, read.axes, period, quiet)
        angles = accelerometer_angles(ax, ay)
        pieces.append(Piece(log.source, t, angles, rate, reference if known else None, flat))
    if not all(piece.in_plane for piece in pieces):
        said.append(
            f"{log.source}: the sensor tilts out of the plane, where -gz is not the rate of the angle; "
            "--rate up takes it from the up vector"
        )
    return TuneLog(log.source, sampling, tuple(pieces), named, lag, quiet, tuple(said))

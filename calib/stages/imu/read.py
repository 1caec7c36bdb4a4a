"""From logs and a rig to what the IMU's stages take."""

from __future__ import annotations

import gzip
import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import as_text, read_bytes, shown
from calib.core.geometry import apply_homography
from calib.core.rig import Rig
from calib.io.logs import ROWS_MISSING, Log, check_time, read_log
from calib.solve.clock import Part
from calib.stages.actuator.kinematics import MARKER_OFFSET_M
from calib.stages.camera.model import Camera, undistort
from calib.stages.imu.intrinsics import PoseLog
from calib.stages.imu.mahony import accelerometer_angles
from calib.stages.imu.sampling import (
    MOST_GYRO_RADPS,
    Sampling,
    quiet_spread,
    regular_parts,
    sampling_findings,
)
from calib.stages.imu.static import AXES, RestLog, is_gyro
from calib.stages.imu.tracks import DriftLog, on_grid, planar_rate, up_vector
from calib.stages.imu.tuning import DATA_SHEET, SHORTEST_S, Noise, Piece, smooth_log

# ----------------------------------------------------------------------
# Readings of an IMU at rest from logs, in SI, with what is wrong about them said in a sentence.
#
# A sensor at rest feels g, so that specific forces in g or in raw counts give themselves away, and no
# sensor turns faster or is louder at rest than the limits below, so that deg/s do.

ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665}
GYRO_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0}

_COLUMN = {axis: f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES}
_FASTEST_RADPS = 45.0
_LARGEST_BIAS_RADPS = 0.35
_ABOUT_G = (8.3, 11.3)


def _axes(log: Log) -> tuple[str, ...]:
    named = [axis for axis in AXES if _COLUMN[axis] in log.columns]
    if not named:
        raise BadInputError(
            f"{log.source}: has no IMU, expected columns as gz_radps, ax_mps2 and ay_mps2 beside t_s"
        )
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_COLUMN[axis]]).any()))
    if not axes:
        raise BadInputError(
            f"{log.source}: the IMU's columns {', '.join(_COLUMN[a] for a in named)} hold no number"
        )
    return axes


def _check_changes(log: Log, axes: tuple[str, ...], values: FloatArray) -> None:
    if len(values) < 2:
        raise BadInputError(f"{log.source}: has {len(values)} IMU sample, expected a log of minutes at rest")
    if not values.any():
        raise BadInputError(f"{log.source}: all IMU readings are zero, expected noise and gravity")
    if not np.ptp(values, axis=0).any():
        raise BadInputError(
            f"{log.source}: no IMU reading ever changes ({', '.join(axes)}), expected noise of a sensor"
        )


def _check_units(log: Log, axes: tuple[str, ...], values: FloatArray, t_s: FloatArray) -> None:
    gyro = is_gyro(axes)
    middle = np.median(values, axis=0)
    if int((~gyro).sum()) == 3:
        norm = float(np.median(np.linalg.norm(values[:, ~gyro], axis=1)))
        if 0.85 <= norm <= 1.15:
            raise BadInputError(
                f"{log.source}: the specific force at rest is {norm:.4g}, so it is in g, expected m/s^2; "
                "give --acc-unit g"
            )
        if not _ABOUT_G[0] <= norm <= _ABOUT_G[1]:
            kind = "raw counts" if norm > 150.0 else "no unit that is known here"
            raise BadInputError(
                f"{log.source}: the specific force at rest is {norm:.4g} ({kind}), expected about 9.81 m/s^2"
            )
    if not gyro.any():
        return
    rates = values[:, gyro]
    period = max(float(np.median(np.diff(t_s))), 1e-6)
    places = np.arange(len(rates))
    quiet = float(quiet_spread((Part(t_s, rates, places, places),), period).max())
    largest, bias = float(np.abs(rates).max()), float(np.abs(middle[gyro]).max())
    why = ""
    if largest > _FASTEST_RADPS:
        why = f"reaches {largest:.4g}"
    elif bias > _LARGEST_BIAS_RADPS:
        why = f"has a bias of {bias:.3g}"
    elif quiet > MOST_GYRO_RADPS:
        why = f"is never quieter than {quiet:.3g}"
    if why:
        raise BadInputError(
            f"{log.source}: the gyroscope {why}, which no gyroscope at rest does in rad/s; if it is in "
            "deg/s, give --gyro-unit deg/s"
        )


def rest_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s") -> RestLog:
    """The IMU's readings of a log in SI.

    Raises
    ------
    BadInputError for a log without an IMU or without readings, whose time runs backwards, whose readings
    never change, and for units that are obviously others.
    """
    axes = _axes(log)
    rows = log.sampled(*(_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    factor = np.where(is_gyro(axes), GYRO_UNITS[gyro_unit], ACCEL_UNITS[acc_unit])
    values = np.stack([log.columns[_COLUMN[axis]][rows] for axis in axes], axis=1) * factor
    t_s = log.t_s[rows]
    _check_changes(log, axes, values)
    _check_units(log, axes, values, t_s)
    chip = log.sampled("onchip_phi_rad")
    angle = log.columns["onchip_phi_rad"][chip] if len(chip) else np.zeros(0)
    return RestLog(log.source, axes, t_s, values, log.t_s[chip], angle)


def read_rest_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s"
) -> tuple[RestLog, Sequence[str]]:
    """`rest_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    return rest_log(log, acc_unit, gyro_unit), said


# ----------------------------------------------------------------------
# The bending angle that the rig's camera sees, as a reference for angles of the IMU.
#
# Of an arc of constant curvature the chord to the head has half of the head's angle (3.10), and the marker
# (mx, my) lies d further along the head's tangent (A.1). Both together give
#
#     tan(phi / 2) = mx / (my + d)
#
# whatever the length. Pictures come late; by how much follows from the log: the lag is the one at which
# the camera's angle differs least from another angle of the same log.

_LAGS_S = np.arange(-0.02, 0.1201, 0.001)
_FEWEST = 30


def angle_from_marker(marker_m: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Bending angle phi (n,) [rad] of marker positions (n, 2) in the plane [m]."""
    x, y = np.moveaxis(np.asarray(marker_m, dtype=np.float64), -1, 0)
    return np.asarray(2.0 * np.arctan2(x, y + offset_m))


def angle_from_pixels(
    camera: Camera, A_inverse: FloatArray, pixels: FloatArray, offset_m: float = MARKER_OFFSET_M
) -> FloatArray:
    """Bending angle phi (n,) [rad] of the marker in distorted pixels (n, 2), NaN beyond the horizon.

    Parameters
    ----------
    A_inverse : (3, 3) from ideal pixels to metres (2.12).
    """
    rays = undistort(camera, pixels)
    ideal = np.column_stack([rays, np.ones(len(rays))]) @ camera.K[:2].T
    return angle_from_marker(apply_homography(A_inverse, ideal), offset_m)


def lag_of(late_t_s: FloatArray, late_rad: FloatArray, t_s: FloatArray, phi_rad: FloatArray) -> float:
    """By how much [s] one angle (m,) is later than another (n,), from -20 to 120 ms; 0 for standing still.

    The lag of least variance of the difference; between the two neighbours it is that of the parabola.
    """
    known = np.isfinite(late_rad) & (late_t_s > t_s[0] + 0.13) & (late_t_s < t_s[-1] - 0.03)
    if int(known.sum()) < _FEWEST:
        return 0.0
    at, late = late_t_s[known], late_rad[known]
    variance = np.array([float((late - np.interp(at - lag, t_s, phi_rad)).var()) for lag in _LAGS_S.tolist()])
    k = int(np.argmin(variance))
    # A minimum at the end, or one that stands out by nothing, tells no lag.
    if k in (0, len(_LAGS_S) - 1) or float(variance.max()) < 1.02 * float(variance[k]):
        return 0.0
    a, b, c = variance[k - 1 : k + 2].tolist()
    bend = a - 2.0 * b + c
    return float(_LAGS_S[k] + (0.5 * 0.001 * (a - c) / bend if bend > 0.0 else 0.0))


# ----------------------------------------------------------------------
# Readings of an IMU from logs in which it may move, in SI, with what is wrong about them said.
#
# A sensor in motion is no measure of its own units, so the calmest tenth of the log is looked at: there
# the specific force is about g. The gyroscope has to turn about as far as the accelerometer's angle within
# a second; in deg/s it turns 57 times as far. Where the log is at rest throughout, the limits of its noise
# and bias hold as well.

_DRIFTLOGS_COLUMN = {f"a{x}": f"a{x}_mps2" for x in "xyz"} | {f"g{x}": f"g{x}_radps" for x in "xyz"}
_ORDER = ("gx", "gy", "gz", "ax", "ay", "az")
_NEEDED = ("gz", "ax", "ay")
_DRIFTLOGS_FASTEST_RADPS = 45.0
_DRIFTLOGS_LARGEST_BIAS_RADPS = 0.35
_DRIFTLOGS_ABOUT_G = (7.0, 13.0)
_CALM = 0.1
_WINDOW = 50
_FARTHER = 12.0
_LEAST_TURN_RAD = 0.05
_REST_RAD = 0.02


def _driftlogs_axes(log: Log) -> tuple[str, ...]:
    named = [axis for axis in _ORDER if _DRIFTLOGS_COLUMN[axis] in log.columns]
    if not named:
        raise BadInputError(
            f"{log.source}: has no IMU, expected columns as gz_radps, ax_mps2 and ay_mps2 beside t_s"
        )
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_DRIFTLOGS_COLUMN[axis]]).any()))
    lacking = [axis for axis in _NEEDED if axis not in axes]
    if lacking:
        raise BadInputError(
            f"{log.source}: has no readings in {', '.join(_COLUMN[axis] for axis in lacking)}, expected "
            "gz_radps, ax_mps2 and ay_mps2"
        )
    return axes


def _driftlogs_check_changes(log: Log, axes: tuple[str, ...], values: FloatArray) -> tuple[str, ...]:
    """The axes that never change, of those that the angle does not need."""
    if len(values) < 2:
        raise BadInputError(f"{log.source}: has {len(values)} IMU sample, expected a log of some seconds")
    if not values.any():
        raise BadInputError(f"{log.source}: all IMU readings are zero, expected noise and gravity")
    stuck = tuple(axis for axis, span in zip(axes, np.ptp(values, axis=0), strict=True) if span == 0.0)
    for axis in _NEEDED:
        if axis in stuck:
            at = float(values[0, axes.index(axis)])
            raise BadInputError(
                f"{log.source}: {axis} never changes, it is stuck at {at:.6g}; expected noise of a sensor"
            )
    return stuck


def _windows(values: FloatArray) -> FloatArray:
    size = min(_WINDOW, len(values))
    count = len(values) // size
    return values[: count * size].reshape(count, size, -1)


def _check_force(log: Log, axes: tuple[str, ...], calm: FloatArray) -> None:
    which = [k for k, axis in enumerate(axes) if axis[0] == "a"]
    norm = float(np.median(np.linalg.norm(calm[:, :, which], axis=2)))
    if 0.85 <= norm <= 1.15:
        raise BadInputError(
            f"{log.source}: the specific force is {norm:.4g} where the log is calm, so it is in g, expected "
            "m/s^2; give --acc-unit g"
        )
    if len(which) == 3 and not _DRIFTLOGS_ABOUT_G[0] <= norm <= _DRIFTLOGS_ABOUT_G[1]:
        kind = "raw counts" if norm > 150.0 else "no unit that is known here"
        raise BadInputError(
            f"{log.source}: the specific force is {norm:.4g} where the log is calm ({kind}), expected about "
            "9.81 m/s^2"
        )


def _turning(axes: tuple[str, ...], values: FloatArray, t_s: FloatArray) -> tuple[float, float, float]:
    """RMS [rad] within windows of a second of the accelerometer's angle and of -gz summed up, and the
    spread of the accelerometer's angle over the whole log."""
    phi = np.unwrap(np.arctan2(values[:, axes.index("ay")], values[:, axes.index("ax")]))
    turned = np.concatenate([[0.0], np.cumsum(-values[1:, axes.index("gz")] * np.diff(t_s))])
    period = max(float(np.median(np.diff(t_s))), 1e-6)
    size = min(max(round(1.0 / period), 4), len(phi))
    count = len(phi) // size
    by_acc, by_gyro = (
        float(np.median(x[: count * size].reshape(count, size).std(axis=1))) for x in (phi, turned)
    )
    return by_acc, by_gyro, float(phi.std())


def _check_rates(
    log: Log, axes: tuple[str, ...], values: FloatArray, calm: FloatArray, t_s: FloatArray
) -> None:
    which = [k for k, axis in enumerate(axes) if axis[0] == "g"]
    largest = float(np.abs(values[:, which]).max())
    quiet = float(np.median(calm[:, :, which].std(axis=1), axis=0).max())
    bias = float(np.abs(np.median(calm[:, :, which], axis=(0, 1))).max())
    by_acc, by_gyro, spread = _turning(axes, values, t_s)
    at_rest = spread < _REST_RAD
    why = ""
    if largest > _DRIFTLOGS_FASTEST_RADPS:
        why = f"reaches {largest:.4g}"
    elif by_gyro > max(_LEAST_TURN_RAD, _FARTHER * by_acc):
        why = f"turns {by_gyro / max(by_acc, 1e-6):.3g} times as far as the accelerometer's angle"
    elif at_rest and bias > _DRIFTLOGS_LARGEST_BIAS_RADPS:
        why = f"has a bias of {bias:.3g}"
    elif at_rest and quiet > MOST_GYRO_RADPS:
        why = f"is never quieter than {quiet:.3g}"
    if why:
        raise BadInputError(
            f"{log.source}: the gyroscope {why}, which no gyroscope does in rad/s; if it is in deg/s, give "
            "--gyro-unit deg/s"
        )


def drift_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s") -> tuple[DriftLog, tuple[str, ...]]:
    """The IMU's readings and the angles of a log in SI, and sentences about axes that were left out.

    Raises
    ------
    BadInputError for a log without gz, ax and ay, whose time runs backwards, whose readings never change,
    and for units that are obviously others.
    """
    axes = _driftlogs_axes(log)
    rows = log.sampled(*(_DRIFTLOGS_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    factor = np.array([(GYRO_UNITS[gyro_unit] if a[0] == "g" else ACCEL_UNITS[acc_unit]) for a in axes])
    values = np.stack([log.columns[_DRIFTLOGS_COLUMN[axis]][rows] for axis in axes], axis=1) * factor
    t_s = log.t_s[rows]
    stuck = _driftlogs_check_changes(log, axes, values)
    windows = _windows(values)
    # Relative to each axis's own middle, so that units play no part.
    loud = windows.std(axis=1)
    loud = (loud / np.maximum(np.median(loud, axis=0), 1e-12)).max(axis=1)
    calm = windows[np.argsort(loud, kind="stable")[: max(math.ceil(_CALM * len(windows)), 1)]]
    _check_force(log, axes, calm)
    _check_rates(log, axes, values, calm, t_s)
    said = []
    if stuck:
        keep = [k for k, axis in enumerate(axes) if axis not in stuck]
        for axis in stuck:
            at = float(values[0, axes.index(axis)])
            said.append(f"{log.source}: {axis} never changes, it is stuck at {at:.6g}; left out")
        axes, values = tuple(axes[k] for k in keep), values[:, keep]
    chip, true = log.sampled("onchip_phi_rad"), log.sampled("true_phi_rad")
    empty = np.zeros(0)
    return DriftLog(
        log.source,
        axes,
        t_s,
        values,
        log.t_s[chip],
        log.columns["onchip_phi_rad"][chip] if len(chip) else empty,
        log.t_s[true],
        log.columns["true_phi_rad"][true] if len(true) else empty,
    ), tuple(said)


def read_drift_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s"
) -> tuple[DriftLog, Sequence[str]]:
    """`drift_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    found, more = drift_log(log, acc_unit, gyro_unit)
    return found, [*said, *more]


# ----------------------------------------------------------------------
# Logs as `calib.stages.imu.tuning` takes them: angles and rates on an even grid, and what to judge them by.

REFERENCES = ("auto", "truth", "camera", "onchip", "none")
_TUNELOGS_FEWEST = 20
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
    tilted : take the rate from the up vector (`calib.stages.imu.tracks`) and not -gz.
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


def _wanted(log: Log, read: DriftLog, how: Reading) -> str:
    """Which reference the log is judged by."""
    seen = len(log.sampled("u_px", "v_px")) >= _TUNELOGS_FEWEST
    has = {
        "truth": len(read.true_t_s) >= _TUNELOGS_FEWEST,
        "camera": seen and how.A_inverse is not None,
        "onchip": len(read.onchip_t_s) >= _TUNELOGS_FEWEST,
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
    if int(known.sum()) < _TUNELOGS_FEWEST:
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
    t = part.t_s
    ax, ay = (np.ascontiguousarray(part.values[:, axes.index(name)]) for name in ("ax", "ay"))
    own = smooth_log(t, accelerometer_angles(ax, ay), rate, DATA_SHEET.gyro, DATA_SHEET.walk)
    # A rate that holds for the step before its sample is half a step ahead.
    return lag_of(seen[0], np.unwrap(seen[1]), t, own.phi_rad - 0.5 * period_s * rate)


def read_tune_log(path: Path, how: Reading) -> TuneLog:
    """A log's angles and rates.

    Raises
    ------
    BadInputError as `calib.stages.imu.read.drift_log`, for a reference that was asked for and is not
    there, for missing axes where the up vector is asked for, and for a log without a second of samples.
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
    said += [one.text for one in sampling_findings(sampling, read.axes, log.source)]
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
        t = part.t_s - part.t_s[0]
        known = reference is not None and int(np.isfinite(reference).sum()) >= _TUNELOGS_FEWEST
        flat = how.tilted or _turns_in_plane(part, read.axes, period, quiet)
        angles = accelerometer_angles(ax, ay)
        pieces.append(Piece(log.source, t, angles, rate, reference if known else None, flat))
    if not all(piece.in_plane for piece in pieces):
        said.append(
            f"{log.source}: the sensor tilts out of the plane, where -gz is not the rate of the angle; "
            "--rate up takes it from the up vector"
        )
    return TuneLog(log.source, sampling, tuple(pieces), named, lag, quiet, tuple(said))


# ----------------------------------------------------------------------
# Readings of an IMU in many poses: from a log, or from a file of each sensor as imu_tk keeps them.
#
# imu_tk's files have lines of four numbers, time in seconds and x, y, z, in raw counts or in SI, and may be
# compressed with gzip. The gyroscope's readings are put on the accelerometer's times by straight lines
# where they have others.

_POSELOGS_COLUMN = {axis: f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES}
_POSELOGS_FASTEST_RADPS = 45.0
_POSELOGS_LARGEST_BIAS_RADPS = 0.35
_POSELOGS_ABOUT_G = (7.5, 12.5)
_MOST_BYTES = 500_000_000
_ODD_COUNTS = 150.0


def _poselogs_check_changes(source: str, axes: tuple[str, ...], values: FloatArray, planar: bool) -> None:
    if len(values) < 2:
        raise BadInputError(f"{source}: has {len(values)} IMU sample, expected rests in many poses")
    if not values.any():
        raise BadInputError(f"{source}: all IMU readings are zero, expected noise and gravity")
    for axis, column in zip(axes, values.T, strict=True):
        if float(np.ptp(column)) == 0.0:
            hint = "; give --planar to do without it" if axis in ("az", "gx", "gy") and not planar else ""
            raise BadInputError(
                f"{source}: {axis} is stuck at {column[0]:g}, expected readings that follow the poses{hint}"
            )


def _check_accel(source: str, accel: FloatArray, unit: str) -> None:
    """The length of the specific force is about g most of the time, if two axes lie in the plane too."""
    if unit == "counts":
        return
    length = float(np.median(np.linalg.norm(accel, axis=1)))
    if unit == "m/s2" and accel.shape[1] == 2 and length < 0.7:
        # Two axes may be far from the vertical; only what cannot be m/s^2 is named.
        return
    if unit == "m/s2" and 0.7 <= length <= 1.3:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g}, so it is in g, expected m/s^2; "
            "give --acc-unit g"
        )
    if length > _ODD_COUNTS:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g}, so it is in raw counts, expected m/s^2; "
            "give --acc-unit counts"
        )
    if not _POSELOGS_ABOUT_G[0] <= length <= _POSELOGS_ABOUT_G[1] and accel.shape[1] == 3:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g} m/s^2, expected about 9.81; see --acc-unit"
        )


def _check_gyro(source: str, gyro: FloatArray, unit: str) -> None:
    """No sensor that is put from pose to pose turns this fast or rests at such a rate."""
    if unit == "counts":
        return
    largest, middle = float(np.abs(gyro).max()), float(np.abs(np.median(gyro, axis=0)).max())
    why = ""
    if largest > _POSELOGS_FASTEST_RADPS:
        why = f"reaches {largest:.4g} rad/s"
    elif middle > _POSELOGS_LARGEST_BIAS_RADPS:
        why = f"has a bias of {middle:.3g} rad/s"
    if not why:
        return
    other = "counts" if middle > _ODD_COUNTS else "deg/s"
    if unit == other:
        raise BadInputError(f"{source}: the gyroscope {why}, which none does; see --gyro-unit")
    raise BadInputError(
        f"{source}: the gyroscope {why}, which none does that is put from pose to pose; if it is in {other}, "
        f"give --gyro-unit {other}"
    )


def _made(
    source: str,
    axes: tuple[str, ...],
    t_s: FloatArray,
    values: FloatArray,
    units: tuple[str, str],
    planar: bool,
) -> PoseLog:
    """The readings in SI or counts, looked at. With `planar` only what lies in the plane is kept."""
    accel_unit, gyro_unit = units
    if planar:
        kept = [k for k, axis in enumerate(axes) if axis not in ("gx", "gy")]
        # A lean of the plane is read from az; stuck, it tells nothing.
        kept = [k for k in kept if axes[k] != "az" or float(np.ptp(values[:, k])) > 0.0]
        axes, values = tuple(axes[k] for k in kept), values[:, kept]
    gyro = is_gyro(axes)
    factor = np.where(gyro, GYRO_UNITS.get(gyro_unit, 1.0), ACCEL_UNITS.get(accel_unit, 1.0))
    values = values * factor
    _poselogs_check_changes(source, axes, values, planar)
    in_plane = [axis in ("ax", "ay") or (axis == "az" and not planar) for axis in axes]
    _check_accel(source, values[:, in_plane], accel_unit)
    if gyro.any():
        _check_gyro(source, values[:, gyro], gyro_unit)
    return PoseLog(
        source,
        axes,
        t_s,
        values,
        "counts" if accel_unit == "counts" else "m/s2",
        "counts" if gyro_unit == "counts" else "rad/s",
    )


def pose_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s", planar: bool = False) -> PoseLog:
    """The IMU's readings of a log; with the unit "counts" its columns are taken as they are.

    Raises
    ------
    BadInputError for a log without an accelerometer or without readings, whose time runs backwards, with
    an axis that never changes, and for units that are obviously others.
    """
    named = [axis for axis in AXES if _POSELOGS_COLUMN[axis] in log.columns]
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_POSELOGS_COLUMN[axis]]).any()))
    if not named:
        raise BadInputError(f"{log.source}: has no IMU, expected columns as ax_mps2, ay_mps2 and gz_radps")
    if not axes:
        raise BadInputError(
            f"{log.source}: the IMU's columns {', '.join(_COLUMN[a] for a in named)} hold no number"
        )
    if "ax" not in axes or "ay" not in axes:
        raise BadInputError(f"{log.source}: has no accelerometer, expected columns ax_mps2 and ay_mps2")
    rows = log.sampled(*(_POSELOGS_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    values = np.stack([log.columns[_POSELOGS_COLUMN[axis]][rows] for axis in axes], axis=1)
    return _made(log.source, axes, log.t_s[rows], values, (acc_unit, gyro_unit), planar)


def read_pose_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s", planar: bool = False
) -> tuple[PoseLog, Sequence[str]]:
    """`pose_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    return pose_log(log, acc_unit, gyro_unit, planar), said


def _unpacked(path: Path) -> bytes:
    data = read_bytes(path)
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
    rows: list[list[float]] = []
    at: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith(("#", "%")):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 4:
            raise BadInputError(
                f"{shown(path)}, line {number}: is {shown(line[:40])!r}, expected four numbers: t, x, y, z"
            )
        if all(np.isfinite(row)):
            rows.append(row)
            at.append(number)
    if not rows:
        raise BadInputError(f"{shown(path)}: has no readings, expected lines of t, x, y, z")
    values = np.array(rows)
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    if len(back):
        i = int(back[0])
        raise BadInputError(
            f"{shown(path)}, line {at[i + 1]}: the time goes back from {values[i, 0]:.6f} to "
            f"{values[i + 1, 0]:.6f}, expected time to run forward"
        )
    return values


def read_pose_files(
    accel: Path,
    gyro: Path | None = None,
    acc_unit: str = "m/s2",
    gyro_unit: str = "rad/s",
    planar: bool = False,
) -> tuple[PoseLog, Sequence[str]]:
    """Readings from a file of the accelerometer, and one of the gyroscope, and sentences about them.

    Raises `BadInputError` as `pose_log`, for lines that are not four numbers, and for files of different
    times.
    """
    a = _four_numbers(accel)
    source = shown(accel)
    said: list[str] = []
    if gyro is None:
        return _made(source, ("ax", "ay", "az"), a[:, 0], a[:, 1:], (acc_unit, gyro_unit), planar), said
    w = _four_numbers(gyro)
    rates = w[:, 1:]
    if len(w) != len(a) or not np.array_equal(w[:, 0], a[:, 0]):
        inside = (a[:, 0] >= w[0, 0]) & (a[:, 0] <= w[-1, 0])
        if inside.sum() < 0.5 * len(a):
            raise BadInputError(
                f"{shown(gyro)}: runs from {w[0, 0]:g} to {w[-1, 0]:g} s, expected the times of {source}, "
                f"{a[0, 0]:g} to {a[-1, 0]:g} s"
            )
        a = a[inside]
        rates = np.stack([np.interp(a[:, 0], w[:, 0], column) for column in w.T[1:]], axis=1)
        said.append(f"{shown(gyro)}: has other times than {source}; put on those by straight lines")
    values = np.hstack([rates, a[:, 1:]])
    return _made(source, AXES, a[:, 0], values, (acc_unit, gyro_unit), planar), said

"""Camera and IMU of a moving rig brought into line: time offset, mount angle, scales, biases, marker.

Under constant curvature two pixels tell the angle and the length, so that what camera and IMU say of the
same motion can be compared: `align_start` finds where to begin, `align_solve` fits the sensors'
quantities and a spline of the motion to all readings at once (continuous-time batch estimation: Furgale,
Barfoot and Sibley 2012). Priors come from outside; where the posterior is no narrower, the logs say nothing.

The covariance is that of the fit plus that of biases that have walked by K sqrt(T / 3) in the mean of a log.
At rest the mount angle and the bias along y are one number,

    atan2((1 + s_y) g sin(alpha) + b_y, (1 + s_x) g cos(alpha) + b_x),

what the accelerometer reads at phi = 0; it comes with its own deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.estimator.align_problem import Noise, Problem, Stretch, pictures_off, readings_off
from calib.estimator.align_solve import Fit, response, solve
from calib.estimator.align_start import AlignLog, Correlation, Piece, correlation, pieces_of, start
from calib.estimator.sensors import GRAVITY_MPS2, SENSOR

__all__ = ["Alignment", "LogCheck", "Settings", "Trace", "align", "rest_angle"]

_OUTLIER_AREA_PX2 = 1256.0
_FIRST_NOISE = Noise(1.0, 0.05, np.array([0.2, 0.2, 0.01]))
_GYRO, _AX, _AY, _MOUNT, _OFFSET = (
    SENSOR.index(name)
    for name in (
        "gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2", "mount_angle_rad", "time_offset_s",
    )
)  # fmt: skip
_SX, _SY = SENSOR.index("accel_scale_x"), SENSOR.index("accel_scale_y")


@dataclass(frozen=True)
class Settings:
    """What is known beforehand.

    Attributes
    ----------
    view : (24,) of `sensors.view_coefficients`.
    mean, sigma : (13,) prior of `SENSOR`. The mount angle's mean is replaced by a first guess.
    grid_px : step of the pixels. gyro_walk, accel_walk : densities K of the biases' walk.
    """

    view: FloatArray
    mean: FloatArray
    sigma: FloatArray
    grid_px: float = 1.0
    gravity_mps2: float = GRAVITY_MPS2
    across_m: float = 0.0
    gyro_walk: float = 1e-5
    accel_walk: float = 1e-4


@dataclass(frozen=True)
class LogCheck:
    """A log's part in the fit.

    Attributes
    ----------
    pictures, outliers : used, and those that more likely show something else.
    samples, duration_s, stretches : of the IMU.
    camera_rate_hz, imu_rate_hz, camera_jitter_s, imu_jitter_s, repeated, missing : of the clocks.
    turned_rad : standard deviation of phi over the log.
    camera_rms_px, gyro_rms_radps, accel_rms_mps2 : residuals.
    """

    source: str
    pictures: int
    outliers: int
    samples: int
    duration_s: float
    stretches: int
    camera_rate_hz: float
    imu_rate_hz: float
    camera_jitter_s: float
    imu_jitter_s: float
    repeated: int
    missing: int
    turned_rad: float
    camera_rms_px: float
    gyro_rms_radps: float
    accel_rms_mps2: float


@dataclass(frozen=True)
class Trace:
    """Residuals of a stretch for figures, with the first guess of the sensors and with the fit.

    Attributes
    ----------
    log : number. camera_s, imu_s : times. good : (n,). camera_before, camera_after : (n, 2) [px].
    imu_before, imu_after : (m, 3).
    """

    log: int
    camera_s: FloatArray
    good: FloatArray
    camera_before: FloatArray
    camera_after: FloatArray
    imu_s: FloatArray
    imu_before: FloatArray
    imu_after: FloatArray


@dataclass(frozen=True)
class Alignment:
    """What was found.

    Attributes
    ----------
    sensor, covariance : (13,) and (13, 13) of `SENSOR`; mean, prior : (13,) prior and its deviations.
    rest_angle_rad, rest_angle_sigma : what the accelerometer reads at phi = 0 at rest.
    noise, converged, steps : of the fit. moves : the first guess could see the offset. factor : of the
        gyroscope against the camera.
    """

    sensor: FloatArray
    covariance: FloatArray
    mean: FloatArray
    prior: FloatArray
    rest_angle_rad: float
    rest_angle_sigma: float
    noise: Noise
    converged: bool
    steps: int
    moves: bool
    factor: float
    logs: tuple[LogCheck, ...]
    traces: tuple[Trace, ...]
    correlation: Correlation
    said: tuple[str, ...]

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (13,)."""
        return np.sqrt(np.diag(self.covariance))


def rest_angle(sensor: FloatArray, gravity_mps2: float = GRAVITY_MPS2) -> tuple[float, FloatArray]:
    """Angle that the accelerometer reads at phi = 0 at rest, and its gradient (13,)."""
    alpha = sensor[_MOUNT]
    ca, sa = math.cos(alpha), math.sin(alpha)
    x = (1.0 + sensor[_SX]) * gravity_mps2 * ca + sensor[_AX]
    y = (1.0 + sensor[_SY]) * gravity_mps2 * sa + sensor[_AY]
    square = x * x + y * y
    by_x, by_y = -y / square, x / square
    gradient = np.zeros(len(SENSOR))
    gradient[_AX], gradient[_AY] = by_x, by_y
    gradient[_SX], gradient[_SY] = by_x * gravity_mps2 * ca, by_y * gravity_mps2 * sa
    gradient[_MOUNT] = gravity_mps2 * (by_y * (1.0 + sensor[_SY]) * ca - by_x * (1.0 + sensor[_SX]) * sa)
    return math.atan2(y, x), gradient


def _walked(settings: Settings, problem: Problem, fit: Fit) -> FloatArray:
    """Covariance (13, 13) from biases that differ from stretch to stretch."""
    total = np.zeros((len(SENSOR), len(SENSOR)))
    nothing = [np.zeros_like(stretch.pixels) for stretch in problem.stretches]
    for i, stretch in enumerate(problem.stretches):
        duration = float(stretch.imu_s[-1] - stretch.imu_s[0])
        for channel, walk in enumerate((settings.accel_walk, settings.accel_walk, settings.gyro_walk)):
            change = [np.zeros_like(other.readings) for other in problem.stretches]
            change[i][:, channel] = walk * math.sqrt(duration / 3.0)
            moved = response(problem, fit, nothing, change)
            total += np.outer(moved, moved)
    return total


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def _traces(problem: Problem, first: FloatArray, fit: Fit) -> tuple[Trace, ...]:
    out = []
    for stretch, c, good in zip(problem.stretches, fit.coefficients, fit.good, strict=True):
        out.append(
            Trace(
                stretch.log, stretch.camera_s, good,
                pictures_off(problem, stretch, c, first), pictures_off(problem, stretch, c, fit.sensor),
                stretch.imu_s,
                readings_off(problem, stretch, c, first), readings_off(problem, stretch, c, fit.sensor),
            )
        )  # fmt: skip
    return tuple(out)


def _check(
    number: int, log: AlignLog, pieces: Sequence[Piece], stretches: Sequence[Stretch], fit: Fit,
    traces: Sequence[Trace],
) -> LogCheck:  # fmt: skip
    own = [i for i, stretch in enumerate(stretches) if stretch.log == number]
    mine = [piece for piece in pieces if piece.log == number]
    good = np.concatenate([fit.good[i] for i in own]) if own else np.zeros(0)
    imu = np.concatenate([traces[i].imu_after for i in own]) if own else np.zeros((0, 3))
    pictures = [traces[i].camera_after[fit.good[i] > 0.5] for i in own]
    # The coefficients at the ends lie outside of the readings.
    phi = [fit.coefficients[i][8:-8, 0] for i in own]

    def middle(values: list[float], invert: bool = False) -> float:
        value = float(np.median(values)) if values else math.nan
        return 1.0 / value if invert else value

    return LogCheck(
        source=log.source,
        pictures=len(good),
        outliers=int((good < 0.5).sum()),
        samples=len(imu),
        duration_s=sum(float(stretches[i].imu_s[-1] - stretches[i].imu_s[0]) for i in own),
        stretches=len(own),
        camera_rate_hz=middle([piece.camera.period_s for piece in mine], True),
        imu_rate_hz=middle([piece.imu.period_s for piece in mine], True),
        camera_jitter_s=middle([piece.camera.jitter_s for piece in mine]),
        imu_jitter_s=middle([piece.imu.jitter_s for piece in mine]),
        repeated=sum(piece.camera.repeated + piece.imu.repeated for piece in mine),
        missing=sum(piece.camera.missing + piece.imu.missing for piece in mine),
        turned_rad=float(np.std(np.concatenate(phi))) if phi else 0.0,
        camera_rms_px=_rms(np.concatenate(pictures)) if pictures else math.nan,
        gyro_rms_radps=_rms(imu[:, 2]),
        accel_rms_mps2=_rms(imu[:, :2]),
    )


def align(logs: Sequence[AlignLog], settings: Settings) -> Alignment:
    """Find what the sensors are from logs, all at once.

    Raises `BadInputError` where no log has a stretch to work on, and for a gyroscope in other units.
    """
    pieces, said = pieces_of(logs, settings.view, settings.mean)
    if not pieces:
        raise BadInputError(said[0] if said else "no log has pictures and IMU samples")
    first = start(pieces, logs, float(settings.mean[_OFFSET]))
    if not first.stretches:
        raise BadInputError(
            f"{logs[pieces[0].log].source}: hardly any picture shows a place where the marker can be, "
            "expected pictures of the marker on the head"
        )
    mean = settings.mean.copy()
    mean[_MOUNT] = first.mount_angle_rad
    problem = Problem(
        settings.view, settings.gravity_mps2, settings.across_m, settings.grid_px, _OUTLIER_AREA_PX2,
        first.stretches, mean, settings.sigma,
    )  # fmt: skip
    sensor = mean.copy()
    sensor[_OFFSET] = first.time_offset_s
    fit = solve(problem, sensor, _FIRST_NOISE)
    covariance = fit.covariance + _walked(settings, problem, fit)
    angle, gradient = rest_angle(fit.sensor, settings.gravity_mps2)
    # Before: the sensors as they were assumed to be.
    before = mean.copy()
    before[_MOUNT] = 0.0
    traces = _traces(problem, before, fit)
    checks = tuple(
        _check(number, log, pieces, first.stretches, fit, traces) for number, log in enumerate(logs)
    )
    return Alignment(
        fit.sensor, covariance, mean, settings.sigma, angle,
        math.sqrt(float(gradient @ covariance @ gradient)), fit.noise, fit.converged, fit.steps, first.moves,
        first.factor, checks, traces, correlation(pieces), tuple(said),
    )  # fmt: skip

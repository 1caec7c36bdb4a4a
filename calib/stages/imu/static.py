"""An IMU at rest: biases, noise, motions left out, and whether to trust them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from calib.core.arrays import BoolArray, FloatArray
from calib.core.errors import BadInputError
from calib.core.verdict import Finding, Verdict
from calib.solve.clock import Part
from calib.stages.imu.allan import LEAST_SAMPLES, Allan, analyse
from calib.stages.imu.sampling import Motion, Sampling, regular_parts, rest_parts, sampling_findings

# ----------------------------------------------------------------------
# An inertial sensor at rest: bias, noise, drift of its angle, and whether the log was at rest at all.
#
# Noise is fitted to all logs together (`calib.stages.imu.allan`), each axis for itself. The bias of one log
# is the mean of its readings. White noise alone lets it err by N^2 / T; as a bias that walks is not at
# the log's end what it was on average, and flickers besides, the variance of the bias that is met
# afterwards is
#
#     sigma^2 = N^2 / T + 2 ln 2 / pi B^2 + K^2 T / 3.
#
# Where the log is too short to show a walk, K^2 is what it cannot exclude, so that a short log does not
# look better than it is. With several logs the spread of their means counts, where it is larger, by
# Student's distribution.
#
# The drift of the angle phi is the slope of -gz integrated, minus the mean of gz, and that of the angle
# that the chip itself reports (Fig. 2.4). The latter's deviation follows from the slopes of eight
# stretches, as its error is no white noise.
#
# A single pose does not tell an accelerometer's bias from gravity: of it the mean is given.

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
"""Rates of rotation [rad/s] and specific forces [m/s^2] by name."""

_SAME_RATE = 0.02
_STRETCHES = 8
_MEAN_FLICKER = 2.0 * math.log(2.0) / math.pi


@dataclass(frozen=True)
class RestLog:
    """Readings of a log that claims to be at rest.

    Attributes
    ----------
    source : name for messages.
    axes : those of `AXES` that it has.
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings, rad/s and m/s^2.
    onchip_t_s, onchip_phi_rad : (k,) the chip's own angle, empty where it is not logged.
    repeated_rows : that were written twice and are left out. findings : on the sensors.
    """

    source: str
    axes: tuple[str, ...]
    t_s: FloatArray
    values: FloatArray
    onchip_t_s: FloatArray
    onchip_phi_rad: FloatArray
    repeated_rows: int = 0
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Drift:
    """Slope of an angle over a log and its standard deviation [rad/s]."""

    slope_radps: float
    sigma_radps: float


@dataclass(frozen=True)
class StaticLog:
    """What one log shows.

    Attributes
    ----------
    sampling : rate, jitter, gaps, steps.
    motions : where it moves; `rest_s` is what is left.
    mean : (axes,) of the rest.
    gyro, onchip : drift of the angle by -gz and by the chip, None without that column.
    """

    source: str
    sampling: Sampling
    parts: tuple[Part, ...]
    motions: tuple[Motion, ...]
    rest_s: float
    mean: FloatArray
    gyro: Drift | None
    onchip: Drift | None


@dataclass(frozen=True)
class AxisNoise:
    """Bias and noise of one axis over all logs.

    Attributes
    ----------
    bias : mean over the logs, for an accelerometer with gravity in it.
    sigma_mean : deviation of the mean from white noise alone.
    sigma, low, high : deviation and 95 % interval of the bias that is met after the logs.
    spread : standard deviation from log to log, NaN for one log.
    allan : None where the axis never changes.
    """

    axis: str
    bias: float
    sigma_mean: float
    sigma: float
    low: float
    high: float
    spread: float
    allan: Allan | None


@dataclass(frozen=True)
class Static:
    """All logs together; `rate_hz` is that of the even grid."""

    axes: tuple[str, ...]
    rate_hz: float
    logs: tuple[StaticLog, ...]
    noise: tuple[AxisNoise, ...]


def is_gyro(axes: Sequence[str]) -> BoolArray:
    """Which of the axes are rates of rotation."""
    return np.array([axis.startswith("g") for axis in axes])


def _slope(t_s: FloatArray, angle_rad: FloatArray) -> Drift | None:
    if len(t_s) < 4 * _STRETCHES or t_s[-1] <= t_s[0]:
        return None
    angle = np.unwrap(angle_rad)
    t = t_s - t_s.mean()
    slope = float(t @ (angle - angle.mean()) / (t @ t))
    at = np.linspace(0, len(t) - 1, _STRETCHES + 1).astype(np.int64)
    length = np.diff(t[at])
    if float(length.min()) <= 0.0:
        return Drift(slope, math.nan)
    pieces = np.diff(angle[at]) / length
    return Drift(slope, float(pieces.std(ddof=1) / math.sqrt(_STRETCHES)))


def _rest_of(log: RestLog) -> StaticLog:
    gyro = is_gyro(log.axes)
    sampling, parts = regular_parts(log.t_s, log.values, gyro, log.source, log.repeated_rows)
    still, motions = rest_parts(parts, sampling.period_s, gyro, sampling.step)
    samples = sum(len(part.values) for part in still)
    if max((len(part.values) for part in still), default=0) < LEAST_SAMPLES:
        if motions:
            raise BadInputError(f"{log.source}: is never at rest, expected a log of a sensor at rest")
        raise BadInputError(
            f"{log.source}: has {sampling.samples} IMU samples without a long gap, expected at least "
            f"{LEAST_SAMPLES}"
        )
    mean = np.concatenate([part.values for part in still]).mean(axis=0)
    onchip = None
    if not motions:
        onchip = _slope(log.onchip_t_s, log.onchip_phi_rad)
    return StaticLog(log.source, sampling, still, motions, samples * sampling.period_s, mean, None, onchip)


def _with_gyro_drift(log: StaticLog, axes: tuple[str, ...], noise: tuple[AxisNoise, ...]) -> StaticLog:
    if "gz" not in axes or log.motions:
        return log
    k = axes.index("gz")
    allan = noise[k].allan
    sigma = math.nan if allan is None else allan.N.value / math.sqrt(log.rest_s)
    drift = Drift(-float(log.mean[k]), sigma)
    return StaticLog(
        log.source, log.sampling, log.parts, log.motions, log.rest_s, log.mean, drift, log.onchip
    )


def _axis_noise(axis: str, k: int, logs: Sequence[StaticLog], period_s: float) -> AxisNoise:
    columns = [np.ascontiguousarray(part.values[:, k]) for log in logs for part in log.parts]
    means = np.array([log.mean[k] for log in logs])
    bias = float(means.mean())
    spread = float(means.std(ddof=1)) if len(logs) > 1 else math.nan
    if all(float(np.ptp(column)) == 0.0 for column in columns):
        nan = math.nan
        return AxisNoise(axis, bias, nan, nan, nan, nan, spread, None)
    allan = analyse(columns, period_s)
    rest = np.array([log.rest_s for log in logs])
    span = np.array([_span_s(log, period_s) for log in logs])
    white = allan.theta[0] / rest
    after = white + _MEAN_FLICKER * allan.theta[1] + allan.walk_within * span / 3.0
    sigma_mean = math.sqrt(float(white.sum())) / len(logs)
    sigma = math.sqrt(float(after.sum())) / len(logs)
    half = 1.959963984540054 * sigma
    if len(logs) > 1:
        between = spread / math.sqrt(len(logs))
        half = max(half, float(stdtrit(len(logs) - 1, 0.975)) * between)
        sigma = max(sigma, between)
    return AxisNoise(axis, bias, sigma_mean, sigma, bias - half, bias + half, spread, allan)


def _span_s(log: StaticLog, period_s: float) -> float:
    last = log.parts[-1]
    return float(last.t_s[-1] - log.parts[0].t_s[0]) + period_s


def analyse_static(logs: Sequence[RestLog]) -> Static:
    """Bias, noise and drift from logs at rest.

    Raises
    ------
    BadInputError for logs without a stretch at rest, and for logs of different axes or rates.
    """
    if not logs:
        raise BadInputError("logs: found none, expected at least one")
    axes = logs[0].axes
    for log in logs[1:]:
        if log.axes != axes:
            raise BadInputError(
                f"{log.source}: has the axes {', '.join(log.axes)}, expected {', '.join(axes)} as in "
                f"{logs[0].source}"
            )
    found = [_rest_of(log) for log in logs]
    rates = [log.sampling.rate_hz for log in found]
    for one, rate in zip(found, rates, strict=True):
        if abs(rate / rates[0] - 1.0) > _SAME_RATE:
            raise BadInputError(
                f"{one.source}: is sampled at {rate:.4g} Hz, expected {rates[0]:.4g} Hz as in "
                f"{found[0].source}"
            )
    rate_hz = float(np.mean(rates))
    noise = tuple(_axis_noise(axis, k, found, 1.0 / rate_hz) for k, axis in enumerate(axes))
    return Static(axes, rate_hz, tuple(_with_gyro_drift(log, axes, noise) for log in found), noise)


# ----------------------------------------------------------------------
# What logs at rest are worth: a verdict, the reasons for it, and remarks that do not change it.

_MOST_REPEATED = 0.02
_MOST_SIGMA_OF_N = 0.10
_LEAST_REST_S = 10.0
_LEAST_CHANCE = 1e-4
_SHOWN_MOTIONS = 3


def _of_log(log: StaticLog, axes: tuple[str, ...]) -> Iterator[Finding]:
    """Findings on motion and on how a log was sampled."""
    for motion in log.motions[:_SHOWN_MOTIONS]:
        yield Finding(
            "poor",
            f"{log.source}: moves from {motion.from_s:.1f} to {motion.to_s:.1f} s, seen most in "
            f"{axes[motion.axis]}; that stretch is left out",
            advice="log again with the rig untouched, on a table that does not shake",
        )
    more = len(log.motions) - _SHOWN_MOTIONS
    if more > 0:
        yield Finding("poor", f"{log.source}: moves {more} more times")
    yield from sampling_findings(log.sampling, axes, log.source, _MOST_REPEATED)


def _of_axis(noise: AxisNoise) -> Iterator[Finding]:
    """Findings on how well an axis' noise is known."""
    axis, allan = noise.axis, noise.allan
    if allan is None:
        yield Finding(
            "poor", f"{axis} never changes: it is stuck at {noise.bias:.6g}, or its step hides all noise"
        )
        return
    N = allan.N
    if not N.sigma <= _MOST_SIGMA_OF_N * N.value:
        share = N.sigma / N.value if N.value > 0.0 else math.inf
        yield Finding("poor", f"{axis}: the white noise is known to {share:.0%} only; the log is too short")
    if allan.chance < _LEAST_CHANCE:
        yield Finding("poor", f"{axis}: its deviation is not that of white noise, flicker and a random walk")
    elif allan.fit_s[0] > 1.5 * float(allan.tau_s[0]):
        yield Finding(
            "remark",
            f"{axis}: below {allan.fit_s[0]:.3g} s the deviation is not that of white noise "
            "(a filter in the sensor, or its step); the fit begins there",
        )


def _of_length(result: Static) -> Iterator[Finding]:
    """Findings on what longer logs would show."""
    longest = max(log.rest_s for log in result.logs)
    if longest < _LEAST_REST_S:
        yield Finding(
            "poor",
            f"{longest:.3g} s at rest are too short to tell a bias from noise, expected {_LEAST_REST_S:g} s",
        )
    unsupported = [n.axis for n in result.noise if n.allan is not None and not n.allan.K.supported]
    if unsupported:
        yield Finding(
            "remark",
            f"{longest:.4g} s do not show a random walk of {', '.join(unsupported)}; an upper bound is given",
            advice="a log of several hours at rest would show the random walk of the bias",
        )


def judge(result: Static) -> Verdict:
    """Verdict of an analysis of logs at rest."""
    return Verdict.of(
        [
            *(finding for log in result.logs for finding in _of_log(log, result.axes)),
            *(finding for noise in result.noise for finding in _of_axis(noise)),
            *_of_length(result),
        ]
    )

"""An IMU at rest: biases, noise, motions left out, and whether to trust them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, blocks, robust_sigma
from calib.core.errors import BadInputError
from calib.core.result import degrees_or_none, finite_or_none, judged
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Finding, Severity, Verdict
from calib.solve.clock import Part
from calib.stages.imu.allan import KINDS, LEAST_SAMPLES, Allan, analyse, model_variance
from calib.stages.imu.levelling import Levelling
from calib.stages.imu.sampling import (
    Motion,
    Readings,
    Sampling,
    check_rate,
    over_logs,
    regular_parts,
    rest_parts,
    rounding,
    sampled,
    sampling_findings,
    sensor_findings,
)
from calib.stages.imu.section import Imu, ImuLog

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
# look better than it is. With several logs the spread of their means counts, where it is larger.
#
# The drift of the angle phi is the slope of -gz integrated, minus the mean of gz, and that of the angle
# that the chip itself reports (Fig. 2.4). The latter's deviation follows from the slopes of eight
# stretches, as its error is no white noise.
#
# A single pose does not tell an accelerometer's bias from gravity: of it the mean is given.
#
# A bias can jump inside a log: a BNO055 calibrates itself anew, a supply or a temperature changes. Means of a
# second are compared before and behind each time, over 10 s and over 60 s. A step stands out from all other
# differences of that log over as long, so that noise, flicker and a random walk, whatever their size, are
# none; and it matters to an angle.

_STRETCHES = 8
_UNKNOWN_N = 0.5
"""Deviation of N, as a share of it, where the noise is less than half a step: by numbers over all places."""
_MEAN_FLICKER = 2.0 * math.log(2.0) / math.pi


@dataclass(frozen=True)
class Drift:
    """Slope of an angle over a log and its standard deviation [rad/s]."""

    slope_radps: float
    sigma_radps: float


@dataclass(frozen=True)
class BiasStep:
    """A jump of an axis' bias, by its number, and how large it is [rad/s or m/s^2]."""

    at_s: float
    axis: int
    size: float


@dataclass(frozen=True)
class StaticLog:
    """What one log shows.

    Attributes
    ----------
    sampling : rate, jitter, gaps, steps.
    motions : where it moves; `rest_s` is what is left, `moved_share` of the log what is not.
    steps : jumps of a bias.
    mean, rounded : (axes,) of the rest, and the deviation of that by the rounding of readings.
    gyro, onchip : drift of the angle by -gz and by the chip, None without that column.
    """

    source: str
    sampling: Sampling
    parts: tuple[Part, ...]
    motions: tuple[Motion, ...]
    rest_s: float
    mean: FloatArray
    rounded: FloatArray
    steps: tuple[BiasStep, ...]
    gyro: Drift | None
    onchip: Drift | None

    @property
    def moved_share(self) -> float:
        """Share of the log that is no rest."""
        moved_s = sum(motion.to_s - motion.from_s for motion in self.motions)
        return moved_s / max(moved_s + self.rest_s, 1e-9)


@dataclass(frozen=True)
class AxisNoise:
    """Bias and noise of one axis over all logs.

    Attributes
    ----------
    bias : mean over the logs, for an accelerometer with gravity in it.
    sigma : deviation of the bias that is met after the logs, NaN where the axis never changes.
    allan : None where the axis never changes.
    rounded : what the rounding of readings adds to sigma, zero where their noise is more than half a step.
    """

    axis: str
    bias: float
    sigma: float
    allan: Allan | None
    rounded: float


@dataclass(frozen=True)
class Static:
    """All logs together; `rate_hz` is that of the even grid."""

    axes: tuple[str, ...]
    rate_hz: float
    logs: tuple[StaticLog, ...]
    noise: tuple[AxisNoise, ...]


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


def _rest_of(log: Readings) -> StaticLog:
    sampling, parts = regular_parts(log)
    still, motions = rest_parts(parts, sampling.period_s, log.gyro, sampling.step)
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
    rest_s = samples * sampling.period_s
    steps = bias_steps(still, sampling.period_s, log.gyro)
    # By differences, which a slow drift does not enter, of readings as they are.
    apart = np.concatenate([np.diff(log.values[part.rows], axis=0) for part in still])
    rounded = rounding(0.5 * (apart**2).mean(axis=0), sampling.step)
    return StaticLog(log.source, sampling, still, motions, rest_s, mean, rounded, steps, None, onchip)


_BIN_S = 1.0
_TOGETHER_S = 10.0
_AROUND = (10, 60)
"""Bins on each side of a step."""
_STANDS_OUT = 8.0
"""Size of a step over the deviation of all differences: chance brings 5 in an hour."""
_LEAST_STEP_RADPS, _LEAST_STEP_MPS2 = math.radians(0.005), 9.8 * math.radians(0.1)
"""Steps that turn an angle by .3 degrees in a minute, or tilt it by .1 degrees."""


def bias_steps(parts: Sequence[Part], period_s: float, gyro: BoolArray) -> tuple[BiasStep, ...]:
    """Jumps of the means (axes,) of a log at rest, in the order of time.

    Parameters
    ----------
    parts : stretches at rest. gyro : (axes,) which axes are rates of rotation.
    """
    size = max(1, round(_BIN_S / period_s))
    stretches: list[tuple[list[FloatArray], list[FloatArray]]] = []
    end_s = -math.inf
    for part in parts:
        if len(part.values) < size:
            continue
        if part.t_s[0] - end_s > _TOGETHER_S:
            stretches.append(([], []))
        end_s = float(part.t_s[-1])
        stretches[-1][0].append(blocks(part.t_s, size)[:, 0])
        stretches[-1][1].append(blocks(part.values, size).mean(axis=1))
    found: list[BiasStep] = []
    for around in _AROUND:
        for times, values in stretches:
            t_s, bins = np.concatenate(times), np.concatenate(values)
            if len(bins) < 6 * around:
                continue
            for k in range(bins.shape[1]):
                least = _LEAST_STEP_RADPS if gyro[k] else _LEAST_STEP_MPS2
                for i, change in _jumps(bins[:, k], around, least):
                    at_s = float(t_s[i])
                    if all(one.axis != k or abs(one.at_s - at_s) > 2.0 * max(_AROUND) for one in found):
                        found.append(BiasStep(at_s, k, change))
    return tuple(sorted(found, key=lambda step: step.at_s))


def _jumps(bins: FloatArray, around: int, least: float) -> Iterator[tuple[int, float]]:
    """Bins behind which the mean over `around` bins differs from that before, and by how much."""
    total = np.concatenate([[0.0], np.cumsum(bins - bins.mean())])
    before = total[around:-around] - total[: -2 * around]
    change = (total[2 * around :] - total[around:-around] - before) / around
    middle = float(np.median(change))
    spread = robust_sigma(change - middle)
    change = change - middle
    while True:
        i = int(np.argmax(np.abs(change)))
        size = float(change[i])
        if abs(size) < max(least, _STANDS_OUT * spread):
            return
        yield i + around, size
        change[max(0, i - 2 * around) : i + 2 * around] = 0.0


def _with_gyro_drift(log: StaticLog, axes: tuple[str, ...], noise: tuple[AxisNoise, ...]) -> StaticLog:
    if "gz" not in axes or log.moved_share > _MOVED_SHARE:
        return log
    k = axes.index("gz")
    allan = noise[k].allan
    sigma = math.nan if allan is None else allan.N.value / math.sqrt(log.rest_s)
    drift = Drift(-float(log.mean[k]), sigma)
    return replace(log, gyro=drift)


def _axis_noise(axis: str, k: int, logs: Sequence[StaticLog], period_s: float) -> AxisNoise:
    columns = [np.ascontiguousarray(part.values[:, k]) for log in logs for part in log.parts]
    means = np.array([log.mean[k] for log in logs])
    bias = float(means.mean())
    if all(float(np.ptp(column)) == 0.0 for column in columns):
        return AxisNoise(axis, bias, math.nan, None, 0.0)
    allan = analyse(columns, period_s)
    rounded = max(float(log.rounded[k]) for log in logs)
    if rounded > 0.0:
        known = replace(allan.N, sigma=max(allan.N.sigma, _UNKNOWN_N * allan.N.value))
        allan = replace(allan, N=known)
    rest = np.array([log.rest_s for log in logs])
    span = np.array([log.parts[-1].t_s[-1] - log.parts[0].t_s[0] + period_s for log in logs])
    after = allan.theta[0] / rest + _MEAN_FLICKER * allan.theta[1] + allan.walk_within * span / 3.0
    sigma = math.sqrt(float(after.sum())) / len(logs)
    if len(logs) > 1:
        sigma = max(sigma, float(means.std(ddof=1)) / math.sqrt(len(logs)))
    return AxisNoise(axis, bias, math.hypot(sigma, rounded), allan, rounded)


def analyse_static(logs: Sequence[Readings]) -> Static:
    """Bias, noise and drift from logs at rest.

    Raises
    ------
    BadInputError for logs without a stretch at rest, and for logs of different axes or rates.
    """
    axes = logs[0].axes
    for log in logs[1:]:
        if log.axes != axes:
            raise BadInputError(
                f"{log.source}: has the axes {', '.join(log.axes)}, expected {', '.join(axes)} as in "
                f"{logs[0].source}"
            )
    found = [_rest_of(log) for log in logs]
    for one in found:
        check_rate(one.sampling, one.source, found[0].sampling, found[0].source)
    rate_hz = float(np.mean([log.sampling.rate_hz for log in found]))
    noise = tuple(_axis_noise(axis, k, found, 1.0 / rate_hz) for k, axis in enumerate(axes))
    return Static(axes, rate_hz, tuple(_with_gyro_drift(log, axes, noise) for log in found), noise)


# ----------------------------------------------------------------------
# What logs at rest are worth: a verdict, the reasons for it, and remarks that do not change it.

_MOVED_SHARE = 0.02
"""Share of a log in motion from which on what is left is not taken for a rest."""
_TILTED_RAD = math.radians(0.3)
"""Turn of gravity between the stretches at rest that makes their mean that of no pose."""
_GRAVITY_MPS2, _MOST_OFF_GRAVITY = 9.81, 0.15
"""Cheap accelerometers are off by a few per cent in scale and some 0.08 g in bias."""
_COLOURED = 2.0
"""Deviation over the fitted one, or this over that, from which on N, B and K do not describe the noise."""
_COLOURED_RAD, _LEARNT_S = math.radians(0.1), Levelling.bias_tau_s
"""What that is to make of an angle, for as long as a bias lasts until a filter has learnt it."""
_LONG_S = 7200.0
"""A log that shows no random walk within this will hardly do so within the next hours."""
_MOST_REPEATED = 0.02
_MOST_SIGMA_OF_N = 0.20
_MOST_ROUNDED_RADPS, _MOST_ROUNDED_MPS2 = 1e-3, 0.02
"""What rounding may shift a bias by: three degrees in a minute, a tenth of a degree of tilt."""
_LEAST_REST_S = 10.0
_LEAST_CHANCE = 1e-4
_SHOWN_MOTIONS = 3
_AGAIN = "log again with the rig untouched, on a table that does not shake"


def _of_log(log: StaticLog, axes: tuple[str, ...]) -> Iterator[Finding]:
    """Findings on motion and on how a log was sampled."""
    moved = log.moved_share > _MOVED_SHARE
    severity: Severity = "poor" if moved else "remark"
    for motion in log.motions[:_SHOWN_MOTIONS]:
        from_s = round(motion.from_s, 1) + 0.0
        text = f"{log.source}: moves from {from_s:.1f} to {motion.to_s:.1f} s, seen most in "
        text += f"{axes[motion.axis]}; that stretch is left out"
        yield Finding(severity, text, _AGAIN if moved else "")
    more = len(log.motions) - _SHOWN_MOTIONS
    if more > 0:
        yield Finding(severity, f"{log.source}: moves {more} more times")
    columns = [k for k, axis in enumerate(axes) if axis.startswith("a")]
    if log.motions and (turned := _turned_rad(log, columns)) > _TILTED_RAD:
        text = f"{log.source}: lies {math.degrees(turned):.2g} deg otherwise after it has moved; the mean of "
        yield Finding("poor", f"{text}the accelerometer is that of no pose", advice=_AGAIN)
    force = float(np.median([np.linalg.norm(part.values[:, columns].mean(axis=0)) for part in log.parts]))
    if len(columns) == 3 and abs(force / _GRAVITY_MPS2 - 1.0) > _MOST_OFF_GRAVITY:
        yield Finding(
            "poor",
            f"{log.source}: the accelerometer reads {force:.4g} m/s^2 at rest, "
            f"{force / _GRAVITY_MPS2:.3g} times gravity, so its noise is as wrong",
            advice="check its unit and range, or find its scale by calib imu intrinsics",
        )
    yield from sampling_findings(log.sampling, axes, log.source, _MOST_REPEATED)


def _turned_rad(log: StaticLog, columns: list[int]) -> float:
    """Largest angle between the mean specific forces of the stretches at rest."""
    long = [part.values[:, columns] for part in log.parts if len(part.values) * log.sampling.period_s > 1.0]
    if len(columns) < 2 or len(long) < 2:
        return 0.0
    means = np.array([values.mean(axis=0) for values in long])
    size = max(float(np.linalg.norm(means, axis=1).mean()), 1e-9)
    return float(np.linalg.norm(means - means[0], axis=1).max()) / size


def _effect(axis: str, size: float) -> tuple[float, str, str]:
    """From what size a change of an axis' mean matters, the change in words, what it does to an angle."""
    if axis.startswith("g"):
        turned = 60.0 * math.degrees(abs(size))
        effect = f"an angle from it turns by {turned:.2g} deg more in a minute"
        return _LEAST_STEP_RADPS, f"{math.degrees(size):+.2g} deg/s", effect
    effect = f"an angle from gravity turns by up to {math.degrees(abs(size) / 9.8):.2g} deg"
    return _LEAST_STEP_MPS2, f"{size:+.2g} m/s^2", effect


def _of_steps(log: StaticLog, noise: Sequence[AxisNoise]) -> Iterator[Finding]:
    """Findings on biases that jump, and what that does to an angle."""
    for step in log.steps[:_SHOWN_MOTIONS]:
        one = noise[step.axis]
        _, size, effect = _effect(one.axis, step.size)
        advice = "see whether the rig was touched then"
        if one.axis.startswith("g"):
            advice = "learn the bias at each rest, and keep a sensor that calibrates itself from doing so"
        text = f"{log.source}: the mean of {one.axis} steps by {size} at {step.at_s:.0f} s; {effect}"
        # A step within the stated deviation of the bias is a part of that.
        poor = abs(step.size) > 3.0 * one.sigma
        yield Finding("poor" if poor else "remark", text, advice if poor else "")
    if len(log.steps) > _SHOWN_MOTIONS:
        yield Finding("remark", f"{log.source}: {len(log.steps) - _SHOWN_MOTIONS} more steps of a mean")


_END_SHARE, _MOST_DRIFT = 0.1, 3.5
"""Parts of a log at its ends, and by how many deviations of a random walk their means may differ."""


def _of_drift(log: StaticLog, noise: Sequence[AxisNoise], logs: int) -> Iterator[Finding]:
    """Findings on biases that differ from a log's start to its end, as of a sensor that warms up."""
    values = np.concatenate([part.values for part in log.parts])
    size = max(round(_END_SHARE * len(values)), 1)
    change = values[-size:].mean(axis=0) - values[:size].mean(axis=0)
    for k, one in enumerate(noise):
        if one.allan is None or any(step.axis == k for step in log.steps):
            continue
        # A walk goes as far as three times the variance of its mean about its end, K^2 T / 3.
        walk = 3.0 * logs * one.sigma**2
        white = 2.0 * one.allan.N.value**2 / (_END_SHARE * log.rest_s)
        least, size_of, effect = _effect(one.axis, float(change[k]))
        if abs(float(change[k])) > max(least, _MOST_DRIFT * math.sqrt(walk + white)):
            advice = "let the sensor run until its bias stays, then log again"
            if one.axis.startswith("a"):
                advice += ", on a table that does not give way"
            text = f"{log.source}: the mean of {one.axis} drifts by {size_of} from start to end; {effect}"
            yield Finding("poor", text, advice)


_LEAST_GYRO_NOISE = 1e-5
_MOST_GYRO_NOISE = 2e-3
"""A quarter of what the best micromachined gyroscopes have, and three times what the worst have, in
rad/s/sqrt(Hz)."""


def _of_axis(noise: AxisNoise) -> Iterator[Finding]:
    """Findings on how well an axis' noise is known."""
    axis, allan = noise.axis, noise.allan
    if allan is None:
        yield Finding(
            "poor", f"{axis} never changes: it is stuck at {noise.bias:.6g}, or its step hides all noise"
        )
        return
    N = allan.N
    if noise.rounded > 0.0:
        most, unit = (_MOST_ROUNDED_RADPS, "rad/s") if axis[0] == "g" else (_MOST_ROUNDED_MPS2, "m/s^2")
        poor = noise.rounded > most
        yield Finding(
            "poor" if poor else "remark",
            f"{axis}: its noise is less than half its step, so that bias and noise depend on where between "
            f"two steps it lies; the bias by {noise.rounded:.2g} {unit}",
            "set the sensor to a finer range or a wider filter" if poor else "",
        )
    elif not N.sigma <= _MOST_SIGMA_OF_N * N.value:
        share = N.sigma / N.value if N.value > 0.0 else math.inf
        yield Finding("poor", f"{axis}: the white noise is known to {share:.0%} only; the log is too short")
    if axis.startswith("g") and N.value < _LEAST_GYRO_NOISE and allan.chance >= _LEAST_CHANCE:
        yield Finding(
            "poor",
            f"{axis}: its noise of {math.degrees(N.value):.2g} deg/s/sqrt(Hz) is less than any small "
            f"gyroscope has ({math.degrees(4.0 * _LEAST_GYRO_NOISE):.2g})",
            "look whether its unit is rad/s where deg/s is stated, or a filter hides its noise",
        )
    if axis.startswith("g") and N.value > _MOST_GYRO_NOISE and noise.rounded == 0.0:
        yield Finding(
            "poor",
            f"{axis}: its noise of {math.degrees(N.value):.2g} deg/s/sqrt(Hz) is more than any gyroscope has "
            f"({math.degrees(_MOST_GYRO_NOISE):.2g}): the rig was held, or shaken throughout",
            _AGAIN,
        )
    if allan.chance < _LEAST_CHANCE:
        off, tau_s, turns_rad = _colour(allan, axis[0] == "g")
        text = f"{axis}: its noise is coloured, at {tau_s:.2g} s the deviation is {off:.2g} times what white "
        text += "noise, flicker and a random walk explain"
        if turns_rad > _COLOURED_RAD:
            yield Finding("poor", f"{text}; N, B and K do not describe it")
        else:
            trusts = "far" if off > 1.0 else "little"
            yield Finding("remark", f"{text}; an estimator trusts it by as much too {trusts} there")
    elif allan.fit_s[0] > 1.5 * (tau_s := float(allan.tau_s[0])):
        off = float(allan.deviation[0] / np.sqrt(model_variance(allan.theta, allan.tau_s[:1]).sum()))
        yield Finding(
            "remark",
            f"{axis}: below {allan.fit_s[0]:.3g} s the deviation is not that of white noise (a filter in the "
            f"sensor, or its step), at {tau_s:.2g} s {off:.2g} times as large; the fit begins there",
        )


def _colour(allan: Allan, gyro: bool) -> tuple[float, float, float]:
    """Deviation over the fitted one where that differs most for sure, and its time.

    And what is beyond `_COLOURED` times makes of an angle at most [rad].
    """
    first, last = allan.fit_s
    used = (allan.tau_s > 0.99 * first) & (allan.tau_s < 1.01 * last)
    tau_s, model = allan.tau_s[used], np.sqrt(model_variance(allan.theta, allan.tau_s[used]).sum(axis=1))
    # Two standard deviations of each side are left to chance.
    low = allan.low[used] ** 2 / allan.deviation[used]
    high = allan.high[used] ** 2 / allan.deviation[used]
    sure = np.where(low > model, low / model, np.where(high < model, high / model, 1.0))
    k = int(np.argmax(np.abs(np.log(sure))))
    angle = np.abs(sure - 1.0) * model * (np.minimum(tau_s, _LEARNT_S) if gyro else 1.0 / GRAVITY_MPS2)
    beyond = np.abs(np.log(sure)) > math.log(_COLOURED)
    return float(sure[k]), float(tau_s[k]), float(angle[beyond].max(initial=0.0))


def _of_length(result: Static) -> Iterator[Finding]:
    """Findings on what longer logs would show."""
    longest = max(log.rest_s for log in result.logs)
    if longest < _LEAST_REST_S:
        yield Finding(
            "poor",
            f"{longest:.3g} s at rest are too short to tell a bias from noise, expected {_LEAST_REST_S:g} s",
        )
    found = {one.axis: one.allan for one in result.noise if one.allan is not None}
    either = [axis for axis, allan in found.items() if not allan.told_apart]
    unshown = [axis for axis, allan in found.items() if not allan.K.supported and axis not in either]
    longer = (
        "" if longest > _LONG_S else "a log of several hours at rest would show the random walk of the bias"
    )
    if either:
        text = (
            f"{longest:.4g} s do not tell whether the slow noise of {', '.join(either)} is bias instability "
        )
        yield Finding("remark", f"{text}or a random walk; upper bounds are given", longer)
    if unshown:
        text = f"{longest:.4g} s do not show a random walk of {', '.join(unshown)}; an upper bound is given"
        yield Finding("remark", text, longer)


def judge(result: Static) -> Verdict:
    """Verdict of an analysis of logs at rest."""
    return Verdict.of(
        [
            *(finding for log in result.logs for finding in _of_log(log, result.axes)),
            *(finding for log in result.logs for finding in _of_steps(log, result.noise)),
            *(finding for log in result.logs for finding in _of_drift(log, result.noise, len(result.logs))),
            *(finding for noise in result.noise for finding in _of_axis(noise)),
            *_of_length(result),
        ]
    )


# ----------------------------------------------------------------------
# The section.

_SENSORS = {
    "g": (
        "gyro_bias_radps", "gyro_step_radps",
        "gyro_noise_radps_per_sqrt_Hz", "gyro_instability_radps", "gyro_walk_radps2_per_sqrt_Hz",
    ),
    "a": (
        "accel_mean_mps2", "accel_step_mps2",
        "accel_noise_mps2_per_sqrt_Hz", "accel_instability_mps2", "accel_walk_mps3_per_sqrt_Hz",
    ),
}  # fmt: skip
"""Keys by the first letter of a sensor's axes: mean, step, then those of `KINDS`."""


def solve_static(logs: Sequence[Readings]) -> Imu:
    """Find bias, noise and drift, judge them, and assemble the section."""

    result = analyse_static(logs)
    every = [np.where(np.isnan(log.sampling.step), math.inf, log.sampling.step) for log in result.logs]
    steps = dict(zip(result.axes, np.nanmin(every, axis=0).tolist(), strict=True))
    noise = {one.axis: one for one in result.noise}

    def triple(of: Mapping[str, Any], letter: str, name: str) -> list[float | None]:
        """An attribute of x, y and z, null where there is none or it is not known."""
        axes = [of.get(letter + axis) for axis in "xyz"]
        return [None if one is None else finite_or_none(getattr(one, name)) for one in axes]

    values: dict[str, list[float | None]] = {}
    sigma: dict[str, list[float | None]] = {}
    below: dict[str, list[float | None]] = {}
    for letter, (mean, step, *densities) in _SENSORS.items():
        values[mean], sigma[mean] = triple(noise, letter, "bias"), triple(noise, letter, "sigma")
        values[step] = [finite_or_none(steps.get(letter + axis, math.nan)) for axis in "xyz"]
        for kind, key in zip(KINDS, densities, strict=True):
            terms = {axis: one.allan and getattr(one.allan, kind) for axis, one in noise.items()}
            for into, name in ((values, "value"), (sigma, "sigma"), (below, "below")):
                into[key] = triple(terms, letter, name)
    drift = {
        name: [math.degrees(one.slope_radps) for log in result.logs if (one := getattr(log, name))]
        for name in ("gyro", "onchip")
    }
    return Imu.model_validate(
        {
            "rate_hz": result.rate_hz,
            **values,
            "sigma": {key: row for key, row in sigma.items() if row != [None] * 3},
            "below": {key: row for key, row in below.items() if row != [None] * 3},
            "drift": {name: over_logs(slopes) for name, slopes in drift.items() if slopes},
            "logs": [_rest_log(log) for log in result.logs],
            **judged(Verdict.of([*judge(result).findings, *sensor_findings(logs)])),
        }
    ).with_evidence(result)


def _rest_log(log: StaticLog) -> ImuLog:
    gyro, onchip = log.gyro, log.onchip
    return ImuLog(
        name=log.source,
        rest_s=log.rest_s,
        samples=log.sampling.samples,
        **sampled(log.sampling),
        moves_s=[[motion.from_s, motion.to_s] for motion in log.motions],
        gyro_degps=None if gyro is None else degrees_or_none(gyro.slope_radps),
        gyro_sigma_degps=None if gyro is None else degrees_or_none(gyro.sigma_radps),
        onchip_degps=None if onchip is None else degrees_or_none(onchip.slope_radps),
        onchip_sigma_degps=None if onchip is None else degrees_or_none(onchip.sigma_radps),
    )

"""How an IMU was sampled, and where it was at rest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, blocks, runs
from calib.core.errors import BadInputError
from calib.core.verdict import Finding
from calib.core.words import counted
from calib.io.sensor_faults import at_range_end
from calib.solve.clock import SPLIT_S, Gap, Part, time_axis
from calib.stages.imu.levelling import GAP_S

# ----------------------------------------------------------------------
# How a log was sampled: rate, jitter, gaps, repeated rows and stamps, steps, readings at their limit.
#
# When the samples were taken says `calib.solve.clock`. Rows that repeat both stamp and readings are one
# sample written twice, and are dropped before (`calib.io.logs`).

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
"""Rates of rotation [rad/s] and specific forces [m/s^2] by name."""


@dataclass(frozen=True)
class Readings:
    """Readings of a log's IMU.

    Attributes
    ----------
    source : name for messages.
    axes : those of `AXES` that it has.
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings, rad/s and m/s^2 unless `counts` says otherwise.
    onchip_t_s, onchip_phi_rad : (k,) the chip's own angle, empty where it is not logged.
    true_t_s, true_phi_rad : (m,) the true angle, likewise.
    repeated_rows : that were written twice and are left out. findings : on the sensors.
    counts : kinds of axes, "a" and "g", whose readings are in counts.
    """

    source: str
    axes: tuple[str, ...]
    t_s: FloatArray
    values: FloatArray
    onchip_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    onchip_phi_rad: FloatArray = field(default_factory=lambda: np.zeros(0))
    true_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    true_phi_rad: FloatArray = field(default_factory=lambda: np.zeros(0))
    repeated_rows: int = 0
    findings: tuple[Finding, ...] = ()
    counts: str = ""

    @property
    def gyro(self) -> BoolArray:
        """Which of the axes are rates of rotation."""
        return np.array([axis.startswith("g") for axis in self.axes])

    @property
    def lacks(self) -> list[str]:
        """Those of `AXES` that it has not."""
        return [axis for axis in AXES if axis not in self.axes]

    def places(self, *axes: str) -> list[int]:
        """Columns of these axes."""
        return [self.axes.index(axis) for axis in axes]


@dataclass(frozen=True)
class Sampling:
    """What is known of the sampling.

    Attributes
    ----------
    samples : that were used.
    period_s, rate_hz : of the sensor, or on average where it is not steady.
    jitter_s : robust standard deviation of the time stamps about the samples' times.
    steady : whether the sensor samples at even steps.
    repeated_rows, repeated_stamps : rows dropped, and stamps that occur again with other readings.
    gaps : in order of time. missing : samples in those that were filled.
    step : (axes,) quantisation step in the axis's unit, NaN where none is seen.
    at_limit : (axes,) readings at the end of a usual range, several in a row.
    dropped : share of the samples that a sensor which is not steady seems to lack.
    """

    samples: int
    duration_s: float
    period_s: float
    rate_hz: float
    jitter_s: float
    steady: bool
    repeated_rows: int
    repeated_stamps: int
    gaps: tuple[Gap, ...]
    missing: int
    step: FloatArray
    at_limit: IntArray
    dropped: float = 0.0


_MOST_MISSING = 0.02
_UNEQUALLY = 0.01
_FEWEST_STEPS, _OFF_WHOLE, _MOSTLY = 100, 0.15, 0.95
"""Steps of stamps that say something, how far one may be from a whole number of the usual shortest one, and
the share that is no further: where samples are dropped, not taken unevenly."""


def _dropped(t_s: FloatArray) -> float:
    """Share of the samples that are missing where all steps of the stamps (n,) are whole ones; else 0."""
    steps = np.diff(t_s)
    steps = steps[(steps > 0.0) & (steps <= SPLIT_S)]
    if len(steps) < _FEWEST_STEPS:
        return 0.0
    short = float(np.quantile(steps, 0.05))
    count = steps / float(np.median(steps[steps < 1.5 * short]))
    whole = np.rint(count)
    if np.mean(np.abs(count - whole) < _OFF_WHOLE) < _MOSTLY:
        return 0.0
    return float(1.0 - len(steps) / max(whole.sum(), 1.0))


def sampling_findings(
    s: Sampling, axes: Sequence[str] = (), source: str = "", most_repeated: float = 1.0
) -> Iterator[Finding]:
    """What is to be known about how a log was sampled.

    Parameters
    ----------
    axes : whose readings at the end of their range are named.
    most_repeated : share of repeated rows above which the log is poor.
    """
    lead = f"{source}: " if source else ""
    if not s.steady and s.dropped > _MOST_MISSING:
        yield Finding(
            "poor",
            f"{lead}{s.dropped:.0%} of the samples are missing, as the time stamps' steps are whole ones of "
            "the shortest; what is left is filled by straight lines, which changes the noise",
        )
    elif not s.steady:
        yield Finding(
            "remark",
            f"{lead}the steps of the time stamps are uneven; the stamps are taken as they are, and where "
            "even samples are needed they lie on straight lines between",
        )
    for gap in s.gaps:
        if gap.split:
            yield Finding("remark", f"{lead}split at a gap of {gap.duration_s:.4g} s after {gap.at_s:.2f} s")
    for finding in limit_findings(s, axes):
        yield replace(finding, text=f"{lead}{finding.text}")
    short = [gap for gap in s.gaps if not gap.split]
    if short:
        longest = max(short, key=lambda gap: gap.duration_s)
        yield Finding(
            "poor" if s.missing > _MOST_MISSING * s.samples else "remark",
            f"{lead}{counted(s.missing, 'sample')} missing in {counted(len(short), 'gap')}, the longest "
            f"{1e3 * longest.duration_s:.3g} ms after {longest.at_s:.2f} s; filled by straight lines",
        )
    if s.repeated_rows:
        share = s.repeated_rows / (s.samples + s.repeated_rows)
        # A recorder that writes each row twice loses none.
        times = s.repeated_rows / s.samples
        each = times > 0.5 and abs(times - round(times)) < _UNEQUALLY
        yield Finding(
            "poor" if share > most_repeated and not each else "remark",
            f"{lead}{counted(s.repeated_rows, 'row')} ({share:.2%}) "
            f"repeat{'s' * (s.repeated_rows == 1)} the one before; dropped",
        )
    if s.repeated_stamps:
        yield Finding(
            "remark",
            f"{lead}{counted(s.repeated_stamps, 'time stamp')} ({s.repeated_stamps / s.samples:.2%}) "
            f"repeat{'s' * (s.repeated_stamps == 1)} the one before with other readings; counted as "
            "samples of their own",
        )


def limit_findings(s: Sampling, axes: Sequence[str], most: float = 0.0) -> Iterator[Finding]:
    """Axes whose readings are at the end of their range; poor above a share `most` of the samples."""
    for axis, count in zip(axes, s.at_limit.tolist(), strict=False):
        if count:
            poor = count > most * s.samples
            yield Finding(
                "poor" if poor else "remark",
                f"{axis} is at the end of its range in {counted(count, 'sample')}",
                "set the sensor to a wider range, or move it more slowly" if poor else "",
            )


def _step(values: FloatArray) -> float:
    """Quantisation step: the least distance of readings, where all are whole multiples of it apart."""
    levels = np.unique(values)
    if not 2 <= len(levels) <= 0.25 * len(values) + 3:
        return math.nan
    apart = np.diff(levels)
    digits = 1e-7 * float(np.abs(levels).max())
    least = float(apart[apart > digits].min(initial=math.inf))
    whole = apart[apart > digits] / least
    if not math.isfinite(least) or float(np.abs(whole - np.rint(whole)).max()) > 0.05:
        return math.nan
    return float((levels[-1] - levels[0]) / np.rint(whole).sum())


_HIDDEN = 0.3


def rounding(variance: FloatArray, step: FloatArray) -> FloatArray:
    """Standard deviations (n,) of means by the rounding of readings, zero where their noise hides that.

    Readings with less noise than half a step have a mean that depends on where between two steps the signal
    lies. With v = variance / step^2 it is off, RMS over these places, by 0.25 steps where v is next to
    nothing, by 0.20 at v = 0.1, by 0.09 at 0.21, by 0.002 at 0.34 and by less than 1e-5 from 0.55 on.

    Parameters
    ----------
    variance : (n,) of single readings at rest. step : (n,) their quantisation step, NaN for none.
    """
    return np.asarray(0.25 * np.sqrt(np.maximum(np.nan_to_num(step) ** 2 - variance / _HIDDEN, 0.0)))


def regular_parts(log: Readings) -> tuple[Sampling, tuple[Part, ...]]:
    """Readings at even steps, in parts without long gaps, and how they were sampled.

    Raises `BadInputError` for stamps that are all the same.
    """
    t_s, values = log.t_s, log.values
    axis = time_axis(t_s)
    if not axis.period_s > 0.0:
        raise BadInputError(f"{log.source}: all {len(t_s)} IMU samples have the time {t_s[0]:g} s")
    parts = axis.parts(values)
    sampling = Sampling(
        samples=len(t_s),
        duration_s=axis.period_s * sum(len(part.values) for part in parts),
        period_s=axis.period_s,
        rate_hz=axis.rate_hz,
        jitter_s=axis.jitter_s,
        steady=axis.steady,
        repeated_rows=log.repeated_rows,
        repeated_stamps=axis.repeated,
        gaps=axis.gaps,
        missing=axis.missing,
        step=np.array([_step(column) for column in values.T]),
        dropped=0.0 if axis.steady else _dropped(t_s),
        at_limit=np.array(
            [at_range_end(column, bool(g)).sum() for column, g in zip(values.T, log.gyro, strict=True)],
            dtype=np.int64,
        ),
    )
    return sampling, parts


_LONG_ENOUGH_S = 10.0
"""A part that leaves some seconds to judge a filter by."""


def without_gaps(parts: Sequence[Part], period_s: float) -> tuple[Part, ...]:
    """Parts cut where filters start anew; as they are where parts to judge by would be less than half."""
    out = []
    for part in parts:
        after = np.flatnonzero(np.diff(part.places) * period_s > GAP_S) + 1
        for rows, places in zip(np.split(part.rows, after), np.split(part.places, after), strict=True):
            a, b = int(places[0]), int(places[-1]) + 1
            out.append(Part(part.t_s[a:b], part.values[a:b], rows, places - a))
    long = sum(len(part.t_s) for part in out if len(part.t_s) * period_s >= _LONG_ENOUGH_S)
    return tuple(out) if 2 * long >= sum(len(part.t_s) for part in parts) else tuple(parts)


_SAME_RATE = 0.02


def check_rate(sampling: Sampling, source: str, first: Sampling, first_source: str) -> None:
    """Raise `BadInputError` for a log that is not sampled at the rate of the first one."""
    if abs(sampling.rate_hz / first.rate_hz - 1.0) > _SAME_RATE:
        raise BadInputError(
            f"{source}: is sampled at {sampling.rate_hz:.4g} Hz, expected {first.rate_hz:.4g} Hz as in "
            f"{first_source}"
        )


# ----------------------------------------------------------------------
# Motion in a log that claims to be at rest.
#
# The log is cut into windows of about a second. A window moves where on any axis
#
# - its standard deviation is more than `TIMES_SPREAD` times that of the quiet windows, or above what no
#   sensor has at rest (`MOST_GYRO_RADPS`, `MOST_ACCEL_MPS2`);
# - its mean differs from the one before by more than `TIMES_MEAN` times the quiet windows' differences.
#
# Quiet is the lower quartile of all windows, so that up to three quarters of a log may be in motion. A
# random walk of the bias raises all differences alike and is not taken for motion.

MOST_GYRO_RADPS = 0.02
MOST_ACCEL_MPS2 = 0.4
TIMES_SPREAD = 3.0
TIMES_MEAN = 8.0
_WINDOW_S = 1.0
_FEWEST = 20
_QUARTILE_OF_NORMAL = 0.3186393639643752


@dataclass(frozen=True)
class Motion:
    """A stretch of time in which the log moves, and the axis that shows it most, by its number."""

    from_s: float
    to_s: float
    axis: int


def _window(period_s: float) -> int:
    return max(_FEWEST, round(_WINDOW_S / period_s))


def quiet_spread(parts: tuple[Part, ...], period_s: float) -> FloatArray:
    """Standard deviation (axes,) within the quiet windows; zeros where there is no whole window."""
    size = _window(period_s)
    spreads = [blocks(part.values, size).std(axis=1) for part in parts if len(part.values) >= size]
    if not spreads:
        return np.zeros(parts[0].values.shape[1])
    return np.asarray(np.quantile(np.concatenate(spreads), 0.25, axis=0))


def rest_parts(
    parts: tuple[Part, ...], period_s: float, gyro: BoolArray, step: FloatArray
) -> tuple[tuple[Part, ...], tuple[Motion, ...]]:
    """The parts without their moving windows, and where these are.

    Parameters
    ----------
    parts : of one log.
    gyro : (axes,) which axes are rates of rotation.
    step : (axes,) quantisation steps, NaN for none.
    """
    size = _window(period_s)
    coarse = np.nan_to_num(step)
    most = np.where(gyro, MOST_GYRO_RADPS, MOST_ACCEL_MPS2)
    quiet = np.maximum(quiet_spread(parts, period_s), 0.3 * coarse)
    means = [blocks(part.values, size).mean(axis=1) for part in parts if len(part.values) >= 2 * size]
    steps = [np.abs(np.diff(mean, axis=0)) for mean in means]
    jump = np.zeros(len(gyro))
    if steps:
        jump = np.quantile(np.concatenate(steps), 0.25, axis=0) / _QUARTILE_OF_NORMAL
    # Few windows may agree by chance; white noise alone gives this much.
    jump = np.maximum(jump, np.sqrt(2.0 / size) * quiet) + 1e-12
    still: list[Part] = []
    motions: list[Motion] = []
    for part in parts:
        if len(part.values) < size:
            still.append(part)
            continue
        # The rest of the part belongs to the last window.
        w = blocks(part.values, size)
        excess = w.std(axis=1) / np.minimum(TIMES_SPREAD * quiet + 1e-12, most)
        change = np.abs(np.diff(w.mean(axis=1), axis=0)) / (TIMES_MEAN * jump)
        # Coming to rest is no motion of the window that follows.
        shaken = (excess > 1.0).any(axis=1)
        change[shaken[:-1]] = 0.0
        excess[1:] = np.maximum(excess[1:], change)
        moving = (excess > 1.0).any(axis=1)
        moves = [(*run, True) for run in runs(moving)]
        for start, stop, moved in sorted([*moves, *((*run, False) for run in runs(~moving))]):
            begin, end = start * size, stop * size if stop < len(w) else len(part.values)
            if moved:
                axis = int(np.argmax(excess[start:stop].max(axis=0)))
                motions.append(Motion(float(part.t_s[begin]), float(part.t_s[end - 1]) + period_s, axis))
            else:
                inside = (part.places >= begin) & (part.places < end)
                places = part.places[inside] - begin
                still.append(Part(part.t_s[begin:end], part.values[begin:end], part.rows[inside], places))
    return tuple(still), tuple(motions)


# ----------------------------------------------------------------------
# Stretches in which a sensor is held still, found by the spread of its specific forces.
#
# A reading is at rest where the spread in a window about it,
#
#     zeta = sqrt(var_x^2 + var_y^2 + var_z^2),
#
# is below a multiple of what it is while the sensor lies still at the start of the log (Tedaldi, Pretto and
# Menegatti, ICRA 2014, eq. 12). Which multiple is right depends on the sensor and on the table; whoever fits
# a model to the rests tries those of `MULTIPLES` and keeps the one with the least residual.
#
# Where the log does not begin at rest, its quietest windows are the measure instead.

MULTIPLES = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0)
WINDOW_S = 1.0
_LEAST_REST_S = 1.0
_RESTS_FEWEST = 21
_LEAST_INITIAL_S = 3.0
_QUIET_QUANTILE = 0.03
_TIMES_QUIET = 12.0
_BATCH_S = 0.25
INSET_S = 1.0
"""How much of a rest's ends, at most a quarter of it each, may belong to a turn: the accelerometer hardly
shows how a slow one starts, and up to half a degree of it made the gyroscope's scales 1 % too small."""


@dataclass(frozen=True)
class Spread:
    """zeta about each reading of each part, at an even period."""

    zeta: tuple[FloatArray, ...]
    period_s: float


@dataclass(frozen=True)
class Quiet:
    """What zeta is at rest, and how long the rest at the start of the log is; 0 s where there is none."""

    zeta: float
    initial_s: float


@dataclass(frozen=True)
class Rest:
    """A stretch at rest.

    Attributes
    ----------
    part, start, stop : number of the part, first sample, and the one behind the last.
    from_s, to_s : the same as time stamps.
    mean : (d,) of the readings of its middle.
    scatter : (d,) long-run variance of a reading: that of a mean of n readings is scatter / n.
    inset : samples at each end that are no part of its middle.
    """

    part: int
    start: int
    stop: int
    from_s: float
    to_s: float
    mean: FloatArray
    scatter: FloatArray
    inset: int = 0

    @property
    def samples(self) -> int:
        """Number of readings."""
        return self.stop - self.start

    @property
    def middle(self) -> slice:
        """Samples of its part without those at its ends, where a slow turn may have begun."""
        return slice(self.start + self.inset, self.stop - self.inset)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.to_s - self.from_s


def _moving_variance(values: FloatArray, size: int) -> FloatArray:
    """Variance (n - size + 1, d) in each window."""
    centred = values - values.mean(axis=0)
    zero = np.zeros((1, values.shape[1]))
    first = np.concatenate([zero, np.cumsum(centred, axis=0)])
    second = np.concatenate([zero, np.cumsum(centred**2, axis=0)])
    mean = (first[size:] - first[:-size]) / size
    return np.asarray(np.maximum((second[size:] - second[:-size]) / size - mean**2, 0.0))


def spread(parts: tuple[Part, ...], columns: list[int], period_s: float) -> Spread:
    """zeta of the given columns; infinite in parts that are shorter than a window.

    Parameters
    ----------
    parts : readings on an even grid.
    columns : those of the accelerometer.
    """
    size = max(_RESTS_FEWEST, round(WINDOW_S / period_s) | 1)
    out = []
    for part in parts:
        zeta = np.full(len(part.values), math.inf)
        if len(part.values) >= size:
            inner = np.sqrt((_moving_variance(part.values[:, columns], size) ** 2).sum(axis=1))
            half = size // 2
            zeta[half : half + len(inner)] = inner
            zeta[:half], zeta[half + len(inner) :] = inner[0], inner[-1]
        out.append(zeta)
    return Spread(tuple(out), period_s)


def quiet_level(s: Spread, step: FloatArray) -> Quiet:
    """What zeta is at rest, from the start of the log where that is still.

    Parameters
    ----------
    step : (d,) quantisation steps, NaN for none; no reading is known better than its step.
    """
    zeta = np.concatenate([one[np.isfinite(one)] for one in s.zeta])
    floor = float(np.linalg.norm(np.nan_to_num(step) ** 2 / 12.0))
    if len(zeta) == 0:
        return Quiet(floor, 0.0)
    quietest = max(float(np.quantile(zeta, _QUIET_QUANTILE)), floor)
    moves = np.flatnonzero(s.zeta[0] > _TIMES_QUIET * quietest)
    initial = int(moves[0]) if len(moves) else len(s.zeta[0])
    if initial * s.period_s >= _LEAST_INITIAL_S:
        return Quiet(max(float(np.median(s.zeta[0][:initial])), floor), initial * s.period_s)
    return Quiet(1.3 * quietest, 0.0)


def _scatter(values: FloatArray, period_s: float) -> FloatArray:
    """Long-run variance (d,): that of means over a batch times its length, which counts correlation."""
    size = max(1, round(_BATCH_S / period_s))
    means = blocks(values, size).mean(axis=1)
    if len(means) < 3:
        return np.asarray(values.var(axis=0, ddof=1))
    # Differences of neighbours, as a drift over the rest is no noise of its mean.
    return np.asarray(size * (np.diff(means, axis=0) ** 2).mean(axis=0) / 2.0)


def find_rests(parts: tuple[Part, ...], columns: list[int], s: Spread, threshold: float) -> tuple[Rest, ...]:
    """Stretches of at least a second in which zeta stays below the threshold, in order of time."""
    least = max(_RESTS_FEWEST, round(_LEAST_REST_S / s.period_s))
    rests = []
    for number, (part, zeta) in enumerate(zip(parts, s.zeta, strict=True)):
        for start, stop in runs(zeta <= threshold):
            if stop - start < least:
                continue
            inset = min((stop - start) // 4, round(INSET_S / s.period_s))
            values = part.values[start + inset : stop - inset][:, columns]
            from_s, to_s = float(part.t_s[start]), float(part.t_s[stop - 1]) + s.period_s
            scatter = _scatter(values, s.period_s)
            rests.append(Rest(number, start, stop, from_s, to_s, values.mean(axis=0), scatter, inset))
    return tuple(rests)


def over_logs(slopes_degps: Sequence[float]) -> dict[str, Any]:
    """Keys of the slopes of an angle, one for each log that shows one (Fig. 2.4): mean and scatter."""
    return {
        "mean_degps": float(np.mean(slopes_degps)) if slopes_degps else None,
        "spread_degps": float(np.std(slopes_degps, ddof=1)) if len(slopes_degps) > 1 else None,
        "logs": len(slopes_degps),
    }


def sampled(s: Sampling) -> dict[str, Any]:
    """Keys that say how a log was sampled."""
    return {
        "duration_s": s.duration_s,
        "rate_hz": s.rate_hz,
        "jitter_s": s.jitter_s,
        "missing": s.missing,
        "gaps": sum(not gap.split for gap in s.gaps),
        "splits": sum(gap.split for gap in s.gaps),
        "repeated_rows": s.repeated_rows,
        "repeated_stamps": s.repeated_stamps,
    }


def sensor_findings(logs: Sequence[Any]) -> Iterator[Finding]:
    """Findings on the sensors of logs, which are named."""
    for log in logs:
        for one in log.findings:
            yield replace(one, text=f"{log.source}: {one.text}")

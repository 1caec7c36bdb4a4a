"""How the angles of one log drift apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import uniform_filter1d
from scipy.special import stdtrit

from calib.core.arrays import BoolArray, FloatArray, blocks, integral, runs
from calib.core.errors import BadInputError
from calib.core.result import degrees_or_none, finite_or_none, judged
from calib.core.verdict import Finding, Verdict
from calib.solve.clock import Part
from calib.solve.delay import vertex
from calib.stages.imu.allan import allan_variance
from calib.stages.imu.mahony import Mahony, mean_angle, wrapped
from calib.stages.imu.sampling import (
    AXES,
    Readings,
    Sampling,
    over_logs,
    regular_parts,
    rest_parts,
    sampled,
    sampling_findings,
    sensor_findings,
    without_gaps,
)
from calib.stages.imu.section import Drift, DriftGains, DriftMethod, DriftOfLog, DriftSlopes
from calib.stages.imu.tracks import Track, Tuned, levelled_angle, on_grid, rate_of, tracks_of
from calib.stages.imu.tuning import contradicted, parameters_of

# ----------------------------------------------------------------------
# What is said of the error of an angle: its slope with an interval, its lag, its Allan deviation.
#
# **Slope.** An ordinary straight line with one slope and an offset for each stretch. The error of an angle
# is no white noise: an integrated rate walks at random, a filter forgets slowly. So the stretches are cut
# into about 128 blocks, and the blocks' means r about the line are taken for white noise on a process of
# order one, whose limit is the random walk,
#
#     cov(r_i, r_j) = s^2 ((1 - a) [i = j] + a (1 - rho^2) rho^|i-j|),
#
# the second term being the covariance of the means of a walk for rho = 1 (min(i, j) would be that of single
# samples, whose steps are larger by the root of 3 / 2).
#
# Every pair of a grid of (rho, a) is given its restricted likelihood (Patterson and Thompson, Biometrika
# 58, 1971), which does not take what the line has fitted for evidence of calm, with the s^2 that suits it
# best, and its variance of the slope, w' cov w for the weights w of the line. Where the log does not decide
# between pairs, the most doubtful counts: the largest deviation among those whose log-likelihood is within
# `_SUPPORT` of the highest. The interval is Student's for the number of blocks.
#
# A slope that itself wanders, as that of a gyroscope's bias does, has no interval from one log: the spread
# over several logs shows it.
#
# **Lag.** Both angles are freed from what is slower than some seconds, the estimate is moved against the
# truth by whole samples, and a parabola through the highest correlation and its neighbours gives the
# fraction. Drift and offsets so play no part. An instrument's truth may itself come late: by how much the
# angle by the gyroscope leads it says so, and the truth is moved by that first.

_BLOCKS = 128
_FEWEST_BLOCKS = 8
_RHO = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
_SHARE = (0.02, 0.1, 0.3, 0.6, 0.9, 1.0)
_SUPPORT = 1.0
_SLOW_S = 4.0
_FARTHEST_S = 0.5
_LEAST_CORRELATION = 0.5
_SURE_CORRELATION = 0.9
_LEAST_LATE = 0.2
"""Steps by which a truth has to be late to be moved: below, the parabola's fraction is in doubt."""


class Slope(NamedTuple):
    """Slope [rad/s], its standard deviation and its 95 % interval; NaN where it cannot be told."""

    value: float = math.nan
    sigma: float = math.nan
    low: float = math.nan
    high: float = math.nan


def _line(stretches: Sequence[FloatArray]) -> float:
    """Slope per sample with one offset for each stretch."""
    top, below = 0.0, 0.0
    for y in stretches:
        k = np.arange(len(y), dtype=np.float64)
        k -= k.mean()
        top += float(k @ y)
        below += float(k @ k)
    return top / below if below > 0.0 else math.nan


@lru_cache(maxsize=512)
def _covariance(count: int, size: int, rho: float, share: float) -> FloatArray:
    """Covariance of the means of `count` blocks of `size` samples for s^2 = 1."""
    k = np.arange(count)
    if rho >= 1.0:
        # A walk of variance 1 / size per sample, averaged within each block.
        slow = np.minimum.outer(k, k) + (size + 1.0) / (2.0 * size)
        slow[k, k] = k + (size + 1.0) * (2.0 * size + 1.0) / (6.0 * size * size)
    else:
        slow = (1.0 - rho * rho) * rho ** np.abs(np.subtract.outer(k, k)).astype(np.float64)
    return np.asarray((1.0 - share) * np.eye(count) + share * slow)


def _judged(means: Sequence[FloatArray], size: int, rho: float, share: float) -> tuple[float, float]:
    """Restricted log-likelihood, and variance of the slope per block."""
    J, below = (
        sum(len(mean) for mean in means),
        sum(len(mean) * (len(mean) ** 2 - 1) / 12.0 for mean in means),
    )
    logs, weight = 0.0, 0.0
    tt, ty, yy = 0.0, 0.0, 0.0
    for mean in means:
        k = np.arange(len(mean), dtype=np.float64)
        k -= k.mean()
        G = _covariance(len(mean), size, rho, share)
        L = np.linalg.cholesky(G)
        one, t, y = solve_triangular(L, np.stack([np.ones_like(k), k, mean], axis=1), lower=True).T
        logs += 2.0 * float(np.log(np.diag(L)).sum()) + math.log(float(one @ one))
        # Each stretch's own offset goes out first.
        t, y = t - one * (one @ t) / (one @ one), y - one * (one @ y) / (one @ one)
        tt, ty, yy = tt + float(t @ t), ty + float(t @ y), yy + float(y @ y)
        weight += float(k @ G @ k) / below**2
    free = J - len(means) - 1
    scale = max(yy - ty * ty / tt, 0.0) / free
    if scale <= 0.0:
        return math.inf, 0.0
    return -0.5 * (logs + math.log(tt) + free * math.log(scale)), scale * weight


def slope_of(stretches: Sequence[FloatArray], period_s: float) -> Slope:
    """Common slope of the stretches (n_i,) [rad] at one period, each with an offset of its own.

    NaN without two samples in a stretch; without an interval where they give too few blocks.
    """
    long = [y for y in stretches if len(y) >= 2]
    if not long:
        return Slope()
    value = _line(long) / period_s
    size = max(sum(len(y) for y in long) // _BLOCKS, 1)
    means = [blocks(y, size).mean(axis=1) for y in long if len(y) >= 2 * size]
    free = sum(len(mean) for mean in means) - len(means) - 1
    if free < _FEWEST_BLOCKS:
        return Slope(value)
    means = [mean - mean.mean() for mean in means]
    pairs = [(rho, share) for rho in _RHO for share in (_SHARE if rho > 0.0 else _SHARE[:1])]
    judged = [_judged(means, size, rho, share) for rho, share in pairs]
    most = max(likely for likely, _ in judged)
    sigma = math.sqrt(max(v for likely, v in judged if likely >= most - _SUPPORT)) / (size * period_s)
    half = float(stdtrit(free, 0.975)) * sigma
    return Slope(value, sigma, value - half, value + half)


def allan_at(stretches: Sequence[FloatArray], period_s: float, tau_s: float) -> float:
    """Overlapping Allan deviation of the angles [rad] averaged over tau; NaN where all are too short."""
    m = np.array([max(round(tau_s / period_s), 1)], dtype=np.int64)
    if not any(len(y) >= 2 * int(m[0]) for y in stretches):
        return math.nan
    return math.sqrt(float(allan_variance(list(stretches), m)[0]))


def _quick(y: FloatArray, period_s: float) -> FloatArray:
    """What is faster than some seconds, without ends where the mean does not take a bias out."""
    size = min(max(round(_SLOW_S / period_s), 3), len(y))
    end = min(size // 2, len(y) // 8)
    return np.asarray(y - uniform_filter1d(y, size, mode="nearest"))[end : len(y) - end]


def _likest(
    estimate: Sequence[FloatArray], truth: Sequence[FloatArray], period_s: float
) -> tuple[float, float]:
    """Highest correlation over all lags, and the lag there; -1 and NaN where none is or it is at an end."""
    M = max(round(_FARTHEST_S / period_s), 2)
    lags = np.arange(-M, M + 1)
    both, own, theirs = np.zeros(len(lags)), np.zeros(len(lags)), 0.0
    for e, t in zip(estimate, truth, strict=True):
        n = len(t)
        if n < 4 * M:
            continue
        quick_e, quick_t = _quick(e, period_s), _quick(t, period_s)
        n = len(quick_t)
        quick_t = quick_t[M : n - M]
        theirs += float(quick_t @ quick_t)
        for i, lag in enumerate(lags.tolist()):
            moved = quick_e[M + lag : n - M + lag]
            both[i] += float(moved @ quick_t)
            own[i] += float(moved @ moved)
    if not (theirs > 0.0 and own.min() > 0.0):
        return -1.0, math.nan
    c = both / np.sqrt(own * theirs)
    i = int(np.argmax(c))
    if i in (0, len(c) - 1):
        return -1.0, math.nan
    return float(c[i]), float((lags[i] + vertex(*(-c[i - 1 : i + 2]).tolist())) * period_s)


def lag_s(estimate: Sequence[FloatArray], truth: Sequence[FloatArray], period_s: float) -> float:
    """How much later [s] the estimate comes than the truth; negative where it is ahead.

    Parameters
    ----------
    estimate, truth : pairs of stretches (n_i,) at one period.

    Returns
    -------
    NaN where the two hardly resemble each other, or are most alike at the end of what was tried.
    """
    likeness, lag = _likest(estimate, truth, period_s)
    return lag if likeness >= _LEAST_CORRELATION else math.nan


def turned_angles(parts: Sequence[Part], axes: tuple[str, ...]) -> list[list[FloatArray]]:
    """Angles (n_i,) [rad] of each part to place a truth by: -gz integrated, and levelled by six axes.

    Of a sensor that tilts -gz is not the angle's rate, and seems ten milliseconds early or late.
    """
    ways = [[integral(part.t_s, rate_of(part, axes, False)) for part in parts]]
    if len(axes) == len(AXES):
        ways.append([levelled_angle(part, axes) for part in parts])
    return ways


def truth_late_s(
    turned: Sequence[Sequence[FloatArray]], truth: Sequence[FloatArray], period_s: float
) -> float:
    """How much later [s] a truth comes than the gyroscope turned; 0 where that is not clear or negligible.

    Parameters
    ----------
    turned : as of `turned_angles`; the one that resembles the truth most counts.
    truth : angles (n_i,) [rad] of each part, NaN where not known.
    """
    likeness, lag = max(_likest(*_both_known(angles, truth), period_s) for angles in turned)
    late_s = -lag if likeness >= _SURE_CORRELATION else 0.0
    return late_s if abs(late_s) > _LEAST_LATE * period_s else 0.0


# ----------------------------------------------------------------------
# How the angle drifts by each way of getting it, on the same log.
#
# The methods are those of `calib.stages.imu.tracks`, over each part of a log that has no long gap. What is
# judged is the error of their angle against
#
# - the true angle, where the log has one: everywhere, without the first seconds of a part for slope,
#   offset, Allan deviation and RMSE; while it moves for RMSE and lag;
# - otherwise a constant, in each stretch at rest, again without the stretch's first seconds, in which
#   filters settle. A log that never rests then shows nothing.
#
# An angle has no absolute zero here, as the sensor is mounted at an unknown one: the offset is the mean
# error against the truth, or against the accelerometer's mean angle in the same stretch, and the RMSE is
# taken about the mean error while it moves.
#
# A slope alone does not rank filters. The MM filter takes a constant bias of the gyroscope into its
# integral and rejects it entirely: what slope is left is the accelerometer's, whatever the gains. A slope
# near zero thus says nothing about noise, lag and error in motion.

NOT_A_RANKING = (
    "a slope alone does not rank filters: the MM filter rejects a constant gyro bias entirely, so that the "
    "slope it has left is the accelerometer's, whatever its gains; look at noise, lag and RMSE in motion too"
)

_SETTLE_S = 5.0
_SETTLE_SHARE = 0.25
_SHORTEST_S = 2.0


@dataclass(frozen=True)
class LogDrift:
    """What is said of one log, and what that is drawn from.

    Attributes
    ----------
    start_s : time of each part's first sample. period_s : from each to the next.
    truth_rad : the true angle in each part, NaN outside of its samples; None without.
    tracks : of each method.
    findings : on a truth that is another motion's.
    """

    section: DriftOfLog
    start_s: tuple[float, ...]
    period_s: float
    truth_rad: tuple[FloatArray, ...] | None
    tracks: tuple[Track, ...]
    findings: tuple[Finding, ...]


def _settled(start: int, stop: int, period_s: float) -> slice:
    skip = min(round(_SETTLE_S / period_s), int(_SETTLE_SHARE * (stop - start)))
    return slice(start + skip, stop)


def _no_turns(error: FloatArray) -> FloatArray:
    """An error without jumps by a turn, its middle within half a turn."""
    smooth = np.unwrap(error)
    return np.asarray(smooth - 2.0 * math.pi * np.rint(np.median(smooth) / (2.0 * math.pi)))


def _upright(log: Readings) -> float:
    """Median share of gravity that is in the sensor's plane, squared; NaN without az.

    Where it is small the plane is nearly level, and the angle hardly defined.
    """
    if "az" not in log.axes:
        return math.nan
    ax, ay, az = (log.values[:, log.axes.index(axis)] for axis in ("ax", "ay", "az"))
    return float(np.median((ax**2 + ay**2) / np.maximum(ax**2 + ay**2 + az**2, 1e-12)))


def _both_known(
    estimate: Sequence[FloatArray], truth: Sequence[FloatArray]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """The stretches of two angles in which both are known."""
    where = [
        (e, t, a, b)
        for e, t in zip(estimate, truth, strict=True)
        for a, b in runs(np.isfinite(e) & np.isfinite(t))
    ]
    return [e[a:b] for e, _, a, b in where], [t[a:b] for _, t, a, b in where]


def _measure(
    track: Track,
    truth: Sequence[FloatArray] | None,
    phi_acc: Sequence[FloatArray],
    stretches: Sequence[tuple[int, slice]],
    moving: Sequence[BoolArray],
    period_s: float,
) -> DriftMethod:
    errors, offsets = [], []
    for k, where in stretches:
        angle = track.phi_rad[k][where]
        error = angle - truth[k][where] if truth is not None else angle
        known = np.isfinite(error)
        if known.sum() < 2:
            continue
        # Short gaps of the truth or of the chip's angle do not cut a stretch in two.
        at = np.arange(len(error))
        error = _no_turns(np.interp(at, at[known], _no_turns(error[known])))
        errors.append(error)
        zero = 0.0 if truth is not None else mean_angle(phi_acc[k][where])
        offsets.append(float(error.mean()) - zero)
    offset = math.nan
    if offsets:
        lengths = [len(error) for error in errors]
        offset = float(np.average(wrapped(np.array(offsets)), weights=lengths))
    rmse, lag = math.nan, math.nan
    if truth is not None:
        off = []
        for e, t, m in zip(track.phi_rad, truth, moving, strict=True):
            late = _settled(0, len(t), period_s)
            error = (e - t)[late]
            off.append(error[np.isfinite(error) & m[late]])
        off = [error for error in off if len(error)]
        if off:
            # Parts may be whole turns apart.
            middle = float(np.median(off[0]))
            rmse = float(np.concatenate([_no_turns(error - middle) for error in off]).std())
            lag = lag_s(*_both_known(track.phi_rad, truth), period_s)
    slope = slope_of(errors, period_s)
    return DriftMethod(
        offset_deg=degrees_or_none(offset),
        slope_degps=degrees_or_none(slope.value),
        sigma_degps=degrees_or_none(slope.sigma),
        interval_degps=[degrees_or_none(slope.low), degrees_or_none(slope.high)],
        allan_1s_deg=degrees_or_none(allan_at(errors, period_s, 1.0)),
        allan_100s_deg=degrees_or_none(allan_at(errors, period_s, 100.0)),
        rmse_deg=degrees_or_none(rmse),
        lag_ms=finite_or_none(1e3 * lag),
    )


def analyse_drift(
    log: Readings,
    tuned: Tuned | None = None,
    peers: bool = True,
    told: Callable[[str], None] = lambda sentence: None,
) -> LogDrift:
    """All methods on one log, and what is said of each.

    Parameters
    ----------
    tuned : what the row "tuned" is made with, left out without.
    peers : run the filters of others that are installed.
    told : is called with a sentence before what may take long.

    Raises
    ------
    BadInputError for a log with too few samples.
    """
    sampling, every = regular_parts(log)
    period_s = sampling.period_s
    every = without_gaps(every, period_s)
    parts = tuple(part for part in every if len(part.values) * period_s >= _SHORTEST_S)
    if not parts:
        longest = max(len(part.values) for part in every) * period_s
        raise BadInputError(
            f"{log.source}: is {longest:.3g} s long without a long gap, expected at least {_SHORTEST_S:g} s"
        )
    _, motions = rest_parts(parts, period_s, log.gyro, sampling.step)
    moving = []
    for part in parts:
        at = part.t_s + 0.5 * period_s
        flags = np.zeros(len(at), dtype=np.bool_)
        for motion in motions:
            flags[np.searchsorted(at, motion.from_s) : np.searchsorted(at, motion.to_s)] = True
        moving.append(flags)
    tracks, skipped = tracks_of(log, parts, period_s, tuned, peers, told)
    by_name = {track.name: track.phi_rad for track in tracks}
    truth, late_s = None, 0.0
    if len(log.true_t_s) >= 2:
        truth = on_grid(log.true_t_s, log.true_phi_rad, parts, period_s)
        late_s = truth_late_s(turned_angles(parts, log.axes), truth, period_s)
        if late_s:
            truth = on_grid(log.true_t_s - late_s, log.true_phi_rad, parts, period_s)
        stretches = [(k, _settled(0, len(part.values), period_s)) for k, part in enumerate(parts)]
    else:
        stretches = [
            (k, _settled(a, b, period_s))
            for k, flags in enumerate(moving)
            for a, b in runs(~flags)
            if (b - a) * period_s >= _SHORTEST_S
        ]
    phi_acc = by_name["accelerometer alone"]
    measures = {one.name: _measure(one, truth, phi_acc, stretches, moving, period_s) for one in tracks}
    against: Literal["truth", "rest", "nothing"] = "rest" if stretches else "nothing"
    if truth is not None:
        against = "truth"
    section = DriftOfLog(
        name=log.source,
        **sampled(sampling),
        against=against,
        about=_ABOUT[against],
        judged_s=period_s * sum(where.stop - where.start for _, where in stretches),
        moving_s=period_s * sum(int(flags.sum()) for flags in moving),
        methods=measures,
        skipped=skipped,
        remarks=[*_remarks(log, sampling, late_s)],
    )
    starts = tuple(float(part.t_s[0]) for part in parts)
    return LogDrift(section, starts, period_s, truth, tuple(tracks), (*_untrue(log, parts, truth or ()),))


def _untrue(log: Readings, parts: Sequence[Part], truth: Sequence[FloatArray]) -> Iterator[Finding]:
    """A finding where a true angle turns otherwise than the gyroscope, by -gz and by the up vector alike."""
    for part, seen in zip(parts, truth, strict=False):
        ways = (False,) if log.lacks else (False, True)
        apart = [contradicted(part.t_s, rate_of(part, log.axes, tilted), seen) for tilted in ways]
        if all(apart):
            text = f"{log.source}: rate and true_phi_rad contradict each other: {apart[0]}"
            yield Finding("inconsistent", text, "check the columns, signs and units of that log")
            return


def spread_of(logs: Sequence[DriftOfLog]) -> dict[str, DriftSlopes]:
    """Mean and spread of the slopes of each method over the logs that show one (Fig. 2.4)."""
    out = {}
    for name in dict.fromkeys(name for log in logs for name in log.methods):
        slopes = [log.methods[name].slope_degps for log in logs if name in log.methods]
        out[name] = DriftSlopes(**over_logs([slope for slope in slopes if slope is not None]))
    return out


# ----------------------------------------------------------------------
# The section.

_LEAST_UPRIGHT = 0.1
_ABOUT = {
    "truth": "error against true_phi_rad, without the first seconds",
    "rest": "angle in the stretches at rest, without their first seconds; the offset is against the "
    "accelerometer's mean angle",
    "nothing": "the log never rests and has no true_phi_rad, so that it shows no drift",
}


def solve_drift(
    logs: Sequence[Readings],
    hashes: dict[str, str],
    tuned: Tuned | None,
    peers: bool,
    narrate: Callable[[str], None],
) -> Drift:
    """Every way of getting the angle on every log, and how each drifts.

    Parameters
    ----------
    hashes : of the logs. tuned : the rig's gains. peers : whether filters of others run.
    """
    analysed = [analyse_drift(log, tuned, peers, narrate) for log in logs]
    sections = [log.section for log in analysed]
    return Drift(
        note=NOT_A_RANKING,
        logs=sections,
        methods=spread_of(sections),
        provenance={"inputs": hashes},
        tuned=None
        if tuned is None
        else DriftGains(
            filter="mahony" if isinstance(tuned.gains, Mahony) else "levelling",
            **parameters_of(tuned.gains),
            rate_of_angle="up vector" if tuned.up_vector else "-gz",
        ),
        **judged(Verdict.of([*sensor_findings(logs), *(one for log in analysed for one in log.findings)])),
    ).with_evidence(analysed)


def _remarks(log: Readings, sampling: Sampling, truth_late_s: float) -> Iterator[str]:
    """Sentences about a log, whose truth was moved by so much."""
    for finding in sampling_findings(sampling, log.axes, log.source):
        yield finding.text
    if truth_late_s:
        when = "later" if truth_late_s > 0.0 else "earlier"
        yield (
            f"{log.source}: true_phi_rad comes {1e3 * abs(truth_late_s):.1f} ms {when} than the gyroscope "
            "turns; it is moved by that, and lags are against the gyroscope"
        )
    upright = _upright(log)
    if upright < _LEAST_UPRIGHT:
        tilt = math.degrees(math.acos(math.sqrt(upright)))
        yield (
            f"{log.source}: gravity is {tilt:.0f} degrees out of the sensor's x-y plane, where the angle "
            "atan2(ay, ax) is hardly defined; noise and drift of all methods are large for that reason"
        )

"""How the angle drifts by each way of getting it, on the same log.

The methods are those of `calib.imu.tracks`, over each part of a log that has no long gap. What is
judged is the error of their angle against

- the true angle, where the log has one: everywhere, without the first seconds of a part for slope,
  offset and Allan deviation, and while it moves for RMSE and lag;
- otherwise a constant, in each stretch at rest, again without the stretch's first seconds, in which
  filters settle. A log that never rests then shows nothing.

An angle has no absolute zero here, as the sensor is mounted at an unknown one: the offset is the mean
error against the truth, or against the accelerometer's mean angle in the same stretch, and the RMSE is
taken about the mean error while it moves.

A slope alone does not rank filters. The MM filter takes a constant bias of the gyroscope into its
integral and rejects it entirely: what slope is left is the accelerometer's, whatever the gains. A slope
near zero thus says nothing about noise, lag and error in motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError
from calib.imu.mahony_batch import wrapped
from calib.imu.measures import Slope, allan_at, lag_s, slope_of
from calib.imu.rest import rest_parts
from calib.imu.sampling import Sampling, regular_parts
from calib.imu.static import is_gyro
from calib.imu.tracks import DriftLog, Track, Tuned, mean_angle, on_grid, tracks_of

__all__ = [
    "NOT_A_RANKING",
    "LogDrift",
    "Measures",
    "Spread",
    "analyse_drift",
    "spread_of",
]

NOT_A_RANKING = (
    "a slope alone does not rank filters: the MM filter rejects a constant gyro bias entirely, so that the "
    "slope it has left is the accelerometer's, whatever its gains; look at noise, lag and RMSE in motion too"
)

_SETTLE_S = 5.0
_SETTLE_SHARE = 0.25
_SHORTEST_S = 2.0


@dataclass(frozen=True)
class Measures:
    """What is said of one method on one log [rad, s]; NaN where the log does not show it."""

    name: str
    offset_rad: float
    slope: Slope
    allan_1s_rad: float
    allan_100s_rad: float
    rmse_rad: float
    lag_s: float


@dataclass(frozen=True)
class LogDrift:
    """One log.

    Attributes
    ----------
    against : "truth", "rest" or "nothing".
    judged_s : length of what slope, offset and Allan deviation rest on.
    moving_s : length of what it moves.
    upright : median share of gravity that is in the sensor's plane, squared; NaN without az. Where it is
        small the plane is nearly level, and the angle hardly defined.
    start_s : time of each part's first sample.
    moving : where (n_i,) each part moves.
    truth_rad : the true angle in each part, NaN outside of its samples; None without.
    tracks, measures : by method, in the same order.
    skipped : sentences about methods that were left out.
    """

    source: str
    sampling: Sampling
    against: str
    judged_s: float
    moving_s: float
    upright: float
    start_s: tuple[float, ...]
    moving: tuple[BoolArray, ...]
    truth_rad: tuple[FloatArray, ...] | None
    tracks: tuple[Track, ...]
    measures: tuple[Measures, ...]
    skipped: tuple[str, ...]


@dataclass(frozen=True)
class Spread:
    """Slopes [rad/s] of one method over several logs: mean, standard deviation from log to log, number."""

    name: str
    mean_radps: float
    spread_radps: float
    logs: int


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    """First and behind the last of each run of set flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int64), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _settled(start: int, stop: int, period_s: float) -> slice:
    skip = min(round(_SETTLE_S / period_s), int(_SETTLE_SHARE * (stop - start)))
    return slice(start + skip, stop)


def _no_turns(error: FloatArray) -> FloatArray:
    """An error without jumps by a turn, its middle within half a turn."""
    smooth = np.unwrap(error)
    return np.asarray(smooth - 2.0 * math.pi * np.rint(np.median(smooth) / (2.0 * math.pi)))


def _upright(log: DriftLog) -> float:
    if "az" not in log.axes:
        return math.nan
    ax, ay, az = (log.values[:, log.axes.index(axis)] for axis in ("ax", "ay", "az"))
    return float(np.median((ax**2 + ay**2) / np.maximum(ax**2 + ay**2 + az**2, 1e-12)))


def _measure(
    track: Track,
    truth: Sequence[FloatArray] | None,
    phi_acc: Sequence[FloatArray],
    stretches: Sequence[tuple[int, slice]],
    moving: Sequence[BoolArray],
    period_s: float,
) -> Measures:
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
        off = [(e - t)[np.isfinite(e - t) & m] for e, t, m in zip(track.phi_rad, truth, moving, strict=True)]
        off = [_no_turns(error) for error in off if len(error)]
        if off:
            # Parts may be whole turns apart.
            middle = float(np.median(off[0]))
            flat = np.concatenate(
                [
                    error - 2.0 * math.pi * np.rint((np.median(error) - middle) / (2.0 * math.pi))
                    for error in off
                ]
            )
            rmse = float(flat.std())
            pieces = [
                (e[a:b], t[a:b])
                for e, t in zip(track.phi_rad, truth, strict=True)
                for a, b in _runs(np.isfinite(e) & np.isfinite(t))
            ]
            lag = lag_s([e for e, _ in pieces], [t for _, t in pieces], period_s)
    return Measures(
        track.name,
        offset,
        slope_of(errors, period_s),
        allan_at(errors, period_s, 1.0),
        allan_at(errors, period_s, 100.0),
        rmse,
        lag,
    )


def analyse_drift(
    log: DriftLog,
    tuned: Tuned | None = None,
    peers: bool = True,
    told: Callable[[str], None] = lambda sentence: None,
) -> LogDrift:
    """All methods on one log, and what is said of each.

    Parameters
    ----------
    tuned : what the row "MM tuned" is made with, left out without.
    peers : run the filters of others that are installed.
    told : is called with a sentence before what may take long.

    Raises
    ------
    BadInputError for a log without gz, ax and ay or with too few samples.
    """
    for axis in ("gz", "ax", "ay"):
        if axis not in log.axes:
            raise BadInputError(f"{log.source}: has no readings of {axis}, expected gz, ax and ay")
    gyro = is_gyro(log.axes)
    sampling, every = regular_parts(log.t_s, log.values, gyro, log.source)
    period_s = sampling.period_s
    parts = tuple(part for part in every if len(part.values) * period_s >= _SHORTEST_S)
    if not parts:
        longest = max(len(part.values) for part in every) * period_s
        raise BadInputError(
            f"{log.source}: is {longest:.3g} s long without a long gap, expected at least {_SHORTEST_S:g} s"
        )
    _, motions = rest_parts(parts, period_s, gyro, sampling.step)
    moving = []
    for part in parts:
        at = part.start_s + period_s * (np.arange(len(part.values)) + 0.5)
        flags = np.zeros(len(at), dtype=np.bool_)
        for motion in motions:
            flags[np.searchsorted(at, motion.from_s) : np.searchsorted(at, motion.to_s)] = True
        moving.append(flags)
    truth = None
    if len(log.true_t_s) >= 2:
        truth = on_grid(log.true_t_s, log.true_phi_rad, parts, period_s)
        stretches = [(k, _settled(0, len(part.values), period_s)) for k, part in enumerate(parts)]
    else:
        stretches = [
            (k, _settled(a, b, period_s))
            for k, flags in enumerate(moving)
            for a, b in _runs(~flags)
            if (b - a) * period_s >= _SHORTEST_S
        ]
    tracks, skipped = tracks_of(log, parts, period_s, tuned, peers, told)
    phi_acc = next(track.phi_rad for track in tracks if track.name == "accelerometer alone")
    measures = [_measure(track, truth, phi_acc, stretches, moving, period_s) for track in tracks]
    return LogDrift(
        log.source,
        sampling,
        "truth" if truth is not None else "rest" if stretches else "nothing",
        period_s * sum(where.stop - where.start for _, where in stretches),
        period_s * sum(int(flags.sum()) for flags in moving),
        _upright(log),
        tuple(part.start_s for part in parts),
        tuple(moving),
        truth,
        tuple(tracks),
        tuple(measures),
        tuple(skipped),
    )


def spread_of(logs: Sequence[LogDrift]) -> tuple[Spread, ...]:
    """Mean and spread of the slopes of each method over the logs that show one (Fig. 2.4)."""
    names = list(dict.fromkeys(measures.name for log in logs for measures in log.measures))
    out = []
    for name in names:
        slopes = [m.slope.value for log in logs for m in log.measures if m.name == name]
        known = np.array([slope for slope in slopes if math.isfinite(slope)])
        spread = float(known.std(ddof=1)) if len(known) > 1 else math.nan
        out.append(Spread(name, float(known.mean()) if len(known) else math.nan, spread, len(known)))
    return tuple(out)

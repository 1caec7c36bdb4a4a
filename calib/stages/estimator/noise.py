"""Noise of sensors and process, tuned on logs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.estimator.driven import Drive, DrivenFilter
from calib.stages.estimator.kinematic import OUT, Filter, Rows, Setup

# ----------------------------------------------------------------------
# Noise that a log itself tells: the tracker's jitter, and levels of process noise.
#
# The likelihood of a log is the product of what its filter expected of each reading. It is maximised over the
# logarithm of one number at a time: a grid, then the parabola through the best three values, whose curvature
# gives the standard deviation. Pooled over logs of rest and motion it would drive the process noise to what
# the most frequent regime needs, so each level of the bank is tuned by logs in which it speaks, weighted by
# nothing else: the bank's own likelihood does that.

_JITTERS_PX = np.array([0.05, 0.1, 0.15, 0.22, 0.3, 0.42, 0.6, 0.85, 1.2, 2.0])
_FACTORS = np.array([0.5, 1.0, 2.0])
GATED = 12.0
"""What a gated sensor costs."""
_DEFAULT_JITTER_PX = 0.4
_ACCELERATIONS = {"phi": "accel_phi_radps2", "length": "accel_length_mps2"}
"""What is tuned of a level, by axis."""


@dataclass(frozen=True)
class Estimate:
    """A number and the standard deviation of its logarithm, None where the log does not bound it."""

    value: float
    sigma: float | None


@dataclass(frozen=True)
class Tuning:
    """What tuning has found.

    Attributes
    ----------
    setup : with the tuned noise. jitter_px : of the tracker.
    factors : by level and axis, against the bank before.
    before, after : log likelihood of all logs. rows : of all logs.
    """

    setup: Setup
    jitter_px: Estimate
    factors: dict[str, Estimate]
    before: float
    after: float
    rows: int


def grid_px(readings: FloatArray) -> float:
    """Step of the pixels in readings (n, 5): 1 where all are whole, else 0."""
    seen = readings[:, :2][np.isfinite(readings[:, :2]).all(axis=1)]
    return 1.0 if len(seen) and bool(np.all(seen == np.rint(seen))) else 0.0


_GATES = [OUT.index(f"gated_{name}") for name in ("camera", "accel", "gyro")]


def _of(out: FloatArray) -> float:
    """Log likelihood of an output; a gated sensor counts as a reading at the edge: gating wins nothing."""
    return float(np.nansum(out[:, OUT.index("log_likelihood")]) - GATED * np.nansum(out[:, _GATES]))


def log_likelihood(setup: Setup, logs: Sequence[Rows], drive: Drive | None = None) -> float:
    """Of all logs by the kinematic filter, or by the driven one."""
    return sum(
        _of((Filter(setup) if drive is None else DrivenFilter(setup, drive)).run(rows)) for rows in logs
    )


def best(values: FloatArray, likelihood: Callable[[float], float]) -> tuple[Estimate, float]:
    """The maximum over a rising grid of positive numbers, refined in the logarithm.

    The grid is climbed from its middle, as each likelihood is a run of the filter.
    """
    found = dict[int, float]()

    def at(index: int) -> float:
        if index not in found:
            found[index] = likelihood(float(values[index])) if 0 <= index < len(values) else -math.inf
        return found[index]

    k = len(values) // 2
    while at(k) < max(at(k - 1), at(k + 1)):
        k += 1 if at(k + 1) > at(k - 1) else -1
    if not 0 < k < len(values) - 1:
        return Estimate(float(values[k]), None), at(k)
    x, y = np.log(values[k - 1 : k + 2]), np.array([at(k - 1), at(k), at(k + 1)])
    a, b, _ = np.polyfit(x - x[1], y - y[1], 2)
    if not a < 0.0:
        return Estimate(float(values[k]), None), at(k)
    top = float(np.clip(-0.5 * b / a, x[0] - x[1], x[2] - x[1]))
    value = math.exp(x[1] + top)
    at_top = likelihood(value)
    if at_top < at(k):
        return Estimate(float(values[k]), math.sqrt(-0.5 / a)), at(k)
    return Estimate(value, math.sqrt(-0.5 / a)), at_top


def with_jitter(setup: Setup, jitter: float) -> Setup:
    """A set-up with another jitter of the tracker [px]."""
    noise = setup.noise.copy()
    noise[0] = jitter
    return replace(setup, noise=noise)


def jitter_px(setup: Setup, logs: Sequence[Rows]) -> Estimate:
    """Standard deviation of the tracker's jitter before rounding [px], by maximum likelihood.

    Without pictures it is a guess of 0.4 px without deviation.
    """
    if not any(np.isfinite(rows.readings[:, 0]).any() for rows in logs):
        return Estimate(_DEFAULT_JITTER_PX, None)
    return best(_JITTERS_PX, lambda value: log_likelihood(with_jitter(setup, value), logs))[0]


def _scaled(setup: Setup, index: int, axis: str, factor: float) -> Setup:
    """A set-up with the accelerations of a level along an axis scaled."""
    levels, name = list(setup.process.levels), _ACCELERATIONS[axis]
    changed: dict[str, Any] = {name: factor * getattr(levels[index], name)}
    levels[index] = replace(levels[index], **changed)
    return replace(setup, process=replace(setup.process, levels=tuple(levels)))


def tune(setup: Setup, logs: Sequence[Rows], progress: Callable[[int, int], None] | None = None) -> Tuning:
    """Jitter and the levels' accelerations by maximum likelihood, one after the other.

    A factor of a level is at most two either way: logs without its motion say little about it.
    """
    before = log_likelihood(setup, logs)
    jitter = jitter_px(setup, logs)
    setup = with_jitter(setup, jitter.value)
    factors: dict[str, Estimate] = {}
    after = log_likelihood(setup, logs)
    tuned = list(product(range(len(setup.process.levels)), _ACCELERATIONS))
    for done, (index, axis) in enumerate(tuned, start=1):
        if progress is not None:
            progress(done, 1 + len(tuned))

        made = partial(_scaled, setup, index, axis)

        def likelihood(factor: float, made: Callable[[float], Setup] = made) -> float:
            return log_likelihood(made(factor), logs)

        found, reached = best(_FACTORS, likelihood)
        factors[f"{setup.process.levels[index].name}_{axis}"] = found
        if reached > after:
            after, setup = reached, made(found.value)
    return Tuning(setup, jitter, factors, before, after, sum(len(rows) for rows in logs))


# ----------------------------------------------------------------------
# Process noise of the driven filter from logs, by maximum likelihood of its innovations.
#
# What the model of plant and pumps lacks is in three random walks: of the disturbance forces, of the rates,
# and of lag, forces and creep. Each is scaled by the factor at which a log is most likely, one after the
# other. A log in which little happens needs no noise and would, pooled with others, drive it to nothing; so
# logs are asked one by one, and the one that needs most has its way. No factor is less than a half: that
# nothing disturbs a plant, a log cannot show.

WALKS = ("disturbance", "rates", "forces")
_DRIVEN_NOISE_FACTORS = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
_CONVINCING = 2.0
"""So much the log likelihood must rise, the gain of one number that means something."""


def scaled(drive: Drive, walk: str, factor: float) -> Drive:
    """A drive with one of `WALKS` scaled."""
    name = f"walk_{walk}"
    value = getattr(drive, name)
    both = isinstance(value, tuple)
    changed: dict[str, Any] = {name: tuple(factor * one for one in value) if both else factor * value}
    return replace(drive, **changed)


def tune_driven(
    setup: Setup, drive: Drive, logs: Sequence[Rows], progress: Callable[[int, int], None] | None = None
) -> tuple[Drive, dict[str, Estimate]]:
    """The drive with the walks that the log with the greatest need of each asks for, and their factors."""
    factors: dict[str, Estimate] = {}
    steps, done = len(WALKS) * len(logs), 0
    for walk in WALKS:
        asked: list[Estimate] = []
        for log in logs:
            if progress is not None:
                progress(done, steps)
            done += 1

            def likelihood(factor: float, walk: str = walk, log: Rows = log, now: Drive = drive) -> float:
                return log_likelihood(setup, [log], scaled(now, walk, factor))

            found, reached = best(_DRIVEN_NOISE_FACTORS, likelihood)
            if reached - likelihood(1.0) < _CONVINCING:
                found = Estimate(1.0, found.sigma)
            asked.append(found)
        factors[walk] = max(asked, key=lambda one: one.value)
        drive = scaled(drive, walk, factors[walk].value)
    return drive, factors

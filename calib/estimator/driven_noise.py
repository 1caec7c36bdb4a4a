"""Process noise of the driven filter from logs, by maximum likelihood of its innovations.

What the model of plant and pumps lacks is in three random walks: of the disturbance forces, of the rates, and
of lag, forces and creep. Each is scaled by the factor at which a log is most likely, one after the other.
A log in which little happens needs no noise and would, pooled with others, drive it to nothing; so logs are
asked one by one, and the one that needs most has its way. No factor is less than a half: that nothing
disturbs a plant, a log cannot show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.driven_filter import DrivenFilter
from calib.estimator.driven_setup import Drive
from calib.estimator.noise import GATED, Estimate, best
from calib.estimator.setup import OUT, Rows, Setup

__all__ = ["WALKS", "DriveTuning", "driven_likelihood", "scaled", "tune_driven"]

WALKS = ("disturbance", "rates", "forces")
_FACTORS = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
_CONVINCING = 2.0
"""So much the log likelihood must rise, the gain of one number that means something."""

Log = tuple[Rows, FloatArray]
"""Rows and their commands (n, 2)."""


@dataclass(frozen=True)
class DriveTuning:
    """What tuning has found.

    Attributes
    ----------
    drive : with the tuned walks. factors : by walk, against those before.
    before, after : log likelihood of all logs. rows : of all logs.
    """

    drive: Drive
    factors: dict[str, Estimate]
    before: float
    after: float
    rows: int


def scaled(drive: Drive, walk: str, factor: float) -> Drive:
    """A drive with one of `WALKS` scaled."""
    if walk == "disturbance":
        return replace(drive, walk_disturbance=factor * drive.walk_disturbance)
    if walk == "rates":
        phi, length = drive.walk_rates
        return replace(drive, walk_rates=(factor * phi, factor * length))
    return replace(drive, walk_forces=factor * drive.walk_forces)


def driven_likelihood(setup: Setup, drive: Drive, logs: Sequence[Log]) -> float:
    """Of all logs; a gated sensor counts as a reading at the edge, as in `noise.log_likelihood`."""
    total = 0.0
    gates = [OUT.index(f"gated_{name}") for name in ("camera", "accel", "gyro")]
    for rows, pwm in logs:
        out = DrivenFilter(setup, drive).run(rows, pwm)
        total += float(np.nansum(out[:, OUT.index("log_likelihood")]))
        total -= GATED * float(np.nansum(out[:, gates]))
    return total


def tune_driven(
    setup: Setup, drive: Drive, logs: Sequence[Log], progress: Callable[[int, int], None] | None = None
) -> DriveTuning:
    """The walks that the log with the greatest need of each asks for."""
    before = driven_likelihood(setup, drive, logs)
    factors: dict[str, Estimate] = {}
    steps, done = len(WALKS) * len(logs), 0
    for walk in WALKS:
        chosen = Estimate(1.0, None)
        asked: list[Estimate] = []
        for log in logs:
            if progress is not None:
                progress(done, steps)
            done += 1

            def likelihood(factor: float, walk: str = walk, log: Log = log, now: Drive = drive) -> float:
                return driven_likelihood(setup, scaled(now, walk, factor), [log])

            found, reached = best(_FACTORS, likelihood)
            if reached - likelihood(1.0) < _CONVINCING:
                found = Estimate(1.0, found.sigma)
            asked.append(found)
        if asked:
            chosen = max(asked, key=lambda one: one.value)
        factors[walk] = chosen
        drive = scaled(drive, walk, chosen.value)
    after = driven_likelihood(setup, drive, logs)
    return DriveTuning(drive, factors, before, after, sum(len(rows) for rows, _ in logs))

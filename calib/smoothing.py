"""A whole log through filter and smoother; the states written are those of the smoother."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from calib.driving import pwm_of
from calib.estimator.consistency import Tally
from calib.estimator.driven_setup import Drive
from calib.estimator.filter import Filter
from calib.estimator.setup import OUT, Rows, Setup
from calib.estimator.smoother import smooth
from calib.logs import Log
from calib.replaying import Periods, rows_of, truth_of
from calib.statesfile import STATES, states_writer

__all__ = ["first_rows", "joined", "smooth_log"]


def joined(parts: list[Rows]) -> Rows:
    """Rows of a log in one piece."""
    return Rows(
        np.concatenate([part.t_s for part in parts]),
        np.concatenate([part.readings for part in parts]),
        np.concatenate([part.kinds for part in parts]),
    )


def first_rows(setup: Setup, found: Periods, stream: Iterable[Log], until_s: float) -> np.ndarray:
    """Rows (n, len(OUT)) of the kinematic smoother up to a time of the log [s], which may be its end."""
    parts = []
    for log in stream:
        rows = rows_of(log, found.ticks)
        some = rows.t_s <= until_s
        parts.append(Rows(rows.t_s[some], rows.readings[some], rows.kinds[some]))
        if not some.all():
            break
    whole = joined(parts)
    return np.asarray(smooth(setup, whole, Filter(setup).run(whole)))


def smooth_log(
    setup: Setup, found: Periods, stream: Iterable[Log], output: Path | None, drive: Drive | None = None
) -> tuple[Tally, Tally, list[np.ndarray]]:
    """Sums of the smoother and of the filter, and for figures its rows with the truth, block by block.

    With a `drive` both models are smoothed and weighed.

    Raises `BadInputError` where `output` cannot be written.
    """
    fused, parts, outs, truths = Filter(setup), [], [], []
    both, pwm, driven, kinematic = None, [], [], []
    if drive is not None:
        from calib.estimator.driven_handover import Handover, blended, smooth_both

        both = Handover(setup, drive)
    for log in stream:
        rows, truth = rows_of(log, found.ticks), truth_of(log)
        parts.append(rows)
        if both is None:
            outs.append(fused.run(rows))
        else:
            pwm.append(pwm_of(log))
            one, other, weight = both.run_each(rows, pwm[-1])
            outs.append(blended(one, other, weight))
            driven.append(one)
            kinematic.append(other)
        truths.append(np.full((len(log), 3), np.nan) if truth is None else truth)
    whole, filtered, truth = joined(parts), np.concatenate(outs), np.concatenate(truths)
    if drive is None:
        smoothed = smooth(setup, whole, filtered)
    else:
        smoothed = smooth_both(
            setup, drive, whole, np.concatenate(pwm), np.concatenate(driven), np.concatenate(kinematic)
        )
    before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
    before.add(filtered, truth)
    after.add(smoothed, truth)
    if output is not None:
        with states_writer(output) as states:
            states.add(smoothed[:, [OUT.index(name) for name in STATES]])
    traced = np.concatenate([smoothed, np.full((len(whole), 3), np.nan), truth], axis=1)
    return after, before, [traced]

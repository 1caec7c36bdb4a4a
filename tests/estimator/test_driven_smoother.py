"""The driven smoother: better than its filter, and the same where it is cut into windows."""

from __future__ import annotations

import numpy as np
import pytest
from drivenlogs import commands_of, driven_log
from estimatorlogs import rows_from, setup_for, truth

from calib.estimator import driven_smoother
from calib.estimator.consistency import Tally
from calib.estimator.driven_filter import DrivenFilter
from calib.estimator.driven_setup import Drive


@pytest.mark.parametrize("name", ["elongation", "step"])
def test_smoothing_lessens_the_error(name: str) -> None:
    figures = []
    for seed in (11, 12):
        rig, log = driven_log(name, seed)
        setup, rows, pwm = setup_for(rig, seed), rows_from(log), commands_of(log)
        filtered = DrivenFilter(setup, Drive()).run(rows, pwm)
        smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, pwm, filtered)
        known = np.isfinite(smoothed[:, 1])
        assert known[rows.t_s > 0.2].all()
        before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
        before.add(filtered, truth(log))
        after.add(smoothed, truth(log))
        late = rows.t_s > 2.0
        assert (smoothed[late, 10:13] <= 1.02 * filtered[late, 10:13]).mean() > 0.98
        figures.append((before.rmse()["mean_q_mm"], after.rmse()["mean_q_mm"], after.rmse()["nees"]))
    filtered_mm, smoothed_mm, nees = np.mean(figures, axis=0)
    assert smoothed_mm < 0.85 * filtered_mm
    assert nees < 8.0


def test_windows_make_little_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, log = driven_log("elongation", 1)
    setup, rows, pwm = setup_for(rig, 1), rows_from(log), commands_of(log)
    filtered = DrivenFilter(setup, Drive()).run(rows, pwm)
    whole = driven_smoother.smooth_driven(setup, Drive(), rows, pwm, filtered)
    monkeypatch.setattr(driven_smoother, "WINDOW", 800)
    monkeypatch.setattr(driven_smoother, "OVERLAP", 1500)
    parts = driven_smoother.smooth_driven(setup, Drive(), rows, pwm, filtered)
    late = rows.t_s > 1.0
    difference = np.abs(whole - parts)[late, 1:3]
    assert (difference < 0.5 * whole[late, 10:12]).all()


def test_a_cut_in_the_middle_leaves_both_sides_smooth() -> None:
    """Pictures that jump away for a while make the filter start again; the chain ends there."""
    rig, log = driven_log("elongation", 2)
    setup, rows, pwm = setup_for(rig, 2), rows_from(log), commands_of(log)
    readings = rows.readings.copy()
    away = (rows.t_s > 5.0) & (rows.t_s < 5.5)
    readings[away, 0] += 40.0
    moved = type(rows)(rows.t_s, readings, rows.kinds)
    filtered = DrivenFilter(setup, Drive()).run(moved, pwm)
    smoothed = driven_smoother.smooth_driven(setup, Drive(), moved, pwm, filtered)
    assert np.isfinite(smoothed[rows.t_s > 0.2, 1:13]).all()
    before = (rows.t_s > 2.0) & (rows.t_s < 4.5)
    assert np.abs(smoothed[before, 1] - truth(log)[before, 0]).max() < 5e-4

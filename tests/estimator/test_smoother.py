"""The smoother: better than the filter, honest, and no different where it is cut into windows."""

from __future__ import annotations

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated, truth

from calib.estimator import smoother
from calib.estimator.consistency import Tally
from calib.estimator.filter import Filter
from calib.estimator.model import Kinematic, predict
from calib.estimator.sensors import SIZE


def test_transition_is_that_of_the_prediction() -> None:
    levels, walk = Kinematic().arrays()
    F = np.empty((SIZE, SIZE))
    for dt in (0.0, 0.004, 0.07):
        smoother.transition(levels[1], dt, F)
        x = np.random.default_rng(1).standard_normal(SIZE)
        moved = x.copy()
        predict(moved, np.zeros((SIZE, SIZE)), levels[1], walk, dt)
        np.testing.assert_allclose(F @ x, moved, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["swing", "ellipse", "elongation"])
def test_smoothing_halves_the_error_and_tells_it(name: str) -> None:
    figures = []
    for seed in (1, 2):
        rig, log = simulated(name, seed)
        setup, rows = setup_for(rig, seed), rows_from(log)
        filtered = Filter(setup).run(rows)
        smoothed = smoother.smooth(setup, rows, filtered)
        assert np.isfinite(smoothed[:, :13]).all()
        np.testing.assert_array_equal(smoothed[:, 13:16], filtered[:, 13:16])
        before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
        before.add(filtered, truth(log))
        after.add(smoothed, truth(log))
        figures.append((before.rmse()["mean_q_mm"], after.rmse()["mean_q_mm"], after.rmse()["nees"]))
    filtered_mm, smoothed_mm, nees = np.mean(figures, axis=0)
    assert smoothed_mm < 0.65 * filtered_mm
    assert nees < 6.0


def test_windows_hardly_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, log = simulated("ellipse", 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    filtered = Filter(setup).run(rows)
    whole = smoother.smooth(setup, rows, filtered)
    monkeypatch.setattr(smoother, "WINDOW", 2000)
    monkeypatch.setattr(smoother, "OVERLAP", 1000)
    cut = smoother.smooth(setup, rows, filtered)
    assert np.abs(cut[:, 1] - whole[:, 1]).max() < 0.5 * np.median(whole[:, 10])
    np.testing.assert_allclose(np.median(cut[:, 10]), np.median(whole[:, 10]), rtol=0.2)


def test_events_come_in_order_and_pictures_at_their_exposure() -> None:
    rig, log = simulated("swing")
    setup, rows = setup_for(rig), rows_from(log)
    events = smoother.events_of(setup, rows)
    assert (np.diff(events.t_s) >= 0.0).all()
    pictures = events.kinds == 1
    delay = rows.t_s[events.rows[pictures]] - events.t_s[pictures]
    np.testing.assert_allclose(delay, setup.start.sensor[7], atol=1.5e-3)
    assert (events.kinds == 0).sum() == len(rows)

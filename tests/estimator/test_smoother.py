"""The smoother: better than the filter, honest, and no different where it is cut into windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from estimatorlogs import SIGMA, rows_from, setup_for, simulated, truth, truth_of_sensors, varied

from calib.io.logs import Log
from calib.stages.estimator import smoother
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.kinematic import FLAGS, OUT, Filter, Start
from calib.stages.estimator.read import periods
from calib.stages.estimator.replay import smooth_log
from calib.stages.estimator.sensors import sensor_values, view_coefficients
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log


@pytest.mark.few(2)
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


LOOSE = {"gyro_scale": 3.4e-3, "marker_offset_m": 3.8e-4, "stretch": 1e-3, "accel_bias_x_mps2": 0.065}


@pytest.mark.slow
def test_a_loose_alignment_makes_the_smoother_no_worse_than_the_filter() -> None:
    """All that scales the angle is known only together, as an alignment on a few logs leaves it."""
    sigma = sensor_values({**SIGMA, **LOOSE, "accel_scale_x": 6.6e-3, "accel_scale_y": 3.2e-3})
    together = sensor_values(
        {"gyro_scale": 1.0, "marker_offset_m": 1.0, "accel_bias_x_mps2": -1.0, "imu_lever_m": 1.0}
        | {"accel_scale_x": 1.0, "accel_scale_y": 1.0}
    )
    V = np.diag(sigma**2) + (1.0 - 1e-3) * np.outer(sigma * together, sigma * together)
    V -= np.diag((1.0 - 1e-3) * (sigma * together) ** 2)
    errors = []
    for seed in (0, 1, 2, 3):
        rig, log = simulated("step", seed)
        setup, rows = setup_for(rig, seed), rows_from(log)
        value = truth_of_sensors(rig)
        value += np.linalg.cholesky(V) @ np.random.default_rng(seed).normal(size=len(V))
        value[8:11] = 0.0
        setup = replace(
            setup,
            start=Start(value, sigma, sensor_covariance=V),
            view=view_coefficients(rig.view.camera, rig.view.R_CW, rig.view.t_CW_m),
        )
        filtered = Filter(setup).run(rows)
        smoothed = smoother.smooth(setup, rows, filtered)
        found = []
        for out in (filtered, smoothed):
            tally = Tally(setup.bellows_radius_m)
            tally.add(out, truth(log))
            found += [tally.rmse()["mean_q_mm"], tally.rmse()["phi_deg"], tally.rmse()["nees"]]
        errors.append(found)
    before_mm, before_deg, _, after_mm, after_deg, nees = np.mean(errors, axis=0)
    assert after_mm <= before_mm
    assert after_deg <= before_deg
    assert nees < 4.0


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


def test_where_the_filter_begins_again_the_smoother_does() -> None:
    """A light head swings too fast for 30 pictures and 50 samples a second, until half its angle is gone."""
    rig = varied(2)
    light = replace(rig.plant, mass_kg=0.6 * rig.plant.mass_kg, inertia_kgm2=0.6 * rig.plant.inertia_kgm2)
    rig = replace(rig, plant=light, imu=replace(rig.imu, rate_hz=50.0))
    log = run_log(run_scenario(make_scenario("swing", {"phi_rad": "0.45"}), rig, 2, "sensors"))
    rows = rows_from(log)
    kept = np.ones(len(rows), dtype=np.bool_)
    kept[np.flatnonzero(rows.kinds & 1)[1::2]] = False
    rows, setup = rows[kept], replace(setup_for(rig, 2), camera_period_s=1.0 / 30.0)
    filtered = Filter(setup).run(rows)
    off = smoother.smooth(setup, rows, filtered)[:, 1:3] - truth(log)[kept, :2]
    assert (filtered[:, OUT.index("flags")].astype(int) & FLAGS["restarted"]).any()
    assert np.abs(off[rows.t_s > 2.0]).max() < 2e-4


def test_pumps_that_fill_at_once_do_not_lose_the_head() -> None:
    rig = varied(2)
    rig = replace(rig, pump=replace(rig.pump, lag_s=0.1))
    log = run_log(run_scenario(make_scenario("steps"), rig, 2, "sensors", 18.0))
    setup, rows = setup_for(rig, 2), rows_from(log)
    setup = replace(setup, process=setup.process.beside(hand=False))
    filtered = Filter(setup).run(rows)
    off = smoother.smooth(setup, rows, filtered)[:, 1:3] - truth(log)[:, :2]
    assert not (filtered[:, OUT.index("flags")].astype(int) & FLAGS["restarted"]).any()
    assert np.abs(off).max() < 1e-3


def cut(log: Log, pieces: int) -> Iterator[Log]:
    for part in np.array_split(np.arange(len(log)), pieces):
        yield replace(log, t_s=log.t_s[part], columns={k: v[part] for k, v in log.columns.items()})


def test_blocks_make_no_difference() -> None:
    rig, log = simulated("ellipse", 1)
    setup, found = setup_for(rig, 1), periods(log)
    pieces = smooth_log(setup, found, cut(log, 4))
    whole = smooth_log(setup, found, [log])
    np.testing.assert_array_equal(pieces.out, whole.out)
    before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
    before.add(pieces.filtered, pieces.truth)
    after.add(pieces.out, pieces.truth)
    assert after.rmse()["mean_q_mm"] < 0.7 * before.rmse()["mean_q_mm"]

"""Readings of logs that may move, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.driftlogs import drift_log
from calib.errors import BadInputError
from calib.logs import Log
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

NAMES = ("gx_radps", "gy_radps", "gz_radps", "ax_mps2", "ay_mps2", "az_mps2")


def _log(values: np.ndarray | None = None, t_s: np.ndarray | None = None, **more: np.ndarray) -> Log:
    if values is None:
        noise = np.array([2e-3] * 3 + [0.02] * 3)
        values = noise * np.random.default_rng(0).normal(size=(3000, 6)) + [0, 0, 0.006, 9.8, 0.2, 0.1]
    t = 0.01 * np.arange(len(values)) if t_s is None else t_s
    columns = {name: values[:, k] for k, name in enumerate(NAMES)} | more
    return Log("log.csv", t, columns, np.arange(2, len(t) + 2))


def _times(log: Log, factor: float, kind: str) -> Log:
    columns = {
        name: v * factor if name[0] == kind and len(name) > 5 else v for name, v in log.columns.items()
    }
    return replace(log, columns=columns)


@pytest.fixture(scope="module", params=["static", "swing", "orientation", "chirp"])
def simulated(request: pytest.FixtureRequest) -> Log:
    """A log of the simulated rig, at rest or in motion of several kinds."""
    return log_of(run_scenario(make_scenario(request.param), SimulatedRig(), 0, "truth", 20.0))


def test_readings_angles_and_truth_are_read(simulated: Log) -> None:
    found, said = drift_log(simulated)
    assert found.axes == ("gx", "gy", "gz", "ax", "ay", "az")
    assert said == ()
    rows = simulated.sampled("gz_radps")
    assert np.array_equal(found.t_s, simulated.t_s[rows])
    assert np.array_equal(found.values[:, 2], simulated.columns["gz_radps"][rows])
    assert len(found.true_t_s) == len(simulated)
    assert len(found.onchip_t_s) == len(simulated.sampled("onchip_phi_rad"))


def test_units_that_are_obviously_others_are_named(simulated: Log) -> None:
    degrees = _times(simulated, 180.0 / np.pi, "g")
    with pytest.raises(BadInputError, match="give --gyro-unit deg/s"):
        drift_log(degrees)
    assert np.allclose(drift_log(degrees, gyro_unit="deg/s")[0].values, drift_log(simulated)[0].values)
    in_g = _times(simulated, 1.0 / 9.80665, "a")
    with pytest.raises(BadInputError, match="give --acc-unit g"):
        drift_log(in_g)
    assert np.allclose(drift_log(in_g, acc_unit="g")[0].values, drift_log(simulated)[0].values)
    with pytest.raises(BadInputError, match="raw counts"):
        drift_log(_times(simulated, 418.0, "a"))


def test_fewer_axes_will_do() -> None:
    whole = _log()
    few = {name: whole.columns[name] for name in ("gz_radps", "ax_mps2", "ay_mps2")}
    assert drift_log(replace(whole, columns=few))[0].axes == ("gz", "ax", "ay")
    with pytest.raises(BadInputError, match="in ay_mps2, expected gz_radps, ax_mps2 and ay_mps2"):
        drift_log(replace(whole, columns={name: few[name] for name in ("gz_radps", "ax_mps2")}))


@pytest.mark.parametrize(("axis", "needed"), [(0, False), (2, True), (3, True), (4, True), (5, False)])
def test_a_stuck_axis(axis: int, needed: bool) -> None:
    log = _log()
    columns = dict(log.columns)
    columns[NAMES[axis]] = np.full(len(log), 0.125)
    stuck = replace(log, columns=columns)
    name = NAMES[axis][:2]
    if needed:
        with pytest.raises(BadInputError, match=f"{name} never changes, it is stuck at 0.125"):
            drift_log(stuck)
    else:
        found, said = drift_log(stuck)
        assert name not in found.axes
        assert said == (f"log.csv: {name} never changes, it is stuck at 0.125; left out",)


def test_what_is_no_log_is_refused() -> None:
    for words, log in (
        ("has no IMU", replace(_log(), columns={"u_px": np.zeros(3000)})),
        ("all IMU readings are zero", _log(np.zeros((500, 6)))),
        ("has 1 IMU sample", _log(np.ones((1, 6)))),
        ("no row has all of", _log(gz_radps=np.full(3000, np.nan), ax_mps2=np.full(3000, np.nan))),
        ("goes back", _log(t_s=np.concatenate([np.arange(2000) * 0.01, np.arange(1000) * 0.01]))),
    ):
        if words == "no row has all of":
            columns = dict(_log().columns)
            columns["gz_radps"] = np.where(np.arange(3000) % 2 == 0, columns["gz_radps"], np.nan)
            columns["ax_mps2"] = np.where(np.arange(3000) % 2 == 1, columns["ax_mps2"], np.nan)
            log = replace(log, columns=columns)
        with pytest.raises(BadInputError, match=words):
            drift_log(log)

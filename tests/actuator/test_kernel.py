"""The compiled kernel: one source of truth with the Python functions, and no compiled namesakes."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from calib.actuator import kernel
from calib.actuator.arc import chord_decay_w, chord_ratio_w
from calib.actuator.dynamics import coefficients, rates
from calib.actuator.integrate import state_row
from calib.actuator.parameters import Plant, pumps_connected
from calib.actuator.pump import Orifice, Pump, RateLimit, advance, pump_coefficients
from calib.arrays import FloatArray


def python_run(plant: Plant, pump: Pump, start: FloatArray, g: FloatArray, substeps: int) -> FloatArray:
    """The kernel's loop written again with the uncompiled functions and numpy's Runge-Kutta."""
    c, p = coefficients(plant), pump_coefficients(pump)
    h, r = pump.tick_s / substeps, c.r
    T = np.array([[0.5, 0.5], [0.5 / r, -0.5 / r]])
    y = np.concatenate([T @ start[:2], T @ start[2:4], [start[4] + start[5], start[4] - start[5]]])
    lag, force = start[6:8].copy(), start[8:10].copy()
    decay = math.exp(-0.5 * h / p.lag_s)

    def slope(y: FloatArray, F: FloatArray) -> FloatArray:
        ddl, ddphi, ds, dd = rates(c, *y.tolist(), *F.tolist())
        return np.array([y[2], y[3], ddl, ddphi, ds, dd])

    for row in g:
        for _ in range(substeps):
            both = [advance(p, lag[i], force[i], row[i], decay, h) for i in range(2)]
            middle, end = np.array([b[1] for b in both]), np.array([b[2] for b in both])
            k1 = slope(y, force)
            k2 = slope(y + 0.5 * h * k1, middle)
            k3 = slope(y + 0.5 * h * k2, middle)
            k4 = slope(y + h * k3, end)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            lag, force = np.array([b[0] for b in both]), end
    back = np.linalg.inv(T)
    z = [0.5 * (y[4] + y[5]), 0.5 * (y[4] - y[5])]
    return np.concatenate([back @ y[:2], back @ y[2:4], z, lag, force])


@pytest.mark.parametrize("deflation", [RateLimit(), Orifice()])
@pytest.mark.parametrize(
    "plant", [pumps_connected(), Plant(gravity_mps2=(0.5, 9.81), force_projection="head")]
)
def test_compiled_is_the_python_text(plant: Plant, deflation: RateLimit | Orifice) -> None:
    pump = Pump(deflation=deflation)
    g = np.array([[1.5, 0.2]] * 5 + [[0.0, 1.0]] * 5)
    start = state_row(plant, 0.3, 0.07, (0.4, 0.1))
    out = np.empty((10, 10))
    args = (coefficients(plant), pump_coefficients(pump), start, g, pump.tick_s, 17, 17, out)
    assert kernel.run(*args) == -1
    assert out[-1] == pytest.approx(python_run(plant, pump, start, g, 17), rel=1e-9, abs=1e-12)


def test_rows_are_written_every_so_many_steps() -> None:
    plant, pump = pumps_connected(), Pump()
    g, start = np.ones((4, 2)), state_row(pumps_connected())
    fine, coarse = np.empty((24, 10)), np.empty((4, 10))
    c, p = coefficients(plant), pump_coefficients(pump)
    assert kernel.run(c, p, start, g, pump.tick_s, 6, 1, fine) == -1
    assert kernel.run(c, p, start, g, pump.tick_s, 6, 6, coarse) == -1
    assert np.array_equal(fine[5::6], coarse)
    odd = np.full((5, 10), 7.0)
    assert kernel.run(c, p, start, g, pump.tick_s, 6, 5, odd) == -1
    assert np.array_equal(odd[:4], fine[4::5])
    assert np.all(odd[4] == 7.0)


def test_stops_at_the_step_that_leaves_the_model() -> None:
    """NaN counts as leaving."""
    plant, pump = Plant(), Pump()
    c, p = coefficients(plant), pump_coefficients(pump)
    start = state_row(plant)
    start[0] = math.nan
    assert kernel.run(c, p, start, np.zeros((3, 2)), pump.tick_s, 5, 5, np.empty((3, 10))) == 0


def test_start_is_not_written_to() -> None:
    plant, pump = Plant(), Pump()
    start = state_row(plant, 0.4)
    kept = start.copy()
    kernel.run(
        coefficients(plant), pump_coefficients(pump), start, np.zeros((3, 2)), 1e-2, 10, 10, np.empty((3, 10))
    )
    assert np.array_equal(start, kept)


def test_inlined_functions_stay_plain_python() -> None:
    """They take arrays and numbers alike."""
    w = np.linspace(0.0, 9.0, 5)
    assert [chord_ratio_w(x) for x in w.tolist()] == pytest.approx(chord_ratio_w(w).tolist(), abs=1e-16)
    assert [chord_decay_w(x) for x in w.tolist()] == pytest.approx(chord_decay_w(w).tolist(), abs=1e-16)


def test_no_two_cached_functions_share_a_name() -> None:
    """Two cached closures of one name would share a cache file; these are module-level and distinct."""
    compiled = [f for f in vars(kernel).values() if hasattr(f, "py_func")]
    names = [f.py_func.__qualname__ for f in compiled]
    assert sorted(names) == ["derivative", "run", "run_lanes"]
    assert all("<locals>" not in name for name in names)


@pytest.mark.slow
def test_runs_where_no_folder_can_be_written() -> None:
    """Without any place for the cache the functions are compiled and not kept."""
    code = (
        "import numba.core.caching as caching\n"
        "caching.CacheImpl._locator_classes = []\n"
        "from calib.actuator.integrate import state_row, swing\n"
        "from calib.actuator.parameters import Plant\n"
        "print(swing(Plant(), state_row(Plant(), 0.1), 0.01).q_m[-1].sum())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(0.13, rel=1e-3)

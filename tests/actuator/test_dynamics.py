"""Motion: Euler-Lagrange in sympy, energies, step sizes, independent integrators, batches, the hot path."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
import source_model as src
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from open_loop import Motion, simulate, swing, tick

from adaptive import simulate_adaptive, swing_adaptive
from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator import dynamics as dyn
from calib.stages.actuator import kinematics as kin
from calib.stages.actuator import simulate as kernel
from calib.stages.actuator.dynamics import coefficients, rates
from calib.stages.actuator.parameters import (
    Creep,
    Plant,
    Stiffness,
    pumps_connected,
)
from calib.stages.actuator.pump import Orifice, Pump, RateLimit, advance_pump, pump_coefficients
from calib.stages.actuator.simulate import (
    LANES,
    STATE,
    derivative,
    largest_step_s,
    rig_at_rest,
    simulate_batch,
    state_row,
)

BELLOWS = st.floats(0.045, 0.095)
GRAVITY = Plant(gravity_mps2=(1.3, 9.81))
PLANTS = [
    Plant(),
    pumps_connected(),
    GRAVITY,
    Plant(gravity_mps2=(-2.0, 9.81), creep=None),
    Plant(stiffness=Stiffness((40.0, 500.0, -2e4, 3e5)), stiffness_scale=0.9102),
    Plant(stiffness=Stiffness((55.0,)), inertia_kgm2=0.0, bending_N_per_rad2=0.0),
]


def random_motion(seed: int, count: int) -> tuple[FloatArray, ...]:
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.045, 0.095, (count, 2))
    return q, rng.normal(0, 0.3, (count, 2)), rng.normal(0, 0.3, (count, 2)), rng.uniform(0, 2, (count, 2))


@lru_cache(maxsize=1)
def lagrange() -> tuple[Callable[..., FloatArray], Callable[..., FloatArray], Callable[..., FloatArray]]:
    """M, the terms quadratic in dq, and dU/dq of the stretched bellows (eps >= 0, phi > 0), by sympy.

    From (3.3), the arc's end point and the energies alone.
    """
    q = sympy.symbols("q1 q2", positive=True)
    v = sympy.symbols("v1 v2", real=True)
    m, J, r, l0, k0, k1, kb, gx, gy = sympy.symbols("m J r l0 k0 k1 kb gx gy", real=True)
    phi, ell = (q[0] - q[1]) / (2 * r), (q[0] + q[1]) / 2
    p = sympy.Matrix([ell * (1 - sympy.cos(phi)) / phi, ell * sympy.sin(phi) / phi])
    dp = p.jacobian(q) * sympy.Matrix(v)
    dphi = (v[0] - v[1]) / (2 * r)
    T = m * (dp.T * dp)[0] / 2 + J * dphi**2 / 2
    springs = sum(k0 * (x - l0) ** 2 / 2 + k1 * (x - l0) ** 3 / 3 for x in q)
    U = springs + sympy.Rational(2, 3) * r * kb * phi**3 - m * (gx * p[0] + gy * p[1])
    momentum = sympy.Matrix([sympy.diff(T, x) for x in v])
    M = momentum.jacobian(v)
    swept = momentum.jacobian(q) * sympy.Matrix(v) - sympy.Matrix([sympy.diff(T, x) for x in q])
    pull = sympy.Matrix([sympy.diff(U, x) for x in q])
    arguments = (*q, *v, m, J, r, l0, k0, k1, kb, gx, gy)
    return tuple(sympy.lambdify(arguments, e, "numpy", cse=True) for e in (M, swept, pull))


def symbols_of(plant: Plant, q: FloatArray, dq: FloatArray) -> tuple[float, ...]:
    c = dyn.coefficients(plant)
    return (*q, *dq, c.m, c.J, c.r, c.l0, c.k0, c.k1, c.bending, c.gx, c.gy)


def test_against_euler_lagrange() -> None:
    M, swept, pull = lagrange()
    plant = replace(GRAVITY, damping_ratio=0.0)
    rng = np.random.default_rng(4)
    for _ in range(30):
        q2 = rng.uniform(0.066, 0.09)
        q = np.array([q2 + rng.uniform(0.004, 0.02), q2])
        dq = rng.normal(0, 0.5, 2)
        at = symbols_of(plant, q, dq)
        assert dyn.mass_matrix(plant, q) == pytest.approx(M(*at), rel=1e-9)
        C = dyn.coriolis_matrix(plant, q, dq)
        assert C @ dq == pytest.approx(swept(*at)[:, 0], rel=1e-7, abs=1e-11)
        assert dyn.resisting_forces(plant, q, dq) == pytest.approx(pull(*at)[:, 0], rel=1e-9)


@given(BELLOWS, BELLOWS)
def test_mass_matrix_is_positive_definite(q1: float, q2: float) -> None:
    """Everywhere in the workspace, with det M = m S^2 (m l^2 S^2 / 4 + J) / (4 r_B^2)."""
    plant, q = Plant(), np.array([q1, q2])
    M = dyn.mass_matrix(plant, q)
    assert pytest.approx(M.T, rel=1e-12) == M
    assert np.linalg.eigvalsh(M)[0] > 0.0
    m, J, r = plant.mass_kg, plant.inertia_kgm2, plant.bellows_radius_m
    S = float(np.sinc(kin.angle(q, r) / (2 * np.pi)))
    expected = m * S**2 * (m * float(kin.length(q)) ** 2 * S**2 / 4 + J) / (4 * r**2)
    assert float(np.linalg.det(M)) == pytest.approx(expected, rel=1e-9)


def test_coriolis_matrix_of_335() -> None:
    """dM/dt - 2 C is skew-symmetric, so C does no work beyond the change of inertia."""
    plant, h = Plant(), 1e-6
    for q, dq in zip(*random_motion(1, 10)[:2], strict=True):
        rate = (dyn.mass_matrix(plant, q + h * dq) - dyn.mass_matrix(plant, q - h * dq)) / (2 * h)
        C = dyn.coriolis_matrix(plant, q, dq)
        skew = rate - 2 * C
        assert skew + skew.T == pytest.approx(np.zeros((2, 2)), abs=1e-8 * np.abs(rate).max() + 1e-9)
        swept = C @ dq
        assert dq @ swept == pytest.approx(0.5 * dq @ rate @ dq, rel=1e-5, abs=1e-10)


@pytest.mark.parametrize("plant", PLANTS)
def test_hot_path_is_the_reference(plant: Plant) -> None:
    """The closed form in (l, phi), compiled and in Python, against M, C, N and tau."""
    c = dyn.coefficients(plant)
    r = c.r
    for q, dq, z, force in zip(*random_motion(2, 60), strict=True):
        expected = src.acceleration(plant, q, dq, z, force)
        rate = derivative(c, np.concatenate([q, dq, z]), *force)
        assert rate[2:4] == pytest.approx(expected, rel=1e-10, abs=1e-9)
        assert rate[:2] == pytest.approx(dq)
        l1, l2, _ = plant.creep_rates
        assert rate[4:] == pytest.approx(-l1 * z + l2 * dq, rel=1e-12, abs=1e-14)
        half = (q.mean(), (q[0] - q[1]) / (2 * r), dq.mean(), (dq[0] - dq[1]) / (2 * r))
        ddl, ddphi, _, _ = dyn.rates(c, *half, z.sum(), z[0] - z[1], *force)
        assert [ddl + r * ddphi, ddl - r * ddphi] == pytest.approx(expected, rel=1e-10, abs=1e-9)


@pytest.mark.parametrize("plant", [Plant(), GRAVITY, PLANTS[4]])
def test_energies_belong_to_the_forces(plant: Plant) -> None:
    """N at rest is the gradient of U, and dE/dt = F dq - dissipation along any motion."""
    h = 1e-7
    for q, dq, z, force in zip(*random_motion(3, 20), strict=True):
        gradient = [
            (src.potential_energy_J(plant, q + e) - src.potential_energy_J(plant, q - e)) / (2 * h)
            for e in np.eye(2) * h
        ]
        assert dyn.resisting_forces(plant, q, np.zeros(2)) == pytest.approx(gradient, rel=1e-5, abs=1e-7)
        rate = derivative(dyn.coefficients(plant), np.concatenate([q, dq, z]), *force)
        ends = [
            float(src.energy_J(plant, q + s * rate[:2], dq + s * rate[2:4], z + s * rate[4:]))
            for s in (-h, h)
        ]
        power = force @ dq - float(src.dissipation_W(plant, q, dq, z))
        assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(power, rel=1e-4, abs=1e-5)
        assert src.dissipation_W(plant, q, dq, z) >= 0.0


@pytest.mark.parametrize("plant", [Plant(), GRAVITY, PLANTS[4], PLANTS[5]])
@pytest.mark.parametrize("q", [(0.07, 0.07), (0.085, 0.066), (0.06, 0.08)])
def test_linearised_plant_against_differences(plant: Plant, q: tuple[float, float]) -> None:
    """About a rest that the pumps hold."""
    c, at = dyn.coefficients(plant), np.array(q)
    hold = dyn.resisting_forces(plant, at, np.zeros(2))
    state, h = np.concatenate([at, np.zeros(4)]), 1e-7
    assert derivative(c, state, *hold)[2:4] == pytest.approx(np.zeros(2), abs=1e-9)
    A = dyn.linearised(plant, at)
    for j, step in enumerate(np.eye(6) * h):
        column = (derivative(c, state + step, *hold) - derivative(c, state - step, *hold)) / (2 * h)
        assert A[:, j] == pytest.approx(column, rel=1e-5, abs=2e-3)


UNDAMPED = replace(Plant(), damping_ratio=0.0, creep=None)
PUMPED = pumps_connected()


def energy(plant: Plant, motion: Motion) -> FloatArray:
    return src.energy_J(plant, motion.q_m, motion.dq_mps, motion.z_N)


def extrema(values: FloatArray) -> FloatArray:
    """First value and all turning points."""
    rising = np.diff(values) > 0
    return values[np.concatenate([[0], 1 + np.flatnonzero(rising[1:] != rising[:-1])])]


def random_commands(seed: int, blocks: int) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).uniform(0, 255, (blocks, 2)), 30, axis=0)


def test_swing_has_the_nominal_damping_frequency_and_offset() -> None:
    """zeta 0.055 by (3.39) on deviations from equilibrium, 4.0 Hz, offset 41 -> 6 mrad after 1 s."""
    motion = swing(Plant(), state_row(Plant(), 0.5), 3.0, 1e-3)
    phi = kin.angle(motion.q_m, Plant().bellows_radius_m)
    peaks = extrema(phi)
    spans = np.abs(np.diff(peaks))
    # Two half swings at a time, so that the creeping offset drops out.
    decrement = np.log(spans[0] / spans[16]) / 8
    zeta = decrement / np.sqrt(decrement**2 + 4 * np.pi**2)
    assert zeta == pytest.approx(0.055, abs=0.001)
    falling = np.flatnonzero((phi[:-1] > 0) & (phi[1:] <= 0))
    assert 1e3 / np.diff(falling)[:8].mean() == pytest.approx(4.0, abs=0.05)
    # The middle of the swing about the first turn after the release, and about that nearest to 1 s.
    turns = np.flatnonzero(np.diff(np.sign(np.diff(phi)))) + 1
    middles = [(a + 2 * b + c) / 4 for (a, b), (_, c) in pairwise(pairwise(peaks))]
    assert middles[1] == pytest.approx(0.041, abs=0.001)
    assert middles[int(np.argmin(np.abs(turns - 1000)))] == pytest.approx(0.006, abs=0.001)


@pytest.mark.parametrize(("volt", "elongation_mm"), [(6, 1.88), (8, 11.11), (10, 21.73), (12, 26.56)])
def test_steady_elongation(volt: float, elongation_mm: float) -> None:
    motion = simulate(PUMPED, Pump(), np.full((900, 2), volt * 255 / 12))
    assert 1e3 * (motion.q_m[-1] - 0.065) == pytest.approx([elongation_mm] * 2, abs=0.006)
    assert motion.dq_mps[-1] == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("deflation", "time_s"), [(RateLimit(), 5.05), (Orifice(), 5.05), (RateLimit(2.0), 2.6)]
)
def test_deflation_to_five_percent(deflation: RateLimit | Orifice, time_s: float) -> None:
    pump = Pump(deflation=deflation)
    motion = simulate(PUMPED, pump, np.repeat([[255.0, 255.0], [0.0, 0.0]], 900, axis=0))
    stretch = kin.length(motion.q_m) - 0.065
    below = 900 + int(np.argmax(stretch[900:] < 0.05 * stretch[900]))
    assert motion.t_s[below] - motion.t_s[900] == pytest.approx(time_s, abs=0.03)
    # The thesis's overshoot at 10 s came from its creep; this creep is passive.
    assert stretch[900:].min() > -1e-5


def test_free_swing_against_dop853() -> None:
    plant = Plant()
    fixed = swing(plant, state_row(plant, 0.5), 4.0, 1e-3)
    exact = swing_adaptive(plant, state_row(plant, 0.5), fixed.t_s, rtol=1e-12, atol=1e-14)
    assert np.abs(fixed.q_m - exact.q_m).max() < 1e-8


@pytest.mark.parametrize("deflation", [RateLimit(), Orifice()])
def test_pumps_against_dop853(deflation: RateLimit | Orifice) -> None:
    pump, pwm = Pump(deflation=deflation, lag_ratio=0.8), random_commands(1, 8)
    fixed = simulate(PUMPED, pump, pwm)
    exact = simulate_adaptive(PUMPED, pump, pwm, rtol=1e-12, atol=1e-14)
    assert np.abs(fixed.q_m - exact.q_m).max() < 1e-6
    assert np.abs(fixed.force_N - exact.force_N).max() < 1e-8


def test_order_of_the_steps() -> None:
    """Halving the step divides the error by sixteen while the springs are smooth."""
    plant = Plant(stiffness=Stiffness((50.0,)), bending_N_per_rad2=0.0)
    start, times = state_row(plant, 0.8, 0.07), np.array([0.0, 0.5])
    exact = swing_adaptive(plant, start, times, rtol=1e-13, atol=1e-15).q_m[-1]
    errors = [np.abs(swing(plant, start, 0.5, h).q_m[-1] - exact).max() for h in (4e-3, 2e-3, 1e-3)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.25)


@pytest.mark.parametrize("phi", [0.5, -1.2])
@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 9.81)])
def test_energy_is_constant_without_damping(phi: float, gravity: tuple[float, float]) -> None:
    """Relative drift below 1e-8 over 20 s, 80 swings."""
    plant = replace(UNDAMPED, gravity_mps2=gravity)
    motion = swing(plant, state_row(plant, phi, 0.07), 20.0, 1e-4, every=20)
    E = energy(plant, motion)
    assert np.abs(E - E[0]).max() / np.ptp(src.potential_energy_J(plant, motion.q_m)) < 1e-8


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-1.3, 1.3),
    st.floats(0.055, 0.085),
    st.floats(0.05, 20.0),
    st.floats(0.0, 30.0),
    st.floats(0.05, 2.0),
)
def test_energy_never_rises(
    phi: float, length: float, damping: float, branch: float, relaxation: float
) -> None:
    """With any damper and any standard linear solid, from any rest.

    What a step may add is its own error at the corner of the stiffness law, k1 (dq h)^3 / 6.
    """
    plant, h = Plant(damping_scale=damping, creep=Creep(1.0 / relaxation, branch, -1.0)), 2e-4
    motion = swing(plant, state_row(plant, phi, length), 1.0, h)
    E = energy(plant, motion)
    corner = 1092.9 * (np.abs(motion.dq_mps).max() * h) ** 3 / 6
    assert np.diff(E).max() <= corner + 1e-16
    assert E[-1] <= E[0]


def test_mirrored_commands_mirror_the_motion() -> None:
    pwm = random_commands(2, 6)
    left = simulate(PUMPED, Pump(), pwm)
    right = simulate(PUMPED, Pump(), pwm[:, ::-1])
    assert np.abs(left.q_m - right.q_m[:, ::-1]).max() < 1e-14


def test_ticks_are_the_open_loop() -> None:
    """Stepping tick by tick, as a controller does, differs by the rounding of the rows only."""
    pump, pwm = Pump(deflation=Orifice(), delay_ticks=3), random_commands(3, 3)
    whole = simulate(PUMPED, pump, pwm)
    state = rig_at_rest(PUMPED, pump)
    for k, (u1, u2) in enumerate(pwm.tolist()):
        state, rows = tick(PUMPED, pump, state, (u1, u2))
        assert rows.shape == (17, len(STATE))
        assert rows[-1] == pytest.approx(whole.states[k + 1], abs=1e-12)


@pytest.mark.parametrize(
    "plant",
    [
        UNDAMPED,
        replace(PUMPED, damping_scale=60.0),
    ],
)
def test_largest_step_is_where_runge_kutta_turns(plant: Plant) -> None:
    """Just below it small motion dies down, just above it grows; both refused beyond."""
    largest = largest_step_s(plant)
    A = dyn.linearised(plant, np.full(2, 0.065 + 0.0266))
    gains = []
    for factor in (0.99, 1.02):
        hA = factor * largest * A
        R = np.eye(6) + hA @ (np.eye(6) + hA / 2 @ (np.eye(6) + hA / 3 @ (np.eye(6) + hA / 4)))
        gains.append(np.abs(np.linalg.eigvals(R)).max())
    assert gains[0] <= 1 + 1e-9
    assert gains[1] > 1
    with pytest.raises(BadInputError, match=r"step: .* s is too large .* expected at most"):
        swing(plant, state_row(plant, 0.1), 1.0, 1.1 * largest)


def test_leaving_the_model_is_told_not_returned() -> None:
    """2 N more on one side than the springs of this soft plant can take."""
    soft = Plant(stiffness=Stiffness((5.0,)), bending_N_per_rad2=0.0)
    with pytest.raises(BadInputError, match=r"simulation: at 0\.\d+ s a bellows has no length left"):
        swing(soft, state_row(soft, 0.0, force_N=(2.0, 0.0)), 5.0)


def python_run(plant: Plant, pump: Pump, start: FloatArray, g: FloatArray, substeps: int) -> FloatArray:
    """The kernel's loop written again with the uncompiled functions and numpy's Runge-Kutta."""
    c, p = coefficients(plant), pump_coefficients(pump)
    h, r = pump.tick_s / substeps, c.r
    T = np.array([[0.5, 0.5], [0.5 / r, -0.5 / r]])
    y = np.concatenate([T @ start[:2], T @ start[2:4], [start[4] + start[5], start[4] - start[5]]])
    lag, force = start[6:8].copy(), start[8:10].copy()

    def slope(y: FloatArray, F: FloatArray) -> FloatArray:
        ddl, ddphi, ds, dd = rates(c, *y.tolist(), *F.tolist())
        return np.array([y[2], y[3], ddl, ddphi, ds, dd])

    for row in g:
        for _ in range(substeps):
            both = [
                advance_pump(one, lag[i], force[i], row[i], math.exp(-0.5 * h / one.lag_s), h)
                for i, one in enumerate(p)
            ]
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
@pytest.mark.parametrize("plant", [pumps_connected(), Plant(gravity_mps2=(0.5, 9.81))])
def test_compiled_is_the_python_text(plant: Plant, deflation: RateLimit | Orifice) -> None:
    pump = Pump(deflation=deflation, lag_ratio=1.3)
    g = np.array([[1.5, 0.2]] * 5 + [[0.0, 1.0]] * 5)
    start = state_row(plant, 0.3, 0.07, (0.4, 0.1))
    out = np.empty((10, 10))
    args = (coefficients(plant), pump_coefficients(pump), start, g, pump.tick_s, 17, 17, out)
    assert kernel.run(*args) == -1
    assert out[-1] == pytest.approx(python_run(plant, pump, start, g, 17), rel=1e-9, abs=1e-12)


def test_stops_at_the_step_that_leaves_the_model() -> None:
    """NaN counts as leaving."""
    plant, pump = Plant(), Pump()
    c, p = coefficients(plant), pump_coefficients(pump)
    start = state_row(plant)
    start[0] = math.nan
    assert kernel.run(c, p, start, np.zeros((3, 2)), pump.tick_s, 5, 5, np.empty((3, 10))) == 0


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
        "from calib.stages.actuator.dynamics import coefficients\n"
        "from calib.stages.actuator.parameters import Plant\n"
        "from calib.stages.actuator.simulate import derivative, state_row\n"
        "print(derivative(coefficients(Plant()), state_row(Plant(), 0.1)[:6], 0.0, 0.0)[:2].sum())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == 0.0


def commands(seed: int, blocks: int) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).uniform(0, 255, (blocks, 2)), 20, axis=0)


def mixed(sets: int, seed: int) -> tuple[list[Plant], list[Pump]]:
    """Every parameter differs; some plants have gravity, some pumps an orifice."""
    rng = np.random.default_rng(seed)
    plants, pumps = [], []
    for i in range(sets):
        plants.append(
            Plant(
                mass_kg=rng.uniform(0.012, 0.02),
                inertia_kgm2=rng.uniform(0.8e-5, 2e-5),
                bellows_radius_m=rng.uniform(0.011, 0.014),
                rest_length_m=rng.uniform(0.06, 0.07),
                stiffness=Stiffness((rng.uniform(40, 60), rng.uniform(0, 2000), 1e3, 1e4)),
                stiffness_scale=rng.uniform(0.9, 1.1),
                damping_scale=rng.uniform(3, 20),
                bending_N_per_rad2=rng.uniform(0, 0.3),
                creep=Creep(rng.uniform(1, 5), rng.uniform(5, 15), -1.0),
                gravity_mps2=(0.4, 9.81) if i % 5 == 3 else (0.0, 0.0),
            )
        )
        deflation = Orifice(rng.uniform(0.8, 1.2)) if i % 3 == 0 else RateLimit(rng.uniform(0.3, 0.5))
        lag_s, lag_ratio = rng.uniform(0.5, 0.9), rng.uniform(0.8, 1.2)
        pumps.append(Pump(lag_s=lag_s, lag_ratio=lag_ratio, delay_ticks=i % 4, deflation=deflation))
    return plants, pumps


@pytest.mark.parametrize(("sets", "threads"), [(1, 1), (5, 1), (2 * LANES + 3, 2), (40, 3)])
def test_sets_are_the_single_runs(sets: int, threads: int) -> None:
    pwm, (plants, pumps) = commands(sets, 3), mixed(sets, sets)
    start = np.array([state_row(plant, 0.2) for plant in plants])
    states, stopped = simulate_batch(plants, pumps, pwm, start, threads=threads)
    assert states.shape == (sets, len(pwm), len(STATE))
    assert np.all(stopped == -1)
    for plant, pump, rows in zip(plants, pumps, states, strict=True):
        alone = simulate(plant, pump, pwm, rig_at_rest(plant, pump, 0.2))
        assert rows == pytest.approx(alone.states[1:], rel=1e-10, abs=1e-13)


def test_the_company_does_not_matter() -> None:
    """A set gives the same bytes alone in a block and in a full one."""
    pwm = commands(2, 2)
    plants = [replace(PUMPED, stiffness=Stiffness((40.0 + i,))) for i in range(LANES)]
    pumps = [Pump()] * LANES
    together, _ = simulate_batch(plants, pumps, pwm, state_row(PUMPED))
    alone, _ = simulate_batch(plants[5:6], pumps[:1], pwm, state_row(PUMPED))
    assert np.array_equal(together[5], alone[0])


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 9.81)])
def test_marks_a_set_that_leaves_the_model(gravity: tuple[float, float]) -> None:
    """Alone and side by side the same step is named, and the neighbours go on."""
    hard = replace(PUMPED, stiffness=Stiffness((1e6,)), gravity_mps2=gravity)
    states, stopped = simulate_batch(
        [PUMPED, hard, PUMPED], [Pump()] * 3, np.full((20, 2), 100.0), state_row(PUMPED, 0.3)
    )
    assert stopped[0] == stopped[2] == -1
    assert 0 <= stopped[1] < 17
    assert np.all(np.isnan(states[1]))
    assert np.all(np.isfinite(states[[0, 2]]))

"""Fixed steps: accuracy, energy, the nominal plant's figures, and steps that are too large."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.actuator import dynamics as dyn
from calib.actuator import kinematics as kin
from calib.actuator.adaptive import simulate_adaptive, swing_adaptive
from calib.actuator.integrate import (
    Motion,
    RigState,
    largest_step_s,
    rig_at_rest,
    simulate,
    state_row,
    swing,
    tick,
)
from calib.actuator.kernel import STATE
from calib.actuator.parameters import (
    PRINTED_CREEP,
    Creep,
    Plant,
    StandardLinearSolid,
    Stiffness,
    UnstablePlantWarning,
    free_swing,
    growth_rate_per_s,
    pumps_connected,
)
from calib.actuator.pump import Orifice, Pump, RateLimit
from calib.arrays import FloatArray
from calib.errors import BadInputError

UNDAMPED = replace(Plant(), damping_ratio=0.0, creep=None)
PUMPED = pumps_connected()


def energy(plant: Plant, motion: Motion) -> FloatArray:
    return dyn.energy_J(plant, motion.q_m, motion.dq_mps, motion.z_N)


def extrema(values: FloatArray) -> FloatArray:
    """First value and all turning points."""
    rising = np.diff(values) > 0
    return values[np.concatenate([[0], 1 + np.flatnonzero(rising[1:] != rising[:-1])])]


def random_commands(seed: int, blocks: int) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).uniform(0, 255, (blocks, 2)), 30, axis=0)


def test_swing_has_the_nominal_damping_frequency_and_offset() -> None:
    """zeta 0.055 by (3.39) on deviations from equilibrium, 4.0 Hz, offset 41 -> 6 mrad after 1 s."""
    motion = swing(free_swing(), state_row(free_swing(), 0.5), 3.0, 1e-3)
    phi = kin.angle(motion.q_m, free_swing().bellows_radius_m)
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
    plant = free_swing()
    fixed = swing(plant, state_row(plant, 0.5), 4.0, 1e-3)
    exact = swing_adaptive(plant, state_row(plant, 0.5), fixed.t_s, rtol=1e-12, atol=1e-14)
    assert np.abs(fixed.q_m - exact.q_m).max() < 1e-8


@pytest.mark.parametrize("deflation", [RateLimit(), Orifice()])
def test_pumps_against_dop853(deflation: RateLimit | Orifice) -> None:
    pump, pwm = Pump(deflation=deflation), random_commands(1, 8)
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
    assert np.abs(E - E[0]).max() / np.ptp(dyn.potential_energy_J(plant, motion.q_m)) < 1e-8


def test_head_projection_has_no_energy() -> None:
    """The printed projection loses and gains by itself, some percent within seconds."""
    plant = replace(UNDAMPED, force_projection="head")
    E = energy(plant, swing(plant, state_row(plant, 0.5), 20.0, 1e-4, every=20))
    assert 0.02 < np.abs(E / E[0] - 1).max() < 0.2


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
    plant, h = Plant(damping_scale=damping, creep=StandardLinearSolid(branch, relaxation)), 2e-4
    motion = swing(plant, state_row(plant, phi, length), 1.0, h)
    E = energy(plant, motion)
    corner = 1092.9 * (np.abs(motion.dq_mps).max() * h) ** 3 / 6
    assert np.diff(E).max() <= corner + 1e-16
    assert E[-1] <= E[0]


@pytest.mark.filterwarnings("ignore::calib.actuator.parameters.UnstablePlantWarning")
def test_printed_creep_runs_away_at_its_growth_rate() -> None:
    plant = Plant(creep=Creep(*PRINTED_CREEP), allow_unstable=True)
    motion = swing(plant, state_row(plant, 1e-6), 20.0, 1e-3)
    size = np.abs(motion.q_m[:, 0] - 0.065)
    assert np.log(size[20000] / size[16000]) / 4.0 == pytest.approx(growth_rate_per_s(plant), rel=1e-3)


def test_warning_for_an_unstable_plant() -> None:
    with pytest.warns(UnstablePlantWarning):
        Plant(creep=Creep(*PRINTED_CREEP), allow_unstable=True)


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


def test_continuing_is_the_same_as_going_on() -> None:
    pump, pwm = Pump(), random_commands(4, 4)
    whole = simulate(PUMPED, pump, pwm)
    first = simulate(PUMPED, pump, pwm[:50])
    waiting = tuple((float(a), float(b)) for a, b in pwm[48:50])
    rest = simulate(PUMPED, pump, pwm[50:], RigState(first.states[-1], waiting))
    assert rest.states[1:] == pytest.approx(whole.states[51:], abs=1e-12)


def test_rows_within_a_tick() -> None:
    pwm = random_commands(5, 2)
    coarse, fine = simulate(PUMPED, Pump(), pwm), simulate(PUMPED, Pump(), pwm, every=1)
    assert np.array_equal(fine.states[::17], coarse.states)
    assert fine.t_s[::17] == pytest.approx(coarse.t_s)
    slopes = np.gradient(fine.q_m, fine.t_s, axis=0)
    assert slopes[1:-1] == pytest.approx(fine.dq_mps[1:-1], abs=2e-4)


def test_motion_stays_under_constant_forces() -> None:
    """Held at its equilibrium the plant does not move."""
    plant = Plant()
    q = np.array([0.08, 0.07])
    force = dyn.resisting_forces(plant, q, np.zeros(2))
    row = state_row(plant, float(kin.angle(q, 0.0126)), 0.075, (float(force[0]), float(force[1])))
    motion = swing(plant, row, 1.0)
    assert np.abs(motion.q_m - q).max() < 1e-14


@pytest.mark.parametrize("plant", [UNDAMPED, free_swing(), PUMPED, replace(PUMPED, damping_scale=60.0)])
def test_largest_step_is_where_runge_kutta_turns(plant: Plant) -> None:
    """Just below it small motion dies down, just above it grows; both refused beyond."""
    largest = largest_step_s(plant, np.array([0.065, 0.065]))
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


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: state_row(Plant(), 6.0), "start: found bellows of .* expected positive lengths"),
        (lambda: swing(Plant(), np.full(10, np.nan), 1.0), "10 finite numbers"),
        (lambda: swing(Plant(), np.zeros(6), 1.0), r"found shape \(6,\)"),
        (lambda: swing(Plant(), state_row(Plant()), 1.0, -1e-3), "step: found -0.001 s"),
        (lambda: simulate(PUMPED, Pump(), np.zeros((0, 2))), "pwm: found no rows"),
        (lambda: simulate(PUMPED, Pump(), np.zeros((5, 2)), substeps=0), "found 0 per tick"),
        (lambda: simulate(PUMPED, Pump(), np.zeros((5, 2)), substeps=1), None),
    ],
)
def test_bad_input(call: object, words: str | None) -> None:
    if words is None:
        # One step per tick is still stable for the nominal plant, though not accurate.
        call()
        return
    with pytest.raises(BadInputError, match=words):
        call()

"""Linear loops against SciPy and the simulation; margins against brute force; gains that keep them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE, UNLIKE
from hypothesis import given, settings
from hypothesis import strategies as st
from open_loop import simulate
from scipy import signal

from calib.core.errors import BadInputError
from calib.stages.actuator.simulate import RigState
from calib.stages.control.laws import Channel, Pid
from calib.stages.control.loops import (
    System,
    break_at,
    closed_loop,
    delay,
    loop_margins,
    pid_system,
    response,
    rig_system,
    series,
    spectral_radius,
)
from calib.stages.control.reach import approach_s, follow, largest_angle
from calib.stages.control.rig_model import Model, bent_rest, feed_forward_pwm, holding_force
from calib.stages.control.section import ControllerCriterion
from calib.stages.control.tuning import (
    Tuned,
    both_channels,
    holds,
    operating_angles,
    orientation_loop,
    position_loop,
    tune_orientation,
    tune_position,
)

H = NOMINAL.tick_s


def _through(system: System, u: np.ndarray) -> np.ndarray:
    x, out = np.zeros(len(system.A)), []
    for row in u:
        out.append(system.C @ x + system.D @ row)
        x = system.A @ x + system.B @ row
    return np.array(out)


@pytest.mark.parametrize("gains", [(1000, 1000, 10), (500, 0, 0), (200, 0, 5), (300, 90, 0)])
def test_the_controller_as_a_system_is_its_recursion(gains: tuple[float, float, float]) -> None:
    pid = Pid(*gains)
    errors = np.random.default_rng(3).normal(size=200)
    channel = Channel(pid)
    expected = [channel.step(e) for e in errors.tolist()]
    system = pid_system(pid)
    assert len(system.A) == (gains[1] != 0) + (gains[2] != 0)
    assert _through(system, errors[:, None])[:, 0] == pytest.approx(np.array(expected), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("phi", [0.2, 0.5])
def test_a_step_of_the_closed_loop_against_scipy(phi: float) -> None:
    loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0, 5.0), tuple(bent_rest(NOMINAL, phi)))
    closed = closed_loop(loop)
    u = np.ones((400, 1))
    _, expected, _ = signal.dlsim((closed.A, closed.B, closed.C, closed.D, H), u)
    # Our own recursion of the open loop with the feedback around it.
    x, y = np.zeros(len(loop.A)), []
    for _ in range(400):
        out = float((loop.C @ x)[0])
        y.append(out)
        x = loop.A @ x + loop.B @ np.array([1.0 - out])
    assert np.array(y) == pytest.approx(np.asarray(expected)[:, 0], abs=1e-9)
    # With an integrator the angle ends at the set-point.
    assert y[-1] == pytest.approx(1.0, abs=2e-3)


def test_the_frequency_response_against_scipy() -> None:
    system = pid_system(Pid(470.0, 100.0, 5.0))
    w = np.linspace(0.01, 3.0, 50)
    _, expected = signal.dfreqresp((system.A, system.B, system.C, system.D, H), w)
    assert response(system, w / H)[:, 0, 0] == pytest.approx(expected, rel=1e-9)
    late = response(series(system, delay(3, H)), w / H)[:, 0, 0]
    assert late == pytest.approx(expected * np.exp(-3j * w), rel=1e-9)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize("q", [(0.075, 0.075), (0.085, 0.073)])
def test_small_steps_of_the_rig_are_those_of_the_simulation(model: Model, q: tuple[float, float]) -> None:
    at = np.array(q)
    F, pwm = holding_force(model.plant, at), feed_forward_pwm(model, at)
    row = np.array([*at, 0.0, 0.0, 0.0, 0.0, *F, *F])
    start = RigState(row, ((float(pwm[0]), float(pwm[1])),) * model.pump.delay_ticks)
    step = np.array([0.5, 0.0])
    motion = simulate(model.plant, model.pump, np.tile(pwm + step, (90, 1)), start)
    still = simulate(model.plant, model.pump, np.tile(pwm, (90, 1)), start)
    linear = _through(rig_system(model, at), np.tile(step, (90, 1)))
    moved = (motion.q_m - still.q_m)[:90]
    assert linear == pytest.approx(moved, abs=0.02 * float(np.abs(moved).max()))


@given(phi=st.floats(-0.85, 0.85))
def test_a_bent_rest_is_at_rest(phi: float) -> None:
    q = bent_rest(NOMINAL, phi)
    assert (q[0] - q[1]) / (2 * NOMINAL.plant.bellows_radius_m) == pytest.approx(phi, abs=1e-12)
    F = holding_force(NOMINAL.plant, q)
    idle = 1 if phi >= 0.0 else 0
    assert F[idle] == pytest.approx(0.0, abs=1e-9)
    assert F[1 - idle] >= -1e-9


def _integrator(k: float) -> System:
    return System(np.eye(1), np.array([[k * H]]), np.eye(1), np.zeros((1, 1)), H)


@given(k=st.floats(0.5, 60.0))
def test_an_integrator_has_the_margins_of_the_book(k: float) -> None:
    """L = k h / (z - 1): gain margin 2 / (k h), |L| = 1 at 2 sin(w h / 2) = k h, phase pi / 2 - w h / 2."""
    (found,) = loop_margins(_integrator(k))
    assert found.stable
    assert found.gain == pytest.approx(2.0 / (k * H), rel=1e-3)
    half = math.asin(0.5 * k * H)
    assert found.phase_rad == pytest.approx(0.5 * math.pi - half, abs=2e-3)
    assert found.crossover_hz == pytest.approx(half / (math.pi * H), rel=1e-2)
    assert found.delay_s == pytest.approx((0.5 * math.pi - half) / (2.0 * half / H), rel=2e-2)


def gain_to_instability(loop: System, channel: int | slice = 0, most: float = 1e4) -> float:
    """Gain margin by brute force: the factor on channels at which an eigenvalue leaves the unit circle.

    Bisection after the first of growing factors that is unstable; infinite when none up to `most` is.
    """

    def stable(factor: float) -> bool:
        scale = np.ones(len(loop.D))
        scale[channel] = factor
        scaled = replace(loop, C=loop.C * scale[:, None], D=loop.D * scale[:, None])
        return spectral_radius(closed_loop(scaled)) < 1.0

    low = 1.0
    if not stable(low):
        return 1.0
    high = low
    while stable(high):
        low, high = high, high * 1.05
        if high > most:
            return math.inf
    for _ in range(50):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize(
    "phi",
    [
        0.15,
        0.8,
    ],
)
@pytest.mark.parametrize(
    "gains",
    [
        (470.0, 1000.0, 0.0),
        (600.0, 0.0, 0.0),
    ],
)
def test_the_gain_margin_by_brute_force(model: object, phi: float, gains: tuple[float, ...]) -> None:
    loop = orientation_loop(model, Pid(*gains), tuple(bent_rest(model, phi)))
    (found,) = loop_margins(loop)
    assert found.stable
    assert found.gain == pytest.approx(gain_to_instability(loop), rel=1e-3)


@pytest.mark.parametrize(
    "q",
    [
        (0.07, 0.07),
        (0.085, 0.072),
    ],
)
@pytest.mark.parametrize("sensing", [False, True])
def test_each_channel_of_the_lengths_and_both_by_brute_force(q: tuple[float, float], sensing: bool) -> None:
    pid = Pid(18000.0, 0.0, 180.0)
    loop = position_loop(NOMINAL, pid, q)
    if not sensing:
        loop = series(both_channels(pid), rig_system(NOMINAL, np.array(q)))
    *each, one, other = loop_margins(loop)
    for i, found in enumerate(each):
        assert found.stable
        assert found.gain == pytest.approx(gain_to_instability(loop, i), rel=1e-3)
    # The pumps share a supply: less of it is left than of each.
    both = gain_to_instability(loop, slice(None))
    assert min(one.gain, other.gain) == pytest.approx(both, rel=1e-3)
    assert both - 1.0 < 0.7 * (min(m.gain for m in each) - 1.0)


def test_the_delay_margin_by_brute_force() -> None:
    """So many ticks more are stable as fit into the delay margin, and one more is not."""
    loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0), tuple(bent_rest(NOMINAL, 0.5)))
    (found,) = loop_margins(loop)
    ticks = math.floor(found.delay_s / H)
    assert ticks >= 3
    assert spectral_radius(closed_loop(series(loop, delay(ticks, H)))) < 1.0
    assert spectral_radius(closed_loop(series(loop, delay(ticks + 1, H)))) > 1.0


@settings(max_examples=30)
@given(a=st.floats(-0.5, 0.5), b=st.floats(-0.5, 0.5), c=st.floats(-0.5, 0.5), d=st.floats(-0.5, 0.5))
def test_breaking_one_channel_keeps_the_determinant(a: float, b: float, c: float, d: float) -> None:
    """det(I + L) = (1 + L_i) det(I + L_oo): the broken loop encircles -1 as often as the whole."""
    L = np.array([[[a, b], [c, d]]], dtype=np.complex128)
    whole = np.linalg.det(np.eye(2) + L[0])
    assert (1.0 + break_at(L, 0)[0]) * (1.0 + d) == pytest.approx(whole)
    assert (1.0 + break_at(L, 1)[0]) * (1.0 + a) == pytest.approx(whole)


CRITERION = ControllerCriterion(gain_margin=2.0, phase_margin_rad=math.pi / 3.0, sensitivity=2.0)


@pytest.fixture(scope="module")
def orientation() -> Tuned:
    return tune_orientation(NOMINAL, CRITERION)


@pytest.fixture(scope="module")
def position() -> Tuned:
    return tune_position(NOMINAL, CRITERION)


def _at_least(tuned: Tuned) -> None:
    for point in tuned.points:
        m = point.margins
        assert m.stable
        # Gains are rounded to two digits.
        assert m.gain > 0.98 * CRITERION.gain_margin
        assert m.phase_rad > 0.98 * CRITERION.phase_margin_rad
        assert m.sensitivity < 1.02 * CRITERION.sensitivity


def test_every_operating_point_keeps_the_margins(orientation: Tuned, position: Tuned) -> None:
    assert len(orientation.points) == 4 and len(position.points) == 6
    _at_least(orientation)
    _at_least(position)


def test_the_limit_is_used(orientation: Tuned, position: Tuned) -> None:
    """Ten percent more of everything breaks the criterion at some point."""
    for tuned, make in ((orientation, orientation_loop), (position, position_loop)):
        pid = tuned.pid
        more = replace(pid, Kp=1.1 * pid.Kp, Ki=1.1 * pid.Ki, Kd=1.1 * pid.Kd)
        kept = [
            all(holds(CRITERION, m) for m in loop_margins(make(NOMINAL, more, point.q_m)))
            for point in tuned.points
        ]
        assert not all(kept)


def test_pumps_that_fill_faster_than_the_head_swings_are_controlled() -> None:
    """No gains were found: the integral was .15 s or more of the gain, and the gain 20 PWM/rad or more."""
    tuned = tune_orientation(replace(NOMINAL, pump=replace(NOMINAL.pump, lag_s=0.05)), CRITERION)
    _at_least(tuned)
    assert tuned.pid.Ki > 10.0 * tuned.pid.Kp > 0.0


def test_what_no_gains_hold_is_said_with_its_cause() -> None:
    with pytest.raises(BadInputError, match=r"sensitivity of 1\.0001 at every"):
        tune_position(NOMINAL, ControllerCriterion(gain_margin=2.0, phase_margin_rad=1.0, sensitivity=1.0001))
    heavy = replace(NOMINAL, plant=replace(NOMINAL.plant, mass_kg=0.15, gravity_mps2=(0.0, -9.81)))
    with pytest.raises(BadInputError, match="does not come to rest by itself but goes away"):
        tune_orientation(heavy, CRITERION)


@pytest.mark.few
@pytest.mark.parametrize("order", [1, -1])
def test_unlike_pumps_keep_the_margins_to_both_sides(order: int) -> None:
    """Tuned on the side of the weaker pump alone, the other side had a gain margin of 1.78."""
    model, mirrored = (replace(UNLIKE, strength=UNLIKE.strength[::way]) for way in (order, -order))
    criterion = ControllerCriterion(gain_margin=2.0, phase_margin_rad=math.radians(60.0), sensitivity=2.0)
    tuned = tune_orientation(model, criterion)
    assert {point.q_m[0] > point.q_m[1] for point in tuned.points} == {True, False}
    for share in (-0.6, 0.6):
        phi = share * abs(largest_angle(model, int(share < 0.0)))
        q1, q2 = bent_rest(model, phi).tolist()
        (margins,) = loop_margins(orientation_loop(model, tuned.pid, (q1, q2)))
        assert margins.gain > 1.95
        assert margins.sensitivity < 2.05
    assert largest_angle(model) == pytest.approx(-largest_angle(mirrored, 1), rel=1e-6)


def test_each_pump_has_its_lag() -> None:
    """With that of both between them a gain margin of 1.44 was printed as 2.04, to the slower pump's side."""
    model = replace(NOMINAL, pump=replace(NOMINAL.pump, lag_ratio=2.0))
    alike = [replace(NOMINAL, pump=replace(NOMINAL.pump, lag_s=lag_s)) for lag_s in model.pump.lags_s]
    q, w = np.array([0.08, 0.075]), np.linspace(0.5, 40.0, 50)
    columns = [response(rig_system(one, q), w)[:, :, i] for i, one in enumerate(alike)]
    assert response(rig_system(model, q), w) == pytest.approx(np.stack(columns, axis=2), rel=1e-9)
    assert {point[0] > point[1] for point in operating_angles(model)} == {True, False}
    assert approach_s(model, q[::-1]) == approach_s(alike[1], q[::-1])
    step = np.concatenate([np.full((3, 2), 0.066), np.full((60, 2), 0.08)])
    given = [follow(one, step).given_N[:, i] for i, one in enumerate(alike)]
    assert follow(model, step).given_N == pytest.approx(np.stack(given, axis=1))


def test_late_pictures_and_their_low_pass_are_in_the_loop() -> None:
    """A delay of 80 ms left a phase margin of 49 degrees where 60 were printed."""
    q, pid = (0.08, 0.08), Pid(18000.0, 0.0, 180.0)
    low = signal.butter(2, 3.0, fs=1.0 / H, output="sos")
    model = replace(NOMINAL, latency_s=0.08, lowpass=tuple(map(tuple, low.tolist())))
    w = np.linspace(0.5, 40.0, 50)
    length = signal.freqz_sos(low, w * H)[1] * np.exp(-5j * w * H)
    both = np.array([[1.0, 1.0], [1.0, -1.0]]) / 2.0
    seen = both @ (length[:, None, None] * np.diag([1.0, 0.0]) + np.diag([0.0, 1.0])) @ (2.0 * both)
    expected = seen @ response(series(both_channels(pid), rig_system(model, np.array(q))), w)
    assert response(position_loop(model, pid, q), w) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    tuned = tune_position(replace(NOMINAL, latency_s=0.08), CRITERION)
    assert tuned.pid.Kp < tune_position(NOMINAL, CRITERION).pid.Kp

"""What the pumps reach: against long simulations, and slowed references that are then followed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_models import MODELS, NOMINAL, ORIFICE
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.actuator.integrate import simulate
from calib.control.inverse_model import Model, feed_forward_pwm, holding_force
from calib.control.linear import bent_rest
from calib.control.reach import (
    approach_s,
    brought_in,
    follow,
    largest_angle,
    longest_m,
    reachable,
    slowed,
)
from calib.control.references import built_in
from calib.control.setpoints import Ellipse
from calib.errors import BadInputError

H = NOMINAL.tick_s


def _ellipse(period_s: float) -> np.ndarray:
    t = H * np.arange(round(period_s / H))
    return Ellipse(period_s=period_s).bellows_m(t, NOMINAL.plant.bellows_radius_m)


def test_the_longest_and_most_bent_are_those_of_a_long_simulation() -> None:
    full = simulate(NOMINAL.plant, NOMINAL.pump, np.full((1200, 2), 253.5)).q_m[-1]
    assert longest_m(NOMINAL) == pytest.approx(full[0], abs=1e-6)
    one = simulate(NOMINAL.plant, NOMINAL.pump, np.tile([253.5, 0.0], (1200, 1))).q_m[-1]
    phi = (one[0] - one[1]) / (2 * NOMINAL.plant.bellows_radius_m)
    assert largest_angle(NOMINAL) == pytest.approx(phi, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(q=st.tuples(st.floats(0.06, 0.1), st.floats(0.06, 0.1)))
@pytest.mark.parametrize("model", MODELS[:2])
def test_reachable_is_what_the_map_can_hold(model: Model, q: tuple[float, float]) -> None:
    at = np.array(q)
    pwm = feed_forward_pwm(model, at)
    end = simulate(model.plant, model.pump, np.tile(pwm, (900, 1))).q_m[-1]
    held = bool(np.abs(end - at).max() < 2e-5)
    near = float(np.abs(end - at).max()) < 1e-4
    assert bool(reachable(model, at)) == held or near


def test_the_source_s_references() -> None:
    assert follow(NOMINAL, built_in(NOMINAL, "ellipse").q_m).possible
    assert follow(NOMINAL, built_in(NOMINAL, "elongation").q_m).possible
    rest = NOMINAL.plant.rest_length_m
    for name in ("step", "jump"):
        found = follow(NOMINAL, built_in(NOMINAL, name).path_m(rest))
        assert found.at_s == 0.0 and "jumps by 19.3 mm within a tick" in found.reason


def test_a_fast_ellipse_is_lost_while_deflating() -> None:
    found = follow(NOMINAL, _ellipse(8.0))
    assert not found.possible and found.at_s is not None
    assert "bellows 2 would have to deflate at" in found.reason and "leaves at 0.4 N/s" in found.reason
    # Up to there the wanted forces fall no faster than the air leaves, by more than the tolerance.
    k = round(found.at_s / H)
    assert np.abs(found.missing_m[:k]).max() <= 2.5e-4 < np.abs(found.missing_m[k]).max()


def test_the_limit_of_the_period_is_between() -> None:
    """The ellipse needs 0.31 N/s in 20 s, so about 15.5 s is the fastest that the orifice allows."""
    assert follow(NOMINAL, _ellipse(16.5)).possible
    assert not follow(NOMINAL, _ellipse(12.0)).possible


def test_too_long_and_too_short() -> None:
    long = np.linspace(0.09, 0.095, 3600)[:, None] * np.ones(2)
    found = follow(NOMINAL, long)
    assert not found.possible and "its pump gives at most 2.04 N" in found.reason
    assert long[round((found.at_s or 0.0) / H), 0] == pytest.approx(longest_m(NOMINAL) + 2.5e-4, abs=2e-4)
    short = np.linspace(0.066, 0.06, 600)[:, None] * np.ones(2)
    assert "pumps only push" in follow(NOMINAL, short).reason


def test_inflating_too_fast() -> None:
    up = 0.07 + 0.018 * np.clip(H * np.arange(120) - 0.5, 0.0, 0.6)[:, None] / 0.6 * np.ones(2)
    assert "inflate at" in follow(NOMINAL, up).reason


def test_the_forces_that_follow_can_be_had() -> None:
    """`given` as commands without delay, turned back through the lag, is what the pumps of the twin give."""
    found = follow(NOMINAL, _ellipse(8.0))
    rise = np.diff(found.given_N, axis=0) / H
    assert float(-rise.min()) <= 0.4 + 1e-9
    most = 2.0390829
    a = math.exp(-H / 0.7)
    assert np.all(found.given_N[1:] <= most + (found.given_N[:-1] - most) * a + 1e-9)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize("period_s", [3.0, 8.0])
def test_slowed_it_can_be_followed_on_the_same_path(model: Model, period_s: float) -> None:
    q = _ellipse(period_s)
    if follow(model, q).possible:
        return
    slow, proof = slowed(model, q)
    assert proof.possible and len(slow) > len(q)
    assert follow(model, slow).possible
    assert slow[0] == pytest.approx(q[0], abs=1e-4) and slow[-1] == pytest.approx(q[-1], abs=1e-4)
    # The same path: every point of it lies close to a point of the reference.
    fine = np.concatenate([q[:-1] + s * np.diff(q, axis=0) for s in (0.0, 0.25, 0.5, 0.75)])
    near = np.min(np.linalg.norm(slow[::7, None, :] - fine[None], axis=2), axis=1)
    assert float(near.max()) < 5e-4


def test_a_jump_becomes_a_ramp_and_holds_stay() -> None:
    path = built_in(NOMINAL, "jump").path_m(NOMINAL.plant.rest_length_m)
    slow, proof = slowed(NOMINAL, path)
    assert proof.possible
    # 10 s, about a second for the rise and 1.0 N at 0.4 N/s for the fall; holding is not stretched.
    assert 12.0 < len(slow) * H < 15.0


def test_no_slowness_brings_back_what_is_out_of_reach() -> None:
    with pytest.raises(BadInputError, match="cannot be held by the pumps at any speed"):
        slowed(NOMINAL, np.linspace(0.08, 0.1, 100)[:, None] * np.ones(2))


def test_lengths_just_outside_are_brought_to_the_edge_and_others_stay() -> None:
    rest = NOMINAL.plant.rest_length_m
    q = np.array([[rest - 5e-4, rest - 3e-4], [0.07, 0.072], [0.08, 0.0655], [rest - 3e-3, rest]])
    inside, moved = brought_in(NOMINAL, q)
    assert reachable(NOMINAL, inside).tolist() == [True, True, True, False]
    assert np.array_equal(inside[[1, 3]], q[[1, 3]])
    assert inside[0] == pytest.approx([rest, rest], abs=1e-6)
    assert moved == pytest.approx(np.abs(inside - q).max()) and moved <= 1e-3
    # On the edge one pump is off.
    assert holding_force(NOMINAL.plant, inside[2])[1] == pytest.approx(0.0, abs=1e-8)


def test_a_recorded_run_with_its_noise_can_be_slowed() -> None:
    q = _ellipse(12.0)
    q = q + 2e-4 * np.sin(np.arange(len(q)) / 9.0)[:, None]
    q[:60] = NOMINAL.plant.rest_length_m - 4e-4
    slow, proof = slowed(NOMINAL, q)
    assert proof.possible and len(slow) > len(q)


def test_the_way_there() -> None:
    q = bent_rest(NOMINAL, 0.5)
    t = approach_s(NOMINAL, q)
    F = 2.0390829 * (1.0 - math.exp(-(t - 2 * H) / 0.7))
    assert float(holding_force(NOMINAL.plant, q)[0]) == pytest.approx(F, rel=1e-6)
    assert math.isinf(approach_s(NOMINAL, np.array([0.1, 0.1])))

"""References at the ticks: the source's set-points, series, and the workspace."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_models import NOMINAL
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.kinematics import angle
from calib.control.inverse_model import holding_force
from calib.control.references import (
    BUILT_IN,
    built_in,
    check_workspace,
    from_angles,
    from_lengths,
    resampled,
)
from calib.control.setpoints import Ellipse
from calib.errors import BadInputError

H = NOMINAL.tick_s
BOX = (-0.06, 0.04, 0.06, 0.11)


def test_the_set_points_of_the_source() -> None:
    elongation = built_in(NOMINAL, "elongation")
    assert elongation.q_m[-1] == pytest.approx([0.09, 0.09]) and np.ptp(elongation.q_m[301:]) == 0.0
    ellipse = built_in(NOMINAL, "ellipse")
    assert ellipse.q_m == pytest.approx(Ellipse().bellows_m(ellipse.t_s, NOMINAL.plant.bellows_radius_m))
    assert len(ellipse.q_m) == 1200 and ellipse.judged_from_s == 2.0
    step, jump = built_in(NOMINAL, "step"), built_in(NOMINAL, "jump")
    assert set(step.phi_rad.tolist()) == {0.7} and step.kind == "angle" and step.jump_s is None
    assert jump.phi_rad[299] == 0.7 and jump.phi_rad[300] == 0.3 and jump.jump_s == 5.0
    for one in (step, jump):
        assert one.path_m(0.065)[0].tolist() == [0.065, 0.065]
        assert one.path_m(0.065)[1:] == pytest.approx(one.q_m[1:])
    assert ellipse.path_m(0.065) is ellipse.q_m


@pytest.mark.parametrize("name", BUILT_IN)
def test_lengths_and_angle_belong_together(name: str) -> None:
    made = built_in(NOMINAL, name)
    assert angle(made.q_m, NOMINAL.plant.bellows_radius_m) == pytest.approx(made.phi_rad, abs=1e-12)
    assert made.duration_s == pytest.approx(len(made.t_s) * H)
    check_workspace(NOMINAL, made, BOX)


def test_an_angle_gets_the_lengths_of_one_pump() -> None:
    phi = 0.6 * np.sin(0.02 * np.arange(900))
    made = from_angles(NOMINAL, "swing", phi)
    F = holding_force(NOMINAL.plant, made.q_m)
    idle = np.where(phi >= 0.0, F[:, 1], F[:, 0])
    # Most of these angles lie between two rests that were computed.
    assert np.abs(idle).max() < 1e-4
    assert angle(made.q_m, NOMINAL.plant.bellows_radius_m) == pytest.approx(phi, abs=1e-9)


def test_a_duration_of_one_s_own() -> None:
    assert len(built_in(NOMINAL, "step", 2.0).phi_rad) == 120
    assert built_in(NOMINAL, "jump", 3.0).jump_s is None


@pytest.mark.parametrize(
    ("name", "duration_s", "sentence"),
    [
        ("circle", None, "found 'circle', expected one of elongation"),
        ("step", 0.01, "lasts 0.01 s, expected 0.05 s to 7200 s"),
        ("step", 1e5, "lasts 100000 s"),
        ("step", math.inf, "lasts inf s"),
    ],
)
def test_references_that_are_none(name: str, duration_s: float | None, sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        built_in(NOMINAL, name, duration_s)


@given(st.lists(st.floats(0.06, 0.09), min_size=4, max_size=30))
def test_resampling_keeps_points_and_overshoots_nowhere(values: list[float]) -> None:
    v = np.array(values)
    t = 3.0 + 5 * H * np.arange(len(v))
    out = resampled(t, v[:, None], H)[:, 0]
    assert len(out) == 5 * (len(v) - 1) + 1
    assert out[::5] == pytest.approx(v, abs=1e-12)
    assert v.min() - 1e-12 <= out.min() and out.max() <= v.max() + 1e-12


def test_the_workspace() -> None:
    far = from_lengths(NOMINAL, "far", np.linspace(0.08, 0.12, 100)[:, None] * np.ones(2))
    with pytest.raises(BadInputError, match=r"far: at 0\.\d+ s the marker would be at \(0\.0, 110\.\d\) mm"):
        check_workspace(NOMINAL, far, BOX)
    none = from_lengths(NOMINAL, "none", np.linspace(0.08, -0.01, 100)[:, None] * np.ones(2))
    with pytest.raises(BadInputError, match=r"a bellows would be .* mm long, expected a positive length"):
        check_workspace(NOMINAL, none, BOX)

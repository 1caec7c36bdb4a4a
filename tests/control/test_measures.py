"""Figures of motions whose figures are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from control_models import NOMINAL

from calib.control.measures import saturation_share, settling_s, tracking
from calib.control.references import Reference, built_in

R, H = NOMINAL.plant.bellows_radius_m, NOMINAL.tick_s


def _tracking(reference: Reference, q: np.ndarray, pwm: np.ndarray | None = None):
    return tracking(reference, q, np.zeros_like(q) if pwm is None else pwm, R, 0.0, 255.0)


def test_a_constant_error_is_its_own_rms() -> None:
    reference = built_in(NOMINAL, "ellipse")
    q = reference.q_m + np.array([1e-3, -1e-3])
    q[:120] += 0.005
    found = _tracking(reference, q)
    assert found.rms_mm == pytest.approx((1.0, 1.0))
    assert found.largest_mm == pytest.approx(1.0)
    assert found.angle_rms_rad == pytest.approx(1e-3 / R)
    assert found.rms_from_start_mm[0] == pytest.approx(math.sqrt(0.9 + 0.1 * 36.0))
    assert found.rise_s is None and found.jump_overshoot_rad is None
    # An error in the angle alone moves the head sideways by about half of l times the angle.
    assert found.head_rms_mm == pytest.approx(1e3 * 0.5 * 0.08 * 1e-3 / R, rel=0.1)


def test_the_figures_of_a_step_and_a_jump() -> None:
    reference = built_in(NOMINAL, "jump")
    t = reference.t_s
    phi = np.where(t < 5.0, np.minimum(0.7 * t, 0.75), np.maximum(0.75 - 0.3 * (t - 5.0), 0.25))
    phi[(t >= 2.0) & (t < 5.0)] = 0.701
    phi[t >= 8.0] = 0.301
    q = 0.08 + R * np.stack([phi, -phi], axis=1)
    found = _tracking(reference, q)
    assert found.rise_s == pytest.approx(0.95, abs=1.01 * H)
    assert found.reach_s == pytest.approx(1.0, abs=1.01 * H)
    assert found.overshoot_rad == pytest.approx(0.05, abs=1e-9)
    assert found.settling_s == pytest.approx(2.0, abs=H)
    assert found.jump_overshoot_rad == pytest.approx(0.05, abs=1e-9)
    assert found.jump_settling_s == pytest.approx(3.0, abs=H)
    assert math.isnan(found.rms_mm[0]) and math.isnan(found.head_rms_mm)


def test_what_never_happens_is_none() -> None:
    reference = built_in(NOMINAL, "step")
    found = _tracking(reference, np.full((300, 2), 0.07))
    assert found.rise_s is None and found.reach_s is None and found.settling_s is None
    assert found.overshoot_rad == 0.0


def test_saturation_and_changes() -> None:
    pwm = np.array([[0.0, 10.0], [255.0, 20.0], [100.0, 255.0], [0.0, 40.0]])
    assert saturation_share(pwm, 0.0, 255.0) == (0.75, 0.25)
    reference = replace(built_in(NOMINAL, "step", 4 * H), kind="lengths")
    found = _tracking(reference, reference.q_m, pwm)
    assert found.changes_pwm == pytest.approx((255 + 155 + 100 + 10 + 235 + 215) / 6)
    assert found.rms_mm == (0.0, 0.0)


def test_settling() -> None:
    assert settling_s(0.1, np.array([3.0, 2.0, 0.1, -0.1]), 0.5) == pytest.approx(0.2)
    assert settling_s(0.1, np.array([0.1, 0.0]), 0.5) == 0.0
    assert settling_s(0.1, np.array([0.0, 1.0]), 0.5) is None


def test_shorter_than_the_way_there_all_counts() -> None:
    reference = built_in(NOMINAL, "ellipse", 1.0)
    assert _tracking(reference, reference.q_m + 1e-3).rms_mm == pytest.approx((1.0, 1.0))

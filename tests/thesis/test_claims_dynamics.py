"""Claims about the dynamics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.stages.actuator.dynamics import mass_matrix
from calib.stages.actuator.parameters import Plant
from thesis import claims_dynamics
from thesis.claims_dynamics import lateral_damping, model_errors
from thesis.outcome import Outcome
from thesis.runs import first_model


def test_the_share_of_the_rotation_in_closed_form() -> None:
    numbers = claims_dynamics.ke_share.check().numbers
    assert numbers["share"] == pytest.approx(1.27e-5 / (1.27e-5 + 0.25 * 0.0166 * 0.065**2))
    assert numbers["share_at_marker"] == pytest.approx(0.25, abs=0.01)


def test_the_lateral_damping_in_closed_form() -> None:
    # zeta of the axial mode times sqrt(m / 2) over sqrt of the bending mode's mass J0 / (2 r^2).
    J0 = 0.25 * 0.0166 * 0.065**2 + 1.27e-5
    share = math.sqrt(0.0166 * 0.0126**2 / J0)
    assert claims_dynamics.damping_lateral.check().numbers["share"] == pytest.approx(share, rel=1e-6)
    assert lateral_damping(first_model().free_plant) == pytest.approx(0.0513 * share, rel=1e-6)


def test_the_growth_with_the_printed_sign_in_closed_form() -> None:
    least = np.linalg.eigvalsh(mass_matrix(Plant(), np.full(2, 0.065))).min()
    growth = claims_dynamics.spring_sign.check().numbers["growth_per_s"]
    assert growth == pytest.approx(math.sqrt(47.7 / least))


def test_wrong_equations_would_be_refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    right = claims_dynamics.coriolis_matrix
    monkeypatch.setattr(claims_dynamics, "coriolis_matrix", lambda *given: 1.01 * right(*given))
    assert claims_dynamics.coriolis.check().outcome is Outcome.REFUTED
    jacobian = claims_dynamics.forward_jacobian
    monkeypatch.setattr(claims_dynamics, "forward_jacobian", lambda *given: 1.001 * jacobian(*given))
    assert claims_dynamics.identity.check().outcome is Outcome.REFUTED
    monkeypatch.setattr(claims_dynamics, "mass_matrix", lambda plant, q: -mass_matrix(plant, q))
    assert claims_dynamics.mass.check().outcome is Outcome.REFUTED


def test_the_first_model_misses_the_rig_by_millimetres_and_begins_with_it() -> None:
    errors = model_errors()
    assert np.abs(errors[0]).max() < 1e-12
    numbers = claims_dynamics.error_band.check().numbers
    assert numbers["least_mm"] < -1.0 and numbers["greatest_mm"] > 1.0
    assert claims_dynamics.static_error.check().numbers["left_mm"] < 1e-6


def test_the_swing_is_the_nominal_one() -> None:
    assert claims_dynamics.damping_ratio.check().numbers["zeta"] == pytest.approx(0.055, rel=0.05)
    assert claims_dynamics.constants.check().numbers["swing_hz"] == pytest.approx(4.0, rel=0.05)
    assert claims_dynamics.rotational.check().numbers["relative_error"] < 1e-8

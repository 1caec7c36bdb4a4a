"""Claims about the fitted parameters: other numbers in the table would come to other outcomes."""

from __future__ import annotations

import pytest

from calib.stages.actuator.parameters import Plant
from thesis import claims_fit
from thesis.outcome import Outcome


def test_passive_creep_would_not_be_refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert claims_fit.creep.check().numbers["growth_per_s"] > 0.1
    monkeypatch.setattr(claims_fit, "printed_plant", Plant)
    assert claims_fit.creep.check().outcome is Outcome.REPRODUCED


def test_the_bending_stiffness_is_right_in_millinewton(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = claims_fit.bending.check().numbers
    assert numbers["largest_angle_newton_rad"] == pytest.approx(0.08, abs=0.005)
    assert numbers["largest_angle_millinewton_rad"] > 0.7
    monkeypatch.setattr(claims_fit, "PRINTED_K_BND", 0.16949)
    assert claims_fit.bending.check().outcome is Outcome.REPRODUCED


def test_the_scale_of_the_damping() -> None:
    numbers = claims_fit.scales.check().numbers
    assert numbers["needed_c_dmp"] == pytest.approx(3.4, abs=0.05)
    assert numbers["zeta_printed"] < 0.8 * 0.0513


def test_percentages_that_do_not_follow_would_be_refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = claims_fit.norms.check().numbers
    assert numbers["q2_percent"] == pytest.approx(35.3, abs=0.05)
    monkeypatch.setitem(claims_fit._NORMS, "q2", (23.2, 15.0, 0.1, 36.3))
    assert claims_fit.norms.check().outcome is Outcome.REFUTED


def test_out_of_plane_is_half_the_angle_times_the_length() -> None:
    numbers = claims_fit.out_of_plane.check().numbers
    assert numbers["greatest_mm"] == pytest.approx(0.5 * 65.0 * 0.0820, rel=2e-3)
    assert numbers["marker_greatest_mm"] > numbers["greatest_mm"] + 1.0

"""Claims about the pumps."""

from __future__ import annotations

import pytest

from thesis import claims_pump
from thesis.outcome import Outcome


def test_the_polynomial_as_printed_and_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = claims_pump.poly.check().numbers
    assert numbers["at_4p7V_mm"] == pytest.approx(-8.4, abs=0.05)
    assert numbers["at_12V_mm"] == pytest.approx(-28.2, abs=0.05)
    monkeypatch.setattr(claims_pump, "_PRINTED", (-0.1493, 3.756, -25.87, 54.13))
    assert claims_pump.poly.check().outcome is Outcome.REPRODUCED


def test_the_force_is_in_millinewton_and_has_a_bump() -> None:
    numbers = claims_pump.force_polynomial.check().numbers
    assert numbers["full_mN"] == pytest.approx(2062.0, abs=1.0)
    assert numbers["spring_at_12V_mN"] == pytest.approx(numbers["full_mN"], rel=0.02)
    assert (numbers["bump_at_pwm"], round(numbers["bump_mN"])) == (31.0, 244)


def test_the_rate_that_takes_five_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = claims_pump.fall.check().numbers
    assert numbers["deflation_s"] == pytest.approx(2.6, abs=0.05)
    assert numbers["with_0p4_s"] == pytest.approx(5.05, abs=0.05)
    monkeypatch.setattr(claims_pump, "PRINTED_RATE", 0.4)
    assert claims_pump.fall.check().outcome is Outcome.REPRODUCED


def test_a_passive_creep_does_not_overshoot() -> None:
    numbers = claims_pump.overshoot.check().numbers
    assert all(value > -0.01 for value in numbers.values())
    assert numbers["least_mm_printed"] > 10.0


def test_the_rest() -> None:
    assert claims_pump.threshold.check().numbers["first_pwm"] == 100.0
    assert claims_pump.threshold.check().numbers["zero_of_polynomial_V"] == pytest.approx(4.7, abs=0.05)
    assert claims_pump.reach.check().numbers["longest_mm"] == pytest.approx(91.5, abs=0.2)
    assert claims_pump.deflation.check().numbers["inflation_s"] == pytest.approx(2.0, abs=0.1)
    assert 0.5 < claims_pump.tau.check().numbers["time_to_63_percent_s"] < 0.9
    assert claims_pump.pwm6v.check().numbers["pwm"] == 127.5

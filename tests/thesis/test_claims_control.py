"""Claims about the control of the angle."""

from __future__ import annotations

import pytest

from calib.stages.control.laws import PidState
from thesis import claims_control
from thesis.outcome import Outcome


def test_no_proportional_gain_reaches() -> None:
    numbers = claims_control.proportional.check().numbers
    assert [round(value, 2) for value in numbers.values()] == pytest.approx(
        [0.375, 0.535, 0.63, 0.70], abs=0.01
    )
    assert max(numbers.values()) < 0.7


def test_a_recursion_that_starts_elsewhere_is_refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert claims_control.pid_discrete.check().numbers["error_pwm"] < 1e-9
    # A history filled with the first error is off by -Kp e_0 for ever.
    monkeypatch.setattr(claims_control, "PidState", lambda: PidState(0.0, 0.7, 0.7))
    assert claims_control.pid_discrete.check().outcome is Outcome.REFUTED


def test_times_of_the_pid() -> None:
    numbers = claims_control.pid_settle.check().numbers
    assert numbers["reach_s"] == pytest.approx(0.92, rel=0.05)
    assert numbers["settle_s"] == pytest.approx(2.37, rel=0.05)
    assert numbers["desaturation_s"] > 1.2 * 0.73
    assert claims_control.pid_peak.check().numbers["peak_rad"] == pytest.approx(0.742, rel=0.01)


def test_clamping_halves_the_overshoot_and_slows_the_rise() -> None:
    numbers = claims_control.windup.check().numbers
    assert 0.3 < numbers["clamped_overshoot_rad"] / numbers["overshoot_rad"] < 0.6
    assert numbers["clamped_reach_s"] > 3.0 * numbers["reach_s"]


def test_only_a_bending_stiffness_in_newton_saturates_for_good() -> None:
    numbers = claims_control.sim_saturates.check().numbers
    assert numbers["share"] < 0.3 and numbers["share_printed_mN"] < 0.7
    assert numbers["share_printed_N"] == 1.0
    assert claims_control.dt.check().numbers["tick_s"] == 1.0 / 60.0

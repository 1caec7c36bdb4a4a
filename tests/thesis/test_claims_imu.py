"""Claims about the IMU: figures, and that outcomes follow from them."""

from __future__ import annotations

import math

import pytest

from calib.stages.imu.mahony import MahonyState
from thesis import claims_imu


def test_steps_of_both_sensors() -> None:
    assert claims_imu.gyro_lsb.check().numbers["step_degps"] == pytest.approx(4000.0 / 65536.0)
    assert claims_imu.acc_lsb.check().numbers["step_mps2"] == pytest.approx(0.01916, abs=5e-6)


def test_the_chips_drift_is_the_mean_of_different_logs() -> None:
    numbers = claims_imu.onchip_drift.check().numbers
    # Five draws around the rig's own drift with a spread of 0.4 of it.
    assert abs(numbers["mean_degps"] - 0.145) < 3.0 * 0.4 * 0.145 / math.sqrt(5.0)
    assert 0.0 < numbers["spread_degps"] < 3.0 * 0.4 * 0.145


def test_a_constant_bias_leaves_no_drift() -> None:
    numbers = claims_imu.mm_drift.check().numbers
    assert numbers["largest_degps"] < 1e-3 * 0.145


def test_gains_are_compared_in_motion() -> None:
    numbers = claims_imu.mm_gains.check().numbers
    assert numbers["rms_best_rad"] < numbers["rms_printed_rad"] < 0.05


def test_a_filter_of_another_kind_would_not_pass_for_first_order(monkeypatch: pytest.MonkeyPatch) -> None:
    assert claims_imu.backward_difference.check().numbers["ratio"] == pytest.approx(2.0, abs=0.1)
    monkeypatch.setattr(claims_imu, "step", lambda gains, state, sample: MahonyState(1.0))
    assert claims_imu.backward_difference.check().outcome.value == "refuted"

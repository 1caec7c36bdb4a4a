"""Claims about the kinematics."""

from __future__ import annotations

import math

import pytest

from thesis import claims_kinematics


def test_errors_of_the_truncated_series() -> None:
    numbers = claims_kinematics.series_H.check().numbers
    phi, length = 0.5 * math.pi, 0.065
    # The next term of each alternating series bounds what is left out.
    assert (
        0.9 * length * phi**9 / math.factorial(10)
        < numbers["error_x_m"]
        < length * phi**9 / math.factorial(10)
    )
    assert (
        0.9 * length * phi**8 / math.factorial(9) < numbers["error_y_m"] < length * phi**8 / math.factorial(9)
    )


def test_the_printed_error_of_f_is_at_another_angle() -> None:
    numbers = claims_kinematics.series_f_error.check().numbers
    assert numbers["error"] == pytest.approx(6.49e-5, abs=1e-7)
    assert numbers["error_at_1p5_rad"] == pytest.approx(4.459e-5, abs=1e-8)


def test_the_tangent_decides_on_the_rotation() -> None:
    numbers = claims_kinematics.rotation.check().numbers
    assert numbers["printed_error"] == pytest.approx(2.0 * math.sin(0.7), abs=1e-6)
    assert numbers["transposed_error"] < 1e-8


def test_both_ways_and_the_limits() -> None:
    assert claims_kinematics.inverse_kinematics.check().numbers["error_m"] < 1e-15
    assert claims_kinematics.limits.check().numbers["error_m"] < 1e-11
    assert claims_kinematics.fem.check().numbers["spread"] < 1e-9

"""The firmware's series of the inverse kinematics."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy
from source_model import inverse_series

from calib.stages.actuator import kinematics as kin

R_B = 0.0126


def test_inverse_coefficients_are_the_printed_ones() -> None:
    printed = (Fraction(2), Fraction(1, 12), Fraction(7, 2880), Fraction(31, 483840))
    assert kin.inverse_coefficients(6) == printed
    assert kin.inverse_coefficients(4) == printed[:3]


def test_inverse_coefficients_against_sympy() -> None:
    x = sympy.Symbol("x")
    expansion = sympy.series(x / sympy.sin(x / 2), x, 0, 13).removeO()
    for n, value in enumerate(kin.inverse_coefficients(12)):
        assert Fraction(str(expansion.coeff(x, 2 * n))) == value


def test_inverse_kinematics_of_the_firmware() -> None:
    """The error in the bellows is half the chord times the error of f."""
    q = np.random.default_rng(5).uniform(0.05, 0.09, (50, 2))
    pose = kin.forward(q, R_B)
    x, y, phi = pose.T
    series = 2.0 + phi**2 / 12.0 + 7.0 * phi**4 / 2880.0 + 31.0 * phi**6 / 483840.0
    expected = 0.5 * np.hypot(x, y) * (phi / np.sin(0.5 * phi) - series)
    error = q - inverse_series(pose, R_B)
    assert error[:, 0] == pytest.approx(expected, abs=1e-15)
    assert error[:, 1] == pytest.approx(expected, abs=1e-15)

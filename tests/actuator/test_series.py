"""The firmware's series: coefficients, printed errors and the true ones."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import sympy

from calib.core.errors import BadInputError
from calib.stages.actuator import kinematics as kin
from calib.stages.actuator import kinematics as series

R_B = 0.0126


def test_inverse_coefficients_are_the_printed_ones() -> None:
    printed = (Fraction(2), Fraction(1, 12), Fraction(7, 2880), Fraction(31, 483840))
    assert series.inverse_coefficients(6) == printed
    assert series.inverse_coefficients(4) == printed[:3]


def test_inverse_coefficients_against_sympy() -> None:
    x = sympy.Symbol("x")
    expansion = sympy.series(x / sympy.sin(x / 2), x, 0, 13).removeO()
    for n, value in enumerate(series.inverse_coefficients(12)):
        assert Fraction(str(expansion.coeff(x, 2 * n))) == value


def test_errors_at_a_quarter_turn() -> None:
    """6.49e-5 where the text says 4.45e-5, which is the error at 1.5 rad."""
    assert float(series.f_error(np.array(np.pi / 2))) == pytest.approx(6.49e-5, rel=1e-3)
    assert float(series.f_error(np.array(1.5))) == pytest.approx(4.459e-5, rel=1e-3)
    assert float(series.H13_error_m(np.array(np.pi / 2), 0.065)) == pytest.approx(1.0e-6, rel=0.03)
    assert float(series.H23_error_m(np.array(np.pi / 2), 0.065)) == pytest.approx(6.5e-6, rel=0.01)


@pytest.mark.parametrize("order", [1, 3, 5, 7])
def test_forward_error_is_the_first_dropped_term(order: int) -> None:
    """An alternating series: the error is below the next term and has its sign."""
    phi, length = np.linspace(-1.5, 1.5, 31), 0.065
    dropped = series.H13_series_m(phi, length, order + 2) - series.H13_series_m(phi, length, order)
    error = series.H13_error_m(phi, length, order)
    assert np.all(np.abs(error) <= np.abs(dropped) + 1e-16)
    assert np.all(error * dropped >= -1e-30)


def test_errors_fall_with_the_order() -> None:
    """f has its poles at 2 pi, so each further term gains (phi / 2 pi)^2, a sixteenth at pi / 2."""
    phi = np.array(np.pi / 2)
    inverse = [abs(float(series.f_error(phi, order))) for order in (0, 2, 4, 6, 8, 10)]
    forward = [abs(float(series.H23_error_m(phi, 0.065, order))) for order in (0, 2, 4, 6, 8)]
    gains = [b / a for a, b in pairwise(inverse)]
    assert gains == pytest.approx([1 / 16] * 5, rel=0.15)
    assert all(b < a / 4 for a, b in pairwise(forward))


def test_curves_vanish_at_zero_curvature() -> None:
    zero = np.zeros(3)
    assert np.all(series.f_error(zero) == 0.0)
    assert np.all(series.H13_error_m(zero, 0.065) == 0.0)
    assert np.all(series.H23_error_m(zero, 0.065) == 0.0)


def test_inverse_kinematics_of_the_firmware() -> None:
    """The error in the bellows is half the chord times the error of f."""
    q = np.random.default_rng(5).uniform(0.05, 0.09, (50, 2))
    pose = kin.forward(q, R_B)
    error = q - series.inverse_series(pose, R_B)
    chord = np.hypot(pose[:, 0], pose[:, 1])
    expected = 0.5 * chord * series.f_error(pose[:, 2])
    assert error[:, 0] == pytest.approx(expected, abs=1e-16)
    assert error[:, 1] == pytest.approx(expected, abs=1e-16)


def test_forward_kinematics_of_the_firmware() -> None:
    q = np.random.default_rng(6).uniform(0.05, 0.09, (50, 2))
    pose, short = kin.forward(q, R_B), series.forward_series(q, R_B)
    bent = np.abs(pose[:, 2]) < np.pi / 2
    assert np.abs(pose - short)[bent].max() < 1e-5


def test_too_low_an_order() -> None:
    with pytest.raises(BadInputError, match="expected 1 or more"):
        series.H13_series_m(np.array(0.1), 0.065, 0)

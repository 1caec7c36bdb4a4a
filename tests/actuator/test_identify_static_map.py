"""The static map: truth recovered with honest deviations, outliers named, bad tables refused."""

from __future__ import annotations

import numpy as np
import pytest

from calib.actuator.identify_pump_models import Shape
from calib.actuator.identify_static_map import fit_static_map
from calib.errors import BadInputError

U = np.arange(100.0, 256.0, 5.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_truth_is_recovered_beside_outliers(sign: float) -> None:
    rng = np.random.default_rng(3)
    y = sign * (20.0 * Shape(95.0, 30.0).of(U) + 0.2 * rng.standard_normal(len(U)))
    y[10] += sign * 6.0
    found = fit_static_map("table", U, y)
    assert found.end == pytest.approx(sign * 20.0, abs=3.5 * found.sigma["end"])
    assert found.shape.dead_pwm == pytest.approx(95.0, abs=3.5 * found.sigma["dead_pwm"])
    assert found.shape.scale_pwm == pytest.approx(30.0, abs=3.5 * found.sigma["scale_pwm"])
    assert U[10] in found.outliers
    assert found.scatter == pytest.approx(0.2, rel=0.5)
    assert abs(found.of(np.array([found.saturates_pwm]))[0]) == pytest.approx(0.95 * abs(found.end))


def test_deviations_are_those_of_repeated_tables() -> None:
    ends, sigmas = [], []
    for seed in range(16):
        noise = 0.3 * np.random.default_rng(seed).standard_normal(len(U))
        found = fit_static_map("t", U, 20.0 * Shape(95.0, 30.0).of(U) + noise)
        ends.append(found.end)
        sigmas.append(found.sigma["end"])
    assert np.std(ends) == pytest.approx(np.mean(sigmas), rel=0.5)


def test_tables_that_say_nothing_are_refused() -> None:
    with pytest.raises(BadInputError, match="has 3 levels of PWM"):
        fit_static_map("t", np.array([100.0, 150.0, 200.0]), np.ones(3))
    with pytest.raises(BadInputError, match="all zero"):
        fit_static_map("t", U, 0.0 * U)

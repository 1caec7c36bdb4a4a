"""The springs' law: order, coefficients within their deviations, zero at zero."""

from __future__ import annotations

import numpy as np
import pytest

from calib.actuator.identify_stiffness import fit_stiffness
from calib.errors import BadInputError

EPS = np.linspace(0.002, 0.027, 12)


def _force(*k: float, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    clean = sum(c * EPS ** (n + 1) for n, c in enumerate(k))
    return np.asarray(clean + noise * np.random.default_rng(seed).standard_normal(len(EPS)))


@pytest.mark.parametrize("law", [(60.0,), (47.7, 1092.9)])
def test_the_order_and_the_coefficients_are_found(law: tuple[float, ...]) -> None:
    fits, best = fit_stiffness("weights", EPS, _force(*law))
    assert fits[best].order == len(law)
    assert np.all(np.abs(fits[best].coefficients - law) < 3.5 * fits[best].sigma)
    assert fits[best].force_N(np.zeros(1))[0] == 0.0
    assert fits[best].rms_N < fits[best].left_out_rms_N


def test_deviations_are_those_of_repeated_tables() -> None:
    found = [fit_stiffness("w", EPS, _force(47.7, 1092.9, seed=s))[0][1] for s in range(200)]
    spread = np.std([f.coefficients for f in found], axis=0)
    assert np.allclose(spread, np.mean([f.sigma for f in found], axis=0), rtol=0.15)
    seen = np.corrcoef(np.array([f.coefficients for f in found]).T)[0, 1]
    assert seen == pytest.approx(found[0].correlation[0, 1], abs=0.03)


def test_tables_that_cannot_be_springs_are_refused() -> None:
    with pytest.raises(BadInputError, match="has 2 elongations"):
        fit_stiffness("w", np.array([0.0, 0.01, 0.02]), np.array([0.0, 0.5, 1.0]))
    with pytest.raises(BadInputError, match="opposite signs"):
        fit_stiffness("w", EPS, -_force(50.0))

"""Tail probabilities beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from calib.solve.chance import tail_of_f, tail_of_t


def test_tails_of_f_are_scipys() -> None:
    rng = np.random.default_rng(0)
    d1, d2 = rng.integers(1, 200, 500), 10 ** rng.uniform(0.3, 5, 500)
    for freedom, second, ratio in zip(d1, d2, 10 ** rng.uniform(-3, 3, 500), strict=True):
        theirs = special.fdtrc(freedom, second, ratio)
        assert tail_of_f(freedom, second, ratio) == pytest.approx(theirs, rel=1e-6, abs=1e-30)
    np.testing.assert_allclose(tail_of_f(3, 5, np.array([0.0, np.inf])), [1.0, 0.0])


@pytest.mark.parametrize("freedom", [1, 2, 5, 30, 1000])
def test_tails_of_t_are_scipys(freedom: int) -> None:
    for t in (-1e9, -5.0, -0.3, 0.0, 0.4, 2.0, 40.0):
        assert tail_of_t(freedom, t) == pytest.approx(special.stdtr(freedom, -t), rel=1e-6, abs=1e-30)

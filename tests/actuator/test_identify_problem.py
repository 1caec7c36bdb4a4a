"""Residuals and their derivatives: against finite differences, and which unknowns belong to which log."""

from __future__ import annotations

import numpy as np
from identifytrials import track

from calib.actuator.identify_parameters import Nominal, values_of
from calib.actuator.identify_problem import FAR, Problem, first_guess, jacobian, residuals

NAMES = (
    "stiffness_scale",
    "damping_scale_free_swing",
    "bending_N_per_rad2",
    "lambda1_per_s",
    "lag_s",
    "strength1",
)


def _problem() -> Problem:
    tracks = [track("free", duration_s=1.5), track("prbs", duration_s=1.5), track("steps", duration_s=1.5)]
    return Problem(Nominal(), tracks, NAMES, {}, threads=1)


def test_unknowns_are_laid_out_by_logs() -> None:
    problem = _problem()
    layout = problem.layout
    # The logs with commands share a delay, the swing has its own.
    assert layout.delays == (0, 1, 1)
    assert layout.size == len(NAMES) + 2 + 2 + 6
    low, high = problem.bounds()
    x = first_guess(problem, values_of(Nominal()))
    assert np.all((low < x) & (x < high))


def test_derivatives_are_those_of_the_residuals() -> None:
    problem = _problem()
    x = first_guess(problem, values_of(Nominal()))
    x[problem.layout.offset : problem.layout.start] += 1e-3
    base, J = jacobian(problem, x)
    assert np.allclose(base, residuals(problem, x[None])[0], atol=1e-6)
    steps = 1e-4 * problem.scales()
    for k in range(len(x)):
        up, down = x.copy(), x.copy()
        up[k] += steps[k]
        down[k] -= steps[k]
        slope = (residuals(problem, up[None]) - residuals(problem, down[None]))[0] / (2.0 * steps[k])
        size = np.abs(slope).max()
        # A cubic between ticks is not smooth where the pumps' commands jump.
        assert np.abs(J[:, k] - slope).max() < 0.02 * size, k


def test_candidates_with_delays_of_their_own_are_shifted_to_them() -> None:
    problem = _problem()
    x = first_guess(problem, values_of(Nominal()))
    other = x.copy()
    other[problem.layout.delay] += 5e-4
    both = residuals(problem, np.stack([x, other]))
    assert np.allclose(both[0], residuals(problem, x[None])[0], atol=0.05)
    assert np.allclose(both[1], residuals(problem, other[None])[0], atol=0.05)


def test_a_candidate_that_leaves_the_model_is_far_and_not_nan() -> None:
    problem = _problem()
    values = {**values_of(Nominal()), "strength1": 10.0, "stiffness_scale": 0.05}
    rows = residuals(problem, first_guess(problem, values)[None])
    assert np.all(np.isfinite(rows))
    assert np.any(rows == FAR) or np.abs(rows).max() > 50.0

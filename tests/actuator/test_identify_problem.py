"""Residuals and their derivatives: against finite differences, and which unknowns belong to which log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identifytrials import SIGMA, track

from calib.actuator.identify_fit import fit_tracks
from calib.actuator.identify_parameters import Nominal, values_of
from calib.actuator.identify_problem import FAR, Problem, first_guess, jacobian, residuals, starts_of
from calib.actuator.identify_sigma import uncertainty
from calib.actuator.identify_tracks import Start, Track
from calib.identifystart import start_in_motion

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


def _cut(one: Track, from_s: float, moving: Start) -> Track:
    """The rest of a track from a tick on, begun in motion."""
    tick = round(from_s / one.tick_s)
    late = one.t_s >= tick * one.tick_s + 0.03
    return replace(
        one,
        pwm=one.pwm[tick:],
        t_s=one.t_s[late] - tick * one.tick_s,
        head=one.head[late],
        whitening=one.whitening[late],
        moving=moving,
    )


def test_a_log_in_motion_has_its_start_among_the_unknowns() -> None:
    moving = Start(0.1, 0.07, -0.5, 0.01, 0.02, -0.01, 0.5, 0.3, 0.4, 0.2)
    tracks = [track("free", duration_s=1.5), _cut(track("prbs", duration_s=2.5), 1.0, moving)]
    free = _cut(track("free", duration_s=2.5), 0.5, Start(0.1, 0.065, -2.0))
    problem = Problem(Nominal(), [*tracks, free], NAMES, {}, threads=1)
    layout = problem.layout
    assert layout.starts == (2, 10, 6)
    assert layout.of_start(1) == slice(layout.start + 2, layout.start + 12)
    x = first_guess(problem, values_of(Nominal()))
    assert starts_of(problem, x)[1] == moving
    assert starts_of(problem, x)[2].dphi_radps == -2.0
    x[layout.start :] += 1e-3 * problem.scales()[layout.start :]
    base, J = jacobian(problem, x)
    assert np.allclose(base, residuals(problem, x[None])[0], atol=1e-6)
    steps = 1e-3 * problem.scales()
    for k in range(layout.start, layout.size):
        up, down = x.copy(), x.copy()
        up[k] += steps[k]
        down[k] -= steps[k]
        slope = (residuals(problem, up[None]) - residuals(problem, down[None]))[0] / (2.0 * steps[k])
        assert np.abs(J[:, k] - slope).max() < 0.02 * np.abs(slope).max(), k


@pytest.mark.slow
def test_a_log_that_is_cut_out_of_a_longer_one_gives_the_same_parameters() -> None:
    values = {"stiffness_scale": 1.1, "lag_s": 0.6, "falling_N_per_s": 0.5, "strength2": 0.95}
    whole = track("prbs", values, duration_s=14.0)
    late = whole.t_s >= 4.03
    at = whole.t_s[late] - 4.0
    guess = start_in_motion(at - 0.025, whole.head[late], True, Nominal().plant, SIGMA[0])
    assert guess is not None
    cut = _cut(whole, 4.0, guess)
    found = fit_tracks(Nominal(), [cut], delay_s=0.025, threads=1)
    known = uncertainty(found)
    for name, value in found.values.items():
        truth = values.get(name, values_of(Nominal())[name])
        assert abs(value - truth) < 3.5 * known.sigma[name], name
    # Taken to begin at rest, the same rows give another rig.
    rest = fit_tracks(Nominal(), [replace(cut, moving=None)], delay_s=0.025, threads=1)
    sure = uncertainty(rest)
    away = [abs(v - values.get(n, values_of(Nominal())[n])) / sure.sigma[n] for n, v in rest.values.items()]
    assert max(away) > 6.0

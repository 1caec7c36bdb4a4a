"""Deviations: Monte Carlo, colour, whiteness, logs held back; recovery on the simulated rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import SIGMA, log_file, rig_file, track, varied

from calib.actuator.identify_fit import Solution, fit_tracks, solve
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_sigma import colour_of, held_back, uncertainty
from calib.actuator.identify_tracks import Track
from calib.identifying import read_track


def _coloured(one: Track, seed: int, memory: float = 0.9) -> Track:
    rng = np.random.default_rng(seed)
    e = rng.standard_normal((len(one.t_s), 2))
    for k in range(1, len(e)):
        e[k] = memory * e[k - 1] + np.sqrt(1.0 - memory**2) * e[k]
    return replace(one, head=one.head + np.array(SIGMA) * e)


@pytest.fixture(scope="module")
def solution() -> Solution:
    tracks = [track("free", phi_rad=phi, seed=k) for k, phi in enumerate((0.5, -0.4))]
    return fit_tracks(Nominal(), tracks, threads=1)


def test_white_noise_of_the_right_size_is_seen_as_such(solution: Solution) -> None:
    known = uncertainty(solution)
    assert known.scale == pytest.approx(1.0, rel=0.1)
    assert all(1.0 <= ratio < 1.6 for ratio in known.inflation.values())
    assert all(colour.white for colour in colour_of(solution))
    assert np.allclose(np.diag(known.correlation), 1.0)
    assert np.all(np.linalg.eigvalsh(known.covariance) > 0.0)


def test_coloured_residuals_raise_the_deviations(solution: Solution) -> None:
    tracks = [_coloured(track("free", phi_rad=phi, noise=0.0), k) for k, phi in enumerate((0.5, -0.4))]
    problem = replace(solution.problem, tracks=tracks)
    x, cost, residual, J = solve(problem, solution.x)
    again = replace(solution, problem=problem, x=x, cost=cost, residual=residual, J=J)
    assert max(uncertainty(again).inflation.values()) > 1.5
    assert not any(colour.white for colour in colour_of(again))


def test_deviations_are_those_of_repeated_logs(solution: Solution) -> None:
    found = []
    for seed in range(12):
        tracks = [track("free", phi_rad=phi, seed=50 + 2 * seed + k) for k, phi in enumerate((0.5, -0.4))]
        found.append(solve(replace(solution.problem, tracks=tracks), solution.x, 10)[0])
    P = len(solution.problem.names)
    spread = np.std([x[:P] for x in found], axis=0, ddof=1)
    ratio = spread / np.array(list(uncertainty(solution).sigma.values()))
    # Twelve draws scatter by a fifth.
    assert np.all((ratio > 0.45) & (ratio < 1.7))


def test_a_log_held_back_is_predicted_as_well_as_fitted(solution: Solution) -> None:
    held = held_back(solution)
    assert [h.name for h in held] == ["free", "free"]
    for h in held:
        assert h.held_phi_rad == pytest.approx(h.fitted_phi_rad, rel=0.1)
        assert h.fitted_phi_rad == pytest.approx(SIGMA[0], rel=0.15)
    alone = replace(solution, problem=replace(solution.problem, tracks=solution.problem.tracks[:1]))
    assert held_back(alone) == []


@pytest.mark.slow
def test_recovery_on_twenty_rigs(tmp_path: Path) -> None:
    """Noisy sensors: 95 % intervals cover the truth in 90 - 100 %, and all is within 3 sigma."""
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    z = []
    for seed in range(20):
        rig, truth = varied(seed)
        tracks = []
        for k, phi in enumerate(("0.5", "-0.4", "0.6")):
            path = log_file(tmp_path / f"{k}.csv", rig, "swing", 10 * seed + k, 8.0, phi_rad=phi)
            tracks.append(read_track(path, known, rig_yaml, 0.0126).track)
        found = fit_tracks(Nominal(), tracks)
        sigma = uncertainty(found).sigma
        assert set(found.fixed) == {"lambda3"}
        z += [(value - truth[name]) / sigma[name] for name, value in found.values.items()]
    inside = float(np.mean(np.abs(z) < 1.96))
    assert 0.9 <= inside <= 1.0
    assert np.abs(z).max() < 3.0


@pytest.mark.slow
def test_recovery_with_the_pumps_connected(tmp_path: Path) -> None:
    """All of the pumps' parameters beside the plant's, from two logs with commands."""
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    z = []
    for seed in range(4):
        rig, truth = varied(seed)
        tracks = []
        for k, (kind, duration_s) in enumerate((("prbs", 15.0), ("deflate", 12.0))):
            path = log_file(tmp_path / f"{kind}.csv", rig, kind, 10 * seed + k, duration_s)
            tracks.append(read_track(path, known, rig_yaml, 0.0126).track)
        found = fit_tracks(Nominal(), tracks)
        sigma = uncertainty(found).sigma
        assert {"lag_s", "strength1", "strength2", "falling_N_per_s"} <= set(found.values)
        z += [(value - truth[name]) / sigma[name] for name, value in found.values.items()]
    assert np.mean(np.abs(z) < 1.96) >= 0.9
    assert np.abs(z).max() < 3.0

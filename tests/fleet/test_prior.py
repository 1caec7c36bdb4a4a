"""A fleet as a prior: its distribution is recovered, and what a rig borrows is worth what it says."""

from __future__ import annotations

import numpy as np
import pytest

from calib.core.arrays import FloatArray
from calib.runner.fleet import Group, group_of, posterior

ORDER = ("a", "b", "c")
MU = np.array([273.0, 160.0, -0.22])
ROOT = np.diag([2.0, 0.8, 0.003]) @ np.array([[1.0, 0.0, 0.0], [0.5, 0.9, 0.0], [0.0, -0.3, 0.95]])
T = ROOT @ ROOT.T


def _rigs(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    theta = MU + rng.standard_normal((n, 3)) @ ROOT.T
    roots = np.array([np.diag(rng.uniform(0.3, 3.0, 3) * [1.0, 0.5, 0.002]) for _ in range(n)])
    V = roots @ roots.transpose(0, 2, 1)
    x = theta + np.einsum("nij,nj->ni", roots, rng.standard_normal((n, 3)))
    return theta, x, V


def _group(x: FloatArray, V: FloatArray) -> Group:
    found = group_of(ORDER, x, V)
    assert found is not None
    return found


def test_mean_and_spread_between_rigs_are_recovered() -> None:
    rng = np.random.default_rng(0)
    groups = [_group(*_rigs(rng, 80)[1:]) for _ in range(60)]
    between = np.mean([g.between for g in groups], axis=0)
    scale = np.sqrt(np.diag(T))
    np.testing.assert_allclose(between / scale / scale[:, None], T / scale / scale[:, None], atol=0.12)
    off = np.array([np.linalg.solve(g.of_mean, g.mean - MU) @ (g.mean - MU) for g in groups])
    # Chi-square of three degrees each, 60 of them: a mean of 3 with a deviation of sqrt(6 / 60).
    assert off.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / 60.0))


def test_borrowing_is_closer_to_the_truth_and_its_covariance_is_honest() -> None:
    rng = np.random.default_rng(1)
    nees, before, after = [], [], []
    for _ in range(40):
        _, x, V = _rigs(rng, 60)
        group = _group(x, V)
        theta, new, own = _rigs(rng, 10)
        for k in range(10):
            found = posterior(group, new[k], own[k])
            e = found.mean - theta[k]
            nees.append(e @ np.linalg.solve(found.covariance, e))
            before.append((new[k] - theta[k]) ** 2)
            after.append(e**2)
            assert np.all(np.diag(found.covariance) <= np.diag(own[k]) * (1 + 1e-9))
    # Three degrees each; taken to the sure side, so rather less than 3 than more.
    assert 2.2 < np.mean(nees) < 3.2
    assert np.all(np.mean(after, axis=0) < np.mean(before, axis=0))


def test_a_rig_that_is_well_known_hardly_moves_and_an_unknown_one_becomes_the_mean() -> None:
    group = Group(ORDER, MU, T, np.zeros((3, 3)), np.zeros((3, 3)), 100)
    x = MU + np.array([1.0, -0.5, 0.001])
    sharp = posterior(group, x, 1e-10 * T)
    np.testing.assert_allclose(sharp.mean, x, rtol=1e-8)
    loose = posterior(group, x, 1e10 * T)
    np.testing.assert_allclose(loose.mean, MU, rtol=1e-6)
    np.testing.assert_allclose(loose.covariance, T, rtol=1e-6, atol=1e-9)
    assert sharp.belongs and loose.belongs


def test_a_stranger_does_not_borrow() -> None:
    group = Group(ORDER, MU, T, np.zeros((3, 3)), np.zeros((3, 3)), 100)
    far = posterior(group, MU + 10.0 * np.sqrt(np.diag(T)), 1e-4 * T)
    assert not far.belongs and far.chance < 1e-6


def test_a_fleet_whose_rigs_are_alike_has_no_spread_of_its_own() -> None:
    rng = np.random.default_rng(3)
    V = np.tile(np.eye(3), (50, 1, 1))
    found = _group(MU + rng.standard_normal((50, 3)), V)
    assert np.linalg.eigvalsh(found.between).min() >= -1e-12
    assert np.trace(found.between) < 1.0
    after = posterior(found, MU + np.array([1.0, 0.0, 0.0]), np.eye(3))
    assert np.trace(after.covariance) < 0.5 * 3.0

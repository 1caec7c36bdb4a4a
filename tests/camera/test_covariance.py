"""Reported standard deviations against the scatter over repeated, made-up calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera.bundle import calibrate
from calib.camera.covariance import covariance, joint_jacobian, projection_sigma_px, residual_inflation
from calib.camera.model import undistort
from calib.camera.projection import vector_from_camera
from calib.camera.views import pack
from synthetic import CAMERA, views_of


def _dense_covariance(normal: np.ndarray, G: int, variance: float) -> np.ndarray:
    views = len(normal)
    H = np.zeros((G + 6 * views, G + 6 * views))
    for i, block in enumerate(normal):
        at = slice(G + 6 * i, G + 6 * i + 6)
        H[:G, :G] += block[:G, :G]
        H[:G, at] = block[:G, G:]
        H[at, :G] = block[G:, :G]
        H[at, at] = block[G:, G:]
    return variance * np.linalg.inv(H)


def test_blocks_equal_the_dense_inverse() -> None:
    fit = calibrate(pack(views_of(6, 2, 0.2)), (640, 480), "radial2")
    found = covariance(fit)
    dense = _dense_covariance(fit.normal, 6, fit.sigma_px**2)
    np.testing.assert_allclose(found.intrinsics, dense[:6, :6], rtol=1e-7)
    for i in range(6):
        at = slice(6 + 6 * i, 12 + 6 * i)
        np.testing.assert_allclose(found.poses[i], dense[at, at], rtol=1e-6, atol=1e-18)


def test_singular_problem_has_no_finite_sigma() -> None:
    view = views_of(1, 3)[0]
    fit = calibrate(pack([view]), (640, 480), "brown5")
    assert (
        not fit.converged
        or not np.isfinite(covariance(fit, 0.01).intrinsics).all()
        or (covariance(fit, 0.01).sigma()["fx_px"] > 20.0)
    )


@pytest.mark.slow
@pytest.mark.parametrize("model", ["radial2", "brown5"])
def test_monte_carlo(model: str) -> None:
    runs, noise = 500, 0.2
    clean = pack(views_of(20, 3))
    truth = vector_from_camera(CAMERA)
    rng = np.random.default_rng(0)
    pixels = np.array([[5.0, 5.0], [320.0, 240.0], [600.0, 100.0]])
    reference = calibrate(clean, (640, 480), model)
    P = len(reference.free)
    estimates, sigmas, joints, shifts, projected = [], [], [], [], []
    start = reference.block
    ideal = undistort(CAMERA, pixels)
    for _ in range(runs):
        noisy = replace(clean, pixels=clean.pixels + noise * rng.standard_normal(clean.pixels.shape))
        fit = calibrate(noisy, (640, 480), model, start=start)
        assert fit.converged
        found = covariance(fit)
        estimates.append(fit.block.intrinsics[fit.free])
        sigmas.append(np.sqrt(np.diag(found.intrinsics)))
        projected.append(projection_sigma_px(fit, found, pixels))
        # The change of projection at fixed places of the scene, poses aligned as the module defines.
        V = reference.normal[:, P:, P:]
        turn = fit.block.R_CT @ reference.block.R_CT.transpose(0, 2, 1)
        dz = np.concatenate(
            [
                np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1),
                fit.block.t_CT_m - reference.block.t_CT_m,
            ],
            axis=1,
        )
        G = np.zeros((20, 6, 6))
        G[:, range(6), range(6)] = 1.0
        t = reference.block.t_CT_m
        for row, col, value in ((3, 1, t[:, 2]), (3, 2, -t[:, 1]), (4, 0, -t[:, 2]), (4, 2, t[:, 0])):
            G[:, row, col] = value
        G[:, 5, 0], G[:, 5, 1] = t[:, 1], -t[:, 0]
        weighted = G.transpose(0, 2, 1) @ V
        g = np.linalg.solve((weighted @ G).sum(axis=0), np.einsum("nab,nb->a", weighted, dz))
        rays = np.concatenate([ideal, np.ones((3, 1))], axis=1)
        points = found.distance_m * rays / np.linalg.norm(rays, axis=1, keepdims=True)
        change = np.concatenate([estimates[-1] - truth[fit.free], g])
        joints.append(change)
        shifts.append(joint_jacobian(reference, points) @ change)
    ratio = np.std(estimates, axis=0) / np.mean(sigmas, axis=0)
    # 500 runs know a standard deviation to 3.2 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.10)
    inside = np.abs(np.array(estimates) - truth[reference.free]) < 1.96 * np.array(sigmas)
    assert 0.93 <= inside.mean() <= 0.97
    cov = np.einsum("rni,rnj->nij", shifts, shifts) / runs
    worst = np.sqrt(np.linalg.eigvalsh(cov)[:, -1])
    np.testing.assert_allclose(worst / np.mean(projected, axis=0), 1.0, atol=0.10)


def test_inflation_is_one_for_white_residuals_and_more_for_a_common_error() -> None:
    white = calibrate(pack(views_of(20, 4, 0.2)), (640, 480), "radial2")
    assert residual_inflation(white) < 1.25
    views = views_of(20, 4, 0.2)
    # A lens that the model does not have.
    for view in views:
        x, y = (view.pixels - [320, 240]).T / 320
        view.pixels[:, 0] += 1.5 * np.sin(4 * x) * np.sin(3 * y)
    structured = calibrate(pack(views), (640, 480), "radial2")
    assert residual_inflation(structured) > 1.5

"""Recovery of a known camera, agreement with OpenCV, robust loss, degenerate input."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.camera.bundle import calibrate, refit_poses
from calib.camera.covariance import covariance
from calib.camera.levenberg import linearise, rotation_exp
from calib.camera.model import COEFFICIENTS, MODELS, Camera
from calib.camera.projection import Block
from calib.camera.views import View, pack
from synthetic import BOARD, CAMERA, views_of

LENS = {"k1": -0.25, "k2": 0.1, "k3": 0.02, "p1": 1e-3, "p2": -5e-4, "k4": 0.05, "k5": 0.02, "k6": -0.01}


def _camera(model: str, skew: float) -> Camera:
    lens = np.array([LENS[name] if name in MODELS[model] else 0.0 for name in COEFFICIENTS])
    return Camera(model, (640, 480), 530.0, 532.0, skew, 325.0, 236.0, lens)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "radial3", "brown5"])
@pytest.mark.parametrize("skew", [0.0, 2.5])
def test_exact_views_give_back_the_camera(model: str, skew: float) -> None:
    camera = _camera(model, skew)
    fit = calibrate(pack(views_of(12, seed=3, camera=camera)), (640, 480), model, skew=skew != 0.0)
    assert fit.converged
    assert fit.rms_px < 1e-7
    assert fit.camera.fx_px == pytest.approx(530.0, abs=1e-4)
    assert fit.camera.skew_px == pytest.approx(skew, abs=1e-4)
    assert fit.camera.cy_px == pytest.approx(236.0, abs=1e-3)
    np.testing.assert_allclose(fit.camera.distortion, camera.distortion, atol=1e-5)


@pytest.mark.parametrize("skew", [0.0, 2.5])
def test_rational_lens_is_recovered_within_its_sigma(skew: float) -> None:
    # Its numerator and denominator all but cancel: exact views leave a valley too flat for rounding.
    camera = _camera("rational8", skew)
    views = views_of(12, seed=3, camera=camera, noise_px=0.05)
    fit = calibrate(pack(views), (640, 480), "rational8", skew=skew != 0.0)
    assert fit.converged
    sigma = covariance(fit).sigma()
    for name, value in (("fx_px", 530.0), ("cx_px", 325.0), ("cy_px", 236.0)):
        assert abs(getattr(fit.camera, name) - value) < 4 * sigma[name]
    if skew:
        assert abs(fit.camera.skew_px - skew) < 4 * sigma["skew_px"]


@pytest.mark.parametrize(
    ("model", "flags"),
    [
        ("radial2", cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3),
        ("radial3", cv2.CALIB_ZERO_TANGENT_DIST),
        ("brown5", 0),
    ],
)
def test_agrees_with_opencv(model: str, flags: int) -> None:
    views = [replace(v, pixels=v.pixels.astype(np.float32).astype(float)) for v in views_of(15, 5, 0.3)]
    fit = calibrate(pack(views), (640, 480), model)
    board = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1).astype(np.float32)
    exact = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-15)
    rms, K, lens, *_ = cv2.calibrateCamera(
        [board] * 15,
        [v.pixels.astype(np.float32)[:, None] for v in views],
        (640, 480),
        None,
        None,
        flags=flags,
        criteria=exact,
    )
    # OpenCV holds the board in single precision, a part in 10^7.
    assert fit.rms_px == pytest.approx(rms, rel=1e-6)
    assert fit.rms_px <= rms * (1 + 1e-7)
    np.testing.assert_allclose(fit.camera.K, K, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(fit.camera.distortion[:5], np.ravel(lens)[:5], rtol=1e-3, atol=1e-5)


def test_the_end_is_a_minimum() -> None:
    fit = calibrate(pack(views_of(10, 7, 0.3)), (640, 480), "brown5", skew=True)
    assert fit.converged
    at = linearise(fit.block, fit.observations, fit.free, None)
    assert at is not None
    G = len(fit.free)
    gradient = np.concatenate([at.gradient[:, :G].sum(axis=0), at.gradient[:, G:].ravel()])
    diagonal = np.concatenate(
        [at.normal[:, range(G), range(G)].sum(axis=0), at.normal[:, range(G, G + 6), range(G, G + 6)].ravel()]
    )
    # Cosine of the angle between the residuals and each column of the Jacobian.
    assert np.abs(gradient / np.sqrt(diagonal * at.cost)).max() < 1e-7
    rng = np.random.default_rng(0)
    for _ in range(20):
        shift = 1e-4 * rng.standard_normal(G) / np.sqrt(diagonal[:G])
        intrinsics = fit.block.intrinsics.copy()
        intrinsics[fit.free] += shift
        near = linearise(
            Block(intrinsics, fit.block.R_CT, fit.block.t_CT_m, fit.block.deformation),
            fit.observations,
            fit.free,
            None,
        )
        assert near is not None
        assert near.cost >= at.cost


def test_different_points_in_each_view() -> None:
    rng = np.random.default_rng(2)
    views = []
    for i in range(8):
        points = rng.uniform(-0.1, 0.1, (40 + 5 * i, 2))
        views += views_of(1, seed=i, points_m=points)
    fit = calibrate(pack(views), (640, 480), "radial2")
    assert fit.converged
    assert fit.camera.fx_px == pytest.approx(CAMERA.fx_px, abs=1e-4)


def test_one_view_with_a_fixed_centre() -> None:
    camera = Camera("pinhole", (640, 480), 530.0, 530.0, 0.0, 319.5, 239.5)
    fit = calibrate(pack(views_of(1, 4, camera=camera)), (640, 480), "pinhole", fixed=("cx_px", "cy_px"))
    assert fit.camera.fx_px == pytest.approx(530.0, abs=1e-3)
    assert fit.camera.fy_px == pytest.approx(530.0, abs=1e-3)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_loss_bears_outliers(loss: str) -> None:
    views = views_of(12, 9, 0.1)
    rng = np.random.default_rng(1)
    for view in views:
        view.pixels[rng.integers(0, 54, 2)] += rng.uniform(5, 15, (2, 2))
    plain = calibrate(pack(views), (640, 480), "radial2")
    robust = calibrate(pack(views), (640, 480), "radial2", loss=loss)
    assert robust.converged
    off = abs(robust.camera.fx_px - 530.0)
    assert off < 0.5
    assert off < 0.5 * abs(plain.camera.fx_px - 530.0)
    assert robust.sigma_px == pytest.approx(0.1, rel=0.35)


def test_bowed_board_is_found_by_the_warp() -> None:
    from calib.camera.selection import board_basis

    views = views_of(15, 11)
    observations = pack(views)
    basis = board_basis(observations.target_m[0], "warp")
    assert basis is not None
    truth = np.array([2e-3, -1e-3])
    bowed = observations.displaced(np.tensordot(truth, basis, axes=1).T)
    fit = calibrate(observations, (640, 480), "radial2")
    start = Block(fit.block.intrinsics, fit.block.R_CT, fit.block.t_CT_m, truth)
    from calib.camera.projection import jacobian

    J = jacobian(start, observations, fit.free, basis)
    assert J is not None
    pixels = observations.pixels + J[:, -1].reshape(-1, 2, 54).transpose(0, 2, 1)
    found = calibrate(replace(observations, pixels=pixels), (640, 480), "radial2", basis=basis)
    assert found.converged
    np.testing.assert_allclose(found.block.deformation, truth, atol=1e-8)
    assert bowed.target_m[0, :, 2].max() > 0


def test_poses_of_other_views_are_refitted() -> None:
    fit = calibrate(pack(views_of(10, 1)), (640, 480), "radial2")
    others = pack(views_of(5, 2, noise_px=0.2))
    residuals = refit_poses(fit, others)
    assert np.sqrt(np.mean(np.sum(residuals**2, axis=2))) == pytest.approx(0.28, rel=0.15)


def test_rotation_exp_is_a_rotation_down_to_nothing() -> None:
    for size in (1e-300, 1e-160, 1e-8, 1e-3, 1.0, 3.14):
        R = rotation_exp(size * np.array([[0.6, 0.0, 0.8]]))[0]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(R, cv2.Rodrigues(size * np.array([0.6, 0.0, 0.8]))[0], atol=1e-14)


def test_identical_views_are_named_singular_or_stalled_not_solved() -> None:
    view = views_of(1, 3, 0.1)[0]
    fit = calibrate(pack([View(str(i), view.target_m, view.pixels) for i in range(5)]), (640, 480), "brown5")
    sigma = covariance(fit).sigma()["fx_px"]
    assert not fit.converged or sigma > 5.0

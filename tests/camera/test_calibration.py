"""From views to a camera: truth recovered, agreement with OpenCV, gradients, covariance, choice of models."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outside import outside
from sets import SPOILS, Recipe, camera_of, take

from calib.stages.camera.bundle import (
    Calibration,
    calibrate,
    covariance,
    joint_jacobian,
    linearise,
    poses_with_camera,
    projection_sigma_px,
    rotation_exp,
)
from calib.stages.camera.checks import (
    DEFORMATIONS,
    TargetShape,
    best_of_starts,
    by_the_views,
    conditioned,
    evidence,
    left_out,
    overdispersion,
    target_shape,
)
from calib.stages.camera.corners import detect
from calib.stages.camera.intrinsics import (
    Candidate,
    Intrinsics,
    LensModel,
    board_basis,
    calibrate_camera,
    candidates_by_board,
    candidates_by_model,
    chosen_lens,
    simplest_good,
)
from calib.stages.camera.model import (
    COEFFICIENTS,
    FISHEYE,
    INTRINSICS,
    MODELS,
    Block,
    Camera,
    Observations,
    View,
    fold_angle,
    free_intrinsics,
    jacobian,
    pack,
    project,
    rays,
    undistort,
    vector_from_camera,
)
from calib.stages.camera.options import Choices, Told
from calib.stages.camera.read import read_views
from calib.twin.pictures import BOARD as TWIN_BOARD
from calib.twin.pictures import CAMERA as SHIPPED
from calib.twin.pictures import shots
from calib.twin.scene import PrintedBoard, render
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
    from calib.stages.camera.intrinsics import board_basis

    views = views_of(15, 11)
    observations = pack(views)
    basis = board_basis(observations.target_m[0], "warp")
    assert basis is not None
    truth = np.array([2e-3, -1e-3])
    bowed = observations.displaced(np.tensordot(truth, basis, axes=1).T)
    fit = calibrate(observations, (640, 480), "radial2")
    start = Block(fit.block.intrinsics, fit.block.R_CT, fit.block.t_CT_m, truth)
    from calib.stages.camera.model import jacobian

    J = jacobian(start, observations, fit.free, basis)
    assert J is not None
    pixels = observations.pixels + J[:, -1].reshape(-1, 2, 54).transpose(0, 2, 1)
    found = calibrate(replace(observations, pixels=pixels), (640, 480), "radial2", basis=basis)
    assert found.converged
    np.testing.assert_allclose(found.block.deformation, truth, atol=1e-8)
    assert bowed.target_m[0, :, 2].max() > 0


def test_identical_views_are_named_singular_or_stalled_not_solved() -> None:
    view = views_of(1, 3, 0.1)[0]
    fit = calibrate(pack([View(str(i), view.target_m, view.pixels) for i in range(5)]), (640, 480), "brown5")
    sigma = covariance(fit).sigma()["fx_px"]
    assert not fit.converged or sigma > 5.0


@pytest.mark.parametrize(("unknowns", "views"), [("skew", 3), ("no skew", 2), ("centre", 1)])
def test_the_fewest_views_suffice(unknowns: str, views: int) -> None:
    skew = 3.0 if unknowns == "skew" else 0.0
    centre, fixed = ((319.5, 239.5), ("cx_px", "cy_px")) if unknowns == "centre" else ((325.0, 236.0), ())
    camera = Camera("pinhole", (640, 480), 530.0, 545.0, skew, *centre)
    seen = pack(views_of(views, 4, camera=camera))
    fit = calibrate(seen, (640, 480), "pinhole", skew=skew != 0.0, fixed=fixed)
    np.testing.assert_allclose(fit.camera.K, camera.K, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("field_deg", [3.0, 5.0, 8.0, 20.0])
@pytest.mark.parametrize("k1", [-0.06, 0.05])
def test_the_lens_of_a_narrow_field_leads_to_no_wrong_minimum(field_deg: float, k1: float) -> None:
    # Within its noise such a view looks alike with its board leaning the other way; the lens outweighs that.
    lens = (k1 / (1.2 * np.tan(np.radians(field_deg / 2))) ** 2,)
    camera = camera_of(field_deg=field_deg, lens=lens)
    seen = pack(take(np.random.default_rng(1), camera, 12, BOARD.points_m()))
    found = calibrate(seen, (640, 480), "radial2")
    from_truth = calibrate(seen, (640, 480), "radial2", start=poses_with_camera(camera, seen))
    assert found.squared_sum < from_truth.squared_sum + 0.1 * from_truth.sigma_px**2


def _block(seed: int, deformation: int = 0) -> Block:
    rng = np.random.default_rng(seed)
    lens = rng.uniform(-0.1, 0.1, 8)
    intrinsics = np.array([500.0, 510.0, 320.0, 240.0, 3.0, *lens])
    R = rotation_exp(rng.uniform(-0.6, 0.6, (3, 3)))
    t = np.array([[-0.1, -0.06, 0.5], [0.0, 0.0, 0.4], [-0.12, -0.1, 0.7]])
    return Block(intrinsics, R, t, 1e-3 * rng.standard_normal(deformation))


def _observations() -> Observations:
    points = BOARD.points_m()
    views = [View(str(i), points[: 54 - 5 * i], np.full((54 - 5 * i, 2), 100.0 * i)) for i in range(3)]
    shared = [View(v.name, points, np.resize(v.pixels, (54, 2))) for v in views]
    return pack(shared)


def _shifted(
    block: Block, free: np.ndarray, row: int, view: int, step: float, basis: np.ndarray | None
) -> Block:
    G = len(free) + (0 if basis is None else len(basis))
    intrinsics, R, t = block.intrinsics.copy(), block.R_CT.copy(), block.t_CT_m.copy()
    deformation = block.deformation.copy()
    if row < len(free):
        intrinsics[free[row]] += step
    elif row < G:
        deformation[row - len(free)] += step
    elif row < G + 3:
        delta = np.zeros((1, 3))
        delta[0, row - G] = step
        R[view] = rotation_exp(delta)[0] @ R[view]
    else:
        t[view, row - G - 3] += step
    return replace(block, intrinsics=intrinsics, R_CT=R, t_CT_m=t, deformation=deformation)


@pytest.mark.few(2, 9, 11)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", ["rigid", "warp"])
@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_gradients_agree_with_finite_differences(model: str, kind: str, seed: int) -> None:
    observations = _observations()
    basis = board_basis(observations.target_m[0], kind)
    free = free_intrinsics(model, skew=True)
    block = replace(_block(seed, 0 if basis is None else len(basis)), fisheye=model == FISHEYE)
    J = jacobian(block, observations, free, basis)
    assert J is not None
    for row in range(J.shape[1] - 1):
        name = INTRINSICS[free[row]] if row < len(free) else "other"
        step = 1e-3 if name.endswith("_px") else 1e-6
        for view in (0, 2):
            ahead = jacobian(_shifted(block, free, row, view, step, basis), observations, free, basis)
            behind = jacobian(_shifted(block, free, row, view, -step, basis), observations, free, basis)
            assert ahead is not None and behind is not None
            numeric = (ahead[view, -1] - behind[view, -1]) / (2 * step)
            scale = np.abs(J[view, row]).max() + 1.0
            np.testing.assert_allclose(J[view, row] / scale, numeric / scale, atol=2e-7)


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


@pytest.mark.parametrize("moved", [[], [[14.0, 13.0, -4.0, 3.0, 0.01, -0.02]]])
def test_blocks_equal_the_dense_inverse(moved: list[list[float]]) -> None:
    fit = calibrate(pack(views_of(6, 2, 0.2)), (640, 480), "radial2")
    found = covariance(fit, shifts=[np.array(shift) for shift in moved])
    dense = _dense_covariance(fit.normal, 6, fit.sigma_px**2)
    for shift in moved:
        # The poses follow the intrinsics as least squares has them do.
        poses = -np.linalg.solve(fit.normal[:, 6:, 6:], (fit.normal[:, 6:, :6] @ shift)[..., None])
        whole = np.concatenate([shift, poses.ravel()])
        dense += np.outer(whole, whole)
    np.testing.assert_allclose(found.intrinsics, dense[:6, :6], rtol=1e-7)
    # The common motion is the one that best explains the change of the poses.
    V, motion = fit.normal[:, 6:, 6:], np.zeros((6, 6, 6))
    motion[:, :3, :3] = motion[:, 3:, 3:] = np.eye(3)
    motion[:, 3:, :3] = [np.cross(t, np.eye(3)) for t in fit.block.t_CT_m]
    weighted = motion.transpose(0, 2, 1) @ V
    F = np.linalg.solve((weighted @ motion).sum(axis=0), weighted)
    by = np.zeros((12, len(dense)))
    by[:6, :6], by[6:, 6:] = np.eye(6), np.hstack(list(F))
    scale = np.sqrt(np.diag(found.joint))
    np.testing.assert_allclose(
        found.joint / scale / scale[:, None], by @ dense @ by.T / scale / scale[:, None], atol=1e-6
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


LENSES = {
    "pinhole": {},
    "radial2": {"k1": -0.25, "k2": 0.1},
    "brown5": {"k1": -0.25, "k2": 0.1, "p1": 0.004, "p2": -0.003, "k3": 0.0},
}


@pytest.mark.parametrize("truth", LENSES)
def test_the_true_lens_is_chosen(truth: str) -> None:
    lens = np.array([LENSES[truth].get(name, 0.0) for name in COEFFICIENTS])
    camera = Camera(truth, (640, 480), 530.0, 532.0, 0.0, 325.0, 236.0, lens)
    found = candidates_by_model(pack(views_of(18, 3, 0.2, camera=camera)), (640, 480))
    names = [candidate.name for candidate, _ in found]
    assert names == ["pinhole", "radial2", "radial3", "brown5", "rational8"]
    fitted = [candidate.fitted_rms_px for candidate, _ in found]
    assert all(b <= a * (1 + 1e-4) for a, b in pairwise(fitted[:4]))
    assert names[simplest_good([candidate for candidate, _ in found])] == truth


def _candidate(name: str, *view_px: float, soundness: int = 3) -> Candidate:
    squared = np.array(view_px) ** 2
    return Candidate(name, 4, float(view_px[0]), float(np.sqrt(squared.mean())), squared, soundness)


def test_one_view_does_not_hide_that_a_richer_model_is_better() -> None:
    simple, rich = [2.8] * 15 + [12.8], [0.09] * 15 + [0.14]
    assert simplest_good([_candidate("simple", *simple), _candidate("rich", *rich)]) == 1
    # Nor does a view that the richer model alone cannot explain, where it is far better for the others.
    assert simplest_good([_candidate("simple", *simple), _candidate("rich", *rich[:15], 15.0)]) == 1
    assert simplest_good([_candidate("simple", *[0.3] * 15), _candidate("rich", *[0.29] * 14, 3.0)]) == 0


def test_a_richer_model_needs_pixels_and_more_than_chance() -> None:
    rng = np.random.default_rng(0)
    noise = 0.2 * np.exp(0.1 * rng.standard_normal(20))
    assert simplest_good([_candidate("simple", *noise), _candidate("rich", *(noise - 1e-5))]) == 0
    assert simplest_good([_candidate("simple", *noise), _candidate("rich", *(noise - 5e-3))]) == 1
    # At 4000 pixels' width a fiftieth of a pixel counts.
    assert simplest_good([_candidate("simple", *noise), _candidate("rich", *(noise - 5e-4))], 4.0) == 0
    other = 0.2 * np.exp(0.1 * rng.standard_normal(20))
    assert simplest_good([_candidate("simple", *noise), _candidate("rich", *other)]) == 0
    # Three views tell little of chance; a fifth less is taken all the same.
    assert simplest_good([_candidate("simple", 0.3, 0.2, 0.4), _candidate("rich", 0.2, 0.19, 0.2)]) == 1
    assert simplest_good([_candidate("simple", 0.3, 0.2, 0.4), _candidate("rich", 0.3, 0.19, 0.39)]) == 0


def test_a_lens_that_folds_is_chosen_only_where_the_others_are_hopeless() -> None:
    folding = _candidate("radial3", *[0.1] * 12, soundness=1)
    assert chosen_lens([_candidate("radial2", *[0.25] * 12), folding]) == 0
    assert chosen_lens([_candidate("radial2", *[4.2] * 12), folding]) == 1
    assert chosen_lens([_candidate("radial2", *[4.2] * 12), replace(folding, soundness=0)]) == 0


def _equidistant(field_deg: float) -> Camera:
    """A lens that shows angles as lengths nearly, which no polynomial follows far."""
    return camera_of((640, 480), field_deg, (7 / 9, 64 / 945, 0, 0, 0, 10 / 9, 5 / 21), "rational8")


SIMULATED = {
    "pinhole": camera_of(lens=(), model="pinhole"),
    "radial2": camera_of(),
    "brown5": camera_of(lens=(-0.25, 0.1, 0.003, -0.002), model="brown5"),
    "rational8, 100 degrees": _equidistant(100.0),
    "rational8, 120 degrees": _equidistant(120.0),
}


def _chosen(found: Intrinsics) -> Candidate:
    return next(one for one in found.models if one.name == str(LensModel.of(found.calibration)))


@pytest.mark.slow
@pytest.mark.parametrize("bad", [0, 1, 2])
@pytest.mark.parametrize("name", SIMULATED)
def test_the_chosen_lens_is_nearly_the_best(name: str, bad: int) -> None:
    """Held-back RMS at most 1.2 times that of the best sound candidate, with up to two bad views."""
    camera, ratios = SIMULATED[name], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        noise = (0.05, 0.1, 0.3)[seed % 3]
        views = take(rng, camera, (8, 11, 16)[seed % 3] + bad, recipe=Recipe(noise_px=noise))
        for k in range(bad):
            spoil = SPOILS[list(SPOILS)[(seed + 3 * k) % len(SPOILS)]]
            views[k] = replace(views[k], pixels=spoil(views[k], camera, rng))
        found = calibrate_camera(views, camera.image_size_px)
        chosen = _chosen(found)
        best = min(one.held_back_rms_px for one in found.models if one.soundness >= chosen.soundness)
        ratios.append(chosen.held_back_rms_px / best)
    print(f"{name}, {bad} bad: {max(ratios):.2f}")
    assert max(ratios) <= 1.2


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["gloworm_qvga", "ocam_fish2", "opencv_left", "pv_charuco", "sks_charuco_left", "udacity_lane"]
)
def test_the_chosen_lens_is_nearly_the_best_for_real_pictures(name: str, shared_data: Path) -> None:
    told = Told(square_m=0.02) if name in ("pv_charuco", "sks_charuco_left") else Told()
    views = read_views([outside(shared_data / name)], told)
    found = calibrate_camera(views.views, views.image_size_px)
    chosen = _chosen(found)
    best = min(one.held_back_rms_px for one in found.models if one.soundness)
    assert chosen.held_back_rms_px <= 1.2 * best


@pytest.mark.few(1)
@pytest.mark.parametrize("skew_px", [0.0, 1.0])
@pytest.mark.parametrize("roll_deg", [5.0, pytest.param(180.0, marks=pytest.mark.slow)])
def test_a_skew_is_chosen_where_the_views_show_one(skew_px: float, roll_deg: float) -> None:
    camera = replace(camera_of(), skew_px=skew_px)
    views = take(np.random.default_rng(2), camera, 14, recipe=Recipe(roll_deg=roll_deg))
    found = calibrate_camera(views, (640, 480))
    assert LensModel.of(found.calibration) == LensModel("radial2", skew_px != 0.0)
    assert found.calibration.camera.skew_px == pytest.approx(skew_px, abs=0.3)
    assert [one.name for one in found.models if "skew" in one.name] == (
        [f"{name}, skew" for name in MODELS if name != FISHEYE] if skew_px else []
    )
    never = calibrate_camera(views, (640, 480), Choices(skew=False))
    assert never.calibration.camera.skew_px == 0.0
    forced = calibrate_camera(views, (640, 480), Choices(skew=True))
    assert "skew_px" in forced.calibration.free_names
    assert calibrate_camera(views, (640, 480), Choices("radial2")).calibration.camera.skew_px == 0.0


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [2, pytest.param(0, marks=pytest.mark.slow)])
def test_a_decentering_that_the_views_show_is_not_left_out(seed: int) -> None:
    """In no view does it stand out from the noise, and the centre of a radial lens is 3.5 deviations off."""
    camera = camera_of(lens=(-0.2, 0.1, 4e-4, -3e-4))
    views = take(np.random.default_rng(seed), camera, 14)
    fit = calibrate_camera(views, (640, 480)).calibration
    assert fit.camera.model == "brown5"
    sigma = by_the_views(fit).sigma()
    for name in ("cx_px", "cy_px"):
        assert abs(getattr(fit.camera, name) - getattr(camera, name)) < 2 * sigma[name]


def test_a_sheared_board_is_no_skew() -> None:
    target = np.array([[x, y] for y in range(5) for x in range(7)]) * 0.02
    sheared = target + np.outer(target[:, 1], [0.003, 0.0])
    views = take(np.random.default_rng(1), camera_of(), 14, sheared)
    fit = calibrate(pack([replace(view, target_m=target) for view in views]), (640, 480), "radial2")
    assert left_out(fit, "skew_px").shear_chi2 > 9.0
    found = calibrate_camera([replace(view, target_m=target) for view in views], (640, 480))
    assert "skew_px" not in found.calibration.free_names


def test_one_step_tells_the_skew_that_a_fit_finds() -> None:
    camera = replace(camera_of(), skew_px=0.8)
    observations = pack(take(np.random.default_rng(5), camera, 14))
    told = left_out(calibrate(observations, (640, 480), "radial2"), "skew_px")
    fit = calibrate(observations, (640, 480), "radial2", skew=True)
    sigma = covariance(fit).sigma()["skew_px"] * overdispersion(evidence(fit))
    assert np.sqrt(told.chi2) == pytest.approx(abs(fit.camera.skew_px) / sigma, rel=0.05)
    assert 0.05 < told.moved_px < 0.4


@pytest.mark.slow
def test_real_pictures_without_a_skew_get_none(shared_data: Path) -> None:
    views = read_views([outside(shared_data / "opencv_left")], Told())
    assert LensModel.of(calibrate_camera(views.views, views.image_size_px).calibration) == LensModel("brown5")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gloworm_qvga", "opencv_left", "pv_charuco", "udacity_lane"])
def test_halves_of_real_sets_differ_by_sigma(name: str, shared_data: Path) -> None:
    """Parameters from one half of the views and the other, over the sigma of their difference."""
    views = read_views([outside(shared_data / name)], Told(square_m=0.02) if name == "pv_charuco" else Told())
    whole = calibrate_camera(views.views, views.image_size_px).calibration
    observations, lens, z = whole.observations, LensModel.of(whole), []
    rng = np.random.default_rng(0)
    for _ in range(20):
        order = rng.permutation(observations.views)
        halves = [
            calibrate(observations.select(part), views.image_size_px, lens.model, skew=lens.skew)
            for part in np.array_split(order, 2)
        ]
        variance = [np.diag(by_the_views(half).intrinsics) for half in halves]
        apart = (halves[0].block.intrinsics - halves[1].block.intrinsics)[whole.free]
        z.append(apart / np.sqrt(variance[0] + variance[1]))
    assert np.mean(np.abs(z) < 2.0) > 0.8
    assert 0.5 < np.sqrt(np.median(np.square(z)) / 0.455) < 1.5


def _twin(seed: int) -> tuple[Camera, list[View]]:
    """A camera like that of the shipped pictures, with a skew of a pixel, and corners of ten renderings."""
    rng = np.random.default_rng([seed, 16])
    scale = rng.uniform(0.97, 1.05)
    camera = replace(
        SHIPPED,
        fx_px=SHIPPED.fx_px * scale,
        fy_px=SHIPPED.fy_px * scale * rng.uniform(0.997, 1.003),
        cx_px=SHIPPED.cx_px + rng.uniform(-4.0, 4.0),
        cy_px=SHIPPED.cy_px + rng.uniform(-4.0, 4.0),
        skew_px=float(rng.normal()),
        distortion=SHIPPED.distortion * rng.uniform(0.6, 1.1),
    )
    views = []
    for k in rng.permutation(17)[:10]:
        shot = shots()[k]
        pose = replace(shot.pose, t_m=shot.pose.t_m + rng.uniform(-0.008, 0.008, 3))
        light, sensor, noise = shot.light, shot.sensor, int(rng.integers(1 << 30))
        picture = render(camera, PrintedBoard(TWIN_BOARD), pose, light=light, sensor=sensor, seed=noise)
        seen = detect(picture, TWIN_BOARD.columns, TWIN_BOARD.rows)
        if seen is not None:
            views.append(View(f"{k:02d}", TWIN_BOARD.points_m(), seen.pixels, seen.refined))
    return camera, views


@pytest.mark.slow
def test_sigma_covers_the_truth_of_rendered_twins_with_skew() -> None:
    """|z| < 2 for 93 to 97 % of the parameters of 100 twins; prints it by parameter."""
    z: dict[str, list[float]] = {}
    for seed in range(100):
        camera, views = _twin(seed)
        found = calibrate_camera(views, camera.image_size_px)
        off = found.calibration.block.intrinsics - vector_from_camera(camera)
        for name, sigma in found.covariance.sigma().items():
            z.setdefault(name, []).append(float(off[INTRINSICS.index(name)] / sigma))
    inside = {name: float(np.mean(np.abs(values) < 2.0)) for name, values in z.items()}
    print({name: (len(values), round(inside[name], 2)) for name, values in z.items()})
    share = float(np.mean(np.abs(np.concatenate(list(z.values()))) < 2.0))
    print(f"|z| < 2 for {share:.1%}")
    assert 0.93 <= share <= 0.97


@pytest.mark.parametrize("truth", ["rigid", "warp", "released"])
def test_the_true_board_is_chosen(truth: str) -> None:
    views = views_of(16, 5)
    observations = pack(views)
    rng = np.random.default_rng(0)
    basis = board_basis(observations.target_m[0], truth)
    if basis is not None:
        weights = np.array([1.5e-3, -1e-3]) if truth == "warp" else 4e-4 * rng.standard_normal(len(basis))
        shape = np.tensordot(weights, basis, axes=1).T
        # Views of the deformed board: fit poses exactly, then project the displaced points.
        fit = calibrate(observations, (640, 480), "radial2")
        from calib.stages.camera.model import jacobian

        J = jacobian(fit.block, observations.displaced(shape), fit.free, None)
        assert J is not None
        observations = replace(
            observations, pixels=observations.pixels + J[:, -1].reshape(-1, 2, 54).transpose(0, 2, 1)
        )
    observations = replace(
        observations, pixels=observations.pixels + 0.1 * rng.standard_normal(observations.pixels.shape)
    )
    found = candidates_by_board(calibrate(observations, (640, 480), "radial2"))
    names = [candidate.name for candidate, _ in found]
    assert names == ["rigid", "warp", "released"]
    assert names[simplest_good([candidate for candidate, _ in found])] == truth


USUAL = Recipe()


def _fit(recipe: Recipe = USUAL, count: int = 14, seed: int = 0, model: str = "radial2") -> Calibration:
    views = take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)
    return calibrate(pack(views), (640, 480), model)


@pytest.mark.parametrize("views", [12, 80])
def test_a_better_minimum_is_adopted(views: int) -> None:
    fit = _fit(count=views)
    # Stopped early, far away.
    intrinsics = fit.block.intrinsics.copy()
    intrinsics[:2] *= 4.0
    lost = calibrate(
        fit.observations,
        (640, 480),
        "radial2",
        start=replace(fit.block, intrinsics=intrinsics, t_CT_m=fit.block.t_CT_m * [1, 1, 4]),
        max_iterations=2,
    )
    assert lost.squared_sum > 2 * fit.squared_sum
    assert best_of_starts(lost).squared_sum == pytest.approx(fit.squared_sum, rel=1e-6)


def test_the_rational_denominator_is_put_aside() -> None:
    fit = _fit(model="rational8")
    sturdy = conditioned(fit)
    assert sturdy.camera.model == "brown5"
    assert sturdy.squared_sum < 1.05 * fit.squared_sum
    assert np.isfinite(covariance(sturdy).sigma()["fx_px"])
    plain = _fit()
    assert conditioned(plain) is plain


def test_a_denominator_that_is_needed_is_held() -> None:
    lens = (0.4, -0.05, 0.0, 0.0, 0.0, 0.9, 0.15, 0.0)
    camera = camera_of((1280, 960), 100.0, lens, "rational8")
    views = take(np.random.default_rng(1), camera, 25, recipe=Recipe(noise_px=0.01))
    fit = calibrate(pack(views), (1280, 960), "rational8")
    simple = calibrate(pack(views), (1280, 960), "brown5")
    assert simple.squared_sum > 1.05 * fit.squared_sum
    sturdy = conditioned(fit)
    assert sturdy.camera == fit.camera
    assert sturdy.free_names == simple.free_names
    assert sturdy.normal.shape[1] == fit.normal.shape[1] - 3


def _shape(recipe: Recipe, seed: int = 0, count: int = 17) -> TargetShape:
    views = take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)
    found = target_shape(calibrate(pack(views), (640, 480), "radial2"))
    assert found is not None
    return found


@pytest.mark.parametrize("aspect", [0.95, 0.99, 1.0, 1.02])
def test_aspect_is_measured(aspect: float) -> None:
    found = _shape(Recipe(aspect=aspect))
    assert found.aspect == pytest.approx(aspect - 1, abs=max(4 * found.aspect_sigma, 0.05 * abs(aspect - 1)))
    assert found.aspect_sigma < 0.005


@pytest.mark.parametrize("bow_m", [-0.003, -0.0005, 0.001, 0.003])
def test_bow_is_measured(bow_m: float) -> None:
    found = _shape(Recipe(bow_m=bow_m))
    along_x = found.values[DEFORMATIONS.index("bow_x")]
    assert along_x == pytest.approx(bow_m, abs=4 * found.sigma[2] + 0.05 * abs(bow_m))
    assert found.bow_m == pytest.approx(abs(bow_m), rel=0.15)
    assert found.bow_significance > 4
    assert found.size_m == pytest.approx(0.12)


@pytest.mark.parametrize(("aspect", "roll_deg"), [(0.997, 20.0), (0.995, 3.0)])
def test_sigma_allows_for_squares_that_are_hardly_told_from_square_ones(
    aspect: float, roll_deg: float
) -> None:
    """Where boards are hardly turned they move fy by six to twelve deviations, which count once."""
    camera, away = camera_of(), []
    for seed in range(12):
        recipe = Recipe(0.08, aspect=aspect, roll_deg=roll_deg)
        views = take(np.random.default_rng(seed), camera, 15, recipe=recipe)
        fit = calibrate(pack(views), camera.image_size_px, "radial2")
        sigma = by_the_views(fit).sigma()
        away.append([abs(getattr(fit.camera, n) - getattr(camera, n)) / sigma[n] for n in ("fx_px", "fy_px")])
    assert np.max(away) < 3.0
    assert np.median(np.max(away, axis=1)) > 0.8


# ----------------------------------------------------------------------
# The fisheye lens.

WIDE = Camera(
    FISHEYE, (748, 480), 250.0, 252.0, 0.8, 370.0, 241.0, np.array([0.03, -0.01, 0, 0, 0.004, -0.001, 0, 0])
)


def _directions(count: int, most_deg: float, seed: int = 0) -> np.ndarray:
    """Directions (count, 3) evenly over angles from the axis, the axis itself among them."""
    theta = np.linspace(0.0, np.radians(most_deg), count)
    around = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, count)
    return np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1)


def test_a_fisheye_lens_is_opencvs() -> None:
    points = _directions(2000, 89.0) * 0.3
    lens = WIDE.distortion[[0, 1, 4, 5]]
    told, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), WIDE.K, lens, alpha=WIDE.skew_px / WIDE.fx_px
    )
    np.testing.assert_allclose(project(WIDE, points), told[:, 0], atol=1e-10)


def test_a_fisheye_lens_is_undone_as_far_as_its_curve_rises() -> None:
    directions = _directions(3000, 114.0)
    last, most = fold_angle(WIDE)
    assert np.radians(114.0) < last < np.radians(120.0)
    np.testing.assert_allclose(rays(WIDE, project(WIDE, directions)), directions, atol=1e-13)
    beyond = np.array([[WIDE.cx_px + 1.001 * most * WIDE.fx_px, WIDE.cy_px]])
    assert np.isnan(rays(WIDE, beyond)).all()
    ahead = directions[:, 2] > 1e-3
    found = undistort(WIDE, project(WIDE, directions))
    np.testing.assert_allclose(
        found[ahead], directions[ahead, :2] / directions[ahead, 2:], rtol=1e-9, atol=1e-12
    )
    assert np.isnan(found[directions[:, 2] < -1e-12]).all()


def test_gradients_of_a_fisheye_lens_agree_with_finite_differences_beside_and_behind_the_camera() -> None:
    points = _directions(40, 114.0) * 0.3
    everything = np.arange(len(INTRINSICS))
    views = Observations(("",), points[None], np.zeros((1, 40, 2)), np.ones((1, 40), dtype=np.bool_))
    here = Block(vector_from_camera(WIDE), np.eye(3)[None], np.zeros((1, 3)), np.zeros(0), fisheye=True)
    J = jacobian(here, views, everything, None)
    assert J is not None
    for row in range(len(INTRINSICS) + 6):
        step = 1e-3 if row < 5 else 1e-7
        ahead, behind = (
            jacobian(_shifted(here, everything, row, 0, sign * step, None), views, everything, None)
            for sign in (1.0, -1.0)
        )
        assert ahead is not None and behind is not None
        numeric = (ahead[0, -1] - behind[0, -1]) / (2 * step)
        np.testing.assert_allclose(J[0, row], numeric, atol=1e-6 * (1.0 + np.abs(numeric).max()))
    straight_behind = replace(views, target_m=views.target_m * [0.01, 0.01, -1.0])
    assert jacobian(here, straight_behind, everything, None) is None


def _of_150_degrees(seed: int, noise_px: float = 0.1, skew_px: float = 0.0, count: int = 12) -> list[View]:
    camera = replace(
        camera_of((748, 480), 150.0, (0.03, -0.01, 0.0, 0.0, 0.004, -0.001), FISHEYE), skew_px=skew_px
    )
    return take(np.random.default_rng(seed), camera, count, recipe=Recipe(noise_px=noise_px, spread=0.45))


@pytest.mark.parametrize("skew_px", [0.0, 1.5])
def test_a_lens_of_150_degrees_is_recovered_from_exact_views(skew_px: float) -> None:
    views = _of_150_degrees(3, 0.0, skew_px)
    fit = calibrate(pack(views), (748, 480), FISHEYE, skew=skew_px != 0.0)
    truth = camera_of((748, 480), 150.0, (0.03, -0.01, 0.0, 0.0, 0.004, -0.001), FISHEYE)
    assert fit.converged
    assert fit.rms_px < 1e-7
    assert fit.camera.skew_px == pytest.approx(skew_px, abs=1e-5)
    np.testing.assert_allclose(fit.camera.K[:2, 2], truth.K[:2, 2], atol=1e-4)
    np.testing.assert_allclose(fit.camera.distortion, truth.distortion, atol=1e-5)


@pytest.mark.slow
def test_sigma_covers_a_lens_of_150_degrees() -> None:
    truth = camera_of((748, 480), 150.0, (0.03, -0.01, 0.0, 0.0, 0.004, -0.001), FISHEYE)
    exact = _of_150_degrees(5, 0.0)
    rng = np.random.default_rng(6)
    z = []
    for _ in range(100):
        views = [replace(v, pixels=v.pixels + 0.1 * rng.standard_normal(v.pixels.shape)) for v in exact]
        fit = calibrate(pack(views), (748, 480), FISHEYE)
        off = (vector_from_camera(fit.camera) - vector_from_camera(truth))[fit.free]
        # Directions that are independent of each other.
        z.append(np.linalg.solve(np.linalg.cholesky(covariance(fit).intrinsics), off))
    assert 0.93 < np.mean(np.abs(z) < 2.0) < 0.97
    assert np.std(z) == pytest.approx(1.0, abs=0.07)


def test_a_fisheye_set_is_fitted_as_opencv_does_and_its_lens_is_chosen(shared_data: Path) -> None:
    views = read_views([outside(shared_data / "ocam_fish2")], Told())
    fit = calibrate(pack(views.views), views.image_size_px, FISHEYE)
    counted = [view.counted() for view in views.views]
    boards = [np.column_stack([target, np.zeros(len(target))])[None] for target, _ in counted]
    rms, K, lens, *_ = cv2.fisheye.calibrate(
        boards,
        [pixels[None] for _, pixels in counted],
        views.image_size_px,
        # OpenCV's own start fails an assertion of `InitExtrinsics` on some processors; from 200 to 270 px
        # all starts end here.
        np.array([[240.0, 0.0, 374.0], [0.0, 240.0, 240.0], [0.0, 0.0, 1.0]]),
        np.zeros((4, 1)),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-12),
    )
    assert fit.converged
    assert fit.rms_px <= rms * (1 + 1e-9)
    np.testing.assert_allclose(fit.camera.K, K, atol=1e-4)
    np.testing.assert_allclose(fit.camera.distortion[[0, 1, 4, 5]], lens[:, 0], atol=1e-5)
    found = calibrate_camera(views.views, views.image_size_px)
    assert found.calibration.camera.model == FISHEYE
    assert found.verdict.word == "ok"

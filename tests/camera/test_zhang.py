"""The closed form: exact on exact views, and a start in every case."""

from __future__ import annotations

import numpy as np
import pytest

from calib.camera.model import Camera
from calib.camera.views import View, pack
from calib.camera.zhang import (
    closed_form_intrinsics,
    homographies,
    initial_guess,
    poses_from_homographies,
    poses_with_camera,
)
from synthetic import BOARD, CAMERA, views_of

IDEAL = Camera("pinhole", (640, 480), 530.0, 545.0, 3.0, 325.0, 236.0)


def test_homographies_map_the_board_to_its_pixels() -> None:
    observations = pack(views_of(6, 1, camera=IDEAL))
    H = homographies(observations)
    points = np.concatenate([BOARD.points_m(), np.ones((54, 1))], axis=1)
    mapped = points @ H.transpose(0, 2, 1)
    np.testing.assert_allclose(mapped[..., :2] / mapped[..., 2:], observations.pixels, atol=1e-8)


@pytest.mark.parametrize(("unknowns", "views"), [("skew", 3), ("no skew", 2), ("centre", 1)])
def test_the_fewest_views_suffice(unknowns: str, views: int) -> None:
    skew = 3.0 if unknowns == "skew" else 0.0
    centre = (319.5, 239.5) if unknowns == "centre" else (325.0, 236.0)
    camera = Camera("pinhole", (640, 480), 530.0, 545.0, skew, *centre)
    H = homographies(pack(views_of(views, 4, camera=camera)))
    K = closed_form_intrinsics(H, (640, 480), unknowns)
    assert K is not None
    np.testing.assert_allclose(K, camera.K, rtol=1e-6, atol=1e-4)


def test_poses_put_the_board_in_front_and_upright() -> None:
    observations = pack(views_of(8, 3, camera=IDEAL))
    R, t = poses_from_homographies(IDEAL.K, homographies(observations))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert (np.linalg.det(R) > 0).all()
    assert (t[:, 2] > 0).all()
    points = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1)
    seen = points @ R.transpose(0, 2, 1) + t[:, None]
    projected = seen @ IDEAL.K.T
    np.testing.assert_allclose(projected[..., :2] / projected[..., 2:], observations.pixels, atol=1e-6)


def test_poses_through_a_known_lens() -> None:
    views = views_of(4, 5)
    R, t = poses_with_camera(CAMERA, pack(views))
    points = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1)
    from calib.camera.model import project

    np.testing.assert_allclose(
        project(CAMERA, points @ R.transpose(0, 2, 1) + t[:, None]), pack(views).pixels, atol=1e-6
    )


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-3])
def test_parallel_views_still_give_a_start(tilt: float) -> None:
    guess = initial_guess(pack(views_of(5, 2, 0.1, tilt_rad=tilt)), (640, 480), skew=True)
    assert np.isfinite(guess.K).all()
    assert guess.K[0, 0] > 0
    assert np.isfinite(guess.t_CT_m).all()


def test_one_view_gives_a_start() -> None:
    guess = initial_guess(pack(views_of(1, 2, 0.1)), (640, 480), skew=False)
    assert 100 < guess.K[0, 0] < 5000


def test_padding_changes_nothing() -> None:
    views = views_of(3, 6)
    short = [View(views[0].name, views[0].target_m[:20], views[0].pixels[:20]), *views[1:]]
    np.testing.assert_allclose(homographies(pack(short))[1:], homographies(pack(views))[1:], rtol=1e-9)

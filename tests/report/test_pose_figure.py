"""Poses in figures: the tilts and leans that are drawn are those of the boards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PathCollection

from calib.camera.bundle import Calibration, calibrate
from calib.camera.levenberg import rotation_exp
from calib.camera.views import pack
from calib.report.pose_figure import pose_figure
from calib.report.style import look
from synthetic import views_of


@pytest.fixture(scope="module")
def fit() -> Calibration:
    return calibrate(pack(views_of(4, noise_px=0.1)), (640, 480), "radial2")


def test_leans_and_tilts_are_those_of_the_poses(fit: Calibration) -> None:
    # Turned by 30 degrees about the camera's x axis the normal (0, 0, 1) goes to (0, -1/2, .87): upwards.
    turns = np.radians([[30.0, 0, 0], [0, 30.0, 0], [0, 0, 80.0], [0, 180.0 - 50.0, 0]])
    turned = replace(fit, block=replace(fit.block, R_CT=rotation_exp(turns)))
    with look():
        figure = pose_figure(turned)
    histogram = next(axes for axes in figure.axes if axes.get_title(loc="left") == "Tilt of the board")
    counts = {round(bar.get_x()): int(bar.get_height()) for bar in histogram.patches if bar.get_height()}
    assert counts == {0: 1, 30: 2, 50: 1}
    lean = next(axes for axes in figure.axes if axes.get_title(loc="left") == "Lean of each view")
    dots = next(artist for artist in lean.collections if isinstance(artist, PathCollection)).get_offsets()
    # The last board is seen from behind, its normal is taken towards the camera's side.
    np.testing.assert_allclose(dots, [[0, -30], [30, 0], [0, 0], [-50, 0]], atol=1e-9)
    assert lean.yaxis_inverted()


def test_boards_are_drawn_where_they_stood(fit: Calibration) -> None:
    with look():
        figure = pose_figure(fit)
    space = next(axes for axes in figure.axes if axes.name == "3d")
    low, high = np.array([space.get_xlim(), space.get_ylim(), space.get_zlim()]).T
    target = fit.observations.target_m[0]
    for R, t in zip(fit.block.R_CT, fit.block.t_CT_m, strict=True):
        x, y, z = (target @ R.T + t).T
        drawn = np.stack([x, z, -y], axis=1)
        assert np.all(drawn >= low)
        assert np.all(drawn <= high)
    assert low[1] < 0.0 < high[1], "the camera itself is in the scene"

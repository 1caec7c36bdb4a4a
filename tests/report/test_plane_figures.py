"""Figures of the plane: complete, repeatable, legible, and honest about what is not seen or not known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.core.arrays import FloatArray
from calib.stages.camera import plots as plane_figures
from calib.stages.camera.bundle import rotation_exp
from calib.stages.camera.model import Camera, View, project
from calib.stages.camera.plane import Plane, calibrate_plane
from calib.stages.camera.plots import write_plane_figures
from synthetic import CAMERA

WORKSPACE = (-0.06, 0.04, 0.06, 0.11)
R_CW = rotation_exp(np.array([[0.35, -0.2, 0.1]]))[0]
t_CW_m = np.array([0.0, -0.07, 0.25])


def plane_of(
    camera: Camera = CAMERA,
    names: tuple[str, ...] = ("plane01.png",),
    workspace_m: tuple[float, float, float, float] = WORKSPACE,
    covariance: FloatArray | None = None,
    points: int = 35,
    noise_px: float = 0.1,
) -> Plane:
    """A plane fitted to made-up pictures of a board that covers the workspace."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-0.058, 0.062, 7), np.linspace(0.03, 0.11, 5)), -1).reshape(-1, 2)
    world = grid[:: max(1, 35 // points)][:points] if points != 4 else grid[[0, 6, 28, 34]]
    seen = project(camera, world @ R_CW[:, :2].T + t_CW_m)
    views = [View(name, world, seen + noise_px * rng.standard_normal(seen.shape)) for name in names]
    return calibrate_plane(camera, covariance, views, workspace_m=workspace_m)


def _known() -> FloatArray:
    return np.diag([0.3, 0.3, 0.2, 0.2, 0.0, 1e-3, 1e-2, *np.zeros(6)]) ** 2


def _tiny() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, image_size_px=(316, 208), fx_px=270.0, fy_px=270.0, cx_px=160.0, cy_px=101.0)
    return camera, plane_of(camera, covariance=_known())


def _wide() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, image_size_px=(1920, 1080), fx_px=1500.0, fy_px=1500.0, cx_px=965.0, cy_px=533.0)
    return camera, plane_of(camera, names=("a$b$.png", "$\\frac{.png", "\u5199\u771f.png"))


def _ideal() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, model="pinhole", distortion=np.zeros(8))
    return camera, plane_of(camera, noise_px=0.0)


CASES = {
    "316x208": _tiny,
    "1920x1080, three pictures, odd names": _wide,
    "no distortion, no noise": _ideal,
    "part of the workspace seen": lambda: (
        CAMERA,
        plane_of(workspace_m=(-0.2, 0.0, 0.2, 0.3), covariance=_known()),
    ),
    "nothing of the workspace seen": lambda: (CAMERA, plane_of(workspace_m=(1.0, 1.0, 1.1, 1.1))),
    "upright workspace": lambda: (CAMERA, plane_of(workspace_m=(-0.01, 0.0, 0.02, 0.12))),
    "four corners": lambda: (CAMERA, plane_of(points=4, covariance=_known())),
    "twelve pictures": lambda: (CAMERA, plane_of(names=tuple(f"{k}.png" for k in range(12)))),
}


SLOW = pytest.mark.slow
QUICK = ("316x208", "nothing of the workspace seen")


@pytest.mark.parametrize("case", [c if c in QUICK else pytest.param(c, marks=SLOW) for c in CASES])
def test_all_figures_are_legible(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, plane = CASES[case]()
    with kept(monkeypatch, plane_figures) as figures:
        write_plane_figures(tmp_path, camera, plane)
    assert len(figures) == 3
    with plane_figures.look():
        for name, figure in figures.items():
            assert complaints(figure) == [], name


def _words(plane: Plane, monkeypatch: pytest.MonkeyPatch, folder: Path) -> dict[str, str]:
    with kept(monkeypatch, plane_figures) as figures:
        write_plane_figures(folder, CAMERA, plane)
    with plane_figures.look():
        return {
            name: " ".join(text.get_text().replace("\n", " ") for text in drawn_texts(figure))
            for name, figure in figures.items()
        }


def test_what_is_not_known_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = _words(plane_of(), monkeypatch, tmp_path)
    assert "covariance of the intrinsics is not known" in words["plane_sigma.png"]
    words = _words(plane_of(workspace_m=(1.0, 1.0, 1.1, 1.1)), monkeypatch, tmp_path)
    assert "No part of the workspace is in the picture" in words["plane_difference.png"]
    assert "verdict: poor" in words["plane_sigma.png"]

"""Which picture to take next: the one that takes most of the uncertainty away.

A candidate view adds its information S_c (its pose eliminated, `calib.camera.evidence`) to the sum S of
the views taken. What is left is measured by tr(R (S + S_c)^-1), where R is the mean information
of reference views that fill the whole picture: the expected squared error, in pixels, of explaining a
new view anywhere in the picture with this camera (optimal design, criterion V).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.bundle import Calibration
from calib.camera.coverage import target_box
from calib.camera.evidence import scaled_inverse
from calib.camera.model import project, undistort
from calib.camera.projection import Block, jacobian
from calib.camera.views import Observations

__all__ = ["Candidate", "best_next_view"]

_EDGES = {0: "right", 90: "bottom", 180: "left", 270: "top"}
_PLACES = (0.22, 0.5, 0.78)
_GRID = 6


@dataclass(frozen=True)
class Candidate:
    """A picture to take.

    Attributes
    ----------
    where : part of the picture, in words with a preposition.
    tilt_deg : angle between the board and the picture's plane.
    away : edge of the board (as the picture shows it) that leans away, or "" without tilt.
    span_share : diagonal of the board over the diagonal of the picture.
    remaining : root of the expected squared error after it over that before.
    """

    where: str
    tilt_deg: float
    away: str
    span_share: float
    remaining: float


def _words(column: int, row: int) -> str:
    across, down = ("left", "", "right")[column], ("top", "", "bottom")[row]
    if not across and not down:
        return "in the middle of the picture"
    if across and down:
        return f"in the {down} {across} corner of the picture"
    return f"at the {across or down} edge of the picture"


def _rotation(tilt: float, azimuth: float) -> FloatArray:
    """Tilt that takes the side in the direction `azimuth` (0 right, pi/2 down) away from the camera."""
    axis = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    S = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + np.sin(tilt) * S + (1 - np.cos(tilt)) * S @ S)


def best_next_view(calibration: Calibration, information: FloatArray) -> Candidate | None:
    """The most useful among about a hundred poses of the board that fit into the picture.

    Parameters
    ----------
    information : (G, G) sum of the views' information about the free intrinsics, pixels squared.
    """
    camera = calibration.camera
    width, height = camera.image_size_px
    box = target_box(calibration)
    extent = box.max(axis=0) - box.min(axis=0)
    across, along = np.meshgrid(np.linspace(-0.5, 0.5, _GRID), np.linspace(-0.5, 0.5, _GRID))
    target = np.stack([across.ravel() * extent[0], along.ravel() * extent[1], np.zeros(_GRID**2)], axis=1)
    diagonal = float(np.hypot(extent[0], extent[1]))
    rotations, translations, kinds = [], [], []
    for row, v in enumerate(_PLACES):
        for column, u in enumerate(_PLACES):
            ray = undistort(camera, np.array([u * (width - 1), v * (height - 1)]))
            if not np.all(np.isfinite(ray)):
                continue
            for span in (0.35, 0.6):
                distance = camera.fx_px * diagonal / (span * np.hypot(width, height))
                for azimuth in (None, 0, 90, 180, 270):
                    tilt = 0.0 if azimuth is None else 35.0
                    rotations.append(_rotation(np.radians(tilt), np.radians(azimuth or 0)))
                    translations.append(distance * np.array([ray[0], ray[1], 1.0]))
                    kinds.append((column, row, tilt, "" if azimuth is None else _EDGES[azimuth], span))
    if not kinds or not np.all(np.isfinite(information)):
        return None
    R, t = np.array(rotations), np.array(translations)
    points = target @ R.transpose(0, 2, 1) + t[:, None]
    ahead = points[..., 2].min(axis=1) > 0.05 * diagonal
    pixels = project(camera, np.where(ahead[:, None, None], points, [0.0, 0.0, 1.0]))
    inside = ((pixels > 0) & (pixels < [width - 1, height - 1])).all(axis=(1, 2))
    # A view half outside of the picture is no advice, except where no other fits.
    kept = np.flatnonzero(ahead & inside & np.isfinite(pixels).all(axis=(1, 2)))
    if len(kept) == 0:
        return None
    S = _information(calibration, target, R[kept], t[kept])
    if S is None:
        return None
    reference = S.mean(axis=0)
    # A direction that nothing has measured yet is held by a hundredth of one view.
    base = information + 0.01 * reference
    before = float(np.trace(reference @ scaled_inverse(base)))
    after = np.array([np.trace(reference @ scaled_inverse(base + added)) for added in S])
    best = int(np.argmin(after))
    column, row, tilt, away, span = kinds[kept[best]]
    return Candidate(
        _words(column, row), tilt, away, span, float(np.sqrt(max(after[best], 0.0) / max(before, 1e-300)))
    )


def _information(
    calibration: Calibration, target: FloatArray, R: FloatArray, t: FloatArray
) -> FloatArray | None:
    """Information (n, G, G) of made-up views of the target about the intrinsics."""
    n, M, P = len(R), len(target), len(calibration.free)
    made = Observations(("",) * n, target[None], np.zeros((n, M, 2)), np.ones((n, M), dtype=np.bool_))
    block = Block(calibration.block.intrinsics, R, t, np.zeros(0))
    J = jacobian(block, made, calibration.free, None)
    if J is None:
        return None
    # As many points as the target has in a view, spread as they are.
    share = calibration.observations.points / calibration.observations.views / M
    normal = share * (J[:, :-1] @ J[:, :-1].transpose(0, 2, 1))
    V, W = normal[:, P:, P:], normal[:, :P, P:]
    return np.asarray(normal[:, :P, :P] - W @ np.linalg.solve(V, W.transpose(0, 2, 1)))

"""The camera's constants: three homographies of one plane, the horizon, and the polynomial's macro."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from firmware_rigs import header, rig

from calib.core.errors import BadInputError
from calib.stages.camera.model import project, undistort
from calib.stages.firmware.constants import MIDDLE_M, camera_groups, plane_constants, put_right
from calib.stages.firmware.header import header_of, header_text
from calib.stages.firmware.literals import literals
from calib.twin.pictures import CAMERA, PLANE

WORKSPACE = (-0.06, 0.04, 0.06, 0.11)


def _A(scale: float = 1.0) -> np.ndarray:
    K = np.array([[CAMERA.fx_px, CAMERA.skew_px, CAMERA.cx_px], [0, CAMERA.fy_px, CAMERA.cy_px], [0, 0, 1]])
    R = np.array(PLANE.R_CW)
    return np.asarray(scale * K @ np.column_stack([R[:, 0], R[:, 1], PLANE.t_m]))


def _made(scale: float = 1.0):
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    return plane_constants(CAMERA, R, t, np.linalg.inv(_A(scale)), WORKSPACE, "ok")


def _points() -> tuple[np.ndarray, np.ndarray]:
    world = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 11), np.linspace(0.05, 0.1, 6)), axis=-1).reshape(
        -1, 2
    )
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    return world, project(CAMERA, world @ R[:, :2].T + t)


def _mapped(H: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = np.column_stack([points, np.ones(len(points))]) @ H.T
    return out[:, :2] / out[:, 2:], out[:, 2]


def test_both_ways_through_the_plane_find_the_world() -> None:
    made = _made()
    world, pixels = _points()
    found, W = _mapped(made.from_normalised, undistort(CAMERA, pixels))
    assert np.abs(found - world).max() < 1e-9
    # 1/s of (2.12) is the reciprocal depth.
    depth = (world @ np.array(PLANE.R_CW)[2, :2]) + PLANE.t_m[2]
    assert np.allclose(W * depth, 1.0)
    assert made.from_raw is not None
    raw, _ = _mapped(made.from_raw, pixels)
    assert 1e-5 < np.abs(raw - world).max() < 1.2 * made.raw_error_m


def test_an_alignments_shift_and_stretch_are_undone() -> None:
    """Places that the calibrated plane shows as the estimator's model of it does come out right."""
    from calib.stages.estimator.sensors import view_coefficients

    shift, stretch = (3e-4, -2e-4), 2e-3
    middle = view_coefficients(CAMERA, np.eye(3), np.zeros(3))[22:24]
    assert tuple(middle) == MIDDLE_M
    world, _ = _points()
    shown = world + np.array(shift) + stretch * (world - middle)
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    pixels = project(CAMERA, shown @ R[:, :2].T + t)
    right = put_right(_made(), shift, stretch)
    found, W = _mapped(right.from_normalised, undistort(CAMERA, pixels))
    assert np.abs(found - world).max() < 1e-9
    assert (W > 0.0).all()
    align = rig("full").align
    assert align is not None
    moved = align.model_copy(update={"plane_shift_m": list(shift), "plane_stretch": stretch})
    made = header_of(rig("full").model_copy(update={"align": moved}), "rig.yaml")
    assert made.camera.plane is not None
    plain = header("full").camera.plane
    assert plain is not None
    np.testing.assert_allclose(
        made.camera.plane.from_normalised, put_right(plain, shift, stretch).from_normalised, atol=1e-12
    )


@pytest.mark.parametrize("scale", [-3.0, 0.01, 100.0])
def test_the_scale_of_a_homography_does_not_matter(scale: float) -> None:
    """A homography is known up to a factor; the horizon's test needs it fixed, sign included."""
    assert np.allclose(_made(scale).from_normalised, _made().from_normalised)
    assert _made(scale).least == pytest.approx(_made().least)


def test_the_horizon_lies_beyond_the_workspace() -> None:
    made = _made()
    world, pixels = _points()
    assert made.from_raw is not None
    for H, points, least in (
        (made.from_normalised, undistort(CAMERA, pixels), made.least[0]),
        (made.from_raw, pixels, made.least[1]),
    ):
        assert 0.0 < least < 0.2 * _mapped(H, points)[1].min()
    assert len(world)


def test_a_workspace_behind_the_camera_is_refused() -> None:
    R, t = np.array(PLANE.R_CW), np.array([0.0, 0.0, -0.3])
    with pytest.raises(BadInputError, match="reaches behind the camera"):
        plane_constants(CAMERA, R, t, np.linalg.inv(_A()), WORKSPACE, "ok")


def test_without_the_workspace_in_sight_there_is_no_raw_plane() -> None:
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    small = replace(CAMERA, image_size_px=(20, 20))
    made = plane_constants(small, R, t, np.linalg.inv(_A()), WORKSPACE, "ok")
    assert made.from_raw is None
    groups = camera_groups(replace(header().camera, plane=made))
    names = literals(groups)
    assert names["CALIB_HAS_RAW_PLANE"] == "0"
    assert not any("PLANE_RAW_" in name for name in names if name != "CALIB_HAS_RAW_PLANE")


def test_a_camera_without_a_lens_needs_no_polynomial() -> None:
    section = rig().camera
    assert section is not None
    plain = section.model_copy(update={"model": "pinhole", "distortion": type(section.distortion)()})
    made = header_of(rig().model_copy(update={"camera": plain, "plane": None}), "rig.yaml")
    assert made.literals["CALIB_CAMERA_HAS_LENS"] == "0"
    assert re.search(r"#define CALIB_LENS_INVERSE_P\(r2\) 1\.0f ", header_text(made))


def test_a_poor_plane_says_so() -> None:
    plane = rig().plane
    assert plane is not None
    poor = rig().model_copy(update={"plane": plane.model_copy(update={"verdict": "poor"})})
    assert header_of(poor, "rig.yaml").literals["CALIB_PLANE_OK"] == "0"


def test_a_lens_that_firmware_cannot_undo_is_marked() -> None:
    section = rig().camera
    assert section is not None
    bent = section.model_copy(update={"distortion": section.distortion.model_copy(update={"k1": -50.0})})
    for camera, verdict, ok in ((section, "ok", "1"), (bent, "poor", "0")):
        made = header_of(rig().model_copy(update={"camera": camera, "plane": None}), "rig.yaml")
        assert (made.camera.verdict, made.literals["CALIB_CAMERA_OK"]) == (verdict, ok)

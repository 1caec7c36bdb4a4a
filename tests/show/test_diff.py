"""Two calibrations beside each other: what the sigma of their difference is worth, and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import browser_or_skip
from pages import EVIL

from calib.core.rig import Rig
from calib.show.diff import diff_page_text, write_diff_page
from calib.stages.camera.lens import far_difference_px, ideal_pixels, pixel_grid, projection_sigma_px
from calib.stages.camera.model import INTRINSICS, Camera, camera_from_vector, vector_from_camera

CAMERA = Camera(
    "radial2", (320, 240), 285.0, 284.0, 0.0, 163.0, 118.0, np.array([-0.22, 0.1, 0, 0, 0, 0, 0, 0.0])
)
ROOT = np.zeros((13, 13))
"""Of a covariance in which focal lengths, centre and lens hang together."""
for _name, _row in {
    "fx_px": [0.4, 0.0, 0.1], "fy_px": [0.38, 0.05, 0.1], "cx_px": [0.0, 0.3, 0.0], "cy_px": [0.0, 0.0, 0.3],
    "k1": [0.002, 0.001, 0.0], "k2": [-0.004, 0.002, 0.001],
}.items():  # fmt: skip
    ROOT[INTRINSICS.index(_name), :3] = _row


def test_differences_of_cameras_scatter_as_their_sigma_says() -> None:
    """Cameras drawn from a covariance differ by it, once the rotation that fits best is taken off."""
    rng = np.random.default_rng(5)
    pixels = pixel_grid(CAMERA.image_size_px, most=60).reshape(-1, 2)
    sigma = projection_sigma_px(CAMERA, ROOT @ ROOT.T, ideal_pixels(CAMERA, pixels))
    centre, square = vector_from_camera(CAMERA), np.zeros(len(pixels))
    for _ in range(120):
        drawn = [
            camera_from_vector("radial2", CAMERA.image_size_px, centre + ROOT @ rng.standard_normal(13))
            for _ in range(2)
        ]
        square += 0.5 * (far_difference_px(*drawn, pixels) ** 2).sum(axis=1) / 120
    ratio = np.sqrt(square / 2) / sigma
    # Near the middle hardly anything is left, so that there the second order shows.
    assert np.abs(np.quantile(ratio, [0.1, 0.9]) - 1.0).max() < 0.06


def test_a_turn_of_the_camera_is_no_difference() -> None:
    """A shift of the centre by a pixel is a turn but for what the lens and the corners make of it."""
    pixels = pixel_grid(CAMERA.image_size_px, most=200).reshape(-1, 2)
    shift = np.zeros(13)
    shift[INTRINSICS.index("cx_px")] = 1.0
    moved = camera_from_vector("radial2", CAMERA.image_size_px, vector_from_camera(CAMERA) + shift)
    assert np.abs(far_difference_px(CAMERA, CAMERA, pixels)).max() < 1e-9
    assert np.linalg.norm(far_difference_px(CAMERA, moved, pixels), axis=1).mean() < 0.35


def _rig(fx_px: float = 285.0, size: tuple[int, int] = (320, 240), shift_m: float = 0.0) -> Rig:
    K = np.array([[fx_px, 0, 163.0], [0, 284.0, 118.0], [0, 0, 1.0]])
    t = np.array([shift_m, -0.06, 0.27])
    A = K @ np.column_stack([np.eye(3)[:, :2], t])
    order = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2"]
    at = [INTRINSICS.index(name) for name in order]
    camera: dict[str, Any] = {
        "model": "radial2", "image_size_px": list(size), "fx_px": fx_px, "fy_px": 284.0, "cx_px": 163.0,
        "cy_px": 118.0, "distortion": {"k1": -0.22, "k2": 0.1}, "verdict": "ok", "views": 9,
        "sigma": {"fx_px": 0.4}, "simulated": True,
        "covariance": {"order": order, "values": (ROOT @ ROOT.T)[np.ix_(at, at)].tolist()},
    }  # fmt: skip
    plane = {
        "R_CW": np.eye(3).tolist(), "t_CW_m": t.tolist(), "A_px_per_m": A.tolist(), "verdict": "ok",
        "A_inverse": np.linalg.inv(A).tolist(), "rms_px": 0.01, "rms_mm": 0.01,
        "sigma_marker_mm": {"calibration_max": 0.01},
    }  # fmt: skip
    return Rig.of({"schema": 2, "camera": camera, "plane": plane}, "rig.yaml")


def test_the_page_shows_both_in_px_and_mm(tmp_path: Path) -> None:
    before, after = _rig(), _rig(fx_px=289.0, shift_m=1e-3)
    found, page = before.diff(after), tmp_path / "diff.html"
    write_diff_page(page, before, after, (EVIL, "b.yaml"), found)
    assert page.read_text() == diff_page_text(before, after, (EVIL, "b.yaml"), found)
    browser = browser_or_skip(tmp_path / "profile")
    try:
        browser.media(prefers_color_scheme="dark")
        browser.open(page, 390)
        browser.run("document.querySelectorAll('.chart').forEach((one) => one.scrollIntoView())")
        assert browser.run("document.documentElement.scrollWidth") <= 390
        assert browser.run("document.title") == "Two calibrations"
        words = browser.run("document.body.innerText")
        assert "more than their error bars" in words and "Simulated" in words
        assert "the sigma of the difference is at most 0.014 mm" in words
        assert browser.errors == []
    finally:
        browser.close()


def test_of_the_same_camera_no_rounding_is_mapped() -> None:
    before, after = _rig(), _rig()
    assert after.camera is not None
    after.camera.fx_px *= 1.0 + 1e-15
    text = diff_page_text(before, after, ("a", "b"), before.diff(after))
    assert text.count("no difference") == 3 and "up to 0 px elsewhere" in text and "read up to 0 mm" in text


@pytest.mark.parametrize("other", [_rig(size=(640, 480)), Rig(), _rig().with_sections({"plane": None})])
def test_what_cannot_be_compared_is_said(other: Rig) -> None:
    before = _rig()
    text = diff_page_text(before, other, ("a", "b"), before.diff(other))
    larger = other.camera is not None and other.camera.image_size_px[0] == 640
    assert ("differ in size: 320x240 and 640x480 px" in text) == larger
    plane = other.plane is not None and not larger
    assert text.count('<figure class="chart"') == (other.camera is not None) + plane

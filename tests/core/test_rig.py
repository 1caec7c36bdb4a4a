"""rig.yaml: round trips, the same bytes, sentences for what is wrong in it, and two of them side by side."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calib.core.errors import BadInputError
from calib.core.result import identity
from calib.core.rig import Rig, read_rig, rig_text, write_rig
from calib.show.diff import diff_rigs
from calib.stages.camera.section import Camera

CAMERA = Camera(
    model="radial2",
    image_size_px=[316, 208],
    fx_px=273.4,
    fy_px=272.6,
    cx_px=160.7,
    cy_px=101.9,
    sigma={"fx_px": 0.4, "fy_px": None},
    verdict="ok",
)


def test_round_trip_and_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write_rig(path, Rig(camera=CAMERA), {"camera": {"b.png": "2", "a.png": "1"}})
    first = path.read_bytes()
    again = read_rig(path)
    assert again.camera == CAMERA
    write_rig(path, again, {"camera": {"a.png": "1", "b.png": "2"}})
    assert path.read_bytes() == first
    assert identity(CAMERA) == identity(again.camera or CAMERA)


def test_sections_of_later_versions_survive(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("twin: {lever_m: [0.1, 0.2, 0.3]}\nfuture: {a: 1}\n")
    write_rig(path, read_rig(path).model_copy(update={"camera": CAMERA}), {})
    text = path.read_text()
    assert "lever_m: [0.1, 0.2, 0.3]" in text
    assert "future: {a: 1}" in text
    assert text.index("camera:") < text.index("twin:") < text.index("provenance:")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("fx_px: 273.4", "fx_px: 273px"), r"camera\.fx_px is '273px', expected a number"),
        (("fx_px: 273.4", "fx_mm: 3.0"), r"camera\.fx_px is missing"),
        (("[316, 208]", "[316]"), r"camera\.image_size_px"),
        (("fx_px: 273.4", "fx_px: 273e0"), r"camera\.fx_px is '273e0', expected a number \(without quotes"),
        (("[316, 208]", "[316, 208.0]"), r"camera\.image_size_px\.1 is 208\.0, expected a whole number"),
        (("verdict: ok", "verdict: 1"), r"camera\.verdict is 1, expected 'ok'"),
    ],
)
def test_wrong_values_name_file_key_value_and_what_was_expected(
    tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    path = tmp_path / "rig.yaml"
    text = rig_text(Rig(camera=CAMERA))
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(BadInputError, match=says) as caught:
        read_rig(path)
    assert "rig.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "compose.yaml"
    path.write_text("services: {web: {image: nginx}}\n")
    with pytest.raises(BadInputError, match=r"is not a rig\.yaml: it has 'services'"):
        read_rig(path)


def test_a_link_to_no_file_is_an_empty_rig(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").symlink_to("gone.yaml")
    assert read_rig(tmp_path / "rig.yaml") == Rig()


K = np.array([[273.4, 0.0, 160.7], [0.0, 272.6, 101.9], [0.0, 0.0, 1.0]])
T_M = np.array([0.004, -0.061, 0.272])


def _rig(path: Path, shift_m: float = 0.0, sigma_mm: float | None = 0.01, **camera: Any) -> Path:
    t = T_M + np.array([shift_m, 0.0, 0.0])
    A = K @ np.column_stack([np.eye(3)[:, :2], t])
    told: dict[str, Any] = {
        "camera": {
            "model": "radial2", "image_size_px": [316, 208], "fx_px": 273.4, "fy_px": 272.6, "cx_px": 160.7,
            "cy_px": 101.9, "distortion": {"k1": -0.22, "k2": 0.549}, "views": 17, "verdict": "ok",
            "sigma": {"fx_px": 0.03, "k1": 0.0003}, **camera,
        },
        "plane": {
            "R_CW": np.eye(3).tolist(), "t_CW_m": t.tolist(), "A_px_per_m": A.tolist(),
            "A_inverse": np.linalg.inv(A).tolist(), "rms_px": 0.01, "rms_mm": 0.01, "verdict": "ok",
            "sigma": {"tx_m": 1e-5}, "sigma_marker_mm": {"calibration_max": sigma_mm},
        },
        "geometry": {"workspace_m": [-0.05, 0.05, 0.05, 0.1]},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(told))
    return path


def test_a_rig_and_itself(tmp_path: Path) -> None:
    path = _rig(tmp_path / "a.yaml")
    found = diff_rigs(path, path)
    assert found.changes == () and not found.significant
    assert found.plane is not None and found.plane.largest_mm < 1e-6
    assert found.compared > 20


def test_difference_in_standard_deviations_of_both(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml")
    b = _rig(
        tmp_path / "b.yaml", fx_px=273.4 + 0.2, sigma={"fx_px": 0.04, "k1": 0.0003}, verdict="poor", views=9
    )
    found = diff_rigs(a, b)
    (change,) = found.changes
    assert change.name == "fx_px" and change.sigma == pytest.approx(0.05)
    assert change.sigmas == pytest.approx(4.0) and change.significant and found.significant
    assert found.verdicts == (("camera", "ok", "poor"),)


def test_shift_of_the_plane_is_read_in_millimetres(tmp_path: Path) -> None:
    found = diff_rigs(_rig(tmp_path / "a.yaml"), _rig(tmp_path / "b.yaml", shift_m=2e-4))
    plane = found.plane
    assert plane is not None
    assert plane.mean_mm == pytest.approx(0.2, rel=1e-6) and plane.largest_mm == pytest.approx(0.2, rel=1e-6)
    assert plane.sigma_mm == pytest.approx(math.hypot(0.01, 0.01)) and plane.significant


def test_without_error_bars_nothing_is_called_significant(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml", sigma_mm=None, sigma={})
    found = diff_rigs(a, _rig(tmp_path / "b.yaml", shift_m=1e-3, sigma_mm=None, sigma={}, fx_px=280.0))
    assert not found.significant
    assert found.plane is not None and found.plane.significant is None

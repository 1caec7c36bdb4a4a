"""rig.yaml: round trips, the same bytes, and sentences for what is wrong in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.core.errors import BadInputError
from calib.core.result import identity
from calib.core.rig import Rig, read_rig, rig_text, write_rig
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
        (
            ("fx_px: 273.4", "fx_px: -3.0"),
            r"camera\.fx_px is -3\.0, expected greater than or equal to 0\.001",
        ),
        (("fx_px: 273.4", "fx_px: .nan"), r"camera\.fx_px is nan"),
        (("fx_px: 273.4", "fx_mm: 3.0"), r"camera\.fx_px is missing"),
        (("verdict: ok", "verdict: fine"), r"camera\.verdict is 'fine'"),
        (("[316, 208]", "[316]"), r"camera\.image_size_px"),
        (("cx_px: 160.7", "cx_px: 160.7\n  colour: red"), r"camera\.colour is not a key"),
        (("camera:", "camera: 7\nother:"), r"camera is 7, expected keys with values"),
        (("fx_px: 273.4", "fx_px: 273e0"), r"camera\.fx_px is '273e0', expected a number \(without quotes"),
        (("[316, 208]", "[316, 208, 3]"), r"camera\.image_size_px is \[316, 208, 3\], expected 2 values"),
        (("[316, 208]", "[316, 208.0]"), r"camera\.image_size_px\.1 is 208\.0, expected a whole number"),
        (("cx_px: 160.7", "cx_px: 1.0e+300"), r"camera\.cx_px is 1e\+300, expected less than or equal to"),
        (("k3: 0.0", "k3: 0.1"), r"camera\.distortion\.k3 is 0\.1, but radial2 has no k3"),
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

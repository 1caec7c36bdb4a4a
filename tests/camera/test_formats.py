"""Cameras in other tools' files: bit-exact round trips, those tools' own readers, and refusals."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.stages.camera.formats import (
    from_kalibr,
    from_opencv,
    from_ros,
    matrix,
    read_storage,
    to_kalibr,
    to_opencv,
    to_ros,
)
from calib.stages.camera.model import COEFFICIENTS, MODELS, Camera

SIZE = (316, 208)
VALUES = {
    "k1": -0.2201,
    "k2": 1 / 3,
    "p1": 1e-5,
    "p2": -2.3e-17,
    "k3": 0.1,
    "k4": 5e-324,
    "k5": 1e-3,
    "k6": -1e-300,
}


def camera_of(model: str, skew_px: float = 0.0) -> Camera:
    used = [VALUES[name] if name in MODELS[model] else 0.0 for name in COEFFICIENTS]
    return Camera(model, SIZE, 273.1 / 3, 0.1 + 0.2, skew_px, 157.49999999999997, -1e-7, np.array(used))


def same(a: Camera, b: Camera) -> bool:
    """Equal to the last bit."""
    return replace(a, distortion=None) == replace(b, distortion=None) and np.array_equal(
        a.distortion, b.distortion
    )


@pytest.mark.parametrize("skew_px", [0.0, 1.7, -1e-9])
@pytest.mark.parametrize("model", MODELS)
def test_ros_and_opencv_round_trips_are_exact(model: str, skew_px: float) -> None:
    camera = camera_of(model, skew_px)
    assert same(from_ros(to_ros(camera)), camera)
    assert same(from_opencv(to_opencv(camera)), camera)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "fisheye4"])
def test_kalibr_round_trips_are_exact(model: str) -> None:
    camera = camera_of(model)
    assert same(from_kalibr(to_kalibr(camera)), camera)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-10, 10), min_size=8, max_size=8),
    st.lists(st.floats(1e-3, 1e5), min_size=5, max_size=5),
)
def test_round_trips_of_any_numbers(distortion: list[float], five: list[float]) -> None:
    camera = Camera("rational8", (4000, 3000), *five, np.array(distortion))
    for back in (from_ros(to_ros(camera)), from_opencv(to_opencv(camera))):
        assert same(replace(back, model="rational8"), camera)


def test_opencv_reads_its_file_and_projects_the_same() -> None:
    camera = camera_of("brown5")
    storage = cv2.FileStorage(to_opencv(camera), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert np.array_equal(storage.getNode("camera_matrix").mat(), camera.K)
    assert np.array_equal(storage.getNode("distortion_coefficients").mat().ravel(), camera.distortion[:5])
    assert int(storage.getNode("image_width").real()) == 316


def test_a_fisheye_lens_is_named_and_has_four_coefficients() -> None:
    camera = camera_of("fisheye4", 0.7)
    lens = [VALUES[name] for name in ("k1", "k2", "k3", "k4")]
    storage = cv2.FileStorage(to_opencv(camera), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert int(storage.getNode("fisheye_model").real()) == 1
    assert storage.getNode("distortion_coefficients").mat().ravel().tolist() == lens
    told = yaml.safe_load(to_ros(camera))
    assert told["distortion_model"] == "equidistant"
    assert told["distortion_coefficients"]["data"] == lens
    told = yaml.safe_load(to_kalibr(replace(camera, skew_px=0.0)))["cam0"]
    assert (told["camera_model"], told["distortion_model"]) == ("pinhole", "equidistant")
    assert told["distortion_coeffs"] == lens
    with pytest.raises(BadInputError, match="fisheye_model is 2, expected 0 or 1"):
        from_opencv(to_opencv(camera).replace("fisheye_model: 1", "fisheye_model: 2"))
    with pytest.raises(BadInputError, match="has 5 numbers, expected 4 of a fisheye lens"):
        from_opencv(
            to_opencv(camera_of("brown5")).replace("camera_matrix", "fisheye_model: 1\ncamera_matrix")
        )


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (camera_of("radial2", 0.5), "skew_px is 0.5 and a Kalibr camchain cannot express it"),
        (camera_of("radial3"), r"k3 is 0.1 and Kalibr's radtan"),
        (replace(camera_of("rational8"), distortion=np.array([0, 0, 0, 0, 0, 0, 0, 0.2])), "k6 is 0.2"),
    ],
)
def test_what_kalibr_cannot_hold_is_refused_by_name(camera: Camera, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        to_kalibr(camera)


ROS = """
image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [526.69, 0, 312.33, 0, 525.75, 246.23, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.0186, -0.0808, 6.7e-04, 1e-05, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [516.2, 0, 310.4, 0, 0, 514.0, 246.9, 0, 0, 0, 1, 0]
"""


def test_a_file_as_ros_writes_it() -> None:
    """Whole numbers, and exponents that YAML 1.1 takes for text."""
    for text in (ROS, "%YAML:1.0\n" + ROS):
        camera = from_ros(text)
        assert camera.model == "brown5"
        assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (526.69, 525.75, 312.33, 246.23)
        assert camera.distortion.tolist() == [0.0186, -0.0808, 6.7e-4, 1e-5, 0, 0, 0, 0]


MESSAGE = """
header:
  stamp: {secs: 0, nsecs: 0}
height: 480
width: 640
distortion_model: "rational_polynomial"
D: [1.1, 0.2, 0.001, 0.002, 0.03, 1.3, 0.4, 0.05, 0, 0, 0, 0, 0, 0]
K: [533.6, 0.0, 342.4, 0.0, 533.7, 234.2, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
binning_x: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: False}
---
"""


@pytest.mark.parametrize("lower", [False, True])
def test_a_message_as_ros_prints_it(lower: bool) -> None:
    text = MESSAGE
    for upper in "DKR":
        text = text.replace(f"\n{upper}:", f"\n{upper.lower()}:") if lower else text
    camera = from_ros(text + text.replace("640", "320"))
    assert camera.image_size_px == (640, 480)
    assert (camera.model, camera.fx_px, camera.cy_px) == ("rational8", 533.6, 234.2)
    assert camera.distortion.tolist() == [1.1, 0.2, 0.001, 0.002, 0.03, 1.3, 0.4, 0.05]
    with pytest.raises(BadInputError, match=r"holds s1 = 0\.1, which cannot be expressed"):
        from_ros(text.replace("0.05, 0,", "0.05, 0.1,"))


def test_names_of_the_sample_of_opencv_2() -> None:
    camera, text = camera_of("brown5"), to_opencv(camera_of("brown5"))
    for new, old in (
        ("image_width", "image_Width"),
        ("image_height", "image_Height"),
        ("camera_matrix", "Camera_Matrix"),
        ("distortion_coefficients", "Distortion_Coefficients"),
    ):
        text = text.replace(f"{new}:", f"{old}:")
    assert same(from_opencv(text), camera)


def test_files_of_opencv_with_more_coefficients() -> None:
    text = to_opencv(camera_of("rational8"))
    storage = cv2.FileStorage("a.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", 316)
    storage.write("image_height", 208)
    storage.write("camera_matrix", camera_of("pinhole").K)
    storage.write("distortion_coefficients", np.array([[0.1, 0.2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]))
    fourteen = storage.releaseAndGetString()
    assert from_opencv(fourteen).distortion.tolist() == [0.1, 0.2, 0, 0, 0, 0, 0, 0]
    assert from_opencv(text).model == "rational8"
    storage = cv2.FileStorage("a.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", 316)
    storage.write("image_height", 208)
    storage.write("camera_matrix", camera_of("pinhole").K)
    storage.write("distortion_coefficients", np.array([[0.1, 0.2, 0, 0, 0, 0, 0, 0, 0, 0.3, 0, 0]]))
    with pytest.raises(BadInputError, match=r"holds s2 = 0\.3, which cannot be expressed"):
        from_opencv(storage.releaseAndGetString())


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 640\n", "", "image_width is missing"),
        ("image_width: 640", "image_width: 0", "the image size is 0x480"),
        ("[526.69, 0, 312.33, 0,", "[526.69, 0, 312.33,", "camera_matrix.data has 8 numbers, expected 9"),
        ("[526.69, 0, 312.33, 0,", "[.nan, 0, 312.33, 0,", "camera_matrix.data contains nan"),
        ("camera_matrix:", "matrix:", "camera_matrix is missing"),
        ("image_width: 640", "image_width: [", r"line \d+: is not YAML"),
        ("camera_matrix:", "camera_matrix: !!opencv-matrix", "import it with calib import opencv"),
    ],
)
def test_wrong_ros_files_are_refused_by_key(old: str, new: str, words: str) -> None:
    assert old in ROS
    with pytest.raises(BadInputError, match=words):
        from_ros(ROS.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 316\n", "", "image_width is missing; the file has image_height, camera_matrix"),
        (" !!opencv-matrix", "", "camera_matrix is no !!opencv-matrix; .* with calib import ros"),
        ("camera_matrix:", "matrix:", "camera_matrix is missing"),
        ("image_width: 316", "fisheye_model: 1\nimage_width: 316", "fisheye"),
        ("rows: 5\n   cols: 1", "rows: 6\n   cols: 1", "not a matrix|has 6 numbers"),
        ("%YAML", "- 1\n%YAML", "not an OpenCV FileStorage"),
    ],
)
def test_wrong_opencv_files_are_refused_by_key(old: str, new: str, words: str) -> None:
    text = to_opencv(camera_of("brown5"))
    assert old in text
    with pytest.raises(BadInputError, match=words):
        from_opencv(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cam0:", "cam1:", "cam0 is missing from the camchain, which has cam1"),
        ("radtan", "fov", "cam0.distortion_model is 'fov', expected radtan, equidistant or none"),
        ("intrinsics: [", "intrinsics: [one, ", "cam0.intrinsics has 5 numbers, expected 4"),
        ("intrinsics:", "intrinsic:", "cam0.intrinsics is missing"),
    ],
)
def test_wrong_camchains_are_refused_by_key(old: str, new: str, words: str) -> None:
    text = to_kalibr(camera_of("radial2"))
    assert old in text
    with pytest.raises(BadInputError, match=words):
        from_kalibr(text.replace(old, new, 1))


FORMS = {
    "yaml": cv2.FILE_STORAGE_FORMAT_YAML,
    "xml": cv2.FILE_STORAGE_FORMAT_XML,
    "json": cv2.FILE_STORAGE_FORMAT_JSON,
}


def written(form: str, values: np.ndarray, how: int = cv2.FILE_STORAGE_WRITE) -> str:
    storage = cv2.FileStorage(f"camera.{form}", how | cv2.FILE_STORAGE_MEMORY | FORMS[form])
    storage.write("image_width", 640)
    storage.write("note", "a: <b> & 'c'")
    storage.write("share", -2.5e-7)
    storage.write("K", values)
    return str(storage.releaseAndGetString())


@pytest.mark.parametrize("how", [cv2.FILE_STORAGE_WRITE, cv2.FILE_STORAGE_WRITE_BASE64])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "kind",
    [
        "float64",
        "int16",
    ],
)
@pytest.mark.parametrize(
    "shape",
    [
        (3, 3),
        (40, 9),
    ],
)
def test_it_reads_what_opencv_writes(form: str, how: int, kind: str, shape: tuple[int, int]) -> None:
    values = (100.0 * np.random.default_rng(3).random(shape)).astype(kind)
    text = written(form, values, how)
    found = read_storage(text)
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert found["image_width"] == 640
    assert found["note"].strip('"') == "a: <b> & 'c'"
    assert float(found["share"]) == -2.5e-7
    read = matrix(found["K"])
    assert read is not None
    assert np.array_equal(read, storage.getNode("K").mat().astype(float))
    assert np.array_equal(read, values.astype(float))


YAML = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: {dt}\n   data: {data}\n"
NO_MATRIX = {
    "memory": {"rows": 100_000, "cols": 100_000},
    "negative": {"rows": -1, "cols": -9},
    "more": {"data": "[ 1., 2., 3., 4., 5. ]"},
    "channels": {"dt": "3d"},
    "fractions in integers": {"dt": "i", "data": "[ 1.5, 2, 3, 4 ]"},
    "truth": {"data": "[ 1, 2, 3, true ]"},
    "infinite": {"data": "[ 1, 2, 3, .inf ]"},
    "too short a base64": {"data": "!!binary MWQg"},
    "true rows": {"rows": "true", "cols": 4},
}


@pytest.mark.parametrize("name", NO_MATRIX)
def test_what_is_no_matrix(name: str) -> None:
    usual = {"rows": 2, "cols": 2, "dt": "d", "data": "[ 1., 2., 3., 4. ]"}
    good = matrix(read_storage(YAML.format(**usual))["K"])
    assert good is not None and good.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert matrix(read_storage(YAML.format(**(usual | NO_MATRIX[name])))["K"]) is None


ENTITIES = '<!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;">]>'
NO_STORAGE = {
    "nothing": "",
    "deep JSON": '{"a": ' * 50_000,
    "digits in JSON": '{"a": ' + "9" * 10_000 + "}",
    "entities": f'<?xml version="1.0"?>{ENTITIES}<opencv_storage><a>&c;</a></opencv_storage>',
    "another root": "<html><a>1</a></html>",
    "no end": "<opencv_storage><a>1</a>",
    "aliases": "a: &a [x, x, x, x, x, x, x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i > 1 else '*a'] * 9)}]\n" for i in range(1, 12)),
}


@pytest.mark.parametrize("name", NO_STORAGE)
def test_what_is_no_storage_is_refused_at_once(name: str) -> None:
    with pytest.raises(BadInputError, match="not an OpenCV FileStorage"):
        read_storage(NO_STORAGE[name])

"""Cameras in other tools' files: bit-exact round trips, those tools' own readers, and refusals."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.camera.formats import from_kalibr, from_opencv, from_ros, to_kalibr, to_opencv, to_ros
from calib.camera.model import COEFFICIENTS, MODELS, Camera
from calib.errors import BadInputError

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


@pytest.mark.parametrize("model", ["pinhole", "radial2"])
def test_kalibr_round_trips_are_exact(model: str) -> None:
    camera = camera_of(model)
    assert same(from_kalibr(to_kalibr(camera)), camera)


def test_kalibr_holds_decentering_without_k3() -> None:
    camera = camera_of("brown5")
    camera = replace(camera, distortion=np.where(np.arange(8) == 4, 0.0, camera.distortion))
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


def test_the_model_is_the_simplest_that_has_all_that_is_not_zero() -> None:
    for coefficients, model in (
        ({}, "pinhole"),
        ({"k2": 0.1}, "radial2"),
        ({"k1": 0.1, "k3": 0.1}, "radial3"),
        ({"p2": 0.1}, "brown5"),
        ({"k6": 0.1}, "rational8"),
    ):
        distortion = np.array([coefficients.get(name, 0.0) for name in COEFFICIENTS])
        camera = replace(camera_of("rational8"), distortion=distortion)
        assert from_ros(to_ros(camera)).model == model
        assert from_opencv(to_opencv(camera)).model == model


def test_opencv_reads_its_file_and_projects_the_same() -> None:
    camera = camera_of("brown5")
    storage = cv2.FileStorage(to_opencv(camera), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert np.array_equal(storage.getNode("camera_matrix").mat(), camera.K)
    assert np.array_equal(storage.getNode("distortion_coefficients").mat().ravel(), camera.distortion[:5])
    assert int(storage.getNode("image_width").real()) == 316


def test_ros_keys_are_those_of_camera_info() -> None:
    document = yaml.safe_load(to_ros(camera_of("brown5", 1.5), "left: cam"))
    assert document["image_width"] == 316
    assert document["image_height"] == 208
    assert document["camera_name"] == "left: cam"
    assert document["distortion_model"] == "plumb_bob"
    for key, rows, cols in (
        ("camera_matrix", 3, 3),
        ("distortion_coefficients", 1, 5),
        ("rectification_matrix", 3, 3),
        ("projection_matrix", 3, 4),
    ):
        assert (document[key]["rows"], document[key]["cols"]) == (rows, cols)
        assert len(document[key]["data"]) == rows * cols
    assert document["camera_matrix"]["data"][1] == 1.5
    rational = yaml.safe_load(to_ros(camera_of("rational8")))
    assert rational["distortion_model"] == "rational_polynomial"
    assert rational["distortion_coefficients"]["cols"] == 8


def test_kalibr_keys_are_those_of_a_camchain() -> None:
    document = yaml.safe_load(to_kalibr(camera_of("radial2"), "left"))["cam0"]
    assert document["camera_model"] == "pinhole"
    assert document["distortion_model"] == "radtan"
    assert document["distortion_coeffs"] == [VALUES["k1"], VALUES["k2"], 0.0, 0.0]
    assert document["resolution"] == [316, 208]
    assert document["rostopic"] == "/left/image_raw"


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
        ("image_width: 640", "image_width: wide", "image_width is 'wide', expected a whole number"),
        ("image_width: 640", "image_width: true", "expected a whole number"),
        ("image_width: 640", "image_width: 0", "the image size is 0x480"),
        ("plumb_bob", "equidistant", "distortion_model is 'equidistant', expected plumb_bob or rational"),
        ("plumb_bob", "rational_polynomial", "has 5 numbers, expected 8 for rational_polynomial"),
        ("[526.69, 0, 312.33, 0,", "[526.69, 0, 312.33,", "camera_matrix.data has 8 numbers, expected 9"),
        ("[526.69, 0, 312.33, 0,", "[fx, 0, 312.33, 0,", "camera_matrix.data contains 'fx'"),
        ("[526.69, 0, 312.33, 0,", "[.nan, 0, 312.33, 0,", "camera_matrix.data contains nan"),
        ("[526.69, 0, 312.33, 0,", "[-526.69, 0, 312.33, 0,", "camera_matrix is not an intrinsic matrix"),
        ("[526.69, 0, 312.33, 0,", "[526.69, 0, 312.33, 2,", "camera_matrix is not an intrinsic matrix"),
        ("camera_matrix:", "matrix:", "camera_matrix is missing"),
        ("data: [0.0186", "data: [[0.0186]", r"distortion_coefficients.data contains \[0.0186\]"),
        (
            "data: [0.0186, -0.0808, 6.7e-04, 1e-05, 0]",
            "data: none",
            "distortion_coefficients.data is 'none'",
        ),
        ("image_width: 640", "image_width: [", "not valid YAML at line"),
    ],
)
def test_wrong_ros_files_are_refused_by_key(old: str, new: str, words: str) -> None:
    assert old in ROS
    with pytest.raises(BadInputError, match=words):
        from_ros(ROS.replace(old, new, 1))


@pytest.mark.parametrize("text", ["", "hello", "- 1\n- 2\n", "a\0b", "{", "x" * 70000])
def test_text_of_another_kind_is_refused(text: str) -> None:
    for reader in (from_ros, from_opencv, from_kalibr):
        with pytest.raises(BadInputError):
            reader(text)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 316\n", "", "image_width is missing"),
        ("image_width: 316", "image_width: wide", "image_width is not a whole number"),
        ("camera_matrix:", "matrix:", "camera_matrix is missing"),
        ("distortion_coefficients:", "d:", "distortion_coefficients is missing"),
        ("image_width: 316", "fisheye_model: 1\nimage_width: 316", "fisheye"),
        ("rows: 3\n   cols: 3", "rows: 1\n   cols: 9", "camera_matrix is 1x9, expected 3x3"),
        ("rows: 5\n   cols: 1", "rows: 6\n   cols: 1", "not a matrix|has 6 numbers"),
        ("157.", ".Nan, 157.", "not a matrix"),
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
        ("camera_model: pinhole", "camera_model: omni", "cam0.camera_model is 'omni', expected pinhole"),
        ("radtan", "equidistant", "cam0.distortion_model is 'equidistant', expected radtan or none"),
        (
            "resolution: [316, 208]",
            "resolution: [316]",
            r"cam0.resolution is \[316\], expected two whole numbers",
        ),
        (
            "distortion_coeffs: [",
            "distortion_coeffs: [0.0, ",
            "cam0.distortion_coeffs has 5 numbers, expected 4",
        ),
        ("intrinsics: [", "intrinsics: [one, ", "cam0.intrinsics has 5 numbers, expected 4"),
        ("intrinsics: [9", "intrinsics: [-9", "cam0.intrinsics is not an intrinsic matrix"),
        ("intrinsics:", "intrinsic:", "cam0.intrinsics is missing"),
    ],
)
def test_wrong_camchains_are_refused_by_key(old: str, new: str, words: str) -> None:
    text = to_kalibr(camera_of("radial2"))
    assert old in text
    with pytest.raises(BadInputError, match=words):
        from_kalibr(text.replace(old, new, 1))


def test_a_camchain_without_distortion_and_with_more_cameras() -> None:
    text = to_kalibr(camera_of("pinhole")).replace("radtan", "none")
    assert same(from_kalibr(text), camera_of("pinhole"))
    both = text + to_kalibr(camera_of("radial2")).replace("cam0:", "cam1:")
    assert same(from_kalibr(both, "cam1"), camera_of("radial2"))

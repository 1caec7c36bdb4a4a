"""A camera in the files of other tools: ROS camera_info, OpenCV FileStorage, Kalibr camchain.

Numbers are written with enough digits to come back bit for bit. What a format cannot hold is refused
and named, never dropped: Kalibr's radtan has no k3 and no skew. ROS's files and OpenCV's have a place
for the skew in K, which OpenCV's own functions then ignore. None of them holds the name of our model;
on reading it is the simplest one that has all coefficients that are not zero.

All three count pixels from the centre of the top-left one and order the coefficients
k1, k2, p1, p2, k3, k4, k5, k6, as this project does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import yaml

from calib.arrays import FloatArray
from calib.boundedyaml import YamlProblem, load
from calib.camera.filestorage import matrix, read_storage
from calib.camera.model import COEFFICIENTS, MODELS, Camera
from calib.errors import BadInputError

__all__ = ["from_kalibr", "from_opencv", "from_ros", "to_kalibr", "to_opencv", "to_ros"]

_BROWN = len(MODELS["brown5"])
_BEYOND_RATIONAL = ("s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's thin prism and tilted sensor, which no model here has."""
_SKEW_LIMIT = 1e-12


def to_ros(camera: Camera, name: str = "camera") -> str:
    """ROS camera_info YAML (sensor_msgs/CameraInfo): plumb_bob, or rational_polynomial for rational8.

    The rectification is the identity and the projection matrix K, as for a single camera.
    """
    rational = bool(np.any(camera.distortion[_BROWN:]))
    coefficients = camera.distortion if rational else camera.distortion[:_BROWN]
    P = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": int(camera.image_size_px[0]),
        "image_height": int(camera.image_size_px[1]),
        "camera_name": name,
        "camera_matrix": _matrix(camera.K),
        "distortion_model": "rational_polynomial" if rational else "plumb_bob",
        "distortion_coefficients": _matrix(coefficients[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(P),
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


def from_ros(text: str) -> Camera:
    """Camera from a ROS camera_info YAML.

    The rectification and projection matrices say how pictures are to be rectified, not what the camera
    is, and are not read.

    Raises
    ------
    BadInputError
        Naming the key that is missing or wrong, or the distortion model that cannot be expressed.
    """
    document = _mapping(text)
    size = (_whole(document, "image_width"), _whole(document, "image_height"))
    model = document.get("distortion_model")
    lengths = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,)}
    if not isinstance(model, str) or model not in lengths:
        raise BadInputError(
            f"distortion_model is {_short(model)}, expected plumb_bob or rational_polynomial; no other can "
            "be "
            "expressed"
        )
    coefficients = _ros_matrix(document, "distortion_coefficients", None)
    if coefficients.size not in lengths[model]:
        raise BadInputError(
            f"distortion_coefficients.data has {coefficients.size} numbers, expected {lengths[model][-1]} "
            f"for {model}"
        )
    return _camera(
        size, _ros_matrix(document, "camera_matrix", (3, 3)), coefficients.ravel(), "camera_matrix"
    )


def to_opencv(camera: Camera) -> str:
    """OpenCV FileStorage YAML with the keys of OpenCV's calibration sample."""
    storage = cv2.FileStorage(
        "camera.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.write("image_width", int(camera.image_size_px[0]))
    storage.write("image_height", int(camera.image_size_px[1]))
    storage.write("camera_matrix", camera.K)
    used = len(COEFFICIENTS) if np.any(camera.distortion[_BROWN:]) else _BROWN
    storage.write("distortion_coefficients", camera.distortion[:used, None])
    return str(storage.releaseAndGetString())


def from_opencv(text: str) -> Camera:
    """Camera from an OpenCV FileStorage, YAML, XML or JSON, written by OpenCV's calibration samples.

    Raises
    ------
    BadInputError
        For text that is no FileStorage, a missing or wrong key, a fisheye model, or coefficients of
        OpenCV's thin-prism and tilted models that are not zero.
    """
    root = read_storage(text)
    fisheye = root.get("fisheye_model", 0)
    if not isinstance(fisheye, int | float) or fisheye != 0:
        raise BadInputError("fisheye_model is set, and a fisheye lens cannot be expressed")
    width, height = (_storage_whole(root, key) for key in ("image_width", "image_height"))
    K = _storage_matrix(root, "camera_matrix")
    coefficients = _storage_matrix(root, "distortion_coefficients").ravel()
    if K.shape != (3, 3):
        raise BadInputError(f"camera_matrix is {K.shape[0]}x{K.shape[1]}, expected 3x3")
    if coefficients.size not in (4, 5, 8, 12, 14):
        raise BadInputError(
            f"distortion_coefficients has {coefficients.size} numbers, expected 4, 5, 8, 12 or 14"
        )
    for name, value in zip(_BEYOND_RATIONAL, coefficients[len(COEFFICIENTS) :], strict=False):
        if value != 0.0:
            raise BadInputError(
                f"distortion_coefficients holds {name} = {value:g}, which cannot be expressed"
            )
    return _camera((width, height), K, coefficients[: len(COEFFICIENTS)], "camera_matrix")


def to_kalibr(camera: Camera, name: str = "cam0") -> str:
    """Kalibr camchain YAML with one pinhole-radtan camera.

    Raises
    ------
    BadInputError
        Naming the parameter that Kalibr's model lacks: skew, k3, k4, k5 or k6.
    """
    if camera.skew_px != 0.0:
        raise BadInputError(
            f"skew_px is {camera.skew_px:g} and a Kalibr camchain cannot express it; calibrate without skew"
        )
    for index, value in enumerate(camera.distortion.tolist()):
        if index >= 4 and value != 0.0:
            raise BadInputError(
                f"{COEFFICIENTS[index]} is {value:g} and Kalibr's radtan (k1, k2, p1, p2) cannot express it; "
                "calibrate with --model radial2"
            )
    numbers = [float(camera.fx_px), float(camera.fy_px), float(camera.cx_px), float(camera.cy_px)]
    document = {
        "cam0": {
            "cam_overlaps": [],
            "camera_model": "pinhole",
            "distortion_coeffs": [float(value) for value in camera.distortion[:4]],
            "distortion_model": "radtan",
            "intrinsics": numbers,
            "resolution": [int(size) for size in camera.image_size_px],
            "rostopic": f"/{name}/image_raw",
        }
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


def from_kalibr(text: str, entry: str = "cam0") -> Camera:
    """Camera `entry` of a Kalibr camchain YAML, pinhole with radtan or no distortion.

    Raises
    ------
    BadInputError
        Naming the key that is missing or wrong, or the model that cannot be expressed.
    """
    document = _mapping(text)
    if not isinstance(document.get(entry), dict):
        known = ", ".join(str(key)[:40] for key in list(document)[:5]) or "nothing"
        raise BadInputError(f"{entry} is missing from the camchain, which has {known}")
    camera = document[entry]
    if camera.get("camera_model") != "pinhole":
        raise BadInputError(
            f"{entry}.camera_model is {_short(camera.get('camera_model'))}, expected pinhole; no other can "
            "be "
            "expressed"
        )
    model = camera.get("distortion_model")
    if model not in ("radtan", "none"):
        raise BadInputError(
            f"{entry}.distortion_model is {_short(model)}, expected radtan or none; no other can be expressed"
        )
    fx, fy, cx, cy = _numbers(camera.get("intrinsics"), f"{entry}.intrinsics", 4)
    coefficients: list[float] = []
    if model == "radtan":
        coefficients = _numbers(camera.get("distortion_coeffs"), f"{entry}.distortion_coeffs", 4)
    size = camera.get("resolution")
    if not (isinstance(size, list) and len(size) == 2 and all(_is_whole(value) for value in size)):
        raise BadInputError(
            f"{entry}.resolution is {_short(size)}, expected two whole numbers [width, height]"
        )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return _camera((size[0], size[1]), K, np.array(coefficients), f"{entry}.intrinsics")


def _camera(size: tuple[int, int], K: FloatArray, coefficients: FloatArray, key: str) -> Camera:
    """The camera, after a look at K and at what it is made of."""
    if min(size) < 1:
        raise BadInputError(f"the image size is {size[0]}x{size[1]}, expected positive numbers")
    lower = [K[1, 0], K[2, 0], K[2, 1]]
    if np.abs(lower).max() > _SKEW_LIMIT or K[2, 2] != 1.0 or min(K[0, 0], K[1, 1]) <= 0.0:
        raise BadInputError(f"{key} is not an intrinsic matrix: [fx skew cx; 0 fy cy; 0 0 1] with fx, fy > 0")
    distortion = np.zeros(len(COEFFICIENTS))
    distortion[: len(coefficients)] = coefficients
    fx, skew, cx, fy, cy = (float(value) for value in (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]))
    return Camera(_simplest_model(distortion), size, fx, fy, skew, cx, cy, distortion)


def _simplest_model(distortion: FloatArray) -> str:
    used = {name for name, value in zip(COEFFICIENTS, distortion, strict=True) if value != 0.0}
    return next(model for model, names in MODELS.items() if used <= set(names))


def _matrix(values: FloatArray) -> dict[str, Any]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": [float(value) for value in values.ravel()]}


def _mapping(text: str) -> Mapping[str, Any]:
    # Some writers put OpenCV's directive, which is no YAML, on the first line.
    lines = text.split("\n", 1)
    if lines[0].startswith("%YAML:"):
        text = "\n" + (lines[1] if len(lines) > 1 else "")
    try:
        document = load(text)
    except YamlProblem as problem:
        where = "" if problem.line is None else f" at line {problem.line}"
        raise BadInputError(f"not valid YAML{where}: {problem.said}") from problem
    if not isinstance(document, dict):
        raise BadInputError(f"expected a YAML mapping, found {type(document).__name__}")
    return document


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _whole(document: Mapping[str, Any], key: str) -> int:
    value = document.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise BadInputError(
            f"{key} is missing" if value is None else f"{key} is {_short(value)}, expected a whole number"
        )
    return value


def _numbers(values: object, key: str, count: int | None) -> list[float]:
    """A list of finite numbers. YAML 1.1 reads 1e-05 as text, and yaml-cpp writes it like that."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise BadInputError(
            f"{key} is missing" if values is None else f"{key} is {_short(values)}, expected a list"
        )
    if count is not None and len(values) != count:
        raise BadInputError(f"{key} has {len(values)} numbers, expected {count}")
    numbers = []
    for value in values:
        try:
            number = float(value) if not isinstance(value, bool) else math.nan
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise BadInputError(f"{key} contains {_short(value)}, expected finite numbers")
        numbers.append(number)
    return numbers


def _ros_matrix(document: Mapping[str, Any], key: str, shape: tuple[int, int] | None) -> FloatArray:
    node = document.get(key)
    if not isinstance(node, dict):
        raise BadInputError(f"{key} is missing" if node is None else f"{key} has no rows, cols and data")
    rows, cols = _whole(node, "rows"), _whole(node, "cols")
    data = _numbers(node.get("data"), f"{key}.data", rows * cols)
    if shape is not None and (rows, cols) != shape:
        raise BadInputError(f"{key} is {rows}x{cols}, expected {shape[0]}x{shape[1]}")
    return np.array(data, dtype=np.float64).reshape(rows, cols)


def _storage_whole(root: Mapping[str, Any], key: str) -> int:
    value = root.get(key)
    if value is None:
        raise BadInputError(f"{key} is missing")
    if not _is_whole(value):
        raise BadInputError(f"{key} is not a whole number")
    return int(value)


def _storage_matrix(root: Mapping[str, Any], key: str) -> FloatArray:
    if root.get(key) is None:
        raise BadInputError(f"{key} is missing")
    values = matrix(root[key])
    if values is None:
        raise BadInputError(f"{key} is not a matrix of finite numbers")
    return values

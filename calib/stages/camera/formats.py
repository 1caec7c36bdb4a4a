"""A camera in the files of other tools: ROS camera_info, OpenCV FileStorage, Kalibr camchain."""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from calib.core.arrays import FloatArray
from calib.core.bounded_yaml import YamlProblem, load
from calib.core.errors import BadInputError
from calib.core.files import one_line, quoted
from calib.core.writing import Kind, holds
from calib.stages.camera.model import COEFFICIENTS, FISHEYE, MODELS, Camera

# ----------------------------------------------------------------------
# OpenCV's FileStorage, read without OpenCV: YAML, XML and JSON, as plain values and matrices.
#
# OpenCV's own reader (5.0) trusts its input: texts of some hundred bytes make it write beyond its memory,
# and a matrix takes the memory that its rows and columns ask for. Only what a camera needs is read here:
# mappings, numbers, texts, and matrices of one channel.
#
# Format: OpenCV 5 documentation, "File Input and Output using XML / YAML / JSON files", and files that
# OpenCV's writer makes.

MATRIX = "opencv-matrix"
"""Type of a matrix: a YAML tag, or the value of `_TYPE`."""

_TYPE = "type_id"
_MOST_NUMBERS = 10_000
_DEEPEST = 20
_HEADER_BYTES = 24
_BASE64 = "$base64$"
_TYPES = {"d": "<f8", "f": "<f4", "i": "<i4", "u": "u1", "c": "i1", "w": "<u2", "s": "<i2"}
_REFUSED = "not an OpenCV FileStorage (YAML, XML or JSON)"


def read_storage(text: str) -> Mapping[str, Any]:
    """Named values of a FileStorage; a matrix is a mapping whose `type_id` is `MATRIX`, see `matrix`.

    Raises `BadInputError` for text that is no FileStorage, or has no names.
    """
    start = text.lstrip()
    try:
        if start.startswith("<"):
            found = _xml(start)
        elif start.startswith("{"):
            found = json.loads(_unescaped(re.sub(r"(?m)^\s*//.*$", "", start)))
        else:
            found = _yaml(text)
    except (ElementTree.ParseError, YamlProblem, ValueError, RecursionError) as error:
        raise BadInputError(_REFUSED) from error
    if not isinstance(found, dict):
        raise BadInputError(_REFUSED)
    return found


def matrix(node: object) -> FloatArray | None:
    """A matrix (rows, cols) of finite numbers, None for all else."""
    if not isinstance(node, Mapping) or node.get(_TYPE) != MATRIX:
        return None
    rows, cols, kind = _count(node.get("rows")), _count(node.get("cols")), _TYPES.get(str(node.get("dt")))
    if kind is None or not 0 < rows * cols <= _MOST_NUMBERS:
        return None
    values = _values(node.get("data"), kind)
    if values is None or values.size != rows * cols or not np.isfinite(values).all():
        return None
    return values.reshape(rows, cols)


def _count(value: object) -> int:
    """A positive whole number, zero for all else."""
    return value if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0


def _values(data: object, kind: str) -> FloatArray | None:
    """Numbers of a matrix, of a list or of base64, None for all else."""
    if isinstance(data, bytes):
        return _binary(data, kind)
    if isinstance(data, str) and data.startswith(_BASE64):
        try:
            return _binary(base64.b64decode(data.removeprefix(_BASE64), validate=True), kind)
        except (binascii.Error, ValueError):
            return None
    if isinstance(data, int | float):
        # The one number of an element of XML.
        data = [data]
    if isinstance(data, str) or not isinstance(data, Sequence) or len(data) > _MOST_NUMBERS:
        return None
    numbers = [_number(value) for value in data]
    if kind in ("<f8", "<f4"):
        with np.errstate(over="ignore"):
            return np.array(numbers, dtype=kind).astype(np.float64)
    return (
        np.array(numbers) if all(value == int(value) for value in numbers if math.isfinite(value)) else None
    )


def _number(value: object) -> float:
    """A number, NaN for what is none. YAML 1.1 reads 1e-05 as text, and yaml-cpp writes it like that."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan


def _binary(raw: bytes, kind: str) -> FloatArray | None:
    """Numbers after the header that names their type, such as "1d" or "d"."""
    header, body = raw[:_HEADER_BYTES].decode("latin-1").split(), raw[_HEADER_BYTES:]
    letter = next(letter for letter, name in _TYPES.items() if name == kind)
    if header not in ([letter], [f"1{letter}"]) or len(body) % np.dtype(kind).itemsize:
        return None
    return np.frombuffer(body, dtype=kind).astype(np.float64)


def _yaml(text: str) -> object:
    return load(_unescaped(_without_directive(text)), _loader())


def _without_directive(text: str) -> str:
    """The same without OpenCV's directive in the first line, which with its colon is no YAML."""
    return re.sub(r"\A%YAML:[^\n]*", "", text)


def _unescaped(text: str) -> str:
    """The same with apostrophes plain, which OpenCV escapes and neither YAML nor JSON knows escaped."""
    return re.sub(r"(?<!\\)((?:\\\\)*)\\'", r"\1'", text)


@cache
def _loader() -> Any:
    """A safe loader that knows OpenCV's matrices."""
    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    made: Any = type("StorageLoader", (base,), {})

    def construct(loader: Any, node: Any) -> dict[Any, Any]:
        return {**loader.construct_mapping(node, deep=True), _TYPE: MATRIX}

    made.add_constructor(f"tag:yaml.org,2002:{MATRIX}", construct)
    return made


def _element(element: ElementTree.Element, depth: int = 0) -> object:
    """An element as nested values."""
    kind = element.get(_TYPE)
    if not len(element):
        return _leaf(element.text or "", kind)
    if depth >= _DEEPEST:
        raise ValueError("too deep")
    inner: dict[str, object] = {} if kind is None else {_TYPE: kind}
    for child in element:
        if child.tag in inner:
            raise ValueError("given twice")
        inner[child.tag] = _element(child, depth + 1)
    return inner


def _leaf(text: str, kind: str | None) -> object:
    """Text of an element: a number, a list of numbers, base64 or text."""
    if kind == "binary":
        return base64.b64decode("".join(text.split()), validate=True)
    words = text.split()
    if len(words) == 1 and re.fullmatch(r"[-+]?[0-9]{1,18}", words[0]):
        return int(words[0])
    if words and all(math.isfinite(_number(word)) for word in words[:2]):
        return [_number(word) for word in words] if len(words) > 1 else _number(words[0])
    return text.strip()


def _xml(text: str) -> object:
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        # Entities are the other way in which a small text becomes a large one.
        raise ValueError("has declarations")
    root = ElementTree.fromstring(text)
    return _element(root) if root.tag == "opencv_storage" else None


# ----------------------------------------------------------------------
# A camera in the files of other tools: ROS camera_info, OpenCV FileStorage, Kalibr camchain.
#
# Numbers are written with enough digits to come back bit for bit. What a format cannot hold is refused
# and named, never dropped: Kalibr's radtan has no k3 and no skew. ROS's files and OpenCV's have a place
# for the skew in K, which OpenCV's own functions then ignore. None of them holds the name of our model;
# on reading it is the simplest one that has all coefficients that are not zero. A fisheye lens is named:
# `equidistant` by ROS and Kalibr, `fisheye_model` by OpenCV's samples.
#
# All three count pixels from the centre of the top-left one and order the coefficients
# k1, k2, p1, p2, k3, k4, k5, k6, as this project does; a fisheye lens's are k1, k2, k3, k4.

_BROWN = len(MODELS["brown5"])
_BEYOND_RATIONAL = ("s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's thin prism and tilted sensor, which no model here has."""
_OLD_NAMES = {
    "image_Width": "image_width",
    "image_Height": "image_height",
    "Camera_Matrix": "camera_matrix",
    "Distortion_Coefficients": "distortion_coefficients",
}
"""Names that the calibration sample of OpenCV 2 writes, and those that later samples do."""
_SKEW_LIMIT = 1e-12
_FISHEYE = [COEFFICIENTS.index(name) for name in MODELS[FISHEYE]]
"""Places of the fisheye model's coefficients among `COEFFICIENTS`."""


_YAML = (".yaml", ".yml")
FILES = {
    "ros": Kind("a camera_info of ROS", _YAML, holds(b"camera_matrix:", b"distortion_model:")),
    "opencv": Kind("a FileStorage of OpenCV", _YAML, holds(b"%YAML", b"!!opencv-matrix")),
    "kalibr": Kind("a camchain of Kalibr", _YAML, holds(b"cam0:", b"camera_model:")),
}
"""Kinds of files by the names of the formats."""


def _coefficients(camera: Camera) -> FloatArray:
    """What a file holds: four of a fisheye lens, eight where the rational model needs them, else five."""
    if camera.fisheye:
        return camera.distortion[_FISHEYE]
    return camera.distortion if np.any(camera.distortion[_BROWN:]) else camera.distortion[:_BROWN]


def to_ros(camera: Camera, name: str = "camera") -> str:
    """ROS camera_info YAML (sensor_msgs/CameraInfo).

    plumb_bob, rational_polynomial for rational8, or equidistant for fisheye4.

    The rectification is the identity and the projection matrix K, as for a single camera.
    """
    coefficients = _coefficients(camera)
    model = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[len(coefficients)]
    P = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": int(camera.image_size_px[0]),
        "image_height": int(camera.image_size_px[1]),
        "camera_name": name,
        "camera_matrix": _matrix(camera.K),
        "distortion_model": model,
        "distortion_coefficients": _matrix(coefficients[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(P),
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


def from_ros(text: str) -> Camera:
    """Camera from a ROS camera_info YAML, or from the message as `ros2 topic echo` prints it.

    Of several messages the first is read. The rectification and projection matrices say how pictures are
    to be rectified, not what the camera is, and are not read; neither are binning and region of interest:
    a message's numbers are those of the full picture.

    Raises
    ------
    BadInputError
        Naming the key that is missing or wrong, or the distortion model that cannot be expressed.
    """
    document = _of_message(_mapping(_first_document(text)))
    size = (_whole(document, "image_width"), _whole(document, "image_height"))
    model = document.get("distortion_model")
    lengths = {"plumb_bob": (0, 4, 5), "rational_polynomial": (12, 14, 8), "equidistant": (4,)}
    if not isinstance(model, str) or model not in lengths:
        raise BadInputError(
            f"distortion_model is {quoted(model)}, expected plumb_bob, rational_polynomial or equidistant; "
            "no other can be expressed"
        )
    coefficients = _ros_matrix(document, "distortion_coefficients")
    if coefficients.size not in lengths[model]:
        raise BadInputError(
            f"distortion_coefficients.data has {coefficients.size} numbers, expected {lengths[model][-1]} "
            f"for {model}"
        )
    K = _ros_matrix(document, "camera_matrix")
    used = _rational(coefficients.ravel())
    return _camera(size, K, used, "camera_matrix", fisheye=model == "equidistant")


def _first_document(text: str) -> str:
    """Text up to the line `---`, which `rostopic echo` prints after each message."""
    begun = re.sub(r"\A---[ \t]*\n", "", _without_directive(text).lstrip())
    return re.split(r"(?m)^---[ \t]*$", begun, maxsplit=1)[0]


def _of_message(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """The keys of a camera_info file for those of a sensor_msgs/CameraInfo, which ROS 1 calls K and D."""
    K, D = (document.get(upper, document.get(upper.lower())) for upper in "KD")
    if not isinstance(K, list) or not isinstance(D, list):
        return document
    return {
        "image_width": document.get("width"),
        "image_height": document.get("height"),
        "distortion_model": document.get("distortion_model"),
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": D},
    }


def _rational(coefficients: FloatArray) -> FloatArray:
    """The first eight coefficients, if OpenCV's others are zero."""
    for name, value in zip(_BEYOND_RATIONAL, coefficients[len(COEFFICIENTS) :], strict=False):
        if value != 0.0:
            raise BadInputError(
                f"distortion_coefficients holds {name} = {value:g}, which cannot be expressed"
            )
    return coefficients[: len(COEFFICIENTS)]


def to_opencv(camera: Camera) -> str:
    """OpenCV FileStorage YAML with the keys of OpenCV's calibration sample."""
    storage = cv2.FileStorage(
        "camera.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    )
    storage.write("image_width", int(camera.image_size_px[0]))
    storage.write("image_height", int(camera.image_size_px[1]))
    storage.write("camera_matrix", camera.K)
    if camera.fisheye:
        storage.write("fisheye_model", 1)
    storage.write("distortion_coefficients", _coefficients(camera)[:, None])
    return str(storage.releaseAndGetString())


def from_opencv(text: str) -> Camera:
    """Camera from an OpenCV FileStorage, YAML, XML or JSON, written by OpenCV's calibration samples.

    Raises
    ------
    BadInputError
        For text that is no FileStorage, a missing or wrong key, or coefficients of OpenCV's thin-prism
        and tilted models that are not zero.
    """
    root = {_OLD_NAMES.get(name, name): value for name, value in read_storage(text).items()}
    fisheye = root.get("fisheye_model", 0)
    if fisheye not in (0, 1):
        raise BadInputError(f"fisheye_model is {quoted(fisheye)}, expected 0 or 1")
    width, height = (_whole(root, key) for key in ("image_width", "image_height"))
    K = _storage_matrix(root, "camera_matrix")
    coefficients = _storage_matrix(root, "distortion_coefficients").ravel()
    if coefficients.size not in ((4,) if fisheye else (4, 5, 8, 12, 14)):
        raise BadInputError(
            f"distortion_coefficients has {coefficients.size} numbers, expected "
            + ("4 of a fisheye lens" if fisheye else "4, 5, 8, 12 or 14")
        )
    used = _rational(coefficients)
    return _camera((width, height), K, used, "camera_matrix", fisheye=bool(fisheye))


def lost_skew_px(camera: Camera) -> float:
    """By how much OpenCV's functions, which ignore the skew of K, are off at the picture's border, px."""
    height = camera.image_size_px[1]
    rows = max(abs(camera.cy_px), abs(height - 1 - camera.cy_px))
    return abs(camera.skew_px) * rows / camera.fy_px


def to_kalibr(camera: Camera, name: str = "cam0") -> str:
    """Kalibr camchain YAML with one camera, pinhole-radtan or for fisheye4 pinhole-equi.

    Raises
    ------
    BadInputError
        Naming the parameter that Kalibr's model lacks: skew, k3, k4, k5 or k6.
    """
    if camera.skew_px != 0.0:
        raise BadInputError(
            f"skew_px is {camera.skew_px:g} and a Kalibr camchain cannot express it; calibrate with --no-skew"
        )
    coefficients = camera.distortion[_FISHEYE] if camera.fisheye else camera.distortion[:4]
    for index, value in enumerate(camera.distortion.tolist()):
        if index >= 4 and value != 0.0 and not camera.fisheye:
            raise BadInputError(
                f"{COEFFICIENTS[index]} is {value:g} and Kalibr's radtan (k1, k2, p1, p2) cannot express it; "
                "calibrate with --model radial2"
            )
    numbers = [float(camera.fx_px), float(camera.fy_px), float(camera.cx_px), float(camera.cy_px)]
    document = {
        "cam0": {
            "cam_overlaps": [],
            "camera_model": "pinhole",
            "distortion_coeffs": [float(value) for value in coefficients],
            "distortion_model": "equidistant" if camera.fisheye else "radtan",
            "intrinsics": numbers,
            "resolution": [int(size) for size in camera.image_size_px],
            "rostopic": f"/{name}/image_raw",
        }
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


def from_kalibr(text: str) -> Camera:
    """Camera cam0 of a Kalibr camchain YAML, pinhole with radtan, equidistant or no distortion.

    Raises
    ------
    BadInputError
        Naming the key that is missing or wrong, or the model that cannot be expressed.
    """
    document = _mapping(text)
    if not isinstance(document.get("cam0"), dict):
        known = ", ".join(str(key)[:40] for key in list(document)[:5]) or "nothing"
        raise BadInputError(f"cam0 is missing from the camchain, which has {known}")
    camera = document["cam0"]
    if camera.get("camera_model") != "pinhole":
        raise BadInputError(
            f"cam0.camera_model is {quoted(camera.get('camera_model'))}, expected pinhole; no other can "
            "be expressed"
        )
    model = camera.get("distortion_model")
    if model not in ("radtan", "equidistant", "none"):
        raise BadInputError(
            f"cam0.distortion_model is {quoted(model)}, expected radtan, equidistant or none; no other "
            "can be expressed"
        )
    fx, fy, cx, cy = _numbers(camera.get("intrinsics"), "cam0.intrinsics", 4)
    coefficients: list[float] = []
    if model != "none":
        coefficients = _numbers(camera.get("distortion_coeffs"), "cam0.distortion_coeffs", 4)
    size = camera.get("resolution")
    if not (isinstance(size, list) and len(size) == 2 and all(_count(value) for value in size)):
        raise BadInputError(f"cam0.resolution is {quoted(size)}, expected two whole numbers [width, height]")
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    key = "cam0.intrinsics"
    return _camera((size[0], size[1]), K, np.array(coefficients), key, fisheye=model == "equidistant")


def _camera(
    size: tuple[int, int], K: FloatArray, coefficients: FloatArray, key: str, *, fisheye: bool
) -> Camera:
    """The camera, after a look at K and at what it is made of."""
    if min(size) < 1:
        raise BadInputError(f"the image size is {size[0]}x{size[1]}, expected positive numbers")
    if K.shape != (3, 3):
        raise BadInputError(f"{key} is {K.shape[0]}x{K.shape[1]}, expected 3x3")
    lower = [K[1, 0], K[2, 0], K[2, 1]]
    if np.abs(lower).max() > _SKEW_LIMIT or K[2, 2] != 1.0 or min(K[0, 0], K[1, 1]) <= 0.0:
        raise BadInputError(f"{key} is not an intrinsic matrix: [fx skew cx; 0 fy cy; 0 0 1] with fx, fy > 0")
    distortion = np.zeros(len(COEFFICIENTS))
    distortion[_FISHEYE if fisheye else slice(len(coefficients))] = coefficients
    fx, skew, cx, fy, cy = (float(value) for value in (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]))
    model = FISHEYE if fisheye else _simplest_model(distortion)
    return Camera(model, size, fx, fy, skew, cx, cy, distortion)


def _simplest_model(distortion: FloatArray) -> str:
    used = {name for name, value in zip(COEFFICIENTS, distortion, strict=True) if value != 0.0}
    return next(model for model, names in MODELS.items() if model != FISHEYE and used <= set(names))


def _matrix(values: FloatArray) -> dict[str, Any]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": [float(value) for value in values.ravel()]}


def _mapping(text: str) -> Mapping[str, Any]:
    if "!!opencv-matrix" in text:
        raise BadInputError("is a FileStorage of OpenCV; import it with calib import opencv")
    try:
        document = load(_without_directive(text))
    except YamlProblem as problem:
        where = "" if problem.line is None else f"line {problem.line}: "
        raise BadInputError(f"{where}{problem.said}") from problem
    if not isinstance(document, dict):
        raise BadInputError(f"expected a YAML mapping, found {type(document).__name__}")
    return document


def _whole(document: Mapping[str, Any], key: str) -> int:
    value = document.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise BadInputError(
            _missing(key, document) if value is None else f"{key} is {quoted(value)}, expected a whole number"
        )
    return value


def _missing(key: str, document: Mapping[str, Any]) -> str:
    """That a key is missing, and the first of those that are there."""
    there = ", ".join(one_line(str(name))[:40] for name in list(document)[:5]) or "nothing"
    return f"{key} is missing; the file has {there}"


def _numbers(values: object, key: str, count: int) -> list[float]:
    """A list of finite numbers."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise BadInputError(
            f"{key} is missing" if values is None else f"{key} is {quoted(values)}, expected a list"
        )
    if len(values) != count:
        raise BadInputError(f"{key} has {len(values)} numbers, expected {count}")
    numbers = [_number(value) for value in values]
    for value, number in zip(values, numbers, strict=True):
        if not math.isfinite(number):
            raise BadInputError(f"{key} contains {quoted(value)}, expected finite numbers")
    return numbers


def _ros_matrix(document: Mapping[str, Any], key: str) -> FloatArray:
    node = document.get(key)
    if not isinstance(node, dict):
        raise BadInputError(_missing(key, document) if node is None else f"{key} has no rows, cols and data")
    rows, cols = _whole(node, "rows"), _whole(node, "cols")
    data = _numbers(node.get("data"), f"{key}.data", rows * cols)
    return np.array(data, dtype=np.float64).reshape(rows, cols)


def _storage_matrix(root: Mapping[str, Any], key: str) -> FloatArray:
    node = root.get(key)
    if node is None:
        raise BadInputError(_missing(key, root))
    values = matrix(node)
    if values is None and isinstance(node, dict) and _TYPE not in node:
        raise BadInputError(f"{key} is no !!opencv-matrix; import a camera_info of ROS with calib import ros")
    if values is None:
        raise BadInputError(f"{key} is not a matrix of finite numbers")
    return values

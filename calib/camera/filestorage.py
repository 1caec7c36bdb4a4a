"""OpenCV's FileStorage, read without OpenCV: YAML, XML and JSON, as plain values and matrices.

OpenCV's own reader (5.0) trusts its input: texts of some hundred bytes make it write beyond its memory,
and a matrix takes the memory that its rows and columns ask for. Only what a camera needs is read here:
mappings, numbers, texts, and matrices of one channel.

Format: OpenCV 5 documentation, "File Input and Output using XML / YAML / JSON files", and files that
OpenCV's writer makes.
"""

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

import numpy as np

from calib.arrays import FloatArray
from calib.boundedyaml import MAX_NODES, YamlProblem, expands_beyond, load
from calib.errors import BadInputError

__all__ = ["MATRIX", "matrix", "read_storage"]

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
    if not isinstance(found, dict) or expands_beyond(found, MAX_NODES):
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
    """A number, NaN for what is none. YAML 1.1 takes some exponents for text."""
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
    # OpenCV's directive with its colon is no YAML.
    text = re.sub(r"\A%YAML:[0-9.]+[^\n]*", "", text)
    return load(_unescaped(text), (MATRIX, "binary"), _loader())


def _unescaped(text: str) -> str:
    """The same with apostrophes plain, which OpenCV escapes and neither YAML nor JSON knows escaped."""
    return re.sub(r"(?<!\\)((?:\\\\)*)\\'", r"\1'", text)


@cache
def _loader() -> Any:
    """A safe loader that knows OpenCV's matrices."""
    import yaml

    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    made: Any = type("StorageLoader", (base,), {})

    def construct(loader: Any, node: Any) -> dict[Any, Any]:
        return {**loader.construct_mapping(node, deep=True), _TYPE: MATRIX}

    made.add_constructor(f"tag:yaml.org,2002:{MATRIX}", construct)
    return made


class _Tree:
    """Elements as nested values, with a bound on their depth."""

    def __init__(self) -> None:
        self.root: object = None
        self._open: list[tuple[str, dict[str, str], dict[str, object], list[str]]] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= _DEEPEST:
            raise ValueError("too deep")
        self._open.append((tag, attributes, {}, []))

    def data(self, text: str) -> None:
        if self._open:
            self._open[-1][3].append(text)

    def end(self, _: str) -> None:
        tag, attributes, inner, texts = self._open.pop()
        value: object = _leaf("".join(texts), attributes)
        if inner:
            value = {**inner, **({_TYPE: attributes[_TYPE]} if _TYPE in attributes else {})}
        if not self._open:
            self.root = (tag, value)
        elif tag in self._open[-1][2]:
            raise ValueError("given twice")
        else:
            self._open[-1][2][tag] = value

    def close(self) -> object:
        return self.root


def _leaf(text: str, attributes: dict[str, str]) -> object:
    """Text of an element: a number, a list of numbers, base64 or text."""
    if attributes.get(_TYPE) == "binary":
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
    parser = ElementTree.XMLParser(target=_Tree())
    parser.feed(text)
    tag, value = parser.close() or ("", None)
    return value if tag == "opencv_storage" else None

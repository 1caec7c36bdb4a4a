"""FileStorage without OpenCV: the same values as OpenCV's own reader, and what makes that one fall."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.camera.filestorage import matrix, read_storage
from calib.errors import BadInputError

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
@pytest.mark.parametrize("kind", ["float64", "float32", "int32", "uint8", "int8", "uint16", "int16"])
@pytest.mark.parametrize("shape", [(3, 3), (5, 1), (1, 14), (1, 1), (40, 9)])
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
    "overflow": {"rows": 65536, "cols": 65536},
    "negative": {"rows": -1, "cols": -9},
    "fewer": {"data": "[ 1., 2. ]"},
    "more": {"data": "[ 1., 2., 3., 4., 5. ]"},
    "channels": {"dt": "3d"},
    "unknown type": {"dt": "q"},
    "fractions in integers": {"dt": "i", "data": "[ 1.5, 2, 3, 4 ]"},
    "text": {"data": "[ 1, 2, 3, four ]"},
    "truth": {"data": "[ 1, 2, 3, true ]"},
    "infinite": {"data": "[ 1, 2, 3, .inf ]"},
    "large for a float": {"dt": "f", "data": "[ 1, 2, 3, 1.0e+300 ]"},
    "too short a base64": {"data": "!!binary MWQg"},
    "no numbers": {"data": "{a: 1}"},
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
    "a list": "- 1\n",
    "deep JSON": '{"a": ' * 50_000,
    "deep lists": '{"a": ' + "[" * 100_000,
    "digits in JSON": '{"a": ' + "9" * 10_000 + "}",
    "deep XML": "<opencv_storage>" + "<a>" * 50_000,
    "entities": f'<?xml version="1.0"?>{ENTITIES}<opencv_storage><a>&c;</a></opencv_storage>',
    "another root": "<html><a>1</a></html>",
    "twice": "<opencv_storage><a>1</a><a>2</a></opencv_storage>",
    "no end": "<opencv_storage><a>1</a>",
    "base64 that is none": "<opencv_storage><a type_id='binary'>%%%</a></opencv_storage>",
    "aliases": "a: &a [x, x, x, x, x, x, x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i > 1 else '*a'] * 9)}]\n" for i in range(1, 12)),
}


@pytest.mark.parametrize("name", NO_STORAGE)
def test_what_is_no_storage_is_refused_at_once(name: str) -> None:
    with pytest.raises(BadInputError, match="not an OpenCV FileStorage"):
        read_storage(NO_STORAGE[name])

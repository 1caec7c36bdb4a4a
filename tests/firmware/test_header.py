"""Literals, escapes and compilers: the header says what rig.yaml says, and nothing else."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.camera.undistortion import InversePolynomial
from calib.errors import BadInputError
from calib.firmware.header import camera_constants, comment_text, float_literal, header_text

WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Wfloat-conversion"]
WARNINGS += ["-Wundef", "-Wshadow", "-Werror"]

NOTHING = InversePolynomial((), 0.0, 0.0, 0, 0.0, 1.0, 0.01)


def _header(inputs: dict[str, str] | None = None) -> str:
    camera = camera_constants(
        (316, 208),
        "radial2",
        "ok",
        {
            "fx_px": 273.4,
            "fy_px": 272.6,
            "skew_px": 0.0,
            "cx_px": 160.7,
            "cy_px": 101.9,
            "k1": -0.22,
            "k2": 0.55,
        },
        InversePolynomial((0.22, -0.4, 0.1), 0.0, 0.0, 0, 0.004, 1.0, 0.01),
        np.array([[1e-3, 2e-5, -0.1], [-2e-5, 1e-3, -0.05], [1e-5, 3e-5, 3.4]]),
        "ok",
    )
    return header_text(camera, {"view01.png": "ab" * 32} if inputs is None else inputs)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_literals_read_back_bit_for_bit(value: float) -> None:
    literal = float_literal(value, "x")
    assert re.fullmatch(r"-?\d+\.\d+(e[+-]\d+)?f", literal)
    assert struct.pack("f", np.float32(literal[:-1])) == struct.pack("f", np.float32(value))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e39, 1e-40, 5e-324])
def test_what_a_float_cannot_hold_is_refused_by_name(value: float) -> None:
    with pytest.raises(BadInputError, match=r"camera\.k1"):
        float_literal(value, "camera.k1")


@given(st.text())
def test_no_text_leaves_its_comment(text: str) -> None:
    safe = comment_text(text)
    assert "*/" not in safe
    assert "/*" not in safe
    assert "??" not in safe
    assert "\\" not in safe
    assert "\n" not in safe
    assert safe.isascii()


def test_same_values_same_bytes_and_another_id_for_others() -> None:
    assert _header() == _header()
    camera = camera_constants((316, 208), "pinhole", "poor", {"fx_px": 1.0}, NOTHING, None, "")
    assert "#define CALIB_HAS_PLANE 0" in header_text(camera, {})
    assert re.search(r"CALIB_ID 0x[0-9A-F]{8}UL", _header())
    assert header_text(camera, {}).split("CALIB_ID")[1][:14] != _header().split("CALIB_ID")[1][:14]


def _compilers() -> list[tuple[str, list[str]]]:
    return [
        ("gcc", ["-std=c99", "-x", "c"]),
        ("gcc", ["-std=c17", "-x", "c"]),
        ("g++", ["-std=c++11", "-x", "c++"]),
        ("g++", ["-std=c++20", "-x", "c++"]),
        ("clang", ["-std=c11", "-x", "c"]),
        ("avr-gcc", ["-std=c11", "-mmcu=atmega328p", "-x", "c"]),
    ]


def _need(tool: str) -> None:
    if shutil.which(tool) is None:
        if os.environ.get("CI"):
            pytest.fail(f"{tool} is not installed")
        pytest.skip(f"{tool} is not installed")


HOSTILE = {"*/ int x; /*": "1", "??/\n#error": "2", 'quote".png': "3", "ünï\u202e.png": "4", "\\": "5"}


@pytest.mark.parametrize(("compiler", "flags"), _compilers(), ids=lambda v: v if isinstance(v, str) else v[0])
def test_every_constant_compiles_to_the_bits_of_numpy(
    tmp_path: Path, compiler: str, flags: list[str]
) -> None:
    _need(compiler)
    text = _header(HOSTILE)
    (tmp_path / "calib_constants.h").write_text(text)
    names = re.findall(r"#define (CALIB_\w+) (-?\d+\.\d+(?:e[+-]\d+)?)f", text)
    assert len(names) == 7 + 3 + 9
    body = ",\n".join(name for name, _ in names)
    declared = '#include "calib_constants.h"\nextern const float values[];\n'
    (tmp_path / "values.c").write_text(f"{declared}const float values[] = {{\n{body}\n}};\n")
    compiled = subprocess.run(
        [compiler, *flags, *WARNINGS, "-c", "values.c", "-o", "values.o"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert compiled.returncode == 0, compiled.stderr
    wanted = np.array([value for _, value in names], dtype=np.float32).tobytes()
    assert wanted in (tmp_path / "values.o").read_bytes()


def test_another_schema_does_not_compile(tmp_path: Path) -> None:
    _need("gcc")
    (tmp_path / "calib_constants.h").write_text(_header())
    (tmp_path / "a.c").write_text('#define CALIB_EXPECT_SCHEMA 99\n#include "calib_constants.h"\n')
    compiled = subprocess.run(["gcc", "-c", "a.c"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert compiled.returncode != 0
    assert "another schema" in compiled.stderr

"""Literals and escapes: what stands in a header is what a compiler reads, and text stays text."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.stages.firmware.literals import (
    Constant,
    Group,
    Table,
    Whole,
    comment_text,
    float_literal,
    literals,
    values,
)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_literals_read_back_bit_for_bit(value: float) -> None:
    literal = float_literal(value, "x")
    assert re.fullmatch(r"-?\d+\.\d+(e[+-]\d+)?f", literal)
    assert struct.pack("f", np.float32(literal[:-1])) == struct.pack("f", np.float32(value) + np.float32(0.0))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e39, 1e-40, 5e-324])
def test_what_a_float_cannot_hold_is_refused_by_name(value: float) -> None:
    with pytest.raises(BadInputError, match=r"camera\.k1"):
        float_literal(value, "camera.k1")


def test_zero_has_no_sign() -> None:
    assert float_literal(-0.0, "x") == "0.0f"


@given(st.text())
def test_no_text_leaves_its_comment(text: str) -> None:
    safe = comment_text(text)
    assert "*/" not in safe
    assert "/*" not in safe
    assert "??" not in safe
    assert "\\" not in safe
    assert "\n" not in safe
    assert safe.isascii()


def test_values_are_what_a_compiler_reads() -> None:
    items = (Constant("A", 0.1, ""), Whole("N", 3, ""), Table("t", (0.2, -1.5), ""))
    found = values(literals((Group(("",), items),)))
    assert found == {"A": float(np.float32(0.1)), "N": 3.0, "t[0]": float(np.float32(0.2)), "t[1]": -1.5}


def test_an_entry_of_a_table_is_refused_by_its_place() -> None:
    group = Group(("",), (Table("t", (1.0, float("nan")), ""),))
    with pytest.raises(BadInputError, match=r"t\[1\] is nan"):
        literals((group,))

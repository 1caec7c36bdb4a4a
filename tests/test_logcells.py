"""The compiled scanner against Python's own `float`, cell by cell."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib.logcells import POWERS, scan


def _scan(text: str, columns: int) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    raw = np.frombuffer(text.encode(), dtype=np.uint8)
    rows = text.count("\n")
    values, lines = np.empty((rows, columns)), np.empty(rows, dtype=np.int64)
    odd = np.empty((text.count(",") + rows + 1, 4), dtype=np.int64)
    slots = np.arange(columns, dtype=np.int64)
    n, _, strange = scan(raw, slots, POWERS, values, lines, odd)
    return values[:n], lines[:n], odd[:strange].tolist()


def _bits(value: float) -> bytes:
    return struct.pack("<d", value)


@settings(deadline=None)  # the first call compiles
@given(
    st.floats(allow_nan=False, allow_infinity=False, width=64), st.sampled_from(["r", ".9g", ".6f", ".3e"])
)
@example(-0.0, "r")
@example(9007199254740993.0, "r")
@example(5e-324, "r")
def test_what_it_reads_has_the_bits_of_float(value: float, form: str) -> None:
    text = repr(value) if form == "r" else format(value, form)
    values, _, odd = _scan(f"{text},1\n", 2)
    if odd:
        # Left to the caller, whole and in its place.
        assert [odd[0][0], odd[0][1], text] == [0, 0, f"{text},1\n"[odd[0][2] : odd[0][3]]]
    else:
        assert _bits(values[0, 0]) == _bits(float(text))
    assert values[0, 1] == 1.0


@pytest.mark.parametrize(
    "text", ["0.1", "161", "-9.79076", "1e-05", "+2.5E+3", ".5", "7.", " 12.5 ", "\t3", "123456.789012"]
)
def test_ordinary_numbers_are_not_left_to_the_caller(text: str) -> None:
    values, _, odd = _scan(f"{text}\n", 1)
    assert odd == []
    assert _bits(values[0, 0]) == _bits(float(text))


@pytest.mark.parametrize(
    "text",
    ["abc", "1 2", "-", "+", ".", "1e", "1e+", "0x10", "1_000", "--1", "1.2.3", "nan", "inf", "1" * 30],
)
def test_anything_else_is(text: str) -> None:
    line = f"1,{text}\n"
    values, _, odd = _scan(line, 2)
    assert [(row, slot, line[start:end]) for row, slot, start, end in odd] == [(0, 1, text)]
    assert math.isnan(values[0, 1])


@settings(deadline=None)  # the first call compiles
@given(
    st.lists(
        st.lists(st.sampled_from(["", " ", "1", "-2.5"]), min_size=3, max_size=3), min_size=1, max_size=20
    )
)
def test_blank_cells_are_nan_and_blank_lines_no_rows(rows: list[list[str]]) -> None:
    text = "".join(",".join(row) + ("\r\n" if i % 2 else "\n\n") for i, row in enumerate(rows))
    values, lines, odd = _scan(text, 3)
    expected = np.array([[float(c) if c.strip() else math.nan for c in row] for row in rows])
    assert odd == []
    assert np.array_equal(values, expected, equal_nan=True)
    assert all(
        text.split("\n")[line].rstrip("\r") == ",".join(row) for line, row in zip(lines, rows, strict=True)
    )


def test_lines_with_quotes_or_another_number_of_cells_are_left_as_a_whole() -> None:
    lines = ["1,2,3", '4,"5",6', "7,8", "1,2,3,4", "# a, comment", "abc,1,2"]
    text = "\n".join(lines) + "\n"
    _, numbers, odd = _scan(text, 3)
    assert [(row, slot, text[a:b]) for row, slot, a, b in odd] == [
        (1, -1, lines[1]),
        (2, -1, lines[2]),
        (3, -1, lines[3]),
        (4, 0, "abc"),
    ]
    assert numbers.tolist() == [0, 1, 2, 3, 5]


def test_columns_that_are_not_wanted_are_passed_over_whatever_they_say() -> None:
    raw = np.frombuffer(b"note,1\n\xff\xfe text,2\n", dtype=np.uint8)
    values, lines, odd = np.empty((2, 1)), np.empty(2, dtype=np.int64), np.empty((5, 4), dtype=np.int64)
    n, passed, strange = scan(raw, np.array([-1, 0]), POWERS, values, lines, odd)
    assert (n, passed, strange) == (2, 2, 0)
    assert values.tolist() == [[1.0], [2.0]]


@settings(deadline=None)  # the first call compiles
@given(st.binary(max_size=200))
def test_no_bytes_are_too_strange(data: bytes) -> None:
    raw = np.frombuffer(data + b"\n", dtype=np.uint8)
    most = int(np.count_nonzero(raw == 10))
    cells = int(np.count_nonzero(raw == 44)) + most + 1
    values, lines = np.empty((most, 2)), np.empty(most, dtype=np.int64)
    odd = np.empty((cells, 4), dtype=np.int64)
    n, passed, strange = scan(raw, np.array([0, 1]), POWERS, values, lines, odd)
    assert n <= most == passed
    assert strange <= cells

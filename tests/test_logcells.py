"""The compiled scanner against Python's own `float`, cell by cell."""

from __future__ import annotations

import math
import struct

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib.io.cells import POWERS, scan


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

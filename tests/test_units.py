"""Quantities with units, and what is said of wrong ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import UsageError
from calib.core.units import parse_corners, parse_duration_s, parse_length_m, plain_number


@pytest.mark.parametrize(
    ("text", "metres"), [("20mm", 0.02), ("2 cm", 0.02), ("0.02m", 0.02), ("1in", 0.0254), ("2e1mm", 0.02)]
)
def test_lengths(text: str, metres: float) -> None:
    assert parse_length_m(text, "--square") == pytest.approx(metres, rel=1e-15)


@pytest.mark.parametrize("text", ["20", "mm", "-20mm", "0mm", "20px", "nan mm", "1e999mm", "", "20 mm mm"])
def test_wrong_lengths_name_the_option(text: str) -> None:
    with pytest.raises(UsageError, match="--square"):
        parse_length_m(text, "--square")


@pytest.mark.parametrize(
    ("text", "seconds"), [("10s", 10.0), ("500 ms", 0.5), ("2min", 120.0), ("1.5h", 5400.0)]
)
def test_durations(text: str, seconds: float) -> None:
    assert parse_duration_s(text, "--duration") == pytest.approx(seconds, rel=1e-15)
    with pytest.raises(UsageError, match="--duration"):
        parse_duration_s(f"-{text}", "--duration")


@given(st.integers(3, 200), st.integers(3, 200), st.sampled_from(["x", "X", ",", " x "]))
def test_corners(columns: int, rows: int, by: str) -> None:
    assert parse_corners(f"{columns}{by}{rows}") == (columns, rows)


@pytest.mark.parametrize("text", ["7", "7x", "2x9", "7.5x5", "7x5x3", "999x999", "x", "7 5"])
def test_wrong_corners(text: str) -> None:
    with pytest.raises(UsageError, match="--corners"):
        parse_corners(text)


@pytest.mark.parametrize(("word", "value"), [("1.5", 1.5), ("-2e-3", -2e-3), ("inf", math.inf), (".5", 0.5)])
def test_plain_number_reads_decimals(word: str, value: float) -> None:
    assert plain_number(word) == value


@pytest.mark.parametrize("word", ["", "1_000", "1,5", "0x10", "one", "1 2"])
def test_plain_number_takes_no_other_words(word: str) -> None:
    assert plain_number(word) is None

"""Quantities with units, and what is said of wrong ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.errors import UsageError
from calib.units import (
    parse_angle_rad,
    parse_corners,
    parse_duration_s,
    parse_frequency_hz,
    parse_image_size,
    parse_jitter,
    parse_length_m,
    parse_region_px,
    parse_square_m,
    plain_number,
)


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


def test_other_quantities() -> None:
    assert parse_frequency_hz("1.5kHz", "--rate") == 1500.0
    assert parse_angle_rad("180deg", "--angle") == pytest.approx(math.pi)
    assert parse_image_size("640x480") == (640, 480)
    with pytest.raises(UsageError):
        parse_frequency_hz("0Hz", "--rate")
    with pytest.raises(UsageError):
        parse_image_size("0x480")


@given(st.integers(3, 200), st.integers(3, 200), st.sampled_from(["x", "X", ",", " x "]))
def test_corners(columns: int, rows: int, by: str) -> None:
    assert parse_corners(f"{columns}{by}{rows}") == (columns, rows)


@pytest.mark.parametrize("text", ["7", "7x", "2x9", "7.5x5", "7x5x3", "999x999", "x", "7 5"])
def test_wrong_corners(text: str) -> None:
    with pytest.raises(UsageError, match="--corners"):
        parse_corners(text)


def test_jitter_in_millimetres_or_pixels() -> None:
    assert parse_jitter("0.1mm") == (pytest.approx(1e-4), "m")
    assert parse_jitter("0.3 px") == (0.3, "px")
    for text, words in (("0.3", "has no unit"), ("0px", "is not positive"), ("1Hz", "has the unit 'Hz'")):
        with pytest.raises(UsageError, match=words):
            parse_jitter(text)


def test_squares_and_regions() -> None:
    assert parse_square_m("20mm") == 0.02
    assert parse_region_px("1,2.5, 3,4") == (1.0, 2.5, 3.0, 4.0)
    for text in ("20m", "1e-30mm"):
        with pytest.raises(UsageError, match=r"--square: .* is not between 0\.01 mm and 10 m"):
            parse_square_m(text)
    for text in ("1,2,3", "a,b,c,d", "5,0,1,9", "0,0,inf,9", "nan,0,1,1", "1e400,0,5,5"):
        with pytest.raises(UsageError, match="--region"):
            parse_region_px(text)
    with pytest.raises(UsageError, match="--image-size"):
        parse_image_size("999999x9")


@pytest.mark.parametrize(("word", "value"), [("1.5", 1.5), ("-2e-3", -2e-3), ("inf", math.inf), (".5", 0.5)])
def test_plain_number_reads_decimals(word: str, value: float) -> None:
    assert plain_number(word) == value


@pytest.mark.parametrize("word", ["", "1_000", "1,5", "0x10", "one", "1 2"])
def test_plain_number_takes_no_other_words(word: str) -> None:
    assert plain_number(word) is None

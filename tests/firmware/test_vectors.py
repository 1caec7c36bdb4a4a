"""Golden vectors: they reach what they are there for, and the text holds them."""

from __future__ import annotations

import re

import pytest
from firmware_rigs import header

from calib.stages.firmware.conformance import (
    ANGLE_LIMIT,
    BAD_REFERENCE,
    CLAMPED,
    IMU_HELD,
    MARKER_HELD,
    SATURATED,
)
from calib.stages.firmware.header import identity_of
from calib.stages.firmware.vectors import selftest_text, vectors


@pytest.mark.parametrize("kind", ["nominal", "full"])
def test_they_reach_every_branch_but_the_angles_limit(kind: str) -> None:
    seen = 0
    for vector in vectors(header(kind)):
        seen |= vector.wanted.flags
    for flag in (MARKER_HELD, IMU_HELD, BAD_REFERENCE, *SATURATED):
        assert seen & flag, hex(flag)
    if kind == "nominal":
        assert seen & (CLAMPED[0] | CLAMPED[1])
    assert not seen & ANGLE_LIMIT


def test_most_commands_are_between_the_limits() -> None:
    """A saturated command says nothing of the gains."""
    between = [v for v in vectors(header("nominal")) if any(0.0 < u < 255.0 for u in v.wanted.pwm)]
    assert len(between) >= 5


def test_the_text_has_all_rows_and_the_headers_id() -> None:
    text = selftest_text(header())
    assert f"CALIB_ID != 0x{identity_of(header())[:8].upper()}UL" in text
    assert len(re.findall(r"-?\d+\.\d+(?:e[+-]\d+)?f(?=,)", text)) == 48 * 19
    assert text == selftest_text(header())

"""Records of what became of a rig: the same after a file, and None for what is none."""

from __future__ import annotations

import math

import pytest

from calib.fleet.outcome import Outcome, from_json, to_json, verdict_of


def test_the_same_after_a_file() -> None:
    told = Outcome(
        "a", "7", "/x", "poor", 1, "why", "key", "camera", ("r1", "r2"), {"intrinsics": "poor"},
        {"camera.fx_px": (273.1, 0.2), "camera.rms_px": (0.1, None)}, 1.5, 99.0, {"rig.yaml": "ab"},
    )  # fmt: skip
    assert from_json(to_json(told)) == told


def test_what_is_not_finite_and_what_breaks_a_line() -> None:
    told = Outcome(
        "a", "", "", "failed", 3, "two\nlines", values={"x": (math.nan, 1.0), "y": (1.0, math.inf)}
    )
    back = from_json(to_json(told))
    assert back is not None
    assert back.sentence == r"two\nlines" and back.values == {"y": (1.0, None)}


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"schema": 2}', '{"schema": 1, "name": 3}', "null"])
def test_what_is_no_outcome(text: str) -> None:
    assert from_json(text) is None


def test_verdicts_by_exit_code() -> None:
    assert [verdict_of(code) for code in (0, 1, 2, 3, 70)] == ["ok", "poor", "failed", "failed", "broken"]

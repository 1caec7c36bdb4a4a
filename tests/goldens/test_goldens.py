"""What the command line answers for six rigs is what is stored; and a difference would be seen."""

from __future__ import annotations

from pathlib import Path

import pytest
from goldens import goldens

QUICK = ("shipped", "poor")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in goldens.RIGS]
)
def test_answers_are_those_stored(name: str, tmp_path: Path) -> None:
    found = goldens.differences(name, goldens.answers(name, tmp_path / name))
    assert not found, "\n".join(["refresh with python tests/goldens/goldens.py --refresh", *found])


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("a 1.5 b", "a 1.5 c"),
        ("a 1.5", "a  1.5"),
        ("a 1.5", "a 1.50"),
        ("a 0.123456789012", "a 0.123456789212"),
        ("a 1e-12", "a 0.0"),
        ("a 3 views", "a 4 views"),
        ("a nan", "a 1.0"),
        ("a\nb", "a"),
        ("k1", "k2"),
    ],
)
def test_another_text_differs(before: str, now: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine as the one that stored them."""
    monkeypatch.setattr(goldens, "SAME_DIGITS", True)
    monkeypatch.setattr(goldens, "RELATIVE", 1e-9)
    assert len(goldens.compare("f", before, now)) == 1


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("a 0.1", "a 0.10000000000000002"),
        ("a -3.1e-17 b", "a 2e-18 b"),
        ("a 123456.789012345", "a 123456.789012346"),
    ],
)
def test_rounding_does_not_differ(before: str, now: str) -> None:
    assert goldens.compare("f", before, now) == []


def test_a_difference_names_the_line_and_both_values() -> None:
    (found,) = goldens.compare("rig/file.txt", "same\nwidth 2.5 m", "same\nwidth 2.6 m")
    assert "rig/file.txt:2" in found and "2.5 is now 2.6" in found


def test_a_line_that_was_put_in_hides_no_number() -> None:
    found = goldens.compare("f", "one\ntwo 2.0", "one\nmore\ntwo 3.0")
    assert len(found) == 2


def test_a_page_is_what_can_be_read() -> None:
    page = "<head><title>x</title></head><h1>Title <b>of</b> it</h1><svg><text>no</text></svg><tr><td>1<td>2"
    assert goldens.page_text(page) == "Title of it\n| 1 | 2\n"

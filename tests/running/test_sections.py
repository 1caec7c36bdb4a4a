"""Sections handed from stage to stage: chosen, joined, and as the text of a rig's file."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import BadInputError
from calib.rig import read_rig
from calib.running.sections import Sections, sections_of

RIG = """geometry: {workspace_m: [0.0, 0.0, 1.0, 1.0]}
later: {made: 2026-01-01, value_m: 1.5}
provenance:
  inputs: {later: {a.csv: abc}, geometry: {b.csv: def}}
"""


def test_read_chosen_and_written(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    whole = sections_of(path)
    assert set(whole.values) == {"geometry", "later"}
    later = whole.only(["later", "none"])
    assert set(later.values) == set(later.inputs) == {"later"}
    assert set(whole.without(["later"]).values) == {"geometry"}
    path.write_text(later.text(path))
    assert read_rig(path).provenance.inputs == {"later": {"a.csv": "abc"}}
    # A date is no JSON, and still tells two files apart.
    assert later.canonical() != Sections({"later": {"value_m": 1.5}}).canonical()


def test_join_takes_the_other_side() -> None:
    a = Sections({"x": {"v": 1}, "y": {"v": 1}}, {"x": {"f": "1"}})
    b = Sections({"x": {"v": 2}}, {"x": {"f": "2"}})
    joined = a.joined(b)
    assert joined.values == {"x": {"v": 2}, "y": {"v": 1}} and joined.inputs == {"x": {"f": "2"}}
    assert joined.canonical() == b.joined(Sections({"y": {"v": 1}})).canonical()


def test_what_the_schema_refuses_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"rig\.yaml: geometry"):
        Sections({"geometry": {"workspace_m": [1.0]}}).text(tmp_path / "rig.yaml")

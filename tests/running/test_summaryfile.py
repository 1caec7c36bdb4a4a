"""run.json: what a run has written comes back, and anything else is as if there were none."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import pytest
from pages import finished_run

from calib.runner.outputs import read_summary
from calib.show.page import page_text

WRONG: tuple[Any, ...] = (None, 0, 1.5, True, "", "<script>alert(1)</script>", [], {}, [1], ["a"], {"a": 1})


def _paths(value: Any, start: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [start, *(path for key, one in inner for path in _paths(one, (*start, key)))]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    rig = finished_run(tmp_path_factory.mktemp("page"))
    return rig, json.loads((rig.parent / ".calib" / "run.json").read_text())


@pytest.mark.parametrize("text", ["", "[]", "{}", "null", '{"jobs": 1}', "[" * 100_000, "9" * 5000, "\0"])
def test_what_is_no_summary(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    assert read_summary(tmp_path / "run.json") is None
    assert read_summary(tmp_path / "none.json") is None


def test_a_page_of_any_summary(run: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Values of other kinds, and keys that are gone: the page is made, of the rig's sections if need be."""
    rig, told = run
    place = tmp_path / "rig.yaml"
    place.write_bytes(rig.read_bytes())
    (tmp_path / ".calib").mkdir()
    dice = random.Random(1)
    for _ in range(60):
        other = copy.deepcopy(told)
        path = dice.choice(_paths(other)[1:])
        parent = other
        for key in path[:-1]:
            parent = parent[key]
        if dice.random() < 0.3:
            del parent[path[-1]]
        else:
            parent[path[-1]] = dice.choice(WRONG)
        (tmp_path / ".calib" / "run.json").write_text(json.dumps(other))
        assert "<script>alert" not in page_text(place), path

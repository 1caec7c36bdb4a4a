"""Results on the disk: whole or not there, and of one key."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calib.running.cache import key_of, load, store


def _stored(tmp_path: Path, key: str = "k", text: str = "a") -> Path:
    work = tmp_path / "work"
    (work / "figures").mkdir(parents=True)
    (work / "figures" / "f.png").write_text(text)
    (work / "document.json").write_text(json.dumps({"verb": "x"}))
    (work / "messages.txt").write_text("one\n\ntwo\n")
    store(work, tmp_path / "result", key, 1, tmp_path / "old")
    return tmp_path / "result"


def test_stored_and_loaded(tmp_path: Path) -> None:
    found = load(_stored(tmp_path), "k")
    assert found is not None and found.code == 1
    assert found.document() == {"verb": "x"} and found.messages() == ["one", "two"]
    assert [path.name for path in found.figures()] == ["f.png"]
    assert load(tmp_path / "result", "other") is None
    assert load(tmp_path / "nothing", "k") is None


def test_a_newer_result_takes_the_place_of_an_older(tmp_path: Path) -> None:
    _stored(tmp_path)
    _stored(tmp_path, "new", "b")
    assert load(tmp_path / "result", "k") is None
    assert load(tmp_path / "result", "new") is not None
    assert not (tmp_path / "old").exists()


def test_what_was_touched_is_not_used(tmp_path: Path) -> None:
    folder = _stored(tmp_path)
    (folder / "figures" / "f.png").write_text("other")
    assert load(folder) is None
    for text in (
        "",
        "[]",
        "{}",
        '{"key": 1, "code": "x", "files": {}}',
        '{"key": "k", "code": 0, "files": 3}',
    ):
        (folder / "result.json").write_text(text)
        assert load(folder) is None


@pytest.mark.parametrize("changed", ["document.json", "messages.txt", "result.json"])
def test_forged_numbers_are_not_told(tmp_path: Path, changed: str) -> None:
    folder = _stored(tmp_path)
    path = folder / changed
    forged = {
        "document.json": path.read_text().replace("x", "y"),
        "messages.txt": "all is well\n",
        "result.json": path.read_text().replace('"code": 1', '"code": 0'),
    }[changed]
    assert forged != path.read_text()
    path.write_text(forged)
    assert load(folder) is None and load(folder, "k") is None


def test_key_depends_on_each_part() -> None:
    keys = {
        key_of(("a",), {}, ""),
        key_of(("b",), {}, ""),
        key_of(("a",), {"x": "1"}, ""),
        key_of(("a",), {"x": "2"}, ""),
        key_of(("a",), {}, "rig"),
    }
    assert len(keys) == 5
    assert key_of(("a",), {"x": "1", "y": "2"}, "") == key_of(("a",), {"y": "2", "x": "1"}, "")

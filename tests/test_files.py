"""Atomic replacement, bounded YAML, and sentences for what cannot be read or written."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from calib import files
from calib.errors import BadInputError
from calib.files import check_writable, read_text, read_yaml_mapping, shown, write_atomically


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write_atomically(path, "old")
    path.chmod(0o640)
    write_atomically(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


@pytest.mark.parametrize("at", ["write", "fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_the_old_file_survives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, failure: BaseException
) -> None:
    path = tmp_path / "rig.yaml"
    write_atomically(path, "old")

    def fail(*_: object, **__: object) -> None:
        raise failure

    if at == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    elif at == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        monkeypatch.setattr(files.os, "fdopen", fail)
    expected = BadInputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


def test_a_link_is_followed_and_stays(tmp_path: Path) -> None:
    (tmp_path / "real.yaml").write_text("old")
    (tmp_path / "rig.yaml").symlink_to("real.yaml")
    write_atomically(tmp_path / "rig.yaml", "new")
    assert (tmp_path / "rig.yaml").is_symlink()
    assert (tmp_path / "real.yaml").read_text() == "new"


def test_unwritable_places_are_known_before_work(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no folder"):
        check_writable(tmp_path / "nowhere" / "rig.yaml")
    with pytest.raises(BadInputError, match="is a folder"):
        check_writable(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1, 2", "line"),
        ("- 1\n- 2\n", "list"),
        ("", "nothing"),
        ("a: !!python/object/apply:os.system [ls]\n", "not YAML"),
        ("1: 2\n", "not text"),
        ("a: 1\n\tb: 2\n", "line 2"),
        ("x: " + "[" * 3000, "not YAML"),
    ],
)
def test_wrong_yaml_is_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=says) as caught:
        read_yaml_mapping(path)
    assert "\n" not in str(caught.value)
    assert "board.yaml" in str(caught.value)


def test_yaml_that_multiplies_itself_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    path.write_text("\n".join(lines))
    with pytest.raises(BadInputError, match="expands"):
        read_yaml_mapping(path)


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(b"view,\xff\xfe")
    with pytest.raises(BadInputError, match="UTF-8"):
        read_text(path)


def test_names_are_shown_on_one_line() -> None:
    assert shown("a\nb\x1b[31m.png") == r"a\nb\x1b[31m.png"

"""Atomic replacement, bounded YAML, and sentences for what cannot be read or written."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from calib.core import files
from calib.core.errors import BadInputError
from calib.core.files import (
    check_folder,
    check_readable,
    check_writable,
    file_sha256,
    read_bytes,
    read_text,
    read_yaml_mapping,
    write_atomically,
)


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
        ("x: " + "{a: " * 90_000, "nested more than 40 deep"),
        ("a: 1\nb: 2\na: 3\n", "line 3: the key a was given before"),
        ("a: [{b: 1, c: 2, b: 3}]\n", "line 1: the key b was given before"),
        ("a: \x07\n", "control characters are not allowed"),
        ("a: " + "9" * 5000, "not YAML that can be read"),
        ("a: 1\n---\nb: 2\n", "another document"),
    ],
)
def test_wrong_yaml_is_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=says) as caught:
        read_yaml_mapping(path)
    assert "\n" not in str(caught.value)
    assert "board.yaml" in str(caught.value)


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(b"view,\xff\xfe")
    with pytest.raises(BadInputError, match="UTF-8"):
        read_text(path)


def test_what_is_no_regular_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_bytes(b"12345")
    assert check_readable(tmp_path / "file") == 5
    with pytest.raises(BadInputError, match="is a pipe or a device"):
        read_bytes(tmp_path / "pipe")
    with pytest.raises(BadInputError, match="is a folder"):
        read_bytes(tmp_path)
    with pytest.raises(BadInputError, match="No such file"):
        read_bytes(tmp_path / "gone")
    with pytest.raises(BadInputError, match="is larger than 4e-06 MB"):
        read_bytes(tmp_path / "file", most=4)


def test_read_only_files_and_loops_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(BadInputError, match="is read-only"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInputError, match="leads back to itself"):
        write_atomically(tmp_path / "loop", "new")


def test_devices_are_written_through() -> None:
    write_atomically(Path("/dev/null"), "x")
    assert Path("/dev/null").is_char_device()


def test_folders_are_known_before_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    check_folder(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
    with pytest.raises(BadInputError, match="file is a file"):
        check_folder(tmp_path / "file" / "b")


def test_the_hash_of_a_file_of_any_size(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(b"abc")
    assert file_sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    for other, says in ((tmp_path, "is a folder"), (tmp_path / "none", "cannot be read")):
        with pytest.raises(BadInputError, match=says):
            file_sha256(other)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BadInputError, match="is a pipe or a device"):
        file_sha256(tmp_path / "pipe")

"""A place for compiled functions where nothing else can be written."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from calib.compiledfolder import choose_folder


@pytest.fixture
def homeless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Neither a home nor a variable; returns the folder of temporary files."""
    monkeypatch.setenv("HOME", str(tmp_path / "nowhere"))
    # Set and then deleted, so that what the function sets is taken back, too.
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_folder_of_ones_own_is_named_and_kept(homeless: Path) -> None:
    choose_folder(homeless / "installed")
    chosen = Path(os.environ["NUMBA_CACHE_DIR"])
    assert chosen.parent == homeless
    assert chosen.stat().st_mode & 0o077 == 0
    del os.environ["NUMBA_CACHE_DIR"]
    choose_folder(homeless / "installed")
    assert Path(os.environ["NUMBA_CACHE_DIR"]) == chosen


def test_what_others_can_write_is_not_run(homeless: Path) -> None:
    choose_folder(homeless / "installed")
    open_to_all = Path(os.environ.pop("NUMBA_CACHE_DIR"))
    open_to_all.chmod(0o777)
    choose_folder(homeless / "installed")
    assert Path(os.environ["NUMBA_CACHE_DIR"]) != open_to_all


def test_numba_is_left_alone_where_it_can_write(homeless: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choose_folder(homeless)
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setenv("HOME", str(homeless))
    choose_folder(homeless / "installed")
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setenv("NUMBA_CACHE_DIR", "chosen")
    monkeypatch.setenv("HOME", str(homeless / "nowhere"))
    choose_folder(homeless / "installed")
    assert os.environ["NUMBA_CACHE_DIR"] == "chosen"

"""One run at a time: the lock refuses a second one, and ends with its process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from calib.errors import BadInputError
from calib.running.lock import held

HOLDER = """
import sys
from pathlib import Path
from calib.running.lock import held
with held(Path(sys.argv[1]), Path("out")):
    print("held", flush=True)
    sys.stdin.read()
"""


def _holder(path: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_second_is_refused_and_told_by_whom(tmp_path: Path) -> None:
    process = _holder(tmp_path / "lock")
    try:
        told = rf"process {process.pid}\) is at work"
        with pytest.raises(BadInputError, match=told), held(tmp_path / "lock", tmp_path):
            pass
    finally:
        process.communicate("")
    with held(tmp_path / "lock", tmp_path) as left:
        assert left is None


def test_one_that_was_killed_holds_nothing_but_is_told(tmp_path: Path) -> None:
    process = _holder(tmp_path / "lock")
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    with held(tmp_path / "lock", tmp_path) as left:
        assert left == process.pid


def test_numbers_of_other_programs_lock_nothing(tmp_path: Path) -> None:
    (tmp_path / "lock").write_text("1\n")
    with held(tmp_path / "lock", tmp_path) as left:
        assert left == 1


def test_a_link_in_place_of_the_lock_is_refused(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "lock").symlink_to(tmp_path / "precious")
    with pytest.raises(BadInputError), held(tmp_path / "lock", tmp_path):
        pass
    assert (tmp_path / "precious").read_text() == "kept"

"""Faults at every write of a run: a full disk, no permission, files that cannot grow.

Whatever fails, the run ends with one sentence, every file that a person sees is whole, and the next run
ends in the bytes of one that was never disturbed.
"""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import signal
import sys
import traceback
from pathlib import Path

import pytest
import yaml
from running_trials import make_folder, run_small

from calib.core.errors import BadInputError
from calib.core.files import write_atomically
from calib.runner.cache import held
from calib.runner.folder import read_folder
from calib.runner.graph import HIDDEN
from calib.show.page import keep_pictures, write_page

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="forking is POSIX's")

KILL = -1
"""In place of an error's number: the process is killed there."""

WRITES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "os.chown", "os.link")


def _whole_run(root: Path, out: Path) -> None:
    """All that `calib run` writes, with verbs that take no time."""
    run_small(root, out)
    keep_pictures(read_folder(root).pictures, out / HIDDEN / "pictures")
    write_page(out / "rig.yaml")


def _bytes(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "lock"
    }


def _in_child(root: Path, out: Path, number: int, fail_at: int = 0, largest: int | None = None) -> str:
    """Run in a child in which a write fails; returns how it ended, and how many writes there were."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        seen = 0

        def count() -> None:
            nonlocal seen
            seen += 1
            if seen == fail_at and number == KILL:
                os.kill(os.getpid(), signal.SIGKILL)
            if seen == fail_at:
                raise OSError(number, os.strerror(number))

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            flags = arguments[2] if event == "open" else 0
            opened = isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            if event in WRITES or opened:
                count()

        fsync = os.fsync

        def synced(descriptor: int) -> None:
            count()
            fsync(descriptor)

        told = {"end": "done"}
        try:
            sys.addaudithook(hook)
            os.fsync = synced
            if largest is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))
            _whole_run(root, out)
        except BadInputError as error:
            told["end"] = f"refused: {error}"
        except BaseException as error:
            told["end"] = f"fault: {error!r} {traceback.format_exc()}"
        finally:
            os.write(write, json.dumps({**told, "seen": seen}).encode())
            os._exit(0)
    os.close(write)
    told = b""
    while part := os.read(read, 65536):
        told += part
    os.close(read)
    os.waitpid(child, 0)
    if not told:
        return "0 killed"
    ended = json.loads(told)
    return f"{ended['seen']} {ended['end']}"


def _check_public(out: Path, known: tuple[dict[str, bytes], ...]) -> None:
    """Every file that a person sees is one of a whole run, or is whole by itself."""
    for path in out.rglob("*"):
        name = path.relative_to(out).as_posix()
        if not path.is_file() or HIDDEN in path.parts or path.name.endswith(".tmp"):
            continue
        if name == "rig.yaml":
            assert isinstance(yaml.safe_load(path.read_text()), dict)
        elif name == "report.html":
            assert path.read_text().rstrip().endswith("</html>")
        elif name.startswith("firmware/"):
            assert path.read_text().endswith("]\n")
        else:
            assert path.read_bytes() in [one[name] for one in known if name in one], name


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, dict[str, bytes], dict[str, bytes]]:
    """A rig folder after a change, the results from before it, and the bytes of both."""
    root, out = make_folder(tmp_path / "rig"), tmp_path / "before"
    _whole_run(root, out)
    old = _bytes(out)
    (root / "images" / "a.png").write_bytes(b"another")
    (root / "logs" / "two.csv").unlink()
    (root / "logs" / "new.csv").write_text("t_s,u_px,v_px\n0,7,7\n")
    wanted = tmp_path / "wanted"
    shutil.copytree(out, wanted)
    _whole_run(root, wanted)
    return root, out, old, _bytes(wanted)


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, KILL])
def test_a_fault_at_any_write_is_one_sentence_and_the_next_run_ends_the_same(
    folders: tuple[Path, Path, dict[str, bytes], dict[str, bytes]], tmp_path: Path, number: int
) -> None:
    root, before, old, wanted = folders
    shutil.copytree(before, tmp_path / "counted")
    count = int(_in_child(root, tmp_path / "counted", number).split()[0])
    assert count > 80
    refused = 0
    # Permission is refused where the disk is full: every third write will do.
    for fail_at in range(1, count + 1, 3 if number == errno.EACCES else 1):
        out = tmp_path / f"out{fail_at}"
        shutil.copytree(before, out)
        ended = _in_child(root, out, number, fail_at).split(" ", 1)[1]
        assert ended in ("done", "killed") or ended.startswith("refused: "), (fail_at, ended)
        refused += ended != "done"
        _check_public(out, (old, wanted))
        assert _in_child(root, out, number).endswith(" done"), fail_at
        assert _bytes(out) == wanted, fail_at
        shutil.rmtree(out)
    assert refused > count // 16


@pytest.mark.parametrize("largest", [0, 1, 40, 300, 1000, 4000])
def test_files_that_cannot_grow(
    folders: tuple[Path, Path, dict[str, bytes], dict[str, bytes]], tmp_path: Path, largest: int
) -> None:
    """The kernel itself refuses to write, as on a full disk: in the middle of a file."""
    root, before, old, wanted = folders
    out = tmp_path / "out"
    shutil.copytree(before, out)
    ended = _in_child(root, out, 0, 0, largest).split(" ", 1)[1]
    assert ended == "done" or (ended.startswith("refused: ") and "File too large" in ended), ended
    _check_public(out, (old, wanted))
    assert not list(out.rglob("*.tmp"))
    assert _in_child(root, out, 0).endswith(" done")
    assert _bytes(out) == wanted


def test_a_full_disk_leaves_no_number_in_the_lock_that_misleads(tmp_path: Path) -> None:
    """The lock is the system's, whatever could be written into its file."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        code = 1
        try:
            with held(tmp_path / "lock", tmp_path):
                pass
            code = 0
        except BadInputError:
            code = 3
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) in (0, 3)
    with held(tmp_path / "lock", tmp_path) as left:
        assert left is None


def test_an_atomic_write_that_cannot_grow_keeps_the_old_file(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.csv", "old\n")
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        code = 1
        try:
            write_atomically(tmp_path / "a.csv", "x" * 5000)
        except BadInputError as error:
            code = 3 if str(error) == f"{tmp_path / 'a.csv'}: cannot be written: File too large" else 2
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.csv": "old\n"}

"""Results of stages on the disk, and one run at a time in an output folder."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from calib.core import __version__
from calib.core.errors import BadInputError
from calib.core.files import file_sha256, sha256, shown, to_be
from calib.core.words import Block
from calib.core.writing import check_folder, make_folder, settle, sweep, try_lock, write_atomically

# ----------------------------------------------------------------------
# One run at a time in an output folder.
#
# The lock is the operating system's on an open file, so that it ends with its process, however that ends.
# The process's number in the file is for the message only: a file that is left behind locks nothing.


def _holder(path: Path) -> str:
    try:
        words = path.read_text(encoding="ascii", errors="replace").split()
    except OSError:
        words = []
    return f" (process {int(words[0])})" if words and words[0].isdigit() else ""


@contextmanager
def opened(
    out: Path, hidden: Path, verb: str, public: Sequence[str], kept: Sequence[str], scratch: str
) -> Iterator[int | None]:
    """Make and lock an output folder; yields the process whose run was interrupted there, or None.

    Parameters
    ----------
    hidden : folder within it that is a verb's own; where that is, it has worked here before.
    public : names in `out` of what it writes. kept : folders in `hidden`, scratch : one that is emptied.

    Raises `BadInputError` when another run is at work there, for links that would lead a write out of it, and
    for something of another origin.
    """
    check_folder(out)
    ours = [out / name for name in public]
    for path in (hidden, *(hidden / name for name in (*kept, scratch)), *ours):
        if path.is_symlink():
            raise BadInputError(f"{shown(path)}: is a symbolic link, expected a place in the output folder")
    for path in ours:
        if path.exists() and not hidden.exists():
            raise BadInputError(
                f"{shown(path)}: is there, and is not the work of {verb}; expected another output folder"
            )
    make_folder(hidden)
    with held(hidden / "lock", out, verb) as interrupted:
        remove(hidden / scratch)
        for place in (out, hidden, *(hidden / name for name in kept)):
            sweep(place)
        for name in (*kept, scratch):
            make_folder(hidden / name)
        yield interrupted


@contextmanager
def held(path: Path, folder: Path, verb: str) -> Iterator[int | None]:
    """Hold the lock; yields the number of a process whose run was interrupted here, None without one.

    Raises `BadInputError` while another process holds it, and where the file cannot be made.
    """
    with to_be("written", path):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        if not try_lock(descriptor):
            raise BadInputError(
                f"{shown(folder)}: another {verb}{_holder(path)} is at work there; wait for it, or give "
                "another folder"
            )
        os.lseek(descriptor, 0, os.SEEK_SET)
        left = os.read(descriptor, 32).split()
        with to_be("written", path):
            _tell(descriptor, f"{os.getpid()}\n")
        yield int(left[0]) if left and left[0].isdigit() else None
        # A run that ends by itself leaves no number.
        with contextlib.suppress(OSError):
            _tell(descriptor, "")
    finally:
        os.close(descriptor)


def _tell(descriptor: int, text: str) -> None:
    os.ftruncate(descriptor, 0)
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, text.encode())


# ----------------------------------------------------------------------
# Results of stages on the disk: which one belongs to which inputs, and whether it is whole.
#
# A result is a folder that appears under its name in one step, when all in it has been written:
#
#     result.json    key, exit code, SHA-256 of every other file, and of all this
#     rig.yaml       the rig's file after the stage: what it saw, and what it has written
#     document.json  what the verb said with --json, words.json without, messages.txt on stderr
#     figures/       and what it wrote with -o
#
# The key is the SHA-256 of all that the result follows from: the program, the command, the inputs' hashes
# and the sections of the rig's file that the stage saw.

_RESULT = "result.json"
BLOCKS = TypeAdapter(list[Block])
"""What a verb says in words, as JSON there and back."""
_MOST_BYTES = 50_000_000


@dataclass(frozen=True)
class Result:
    """A stage's result.

    Attributes
    ----------
    code : exit code of the verb, 0 or 1 for a result that can be used.
    files : SHA-256 by name relative to `folder`.
    """

    folder: Path
    key: str
    code: int
    files: dict[str, str]

    def document(self) -> dict[str, Any]:
        """What the verb said with --json; empty where it said nothing that can be read."""
        with contextlib.suppress(ValueError, RecursionError):
            found = json.loads(self._text("document.json"))
            return found if isinstance(found, dict) else {}
        return {}

    def words(self) -> list[Block]:
        """The same as a person reads it."""
        with contextlib.suppress(ValueError):
            return BLOCKS.validate_json(self._text("words.json"))
        return []

    def messages(self) -> list[str]:
        """What the verb said on stderr."""
        return [line for line in self._text("messages.txt").splitlines() if line.strip()]

    def _text(self, name: str) -> str:
        """What a file of it holds, nothing where there is none that can be read."""
        path = self.folder / name
        with contextlib.suppress(OSError):
            if name in self.files and path.stat().st_size <= _MOST_BYTES:
                return path.read_text(encoding="utf-8", errors="replace")
        return ""

    def figures(self) -> list[Path]:
        """The charts of the figures, in the order of their names."""
        names = sorted(name for name in self.files if name.startswith("figures/"))
        return [self.folder / name for name in names if name.endswith(".json")]


@cache
def program_digest() -> str:
    """SHA-256 of this version and its files but compiled ones: results of another program are not reused."""
    root = Path(__file__).resolve().parent.parent
    files = (path for path in sorted(root.rglob("*")) if path.is_file())
    sources = [path for path in files if path.parent.name != "__pycache__"]
    parts = [__version__, *(f"{path.relative_to(root).as_posix()} {file_sha256(path)}" for path in sources)]
    return sha256("\n".join(parts).encode())


@cache
def program() -> str:
    """What results follow from beside their inputs: this program and the libraries under it."""
    import cv2
    import numpy
    import scipy

    versions = (platform.python_version(), numpy.__version__, scipy.__version__, cv2.__version__)
    return sha256(json.dumps([program_digest(), *versions]).encode())


def key_of(command: tuple[str, ...], inputs: Mapping[str, str], sections: str) -> str:
    """Key of a result: `inputs` holds SHA-256 by name, `command` names in place of paths, and
    `sections` is what the stage sees of the rig's file."""
    whole = {
        "program": program_digest(),
        "command": list(command),
        "inputs": dict(sorted(inputs.items())),
        "sections": sha256(sections.encode()),
    }
    return sha256(json.dumps(whole, sort_keys=True, ensure_ascii=True).encode())


def _digest(told: Mapping[str, Any]) -> str:
    return sha256(json.dumps(told, sort_keys=True).encode())


def load(folder: Path, key: str | None = None) -> Result | None:
    """The result in a folder if it is whole, and of this key where one is given."""
    try:
        told = json.loads((folder / _RESULT).read_text(encoding="utf-8"))
        if told.pop("sha256", None) != _digest(told):
            return None
        result = Result(
            folder,
            str(told["key"]),
            int(told["code"]),
            {str(name): str(digest) for name, digest in told["files"].items()},
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    if key is not None and result.key != key:
        return None
    for name, digest in result.files.items():
        path = folder / name
        if not path.is_file() or path.is_symlink() or file_sha256(path) != digest:
            return None
    return result


def store(work: Path, folder: Path, key: str, code: int, trash: Path) -> Result:
    """Turn a folder of work into the result of that name; an older one gives way."""
    files = {}
    for path in sorted(work.rglob("*")):
        if path.is_file() and not path.is_symlink():
            files[path.relative_to(work).as_posix()] = file_sha256(path)
    told: dict[str, Any] = {"schema": 1, "key": key, "code": code, "files": files}
    told["sha256"] = _digest(told)
    write_atomically(work / _RESULT, json.dumps(told, indent=1, sort_keys=True) + "\n")
    with to_be("written", folder):
        if folder.exists():
            folder.rename(trash)
        work.rename(folder)
        settle(folder.parent)
    remove(trash)
    return Result(folder, key, code, files)


def remove(folder: Path) -> None:
    """Remove a folder of ours, as far as that is possible."""
    shutil.rmtree(folder, ignore_errors=True)

"""Writing files: every output of every verb goes through `replacing`.

A file appears under its name when it is whole; until then its bytes lie in a temporary file beside it, which
is removed on errors, Ctrl-C and SIGTERM. One whose process was killed is removed by the next write into the
folder. Recordings grow under their own name (`appending`). Pipes, devices, /dev/stdout are written through.

What is there is replaced only where nothing is lost that calib cannot make again: never a file that the same
command reads, and otherwise a file that is empty or of the `Kind` that is about to be written.
"""

from __future__ import annotations

import contextlib
import filecmp
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from calib.core.command import current, number_of
from calib.core.errors import BadInputError, ReaderGoneError
from calib.core.files import PICTURES, shown, to_be

_TEMPORARY = ".calib.tmp"
"""End of the names of temporary files."""
_HEAD_BYTES = 1 << 16

# ----------------------------------------------------------------------
# What may be written over what.


@dataclass(frozen=True)
class Kind:
    """A kind of file that calib writes.

    Attributes
    ----------
    words : for sentences, as "a log". endings : that a name of it may have; another kind's are refused.
    ours : whether a file that is there is one of these, as calib writes them.
    merged : whether what is there was read, and is written again with what was added.
    recorded : whether it may be a recording, which gives way to the same bytes alone.
    """

    words: str
    endings: tuple[str, ...]
    ours: Callable[[Path], bool]
    merged: bool = False
    recorded: bool = False


_OTHERS = frozenset(
    (
        *PICTURES, ".csv", ".tsv", ".parquet", ".mcap", ".bag", ".db3", ".bin", ".log", ".pdf", ".html",
        ".htm", ".json", ".yaml", ".yml", ".xml", ".c", ".h", ".cpp", ".hpp", ".ino", ".py", ".ipynb", ".md",
        ".mp4", ".avi", ".mkv", ".mov", ".npz", ".npy", ".zip", ".gz", ".svg", ".gif", ".ps", ".eps",
    )
)  # fmt: skip
"""Endings that promise some kind of file; under any other a file may be of each kind."""

_LOOK_AGAIN_S, _TURN_S = 0.02, 10.0
"""Between two looks at a lock, and longer than any file is written, unless its process was stopped."""
RIG_FILE = "rig.yaml"
"""The name that is left to the sections of a rig."""


def head(path: Path, most: int = _HEAD_BYTES) -> bytes:
    """The first bytes of a file that is there; none where it cannot be read."""
    try:
        with path.open("rb") as stream:
            return stream.read(most)
    except OSError:
        return b""


def begins(*beginnings: bytes) -> Callable[[Path], bool]:
    """Whether a file begins with one of these."""
    return lambda path: head(path, max(map(len, beginnings))).startswith(beginnings)


def holds(*parts: bytes, most: int = _HEAD_BYTES) -> Callable[[Path], bool]:
    """Whether there are all of these in the beginning of a file."""
    return lambda path: all(part in head(path, most) for part in parts)


def column_names(path: Path) -> tuple[str, ...]:
    """Names of the columns of a table in CSV or Parquet; none for another file."""
    start = head(path)
    if start.startswith(b"PAR1"):
        from pyarrow import ArrowException, parquet

        with contextlib.suppress(ArrowException, OSError):
            return tuple(parquet.read_schema(path, memory_map=False).names)
        return ()
    return tuple(start.split(b"\n", 1)[0].decode("utf-8", "replace").strip().split(","))


def _check_kind(path: Path, target: Path, kind: Kind) -> None:
    """Raise `BadInputError` where a file of this kind must not be written."""
    command = current()
    if command is not None:
        place = os.path.normcase(os.path.realpath(target))
        other = command.outputs.setdefault(place, kind.words)
        if other != kind.words:
            raise BadInputError(f"{shown(path)}: would hold {other} and {kind.words}, expected two names")
    if target.name.lower() == RIG_FILE and not kind.merged:
        raise BadInputError(
            f"{shown(path)}: holds the sections of a rig, expected another name for {kind.words}"
        )
    ending = target.suffix.lower()
    if ending in _OTHERS and ending not in kind.endings and not kind.merged:
        *most, last = kind.endings
        expected = f"{', '.join(most)} or {last}" if most else last
        raise BadInputError(f"{shown(path)}: ends in {ending}, expected {expected} for {kind.words}")


def _check_replaced(path: Path, target: Path, kind: Kind) -> None:
    """Raise `BadInputError` where something else would be lost."""
    if target.is_file() and target.stat().st_size and not kind.ours(target):
        raise BadInputError(
            f"{shown(path)}: is there, and is not {kind.words} that calib wrote; give another name, or "
            "remove it"
        )


# ----------------------------------------------------------------------
# Where can be written.


def stdout_is_taken() -> bool:
    """Whether an output of this command goes to stdout, so that words must not."""
    command = current()
    return command is not None and command.stdout_taken


def check_writable(path: Path, kind: Kind | None = None) -> None:
    """Fail before long work when a file of this kind cannot be written to `path` afterwards.

    Raises `BadInputError`.
    """
    if _through(path) is not None:
        command = current()
        if command is not None and _through(path) == 1:
            command.stdout_taken = True
        return
    target = _target(path)
    parent = target.parent
    # A name that is too long is no file to Python 3.14, as one that is not there.
    with to_be("written", path), contextlib.suppress(FileNotFoundError, NotADirectoryError):
        target.stat()
    if target.is_dir():
        raise BadInputError(f"{shown(path)}: is a folder, expected a file to write")
    if not parent.is_dir():
        raise BadInputError(f"{shown(path)}: cannot be written: there is no folder {shown(parent)}")
    if target.exists() and not (target.stat().st_mode & 0o222 and os.access(target, os.W_OK)):
        raise BadInputError(f"{shown(path)}: cannot be written: it is read-only")
    if _is_device(target):
        return
    command = current()
    if not (kind is not None and kind.merged) and command is not None and command.reads(target):
        what = "what it writes" if kind is None else kind.words
        raise BadInputError(f"{shown(path)}: is an input of this command, expected another name for {what}")
    if kind is not None:
        _check_kind(path, target, kind)
        if not kind.merged:
            _check_replaced(path, target, kind)
    if not os.access(parent, os.W_OK | os.X_OK):
        raise BadInputError(f"{shown(path)}: cannot be written: no permission in {shown(parent.resolve())}")


def check_folder(path: Path) -> None:
    """Fail before long work when `make_folder` or writing into this folder cannot succeed afterwards."""
    there = path
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise BadInputError(f"{shown(path)}: cannot be made a folder: {shown(there)} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise BadInputError(f"{shown(path)}: cannot be written: no permission in {shown(there.resolve())}")


def check_figures(folder: Path) -> None:
    """As `check_folder`, for figures: among pictures that are read they would be taken for some."""
    check_folder(folder)
    command, place = current(), Path(os.path.realpath(folder))
    inputs = [] if command is None else [Path(one) for one in command.inputs.values()]
    if any(one.parent == place and one.suffix.lower() in PICTURES for one in inputs):
        raise BadInputError(
            f"{shown(folder)}: holds pictures that are read, expected another folder for figures"
        )


def make_folder(path: Path) -> None:
    """Create a folder to write into, or a `BadInputError` that says why not."""
    with to_be("made a folder", path):
        path.mkdir(parents=True, exist_ok=True)


def _target(path: Path) -> Path:
    """The file that a path stands for, symbolic links followed."""
    if not path.is_symlink() or _is_device(path):
        return path
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise BadInputError(f"{shown(path)}: is a symbolic link that leads back to itself")
    return target


def _is_device(path: Path) -> bool:
    """Whether this is there and can only be written through, as /dev/null or a pipe."""
    return path.exists() and not path.is_file() and not path.is_dir()


def writes_through(path: Path) -> bool:
    """Whether what is written to this path goes on, as into a pipe, and is no file afterwards."""
    return _through(path) is not None or _is_device(path)


def _through(path: Path) -> int | None:
    """The open descriptor that a path stands for, as - and /dev/stdout do, whatever that is."""
    if str(path) == "-":
        return 1
    place = os.path.abspath(path)  # noqa: PTH100  a link must not be followed here
    if place in ("/dev/stdout", "/dev/stderr"):
        return 1 if place == "/dev/stdout" else 2
    found = re.fullmatch(r"(?:/dev|/proc/self)/fd/(\d+)", place)
    return int(found[1]) if found else None


# ----------------------------------------------------------------------
# Writing.


@contextlib.contextmanager
def replacing(path: Path, kind: Kind | None = None, durable: bool = True) -> Iterator[BinaryIO]:
    """A stream whose bytes become the file when all of them are there and, if `durable`, on the disk.

    Raises `BadInputError` as `check_writable`, and when the disk is full or the place cannot be written; the
    old file then survives. `ReaderGoneError` for a pipe that nobody reads any more.
    """
    check_writable(path, kind)
    try:
        descriptor = _through(path)
        if descriptor is not None:
            with _duplicate(descriptor) as stream:
                yield stream
            return
        target = _target(path)
        if _is_device(target):
            with target.open("wb") as stream:
                yield stream
            return
        _sweep(target.parent)
        with _beside(target) as (stream, temporary):
            yield stream
            stream.flush()
            if kind is not None and kind.recorded and _differ(target, temporary):
                raise BadInputError(
                    f"{shown(path)}: is there and says something else, which may be a recording; give "
                    "another name, or remove it"
                )
            if durable:
                os.fsync(stream.fileno())
            # Another process may have written there meanwhile.
            if kind is not None:
                _check_replaced(path, target, kind)
            _take_over(target, temporary)
            if os.name == "nt":
                stream.close()
            # Still locked where that is possible, so that nobody takes it for one that was left behind.
            temporary.replace(target)
    except BrokenPipeError as error:
        raise ReaderGoneError("") from error
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    if durable:
        settle(target.parent)


def _differ(old: Path, new: Path) -> bool:
    """Whether a file would be lost to another one."""
    there = old.is_file() and old.stat().st_size > 0
    return there and not filecmp.cmp(old, new, shallow=False)


def settle(folder: Path) -> None:
    """Let the disk know of what was renamed in a folder."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def appending(path: Path, kind: Kind | None = None) -> BinaryIO:
    """A stream to a new or empty file that grows as it is written: for what cannot be made again.

    Raises `BadInputError` as `check_writable`.
    """
    check_writable(path, kind)
    descriptor = _through(path)
    with to_be("written", path):
        return _duplicate(descriptor) if descriptor is not None else _target(path).open("ab")


def write_atomically(path: Path, data: bytes | str, kind: Kind | None = None, durable: bool = True) -> None:
    """Replace a file as a whole. Raises as `replacing`."""
    raw = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    with replacing(path, kind, durable) as stream:
        stream.write(raw)


def move(path: Path, target: Path) -> None:
    """Give a file another name on the same disk. Raises `BadInputError`, as where that name is taken."""
    if target.exists():
        raise BadInputError(f"{shown(target)}: is there already; {shown(path)} stays where it is")
    with to_be("moved", path):
        path.rename(target)


@contextlib.contextmanager
def _beside(target: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """A new, locked file beside another one, which is gone afterwards under its first name."""
    import tempfile

    temporary: Path | None = None
    try:
        while True:
            descriptor, name = tempfile.mkstemp(f"{_TEMPORARY}", f".{target.name[:40]}.", target.parent)
            temporary = Path(name)
            try_lock(descriptor)
            if number_of(temporary) is not None:
                break
            # Somebody has swept it before it was locked.
            os.close(descriptor)
        with os.fdopen(descriptor, "wb") as stream:
            yield stream, temporary
    finally:
        if temporary is not None:
            # After the renaming there is none; one that cannot be removed is no reason to fail.
            with contextlib.suppress(OSError):
                temporary.unlink()


def _duplicate(descriptor: int) -> BinaryIO:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    # Where stderr is, libraries in C may have nothing to write to.
    own = sys.stderr.fileno() if descriptor == 2 else descriptor
    return os.fdopen(os.dup(own), "wb")


def _sweep(folder: Path) -> None:
    """Remove temporary files of processes that were killed, once for each folder of a command."""
    command = current()
    if command is not None:
        if str(folder) in command.swept:
            return
        command.swept.add(str(folder))
    sweep(folder)


def sweep(folder: Path) -> None:
    """Remove temporary files of calib in a folder that no process holds any more."""
    try:
        left = [path for path in folder.iterdir() if path.name.endswith(_TEMPORARY) and path.name[0] == "."]
    except OSError:
        return
    for path in left:
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                dead = try_lock(descriptor)
                if dead and os.name != "nt":
                    path.unlink()
            finally:
                os.close(descriptor)
            if dead and os.name == "nt":
                path.unlink()


def try_lock(descriptor: int) -> bool:
    """Lock an open file until it is closed or its process ends; False where another process has."""
    try:
        if sys.platform == "win32":
            import msvcrt

            # Beyond the text, which others have to be able to read.
            os.lseek(descriptor, 1 << 40, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def lock_within(descriptor: int, longest_s: float) -> None:
    """As `try_lock`, waiting for another process that has the lock, but not for ever."""
    until = time.monotonic() + longest_s
    while not try_lock(descriptor) and time.monotonic() < until:
        time.sleep(_LOOK_AGAIN_S)


@contextlib.contextmanager
def one_at_a_time(path: Path) -> Iterator[None]:
    """Read, change and write a file while no other process does; only where folders can be locked."""
    descriptor = None
    with contextlib.suppress(OSError):
        descriptor = os.open(_target(path).parent, os.O_RDONLY)
    try:
        if descriptor is not None:
            lock_within(descriptor, _TURN_S)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _take_over(old: Path, new: Path) -> None:
    """Give a file the mode and, where allowed, the owner of the one that it replaces."""
    if not old.exists():
        new.chmod(0o666 & ~_umask())
        return
    status = old.stat()
    with contextlib.suppress(OSError):
        os.chown(new, status.st_uid, status.st_gid)
    new.chmod(status.st_mode & 0o777)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

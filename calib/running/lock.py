"""One run at a time in an output folder.

The lock is the operating system's on an open file, so that it ends with its process, however that ends.
The process's number in the file is for the message only: a file that is left behind locks nothing.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from calib.errors import BadInputError
from calib.files import shown

__all__ = ["held"]


def _try_lock(descriptor: int) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            # Beyond the text, which others have to be able to read.
            os.lseek(descriptor, 1 << 20, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _holder(path: Path) -> str:
    try:
        words = path.read_text(encoding="ascii", errors="replace").split()
    except OSError:
        words = []
    return f" (process {int(words[0])})" if words and words[0].isdigit() else ""


@contextmanager
def held(path: Path, folder: Path, verb: str = "calib run") -> Iterator[int | None]:
    """Hold the lock; yields the number of a process whose run was interrupted here, None without one.

    Raises `BadInputError` while another process holds it, and where the file cannot be made.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    try:
        if not _try_lock(descriptor):
            raise BadInputError(
                f"{shown(folder)}: another {verb}{_holder(path)} is at work there; wait for it, or give "
                "another folder"
            )
        os.lseek(descriptor, 0, os.SEEK_SET)
        left = os.read(descriptor, 32).split()
        _tell(descriptor, f"{os.getpid()}\n")
        yield int(left[0]) if left and left[0].isdigit() else None
        # A run that ends by itself leaves no number.
        with contextlib.suppress(OSError):
            _tell(descriptor, "")
    finally:
        os.close(descriptor)


def _tell(descriptor: int, text: str) -> None:
    try:
        os.ftruncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, text.encode())
    except OSError as error:
        raise BadInputError(f"the lock of calib run cannot be written: {error.strerror or error}") from error

"""Tasks for other processes, which find them by the name of this module."""

from __future__ import annotations

import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

from calib.runner.processes import _OtherProgramError


def scratch() -> str:
    """Where this process puts temporary files."""
    return tempfile.gettempdir()


def die() -> None:
    """End the process at once."""
    os._exit(1)


def die_once(mark: str) -> str:
    """End the process, unless the file is there that tells of an earlier attempt."""
    if Path(mark).exists():
        return "alive"
    Path(mark).touch()
    os._exit(1)


def hold_the_interpreter() -> None:
    """Do what does not end, and lets no other thread of the process do anything."""
    re.match("(a+)+$", "a" * 60 + "b")


def fail(words: str) -> None:
    """Raise an error."""
    raise ValueError(words)


def sleep(seconds: float) -> str:
    """Take so long."""
    time.sleep(seconds)
    return "slept"


def tell(path: str) -> None:
    """Write the number of this process into a file, and take a minute."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(60.0)


def refuse(*_: Any) -> None:
    """As a worker with another program does."""
    raise _OtherProgramError

"""Functions that are sent to workers in tests of the engine; some of them kill their process."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

__all__ = ["dies_in", "double", "faulty", "hangs", "noted"]


def double(number: int) -> int:
    """Twice the number."""
    return 2 * number


def faulty(number: int) -> int:
    """As `double`, but it cannot do 3."""
    if number == 3:
        raise ArithmeticError("three is too much")
    return 2 * number


def dies_in(number: int, deadly: tuple[int, ...], seconds: float) -> int:
    """As `double` after some time; the deadly numbers kill the process, as a fault in a library would."""
    if number in deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(seconds)
    return 2 * number


def noted(number: int, folder: str, seconds: float) -> int:
    """As `double` after some time; leaves a file that tells which process has begun."""
    Path(folder, f"{number}-{os.getpid()}").touch()
    time.sleep(seconds)
    return 2 * number


def hangs(number: int, endless: tuple[int, ...]) -> int:
    """As `double`; some numbers never come to an end."""
    while number in endless:
        time.sleep(0.1)
    return 2 * number

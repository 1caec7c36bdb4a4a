"""A task in its process: one at a time, by the same program as all others, and not for ever.

What hangs cannot be stopped from within Python, so that it is left behind: the answer is that it took too
long, and the process ends some seconds later, when the answer has been fetched. Its nanny starts another.
Where a library holds the interpreter itself, nothing can be answered, and the process ends without.
"""

from __future__ import annotations

import faulthandler
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from calib.fleet.extra import needed
from calib.fleet.task import program

__all__ = ["Overdue", "Stranger", "call"]

_SETTLE_S = 1.0
_LEAVE_S = 10.0
_GRACE_S = 60.0
_turn = threading.Lock()
"""A verb takes over stdout, and memory is measured for the whole process."""
_settled = threading.Event()
_leaving = threading.Event()


@dataclass(frozen=True)
class Overdue:
    """A task that was not done when its time was over."""

    limit_s: float


@dataclass(frozen=True)
class Stranger:
    """A task that was refused, because its worker would work with another program."""

    worker: str


def call(expected: str, limit_s: float, function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, `Overdue` or `Stranger`; not before the worker's nanny knows that it is there.

    Parameters
    ----------
    expected : the program that all work with, "" for any.
    """
    with _turn:
        if _leaving.is_set():
            # The process ends in a moment, and another one gets this task.
            time.sleep(2.0 * _LEAVE_S)
        if expected and program() != expected:
            return Stranger(str(needed("distributed").get_worker().address))
        if not _settled.is_set():
            time.sleep(_SETTLE_S)
            _settled.set()
        return _within(limit_s, function, arguments)


def _within(limit_s: float, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    ended: list[tuple[Any, BaseException | None]] = []

    def work() -> None:
        try:
            ended.append((function(*arguments), None))
        except BaseException as error:
            ended.append((None, error))

    thread = threading.Thread(target=work, daemon=True)
    # More than a clock can count is for ever.
    wait_s = min(limit_s, 0.5 * threading.TIMEOUT_MAX)
    _end_process(wait_s + _GRACE_S)
    thread.start()
    thread.join(wait_s)
    if not ended:
        _leaving.set()
        _end_process(_LEAVE_S)
        return Overdue(limit_s)
    faulthandler.cancel_dump_traceback_later()
    result, error = ended[0]
    if error is not None:
        raise error
    return result


def _end_process(seconds: float) -> None:
    """End this process then, whatever it is doing: the clock is a thread that needs no interpreter."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=_nowhere())


@cache
def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)

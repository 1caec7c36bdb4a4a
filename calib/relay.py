"""Stages of a stream in threads of their own: what is read ahead, and what is left for another to finish.

Compiled loops and file operations let go of the interpreter's lock, so reading, filtering and writing a
long log keep two cores busy. Items come and go in their order, a few at a time, so neither the results nor
the memory depend on the threads. An error of one stage ends the others and is raised to the caller.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

__all__ = ["ahead", "behind"]

T = TypeVar("T")

_DEPTH = 4
_WAIT_S = 0.1
_END = object()


def _put(items: queue.Queue[Any], item: Any, over: threading.Event) -> bool:
    """Add an item; False when the other side has ended."""
    while not over.is_set():
        with contextlib.suppress(queue.Full):
            items.put(item, timeout=_WAIT_S)
            return True
    return False


def ahead(source: Iterable[T], depth: int = _DEPTH) -> Iterator[T]:
    """The items of a source that another thread goes through, at most `depth` of them ahead."""
    items: queue.Queue[Any] = queue.Queue(depth)
    over = threading.Event()
    failed: list[BaseException] = []

    def produce() -> None:
        try:
            for item in source:
                if not _put(items, item, over):
                    return
        except BaseException as error:  # it is raised again where the items are taken
            failed.append(error)
        _put(items, _END, over)

    thread = threading.Thread(target=produce, daemon=True)
    thread.start()
    try:
        while (item := items.get()) is not _END:
            yield item
        if failed:
            raise failed[0]
    finally:
        over.set()
        thread.join()


@contextmanager
def behind(finish: Callable[[T], None], depth: int = _DEPTH) -> Iterator[Callable[[T], None]]:
    """A function that hands items to another thread, which finishes them in their order.

    All are finished when the block ends. An error in `finish` is raised by the next item or at the end.
    """
    items: queue.Queue[Any] = queue.Queue(depth)
    over = threading.Event()
    failed: list[BaseException] = []

    def consume() -> None:
        try:
            while (item := items.get()) is not _END:
                finish(item)
        except BaseException as error:  # it is raised again where the items come from
            failed.append(error)
            over.set()

    thread = threading.Thread(target=consume, daemon=True)
    thread.start()

    def hand(item: T) -> None:
        if not _put(items, item, over):
            raise failed[0]

    try:
        yield hand
    finally:
        # After an error, too, the thread ends before what it writes to is closed.
        _put(items, _END, over)
        thread.join()
    if failed:
        raise failed[0]

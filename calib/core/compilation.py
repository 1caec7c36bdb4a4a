"""Noticing that numba compiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


class _Once(event.Listener):
    """Calls a function when the first compilation begins."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call, self._called = call, False

    def on_start(self, _: object) -> None:
        """A compilation begins."""
        if not self._called:
            self._called = True
            self._call()

    def on_end(self, _: object) -> None:
        """It has ended."""


@contextmanager
def on_compiling(call: Callable[[], None]) -> Iterator[None]:
    """Call a function once if anything is compiled in this block, when it begins; not for what is cached."""
    # Numba tells no types of these.
    events: Any = event
    listener = _Once(call)
    events.register("numba:compile", listener)
    try:
        yield
    finally:
        events.unregister("numba:compile", listener)

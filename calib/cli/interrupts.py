"""Ctrl-C, SIGTERM and the terminal's end: answered soon, whatever the command is doing.

The signal raises `KeyboardInterrupt` in the main thread, which cleans up on its way out. Two things may keep
it from being raised: code of a library that calls back drops it, so that it is raised again; and a long call
into compiled code, in which Python cannot raise anything. After `_PATIENCE_S` of the latter another thread
ends the process, as SIGKILL would: what is written takes its place when it is whole.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from calib.core.command import WATCHER

_AGAIN_S = 1.0
"""How long the answer to a signal may take before it is raised again."""
_LOST_S = 0.01
"""The same where it is known to have been dropped."""
_PATIENCE_S = 1.0
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_TIMED = hasattr(signal, "setitimer")


class Interrupts:
    """Whether a signal asked the command to end."""

    def __init__(self) -> None:
        self._came = threading.Event()

    @property
    def came(self) -> bool:
        """Whether one came."""
        return self._came.is_set()

    def _interrupt(self, *_: object) -> None:
        self._came.set()
        if _TIMED:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        raise KeyboardInterrupt

    def _unraisable(self, what: Any) -> None:
        """Raise again what a callback or a finaliser could not; all else is shown as ever."""
        if issubclass(what.exc_type, KeyboardInterrupt) and _TIMED:
            signal.setitimer(signal.ITIMER_REAL, _LOST_S)
        else:
            sys.__unraisablehook__(what)

    @contextlib.contextmanager
    def taken(self, end: Callable[[], None]) -> Iterator[None]:
        """Take the signals within the block, in the main thread; `end` leaves where nothing can be raised."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        # What whoever started this process has told it to ignore stays ignored.
        before: dict[int, Any] = {
            number: handler
            for number in (getattr(signal, name, None) for name in _NAMES)
            if number is not None
            and (handler := signal.getsignal(number)) in (signal.default_int_handler, signal.SIG_DFL)
        }
        wanted = bool(before)
        if _TIMED and wanted:
            before[signal.SIGALRM] = signal.getsignal(signal.SIGALRM)
        for number in before:
            signal.signal(number, self._interrupt)
        hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        try:
            with self._watched(end) if _TIMED and wanted else contextlib.nullcontext():
                yield
        finally:
            self.settle()
            sys.unraisablehook = hook
            for number, handler in before.items():
                signal.signal(number, handler)

    @staticmethod
    def settle() -> None:
        """Raise nothing again: the signal is answered, and what a command does after it is done whole."""
        if _TIMED and threading.current_thread() is threading.main_thread():
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    @contextlib.contextmanager
    def _watched(self, end: Callable[[], None]) -> Iterator[None]:
        reading, writing = os.pipe()
        os.set_blocking(writing, False)

        def watch() -> None:
            # Ends with the pipe.
            if os.read(reading, 1) and not self._came.wait(_PATIENCE_S):
                end()

        watcher = threading.Thread(target=watch, name=WATCHER, daemon=True)
        outer = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        # A signal to a forked child is none to this process.
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(outer)
            os.close(writing)
            watcher.join()
            os.close(reading)

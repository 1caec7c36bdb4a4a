"""Processes in which verbs run, one at a time in each, as if they had been typed.

A process is kept for many verbs: starting Python and its libraries takes longer than most verbs do. A
verb that brings its process down (out of memory, a fault in a library) fails alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

__all__ = ["Command", "Pool", "Runs", "run_here"]

_PR_SET_PDEATHSIG = 1
_LOOK_UP_S = 0.2
_LOST = 70
"""Exit code for a verb whose process has died."""
_LIBRARIES = (
    "calib.cli.main",
    "calib.cli.app",
    "calib.rig",
    "scipy.optimize",
    "scipy.signal",
    "numba",
    "calib.report.style",
)
"""What most verbs need and takes long to load; the first of them sets up the others."""

_Process = tuple[multiprocessing.process.BaseProcess, Connection]


@dataclass(frozen=True)
class Command:
    """A verb to run: its words, and files for what it says on stdout and stderr."""

    name: str
    words: tuple[str, ...]
    stdout: Path
    stderr: Path


class Runs(Protocol):
    """What runs commands: `start` while `free`, then the names and exit codes of `finished` ones."""

    @property
    def free(self) -> bool:
        """Whether another command can start."""

    def start(self, command: Command) -> None:
        """Start a command."""

    def finished(self) -> Iterator[tuple[str, int]]:
        """Wait until at least one command has ended."""


def _serve(channel: Connection, parent: int, ahead: bool) -> None:
    """Life of a process: commands in, exit codes out, until the other end closes.

    One that is started `ahead` of its first command loads meanwhile what most of them need.
    """
    # Ctrl-C reaches all processes of a terminal; the first one answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)
    for name in _LIBRARIES if ahead else ():
        # The verb that needs it says so.
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    while True:
        try:
            command = channel.recv()
        except EOFError:
            return
        code = run_here(command)
        try:
            channel.send(code)
        except OSError:
            return


def run_here(command: Command) -> int:
    """Run a verb in this process and return its exit code; one at a time, for it takes over stdout."""
    from calib.cli.main import main

    before = sys.argv, sys.stdout, sys.stderr
    how: Any = {"mode": "w", "encoding": "utf-8", "errors": "backslashreplace"}
    try:
        with command.stdout.open(**how) as out, command.stderr.open(**how) as told:
            sys.argv, sys.stdout, sys.stderr = ["calib", *command.words], out, told
            try:
                main()
            except SystemExit as leaving:
                return leaving.code if isinstance(leaving.code, int) else 0
    except OSError:
        return _LOST
    finally:
        sys.argv, sys.stdout, sys.stderr = before


class Pool:
    """A few processes that run verbs; use with `with`."""

    def __init__(self, count: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._count = max(1, count)
        self._idle: list[_Process] = []
        self._busy: dict[str, _Process] = {}

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for process, channel in (*self._idle, *self._busy.values()):
            channel.close()
            process.kill()
        for process, _channel in (*self._idle, *self._busy.values()):
            process.join()

    @property
    def free(self) -> bool:
        """Whether another command can start."""
        return len(self._busy) < self._count

    def start(self, command: Command) -> None:
        """Hand a command to an idle process, or to a new one; with the first, another is made ready."""
        first = not (self._idle or self._busy)
        process, channel = self._idle.pop() if self._idle else self._made(ahead=False)
        self._busy[command.name] = process, channel
        with contextlib.suppress(OSError):
            channel.send(command)
        if first and self._count > 1:
            self._idle.append(self._made(ahead=True))

    def _made(self, ahead: bool) -> _Process:
        channel, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, os.getpid(), ahead))
        process.start()
        theirs.close()
        return process, channel

    def finished(self) -> Iterator[tuple[str, int]]:
        """Names and exit codes of commands that have ended; waits for at least one."""
        ready: list[object] = []
        while not ready and self._busy:
            # The wait is a short one, again and again, so that Ctrl-C is answered.
            ready = list(wait([channel for _, channel in self._busy.values()], timeout=_LOOK_UP_S))
        for name, (process, channel) in list(self._busy.items()):
            if channel not in ready:
                continue
            del self._busy[name]
            try:
                code = int(channel.recv())
                self._idle.append((process, channel))
            except (EOFError, OSError):
                process.kill()
                process.join()
                channel.close()
                code = _LOST
            yield name, code

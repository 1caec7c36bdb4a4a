"""Runs of `calib fleet` and `calib sweep` as processes of their own, to be killed half-way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["COMMAND", "all_gone", "done", "started", "until", "workers"]

COMMAND = (sys.executable, "-c", "from calib.cli.main import main; main()")


def done(out: Path) -> int:
    """How many rigs or cases have ended."""
    return len(list(out.glob(".*/outcomes/*.json")))


def workers(parent: int) -> list[int]:
    """Worker processes of a run: they were spawned, and they are not the tracker of resources."""
    found = subprocess.run(
        ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(parent)], capture_output=True, text=True, check=False
    )
    return [int(line.split()[0]) for line in found.stdout.splitlines() if "spawn_main" in line]


@contextmanager
def started(environment: dict[str, str], *words: object) -> Iterator[subprocess.Popen[str]]:
    """A process of the command line, killed at the end."""
    process = subprocess.Popen(
        [*COMMAND, *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until(true: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Wait for something; fails where the process ends before."""
    while not true():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def first_worker(process: subprocess.Popen[str]) -> int:
    """A worker of a run, as soon as there is one: asked for later, a quick run may have ended."""
    until(lambda: bool(workers(process.pid)), process)
    return workers(process.pid)[0]


def all_gone(processes: list[int], seconds: float = 30.0) -> bool:
    """Whether these processes end within some time."""
    ends = time.monotonic() + seconds
    while not all(map(_gone, processes)) and time.monotonic() < ends:
        time.sleep(0.1)
    return all(map(_gone, processes))


def _gone(process: int) -> bool:
    try:
        os.kill(process, signal.SIG_DFL)
    except ProcessLookupError:
        return True
    state = Path(f"/proc/{process}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z"

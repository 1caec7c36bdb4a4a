"""What the benchmarks share: rows of one table, interleaved repetitions, processes measured whole."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

CALIB = [sys.executable, "-c", "from calib.cli.main import main; main()"]


@dataclass(frozen=True)
class Row:
    """Ours beside one peer.

    Attributes
    ----------
    ours_s, peer_s : medians of the same run; a peer that is not here has None.
    target : least ratio of theirs over ours, if one is set.
    ours_mib, peer_mib : peak memory, of whole processes, or of ours what it allocated.
    note : boards found, digits agreed, or why there is no figure.
    """

    job: str
    peer: str
    ours_s: float
    peer_s: float | None
    target: float | None = None
    ours_mib: float | None = None
    peer_mib: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        return None if self.peer_s is None else self.peer_s / self.ours_s


@dataclass(frozen=True)
class Process:
    """A finished process: wall and processor seconds, peak memory of its largest, exit code and output."""

    seconds: float
    cpu_s: float
    mib: float
    code: int
    output: str


def fastest(
    call: Callable[[], object], repeats: int = 5, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Least seconds of a call: others may share the machine."""
    times = []
    for _ in range(repeats):
        began = clock()
        call()
        times.append(clock() - began)
    return min(times)


def interleaved(calls: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each call, in turn: A B C A B C."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - began)
    return {name: median(found) for name, found in times.items()}


def run(command: Sequence[str], folder: Path | None = None) -> Process:
    """Carry out a command, in a folder where one is named, and measure it.

    The first time it compiles Python's modules, as an installer does, and keeps them.
    """
    measured = [sys.executable, "-S", str(Path(__file__).with_name("_measured.py")), *command]
    compiled = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(measured, capture_output=True, check=True, env=compiled, cwd=folder)
    return Process(**json.loads(done.stdout))


def interleaved_processes(commands: Mapping[str, Sequence[str]], repeats: int) -> dict[str, Process]:
    """Median seconds of whole processes in turn, the first round not counted, with the last one's output."""
    found: dict[str, list[Process]] = {name: [] for name in commands}
    for _ in range(1 + repeats):
        for name, command in commands.items():
            found[name].append(run(command))
    return {
        name: replace(runs[-1], seconds=median(p.seconds for p in runs[1:])) for name, runs in found.items()
    }


def peak_mib(call: Callable[[], object]) -> float:
    """What Python and NumPy allocate at most during a call."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def _seconds(value: float | None) -> str:
    if value is None:
        return "-"
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "us")):
        if value * factor >= 1.0:
            return f"{value * factor:.3g} {unit}"
    return f"{1e9 * value:.3g} ns"


def _mib(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}"


def print_rows(rows: Sequence[Row]) -> None:
    """The table, with a mark where a target is missed."""
    print(f"{'job':44}{'peer':22}{'ours':>9}{'peer':>9}{'ratio':>8}{'target':>8}{'MiB':>6}{'peer':>6}  note")
    for row in rows:
        ratio = "skipped" if row.ratio is None else f"{row.ratio:.3g}"
        target = "" if row.target is None else f">= {row.target:g}"
        missed = row.target is not None and row.ratio is not None and row.ratio < row.target
        print(
            f"{row.job:44}{row.peer:22}{_seconds(row.ours_s):>9}{_seconds(row.peer_s):>9}{ratio:>8}{target:>8}"
            f"{_mib(row.ours_mib):>6}{_mib(row.peer_mib):>6}  {'MISSED ' if missed else ''}{row.note}",
            flush=True,
        )

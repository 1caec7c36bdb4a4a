"""Time of the fused filter per row of a log, beside filterpy's EKF on the same events in the same run.

    python tests/bench/estimator.py

One level of process noise with its 19 states: compiled and on filterpy, the same recursion to 1e-9. Then the
whole filter as `calib replay` runs it: clocks, late pictures, gating and a bank of four levels.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from estimatorlogs import rows_from, setup_for, simulated
from numba import njit

from calib.estimator import reference, smoother
from calib.estimator.filter import Filter, starting_state
from calib.estimator.kernel import event
from calib.estimator.model import Kinematic
from calib.estimator.smoother import Events


@njit
def _recursion(t, kinds, readings, x, P, levels, walk, view, constants, noise):  # type: ignore[no-untyped-def]
    """All events by `kernel.event`, without keeping or judging anything."""
    work, report, one, gated = np.zeros((13, x.shape[1])), np.empty(12), np.ones(1), np.zeros(3)
    for k in range(len(t)):
        dt = t[k] - t[k - 1] if k else 0.0
        event(
            x, P, one, kinds[k], readings[k], dt, 0.0, levels, walk, view, constants, noise, work, True,
            report, gated,
        )  # fmt: skip


def _seconds(call: Callable[[], object], repeats: int = 7) -> float:
    best = float("inf")
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - began)
    return best


def main() -> None:
    """Print the table."""
    rig, log = simulated("ellipse", 1)
    rows = rows_from(log)
    setup = setup_for(rig, 1, Kinematic(Kinematic().levels[2:3]))
    events = smoother.events_of(setup, rows, outputs=False)
    count = len(events.t_s)
    levels, walk = setup.process.arrays()
    mixed, gated, constants = np.tile(levels[0], (count, 1)), np.zeros((count, 3)), np.array([9.81, 0.0])
    kept_x, kept_P = np.empty((count, 19)), np.empty((count, 19, 19))

    def ours() -> None:
        x, P, _ = starting_state(setup, rows)
        smoother._forward(
            events.t_s, float(events.t_s[0]), events.kinds, events.readings, mixed, gated, x, P, walk,
            setup.view, constants, setup.noise, kept_x, kept_P,
        )  # fmt: skip

    def alone() -> None:
        x, P, _ = starting_state(setup, rows)
        _recursion(
            events.t_s, events.kinds, events.readings, x, P, levels, walk, setup.view, constants, setup.noise
        )

    ours()
    alone()
    few = 600
    some = Events(events.t_s[:few], events.kinds[:few], events.readings[:few], events.rows[:few])
    reference.extended(setup, rows, some, gated)
    found: list[np.ndarray] = []
    theirs = _seconds(lambda: found.append(reference.extended(setup, rows, some, gated)[0]), 2) / few
    mine = _seconds(alone) / count
    difference = np.abs(found[-1] - kept_x[:few]) / np.sqrt(np.diagonal(kept_P[:few], axis1=1, axis2=2))
    print(
        f"one level, 19 states: {1e6 * mine:.2f} us per row, filterpy {1e6 * theirs:.0f} us: "
        f"{theirs / mine:.0f} times as fast"
    )
    print(f"largest difference {difference.max():.1e} standard deviations")
    for label, process in (("1 level", setup.process), ("4 levels", Kinematic())):
        whole = setup_for(rig, 1, process)
        Filter(whole).run(rows)
        seconds = _seconds(lambda whole=whole: Filter(whole).run(rows))
        print(
            f"whole filter, {label}: {1e6 * seconds / len(rows):.2f} us per row, "
            f"{float(rows.t_s[-1]) / seconds:.0f} times real time"
        )
    outputs = Filter(setup_for(rig, 1)).run(rows)
    whole = setup_for(rig, 1)
    smoother.smooth(whole, rows, outputs)
    seconds = _seconds(lambda: smoother.smooth(whole, rows, outputs), 2)
    print(f"smoother, 4 levels: {1e6 * seconds / len(rows):.1f} us per row")


if __name__ == "__main__":
    main()

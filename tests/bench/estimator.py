"""Time of the fused filter per row of a log, beside filterpy's EKF on the same events in the same run.

    python tests/bench/estimator.py

One level of process noise with its 20 states: compiled and on filterpy, the same recursion to 1e-9. Then the
whole filter as `calib replay` runs it: clocks, late pictures, gating and a bank of four levels; its time and
memory over logs of up to 64 times the rows, read in blocks. Times are those of the processor, the least of
several, so that other work on the machine shows little.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import _here  # noqa: F401
import numpy as np
from _rows import Row, fastest, print_rows
from estimatorlogs import rows_from, setup_for, simulated

from calib.stages.estimator import reference, smoother
from calib.stages.estimator.kinematic import TRACE, Filter, Kinematic, Rows, starting_state
from calib.stages.estimator.sensors import SIZE
from calib.stages.estimator.smoother import Events


def _seconds(call: Callable[[], object], repeats: int = 7) -> float:
    return fastest(call, repeats, time.process_time)


def _growth(rows: Rows) -> None:
    """Time per row, its exponent and the process's memory over longer and longer logs of four levels."""
    length, sizes, times = float(rows.t_s[-1] - rows.t_s[0]) + 0.01, (1, 4, 16, 64), []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for size in sizes:
        whole = Filter(setup_for(simulated("ellipse", 1)[0], 1))
        began = time.process_time()
        for turn in range(size):
            whole.run(Rows(rows.t_s + turn * length, rows.readings, rows.kinds))
        times.append(time.process_time() - began)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    exponent = np.polyfit(np.log(sizes), np.log(times), 1)[0]
    each = ", ".join(f"{1e6 * t / n / len(rows):.2f}" for t, n in zip(times, sizes, strict=True))
    print(
        f"four levels over {len(rows)} to {sizes[-1] * len(rows)} rows: {each} us per row, "
        f"time grows as rows^{exponent:.2f}, memory by {1024 * grown / sizes[-1] / len(rows):.1f} bytes a row"
    )


def rows() -> list[Row]:
    """One level, one row of a log."""
    rig, log = simulated("ellipse", 1)
    readings = rows_from(log)
    setup = setup_for(rig, 1, Kinematic(Kinematic().levels[2:3]))
    events = smoother.events_of(setup, readings)
    some = events.kinds > 0
    events = smoother.Events(*(values[some] for values in vars(events).values()))
    count = len(events.t_s)
    levels, walk = setup.process.arrays()
    gated = np.zeros((count, 3))
    kept_x, kept_P = np.empty((count, SIZE)), np.empty((count, SIZE, SIZE))
    nothing = (np.empty((1, 0, TRACE)), np.empty((0, SIZE)), np.empty((0, SIZE, SIZE)))

    def recursion(*kept: np.ndarray) -> None:
        x, P, w = starting_state(setup, readings)
        smoother.forward(
            events.t_s, float(events.t_s[0]), events.kinds, events.readings, *smoother.banked(x, P, w), 0.0,
            levels[None], walk, setup.view, setup.noise, True, gated, np.empty((count, 1)), *kept,
        )  # fmt: skip

    def alone() -> None:
        recursion(*nothing)

    recursion(np.empty((1, 0, TRACE)), kept_x, kept_P)
    alone()
    few = 600
    some = Events(events.t_s[:few], events.kinds[:few], events.readings[:few], events.rows[:few])
    reference.extended(setup, readings, some, gated)
    found: list[np.ndarray] = []
    theirs = _seconds(lambda: found.append(reference.extended(setup, readings, some, gated)[0]), 2) / few
    mine = _seconds(alone) / count
    difference = np.abs(found[-1] - kept_x[:few]) / np.sqrt(np.diagonal(kept_P[:few], axis1=1, axis2=2))
    note = f"{SIZE} states, differ by {difference.max():.0e} deviations"
    return [Row("estimator, one row of a log", "filterpy EKF", mine, theirs, 200.0, note=note)]


def main() -> None:
    """Print the table."""
    print_rows(rows())
    rig, log = simulated("ellipse", 1)
    readings = rows_from(log)
    for label, process in (("1 level", Kinematic(Kinematic().levels[2:3])), ("4 levels", Kinematic())):
        whole = setup_for(rig, 1, process)
        Filter(whole).run(readings)
        seconds = _seconds(lambda whole=whole: Filter(whole).run(readings))
        print(
            f"whole filter, {label}: {1e6 * seconds / len(readings):.2f} us per row, "
            f"{float(readings.t_s[-1]) / seconds:.0f} times real time"
        )
    _growth(readings)
    outputs = Filter(setup_for(rig, 1)).run(readings)
    whole = setup_for(rig, 1)
    smoother.smooth(whole, readings, outputs)
    seconds = _seconds(lambda: smoother.smooth(whole, readings, outputs), 2)
    print(f"smoother, 4 levels: {1e6 * seconds / len(readings):.1f} us per row")


if __name__ == "__main__":
    main()

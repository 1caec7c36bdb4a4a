"""Many parameter sets under the same commands, as an identification needs them.

Sets are taken `LANES` at a time through `kernel.run_lanes`, and the blocks are shared among threads,
since the kernel releases the interpreter. Plants with gravity or with the head's projection need the
sine of the angle, which has no vector instruction, and go one by one through `kernel.run`. Either
way a set gives the numbers that `integrate.simulate` gives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from calib.actuator.dynamics import coefficients
from calib.actuator.integrate import SUBSTEPS
from calib.actuator.kernel import LANE_COEFFICIENTS, LANES, STATE, run, run_lanes
from calib.actuator.parameters import Plant
from calib.actuator.pump import Pump, delayed, pump_coefficients, static_force_N
from calib.arrays import FloatArray, IntArray
from calib.errors import BadInputError

__all__ = ["simulate_batch"]


@dataclass(frozen=True)
class _Task:
    """What all threads share: the sets, and the arrays that they fill."""

    plants: Sequence[Plant]
    pumps: Sequence[Pump]
    static_N: dict[Pump, FloatArray]
    start: FloatArray
    substeps: int
    states: FloatArray
    stopped: IntArray


def _one(task: _Task, index: int) -> None:
    plant, pump = task.plants[index], task.pumps[index]
    c, p = coefficients(plant), pump_coefficients(pump)
    rows, steps = task.states[index], task.substeps
    stopped = run(c, p, task.start[index], task.static_N[pump], pump.tick_s, steps, steps, rows)
    task.stopped[index] = stopped
    if stopped >= 0:
        rows[:] = np.nan


def _block(task: _Task, indices: Sequence[int]) -> None:
    """Up to `LANES` sets side by side; lanes that are left over repeat the last set."""
    padded = [*indices, *[indices[-1]] * (LANES - len(indices))]
    pumps = [task.pumps[i] for i in padded]
    h = pumps[0].tick_s / task.substeps
    table = np.empty((LANE_COEFFICIENTS, LANES))
    for lane, (i, pump) in enumerate(zip(padded, pumps, strict=True)):
        decay = math.exp(-0.5 * h / pump.lag_s)
        table[:, lane] = (*coefficients(task.plants[i])[:13], decay, *pump_coefficients(pump)[1:])
    radius = table[2]
    begin = task.start[padded].T
    lanes = np.empty((12, LANES))
    for row, (first, divisor) in enumerate(((0, 2.0), (2, 2.0), (4, 1.0))):
        lanes[2 * row] = (begin[first] + begin[first + 1]) / divisor
        lanes[2 * row + 1] = (begin[first] - begin[first + 1]) / (divisor if row == 2 else 2.0 * radius)
    lanes[6:10], lanes[10], lanes[11] = begin[6:], 1.0, 0.0
    static = np.stack([task.static_N[pump] for pump in pumps], axis=-1)
    ticks = len(static)
    out = np.empty((ticks, 10 * LANES))
    kind = pump_coefficients(pumps[0]).kind
    flat = lanes.reshape(-1)
    run_lanes(kind, table.reshape(-1), flat, static.reshape(ticks, -1), h, task.substeps, out)
    alive, good = flat[10 * LANES : 11 * LANES], flat[11 * LANES :]
    rows = out.reshape(ticks, 10, LANES)
    for lane, i in enumerate(indices):
        if alive[lane] == 0.0:
            task.stopped[i] = round(good[lane])
            task.states[i] = np.nan
            continue
        to, r = task.states[i], radius[lane]
        for column, row, scale in ((0, 0, r), (2, 2, r), (4, 4, 1.0)):
            mean, half = rows[:, row, lane], scale * rows[:, row + 1, lane]
            to[:, column], to[:, column + 1] = mean + half, mean - half
        to[:, 4:6] *= 0.5
        to[:, 6:] = rows[:, 6:, lane]


def _blocks(plants: Sequence[Plant], pumps: Sequence[Pump]) -> tuple[list[list[int]], list[int]]:
    """Sets that may run side by side, and those that go alone."""
    alike: dict[int, list[int]] = {}
    alone = []
    for i, (plant, pump) in enumerate(zip(plants, pumps, strict=True)):
        c = coefficients(plant)
        if c.head or c.gravity:
            alone.append(i)
        else:
            alike.setdefault(pump_coefficients(pump).kind, []).append(i)
    blocks = [group[k : k + LANES] for group in alike.values() for k in range(0, len(group), LANES)]
    return blocks, alone


def simulate_batch(
    plants: Sequence[Plant],
    pumps: Sequence[Pump],
    pwm: FloatArray,
    start: FloatArray,
    substeps: int = SUBSTEPS,
    threads: int = 2,
) -> tuple[FloatArray, IntArray]:
    """The same commands for many parameter sets at once.

    Parameters
    ----------
    plants, pumps : one pair per set; the pumps' ticks are alike.
    pwm : (n, 2) commands; those before are zero.
    start : (10,) or (sets, 10) rows of `kernel.STATE`.
    threads : workers that share the sets.

    Returns
    -------
    states (sets, n, 10), one row at the end of each tick, and (sets,) the step in which a set left
    the model, -1 where it did not; the states of such a set are NaN. The step is not checked
    beforehand: an unstable one leaves the model.

    Raises
    ------
    BadInputError for lists that do not match, ticks that differ and counts below one.
    """
    if len(plants) != len(pumps) or not plants:
        raise BadInputError(f"batch: found {len(plants)} plants and {len(pumps)} pumps, expected as many")
    if len({pump.tick_s for pump in pumps}) > 1:
        raise BadInputError("batch: found pumps with different ticks, expected the same for all")
    if substeps < 1 or threads < 1 or len(pwm) < 1:
        raise BadInputError(
            f"batch: found {substeps} steps per tick, {threads} threads, {len(pwm)} rows, expected 1 or more"
        )
    rows = np.asarray(start, dtype=np.float64)
    if rows.shape not in ((len(STATE),), (len(plants), len(STATE))):
        raise BadInputError(
            f"batch: found starts of shape {rows.shape}, expected {len(STATE)} numbers per set"
        )
    task = _Task(
        plants,
        pumps,
        {pump: static_force_N(pump, delayed(pump, pwm)) for pump in set(pumps)},
        np.ascontiguousarray(np.broadcast_to(rows, (len(plants), len(STATE)))),
        substeps,
        np.empty((len(plants), len(pwm), len(STATE))),
        np.full(len(plants), -1, dtype=np.int64),
    )
    blocks, alone = _blocks(plants, pumps)
    with ThreadPoolExecutor(max_workers=threads) as pool:
        side_by_side = [pool.submit(_block, task, block) for block in blocks]
        single = [pool.submit(_one, task, index) for index in alone]
        for job in (*side_by_side, *single):
            job.result()
    return task.states, task.stopped

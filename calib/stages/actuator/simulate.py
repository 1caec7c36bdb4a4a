"""Simulating actuator and pumps with fixed steps in time with the controller's ticks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import Coefficients, coefficients, linearised, rates
from calib.stages.actuator.kinematics import LARGEST_ANGLE_RAD, bellows, inlined
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import (
    Pump,
    PumpCoefficients,
    advance_pump,
    delayed,
    pump_coefficients,
    settling_force_N,
    static_force_N,
)

# ----------------------------------------------------------------------
# The compiled hot path: Runge-Kutta steps of the plant with its pumps, tick by tick.
#
# The mathematics is that of `dynamics.rates` and `pump.advance_pump`, inlined. Forces are known ahead of the
# mechanics, at the start, middle and end of each step, so the step is of fourth order.
#
# A state is the row
#
#     q1, q2 [m], dq1, dq2 [m/s], z1, z2 [N], lag1, lag2, force1, force2 [N].
#
# `run` follows one parameter set, `run_lanes` `LANES` sets side by side, which the compiler turns into
# vector instructions: the same numbers at a quarter of the time for each.
#
# The functions are cached on disk beside this file. The cache notices a change of this file only, not
# of the functions that it inlines: touch it after editing `dynamics`, `pump` or `kinematics`.

STATE = (
    "q1_m",
    "q2_m",
    "dq1_mps",
    "dq2_mps",
    "z1_N",
    "z2_N",
    "lag1_N",
    "lag2_N",
    "force1_N",
    "force2_N",
)

LANES = 16
"""Sets side by side; with fewer the compiler leaves the loop scalar, with more nothing is gained."""

LANE_COEFFICIENTS = 22
"""Rows of the coefficients of `run_lanes`: 15 of the plant, 2 decays, 2 lags, and 3 of the pumps."""


@inlined
def _step(
    c: Coefficients,
    y: tuple[float, float, float, float, float, float],
    h: float,
    start: tuple[float, float],
    middle: tuple[float, float],
    end: tuple[float, float],
) -> tuple[float, float, float, float, float, float]:
    """One classical Runge-Kutta step of (l, phi, dl, dphi, z1 + z2, z1 - z2)."""
    x, p, u, v, s, d = y
    g = 0.5 * h
    a1, b1, s1, d1 = rates(c, x, p, u, v, s, d, start[0], start[1])
    u2, v2 = u + g * a1, v + g * b1
    a2, b2, s2, d2 = rates(c, x + g * u, p + g * v, u2, v2, s + g * s1, d + g * d1, middle[0], middle[1])
    u3, v3 = u + g * a2, v + g * b2
    a3, b3, s3, d3 = rates(c, x + g * u2, p + g * v2, u3, v3, s + g * s2, d + g * d2, middle[0], middle[1])
    u4, v4 = u + h * a3, v + h * b3
    a4, b4, s4, d4 = rates(c, x + h * u3, p + h * v3, u4, v4, s + h * s3, d + h * d3, end[0], end[1])
    w = h / 6.0
    return (
        x + w * (u + 2.0 * (u2 + u3) + u4),
        p + w * (v + 2.0 * (v2 + v3) + v4),
        u + w * (a1 + 2.0 * (a2 + a3) + a4),
        v + w * (b1 + 2.0 * (b2 + b3) + b4),
        s + w * (s1 + 2.0 * (s2 + s3) + s4),
        d + w * (d1 + 2.0 * (d2 + d3) + d4),
    )


@kernel()
def run(
    c: Coefficients,
    pumps: tuple[PumpCoefficients, PumpCoefficients],
    start: FloatArray,
    static_N: FloatArray,
    tick_s: float,
    substeps: int,
    every: int,
    out: FloatArray,
) -> int:
    """Simulate the ticks of `static_N` (n, 2), the static forces in effect [N]; returns a step number.

    Writes the state after every `every`-th step into `out` (n * substeps // every, 10). The result is
    the number of the step in which the state left the model (a length that is not positive, an
    angle beyond `LARGEST_ANGLE_RAD`, or no number at all), or -1.
    """
    h = tick_s / substeps
    one, two = pumps
    decay1, decay2 = math.exp(-0.5 * h / one.lag_s), math.exp(-0.5 * h / two.lag_s)
    r = c.r
    y = (
        0.5 * (start[0] + start[1]),
        0.5 * (start[0] - start[1]) / r,
        0.5 * (start[2] + start[3]),
        0.5 * (start[2] - start[3]) / r,
        start[4] + start[5],
        start[4] - start[5],
    )
    x1, x2, f1, f2 = start[6], start[7], start[8], start[9]
    row, due, count = 0, every, 0
    for tick in range(len(static_N)):
        g1, g2 = static_N[tick, 0], static_N[tick, 1]
        for _ in range(substeps):
            x1, middle1, end1 = advance_pump(one, x1, f1, g1, decay1, h)
            x2, middle2, end2 = advance_pump(two, x2, f2, g2, decay2, h)
            y = _step(c, y, h, (f1, f2), (middle1, middle2), (end1, end2))
            f1, f2 = end1, end2
            # Written so that NaN fails as well.
            if not (abs(y[1]) < LARGEST_ANGLE_RAD and y[0] > r * abs(y[1])):
                return count
            count += 1
            due -= 1
            if due == 0:
                due = every
                turned, spun = r * y[1], r * y[3]
                out[row, 0], out[row, 1] = y[0] + turned, y[0] - turned
                out[row, 2], out[row, 3] = y[2] + spun, y[2] - spun
                out[row, 4], out[row, 5] = 0.5 * (y[4] + y[5]), 0.5 * (y[4] - y[5])
                out[row, 6], out[row, 7], out[row, 8], out[row, 9] = x1, x2, f1, f2
                row += 1
    return -1


@kernel()
def derivative(c: Coefficients, y: FloatArray, F1: float, F2: float) -> FloatArray:
    """Rate (6,) of the mechanical state (q1, q2, dq1, dq2, z1, z2) under the forces F1, F2 [N]."""
    r = c.r
    a, b, s, d = rates(
        c,
        0.5 * (y[0] + y[1]),
        0.5 * (y[0] - y[1]) / r,
        0.5 * (y[2] + y[3]),
        0.5 * (y[2] - y[3]) / r,
        y[4] + y[5],
        y[4] - y[5],
        F1,
        F2,
    )
    out = np.empty(6)
    out[0], out[1] = y[2], y[3]
    out[2], out[3] = a + r * b, a - r * b
    out[4], out[5] = 0.5 * (s + d), 0.5 * (s - d)
    return out


@kernel()
def run_lanes(
    kind: int,
    table: FloatArray,
    lanes: FloatArray,
    static_N: FloatArray,
    step_s: float,
    substeps: int,
    out: FloatArray,
) -> None:
    """As `run` for `LANES` sets, and pumps of one kind.

    Lane i of row k of a flat array is at k LANES + i: offsets that are known when compiling are what
    lets the loop over the lanes become vector instructions.

    Parameters
    ----------
    table : (LANE_COEFFICIENTS * LANES,) the first 15 of `Coefficients`, both pumps' decay in half a
        step, their lags, and the last 3 of `PumpCoefficients`.
    lanes : (12 * LANES,) l, phi, dl, dphi, z1 + z2, z1 - z2, lags, forces, then 1 for a lane that is in
        the model and its number of good steps; written to.
    static_N : (n, 2 * LANES) static forces in effect, those of bellows 1 first.
    out : (n, 10 * LANES) the first ten rows of `lanes` after each tick.
    """
    for tick in range(len(static_N)):
        for _ in range(substeps):
            for i in range(LANES):
                c = Coefficients(
                    table[i],
                    table[LANES + i],
                    table[2 * LANES + i],
                    table[3 * LANES + i],
                    table[4 * LANES + i],
                    table[5 * LANES + i],
                    table[6 * LANES + i],
                    table[7 * LANES + i],
                    table[8 * LANES + i],
                    table[9 * LANES + i],
                    table[10 * LANES + i],
                    table[11 * LANES + i],
                    table[12 * LANES + i],
                    table[13 * LANES + i],
                    table[14 * LANES + i],
                    1,
                )
                decay1, decay2 = table[15 * LANES + i], table[16 * LANES + i]
                falling, laminar = table[19 * LANES + i], table[20 * LANES + i]
                turbulent = table[21 * LANES + i]
                one = PumpCoefficients(kind, table[17 * LANES + i], falling, laminar, turbulent)
                two = PumpCoefficients(kind, table[18 * LANES + i], falling, laminar, turbulent)
                g1, g2 = static_N[tick, i], static_N[tick, LANES + i]
                f1, f2 = lanes[8 * LANES + i], lanes[9 * LANES + i]
                x1, middle1, end1 = advance_pump(one, lanes[6 * LANES + i], f1, g1, decay1, step_s)
                x2, middle2, end2 = advance_pump(two, lanes[7 * LANES + i], f2, g2, decay2, step_s)
                y = (
                    lanes[i],
                    lanes[LANES + i],
                    lanes[2 * LANES + i],
                    lanes[3 * LANES + i],
                    lanes[4 * LANES + i],
                    lanes[5 * LANES + i],
                )
                y = _step(c, y, step_s, (f1, f2), (middle1, middle2), (end1, end2))
                lanes[i], lanes[LANES + i] = y[0], y[1]
                lanes[2 * LANES + i], lanes[3 * LANES + i] = y[2], y[3]
                lanes[4 * LANES + i], lanes[5 * LANES + i] = y[4], y[5]
                lanes[6 * LANES + i], lanes[7 * LANES + i] = x1, x2
                lanes[8 * LANES + i], lanes[9 * LANES + i] = end1, end2
                inside = abs(y[1]) < LARGEST_ANGLE_RAD and y[0] > c.r * abs(y[1])
                kept = lanes[10 * LANES + i] if inside else 0.0
                lanes[10 * LANES + i] = kept
                lanes[11 * LANES + i] += kept
        for k in range(10 * LANES):
            out[tick, k] = lanes[k]


# ----------------------------------------------------------------------
# States to start from, and how large a step may be.
#
# A command that is given at a tick acts `delay_ticks` later and is constant within a tick, so no step ever
# spans a jump. The default of 17 steps per tick at 60 Hz is 0.98 ms; the bellows' lengths then agree with
# an adaptive method at 1e-12 to well within a micrometre. The largest step follows from the roots of the
# plant linearised about the straight rest and the longest elongation, and Runge-Kutta's region of stability.

SUBSTEPS = 17
"""Steps per tick: 0.98 ms at 60 Hz."""

_STRETCHED_M = 0.0266
"""Elongation at 12 V, where the stiffness is greatest in use."""


@dataclass(frozen=True)
class RigState:
    """Plant and pumps at a tick: a row of `STATE` and the commands on their way, oldest first."""

    row: FloatArray
    waiting_pwm: tuple[tuple[float, float], ...]


def state_row(
    plant: Plant,
    phi_rad: float = 0.0,
    length_m: float | None = None,
    force_N: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """A row (10,) of `STATE` at rest at an angle and a length (the rest length by default).

    Raises `BadInputError` where a bellows would have no length.
    """
    l = plant.rest_length_m if length_m is None else length_m  # noqa: E741  the source's symbol
    q1, q2 = bellows(phi_rad, l, plant.bellows_radius_m)
    row = np.array([q1, q2, 0.0, 0.0, 0.0, 0.0, *force_N, *force_N])
    check_start(row)
    return row


def rig_at_rest(plant: Plant, pump: Pump, phi_rad: float = 0.0, length_m: float | None = None) -> RigState:
    """The rig before the first command: pumps off, plant at rest at an angle and a length."""
    g1, g2 = static_force_N(pump, np.zeros(2)).tolist()
    return RigState(state_row(plant, phi_rad, length_m, (g1, g2)), ((0.0, 0.0),) * pump.delay_ticks)


def check_start(row: FloatArray) -> None:
    """Raise `BadInputError` unless a row (10,) of `STATE` is finite with positive lengths."""
    if row.shape != (len(STATE),) or not np.all(np.isfinite(row)):
        raise BadInputError(f"start: found shape {row.shape}, expected {len(STATE)} finite numbers")
    if not min(row[0], row[1]) > 0.0:
        raise BadInputError(
            f"start: found bellows of {row[0]:.6g} m and {row[1]:.6g} m, expected positive lengths"
        )


def _stable_step_s(A: FloatArray) -> float:
    """Largest step that keeps Runge-Kutta from blowing up modes that decay or swing by themselves."""

    def grows(h: float) -> bool:
        w = h * modes
        gain = np.abs(1.0 + w * (1.0 + w / 2.0 * (1.0 + w / 3.0 * (1.0 + w / 4.0))))
        return bool(np.any(gain > 1.0 + 1e-9))

    roots = np.linalg.eigvals(A)
    modes = roots[(np.abs(roots) > 0.0) & (roots.real <= 1e-9 * np.abs(roots).max())]
    if len(modes) == 0:
        return math.inf
    # Rounding may leave an undamped root on the right of the axis; it belongs on it.
    modes = np.minimum(modes.real, 0.0) + 1j * modes.imag
    high = 3.0 / float(np.abs(modes).max())
    low = 0.1 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return low


@lru_cache(maxsize=256)
def largest_step_s(plant: Plant) -> float:
    """Largest stable step [s] at rest and at the longest elongation; a tenth of it and less is accurate."""
    lengths = (plant.rest_length_m, plant.rest_length_m + _STRETCHED_M)
    return min(_stable_step_s(linearised(plant, np.full(2, q))) for q in lengths)


# ----------------------------------------------------------------------
# Many parameter sets under the same commands, as an identification needs them.
#
# Sets are taken `LANES` at a time through `run_lanes`, and the blocks are shared among threads, since the
# kernel releases the interpreter.


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


def _block(task: _Task, indices: Sequence[int]) -> None:
    """Up to `LANES` sets side by side; lanes that are left over repeat the last set."""
    padded = [*indices, *[indices[-1]] * (LANES - len(indices))]
    pumps = [task.pumps[i] for i in padded]
    h = pumps[0].tick_s / task.substeps
    table = np.empty((LANE_COEFFICIENTS, LANES))
    for lane, (i, pump) in enumerate(zip(padded, pumps, strict=True)):
        one, two = pump_coefficients(pump)
        lags_s = one.lag_s, two.lag_s
        decays = [math.exp(-0.5 * h / lag_s) for lag_s in lags_s]
        table[:, lane] = (*coefficients(task.plants[i])[:15], *decays, *lags_s, *one[2:])
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
    kind = pump_coefficients(pumps[0])[0].kind
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


def _blocks(pumps: Sequence[Pump]) -> list[list[int]]:
    """Sets that run side by side."""
    alike: dict[int, list[int]] = {}
    for i, pump in enumerate(pumps):
        alike.setdefault(pump_coefficients(pump)[0].kind, []).append(i)
    return [group[k : k + LANES] for group in alike.values() for k in range(0, len(group), LANES)]


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
    start : (10,) or (sets, 10) rows of `STATE`.
    threads : workers that share the sets.

    Returns
    -------
    states (sets, n, 10), one row at the end of each tick, and (sets,) the step in which a set left
    the model, -1 where it did not; the states of such a set are NaN. The step is not checked
    beforehand: an unstable one leaves the model.
    """
    task = _Task(
        plants,
        pumps,
        {pump: settling_force_N(pump, delayed(pump, pwm)) for pump in set(pumps)},
        np.ascontiguousarray(np.broadcast_to(start, (len(plants), len(STATE)))),
        substeps,
        np.empty((len(plants), len(pwm), len(STATE))),
        np.full(len(plants), -1, dtype=np.int64),
    )
    jobs = [partial(_block, task, block) for block in _blocks(pumps)]
    if len(jobs) == 1:
        # As in most of a search: a thread would cost a tenth of the work.
        jobs[0]()
        return task.states, task.stopped
    with ThreadPoolExecutor(max_workers=threads) as pool:
        for job in [pool.submit(job) for job in jobs]:
            job.result()
    return task.states, task.stopped

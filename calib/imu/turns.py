"""Turns from one rest to the next: what the rates of rotation predict there, and how far it can be off.

The rate is integrated from the end of a rest to the start of the next; the direction of gravity before,
carried along, is compared with that after by its components across the latter (Tedaldi, Pretto and
Menegatti, ICRA 2014, eqs. 13 - 18).

A rest ends one turn and begins the next, so both share the error of its direction. All turns share the
errors of the gyroscope's bias and of the accelerometer's parameters. White noise of the rate and what the
bias moves by belong to each turn alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.imu.accelerometer import Accelerometer, corrected
from calib.imu.rests import Rest
from calib.imu.turn_kernel import turn_directions

__all__ = ["Turns", "carried", "misfit", "misfit_covariance", "rest_forces", "tangents"]


@dataclass(frozen=True)
class Turns:
    """Readings on the way from each rest to the next.

    Attributes
    ----------
    gyro : (n, 3) readings, (0, 0, z) in a plane.
    accel : (n, d) readings.
    first, last : (k,) last reading of the rest before and first of the rest after.
    before, after : (k,) numbers of these rests, both rising.
    rests : all of them.
    gyro_mean, gyro_scatter : (m, 3) mean over each rest, and long-run variance of a reading.
    initial : number of the rest that the bias is taken from.
    """

    gyro: FloatArray
    accel: FloatArray
    first: IntArray
    last: IntArray
    before: IntArray
    after: IntArray
    rests: Sequence[Rest]
    gyro_mean: FloatArray
    gyro_scatter: FloatArray
    initial: int
    period_s: float

    @property
    def duration_s(self) -> FloatArray:
        """(k,) lengths in seconds."""
        return np.asarray((self.last - self.first) * self.period_s)


def rest_forces(turns: Turns, parameters: FloatArray) -> FloatArray:
    """Specific forces (m, d) at rest [m/s^2], by parameters of the accelerometer."""
    return corrected(parameters, np.stack([rest.mean for rest in turns.rests]))


def _directions(turns: Turns, parameters: FloatArray) -> FloatArray:
    """Unit vectors (m, 3) at rest; z is zero in a plane."""
    f = rest_forces(turns, parameters)
    out = np.zeros((len(f), 3))
    out[:, : f.shape[1]] = f / np.linalg.norm(f, axis=1)[:, None]
    return out


def carried(turns: Turns, rates: FloatArray, M: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (k, 3) fixed in the world, given before each turn and returned as they are seen after it.

    `rates` (n, 3) are readings without their bias, M (3, 3) makes them rad/s.
    """
    out = np.empty((len(turns.first), 3))
    turn_directions(
        rates,
        np.ascontiguousarray(M),
        turns.first,
        turns.last,
        np.ascontiguousarray(vectors),
        turns.period_s,
        out,
    )
    return out


def tangents(turns: Turns, accel: Accelerometer) -> FloatArray:
    """Unit vectors (k, 2, 3) across the direction after each turn; in a plane one (k, 1, 3)."""
    u = _directions(turns, accel.parameters)[turns.after]
    planar = len(accel.bias) == 2
    z = np.tile([0.0, 0.0, 1.0], (len(u), 1)) if planar else np.eye(3)[np.argmin(np.abs(u), axis=1)]
    first = np.cross(z, u)
    first /= np.linalg.norm(first, axis=1)[:, None]
    if planar:
        return np.asarray(first[:, None])
    return np.stack([first, np.cross(u, first)], axis=1)


def misfit(
    turns: Turns, parameters: FloatArray, rates: FloatArray, M: FloatArray, across: FloatArray
) -> FloatArray:
    """Direction predicted less direction found, along the vectors `across` (k, c, 3): (k c,) [rad]."""
    u = _directions(turns, parameters)
    off = carried(turns, rates, M, u[turns.before]) - u[turns.after]
    return np.asarray(np.einsum("kci,ki->kc", across, off).ravel())


def misfit_covariance(
    turns: Turns,
    accel: Accelerometer,
    rates: FloatArray,
    M: FloatArray,
    across: FloatArray,
    bias_sigma: FloatArray,
    wander: FloatArray,
) -> FloatArray:
    """Covariance (k c, k c) of `misfit`.

    Parameters
    ----------
    bias_sigma : (3,) of the bias that all turns share, in the readings' unit.
    wander : (3,) standard deviation of the bias about that from turn to turn.
    """
    k, c = across.shape[:2]
    s2 = accel.direction_sigma**2
    gain = (M**2).sum(axis=0)
    white = float((np.median(turns.gyro_scatter, axis=0) * gain).sum()) * turns.period_s
    moved = float((wander**2 * gain).sum())
    # In a plane all noise is that of z; else each component across has the mean of three axes.
    axes = 1 if c == 1 else 3
    T = turns.duration_s
    own = s2[turns.before] + s2[turns.after] + (white * T + moved * T**2) / axes
    C = np.zeros((k, c, k, c))
    C[np.arange(k), :, np.arange(k), :] = own[:, None, None] * np.eye(c)
    # Turns that follow each other: what the rest between them was off by, seen before and after.
    last = np.flatnonzero(turns.after[:-1] == turns.before[1:])
    vectors = np.zeros((c, k, 3))
    vectors[:, last + 1] = across[last].transpose(1, 0, 2)
    seen = np.stack([carried(turns, rates, M, one) for one in vectors], axis=1)
    cross = -s2[turns.before, None, None] * np.einsum("kai,kbi->kab", across, seen)
    C[last + 1, :, last, :] = cross[last + 1]
    C[last, :, last + 1, :] = cross[last + 1].transpose(0, 2, 1)
    C2 = C.reshape(k * c, k * c)
    base = misfit(turns, accel.parameters, rates, M, across)
    shared = [
        misfit(turns, accel.parameters, rates - sigma * np.eye(3)[j], M, across) - base
        for j, sigma in enumerate(bias_sigma.tolist())
        if sigma > 0.0 and gain[j] > 0.0
    ]
    values, vectors = np.linalg.eigh(accel.covariance)
    shared += [
        misfit(turns, accel.parameters + math.sqrt(value) * vector, rates, M, across) - base
        for value, vector in zip(values.tolist(), vectors.T, strict=True)
        if value > 0.0
    ]
    E = np.array(shared).reshape(-1, k * c)
    return np.asarray(C2 + E.T @ E + 1e-16 * np.eye(k * c))

"""Columns 1 to 12 of the output: lengths, rates, pose, bias and deviations from states and covariances."""

from __future__ import annotations

import math

from calib.arrays import FloatArray, IntArray
from calib.estimator.bank import R1, R2, R3, R4, R5, RECORD, STATE
from calib.estimator.clock import restart
from calib.estimator.compiled import compiled
from calib.estimator.model import axis_noise, axis_transition
from calib.estimator.sensors import head_position

__all__ = ["begin_row", "write_bank", "write_columns"]

_JUMP_S = (-0.1, 2.0)


@compiled()
def begin_row(
    stamp: float, last: float, camera_clock: FloatArray, imu_clock: FloatArray, out: FloatArray, row: int
) -> bool:
    """Blank a row but for its stamp; whether time jumps there from the last one, where clocks start again."""
    for k in range(out.shape[1]):
        out[row, k] = math.nan
    out[row, 0] = stamp
    step = stamp - last
    jumps = step < _JUMP_S[0] or step > _JUMP_S[1]
    if jumps:
        restart(camera_clock)
        restart(imu_clock)
    return bool(jumps)


@compiled()
def _finish(
    phi: float, length: float, dphi: float, dl: float, bias: float, pp: float, ll: float, pl: float, r: float,
    out: FloatArray, row: int,
) -> None:  # fmt: skip
    """Means and variances into columns 1 to 12 of a row."""
    out[row, 1], out[row, 2] = length + r * phi, length - r * phi
    out[row, 3], out[row, 4] = dl + r * dphi, dl - r * dphi
    out[row, 5], out[row, 6] = phi, length
    out[row, 7], out[row, 8] = head_position(phi, length)
    out[row, 9] = bias
    out[row, 10] = math.sqrt(max(ll + r * r * pp + 2.0 * r * pl, 1e-18))
    out[row, 11] = math.sqrt(max(ll + r * r * pp - 2.0 * r * pl, 1e-18))
    out[row, 12] = math.sqrt(max(pp, 1e-18))


@compiled()
def write_bank(
    bank: FloatArray, weights: FloatArray, slot: int, dt: float, levels: FloatArray, radius: float,
    out: FloatArray, row: int,
) -> None:  # fmt: skip
    """Means and deviations of the bank a short time dt after its last event into columns 1 to 12."""
    count = weights.shape[1] - 1
    phi = length = dphi = dl = bias = pp = ll = pl = 0.0
    # Second moments about the first level: what cancels is no more than the levels are apart.
    phi_0 = length_0 = 0.0
    for m in range(count):
        at = (slot * count + m) * RECORD
        x = at + STATE
        a01, a02, a11, a12, _ = axis_transition(levels[0, m, 0], levels[0, m, 1], dt)
        b01, b02, b11, b12, _ = axis_transition(levels[0, m, 4], levels[0, m, 5], dt)
        phi_m = bank[x] + a01 * bank[x + 2] + a02 * bank[x + 4]
        length_m = bank[x + 1] + b01 * bank[x + 3] + b02 * bank[x + 5]
        if m == 0:
            phi_0, length_0 = phi_m, length_m
        phi_m, length_m = phi_m - phi_0, length_m - length_0
        p, v, a = at, at + R2, at + R4
        q, u, b = at + R1, at + R3, at + R5
        var_p = (
            bank[p] + a01 * a01 * bank[v + 2] + a02 * a02 * bank[a + 4]
            + 2.0 * (a01 * bank[p + 2] + a02 * bank[p + 4] + a01 * a02 * bank[v + 4])
        )  # fmt: skip
        var_l = (
            bank[q + 1] + b01 * b01 * bank[u + 3] + b02 * b02 * bank[b + 5]
            + 2.0 * (b01 * bank[q + 3] + b02 * bank[q + 5] + b01 * b02 * bank[u + 5])
        )  # fmt: skip
        cross = bank[p + 1] + b01 * bank[p + 3] + b02 * bank[p + 5]
        cross += a01 * (bank[v + 1] + b01 * bank[v + 3] + b02 * bank[v + 5])
        cross += a02 * (bank[a + 1] + b01 * bank[a + 3] + b02 * bank[a + 5])
        if dt > 0.0:
            var_p += axis_noise(levels[0, m, 2], levels[0, m, 3], dt)[0]
            var_l += axis_noise(levels[0, m, 6], levels[0, m, 7], dt)[0]
        w = weights[slot, m]
        phi += w * phi_m
        length += w * length_m
        dphi += w * (a11 * bank[x + 2] + a12 * bank[x + 4])
        dl += w * (b11 * bank[x + 3] + b12 * bank[x + 5])
        bias += w * bank[x + 6]
        pp += w * (var_p + phi_m * phi_m)
        ll += w * (var_l + length_m * length_m)
        pl += w * (cross + phi_m * length_m)
    _finish(
        phi_0 + phi, length_0 + length, dphi, dl, bias, pp - phi * phi, ll - length * length,
        pl - phi * length, radius, out, row,
    )  # fmt: skip


@compiled()
def write_columns(x: FloatArray, P: FloatArray, rows: IntArray, radius: float, out: FloatArray) -> None:
    """States (k, n) and covariances (k, n, n) into columns 1 to 12 of these rows (k,) of `out`."""
    for k in range(len(rows)):
        _finish(
            x[k, 0],
            x[k, 1],
            x[k, 2],
            x[k, 3],
            x[k, 6],
            P[k, 0, 0],
            P[k, 1, 1],
            P[k, 0, 1],
            radius,
            out,
            rows[k],
        )

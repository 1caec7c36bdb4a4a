"""Compiled arithmetic of the simulated head: states between nodes, and the head's motion in them.

Sensors in a closed loop look at one or two states per tick, where calls cost more than numbers.

With rho = l S(phi), h = phi / 2 and S of `calib.actuator.arc` the head is at rho (sin h, cos h), and its
acceleration along and across that direction is

    a_r = rho'' - rho dphi^2 / 4,   a_t = rho ddphi / 2 + rho' dphi,
    rho' = dl S + l S' dphi,   rho'' = ddl S + 2 dl S' dphi + l (S'' dphi^2 + S' ddphi),
    S' = -phi D,   S'' = 2 D - S / 4.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from calib.actuator.arc import chord_decay_w, chord_ratio_w
from calib.arrays import FloatArray

__all__ = ["MOTION", "head_rows", "states_between"]

MOTION = ("phi_rad", "dphi_radps", "ddphi_radps2", "x_m", "y_m", "ax_mps2", "ay_mps2")
"""Columns of `head_rows`, in the world frame."""


@njit(cache=True, nogil=True, error_model="numpy")
def states_between(node_s: float, nodes: FloatArray, t_s: FloatArray) -> FloatArray:
    """States (m, 10) at the times (m,) from nodes (n, 10); see `sensors.Trajectory`."""
    last = len(nodes) - 1
    out = np.empty((len(t_s), nodes.shape[1]))
    for row in range(len(t_s)):
        place = min(max(t_s[row] / node_s, 0.0), float(last))
        near = np.rint(place)
        # A time meant to be a node's own must find it in spite of rounding.
        if abs(place - near) < 1e-7:
            place = near
        i = int(place)
        s = place - i
        if i >= last or s == 0.0:
            out[row] = nodes[min(i, last)]
            continue
        a, b = nodes[i], nodes[i + 1]
        for k in range(4, nodes.shape[1]):
            out[row, k] = a[k] + s * (b[k] - a[k])
        for k in range(2):
            v0, v1, rise = node_s * a[k + 2], node_s * b[k + 2], b[k] - a[k]
            # The cubic q0 + s v0 + s^2 (3 rise - 2 v0 - v1) + s^3 (v0 + v1 - 2 rise).
            second, third = 3.0 * rise - 2.0 * v0 - v1, v0 + v1 - 2.0 * rise
            out[row, k] = a[k] + s * (v0 + s * (second + s * third))
            out[row, k + 2] = (v0 + s * (2.0 * second + 3.0 * s * third)) / node_s
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def head_rows(r: float, states: FloatArray, ddq: FloatArray) -> FloatArray:
    """Motion (m, 7) of the head, see `MOTION`, from states (m, 10) and accelerations (m, 2) [m/s^2]."""
    out = np.empty((len(states), 7))
    for row in range(len(states)):
        q1, q2, dq1, dq2 = states[row, 0], states[row, 1], states[row, 2], states[row, 3]
        phi, length = (q1 - q2) / (2.0 * r), 0.5 * (q1 + q2)
        dphi, dl = (dq1 - dq2) / (2.0 * r), 0.5 * (dq1 + dq2)
        ddphi, ddl = (ddq[row, 0] - ddq[row, 1]) / (2.0 * r), 0.5 * (ddq[row, 0] + ddq[row, 1])
        S, D = chord_ratio_w(phi * phi), chord_decay_w(phi * phi)
        S1, S2 = -phi * D, 2.0 * D - 0.25 * S
        rho = length * S
        drho = dl * S + length * S1 * dphi
        ddrho = ddl * S + 2.0 * dl * S1 * dphi + length * (S2 * dphi * dphi + S1 * ddphi)
        along = ddrho - 0.25 * rho * dphi * dphi
        across = 0.5 * rho * ddphi + drho * dphi
        sine, cosine = math.sin(0.5 * phi), math.cos(0.5 * phi)
        out[row, 0], out[row, 1], out[row, 2] = phi, dphi, ddphi
        out[row, 3], out[row, 4] = rho * sine, rho * cosine
        out[row, 5] = along * sine + across * cosine
        out[row, 6] = along * cosine - across * sine
    return out

"""The driven process: the actuator's dynamics with the commands of its pumps as input.

A state is the row `DRIVEN` of 36 numbers. The first twelve move: angle, length and their rates, creep as
z1 + z2 and z1 - z2, and for each bellows the output of the pump's lag, its force, and a slow disturbance that
is added to it. Then come what is not known exactly of plant and pumps (`PARAMETER`), as relative
deviations from the nominal value (of the damping its logarithm, of the rest length metres), and the
sensors of `sensors.SENSOR`.

The motion is that of `calib.actuator.dynamics.rates` and `calib.actuator.pump.advance`, in Runge-Kutta steps
of at most `STEP_S`. A command acts as the static force that it settles at, constant between the times at
which commands take effect; a step of the filter is cut there (`Segments`). The Jacobian is by forward
differences of the same steps, over the 23 columns that the motion depends on; those of the sensors are
those of the identity.
"""

from __future__ import annotations

import math

import numpy as np

from calib.actuator.dynamics import Coefficients, rates
from calib.actuator.pump import PumpCoefficients, advance
from calib.arrays import FloatArray
from calib.estimator.compiled import compiled
from calib.estimator.sensors import SENSOR

__all__ = [
    "DRIVEN",
    "DYNAMIC",
    "INVOLVED",
    "PARAMETER",
    "PLANT",
    "STEP_S",
    "accelerations",
    "carry",
    "flow",
    "jacobian",
]

MOVING = (
    "phi_rad", "length_m", "dphi_radps", "dlength_mps", "z_sum_N", "z_difference_N",
    "lag1_N", "lag2_N", "force1_N", "force2_N", "disturbance1_N", "disturbance2_N",
)  # fmt: skip

PARAMETER = (
    "stiffness", "log_damping", "bending", "strength1", "strength2", "lag", "deflation", "rest_length_m",
    "mass", "creep_stiffness", "creep_rate",
)  # fmt: skip
"""What is uncertain of plant and pumps: entries 12 to 22 of a state."""

DRIVEN = (*MOVING, *PARAMETER, *SENSOR)

DYNAMIC = len(MOVING)
INVOLVED = DYNAMIC + len(PARAMETER)
"""Entries that move, and entries that the motion depends on."""

PLANT = (
    "m", "J", "r", "l0", "k0", "k1", "k2", "k3", "damping", "bending", "lambda1", "lambda2", "lambda3",
    "gx", "gy", "head", "gravity", "kind", "lag_s", "falling", "laminar", "turbulent",
)  # fmt: skip
"""Nominal values, those of `Coefficients` and then of `PumpCoefficients`, as the vector `plant`."""

STEP_S = 0.0035
"""Longest Runge-Kutta step; the stiffest mode, 200 1/s, is then within 1e-4 of its own course."""

_NUDGE = np.array([1e-6, 1e-7, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6,
                   1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-7, 1e-5, 1e-5, 1e-5])  # fmt: skip


@compiled()
def _factor(deviation: float) -> float:
    return max(1.0 + deviation, 0.1)


@compiled()
def _coefficients(plant: FloatArray, x: FloatArray) -> Coefficients:
    scale = _factor(x[12])
    return Coefficients(
        plant[0] * _factor(x[20]), plant[1], plant[2], plant[3] + x[19],
        plant[4] * scale, plant[5] * scale, plant[6] * scale, plant[7] * scale,
        plant[8] * math.exp(min(x[13], 3.0)) / math.sqrt(scale), plant[9] * _factor(x[14]),
        plant[10] * _factor(x[22]), plant[11] * _factor(x[21]), plant[12],
        plant[13], plant[14], int(plant[15]), int(plant[16]),
    )  # fmt: skip


@compiled()
def flow(plant: FloatArray, x: FloatArray, segments: FloatArray, count: int, out: FloatArray) -> None:
    """State of the moving part (12,) after the segments.

    Parameters
    ----------
    plant : (22,) of `PLANT`.
    x : (23,) or more, of `DRIVEN`.
    segments : (count, 3) or more rows: duration [s] and the nominal static forces of both pumps [N].
    """
    c = _coefficients(plant, x)
    lag_s, deflation = plant[18] * _factor(x[17]), _factor(x[18])
    # An orifice that passes more empties sooner.
    pump = PumpCoefficients(
        int(plant[17]), lag_s, plant[19] * deflation, plant[20] / deflation, plant[21] / deflation
    )
    y0, y1, y2, y3, y4, y5 = x[1], x[0], x[3], x[2], x[4], x[5]
    x1, x2, f1, f2, d1, d2 = x[6], x[7], x[8], x[9], x[10], x[11]
    strength1, strength2 = _factor(x[15]), _factor(x[16])
    for k in range(count):
        parts = max(math.ceil(segments[k, 0] / STEP_S - 1e-9), 1)
        h = segments[k, 0] / parts
        decay = math.exp(-0.5 * h / lag_s)
        g1, g2 = strength1 * segments[k, 1], strength2 * segments[k, 2]
        for _ in range(parts):
            x1, middle1, end1 = advance(pump, x1, f1, g1, decay, h)
            x2, middle2, end2 = advance(pump, x2, f2, g2, decay, h)
            a0, a1, a2, a3, a4, a5 = y0, y1, y2, y3, y4, y5
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            F1, F2 = f1 + d1, f2 + d2
            # The four stages in a loop: compiling `rates` once takes a quarter of the time.
            for stage in range(4):
                if stage == 1:
                    F1, F2 = middle1 + d1, middle2 + d2
                elif stage == 3:
                    F1, F2 = end1 + d1, end2 + d2
                r2, r3, r4, r5 = rates(c, a0, a1, a2, a3, a4, a5, F1, F2)
                w = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
                s0, s1, s2, s3 = s0 + w * a2, s1 + w * a3, s2 + w * r2, s3 + w * r3
                s4, s5 = s4 + w * r4, s5 + w * r5
                g = h if stage == 2 else 0.5 * h
                a0, a1, a2, a3 = y0 + g * a2, y1 + g * a3, y2 + g * r2, y3 + g * r3
                a4, a5 = y4 + g * r4, y5 + g * r5
            y0, y1, y2, y3, y4, y5 = y0 + s0, y1 + s1, y2 + s2, y3 + s3, y4 + s4, y5 + s5
            f1, f2 = end1, end2
    out[0], out[1], out[2], out[3], out[4], out[5] = y1, y0, y3, y2, y4, y5
    out[6], out[7], out[8], out[9], out[10], out[11] = x1, x2, f1, f2, d1, d2


@compiled()
def jacobian(
    plant: FloatArray, x: FloatArray, segments: FloatArray, count: int, out: FloatArray, F: FloatArray
) -> None:
    """`flow` into out[:12], and its derivative F (12, 23).

    Twelve more entries of out are scratch; x is nudged on the way and then as before.
    """
    flow(plant, x, segments, count, out)
    moved = out[DYNAMIC:]
    for k in range(INVOLVED):
        step, own = _NUDGE[k], x[k]
        x[k] = own + step
        flow(plant, x, segments, count, moved)
        x[k] = own
        for i in range(DYNAMIC):
            F[i, k] = (moved[i] - out[i]) / step


@compiled()
def _accelerate(plant: FloatArray, x: FloatArray) -> tuple[float, float]:
    c = _coefficients(plant, x)
    ddl, ddphi, _, _ = rates(c, x[1], x[0], x[3], x[2], x[4], x[5], x[8] + x[10], x[9] + x[11])
    return ddphi, ddl


@compiled()
def accelerations(
    plant: FloatArray, x: FloatArray, by_phi: FloatArray, by_length: FloatArray
) -> tuple[float, float]:
    """ddphi [rad/s^2], ddl [m/s^2] of a state and their gradients (23,), written to; x stays."""
    ddphi, ddl = _accelerate(plant, x)
    for k in range(INVOLVED):
        by_phi[k], by_length[k] = 0.0, 0.0
        if k == 6 or k == 7 or 15 <= k <= 18 or k >= 21:
            continue
        own = x[k]
        x[k] = own + _NUDGE[k]
        a, b = _accelerate(plant, x)
        x[k] = own
        by_phi[k], by_length[k] = (a - ddphi) / _NUDGE[k], (b - ddl) / _NUDGE[k]
    return ddphi, ddl


@compiled()
def carry(P: FloatArray, F: FloatArray, noise: FloatArray, dt: float, FP: FloatArray) -> None:
    """P = [F 0; 0 1] P [F 0; 0 1]' + noise dt, in place.

    Parameters
    ----------
    P : (36, 36). F : (12, 23). noise : (36,) squared densities. FP : (12, 36) scratch.
    """
    n = P.shape[0]
    for i in range(DYNAMIC):
        for j in range(n):
            FP[i, j] = 0.0
        for k in range(INVOLVED):
            slope = F[i, k]
            if slope != 0.0:
                for j in range(n):
                    FP[i, j] += slope * P[k, j]
    for i in range(DYNAMIC):
        for j in range(i + 1):
            total = 0.0
            for k in range(INVOLVED):
                total += FP[i, k] * F[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(DYNAMIC, n):
            P[i, j] = FP[i, j]
            P[j, i] = FP[i, j]
    for i in range(n):
        P[i, i] += noise[i] * dt

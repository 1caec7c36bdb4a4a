"""The driven filter: the actuator's dynamics as process model, filter, smoother, hand-over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.stages.actuator.dynamics import Coefficients, coefficients, rates
from calib.stages.actuator.kinematics import chord_decay_w, chord_ratio_w
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.pump import (
    PumpCoefficients,
    advance_pump,
    pump_coefficients,
    settling_force_N,
)
from calib.stages.estimator.event import (
    CAMERA,
    IMU,
    TELLING,
    absorb,
    accel_variance,
    camera_terms,
    chi_squares,
    judge,
    leave,
    stamp_variance,
    tell,
    update,
)
from calib.stages.estimator.kinematic import (
    COUNT,
    FASTEST_MPS,
    NEWEST,
    OUT,
    Events,
    Filter,
    Rows,
    Setup,
    advance,
    begin_row,
    copy_state,
    count_first,
    even_times,
    finish_row,
    make_room,
    new_clock,
    no_events,
    settle_event,
    starting_state,
    write_columns,
)
from calib.stages.estimator.sensors import (
    GRAVITY_MPS2,
    SENSOR,
    SIZE,
    accelerometer,
    decay_slope_w,
    gyroscope,
    head_position,
    invert_marker,
)
from calib.stages.estimator.smoother import events_of, look_back, smooth, undo_readings

# ----------------------------------------------------------------------
# The driven process: the actuator's dynamics with the commands of its pumps as input.
#
# A state is the row `DRIVEN` of 37 numbers. The first twelve move: angle, length and their rates, creep as z1
# + z2 and z1 - z2, and for each bellows the output of the pump's lag, its force, and a slow disturbance that
# is added to it. Then come what is not known exactly of plant and pumps (`PARAMETER`), as relative deviations
# from the nominal value (of the damping its logarithm, of the rest length metres), and the sensors of
# `sensors.SENSOR`.
#
# The motion is that of `calib.stages.actuator.dynamics.rates` and
# `calib.stages.actuator.pump.advance_pump`, in Runge-Kutta steps of at most `longest_step_s`: as damping and
# springs are uncertain, so is what is stiff. At equal steps an L-stable Rosenbrock method of third order
# (ROS34PW2) errs five to forty times as much. A command acts as the static force that it settles at,
# constant between the times at which commands take effect; a step of the filter is cut there (`cut`). The
# Jacobian is that of the same steps, over the 23 columns that the motion depends on; those of the sensors are
# those of the identity.

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

SIZE_D = len(DRIVEN)
DYNAMIC = len(MOVING)
INVOLVED = DYNAMIC + len(PARAMETER)
"""Entries that move, and entries that the motion depends on."""

PLANT = (
    "m", "J", "r", "l0", "k0", "k1", "k2", "k3", "damping", "bending", "lambda1", "lambda2", "lambda3",
    "gx", "gy", "gravity", "kind", "lag1_s", "falling", "laminar", "turbulent", "lag2_s",
)  # fmt: skip
"""Nominal values, of `Coefficients`, then of `PumpCoefficients` and the second lag: the vector `plant`."""

STEP_S, STEP_RATE, LEAST_STEP_S = 0.0035, 1.5, 5e-5
"""Longest Runge-Kutta step, the most that it may be times the stiffest rate, and the shortest step, for 30
times the damping of a rig with its hoses on. From 2.78 on a step makes what it should damp grow."""


@kernel(arrays=False)
def _factor(deviation: float) -> float:
    return max(1.0 + deviation, 0.1)


@kernel(arrays=False)
def _coefficients(plant: FloatArray, x: FloatArray) -> Coefficients:
    scale = _factor(x[12])
    return Coefficients(
        plant[0] * _factor(x[20]), plant[1], plant[2], plant[3] + x[19],
        plant[4] * scale, plant[5] * scale, plant[6] * scale, plant[7] * scale,
        plant[8] * math.exp(x[13]) / math.sqrt(scale), plant[9] * _factor(x[14]),
        plant[10] * _factor(x[22]), plant[11] * _factor(x[21]), plant[12],
        plant[13], plant[14], int(plant[15]),
    )  # fmt: skip


@kernel(arrays=False)
def longest_step_s(plant: FloatArray, x: FloatArray) -> float:
    """Longest Runge-Kutta step [s] from a state (23,) or more: `STEP_S`, less where it is stiff.

    The traces of M^-1 D and M^-1 K, of dampers and springs in (l, phi), bound their eigenvalues.
    """
    c = _coefficients(plant, x)
    length, phi = x[1], x[0]
    S = chord_ratio_w(phi * phi)
    a = length * phi * chord_decay_w(phi * phi) / S
    by_l, by_phi = 1.0 / (c.m * S * S), 1.0 / (0.25 * c.m * length * length * S * S + c.J)
    damping, springs = 0.0, 0.0
    for side in (-1.0, 1.0):
        stretch = max(length + side * c.r * phi - c.l0, 0.0)
        k = c.k0 + stretch * (c.k1 + stretch * (c.k2 + stretch * c.k3))
        tangent = c.k0 + stretch * (2.0 * c.k1 + stretch * (3.0 * c.k2 + stretch * 4.0 * c.k3))
        share = by_l + by_phi * (a + side * c.r) ** 2
        damping += share * c.damping * math.sqrt(k)
        springs += share * abs(tangent)
    springs += by_phi * 4.0 * c.r * c.bending * abs(phi)
    rate = damping + math.sqrt(springs)
    return max(STEP_RATE / rate, LEAST_STEP_S) if rate * STEP_S > STEP_RATE else STEP_S


@kernel(arrays=False)
def _per_factor(deviation: float) -> float:
    """Derivative of the logarithm of `_factor`."""
    return 1.0 / (1.0 + deviation) if 1.0 + deviation > 0.1 else 0.0


@kernel(arrays=False)
def _pump(plant: FloatArray, side: int, lag: float, deflation: float) -> PumpCoefficients:
    # An orifice that passes more empties sooner.
    return PumpCoefficients(
        int(plant[16]), plant[17 + 4 * side] * lag, plant[18] * deflation, plant[19] / deflation,
        plant[20] / deflation,
    )  # fmt: skip


_FELT = (12, 13, 14, 19, 20)
"""Parameters on which accelerations depend: stiffness, damping, bending, rest length, mass."""


@kernel(arrays=False)
def _motion(
    c: Coefficients, x: FloatArray, phi: float, length: float, dphi: float, dl: float, z_sum: float,
    z_difference: float, F1: float, F2: float, by: FloatArray,
) -> tuple[float, float, float, float]:  # fmt: skip
    """ddphi, ddl and the rates of both creep forces, as `rates` has them.

    Parameters
    ----------
    c, x : coefficients, and the state (23,) or more whose parameters made them.
    by : (26,) derivatives of ddphi and then of ddl, written to: by phi, l, dphi, dl, z_sum, z_difference, F1,
        F2 and the parameters `_FELT`.
    """
    ddl, ddphi, dz_sum, dz_difference = rates(c, length, phi, dl, dphi, z_sum, z_difference, F1, F2)
    w, r = phi * phi, c.r
    S, D = chord_ratio_w(w), chord_decay_w(w)
    E = D / S
    g, E_phi = phi * E, phi * (E * E - decay_slope_w(w) / S)
    g_phi, moved = E + phi * E_phi, length * g
    # Sums and differences over the bellows of force by length and by rate, of springs' and dampers' forces.
    stiff = stiff_apart = damped = damped_apart = spring = spring_apart = damper = damper_apart = 0.0
    for side in (-1.0, 1.0):
        eps, rate = length + side * r * phi - c.l0, dl + side * r * dphi
        stretch = max(eps, 0.0)
        k = c.k0 + stretch * (c.k1 + stretch * (c.k2 + stretch * c.k3))
        k_q = c.k1 + stretch * (2.0 * c.k2 + stretch * 3.0 * c.k3) if eps > 0.0 else 0.0
        resistance = c.damping * math.sqrt(k)
        by_q = k + k_q * (eps + 0.5 * resistance * rate / k)
        stiff, stiff_apart = stiff + by_q, stiff_apart + side * by_q
        damped, damped_apart = damped + resistance, damped_apart + side * resistance
        spring, spring_apart = spring + k * eps, spring_apart + side * k * eps
        damper, damper_apart = damper + resistance * rate, damper_apart + side * resistance * rate
    pulling = F1 + F2 + c.lambda3 * z_sum - spring - damper
    weight, weight_phi, weight_phi2 = 0.0, 0.0, 0.0
    if c.gravity:
        sine, cosine = math.sin(0.5 * phi), math.cos(0.5 * phi)
        along, across = c.m * (c.gx * sine + c.gy * cosine), c.m * (c.gx * cosine - c.gy * sine)
        weight, weight_phi = S * along, S * (0.5 * across - g * along)
        weight_phi2 = (2.0 * D - 0.5 * S) * along - g * S * across
        pulling += weight
    a, spun = 0.25 * c.m * length * S * S, dl - moved * dphi
    by_l, by_phi = 1.0 / (c.m * S * S), 1.0 / (a * length + c.J)
    for k in range(13):
        P = T = N = L = 0.0
        if k == 0:
            P = weight_phi - r * stiff_apart
            T = length * weight_phi2 - r * (r * stiff + 4.0 * c.bending * abs(phi))
            N = length * g_phi * (pulling + 2.0 * a * dphi * dphi)
            N += 2.0 * a * g * (2.0 * dphi * spun + length * ddphi)
            L = 2.0 * g * by_l * pulling - 2.0 * length * dphi * dphi * E_phi
            L += g_phi * (2.0 * dl * dphi + length * ddphi)
        elif k == 1:
            P, T = -stiff, weight_phi - r * stiff_apart
            N = pulling * g - 2.0 * a * (dphi * spun / length - g * dphi * dphi + ddphi)
            L = dphi * dphi * (0.5 - 2.0 * E) + g * ddphi
        elif k == 2:
            P, T = -r * damped_apart, -r * r * damped
            N, L = -2.0 * a * (spun - moved * dphi), 2.0 * length * dphi * (0.5 - 2.0 * E) + 2.0 * g * dl
        elif k == 3:
            P, T, N, L = -damped, -r * damped_apart, -2.0 * a * dphi, 2.0 * g * dphi
        elif k == 4:
            P = c.lambda3
        elif k == 5:
            T = r * c.lambda3
        elif k == 6:
            P, T = 1.0, r
        elif k == 7:
            P, T = 1.0, -r
        elif k == 8:
            per = _per_factor(x[12])
            P, T = -spring * per, -r * spring_apart * per
        elif k == 9:
            P, T = -damper, -r * damper_apart
        elif k == 10:
            T = -2.0 * r * c.bending * phi * abs(phi) * _per_factor(x[14])
        elif k == 11:
            P, T = stiff, r * stiff_apart
        else:
            per = _per_factor(x[20])
            P, T, N = weight * per, length * weight_phi * per, -a * (2.0 * dphi * spun + length * ddphi) * per
            L = -by_l * pulling * per
        by[k] = by_phi * (T + moved * P + N)
        by[13 + k] = by_l * P + L + moved * by[k]
    return ddphi, ddl, dz_sum, dz_difference


# Sensitivities are rows of `_L` numbers in one flat array, at distances that the compiler sees: it takes
# several columns at a time. Rows 0 to 11 are those of the moving part; then come those of its first six
# entries at a stage of Runge and Kutta and of their change in a step, of both forces at a stage, in the
# middle of a step and at its end, and what parameters do by themselves to the last four of the six.
_L = INVOLVED + 1
_A, _SUM, _FORCE, _MIDDLE, _END, _OWN = 12 * _L, 18 * _L, 24 * _L, 26 * _L, 28 * _L, 30 * _L
_BY = 34 * _L
FLOW = _BY + 26 + 12
"""Length of the scratch of `jacobian`: rows, derivatives of `_motion`, a stage's state and its change."""

_NUDGES = (1e-6, 1e-6, 1e-5, 1e-5, 1e-5)
"""Steps of the differences by which pumps are differentiated: by lag, force, strength, time and deflation."""


@kernel(arrays=False)
def _pump_rows(
    plant: FloatArray, x: FloatArray, y: FloatArray, side: int, to: float, h: float, w: FloatArray
) -> tuple[float, float]:
    """Advance a pump's lag by h [s] and give its force after h / 2 and h, all with their sensitivities.

    Parameters
    ----------
    x : as in `jacobian`. y : (12,) of `MOVING`. to : nominal static force [N].
    """
    lag, force, strength = y[6 + side], y[8 + side], _factor(x[15 + side])
    pump = _pump(plant, side, _factor(x[17]), _factor(x[18]))
    decay = math.exp(-0.5 * h / pump.lag_s)
    own, middle, end = advance_pump(pump, lag, force, strength * to, decay, h)
    y[6 + side] = own
    lag_row, force_row = (6 + side) * _L, (8 + side) * _L
    middle_row, end_row = _MIDDLE + side * _L, _END + side * _L
    for n in range(5):
        step = _NUDGES[n]
        other = _pump(plant, side, _factor(x[17] + step * (n == 3)), _factor(x[18] + step * (n == 4)))
        settled = _factor(x[15 + side] + step * (n == 2)) * to
        fades = math.exp(-0.5 * h / other.lag_s) if n == 3 else decay
        a, b, c = advance_pump(other, lag + step * (n == 0), force + step * (n == 1), settled, fades, h)
        by_own, by_middle, by_end = (a - own) / step, (b - middle) / step, (c - end) / step
        if n < 2:
            since = force_row if n else lag_row
            for k in range(_L):
                w[middle_row + k] = by_middle * w[since + k] + (w[middle_row + k] if n else 0.0)
                w[end_row + k] = by_end * w[since + k] + (w[end_row + k] if n else 0.0)
            if n == 0:
                fading = by_own
        else:
            k = 15 + side if n == 2 else 14 + n
            w[middle_row + k] += by_middle
            w[end_row + k] += by_end
            w[_BY + n] = by_own
    for k in range(_L):
        w[lag_row + k] *= fading
    for n in range(2, 5):
        w[lag_row + (15 + side if n == 2 else 14 + n)] += w[_BY + n]
    return middle, end


@kernel(arrays=False)
def _stage_rows(c: Coefficients, by: FloatArray, weight: float, g: float, w: FloatArray) -> None:
    """Add a stage's rates of the sensitivities with this weight, and go by g times them to the next one."""
    p0, p1, p2, p3, p4, p5, p6, p7 = by[0], by[1], by[2], by[3], by[4], by[5], by[6], by[7]
    q0, q1, q2, q3, q4, q5, q6, q7 = by[13], by[14], by[15], by[16], by[17], by[18], by[19], by[20]
    by_dl, by_dphi, fading = 2.0 * c.lambda2, 2.0 * c.r * c.lambda2, c.lambda1
    for k in range(_L):
        phi, length, dphi, dl = w[_A + k], w[_A + _L + k], w[_A + 2 * _L + k], w[_A + 3 * _L + k]
        z1, z2, F1, F2 = w[_A + 4 * _L + k], w[_A + 5 * _L + k], w[_FORCE + k], w[_FORCE + _L + k]
        ddphi = p0 * phi + p1 * length + p2 * dphi + p3 * dl + p4 * z1 + p5 * z2 + p6 * F1 + p7 * F2
        ddl = q0 * phi + q1 * length + q2 * dphi + q3 * dl + q4 * z1 + q5 * z2 + q6 * F1 + q7 * F2
        ddphi, ddl = ddphi + w[_OWN + k], ddl + w[_OWN + _L + k]
        dz_sum = by_dl * dl - fading * z1 + w[_OWN + 2 * _L + k]
        dz_difference = by_dphi * dphi - fading * z2 + w[_OWN + 3 * _L + k]
        w[_SUM + k] += weight * dphi
        w[_SUM + _L + k] += weight * dl
        w[_SUM + 2 * _L + k] += weight * ddphi
        w[_SUM + 3 * _L + k] += weight * ddl
        w[_SUM + 4 * _L + k] += weight * dz_sum
        w[_SUM + 5 * _L + k] += weight * dz_difference
        w[_A + k] = w[k] + g * dphi
        w[_A + _L + k] = w[_L + k] + g * dl
        w[_A + 2 * _L + k] = w[2 * _L + k] + g * ddphi
        w[_A + 3 * _L + k] = w[3 * _L + k] + g * ddl
        w[_A + 4 * _L + k] = w[4 * _L + k] + g * dz_sum
        w[_A + 5 * _L + k] = w[5 * _L + k] + g * dz_difference


@kernel(arrays=False)
def jacobian(
    plant: FloatArray, x: FloatArray, segments: FloatArray, count: int, longest_s: float, out: FloatArray,
    F: FloatArray, w: FloatArray,
) -> None:  # fmt: skip
    """State of the moving part (12,) after the segments into out, and its derivative F (12, 23).

    Parameters
    ----------
    plant : (22,) of `PLANT`.
    x : (23,) or more, of `DRIVEN`.
    segments : (count, 3) or more rows: duration [s] and the nominal static forces of both pumps [N].
    longest_s : step. w : (`FLOW`,) scratch.
    """
    c = _coefficients(plant, x)
    creep_stiffness, creep_rate = _per_factor(x[21]) * c.lambda2, _per_factor(x[22]) * c.lambda1
    by, a, s = w[_BY : _BY + 26], w[_BY + 26 : _BY + 32], w[_BY + 32 : _BY + 38]
    for k in range(_BY):
        w[k] = 0.0
    for i in range(DYNAMIC):
        out[i], w[i * _L + i] = x[i], 1.0
    for segment in range(count):
        parts = max(math.ceil(segments[segment, 0] / longest_s - 1e-9), 1)
        h = segments[segment, 0] / parts
        for _ in range(parts):
            middle1, end1 = _pump_rows(plant, x, out, 0, segments[segment, 1], h, w)
            middle2, end2 = _pump_rows(plant, x, out, 1, segments[segment, 2], h, w)
            for i in range(6):
                a[i], s[i] = out[i], 0.0
            for k in range(6 * _L):
                w[_A + k], w[_SUM + k] = w[k], 0.0
            F1, F2 = out[8], out[9]
            for k in range(2 * _L):
                w[_FORCE + k] = w[8 * _L + k] + w[10 * _L + k]
            for stage in range(4):
                if stage == 1:
                    F1, F2 = middle1, middle2
                    for k in range(2 * _L):
                        w[_FORCE + k] = w[_MIDDLE + k] + w[10 * _L + k]
                elif stage == 3:
                    F1, F2 = end1, end2
                    for k in range(2 * _L):
                        w[_FORCE + k] = w[_END + k] + w[10 * _L + k]
                dphi, dl, z1, z2 = a[2], a[3], a[4], a[5]
                ddphi, ddl, dz1, dz2 = _motion(
                    c, x, a[0], a[1], dphi, dl, z1, z2, F1 + out[10], F2 + out[11], by
                )
                for n in range(5):
                    w[_OWN + _FELT[n]], w[_OWN + _L + _FELT[n]] = by[8 + n], by[21 + n]
                w[_OWN + 2 * _L + 21], w[_OWN + 2 * _L + 22] = 2.0 * creep_stiffness * dl, -creep_rate * z1
                w[_OWN + 3 * _L + 21] = 2.0 * c.r * creep_stiffness * dphi
                w[_OWN + 3 * _L + 22] = -creep_rate * z2
                weight = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
                g = h if stage == 2 else 0.5 * h
                _stage_rows(c, by, weight, g, w)
                s[0], s[1], s[2] = s[0] + weight * dphi, s[1] + weight * dl, s[2] + weight * ddphi
                s[3], s[4], s[5] = s[3] + weight * ddl, s[4] + weight * dz1, s[5] + weight * dz2
                a[0], a[1], a[2] = out[0] + g * dphi, out[1] + g * dl, out[2] + g * ddphi
                a[3], a[4], a[5] = out[3] + g * ddl, out[4] + g * dz1, out[5] + g * dz2
            for i in range(6):
                out[i] += s[i]
            for k in range(6 * _L):
                w[k] += w[_SUM + k]
            out[8], out[9] = end1, end2
            for k in range(2 * _L):
                w[8 * _L + k] = w[_END + k]
    for i in range(DYNAMIC):
        for k in range(INVOLVED):
            F[i, k] = w[i * _L + k]


@kernel(arrays=False)
def accelerations(
    plant: FloatArray, x: FloatArray, by_phi: FloatArray, by_length: FloatArray, by: FloatArray
) -> tuple[float, float]:
    """ddphi [rad/s^2], ddl [m/s^2] of a state and their gradients (23,), written to; by (26,) is scratch."""
    F1, F2 = x[8] + x[10], x[9] + x[11]
    ddphi, ddl, _, _ = _motion(
        _coefficients(plant, x), x, x[0], x[1], x[2], x[3], x[4], x[5], F1, F2, by
    )  # fmt: skip
    for i in range(2):
        to, at = by_phi if i == 0 else by_length, 13 * i
        for k in range(INVOLVED):
            to[k] = by[at + k] if k < 6 else 0.0
        to[8], to[9], to[10], to[11] = by[at + 6], by[at + 7], by[at + 6], by[at + 7]
        for n in range(5):
            to[_FELT[n]] = by[at + 8 + n]
    return ddphi, ddl


_DENSE, _WIDTH, _TURNED = 6, 24, DYNAMIC * SIZE_D
"""Rows of F that are full, those of head and creep; how wide the rows of F' are: shorter loops are slower."""
CARRY = _TURNED + INVOLVED * _WIDTH
"""Length of the scratch of `carry`."""


@kernel(arrays=False)
def carry(P: FloatArray, F: FloatArray, noise: FloatArray, dt: float, w: FloatArray) -> None:
    """P = [F 0; 0 1] P [F 0; 0 1]' + noise dt, in place.

    Parameters
    ----------
    P : (37, 37). F : (12, 23). noise : (37,) squared densities. w : (`CARRY`,) scratch, for F P and F'.
    """
    # Flat arrays with sizes that are known: the compiler takes several columns at a time.
    flat = P.reshape(-1)
    for i in range(DYNAMIC):
        for k in range(INVOLVED):
            w[_TURNED + k * _WIDTH + i] = F[i, k]
    for i in range(_DENSE):
        for j in range(SIZE_D):
            total = 0.0
            for k in range(INVOLVED):
                total += F[i, k] * flat[k * SIZE_D + j]
            w[i * SIZE_D + j] = total
    for i in range(_DENSE, DYNAMIC):
        for j in range(SIZE_D):
            w[i * SIZE_D + j] = 0.0
        for k in range(INVOLVED):
            slope = F[i, k]
            if slope != 0.0:
                for j in range(SIZE_D):
                    w[i * SIZE_D + j] += slope * flat[k * SIZE_D + j]
    for i in range(DYNAMIC):
        # What is beyond the twelfth is written over.
        for j in range(_WIDTH):
            total = 0.0
            for k in range(INVOLVED):
                total += w[i * SIZE_D + k] * w[_TURNED + k * _WIDTH + j]
            flat[i * SIZE_D + j] = total
    for i in range(DYNAMIC):
        for j in range(i):
            P[j, i] = P[i, j]
        for j in range(DYNAMIC, SIZE_D):
            P[i, j] = P[j, i] = w[i * SIZE_D + j]
    for i in range(SIZE_D):
        P[i, i] += noise[i] * dt


# ----------------------------------------------------------------------
# What the driven filter knows beforehand: plant, pumps, and how far from the truth they may be.

SIGMA = (0.08, 0.1, 0.1, 0.06, 0.06, 0.06, 0.08, 5e-4, 0.08, 0.1, 0.1)
"""Deviations of `PARAMETER` from nominal: by what two rigs that were made alike differ."""


@dataclass(frozen=True)
class Drive(Machine):
    """Plant and pumps of the driven filter; until the first command nobody knows whether the hoses are on.

    Attributes
    ----------
    sigma : (11,) deviations of `PARAMETER`.
    covariance : (11, 11) of the same where they are not independent; its diagonal is `sigma` squared.
    sigma_force_N, sigma_disturbance_N, sigma_creep_N : of the state before the first reading.
    sigma_turning_radps : of dphi; a free swing is fast.
    walk_disturbance : density of the disturbances' walk [N/sqrt(s)].
    walk_rates : densities of the walk of dphi and dl [rad/s, m/s per sqrt(s)].
    walk_forces : density of the walk of lag, force and creep [N/sqrt(s)].
    walk_switching : what the density of the disturbances' walk has beside, as a share of the rate of the
        pump's force [sqrt(s)]: a law that is not quite the pump's errs while the force changes.
    walk_parameters : of all parameters, as a share of `SIGMA` per sqrt(s). Known ones walk as well: they
        stand for a model that is not the actuator, and a smoother spreads what they learn over the log.
    imu_noise : deviations of a_x, a_y [m/s^2] and g_z [rad/s] for this filter, which knows the head's
        accelerations; None for those of the set-up.
    """

    sigma: tuple[float, ...] = SIGMA
    sigma_force_N: float = 0.03
    sigma_disturbance_N: float = 0.01
    sigma_creep_N: float = 0.03
    sigma_turning_radps: float = 6.0
    walk_disturbance: float = 2.5e-4
    walk_rates: tuple[float, float] = (2e-3, 1e-4)
    walk_forces: float = 1e-4
    walk_switching: float = 0.0
    walk_parameters: float = 3.5e-3
    imu_noise: tuple[float, float, float] | None = None
    covariance: FloatArray | None = None

    def numbers(self) -> FloatArray:
        """The (22,) vector of `PLANT`."""
        one, two = pump_coefficients(self.pump)
        return np.array([*coefficients(self.plant), *one, two.lag_s], dtype=np.float64)

    def noise(self, setup: Setup) -> FloatArray:
        """The (11,) of `event.NOISE` for the driven filter."""
        noise = setup.noise.copy()
        if self.imu_noise is not None:
            noise[2:5] = self.imu_noise
        return noise

    def walk(self, setup: Setup) -> FloatArray:
        """Squared densities (37,) of the walk of the state, and of `walk_switching`."""
        moving = np.zeros(DYNAMIC)
        moving[2:4] = self.walk_rates
        moving[4:10] = self.walk_forces
        moving[10:12] = self.walk_disturbance
        parameters = self.walk_parameters * np.array(SIGMA)
        return np.concatenate([moving, parameters, setup.process.sensor_walk, [self.walk_switching]]) ** 2

    def start(self, setup: Setup) -> tuple[FloatArray, FloatArray]:
        """State (37,) and covariance (37, 37) before the first reading."""
        begin = setup.start
        x, sigma = np.zeros(len(DRIVEN)), np.zeros(len(DRIVEN))
        x[:4], sigma[:4] = begin.head[:4], begin.head_sigma[:4]
        sigma[2] = self.sigma_turning_radps
        sigma[4:6], sigma[6:10] = self.sigma_creep_N, self.sigma_force_N
        sigma[10:12] = self.sigma_disturbance_N
        sigma[DYNAMIC:INVOLVED] = self.sigma
        # With the hoses off or on, whichever it is.
        apart = (
            math.log(self.free_damping_scale / self.plant.damping_scale) if self.free_damping_scale else -1.0
        )
        at = DYNAMIC + PARAMETER.index("log_damping")
        x[at], sigma[at] = 0.5 * apart, math.hypot(0.5 * apart, self.sigma[1])
        x[INVOLVED:] = begin.sensor
        # Pictures are put at their exposure, so that what is left of the offset is zero.
        x[INVOLVED + 7] -= setup.delay_s
        P = np.diag(sigma**2)
        if self.covariance is not None:
            P[DYNAMIC:INVOLVED, DYNAMIC:INVOLVED] = self.covariance
            P[at, at] = sigma[at] ** 2
        P[INVOLVED:, INVOLVED:] = begin.covariance()[6:, 6:]
        return x, P

    def model(self, setup: Setup) -> Model:
        """All of it for the compiled functions."""
        return Model(
            *self.start(setup), self.numbers(), self.walk(setup), setup.view, self.noise(setup),
            setup.bellows_radius_m, setup.delay_s, setup.imu_delay_s,
            self.pump.delay_ticks * self.pump.tick_s, setup.command_period_s, self.sigma[1],
        )  # fmt: skip


class Switches(NamedTuple):
    """Times (n,) at which commands take effect, a ring, and what holds from each on (n, 4).

    That are the static forces of both pumps and the squared densities of the walks of their lags.
    """

    t: FloatArray
    g: FloatArray


class Model(NamedTuple):
    """What does not change: start (37,), (37, 37), plant (22,), walk, the camera's view, noise, and numbers.

    Attributes
    ----------
    delay, imu_delay : of pictures and of the IMU's readings [s]. action : how long after its tick a command
        acts [s]. period : as in `give`.
    hoses_sigma : deviation of the logarithm of the damping once the hoses are on. radius : of a bellows [m].
    """

    x0: FloatArray
    P0: FloatArray
    plant: FloatArray
    walk: FloatArray
    camera: FloatArray
    noise: FloatArray
    radius: float
    delay: float
    imu_delay: float
    action: float
    period: float
    hoses_sigma: float


def commands(drive: Drive, pwm: FloatArray, held: FloatArray | None = None) -> FloatArray:
    """Static forces (n, 2) [N] that commands (n, 2) settle at with nominal pumps; NaN without a command.

    `held` is that of `settling_force_N`.
    """
    known = np.isfinite(pwm).all(axis=1)
    out = np.full(pwm.shape, np.nan)
    out[known] = settling_force_N(drive.pump, pwm[known], drive.strength, held)
    return out


# ----------------------------------------------------------------------
# One event of the driven filter: a picture, an IMU sample, or the certainty that the hoses are on.
#
# Readings are those of `event`. The head's accelerations, which the accelerometer feels, are what the
# dynamics say of the state, so their gradients reach forces and parameters. What `kinematic.CONSIDERED` names
# of the geometry is considered and not learnt.

HOSES = 4
"""A kind of event beside those of `event`."""

LONGEST_S = 0.02
"""Longer steps are taken in parts."""

WORK = (26 + DYNAMIC + max(FLOW, CARRY) // SIZE_D, SIZE_D)
"""Shape of the scratch: p, x0, gradients, terms, segments, accelerations, F P, a smoother's report and gates,
what is learnt, and F."""

TRACE = 2 * SIZE_D + 2
"""Length of what a reading leaves; the last number is 0 where there was none."""

_ALONE = np.ones(1)
_MOST_DAMPED = 1.1
"""Limit of `log_damping`, three times the damping that is known: a head that is held is not in honey."""
_KNOWN_MPS = 3e-3
"""The accelerometer is left out until the length's rate is known so well."""
SETTLING_S = 0.3
"""For so long after a start it is left out too: it is not linear in what is not known yet."""
_MOST_SEGMENTS = 12
LONGEST_GAP_S = 2.0
"""A longer silence cuts a log."""
_SHIFT = INVOLVED - 6
"""The sensors' quantities stand this much further on than in `sensors`."""


@kernel(arrays=False)
def _consider(x: FloatArray, P: FloatArray, learnt: FloatArray) -> None:
    """Which entries of a state (37,) readings change: 1, and 0 for what is considered and not learnt.

    Considered is the geometry: place of the IMU, marker offset, shift and stretch of the plane. So is what
    multiplies a quantity that may be none: the product of both errors would pass for knowledge. At rest the
    damping went to seven times its value and the stiffness 30 % up, both sure of it. Of a head that does not
    move these are damping, mass and creep; stiffness, bending and pumps, too, where no pump holds it.
    """
    for k in range(x.shape[0]):
        learnt[k] = 1.0
    learnt[28], learnt[29], learnt[31], learnt[32], learnt[33], learnt[36] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if x[2] * x[2] > TELLING * P[2, 2] or x[3] * x[3] > TELLING * P[3, 3]:
        return
    learnt[13], learnt[20], learnt[21], learnt[22] = 0.0, 0.0, 0.0, 0.0
    pumped = x[8] + x[9]
    if pumped * pumped < TELLING * (P[10, 10] + P[11, 11]):
        learnt[12], learnt[14], learnt[15], learnt[16], learnt[17], learnt[18] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@kernel(arrays=False)
def give(
    switches: Switches, last: int, when: float, force1: float, force2: float, period: float, lag_s: float
) -> int:
    """Let a command take effect after the newest in the ring; returns its place, where all before it holds.

    Where commands are missing between the two, as of rows that were dropped, any of those may have been the
    first with the new force. In the mean it rises evenly, and from n missing ones T apart on the force that
    the lag has taken up is uncertain by (difference T / lag) sqrt(n (n + 2) / 12), here as a walk.

    Parameters
    ----------
    when, force1, force2 : its time [s] and static forces [N].
    period : T [s] of commands, NaN where each holds until the next. lag_s : of the pumps.
    """
    switch_t, switch_g = switches
    size, step = switch_t.shape[0], when - switch_t[last]
    missing = math.floor(step / period + 0.5) - 1.0 if period > 0.0 and step < LONGEST_GAP_S else 0.0
    if missing > 0.0:
        between = (last + 1) % size
        switch_t[between] = switch_t[last] + period
        for k in range(2):
            force = force1 if k == 0 else force2
            change = (force - switch_g[last, k]) / lag_s
            switch_g[between, k] = 0.5 * (force + switch_g[last, k])
            switch_g[between, 2 + k] = change * change * period * (missing + 2.0) / 12.0
        last = between
    to = (last + 1) % size
    switch_t[to] = max(when, switch_t[last])
    switch_g[to, 0], switch_g[to, 1], switch_g[to, 2], switch_g[to, 3] = force1, force2, 0.0, 0.0
    return int(to)


@kernel(arrays=False)
def cut(begin: float, end: float, switches: Switches, last: int, segments: FloatArray) -> int:
    """Segments of constant command between two times; returns their number.

    Parameters
    ----------
    segments : (`_MOST_SEGMENTS`, 5) durations, and what holds for so long.
    last : place of the newest. Before the oldest one the oldest holds.
    """
    switch_t, switch_g = switches
    size, back = switch_t.shape[0], 0
    while back < size - 1 and switch_t[(last - back) % size] > begin:
        back += 1
    count, now = 0, begin
    while True:
        at = (last - back) % size
        stop = end
        if back > 0 and count < _MOST_SEGMENTS - 1:
            stop = min(end, max(switch_t[(last - back + 1) % size], now))
        if stop > now or stop == end:
            segments[count, 0] = stop - now
            for k in range(4):
                segments[count, 1 + k] = switch_g[at, k]
            count += 1
            now = stop
        if stop == end or back == 0:
            return count
        back -= 1


@kernel(arrays=False)
def predict_driven(
    x: FloatArray, P: FloatArray, begin: float, end: float, model: Model, switches: Switches, last: int,
    F: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """Carry a state on from one time to another, in place; F (12, 23) is that of the last part."""
    if not end > begin:
        return
    parts = max(math.ceil((end - begin) / LONGEST_S - 1e-9), 1)
    h = (end - begin) / parts
    segments, moved = work[8:12].reshape(-1)[: 5 * _MOST_SEGMENTS].reshape(_MOST_SEGMENTS, 5), work[6]
    plant, walk, flow = model.plant, model.walk, work[37:].reshape(-1)
    for k in range(parts):
        count = cut(begin + k * h, begin + (k + 1) * h, switches, last, segments)
        jacobian(plant, x, segments, count, longest_step_s(plant, x), moved, F, flow)
        carry(P, F, walk, h, flow)
        for i in range(count):
            P[6, 6] += segments[i, 3] * segments[i, 0]
            P[7, 7] += segments[i, 4] * segments[i, 0]
        for i in range(2):
            change = moved[8 + i] - x[8 + i]
            P[10 + i, 10 + i] += walk[SIZE_D] * change * change / h
        for i in range(DYNAMIC):
            x[i] = moved[i]


@kernel(arrays=False)
def _spread_out(h: FloatArray, H: FloatArray) -> None:
    """A gradient (20,) by head and sensors as one by the driven state; accelerations are left out."""
    for k in range(4, INVOLVED):
        H[k] = 0.0
    for k in range(4):
        H[k] = h[k]
    for k in range(6, SIZE):
        H[k + _SHIFT] = h[k]


@kernel(arrays=False)
def measure(
    kind: int, x: FloatArray, P: FloatArray, model: Model, stamp: float, H: FloatArray, out: FloatArray,
    work: FloatArray,
) -> None:  # fmt: skip
    """Predicted readings out[0:3] and variances of their noise out[3:6]; H (3, 37) gets the gradients.

    `stamp` is the variance [s^2] of the event's time: what moves fast is not read where it was.
    """
    state, noise = work[0, :SIZE], model.noise
    state[0], state[1], state[2], state[3], state[4], state[5] = x[0], x[1], x[2], x[3], 0.0, 0.0
    for k in range(6, SIZE):
        state[k] = x[k + _SHIFT]
    h = work[6:8, :SIZE]
    h0, h1 = h[0], h[1]
    if kind == CAMERA:
        camera_terms(model.camera, noise, stamp, state, P, h, out)
        _spread_out(h0, H[0])
        _spread_out(h1, H[1])
        return
    by_phi, by_length = work[8], work[9]
    state[4], state[5] = accelerations(model.plant, x, by_phi, by_length, work[1])
    out[0], out[1] = accelerometer(state, h0, h1)
    tilt = x[0] + x[26]
    moved_x = out[0] - x[24] - GRAVITY_MPS2 * math.cos(tilt)
    moved_y = out[1] - x[25] - GRAVITY_MPS2 * math.sin(tilt)
    scale = accel_variance(noise, stamp, x[2], moved_x * moved_x + moved_y * moved_y)
    for k in range(2):
        _spread_out(h[k], H[k])
        for i in range(INVOLVED):
            H[k, i] += h[k, 4] * by_phi[i] + h[k, 5] * by_length[i]
        out[3 + k] = noise[2 + k] * noise[2 + k] + scale
    out[2] = gyroscope(state, h0)
    _spread_out(h0, H[2])
    if x[2] * x[2] < TELLING * P[2, 2]:
        H[2, 27] = 0.0
    out[5] = noise[4] * noise[4] + state[4] * state[4] * stamp


@kernel(arrays=False)
def driven_event(
    x: FloatArray, P: FloatArray, kind: int, z: FloatArray, model: Model, work: FloatArray, again: bool,
    report: FloatArray, gated: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """Update a predicted state by an event, in place.

    Parameters
    ----------
    kind, z : `CAMERA`, `IMU` or `HOSES` and (4,) its readings, NaN where missing, and the variance of its
        time [s^2]; of `HOSES` the deviation that the damping then has.
    work : scratch of the shape `WORK`. report : (12,) of `event.REPORT`, written to.
    again : whether the event is done once more; then `gated` (3,) holds.
    trace : (3, `TRACE`) what each reading did, for the smoother; (0, `TRACE`) for nothing.
    """
    trace[:, TRACE - 1] = 0.0
    if not again:
        report[:] = math.nan
    log_l, noise = 0.0, model.noise
    stamp = stamp_variance(kind, noise, z)
    H, p, out, e = work[2:5], work[0], work[5], work[10]
    learnt = work[24]
    _consider(x, P, learnt)
    if kind == HOSES:
        for k in range(x.shape[0]):
            H[0, k], p[k] = 0.0, P[k, 13]
        H[0, 13] = 1.0
        y, S = -x[13], P[13, 13] + z[0] * z[0]
        learnt[13] = 1.0
        update(x, P, y, S, p, learnt)
        leave(trace, 0, H[0], p, y, S)
    else:
        measure(kind, x, P, model, stamp, H, out, work)
        told = work[11:12]
        chi_squares(kind, P, H, z, out, noise, e, work[12:15], work[15:18], told[0], int(SIZE_D))
        if not again:
            judge(kind, z, told, noise, P[3, 3] < _KNOWN_MPS * _KNOWN_MPS, gated, report)
            tell(kind, _ALONE, told, report)
        log_l = absorb(
            kind, x, P, H, e, out, noise, gated, learnt, work[12:15], work[15:18], trace, int(SIZE_D)
        )
    x[13] = min(x[13], _MOST_DAMPED)
    report[11] = log_l


assert SIZE_D == 37


# ----------------------------------------------------------------------
# The driven filter, row by row: the dynamics with the commands as input, readings as they arrive.
#
# As in `kinematic` a picture belongs to its exposure, before IMU samples that have been used already; the
# last events are kept, the picture is put among them and those after it are done again. A command acts
# `delay_s` after the tick that gave it, so it is known in time.
#
# The first command that is not zero says that the hoses are on (`HOSES`); until then the damping may be that
# of either. When most readings are rejected for a tenth of a second, time jumps, or the state leaves the
# model, the filter starts again from the next picture.
#
# Somebody may hold the head, which the disturbance forces then do, and let it go. A sample of which neither
# gyroscope nor accelerometer agrees with the model is wrong, or comes after a release; the next one tells.
# Where it disagrees as well and is another one, as that of a gyroscope in saturation is not, the events since
# the last sample before the two are done again with a release at the time that the first of the two tells.
# Where both gyroscope readings then agree it was one, else all is as it was.

_LOCKED_OUT = 5.5
"""So many pictures rejected, IMU readings twice so many, and the filter starts again."""
_BEFORE_S = 0.03
_LOST_N = 0.5
"""Deviation of forces after a restart: a third of what a pump can do."""
_HELD_N = (0.4, 0.05)
"""What a hand may do: deviations of half the difference and half the sum of the forces."""
_LET_GO_RADPS = 0.3
"""What the head's rate is off by where it is let go at a time that one sample of the gyroscope tells."""
_LAST, _REJECTED, _FIRST, _REJECTED_IMU, _BEGUN = range(5)
_STARTED, _PENDING, _SWITCH, _HOSES = range(2, 6)
_SWITCHES = 128
_LET_GO = OUT.index("let_go_s")
SILENT_S = 0.1
"""A row so long after the last reading carries the state on with it."""


@kernel(arrays=False)
def write_row(x: FloatArray, P: FloatArray, dt: float, radius: float, out: FloatArray, row: int) -> None:
    """Mean and deviations a very short time dt after the state into columns 1 to 12."""
    pp = P[0, 0] + dt * (2.0 * P[0, 2] + dt * P[2, 2])
    ll = P[1, 1] + dt * (2.0 * P[1, 3] + dt * P[3, 3])
    pl = P[0, 1] + dt * (P[0, 3] + P[1, 2] + dt * P[2, 3])
    finish_row(x[0] + dt * x[2], x[1] + dt * x[3], x[2], x[3], x[INVOLVED], pp, ll, pl, radius, out, row)


@kernel(arrays=False)
def begin_again(
    x: FloatArray, P: FloatArray, model: Model, z: FloatArray, again: bool, driven: bool, g: FloatArray
) -> bool:
    """Start a state (37,) from its prior and a picture z; what has been learnt may be wrong and goes.

    A log begins at rest. In its middle, `again`, the forces may be anything: those of the pumps, most likely
    the static ones of the last command, g (4,), or where nothing was `driven` yet those of a hand. The hoses
    of what is `driven` are on.
    """
    x0, P0 = model.x0, model.P0
    phi, length, found = invert_marker(model.camera, x0[INVOLVED:], z[0], z[1], 0.0, x0[1])
    if not (found and 0.2 * x0[1] < length < 3.0 * x0[1]):
        return False
    copy_state(x, P, x0, P0)
    x[0], x[1] = phi, length
    if again:
        x[6], x[7], x[8], x[9] = g[0], g[1], g[0], g[1]
        for i in range(4, 10 if driven else 4):
            P[i, i] = _LOST_N * _LOST_N
        if not driven:
            across, along = _HELD_N[0] * _HELD_N[0], _HELD_N[1] * _HELD_N[1]
            P[10, 10], P[11, 11] = along + across, along + across
            P[10, 11], P[11, 10] = along - across, along - across
    if driven:
        x[13], P[13, 13] = 0.0, model.hoses_sigma * model.hoses_sigma
    return True


@kernel(arrays=False)
def contradicted(z: FloatArray, gated: FloatArray) -> bool:
    """Whether a sample's gyroscope contradicts a state and its accelerometer does not support it."""
    return bool(not math.isnan(z[2]) and gated[1] == 1.0 and gated[2] == 1.0)


@kernel(arrays=False)
def let_go_time(
    x: FloatArray, g_z: float, begin: float, end: float, plant: FloatArray, work: FloatArray
) -> float:
    """When, between two times, a head of this state was let go that turns at the end as a sample says."""
    own1, own2 = x[10], x[11]
    x[10], x[11] = 0.0, 0.0
    ddphi, _ = accelerations(plant, x, work[8], work[9], work[1])
    x[10], x[11] = own1, own2
    turned = (x[23] - g_z) / (1.0 + x[27]) - x[2]
    since = turned / ddphi if ddphi * turned > 0.0 else 0.0
    return float(end - min(since, end - begin))


@kernel(arrays=False)
def pass_on(
    x: FloatArray, P: FloatArray, begin: float, end: float, let_go_s: float, model: Model,
    switches: Switches, last: int, F: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """`predict_driven` for a head that is let go at a time between, or NaN; F (12, 23) is that of the whole.

    What held it were the disturbance forces. They are as at the beginning of a log from then on.
    """
    if math.isnan(let_go_s):
        predict_driven(x, P, begin, end, model, switches, last, F, work)
        return
    held, row = work[25:], work[0]
    _stand(F)
    predict_driven(x, P, begin, let_go_s, model, switches, last, F, work)
    for i in range(DYNAMIC):
        for j in range(INVOLVED):
            held[i, j] = F[i, j] if i < 10 else 0.0
    for i in range(10, DYNAMIC):
        for j in range(x.shape[0]):
            P[i, j], P[j, i] = 0.0, 0.0
    for i in range(10, DYNAMIC):
        x[i], P[i, i] = model.x0[i], model.P0[i, i]
    P[2, 2] += _LET_GO_RADPS * _LET_GO_RADPS
    _stand(F)
    predict_driven(x, P, let_go_s, end, model, switches, last, F, work)
    for i in range(DYNAMIC):
        for j in range(INVOLVED):
            row[j] = F[i, j] if j >= DYNAMIC else 0.0
            for k in range(DYNAMIC):
                row[j] += F[i, k] * held[k, j]
        for j in range(INVOLVED):
            F[i, j] = row[j]


@kernel(arrays=False)
def _stand(F: FloatArray) -> None:
    """The transition (12, 23) of no time."""
    for i in range(DYNAMIC):
        for j in range(INVOLVED):
            F[i, j] = 1.0 if i == j else 0.0


@kernel(arrays=False)
def sound(x: FloatArray, P: FloatArray, radius: float) -> bool:
    """Whether a state is one that a rig can have."""
    good = abs(x[0]) < 3.0 and 1e-3 < x[1] < 1.0 and abs(x[3]) + radius * abs(x[2]) < FASTEST_MPS
    for i in range(x.shape[0]):
        good = good and abs(x[i]) < 1e4 and 0.0 < P[i, i] < 1e6
        good = good and abs(P[0, i]) + abs(P[1, i]) + abs(P[2, i]) + abs(P[3, i]) < 1e6
    return bool(good)


class Memory(NamedTuple):
    """What the filter remembers beside the last events.

    Attributes
    ----------
    x, P : (size, 36), (size, 36, 36) states after the last events.
    whole, real : (6,) `NEWEST`, `COUNT`, and from `_STARTED` on; (5,) from `_LAST` on.
    switches : of commands, the newest at `whole[_SWITCH]`.
    camera_clock, imu_clock : of `kinematic.new_clock`.
    """

    x: FloatArray
    P: FloatArray
    whole: IntArray
    real: FloatArray
    switches: Switches
    camera_clock: FloatArray
    imu_clock: FloatArray


class Room(NamedTuple):
    """Scratch: a reading (4,), two reports (12,), a state, the transition of `predict_driven`, and `WORK`."""

    z: FloatArray
    report: FloatArray
    spare: FloatArray
    x: FloatArray
    P: FloatArray
    F: FloatArray
    work: FloatArray
    untraced: FloatArray


@kernel(arrays=False)
def _due(
    turn: int, stamp: float, tick: float, taken: float, readings: FloatArray, kinds: int, driven: float,
    events: Events, memory: Memory, model: Model, z: FloatArray,
) -> tuple[int, float]:  # fmt: skip
    """Kind and time of the event that a row brings in a turn, with its reading in z; -1 for none.

    In turn come the hoses, of which the first command tells, a picture, a sample of the IMU, and, a while
    after the last reading, the state itself, one picture behind.
    """
    whole = memory.whole
    if turn == 0:
        # Its own event, so that it is done again with those around it.
        if whole[_HOSES] == 1 or not driven > 0.0:
            return -1, 0.0
        whole[_HOSES] = 1
        z[0], z[1], z[2], z[3] = model.hoses_sigma, math.nan, math.nan, 0.0
        return HOSES, tick
    if turn == 1:
        if not kinds & 1 or math.isnan(readings[0]) or math.isnan(readings[1]):
            return -1, 0.0
        z[0], z[1], z[2], z[3] = readings[0], readings[1], math.nan, memory.camera_clock[3]
        return CAMERA, tick - model.delay
    if turn == 2:
        if not kinds & 2:
            return -1, 0.0
        when = advance(memory.imu_clock, taken) - model.imu_delay
        z[0], z[1], z[2], z[3] = readings[2], readings[3], readings[4], memory.imu_clock[3]
        if math.isnan(z[2]) and (math.isnan(z[0]) or math.isnan(z[1])):
            return -1, 0.0
        return IMU, when
    if whole[COUNT] == 0 or not stamp - events.t[whole[NEWEST]] > model.delay + SILENT_S:
        return -1, 0.0
    return 0, stamp - model.delay


@kernel(arrays=False)
def _waits(kind: int, when: float, whole: IntArray, real: FloatArray) -> bool:
    """Whether the filter, which has not started or starts again, may begin at an event."""
    waits = whole[_STARTED] == 0 or whole[_PENDING] == 1
    # Who holds the head until the log begins is not in the model.
    return bool(kind == CAMERA and waits and when > real[_FIRST] + _BEFORE_S)


@kernel(arrays=False)
def _begun(
    x: FloatArray, P: FloatArray, when: float, z: FloatArray, whole: IntArray, real: FloatArray, model: Model,
    g: FloatArray,
) -> bool:  # fmt: skip
    """Begin at a picture z if it shows a head that a rig can have; g as of `begin_again`."""
    if not begin_again(x, P, model, z, not math.isnan(real[_BEGUN]), whole[_HOSES] == 1, g):
        return False
    whole[_STARTED], whole[_PENDING], real[_BEGUN] = 1, 0, when
    return True


@kernel(arrays=False)
def _count_rejected(report: FloatArray, whole: IntArray, real: FloatArray) -> None:
    """Count what an event's report says of rejected readings; after many the filter starts again."""
    for k in range(3):
        at = _REJECTED if k == 0 else _REJECTED_IMU
        if report[8 + k] == 1.0:
            real[at] += 1.0
        elif report[8 + k] == 0.0:
            real[at] *= 0.7
    if real[_REJECTED] > _LOCKED_OUT or real[_REJECTED_IMU] > 2.0 * _LOCKED_OUT:
        whole[_PENDING], real[_REJECTED], real[_REJECTED_IMU] = 1, 0.0, 0.0


@kernel(arrays=False)
def _do_again(
    own: int, first: int, begin: bool, afresh: bool, events: Events, memory: Memory, model: Model, room: Room
) -> int:
    """Do the last events again, from `first` before the newest on; returns flags.

    Parameters
    ----------
    own : place of the event that is new, which `begin` says the filter may begin at.
    afresh : whether those that were done before are gated anew.
    """
    whole, real, switches = memory.whole, memory.real, memory.switches
    size, flags = events.t.shape[0], 0
    for i in range(first + 1):
        now = (whole[NEWEST] + 1 - first + i) % size
        before = (now - 1) % size
        x, P, z, gated = memory.x[now], memory.P[now], events.z[now], events.gated[now]
        copy_state(x, P, memory.x[before], memory.P[before])
        if whole[_STARTED] == 1:
            pass_on(
                x, P, events.t[before], events.t[now], events.let_go[now], model, switches, whole[_SWITCH],
                room.F, room.work,
            )  # fmt: skip
        started = whole[_STARTED] == 1
        if now == own and begin:
            g = switches.g[whole[_SWITCH]]
            flags |= int(_begun(x, P, events.t[now], z, whole, real, model, g) and started)
        if events.kind[now] == IMU and events.t[now] < real[_BEGUN] + SETTLING_S:
            z[0], z[1], gated[1] = math.nan, math.nan, 1.0
        if (whole[_STARTED] == 0 and events.kind[now] != HOSES) or events.kind[now] == 0:
            if now == own:
                room.report[:] = math.nan
            gated[:] = 1.0
            continue
        driven_event(
            x, P, events.kind[now], z, model, room.work, not (afresh or now == own),
            room.report if now == own else room.spare, gated, room.untraced,
        )  # fmt: skip
        if not sound(x, P, model.radius):
            copy_state(x, P, model.x0, model.P0)
            whole[_PENDING] = 1
            flags |= 1
    return flags


@kernel(arrays=False)
def _suspects(own: int, events: Events, count: int) -> tuple[int, int]:
    """How far back the first of two samples is that contradict the model, and the last one before them.

    The second of the two is `own`; 0, 0 where there are no two, or their rates are the same.
    """
    size, suspect = events.t.shape[0], 0
    if not contradicted(events.z[own], events.gated[own]):
        return 0, 0
    for i in range(1, count - 1):
        now = (own - i) % size
        if events.kind[now] != IMU:
            continue
        if suspect > 0:
            return (0, 0) if events.z[(own - suspect) % size, 2] == events.z[own, 2] else (suspect, i)
        if not contradicted(events.z[now], events.gated[now]):
            return 0, 0
        suspect = i
    return 0, 0


@kernel(arrays=False)
def _taken(
    own: int, back: int, begin: bool, events: Events, memory: Memory, model: Model, room: Room
) -> tuple[int, float]:
    """Do a new event and the `back` ones after it; flags, and when the head was let go, NaN if it was not.

    They are done again where two samples say that the head was let go, and once more where it was not.
    """
    flags, size = _do_again(own, back, begin, False, events, memory, model, room), events.t.shape[0]
    settled = events.t[own] > memory.real[_BEGUN] + SETTLING_S
    if back > 0 or events.kind[own] != IMU or not settled:
        return flags, math.nan
    suspect, since = _suspects(own, events, memory.whole[COUNT])
    if since == 0:
        return flags, math.nan
    before, first = (own - since) % size, (own - suspect) % size
    let_go_s = let_go_time(
        memory.x[before], events.z[first, 2], events.t[before], events.t[first], model.plant, room.work
    )
    for i in range(suspect, since):
        now = (own - i) % size
        if events.t[(now - 1) % size] <= let_go_s:
            events.let_go[now] = let_go_s
            break
    flags |= _do_again(own, since - 1, False, True, events, memory, model, room)
    if not events.gated[first, 2] + events.gated[own, 2] > 0.0:
        return flags, let_go_s
    for i in range(since):
        events.let_go[(own - i) % size] = math.nan
    return flags | _do_again(own, since - 1, False, True, events, memory, model, room), math.nan


@kernel(arrays=False)
def run_driven(
    t: FloatArray, taken: FloatArray, readings: FloatArray, kinds: IntArray, forces: FloatArray,
    driven: FloatArray, events: Events, memory: Memory, model: Model, room: Room, out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n,), (n, 5), (n,), (n, 2), (n,) through the ring of the last events; writes `out`.

    `driven` says whether a row's command drives the pumps.
    """
    whole, real, size, switches = memory.whole, memory.real, events.t.shape[0], memory.switches
    for row in range(len(t)):
        stamp, flags = t[row], 0
        if begin_row(stamp, real[_LAST], memory.camera_clock, memory.imu_clock, out, row):
            whole[COUNT], whole[_STARTED], whole[_PENDING] = 0, 0, 0
            for k in range(len(switches.t)):
                switches.t[k] = -math.inf
                for i in range(2):
                    switches.g[k, i], switches.g[k, 2 + i] = switches.g[whole[_SWITCH], i], 0.0
            real[_REJECTED], real[_REJECTED_IMU], real[_FIRST] = 0.0, 0.0, stamp
            flags |= 32
        elif math.isnan(real[_LAST]):
            real[_REJECTED], real[_REJECTED_IMU], real[_FIRST] = 0.0, 0.0, stamp
        real[_LAST] = stamp
        tick = advance(memory.camera_clock, taken[row]) if kinds[row] & 1 else stamp
        if not math.isnan(forces[row, 0]):
            whole[_SWITCH] = give(
                switches, whole[_SWITCH], tick + model.action, forces[row, 0], forces[row, 1], model.period,
                model.plant[17],
            )  # fmt: skip
        for turn in range(4):
            kind, when = _due(
                turn, stamp, tick, taken[row], readings[row], kinds[row], driven[row], events, memory, model,
                room.z,
            )  # fmt: skip
            if kind < 0:
                continue
            newest = whole[NEWEST]
            count_first(events, whole, when)
            back = make_room(events, whole, kind, when)
            if back < 0:
                flags |= 16
                continue
            own = (newest + 1 - back) % size
            when, events.let_go[own] = events.t[own], math.nan
            after = (own + 1) % size
            if back > 0 and events.let_go[after] < when:
                events.let_go[own], events.let_go[after] = events.let_go[after], math.nan
            for k in range(4):
                events.z[own, k] = room.z[k]
            begin = _waits(kind, when, whole, real)
            found, let_go_s = _taken(own, back, begin, events, memory, model, room)
            flags |= found
            if not math.isnan(let_go_s):
                out[row, _LET_GO] = let_go_s
            report = room.report
            if kind == HOSES or kind == 0:
                report[:] = math.nan
            settle_event(whole, size, report, out, row)
            _count_rejected(report, whole, real)
        here = whole[NEWEST]
        ahead = stamp - events.t[here] if whole[COUNT] > 0 else 0.0
        if whole[_STARTED] == 0:
            flags |= 64
        if ahead > 1e-3 and whole[_STARTED] == 1:
            copy_state(room.x, room.P, memory.x[here], memory.P[here])
            predict_driven(
                room.x, room.P, events.t[here], stamp, model, switches, whole[_SWITCH], room.F, room.work
            )
            if not sound(room.x, room.P, model.radius):
                copy_state(room.x, room.P, model.x0, model.P0)
            write_row(room.x, room.P, 0.0, model.radius, out, row)
        else:
            back_s = min(max(ahead, -max(model.delay, 1e-3)), 1e-3)
            write_row(memory.x[here], memory.P[here], back_s, model.radius, out, row)
        out[row, 25] = flags


class DrivenFilter:
    """A driven filter at work: rows in, estimates out, with memory of the last events only."""

    sensor = None
    """Unlike that of `Filter` it says nothing of the calibration: the plant has a say in it."""

    def __init__(self, setup: Setup, drive: Drive) -> None:
        self.setup, self.drive = setup, drive
        self._held = np.zeros((2, 2))
        size, n = setup.ring, len(DRIVEN)
        self._events = no_events(size, np.full(size, np.nan))
        self._memory = Memory(
            np.zeros((size, n)), np.zeros((size, n, n)), np.zeros(6, dtype=np.int64), np.full(5, np.nan),
            Switches(np.full(_SWITCHES, -np.inf), np.zeros((_SWITCHES, 4))),
            new_clock(setup.camera_period_s), new_clock(setup.imu_period_s),
        )  # fmt: skip
        self._model = drive.model(setup)
        self._memory.x[0], self._memory.P[0] = self._model.x0, self._model.P0
        self._room = Room(
            np.empty(4), np.empty(12), np.empty(12), np.empty(n), np.empty((n, n)),
            np.zeros((DYNAMIC, INVOLVED)), np.zeros(WORK), np.empty((0, TRACE)),
        )  # fmt: skip

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        pwm, out = rows.commands, np.empty((len(rows), len(OUT)))
        driven = np.asarray(np.nan_to_num(pwm).max(axis=1, initial=0.0), dtype=np.float64)
        forces = commands(self.drive, pwm, self._held)
        run_driven(
            rows.t_s, rows.taken_s, rows.readings, rows.kinds, forces, driven, self._events, self._memory,
            self._model, self._room, out,
        )  # fmt: skip
        return out

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (37,) and covariance (37, 37) after the last event."""
        here = int(self._memory.whole[NEWEST])
        return self._memory.x[here].copy(), self._memory.P[here].copy()

    @property
    def longer_m(self) -> tuple[float, float] | None:
        """By how much the actuator is longer than identified, and that value's deviation; None without."""
        at, before = DYNAMIC + PARAMETER.index("rest_length_m"), self._model
        if self.drive.covariance is None:
            return None
        return float(self.state[0][at] - before.x0[at]), math.sqrt(before.P0[at, at])


assert SIZE == 20


# ----------------------------------------------------------------------
# The driven smoother: forward with the commands, backward by Bryson and Frazier (1963).
#
# Events stand in the order of their times as in `smoother`, pictures at their exposure. The forward pass
# leaves what each reading did, and for each step the transition F of `jacobian`; backward each reading with
# the gain k, L = I - k H, turns y into L' y + H' innovation / S and Y into L' Y L + H' H / S, each step turns
# them into F' y and F' Y F, and
#
#     x_N = x + P y,   P_N = P - P Y P.
#
# Nothing is inverted. F' only shrinks what a damped actuator forgets, where the F^-1 that is hidden in the
# gain of Rauch, Tung and Striebel (1965) lets it grow. k is the whole gain, also for what is considered and
# not learnt: Y is then at most P^-1 of a filter that learns it, so that P_N is positive.
#
# Only twelve of the states move, the others are carried over as they are. Where the forward filter starts
# again, or the log is silent for longer than `LONGEST_GAP_S`, the chain is cut: what comes later says nothing
# of what was before. The backward pass begins anew every `WINDOW` events, from events `OVERLAP` further on.

WINDOW, OVERLAP = 6000, 3000
_SHOWN = np.array([0, 1, 2, 3, INVOLVED])
"""States that the output needs: the motion and the gyroscope's bias."""


@kernel(arrays=False)
def _forward(
    t: FloatArray, before_s: float, kinds: IntArray, readings: FloatArray, x: FloatArray, P: FloatArray,
    whole: IntArray, real: FloatArray, switches: Switches, model: Model, kept_x: FloatArray,
    kept_P: FloatArray, trace: FloatArray, F: FloatArray, chained: BoolArray, alive: BoolArray,
    let_go_s: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """The filter over events, keeping what is shown; state and counters are those after the last one.

    `whole` and `real` are of `Memory`; `let_go_s` (n,) has the time of a release in the event whose step it
    is in.
    """
    report, gated, last = work[18, :12], work[19, :3], 0
    for k in range(len(t)):
        begin = t[k - 1] if k else before_s
        while last < len(switches.t) - 1 and switches.t[last + 1] <= t[k]:
            last += 1
        while last > 0 and switches.t[last] > t[k]:
            last -= 1
        kind, z = kinds[k], readings[k]
        chained[k] = False
        trace[k, :, TRACE - 1] = 0.0
        if t[k] - begin > LONGEST_GAP_S:
            whole[_STARTED], whole[_PENDING], real[_REJECTED], real[_REJECTED_IMU] = 0, 0, 0.0, 0.0
        if whole[_STARTED] == 1:
            _stand(F[k])
            pass_on(x, P, begin, t[k], let_go_s[k], model, switches, last, F[k], work)
            chained[k] = True
        if kind == HOSES:
            whole[_HOSES] = 1
        if _waits(kind, t[k], whole, real) and _begun(x, P, t[k], z, whole, real, model, switches.g[last]):
            chained[k] = False
        if kind == IMU and t[k] < real[_BEGUN] + SETTLING_S:
            z[0], z[1] = math.nan, math.nan
        if whole[_STARTED] == 1 and kind != 0:
            driven_event(x, P, kind, z, model, work, False, report, gated, trace[k])
            _count_rejected(report, whole, real)
            if not sound(x, P, model.radius):
                copy_state(x, P, model.x0, model.P0)
                chained[k] = False
                whole[_PENDING] = 1
        for i in range(len(_SHOWN)):
            kept_x[k, i] = x[_SHOWN[i]]
            for j in range(len(x)):
                kept_P[k, i, j] = P[_SHOWN[i], j]
        alive[k] = whole[_STARTED] == 1


@kernel(arrays=False)
def _undo_step(y: FloatArray, Y: FloatArray, F: FloatArray, FY: FloatArray) -> None:
    """F' y and F' Y F for the transition F (12, 23) of a step, in place; FY (24, 36) is scratch."""
    n, moved = y.shape[0], FY[INVOLVED]
    for i in range(INVOLVED):
        moved[i] = y[i] if i >= DYNAMIC else 0.0
        for j in range(n):
            FY[i, j] = Y[i, j] if i >= DYNAMIC else 0.0
        for m in range(DYNAMIC):
            slope = F[m, i]
            moved[i] += slope * y[m]
            for j in range(n):
                FY[i, j] += slope * Y[m, j]
    for i in range(INVOLVED):
        y[i] = moved[i]
        for j in range(n):
            Y[i, j] = FY[i, j] if j >= DYNAMIC else 0.0
        for m in range(DYNAMIC):
            slope = FY[i, m]
            for j in range(INVOLVED):
                Y[i, j] += slope * F[m, j]
        for j in range(INVOLVED, n):
            Y[j, i] = Y[i, j]


@kernel()
def _backward(
    t: FloatArray, F: FloatArray, trace: FloatArray, chained: BoolArray, rows: IntArray, kept_x: FloatArray,
    kept_P: FloatArray,
) -> None:  # fmt: skip
    """Over what `_forward` kept, in place; of kept_P (n, 5, 36) the first five columns become smoothed ones.

    `rows` tells at which events (>= 0) states are wanted.
    """
    n = kept_P.shape[2]
    y, Y, part, FY = np.zeros(n), np.zeros((n, n)), np.empty(n), np.empty((INVOLVED + 1, n))
    # A literal would be a type of its own, and its functions compiled for it.
    spread = n > 0
    for k in range(len(t) - 1, -1, -1):
        if rows[k] >= 0:
            look_back(kept_x[k], kept_P[k], y, Y, part, spread)
        undo_readings(trace[k], y, Y, part, spread)
        if not chained[k]:
            y[:], Y[:] = 0.0, 0.0
        elif k and t[k] > t[k - 1]:
            _undo_step(y, Y, F[k], FY)


@kernel()
def _switches(t: FloatArray, forces: FloatArray, period: float, lag_s: float) -> Switches:
    """All that `give` makes of commands with static forces (n, 2) that take effect at the times t (n,)."""
    made, last = Switches(np.full(2 * len(t) + 1, -np.inf), np.zeros((2 * len(t) + 1, 4))), 0
    for k in range(len(t)):
        last = give(made, last, t[k], forces[k, 0], forces[k, 1], period, lag_s)
    return Switches(made.t[: last + 1], made.g[: last + 1])


def _timeline(
    setup: Setup, drive: Drive, rows: Rows
) -> tuple[FloatArray, IntArray, FloatArray, IntArray, Switches]:
    """Times, kinds, readings (n, 4) and rows of all events, and when commands act with their forces."""
    events, pwm = events_of(setup, rows), rows.commands
    forces = commands(drive, pwm)
    ticks = rows.t_s.copy()
    camera = np.nonzero(rows.kinds & 1)[0]
    ticks[camera] = even_times(new_clock(setup.camera_period_s), rows.taken_s[camera])[0]
    given = np.isfinite(forces[:, 0])
    action = drive.pump.delay_ticks * drive.pump.tick_s
    switches = _switches(ticks[given] + action, forces[given], setup.command_period_s, drive.pump.lag_s)
    t, kinds, at, readings = events.t_s, events.kinds, events.rows, events.readings
    extra_t, extra_kind = [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    driven = np.nonzero(np.nan_to_num(pwm).max(axis=1, initial=0.0) > 0.0)[0]
    if len(driven):
        extra_t.append(ticks[driven[:1]])
        extra_kind.append(np.array([HOSES]))
    for k in np.nonzero(np.diff(t) > 0.95 * LONGEST_S)[0]:
        # No step is taken in parts, so that each has one transition. Longer silences are a cut.
        gap = t[k + 1] - t[k]
        if gap <= LONGEST_GAP_S:
            fill = np.linspace(t[k], t[k + 1], math.ceil(gap / (0.95 * LONGEST_S)) + 1)[1:-1]
            extra_t.append(fill)
            extra_kind.append(np.zeros(len(fill), dtype=np.int64))
    more_t, more_kind = np.concatenate(extra_t), np.concatenate(extra_kind)
    more = np.zeros((len(more_t), 4))
    more[:, 0] = drive.sigma[1]
    order = np.argsort(np.concatenate([t, more_t]), kind="stable")
    readings = np.concatenate([readings, more])[order]
    kinds = np.concatenate([kinds, more_kind])[order]
    at = np.concatenate([at, np.full(len(more_t), -1)])[order]
    return np.concatenate([t, more_t])[order], kinds, readings, at, switches


def smooth_driven(setup: Setup, drive: Drive, rows: Rows, outputs: FloatArray) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) at the rows' stamps; NaN where the filter had not started.

    Parameters
    ----------
    outputs : (n, len(OUT)) of the driven filter; what it says of innovations and flags is kept, and where it
        says that the head was let go, it was.
    """
    t, kinds, readings, at, switches = _timeline(setup, drive, rows)
    model = drive.model(setup)
    x, P = model.x0.copy(), model.P0.copy()
    whole, real = np.zeros(6, dtype=np.int64), np.array([0.0, 0.0, 0.0, 0.0, np.nan])
    real[_FIRST] = rows.t_s[0] - setup.delay_s if len(rows) else 0.0
    out = outputs.copy()
    out[:, 1:13] = np.nan
    n, size, shown, work = len(t), len(DRIVEN), len(_SHOWN), np.zeros(WORK)
    let_go_s, told = np.full(n + 1, np.nan), outputs[np.isfinite(outputs[:, _LET_GO]), _LET_GO]
    let_go_s[np.searchsorted(t, told, side="right")] = told
    begin, before = 0, float(t[0]) if n else 0.0
    while begin < n:
        end = min(begin + WINDOW, n)
        stop = min(end + OVERLAP, n)
        part, count = slice(begin, stop), stop - begin
        kept_x, kept_P = np.empty((count, shown)), np.empty((count, shown, size))
        trace, F = np.empty((count, 3, TRACE)), np.empty((count, DYNAMIC, INVOLVED))
        chained, alive = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        state = x, P, whole, real
        for first, behind in ((begin, end), (end, stop)):
            of, to = slice(first, behind), slice(first - begin, behind - begin)
            _forward(
                t[of], before, kinds[of], readings[of], *state, switches, model, kept_x[to], kept_P[to],
                trace[to], F[to], chained[to], alive[to], let_go_s[of], work,
            )  # fmt: skip
            # The next window begins with the state at `end`; what is beyond only looks back.
            before, state = float(t[end - 1]), (x.copy(), P.copy(), whole.copy(), real.copy())
        wanted = np.where(alive & (kinds[part] == 0), at[part], -1)
        wanted[end - begin :] = -1
        _backward(t[part], F, trace, chained, wanted, kept_x, kept_P)
        some = np.nonzero(wanted >= 0)[0]
        write_columns(kept_x[some], kept_P[some], shown - 1, wanted[some], setup.bellows_radius_m, out)
        begin = end
    # As in `smooth`: readings that lie carry it away, and there the kinematic model speaks.
    out[~(np.abs(out[:, 3:5]) < FASTEST_MPS).all(axis=1), 1:13] = np.nan
    return out


# ----------------------------------------------------------------------
# Which of two models speaks: the driven one while it explains the pictures, else the kinematic one.
#
# Both filters predict every picture. With s the sum over pictures of the log likelihood of the driven filter
# minus that of the kinematic one, each term cut to +-`CUT` and forgotten over `MEMORY_S`, the driven one's
# weight is
#
#     w = 1 / (1 + exp(-(s - OFFSET) / SOFT)).
#
# Pictures are compared since they alone see the length. Likelihoods only compare two predictions, though, and
# a wrong model of the plant may still predict better than one that knows nothing. So the driven filter must
# agree with itself as well: over what is in memory the mean of each sensor's innovations, which a wrong force
# moves first, and their mean square are chi-square, and what they exceed that by is taken from s. A restart
# or a reading that only the driven filter rejects counts against it too, a picture that only the kinematic
# one rejects for it.
#
# Means are mixed by the weight, and what they differ by is added to the covariance.

HANDOVER_STATE = 14
"""Entries: time, s, and for each sensor a count, the sum of NIS and the sums of its innovations."""

CUT, MEMORY_S = 6.0, 1.0
OFFSET, SOFT = -4.0, 1.5
AGAIN, BEGIN = -40.0, -12.0
"""s after a restart, and at the first start of a filter that has to find its state; a smoother has not."""
PULLED, PULL = 10.0, 0.5
EXCEEDED, EXCESS = 0.25, 20.0
_E, _NIS, _GATED, _LL, _FLAGS = (
    OUT.index(name) for name in ("e_u", "nis_camera", "gated_camera", "log_likelihood", "flags")
)


def new_handover() -> FloatArray:
    """Memory of `weigh` before the first row."""
    memory = np.zeros(HANDOVER_STATE)
    memory[0] = np.nan
    return memory


@kernel()
def _distrust(memory: FloatArray) -> float:
    """What the driven filter's innovations in memory cost it."""
    cost = 0.0
    for sensor in range(3):
        at = 2 + 4 * sensor
        count = memory[at]
        if count < 6.0:
            continue
        # Of white innovations (sum)^2 / count is chi-square with one degree for each axis.
        pull = (memory[at + 2] ** 2 + memory[at + 3] ** 2) / count
        cost += PULL * max(pull - PULLED, 0.0)
        degrees = 1.0 if sensor == 2 else 2.0
        excess = memory[at + 1] / (degrees * count) - 1.0
        cost += EXCESS * max(excess - 4.0 / math.sqrt(degrees * count) - EXCEEDED, 0.0)
    return cost


@kernel()
def weigh(
    driven: FloatArray, kinematic: FloatArray, memory: FloatArray, begin: float, weight: FloatArray
) -> None:
    """Weight (n,) of the driven model after each row of both outputs (n, len(OUT)).

    `begin` is s where the driven filter has not started.
    """
    for row in range(len(driven)):
        t = driven[row, 0]
        step = t - memory[0] if t > memory[0] else 0.0
        memory[0] = t
        keep = math.exp(-step / MEMORY_S)
        for k in range(1, HANDOVER_STATE):
            memory[k] *= keep
        gated, other = driven[row, _GATED], kinematic[row, _GATED]
        if gated == 0.0 and other == 0.0:
            difference = driven[row, _LL] - kinematic[row, _LL]
            memory[1] += min(max(difference, -CUT), CUT)
        elif gated == 1.0 and other == 0.0:
            memory[1] -= CUT
        elif gated == 0.0 and other == 1.0:
            memory[1] += CUT
        for sensor in range(3):
            at, e = 2 + 4 * sensor, _E + 2 * sensor
            if driven[row, _GATED + sensor] == 0.0:
                memory[at] += 1.0
                memory[at + 1] += driven[row, _NIS + sensor]
                memory[at + 2] += driven[row, e]
                if sensor < 2:
                    memory[at + 3] += driven[row, e + 1]
            elif driven[row, _GATED + sensor] == 1.0 and kinematic[row, _GATED + sensor] == 0.0:
                memory[1] -= 0.5 * CUT
        flags = int(driven[row, _FLAGS])
        if flags & 97:
            # Restarted, time jumped, or not started.
            memory[1:] = 0.0
            memory[1] = AGAIN if flags & 33 else begin
        s = memory[1] - _distrust(memory)
        weight[row] = 1.0 / (1.0 + math.exp(min(max(-(s - OFFSET) / SOFT, -40.0), 40.0)))


@kernel()
def _positions(out: FloatArray) -> None:
    for k in range(len(out)):
        out[k, 7], out[k, 8] = head_position(out[k, 5], out[k, 6])


def blended(driven: FloatArray, kinematic: FloatArray, weight: FloatArray) -> FloatArray:
    """Both outputs (n, len(OUT)) mixed by the weight (n,) of the driven one, which is written beside them.

    Innovations and gates are those of the filter that has the greater weight, flags of the kinematic one.
    """
    w = np.where(np.isfinite(driven[:, 5]), weight, 0.0)
    driven = np.where((w > 0.0)[:, None], driven, kinematic)
    out = np.where((w >= 0.5)[:, None], driven, kinematic)
    columns = [1, 2, 3, 4, 5, 6, 9]
    out[:, columns] = w[:, None] * driven[:, columns] + (1.0 - w)[:, None] * kinematic[:, columns]
    _positions(out)
    for sigma, value in ((10, 1), (11, 2), (12, 5)):
        apart = driven[:, value] - kinematic[:, value]
        variance = w * driven[:, sigma] ** 2 + (1.0 - w) * kinematic[:, sigma] ** 2
        out[:, sigma] = np.sqrt(variance + w * (1.0 - w) * apart**2)
    for name in ("flags", "swing_weight", "rest_weight"):
        out[:, OUT.index(name)] = kinematic[:, OUT.index(name)]
    out[:, OUT.index("driven_weight")] = w
    return out


_MOSTLY = 0.5
"""Of the rows: .57 to 1 in 26 of 27 logs of random jumps; a spoilt column, which turns the driven one unseen,
leaves it .35 at most."""


class Handover:
    """Both filters at work and the weighing of them; rows in, estimates out."""

    def __init__(self, setup: Setup, drive: Drive) -> None:
        self._before = starting_state(setup)[0][0, 6:]
        self._spoke = self._weighed = 0
        self._kinematic, self._driven = Filter(setup), DrivenFilter(setup, drive)
        self._memory = new_handover()

    def run_each(self, rows: Rows) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Estimates of the driven and of the kinematic filter (n, len(OUT)), and the driven one's weight."""
        driven, kinematic = self._driven.run(rows), self._kinematic.run(rows)
        weight = np.empty(len(rows))
        weigh(driven, kinematic, self._memory, BEGIN, weight)
        self._weighed += int(np.isfinite(weight).sum())
        self._spoke += int(np.count_nonzero(weight >= 0.5))
        return driven, kinematic, weight

    @property
    def sensor(self) -> FloatArray:
        """As `Filter.sensor`, of the model without commands, which no error of the plant turns.

        Motion that jumps all the time turns it. Where the driven one mostly speaks, what both say counts.
        """
        if self._spoke < _MOSTLY * self._weighed:
            return self._kinematic.sensor
        one, other = self._kinematic.sensor - self._before, self._driven.state[0][INVOLVED:] - self._before
        nearer = np.copysign(np.minimum(np.abs(one), np.abs(other)), one)
        return np.asarray(self._before + np.where(one * other > 0.0, nearer, 0.0))

    @property
    def longer_m(self) -> tuple[float, float] | None:
        """As `DrivenFilter.longer_m`."""
        return self._driven.longer_m

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        return blended(*self.run_each(rows))


def smooth_both(
    setup: Setup, drive: Drive, rows: Rows, driven: FloatArray, kinematic: FloatArray
) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) of both models, weighed by what both sides of a row say.

    Parameters
    ----------
    driven, kinematic : (n, len(OUT)) of the filters on the same rows.
    """
    weight, after = np.empty(len(rows)), np.empty(len(rows))
    weigh(driven, kinematic, new_handover(), 0.0, weight)
    back = driven[::-1].copy()
    back[:, 0] = -back[:, 0]
    weigh(back, kinematic[::-1].copy(), new_handover(), 0.0, after)
    return blended(
        smooth_driven(setup, drive, rows, driven),
        smooth(setup, rows, kinematic),
        np.minimum(weight, after[::-1]),
    )

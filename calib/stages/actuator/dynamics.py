"""Equations of motion of one section, (3.15) - (3.48), with the printed ones corrected.

    M(q) ddq + C(q, dq) dq + N(q, dq) = tau + lambda3 z,   dz/dt = -lambda1 z + lambda2 dq     (3.33), (3.46)

    M = m Jp' Jp + J / (4 r_B^2) [[1, -1], [-1, 1]]                                            (3.34)
    C = m Jp' dJp/dt                                                                           (3.35)
    N = dM_bnd/dq - m Jp' g + F_spring + F_damper                                              (3.43)
    tau = F_act                                                                                (3.37)

Jp is the position part of `kinematics.forward_jacobian`; its rate satisfies (3.23). By virtual work the
bellows' forces are the generalised forces, since the bellows' lengths are the coordinates. The source
projects them in the head's frame by P[r, i] = t . d r_Bi / dq_r, which is [[1.25, 0.25], [-0.33, 0.67]]
at 0.7 rad: such springs have no potential and the undamped energy drifts.

The functions of q above are the reference. The hot path, `rates`, uses (l, phi), in which the
equations solve in closed form. With p = l S(phi) e(phi / 2), E = D / S (see `kinematics`) and the
generalised forces Q_l, Q_phi, the acceleration of p along and across the chord is
a_r = d2(lS)/dt2 - l S dphi^2 / 4 and a_t = l S ddphi / 2 + d(lS)/dt dphi, so

    m S a_r = Q_l,   m l (S' a_r + S a_t / 2) + J ddphi = Q_phi,   S' = -phi E S,

    ddphi = (Q_phi + Q_l l phi E - m l S^2 dphi (dl - l phi E dphi) / 2) / (m l^2 S^2 / 4 + J)
    ddl   = Q_l / (m S^2) + l dphi^2 (1/2 - 2 E) + phi E (2 dl dphi + l ddphi).

(l, phi) are linear in q and Runge-Kutta steps are the same in both. From the first line,
det M = m S^2 (m l^2 S^2 / 4 + J) / (4 r_B^2): M is regular wherever the chord is not zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.kinematics import (
    angle,
    chord_curvature,
    chord_decay_w,
    chord_ratio,
    chord_ratio_w,
    chord_slope,
    forward_jacobian,
    forward_jacobian_rate,
    inlined,
    length,
)
from calib.stages.actuator.parameters import Plant

_TURN = np.array([[1.0, -1.0], [-1.0, 1.0]])


class Coefficients(NamedTuple):
    """What `rates` needs, derived from a `Plant`."""

    m: float
    J: float
    r: float
    l0: float
    k0: float
    k1: float
    k2: float
    k3: float
    damping: float
    bending: float
    lambda1: float
    lambda2: float
    lambda3: float
    gx: float
    gy: float
    gravity: int


def coefficients(plant: Plant) -> Coefficients:
    """Coefficients of the compiled kernel; c_spr scales the spring but not the damper (3.47), (3.48)."""
    scale = plant.stiffness_scale
    k0, k1, k2, k3 = (scale * k for k in plant.stiffness.padded)
    gx, gy = plant.gravity_mps2
    return Coefficients(
        plant.mass_kg,
        plant.inertia_kgm2,
        plant.bellows_radius_m,
        plant.rest_length_m,
        k0,
        k1,
        k2,
        k3,
        plant.damping_Ns_per_sqrt_N_per_m / math.sqrt(scale),
        plant.bending_N_per_rad2,
        *plant.creep_rates,
        gx,
        gy,
        int(gx != 0.0 or gy != 0.0),
    )


@inlined
def _pull(c: Coefficients, q: float, dq: float) -> float:
    """Spring and damper of one bellows [N], (3.47) with the right sign and (3.48)."""
    eps = q - c.l0
    stretch = 0.5 * (eps + abs(eps))
    k = c.k0 + stretch * (c.k1 + stretch * (c.k2 + stretch * c.k3))
    return k * eps + c.damping * math.sqrt(k) * dq


@inlined
def rates(
    c: Coefficients,
    l: float,  # noqa: E741  the source's symbol
    phi: float,
    dl: float,
    dphi: float,
    z_sum: float,
    z_difference: float,
    F1: float,
    F2: float,
) -> tuple[float, float, float, float]:
    """ddl, ddphi and the rates of z1 + z2 and z1 - z2, of the forces F1, F2 [N] of the pumps."""
    S, D = chord_ratio_w(phi * phi), chord_decay_w(phi * phi)
    E = D / S
    r = c.r
    turned, spun = r * phi, r * dphi
    f1 = F1 - _pull(c, l + turned, dl + spun)
    f2 = F2 - _pull(c, l - turned, dl - spun)
    # Brackets and reciprocals keep what does not wait for the springs out of the chain that does.
    pulling = (f1 + f2) + c.lambda3 * z_sum
    turning = r * ((f1 - f2) + (c.lambda3 * z_difference - 2.0 * c.bending * phi * abs(phi)))
    if c.gravity:
        # sin(phi / 2) and cos(phi / 2) without a branch, which would keep lanes from vector instructions.
        sine, cosine = 0.5 * phi * S, S - phi * phi * D
        along, aside = c.gx * sine + c.gy * cosine, c.gx * cosine - c.gy * sine
        pulling += c.m * S * along
        turning += c.m * l * (0.5 * S * aside - phi * D * along)
    phiE = phi * E
    across = 0.25 * c.m * l * S * S
    by_l, by_phi = 1.0 / (c.m * S * S), 1.0 / (across * l + c.J)
    ddphi = by_phi * (turning + pulling * (l * phiE) - 2.0 * across * dphi * (dl - l * phiE * dphi))
    ddl = by_l * pulling + l * dphi * dphi * (0.5 - 2.0 * E) + 2.0 * phiE * dl * dphi + (l * phiE) * ddphi
    return (
        ddl,
        ddphi,
        2.0 * c.lambda2 * dl - c.lambda1 * z_sum,
        2.0 * r * c.lambda2 * dphi - c.lambda1 * z_difference,
    )


def mass_matrix(plant: Plant, q_m: FloatArray) -> FloatArray:
    """M (..., 2, 2) [kg] of the bellows' lengths (..., 2) (3.34)."""
    Jp = forward_jacobian(q_m, plant.bellows_radius_m)[..., :2, :]
    turning = plant.inertia_kgm2 / (4.0 * plant.bellows_radius_m**2) * _TURN
    return np.asarray(plant.mass_kg * np.swapaxes(Jp, -1, -2) @ Jp + turning)


def coriolis_matrix(plant: Plant, q_m: FloatArray, dq_mps: FloatArray) -> FloatArray:
    """C (..., 2, 2) [kg/s] (3.35); dM/dt - 2 C is skew-symmetric."""
    Jp = forward_jacobian(q_m, plant.bellows_radius_m)[..., :2, :]
    rate = forward_jacobian_rate(q_m, dq_mps, plant.bellows_radius_m)[..., :2, :]
    return np.asarray(plant.mass_kg * np.swapaxes(Jp, -1, -2) @ rate)


def _bellows_forces(plant: Plant, q: FloatArray, dq: FloatArray) -> FloatArray:
    c = coefficients(plant)
    eps = q - c.l0
    stretch = np.maximum(eps, 0.0)
    k = c.k0 + stretch * (c.k1 + stretch * (c.k2 + stretch * c.k3))
    return np.asarray(k * eps + c.damping * np.sqrt(k) * dq)


def resisting_forces(plant: Plant, q_m: FloatArray, dq_mps: FloatArray) -> FloatArray:
    """N (..., 2) [N] (3.43): bending, gravity, springs and dampers, on the left-hand side."""
    q, dq = np.asarray(q_m, dtype=np.float64), np.asarray(dq_mps, dtype=np.float64)
    phi = angle(q, plant.bellows_radius_m)
    bent = plant.bending_N_per_rad2 * phi * np.abs(phi)
    Jp = forward_jacobian(q, plant.bellows_radius_m)[..., :2, :]
    weight = plant.mass_kg * np.einsum("...xr,x->...r", Jp, np.array(plant.gravity_mps2))
    return np.asarray(np.stack([bent, -bent], axis=-1) - weight + _bellows_forces(plant, q, dq))


def linearised(plant: Plant, q_m: FloatArray) -> FloatArray:
    """A (6, 6) of d(q, dq, z)/dt = A (dq, ddq, dz) for small motion about a rest at q (2,).

    The pumps' forces hold the plant there.
    """
    q = np.asarray(q_m, dtype=np.float64)
    c = coefficients(plant)
    phi, l = float(angle(q, c.r)), float(length(q))  # noqa: E741  the source's symbol
    eps = q - c.l0
    stiff = plant.stiffness_scale * np.array([plant.stiffness.tangent(e) for e in eps.tolist()])
    secant = np.array([plant.stiffness.secant(e) for e in eps.tolist()])
    K = np.diag(stiff) + c.bending * abs(phi) / c.r * _TURN
    S, S1, S2 = (float(f(np.array(phi))) for f in (chord_ratio, chord_slope, chord_curvature))
    sine, cosine = math.sin(0.5 * phi), math.cos(0.5 * phi)
    along, across = c.gx * sine + c.gy * cosine, c.gx * cosine - c.gy * sine
    mixed = S1 * along + 0.5 * S * across
    bent = l * (S2 * along + S1 * across - 0.25 * S * along)
    T = np.array([[0.5, 0.5], [0.5 / c.r, -0.5 / c.r]])
    K -= c.m * T.T @ np.array([[0.0, mixed], [mixed, bent]]) @ T
    inverse = np.linalg.inv(mass_matrix(plant, q))
    damping = plant.damping_Ns_per_sqrt_N_per_m * np.diag(np.sqrt(secant))
    A = np.zeros((6, 6))
    A[:2, 2:4] = np.eye(2)
    A[2:4] = inverse @ np.hstack([-K, -damping, c.lambda3 * np.eye(2)])
    A[4:, 2:4] = c.lambda2 * np.eye(2)
    A[4:, 4:] = -c.lambda1 * np.eye(2)
    return A

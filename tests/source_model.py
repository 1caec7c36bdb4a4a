"""What the source states of the actuator that only tests and its claims use: poses, energies, values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.dynamics import (
    coefficients,
    coriolis_matrix,
    mass_matrix,
    resisting_forces,
)
from calib.stages.actuator.kinematics import (
    MARKER_OFFSET_M,
    angle,
    chord_ratio,
    forward,
    forward_jacobian,
    inverse_coefficients,
    length,
    marker_from_head,
)
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import ElongationForce

PRINTED_CREEP = (-0.1047, -14.98, -1.854)
"""Table 3.2; its energy grows."""


@dataclass(frozen=True)
class PolynomialForce(ElongationForce):
    """Static force as a polynomial of the PWM value (3.49).

    Attributes
    ----------
    force_mN : coefficients of u^4, u^3, u^2, u, u the PWM value, in millinewton.
    dead_zone_pwm : no force below.
    """

    force_mN: tuple[float, float, float, float] = (-5.686e-6, 2.937e-3, -0.4189, 18.21)
    dead_zone_pwm: float = 100.0

    def force_N(self, pwm: FloatArray) -> FloatArray:
        """Steady force [N] of PWM values 0 .. 255, any shape."""
        force = 1e-3 * np.polyval((*self.force_mN, 0.0), pwm)
        return np.where(pwm < self.dead_zone_pwm, 0.0, np.maximum(force, 0.0))


def transform(phi: FloatArray, length_m: FloatArray) -> FloatArray:
    """Homogeneous transform H_bh (..., 3, 3) from the head's to the base frame (3.5), (3.6).

    Parameters
    ----------
    phi : (...) bending angle [rad].
    length_m : (...) length of the backbone [m].
    """
    phi, ell = np.broadcast_arrays(np.asarray(phi, dtype=np.float64), np.asarray(length_m, dtype=np.float64))
    chord = ell * chord_ratio(phi)
    H = np.zeros((*phi.shape, 3, 3))
    H[..., 0, 0] = H[..., 1, 1] = np.cos(phi)
    H[..., 0, 1] = np.sin(phi)
    H[..., 1, 0] = -H[..., 0, 1]
    H[..., 0, 2] = chord * np.sin(0.5 * phi)
    H[..., 1, 2] = chord * np.cos(0.5 * phi)
    H[..., 2, 2] = 1.0
    return H


def configuration(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Curvature and length (..., 2) [1/m, m] of the bellows' lengths (..., 2) (3.3)."""
    ell = length(q_m)
    return np.stack([angle(q_m, bellows_radius_m) / ell, ell], axis=-1)


def pose_from_configuration(k: FloatArray) -> FloatArray:
    """Head (..., 3) [m, m, rad] of curvature and length (..., 2) (3.6), exact at zero curvature."""
    kappa, ell = k[..., 0], k[..., 1]
    phi = kappa * ell
    chord = ell * chord_ratio(phi)
    return np.stack([chord * np.sin(0.5 * phi), chord * np.cos(0.5 * phi), phi], axis=-1)


def head_from_marker(marker_m: FloatArray, phi: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Head (..., 2) [m] of the marker (..., 2) [m] and the angle phi (...) [rad] (A.1)."""
    return np.asarray(marker_m, dtype=np.float64) - marker_from_head(np.zeros(2), phi, offset_m)


def inverse_series(pose: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Bellows (..., 2) [m] of the head (..., 3) by (3.12) with the series for f, as the firmware does.

    q1 = r_B phi + |(x, y)| f(phi) / 2 and q2 = -r_B phi + |(x, y)| f(phi) / 2.
    """
    x, y, phi = np.moveaxis(np.asarray(pose, dtype=np.float64), -1, 0)
    f = np.polyval([float(c) for c in reversed(inverse_coefficients())], phi * phi)
    ell = 0.5 * np.hypot(x, y) * f
    return np.stack([ell + bellows_radius_m * phi, ell - bellows_radius_m * phi], axis=-1)


def acceleration(
    plant: Plant, q_m: FloatArray, dq_mps: FloatArray, z_N: FloatArray, force_N: FloatArray
) -> FloatArray:
    """ddq (..., 2) [m/s^2] from M, C, N and tau; every argument (..., 2)."""
    q, dq = np.asarray(q_m, dtype=np.float64), np.asarray(dq_mps, dtype=np.float64)
    swept = np.einsum("...rc,...c->...r", coriolis_matrix(plant, q, dq), dq)
    driving = np.asarray(force_N) + plant.creep_rates[2] * np.asarray(z_N)
    total = driving - swept - resisting_forces(plant, q, dq)
    return np.asarray(np.linalg.solve(mass_matrix(plant, q), total[..., None])[..., 0])


def kinetic_energy_J(plant: Plant, q_m: FloatArray, dq_mps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Translational and rotational kinetic energy (...) [J] (3.21)."""
    J = forward_jacobian(q_m, plant.bellows_radius_m)
    rate = np.einsum("...xr,...r->...x", J, np.asarray(dq_mps, dtype=np.float64))
    moving = 0.5 * plant.mass_kg * (rate[..., 0] ** 2 + rate[..., 1] ** 2)
    return np.asarray(moving), np.asarray(0.5 * plant.inertia_kgm2 * rate[..., 2] ** 2)


def potential_energy_J(plant: Plant, q_m: FloatArray) -> FloatArray:
    """Springs, bending and gravity (...) [J] (3.42); M_bnd = 2 r_B k_bnd |phi|^3 / 3.

    Only the forces by virtual work derive from it.
    """
    q = np.asarray(q_m, dtype=np.float64)
    c = coefficients(plant)
    eps = q - c.l0
    stretch = np.maximum(eps, 0.0)
    more = stretch**3 * (c.k1 / 3.0 + stretch * (c.k2 / 4.0 + stretch * c.k3 / 5.0))
    springs = np.sum(0.5 * c.k0 * eps**2 + more, axis=-1)
    phi = np.abs(angle(q, c.r))
    weight = c.m * forward(q, c.r)[..., :2] @ np.array([c.gx, c.gy])
    return np.asarray(springs + 2.0 / 3.0 * c.r * c.bending * phi**3 - weight)


def creep_energy_J(plant: Plant, z_N: FloatArray) -> FloatArray:
    """Energy (...) [J] that a creep element with lambda2 lambda3 < 0 holds at z (..., 2) [N], else 0."""
    z = np.asarray(z_N, dtype=np.float64)
    _, l2, l3 = plant.creep_rates
    if l2 * l3 >= 0.0:
        return np.zeros(z.shape[:-1])
    return np.asarray(-0.5 * l3 * np.sum(z / l2 * z, axis=-1))


def energy_J(plant: Plant, q_m: FloatArray, dq_mps: FloatArray, z_N: FloatArray) -> FloatArray:
    """Whole energy (...) [J]: constant without damping and creep, never rising with passive ones."""
    moving, turning = kinetic_energy_J(plant, q_m, dq_mps)
    return moving + turning + potential_energy_J(plant, q_m) + creep_energy_J(plant, z_N)


def dissipation_W(plant: Plant, q_m: FloatArray, dq_mps: FloatArray, z_N: FloatArray) -> FloatArray:
    """Power (...) [W] that dampers and creep turn into heat, by virtual work."""
    q, dq = np.asarray(q_m, dtype=np.float64), np.asarray(dq_mps, dtype=np.float64)
    damped = resisting_forces(plant, q, dq) - resisting_forces(plant, q, np.zeros_like(dq))
    crept = 2.0 * plant.creep_rates[0] * creep_energy_J(plant, z_N)
    return np.asarray(np.sum(damped * dq, axis=-1) + crept)

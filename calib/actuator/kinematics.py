"""Actuator, configuration and task space of one section, both ways, with their derivatives.

    q = (q1, q2)        lengths of the bellows [m]                                  (3.1)
    k = (kappa, l)      curvature [1/m] and length of the backbone [m]              (3.2)
    x = (x, y, phi)     head in the world frame [m, m, rad]                         (3.4)

    phi = kappa l = (q1 - q2) / (2 r_B),   l = (q1 + q2) / 2                        (3.3)
    (x, y) = l S(phi) (sin(phi / 2), cos(phi / 2))                                  (3.6), (3.10)
    l = |(x, y)| / S(phi)                                                           (3.11), (3.12)

with S of `calib.actuator.arc`. World: x to the right, y along the straight actuator towards the
head, phi > 0 bends the head towards +x and bellows 1, at -r_B in the head's frame, is then longer.

The rotation in (3.6) is printed the other way round: the arc's tangent at the head is
(sin phi, cos phi), as (A.1) has it, so the block is [[cos, sin], [-sin, cos]].

All functions take arrays with any leading dimensions.
"""

from __future__ import annotations

import numpy as np

from calib.actuator.arc import FULL_CIRCLE_RAD, chord_curvature, chord_ratio, chord_slope
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = [
    "MARKER_OFFSET_M",
    "angle",
    "bellows_from_configuration",
    "configuration",
    "configuration_from_pose",
    "configuration_jacobian",
    "forward",
    "forward_jacobian",
    "forward_jacobian_rate",
    "head_from_marker",
    "inverse",
    "inverse_jacobian",
    "length",
    "marker_from_head",
    "pose_from_configuration",
    "transform",
]

MARKER_OFFSET_M = 0.015
"""Distance d from the head to the marker along the head's tangent (A.1)."""


def _parts(values: FloatArray, size: int, what: str) -> tuple[FloatArray, ...]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != size:
        raise BadInputError(f"{what}: found shape {array.shape}, expected (..., {size})")
    return tuple(array[..., i] for i in range(size))


def angle(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Bending angle phi [rad] of the bellows' lengths (..., 2) (3.3)."""
    q1, q2 = _parts(q_m, 2, "bellows")
    return (q1 - q2) / (2.0 * bellows_radius_m)


def length(q_m: FloatArray) -> FloatArray:
    """Length l [m] of the backbone (3.3)."""
    q1, q2 = _parts(q_m, 2, "bellows")
    return 0.5 * (q1 + q2)


def configuration(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Curvature and length (..., 2) [1/m, m] of the bellows' lengths (..., 2) (3.3)."""
    ell = length(q_m)
    return np.stack([angle(q_m, bellows_radius_m) / ell, ell], axis=-1)


def bellows_from_configuration(k: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Lengths of the bellows (..., 2) [m] of curvature and length (..., 2), the inverse of (3.3)."""
    kappa, ell = _parts(k, 2, "configuration")
    half = bellows_radius_m * kappa * ell
    return np.stack([ell + half, ell - half], axis=-1)


def pose_from_configuration(k: FloatArray) -> FloatArray:
    """Head (..., 3) [m, m, rad] of curvature and length (..., 2) (3.6), exact at zero curvature."""
    kappa, ell = _parts(k, 2, "configuration")
    phi = kappa * ell
    chord = ell * chord_ratio(phi)
    return np.stack([chord * np.sin(0.5 * phi), chord * np.cos(0.5 * phi), phi], axis=-1)


def configuration_from_pose(pose: FloatArray) -> FloatArray:
    """Curvature and length (..., 2) [1/m, m] of the head (..., 3) (3.11).

    Raises `BadInputError` for |phi| >= 2 pi, where no chord is left to measure.
    """
    x, y, phi = _parts(pose, 3, "pose")
    if np.any(np.abs(phi) >= FULL_CIRCLE_RAD):
        raise BadInputError(
            f"pose: found an angle of {np.nanmax(np.abs(phi)):.6g} rad, expected less than a full circle"
        )
    ell = np.hypot(x, y) / chord_ratio(phi)
    return np.stack([phi / ell, ell], axis=-1)


def forward(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Head (..., 3) [m, m, rad] of the bellows' lengths (..., 2) (3.3), (3.6)."""
    phi = angle(q_m, bellows_radius_m)
    chord = length(q_m) * chord_ratio(phi)
    return np.stack([chord * np.sin(0.5 * phi), chord * np.cos(0.5 * phi), phi], axis=-1)


def inverse(pose: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Lengths of the bellows (..., 2) [m] of the head (..., 3) (3.12).

    Only the distance of (x, y) from the base counts, as in the source. Raises `BadInputError` for
    |phi| >= 2 pi.
    """
    ell = configuration_from_pose(pose)[..., 1]
    half = bellows_radius_m * np.asarray(pose, dtype=np.float64)[..., 2]
    return np.stack([ell + half, ell - half], axis=-1)


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


def configuration_jacobian(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """d(kappa, l) / d(q1, q2), shape (..., 2, 2), of (3.3)."""
    q1, q2 = _parts(q_m, 2, "bellows")
    scale = 2.0 / (bellows_radius_m * (q1 + q2) ** 2)
    half = np.full_like(q1, 0.5)
    return np.stack([np.stack([scale * q2, -scale * q1], axis=-1), np.stack([half, half], axis=-1)], axis=-2)


def _arc_derivatives(phi: FloatArray) -> tuple[FloatArray, ...]:
    """a = S sin(phi / 2) and b = S cos(phi / 2) with their first and second derivatives."""
    S, S1, S2 = chord_ratio(phi), chord_slope(phi), chord_curvature(phi)
    s, c = np.sin(0.5 * phi), np.cos(0.5 * phi)
    return (
        S * s,
        S1 * s + 0.5 * S * c,
        S2 * s + S1 * c - 0.25 * S * s,
        S * c,
        S1 * c - 0.5 * S * s,
        S2 * c - S1 * s - 0.25 * S * c,
    )


def _to_bellows(by_length: FloatArray, by_phi: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Columns d/dq1, d/dq2 from d/dl, d/dphi: ell = (q1 + q2) / 2, phi = (q1 - q2) / (2 r_B)."""
    half_l, half_phi = 0.5 * by_length, by_phi / (2.0 * bellows_radius_m)
    return np.stack([half_l + half_phi, half_l - half_phi], axis=-1)


def forward_jacobian(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """J = d(x, y, phi) / d(q1, q2), shape (..., 3, 2), of `forward`, for |phi| <= 2 pi."""
    phi, ell = angle(q_m, bellows_radius_m), length(q_m)
    a, a1, _, b, b1, _ = _arc_derivatives(phi)
    zero, one = np.zeros_like(phi), np.ones_like(phi)
    return _to_bellows(
        np.stack([a, b, zero], axis=-1), np.stack([ell * a1, ell * b1, one], axis=-1), bellows_radius_m
    )


def forward_jacobian_rate(q_m: FloatArray, dq_mps: FloatArray, bellows_radius_m: float) -> FloatArray:
    """dJ/dt, shape (..., 3, 2), along (q, dq): the head accelerates with J ddq + dJ/dt dq."""
    phi, ell = angle(q_m, bellows_radius_m), length(q_m)
    dphi, dl = angle(dq_mps, bellows_radius_m), length(dq_mps)
    _, a1, a2, _, b1, b2 = _arc_derivatives(phi)
    zero = np.zeros_like(phi * dphi)
    return _to_bellows(
        np.stack([a1 * dphi, b1 * dphi, zero], axis=-1),
        np.stack([dl * a1 + ell * a2 * dphi, dl * b1 + ell * b2 * dphi, zero], axis=-1),
        bellows_radius_m,
    )


def inverse_jacobian(pose: FloatArray, bellows_radius_m: float) -> FloatArray:
    """d(q1, q2) / d(x, y, phi), shape (..., 2, 3), of `inverse`, away from the base, |phi| < 2 pi."""
    x, y, phi = _parts(pose, 3, "pose")
    S = chord_ratio(phi)
    chord = np.hypot(x, y)
    by_x, by_y = x / (chord * S), y / (chord * S)
    by_phi = -chord * chord_slope(phi) / (S * S)
    return np.stack(
        [
            np.stack([by_x, by_y, by_phi + bellows_radius_m], axis=-1),
            np.stack([by_x, by_y, by_phi - bellows_radius_m], axis=-1),
        ],
        axis=-2,
    )


def _along_tangent(phi: FloatArray, distance_m: float) -> FloatArray:
    phi = np.asarray(phi, dtype=np.float64)
    return distance_m * np.stack([np.sin(phi), np.cos(phi)], axis=-1)


def head_from_marker(marker_m: FloatArray, phi: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Head (..., 2) [m] of the marker (..., 2) [m] and the angle phi (...) [rad] (A.1)."""
    return np.asarray(marker_m, dtype=np.float64) - _along_tangent(phi, offset_m)


def marker_from_head(head_m: FloatArray, phi: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Marker (..., 2) [m] of the head (..., 2) [m] and the angle phi (...) [rad], (A.1) reversed."""
    return np.asarray(head_m, dtype=np.float64) + _along_tangent(phi, offset_m)

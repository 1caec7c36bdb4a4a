"""n sections in series: each head carries the next base (end of 3.2).

Section i has its own bellows (q1, q2)_i and maps its head's frame into its base's frame with
H_i = `kinematics.transform`; the pose of head i in the world is the composition H_1 H_2 ... H_i.
Angles add, so phi_i (world) = phi_1 + ... + phi_i without any wrapping.

The Jacobian of the tip follows section by section: moving q of section i moves its own head by
J_i in the frame of its base, and carries everything beyond it along as a rigid body, which turns
clockwise by dphi (phi > 0 turns y towards x): a point at (dx, dy) from that head moves by
(dy, -dx) dphi.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator.kinematics import forward_jacobian, length, transform


def _radii(q_m: FloatArray, bellows_radius_m: float | FloatArray) -> FloatArray:
    if q_m.ndim != 2 or q_m.shape[1] != 2 or len(q_m) == 0:
        raise BadInputError(f"bellows of the sections: found shape {q_m.shape}, expected (n, 2)")
    radii = np.asarray(bellows_radius_m, dtype=np.float64)
    if radii.ndim > 1 or (radii.ndim == 1 and len(radii) != len(q_m)):
        raise BadInputError(f"bellows radius: found shape {radii.shape}, expected one or {len(q_m)} values")
    return np.broadcast_to(radii, (len(q_m),))


def heads(q_m: FloatArray, bellows_radius_m: float | FloatArray) -> FloatArray:
    """Transforms H_wi (n, 3, 3) from each head's frame to the world, base first.

    Parameters
    ----------
    q_m : (n, 2) lengths of the bellows, one row per section from the base to the tip [m].
    bellows_radius_m : one radius for all sections or one for each [m].

    Raises
    ------
    BadInputError for arrays of another shape.
    """
    q = np.asarray(q_m, dtype=np.float64)
    radii = _radii(q, bellows_radius_m)
    phi = (q[:, 0] - q[:, 1]) / (2.0 * radii)
    H = transform(phi, length(q))
    for i, (before, own) in enumerate(pairwise(H)):
        H[i + 1] = before @ own
    return H


def poses(q_m: FloatArray, bellows_radius_m: float | FloatArray) -> FloatArray:
    """World pose (n, 3) [m, m, rad] of each head; the angles are summed, not wrapped."""
    q = np.asarray(q_m, dtype=np.float64)
    H = heads(q, bellows_radius_m)
    phi = np.cumsum((q[:, 0] - q[:, 1]) / (2.0 * _radii(q, bellows_radius_m)))
    return np.stack([H[:, 0, 2], H[:, 1, 2], phi], axis=1)


def tip_jacobian(q_m: FloatArray, bellows_radius_m: float | FloatArray) -> FloatArray:
    """Derivatives (3, 2 n) of the tip's pose with respect to all bellows, section by section."""
    q = np.asarray(q_m, dtype=np.float64)
    radii = _radii(q, bellows_radius_m)
    H = heads(q, bellows_radius_m)
    tip = H[-1, :2, 2]
    J = np.zeros((3, 2 * len(q)))
    base = np.eye(3)
    for i in range(len(q)):
        own = forward_jacobian(q[i], float(radii[i]))
        reach = tip - H[i, :2, 2]
        turned = np.array([reach[1], -reach[0]])
        J[:2, 2 * i : 2 * i + 2] = base[:2, :2] @ own[:2] + np.outer(turned, own[2])
        J[2, 2 * i : 2 * i + 2] = own[2]
        base = H[i]
    return J

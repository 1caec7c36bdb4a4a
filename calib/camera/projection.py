"""Residuals of all views and their Jacobian, for the bundle adjustment.

For the point X of the target, p = R X + t in the camera's frame, x = p1 / p3, y = p2 / p3, distorted
and projected as in `calib.camera.model`. With a = du/dp (3,) the derivatives are, for a rotation
exp(delta) R on the left,

    du/d(delta) = (R X) x a,   du/dt = a,   du/dw_k = a . R B_k

where the target is X + sum_k w_k B_k when it is allowed to deform. All arrays are kept with the
point last, so that each line of code runs over all views and points at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.model import COEFFICIENTS, MODELS, Camera
from calib.camera.views import Observations

__all__ = [
    "INTRINSICS",
    "Block",
    "camera_from_vector",
    "free_intrinsics",
    "jacobian",
    "vector_from_camera",
]

INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px", *COEFFICIENTS)
"""Order of the vector of intrinsics."""


@dataclass(frozen=True)
class Block:
    """What the residuals depend on.

    Attributes
    ----------
    intrinsics : (13,) in the order of `INTRINSICS`.
    R_CT, t_CT_m : (N, 3, 3) and (N, 3), pose of the target in the camera's frame.
    deformation : (K,) weights of the target's deformation, metres.
    """

    intrinsics: FloatArray
    R_CT: FloatArray
    t_CT_m: FloatArray
    deformation: FloatArray

    def part(self, views: slice) -> Block:
        """The same with the poses of some views only."""
        return Block(self.intrinsics, self.R_CT[views], self.t_CT_m[views], self.deformation)


def free_intrinsics(model: str, skew: bool, fixed: tuple[str, ...] = ()) -> IntArray:
    """Indices into `INTRINSICS` that the model estimates."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px") + (("skew_px",) if skew else ()) + MODELS[model]
    return np.array([INTRINSICS.index(name) for name in names if name not in fixed], dtype=np.int64)


def camera_from_vector(model: str, image_size_px: tuple[int, int], intrinsics: FloatArray) -> Camera:
    """A camera from the vector of intrinsics."""
    fx, fy, cx, cy, skew = (float(value) for value in intrinsics[:5])
    return Camera(model, image_size_px, fx, fy, skew, cx, cy, intrinsics[5:].copy())


def vector_from_camera(camera: Camera) -> FloatArray:
    """The vector of intrinsics (13,) of a camera."""
    five = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew_px]
    return np.concatenate([five, camera.distortion])


def jacobian(
    block: Block, observations: Observations, free: IntArray, basis: FloatArray | None
) -> FloatArray | None:
    """Jacobian and residuals stacked, (N, G + 7, 2 M), or None where a point is behind the camera.

    Rows: free intrinsics and deformation (G together), rotation (3), translation (3), and last the
    residual, projected minus measured. Columns: all u, then all v. Points that are not present are
    zero throughout.

    Parameters
    ----------
    free : indices into `INTRINSICS`.
    basis : (K, 3, M) displacements of the target's points, or None for a rigid target.
    """
    points = observations.pixels.shape[1]
    target = observations.target_m.transpose(0, 2, 1)
    if basis is not None:
        target = target + np.tensordot(block.deformation, basis, axes=1)
    # (n, 3, M) and (N, 3, 3): R X without the translation.
    rotated = block.R_CT @ target
    p1, p2, p3 = np.moveaxis(rotated + block.t_CT_m[:, :, None], 1, 0)
    if not observations.complete:
        p3 = np.where(observations.present, p3, 1.0)
    if p3.min() <= 0.0:
        return None
    fx, fy, cx, cy, skew = block.intrinsics[:5]
    k1, k2, t1, t2, k3, k4, k5, k6 = block.intrinsics[5:]
    inverse = 1.0 / p3
    x, y = p1 * inverse, p2 * inverse
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3))
    over: FloatArray | float = 1.0
    radial = numerator
    if k4 or k5 or k6:
        over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        radial = numerator * over
        slope = (slope - radial * (k4 + r2 * (2.0 * k5 + r2 * (3.0 * k6)))) * over
    xd = x * radial
    yd = y * radial
    if t1 or t2:
        xd = xd + 2.0 * t1 * xy + t2 * (r2 + 2.0 * xx)
        yd = yd + t1 * (r2 + 2.0 * yy) + 2.0 * t2 * xy
    # Derivatives of the distorted by the undistorted normalised coordinates; symmetric.
    xd_x = radial + 2.0 * xx * slope + (2.0 * t1 * y + 6.0 * t2 * x if t1 or t2 else 0.0)
    yd_y = radial + 2.0 * yy * slope + (6.0 * t1 * y + 2.0 * t2 * x if t1 or t2 else 0.0)
    cross = 2.0 * xy * slope + (2.0 * t1 * x + 2.0 * t2 * y if t1 or t2 else 0.0)

    shared = len(free) + (0 if basis is None else len(basis))
    out = np.empty((observations.views, shared + 7, 2, points))
    for row, index in enumerate(free):
        u, v = out[:, row, 0], out[:, row, 1]
        name = INTRINSICS[index]
        if name in ("fx_px", "cx_px", "skew_px"):
            u[:] = {"fx_px": xd, "cx_px": 1.0, "skew_px": yd}[name]
            v[:] = 0.0
        elif name in ("fy_px", "cy_px"):
            u[:] = 0.0
            v[:] = yd if name == "fy_px" else 1.0
        else:
            dx, dy = _by_coefficient(name, x, y, xx, yy, xy, r2, over, radial)
            np.multiply(fx, dx, out=u)
            if skew:
                u += skew * dy
            np.multiply(fy, dy, out=v)
    pose = out[:, shared : shared + 6]
    q1, q2, q3 = rotated[:, 0], rotated[:, 1], rotated[:, 2]
    u_scale, v_scale = fx * inverse, fy * inverse
    for side in (0, 1):
        turn1, turn2, turn3, a1, a2, a3 = (pose[:, row, side] for row in range(6))
        if side == 0:
            np.multiply(xd_x, u_scale, out=a1)
            np.multiply(cross, u_scale, out=a2)
            if skew:
                a1 += skew * inverse * cross
                a2 += skew * inverse * yd_y
        else:
            np.multiply(cross, v_scale, out=a1)
            np.multiply(yd_y, v_scale, out=a2)
        np.multiply(x, a1, out=a3)
        a3 += y * a2
        np.negative(a3, out=a3)
        np.multiply(q2, a3, out=turn1)
        turn1 -= q3 * a2
        np.multiply(q3, a1, out=turn2)
        turn2 -= q1 * a3
        np.multiply(q1, a2, out=turn3)
        turn3 -= q2 * a1
        if basis is not None:
            in_target = np.einsum("ncm,ncd->ndm", pose[:, 3:, side], block.R_CT)
            out[:, len(free) : shared, side] = np.einsum("ndm,kdm->nkm", in_target, basis)
    residual_u, residual_v = out[:, shared + 6, 0], out[:, shared + 6, 1]
    residual_u[:] = fx * xd + skew * yd + cx - observations.pixels[..., 0]
    residual_v[:] = fy * yd + cy - observations.pixels[..., 1]
    if not observations.complete:
        out *= observations.present[:, None, None, :]
    return out.reshape(observations.views, shared + 7, 2 * points)


def _by_coefficient(
    name: str,
    x: FloatArray,
    y: FloatArray,
    xx: FloatArray,
    yy: FloatArray,
    xy: FloatArray,
    r2: FloatArray,
    over: FloatArray | float,
    radial: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of (xd, yd) by one distortion coefficient."""
    if name == "p1":
        return 2.0 * xy, r2 + 2.0 * yy
    if name == "p2":
        return r2 + 2.0 * xx, 2.0 * xy
    power = {"k1": 1, "k2": 2, "k3": 3, "k4": 1, "k5": 2, "k6": 3}[name]
    factor = r2 if power == 1 else r2 * r2 if power == 2 else r2 * r2 * r2
    factor = factor * over
    if name in ("k4", "k5", "k6"):
        factor = -factor * radial
    return x * factor, y * factor

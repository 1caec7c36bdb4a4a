"""The camera's constants: pinhole and lens, the polynomial that undoes the lens, and the plane.

A marker goes through one of two homographies of (2.11):

    CALIB_UNDISTORT 1   pixels -> normalised -> lens undone -> A^-1 K
    CALIB_UNDISTORT 0   pixels -> a homography fitted to the pixels as the lens shows them

The second neglects the lens as the source does, and spreads what that costs over the workspace. Both are
scaled so that the denominator, 1/s of (2.12), is the reciprocal depth in 1/m and positive wherever the
marker can be; at a tenth of its least value there the marker counts as lost behind the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import FloatArray
from calib.camera.homography import fit_homography
from calib.camera.model import Camera, project
from calib.camera.undistortion import InversePolynomial
from calib.errors import BadInputError
from calib.firmware.literals import Constant, Group, Macro, Whole

__all__ = ["MIDDLE_M", "CameraConstants", "PlaneConstants", "camera_groups", "plane_constants", "put_right"]

_WHAT = {
    "fx_px": "focal length along u, px; sigma_mu of (2.5)",
    "fy_px": "focal length along v, px; sigma_nu of (2.5)",
    "skew_px": "skew, px; gamma of (2.5)",
    "cx_px": "principal point, px from the centre of the left column; mu_0 of (2.5)",
    "cy_px": "principal point, px from the centre of the top row; nu_0 of (2.5)",
}

_HORIZON_SHARE = 0.1

MIDDLE_M = (0.0, 0.08)
"""Place about which an alignment's stretch magnifies, as in `calib.estimator.sensors`."""


@dataclass(frozen=True)
class PlaneConstants:
    """The plane's three homographies (3, 3) and the least denominator.

    Attributes
    ----------
    from_ideal : undistorted pixels to metres, A^-1.
    from_normalised : undistorted normalised coordinates to metres, A^-1 K.
    from_raw : pixels as the camera reports them to metres; None where the camera sees too little of the
        workspace to fit it.
    least : least denominators of the second and of the third in the workspace, times a tenth [1/m].
    raw_error_m : largest error of `from_raw` in the workspace.
    verdict : of the plane.
    """

    from_ideal: FloatArray
    from_normalised: FloatArray
    from_raw: FloatArray | None
    least: tuple[float, float]
    raw_error_m: float
    verdict: str


@dataclass(frozen=True)
class CameraConstants:
    """What the header says of the camera.

    Attributes
    ----------
    image_size_px : width and height.
    model, verdict : of the camera.
    intrinsics : pinhole and distortion by the names of rig.yaml (fx_px ... k1 ...).
    inverse : the polynomial that undistorts.
    plane : None without a plane.
    """

    image_size_px: tuple[int, int]
    model: str
    verdict: str
    intrinsics: dict[str, float]
    inverse: InversePolynomial
    plane: PlaneConstants | None


def _depths(A: FloatArray, world: FloatArray) -> FloatArray:
    return np.asarray(world @ A[2, :2] + A[2, 2])


def plane_constants(
    camera: Camera,
    R_CW: FloatArray,
    t_CW_m: FloatArray,
    A_inverse: FloatArray,
    workspace_m: tuple[float, float, float, float],
    verdict: str,
) -> PlaneConstants:
    """The plane's homographies for a marker that is in the workspace.

    Parameters
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    A_inverse : (3, 3) of (2.11), ideal pixels to metres.
    workspace_m : least x, least y, greatest x, greatest y.

    Raises `BadInputError` for a workspace behind the camera.
    """
    x0, y0, x1, y1 = workspace_m
    grid = np.stack(np.meshgrid(np.linspace(x0, x1, 9), np.linspace(y0, y1, 7)), axis=-1).reshape(-1, 2)
    # The denominator is the reciprocal depth when A's depth is in metres.
    A = np.asarray(np.linalg.inv(A_inverse), dtype=np.float64)
    scale = (R_CW[2, 0] * grid[0, 0] + R_CW[2, 1] * grid[0, 1] + t_CW_m[2]) / _depths(A, grid[:1])[0]
    ideal = A_inverse / scale
    depth = _depths(A * scale, grid)
    if not depth.min() > 0.0:
        raise BadInputError("plane: the workspace reaches behind the camera, so no marker can be mapped")
    least = _HORIZON_SHARE / float(depth.max())
    points = grid @ R_CW[:, :2].T + t_CW_m
    pixels = project(camera, points)
    width, height = camera.image_size_px
    inside = ((pixels >= -0.5) & (pixels <= np.array([width - 0.5, height - 0.5]))).all(axis=1)
    raw, raw_least, error = None, 0.0, 0.0
    if inside.sum() >= 12:
        H = fit_homography(grid[inside], pixels[inside], np.arange(int(inside.sum()))).H
        centre = np.array([[0.5 * (x0 + x1), 0.5 * (y0 + y1)]])
        true_depth = float((centre @ R_CW[2, :2] + t_CW_m[2])[0])
        H = H * (true_depth / _depths(H, centre)[0])
        raw = np.asarray(np.linalg.inv(H))
        raw_least = _HORIZON_SHARE / float(_depths(H, grid).max())
        back = np.concatenate([pixels[inside], np.ones((int(inside.sum()), 1))], axis=1) @ raw.T
        error = float(np.abs(back[:, :2] / back[:, 2:] - grid[inside]).max())
    K = np.array([[camera.fx_px, camera.skew_px, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    return PlaneConstants(ideal, ideal @ K, raw, (least, raw_least), error, verdict)


def put_right(plane: PlaneConstants, shift_m: tuple[float, float], stretch: float) -> PlaneConstants:
    """The plane without the error that an alignment has found: places it shows are shifted and stretched.

    Parameters
    ----------
    shift_m, stretch : the calibrated plane shows P at P + shift + stretch (P - `MIDDLE_M`).
    """
    shrink, (x, y) = 1.0 / (1.0 + stretch), MIDDLE_M
    right = np.array(
        [
            [shrink, 0.0, x - shrink * (x + shift_m[0])],
            [0.0, shrink, y - shrink * (y + shift_m[1])],
            [0.0, 0.0, 1.0],
        ]
    )
    raw = None if plane.from_raw is None else right @ plane.from_raw
    return replace(
        plane,
        from_ideal=right @ plane.from_ideal,
        from_normalised=right @ plane.from_normalised,
        from_raw=raw,
    )


def _matrix(name: str, values: FloatArray, comment: str) -> tuple[Constant, ...]:
    return tuple(
        Constant(f"{name}_{i + 1}{j + 1}", float(values[i, j]), f"row {i + 1}, {comment}")
        for i in range(3)
        for j in range(3)
    )


def _lens_group(camera: CameraConstants) -> Group:
    inverse, known = camera.inverse, camera.intrinsics
    notes = [
        "Inverse lens, normalised coordinates: yd = (v - cy) / fy, xd = (u - cx - skew yd) / fx, then",
        "x = xd P, y = yd P with P = 1 + c1 r2 + c2 r2^2 + ..., r2 = xd^2 + yd^2.",
    ]
    if inverse.decentering_steps:
        notes += [
            "Decentering: x and y as above, then CALIB_LENS_DECENTERING_STEPS times the same from",
            "xd - (2 p1 x y + p2 (r2 + 2 x^2)), yd - (p1 (r2 + 2 y^2) + 2 p2 x y) with r2 = x^2 + y^2.",
        ]
    notes.append(
        f"Error at most {inverse.max_error_px:.4f} px over {100 * inverse.covered:.0f} % of the picture."
    )
    items: list[Constant | Whole | Macro] = [
        Whole("CALIB_LENS_INVERSE_ORDER", len(inverse.radial), "number of coefficients c"),
        Whole("CALIB_LENS_DECENTERING_STEPS", inverse.decentering_steps, "0: no decentering"),
        Whole("CALIB_CAMERA_HAS_SKEW", int(known["skew_px"] != 0.0), "for #if"),
        Constant("CALIB_CAMERA_PER_FX", 1.0 / known["fx_px"], "1 / fx, 1/px"),
        Constant("CALIB_CAMERA_PER_FY", 1.0 / known["fy_px"], "1 / fy, 1/px"),
    ]
    items += [
        Constant(f"CALIB_LENS_INVERSE_C{i}", value, f"coefficient of r2^{i}, dimensionless")
        for i, value in enumerate(inverse.radial, start=1)
    ]
    body = "1.0f"
    if inverse.radial:
        names = [f"CALIB_LENS_INVERSE_C{i}" for i in range(1, len(inverse.radial) + 1)]
        body = f"(1.0f + (r2) * {' + (r2) * ('.join(['(' + names[0], *names[1:]])}{')' * (len(names) + 1)}"
    items.append(Macro("CALIB_LENS_INVERSE_P(r2)", body, "P by Horner's scheme"))
    return Group(tuple(notes), tuple(items))


def _plane_groups(plane: PlaneConstants) -> list[Group]:
    ok = Whole("CALIB_PLANE_OK", int(plane.verdict == "ok"), "0: the plane failed its gate")
    groups = [
        Group(
            ("Plane of the actuator, without the shift and stretch that align has found.",),
            (
                Whole("CALIB_HAS_PLANE", 1, "for #if"),
                ok,
                *_matrix(
                    "CALIB_PLANE_INVERSE",
                    plane.from_ideal,
                    "A^-1, undistorted px to m; (2.11), row 3 gives 1/s of (2.12) in 1/m",
                ),
            ),
        ),
        Group(
            ("The same from normalised undistorted coordinates, for CALIB_UNDISTORT 1.",),
            (
                *_matrix("CALIB_PLANE_NORMALISED", plane.from_normalised, "A^-1 K, dimensionless to m"),
                Constant(
                    "CALIB_PLANE_LEAST_PER_M", plane.least[0], "1/s below this: behind the horizon, 1/m"
                ),
            ),
        ),
        Group(
            (
                "The same from pixels as the camera reports them, fitted over the workspace, for",
                f"CALIB_UNDISTORT 0. Neglecting the lens costs up to {1e3 * plane.raw_error_m:.3f} mm there.",
            ),
            (
                Whole(
                    "CALIB_HAS_RAW_PLANE", int(plane.from_raw is not None), "0: the workspace is not in sight"
                ),
                *(
                    ()
                    if plane.from_raw is None
                    else (
                        *_matrix("CALIB_PLANE_RAW", plane.from_raw, "distorted px to m"),
                        Constant(
                            "CALIB_PLANE_RAW_LEAST_PER_M",
                            plane.least[1],
                            "1/s below this: behind the horizon, 1/m",
                        ),
                    )
                ),
            ),
        ),
    ]
    return groups


def camera_groups(camera: CameraConstants) -> tuple[Group, ...]:
    """Camera, lens and plane as groups of the header."""
    width, height = camera.image_size_px
    lens = any(value != 0.0 for name, value in camera.intrinsics.items() if not name.endswith("_px"))
    rows = [
        Constant(
            f"CALIB_CAMERA_{name.upper()}",
            value,
            _WHAT.get(name, "lens, dimensionless, OpenCV's order and signs"),
        )
        for name, value in camera.intrinsics.items()
    ]
    head = Group(
        ("Camera (2.5) and lens (B.1).",),
        (
            Whole("CALIB_IMAGE_WIDTH_PX", width, "columns"),
            Whole("CALIB_IMAGE_HEIGHT_PX", height, "rows"),
            Whole("CALIB_CAMERA_OK", int(camera.verdict == "ok"), "0: the calibration failed its gate"),
            Constant(
                "CALIB_CAMERA_GREATEST_U_PX",
                width - 0.5,
                "greatest u inside the picture, px; the least is -0.5",
            ),
            Constant(
                "CALIB_CAMERA_GREATEST_V_PX",
                height - 0.5,
                "greatest v inside the picture, px; the least is -0.5",
            ),
            Whole("CALIB_CAMERA_HAS_LENS", int(lens), "0: no distortion, default of CALIB_UNDISTORT"),
            *rows,
        ),
    )
    if camera.plane is None:
        return head, _lens_group(camera), Group(("No plane yet.",), (Whole("CALIB_HAS_PLANE", 0, "for #if"),))
    return head, _lens_group(camera), *_plane_groups(camera.plane)

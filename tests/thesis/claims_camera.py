"""Claims about the camera, its calibration and its lens (2.2.2, A, B)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.kinematics import head_from_marker, marker_from_head, transform
from calib.stages.camera.bundle import calibrate
from calib.stages.camera.lens import fit_inverse, pixel_grid
from calib.stages.camera.model import View, distort, pack, undistort
from calib.twin.pictures import BOARD, CAMERA, PLANE, shots
from calib.twin.scene import PrintedBoard, corner_pixels
from thesis.outcome import Finding, Outcome, claim, exactly

__all__ = ["CLAIMS"]

_MEAN_ERROR_PX = 0.31
_MEAN_OF_RAYLEIGH = np.sqrt(0.5 * np.pi)
_FITS = 8


@claim(
    "cam.points",
    "2.2.2",
    "corners of a board of 6 x 8 squares in 17 views",
    "35 x 17 = 595",
    basis="equations",
)
def points() -> Finding:
    inner = (6 - 1) * (8 - 1)
    return Finding(
        f"{inner} x 17 = {17 * inner}",
        exactly(17 * inner == 595 and len(BOARD.points_m()) == inner),
        "inner corners of 6 x 8 squares are 5 x 7",
        {"corners": inner, "points": 17 * inner},
    )


@lru_cache(maxsize=1)
def _corners() -> tuple[FloatArray, ...]:
    """Pixels of the corners in each of the 17 views of the stand-in camera, without noise."""
    return tuple(corner_pixels(CAMERA, PrintedBoard(BOARD), shot.pose) for shot in shots())


def _views(noise_px: float, seed: int) -> list[View]:
    rng = np.random.default_rng(seed)
    return [
        View(f"view{k}", BOARD.points_m(), pixels + noise_px * rng.standard_normal(pixels.shape))
        for k, pixels in enumerate(_corners())
    ]


@claim(
    "cam.mean_error",
    "2.2.2",
    "mean distance between corners and their reprojection after a calibration without a lens model",
    "0.31 px",
    "data",
    basis="twin",
)
def mean_error() -> Finding:
    fit = calibrate(pack(_views(0.0, 0)), CAMERA.image_size_px, "pinhole")
    mean = float(np.nanmean(np.linalg.norm(fit.residuals_px, axis=2)))
    return Finding(
        f"{mean:.3f} px",
        Outcome.UNMEASURED,
        "17 simulated views without any noise through a lens with the coefficients of appendix B, fitted "
        "without a lens model as in (2.10): so much of such an error is the lens left out",
        {"mean_error_px": mean},
        simulated=True,
    )


def _pinhole_pixels(A: FloatArray, plane_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (M, 2) and depths (M,) of points of the plane by s (mu, nu, 1) = A (x, y, 1)."""
    mapped = np.column_stack([plane_m, np.ones(len(plane_m))]) @ A.T
    return mapped[:, :2] / mapped[:, 2:], mapped[:, 2]


def _workspace() -> FloatArray:
    x, y = np.meshgrid(np.linspace(-0.04, 0.04, 9), np.linspace(0.06, 0.10, 5))
    return np.column_stack([x.ravel(), y.ravel()])


def _extrinsic() -> FloatArray:
    return np.column_stack([PLANE.R_CW[:, :2], PLANE.t_m])


@claim("cam.homography", "2.9", "the map from the plane to the picture is A = [R1 R2 t]", basis="equations")
def homography() -> Finding:
    world = _workspace()
    in_camera = world @ PLANE.R_CW[:, :2].T + PLANE.t_m
    pixels = (in_camera / in_camera[:, 2:]) @ CAMERA.K[:2].T
    printed = np.abs(_pinhole_pixels(_extrinsic(), world)[0] - pixels).max()
    right = np.abs(_pinhole_pixels(CAMERA.K @ _extrinsic(), world)[0] - pixels).max()
    return Finding(
        f"off by {printed:.0f} px; with K in front by {right:.0e} px",
        exactly(float(printed) < 1e-6),
        "points of the workspace through the whole camera and through A: without the intrinsics K the result "
        "is no pixel; A = K [R1 R2 t] is exact",
        {"printed_error_px": float(printed), "with_K_error_px": float(right)},
    )


@claim(
    "cam.scale",
    "2.12",
    "the scale of a pixel follows from the third row of the inverse of A",
    "exact",
    basis="equations",
)
def scale() -> Finding:
    A, world = CAMERA.K @ _extrinsic(), _workspace()
    pixels, depth = _pinhole_pixels(A, world)
    back = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(A).T
    s = 1.0 / back[:, 2]
    error = max(float(np.abs(s / depth - 1.0).max()), float(np.abs(s[:, None] * back[:, :2] - world).max()))
    return Finding(
        f"exact to {error:.0e}",
        exactly(error < 1e-9),
        "from the plane to the picture and back: scale and place return, with A = K [R1 R2 t]",
        {"error": error},
    )


@claim(
    "cam.distortion",
    "B",
    "radial coefficients of the lens",
    "k1 = -0.2201, k2 = 0.5494",
    "data",
    basis="chosen",
)
def distortion() -> Finding:
    noise = float(_MEAN_ERROR_PX / _MEAN_OF_RAYLEIGH)
    found = np.array(
        [
            calibrate(pack(_views(noise, seed)), CAMERA.image_size_px, "radial2").camera.distortion[:2]
            for seed in range(_FITS)
        ]
    )
    k1, k2 = found.mean(axis=0).tolist()
    s1, s2 = found.std(axis=0, ddof=1).tolist()
    return Finding(
        f"{k1:.3f} +- {s1:.3f}, {k2:.2f} +- {s2:.2f}",
        Outcome.UNMEASURED,
        f"{_FITS} sets of 17 simulated views of a camera with these coefficients and an error of the printed "
        "size: the spread is what such a calibration leaves open",
        {"k1": k1, "k2": k2, "sigma_k1": s1, "sigma_k2": s2},
        simulated=True,
    )


@claim("cam.mustache", "B", "coefficients of different sign make mustache distortion", basis="printed")
def mustache() -> Finding:
    k1, k2 = CAMERA.distortion[:2].tolist()
    turns_at = float(np.sqrt(-3.0 * k1 / (5.0 * k2)))
    corner = float(np.linalg.norm(undistort(CAMERA, np.array([[0.0, 0.0]]))))
    r = np.linspace(0.0, corner, 400)
    moved = distort(r, np.zeros_like(r), CAMERA.distortion)[0] - r
    slopes = np.sign(np.diff(moved))
    mixed = bool(slopes.min() < 0.0 < slopes.max())
    return Finding(
        f"the displacement turns back at r = {turns_at:.2f}, the picture's corner is at {corner:.2f}",
        exactly(mixed),
        "displacement of the stand-in camera along a radius, its field of view of 60 degrees assumed: it "
        "goes towards the middle first and back further out",
        {"turns_at": turns_at, "corner": corner},
    )


def _bow(k1: float) -> float:
    """How much nearer to the middle a straight line's image is at its own middle than at its ends."""
    x, y = np.full(3, 0.4), np.array([-0.3, 0.0, 0.3])
    xd, _ = distort(x, y, np.array([k1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return float(xd[0] - xd[1])


@claim(
    "cam.naming",
    "B",
    "positive coefficients are barrel distortion, negative ones pincushion",
    basis="equations",
)
def naming() -> Finding:
    positive, negative = _bow(0.2), _bow(-0.2)
    return Finding(
        f"ends of a line {positive:+.4f} outwards for k1 > 0, {negative:+.4f} for k1 < 0",
        exactly(positive < 0.0 < negative),
        "image of a straight line beside the middle: for k1 > 0 its ends lie further out than its middle, "
        "which is pincushion, for k1 < 0 the other way round, which is barrel",
        {"bow_positive": positive, "bow_negative": negative},
    )


@claim(
    "cam.negligible", "B", "the lens does not matter where the marker moves", "-", "plant", basis="printed"
)
def negligible() -> Finding:
    width, height = CAMERA.image_size_px

    def moved(region: tuple[float, float, float, float]) -> FloatArray:
        pixels = pixel_grid(CAMERA.image_size_px, region).reshape(-1, 2)
        ideal = undistort(CAMERA, pixels) @ CAMERA.K[:2, :2].T + CAMERA.K[:2, 2]
        return np.asarray(np.linalg.norm(ideal - pixels, axis=1))

    u, v = 0.5 * (width - 1), 0.5 * (height - 1)
    middle = moved((u - 80.0, v - 60.0, u + 80.0, v + 60.0))
    whole = moved((0.0, 0.0, width - 1.0, height - 1.0))
    return Finding(
        f"up to {middle.max():.1f} px (mean {middle.mean():.2f}) in the middle, {whole.max():.1f} anywhere",
        exactly(float(middle.max()) < _MEAN_ERROR_PX),
        "displacement by the printed coefficients over 160 x 120 of 316 x 208 px, a field of view of 60 "
        "degrees assumed: more than the calibration's own error of 0.31 px",
        {
            "largest_px": float(middle.max()),
            "mean_px": float(middle.mean()),
            "anywhere_px": float(whole.max()),
        },
    )


@claim(
    "cam.no_closed_form",
    "B",
    "taking the distortion off needs a non-linear optimisation at every step",
    basis="printed",
)
def no_closed_form() -> Finding:
    inverse = fit_inverse(CAMERA, 0.01)
    return Finding(
        f"a polynomial of {len(inverse.radial)} coefficients within {inverse.max_error_px:.4f} px",
        exactly(not inverse.good_enough),
        "the inverse of the lens as a polynomial in r^2, fitted once beforehand: there is no closed form, "
        "but none is needed and nothing is optimised while it runs",
        {"coefficients": len(inverse.radial), "max_error_px": inverse.max_error_px},
    )


@claim(
    "cam.offset",
    "A.1",
    "the head follows from the marker by d = 0.015 m along the tangent",
    "exact",
    basis="equations",
)
def offset() -> Finding:
    phi, length, d = np.linspace(-1.5, 1.5, 13), np.full(13, 0.08), 0.015
    H = transform(phi, length)
    marker = H @ np.array([0.0, d, 1.0])
    error = float(np.abs(head_from_marker(marker[:, :2], phi, d) - H[:, :2, 2]).max())
    there = marker_from_head(H[:, :2, 2], phi, d)
    error = max(error, float(np.abs(there - marker[:, :2]).max()))
    return Finding(
        f"exact to {error:.0e} m",
        exactly(error < 1e-12),
        "marker fixed to the head's frame, carried by (3.6) with the right rotation, and taken back",
        {"error_m": error},
    )


CLAIMS = (
    points,
    mean_error,
    homography,
    scale,
    distortion,
    mustache,
    naming,
    negligible,
    no_closed_form,
    offset,
)
"""In the order of the source."""

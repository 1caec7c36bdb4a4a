"""Pictures of a printed checkerboard, rendered from the camera model, with the corners known exactly.

Inverse mapping: the ray of a pixel comes from `undistort`, and the point (X, Y) of the board that it
meets is a smooth function of the pixel. It is computed at the pixels' centres and carried to a grid of
n x n sub-samples by quartic interpolation (error below 1e-5 px). At a sub-sample an edge is not a
step but a ramp as wide as the sub-sample, which is odd about the edge and exact for edges along the
grid, so that no corner is pulled to the grid. The lens's Gaussian blur and the pixel's square
aperture act on the sub-samples; then come light, gamma, noise and 8 bits.

The same arguments give the same bytes: arithmetic is elementwise in double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.arrays import FloatArray, GrayImage, IntArray
from calib.camera.model import Camera, undistort
from calib.errors import BadInputError
from calib.twin.background import clutter, gaussian_noise
from calib.twin.sheet import (
    Pose,
    PrintedBoard,
    board_coordinates,
    corner_pixels,
    pose_facing,
    rotation,
    shadow,
    tones,
)

__all__ = [
    "Light",
    "Pose",
    "PrintedBoard",
    "Sensor",
    "corner_pixels",
    "expose",
    "pose_facing",
    "quantise",
    "render",
    "rotation",
]

_NODES = (-2.0, -1.0, 0.0, 1.0, 2.0)
_PIXELS_AT_ONCE = 4096


@dataclass(frozen=True)
class Light:
    """Light on the scene; positions run from -1 to 1 across the picture, strengths are fractions.

    Attributes
    ----------
    level : brightness of a white surface, as a fraction of full scale.
    gradient : change of brightness from the middle to the right and to the lower border.
    spot, spot_at, spot_radius : strength, centre and width (in half picture widths) of a Gaussian spot.
    vignetting : loss of light in the picture's corners.
    shadow : darkening of the background beside the sheet.
    """

    level: float = 0.95
    gradient: tuple[float, float] = (0.0, 0.0)
    spot: float = 0.0
    spot_at: tuple[float, float] = (0.0, 0.0)
    spot_radius: float = 0.6
    vignetting: float = 0.0
    shadow: float = 0.3


@dataclass(frozen=True)
class Sensor:
    """Lens blur and sensor.

    Attributes
    ----------
    blur_px : standard deviation of the lens's Gaussian blur; the pixel's aperture comes on top.
    motion_px : path of the picture during the exposure (du, dv); truth is the middle of it.
    noise_grey : standard deviation of the noise, grey levels.
    gamma : grey = 255 * light^(1 / gamma).
    supersampling : sub-samples per pixel along each axis.
    """

    blur_px: float = 0.7
    motion_px: tuple[float, float] = (0.0, 0.0)
    noise_grey: float = 2.0
    gamma: float = 1.0
    supersampling: int = 4


@dataclass(frozen=True)
class _Plan:
    """Kernel of aperture and blur on the sub-samples, and the border that it needs."""

    kernel: FloatArray
    reach: int
    pad_px: int


@lru_cache(maxsize=8)
def _rays_of(
    size_px: tuple[int, int], K: tuple[float, ...], distortion: tuple[float, ...], pad_px: int
) -> FloatArray:
    width, height = size_px
    fx, fy, skew, cx, cy = K
    camera = Camera("rational8", size_px, fx, fy, skew, cx, cy, np.array(distortion))
    v, u = np.mgrid[-pad_px : height + pad_px, -pad_px : width + pad_px].astype(np.float64)
    rays = undistort(camera, np.stack([u, v], axis=-1))
    rays.setflags(write=False)
    return rays


def _rays(camera: Camera, pad_px: int) -> FloatArray:
    """Normalised coordinates of the pixels' centres with a border of `pad_px`, kept per camera."""
    K = (camera.fx_px, camera.fy_px, camera.skew_px, camera.cx_px, camera.cy_px)
    return _rays_of(camera.image_size_px, tuple(map(float, K)), tuple(map(float, camera.distortion)), pad_px)


def _plan(sensor: Sensor) -> _Plan:
    n = sensor.supersampling
    radius = math.ceil(4.0 * sensor.blur_px * n)
    offsets = range(-radius, radius + 1)
    sigma = max(sensor.blur_px * n, 1e-3)
    bell = np.array([math.exp(-0.5 * (k / sigma) ** 2) for k in offsets])
    kernel = np.convolve(bell / math.fsum(bell), np.full(n, 1.0 / n))
    motion = math.ceil(0.5 * max(abs(value) for value in sensor.motion_px))
    return _Plan(kernel, radius, math.ceil(radius / n) + motion)


def _interpolation(n: int) -> FloatArray:
    """Weights of Lagrange's quartic on five pixels for each of n sub-samples of a pixel, shape (n, 5)."""
    weights = np.empty((n, len(_NODES)))
    for phase in range(n):
        offset = (phase + 0.5) / n - 0.5
        for j, node in enumerate(_NODES):
            weights[phase, j] = math.prod((offset - k) / (node - k) for k in _NODES if k != node)
    return weights


def _refine(values: FloatArray, rows: IntArray, columns: IntArray, weights: FloatArray) -> FloatArray:
    """Sub-samples (K, n, n) of the pixels (rows, columns) of an array that has two more pixels per side."""
    n = weights.shape[0]
    reach = np.arange(len(_NODES))
    around = values[rows[:, None, None] + reach[:, None], columns[:, None, None] + reach]
    along_v = np.zeros((rows.size, n, reach.size))
    out = np.zeros((rows.size, n, n))
    for j in reach:
        along_v += weights[:, j, None] * around[:, None, j, :]
    for j in reach:
        out += weights[:, j] * along_v[:, :, j, None]
    return out


def _steps(values: FloatArray) -> FloatArray:
    """Change of a board coordinate over one pixel, metres; two pixels are lost per side."""
    slope_v = 0.5 * (values[3:-1, 2:-2] - values[1:-3, 2:-2])
    slope_u = 0.5 * (values[2:-2, 3:-1] - values[2:-2, 1:-3])
    return np.sqrt(slope_u * slope_u + slope_v * slope_v)


def _sampled(printed: PrintedBoard, bx: FloatArray, by: FloatArray, behind: FloatArray, n: int) -> FloatArray:
    """Sub-samples (n H, n W) of the sheet over the background (H, W); bx and by are (H + 4, W + 4)."""
    step_x, step_y = _steps(bx), _steps(by)
    # Pixels farther than 1.5 px from every edge are plain, the others are drawn on the fine grid.
    ink, sheet = tones(printed, bx[2:-2, 2:-2], by[2:-2, 2:-2], 3.0 * step_x, 3.0 * step_y)
    plain = np.where(sheet < 0.5, behind, np.where(ink < 0.5, printed.paper, printed.ink))
    fine = np.repeat(np.repeat(plain, n, axis=0), n, axis=1)
    cells = fine.reshape(behind.shape[0], n, behind.shape[1], n)
    rows, columns = np.nonzero(((ink > 0.0) & (ink < 1.0)) | ((sheet > 0.0) & (sheet < 1.0)))
    weights = _interpolation(n)
    for start in range(0, rows.size, _PIXELS_AT_ONCE):
        i, j = rows[start : start + _PIXELS_AT_ONCE], columns[start : start + _PIXELS_AT_ONCE]
        ramp_x, ramp_y = step_x[i, j, None, None] / n, step_y[i, j, None, None] / n
        ink, sheet = tones(printed, _refine(bx, i, j, weights), _refine(by, i, j, weights), ramp_x, ramp_y)
        under = behind[i, j, None, None]
        cells[i, :, j, :] = under + sheet * (printed.paper - under) + ink * (printed.ink - printed.paper)
    return fine


def _move(fine: FloatArray, motion_px: tuple[float, float], n: int) -> FloatArray:
    """Average over the exposure, in steps of at most one sub-sample, symmetric about its middle."""
    half = math.ceil(0.5 * n * max(abs(value) for value in motion_px))
    if half == 0:
        return fine
    total = np.zeros_like(fine)
    for k in range(-half, half + 1):
        share = 0.5 * n * k / half
        shift = (round(share * motion_px[1]), round(share * motion_px[0]))
        total += np.roll(fine, shift, axis=(0, 1))
    return total / (2 * half + 1)


def _decimate(fine: FloatArray, plan: _Plan, n: int, size_px: tuple[int, int]) -> FloatArray:
    """Blur and aperture at the pixels' centres, shape (height, width)."""
    start = plan.pad_px * n - plan.reach
    width, height = size_px
    rows = np.zeros((height, fine.shape[1]))
    for k, weight in enumerate(plan.kernel):
        rows += weight * fine[start + k : start + k + n * (height - 1) + 1 : n]
    out = np.zeros((height, width))
    for k, weight in enumerate(plan.kernel):
        out += weight * rows[:, start + k : start + k + n * (width - 1) + 1 : n]
    return out


def _illumination(light: Light, size_px: tuple[int, int]) -> FloatArray:
    width, height = size_px
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = (2.0 * u - (width - 1)) / width, (2.0 * v - (height - 1)) / height
    ratio = height / width
    dx, dy = x - light.spot_at[0], (y - light.spot_at[1]) * ratio
    spot = light.spot * np.exp(-0.5 * (dx * dx + dy * dy) / (light.spot_radius * light.spot_radius))
    radius2 = (x * x + y * y * (ratio * ratio)) / (1.0 + ratio * ratio)
    even = 1.0 + light.gradient[0] * x + light.gradient[1] * y + spot
    light_there: FloatArray = light.level * even * (1.0 - light.vignetting * radius2)
    return light_there


def expose(
    camera: Camera,
    printed: PrintedBoard | None,
    pose: Pose | None,
    light: Light,
    sensor: Sensor,
    background: FloatArray | float,
) -> FloatArray:
    """Noise-free picture in grey levels, shape (height, width), not yet rounded or clipped.

    Parameters
    ----------
    printed, pose : the sheet; both None for a picture of the background alone.
    background : reflectance, one number or shape (height, width).

    Raises
    ------
    BadInputError : a background of another size than the picture, or a board without a pose.
    """
    width, height = camera.image_size_px
    n, plan = sensor.supersampling, _plan(sensor)
    behind = np.asarray(background, dtype=np.float64)
    if behind.ndim == 0:
        behind = np.full((height, width), float(behind))
    if behind.shape != (height, width):
        raise BadInputError(f"background has shape {behind.shape}, the picture {(height, width)}")
    if (printed is None) != (pose is None):
        raise BadInputError("a board needs a pose and a pose needs a board")
    behind = np.pad(behind, plan.pad_px, mode="edge")
    if printed is not None and pose is not None:
        bx, by = board_coordinates(printed, pose, _rays(camera, plan.pad_px + 2))
        behind = behind * (1.0 - light.shadow * shadow(printed, bx, by)[2:-2, 2:-2])
        fine = _sampled(printed, bx, by, behind, n)
    else:
        fine = np.repeat(np.repeat(behind, n, axis=0), n, axis=1)
    seen = _decimate(_move(fine, sensor.motion_px, n), plan, n, (width, height))
    seen = seen * _illumination(light, (width, height))
    if sensor.gamma != 1.0:
        seen = np.power(np.maximum(seen, 0.0), 1.0 / sensor.gamma)
    grey: FloatArray = 255.0 * seen
    return grey


def quantise(grey: FloatArray, noise_grey: float, seed: int) -> GrayImage:
    """Add seeded sensor noise and round to 8 bits, clipping at 0 and 255."""
    if noise_grey > 0.0:
        shape = (grey.shape[0], grey.shape[1])
        grey = grey + noise_grey * gaussian_noise(np.random.PCG64(seed), shape)
    return np.clip(np.floor(grey + 0.5), 0.0, 255.0).astype(np.uint8)


def render(
    camera: Camera,
    printed: PrintedBoard | None = None,
    pose: Pose | None = None,
    *,
    light: Light | None = None,
    sensor: Sensor | None = None,
    background: FloatArray | float | None = None,
    seed: int = 0,
) -> GrayImage:
    """Picture that the camera takes, shape (height, width), 8 bits; the same arguments, the same bytes.

    Without `background` the board lies on a desk strewn with things, drawn from `seed`.
    """
    light = Light() if light is None else light
    sensor = Sensor() if sensor is None else sensor
    if background is None:
        background = clutter(camera.image_size_px, seed)
    grey = expose(camera, printed, pose, light, sensor, background)
    return quantise(grey, sensor.noise_grey, seed + 1)

"""Pictures of a printed checkerboard, rendered from the camera model, with the corners known exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray, GrayImage, IntArray
from calib.core.errors import BadInputError
from calib.stages.camera.model import Board, Camera, project, undistort
from calib.twin.sensors import normal, uniform

# ----------------------------------------------------------------------
# The printed sheet in front of a camera: its pose, where rays meet it, and what colour it has there.


@dataclass(frozen=True)
class Pose:
    """Board to camera: p_C = R_CB p_B + t_m, with the board's origin in its corner (0, 0).

    Attributes
    ----------
    R_CB : (3, 3) rotation.
    t_m : (3,) corner (0, 0) in the camera's frame, metres.
    """

    R_CB: FloatArray
    t_m: FloatArray


@dataclass(frozen=True)
class PrintedBoard:
    """The sheet as it really is, which may differ from the board that a user believes in.

    Attributes
    ----------
    board : corners and the width of a square.
    aspect : height of a square over its width.
    bow_m : deflection away from the camera, along columns and along rows, metres: a parabola that
        is zero at the outermost inner corners and `bow_m` half-way between them.
    margin_squares : width of the white margin, in squares.
    paper, ink : reflectances.
    """

    board: Board
    aspect: float = 1.0
    bow_m: tuple[float, float] = (0.0, 0.0)
    margin_squares: float = 1.0
    paper: float = 0.82
    ink: float = 0.07

    @property
    def pitch_m(self) -> tuple[float, float]:
        """Distance of neighbouring corners along columns and rows, metres."""
        return self.board.square_m, self.board.square_m * self.aspect

    @property
    def centre_m(self) -> FloatArray:
        """Middle of the board before it is bent, shape (3,), metres."""
        px, py = self.pitch_m
        return np.array([0.5 * (self.board.columns - 1) * px, 0.5 * (self.board.rows - 1) * py, 0.0])

    def depth_m(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Bow z(x, y) and its slopes along x and y, metres and dimensionless."""
        z, slopes = np.zeros_like(x_m), []
        for value, bow, middle in zip((x_m, y_m), self.bow_m, self.centre_m, strict=False):
            half = max(float(middle), 1e-9)
            ratio = (value - middle) / half
            z = z + bow * (1.0 - ratio * ratio)
            slopes.append(-2.0 * bow * ratio / half)
        return z, slopes[0], slopes[1]

    def points_m(self) -> FloatArray:
        """Inner corners on the bent sheet, shape (columns * rows, 3), metres, in the order of `Board`."""
        flat = self.board.points_m() * np.array([1.0, self.aspect])
        z, _, _ = self.depth_m(flat[:, 0], flat[:, 1])
        return np.column_stack([flat, z])


def rotation(tilt_rad: float, azimuth_rad: float = 0.0, roll_rad: float = 0.0) -> FloatArray:
    """R_CB of a board that is rolled in its plane and then tilted, shape (3, 3).

    The tilt pushes the side that lies in the direction `azimuth_rad` (0 right, pi/2 down) away from
    the camera. Zero everywhere is a board parallel to the picture.
    """
    ca, sa = math.cos(azimuth_rad), math.sin(azimuth_rad)
    ct, st = math.cos(tilt_rad), math.sin(tilt_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    # Rodrigues about (sin a, -cos a, 0); written out because a matrix product may differ by an ulp.
    tilted = (
        (ct * ca * ca + sa * sa, (ct - 1.0) * ca * sa, -st * ca),
        ((ct - 1.0) * ca * sa, ct * sa * sa + ca * ca, -st * sa),
        (st * ca, st * sa, ct),
    )
    return np.array([[a * cr + b * sr, b * cr - a * sr, c] for a, b, c in tilted])


def pose_facing(
    camera: Camera,
    printed: PrintedBoard,
    pixel: tuple[float, float],
    distance_m: float,
    tilt_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    roll_rad: float = 0.0,
) -> Pose:
    """Pose whose board has its middle at `pixel` and at depth Z = `distance_m`, turned as in `rotation`.

    Raises
    ------
    BadInputError : no ray of the camera ends at this pixel.
    """
    ray = undistort(camera, np.array(pixel, dtype=np.float64))
    if not np.all(np.isfinite(ray)):
        raise BadInputError(f"pixel {pixel} is beyond the fold of the camera's distortion")
    R = rotation(tilt_rad, azimuth_rad, roll_rad)
    cx, cy, _ = (float(value) for value in printed.centre_m)
    at = (float(ray[0]) * distance_m, float(ray[1]) * distance_m, distance_m)
    return Pose(R, np.array([at[k] - (R[k, 0] * cx + R[k, 1] * cy) for k in range(3)]))


def corner_pixels(camera: Camera, printed: PrintedBoard, pose: Pose) -> FloatArray:
    """True pixels of the inner corners, shape (columns * rows, 2), in the order of `Board.points_m`."""
    return project(camera, printed.points_m() @ pose.R_CB.T + pose.t_m)


def board_coordinates(printed: PrintedBoard, pose: Pose, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where rays (..., 2) meet the sheet: (X, Y) in metres, NaN where they miss it or see its back."""
    x, y = rays[..., 0], rays[..., 1]
    R = [[float(value) for value in row] for row in pose.R_CB]
    t = [float(value) for value in pose.t_m]
    origin = [-(R[0][k] * t[0] + R[1][k] * t[1] + R[2][k] * t[2]) for k in range(3)]
    dx, dy, dz = (R[0][k] * x + R[1][k] * y + R[2][k] for k in range(3))
    with np.errstate(all="ignore"):
        depth = -origin[2] / dz
        bx, by = origin[0] + depth * dx, origin[1] + depth * dy
        if printed.bow_m != (0.0, 0.0):
            # Newton on the ray's depth; a parabola this flat needs three or four steps.
            for _ in range(8):
                z, zx, zy = printed.depth_m(bx, by)
                depth = depth - (origin[2] + depth * dz - z) / (dz - zx * dx - zy * dy)
                bx, by = origin[0] + depth * dx, origin[1] + depth * dy
        far = 3.0 * max(printed.board.columns + 2, printed.board.rows + 2) * max(printed.pitch_m)
        seen = (dz > 0.0) & (depth > 0.0) & (np.abs(bx) < far) & (np.abs(by) < far)
    return np.where(seen, bx, np.nan), np.where(seen, by, np.nan)


def _coverage(
    printed: PrintedBoard, coordinate: FloatArray, ramp: FloatArray, axis: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along one axis: alternating sign of the squares, share inside the squares, share inside the sheet."""
    pitch = printed.pitch_m[axis]
    last = (printed.board.columns, printed.board.rows)[axis]
    t = coordinate / pitch
    slope = pitch / ramp
    # The outermost squares have no neighbour, so their colour does not change again.
    wave = np.clip(t, -0.5, last - 0.5) + 0.5
    wave -= 2.0 * np.floor(0.5 * wave)
    sign = np.clip((2.0 * np.abs(wave - 1.0) - 1.0) * slope, -1.0, 1.0)
    beyond = (np.abs(t - 0.5 * (last - 1)) - 0.5 * (last + 1)) * slope - 0.5
    inside = np.clip(-beyond, 0.0, 1.0)
    sheet = np.clip(printed.margin_squares * slope - beyond, 0.0, 1.0)
    return sign, inside, sheet


def tones(
    printed: PrintedBoard, bx: FloatArray, by: FloatArray, ramp_x: FloatArray, ramp_y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Shares of ink and of sheet at board coordinates, any shape, each in [0, 1], both 0 off the sheet.

    Parameters
    ----------
    bx, by : board coordinates, metres, NaN off the board's plane.
    ramp_x, ramp_y : widths over which an edge along each axis goes from 0 to 1, metres.
    """
    sign_x, inside_x, sheet_x = _coverage(printed, bx, ramp_x, 0)
    sign_y, inside_y, sheet_y = _coverage(printed, by, ramp_y, 1)
    sheet = sheet_x * sheet_y
    ink = inside_x * inside_y * (0.5 + 0.5 * sign_x * sign_y)
    seen = np.isfinite(sheet)
    return np.where(seen, ink, 0.0), np.where(seen, sheet, 0.0)


def shadow(printed: PrintedBoard, bx: FloatArray, by: FloatArray) -> FloatArray:
    """Soft shadow around the sheet, in [0, 1], falling to the lower right."""
    px, py = printed.pitch_m
    half_x = (0.5 * (printed.board.columns + 1) + printed.margin_squares) * px
    half_y = (0.5 * (printed.board.rows + 1) + printed.margin_squares) * py
    mx, my, _ = (float(value) for value in printed.centre_m)
    outside = np.maximum(np.abs(bx - mx - 0.15 * px) - half_x, np.abs(by - my - 0.15 * py) - half_y)
    return np.where(np.isfinite(outside), np.clip(0.5 - outside / (0.8 * px), 0.0, 1.0), 0.0)


# ----------------------------------------------------------------------
# A cluttered desk behind the board. As for the random numbers only elementwise arithmetic is used.

_OBJECTS = 16


def _value_noise(bits: np.random.PCG64, width: int, height: int, cell_px: float) -> FloatArray:
    """Smooth random surface in [-1, 1], shape (height, width), with bumps of about `cell_px`."""
    columns, rows = int(width / cell_px) + 2, int(height / cell_px) + 2
    knots = 2.0 * uniform(bits, columns * rows).reshape(rows, columns) - 1.0

    def along(count: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], FloatArray]:
        position = np.arange(count) / cell_px
        cell = np.floor(position).astype(np.intp)
        t = position - cell
        return cell, t * t * (3.0 - 2.0 * t)

    (i, s), (j, t) = along(width), along(height)
    upper = knots[:, i] + s * (knots[:, i + 1] - knots[:, i])
    return upper[j] + t[:, None] * (upper[j + 1] - upper[j])


def _distance_rectangle(x: FloatArray, y: FloatArray, half_x: float, half_y: float) -> FloatArray:
    """Signed distance to a rectangle's outline, negative inside (an octagonal norm at the corners)."""
    return np.maximum(np.abs(x) - half_x, np.abs(y) - half_y)


def clutter(size_px: tuple[int, int], seed: int) -> FloatArray:
    """Reflectance of a desk strewn with papers, discs, frames and cables, without any checkerboard.

    Parameters
    ----------
    size_px : (width, height).

    Returns
    -------
    (height, width) in [0.03, 0.95].
    """
    width, height = size_px
    bits = np.random.PCG64(seed)
    scale = float(max(width, height))
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    tone = float(uniform(bits, 1)[0])
    picture = 0.26 + 0.24 * tone + np.zeros((height, width))
    for cell, strength in ((0.31, 0.07), (0.083, 0.03), (0.019, 0.015)):
        picture += strength * _value_noise(bits, width, height, max(2.0, cell * scale))
    grain = _value_noise(bits, width, height, max(2.0, 0.012 * scale))
    for _ in range(_OBJECTS):
        draw = [float(value) for value in uniform(bits, 10)]
        angle = math.pi * draw[2]
        c, s = math.cos(angle), math.sin(angle)
        du, dv = u - width * (1.2 * draw[0] - 0.1), v - height * (1.2 * draw[1] - 0.1)
        x, y = c * du + s * dv, c * dv - s * du
        size = scale * (0.03 + 0.12 * draw[3])
        kind = int(5 * draw[4])
        if kind == 0:  # a disc, such as a mug from above, with a rim
            distance = np.sqrt(x * x + y * y) - 0.6 * size
            if draw[9] > 0.5:
                distance = np.abs(distance) - 0.12 * size
        elif kind == 1:  # a cable: a long, slightly bent line
            bend = (draw[5] - 0.5) / scale
            distance = np.abs(y - bend * x * x) - scale * (0.003 + 0.005 * draw[9])
        elif kind == 2:  # the outline of a frame
            distance = np.abs(_distance_rectangle(x, y, size, size * (0.4 + draw[5]))) - 0.08 * size
        elif kind == 3:  # a pen
            distance = _distance_rectangle(x, y, 1.6 * size, scale * (0.006 + 0.008 * draw[5]))
        else:  # a book or a sheet of paper
            distance = _distance_rectangle(x, y, size, size * (0.5 + draw[5]))
        softness = 1.0 + 0.006 * scale * draw[6]
        coverage = np.clip(0.5 - distance / softness, 0.0, 1.0)
        shade = 0.06 + 0.66 * draw[7] + 0.08 * (draw[8] - 0.5) * (du + dv) / size + 0.03 * grain
        shadow = 0.3 * np.clip(0.6 - distance / (0.03 * scale), 0.0, 1.0)
        picture = (1.0 - coverage) * picture * (1.0 - shadow) + coverage * shade
    return np.clip(picture, 0.03, 0.95)


# ----------------------------------------------------------------------
# Pictures of a printed checkerboard, rendered from the camera model, with the corners known exactly.
#
# Inverse mapping: the ray of a pixel comes from `undistort`, and the point (X, Y) of the board that it
# meets is a smooth function of the pixel. It is computed at the pixels' centres and carried to a grid of
# n x n sub-samples by quartic interpolation (error below 1e-5 px). At a sub-sample an edge is not a
# step but a ramp as wide as the sub-sample, which is odd about the edge and exact for edges along the
# grid, so that no corner is pulled to the grid. The lens's Gaussian blur and the pixel's square
# aperture act on the sub-samples; then come light, gamma, noise and 8 bits.
#
# The same arguments give the same bytes: arithmetic is elementwise in double precision.

_NODES = (-2.0, -1.0, 0.0, 1.0, 2.0)
_PIXELS_AT_ONCE = 4096
_ROWS_AT_ONCE = 8


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
    model: str, size_px: tuple[int, int], K: tuple[float, ...], distortion: tuple[float, ...], pad_px: int
) -> FloatArray:
    width, height = size_px
    fx, fy, skew, cx, cy = K
    camera = Camera(model, size_px, fx, fy, skew, cx, cy, np.array(distortion))
    v, u = np.mgrid[-pad_px : height + pad_px, -pad_px : width + pad_px].astype(np.float64)
    rays = undistort(camera, np.stack([u, v], axis=-1))
    rays.setflags(write=False)
    return rays


def _rays(camera: Camera, pad_px: int) -> FloatArray:
    """Normalised coordinates of the pixels' centres with a border of `pad_px`, kept per camera."""
    K = (camera.fx_px, camera.fy_px, camera.skew_px, camera.cx_px, camera.cy_px)
    distortion = tuple(map(float, camera.distortion))
    return _rays_of(camera.model, camera.image_size_px, tuple(map(float, K)), distortion, pad_px)


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
    width, height = size_px
    taps = list(enumerate(plan.kernel, plan.pad_px * n - plan.reach))
    out = np.empty((height, width))
    # A few rows at once stay in the processor's cache, and so do columns that lie side by side.
    for top in range(0, height, _ROWS_AT_ONCE):
        seen = out[top : top + _ROWS_AT_ONCE]
        rows = np.zeros((len(seen), fine.shape[1]))
        product = np.empty_like(rows)
        for at, weight in taps:
            begin = n * top + at
            rows += np.multiply(fine[begin : begin + n * (len(seen) - 1) + 1 : n], weight, out=product)
        phases = np.ascontiguousarray(rows.reshape(len(seen), -1, n).transpose(2, 0, 1))
        seen[:] = 0.0
        for at, weight in taps:
            seen += weight * phases[at % n][:, at // n : at // n + width]
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
        grey = grey + noise_grey * normal(np.random.PCG64(seed), *grey.shape)
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

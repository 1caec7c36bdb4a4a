"""Sub-pixel refinement of a grid of corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Self

import cv2
import numpy as np
import numpy.typing as npt

from calib.core.arrays import BoolArray, FloatArray, GrayImage, IntArray, evenly
from calib.core.geometry import linear_homographies
from calib.stages.camera.lattice import checkered, extrapolated

# ----------------------------------------------------------------------
# The blurred corner itself, fitted to the grey levels around it, many corners at once.
#
# Around a corner at (u0, v0) the edges along the rows and along the columns of the board have the
# directions alpha and beta and the curvatures kappa and lambda, which distortion gives them. With
# (x, y) the offset from the corner, c = cos, s = sin,
#
#     t1 =  c(alpha) x + s(alpha) y      d1 = -s(alpha) x + c(alpha) y - kappa t1^2 / 2
#     t2 =  c(beta)  x + s(beta)  y      d2 =  s(beta)  x - c(beta)  y + lambda t2^2 / 2
#
# d1 and d2 are the distances from the two edges, growing with row and column, t1 and t2 the way along
# them. Blur and the pixel's aperture make an error function of each step:
#
#     I = (1 + g_x x + g_y y) (b + a erf(d1 / w) erf(d2 / w))
#
# Light that is not even scales dark and bright alike, hence one gradient g. The parameters u0, v0,
# alpha, beta, w, b, a, g_x, g_y, kappa, lambda of each corner are found by Levenberg-Marquardt. The
# curvatures are measured much better by the row and column of corners than by a single window: that
# value and its standard deviation enter as one more observation. So does the gradient, from the tones b
# of the corners beside: where blur fills the window, g_y b y is nearly what a shift of u0 makes. So do
# the tones b and a of the start, weakly: in a picture that is full everywhere nothing else holds them.
# The window is a parallelogram along the board, so that the model holds in all of it.
#
# A camera that sharpens adds h times the difference between the picture and itself blurred by a Gaussian
# of standard deviation r. Of the product of two edges that leaves
#
#     (1 + h) erf(d1 / w) erf(d2 / w) - h erf(d1 / w') erf(d2 / w'),   w'^2 = w^2 + 2 r^2,
#
# with h for a twelfth parameter; r is one for the whole picture.
#
# A board that moves is blurred along one line, which moves both edges at once: the two distances are then
# correlated. By Plackett's identity a correlation rho adds to the product of the edges, to first order,
#
#     rho (2 / pi) exp(-(d1 / w)^2 - (d2 / w)^2),
#
# with rho for the twelfth parameter instead. Without it a corner that moved by half a square has two places
# that fit alike, one to each side of the true one.

WINDOW = 0.45
"""Half the window's width over the local square: the next corner must not come in."""
REACH_PX = 12
_LEAST_REACH_PX = 2.5
_ITERATIONS = 16
_STEP_PX = 3e-3
_STEP_SIGMA = 0.1
_WHITE = np.float32(255.0)
_NOISE, _LEAST_NOISE = 0.04, 1.0
_LEAST_BEND_SIGMA = 1e-6
_WARM_RESIDUAL = 0.5
_START_WIDTH_PX = 1.2
_APERTURE_PX2 = 1.0 / 12.0
"""Variance of a pixel's aperture."""
_WIDTH_PX = (float(np.sqrt(2.0 * _APERTURE_PX2)), 12.0)
"""The least width is that of a pixel's aperture."""
_SAMPLING_PX = 0.04
"""Standard deviation of the place of an edge along the pixels without blur, as in rendered pictures."""
_PARAMETERS = 11
_WIDTH = 4
_OBSERVED = np.array([5, 6, 9, 10, 7, 8])
"""Parameters that are observed beside the picture: b, a, kappa, lambda, g_x and g_y."""
_TONE_SIGMA = 5.0
"""Standard deviation of the tones of the start, grey levels."""
_UNKNOWN_BEND = 3e-3
_UNKNOWN_LIGHT = 1.0
_PART_PIXELS, _LEAST_PART = 24_000, 8
"""Corners are fitted in parts of about so many pixels, whose arrays stay in the processor's cache."""
_EDGE_SLOPE = 2.0 / np.sqrt(np.pi)

_Float32 = npt.NDArray[np.float32]


class _Rows:
    """Arrays of one row for each of N corners."""

    def take(self, chosen: IntArray) -> Self:
        """Those of some corners."""
        return type(self)(*(value[chosen] for value in vars(self).values()))


@dataclass(frozen=True)
class Frames(_Rows):
    """What the grid says of the surroundings of each of N corners.

    Attributes
    ----------
    along, across : (N, 2) steps to the next column and row, pixels.
    bends : (N, 2) curvatures of the edges along the row and along the column, 1 / px.
    bend_sigmas : (N, 2) standard deviations of `bends`.
    light : (N, 2) gradient of the light over the light, 1 / px.
    light_sigmas : (N, 2) its standard deviations.
    """

    along: FloatArray
    across: FloatArray
    bends: FloatArray
    bend_sigmas: FloatArray
    light: FloatArray
    light_sigmas: FloatArray


@dataclass(frozen=True)
class LocalFit(_Rows):
    """Fitted corners.

    Attributes
    ----------
    points : (N, 2) pixels.
    sigma_px : (N,) standard deviation of one coordinate, from the fit's residuals.
    amplitude : (N,) half the step from dark to bright, positive where the square between growing
        column and growing row is bright, grey levels.
    residual : (N,) RMS of the fit over |amplitude|.
    width_px : (N,) sqrt(2) times the standard deviation of the blur.
    window : (N,) half the width of the window over the local square.
    parameters : (N, 11) as the fit holds them, to start another one, or (N, 12) with h or rho.
    converged : (N,) whether the last step was small and the window held enough of the corner.
    """

    points: FloatArray
    sigma_px: FloatArray
    amplitude: FloatArray
    residual: FloatArray
    width_px: FloatArray
    window: FloatArray
    parameters: FloatArray
    converged: BoolArray

    def tones(self, shape: tuple[int, int]) -> FloatArray:
        """The mean of dark and bright at each corner of a grid, grey levels."""
        return self.parameters[:, 5].reshape(shape)


@dataclass(frozen=True)
class _Windows(_Rows):
    """Pixels around N corners, (N, M) each, with weights 0 or 1; x and y from `centre` (N, 2)."""

    centre: FloatArray
    x: _Float32
    y: _Float32
    grey: _Float32
    weight: _Float32


def _curvatures(curves: FloatArray, degree: int) -> FloatArray:
    """Curvature (m, n) of m curves of n points, (m, n, 2), each a polynomial over its own chord.

    Perspective keeps lines straight, so the polynomial has to follow the lens only.
    """
    chord = curves[:, -1] - curves[:, 0]
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
    c, s = (chord / length).T[:, :, None]
    offset = curves - curves.mean(axis=1, keepdims=True)
    t = (c * offset[..., 0] + s * offset[..., 1]) * (2.0 / length)
    height = c * offset[..., 1] - s * offset[..., 0]
    powers = t[..., None] ** np.arange(degree + 1)
    normal = powers.transpose(0, 2, 1) @ powers + 1e-9 * np.eye(degree + 1)
    k = np.linalg.solve(normal, powers.transpose(0, 2, 1) @ height[..., None])[..., 0]
    m = np.arange(degree + 1)
    slope = np.einsum("mnd,md->mn", powers[..., :-1], (k * m)[:, 1:]) * (2.0 / length)
    bend = np.einsum("mnd,md->mn", powers[..., :-2], (k * m * (m - 1))[:, 2:]) * (2.0 / length) ** 2
    return np.asarray(bend / (1.0 + slope**2) ** 1.5)


def _bends(curves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Curvatures and their standard deviations, (m, n): half of what one degree more or less would change."""
    n = curves.shape[1]
    if n < 3:
        return np.zeros(curves.shape[:2]), np.full(curves.shape[:2], _UNKNOWN_BEND)
    degree = 2 if n < 5 else 3 if n < 7 else 4
    bend = _curvatures(curves, degree)
    lower = _curvatures(curves, degree - 1) if degree > 2 else np.zeros_like(bend)
    change = 0.5 * np.abs(bend - lower)
    # Alike along the curve, but for the ends, where the polynomials differ most.
    sigma = np.maximum(change, np.sqrt(np.mean(change**2, axis=1, keepdims=True)))
    return bend, sigma


def _smoothed(values: FloatArray) -> FloatArray:
    """Binomial means over 3 x 3 of a grid, without what alternates from corner to corner."""
    for axis in (0, 1):
        wide = np.pad(values, [(int(axis == k),) * 2 for k in (0, 1)], "reflect", reflect_type="odd")
        before, after = np.delete(wide, (-1, -2), axis), np.delete(wide, (0, 1), axis)
        values = 0.5 * values + 0.25 * (before + after)
    return values


def _slopes(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Steps along the rows of a grid (m, n), smoothed, and their standard deviations.

    Half of how much a step changes to either side, or how far the smoothed one is from the corners' own.
    """
    smooth = _smoothed(values)
    step = np.gradient(smooth, axis=1)
    if values.shape[1] < 3:
        return step, np.full_like(step, _UNKNOWN_LIGHT)
    change = np.abs(np.diff(smooth, 2, axis=1))
    # At the ends only one side tells.
    change = np.concatenate([2.0 * change[:, :1], change, 2.0 * change[:, -1:]], axis=1)
    off = np.maximum(0.5 * change, np.abs(np.gradient(values, axis=1) - step))
    beside = np.pad(off, ((0, 0), (1, 1)))
    largest = np.maximum(np.maximum(beside[:, :-2], beside[:, 2:]), off)
    return step, np.maximum(largest, np.median(off, axis=1, keepdims=True))


def frames_of(points: FloatArray, tones: FloatArray | None = None) -> Frames:
    """Steps and curvatures of a grid of corners, (rows, columns, 2) pixels, at least 2 x 2.

    The light's gradient follows from their tones (rows, columns), grey levels, and is unknown without.
    """
    along, across = np.gradient(points, axis=1), np.gradient(points, axis=0)
    by_row, by_column = _bends(points), _bends(points.transpose(1, 0, 2))
    bends, sigmas = (
        np.stack([row.ravel(), column.T.ravel()], axis=1)
        for row, column in zip(by_row, by_column, strict=True)
    )
    along, across = along.reshape(-1, 2), across.reshape(-1, 2)
    light, light_sigmas = np.zeros_like(bends), np.full_like(bends, _UNKNOWN_LIGHT)
    if tones is not None:
        shades = np.log(np.nan_to_num(np.fmax(tones, 1.0)))
        steps, changes = (
            np.stack([row.ravel(), column.T.ravel()], axis=1)[..., None]
            for row, column in zip(_slopes(shades), _slopes(shades.T), strict=True)
        )
        inverse = np.linalg.pinv(np.stack([along, across], axis=1))
        light = (inverse @ steps)[..., 0]
        light_sigmas = np.sqrt((inverse**2 @ changes**2)[..., 0])
    return Frames(along, across, bends, sigmas, light, light_sigmas)


def _windows(
    image: _Float32 | GrayImage, points: FloatArray, frames: Frames, window: float, most_px: int
) -> _Windows:
    height, width = image.shape
    centre = np.rint(points)
    extent = window * (np.abs(frames.along) + np.abs(frames.across))
    reach = int(np.clip(np.ceil(extent.max(initial=3.0)), np.ceil(_LEAST_REACH_PX), most_px))
    offset = np.arange(-reach, reach + 1)
    dx, dy = (o.ravel() for o in np.meshgrid(offset, offset))
    x = dx - (points - centre)[:, :1]
    y = dy - (points - centre)[:, 1:]
    (ax, ay), (bx, by) = frames.along.T[:, :, None], frames.across.T[:, :, None]
    area = np.maximum(np.abs(ax * by - ay * bx), 1e-9)
    inside = (np.abs(by * x - bx * y) <= window * area) & (np.abs(ax * y - ay * x) <= window * area)
    # The smallest squares leave too few pixels; there the next edge is let in.
    inside |= (np.abs(x) <= _LEAST_REACH_PX) & (np.abs(y) <= _LEAST_REACH_PX)
    u, v = centre[:, :1] + dx, centre[:, 1:] + dy
    inside &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    # Pack the pixels that count to the left.
    most = max(int(inside.sum(axis=1).max(initial=1)), 1)
    packed = np.argsort(~inside, axis=1, kind="stable")[:, :most]
    weight = np.take_along_axis(inside, packed, axis=1)
    u = np.clip(np.take_along_axis(u, packed, axis=1), 0, width - 1).astype(np.intp)
    v = np.clip(np.take_along_axis(v, packed, axis=1), 0, height - 1).astype(np.intp)
    return _Windows(
        centre,
        dx[packed].astype(np.float32),
        dy[packed].astype(np.float32),
        image[v, u].astype(np.float32, copy=False),
        weight.astype(np.float32),
    )


def _edge(d: _Float32, w: _Float32) -> tuple[_Float32, _Float32, _Float32]:
    """erf(d / w) and its derivatives by d and by w (Abramowitz and Stegun 7.1.26, error below 2e-7)."""
    z = d / w
    bell = np.exp(-z * z)
    t = 1.0 / (1.0 + np.float32(0.3275911) * np.abs(z))
    series = np.float32(1.061405429) * t
    for c in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        series = (series + np.float32(c)) * t
    slope = np.float32(_EDGE_SLOPE) * bell / w
    return np.copysign(1.0 - series * bell, z), slope, -slope * z


class _Places(NamedTuple):
    """Where the pixels (N, M) lie in the corners' own coordinates: the symbols of the equations above."""

    x: _Float32
    y: _Float32
    t1: _Float32
    t2: _Float32
    n1: _Float32
    n2: _Float32
    d1: _Float32
    d2: _Float32
    w: _Float32


def _places(q: _Float32, win: _Windows) -> _Places:
    u0, v0, alpha, beta, w, _, _, _, _, kappa, lam = (q[:, k, None] for k in range(_PARAMETERS))
    x, y = win.x - u0, win.y - v0
    c1, s1, c2, s2 = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    t1, t2 = c1 * x + s1 * y, c2 * x + s2 * y
    n1, n2 = c1 * y - s1 * x, s2 * x - c2 * y
    half = np.float32(0.5)
    return _Places(x, y, t1, t2, n1, n2, n1 - half * kappa * t1 * t1, n2 + half * lam * t2 * t2, w)


def _model(q: _Float32, win: _Windows, room: _Float32, part: Part) -> tuple[_Float32, _Float32]:
    """Residuals (N, M) and the Jacobian of the model (N, P, M), in `room`, both zero outside the window."""
    _, _, alpha, beta, _, b, a, gx, gy, kappa, lam = (q[:, k, None] for k in range(_PARAMETERS))
    x, y, t1, t2, n1, n2, d1, d2, w = _places(q, win)
    c1, s1, c2, s2 = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    k1t, k2t = kappa * t1, lam * t2
    P, P1, P2, Pw = _crossing(d1, d2, w)
    J = room[: len(q)]
    light = (1.0 + gx * x + gy * y) * win.weight
    if part.halo_px:
        h, wide = q[:, _PARAMETERS, None], np.sqrt(w * w + np.float32(2.0 * part.halo_px**2))
        Q, Q1, Q2, Qw = _crossing(d1, d2, wide)
        J[:, _PARAMETERS] = a * light * (P - Q)
        P, P1, P2 = P + h * (P - Q), P1 + h * (P1 - Q1), P2 + h * (P2 - Q2)
        Pw = Pw + h * (Pw - Qw * (w / wide))
    if part.moved:
        z1, z2, two = d1 / w, d2 / w, np.float32(2.0)
        bell = np.float32(2.0 / np.pi) * np.exp(-z1 * z1 - z2 * z2)
        J[:, _PARAMETERS] = a * light * bell
        R = two * q[:, _PARAMETERS, None] / w * bell
        P, Pw = P + (w / two) * R, Pw + (z1 * z1 + z2 * z2) * R
        P1, P2 = P1 - z1 * R, P2 - z2 * R
    tone = b + a * P
    by_d1, by_d2 = a * light * P1, a * light * P2
    toned = win.weight * tone
    J[:, 0] = by_d1 * (s1 + k1t * c1) - by_d2 * (s2 + k2t * c2) - gx * toned
    J[:, 1] = by_d1 * (k1t * s1 - c1) + by_d2 * (c2 - k2t * s2) - gy * toned
    J[:, 2] = by_d1 * (-t1 - k1t * n1)
    J[:, 3] = by_d2 * (t2 - k2t * n2)
    J[:, 4] = a * light * Pw
    J[:, 5] = light
    J[:, 6] = light * P
    J[:, 7] = x * toned
    J[:, 8] = y * toned
    J[:, 9] = by_d1 * (-0.5 * t1 * t1)
    J[:, 10] = by_d2 * (0.5 * t2 * t2)
    shown = light * tone
    # A sensor that is full shows white, whatever the light: nothing there to learn from.
    full = (shown >= _WHITE) | (shown < 0.0)
    if np.any(full):
        J *= ~full[:, None, :]
        shown = np.clip(shown, 0.0, _WHITE)
    return (win.grey * win.weight - shown).astype(np.float32, copy=False), J


def _crossing(d1: _Float32, d2: _Float32, w: _Float32) -> tuple[_Float32, _Float32, _Float32, _Float32]:
    """erf(d1 / w) erf(d2 / w) and its derivatives by d1, d2 and w."""
    E1, G1, W1 = _edge(d1, w)
    E2, G2, W2 = _edge(d2, w)
    return E1 * E2, G1 * E2, E1 * G2, W1 * E2 + E1 * W2


def _start(points: FloatArray, frames: Frames, win: _Windows, count: int) -> FloatArray:
    """Parameters (N, count) with position and directions of the grid, and the grey levels that fit them."""
    q = np.zeros((len(points), count))
    q[:, :2] = points - win.centre
    q[:, 2] = np.arctan2(frames.along[:, 1], frames.along[:, 0])
    q[:, 3] = np.arctan2(frames.across[:, 1], frames.across[:, 0])
    q[:, 4] = _START_WIDTH_PX
    q[:, 9:11] = frames.bends
    at = _places(q.astype(np.float32), win)
    P = np.asarray(_edge(at.d1, at.w)[0] * _edge(at.d2, at.w)[0] * win.weight, dtype=np.float64)
    grey = win.grey * win.weight
    n, sum_p, sum_pp = win.weight.sum(axis=1), P.sum(axis=1), (P * P).sum(axis=1)
    sum_g, sum_gp = grey.sum(axis=1), (grey * P).sum(axis=1)
    det = np.maximum(n * sum_pp - sum_p**2, 1e-9)
    q[:, 6] = (n * sum_gp - sum_p * sum_g) / det
    q[:, 5] = (sum_pp * sum_g - sum_p * sum_gp) / det
    return q


def fit_corners(
    part: Part,
    points: FloatArray,
    frames: Frames,
    iterations: int = _ITERATIONS,
    reach_px: int = REACH_PX,
    window: float = WINDOW,
    warm: LocalFit | None = None,
) -> LocalFit:
    """Fit the blurred corner around each of N points.

    Parameters
    ----------
    part : of the picture.
    points : (N, 2) where to start, pixels of the part.
    frames : steps and curvatures of the grid at the N points.
    reach_px : most pixels that a window reaches to each side of its corner.
    window : half the width of a window over the local square.
    warm : an earlier fit of the same corners, whose other parameters are taken for a start.
    """
    extent = (2.0 * window) ** 2 * np.abs(
        frames.along[:, 0] * frames.across[:, 1] - frames.along[:, 1] * frames.across[:, 0]
    )
    count = max(_LEAST_PART, int(_PART_PIXELS / min(extent.max(initial=1.0), (2 * reach_px + 1) ** 2)))
    fits = []
    for first in range(0, max(len(points), 1), count):
        some = np.arange(first, min(first + count, len(points)))
        before = None if warm is None else warm.take(some)
        win = _windows(part.image, points[some], frames.take(some), window, reach_px)
        fits.append(_fit_part(win, points[some], frames.take(some), iterations, window, before, part))
    if len(fits) == 1:
        return fits[0]
    return LocalFit(
        *(np.concatenate(rows) for rows in zip(*(vars(fit).values() for fit in fits), strict=True))
    )


def _fit_part(
    win: _Windows,
    points: FloatArray,
    frames: Frames,
    iterations: int,
    window: float,
    warm: LocalFit | None,
    part: Part,
) -> LocalFit:
    N, P = len(points), _PARAMETERS + (part.halo_px > 0.0 or part.moved)
    room = np.empty((N, P, win.x.shape[1]), dtype=np.float32)
    q = _start(points, frames, win, P)
    # Weight of the further observations, for residuals of the size that the fit will leave.
    noise = np.maximum(_NOISE * np.abs(q[:, 6, None]), _LEAST_NOISE)
    sigmas = np.column_stack([np.full((N, 2), _TONE_SIGMA), frames.bend_sigmas, frames.light_sigmas])
    prior = (noise / np.maximum(sigmas, _LEAST_BEND_SIGMA)) ** 2
    observed = np.column_stack([q[:, 5:7], frames.bends, frames.light])
    if warm is not None:
        kept = warm.residual < _WARM_RESIDUAL
        q[kept, 2:9] = warm.parameters[kept, 2:9]
        if P > _PARAMETERS and warm.parameters.shape[1] == P:
            q[kept, _PARAMETERS] = warm.parameters[kept, _PARAMETERS]
    freedom = np.maximum(win.weight.sum(axis=1).astype(np.float64) - P, 1.0)
    damping, converged = np.full(N, 1e-3), np.zeros(N, dtype=bool)
    r, J = _model(q.astype(np.float32), win, room, part)
    normal, gradient, cost = _equations(q, r, J, prior, observed)
    active = np.arange(N)
    diagonal = np.arange(P)
    for _ in range(iterations):
        N_a, g_a = normal[active], gradient[active]
        A = N_a.copy()
        A[:, diagonal, diagonal] *= 1.0 + damping[active, None]
        A[:, diagonal, diagonal] += 1e-6
        step = _bounded_step(A, g_a, q[active, _WIDTH])
        length = np.hypot(step[:, 0], step[:, 1])
        step /= np.maximum(1.0, np.maximum(length, 4.0 * np.abs(step[:, 2:4]).max(axis=1)))[:, None]
        foreseen = np.einsum("ni,ni->n", step, 2.0 * g_a - np.einsum("nij,nj->ni", N_a, step))
        trial = q[active] + step
        some = win.take(active) if len(active) < N else win
        r, J = _model(trial.astype(np.float32), some, room, part)
        equations = _equations(trial, r, J, prior[active], observed[active])
        gain = (cost[active] - equations[2]) / np.maximum(foreseen, 1e-9)
        better = equations[2] <= cost[active] * (1 + 1e-6)
        # A step is small when it is so in pixels, or against the fit's own uncertainty.
        settled = (length < _STEP_PX) | (foreseen * freedom[active] < _STEP_SIGMA**2 * cost[active])
        won = active[better]
        q[won] = trial[better]
        normal[won], gradient[won], cost[won] = (one[better] for one in equations)
        factor = np.where(gain > 0.75, 0.1, np.where(gain > 0.25, 1.0, 6.0))
        damping[active] = np.clip(damping[active] * factor, 1e-7, 1e8)
        converged[active] = better & settled & (damping[active] < 1e3)
        active = active[~converged[active]]
        if len(active) == 0:
            break
    return _result(q, win, window, normal, cost, freedom, converged)


def _bounded_step(A: FloatArray, g: FloatArray, width: FloatArray) -> FloatArray:
    """Solution (N, P) of A s = g; a width that would leave its bounds is held there and the rest solved."""
    step = np.asarray(np.linalg.solve(A, g[:, :, None])[:, :, 0])
    low, high = _WIDTH_PX
    out = (width + step[:, _WIDTH] < low) | (width + step[:, _WIDTH] > high)
    if np.any(out):
        held, right = A[out], g[out]
        held[:, _WIDTH] = np.arange(A.shape[1]) == _WIDTH
        right[:, _WIDTH] = np.clip(width + step[:, _WIDTH], low, high)[out] - width[out]
        step[out] = np.linalg.solve(held, right[:, :, None])[:, :, 0]
    return step


def _equations(
    q: FloatArray, r: _Float32, J: _Float32, prior: FloatArray, observed: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal matrix (N, P, P), right side (N, P) and cost (N,), with the observed parameters (N, 4)."""
    normal = (J @ J.transpose(0, 2, 1)).astype(np.float64)
    gradient = (J @ r[:, :, None])[:, :, 0].astype(np.float64)
    cost = np.einsum("nm,nm->n", r, r, dtype=np.float64)
    off = observed - q[:, _OBSERVED]
    normal[:, _OBSERVED, _OBSERVED] += prior
    gradient[:, _OBSERVED] += prior * off
    return normal, gradient, cost + np.sum(prior * off**2, axis=1)


def _result(
    q: FloatArray,
    win: _Windows,
    window: float,
    normal: FloatArray,
    cost: FloatArray,
    freedom: FloatArray,
    converged: BoolArray,
) -> LocalFit:
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-12))
    scaled = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-7 * np.eye(q.shape[1])
    inverse = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    variance = cost / freedom
    sigma2 = 0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]) * variance
    # Rounding can make it negative where the parameters cannot be told apart.
    sigma = np.sqrt(np.where(sigma2 >= 0.0, sigma2, np.inf) + _sampling_px2(q, win))
    amplitude = q[:, 6]
    residual = np.sqrt(variance) / np.maximum(np.abs(amplitude), 1e-9)
    finite = np.all(np.isfinite(q), axis=1) & np.isfinite(sigma)
    return LocalFit(
        points=q[:, :2] + win.centre,
        sigma_px=sigma,
        amplitude=amplitude,
        residual=residual,
        width_px=q[:, 4],
        window=np.full(len(q), window),
        parameters=q,
        converged=converged & finite & (freedom > _PARAMETERS),
    )


def _sampling_px2(q: FloatArray, win: _Windows) -> FloatArray:
    """Variance (N,) of a corner's place from the pixels' grid, which edges that are hardly blurred show.

    What blur of standard deviation s leaves at the grid's frequency is exp(-2 pi^2 s^2). Along an edge that
    crosses n rows or columns within the window it averages out as sin(pi n) / (pi n) does.
    """
    blur2 = np.maximum(0.5 * q[:, _WIDTH] ** 2 - _APERTURE_PX2, 0.0)
    side = np.sqrt(win.weight.sum(axis=1))[:, None]
    crossed = 0.5 * side * np.abs(np.sin(2.0 * q[:, 2:4]))
    averaged = np.mean(1.0 / (1.0 + (np.pi * crossed) ** 2), axis=1)
    return np.asarray((_SAMPLING_PX * np.exp(-2.0 * np.pi**2 * blur2)) ** 2 * averaged)


# ----------------------------------------------------------------------
# Where the other corners say that a corner is: a homography seen through a smooth lens.
#
# A pixel at the distance r from the picture's centre, in half diagonals, is moved to r / (1 + lambda r^2)
# (Fitzgibbon 2001), which straightens most of what a wide lens bends. There the corners are a homography
# of the board plus what a polynomial of low degree over the board says, fitted robustly (Geman and
# McClure's weights). Each corner is compared with what the fit without it would say: e_i / (1 - h_i),
# where h_i is the corner's leverage. lambda and the degree are those whose predictions are best.

_DEGREES = (1, 2, 3, 5)
_FREEDOM = 1.6
"""Corners for each coefficient that a degree must have."""
_ROUNDS = 4
_LAMBDAS = np.array([-0.9, -0.7, -0.5, -0.35, -0.22, -0.12, -0.05, 0.0, 0.05, 0.12])
_LIMIT = 6.0
_LEAST_SPREAD_PX = 0.02


@dataclass(frozen=True)
class Lens:
    """Centre (2,) and half diagonal of the picture, pixels."""

    centre: FloatArray
    radius_px: float

    def straightened(self, points: FloatArray, strength: FloatArray | float) -> FloatArray:
        """Points (..., 2) without the distortion of strength lambda."""
        d = (points - self.centre) / self.radius_px
        r2 = np.sum(d * d, axis=-1, keepdims=True)
        return np.asarray(d / np.maximum(1.0 + strength * r2, 0.05))

    def bent(self, straight: FloatArray, strength: float) -> FloatArray:
        """The inverse of `straightened`."""
        r2 = np.sum(straight * straight, axis=-1, keepdims=True)
        root = np.sqrt(np.maximum(1.0 - 4.0 * strength * r2, 0.0))
        return np.asarray(straight * (2.0 / (1.0 + root)) * self.radius_px + self.centre)


@dataclass(frozen=True)
class Prediction:
    """Corners as their neighbours place them.

    Attributes
    ----------
    points : (rows, columns, 2) pixels, each from all corners but itself.
    spread_px : typical distance of a corner from its prediction, robust.
    limit_px : (rows, columns) distance beyond which a corner disagrees with the others.
    """

    points: FloatArray
    spread_px: float
    limit_px: FloatArray


def _homographies(board: FloatArray, targets: FloatArray, weights: FloatArray) -> FloatArray:
    """Board (N, 2) mapped by the homographies to L targets (L, N, 2) with weights (N,)."""
    H = linear_homographies(board[None], targets, weights[None])
    mapped = np.column_stack([board, np.ones(len(board))]) @ H.transpose(0, 2, 1)
    depth = np.where(np.abs(mapped[..., 2:]) < 1e-9, 1e-9, mapped[..., 2:])
    return np.asarray(mapped[..., :2] / depth)


def _strength(board: FloatArray, pixels: FloatArray, used: BoolArray, lens: Lens) -> float:
    """The lambda under which the corners are nearest to a homography, robustly."""
    straight = lens.straightened(pixels[None], _LAMBDAS[:, None, None])
    mapped = _homographies(board, straight, used.astype(np.float64))
    # What a straightened distance is worth in pixels differs from lambda to lambda.
    back = np.stack([lens.bent(m, s) for m, s in zip(mapped, _LAMBDAS, strict=True)])
    error = np.mean(np.linalg.norm(back - pixels, axis=2)[:, used], axis=1)
    k = int(np.argmin(error))
    none = int(np.argmin(np.abs(_LAMBDAS)))
    if error[k] > 0.9 * error[none]:
        return 0.0
    if not 0 < k < len(_LAMBDAS) - 1:
        return float(_LAMBDAS[k])
    a, b, _ = np.polyfit(_LAMBDAS[k - 1 : k + 2], error[k - 1 : k + 2], 2)
    return float(np.clip(-b / (2.0 * a), _LAMBDAS[k - 1], _LAMBDAS[k + 1])) if a > 0 else float(_LAMBDAS[k])


@lru_cache(maxsize=16)
def _bases(columns: int, rows: int) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Corners (N, 2) of a board in [-1, 1], and the polynomials (N, P) over it of each degree."""
    j, i = np.mgrid[0:rows, 0:columns]
    x, y = (2.0 * i / max(columns - 1, 1) - 1.0).ravel(), (2.0 * j / max(rows - 1, 1) - 1.0).ravel()
    terms = [
        [
            x**p * y**q
            for p in range(degree + 1)
            for q in range(degree + 1 - p)
            if p < max(columns - 1, 2) and q < max(rows - 1, 2)
        ]
        for degree in _DEGREES
    ]
    return np.stack([x, y], axis=1), tuple(np.stack(some, axis=1) for some in terms)


def _median(values: FloatArray) -> float:
    """Median of (n,) values; NumPy's own takes five times as long for so few."""
    n = len(values)
    low, high = np.partition(values, ((n - 1) // 2, n // 2))[[(n - 1) // 2, n // 2]]
    return 0.5 * float(low + high)


def _weights(error: FloatArray, used: BoolArray, least: float) -> FloatArray:
    """Geman and McClure's weights with the median of the errors for a scale."""
    scale = max(3.0 * _median(error[used]), least)
    return used / (1.0 + (error / scale) ** 2) ** 2


def predict(points: FloatArray, known: BoolArray, lens: Lens | None = None) -> Prediction | None:
    """Predict every corner of a grid from the others.

    Parameters
    ----------
    points : (rows, columns, 2) pixels.
    known : (rows, columns) which points to go by; at least six, or None is returned.
    lens : where the picture's centre is; without it lambda is 0.
    """
    rows, columns = known.shape
    (board, bases), used = _bases(columns, rows), known.ravel()
    if int(used.sum()) < 6:
        return None
    pixels = np.where(used[:, None], points.reshape(-1, 2), 0.0)
    strength = 0.0
    if lens is None:
        lens = Lens(np.mean(pixels[used], axis=0), float(np.ptp(pixels[used])) + 1.0)
    else:
        strength = _strength(board, pixels, used, lens)
    fit = _Fit(board, pixels, used, lens, strength, (rows, columns))
    weights, plane = fit.homography()
    best: Prediction | None = None
    for basis in bases:
        if best is not None and used.sum() < _FREEDOM * basis.shape[1]:
            break
        candidate = fit.with_basis(basis, weights, plane)
        if best is None or candidate.spread_px < best.spread_px:
            best = candidate
    return best


@dataclass(frozen=True)
class _Fit:
    """Corners to fit: board (N, 2), pixels (N, 2), which are used (N,), and the lens of strength lambda."""

    board: FloatArray
    pixels: FloatArray
    used: BoolArray
    lens: Lens
    strength: float
    shape: tuple[int, int]

    def _apart(self, straight: FloatArray) -> FloatArray:
        u, v = (self.pixels - self.lens.bent(straight, self.strength)).T
        return np.asarray(np.hypot(u, v))

    def homography(self) -> tuple[FloatArray, FloatArray]:
        """Robust weights (N,) and mapped corners (N, 2), straightened."""
        target = self.lens.straightened(self.pixels, self.strength)[None]
        weights = self.used.astype(np.float64)
        plane = _homographies(self.board, target, weights)[0]
        for _ in range(_ROUNDS - 1):
            # Distortion that is left is no reason to distrust a corner; only large errors count here.
            weights = _weights(self._apart(plane), self.used, 1.0)
            plane = _homographies(self.board, target, weights)[0]
        return weights, plane

    def with_basis(self, basis: FloatArray, weights: FloatArray, plane: FloatArray) -> Prediction:
        """Fit the displacement from the homography by `basis` (N, P), robustly."""
        target = self.lens.straightened(self.pixels, self.strength)
        for _ in range(_ROUNDS):
            weighted = basis * weights[:, None]
            inverse = np.linalg.inv(weighted.T @ basis + 1e-9 * np.eye(basis.shape[1]))
            smooth = plane + basis @ (inverse @ (weighted.T @ (target - plane)))
            power = np.sum((basis @ inverse) * basis, axis=1)
            leverage = np.clip(weights * power, 0.0, 0.95)
            apart = self._apart(smooth)
            before, weights = weights, _weights(apart / np.sqrt(1.0 - leverage), self.used, 1e-3)
            if np.max(np.abs(weights - before)) < 0.05:
                break
        without = target - (target - smooth) / (1.0 - leverage)[:, None]
        points = self.lens.bent(np.where(self.used[:, None], without, smooth), self.strength)
        spread = _median((apart / (1.0 - leverage))[self.used])
        # A prediction is as uncertain as the corners, and as its leverage makes it.
        limit = _LIMIT * max(spread, _LEAST_SPREAD_PX) * np.sqrt(1.0 + np.minimum(power, 8.0))
        return Prediction(points.reshape(*self.shape, 2), spread, limit.reshape(self.shape))


# ----------------------------------------------------------------------
# Sub-pixel refinement of a grid of corners.
#
# Each corner is fitted on its own. Then the corners check each other (`predict`): one that
# did not converge, has the wrong colours or disagrees with the others is fitted again from where the
# others place it. A corner that still fails is not a measurement: it is reported at its predicted place,
# with a large sigma and `refined` false, and never at the place where the search began.
#
# Where squares are large the picture is averaged over blocks of k x k pixels first: the window then
# covers the same share of the square, and averaging loses nothing that the blur has not lost.

_SQUARE_PX = 40.0
"""Squares of twice this size and more are averaged down to it, where that leaves their edges blurred."""
_LEAST_WIDTH_PX = 0.9
"""Width of an edge below which its place depends on where it falls between the pixels."""
_FIRST_ITERATIONS = 4
_FIRST_REACH_PX = 6
_EVEN = 0.02
"""Third differences of a grid in squares, of which a smooth one has less."""
_HALOS_PX = (1.6, 0.8, 3.0)
_FEW_CORNERS = 16
"""Corners that tell a picture's halo, and the width of its edges."""
_HALO_SIGN = 0.95
"""Misshape with the first halo over that without from which on none of the others helps. It was below in all
39 pictures of five sets whose halo is taken, and above in 81 of 94 others."""
_HALO_MISSHAPE = 0.05
"""Typical misshape from which on halos are tried."""
_HALO_GAIN = 0.8
"""Misshape with a halo over that without, at most, for a halo to be believed."""
_WIDE = 0.1
"""Width of the edges, in squares, from which on the blur may be a motion's."""
_CORRELATED, _ALIKE = 0.5, 0.75
"""Least |rho| of a motion, and the share of corners that have to have it, all of one sign. In 24 photographs
that were blurred by 1.5 to 4 px the median of |rho| was .21 and less, and in 16 of them, of 316x208, moved
aslant by 9 to 14 px, .72 and more."""
_LARGEST_RESIDUAL = 0.8
"""RMS of a fit over the amplitude; clutter is above it."""
_LEAST_SHARE = 0.1
"""Least amplitude of a corner over the picture's median."""
_FAR = 0.2
"""Share of a square that no corner may be away from its prediction."""
_UNKNOWN_SIGMA = 0.25
"""Sigma of a corner that was not refined, in squares."""
_SIGMAS, _UNSURE = 6.0, 8.0
"""Distance from its prediction in standard deviations of a corner, these up to so many times the median."""
_PASSES = 3
_CLOSE_WINDOW = 0.28
_DISTURBED = 1.5
_STEADY_PX = 0.1
"""Corners that moved farther are fitted again, with the curvatures of where they are now, as those that did
not converge are."""
_LEAST_PICTURE_PX = 8
_NOISE_SAMPLE = 10_000
_STRIP_PIXELS = 65_536


@dataclass(frozen=True)
class Refined:
    """A refined grid; arrays are (rows, columns) and `points` has two pixel coordinates more.

    Attributes
    ----------
    points : pixels.
    sigma_px : standard deviation of one coordinate of a corner, from the residuals of its fit.
    amplitude : half the step from dark to bright that the picture shows, positive where the square between
        growing column and growing row is bright, grey levels.
    residual : RMS of the fit over the amplitude without clipping, and without the share of the noise.
    narrow : whether a corner had to be fitted with a smaller window than usual.
    refined : False where a corner could not be measured and its predicted place is given.
    misfit_px : typical distance of a corner from where the others place it.
    part : of the picture, in which the corners were fitted.
    """

    points: FloatArray
    sigma_px: FloatArray
    amplitude: FloatArray
    residual: FloatArray
    narrow: BoolArray
    refined: BoolArray
    misfit_px: float
    part: Part

    @property
    def sign(self) -> int:
        """+1 where the square between growing column and row of corner (0, 0) is bright, else -1."""
        return 1 if np.sum(np.sign(self.amplitude) * checkered(*self.amplitude.shape)) >= 0 else -1


def square_px(points: FloatArray) -> float:
    """Median length of the sides of the squares."""
    along = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    across = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return float(np.median(np.concatenate([along.ravel(), across.ravel()])))


def _unevenness(points: FloatArray) -> float:
    """Largest third difference of a grid (rows, columns, 2), in squares; infinite below 4 x 4."""
    if min(points.shape[:2]) < 4:
        return float("inf")
    third = [np.abs(np.diff(points, 3, axis=axis)).max() for axis in (0, 1)]
    return float(max(third)) / square_px(points)


def _sides_px(points: FloatArray) -> FloatArray:
    """The shorter side of the square at each corner of a grid (rows, columns, 2)."""
    steps = np.stack([np.gradient(points, axis=axis) for axis in (0, 1)])
    return np.asarray(np.linalg.norm(steps, axis=-1).min(axis=0))


@dataclass(frozen=True)
class Part:
    """The part of a picture around a grid, averaged over k x k pixels.

    Attributes
    ----------
    image : grey levels; of k = 1 the picture's own, not copied.
    points : the grid in it, (rows, columns, 2) of its pixels.
    k, origin : a pixel (x, y) of the part is at k (x, y) + (k - 1) / 2 + origin in the picture.
    lens : the centre and half diagonal of the picture, in pixels of the part.
    noise : standard deviation of the noise, grey levels.
    halo_px : r of a picture that was sharpened, 0 of others.
    moved : whether the board moved across the pixels while the picture was taken.
    """

    image: _Float32 | GrayImage
    points: FloatArray
    k: int
    origin: FloatArray
    lens: Lens
    noise: float
    halo_px: float = 0.0
    moved: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.points.shape[0], self.points.shape[1]

    def to_picture(self, points: FloatArray) -> FloatArray:
        """Pixels of the picture from pixels of the part."""
        return np.asarray(points * self.k + 0.5 * (self.k - 1) + self.origin)

    def from_picture(self, points: FloatArray) -> FloatArray:
        """The inverse of `to_picture`."""
        return np.asarray((points - 0.5 * (self.k - 1) - self.origin) / self.k)


def _noise(image: _Float32 | GrayImage) -> float:
    """Standard deviation of the noise, from the median of a mask that is blind to edges (Immerkaer 1996).

    A sample of the pixels is enough for the median.
    """
    step = max(1, int(np.sqrt(image.size / _NOISE_SAMPLE)))
    height, width = image.shape
    # [1 -2 1] down of [1 -2 1] across.
    at = [
        [image[j : height - 2 + j : step, i : width - 2 + i : step].astype(np.float32) for i in range(3)]
        for j in range(3)
    ]
    across = [left - 2.0 * middle + right for left, middle, right in at]
    return float(np.median(np.abs(across[0] - 2.0 * across[1] + across[2]))) / (6.0 * 0.6745)


def part_around(gray: GrayImage, points: FloatArray, k: int | None = None) -> Part | None:
    """The part of a picture that holds a grid (rows, columns, 2) and two squares around it.

    It is averaged over blocks of k pixels, by default such that squares keep about 40 px. None when that is
    next to nothing.
    """
    k = max(1, int(square_px(points) // _SQUARE_PX)) if k is None else k
    height, width = gray.shape
    square = float(np.max(np.abs(np.gradient(points, axis=0)) + np.abs(np.gradient(points, axis=1))))
    low = np.floor((points.reshape(-1, 2).min(axis=0) - 2 * square) / k).astype(int) * k
    high = np.ceil(points.reshape(-1, 2).max(axis=0) + 2 * square).astype(int)
    u0, v0 = max(int(low[0]), 0), max(int(low[1]), 0)
    columns, rows = (min(int(high[0]), width) - u0) // k, (min(int(high[1]), height) - v0) // k
    if min(columns, rows) < _LEAST_PICTURE_PX:
        return None
    cut = gray[v0 : v0 + rows * k, u0 : u0 + columns * k]
    image = _averaged(cut, k) if k > 1 else cut
    origin = np.array([u0, v0], dtype=np.float64)
    shift = origin + 0.5 * (k - 1)
    lens = Lens(
        (0.5 * np.array([width - 1, height - 1]) - shift) / k, 0.5 * float(np.hypot(width, height)) / k
    )
    return Part(image, (points - shift) / k, k, origin, lens, _noise(image))


def _averaged(gray: GrayImage, k: int) -> _Float32:
    """Means of blocks of k x k pixels, a few rows at a time, so that no large copy is made."""
    rows, columns = gray.shape[0] // k, gray.shape[1] // k
    out = np.empty((rows, columns), dtype=np.float32)
    some = max(1, _STRIP_PIXELS // gray[:k].size)
    for first in range(0, rows, some):
        strip = gray[first * k : (first + some) * k].astype(np.float32)
        size = (columns, len(strip) // k)
        out[first : first + some] = cv2.resize(strip, size, interpolation=cv2.INTER_AREA)
    return out


def _colours(fit: LocalFit, shape: tuple[int, int]) -> FloatArray:
    """Amplitude (N,), positive where a corner has the colours that most corners give it."""
    signed = fit.amplitude * checkered(*shape).ravel()
    return signed * (1.0 if np.sum(np.sign(signed)) >= 0 else -1.0)


def _shown(fit: LocalFit) -> FloatArray:
    """Amplitudes (N,) of fits as a sensor shows them that is full at white: the fit's own go on beyond."""
    b, a = fit.parameters[:, 5], fit.parameters[:, 6]
    clipped = 0.5 * (np.clip(b + a, 0.0, _WHITE) - np.clip(b - a, 0.0, _WHITE))
    return np.where((b + np.abs(a) > _WHITE) | (b < np.abs(a)), clipped, a)


def misshape(fit: LocalFit, noise: float) -> FloatArray:
    """What of the residuals (N,) of fits noise does not explain, over the amplitude."""
    share = noise / np.maximum(np.abs(fit.amplitude), 1e-9)
    return np.sqrt(np.maximum(fit.residual**2 - share**2, 0.0))


def _sound(part: Part, fit: LocalFit) -> BoolArray:
    """Which fits (N,) are of a corner with the right colours, converged or not yet."""
    amplitude = _colours(fit, part.shape)
    enough = amplitude > np.maximum(_LEAST_SHARE * np.median(np.abs(amplitude)), part.noise)
    shaped = misshape(fit, part.noise) < _LARGEST_RESIDUAL
    return np.asarray(enough & shaped & np.isfinite(fit.points[:, 0]))


def _trusted(part: Part, fit: LocalFit) -> BoolArray:
    """Which fits (N,) are measurements."""
    return np.asarray(fit.converged & _sound(part, fit))


def _merged(fit: LocalFit, again: LocalFit, where: IntArray, use: BoolArray | None = None) -> LocalFit:
    """`fit` with the corners `where` (indices) replaced by those of `again` that are to be used."""
    use = np.ones(len(where), dtype=np.bool_) if use is None else use
    merged = {name: value.copy() for name, value in vars(fit).items()}
    for name, value in vars(again).items():
        merged[name][where[use]] = value[use]
    return LocalFit(**merged)


def _closer_looked(part: Part, fit: LocalFit, grid: FloatArray) -> LocalFit:
    """Fit with a smaller window the corners that something near them disturbs: a margin, a shadow, a hand."""
    typical = float(np.median(fit.residual))
    doubtful = np.flatnonzero((fit.residual > _DISTURBED * typical + 0.02) | ~fit.converged)
    if len(doubtful) == 0:
        return fit
    frames = frames_of(grid, fit.tones(part.shape)).take(doubtful)
    again = fit_corners(part, fit.points[doubtful], frames, window=_CLOSE_WINDOW)
    use = again.converged & (again.residual < np.where(fit.converged, 0.7 * fit.residual, np.inf)[doubtful])
    return _merged(fit, again, doubtful, use)


@dataclass(frozen=True)
class _Check:
    """What the other corners say of each of N fits: a prediction, and what follows from it.

    Its place, the distance to it, the distance that is doubtful and the distance that is out of the
    question; `grid` (rows, columns, 2) holds the good fits and the places of the others.
    """

    prediction: Prediction
    placed: FloatArray
    away: FloatArray
    bound: FloatArray
    far: FloatArray
    grid: FloatArray


def _checked(part: Part, fit: LocalFit, good: BoolArray) -> _Check | None:
    prediction = predict(fit.points.reshape(*part.shape, 2), good.reshape(part.shape), part.lens)
    if prediction is None:
        return None
    placed = prediction.points.reshape(-1, 2)
    grid = np.where(good[:, None], fit.points, placed).reshape(*part.shape, 2)
    square = _sides_px(grid).ravel()
    away = np.linalg.norm(fit.points - placed, axis=1)
    far = _FAR * square
    # What lies over a corner makes it unsure, and is not to excuse how far off it is.
    sigma_px = np.minimum(fit.sigma_px, _UNSURE * np.median(fit.sigma_px[good]))
    bound = np.minimum(np.maximum(prediction.limit_px.ravel(), _SIGMAS * sigma_px), far)
    return _Check(prediction, placed, away, bound, far, grid)


def _rescued(part: Part, fit: LocalFit) -> tuple[LocalFit, BoolArray, Prediction] | None:
    """Fit again, from where the others place them, the corners that failed or disagree with the others."""
    good = _trusted(part, fit)
    check = _checked(part, fit, good)
    if check is None:
        return None
    doubtful = np.flatnonzero(~good | ~(check.away < check.bound))
    if len(doubtful) == 0:
        return fit, good, check.prediction
    frames = frames_of(check.grid, fit.tones(part.shape)).take(doubtful)
    again = fit_corners(part, check.placed[doubtful], frames, window=_CLOSE_WINDOW)
    trial = _merged(fit, again, doubtful)
    near = np.linalg.norm(again.points - check.placed[doubtful], axis=1)
    use = _trusted(part, trial)[doubtful] & (~good[doubtful] | (near < 0.7 * check.away[doubtful]))
    fit = _merged(fit, again, doubtful, use)
    good[doubtful[use]] = True
    check = _checked(part, fit, good)
    if check is None:
        return None
    # A clean fit may contradict the others: neither board nor lens need be smooth. A disturbed one may not.
    clean = fit.residual < _DISTURBED * np.median(fit.residual) + 0.02
    beside = extrapolated(fit.points.reshape(*part.shape, 2))[1:-1, 1:-1].reshape(-1, 2)
    nearest = np.fmin(check.away, np.linalg.norm(fit.points - beside, axis=1))
    good &= np.where(clean, nearest < check.far, check.away < check.bound)
    last = predict(fit.points.reshape(*part.shape, 2), good.reshape(part.shape), part.lens)
    return None if last is None else (fit, good, last)


def _begun(gray: GrayImage, points: FloatArray) -> tuple[Part, LocalFit] | None:
    """The part of the picture around a grid and a first fit of its corners.

    Blocks are as large as the edges' blur allows, and no larger than a window needs to hold its share of a
    square.
    """
    part = part_around(gray, points)
    largest = max(1, int(np.ceil(WINDOW * square_px(points) / REACH_PX)))
    while part is not None:
        every = np.arange(points[..., 0].size)
        # Of blocks that may be too large a few corners tell.
        some = every if part.k == 1 else evenly(len(every), _FEW_CORNERS)
        first = _first_fit(part, some)
        k = min(largest, max(1, int(part.k * _blocks(float(np.median(first.width_px))))))
        if k == part.k:
            first = first if len(some) == len(every) else _first_fit(part, every)
            wide = float(np.median(first.width_px)) > _WIDE * square_px(part.points)
            return (_moved(part) if wide else None) or _sharpened(part, first)
        # The next time blocks can only become smaller.
        largest, part = k, part_around(gray, points, k)
    return None


def _first_fit(part: Part, some: IntArray, warm: LocalFit | None = None) -> LocalFit:
    points, frames = part.points.reshape(-1, 2)[some], frames_of(part.points).take(some)
    return fit_corners(part, points, frames, _FIRST_ITERATIONS, _FIRST_REACH_PX, warm=warm)


def _blocks(width_px: float) -> float:
    """How many times as large blocks may be for edges of this width to have `_LEAST_WIDTH_PX`.

    Of a sharp edge most of the width is the pixel's aperture, which smaller blocks have as well.
    """
    least, sharp = _LEAST_WIDTH_PX**2, 2.0 * _APERTURE_PX2
    return min(width_px / _LEAST_WIDTH_PX, float(np.sqrt(max(width_px**2 - sharp, 0.0) / (least - sharp))))


def _moved(part: Part) -> tuple[Part, LocalFit] | None:
    """The same with the correlation of the edges' blur, where the corners agree on one."""
    other = replace(part, moved=True)

    def correlated(some: IntArray) -> LocalFit:
        return fit_corners(other, part.points.reshape(-1, 2)[some], frames_of(part.points).take(some))

    every = np.arange(part.points[..., 0].size)
    rho = correlated(evenly(len(every), _FEW_CORNERS)).parameters[:, _PARAMETERS]
    alike = max(np.mean(rho > _CORRELATED), np.mean(rho < -_CORRELATED))
    return (other, correlated(every)) if alike > _ALIKE else None


def _sharpened(part: Part, first: LocalFit) -> tuple[Part, LocalFit]:
    """The same with the halo that fits best, where the corners are not those of a picture as taken."""
    if float(np.median(misshape(first, part.noise))) < _HALO_MISSHAPE:
        return part, first
    some, every = evenly(len(first.points), _FEW_CORNERS), np.arange(len(first.points))

    def with_halo(halo_px: float, chosen: IntArray) -> tuple[Part, LocalFit]:
        other = replace(part, halo_px=halo_px)
        return other, _first_fit(other, chosen, first.take(chosen))

    plain = float(np.median(misshape(first.take(some), part.noise)))
    left: dict[float, float] = {}
    for halo_px in _HALOS_PX:
        left[halo_px] = float(np.median(misshape(with_halo(halo_px, some)[1], part.noise)))
        if min(left.values()) > _HALO_SIGN * plain:
            return part, first
    best = min(sorted(left), key=lambda halo_px: left[halo_px])
    return with_halo(best, every) if left[best] < _HALO_GAIN * plain else (part, first)


def refine(gray: GrayImage, points: FloatArray) -> Refined | None:
    """Refine a grid of corners to a small fraction of a pixel.

    Parameters
    ----------
    gray : (H, W) grey levels.
    points : (rows, columns, 2) pixels, off by less than a third of a square, at least 3 x 3.

    Returns
    -------
    None where fewer than six corners could be fitted.
    """
    begun = _begun(gray, points)
    if begun is None:
        return None
    part, first = begun
    shape, start = part.shape, part.points
    sound, moved = _sound(part, first), first.points.reshape(start.shape)
    if not sound.all() or _unevenness(moved) > _EVEN:
        # A misplaced corner would spoil the curvatures of its row and column.
        rough = predict(moved, sound.reshape(shape), part.lens)
        if rough is None:
            return None
        away = np.linalg.norm(moved - rough.points, axis=2)
        stays = sound.reshape(shape) & (away < rough.limit_px)
        moved = np.where(stays[..., None], moved, rough.points)
    fit, unsteady = first, np.arange(len(first.points))
    for _ in range(_PASSES):
        frames = frames_of(moved, fit.tones(shape)).take(unsteady)
        again = fit_corners(part, moved.reshape(-1, 2)[unsteady], frames, warm=fit.take(unsteady))
        fit = again if len(unsteady) == len(fit.points) else _merged(fit, again, unsteady)
        before = moved
        moved = np.where(_sound(part, fit)[:, None], fit.points, before.reshape(-1, 2)).reshape(start.shape)
        steady = np.max(np.abs(moved - before), axis=2).ravel() < _STEADY_PX
        unsteady = np.flatnonzero(~(steady & fit.converged))
        if len(unsteady) == 0:
            break
    fit = _closer_looked(part, fit, moved)
    rescued = _rescued(part, fit)
    if rescued is None:
        return None
    fit, good, prediction = rescued
    placed = prediction.points.reshape(-1, 2)
    unknown = _UNKNOWN_SIGMA * square_px(prediction.points)
    found = np.where(good[:, None], fit.points, placed).reshape(*shape, 2)
    return Refined(
        points=part.to_picture(found),
        sigma_px=part.k * np.where(good, fit.sigma_px, unknown).reshape(shape),
        amplitude=_shown(fit).reshape(shape),
        residual=misshape(fit, part.noise).reshape(shape),
        narrow=(fit.window < WINDOW).reshape(shape),
        refined=good.reshape(shape),
        misfit_px=part.k * prediction.spread_px,
        part=part,
    )

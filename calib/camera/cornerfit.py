"""The blurred corner itself, fitted to the grey levels around it, many corners at once.

Around a corner at (u0, v0) the edges along the rows and along the columns of the board have the
directions alpha and beta and the curvatures kappa and lambda, which distortion gives them. With
(x, y) the offset from the corner, c = cos, s = sin,

    t1 =  c(alpha) x + s(alpha) y      d1 = -s(alpha) x + c(alpha) y - kappa t1^2 / 2
    t2 =  c(beta)  x + s(beta)  y      d2 =  s(beta)  x - c(beta)  y + lambda t2^2 / 2

d1 and d2 are the distances from the two edges, growing with row and column, t1 and t2 the way along
them. Blur and the pixel's aperture make an error function of each step:

    I = (1 + g_x x + g_y y) (b + a erf(d1 / w) erf(d2 / w))

Light that is not even scales dark and bright alike, hence one gradient g. The eleven parameters u0, v0,
alpha, beta, w, b, a, g_x, g_y, kappa, lambda of each corner are found by Levenberg-Marquardt. The
curvatures are measured much better by the row and column of corners than by a single window: that
value and its standard deviation enter as one more observation. The window is a parallelogram along
the board, so that the model holds in all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import BoolArray, FloatArray, IntArray

__all__ = ["WINDOW", "Frames", "LocalFit", "fit_corners", "frames_of"]

WINDOW = 0.45
"""Half the window's width over the local square: the next corner must not come in."""
REACH_PX = 12
_LEAST_REACH_PX = 2.5
_ITERATIONS = 16
_STEP_PX = 1e-3
_STEP_SIGMA = 0.05
_WHITE = np.float32(255.0)
_NOISE, _LEAST_NOISE = 0.04, 1.0
_LEAST_BEND_SIGMA = 1e-6
_WARM_RESIDUAL = 0.3
_START_WIDTH_PX = 1.2
_WIDTH_PX = (0.3, 12.0)
_PARAMETERS = 11
_BENDS = slice(9, 11)
_UNKNOWN_BEND = 3e-3
_PART_PIXELS, _LEAST_PART = 24_000, 8
"""Corners are fitted in parts of about so many pixels, whose arrays stay in the processor's cache."""
_EDGE_SLOPE = 2.0 / np.sqrt(np.pi)

_Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Frames:
    """What the grid says of the surroundings of each of N corners.

    Attributes
    ----------
    along, across : (N, 2) steps to the next column and row, pixels.
    bends : (N, 2) curvatures of the edges along the row and along the column, 1 / px.
    bend_sigmas : (N, 2) standard deviations of `bends`.
    """

    along: FloatArray
    across: FloatArray
    bends: FloatArray
    bend_sigmas: FloatArray

    def take(self, chosen: IntArray) -> Frames:
        """The frames of some corners."""
        return Frames(self.along[chosen], self.across[chosen], self.bends[chosen], self.bend_sigmas[chosen])


@dataclass(frozen=True)
class LocalFit:
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
    parameters : (N, 11) as the fit holds them, to start another one.
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

    def take(self, chosen: IntArray) -> LocalFit:
        """The fits of some corners."""
        return LocalFit(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def _joined(fits: Sequence[LocalFit]) -> LocalFit:
    return LocalFit(
        *(np.concatenate([getattr(fit, name) for fit in fits]) for name in LocalFit.__dataclass_fields__)
    )


@dataclass(frozen=True)
class _Windows:
    """Pixels around N corners, (N, M) each, with weights 0 or 1; x and y from `centre` (N, 2)."""

    centre: FloatArray
    x: _Float32
    y: _Float32
    grey: _Float32
    weight: _Float32

    def take(self, chosen: IntArray) -> _Windows:
        return _Windows(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


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


def frames_of(points: FloatArray) -> Frames:
    """Steps and curvatures of a grid of corners, (rows, columns, 2) pixels, at least 2 x 2."""
    along, across = np.gradient(points, axis=1), np.gradient(points, axis=0)
    by_row, by_column = _bends(points), _bends(points.transpose(1, 0, 2))
    bends, sigmas = (
        np.stack([row.ravel(), column.T.ravel()], axis=1)
        for row, column in zip(by_row, by_column, strict=True)
    )
    return Frames(along.reshape(-1, 2), across.reshape(-1, 2), bends, sigmas)


def _windows(image: _Float32, points: FloatArray, frames: Frames, window: float, most_px: int) -> _Windows:
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
        image[v, u],
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


def _model(q: _Float32, win: _Windows, room: _Float32) -> tuple[_Float32, _Float32]:
    """Residuals (N, M) and the Jacobian of the model (N, 11, M), in `room`, both zero outside the window."""
    u0, v0, alpha, beta, w, b, a, gx, gy, kappa, lam = (q[:, k, None] for k in range(_PARAMETERS))
    x, y = win.x - u0, win.y - v0
    c1, s1, c2, s2 = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    t1, t2 = c1 * x + s1 * y, c2 * x + s2 * y
    n1, n2 = c1 * y - s1 * x, s2 * x - c2 * y
    k1t, k2t = kappa * t1, lam * t2
    E1, G1, W1 = _edge(n1 - 0.5 * k1t * t1, w)
    E2, G2, W2 = _edge(n2 + 0.5 * k2t * t2, w)
    light = (1.0 + gx * x + gy * y) * win.weight
    P = E1 * E2
    tone = b + a * P
    J = room[: len(q)]
    by_d1, by_d2 = a * light * G1 * E2, a * light * E1 * G2
    toned = win.weight * tone
    J[:, 0] = by_d1 * (s1 + k1t * c1) - by_d2 * (s2 + k2t * c2) - gx * toned
    J[:, 1] = by_d1 * (k1t * s1 - c1) + by_d2 * (c2 - k2t * s2) - gy * toned
    J[:, 2] = by_d1 * (-t1 - k1t * n1)
    J[:, 3] = by_d2 * (t2 - k2t * n2)
    J[:, 4] = a * light * (W1 * E2 + E1 * W2)
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


def _start(points: FloatArray, frames: Frames, win: _Windows, room: _Float32) -> FloatArray:
    """Parameters (N, 11) with position and directions of the grid, and the grey levels that fit them."""
    q = np.zeros((len(points), _PARAMETERS))
    q[:, :2] = points - win.centre
    q[:, 2] = np.arctan2(frames.along[:, 1], frames.along[:, 0])
    q[:, 3] = np.arctan2(frames.across[:, 1], frames.across[:, 0])
    q[:, 4] = _START_WIDTH_PX
    q[:, _BENDS] = frames.bends
    _, J = _model(q.astype(np.float32), win, room)
    ones, P = J[:, 5].astype(np.float64), J[:, 6].astype(np.float64)
    grey = win.grey * win.weight
    n, sum_p, sum_pp = ones.sum(axis=1), P.sum(axis=1), (P * P).sum(axis=1)
    sum_g, sum_gp = grey.sum(axis=1), (grey * P).sum(axis=1)
    det = np.maximum(n * sum_pp - sum_p**2, 1e-9)
    q[:, 6] = (n * sum_gp - sum_p * sum_g) / det
    q[:, 5] = (sum_pp * sum_g - sum_p * sum_gp) / det
    return q


def fit_corners(
    image: _Float32,
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
    image : (H, W) grey levels.
    points : (N, 2) where to start, pixels.
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
        part = np.arange(first, min(first + count, len(points)))
        before = None if warm is None else warm.take(part)
        fits.append(_fit_part(image, points[part], frames.take(part), iterations, reach_px, window, before))
    return fits[0] if len(fits) == 1 else _joined(fits)


def _fit_part(
    image: _Float32,
    points: FloatArray,
    frames: Frames,
    iterations: int,
    reach_px: int,
    window: float,
    warm: LocalFit | None,
) -> LocalFit:
    N = len(points)
    win = _windows(image, points, frames, window, reach_px)
    room = np.empty((N, _PARAMETERS, win.x.shape[1]), dtype=np.float32)
    q = _start(points, frames, win, room)
    if warm is not None:
        kept = warm.residual < _WARM_RESIDUAL
        q[kept, 2:9] = warm.parameters[kept, 2:9]
    freedom = np.maximum(win.weight.sum(axis=1).astype(np.float64) - _PARAMETERS, 1.0)
    damping, converged = np.full(N, 1e-3), np.zeros(N, dtype=bool)
    # Weight of the curvatures' own observation, for residuals of the size that the fit will leave.
    noise = np.maximum(_NOISE * np.abs(q[:, 6]), _LEAST_NOISE)
    prior = (noise[:, None] / np.maximum(frames.bend_sigmas, _LEAST_BEND_SIGMA)) ** 2
    r, J = _model(q.astype(np.float32), win, room)
    normal, gradient, cost = _equations(q, r, J, prior, frames.bends)
    active = np.arange(N)
    diagonal = np.arange(_PARAMETERS)
    for _ in range(iterations):
        N_a, g_a = normal[active], gradient[active]
        A = N_a.copy()
        A[:, diagonal, diagonal] *= 1.0 + damping[active, None]
        A[:, diagonal, diagonal] += 1e-6
        step = np.linalg.solve(A, g_a[:, :, None])[:, :, 0]
        length = np.hypot(step[:, 0], step[:, 1])
        step /= np.maximum(1.0, np.maximum(length, 4.0 * np.abs(step[:, 2:4]).max(axis=1)))[:, None]
        foreseen = np.einsum("ni,ni->n", step, 2.0 * g_a - np.einsum("nij,nj->ni", N_a, step))
        trial = q[active] + step
        trial[:, 4] = np.clip(trial[:, 4], *_WIDTH_PX)
        r, J = _model(trial.astype(np.float32), win.take(active) if len(active) < N else win, room)
        equations = _equations(trial, r, J, prior[active], frames.bends[active])
        gain = (cost[active] - equations[2]) / np.maximum(foreseen, 1e-9)
        better = equations[2] <= cost[active] * (1 + 1e-6)
        # A step is small when it is so in pixels, or against the fit's own uncertainty.
        settled = (length < _STEP_PX) | (foreseen * freedom[active] < _STEP_SIGMA**2 * cost[active])
        won = active[better]
        q[won] = trial[better]
        normal[won], gradient[won], cost[won] = (part[better] for part in equations)
        factor = np.where(gain > 0.75, 0.1, np.where(gain > 0.25, 1.0, 6.0))
        damping[active] = np.clip(damping[active] * factor, 1e-7, 1e8)
        converged[active] = better & settled & (damping[active] < 1e3)
        active = active[~converged[active]]
        if len(active) == 0:
            break
    return _result(q, win, window, normal, cost, freedom, converged)


def _equations(
    q: FloatArray, r: _Float32, J: _Float32, prior: FloatArray, bends: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal matrix (N, 11, 11), right side (N, 11) and cost (N,), with the observed curvatures."""
    normal = (J @ J.transpose(0, 2, 1)).astype(np.float64)
    gradient = (J @ r[:, :, None])[:, :, 0].astype(np.float64)
    cost = np.einsum("nm,nm->n", r, r, dtype=np.float64)
    off = bends - q[:, _BENDS]
    both = np.arange(_PARAMETERS)[_BENDS]
    normal[:, both, both] += prior
    gradient[:, _BENDS] += prior * off
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
    scaled = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-7 * np.eye(_PARAMETERS)
    inverse = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    variance = cost / freedom
    sigma = np.sqrt(np.maximum(0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]) * variance, 0.0))
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

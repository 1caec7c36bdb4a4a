"""Time offset, mount angle, scales and biases of camera and IMU, by least squares over a spline of motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.ndimage import maximum_filter1d

from calib.core.arrays import BoolArray, FloatArray, integral, rms, robust_sigma
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.core.result import finite_or_none
from calib.core.rig import Geometry
from calib.core.units import unit_of
from calib.core.verdict import Finding, Verdict
from calib.core.words import all_of
from calib.solve.clock import COARSE, TimeAxis, clock_step_s, time_axis
from calib.solve.delay import moments, shares, vertex
from calib.solve.information import tied_groups
from calib.stages.align.section import LogCheck
from calib.stages.align.spline import (
    BAND,
    Knots,
    Rows,
    basis_rows,
    camera_rows,
    chunks,
    gathered,
    imu_rows,
    normal_sums,
)
from calib.stages.estimator.sensors import (
    GRAVITY_MPS2,
    HEAD,
    QUANTITIES,
    SENSOR,
    SIZE,
    heads_seen,
    rest_reading,
    truncated,
)

# ----------------------------------------------------------------------
# How well readings fit: whole pixels with outliers, and readings of the IMU.
#
# A rounded pixel r says that the tracker's place z ~ N(m, jitter^2) lay in [r - g / 2, r + g / 2] (see
# `calib.stages.estimator.sensors`). With Z_u, Z_v the probabilities of both intervals a picture has the
# likelihood
#
#     p = (1 - e) Z_u Z_v + e / a
#
# where e is the share of pictures that show something else and a the area over which that lies. By
# its score and Fisher's information a pixel pulls the fit with w E / jitter and weighs w (1 - V) /
# jitter^2,
# E and V mean and variance of the truncated normal distribution in units of the jitter, and
# w = (1 - e) Z_u Z_v / p.
#
# Readings of the IMU have Huber's loss with a far knee.

HUBER = 4.0
"""Knee of the loss of an IMU's reading, in deviations."""

_OUTLIER_AREA_PX2 = 1256.0
"""The area a over which pictures of something else lie: a circle of 20 px."""
_JITTERS_PX = np.exp(np.linspace(math.log(0.03), math.log(3.0), 47))
_COARSE = 4
"""Of the jitters every fourth is tried first, then those beside the best."""


@kernel()
def pixel_terms(
    off: FloatArray, jitter: float, grid: float, share: float, pull: FloatArray, weight: FloatArray,
    good: FloatArray,
) -> float:  # fmt: skip
    """Loss of pictures off by (n, 2) [px]; pull (n, 2), weight (n, 2) and w (n,) are written to.

    A picture that is not finite has no pull and no weight. Without a grid the density at the reading stands
    for Z over one pixel.
    """
    loss = 0.0
    back = share / _OUTLIER_AREA_PX2
    for n in range(len(off)):
        log_z = 0.0
        known = True
        for k in range(2):
            d = off[n, k]
            pull[n, k], weight[n, k] = 0.0, 0.0
            if not abs(d) < 1e6:
                known = False
            elif grid > 0.0:
                z, mean, variance = truncated((d - 0.5 * grid) / jitter, (d + 0.5 * grid) / jitter)
                log_z += z
                pull[n, k] = mean / jitter
                weight[n, k] = max(1.0 - variance, 1e-3) / (jitter * jitter)
            else:
                log_z += -0.5 * (d / jitter) ** 2 - math.log(jitter * math.sqrt(2.0 * math.pi))
                pull[n, k] = d / (jitter * jitter)
                weight[n, k] = 1.0 / (jitter * jitter)
        if not known:
            good[n] = 0.0
            pull[n, 0], pull[n, 1], weight[n, 0], weight[n, 1] = 0.0, 0.0, 0.0, 0.0
            loss -= math.log(back)
            continue
        inside = (1.0 - share) * math.exp(log_z)
        good[n] = inside / (inside + back)
        loss -= math.log(inside + back)
        for k in range(2):
            pull[n, k] *= good[n]
            weight[n, k] *= good[n]
    return loss


def best_jitter_px(off: FloatArray, grid: float, share: float) -> float:
    """Jitter that makes pictures off by (n, 2) [px] most likely."""
    pull, weight, good = np.empty(off.shape), np.empty(off.shape), np.empty(len(off))

    def loss(k: int) -> float:
        return pixel_terms(off, float(_JITTERS_PX[k]), grid, share, pull, weight, good)

    last = len(_JITTERS_PX) - 1
    coarse = min(range(0, last + 1, _COARSE), key=loss)
    near = range(max(coarse - _COARSE, 0), min(coarse + _COARSE, last) + 1)
    losses = [loss(k) for k in near]
    at = int(np.argmin(losses))
    k = near[at]
    if not 0 < k < last:
        return float(_JITTERS_PX[k])
    step = math.log(_JITTERS_PX[1] / _JITTERS_PX[0])
    return float(_JITTERS_PX[k] * math.exp(step * vertex(*losses[at - 1 : at + 2])))


def imu_terms(off: FloatArray, noise: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Loss of readings off by (n, 3), with pull and weight (n, 3); zero where a reading is missing.

    Parameters
    ----------
    noise : (n, 3) standard deviations.
    """
    known = np.isfinite(off)
    z = np.where(known, off, 0.0) / noise
    size = np.abs(z)
    inside = size <= HUBER
    loss = float(np.sum(np.where(inside, 0.5 * z * z, HUBER * (size - 0.5 * HUBER))))
    w = np.where(known, np.where(inside, 1.0, HUBER / np.maximum(size, HUBER)), 0.0)
    return loss, w * z / noise, w / (noise * noise)


# ----------------------------------------------------------------------
# The normal equations of an alignment: readings, noise, losses, and an arrow of banded blocks.
#
# Unknown are the coefficients c of each stretch's spline and the 14 quantities s of `SENSOR`, which all
# stretches share. Gauss-Newton's normal equations are
#
#     [A_1           B_1] [dc_1]   [g_1]
#     [     ...         ] [    ] = [   ]
#     [B_1' ...   C     ] [ds  ]   [g_s]
#
# so that with X_i = A_i^-1 B_i, S = C - sum B_i' X_i it is S ds = g_s - sum X_i' g_i, and S^-1 is the
# covariance of s with the motion eliminated. Priors: s as given, and accelerations of the head at each knot
# span about zero with a deviation that leaves them free (`loose`), for times without readings.

_ANCHOR = np.array([3.0, 0.1])


@dataclass(frozen=True)
class Stretch:
    """Readings without a long gap, at even times.

    Attributes
    ----------
    log : number of the log that they are from.
    camera_s, pixels : (n,) stamps and (n, 2) pictures.
    imu_s, readings : (m,) times and (m, 3) a_x, a_y, g_z, NaN where one is missing.
    knots, start : of the spline, and its coefficients (count, 2) to begin with.
    loose : (spans, 2) deviation of the accelerations of phi and l.
    missed : (m, 3) by how much the spline misses readings where it cannot follow the motion, elsewhere 0.
    clock_s : deviation of the time offset in this stretch by the jitter of both sensors' stamps.
    """

    log: int
    camera_s: FloatArray
    pixels: FloatArray
    imu_s: FloatArray
    readings: FloatArray
    knots: Knots
    start: FloatArray
    loose: FloatArray
    missed: FloatArray
    clock_s: float = 0.0

    @cached_property
    def steep(self) -> FloatArray:
        """Change (m, 3) of the readings in a second, 0 where one is missing."""
        # Samples of a burst may bear one time: its slope is that of the bursts' means.
        t, of, count = np.unique(self.imu_s, return_inverse=True, return_counts=True)
        means = np.add.reduceat(self.readings, np.cumsum(count) - count) / count[:, None]
        return np.nan_to_num(np.abs(np.gradient(means, t, axis=0)))[of]


@dataclass(frozen=True)
class Noise:
    """Noise of the sensors.

    Attributes
    ----------
    jitter_px, share : of the tracker, and the share of outliers.
    imu : (3,) of a_x, a_y, g_z at rest.
    age_s : of the times of readings: a sensor renews what is read by a clock of its own.
    """

    jitter_px: float
    share: float
    imu: FloatArray
    age_s: float = 0.0

    def of(self, stretch: Stretch, part: slice) -> FloatArray:
        """Deviations (n, 3) of a part of a stretch's readings."""
        known = np.hypot(self.imu, self.age_s * stretch.steep[part])
        return np.asarray(np.hypot(known, stretch.missed[part]))


@dataclass(frozen=True)
class Problem:
    """Everything that goes into the fit.

    Attributes
    ----------
    view : (25,) of `sensors.view_coefficients`.
    grid_px : step of the pixels, 0 for none.
    mean, sigma : (14,) prior of `SENSOR`.
    """

    view: FloatArray
    grid_px: float
    stretches: tuple[Stretch, ...]
    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Arrow:
    """Normal equations [A B; B' C] of all coefficients and s: factors of each stretch's A, its B, and of S.

    S = C - B' A^-1 B. An hour at 100 Hz has 35 MB of A and 40 MB of B.
    """

    factors: list[FloatArray]
    B: list[FloatArray]
    S: tuple[FloatArray, bool]

    def own(self, i: int, right: FloatArray) -> FloatArray:
        """A^-1 times a right-hand side (2 count,) or (2 count, k) of stretch i."""
        return np.asarray(cho_solve_banded((self.factors[i], True), right, check_finite=False))

    def solve(self, to_c: list[FloatArray], to_s: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Steps of all coefficients and of s for a right-hand side."""
        steps, right = [self.own(i, g) for i, g in enumerate(to_c)], to_s.copy()
        for B, step in zip(self.B, steps, strict=True):
            right -= B.T @ step
        ds = np.asarray(cho_solve(self.S, right))
        for i, (B, step) in enumerate(zip(self.B, steps, strict=True)):
            step -= self.own(i, B @ ds)
        return steps, ds

    def size(self, ds: FloatArray) -> float:
        """The largest of a step (14,) in deviations."""
        return float(np.max(np.abs(ds) / np.sqrt(np.diag(cho_solve(self.S, np.eye(len(ds)))))))


def _pictures(
    problem: Problem, stretch: Stretch, c: FloatArray, sensor: FloatArray
) -> Iterator[tuple[FloatArray, Rows]]:
    """Pixels (k, 2) seen minus predicted with their rows, a chunk at a time."""
    for part in chunks(len(stretch.camera_s)):
        rows = camera_rows(problem.view, stretch.knots, c, sensor, stretch.camera_s[part])
        yield stretch.pixels[part] - rows.predicted, rows


def _readings(
    stretch: Stretch, c: FloatArray, sensor: FloatArray
) -> Iterator[tuple[FloatArray, Rows, slice]]:
    """Readings (k, 3) of the IMU minus predicted with their rows, and which they are, a chunk at a time."""
    for part in chunks(len(stretch.imu_s)):
        rows = imu_rows(stretch.knots, c, sensor, stretch.imu_s[part])
        yield stretch.readings[part] - rows.predicted, rows, part


def pictures_off(problem: Problem, stretch: Stretch, c: FloatArray, sensor: FloatArray) -> FloatArray:
    """Pixels (n, 2) seen minus predicted."""
    return np.concatenate([off for off, _ in _pictures(problem, stretch, c, sensor)])


def readings_off(stretch: Stretch, c: FloatArray, sensor: FloatArray) -> FloatArray:
    """Readings (m, 3) of the IMU minus predicted, NaN where one is missing."""
    return np.concatenate([off for off, _, _ in _readings(stretch, c, sensor)])


class Terms(NamedTuple):
    """What measurements of one kind add to the loss and to the normal equations, a chunk of them.

    Attributes
    ----------
    pull, weight : (k, channels). good : (k,) probability that a picture shows the marker; (0,) of no picture.
    """

    rows: Rows
    loss: float
    pull: FloatArray
    weight: FloatArray
    good: FloatArray = np.empty(0)


def _picture_terms(
    problem: Problem, noise: Noise, stretch: Stretch, c: FloatArray, s: FloatArray
) -> Iterator[Terms]:
    for off, rows in _pictures(problem, stretch, c, s):
        room = np.empty_like(off), np.empty_like(off), np.empty(len(off))
        loss = pixel_terms(off, noise.jitter_px, problem.grid_px, noise.share, *room)
        yield Terms(rows, loss, *room)


def _reading_terms(noise: Noise, stretch: Stretch, c: FloatArray, s: FloatArray) -> Iterator[Terms]:
    for off, rows, part in _readings(stretch, c, s):
        yield Terms(rows, *imu_terms(off, noise.of(stretch, part)))


def _prior_terms(stretch: Stretch, c: FloatArray) -> Iterator[Terms]:
    """Accelerations of phi and l in the middle of each span, of which zero is likely."""
    middles = stretch.knots.middles
    for part in chunks(len(middles)):
        span, basis = basis_rows(stretch.knots, middles[part])
        by, loose = np.zeros((len(span), 2, SIZE)), stretch.loose[part]
        by[:, 0, 4], by[:, 1, 5] = 1.0, 1.0
        bend = np.einsum("nj,nja->na", basis[:, 2], c[span[:, None] + np.arange(6)])
        z = bend / loose
        yield Terms(Rows(span, basis, bend, by), 0.5 * float((z * z).sum()), -z / loose, 1.0 / loose**2)


def _terms(problem: Problem, noise: Noise, stretch: Stretch, c: FloatArray, s: FloatArray) -> Iterator[Terms]:
    """All that the fit knows of a stretch, but for the anchor of its coefficients."""
    yield from _picture_terms(problem, noise, stretch, c, s)
    yield from _reading_terms(noise, stretch, c, s)
    yield from _prior_terms(stretch, c)


def _loss(problem: Problem, cs: list[FloatArray], s: FloatArray, noise: Noise) -> float:
    """Minus the logarithm of the posterior."""
    total = 0.5 * float((((s - problem.mean) / problem.sigma) ** 2).sum())
    for stretch, c in zip(problem.stretches, cs, strict=True):
        total += 0.5 * float((((c - stretch.start) / _ANCHOR) ** 2).sum())
        total += sum(one.loss for one in _terms(problem, noise, stretch, c, s))
    return total


def _normal(
    problem: Problem, cs: list[FloatArray], s: FloatArray, noise: Noise
) -> tuple[Arrow, list[FloatArray], FloatArray, list[FloatArray]]:
    """Factors, right-hand sides, and the probability of each picture to show the marker."""
    C, taken = np.diag(1.0 / problem.sigma**2), np.zeros((len(s), len(s)))
    to_s = (problem.mean - s) / problem.sigma**2
    factors: list[FloatArray] = []
    Bs: list[FloatArray] = []
    to_cs: list[FloatArray] = []
    goods: list[FloatArray] = []
    for stretch, c in zip(problem.stretches, cs, strict=True):
        A, B, to_c = np.zeros((c.size, BAND)).T, np.zeros((c.size, len(s))), np.zeros(c.size)
        good = []
        for rows, _, pull, weight, likely in _terms(problem, noise, stretch, c, s):
            normal_sums(rows.span, rows.basis, rows.by, weight, A, B, C)
            gathered(rows.span, rows.basis, rows.by, pull, to_c, to_s)
            good.append(likely)
        A[0] += np.tile(1.0 / _ANCHOR**2, len(c))
        to_c += ((stretch.start - c) / _ANCHOR**2).ravel()
        # A turns into its factor where it is, and A^-1 B is never there as a whole.
        factors.append(cholesky_banded(A, lower=True, overwrite_ab=True, check_finite=False))
        for k in range(len(s)):
            taken[:, k] += B.T @ cho_solve_banded((factors[-1], True), B[:, k], check_finite=False)
        Bs.append(B)
        to_cs.append(to_c)
        goods.append(np.concatenate(good))
    S = C - taken
    return Arrow(factors, Bs, cho_factor(0.5 * (S + S.T))), to_cs, to_s, goods


# ----------------------------------------------------------------------
# Where the alignment starts: stretches without gaps, the camera's own angle, and a first time offset.
#
# Two pixels give angle and length of a resting head (`invert_marker`), the gyroscope integrated gives the
# angle but for a line in time. For offsets on a grid the camera's angle is fitted by
#
#     phi_camera(t) = a theta(t - offset) + b + c t,   theta' = -g_z
#
# over all stretches with one a; the offset that leaves the least share of the squares is the first guess. The
# factor a tells a gyroscope in degrees per second (1 / 57) and one that turns the other way round (negative).

SPLIT_S, _SPLIT_STEPS = 0.3, 5.0
"""Gaps of the gyroscope at which a log is split, in seconds and in its usual steps. Over three of 0.4 s in a
swing of 5 s the angle was drawn straight, and the time offset came out at 0.27 s."""
SHORTEST_S = 1.0
"""Stretches that are too short to be used."""

OFFSETS_S = np.arange(-0.1, 0.8001, 0.0025)
"""Time offsets (k,) among which the first guess is."""
_LEAST_PICTURES = 20
_START_LEAST_SAMPLES = 40
_LENGTH_M = 0.07
"""Where the search for the length that pictures show begins."""
_PHI_SIGMA = 0.012
_WORTH = 60.0
_TIMES_IN_DEGREES = (0.5 / 57.3, 2.0 / 57.3)
_MOST_FACTOR, _MOST_LEFT = 6.0, 0.1
"""Of the camera's turn over the gyroscope's, and of the squares that this leaves: z is 80 degrees off."""
_MARGIN_S = 0.06
_MOST_SPAN_S = 0.021
"""Longest span of knots, however seldom the IMU is read: with 0.04 s the splines miss the accelerations of a
swing at 4 Hz by more than their noise, which scales and marker then take up."""
_LOCAL_S = 1.0
_MEANS = 5
_REST_FACTOR = 2.0
_MOST_NOISE = (0.01, 0.06)
_FREE = (10.0, 3.0)
_TIMES_FELT = 20.0
_RESTING = (1e-3, 3e-4)
_LEAST_CREEP_M = 1e-4
_UNFELT_MPS2 = 0.1
_MISFIT = 1e-3
"""Share of the power that readings of a right-handed accelerometer miss by; biases of 0.3 m/s^2 give 5e-4."""


@dataclass(frozen=True)
class AlignLog:
    """Readings of a log.

    Attributes
    ----------
    camera_s, pixels : stamps (n,) and pictures (n, 2) [px].
    imu_s, readings : stamps (m,) and a_x, a_y [m/s^2], g_z [rad/s] (m, 3), NaN where one is missing.
    """

    source: str
    camera_s: FloatArray
    pixels: FloatArray
    imu_s: FloatArray
    readings: FloatArray


@dataclass(frozen=True)
class Piece:
    """A stretch with even times, and the camera's own angle and length in it.

    Attributes
    ----------
    phi, length : (n,), NaN where two pixels have no solution. fine : (n,) pictures that have one.
    theta : (m,) integrated rate.
    """

    log: int
    camera: TimeAxis
    imu: TimeAxis
    pixels: FloatArray
    readings: FloatArray
    phi: FloatArray
    length: FloatArray
    fine: BoolArray
    theta: FloatArray


@dataclass(frozen=True)
class Started:
    """First guess: stretches with splines, offset, mount angle, and the factor a.

    `moves` says whether the offset could be told from the pictures at all.
    """

    stretches: tuple[Stretch, ...]
    time_offset_s: float
    mount_angle_rad: float
    factor: float
    moves: bool


_SETTLED_S = 0.05
"""In which a low-pass of 20 Hz or more forgets what was: a log of a swing begins as the head is let go, and
the sensor still shows the hand for some samples."""


def _cuts(log: AlignLog) -> list[float]:
    """Times at which a log begins and is split: where nobody knows how far the head turned."""
    felt = log.imu_s[np.isfinite(log.readings[:, 2])]
    if len(felt) < 2:
        return [-math.inf, math.inf]
    steps = np.diff(felt)
    gaps = np.flatnonzero(steps > max(SPLIT_S, _SPLIT_STEPS * float(np.median(steps))))
    first = float(felt[0]) + _SETTLED_S
    return [first, *(0.5 * (felt[i] + felt[i + 1]) for i in gaps.tolist() if felt[i] > first), math.inf]


_SPIKE = 20.0
"""How far a single rate stands out, over what rates usually are from the median of three."""


def _without_spikes(rates: FloatArray) -> FloatArray:
    """Rates (n,) with the median of three in place of single ones that stand out, for a first guess."""
    middle = rates.copy()
    middle[1:-1] = np.median([rates[:-2], rates[1:-1], rates[2:]], axis=0)
    off = np.abs(rates - middle)
    # Half of the readings are their own median.
    usual = float(np.median(off[off > 0.0])) if off.any() else 0.0
    return np.where(off > _SPIKE * usual, middle, rates)


def _integrated(t: FloatArray, gz: FloatArray) -> FloatArray:
    known = np.isfinite(gz)
    if known.sum() < 2:
        return np.zeros(len(t))
    rate = -np.interp(t, t[known], _without_spikes(gz[known]))
    return integral(t, rate)


def pieces_of(
    logs: Sequence[AlignLog], view: FloatArray, sensor: FloatArray
) -> tuple[list[Piece], list[str]]:
    """Stretches that can be used, and sentences about what was left out.

    Parameters
    ----------
    sensor : (14,) prior of `SENSOR`.
    """
    pieces, said = [], []
    for number, log in enumerate(logs):
        cuts, kept = _cuts(log), 0
        for begin, end in pairwise(cuts):
            # Parts of what was read, not copies of it.
            seen, felt = (slice(*np.searchsorted(t, (begin, end))) for t in (log.camera_s, log.imu_s))
            camera_s, imu_s = log.camera_s[seen], log.imu_s[felt]
            if len(camera_s) < _LEAST_PICTURES or len(imu_s) < _START_LEAST_SAMPLES:
                continue
            camera, imu = time_axis(camera_s), time_axis(imu_s)
            if min(camera.t_s[-1], imu.t_s[-1]) - max(camera.t_s[0], imu.t_s[0]) < SHORTEST_S:
                continue
            pixels, readings = log.pixels[seen], log.readings[felt]
            phi, length = heads_seen(view, sensor, pixels, _LENGTH_M).T.copy()
            theta = _integrated(imu.t_s, readings[:, 2])
            pieces.append(Piece(number, camera, imu, pixels, readings, phi, length, np.isfinite(phi), theta))
            kept += 1
        split = f"split at {len(cuts) - 2} gap(s) of the gyroscope" if len(cuts) > 2 else ""
        if kept == 0:
            has = f"has no stretch of {SHORTEST_S:g} s with pictures and IMU samples"
            said.append(f"{log.source}: {has}{f', {split}: look what stops its recorder' if split else ''}")
        elif split:
            said.append(f"{log.source}: {split}")
    return pieces, said


def _use(piece: Piece, offset_s: float) -> BoolArray:
    """Pictures of a head that were exposed while the IMU ran."""
    exposed = piece.camera.t_s - offset_s
    inside = (exposed >= piece.imu.t_s[0]) & (exposed <= piece.imu.t_s[-1])
    return np.asarray(inside & piece.fine)


def correlation(pieces: Sequence[Piece]) -> FloatArray:
    """Correlation (k,) of the camera's rate, over four frames, with the gyroscope's at `OFFSETS_S`."""
    values = []
    for offset in OFFSETS_S:
        cross, one, two = 0.0, 0.0, 0.0
        for piece in pieces:
            use = np.flatnonzero(_use(piece, float(offset)))
            if len(use) < _LEAST_PICTURES:
                continue
            t = piece.camera.t_s[use]
            theta = np.interp(t - offset, piece.imu.t_s, piece.theta)
            a, b = piece.phi[use][4:] - piece.phi[use][:-4], theta[4:] - theta[:-4]
            dt = t[4:] - t[:-4]
            near = dt < 1.5 * float(np.median(dt))
            a, b = a[near] / dt[near], b[near] / dt[near]
            a, b = a - a.mean(), b - b.mean()
            cross, one, two = cross + float(a @ b), one + float(a @ a), two + float(b @ b)
        values.append(cross / math.sqrt(one * two) if one * two > 0.0 else math.nan)
    return np.array(values)


TURNING = (
    "expected minus the rate of phi: an IMU with its x axis from the head to the base, z away from the "
    "camera. For one that lies on its face state factor: -1 for ay_mps2 and gz_radps in columns.yaml, and "
    "geometry: {imu_sign: [1, -1, -1]} in rig.yaml; pictures as of a selfie camera are mirrored: flip those "
    "of board and marker; a camera upside down may have read the plane's board from its other end: state "
    "first_corner_px in its board.yaml"
)
"""What to do where camera and gyroscope turn against each other."""


def _check_gyro(log: AlignLog, sums: FloatArray) -> None:
    """Raise `BadInputError` for a log whose motion tells a gyroscope of another unit or sign.

    `sums` (n, 3) are its moments at some offsets. Half a period late a swing turns the other way round: it
    counts as turned where no offset of the other sign explains it half as well.
    """
    factors, left = shares(sums)
    total = float(sums[:, 2].max())
    least = {sign: float(np.min(left[sign * factors > 0.0], initial=1.0)) for sign in (1.0, -1.0)}
    turned = least[-1.0] < 0.5 * least[1.0]
    best = least[-1.0 if turned else 1.0]
    if best > 0.5 or (1.0 - best) * total < _WORTH * _PHI_SIGMA**2:
        return
    factor = float(factors[np.argmin(np.abs(left - best))])
    if abs(factor) > _MOST_FACTOR and best < _MOST_LEFT:
        raise BadInputError(
            f"{log.source}: gz_radps shows {1.0 / abs(factor):.1%} of the turn that the camera sees, "
            "expected all: the rate about the axis away from the camera, in the unit of columns.yaml; turn "
            "the IMU on its mount, or name its axes in columns.yaml and in the sketch"
        )
    if _TIMES_IN_DEGREES[0] < abs(factor) < _TIMES_IN_DEGREES[1]:
        raise BadInputError(
            f"{log.source}: gz_radps turns {1.0 / abs(factor):.3g} times as fast as the camera sees, so it "
            "is in deg/s, expected rad/s"
        )
    if factor < -0.3:
        raise BadInputError(
            f"{log.source}: gz_radps turns the other way round than the camera sees, {TURNING}"
        )


def _spline(
    knots: Knots, values: list[tuple[FloatArray, FloatArray, int, float]], loose: float
) -> FloatArray:
    """Coefficients (count,) by least squares: lists of (times, values, derivative, deviation)."""
    n = 2 * knots.count
    A, B, C = np.zeros((n, BAND)).T, np.zeros((n, SIZE - 6)), np.zeros((SIZE - 6, SIZE - 6))
    to_c, to_s = np.zeros(n), np.zeros(SIZE - 6)
    middles = knots.middles
    for at, value, derivative, sigma in [*values, (middles, np.zeros(len(middles)), 2, loose)]:
        for part in chunks(len(at)):
            span, basis = basis_rows(knots, at[part])
            by = np.zeros((len(span), 1, SIZE))
            by[:, 0, 2 * derivative] = 1.0
            weight = np.full((len(span), 1), 1.0 / sigma**2)
            normal_sums(span, basis, by, weight, A, B, C)
            gathered(span, basis, by, weight * value[part, None], to_c, to_s)
    A[0, 1::2] = 1.0
    A[0, ::2] += 1e-3
    factor = cholesky_banded(A, lower=True, overwrite_ab=True)
    return np.asarray(cho_solve_banded((factor, True), to_c))[::2].copy()


def _local_size(t: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Standard deviation (k,) of values (n,) within `_LOCAL_S` of the times (k,), those outside held."""
    first, last = np.searchsorted(t, at - _LOCAL_S), np.searchsorted(t, at + _LOCAL_S)
    first = np.minimum(first, len(t) - 2)
    last = np.maximum(last, first + 2)
    one, two = (np.concatenate([[0.0], np.cumsum(values**power)]) for power in (1, 2))
    mean = (one[last] - one[first]) / (last - first)
    return np.asarray(np.sqrt(np.maximum((two[last] - two[first]) / (last - first) - mean**2, 0.0)))


def _averaged(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of `_MEANS` neighbours, and the middle times; what is missing is on a straight line."""
    known = np.isfinite(values)
    filled = np.interp(t, t[known], values[known])
    kernel = np.full(_MEANS, 1.0 / _MEANS)
    return np.convolve(t, kernel, "valid"), np.convolve(filled, kernel, "valid")


def _sample_noise(values: FloatArray) -> float:
    """Robust deviation of one sample from fourth differences, which slow motion does not reach."""
    return robust_sigma(np.diff(values, 4)) / math.sqrt(70.0)


def _at_rest(t: FloatArray, values: FloatArray, at: FloatArray, most: float) -> BoolArray:
    """Whether averaged readings (n,) near these times (k,) spread no more than their noise does."""
    known = np.isfinite(values)
    if known.sum() < 4 * _MEANS:
        return np.zeros(len(at), dtype=np.bool_)
    noise = min(_sample_noise(values[known]), most)
    middle, means = _averaged(t, values)
    return _local_size(middle, means - means.mean(), at) < _REST_FACTOR * noise / math.sqrt(_MEANS)


def _length_stays(piece: Piece, at: FloatArray) -> BoolArray:
    """Whether the camera's own length is the same a second before and after these times (k,)."""
    t, length = piece.camera.t_s[piece.fine], piece.length[piece.fine]
    if len(t) < _LEAST_PICTURES:
        return np.zeros(len(at), dtype=np.bool_)
    noise = float(np.percentile(np.abs(np.diff(length, 4)), 90.0)) / 1.645 / math.sqrt(70.0)
    sums = np.concatenate([[0.0], np.cumsum(length - length[0])])
    first, middle, last = (np.searchsorted(t, at + shift) for shift in (-_LOCAL_S, 0.0, _LOCAL_S))
    before, after = np.maximum(middle - first, 1), np.maximum(last - middle, 1)
    moved = (sums[last] - sums[middle]) / after - (sums[middle] - sums[first]) / before
    limit = _LEAST_CREEP_M + 3.0 * noise * np.sqrt(1.0 / before + 1.0 / after)
    return np.asarray((np.abs(moved) < limit) & (middle - first > 10) & (last - middle > 10))


def _loose(knots: Knots, piece: Piece) -> FloatArray:
    """Deviation (spans, 2) of the accelerations of phi and l about zero.

    In motion it is many times what is felt: a prior that is felt would favour small motion and with it
    wrong scales. Where nothing moves it is tiny, or the fit would take the noise for motion, and the
    sensors' agreement on it for knowledge. Where no accelerometer bounds the length it is small, too.
    """
    at = knots.middles
    t, ax, gz = piece.imu.t_s, piece.readings[:, 0], piece.readings[:, 2]
    # Stamps that are taken as they are may be equal.
    steps = np.maximum(np.diff(t), 1e-4)
    bend = np.diff(np.diff(piece.theta) / steps) / steps[1:]
    out = np.empty((len(at), 2))
    out[:, 0] = _FREE[0] + _TIMES_FELT * rms(bend)
    out[:, 1] = _UNFELT_MPS2
    if np.isfinite(ax).any():
        out[:, 1] = _FREE[1] + _TIMES_FELT * float(np.nanstd(ax))
    still = _at_rest(t, gz, at, _MOST_NOISE[0])
    out[still, 0] = _RESTING[0]
    out[still & _at_rest(t, ax, at, _MOST_NOISE[1]) & _length_stays(piece, at), 1] = _RESTING[1]
    return out


def _stretch(piece: Piece, offset_s: float) -> Stretch | None:
    exposed = piece.camera.t_s - offset_s
    first, last = piece.imu.t_s[0], piece.imu.t_s[-1]
    # The first pictures may show the head before the IMU ran; what it did then nobody knows.
    inside = (exposed >= first) & (exposed <= last)
    use = inside & piece.fine
    if inside.sum() < _LEAST_PICTURES or use.sum() < _LEAST_PICTURES // 2:
        return None
    span = max(min(2.0 * piece.imu.period_s, _MOST_SPAN_S), piece.imu.period_s, 0.005)
    knots = Knots.over(first - _MARGIN_S, last + _MARGIN_S, span)
    t = exposed[use]
    known = np.isfinite(piece.readings[:, 2])
    rates = (piece.imu.t_s[known], -_without_spikes(piece.readings[known, 2]), 1, 0.02)
    phi = _spline(knots, [(t, piece.phi[use], 0, _PHI_SIGMA), rates], 300.0)
    length = _spline(knots, [(t, piece.length[use], 0, 1.5e-3)], 0.5)
    return Stretch(
        piece.log, piece.camera.t_s[inside], piece.pixels[inside], piece.imu.t_s, piece.readings, knots,
        np.stack([phi, length], axis=1), _loose(knots, piece), np.zeros_like(piece.readings),
        math.hypot(piece.camera.shift_sigma_s, piece.imu.shift_sigma_s),
    )  # fmt: skip


def _mount(stretches: Sequence[Stretch]) -> float:
    """What atan2(a_y, a_x) reads beyond phi, in the median."""
    offs = []
    for stretch in stretches:
        for part in chunks(len(stretch.imu_s)):
            span, basis = basis_rows(stretch.knots, stretch.imu_s[part])
            phi = np.einsum("nj,nj->n", basis[:, 0], stretch.start[span[:, None] + np.arange(6), 0])
            off = np.arctan2(stretch.readings[part, 1], stretch.readings[part, 0]) - phi
            offs.append(off[np.isfinite(off)])
    whole = np.concatenate(offs)
    if len(whole) == 0:
        return 0.0
    middle = float(np.angle(np.exp(1j * whole).sum()))
    return middle + float(np.median((whole - middle + math.pi) % (2.0 * math.pi) - math.pi))


def check_accelerometer(problem: Problem, source: str, sensor: FloatArray) -> None:
    """Refuse an accelerometer whose axes are mirrored, which no mount angle explains.

    With p = x + i y of the predicted specific force and r of the readings, the least sum of |r - e^(ia) p|^2
    over all mount angles a is sum |r|^2 + sum |p|^2 - 2 |sum r p*|; for axes that are swapped or of which one
    has the wrong sign p* stands for p.

    Parameters
    ----------
    sensor : (14,) of `SENSOR` with the mount angle 0.
    """
    power, straight, mirrored = 0.0, 0j, 0j
    for stretch in problem.stretches:
        for off, rows, _ in _readings(stretch, stretch.start, sensor):
            known = np.isfinite(off[:, 0] + off[:, 1])
            p, e = (values[known, 0] + 1j * values[known, 1] for values in (rows.predicted, off))
            r = p + e
            power += float((np.abs(p) ** 2 + np.abs(r) ** 2).sum())
            straight, mirrored = straight + complex(r @ p.conj()), mirrored + complex(r @ p)
    miss, miss_mirrored = power - 2.0 * abs(straight), power - 2.0 * abs(mirrored)
    if miss > _MISFIT * power and miss_mirrored < 0.5 * miss:
        raise BadInputError(
            f"{source}: ax_mps2 and ay_mps2 turn the other way round than the camera sees, so they are "
            "swapped or one has the wrong sign, expected a right-handed IMU, its x axis from the head to the "
            "base"
        )


def start(pieces: Sequence[Piece], logs: Sequence[AlignLog], usual_offset_s: float) -> Started:
    """First guess of all that the fit needs.

    Raises `BadInputError` for a gyroscope in other units or with another sign.
    """
    by_log = np.zeros((len(logs), len(OFFSETS_S), 3))
    for piece in pieces:
        seen, imu = piece.camera.t_s[piece.fine], piece.imu
        by_log[piece.log] += moments(
            seen, piece.phi[piece.fine], imu.t_s, piece.theta, OFFSETS_S, _LEAST_PICTURES
        )
    for log, own in zip(logs, by_log, strict=True):
        _check_gyro(log, own)
    sums = by_log.sum(axis=0)
    factors, left = shares(sums)
    usual = int(np.argmin(np.abs(OFFSETS_S - usual_offset_s)))
    best = int(np.argmin(left))
    moves = bool((left.max() - left[best]) * sums[best, 2] / _PHI_SIGMA**2 > _WORTH)
    at = best if moves else usual
    most = logs[int(np.argmax(by_log[:, at, 2]))]
    _check_gyro(most, sums[at : at + 1])
    offset = float(OFFSETS_S[at])
    made = [_stretch(piece, offset) for piece in pieces]
    stretches = tuple(stretch for stretch in made if stretch is not None)
    mount = _mount(stretches) if stretches else 0.0
    return Started(stretches, offset, mount, float(factors[at]), moves)


# ----------------------------------------------------------------------
# Batch least squares for what the sensors are, over splines for how the head moved.
#
# The normal equations are those of `_normal`. Camera, accelerometer and gyroscope read the same motion
# with errors of known size, so that the fit, which makes the motion and the sensors' quantities most likely
# together, is a total least squares: right on the average while the motion is left free (Van Huffel and
# Vandewalle 1991).
#
# The noise is found on the way: the IMU's from the residuals, sum w r^2 / (n - d), where d = tr(W J P J') are
# the degrees of freedom that the fit took from the sensor; the trace comes from random signs (Hutchinson
# 1990). The tracker's share of outliers and its jitter are those of maximum likelihood, the latter times
# sqrt(n / (n - d)), n the number of exact readings that say as much.

_MOST_STEPS = 100
"""Noise and fit follow each other: a change of the noise leaves three quarters of it to the next, or less."""
_HALVINGS = 8
_SMALL_STEP = 0.01
_SMALL_CHANGE = 0.01
_PROBES = 4


@dataclass(frozen=True)
class Fit:
    """What the fit has come to.

    Attributes
    ----------
    sensor, covariance : (14,) and (14, 14) of `SENSOR`.
    coefficients : of each stretch's spline. noise : that was found.
    good : for each stretch (n,), probability that a picture shows the marker.
    steps, converged : of Gauss-Newton.
    """

    sensor: FloatArray
    covariance: FloatArray
    coefficients: list[FloatArray]
    noise: Noise
    good: list[FloatArray]
    steps: int
    converged: bool
    arrow: Arrow


def _taken(
    arrow: Arrow, cs: list[FloatArray], size: int, rooted: Callable[[int], Iterable[tuple[Rows, FloatArray]]]
) -> float:
    """Degrees of freedom that the fit took from readings of a kind, by `_PROBES` vectors of random signs.

    Parameters
    ----------
    size : of s. rooted : of a stretch, rows with the square roots (k, channels) of their weights.
    """
    rng, both = np.random.default_rng(0), np.array([-1, 1], dtype=np.int8)
    to_cs, to_s = [[np.zeros(c.size) for c in cs] for _ in range(_PROBES)], np.zeros((_PROBES, size))
    for i in range(len(cs)):
        for rows, root in rooted(i):
            for to_c, to in zip(to_cs, to_s, strict=True):
                signed = root * rng.choice(both, root.shape)
                gathered(rows.span, rows.basis, rows.by, signed, to_c[i], to)
    taken = 0.0
    for to_c, to in zip(to_cs, to_s, strict=True):
        dcs, ds = arrow.solve(to_c, to)
        taken += sum(float(a @ b) for a, b in zip(dcs, to_c, strict=True)) + float(ds @ to)
    return taken / _PROBES


def _imu_noise(
    problem: Problem, arrow: Arrow, cs: list[FloatArray], s: FloatArray, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Deviations (3,) of the IMU's readings by residuals and degrees of freedom, and counts over these."""
    squares, count, taken = np.zeros(3), np.zeros(3), np.zeros(3)
    # One channel at a time: each probe takes the memory of all coefficients.
    for channel in range(3):

        def rooted(i: int, channel: int = channel) -> Iterator[tuple[Rows, FloatArray]]:
            for off, rows, part in _readings(problem.stretches[i], cs[i], s):
                deviation = noise.of(problem.stretches[i], part)
                _, pull, weight = imu_terms(off, deviation)
                # Beyond `HUBER` deviations a reading counts as one there: a few wild ones are no noise.
                squares[channel] += ((pull[:, channel] * deviation[:, channel]) ** 2).sum()
                count[channel] += (weight[:, channel] > 0.0).sum()
                yield rows, np.where(np.arange(3) == channel, np.sqrt(weight), 0.0)

        taken[channel] = _taken(arrow, cs, len(s), rooted)
    left = np.maximum(count - taken, 1.0)
    found = noise.imu * np.sqrt(squares / left)
    # Without readings of an axis its deviation plays no part.
    return np.where(count > 20, np.maximum(found, 1e-6), noise.imu), count / left


_MOST_TAKEN = 0.5
"""Share of what pictures say that counts as taken at most: of whole pixels with little jitter, which leave
next to no residuals, next to all."""


def _jitter_px(
    problem: Problem, arrow: Arrow, cs: list[FloatArray], s: FloatArray, noise: Noise, share: float
) -> float:
    """The tracker's jitter by residuals and the degrees of freedom that the fit took from them."""
    offs = [pictures_off(problem, stretch, c, s) for stretch, c in zip(problem.stretches, cs, strict=True)]
    count = 0.0

    def rooted(i: int) -> Iterator[tuple[Rows, FloatArray]]:
        nonlocal count
        for rows, _, _, weight, _ in _picture_terms(problem, noise, problem.stretches[i], cs[i], s):
            # As many exact readings would say as much.
            count += noise.jitter_px**2 * float(weight.sum())
            yield rows, np.sqrt(weight)

    taken = _taken(arrow, cs, len(s), rooted)
    left = 1.0 - min(taken / max(count, 1.0), _MOST_TAKEN)
    return best_jitter_px(np.concatenate(offs), problem.grid_px, share) / math.sqrt(left)


_AGES_S = np.concatenate([[0.0], np.geomspace(5e-5, 3e-3, 42)])
_AGE_GAIN = 10.0
"""Loss that an age has to spare to be believed."""


def _age_s(problem: Problem, cs: list[FloatArray], s: FloatArray, imu: FloatArray, lost: FloatArray) -> float:
    """The likeliest deviation of the readings' times, by the gyroscope.

    Parameters
    ----------
    lost : (3,) factors by which the fit has made the squares of residuals smaller.
    """
    rates = [
        np.stack([readings_off(one, c, s)[:, 2], one.steep[:, 2], one.missed[:, 2]])
        for one, c in zip(problem.stretches, cs, strict=True)
    ]
    off, steep, missed = (whole := np.concatenate(rates, axis=1))[:, np.isfinite(whole[0])]
    squares, quiet = lost[2] * off**2, imu[2] ** 2 + missed**2
    losses = np.empty(len(_AGES_S))
    for k, age in enumerate(_AGES_S):
        variance = quiet + (age * steep) ** 2
        losses[k] = 0.5 * float((np.log(variance) + np.minimum(squares / variance, HUBER**2)).sum())
    best = int(np.argmin(losses))
    return float(_AGES_S[best]) if losses[best] < losses[0] - _AGE_GAIN else 0.0


def _renewed(
    problem: Problem, arrow: Arrow, cs: list[FloatArray], s: FloatArray, noise: Noise, goods: list[FloatArray]
) -> Noise:
    good = np.concatenate(goods)
    share = float(np.clip(1.0 - good.mean() if len(good) else 0.0, 1e-3, 0.5))
    jitter = _jitter_px(problem, arrow, cs, s, noise, share)
    imu, lost = _imu_noise(problem, arrow, cs, s, noise)
    return Noise(jitter, share, imu, _age_s(problem, cs, s, imu, lost))


def solve(problem: Problem, sensor: FloatArray, noise: Noise) -> Fit:
    """Fit from these quantities (14,) and this noise on.

    The noise is renewed after each step that is small or of which it was the third with the same noise.
    """
    cs, s = [stretch.start.copy() for stretch in problem.stretches], sensor.copy()
    same, converged, steps = 0, False, 0
    loss = _loss(problem, cs, s, noise)
    arrow, to_cs, to_s, goods = _normal(problem, cs, s, noise)
    while steps < _MOST_STEPS and not converged:
        steps += 1
        dcs, ds = arrow.solve(to_cs, to_s)
        size = arrow.size(ds)
        share = 1.0
        # The next factors take the place of these in memory.
        del arrow
        for _ in range(_HALVINGS):
            moved = [c + share * dc.reshape(c.shape) for c, dc in zip(cs, dcs, strict=True)]
            trial = _loss(problem, moved, s + share * ds, noise)
            if trial <= loss + 1e-9 * abs(loss):
                cs, s, loss = moved, s + share * ds, trial
                break
            share *= 0.5
        else:
            size = 0.0
        same += 1
        small = size < _SMALL_STEP
        arrow, to_cs, to_s, goods = _normal(problem, cs, s, noise)
        if small or same >= 3:
            found = _renewed(problem, arrow, cs, s, noise, goods)
            change = np.abs(np.log(found.imu / noise.imu)).max()
            change = max(float(change), abs(np.log(found.jitter_px / noise.jitter_px)))
            same_age = abs(found.age_s - noise.age_s) < 0.15 * max(found.age_s, _AGES_S[1])
            noise, same = found, 0
            del arrow
            arrow, to_cs, to_s, goods = _normal(problem, cs, s, noise)
            converged = small and change < _SMALL_CHANGE and same_age
            loss = _loss(problem, cs, s, noise)
    covariance = np.asarray(cho_solve(arrow.S, np.eye(len(s))))
    covariance = 0.5 * (covariance + covariance.T)
    return Fit(s, covariance, cs, noise, goods, steps, converged, arrow)


_UNFOLLOWED = 5.0
"""Deviations from which on a residual is no noise: of Gaussian noise one in two million."""
_FREE_BEND = 1e6
"""Deviation of a curve's second derivative, which a gap alone feels: in a swing it is 1e4 m/s^4."""


def _followed(stretch: Stretch, c: FloatArray, fit: Fit) -> Stretch:
    """A stretch whose readings weigh less within a span of those that no spline on its knots follows.

    A pump that is switched jerks the head for one or two readings, which resolve that no better than the
    knots do: by how much the velocity has changed is not known from them, and scales would make up for it.
    Both the fit and a spline of the readings alone miss them. The latter follows readings that contradict the
    pictures, and the fit those beside a wild one.
    """
    known = np.isfinite(stretch.readings)
    curves = [
        _spline(stretch.knots, [(stretch.imu_s[use], values[use], 0, sigma)], _FREE_BEND)
        for values, use, sigma in zip(stretch.readings.T, known.T, fit.noise.imu.tolist(), strict=True)
    ]
    off = np.abs(readings_off(stretch, c, fit.sensor))
    for part in chunks(len(off)):
        span, basis = basis_rows(stretch.knots, stretch.imu_s[part])
        alone = np.einsum("nj,njk->nk", basis[:, 0], np.stack(curves, 1)[span[:, None] + np.arange(6)])
        off[part] = np.minimum(off[part], np.abs(stretch.readings[part] - alone))
    off[~known] = 0.0
    off[off <= _UNFOLLOWED * fit.noise.of(stretch, slice(None))] = 0.0
    # Of samples that come in bursts most have the time of the one before.
    step_s = float(stretch.imu_s[-1] - stretch.imu_s[0]) / (len(stretch.imu_s) - 1)
    near = math.ceil(stretch.knots.span_s / step_s - 1e-6)
    return replace(stretch, start=c, missed=maximum_filter1d(off, 2 * near + 1, axis=0))


# ----------------------------------------------------------------------
# Camera and IMU of a moving rig brought into line: time offset, mount angle, scales, biases, marker.
#
# Under constant curvature two pixels tell the angle and the length, so that what camera and IMU say of the
# same motion can be compared: `start` finds where to begin, `solve` fits the sensors'
# quantities and a spline of the motion to all readings at once (continuous-time batch estimation: Furgale,
# Barfoot and Sibley 2012). Priors come from outside; where the posterior is no narrower, the logs say
# nothing.
#
# The covariance is that of the fit, its information bounded, plus that of biases that have walked by
# K sqrt(T / 3) in the mean of a log, of a time offset by the jitter of a log's stamps, and of quantities that
# in one log are not what they are in the others: of a sensor that was mounted anew or was warmer, of a camera
# that was moved, or, of the time offset, of a log that was joined to its camera's by itself. To add d to a
# quantity in one log, which changes its readings by J, has the score g = J' W e and the information I,
# J' W J less what motion and s explain; d = g / I.
# Nor need gravity lie along the world's y axis, which is a board's. The mount angle is the one against
# gravity, so that the head's motion comes turned by that angle; across a swinging head it looks like an IMU
# that sits aside. By the logs the angle is not told well from it, and the covariance holds what is likely. It
# holds as well what axes of the accelerometer that are not square, which no quantity stands for, make of the
# scales of accelerometer and gyroscope: 4 deviations for 0.4 %.
#
# At rest the mount angle and the bias along y are one number,
#
#     atan2((1 + s_y) g sin(alpha) + b_y, (1 + s_x) g cos(alpha) + b_x),
#
# what the accelerometer reads at phi = 0; it comes with its own deviation.

_FIRST_NOISE = Noise(1.0, 0.05, np.array([0.2, 0.2, 0.01]))
_GZ, _AX, _AY, _MOUNT, _OFFSET, _MARKER = (
    SENSOR.index(name)
    for name in (
        "gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2", "mount_angle_rad", "time_offset_s",
        "marker_offset_m",
    )
)  # fmt: skip
_SX, _SY = SENSOR.index("accel_scale_x"), SENSOR.index("accel_scale_y")
_SHIFT_X, _ACROSS = SENSOR.index("shift_x_m"), SENSOR.index("imu_across_m")
_SHIFT, _STRETCH = (
    [len(HEAD) + SENSOR.index(f"shift_{axis}_m") for axis in "xy"],
    len(HEAD) + SENSOR.index("stretch"),
)


_LEAN_RAD = 5e-3
"""How far the world's y axis may stand off the vertical: .3 degrees, as of a board laid by a spirit level."""
_SKEW = 5e-3
"""Share of what is along x that the accelerometer's y axis may feel: data sheets (BNO055) allow 1 %."""


@dataclass(frozen=True)
class Settings:
    """What is known beforehand.

    Attributes
    ----------
    view : (25,) of `sensors.view_coefficients`.
    mean, sigma : (14,) prior of `SENSOR`. The mount angle's mean is replaced by a first guess.
    grid_px : step of the pixels. gyro_walk, accel_walk : densities K of the biases' walk.
    aside_sigma_m : how far the marker is across a straight head: as its drawing tells, and on its axis but
        for the calibration; empty where `sigma` is all that is known. turn_sigma_rad : how well the plane's
        direction is known.
    """

    view: FloatArray
    mean: FloatArray
    sigma: FloatArray
    grid_px: float = 1.0
    gyro_walk: float = 1e-5
    accel_walk: float = 1e-4
    aside_sigma_m: tuple[float, ...] = ()
    turn_sigma_rad: float = 0.0


@dataclass(frozen=True)
class Trace:
    """Residuals of a stretch for figures, with the first guess of the sensors and with the fit.

    Attributes
    ----------
    log : number. camera_s, imu_s : times. good : (n,). camera_before, camera_after : (n, 2) [px].
    imu_before, imu_after : (m, 3).
    """

    log: int
    camera_s: FloatArray
    good: FloatArray
    camera_before: FloatArray
    camera_after: FloatArray
    imu_s: FloatArray
    imu_before: FloatArray
    imu_after: FloatArray


@dataclass(frozen=True)
class Alignment:
    """What was found.

    Attributes
    ----------
    sensor, covariance : (14,) and (14, 14) of `SENSOR`; mean, prior : (14,) prior and its deviations.
    noise, converged, steps : of the fit. moves : the first guess could see the offset. factor : of the
        gyroscope against the camera.
    correlation : (k,) of the camera's rate of angle with the gyroscope's at `OFFSETS_S`.
    left_out : sentences on gaps and logs that were not used.
    clock_s : by how much steps of the logs' clocks may move the offset.
    shared : the largest share of a sensor's stamps in a stretch that are those of the reading before.
    pace, pace_sigma : by which share the camera's clock is faster than the IMU's.
    span_s : of the longest stretch. apart : logs in which a quantity is another one.
    aside_m : how far across the head the logs alone place the marker, with its deviation, where that is
        farther than drawing and calibration allow.
    """

    sensor: FloatArray
    covariance: FloatArray
    mean: FloatArray
    prior: FloatArray
    noise: Noise
    converged: bool
    steps: int
    moves: bool
    factor: float
    logs: tuple[LogCheck, ...]
    traces: tuple[Trace, ...]
    correlation: FloatArray
    left_out: tuple[str, ...]
    clock_s: float = 0.0
    pace: float = 0.0
    pace_sigma: float = math.inf
    span_s: float = 0.0
    apart: tuple[Apart, ...] = ()
    shared: float = 0.0
    aside_m: tuple[float, float] | None = None

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (14,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rest_angle_rad(self) -> float:
        """What the accelerometer reads at phi = 0 at rest."""
        return rest_reading(self.sensor)[0][0]

    @property
    def rest_angle_sigma(self) -> float:
        """Standard deviation of that."""
        gradient = rest_reading(self.sensor)[1][0]
        return math.sqrt(float(gradient @ self.covariance @ gradient))


_LEAST_STEP_S, _OFF_GRID = 2e-3, 0.15
"""A clock with finer steps moves the offset by less than half of what it is to be known to."""


_MOMENT_S = 1e-4
"""Deviation of the moment that a sample stands for, which no log tells: low-passes that differ, jitter that
is not symmetric, times made monotone. On 27 rigs of another simulator the offset was within two deviations in
67 % without it, in 96 % with it. At 0.5 m/s it is 0.05 mm."""


def clock_sigma_s(piece: Piece) -> float:
    """Standard deviation [s] that steps of a log's clock give to the time offset, 0 for steps that do not.

    Samples that come at every phase of the steps are late by the same on the average, and those that always
    come at one phase by an unknown part of a step. Where no sensor is off the grid, that is how its times
    were made up.
    """
    axes = piece.camera, piece.imu
    step = clock_step_s(np.concatenate([axis.stamps_s for axis in axes]))
    if step < _LEAST_STEP_S or max(axis.jitter_s for axis in axes) < _OFF_GRID * step:
        return 0.0
    buffered = all(axis.burst > 1 for axis in axes)
    return math.hypot(*(_step_s(axis, step, buffered) for axis in axes)) / math.sqrt(12.0)


def _step_s(axis: TimeAxis, step_s: float, buffered: bool) -> float:
    """Of a clock's step the share by which all of a sensor's times may be off [s].

    Times of a burst end at its stamp, and those that share a step are spread about it. So where all sensors
    are `buffered` steps do not part them, and what is unknown is how late in a period buffers are read.
    """
    if buffered:
        # Those of a burst before its last are whole periods older.
        late = (axis.stamps_s - axis.t_s) / axis.period_s
        return axis.period_s * abs(complex(np.exp(2j * np.pi * late).mean()))
    if step_s > COARSE[1] * axis.period_s:
        return step_s
    return step_s * abs(complex(np.exp(2j * np.pi * axis.t_s / step_s).mean()))


def _pace(pieces: Sequence[Piece], offset_s: float) -> tuple[float, float]:
    """By which share the camera's clock is faster than the IMU's, and its deviation; inf where nothing tells.

    With a delay d + a (t - t_0) the camera's angle is, to first order, theta - theta' (d + a (t - t_0)). Its
    scale and offset and the gyroscope's bias are fitted beside d and a, stretch by stretch.
    """
    sums = np.zeros(2)
    for piece in pieces:
        use = np.flatnonzero(_use(piece, offset_s))
        if len(use) < 2 * _LEAST_PICTURES:
            continue
        t, felt = piece.camera.t_s[use], piece.imu.t_s
        rate = np.diff(piece.theta) / np.maximum(np.diff(felt), 1e-9)
        theta = np.interp(t - offset_s, felt, piece.theta)
        turning, since = -np.interp(t - offset_s, 0.5 * (felt[1:] + felt[:-1]), rate), t - t.mean()
        A = np.stack([turning * since, turning, np.ones_like(t), since, theta], axis=1)
        off = piece.phi[use] - theta
        rest = off
        for _ in range(3):
            x = np.linalg.lstsq(A, off, rcond=None)[0]
            rest = off - A @ x
            near = np.abs(rest) <= 4.0 * robust_sigma(rest)
            A, off, rest = A[near], off[near], rest[near]
        if len(rest) < _LEAST_PICTURES or not rest.any():
            continue
        # What hangs together from picture to picture says less.
        together = min(max(float(rest[1:] @ rest[:-1] / (rest @ rest)), 0.0), 0.99)
        variance = float(rest @ rest) / max(len(rest) - A.shape[1], 1) * (1.0 + together) / (1.0 - together)
        # A marker that stays on one pixel leaves nothing.
        variance = max(variance, (0.1 * _PHI_SIGMA) ** 2)
        known = 1.0 / max(float(np.linalg.pinv(A.T @ A)[0, 0]) * variance, 1e-12)
        sums += known * x[0], known
    return (float(sums[0] / sums[1]), float(sums[1] ** -0.5)) if sums[1] > 0.0 else (0.0, math.inf)


_SURELY_APART = 6.0
_MAY_DIFFER = {
    "accel_bias_x_mps2": (0.01, "by {:+.3f} m/s^2"),
    "accel_bias_y_mps2": (0.01, "by {:+.3f} m/s^2"),
    "gyro_bias_radps": (1e-3, "by {:+.4f} rad/s"),
    "mount_angle_rad": (1e-3, "by {:+.4f} rad"),
    "time_offset_s": (5e-4, "by {:+.4f} s"),
}
"""Deviations, and amounts with their words, from which on a log has its own: 0.001 rad and 0.01 m/s^2 are
0.06 degrees, and logs that were joined to their camera's differ by up to 3 ms, of one clock by less than 2
deviations. Four logs of one rig come to 2.4 deviations at most, in 32 alignments of other plants, noise,
rates and outliers; of stamps in steps of 10 ms to 8.9, for 9e-4 rad/s."""
_TOLD = 1e-3
"""Share of the information that is left beside other quantities, below which a log does not tell it."""


_LATE, _LATE_S = "accelerometer's delay", (1e-3, 4e-3)
"""Delays of the accelerometer beside the gyroscope that are a remark, and that make an alignment poor."""
_DIFFERENCE_S = 0.02
"""Differences over less see the noise that a spline follows, and make of it a delay that is not there."""


@dataclass(frozen=True)
class Apart:
    """A quantity that is another one in a log than in the others, or that the model does not have.

    Attributes
    ----------
    log : its number, -1 for all. name : of `SENSOR`, or `_LATE`. away, deviations : by how much.
    moved : (14,) how far this moves the quantities of all logs.
    """

    log: int
    name: str
    away: float
    deviations: float
    moved: FloatArray


Changes = Iterator[tuple[Terms, FloatArray]]
"""Terms of a stretch, and what one more quantity changes of their predictions."""
Column = Callable[[Stretch, FloatArray], Changes]


def _beside(
    problem: Problem, fit: Fit, column: Column, of: Iterable[int]
) -> tuple[float, float, float, FloatArray]:
    """Score of one more quantity of these stretches, and information on it alone and beside all others.

    Last, by how much one unit of it moves these (14,).
    """
    right, score, alone, taken = np.zeros(len(SENSOR)), 0.0, 0.0, 0.0
    for i in of:
        c = fit.coefficients[i]
        to_c = np.zeros(c.size)
        for (rows, _, pull, weight, _), change in column(problem.stretches[i], c):
            score += float((pull * change).sum())
            alone += float((weight * change**2).sum())
            gathered(rows.span, rows.basis, rows.by, weight * change, to_c, right)
        own = fit.arrow.own(i, to_c)
        taken += float(to_c @ own)
        right -= fit.arrow.B[i].T @ own
    moved = cho_solve(fit.arrow.S, right)
    return score, alone, alone - taken - float(right @ moved), moved


def _one_more(problem: Problem, fit: Fit, column: Column, log: int, name: str) -> Apart | None:
    """One more quantity of a log, or of all (-1), as far as the readings tell it beside all others."""
    of = [i for i, stretch in enumerate(problem.stretches) if log in (-1, stretch.log)]
    score, alone, known, moved = _beside(problem, fit, column, of)
    if known <= _TOLD * alone:
        return None
    away = score / known
    return Apart(log, name, away, abs(score) / math.sqrt(known), away * moved)


def _apart(problem: Problem, fit: Fit, logs: int) -> list[Apart]:
    """Logs with quantities of their own, of which a single one has none; an accelerometer that is late."""
    out = [_one_more(problem, fit, partial(_late, fit), -1, _LATE)]
    for log, name in product(range(logs if logs > 1 else 0), _MAY_DIFFER):
        out.append(_one_more(problem, fit, partial(_own, problem, fit, name, 1.0), log, name))
    least = {name: amount for name, (amount, _) in _MAY_DIFFER.items()} | {_LATE: _LATE_S[0]}
    return [
        one for one in out
        if one is not None and one.deviations > _SURELY_APART and abs(one.away) > least[one.name]
    ]  # fmt: skip


def _own(problem: Problem, fit: Fit, name: str, size: float, stretch: Stretch, c: FloatArray) -> Changes:
    """What so much of a quantity changes: pictures or the IMU's readings."""
    at = len(HEAD) + SENSOR.index(name)
    if name == SENSOR[_OFFSET]:
        for one in _picture_terms(problem, fit.noise, stretch, c, fit.sensor):
            # A place that no picture shows has no derivative.
            yield one, size * np.where(one.weight > 0.0, one.rows.by[:, :, at], 0.0)
        return
    for one in _reading_terms(fit.noise, stretch, c, fit.sensor):
        yield one, size * one.rows.by[:, :, at]


def _walked(settings: Settings, problem: Problem, fit: Fit) -> FloatArray:
    """Covariance (14, 14) from biases and a time offset that differ from stretch to stretch."""
    total = np.zeros((len(SENSOR), len(SENSOR)))
    for i, stretch in enumerate(problem.stretches):
        root = math.sqrt(float(stretch.imu_s[-1] - stretch.imu_s[0]) / 3.0)
        walks = (_AX, settings.accel_walk), (_AY, settings.accel_walk), (_GZ, settings.gyro_walk)
        for at, size in (*((at, walk * root) for at, walk in walks), (_OFFSET, stretch.clock_s)):
            moved = _beside(problem, fit, partial(_own, problem, fit, SENSOR[at], size), [i])[3]
            total += np.outer(moved, moved)
    return total


_ALIKE_S = 300.0
"""Motion whose noise leaves as much unknown as what stays the same however long it lasts.

On 27 rigs of another simulator with 75 to 190 s of motion scales and biases missed the truth by 1.23 to 1.36
deviations (RMS) of the noise alone. In logs of the simulated rig of 10 and 20 minutes, in which the
controllers follow the tracker's noise with the head, scales were off by 2.2 and 3.3 on the average; without
that, by .3.
"""


def _bounded(problem: Problem, fit: Fit) -> FloatArray:
    """Covariance (14, 14) of the fit, whose information beside the prior's ends at that of `_ALIKE_S`.

    Errors are not all noise that longer logs average out: motion follows what a controller has read, sensors
    are not quite linear. Information I / (1 + T / T_0) on top of a prior of one turns an eigenvalue w of the
    covariance in units of the prior into k w / (1 + (k - 1) w) with k = 1 + T / T_0.
    """
    moving_s = sum(
        one.knots.span_s * np.count_nonzero(one.loose[:, 0] > _RESTING[0]) for one in problem.stretches
    )
    k, units = 1.0 + moving_s / _ALIKE_S, problem.sigma[:, None]
    w, V = np.linalg.eigh(fit.covariance / (units * problem.sigma))
    root = units * V * np.sqrt(k * w / (1.0 + (k - 1.0) * w))
    return np.asarray(root @ root.T)


def turned(problem: Problem, fit: Fit) -> FloatArray:
    """Change (14,) of the quantities per radian by which the world's axes lie turned about its middle.

    Turned axes look like a bent head: at rest the marker is as far aside, and only the curve of its path
    differs. No quantity stands for them.
    """

    def across(stretch: Stretch, c: FloatArray) -> Changes:
        for one in _picture_terms(problem, fit.noise, stretch, c, fit.sensor):
            seen = (one.weight > 0.0).all(axis=1) & np.isfinite(one.rows.by).all(axis=(1, 2))
            by, change = one.rows.by[seen], np.zeros_like(one.pull)
            # Stretching moves the marker away from the middle, turning across that.
            away = np.linalg.solve(by[:, :, _SHIFT], by[:, :, _STRETCH, None])
            change[seen] = (by[:, :, _SHIFT] @ (away[:, ::-1] * np.array([[1.0], [-1.0]])))[:, :, 0]
            yield one, change

    moved = [_beside(problem, fit, across, [i])[3] for i in range(len(problem.stretches))]
    return np.asarray(np.sum(moved, axis=0))


def _accelerations_at(stretch: Stretch, late_s: float) -> Stretch:
    """A stretch whose accelerations, which come late, are those of the moments of its rates."""
    readings = stretch.readings.copy()
    for k in range(2):
        known = np.isfinite(readings[:, k])
        t, values = stretch.imu_s[known], readings[known, k]
        # Of readings with one stamp the first.
        apart = np.diff(t, prepend=-math.inf) > 0.0
        if apart.sum() > 1:
            curve = CubicSpline(t[apart], values[apart])
            readings[known, k] = curve(np.clip(t + late_s, t[0], t[-1]))
    return replace(stretch, readings=readings)


def _late(fit: Fit, stretch: Stretch, c: FloatArray) -> Changes:
    """What accelerations that are late beside the rates change of the IMU's readings."""
    terms = _reading_terms(fit.noise, stretch, c, fit.sensor)
    for one, part in zip(terms, chunks(len(stretch.imu_s)), strict=True):
        before, after = (
            imu_rows(stretch.knots, c, fit.sensor, stretch.imu_s[part] + step).predicted
            for step in (-_DIFFERENCE_S, _DIFFERENCE_S)
        )
        change = (before - after) / (2.0 * _DIFFERENCE_S)
        change[:, 2] = 0.0
        yield one, change


def _turned_motion(fit: Fit, stretch: Stretch, c: FloatArray) -> Changes:
    """Change of what the accelerometer reads of the motion, by the angle at which gravity stands aside."""
    s = fit.sensor
    for one in _reading_terms(fit.noise, stretch, c, s):
        rows = one.rows
        phi = np.einsum("nj,nj->n", rows.basis[:, 0], c[rows.span[:, None] + np.arange(6), 0])
        # As by the mount angle, which turns gravity too.
        change = rows.by[:, :, len(HEAD) + _MOUNT].copy()
        change[:, 0] += (1.0 + s[_SX]) * GRAVITY_MPS2 * np.sin(phi + s[_MOUNT])
        change[:, 1] -= (1.0 + s[_SY]) * GRAVITY_MPS2 * np.cos(phi + s[_MOUNT])
        yield one, change


def _skewed(fit: Fit, stretch: Stretch, c: FloatArray) -> Changes:
    """Change of what the accelerometer reads along y, by the share that it feels of what is along x.

    Beside that at rest at phi = 0, which is in the bias.
    """
    angle, size = rest_reading(fit.sensor)[0]
    for one in _reading_terms(fit.noise, stretch, c, fit.sensor):
        change = np.zeros_like(one.pull)
        change[:, 1] = one.rows.predicted[:, 0] - size * math.cos(angle)
        yield one, change


def _likely(problem: Problem, fit: Fit, column: Column, sigma: float) -> FloatArray:
    """Covariance (14, 14) by a quantity that the model lacks, as large as the logs and its deviation say."""
    score, _, known, moved = _beside(problem, fit, column, range(len(problem.stretches)))
    variance = 1.0 / (max(known, 0.0) + sigma**-2)
    return (variance + (score * variance) ** 2) * np.outer(moved, moved)


def _traces(problem: Problem, first: FloatArray, fit: Fit) -> tuple[Trace, ...]:
    return tuple(
        Trace(
            stretch.log, stretch.camera_s, good,
            pictures_off(problem, stretch, c, first), pictures_off(problem, stretch, c, fit.sensor),
            stretch.imu_s,
            readings_off(stretch, c, first), readings_off(stretch, c, fit.sensor),
        )
        for stretch, c, good in zip(problem.stretches, fit.coefficients, fit.good, strict=True)
    )  # fmt: skip


def _check(
    number: int, log: AlignLog, pieces: Sequence[Piece], stretches: Sequence[Stretch], fit: Fit,
    traces: Sequence[Trace],
) -> LogCheck:  # fmt: skip
    own = [i for i, stretch in enumerate(stretches) if stretch.log == number]
    mine = [piece for piece in pieces if piece.log == number]
    good = np.concatenate([fit.good[i] for i in own]) if own else np.zeros(0)
    imu = np.concatenate([traces[i].imu_after for i in own]) if own else np.zeros((0, 3))
    pictures = [traces[i].camera_after[fit.good[i] > 0.5] for i in own]
    # The coefficients at the ends lie outside of the readings.
    phi = [fit.coefficients[i][8:-8, 0] for i in own]

    def middle(values: list[float], invert: bool = False) -> float:
        value = float(np.median(values)) if values else math.nan
        return 1.0 / value if invert else value

    def known_rms(values: FloatArray) -> float | None:
        return finite_or_none(rms(values[np.isfinite(values)]))

    return LogCheck(
        name=log.source,
        pictures=len(good),
        outliers=int((good < 0.5).sum()),
        samples=len(imu),
        duration_s=sum(float(stretches[i].imu_s[-1] - stretches[i].imu_s[0]) for i in own),
        stretches=len(own),
        camera_rate_hz=finite_or_none(middle([piece.camera.period_s for piece in mine], True)),
        imu_rate_hz=finite_or_none(middle([piece.imu.period_s for piece in mine], True)),
        camera_jitter_s=finite_or_none(middle([piece.camera.jitter_s for piece in mine])),
        imu_jitter_s=finite_or_none(middle([piece.imu.jitter_s for piece in mine])),
        repeated_stamps=sum(piece.camera.repeated + piece.imu.repeated for piece in mine),
        missing=sum(piece.camera.missing + piece.imu.missing for piece in mine),
        turned_rad=float(np.std(np.concatenate(phi))) if phi else 0.0,
        camera_rms_px=known_rms(np.concatenate(pictures)) if pictures else None,
        gyro_rms_radps=known_rms(imu[:, 2]),
        accel_rms_mps2=known_rms(imu[:, :2]),
    )


def align(logs: Sequence[AlignLog], settings: Settings) -> Alignment:
    """Find what the sensors are from logs, all at once.

    Raises `BadInputError` where no log has a stretch to work on, and for a gyroscope in other units.
    """
    pieces, said = pieces_of(logs, settings.view, settings.mean)
    if not pieces:
        raise BadInputError(said[0] if said else "no log has pictures and IMU samples")
    first = start(pieces, logs, float(settings.mean[_OFFSET]))
    if not first.stretches:
        raise BadInputError(
            f"{logs[pieces[0].log].source}: hardly any picture shows a place where the marker can be, "
            "expected pictures of the marker on the head"
        )
    mean = settings.mean.copy()
    mean[_MOUNT] = 0.0
    problem = Problem(
        settings.view, settings.grid_px,
        first.stretches, mean, settings.sigma,
    )  # fmt: skip
    if first.moves:
        check_accelerometer(problem, logs[pieces[0].log].source, mean)
    mean[_MOUNT] = first.mount_angle_rad
    sensor = mean.copy()
    sensor[_OFFSET] = first.time_offset_s
    fit = solve(problem, sensor, _FIRST_NOISE)
    followed = tuple(
        _followed(stretch, c, fit) for stretch, c in zip(problem.stretches, fit.coefficients, strict=True)
    )
    if any(stretch.missed.any() for stretch in followed):
        problem, sensor, noise = replace(problem, stretches=followed), fit.sensor, fit.noise
        # The next factors take the place of these in memory.
        del fit
        fit = solve(problem, sensor, noise)
    late = [one for one in _apart(problem, fit, 1) if one.name == _LATE]
    for one in late:
        at_once = tuple(
            replace(_accelerations_at(stretch, one.away), start=c)
            for stretch, c in zip(problem.stretches, fit.coefficients, strict=True)
        )
        problem = replace(problem, stretches=at_once)
        fit = solve(problem, fit.sensor, fit.noise)
    moved = settings.turn_sigma_rad * turned(problem, fit)
    covariance = _bounded(problem, fit) + _walked(settings, problem, fit) + np.outer(moved, moved)
    covariance += _likely(problem, fit, partial(_turned_motion, fit), _LEAN_RAD)
    covariance += _likely(problem, fit, partial(_skewed, fit), _SKEW)
    # What is left of a delay that was taken out is its deviation.
    apart = [one for one in _apart(problem, fit, len(logs)) if not late or one.name != _LATE]
    for one in [*apart, *(replace(one, moved=one.moved / one.deviations) for one in late)]:
        covariance += np.outer(one.moved, one.moved)
    apart = [*late, *apart]
    clock_s = max(clock_sigma_s(piece) for piece in pieces)
    covariance[_OFFSET, _OFFSET] += clock_s**2 + _MOMENT_S**2
    # Before: the sensors as they were assumed to be.
    before = mean.copy()
    before[_MOUNT] = 0.0
    traces = _traces(problem, before, fit)
    checks = tuple(
        _check(number, log, pieces, first.stretches, fit, traces) for number, log in enumerate(logs)
    )
    found = Alignment(
        fit.sensor, covariance, mean, settings.sigma, fit.noise, fit.converged, fit.steps, first.moves,
        first.factor, checks, traces, correlation(pieces), tuple(said), clock_s,
        *_pace(pieces, float(fit.sensor[_OFFSET])),
        max(float(np.ptp(piece.camera.t_s)) for piece in pieces), tuple(apart),
        max(axis.repeated / len(axis.stamps_s) for piece in pieces for axis in (piece.camera, piece.imu)),
    )  # fmt: skip
    if settings.aside_sigma_m:
        found = _centred(found, settings.aside_sigma_m)
    return _from_axis(found, settings.aside_sigma_m)


# ----------------------------------------------------------------------
# The marker across the head.
#
# A marker aside and a plane that lies aside are one at a straight head, and there look like a bent one: 0.05
# mm are 0.06 degrees. So it matters what is taken for likely. The fit takes next to nothing for known, within
# `ASIDE_M`; then each of three kinds is weighed by how well the logs bear it: on the axis as the
# calibration tells, off it as the drawing's deviation allows, or elsewhere, as of a board that was laid
# with a ruler.

ASIDE_M = 3e-4
_KINDS = np.array([0.5, 0.495, 0.005])
"""Probabilities beforehand: on the axis, within the drawing's deviation, elsewhere."""
_SURELY_ELSEWHERE = 0.9


def _mixed(
    found: Alignment, k: int, away: float, sums: FloatArray, likely: FloatArray
) -> tuple[Alignment, FloatArray]:
    """An alignment with one more reading of quantity k, of several kinds, and the kinds' probabilities.

    Mean and covariance are those of the mixture.

    Parameters
    ----------
    away : the reading less the value. sums : variance of that by kind, infinite of one that says nothing.
    likely : of the kinds, up to a factor.
    """
    weight, by = likely / likely.sum(), found.covariance[k]
    # All quantities move along their covariance with k, by these amounts of k per variance.
    pulls = away / sums
    pull = float(weight @ pulls)
    spread = float(weight @ (1.0 / sums) - weight @ (pulls - pull) ** 2)
    sensor, covariance = found.sensor + by * pull, found.covariance - spread * np.outer(by, by)
    return replace(found, sensor=sensor, covariance=covariance), weight


def _centred(found: Alignment, aside_sigma_m: tuple[float, ...]) -> Alignment:
    """An alignment with what is likely of the marker across the head; the fit held it to a wide prior."""
    wide, value, known = float(found.prior[_SHIFT_X]), float(found.sensor[_SHIFT_X]), found.sigma[_SHIFT_X]
    drawn, calibrated = aside_sigma_m
    kinds = np.array([calibrated, drawn, wide])
    # A narrower prior is the wide one and one more reading of zero.
    with np.errstate(divide="ignore"):
        more = 1.0 / np.maximum(1.0 / kinds**2 - 1.0 / wide**2, 0.0)
        sums = more + known**2
        likely = _KINDS * wide / kinds * np.exp(-0.5 * value**2 / sums) / np.sqrt(1.0 + known**2 / more)
    centred, weight = _mixed(found, _SHIFT_X, -value, sums, likely)
    if weight[2] < _SURELY_ELSEWHERE:
        return centred
    # Beyond the prior are deviations that hold what logs contradict each other in.
    if known > _NOTHING_LEARNT * wide:
        return replace(centred, aside_m=(value, known))
    told = 1.0 - (known / wide) ** 2
    return replace(centred, aside_m=(value / told, wide * math.sqrt((1.0 - told) / told)))


def _from_axis(found: Alignment, aside_sigma_m: tuple[float, ...]) -> Alignment:
    """An alignment whose IMU is placed from the axis, where the fit places it from the marker.

    What lies aside is the marker by its share in what is likely beforehand; where it is surely more, either.
    """
    share, likely = 1.0, 0.0
    if aside_sigma_m and found.aside_m is None:
        drawn, calibrated = aside_sigma_m
        share = 1.0 - (calibrated / drawn) ** 2
        likely = share * calibrated**2
    covariance = found.covariance.copy()
    aside = found.sensor[_SHIFT_X] ** 2 + covariance[_SHIFT_X, _SHIFT_X]
    covariance[_ACROSS, _ACROSS] += share**2 * aside + likely
    return replace(found, covariance=covariance)


# ----------------------------------------------------------------------
# Whether an alignment can be used, and what its logs could not tell apart.
#
# What has to be known is the time offset and the angle read at rest. Of the others a combination is
# often known much better than each alone: with the correlation r of two quantities, a part sqrt(1 - r^2) of
# their deviations is left once the other is known.

_OFFSET_S = (1e-3, 1e-2)
_REST_RAD = math.radians(0.1)
_OUTLIERS = (0.2, 0.5)
_FEW = 20
_SHORT_S = 3.0
_SURE_PACE, _PACE_S = 5.0, 4e-3
"""Deviations, and change of the time offset within a log: four times what it is to be known to."""
_JITTER_PX = 1.5
_REPEATS = 0.25
"""On good logs of seven rigs, wrong plants and noise twice as large among them, .07 at most."""
_REPEATS_PX = 0.1
"""Root mean square of what is beyond half a pixel from which on it says something."""
_FACTOR, _NO_FACTOR = 0.2, 0.5
_TURNS = (
    "check the gyroscope's unit and axis, and the squares' length; calib align is not for a head on a stiff "
    "arm about a pin, such as a pendulum, which turns half as far as one that bends"
)
_COLUMNS = "check the columns of the logs: their order, signs, units and times"
_BEYOND_PRIOR = 4.0
_GYRO_SCALE = 0.04
"""Of a gyroscope whose scale nobody calibrated: data sheets (BNO055, MPU-6050) allow 3 %."""
_STRETCHED = (
    "check that t_s runs in seconds and is no count of samples: a stretched time looks the same, and forces "
    "err by twice as much; if the gyroscope is so, find its scale with calib imu intrinsics"
)
_NOTHING_LEARNT = 0.8
_INSEPARABLE = 0.98
_TURNED_RAD = 0.02
_SWING = "a log of a free swing, let go at 20 degrees, shows the time offset within a millisecond"
_TILT = "slow motion to large angles both ways tells the mount angle from the accelerometer's bias"


def _data(found: Alignment) -> Iterator[Finding]:
    pictures = sum(log.pictures for log in found.logs)
    outliers = sum(log.outliers for log in found.logs)
    share = outliers / max(pictures, 1)
    if share > _OUTLIERS[0]:
        yield Finding(
            "unidentifiable" if share > _OUTLIERS[1] else "poor",
            f"{100.0 * share:.0f} % of {pictures} pictures show something else than the marker",
            "look for a second thing of its colour; else " + _COLUMNS,
        )
    # One log on a wrong clock is few among many.
    for log in found.logs if len(found.logs) > 1 else ():
        if log.outliers > max(_OUTLIERS[0] * log.pictures, _FEW):
            yield Finding(
                "poor",
                f"{log.name}: {100.0 * log.outliers / log.pictures:.0f} % of its {log.pictures} pictures do "
                f"not fit the IMU, expected {100.0 * _OUTLIERS[0]:.0f} % at most",
                f"check the clock of {log.name}, or the offset that joined it, what its marker is, and "
                "whether camera and IMU stood as in the other logs",
            )
    if abs(found.pace) > _SURE_PACE * found.pace_sigma and abs(found.pace) * found.span_s > _PACE_S:
        yield Finding(
            "poor",
            f"the camera's clock runs {1e2 * abs(found.pace):.2g} +- {1e2 * found.pace_sigma:.1g} % "
            f"{'faster' if found.pace > 0.0 else 'slower'} than the IMU's; the time offset changes by "
            f"{1e3 * abs(found.pace) * found.span_s:.0f} ms within a log",
            "stamp both by one clock, and a video's frames by their own times",
        )
    duration = sum(log.duration_s for log in found.logs)
    if duration < _SHORT_S:
        yield Finding(
            "poor", f"the logs are too short: {duration:.2g} s together, expected {_SHORT_S:g} s or more"
        )
    if not found.converged:
        yield Finding("poor", f"the fit has not converged after {found.steps} steps")
    if found.noise.jitter_px > _JITTER_PX:
        yield Finding(
            "poor",
            f"pictures miss the fit by {found.noise.jitter_px:.2g} px; camera, plane or constant curvature "
            "do not hold",
        )
    turned = max((log.turned_rad for log in found.logs), default=0.0)
    if turned > _TURNED_RAD and abs(found.factor - 1.0) > _FACTOR:
        yield Finding(
            "unidentifiable" if abs(found.factor - 1.0) > _NO_FACTOR else "poor",
            f"the camera sees {found.factor:.2g} times the turn that the gyroscope feels",
            _TURNS,
        )


def repeating(found: Alignment) -> float:
    """How much residuals of pictures repeat from one to the next: the larger correlation of u and v.

    Whole pixels repeat at rest, by half of one at most, which does not count; nor do outliers, nor what is
    hardly more.
    """
    sums, count = np.zeros((2, 2)), 0
    for trace in found.traces:
        e = np.where(trace.good.astype(bool)[:, None], trace.camera_after, np.nan)
        beyond = np.sign(e) * np.maximum(np.abs(e) - 0.5, 0.0)
        sums[0] += np.nansum(beyond[1:] * beyond[:-1], axis=0)
        sums[1] += np.nansum(beyond**2, axis=0)
        count += int(np.isfinite(beyond[:, 0]).sum())
    matters = sums[1] > max(count, 1) * _REPEATS_PX**2
    return float(np.max(np.where(matters, sums[0] / np.maximum(sums[1], 1e-12), 0.0)))


def _contradicted(found: Alignment) -> Iterator[Finding]:
    if (correlation := repeating(found)) > _REPEATS:
        yield Finding(
            "poor",
            "pictures contradict the IMU: they miss the fit in the same way from one to the next, "
            f"correlation {correlation:.2f}",
            f"{_COLUMNS}; delays are looked for from {OFFSETS_S[0]:.1f} to {OFFSETS_S[-1]:.1f} s",
        )


_MOUNTED = "was the IMU or the camera moved between the logs, or the IMU warmer? align this log alone"
_JOINED = "were camera and IMU joined log by log? where their clocks went on, join all with one --offset"


def _differing(found: Alignment) -> Iterator[Finding]:
    """What is most clearly another one in one log; of what is mounted anew biases seem to be others, too."""
    for names, advice in (
        (("mount_angle_rad", "accel_bias_x_mps2", "accel_bias_y_mps2"), _MOUNTED),
        (("gyro_bias_radps",), _MOUNTED),
        (("time_offset_s",), _JOINED),
    ):
        mine = [one for one in found.apart if one.name in names]
        if mine:
            most = max(mine, key=lambda one: one.deviations)
            yield Finding(
                "remark",
                f"{found.logs[most.log].name}: {QUANTITIES[most.name].words} differs from that in the other "
                f"logs {_MAY_DIFFER[most.name][1].format(most.away)}; the deviations hold this",
                advice,
            )


def _late_accelerometer(found: Alignment) -> Iterator[Finding]:
    for one in found.apart:
        if one.name == _LATE:
            when = "after" if one.away > 0.0 else "before"
            yield Finding(
                "poor" if abs(one.away) > _LATE_S[1] else "remark",
                f"accelerations come about {1e3 * abs(one.away):.1f} ms {when} the rates of the same motion; "
                "the alignment takes them at once",
                "give accelerometer and gyroscope low-passes of one bandwidth, and read both at once",
            )


_SHOWN = {"": (100.0, "%"), "m": (1e3, "mm"), "s": (1e3, "ms"), "rad": (180.0 / math.pi, "deg")}
_SHIFTS = ("shift_x_m", "shift_y_m", "stretch")
_MOVED = (
    "find the plane again: its board lay elsewhere (state first_corner_sigma_m and angle_sigma_rad in "
    "board.yaml) or has another square, the marker sits aside, or the camera has moved since; a "
    "video may store its colours half a pixel aside, which moves the marker by 0.4 px"
)


_STAMPS = "write t_s with six decimals, as each reading is taken"
_SHARED = 0.05
"""Of the stamps; those of a recorder that wrote one twice are fewer."""


def _known(found: Alignment) -> Iterator[Finding]:
    sigma = found.sigma
    offset = float(sigma[_OFFSET])
    if offset > _OFFSET_S[0]:
        turned = max((log.turned_rad for log in found.logs), default=0.0)
        why = ""
        if turned < _TURNED_RAD:
            why = f": the logs hardly move (phi by {math.degrees(turned):.2g} degrees)"
        advice = _SWING
        if found.clock_s > 0.5 * offset:
            why = f": the logs' clock has steps, which alone make {1e3 * found.clock_s:.2g} ms of it"
            advice = _STAMPS
        elif found.shared > _SHARED:
            why = f": {100.0 * found.shared:.0f} % of the time stamps are those of the reading before"
            advice = _STAMPS
        words = "is not observable, its deviation is" if offset > _OFFSET_S[1] else "has a deviation of"
        yield Finding(
            "unidentifiable" if offset > _OFFSET_S[1] else "poor",
            f"the time offset {words} {1e3 * offset:.2g} ms, expected 1 ms{why}",
            advice,
        )
    if found.rest_angle_sigma > _REST_RAD:
        yield Finding(
            "poor",
            f"the angle read at rest is known to {math.degrees(found.rest_angle_sigma):.3g} degrees, "
            "expected at most 0.1 degrees",
        )
    for k, name in enumerate(SENSOR):
        away = abs(found.sensor[k] - found.mean[k]) / found.prior[k]
        if k == _SHIFT_X and found.aside_m is not None:
            value, spread = (1e3 * x for x in found.aside_m)
            yield Finding(
                "poor",
                f"by the logs the plane is {value:.2g} +- {spread:.1g} mm aside, or the marker on the head",
                _MOVED,
            )
        stretched = name == "gyro_scale" and abs(found.sensor[k] - found.mean[k]) > _GYRO_SCALE
        # A delay that the logs tell is a delay, however long.
        if stretched or (away > _BEYOND_PRIOR and (k != _OFFSET or offset > _OFFSET_S[0])):
            # In the units of the table.
            scale, unit = _SHOWN.get(unit_of(name), (1.0, unit_of(name)))
            value, mean, spread = (scale * float(x[k]) for x in (found.sensor, found.mean, found.prior))
            text = f"came out as {value:.3g} {unit}, expected {mean:.3g} +- {spread:.2g} {unit}"
            advice = _MOVED if name in _SHIFTS else _STRETCHED if stretched else ""
            yield Finding("poor", f"{QUANTITIES[name].words} {text}", advice)


def _separable(found: Alignment) -> Iterator[Finding]:
    sigma = found.sigma
    R = found.covariance / sigma / sigma[:, None]
    unlearnt = [k for k in range(len(SENSOR)) if sigma[k] > _NOTHING_LEARNT * found.prior[k]]
    if sigma[_MOUNT] > 2.0 * found.rest_angle_sigma or R[_MOUNT, _AY] < -_INSEPARABLE:
        yield Finding(
            "remark",
            "the mount angle and the accelerometer's bias along y are nearly one number "
            f"(correlation {R[_MOUNT, _AY]:.3f}): together, as the angle read at rest at phi = 0, they are "
            f"{math.degrees(found.rest_angle_rad):.3f} +- {math.degrees(found.rest_angle_sigma):.3f} deg, "
            f"the mount angle alone {math.degrees(found.sensor[_MOUNT]):.2f} +- "
            f"{math.degrees(sigma[_MOUNT]):.2f} deg",
            _TILT if sigma[_MOUNT] > _REST_RAD else "",
        )
    for group in tied_groups(R, _INSEPARABLE):
        if set(group) != {_MOUNT, _AY}:
            words = [QUANTITIES[SENSOR[k]].words for k in group]
            yield Finding(
                "remark",
                f"hardly told apart from each other: {all_of(words)}; what they do together is known much "
                "better than each, see the covariance",
            )
    if unlearnt:
        names = ", ".join(QUANTITIES[SENSOR[k]].words for k in unlearnt)
        yield Finding("remark", f"the logs say next to nothing of {names}: as assumed beforehand")


def judge(found: Alignment) -> Verdict:
    """Verdict on an alignment by its logs alone."""
    findings = [*_data(found), *_contradicted(found), *_differing(found), *_late_accelerometer(found)]
    findings += [*_known(found), *_separable(found)]
    if not np.isfinite(found.covariance).all():
        findings.append(Finding("unidentifiable", "the covariance is not finite"))
    return Verdict.of([*findings, *(Finding("remark", text) for text in found.left_out)])


# ----------------------------------------------------------------------
# The marker's offset by the rig's drawing.

_DOUBT = {True: 0.02, False: 0.1}
"""Probability that the marker is not where its drawing says: with one written down, and without."""
_ELSEWHERE_M, _CONTRARY_M = 3e-3, 5e-4


def with_drawn_marker(found: Alignment, geometry: Geometry) -> tuple[Alignment, Finding]:
    """An alignment with what the rig's drawing says of the marker's offset d, and a finding on that.

    Along the straight actuator d and the length are one number. Logs part them only by the angle between
    chord and tangent, to some tenths of a millimetre, since the scales of gyroscope and accelerometer take
    the same share of it. So the drawing counts as one more reading of d, of two kinds: right to its
    deviation, or, with the probability `_DOUBT`, off by about `_ELSEWHERE_M`. Each kind is weighed by how
    well the logs bear it, and mean and covariance are those of the mixture: the further apart drawing and
    logs are, the larger is sigma, until the logs alone are left.
    """
    written = "marker_offset_m" in geometry.model_fields_set
    drawn, sigma = geometry.marker_offset_m, geometry.marker_offset_sigma_m
    value = float(found.sensor[_MARKER])
    doubt, away = _DOUBT[written], drawn - value
    sums = found.sigma[_MARKER] ** 2 + np.array([sigma, math.hypot(sigma, _ELSEWHERE_M)]) ** 2
    likely = np.array([1.0 - doubt, doubt]) * np.exp(-0.5 * away * away / sums) / np.sqrt(sums)
    mixed, weight = _mixed(found, _MARKER, away, sums, likely)
    both = (
        f"the marker's offset d: {_mm(drawn, sigma)} as drawn (geometry.marker_offset_m), "
        f"{_mm(value, float(found.sigma[_MARKER]))} by the logs alone, "
        f"{_mm(float(mixed.sensor[_MARKER]), float(mixed.sigma[_MARKER]))} together"
    )
    if weight[0] < 0.5:
        both += "; drawing and logs contradict each other, and the logs are believed"
        if abs(away) > _CONTRARY_M:
            advice = (
                "measure d again; where it is as drawn, camera or plane have moved since they were "
                "calibrated, or a column of the logs is scaled"
            )
            return mixed, Finding("inconsistent" if written else "poor", both, advice)
    elif not written:
        both += "; lengths err as much as it does, so measure it and write it down: nobody has for this rig"
    return mixed, Finding("remark", both)


def _mm(value_m: float, sigma_m: float) -> str:
    return f"{1e3 * value_m:.2f} +- {1e3 * sigma_m:.2f} mm"

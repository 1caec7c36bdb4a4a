"""The normal equations of an alignment: readings, noise, losses, and an arrow of banded blocks.

Unknown are the coefficients c of each stretch's spline and the 13 quantities s of `SENSOR`, which all
stretches share. Gauss-Newton's normal equations are

    [A_1           B_1] [dc_1]   [g_1]
    [     ...         ] [    ] = [   ]
    [B_1' ...   C     ] [ds  ]   [g_s]

so that with X_i = A_i^-1 B_i, S = C - sum B_i' X_i it is S ds = g_s - sum X_i' g_i, and S^-1 is the
covariance of s with the motion eliminated. Priors: s as given, and accelerations of the head at each knot
span about zero with a deviation that leaves them free (`loose`), for times without readings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from calib.arrays import FloatArray
from calib.estimator.align_loss import imu_terms, pixel_terms
from calib.estimator.align_spline import (
    BAND,
    Knots,
    Rows,
    basis_rows,
    camera_rows,
    gathered,
    imu_rows,
    normal_sums,
)
from calib.estimator.sensors import SENSOR, SIZE

__all__ = ["Arrow", "Noise", "Problem", "Stretch", "Work", "pictures_off", "readings_off"]

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
    """

    log: int
    camera_s: FloatArray
    pixels: FloatArray
    imu_s: FloatArray
    readings: FloatArray
    knots: Knots
    start: FloatArray
    loose: FloatArray


@dataclass(frozen=True)
class Noise:
    """Noise of the sensors: tracker's jitter [px], share of outliers, and (3,) of a_x, a_y, g_z."""

    jitter_px: float
    share: float
    imu: FloatArray


@dataclass(frozen=True)
class Problem:
    """Everything that goes into the fit.

    Attributes
    ----------
    view : (24,) of `sensors.view_coefficients`. gravity_mps2, across_m : g and c_n.
    grid_px : step of the pixels, 0 for none. area_px2 : over which outliers lie.
    mean, sigma : (13,) prior of `SENSOR`.
    """

    view: FloatArray
    gravity_mps2: float
    across_m: float
    grid_px: float
    area_px2: float
    stretches: tuple[Stretch, ...]
    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Arrow:
    """Factors of the normal equations."""

    factors: list[FloatArray]
    X: list[FloatArray]
    S: tuple[FloatArray, bool]

    def solve(self, to_c: list[FloatArray], to_s: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Steps of all coefficients and of s for a right-hand side."""
        inner = [cho_solve_banded((f, True), g) for f, g in zip(self.factors, to_c, strict=True)]
        right = to_s.copy()
        for X, g in zip(self.X, to_c, strict=True):
            right -= X.T @ g
        ds = np.asarray(cho_solve(self.S, right))
        return [u - X @ ds for u, X in zip(inner, self.X, strict=True)], ds

    def size(self, ds: FloatArray) -> float:
        """The largest of a step (13,) in deviations."""
        return float(np.max(np.abs(ds) / np.sqrt(np.diag(cho_solve(self.S, np.eye(len(ds)))))))


def pictures_off(problem: Problem, stretch: Stretch, c: FloatArray, sensor: FloatArray) -> FloatArray:
    """Pixels (n, 2) seen minus predicted."""
    rows = camera_rows(problem.view, stretch.knots, c, sensor, stretch.camera_s)
    return np.asarray(stretch.pixels - rows.predicted)


def readings_off(problem: Problem, stretch: Stretch, c: FloatArray, sensor: FloatArray) -> FloatArray:
    """Readings (m, 3) of the IMU minus predicted, NaN where one is missing."""
    rows = imu_rows(problem.gravity_mps2, problem.across_m, stretch.knots, c, sensor, stretch.imu_s)
    return np.asarray(stretch.readings - rows.predicted)


def _loose_rows(stretch: Stretch) -> Rows:
    """Accelerations of phi and l in the middle of each span."""
    knots = stretch.knots
    middles = knots.middles
    span, basis = basis_rows(knots, middles)
    by = np.zeros((len(middles), 2, SIZE))
    by[:, 0, 4], by[:, 1, 5] = 1.0, 1.0
    return Rows(span, basis, np.zeros((len(middles), 2)), by)


class Work:
    """The problem at a point: loss, and the normal equations."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.loose = [_loose_rows(stretch) for stretch in problem.stretches]

    def prior(self, i: int, c: FloatArray) -> tuple[float, FloatArray]:
        """Loss of a stretch's accelerations and anchor, and its pull on the accelerations (n, 2)."""
        stretch, rows = self.problem.stretches[i], self.loose[i]
        at = rows.span[:, None] + np.arange(6)
        bends = np.einsum("nj,nja->na", rows.basis[:, 2], c[at])
        z, away = bends / stretch.loose, (c - stretch.start) / _ANCHOR
        return 0.5 * float((z * z).sum() + (away * away).sum()), -z / stretch.loose

    def loss(self, cs: list[FloatArray], s: FloatArray, noise: Noise) -> float:
        """Minus the logarithm of the posterior."""
        p = self.problem
        total = 0.5 * float((((s - p.mean) / p.sigma) ** 2).sum())
        for i, (stretch, c) in enumerate(zip(p.stretches, cs, strict=True)):
            off = pictures_off(p, stretch, c, s)
            room = np.empty_like(off), np.empty_like(off), np.empty(len(off))
            total += pixel_terms(off, noise.jitter_px, p.grid_px, noise.share, p.area_px2, *room)
            total += imu_terms(readings_off(p, stretch, c, s), noise.imu)[0]
            total += self.prior(i, c)[0]
        return total

    def normal(
        self, cs: list[FloatArray], s: FloatArray, noise: Noise
    ) -> tuple[Arrow, list[FloatArray], FloatArray, list[FloatArray]]:
        """Factors, right-hand sides, and the probability of each picture to show the marker."""
        p = self.problem
        C = np.diag(1.0 / p.sigma**2)
        to_s = (p.mean - s) / p.sigma**2
        factors: list[FloatArray] = []
        Xs: list[FloatArray] = []
        Bs: list[FloatArray] = []
        to_cs: list[FloatArray] = []
        goods: list[FloatArray] = []
        for i, (stretch, c) in enumerate(zip(p.stretches, cs, strict=True)):
            n = 2 * stretch.knots.count
            A, B, to_c = np.zeros((BAND, n)), np.zeros((n, len(SENSOR))), np.zeros(n)
            rows = camera_rows(p.view, stretch.knots, c, s, stretch.camera_s)
            off = stretch.pixels - rows.predicted
            pull, weight, good = np.empty_like(off), np.empty_like(off), np.empty(len(off))
            pixel_terms(off, noise.jitter_px, p.grid_px, noise.share, p.area_px2, pull, weight, good)
            by = np.where(good[:, None, None] > 0.0, rows.by, 0.0)
            normal_sums(rows.span, rows.basis, by, weight, A, B, C)
            gathered(rows.span, rows.basis, by, pull, to_c, to_s)
            rows = imu_rows(p.gravity_mps2, p.across_m, stretch.knots, c, s, stretch.imu_s)
            _, pull, weight = imu_terms(stretch.readings - rows.predicted, noise.imu)
            normal_sums(rows.span, rows.basis, rows.by, weight, A, B, C)
            gathered(rows.span, rows.basis, rows.by, pull, to_c, to_s)
            rows = self.loose[i]
            normal_sums(rows.span, rows.basis, rows.by, 1.0 / stretch.loose**2, A, B, C)
            gathered(rows.span, rows.basis, rows.by, self.prior(i, c)[1], to_c, to_s)
            A[0] += np.tile(1.0 / _ANCHOR**2, stretch.knots.count)
            to_c += ((stretch.start - c) / _ANCHOR**2).ravel()
            factor = np.asarray(cholesky_banded(A, lower=True, check_finite=False))
            X = np.asarray(cho_solve_banded((factor, True), B, check_finite=False))
            for found, value in zip((factors, Xs, Bs, to_cs, goods), (factor, X, B, to_c, good), strict=True):
                found.append(value)
        S = C - sum((B.T @ X for B, X in zip(Bs, Xs, strict=True)), np.zeros_like(C))
        return Arrow(factors, Xs, cho_factor(0.5 * (S + S.T))), to_cs, to_s, goods

"""Batch least squares for what the sensors are, over splines for how the head moved.

The normal equations are those of `align_problem`. Camera, accelerometer and gyroscope read the same motion
with errors of known size, so that the fit, which makes the motion and the sensors' quantities most likely
together, is a total least squares: right on the average while the motion is left free (Van Huffel and
Vandewalle 1991).

The noise is found on the way: the tracker's jitter and its share of outliers by maximum likelihood, the
IMU's from the residuals, sum w r^2 / (n - d), where d = tr(W J P J') are the degrees of freedom that
the fit took from the sensor; the trace comes from random signs (Hutchinson 1990).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve

from calib.arrays import FloatArray
from calib.estimator.align_loss import best_jitter_px, imu_terms, pixel_terms
from calib.estimator.align_problem import Arrow, Noise, Problem, Work, pictures_off
from calib.estimator.align_spline import camera_rows, gathered, imu_rows
from calib.estimator.sensors import SENSOR

__all__ = ["Fit", "response", "solve"]

_MOST_STEPS = 40
_HALVINGS = 8
_SMALL_STEP = 0.01
_SMALL_CHANGE = 0.01
_PROBES = 4


@dataclass(frozen=True)
class Fit:
    """What the fit has come to.

    Attributes
    ----------
    sensor, covariance : (13,) and (13, 13) of `SENSOR`.
    coefficients : of each stretch's spline. noise : that was found.
    good : for each stretch (n,), probability that a picture shows the marker.
    loss, steps, converged : of Gauss-Newton.
    """

    sensor: FloatArray
    covariance: FloatArray
    coefficients: list[FloatArray]
    noise: Noise
    good: list[FloatArray]
    loss: float
    steps: int
    converged: bool
    arrow: Arrow


def _imu_noise(work: Work, arrow: Arrow, cs: list[FloatArray], s: FloatArray, noise: Noise) -> FloatArray:
    """Deviations (3,) of the IMU's readings by their residuals and degrees of freedom."""
    p, rng = work.problem, np.random.default_rng(0)
    squares, count, taken = np.zeros(3), np.zeros(3), np.zeros(3)
    all_rows = []
    for stretch, c in zip(p.stretches, cs, strict=True):
        rows = imu_rows(p.gravity_mps2, p.across_m, stretch.knots, c, s, stretch.imu_s)
        off = stretch.readings - rows.predicted
        _, pull, weight = imu_terms(off, noise.imu)
        squares += np.nansum(np.where(np.isfinite(off), pull * off, 0.0), axis=0)
        count += (weight > 0.0).sum(axis=0)
        all_rows.append((rows, np.sqrt(weight)))
    for channel in range(3):
        for _ in range(_PROBES):
            to_cs, to_s = [], np.zeros(len(SENSOR))
            for (rows, root), c in zip(all_rows, cs, strict=True):
                signs = np.zeros_like(root)
                signs[:, channel] = root[:, channel] * rng.choice(np.array([-1.0, 1.0]), len(root))
                to_c = np.zeros(c.size)
                gathered(rows.span, rows.basis, rows.by, signs, to_c, to_s)
                to_cs.append(to_c)
            dcs, ds = arrow.solve(to_cs, to_s)
            taken[channel] += sum(float(a @ b) for a, b in zip(dcs, to_cs, strict=True)) + float(ds @ to_s)
    left = np.maximum(count - taken / _PROBES, 1.0)
    found = noise.imu * np.sqrt(squares / left)
    # Without readings of an axis its deviation plays no part.
    return np.where(count > 20, np.maximum(found, 1e-6), noise.imu)


def _renewed(
    work: Work, arrow: Arrow, cs: list[FloatArray], s: FloatArray, noise: Noise, goods: list[FloatArray]
) -> Noise:
    p = work.problem
    offs = [pictures_off(p, stretch, c, s) for stretch, c in zip(p.stretches, cs, strict=True)]
    good = np.concatenate(goods)
    share = float(np.clip(1.0 - good.mean() if len(good) else 0.0, 1e-3, 0.5))
    jitter = best_jitter_px(np.concatenate(offs), p.grid_px, share, p.area_px2)
    return Noise(jitter, share, _imu_noise(work, arrow, cs, s, noise))


def solve(problem: Problem, sensor: FloatArray, noise: Noise) -> Fit:
    """Fit from these quantities (13,) and this noise on.

    The noise is renewed after each step that is small or of which it was the third with the same noise.
    """
    work = Work(problem)
    cs, s = [stretch.start.copy() for stretch in problem.stretches], sensor.copy()
    same, converged, steps = 0, False, 0
    loss = work.loss(cs, s, noise)
    arrow, to_cs, to_s, goods = work.normal(cs, s, noise)
    while steps < _MOST_STEPS and not converged:
        steps += 1
        dcs, ds = arrow.solve(to_cs, to_s)
        size = arrow.size(ds)
        share = 1.0
        for _ in range(_HALVINGS):
            moved = [c + share * dc.reshape(c.shape) for c, dc in zip(cs, dcs, strict=True)]
            trial = work.loss(moved, s + share * ds, noise)
            if trial <= loss + 1e-9 * abs(loss):
                cs, s, loss = moved, s + share * ds, trial
                break
            share *= 0.5
        else:
            size = 0.0
        same += 1
        small = size < _SMALL_STEP
        arrow, to_cs, to_s, goods = work.normal(cs, s, noise)
        if small or same >= 3:
            found = _renewed(work, arrow, cs, s, noise, goods)
            change = np.abs(np.log(found.imu / noise.imu)).max()
            change = max(float(change), abs(np.log(found.jitter_px / noise.jitter_px)))
            noise, same = found, 0
            arrow, to_cs, to_s, goods = work.normal(cs, s, noise)
            converged = small and change < _SMALL_CHANGE
            loss = work.loss(cs, s, noise)
    covariance = np.asarray(cho_solve(arrow.S, np.eye(len(s))))
    covariance = 0.5 * (covariance + covariance.T)
    return Fit(s, covariance, cs, noise, goods, loss, steps, converged, arrow)


def response(
    problem: Problem, fit: Fit, pictures: list[FloatArray], readings: list[FloatArray]
) -> FloatArray:
    """Change (13,) of the sensors' quantities when predictions change by so much.

    Parameters
    ----------
    pictures, readings : for each stretch (n, 2) [px] and (m, 3), the change of what is predicted.
    """
    to_cs, to_s = [], np.zeros(len(SENSOR))
    for i, (stretch, c) in enumerate(zip(problem.stretches, fit.coefficients, strict=True)):
        to_c = np.zeros(c.size)
        rows = camera_rows(problem.view, stretch.knots, c, fit.sensor, stretch.camera_s)
        off = stretch.pixels - rows.predicted
        pull, weight, good = np.empty_like(off), np.empty_like(off), np.empty(len(off))
        n = fit.noise
        pixel_terms(off, n.jitter_px, problem.grid_px, n.share, problem.area_px2, pull, weight, good)
        by = np.where(good[:, None, None] > 0.0, rows.by, 0.0)
        gathered(rows.span, rows.basis, by, -weight * pictures[i], to_c, to_s)
        rows = imu_rows(problem.gravity_mps2, problem.across_m, stretch.knots, c, fit.sensor, stretch.imu_s)
        _, _, weight = imu_terms(stretch.readings - rows.predicted, n.imu)
        gathered(rows.span, rows.basis, rows.by, -weight * readings[i], to_c, to_s)
        to_cs.append(to_c)
    return fit.arrow.solve(to_cs, to_s)[1]

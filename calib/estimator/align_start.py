"""Where the alignment starts: stretches without gaps, the camera's own angle, and a first time offset.

Two pixels give angle and length of a resting head (`invert_marker`), the gyroscope integrated gives the
angle but for a line in time. For offsets on a grid the camera's angle is fitted by

    phi_camera(t) = a theta(t - offset) + b + c t,   theta' = -g_z

over all stretches with one a; the offset with the least squares is the first guess. The factor a tells
a gyroscope in degrees per second (1 / 57) and one that turns the other way round (negative).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError
from calib.estimator.align_clock import EvenTimes, even_times_of
from calib.estimator.align_problem import Stretch
from calib.estimator.align_spline import BAND, Knots, basis_rows, gathered, normal_sums
from calib.estimator.sensors import SIZE, invert_marker

__all__ = ["SHORTEST_S", "AlignLog", "Correlation", "Piece", "Started", "correlation", "pieces_of", "start"]

SPLIT_S = 1.0
SHORTEST_S = 1.0
"""Gaps at which a log is split, and stretches that are too short to be used."""

_OFFSETS_S = np.arange(-0.1, 0.3001, 0.0025)
_LEAST_PICTURES = 20
_LEAST_SAMPLES = 40
_PHI_SIGMA = 0.012
_WORTH = 60.0
_TIMES_IN_DEGREES = (0.5 / 57.3, 2.0 / 57.3)
_MARGIN_S = 0.06
_LOCAL_S = 1.0
_MEANS = 5
_REST_FACTOR = 2.0
_MOST_NOISE = (0.01, 0.06)
_FREE = (10.0, 3.0)
_TIMES_FELT = 20.0
_RESTING = (1e-3, 3e-4)
_LEAST_CREEP_M = 1e-4
_UNFELT_MPS2 = 0.1


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
    phi, length : (n,), NaN where two pixels have no solution. fine : (n,) pictures that go with their
        neighbours.
    theta : (m,) integrated rate.
    """

    log: int
    camera: EvenTimes
    imu: EvenTimes
    pixels: FloatArray
    readings: FloatArray
    phi: FloatArray
    length: FloatArray
    fine: BoolArray
    theta: FloatArray


@dataclass(frozen=True)
class Correlation:
    """Correlation of the camera's rate of angle with the gyroscope's over the time offset (k,) [s]."""

    offset_s: FloatArray
    value: FloatArray


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


def _cuts(log: AlignLog) -> list[float]:
    """Times at which a log is split."""
    both = np.sort(np.concatenate([log.camera_s, log.imu_s]))
    gaps = np.flatnonzero(np.diff(both) > SPLIT_S)
    return [-math.inf, *(0.5 * (both[i] + both[i + 1]) for i in gaps.tolist()), math.inf]


def _own_angle(view: FloatArray, sensor: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    phi, length = np.full(len(pixels), np.nan), np.full(len(pixels), np.nan)
    at = (0.0, 0.07)
    for n, (u, v) in enumerate(pixels.tolist()):
        for guess in (at, (0.0, 0.07)):
            angle, arc, found = invert_marker(view, sensor, u, v, *guess)
            if found:
                phi[n], length[n] = angle, arc
                at = (angle, arc)
                break
    return phi, length


def _like_neighbours(phi: FloatArray) -> BoolArray:
    """Pictures whose angle is near the median of five."""
    if len(phi) < 5:
        return np.isfinite(phi)
    filled = np.where(np.isfinite(phi), phi, np.nanmedian(phi) if np.isfinite(phi).any() else 0.0)
    padded = np.concatenate([filled[2:0:-1], filled, filled[-2:-4:-1]])
    off = filled - np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    limit = max(6.0 * 1.4826 * float(np.median(np.abs(off))), 0.04)
    return np.asarray(np.isfinite(phi) & (np.abs(off) <= limit))


def _integrated(t: FloatArray, gz: FloatArray) -> FloatArray:
    known = np.isfinite(gz)
    if known.sum() < 2:
        return np.zeros(len(t))
    rate = -np.interp(t, t[known], gz[known])
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t)
    return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]))


def pieces_of(
    logs: Sequence[AlignLog], view: FloatArray, sensor: FloatArray
) -> tuple[list[Piece], list[str]]:
    """Stretches that can be used, and sentences about what was left out.

    Parameters
    ----------
    sensor : (13,) prior of `SENSOR`.
    """
    pieces, said = [], []
    for number, log in enumerate(logs):
        cuts, kept = _cuts(log), 0
        if len(cuts) > 2:
            said.append(f"{log.source}: split at {len(cuts) - 2} gap(s) of more than {SPLIT_S:g} s")
        for begin, end in pairwise(cuts):
            seen = (log.camera_s > begin) & (log.camera_s < end)
            felt = (log.imu_s > begin) & (log.imu_s < end)
            if seen.sum() < _LEAST_PICTURES or felt.sum() < _LEAST_SAMPLES:
                continue
            camera, imu = even_times_of(log.camera_s[seen]), even_times_of(log.imu_s[felt])
            if min(camera.t_s[-1], imu.t_s[-1]) - max(camera.t_s[0], imu.t_s[0]) < SHORTEST_S:
                continue
            pixels, readings = log.pixels[seen], log.readings[felt]
            phi, length = _own_angle(view, sensor, pixels)
            theta = _integrated(imu.t_s, readings[:, 2])
            fine = _like_neighbours(phi)
            pieces.append(Piece(number, camera, imu, pixels, readings, phi, length, fine, theta))
            kept += 1
        if kept == 0:
            said.append(f"{log.source}: has no stretch of {SHORTEST_S:g} s with pictures and IMU samples")
    return pieces, said


def _use(piece: Piece, offset_s: float) -> BoolArray:
    """Pictures that go with their neighbours and were exposed while the IMU ran."""
    exposed = piece.camera.t_s - offset_s
    inside = (exposed >= piece.imu.t_s[0]) & (exposed <= piece.imu.t_s[-1])
    return np.asarray(inside & piece.fine)


def _factor_at(pieces: Sequence[Piece], offset_s: float) -> tuple[float, float, float]:
    """Factor a at this offset, sum of squares with it, and without the gyroscope."""
    cross, own, total = 0.0, 0.0, 0.0
    for piece in pieces:
        use = _use(piece, offset_s)
        if use.sum() < _LEAST_PICTURES:
            continue
        t = piece.camera.t_s[use]
        theta = np.interp(t - offset_s, piece.imu.t_s, piece.theta)
        line = np.stack([np.ones(len(t)), t - t.mean()], axis=1)
        norms = (line * line).sum(axis=0)
        theta = theta - line @ (line.T @ theta / norms)
        phi = piece.phi[use] - line @ (line.T @ piece.phi[use] / norms)
        cross, own, total = cross + float(theta @ phi), own + float(theta @ theta), total + float(phi @ phi)
    factor = cross / own if own > 0.0 else 0.0
    return factor, total - factor * cross, total


def correlation(pieces: Sequence[Piece]) -> Correlation:
    """Correlation of the camera's rate, over four frames, with the gyroscope's over the same time."""
    values = []
    for offset in _OFFSETS_S:
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
    return Correlation(_OFFSETS_S.copy(), np.array(values))


def _check_gyro(pieces: Sequence[Piece], logs: Sequence[AlignLog], factor: float, share: float) -> None:
    if share < 0.5:
        return
    if _TIMES_IN_DEGREES[0] < abs(factor) < _TIMES_IN_DEGREES[1]:
        raise BadInputError(
            f"{logs[pieces[0].log].source}: gz_radps turns {1.0 / abs(factor):.3g} times as fast as the "
            "camera sees, so it is in deg/s, expected rad/s"
        )
    if factor < -0.3:
        raise BadInputError(
            f"{logs[pieces[0].log].source}: gz_radps turns the other way round than the camera sees, "
            "expected minus the rate of phi (a right-handed IMU, its x axis from the head to the base)"
        )


def _spline(
    knots: Knots, values: list[tuple[FloatArray, FloatArray, int, float]], loose: float
) -> FloatArray:
    """Coefficients (count,) by least squares: lists of (times, values, derivative, deviation)."""
    n = 2 * knots.count
    A, B, C = np.zeros((BAND, n)), np.zeros((n, SIZE - 6)), np.zeros((SIZE - 6, SIZE - 6))
    to_c, to_s = np.zeros(n), np.zeros(SIZE - 6)
    middles = knots.middles
    for at, value, derivative, sigma in [*values, (middles, np.zeros(len(middles)), 2, loose)]:
        span, basis = basis_rows(knots, at)
        by = np.zeros((len(at), 1, SIZE))
        by[:, 0, 2 * derivative] = 1.0
        weight = np.full((len(at), 1), 1.0 / sigma**2)
        normal_sums(span, basis, by, weight, A, B, C)
        gathered(span, basis, by, weight * value[:, None], to_c, to_s)
    A[0, 1::2] = 1.0
    A[0, ::2] += 1e-3
    factor = cholesky_banded(A, lower=True)
    return np.asarray(cho_solve_banded((factor, True), to_c))[::2]


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
    return 1.4826 * float(np.median(np.abs(np.diff(values, 4)))) / math.sqrt(70.0)


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
    out[:, 0] = _FREE[0] + _TIMES_FELT * float(np.sqrt(np.mean(bend**2)))
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
    period = piece.imu.period_s if piece.imu.period_s > 0.0 else float(np.median(np.diff(piece.imu.t_s)))
    span = float(np.clip(2.0 * period, 0.005, 0.04))
    knots = Knots.over(first - _MARGIN_S, last + _MARGIN_S, span)
    t = exposed[use]
    known = np.isfinite(piece.readings[:, 2])
    rates = (piece.imu.t_s[known], -piece.readings[known, 2], 1, 0.02)
    phi = _spline(knots, [(t, piece.phi[use], 0, _PHI_SIGMA), rates], 300.0)
    length = _spline(knots, [(t, piece.length[use], 0, 1.5e-3)], 0.5)
    return Stretch(
        piece.log, piece.camera.t_s[inside], piece.pixels[inside], piece.imu.t_s, piece.readings, knots,
        np.stack([phi, length], axis=1), _loose(knots, piece),
    )  # fmt: skip


def _mount(stretches: Sequence[Stretch]) -> float:
    """What atan2(a_y, a_x) reads beyond phi, in the median."""
    offs = []
    for stretch in stretches:
        span, basis = basis_rows(stretch.knots, stretch.imu_s)
        phi = np.einsum("nj,nj->n", basis[:, 0], stretch.start[span[:, None] + np.arange(6), 0])
        off = np.arctan2(stretch.readings[:, 1], stretch.readings[:, 0]) - phi
        offs.append(off[np.isfinite(off)])
    whole = np.concatenate(offs)
    if len(whole) == 0:
        return 0.0
    middle = float(np.angle(np.exp(1j * whole).sum()))
    return middle + float(np.median((whole - middle + math.pi) % (2.0 * math.pi) - math.pi))


def start(pieces: Sequence[Piece], logs: Sequence[AlignLog], usual_offset_s: float) -> Started:
    """First guess of all that the fit needs.

    Raises `BadInputError` for a gyroscope in other units or with another sign.
    """
    found = [_factor_at(pieces, float(offset)) for offset in _OFFSETS_S]
    squares = np.array([entry[1] for entry in found])
    usual = int(np.argmin(np.abs(_OFFSETS_S - usual_offset_s)))
    best = int(np.argmin(squares))
    moves = bool((squares.max() - squares[best]) / _PHI_SIGMA**2 > _WORTH)
    at = best if moves else usual
    factor, left, total = found[at]
    _check_gyro(pieces, logs, factor, 1.0 - left / total if total > 0.0 else 0.0)
    offset = float(_OFFSETS_S[at])
    made = [_stretch(piece, offset) for piece in pieces]
    stretches = tuple(stretch for stretch in made if stretch is not None)
    mount = _mount(stretches) if stretches else 0.0
    return Started(stretches, offset, mount, factor, moves)

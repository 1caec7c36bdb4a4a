"""Gains of the angle filter from logs, tuned on one part and judged on the other.

The judge is a reference angle where the logs have one, and the log's own smoothed angle where they do not
(`calib.imu.smoother`). For Gaussian errors the latter is no makeshift: the expected square of a filter's
error, given the log, is the square of its distance from the smoothed angle plus the smoother's variance,
which no gains change. It holds as far as the smoother's model does, so a log that contradicts the model
has no judge of its own.

A filter runs over each log from its first sample with an empty integral, as firmware does. For the
judgement each half counts as a log of its own, so that both have a bias to learn; it starts at the angle
that it is judged by, as logs start at rest and halves do not. The best gains of the first half are judged
on the second and those of the second on the first: together these errors are the held-out ones of
"tuned". Whether they are less than those of 3/3 is asked of a block bootstrap (`calib.imu.heldout`). Only
a pair that wins with 95 % is recommended; the pair itself is then that of the whole logs.

Of pairs within 3 % of the least error the best damped is taken: a short log does not tell them apart,
and a pair that rings has fitted the log's start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.frontier import damped, gain_grid
from calib.imu.gains import Noise, equivalent_noise, riccati
from calib.imu.heldout import CONFIDENCE, Candidate, Row, compared, rms
from calib.imu.mahony import Mahony, MahonyState
from calib.imu.mahony_batch import advance, filter_log, wrapped
from calib.imu.mahony_kalman import Prior, filter_from_prior
from calib.imu.smoother import BLOCK_S, SHORTEST_S, Smoothed, smooth_log

__all__ = ["THREE", "Piece", "Surface", "Tuning", "tune"]

THREE = Mahony(3.0, 3.0)
_ALIKE = 1.03
_LEAST_JUDGED_S = 8.0
_WORSE = 100.0


@dataclass(frozen=True)
class Piece:
    """A log without long gaps.

    Attributes
    ----------
    t_s, phi_acc_rad, rate_radps : (n,) as of `calib.imu.mahony_batch.filter_log`.
    reference_rad : (n,) the true angle but for a constant, NaN where it is not known; None without one.
    in_plane : False where the rate is known not to be the angle's; the log then cannot judge itself.
    """

    source: str
    t_s: FloatArray
    phi_acc_rad: FloatArray
    rate_radps: FloatArray
    reference_rad: FloatArray | None = None
    in_plane: bool = True


@dataclass(frozen=True)
class Surface:
    """Root mean square error (kp, dampings) on the whole logs over the grid of gains."""

    Kp: FloatArray
    damping: FloatArray
    rmse_rad: FloatArray


@dataclass(frozen=True)
class Tuning:
    """What tuning found.

    Attributes
    ----------
    judge : "reference", "smoothed", or "none" where nothing could be judged.
    candidates : with 3/3 first; without errors (NaN) where nothing could be judged.
    recommended : one of them that has constant gains.
    reasons : why.
    halves : best gains of the first and of the second halves.
    surface : None where nothing could be judged.
    smoothed : of each piece, None where it is too short.
    noise : densities of the sensor with the accelerometer's in motion.
    offset_rad : what was added to each piece's reference.
    judged_s : length of what was judged, `block_s` that of the bootstrap's blocks.
    """

    judge: str
    candidates: tuple[Candidate, ...]
    recommended: Candidate
    reasons: tuple[str, ...]
    halves: tuple[Mahony, Mahony] | None
    surface: Surface | None
    smoothed: tuple[Smoothed | None, ...]
    noise: Noise
    offset_rad: tuple[float, ...]
    judged_s: float
    block_s: float


@njit(cache=True, nogil=True)
def _squares(
    t: FloatArray,
    phi_acc: FloatArray,
    w: FloatArray,
    target: FloatArray,
    start: float,
    gains: FloatArray,
    out: FloatArray,
) -> None:
    """Adds the sums of squared errors to out (gains,); NaN targets do not count."""
    turn = 2.0 * math.pi
    for j in range(len(gains)):
        Kp, Ki = gains[j, 0], gains[j, 1]
        phi, integral, before, total = start, 0.0, t[0], 0.0
        for k in range(len(t)):
            dt = t[k] - before
            before = t[k]
            phi, integral = advance(phi, integral, phi_acc[k], w[k], dt, Kp, Ki)
            d = phi - target[k]
            if d == d:
                d -= turn * np.rint(d / turn)
                total += d * d
        out[j] += total


@dataclass(frozen=True)
class _Judged:
    """Readings with the angle that they are judged by, NaN where they are not, and the filter's start."""

    t_s: FloatArray
    phi_acc_rad: FloatArray
    rate_radps: FloatArray
    target: FloatArray
    start: MahonyState

    def halves(self) -> tuple[_Judged, _Judged]:
        """Two logs, each with half of what is judged."""
        known = np.flatnonzero(np.isfinite(self.target))
        m = int(known[len(known) // 2])
        return self._part(slice(0, m)), self._part(slice(m, None))

    def _part(self, rows: slice) -> _Judged:
        target = self.target[rows]
        first = float(target[0]) if math.isfinite(target[0]) else float(self.phi_acc_rad[rows][0])
        return _Judged(
            self.t_s[rows], self.phi_acc_rad[rows], self.rate_radps[rows], target, MahonyState(first)
        )


def _sums(judged: Sequence[_Judged], gains: Sequence[Mahony]) -> FloatArray:
    pairs = np.array([(g.Kp, g.Ki) for g in gains])
    out = np.zeros(len(gains))
    for one in judged:
        _squares(one.t_s, one.phi_acc_rad, one.rate_radps, one.target, one.start.phi_rad, pairs, out)
    return np.where(np.isfinite(out), out, np.inf)


def _pick(gains: Sequence[Mahony], errors: FloatArray) -> Mahony:
    """The best damped of the pairs whose error is nearly the least, up to critical damping."""
    near = np.flatnonzero(errors <= _ALIKE**2 * errors.min()).tolist()
    rank = {k: min(round(gains[k].Kp / (2.0 * math.sqrt(gains[k].Ki)), 3), 1.0) for k in near}
    most = max(rank.values())
    return gains[min((k for k in near if rank[k] == most), key=lambda k: float(errors[k]))]


def _search(judged: Sequence[_Judged], dt_s: float) -> tuple[Mahony, Surface]:
    """Best gains of these logs, and the errors over the grid."""
    K, Z = gain_grid(dt_s)
    tried = [damped(k, z) for k in K.tolist() for z in Z.tolist()]
    sums = _sums(judged, tried)
    count = sum(int(np.isfinite(one.target).sum()) for one in judged)
    surface = Surface(K, Z, np.sqrt(sums / count).reshape(len(K), len(Z)))
    step_k, step_z = float(K[1] / K[0]), float(Z[1] / Z[0])
    for _ in range(3):
        step_k, step_z = math.sqrt(step_k), math.sqrt(step_z)
        at = tried[int(np.argmin(sums))]
        zeta = at.Kp / (2.0 * math.sqrt(at.Ki))
        more = [
            damped(
                float(np.clip(at.Kp * step_k**i, K[0], K[-1])),
                float(np.clip(zeta * step_z**j, Z[0], Z[-1])),
            )
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if (i, j) != (0, 0)
        ]
        tried += more
        sums = np.concatenate([sums, _sums(judged, more)])
    return _pick(tried, sums), surface


def _errors(judged: _Judged, gains: Mahony) -> FloatArray:
    one = judged
    return wrapped(filter_log(gains, one.t_s, one.phi_acc_rad, one.rate_radps, one.start)[0] - one.target)


def _errors_from_prior(judged: _Judged, noise: Noise, prior: Prior) -> FloatArray:
    run = filter_from_prior(noise, prior, judged.t_s, judged.phi_acc_rad, judged.rate_radps, judged.start)
    return wrapped(run.phi_rad - judged.target)


def _smoothed(piece: Piece, sensor: Noise) -> Smoothed | None:
    if piece.t_s[-1] - piece.t_s[0] < SHORTEST_S:
        return None
    return smooth_log(piece.t_s, piece.phi_acc_rad, piece.rate_radps, sensor.gyro, sensor.walk)


def _astray(own: Smoothed, sensor: Noise) -> bool:
    """Whether the smoothed angle is the accelerometer's alone, or the rate worse than any gyroscope's."""
    return own.gyro_noise * BLOCK_S > own.accel_noise or own.gyro_noise > _WORSE * sensor.gyro


def _offset(piece: Piece, smoothed: Smoothed | None) -> float:
    """What brings the reference to the accelerometer's zero: how the sensor is mounted."""
    assert piece.reference_rad is not None
    own = piece.phi_acc_rad if smoothed is None else smoothed.phi_rad
    apart = own - piece.reference_rad
    known = apart[np.isfinite(apart)]
    middle = math.atan2(float(np.sin(known).mean()), float(np.cos(known).mean()))
    return middle + float(wrapped(known - middle).mean())


def tune(pieces: Sequence[Piece], sensor: Noise, prior: Prior | None = None) -> Tuning:
    """Gains for these logs, and whether they are worth more than 3/3.

    Parameters
    ----------
    pieces : logs of the same rate; where one has a reference, only those that have one are judged.
    sensor : densities of the sensor; the accelerometer's is that of a log too short to tell its own.
    prior : of the start in "from a prior".

    Raises `BadInputError` for no logs at all.
    """
    if not pieces:
        raise BadInputError("logs: found none, expected at least one")
    smoothed = tuple(_smoothed(piece, sensor) for piece in pieces)
    spans = [len(piece.t_s) for piece in pieces]
    known = [(n, s.accel_noise) for n, s in zip(spans, smoothed, strict=True) if s is not None]
    accel = sensor.accel
    if known:
        accel = math.sqrt(sum(n * a * a for n, a in known) / sum(n for n, _ in known))
    noise = Noise(sensor.gyro, sensor.walk, accel)
    dt_s = float(np.median([(p.t_s[-1] - p.t_s[0]) / max(len(p.t_s) - 1, 1) for p in pieces]))
    judge = "reference" if any(p.reference_rad is not None for p in pieces) else "smoothed"
    judged, offsets, reasons = [], [], []
    for piece, own in zip(pieces, smoothed, strict=True):
        offset = 0.0
        target: FloatArray | None = None if own is None else own.phi_rad
        if judge == "reference":
            target = None
            if piece.reference_rad is not None and int(np.isfinite(piece.reference_rad).sum()) >= 20:
                offset = _offset(piece, own)
                target = piece.reference_rad + offset
        elif own is not None and not piece.in_plane:
            reasons.append(f"{piece.source}: the sensor tilts out of the plane, so that -gz is not its rate.")
            target = None
        elif own is not None and _astray(own, sensor):
            reasons.append(
                f"{piece.source}: the rate errs by {math.degrees(own.gyro_noise):.2g} deg/s/sqrt(Hz), so "
                "that it is not the rate of the angle, and the log cannot judge itself."
            )
            target = None
        offsets.append(offset)
        if target is not None:
            arrays = (piece.t_s, piece.phi_acc_rad, piece.rate_radps, target)
            t, phi_acc, w, known_angle = (np.ascontiguousarray(x, dtype=np.float64) for x in arrays)
            judged.append(_Judged(t, phi_acc, w, known_angle, MahonyState(float(phi_acc[0]))))
    judged_s = sum(float(np.isfinite(one.target).sum()) for one in judged) * dt_s
    if judged_s < _LEAST_JUDGED_S:
        reasons.append(
            f"There are {judged_s:.3g} s to judge gains by, expected at least {_LEAST_JUDGED_S:g} s: "
            "3/3 is kept."
        )
        nan = math.nan
        unknown = tuple(
            Candidate(name, gains, nan, nan, nan, nan, nan, nan, nan, nan)
            for name, gains in (("3/3", THREE), ("riccati", riccati(noise, dt_s)))
        )
        return Tuning(
            judge="none",
            candidates=unknown,
            recommended=unknown[0],
            reasons=tuple(reasons),
            halves=None,
            surface=None,
            smoothed=smoothed,
            noise=noise,
            offset_rad=tuple(offsets),
            judged_s=judged_s,
            block_s=nan,
        )
    tuned, surface = _search(judged, dt_s)
    firsts, seconds = zip(*(one.halves() for one in judged), strict=True)
    of_first, of_second = _search(firsts, dt_s)[0], _search(seconds, dt_s)[0]
    settled = riccati(noise, dt_s)
    start = prior or Prior()
    parts = [*firsts, *seconds]

    def plain(name: str, gains: Mahony) -> Row:
        whole = rms([_errors(one, gains) for one in judged])
        return Row(name, gains, [_errors(one, gains) for one in parts], whole)

    def started(name: str, gains: Mahony, density: Noise) -> Row:
        whole = rms([_errors_from_prior(one, density, start) for one in judged])
        return Row(name, gains, [_errors_from_prior(one, density, start) for one in parts], whole)

    crossed = [_errors(one, of_second) for one in firsts] + [_errors(one, of_first) for one in seconds]
    candidates, block_s = compared(
        [
            plain("3/3", THREE),
            Row("tuned", tuned, crossed, rms([_errors(one, tuned) for one in judged])),
            plain("riccati", settled),
            started("3/3 from a prior", THREE, equivalent_noise(THREE, accel)),
            started("riccati from a prior", settled, noise),
        ],
        dt_s,
    )
    recommended, why = _recommended(candidates, judge)
    return Tuning(
        judge,
        candidates,
        recommended,
        (*reasons, *why),
        (of_first, of_second),
        surface,
        smoothed,
        noise,
        tuple(offsets),
        judged_s,
        block_s,
    )


def _recommended(candidates: Sequence[Candidate], judge: str) -> tuple[Candidate, tuple[str, ...]]:
    """The first of tuned and riccati that wins, else 3/3, and why."""
    by = "the reference" if judge == "reference" else "the log's own smoothed angle"
    base = candidates[0]
    said: list[str] = []
    for one in candidates[1:3]:
        held = " on parts that it was not tuned on" if one.name == "tuned" else ""
        errors = (
            f"By {by} {one.name} leaves {math.degrees(one.rmse_rad):.3f} deg{held}, 3/3 "
            f"{math.degrees(base.rmse_rad):.3f} deg; it is better with {100.0 * one.confidence:.3g} %"
        )
        if one.wins:
            return one, (*said, f"{errors}, and recommended.")
        said.append(f"{errors}, expected {100.0 * CONFIDENCE:g} %.")
    return base, (*said, "3/3 is kept.")

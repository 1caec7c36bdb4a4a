"""Whether a covariance can be believed: NEES against truth, NIS per sensor, whiteness of innovations.

With an honest covariance e' P^-1 e of n numbers is chi-square with n degrees of freedom, so that its mean
over N independent draws lies in the band of chi2(n N) / N (Bar-Shalom, Li and Kirubarajan 2001, 5.4). Rows
of one log are not independent draws; the bands here are those of white innovations, and for NEES
those of logs. The angle and both lengths are two numbers, phi = (q1 - q2) / (2 r_B), so their NEES is 2.

`Tally` gathers sums, so that a log of any length can be judged in constant memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from calib.core.arrays import FloatArray, robust_sigma
from calib.core.result import finite_or_none
from calib.stages.estimator.kinematic import FLAGS, OUT
from calib.stages.estimator.section import SensorCheck

SENSORS = {"camera": 2, "accel": 2, "gyro": 1}
"""Readings of each sensor at a time."""

_INNOVATIONS = {"camera": ("e_u", "e_v"), "accel": ("e_ax", "e_ay"), "gyro": ("e_gz",)}
SETTLED_S = 2.0
_LEVEL = 0.95
_TOGETHER, _CLIPPED = 6, 6.0
"""Pictures whose innovations are summed up to find a jump, and where each of them is cut."""
_BACK_S, _AROUND, _FOLLOWED, _MOST_JUMPS, _NO_JUMP = 2.0, 25, 2.0, 20, 4.0
"""What jumps back within this time was no camera that moved; pictures whose motion a step stands out of;
innovations are below the third where the filter has followed a jump; jumps that are looked at in a block;
sums that are none."""
_HALF_A_PIXEL, _BEYOND = math.sqrt(3.0), 0.12
"""Half a pixel in the deviations of one that is rounded, and the mean square of what lies beyond from which
on it says something; of white innovations it is 0.03."""


def chi_square_band(degrees: int, draws: int) -> tuple[float, float]:
    """Band in which the mean of `draws` chi-square numbers of `degrees` lies with probability 95 %."""
    from scipy.special import chdtri

    total, tail = degrees * max(draws, 1), 0.5 * (1.0 - _LEVEL)
    return float(chdtri(total, 1.0 - tail)) / max(draws, 1), float(chdtri(total, tail)) / max(draws, 1)


def nees(out: FloatArray, q_m: FloatArray, phi_rad: FloatArray, bellows_radius_m: float) -> FloatArray:
    """NEES (n,) of (q1, q2, phi), two degrees of freedom, of rows of `kinematic.OUT` against the truth.

    Parameters
    ----------
    q_m, phi_rad : (n, 2) and (n,) truth.
    """
    r = bellows_radius_m
    s1, s2, sp = out[:, OUT.index("sigma_q1_m")], out[:, OUT.index("sigma_q2_m")], out[:, 12]
    var_l = np.maximum(0.5 * (s1**2 + s2**2) - (r * sp) ** 2, 1e-18)
    cross = (s1**2 - s2**2) / (4.0 * r)
    e_l = 0.5 * (out[:, 1] + out[:, 2] - q_m[:, 0] - q_m[:, 1])
    e_p = out[:, 5] - phi_rad
    determinant = np.maximum(var_l * sp**2 - cross**2, 1e-12 * var_l * sp**2)
    return np.asarray((sp**2 * e_l**2 - 2.0 * cross * e_l * e_p + var_l * e_p**2) / determinant)


def _back_again(t_s: FloatArray, e: FloatArray, readings: FloatArray, k: int) -> int | None:
    """Index from which on a jump of the readings at `k` is undone; None where it stays, or too few tell.

    They change back then, by half as much or more, and so do the innovations, which alone do when a filter
    follows a jump.
    """
    from scipy.ndimage import median_filter

    first, end = max(k - _TOGETHER, 0), int(np.searchsorted(t_s, t_s[k] + _BACK_S))
    if k - first < 3 or end - k < 3:
        # From three before to three from there on, of pictures that a gap may follow.
        return None
    back = np.ones(end - first - 5, dtype=np.bool_)
    for values in (readings[first:end], e[first:end]):
        # From the mean of three to that of the next three; beside what moves all the time.
        means = np.convolve(values, np.ones(3) / 3, "valid")
        changes = means[3:] - means[:-3]
        changes = changes - median_filter(changes, _AROUND)
        at = changes[k - first - 3]
        back &= changes * at < -0.5 * at**2
    later = np.flatnonzero(back[k - first - 2 :])
    if not len(later):
        return None
    j = k + 1 + int(later[-1])
    while j < len(e) and (e[j : j + 3] * e[k] < -_FOLLOWED * abs(e[k])).any():
        j += 1
    return j


def _add_pairs(sums: FloatArray, e: FloatArray) -> None:
    """Add to sums (2,) the products of each with the one before, and the squares, of e (n + 1,)."""
    sums += (e[1:] * e[:-1]).sum(), (e[1:] ** 2).sum()


@dataclass
class Tally:
    """Sums over the rows of a log, block after block; rows of the first two seconds do not count."""

    bellows_radius_m: float
    rows: int = 0
    start_s: float = math.nan
    end_s: float = math.nan
    scored: int = 0
    sensors: dict[str, FloatArray] = field(
        default_factory=lambda: {name: np.zeros(8) for name in (*SENSORS, "last", "beyond")}
    )
    flags: dict[str, int] = field(default_factory=lambda: dict.fromkeys(FLAGS, 0))
    squares: FloatArray = field(default_factory=lambda: np.zeros(7))
    jump: tuple[float, float] = (0.0, math.nan)
    """Where the pictures jump most, in deviations of what innovations sum up to, and when [s]."""

    def add(
        self, out: FloatArray, truth: FloatArray | None = None, marker_px: FloatArray | None = None
    ) -> None:
        """Rows of `kinematic.OUT`, (n, 3) true q1, q2, phi, NaN where not known, and (n, 2) readings of the
        camera, without which no jump of theirs is looked for.
        """
        if len(out) == 0:
            return
        if self.rows == 0:
            self.start_s = float(out[0, 0])
        self.end_s = float(out[-1, 0])
        self.rows += len(out)
        flags = out[:, OUT.index("flags")].astype(np.int64)
        for name, bit in FLAGS.items():
            self.flags[name] += int(np.count_nonzero(flags & bit))
        late = out[:, 0] >= self.start_s + SETTLED_S
        for name in SENSORS:
            self._add_sensor(name, out[late])
        if marker_px is not None:
            self._add_jump(out[late], marker_px[late])
        if truth is not None:
            self._add_truth(out[late], truth[late])

    def _add_sensor(self, name: str, out: FloatArray) -> None:
        gated = out[:, OUT.index(f"gated_{name}")]
        used = gated == 0.0
        sums, last = self.sensors[name], self.sensors["last"]
        sums[1] += int(np.count_nonzero(gated == 1.0))
        nis = out[used, OUT.index(f"nis_{name}")]
        if len(nis) == 0:
            return
        low, high = chi_square_band(SENSORS[name], 1)
        sums[0] += len(nis)
        sums[2] += float(nis.sum())
        sums[3] += int(np.count_nonzero((nis >= low) & (nis <= high)))
        for k, column in enumerate(_INNOVATIONS[name]):
            place = list(SENSORS).index(name) * 2 + k
            e = np.concatenate([[last[place]], out[used, OUT.index(column)]])
            _add_pairs(sums[4 + 2 * k : 6 + 2 * k], e)
            if name == "camera":
                beyond = np.sign(e) * np.maximum(np.abs(e) - _HALF_A_PIXEL, 0.0)
                _add_pairs(self.sensors["beyond"][2 * k : 2 * k + 2], beyond)
            last[place] = e[-1]

    def repeating(self) -> float:
        """How much innovations of whole pixels repeat beyond half of one: the larger correlation of u and v.

        A marker at rest has the same error again and again, of half a pixel at most.
        """
        least, count = _BEYOND * self.sensors["camera"][0], self.sensors["beyond"]
        return max((float(count[k] / count[k + 1]) for k in (0, 2) if count[k + 1] > least), default=0.0)

    def _add_jump(self, out: FloatArray, marker_px: FloatArray) -> None:
        """Innovations of a camera that was moved are alike until the filter has followed it.

        With those that were gated out, and over what such sums are in this log, which wrong constants raise.
        A reflection that is taken for the marker for a while is none: the pictures jump back.
        """
        seen = np.isfinite(out[:, OUT.index("gated_camera")])
        if np.count_nonzero(seen) < 10 * _TOGETHER:
            return
        t_s = out[seen, 0]
        for column, readings in zip(_INNOVATIONS["camera"], marker_px[seen].T, strict=True):
            e = np.nan_to_num(out[seen, OUT.index(column)])
            for _ in range(_MOST_JUMPS):
                sums = np.convolve(np.clip(e, -_CLIPPED, _CLIPPED), np.ones(_TOGETHER), "valid")
                size = np.abs(sums) / max(robust_sigma(sums), math.sqrt(_TOGETHER))
                k = int(np.argmax(size))
                if size[k] <= max(self.jump[0], _NO_JUMP):
                    break
                back = _back_again(t_s, e, readings, k)
                if back is None:
                    self.jump = float(size[k]), float(t_s[k])
                    break
                e[k:back] = 0.0

    def _add_truth(self, out: FloatArray, truth: FloatArray) -> None:
        known = np.isfinite(truth).all(axis=1)
        out, truth = out[known], truth[known]
        if len(out) == 0:
            return
        self.scored += len(out)
        self.squares[:3] += ((out[:, [1, 2, 5]] - truth) ** 2).sum(axis=0)
        self.squares[3] += nees(out, truth[:, :2], truth[:, 2], self.bellows_radius_m).sum()
        self.squares[4:] += (out[:, 10:13] ** 2).sum(axis=0)

    def rmse(self) -> dict[str, float]:
        """Errors against the truth, empty without one: q1, q2, their mean [mm], phi [deg], NEES."""
        if self.scored == 0:
            return {}
        mean = self.squares / self.scored
        q1, q2 = 1e3 * math.sqrt(mean[0]), 1e3 * math.sqrt(mean[1])
        return {
            "q1_mm": q1,
            "q2_mm": q2,
            "mean_q_mm": 0.5 * (q1 + q2),
            "phi_deg": math.degrees(math.sqrt(mean[2])),
            "nees": float(mean[3]),
            "sigma_q1_mm": 1e3 * math.sqrt(mean[4]),
            "sigma_q2_mm": 1e3 * math.sqrt(mean[5]),
            "sigma_phi_deg": math.degrees(math.sqrt(mean[6])),
        }

    def check(self, name: str) -> SensorCheck | None:
        """What a sensor's innovations say, None where it had no reading after the first two seconds."""
        sums, degrees = self.sensors[name], SENSORS[name]
        count, gated = int(sums[0]), int(sums[1])
        if count == 0:
            return SensorCheck(degrees=degrees, readings=0, gated=gated) if gated else None
        low, high = chi_square_band(degrees, count)
        correlations = [
            sums[4 + 2 * k] / sums[5 + 2 * k] if sums[5 + 2 * k] > 0.0 else 0.0 for k in range(degrees)
        ]
        return SensorCheck(
            degrees=degrees,
            readings=count,
            gated=gated,
            nis=finite_or_none(sums[2] / count),
            low=low,
            high=high,
            inside=float(sums[3] / count),
            correlation=finite_or_none(max(correlations, key=abs)),
            correlation_bound=1.96 / math.sqrt(max(count, 1)),
        )

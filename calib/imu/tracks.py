"""The angle in the plane by each way of getting it, over a log: what `calib.imu.drift` compares.

Every method runs over each part of a log that has no long gap. Ours begin with the accelerometer's mean
angle over the part's first half second, less what the gyroscope turned in it. Filters by others work in
three dimensions; the angle is that of their up vector in the sensor's axes, atan2(uy, ux).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.errors import pip_install
from calib.imu.mahony import Mahony, MahonyState
from calib.imu.mahony_batch import accelerometer_angles, filter_log
from calib.imu.orientation import up_in_sensor
from calib.imu.peers import MOST_SAMPLES, PEERS, missing, run_peer
from calib.imu.rate import planar_rate, up_vector
from calib.imu.sampling import Part

_START_S = 0.5
_THREE = ("gx", "gy", "gz", "ax", "ay", "az")


@dataclass(frozen=True)
class DriftLog:
    """Readings of a log, at rest or in motion.

    Attributes
    ----------
    source : name for messages.
    axes : those of `calib.imu.static.AXES` that it has; gz, ax and ay among them.
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings, rad/s and m/s^2.
    onchip_t_s, onchip_phi_rad : (k,) the chip's own angle, empty where it is not logged.
    true_t_s, true_phi_rad : (m,) the true angle, likewise.
    """

    source: str
    axes: tuple[str, ...]
    t_s: FloatArray
    values: FloatArray
    onchip_t_s: FloatArray
    onchip_phi_rad: FloatArray
    true_t_s: FloatArray
    true_phi_rad: FloatArray


@dataclass(frozen=True)
class Track:
    """Angles of one method in each part (n_i,) [rad], not wrapped."""

    name: str
    phi_rad: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Tuned:
    """Gains of the row "MM tuned", and whether its rate is that by the up vector instead of -gz."""

    gains: Mahony
    up_vector: bool = False


def mean_angle(angles: FloatArray) -> float:
    """Direction of the mean of unit vectors at the angles (n,) [rad]."""
    return math.atan2(float(np.sin(angles).mean()), float(np.cos(angles).mean()))


def _start(phi_acc: FloatArray, rate_radps: FloatArray, period_s: float) -> float:
    """Angle at the first sample, by the accelerometer over half a second less what it turned since."""
    size = max(round(_START_S / period_s), 1)
    rate = rate_radps[:size].copy()
    rate[0] = 0.0
    return mean_angle(phi_acc[:size] - period_s * np.cumsum(rate))


def on_grid(
    t_s: FloatArray, phi_rad: FloatArray, parts: Sequence[Part], period_s: float
) -> tuple[FloatArray, ...]:
    """Samples of an angle at the even grid's times, NaN before the first, after the last and in gaps."""
    out = []
    whole = np.unwrap(phi_rad)
    widest = 5.0 * max(float(np.median(np.diff(t_s))), period_s)
    for part in parts:
        at = part.start_s + period_s * np.arange(len(part.values))
        phi = np.interp(at, t_s, whole)
        after = np.clip(np.searchsorted(t_s, at), 1, len(t_s) - 1)
        far = (t_s[after] - t_s[after - 1] > widest) & (at > t_s[after - 1]) & (at < t_s[after])
        outside = (at < t_s[0] - 1.5 * period_s) | (at > t_s[-1] + 1.5 * period_s)
        out.append(np.where(far | outside, np.nan, phi))
    return tuple(out)


class _Runner:
    """Runs the methods over the parts of one log."""

    def __init__(self, log: DriftLog, parts: Sequence[Part], period_s: float) -> None:
        self.log, self.parts, self.period_s = log, parts, period_s
        self.samples = sum(len(part.values) for part in parts)
        self.column = {axis: k for k, axis in enumerate(log.axes)}
        self.phi_acc = tuple(accelerometer_angles(self._of(p, "ax"), self._of(p, "ay")) for p in parts)
        self.lacking = tuple(axis for axis in _THREE if axis not in log.axes)

    def _of(self, part: Part, axis: str) -> FloatArray:
        return np.ascontiguousarray(part.values[:, self.column[axis]])

    def three(self, part: Part) -> tuple[FloatArray, FloatArray]:
        """Rates and specific forces (n, 3)."""
        columns = [np.ascontiguousarray(part.values[:, [self.column[k + x] for x in "xyz"]]) for k in "ga"]
        return columns[0], columns[1]

    def gyroscope(self) -> tuple[FloatArray, ...]:
        """-gz summed up: the rate of a sample holds for the step before it, as in (2.3c)."""
        out = []
        for part, phi_acc in zip(self.parts, self.phi_acc, strict=True):
            rate = np.negative(self._of(part, "gz"))
            start = _start(phi_acc, rate, self.period_s)
            rate[0] = 0.0
            out.append(start + self.period_s * np.cumsum(rate))
        return tuple(out)

    def accelerometer(self) -> tuple[FloatArray, ...]:
        return tuple(np.unwrap(phi) for phi in self.phi_acc)

    def mahony(self, gains: Mahony, tilted: bool = False) -> tuple[FloatArray, ...]:
        out = []
        for part, phi_acc in zip(self.parts, self.phi_acc, strict=True):
            rate: FloatArray = np.negative(self._of(part, "gz"))
            if tilted:
                gyro, force = self.three(part)
                rate = planar_rate(gyro, up_vector(force, gyro, self.period_s))
            t = self.period_s * np.arange(len(rate), dtype=np.float64)
            start = MahonyState(_start(phi_acc, rate, self.period_s))
            out.append(filter_log(gains, t, phi_acc, rate, start)[0])
        return tuple(out)

    def peer(self, name: str) -> tuple[FloatArray, ...]:
        out = []
        for part in self.parts:
            gyro, force = self.three(part)
            up = up_in_sensor(run_peer(name, gyro, force, self.period_s))
            out.append(np.unwrap(np.arctan2(up[:, 1], up[:, 0])))
        return tuple(out)


def tracks_of(
    log: DriftLog,
    parts: Sequence[Part],
    period_s: float,
    tuned: Tuned | None = None,
    peers: bool = True,
    told: Callable[[str], None] = lambda sentence: None,
) -> tuple[list[Track], list[str]]:
    """The methods' angles on one log, and sentences about methods that were left out.

    Parameters
    ----------
    parts : of the log on an even grid of this period, each at least two samples long.
    tuned : what the row "MM tuned" is made with, left out without.
    peers : run the filters of others that are installed.
    told : is called with a sentence before what may take long.
    """
    runner = _Runner(log, parts, period_s)
    skipped, found = [], []
    if len(log.onchip_t_s) >= 2:
        chip = on_grid(log.onchip_t_s, log.onchip_phi_rad, runner.parts, runner.period_s)
        found.append(Track("on the chip", chip))
    else:
        skipped.append("on the chip: the log has no column onchip_phi_rad")
    found.append(Track("gyroscope alone", runner.gyroscope()))
    found.append(Track("accelerometer alone", runner.accelerometer()))
    found.append(Track("MM 3/3", runner.mahony(Mahony())))
    if tuned is None:
        skipped.append("MM tuned: the rig's file has no section orientation_filter")
    elif tuned.up_vector and runner.lacking:
        skipped.append("MM tuned: it was tuned with the up vector, which needs three axes of both sensors")
    else:
        found.append(Track("MM tuned", runner.mahony(tuned.gains, tuned.up_vector)))
    if runner.lacking:
        which = ", ".join(runner.lacking)
        skipped.append(f"MM 3/3 with up vector, peers: these need three axes, and {which} is not in the log")
        return found, skipped
    found.append(Track("MM 3/3 with up vector", runner.mahony(Mahony(), tilted=True)))
    for name in (name for name in PEERS if name != "VQF offline") if peers else ():
        if package := missing(name):
            skipped.append(f"{name}: the package {package} is not installed: {pip_install('peers')}")
        elif runner.samples > MOST_SAMPLES.get(name, runner.samples):
            skipped.append(
                f"{name}: its loop is too slow for {runner.samples} samples, at most "
                f"{MOST_SAMPLES[name]} are given to it"
            )
        else:
            told(f"{log.source}: running {name}")
            found.append(Track(name, runner.peer(name)))
    return found, skipped

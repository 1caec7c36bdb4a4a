"""Every way of getting the angle from an IMU's log, ours and the peers'."""

from __future__ import annotations

import importlib
import importlib.util
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from calib.core.arrays import BoolArray, FloatArray
from calib.core.errors import BadInputError, pip_install
from calib.core.verdict import Finding
from calib.solve.clock import Part
from calib.stages.imu.levelling import Levelling, level_three
from calib.stages.imu.mahony import Mahony, MahonyState, accelerometer_angles
from calib.stages.imu.tuning import AngleFilter, run_filter

# ----------------------------------------------------------------------
# How far an estimated orientation is from a true one, as BROAD counts it.
#
# Quaternions (n, 4) are w, x, y, z and turn sensor into world, whose z axis points up. The error
# e = q_true conj(q_estimate) is seen in the world frame. Split there into a turn about a horizontal axis
# and one about the vertical,
#
#     inclination = 2 atan2(|(x, y)|, |(w, z)|),   heading = 2 atan2(|z|, |w|),
#
# so that the first is the angle between the two up vectors and the second is what gravity cannot show.
# Without a magnetometer only the inclination is judged. (Laidig, Caruso, Cereatti, Seel: BROAD, Data
# 6(7):72, 2021, section 4.) The arc tangents equal the arc cosines given there and keep their digits near
# zero.


def _checked(q: FloatArray) -> FloatArray:
    if q.ndim != 2 or q.shape[1] != 4:
        raise BadInputError(f"quaternions: found an array {q.shape}, expected (n, 4)")
    return q


def product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Hamilton's product (n, 4) of quaternions p and q, each (n, 4).

    Raises `BadInputError` for other shapes.
    """
    w, x, y, z = _checked(p).T
    a, b, c, d = _checked(q).T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )


def conjugate(q: FloatArray) -> FloatArray:
    """The opposite turns (n, 4) of unit quaternions."""
    return np.asarray(_checked(q) * np.array([1.0, -1.0, -1.0, -1.0]))


def up_in_sensor(q: FloatArray) -> FloatArray:
    """The world's up vector (n, 3) in the sensor's axes: what an accelerometer at rest feels, over g."""
    w, x, y, z = _checked(q).T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


def _error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    if len(estimate) != len(truth):
        raise BadInputError(
            f"orientations: found {len(estimate)} estimates and {len(truth)} true ones, expected as many"
        )
    return np.asarray(np.abs(product(truth, conjugate(estimate))))


def inclination_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Angle (n,) [rad] between the up vectors, 0 to pi; NaN where either is NaN."""
    w, x, y, z = _error(estimate, truth).T
    return np.asarray(2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)))


def rms_in_motion(error_rad: FloatArray, moving: BoolArray) -> float:
    """Root mean square of the errors (n,) where it moves and the truth is known, NaN for none."""
    counted = error_rad[moving & np.isfinite(error_rad)]
    return math.sqrt(float(np.mean(counted**2))) if len(counted) else math.nan


# ----------------------------------------------------------------------
# The rate of the angle in the plane of a sensor that is not exactly in plane.
#
# The angle is phi = atan2(uy, ux) with u the up vector in the sensor's axes, which an accelerometer at rest
# measures (2.1). The vertical stands still in the world, so in the sensor, which turns at w = (gx, gy, gz),
#
#     du/dt = u x w,   that is   dux/dt = uy gz - uz gy,   duy/dt = uz gx - ux gz,
#
# and with s = ux^2 + uy^2
#
#     dphi/dt = (ux duy/dt - uy dux/dt) / s = -gz + uz (gx ux + gy uy) / s.
#
# In plane uz is zero and the rate is -gz. Out of plane the other two axes count, and the more the smaller
# s is; where s is zero the angle itself is not defined. Below `LEAST` s is therefore held there, which
# takes the second term to zero with ux and uy instead of to infinity.
#
# The up vector must not follow the sensor's own acceleration, and not lag behind its turning either. So
# the specific force is turned into a frame that follows the gyroscope alone, where gravity stands still
# but for the gyroscope's bias, is low-passed there, and turned back (Laidig and Seel: VQF, Information
# Fusion 91, 2023, section 3.2). The low-pass is a Butterworth filter of order two at sqrt(2) / (2 pi tau)
# Hz, 0.075 Hz for tau = 3 s: of a swing at 4 Hz it lets 1 / 2800 through. Until tau has passed it is the
# mean so far. Of a gyro bias b the up vector is left b tau behind, 0.9 degrees at 0.3 degrees/s.
#
# A bias of gx and gy reaches the rate by the factor |uz| / sqrt(s), which is small for a sensor that is
# nearly in plane: only gz has to be as well calibrated as without the second term.

LEAST = 0.01
"""s below which the angle counts as undefined: the sensor's plane is within 6 degrees of level."""

TAU_S = 3.0


def _three(name: str, values: FloatArray) -> FloatArray:
    if values.ndim != 2 or values.shape[1] != 3:
        raise BadInputError(f"{name}: found an array {values.shape}, expected (n, 3)")
    return np.ascontiguousarray(values, dtype=np.float64)


def planar_rate(gyro_radps: FloatArray, up: FloatArray, least: float = LEAST) -> FloatArray:
    """Rate (n,) [rad/s] of atan2(uy, ux), exact where ux^2 + uy^2 is at least `least`.

    Parameters
    ----------
    gyro_radps : (n, 3) rates about the sensor's axes.
    up : (n, 3) unit up vectors in the sensor's axes, as from `up_vector`.

    Raises
    ------
    BadInputError for other shapes and for `least` that is not positive.
    """
    if not least > 0.0:
        raise BadInputError(f"least ux^2 + uy^2: found {least:g}, expected more than zero")
    gx, gy, gz = _three("rates", gyro_radps).T
    ux, uy, uz = _three("up vectors", up).T
    if len(gx) != len(ux):
        raise BadInputError(f"found {len(gx)} rates and {len(ux)} up vectors, expected as many of each")
    return np.asarray(-gz + uz * (gx * ux + gy * uy) / np.maximum(ux * ux + uy * uy, least))


def in_plane(up: FloatArray, least: float = 0.5) -> BoolArray:
    """Where (n,) ux^2 + uy^2 is at least `least`: 0.5 is a tilt of the plane by up to 45 degrees."""
    ux, uy, _ = _three("up vectors", up).T
    return np.asarray(ux * ux + uy * uy >= least)


@njit(cache=True, nogil=True)
def _follow(
    force: FloatArray,
    gyro: FloatArray,
    period: float,
    b: FloatArray,
    a: FloatArray,
    settle: int,
    out: FloatArray,
) -> None:
    """Fills `out` with unit up vectors; the frame's quaternion is q = (w, x, y, z)."""
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    mean = np.zeros(3)
    first, second, still = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(len(force)):
        if k > 0:
            # Rates are taken as straight between the samples.
            rx = 0.5 * (gyro[k, 0] + gyro[k - 1, 0]) * period
            ry = 0.5 * (gyro[k, 1] + gyro[k - 1, 1]) * period
            rz = 0.5 * (gyro[k, 2] + gyro[k - 1, 2]) * period
            turn = math.sqrt(rx * rx + ry * ry + rz * rz)
            c = math.cos(0.5 * turn)
            s = 0.5 if turn < 1e-9 else math.sin(0.5 * turn) / turn
            i, j, m = s * rx, s * ry, s * rz
            w, x, y, z = (
                w * c - x * i - y * j - z * m,
                w * i + x * c + y * m - z * j,
                w * j - x * m + y * c + z * i,
                w * m + x * j - y * i + z * c,
            )
            n = math.sqrt(w * w + x * x + y * y + z * z)
            w, x, y, z = w / n, x / n, y / n, z / n
        R = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
        for axis in range(3):
            row = R[axis]
            f = row[0] * force[k, 0] + row[1] * force[k, 1] + row[2] * force[k, 2]
            if k < settle:
                mean[axis] += (f - mean[axis]) / (k + 1)
                still[axis] = mean[axis]
                # The state in which the low-pass has always seen this mean.
                first[axis] = (1.0 - b[0]) * mean[axis]
                second[axis] = (b[2] - a[2]) * mean[axis]
            else:
                value = b[0] * f + first[axis]
                first[axis] = b[1] * f - a[1] * value + second[axis]
                second[axis] = b[2] * f - a[2] * value
                still[axis] = value
        length = math.sqrt(still[0] ** 2 + still[1] ** 2 + still[2] ** 2)
        for axis in range(3):
            value = R[0][axis] * still[0] + R[1][axis] * still[1] + R[2][axis] * still[2]
            out[k, axis] = value / length if length > 0.0 else 0.0


def up_vector(
    force_mps2: FloatArray, gyro_radps: FloatArray, period_s: float, tau_s: float = TAU_S
) -> FloatArray:
    """Unit up vectors (n, 3) in the sensor's axes, from samples up to each; zeros without any force.

    Parameters
    ----------
    force_mps2, gyro_radps : (n, 3) finite readings on an even grid.
    period_s : of the grid.
    tau_s : time constant of the low-pass, at least one period.

    Raises
    ------
    BadInputError for other shapes, values that are not finite, and times that make no filter.
    """
    force, gyro = _three("specific forces", force_mps2), _three("rates", gyro_radps)
    if len(force) != len(gyro):
        raise BadInputError(f"found {len(force)} specific forces and {len(gyro)} rates, expected as many")
    if not 0.0 < period_s <= tau_s < math.inf:
        raise BadInputError(
            f"up vector: found a period of {period_s:g} s and a time constant of {tau_s:g} s, expected "
            "0 < period <= time constant"
        )
    if not (np.isfinite(force).all() and np.isfinite(gyro).all()):
        raise BadInputError("up vector: a reading is not finite, expected numbers")
    cutoff = min(math.sqrt(2.0) / (2.0 * math.pi * tau_s), 0.45 / period_s)
    from scipy.signal import butter

    b, a = butter(2, cutoff, fs=1.0 / period_s)
    out = np.empty_like(force)
    settle = max(round(tau_s / period_s), 1)
    _follow(force, gyro, period_s, np.asarray(b), np.asarray(a), settle, out)
    return out


# ----------------------------------------------------------------------
# Orientation filters by others, run on the same log: the optional packages ahrs, imufusion and vqf.
#
# Each takes three axes of both sensors and gives quaternions w, x, y, z from sensor to a world whose z axis
# points up. All run with their authors' defaults and without a magnetometer. None is needed by anything
# else here; what is not installed is named by `missing`.

_G = 9.80665

MOST_SAMPLES = {"Mahony": 300_000, "Madgwick": 300_000, "imufusion": 10_000_000}
"""Longest logs for peers whose loop is in Python; the first two take a minute for that."""


def _mahony(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    filters: Any = importlib.import_module("ahrs.filters")
    return np.asarray(filters.Mahony(gyr=gyro, acc=force, frequency=1.0 / period_s, k_P=1.0, k_I=0.3).Q)


def _madgwick(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    filters: Any = importlib.import_module("ahrs.filters")
    return np.asarray(filters.Madgwick(gyr=gyro, acc=force, frequency=1.0 / period_s).Q)


def _imufusion(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    fusion: Any = importlib.import_module("imufusion")
    settings = fusion.AhrsSettings()
    settings.sample_rate = 1.0 / period_s
    settings.convention = fusion.CONVENTION_ENU
    filter_ = fusion.Ahrs()
    filter_.set_settings(settings)
    degps, g = np.degrees(gyro), force / _G
    out = np.empty((len(gyro), 4))
    for k in range(len(gyro)):
        filter_.update_no_magnetometer(degps[k], g[k])
        out[k] = filter_.get_quaternion()
    return out


def _vqf(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    vqf: Any = importlib.import_module("vqf")
    return np.asarray(vqf.VQF(period_s).updateBatch(gyro, force)["quat6D"])


def _vqf_offline(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    vqf: Any = importlib.import_module("vqf")
    return np.asarray(vqf.offlineVQF(gyro, force, None, period_s)["quat6D"])


_RUNS: dict[str, tuple[str, Callable[[FloatArray, FloatArray, float], FloatArray]]] = {
    "Mahony": ("ahrs", _mahony),
    "Madgwick": ("ahrs", _madgwick),
    "imufusion": ("imufusion", _imufusion),
    "VQF": ("vqf", _vqf),
    "VQF offline": ("vqf", _vqf_offline),
}

PEERS = tuple(_RUNS)
"""In the order of tables. Mahony has Kp 1 and Ki 0.3, Madgwick 0.033, imufusion 0.5; the last looks ahead."""


def missing(name: str) -> str:
    """The package that a peer needs and that is not installed, or nothing.

    Raises `BadInputError` for a name that is none of `PEERS`.
    """
    if name not in _RUNS:
        raise BadInputError(f"peer: found {name!r}, expected one of {', '.join(PEERS)}")
    package = _RUNS[name][0]
    return "" if importlib.util.find_spec(package) is not None else package


def run_peer(name: str, gyro_radps: FloatArray, force_mps2: FloatArray, period_s: float) -> FloatArray:
    """Quaternions (n, 4) of a peer after each sample of an even grid.

    Parameters
    ----------
    gyro_radps, force_mps2 : (n, 3) finite readings.

    Raises
    ------
    BadInputError for an unknown name, a package that is not installed, and readings of another shape.
    """
    if package := missing(name):
        raise BadInputError(f"{name}: needs the package {package}: {pip_install('peers')}")
    for what, values in (("rates", gyro_radps), ("specific forces", force_mps2)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) != len(gyro_radps) or len(values) == 0:
            raise BadInputError(f"{name}: found {what} {values.shape}, expected (n, 3)")
    if not 0.0 < period_s < math.inf:
        raise BadInputError(f"{name}: found a period of {period_s:g} s, expected more than zero")
    gyro = np.ascontiguousarray(gyro_radps, dtype=np.float64)
    force = np.ascontiguousarray(force_mps2, dtype=np.float64)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return _RUNS[name][1](gyro, force, period_s)


# ----------------------------------------------------------------------
# The angle in the plane by each way of getting it, over a log: what `calib.stages.imu.drift` compares.
#
# Every method runs over each part of a log that has no long gap. Ours begin with the accelerometer's mean
# angle over the part's first half second, less what the gyroscope turned in it. Filters by others work in
# three dimensions; the angle is that of their up vector in the sensor's axes, atan2(uy, ux).

_START_S = 0.5
_THREE = ("gx", "gy", "gz", "ax", "ay", "az")


@dataclass(frozen=True)
class DriftLog:
    """Readings of a log, at rest or in motion.

    Attributes
    ----------
    source : name for messages.
    axes : those of `calib.stages.imu.static.AXES` that it has; gz, ax and ay among them.
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings, rad/s and m/s^2.
    onchip_t_s, onchip_phi_rad : (k,) the chip's own angle, empty where it is not logged.
    true_t_s, true_phi_rad : (m,) the true angle, likewise.
    repeated_rows : that were written twice and are left out. findings : on the sensors.
    """

    source: str
    axes: tuple[str, ...]
    t_s: FloatArray
    values: FloatArray
    onchip_t_s: FloatArray
    onchip_phi_rad: FloatArray
    true_t_s: FloatArray
    true_phi_rad: FloatArray
    repeated_rows: int = 0
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Track:
    """Angles of one method in each part (n_i,) [rad], not wrapped."""

    name: str
    phi_rad: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Tuned:
    """The filter of the row "tuned", and whether its rate is that by the up vector instead of -gz."""

    gains: AngleFilter
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
    """Samples of an angle at the parts' times, NaN before the first, after the last and in gaps."""
    out = []
    whole = np.unwrap(phi_rad)
    widest = 5.0 * max(float(np.median(np.diff(t_s))), period_s)
    for part in parts:
        at = part.t_s
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
            out.append(start + np.cumsum(rate * np.diff(part.t_s, prepend=part.t_s[0])))
        return tuple(out)

    def accelerometer(self) -> tuple[FloatArray, ...]:
        return tuple(np.unwrap(phi) for phi in self.phi_acc)

    def planar(self, gains: AngleFilter, tilted: bool = False) -> tuple[FloatArray, ...]:
        out = []
        for part, phi_acc in zip(self.parts, self.phi_acc, strict=True):
            rate: FloatArray = np.negative(self._of(part, "gz"))
            if tilted:
                gyro, force = self.three(part)
                rate = planar_rate(gyro, up_vector(force, gyro, self.period_s))
            start = MahonyState(_start(phi_acc, rate, self.period_s))
            out.append(run_filter(gains, part.t_s, phi_acc, rate, start))
        return tuple(out)

    def levelling(self) -> tuple[FloatArray, ...]:
        """In three axes."""
        out = []
        for part in self.parts:
            gyro, force = self.three(part)
            up = level_three(Levelling(), part.t_s, force, gyro)
            out.append(np.unwrap(np.arctan2(up[:, 1], up[:, 0])))
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
    parts : of the log at even steps of this period, each at least two samples long.
    tuned : what the row "tuned" is made with, left out without.
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
    found.append(Track("MM 3/3", runner.planar(Mahony())))
    found.append(Track("levelling", runner.planar(Levelling())))
    if tuned is None:
        skipped.append("tuned: the rig's file has no section orientation_filter")
    elif tuned.up_vector and runner.lacking:
        skipped.append("tuned: it was tuned with the up vector, which needs three axes of both sensors")
    else:
        found.append(Track("tuned", runner.planar(tuned.gains, tuned.up_vector)))
    if runner.lacking:
        which = ", ".join(runner.lacking)
        skipped.append(
            f"MM 3/3 with up vector, levelling in three axes, peers: these need three axes, and {which} is "
            "not in the log"
        )
        return found, skipped
    found.append(Track("MM 3/3 with up vector", runner.planar(Mahony(), tilted=True)))
    found.append(Track("levelling in three axes", runner.levelling()))
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

"""Every way of getting the angle from an IMU's log, ours and the peers'."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import pip_install
from calib.core.units import GRAVITY_MPS2
from calib.solve.clock import Part
from calib.stages.imu import mahony
from calib.stages.imu.levelling import Levelling, level_three
from calib.stages.imu.sampling import AXES, Readings

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
# The up vector is that of the levelling filter in three axes (`calib.stages.imu.levelling`): it must not
# follow the sensor's own acceleration, and not lag behind its turning either.
#
# A bias of gx and gy reaches the rate by the factor |uz| / sqrt(s), which is small for a sensor that is
# nearly in plane: only gz has to be as well calibrated as without the second term.

LEAST = 0.01
"""s below which the angle counts as undefined: the sensor's plane is within 6 degrees of level."""


def planar_rate(gyro_radps: FloatArray, up: FloatArray) -> FloatArray:
    """Rate (n,) [rad/s] of atan2(uy, ux), exact where ux^2 + uy^2 is at least `LEAST`.

    Parameters
    ----------
    gyro_radps : (n, 3) rates about the sensor's axes.
    up : (n, 3) up vectors in the sensor's axes, of length about one.
    """
    gx, gy, gz = gyro_radps.T
    ux, uy, uz = up.T
    return np.asarray(-gz + uz * (gx * ux + gy * uy) / np.maximum(ux * ux + uy * uy, LEAST))


def rate_of(part: Part, axes: tuple[str, ...], tilted: bool) -> FloatArray:
    """Rate (n,) [rad/s] of the angle: -gz, or for a tilted sensor with six axes that of its up vector."""
    if not tilted:
        return np.negative(part.values[:, axes.index("gz")])
    gyro, force = three(part, axes)
    return planar_rate(gyro, level_three(Levelling(), part.t_s, force, gyro))


def three(part: Part, axes: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Rates and specific forces (n, 3) of a part that has all six axes."""
    values = part.values[:, [axes.index(axis) for axis in AXES]]
    return np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:])


def angle_of(part: Part, axes: tuple[str, ...]) -> FloatArray:
    """Accelerometer's angle (n,) (2.1)."""
    return mahony.accelerometer_angles(part.values[:, axes.index("ax")], part.values[:, axes.index("ay")])


# ----------------------------------------------------------------------
# Orientation filters by others, run on the same log: the optional packages ahrs, imufusion and vqf.
#
# Each takes three axes of both sensors and gives quaternions w, x, y, z from sensor to a world whose z axis
# points up. All run with their authors' defaults and without a magnetometer. None is needed by anything
# else here; what is not installed is named by `missing`.

MOST_SAMPLES = {"Mahony": 300_000, "Madgwick": 300_000, "imufusion": 10_000_000}
"""Longest logs for peers whose loop is in Python; the first two take a minute for that."""


def _ahrs(name: str, gyro: FloatArray, force: FloatArray, period_s: float, **gains: float) -> FloatArray:
    peer: Any = getattr(importlib.import_module("ahrs.filters"), name)
    return np.asarray(peer(gyr=gyro, acc=force, frequency=1.0 / period_s, **gains).Q)


def _imufusion(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    fusion: Any = importlib.import_module("imufusion")
    settings = fusion.AhrsSettings()
    settings.sample_rate = 1.0 / period_s
    settings.convention = fusion.CONVENTION_ENU
    filter_ = fusion.Ahrs()
    filter_.set_settings(settings)
    degps, g = np.degrees(gyro), force / GRAVITY_MPS2
    out = np.empty((len(gyro), 4))
    for k in range(len(gyro)):
        filter_.update_no_magnetometer(degps[k], g[k])
        out[k] = filter_.get_quaternion()
    return out


def _vqf(gyro: FloatArray, force: FloatArray, period_s: float) -> FloatArray:
    vqf: Any = importlib.import_module("vqf")
    return np.asarray(vqf.VQF(period_s).updateBatch(gyro, force)["quat6D"])


_RUNS: dict[str, tuple[str, Callable[[FloatArray, FloatArray, float], FloatArray]]] = {
    "Mahony": ("ahrs", partial(_ahrs, "Mahony", k_P=1.0, k_I=0.3)),
    "Madgwick": ("ahrs", partial(_ahrs, "Madgwick")),
    "imufusion": ("imufusion", _imufusion),
    "VQF": ("vqf", _vqf),
}

PEERS = tuple(_RUNS)
"""In the order of tables. Mahony has Kp 1 and Ki 0.3, Madgwick 0.033, imufusion 0.5."""


def missing(name: str) -> str:
    """The package that a peer, one of `PEERS`, needs and that is not installed, or nothing."""
    package = _RUNS[name][0]
    return "" if importlib.util.find_spec(package) is not None else package


def run_peer(name: str, gyro_radps: FloatArray, force_mps2: FloatArray, period_s: float) -> FloatArray:
    """Up vectors (n, 3) in the sensor's axes by a peer that is installed, after each sample of an even grid.

    Parameters
    ----------
    gyro_radps, force_mps2 : (n, 3) finite readings.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        w, x, y, z = _RUNS[name][1](gyro_radps, force_mps2, period_s).T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


# ----------------------------------------------------------------------
# The angle in the plane by each way of getting it, over a log: what `calib.stages.imu.drift` compares.
#
# Every method runs over each part of a log that has no long gap. Ours begin with the accelerometer's mean
# angle over the part's first half second, less what the gyroscope turned in it. Filters by others work in
# three dimensions; the angle is that of their up vector in the sensor's axes, atan2(uy, ux).

_START_S = 0.5


@dataclass(frozen=True)
class Track:
    """Angles of one method in each part (n_i,) [rad], not wrapped."""

    name: str
    phi_rad: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Tuned:
    """The filter of the row "tuned", and whether its rate is that by the up vector instead of -gz."""

    gains: mahony.AngleFilter
    up_vector: bool = False


def _start(phi_acc: FloatArray, rate_radps: FloatArray, period_s: float) -> float:
    """Angle at the first sample, by the accelerometer over half a second less what it turned since."""
    size = max(round(_START_S / period_s), 1)
    rate = rate_radps[:size].copy()
    rate[0] = 0.0
    return mahony.mean_angle(phi_acc[:size] - period_s * np.cumsum(rate))


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


def _turning(up: FloatArray) -> FloatArray:
    """Angle (n,), not wrapped, of up vectors (n, 3)."""
    return np.unwrap(np.arctan2(up[:, 1], up[:, 0]))


def levelled_angle(part: Part, axes: tuple[str, ...]) -> FloatArray:
    """Angle (n,) of the up vector by the levelling filter, of a part that has all six axes."""
    gyro, force = three(part, axes)
    return _turning(level_three(Levelling(), part.t_s, force, gyro))


def tracks_of(
    log: Readings,
    parts: Sequence[Part],
    period_s: float,
    tuned: Tuned | None,
    peers: bool,
    told: Callable[[str], None],
) -> tuple[list[Track], list[str]]:
    """The methods' angles on one log, and sentences about methods that were left out.

    Parameters
    ----------
    log : with gz, ax and ay at least.
    parts : of the log at even steps of this period, each at least two samples long.
    tuned : what the row "tuned" is made with, left out without.
    peers : run the filters of others that are installed.
    told : is called with a sentence before what may take long.
    """
    axes, skipped, found = log.axes, [], []
    phi_acc = {id(part): angle_of(part, axes) for part in parts}

    def add(name: str, angle: Callable[[Part], FloatArray]) -> None:
        found.append(Track(name, tuple(angle(part) for part in parts)))

    def gyroscope(part: Part) -> FloatArray:
        # The rate of a sample holds for the step before it, as in (2.3c).
        rate = rate_of(part, axes, False)
        start = _start(phi_acc[id(part)], rate, period_s)
        return np.asarray(start + np.cumsum(rate * np.diff(part.t_s, prepend=part.t_s[0])))

    def filtered(gains: mahony.AngleFilter, tilted: bool = False) -> Callable[[Part], FloatArray]:
        def angle(part: Part) -> FloatArray:
            rate, acc = rate_of(part, axes, tilted), phi_acc[id(part)]
            return mahony.filter_log(
                gains, part.t_s, acc, rate, mahony.MahonyState(_start(acc, rate, period_s))
            )[0]

        return angle

    if len(log.onchip_t_s) >= 2:
        found.append(Track("on the chip", on_grid(log.onchip_t_s, log.onchip_phi_rad, parts, period_s)))
    else:
        skipped.append("on the chip: the log has no column onchip_phi_rad")
    add("gyroscope alone", gyroscope)
    add("accelerometer alone", lambda part: np.unwrap(phi_acc[id(part)]))
    add("MM 3/3", filtered(mahony.Mahony()))
    add("levelling", filtered(Levelling()))
    lacking = ", ".join(log.lacks)
    if tuned is None:
        skipped.append("tuned: the rig's file has no section orientation_filter")
    elif tuned.up_vector and lacking:
        skipped.append("tuned: it was tuned with the up vector, which needs three axes of both sensors")
    else:
        add("tuned", filtered(tuned.gains, tuned.up_vector))
    if lacking:
        skipped.append(
            f"MM 3/3 with up vector, levelling in three axes, peers: these need three axes, and {lacking} is "
            "not in the log"
        )
        return found, skipped
    add("MM 3/3 with up vector", filtered(mahony.Mahony(), tilted=True))
    add("levelling in three axes", lambda part: levelled_angle(part, axes))
    samples = sum(len(part.values) for part in parts)
    for name in PEERS if peers else ():
        if package := missing(name):
            skipped.append(f"{name}: the package {package} is not installed: {pip_install('peers')}")
        elif samples > MOST_SAMPLES.get(name, samples):
            skipped.append(
                f"{name}: its loop is too slow for {samples} samples, at most {MOST_SAMPLES[name]} are given "
                "to it"
            )
        else:
            told(f"{log.source}: running {name}")
            # mypy takes the type of a lambda's default from nowhere.
            add(name, lambda part, name=name: _turning(run_peer(name, *three(part, axes), period_s)))  # type: ignore[misc]
    return found, skipped

"""From a log and a rig to the estimator's rows and its set-up."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, rms, runs
from calib.core.errors import BadInputError, NoSectionError
from calib.core.files import shown
from calib.core.options import LogOptions
from calib.core.result import CovarianceTable
from calib.core.rig import Rig
from calib.io.logs import Log, blank_clipped, drop_repeated_rows, iter_log, refuse_counts, sort_rows
from calib.solve.clock import time_axis
from calib.stages.actuator.kinematics import inverse
from calib.stages.actuator.section import Standing
from calib.stages.align.section import SENSORS_OF
from calib.stages.estimator.baseline import BaselineSetup, undistorting_nothing
from calib.stages.estimator.driven import PARAMETER, Drive
from calib.stages.estimator.event import NOISE
from calib.stages.estimator.kinematic import LEVELS, Kinematic, Rows, Setup, Start
from calib.stages.estimator.noise import grid_px
from calib.stages.estimator.sensors import QUANTITIES, SENSOR, sensor_values, view_coefficients

# ----------------------------------------------------------------------
# From a log and a rig.yaml to the estimator's rows and its set-up.
#
# Logs are read block by block; nothing grows with their length. So this takes the rows as they are, each of
# which gets its estimate, and not `Log.signals`, which needs all of a log; `refuse_counts` and `Watch` check
# them.

READINGS = ("u_px", "v_px", "ax_mps2", "ay_mps2", "gz_radps")
"""Columns of `kinematic.Rows.readings`."""
PLACE = ("place_x_mm", "place_y_mm")
"""What stands for the first two of them in a log without pictures: the tip's place against the base by motion
capture, which `blocks` adds to its columns."""
_TIP, _BASE = ("tip_x_m", "tip_y_m"), ("base_x_m", "base_y_m")
_PER_M = 1e3
_SOME, _STUCK_S = 25, 1.0
_REACH = (0.3, 3.0)
"""Distance of tip and base over the length at rest; no bellows is so short or so long."""
_TRUTH = ("true_q1_m", "true_q2_m", "true_phi_rad")


@dataclass(frozen=True)
class Periods:
    """What the beginning of a log says of its sensors.

    Attributes
    ----------
    camera_s, imu_s : distance of samples [s], NaN where there are too few.
    camera_even, imu_even : whether they are taken at even steps, so that their times are better than stamps.
    grid_px : 1 for whole pixels, 0 for others.
    ticks : whether rows with commands and without IMU are ticks of the camera's clock.
    camera, imu : samples.
    command_s : distance of commands [s], NaN where they are not as steady as a loop's.
    pose : whether the tip's place stands for pictures.
    camera_burst, imu_burst : samples of the longest burst, 1 where they come one by one.
    """

    camera_s: float
    imu_s: float
    grid_px: float
    ticks: bool
    camera: int
    imu: int
    camera_even: bool = True
    imu_even: bool = True
    command_s: float = math.nan
    pose: bool = False
    camera_burst: int = 1
    imu_burst: int = 1


def seen_by(log: Log) -> tuple[str, ...]:
    """Columns of a block of `blocks` that `kinematic.Rows.readings` are taken from."""
    return (*(PLACE if PLACE[0] in log.columns else READINGS[:2]), *READINGS[2:])


def _column(log: Log, name: str) -> FloatArray:
    return log.columns[name] if name in log.columns else np.full(len(log), np.nan)


def _kinds(log: Log, readings: FloatArray, ticks: bool) -> tuple[BoolArray, BoolArray]:
    """Rows (n,) with a picture or a tick of the camera, and rows with an IMU sample."""
    finite = np.isfinite(readings)
    imu: BoolArray = np.any(finite[:, 2:], axis=1)
    camera: BoolArray = np.all(finite[:, :2], axis=1)
    if ticks:
        camera |= np.isfinite(_column(log, "pwm1")) & ~imu
    return camera, imu


def _readings(log: Log) -> FloatArray:
    values = np.stack([_column(log, name) for name in seen_by(log)], axis=1)
    return np.where(np.isfinite(values), values, np.nan)


_STEADY = 0.7
"""Share of steps near the usual one from which on commands are a loop's, and longer ones have lost some."""


def periods(log: Log) -> Periods:
    """Rates and pixel grid from the first block of a log."""
    readings = _readings(log)
    seen, imu = _kinds(log, readings, False)
    ticks = np.isfinite(_column(log, "pwm1")) & ~imu
    # Commands stand in the rows of pictures when most of those rows have one.
    use = bool(ticks.any()) and int((ticks & seen).sum()) >= 0.5 * int(ticks.sum()) > 0
    camera = seen | ticks if use else seen
    # Time that goes back starts the filter again, and says nothing of the period.
    first, second = (time_axis(np.maximum.accumulate(log.t_s[rows])) for rows in (camera, imu))
    steps = np.diff(log.t_s[np.isfinite(_column(log, "pwm1"))])
    usual = float(np.median(steps)) if len(steps) else math.nan
    steady = bool(np.mean(np.abs(steps / usual - 1.0) < 0.5) > _STEADY) if usual > 0.0 else False
    pose = PLACE[0] in log.columns
    return Periods(
        first.period_s, second.period_s, 0.0 if pose else grid_px(readings), use, int(seen.sum()),
        int(imu.sum()), first.steady, second.steady, usual if steady else math.nan, pose, first.burst,
        second.burst,
    )  # fmt: skip


def rows_of(log: Log, found: Periods) -> Rows:
    """A block's rows for the estimator."""
    readings = _readings(log)
    camera, imu = _kinds(log, readings, found.ticks)
    kinds = camera.astype(np.int64) + 2 * imu.astype(np.int64)
    t = np.asarray(log.t_s, dtype=np.float64)
    buffered = [rows for rows, burst in ((camera, found.camera_burst), (imu, found.imu_burst)) if burst > 1]
    waited = np.zeros(len(t) if buffered else 0)
    for own in map(np.flatnonzero, buffered):
        for part in np.split(own, np.flatnonzero(np.diff(t[own]) < 0.0) + 1):
            waited[part] = t[part] - time_axis(t[part]).t_s
    return Rows(t, readings, kinds, waited, pwm_of(log))


def truth_of(log: Log, setup: Setup) -> FloatArray | None:
    """True q1, q2 [m] and phi [rad] (n, 3), None for a log that does not know them.

    Beside pictures the tip's pose by motion capture is taken for true where nothing truer is there and the
    tip is within reach.
    """
    if all(name in log.columns for name in _TRUTH):
        return np.stack([log.columns[name] for name in _TRUTH], axis=1)
    if not scored_by_pose(log):
        return None
    pose = np.column_stack([_place_m(log), log.columns["tip_phi_rad"]])
    near, far = (share * float(setup.start.head[1]) for share in _REACH)
    distance = np.hypot(pose[:, 0], pose[:, 1])
    pose[~((distance > near) & (distance < far) & (np.abs(pose[:, 2]) < 2.0 * math.pi))] = np.nan
    out = np.full((len(log), 3), np.nan)
    known = np.isfinite(pose).all(axis=1)
    out[known] = np.column_stack([inverse(pose[known], setup.bellows_radius_m), pose[known, 2]])
    return out


def scored_by_pose(log: Log) -> bool:
    """Whether a block has pictures, no truth, and the tip's pose in the plane."""
    return (
        PLACE[0] not in log.columns
        and any(name not in log.columns for name in _TRUTH)
        and _in_plane(log)
        and "tip_phi_rad" in log.columns
    )


def _in_plane(log: Log) -> bool:
    return all(name in log.columns for name in _TIP) and "tip_z_m" not in log.columns


def _place_m(log: Log) -> FloatArray:
    """The tip's place (n, 2) [m] against the base."""
    base = [log.columns.get(name, np.zeros(len(log))) for name in _BASE]
    return np.stack([log.columns[name] for name in _TIP], axis=1) - np.stack(base, axis=1)


def bend_apart_rad(log: Log) -> float:
    """RMS [rad] between the tip's angle and that of an arc from the base to its place; NaN without both.

    Of medians over some poses each, so that neither noise nor jumps count.
    """
    if not _in_plane(log) or "tip_phi_rad" not in log.columns:
        return math.nan
    away = log.columns["tip_phi_rad"] - 2.0 * np.arctan2(*_place_m(log).T)
    away = away[np.isfinite(away)]
    parts = np.array_split(away, max(len(away) // _SOME, 1))
    return rms(np.array([np.median(part) for part in parts])) if len(away) else math.nan


def stuck_place(log: Log, names: tuple[str, str] = PLACE) -> tuple[float, float, float] | None:
    """The time from and to [s] in which a place repeats to the digit and the gyroscope turns most, and by how
    much [rad], beyond an even rate, as of a bias; None where none repeats for a second or the gyroscope is
    silent.
    """
    seen, turning = log.sampled(*names), log.sampled("gz_radps")
    if len(seen) < 2 or len(turning) < 2:
        return None
    place, t = np.stack([log.columns[name][seen] for name in names]), log.t_s[seen]
    rate, at = log.columns["gz_radps"][turning], log.t_s[turning]
    turned = np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(at))])
    out = None
    for a, b in runs((place[:, 1:] == place[:, :-1]).all(axis=0)):
        inside = (at >= t[a]) & (at <= t[b])
        if not t[b] - t[a] >= _STUCK_S or inside.sum() < 3:
            continue
        off = turned[inside] - np.polyval(np.polyfit(at[inside], turned[inside], 1), at[inside])
        if out is None or np.ptp(off) > out[2]:
            out = float(t[a]), float(t[b]), float(np.ptp(off))
    return out


def _placed(log: Log) -> Log:
    """A block with the columns `PLACE`."""
    columns = dict(zip(PLACE, _PER_M * _place_m(log).T, strict=True))
    return replace(log, columns={**log.columns, **columns})


def _check_reach(log: Log, rest_length_m: float) -> None:
    """Raise `BadInputError` where the tip is too near to or too far from the base for these bellows."""
    far = float(np.nanmedian(np.hypot(*_place_m(log).T)))
    if not _REACH[0] * rest_length_m <= far <= _REACH[1] * rest_length_m:
        raise BadInputError(
            f"{log.source}: the tip is {1e3 * far:.4g} mm from the base, expected about the rest length, "
            f"{1e3 * rest_length_m:.4g} mm; look at the unit of tip_x_m and tip_y_m, and state the base as "
            "base_x_m, base_y_m"
        )


def blocks(
    path: Path, options: LogOptions, picture_px: tuple[int, int] | None, rest_length_m: float = math.nan
) -> Iterator[Log]:
    """Blocks with rows of a log; `options` and `picture_px` as for `iter_log`.

    Where the first has no picture and the tip's place in the plane, all get the columns `PLACE`.

    Raises `BadInputError` for one without rows, or without camera, pose and IMU, and for a tip that is not
    within reach of bellows of this length at rest.
    """
    rows, known, pose = 0, False, False
    for block in iter_log(path, options, picture_px=picture_px):
        if not known and not any(name in block.columns for name in (*READINGS, *_TIP)):
            raise BadInputError(
                f"{shown(path)}: has neither camera nor IMU, expected columns as u_px, v_px or gz_radps"
            )
        if not known:
            refuse_counts(block, READINGS)
            pose = (
                _in_plane(block) and not len(block.sampled(*READINGS[:2])) and len(block.sampled(*_TIP)) > 0
            )
            if pose:
                _check_reach(block, rest_length_m)
            elif not any(name in block.columns for name in READINGS):
                raise BadInputError(
                    f"{shown(path)}: has neither camera nor IMU and no tip in the plane of motion, expected "
                    "tip_x_m, tip_y_m without tip_z_m"
                )
        known = True
        if len(block):
            rows += len(block)
            yield blank_clipped(drop_repeated_rows(sort_rows(_placed(block) if pose else block)))
    if rows == 0:
        raise BadInputError(f"{shown(path)}: has a header but no rows")


_CAPTURED = ("marker_offset_m", "time_offset_s", "shift_x_m", "shift_y_m", "stretch")
"""Quantities of the picture; of motion capture they are nothing, as far as anybody knows."""


def _of_capture(
    values: dict[str, tuple[float, float]], covariance: FloatArray | None
) -> tuple[dict[str, tuple[float, float]], FloatArray | None]:
    """Values and covariance of the sensors where the tip's place stands for pictures."""
    values = values | {name: (0.0, QUANTITIES[name].assumed) for name in _CAPTURED}
    if covariance is not None:
        at = [SENSOR.index(name) for name in _CAPTURED]
        covariance = covariance.copy()
        covariance[at], covariance[:, at] = 0.0, 0.0
        covariance[at, at] = [QUANTITIES[name].assumed ** 2 for name in _CAPTURED]
    return values, covariance


def _place_view() -> FloatArray:
    """A view (25,) of `sensors.view_coefficients` that shows places in the plane in mm."""
    view = np.zeros(25)
    view[[0, 4, 8]] = 1.0
    view[[9, 10]] = _PER_M
    return view


def _from_align(rig: Rig) -> tuple[dict[str, tuple[float, float]], FloatArray | None, list[str]]:
    """Values and deviations of the sensors, their covariance, and sentences for what is only assumed."""
    values, said = {name: (one.usual, one.assumed) for name, one in QUANTITIES.items()}, list[str]()
    if (shifts := rig.shift_sigma_m) is not None:
        values["shift_x_m"], values["shift_y_m"] = ((0.0, max(sigma, 1e-6)) for sigma in shifts)
    if rig.imu is not None and rig.imu.gyro_bias_radps[2] is not None:
        listed = rig.imu.sigma.get("gyro_bias_radps")
        sigma = listed[2] if listed is not None else None
        values["gyro_bias_radps"] = (
            rig.imu.gyro_bias_radps[2],
            max(2e-4, sigma or 1e-3, _between_logs(rig)["gyro_bias_radps"]),
        )
    align = rig.align
    if align is None:
        said.append(
            "no section align: time offset, mount angle and biases are taken from the log itself within "
            "wide priors (calib align finds them)"
        )
        return values, None, said
    found, deviations = _by_quantity(dict(align)), _by_quantity(align.sigma)
    sigmas = {
        name: max(one, 1e-9) if isinstance(one := deviations.get(name), float) else values[name][1]
        for name in SENSOR
    }
    values = {
        name: (usual if found[name] is None else found[name], sigmas[name])
        for name, (usual, _) in values.items()
    }
    covariance = (
        None if align.covariance is None else _covariance(align.covariance, sigmas, _between_logs(rig))
    )
    # Logs tell how much older a picture is than the readings of the IMU.
    offset_s, sigma_s = values["time_offset_s"]
    values["time_offset_s"] = (offset_s + rig.imu_delay_s, sigma_s)
    return values, covariance, said


_BETWEEN_LOGS = {"gyro_bias_radps": 1e-4, "accel_bias_x_mps2": 1e-3, "accel_bias_y_mps2": 1e-3}
"""How far biases walk between the logs of the alignment and another one, at least."""


def _between_logs(rig: Rig) -> dict[str, float]:
    """Deviation of biases from log to log: what logs at rest show, where they show more than the least."""
    out = dict(_BETWEEN_LOGS)
    seen = rig.imu.drift.get("gyro") if rig.imu is not None else None
    if seen is not None and seen.spread_degps is not None:
        # A spread over n logs, and the next one is n + 1.
        spread = math.radians(seen.spread_degps) * math.sqrt(1.0 + 1.0 / seen.logs)
        out["gyro_bias_radps"] = max(out["gyro_bias_radps"], spread)
    return out


def _by_quantity(by_key: Mapping[str, Any]) -> dict[str, Any]:
    """What is listed by the keys of `Align` by the quantities of `SENSOR`."""
    out: dict[str, Any] = {}
    for key, names in SENSORS_OF.items():
        value = by_key.get(key)
        out |= zip(names, value if isinstance(value, list) else [value] * len(names), strict=False)
    return out


def _covariance(
    table: CovarianceTable, sigmas: Mapping[str, float], between: Mapping[str, float]
) -> FloatArray:
    """Covariance (14, 14) of `sensors.SENSOR`, with what differs between logs added; those that the table
    lacks stand alone.
    """
    V = np.diag([sigmas[name] ** 2 for name in SENSOR])
    known = [name for name in table.order if name in SENSOR]
    at = [SENSOR.index(name) for name in known]
    rows = [table.order.index(name) for name in known]
    V[np.ix_(at, at)] = np.array(table.values)[np.ix_(rows, rows)]
    for name, walk in between.items():
        V[SENSOR.index(name), SENSOR.index(name)] += walk**2
    # A table that was rounded on its way through the file may have lost a digit of its smallest eigenvalue.
    V = 0.5 * (V + V.T)
    scale = np.sqrt(np.maximum(np.diag(V), 1e-18))
    eigenvalues, Q = np.linalg.eigh(V / scale / scale[:, None])
    normal = (Q * np.maximum(eigenvalues, 1e-9)) @ Q.T
    return np.asarray(normal * scale * scale[:, None], dtype=np.float64)


_MINUTE_S = 60.0
_WALKS = (
    ("gyro_walk_radps2_per_sqrt_Hz", "gyro_instability_radps", 2),
    ("accel_walk_mps3_per_sqrt_Hz", "accel_instability_mps2", 1),
)
"""Walk and instability of the biases that turn the angle, the gyroscope's and the accelerometer's; axis."""


def _process(rig: Rig) -> Kinematic:
    """Levels that were tuned, and walks of the biases that were measured at rest.

    An instability B counts as a walk by B in a minute. Where a log was too short for more than a bound, the
    walk is that, and at most the nominal one. Along x the nominal walk stays: it stands for what scale and
    length make of the accelerations, too.
    """
    tuned, nominal = rig.estimator, Kinematic()
    walks = list(nominal.sensor_walk)
    for name, (walk, instability, axis) in zip(("gyro_bias_radps", "accel_bias_y_mps2"), _WALKS, strict=True):
        if rig.imu is None:
            break
        at = SENSOR.index(name)
        K, B = getattr(rig.imu, walk)[axis], getattr(rig.imu, instability)[axis] or 0.0
        most = rig.imu.below[walk][axis] if walk in rig.imu.below else None
        slow = B / math.sqrt(_MINUTE_S)
        if K is not None:
            walks[at] = math.hypot(K, slow)
        elif most is not None:
            walks[at] = min(walks[at], math.hypot(most, slow))
    levels = tuple(tuned.levels) if tuned is not None and tuned.levels else LEVELS
    return Kinematic(levels, sensor_walk=tuple(walks))


_SHAKEN = 1.6
"""So many times the noise at rest in the alignment's logs, and a moving rig shakes its IMU."""


def _at_rest(rig: Rig, found: Periods) -> dict[str, float]:
    """Noise of an IMU sample by `calib imu static`."""
    imu = rig.imu
    if imu is None:
        return {}
    root = math.sqrt(1.0 / found.imu_s) if found.imu_s > 0.0 else math.sqrt(imu.rate_hz)
    densities = (
        ("accel_x_mps2", imu.accel_noise_mps2_per_sqrt_Hz[0]),
        ("accel_y_mps2", imu.accel_noise_mps2_per_sqrt_Hz[1]),
        ("gyro_radps", imu.gyro_noise_radps_per_sqrt_Hz[2]),
    )
    return {key: density * root for key, density in densities if density}


def _noise(rig: Rig, found: Periods) -> dict[str, float]:
    """Numbers of `event.NOISE` for a rig and a log."""
    numbers = NOISE | _at_rest(rig, found)
    numbers["grid_px"] = found.grid_px
    if rig.align is not None:
        numbers["jitter_px"] = rig.align.jitter_px or numbers["jitter_px"]
        numbers["gyro_radps"] = rig.align.gyro_noise_radps or numbers["gyro_radps"]
        for key, value in zip(("accel_x_mps2", "accel_y_mps2"), rig.align.accel_noise_mps2, strict=True):
            numbers[key] = value or numbers[key]
        numbers["imu_stamp_s"] = math.hypot(numbers["imu_stamp_s"], rig.align.imu_age_s or 0.0)
    if rig.estimator is not None:
        numbers["jitter_px"] = rig.estimator.jitter_px
        if rig.estimator.accel_noise_mps2 is not None:
            numbers["accel_x_mps2"] = numbers["accel_y_mps2"] = rig.estimator.accel_noise_mps2
        if rig.estimator.gyro_noise_radps is not None:
            numbers["gyro_radps"] = rig.estimator.gyro_noise_radps
    return numbers


def noise_at_rest(rig: Rig, found: Periods) -> tuple[float, float, float] | None:
    """Noise of a_x, a_y, g_z for a filter that knows the head's accelerations; None without a log at rest.

    The noise that an alignment finds holds what its splines cannot follow as well, which suits a model that
    knows no better. Where it is much greater than that at rest, the moving rig shakes, and it holds.
    """
    tuned, rest, moving = rig.estimator, _at_rest(rig, found), _noise(rig, found)
    if not rest or (tuned is not None and (tuned.accel_noise_mps2 or tuned.gyro_noise_radps)):
        return None
    x, y, z = (
        rest[key] if key in rest and moving[key] <= _SHAKEN * rest[key] else moving[key]
        for key in ("accel_x_mps2", "accel_y_mps2", "gyro_radps")
    )
    return x, y, z


def setup_from_rig(rig: Rig, path: Path, found: Periods) -> tuple[Setup, list[str]]:
    """The estimator's set-up, and sentences about what is assumed.

    Raises `BadInputError` without a camera or a plane where the log has pictures.
    """
    source = shown(path)
    said: list[str] = []
    view = np.zeros(25)
    if found.pose:
        view = _place_view()
    elif found.camera:
        plane = rig.current_plane(str(path))
        if rig.camera is None:
            raise NoSectionError(f"{source}: has no camera, which pictures need; run calib intrinsics first")
        if plane is None:
            raise NoSectionError(f"{source}: has no plane, which pictures need; run calib extrinsics first")
        R, t = np.array(plane.R_CW), np.array(plane.t_CW_m)
        view = view_coefficients(rig.camera.optics, R, t, rig.middle_m)
    values, covariance, assumed = _from_align(rig)
    said += assumed
    if found.pose:
        values, covariance = _of_capture(values, covariance)
    plant = rig.plant
    head = np.array([0.0, plant.rest_length_m + 0.004, 0.0, 0.0, 0.0, 0.0])
    start = Start(
        sensor_values({name: values[name][0] for name in SENSOR}),
        sensor_values({name: values[name][1] for name in SENSOR}),
        head,
        sensor_covariance=covariance,
    )
    setup = Setup(
        view, np.array(list(_noise(rig, found).values())), start, plant.bellows_radius_m,
        process=_process(rig),
        camera_period_s=found.camera_s if found.camera_even else math.nan,
        imu_period_s=found.imu_s if found.imu_even else math.nan,
        command_period_s=found.command_s, imu_delay_s=rig.imu_delay_s,
        waits_s=max(0.0, (found.imu_burst - 1) * found.imu_s, (found.camera_burst - 1) * found.camera_s),
    )  # fmt: skip
    return setup, said


def baseline_setup(setup: Setup, rig: Rig, path: Path, found: Periods) -> BaselineSetup:
    """The source's pipeline for the same rig, without what it does not know of."""
    plane = rig.current_plane(str(path))
    if rig.camera is None or plane is None or not found.camera:
        raise BadInputError(f"{shown(path)}: the baseline needs a camera, a plane, and pictures in the log")
    R, t = np.array(plane.R_CW), np.array(plane.t_CW_m)
    return BaselineSetup(
        undistorting_nothing(rig.camera.optics, R, t, rig.workspace_m),
        setup.bellows_radius_m,
        float(setup.start.head[1]),
        float(setup.start.sensor[6]),
        1.0 / found.imu_s if found.imu_s > 0.0 else 100.0,
        1.0 / found.camera_s if found.camera_s > 0.0 else 60.0,
    )


# ----------------------------------------------------------------------
# The driven model of a rig: plant and pumps from the sections `actuator` and `pump` of rig.yaml.

_LEAST_SHARE, _APART = 0.01, 0.003
"""Identified values are not taken to be nearer the truth than the first, nor what they tell together than
the second: an identification keeps the mass as it is, and its model is not the actuator."""

_WALK_IDENTIFIED, _SWITCHING = 1e-3, 0.01
"""Walks beside parameters that were identified: errors of the model itself, which deviations of parameters
that are nominal cover. On rigs with another law of deflation, without creep, and with a play of the pumps
errors fall by up to a half, on rigs that are as the model they stay."""


def has_commands(log: Log) -> bool:
    """Whether a block says what the pumps were told."""
    return any(np.isfinite(pair).all() for pair in pwm_of(log))


def pwm_of(log: Log) -> FloatArray:
    """Commands (n, 2) of a block, NaN in rows without."""
    return np.stack([_column(log, name) for name in ("pwm1", "pwm2")], axis=1)


_SIGMA = {
    "stiffness": ("actuator", "stiffness_scale"),
    "log_damping": ("actuator", "damping_scale_pumps_connected"),
    "bending": ("actuator", "bending_N_per_rad2"),
    "strength1": ("pump", "strength"),
    "strength2": ("pump", "strength"),
    "lag": ("pump", "lag_s"),
    "deflation": ("pump", "falling_N_per_s"),
    "rest_length_m": ("actuator", "rest_length_m"),
    "mass": ("actuator", "mass_kg"),
    "creep_stiffness": ("actuator", "lambda2_N_per_m"),
    "creep_rate": ("actuator", "lambda1_per_s"),
}
"""Whose standard deviation, as a share of the value, a parameter has."""


def _deviation(values: Standing, key: str, at: int, relative: bool) -> float | None:
    value, sigma = values.get(key, (None, None))
    if isinstance(sigma, list):
        sigma, value = sigma[at], value[at]
    if sigma is None:
        return None
    if not relative:
        return float(sigma)
    return max(float(sigma) / abs(float(value)), _LEAST_SHARE) if value else None


def _driving_covariance(
    table: CovarianceTable, sections: Mapping[str, Standing], sigma: dict[str, float]
) -> FloatArray:
    """Covariance (11, 11) of the parameters: their deviations with the correlations of the identification.

    What was estimated apart since then, so that the deviation in the file is another one, is independent.
    """
    out = np.diag(np.array(list(sigma.values())) ** 2)
    rows, names = [], []
    for name, (section, key) in _SIGMA.items():
        row = name if key == "strength" else key
        deviation = _deviation(sections[section], key, int(name == "strength2"), relative=False)
        if not deviation or row not in table.order:
            continue
        at = table.order.index(row)
        if math.isclose(deviation * deviation, table.values[at][at], rel_tol=2e-3):
            rows.append(at)
            names.append(name)
    spread = np.sqrt([table.values[k][k] for k in rows])
    places = [PARAMETER.index(name) for name in names]
    together = np.array(table.values)[np.ix_(rows, rows)]
    correlation = 0.5 * (together + together.T) / np.outer(spread, spread)
    deviations = np.array([sigma[name] for name in names])
    out[np.ix_(places, places)] = correlation * np.outer(deviations, deviations)
    shares = [place for place in places if PARAMETER[place] != "rest_length_m"]
    out[shares, shares] += _APART**2
    return np.asarray(out)


def drive_from_rig(rig: Rig) -> Drive:
    """Plant and pumps with their deviations; what the rig lacks is nominal."""
    nominal, sections = Drive(), rig.standing
    table = None if rig.actuator is None else rig.actuator.covariance
    sigma = dict(zip(PARAMETER, nominal.sigma, strict=True))
    for name, (section, key) in _SIGMA.items():
        one = _deviation(sections[section], key, int(name == "strength2"), name != "rest_length_m")
        if one is not None:
            # What was hardly identified differs from other rigs as they do from each other.
            sigma[name] = one if table is None else min(one, sigma[name])
    covariance = None
    if table is not None:
        if sections["actuator"].get("mass_kg", (None, None))[1] is None:
            # Forces, springs and mass have one scale, which the identification takes from the mass.
            sigma["mass"] = _LEAST_SHARE
        covariance = _driving_covariance(table, sections, sigma)
        sigma = dict(zip(PARAMETER, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        nominal = replace(nominal, walk_disturbance=_WALK_IDENTIFIED, walk_switching=_SWITCHING)
    tuned = rig.estimator.driven if rig.estimator is not None else None
    if tuned is not None:
        nominal = replace(
            nominal,
            walk_disturbance=tuned.walk_disturbance_N_per_sqrt_s,
            walk_rates=(tuned.walk_turning_radps_per_sqrt_s, tuned.walk_growing_mps_per_sqrt_s),
            walk_forces=tuned.walk_forces_N_per_sqrt_s,
        )
    return replace(nominal, **vars(rig.machine), sigma=tuple(sigma.values()), covariance=covariance)

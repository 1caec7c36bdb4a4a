"""The stages of the IMU: at rest, in many poses, the gains of the angle filter, and how angles drift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from calib.core.errors import UsageError
from calib.core.files import shown
from calib.core.options import LogOptions, option
from calib.core.stage import Files, Output, Stage, later
from calib.core.units import GRAVITY_MPS2
from calib.core.words import Block, Line, described, listed
from calib.core.writing import write_atomically

if TYPE_CHECKING:
    from collections.abc import Callable

    from calib.core.rig import Rig
    from calib.io.logs import Log
    from calib.stages.imu.mahony import AngleFilter
    from calib.stages.imu.sampling import Readings
    from calib.stages.imu.section import Drift, Imu
    from calib.stages.imu.tuning import TuneLog


def _readings(files: Files, options: LogOptions, read: Callable[[Log], Readings]) -> list[Readings]:
    """Readings of each log, by the name that is written, which does not depend on the folder."""
    from calib.io.logs import read_log

    logs = []
    for path in files.paths:
        log = read_log(path, options, files.remarks)
        logs.append(replace(read(log), source=files.taken(path, log.beginning)))
    return logs


# ----------------------------------------------------------------------
# `calib imu static`: logs of an IMU at rest in, its bias, noise and drift out.


def _read_static(files: Files, rig: Rig, options: LogOptions) -> tuple[list[Readings]]:
    from calib.stages.imu.read import rest_log

    del rig
    return (_readings(files, options, rest_log),)


def _write_kalibr(files: Files, imu: Imu) -> list[Path]:
    from calib.stages.imu.formats import IMU_YAML, to_kalibr

    assert files.output is not None
    write_atomically(files.output, to_kalibr(imu), IMU_YAML)
    return [files.output]


static = Stage(
    "imu static",
    "IMU at rest",
    """Find bias, noise densities and drift of an IMU from logs at rest, and whether they were at rest.

    Writes the section imu of the rig's file. Exits 1 when the verdict is not ok.
    """,
    _read_static,
    later("calib.stages.imu.static", "solve_static"),
    LogOptions,
    sources="Logs of the rig at rest.",
    metavar="LOG...",
    leaves_out=True,
    writes=("imu",),
    output=Output(
        "Kalibr's imu.yaml to write as well.",
        _write_kalibr,
        ("--imu-yaml",),
        kind=("calib.stages.imu.formats", "IMU_YAML"),
    ),
    words=lambda imu: [
        Line("± is one standard deviation, < a 95 % bound where the logs are too short for an estimate"),
        Line("accel mean holds gravity: one pose does not tell it from a bias"),
    ],
    plots=later("calib.stages.imu.plots", "static_plots"),
)


# ----------------------------------------------------------------------
# `calib imu intrinsics`: rests of an IMU in many poses in, its bias, scale and misalignment out.


@dataclass(frozen=True)
class IntrinsicsOptions(LogOptions):
    """What is calibrated, and the inputs' units."""

    accel: Path | None = option(None, "Instead of LOG: lines of t x y z, may be gzipped.")
    gyro: Path | None = option(None, "The gyroscope's file beside --accel.")
    gravity: float = option(GRAVITY_MPS2, "Gravity where the log was taken, m/s^2.")
    planar: bool = option(False, "Calibrate ax, ay and gz alone, from tilts about z.")


def _read_intrinsics(files: Files, rig: Rig, options: IntrinsicsOptions) -> tuple[Any, ...]:
    from calib.io.logs import read_log
    from calib.stages.imu.read import pose_log, read_pose_files

    del rig
    if not 1.0 <= options.gravity <= 30.0:
        raise UsageError(f"--gravity is {options.gravity:g}, expected about 9.81 m/s^2")
    accel, gyro = options.accel, options.gyro
    if bool(files.paths) == (accel is not None) or (gyro is not None and accel is None):
        raise UsageError("give a LOG, or --accel FILE with --gyro FILE beside it")
    if accel is not None:
        whole, remarks = read_pose_files(accel, gyro, options)
        files.remarks += [*remarks, *whole.remarks()]
    else:
        whole = read_log(files.paths[0], options, files.remarks)
    log = pose_log(whole, options.planar)
    for path in (*files.paths, accel, gyro):
        if path is not None:
            files.taken(path)
    return log, options.gravity, options.planar


intrinsics = Stage(
    "imu intrinsics",
    "IMU in poses",
    """Find bias, scale and misalignment of an IMU from rests in many poses.

    Let it lie for 30 s, then put it down in 24 poses or more: each axis up and down, and between axes; each
    held still for 3 s. On a rig that moves in a plane: upright, 10 s at rest, then tilts about z by 45
    degrees at a time through the circle. Writes the section imu_intrinsics of the rig's file. Exits 1
    when the verdict is not ok.
    """,
    _read_intrinsics,
    later("calib.stages.imu.intrinsics", "solve_intrinsics"),
    IntrinsicsOptions,
    sources="Log of rests in many poses, turns between.",
    several=False,
    optional=True,
    metavar="LOG",
    writes=("imu_intrinsics",),
    uses=("imu",),
    plots=later("calib.stages.imu.plots", "intrinsics_plots"),
)


# ----------------------------------------------------------------------
# `calib imu tune`: logs in, gains of the angle filter out, with what they are worth beside 3/3.


@dataclass(frozen=True)
class TuneOptions(LogOptions):
    """By what gains are judged."""

    reference: Literal["auto", "truth", "camera", "onchip", "none"] = option(
        "auto",
        "Angle to judge by: true_phi_rad, the camera's through the rig's plane, onchip_phi_rad, or none for "
        "the log's own smoothed angle. auto: the camera where there is one.",
    )
    rate: Literal["plane", "up"] = option(
        "plane", "Rate of the angle: -gz, or of the up vector for a sensor that is not in plane."
    )


def _read_tune(files: Files, rig: Rig, options: TuneOptions) -> tuple[Any, ...]:
    from calib.io.logs import read_log
    from calib.stages.actuator.kinematics import angle_from_marker
    from calib.stages.imu.read import Reading, sensor_noise, tune_log
    from calib.stages.imu.sampling import check_rate

    how = Reading(options.rate == "up", options.reference)
    camera, plane = rig.camera, None
    if options.reference in ("auto", "camera"):
        plane = rig.current_plane(files.rig_path)
    if camera is not None and plane is not None:
        how = replace(
            how,
            angle_seen=lambda pixels: angle_from_marker(plane.to_world(pixels, camera), rig.marker_offset_m),
        )
    logs: list[TuneLog] = []
    for path in files.paths:
        whole = read_log(path, options, files.remarks, rig.picture_px)
        log = tune_log(whole, how)
        files.remarks += log.said
        name = files.taken(path, whole.beginning)
        # What is written to the rig's file does not depend on the folder.
        logs.append(replace(log, source=name, pieces=tuple(replace(p, source=name) for p in log.pieces)))
        check_rate(log.sampling, shown(path), logs[0].sampling, logs[0].source)
    files.hashes |= rig.identities("imu")
    if any(log.reference == "camera" for log in logs):
        files.hashes |= rig.identities("geometry", "camera", "plane")
    return logs, *sensor_noise(rig, logs), how.tilted


tune = Stage(
    "imu tune",
    "Angle filter",
    """Tune angle filters on logs, judge them on parts they were not tuned on, and keep 3/3 unless one wins.

    3/3 are the gains Kp = 3/s and Ki = 3/s^2 of the Mahony-Madgwick filter. Uses the sections imu, camera
    and plane of the rig's file where they are, and writes its section orientation_filter. Exits 1 when the
    logs do not allow a judgement.
    """,
    _read_tune,
    later("calib.stages.imu.tuning", "solve_tune"),
    TuneOptions,
    sources="Logs of the rig in motion.",
    metavar="LOG...",
    leaves_out=True,
    writes=("orientation_filter",),
    uses=("imu", "imu_intrinsics", "camera", "plane"),
    words=lambda section: [
        Line("noise: variance of the angle over that of the accelerometer's; peak: angle per rate's bias"),
        Line("each part of the logs is judged with gains of the others"),
    ],
    plots=later("calib.stages.imu.plots", "tune_plots"),
)


# ----------------------------------------------------------------------
# `calib imu drift`: the same logs through every way of getting the angle, and how each drifts.

_INTERVALS = (
    "intervals allow for errors that hang together in time (white noise on a process of order one or a "
    "random walk, by restricted likelihood); RMSE is in motion, without the constant mount offset; a "
    "positive lag is late"
)


@dataclass(frozen=True)
class DriftOptions(LogOptions):
    """Which filters are compared."""

    peers: bool = option(True, "Run the filters of the extra peers as well.", flag="peers/--no-peers")


def _read_drift(files: Files, rig: Rig, options: DriftOptions) -> tuple[Any, ...]:
    from calib.stages.imu.levelling import Levelling
    from calib.stages.imu.mahony import Mahony
    from calib.stages.imu.read import drift_log
    from calib.stages.imu.tracks import Tuned

    logs = _readings(files, options, drift_log)
    tuned, section = None, rig.orientation_filter
    if section is not None:
        gains: AngleFilter = Mahony(section.Kp_per_s, section.Ki_per_s2)
        if section.filter == "levelling" and section.tau_s and section.velocity_mps:
            gains = Levelling(section.tau_s, section.velocity_mps)
        tuned = Tuned(gains, section.rate_of_angle == "up vector")
    return logs, dict(files.hashes), tuned, options.peers, files.narrate


def _drift_document(result: Drift) -> dict[str, Any]:
    from calib.core.result import section_json

    return {"drift": section_json(result)}


def _drift_words(result: Drift) -> list[Block]:
    """A table of the methods for each log, then the slopes over all."""
    blocks: list[Block] = []
    for log in result.logs:
        blocks.append(
            Line(
                f"{log.name}: {log.duration_s:.5g} s at {log.rate_hz:.5g} Hz, {log.judged_s:.5g} s judged, "
                f"{log.moving_s:.5g} s in motion; {log.about}"
            )
        )
        blocks.append(listed("method", log.methods))
        blocks += [Line(sentence, "remark") for sentence in (*log.skipped, *log.remarks)]
    return [*blocks, Line(_INTERVALS), Line(f"note: {result.note}"), *described(result)]


drift = Stage(
    "imu drift",
    "Drift of the angle",
    """Compare how the angle drifts by the chip, the sensors, the Mahony-Madgwick (MM) filter and others.

    Tuned gains are read from the rig's file, to which nothing is written.
    """,
    _read_drift,
    later("calib.stages.imu.drift", "solve_drift"),
    DriftOptions,
    sources="Logs of the rig, at rest or in motion.",
    metavar="LOG...",
    leaves_out=True,
    uses=("imu", "imu_intrinsics", "orientation_filter"),
    document=_drift_document,
    words=_drift_words,
    plots=later("calib.stages.imu.plots", "drift_plots"),
)

"""The stages of the IMU: at rest, in many poses, the gains of the angle filter, and how angles drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from calib.core.errors import BadInputError, UsageError
from calib.core.stage import Files, LogOptions, Output, Stage, option

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from calib.core.arrays import FloatArray
    from calib.core.plot import Figure
    from calib.core.rig import Rig
    from calib.core.verdict import Finding
    from calib.core.words import Block
    from calib.core.writing import Kind
    from calib.stages.imu.drift import LogDrift, Measures
    from calib.stages.imu.intrinsics import Gyroscope, Intrinsics
    from calib.stages.imu.read import TuneLog
    from calib.stages.imu.sampling import Readings
    from calib.stages.imu.section import (
        AccelIntrinsics,
        Drift,
        DriftMethod,
        DriftOfLog,
        FilterCandidate,
        FilterLog,
        GyroIntrinsics,
        Imu,
        ImuIntrinsics,
        ImuLog,
        OrientationFilter,
    )
    from calib.stages.imu.static import AxisNoise, StaticLog
    from calib.stages.imu.tracks import Tuned
    from calib.stages.imu.tuning import AngleFilter, Candidate, Noise, Tuning

_SAME_RATE = 0.02


def _degrees(value: float) -> float | None:
    from calib.core.result import finite_or_none

    return finite_or_none(math.degrees(value))


def _of_sensors(logs: Sequence[Readings | TuneLog]) -> Iterator[Finding]:
    """Findings on the sensors of logs, which are named."""
    for log in logs:
        for one in log.findings:
            yield replace(one, text=f"{log.source}: {one.text}")


def _sampled(s: Any) -> dict[str, Any]:
    """Keys that say how a log was sampled."""
    return {
        "duration_s": s.duration_s,
        "rate_hz": s.rate_hz,
        "jitter_s": s.jitter_s,
        "missing": s.missing,
        "gaps": sum(not gap.split for gap in s.gaps),
        "splits": sum(gap.split for gap in s.gaps),
        "repeated_rows": s.repeated_rows,
        "repeated_stamps": s.repeated_stamps,
    }


# ----------------------------------------------------------------------
# `calib imu static`: logs of an IMU at rest in, its bias, noise and drift out.

_SENSORS = (
    (
        "g",
        "gyro_bias_radps",
        ("gyro_noise_radps_per_sqrt_Hz", "gyro_instability_radps", "gyro_walk_radps2_per_sqrt_Hz"),
        "gyro_step_radps",
    ),
    (
        "a",
        "accel_mean_mps2",
        ("accel_noise_mps2_per_sqrt_Hz", "accel_instability_mps2", "accel_walk_mps3_per_sqrt_Hz"),
        "accel_step_mps2",
    ),
)
"""First letter of a sensor's axes, and its keys: mean, then N, B and K, then the step."""


def _read_static(files: Files, rig: Rig, options: LogOptions) -> list[Readings]:
    from calib.io.logs import read_log
    from calib.stages.imu.read import rest_log

    del rig
    # What is written to the rig's file does not depend on the folder.
    read = [(path, rest_log(read_log(path, options, files.remarks))) for path in files.paths]
    return [replace(log, source=files.taken(path)) for path, log in read]


def solve_static(logs: Sequence[Readings]) -> Imu:
    """Find bias, noise and drift, judge them, and assemble the section."""
    import numpy as np

    from calib.core.result import finite_or_none, judged
    from calib.core.verdict import Verdict
    from calib.stages.imu.section import Imu
    from calib.stages.imu.static import analyse_static, judge

    result = analyse_static(logs)
    every = [np.where(np.isnan(log.sampling.step), math.inf, log.sampling.step) for log in result.logs]
    steps = dict(zip(result.axes, np.nanmin(every, axis=0).tolist(), strict=True))
    noise = {one.axis: one for one in result.noise}

    def triple(kind: str, value: Callable[[AxisNoise], float]) -> list[float | None]:
        axes = [noise.get(kind + letter) for letter in "xyz"]
        return [None if one is None else finite_or_none(value(one)) for one in axes]

    def term(index: int, name: str) -> Callable[[AxisNoise], float]:
        def value(one: AxisNoise) -> float:
            allan = one.allan
            return math.nan if allan is None else float(getattr((allan.N, allan.B, allan.K)[index], name))

        return value

    values: dict[str, list[float | None]] = {}
    sigma: dict[str, list[float | None]] = {}
    below: dict[str, list[float | None]] = {}
    for kind, mean, densities, step in _SENSORS:
        values[mean] = triple(kind, lambda one: one.bias)
        sigma[mean] = triple(kind, lambda one: one.sigma)
        for index, key in enumerate(densities):
            values[key] = triple(kind, term(index, "value"))
            sigma[key] = triple(kind, term(index, "sigma"))
            below[key] = triple(kind, term(index, "below"))
        values[step] = [finite_or_none(steps.get(kind + letter, math.nan)) for letter in "xyz"]
    drift = {
        name: [math.degrees(one.slope_radps) for one in slopes if one is not None]
        for name, slopes in (
            ("gyro", [log.gyro for log in result.logs]),
            ("onchip", [log.onchip for log in result.logs]),
        )
    }
    return Imu.model_validate(
        {
            "rate_hz": result.rate_hz,
            **values,
            "sigma": {key: row for key, row in sigma.items() if row != [None] * 3},
            "below": {key: row for key, row in below.items() if row != [None] * 3},
            "drift": {
                name: {
                    "mean_degps": float(np.mean(slopes)),
                    "spread_degps": float(np.std(slopes, ddof=1)) if len(slopes) > 1 else None,
                    "logs": len(slopes),
                }
                for name, slopes in drift.items()
                if slopes
            },
            "logs": [_rest_log(log) for log in result.logs],
            **judged(Verdict.of([*judge(result).findings, *_of_sensors(logs)])),
        }
    ).with_evidence(result)


def _rest_log(log: StaticLog) -> ImuLog:
    from calib.stages.imu.section import ImuLog

    gyro, onchip = log.gyro, log.onchip
    return ImuLog(
        name=log.source,
        rest_s=log.rest_s,
        samples=log.sampling.samples,
        **_sampled(log.sampling),
        moves_s=[[motion.from_s, motion.to_s] for motion in log.motions],
        gyro_degps=None if gyro is None else _degrees(gyro.slope_radps),
        gyro_sigma_degps=None if gyro is None else _degrees(gyro.sigma_radps),
        onchip_degps=None if onchip is None else _degrees(onchip.slope_radps),
        onchip_sigma_degps=None if onchip is None else _degrees(onchip.sigma_radps),
    )


def _imu_yaml() -> Kind:
    from calib.stages.imu.formats import IMU_YAML

    return IMU_YAML


def _write_kalibr(files: Files, imu: Imu) -> list[Path]:
    from calib.core.writing import write_atomically
    from calib.stages.imu.formats import IMU_YAML, to_kalibr

    assert files.output is not None
    write_atomically(files.output, to_kalibr(imu), IMU_YAML)
    return [files.output]


def _static_plots(imu: Imu) -> dict[str, Figure]:
    from calib.stages.imu.plots import static_plots

    return static_plots(imu.evidence, imu.verdict.word)


def _static_words(imu: Imu) -> list[Block]:
    from calib.core.words import Line

    del imu
    return [
        Line("± is one standard deviation, < a 95 % bound where the logs are too short for an estimate"),
        Line("accel mean holds gravity: one pose does not tell it from a bias"),
    ]


static = Stage(
    "imu static",
    "IMU at rest",
    """Find bias, noise densities and drift of an IMU from logs at rest, and whether they were at rest.

    Writes the section imu of the rig's file. Exits 1 when the verdict is not ok.
    """,
    _read_static,
    solve_static,
    LogOptions,
    sources="Logs of the rig at rest.",
    metavar="LOG...",
    writes=("imu",),
    output=Output("Kalibr's imu.yaml to write as well.", _write_kalibr, ("--imu-yaml",), kind=_imu_yaml),
    words=_static_words,
    plots=_static_plots,
)


# ----------------------------------------------------------------------
# `calib imu intrinsics`: rests of an IMU in many poses in, its bias, scale and misalignment out.


@dataclass(frozen=True)
class IntrinsicsOptions(LogOptions):
    """What is calibrated, and the inputs' units."""

    accel: Path | None = option(None, "Instead of LOG: lines of t x y z, may be gzipped.")
    gyro: Path | None = option(None, "The gyroscope's file beside --accel.")
    gravity: float = option(9.80665, "Gravity where the log was taken, m/s^2.")
    planar: bool = option(False, "Calibrate ax, ay and gz alone, from tilts about z.")


@dataclass(frozen=True)
class IntrinsicsInputs:
    """A log of rests in many poses, gravity there, and whether x, y and gz alone are calibrated."""

    log: Readings
    gravity_mps2: float = 9.80665
    planar: bool = False


def _read_intrinsics(files: Files, rig: Rig, options: IntrinsicsOptions) -> IntrinsicsInputs:
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
    return IntrinsicsInputs(log, options.gravity, options.planar)


def solve_intrinsics(inputs: IntrinsicsInputs) -> ImuIntrinsics:
    """Calibrate, judge, and assemble the section; what the log does not tell is null."""
    from calib.core.result import finite_or_none, judged
    from calib.stages.imu.intrinsics import find_intrinsics, judge_intrinsics
    from calib.stages.imu.section import ImuIntrinsics

    result = find_intrinsics(inputs.log, inputs.gravity_mps2, inputs.planar)
    return ImuIntrinsics(
        gravity_mps2=result.gravity_mps2,
        planar=result.planar,
        rate_hz=result.sampling.rate_hz,
        rests=len(result.rests),
        poses=result.poses,
        rest_s=sum(rest.duration_s for rest in result.rests),
        degrees_of_freedom=None if result.accel is None else result.accel.dof,
        initial_rest_s=result.quiet.initial_s,
        threshold=result.multiple,
        thresholds={f"{trial.multiple:g}": finite_or_none(trial.rms_mps2) for trial in result.trials},
        accel=_accelerometer(result),
        gyro=None if result.gyro is None else _gyroscope(result, result.gyro),
        **judged(judge_intrinsics(result)),
    ).with_evidence(result)


def _three(values: FloatArray) -> list[float | None]:
    """x, y, z with null for what is not finite or not there."""
    from calib.core.result import finite_or_none

    out = [finite_or_none(value) for value in values.tolist()]
    return out + [None] * (3 - len(out))


def _named(names: Sequence[str], values: FloatArray) -> dict[str, float | None]:
    from calib.core.result import finite_or_none

    pairs = zip(names, values.tolist(), strict=True)
    return {name: finite_or_none(value) for name, value in pairs if not math.isnan(value)}


def _padded(matrix: FloatArray) -> list[list[float]]:
    """A matrix (r, c) as rows of three, zero where there is nothing."""
    import numpy as np

    out = np.zeros((3, 3))
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    rows: list[list[float]] = out.tolist()
    return rows


def _accelerometer(result: Intrinsics) -> AccelIntrinsics:
    import numpy as np

    from calib.stages.imu.intrinsics import ANGLES, LEAST_SPAN
    from calib.stages.imu.section import AccelIntrinsics, IntrinsicsSigma

    unit: Literal["m/s2", "counts"] = "counts" if "a" in result.log.counts else "m/s2"
    accel = result.accel
    if accel is None or accel.span < LEAST_SPAN:
        unknown = _three(np.full(3, math.nan))
        sigma = IntrinsicsSigma(bias=unknown, scale=unknown)
        return AccelIntrinsics(unit=unit, bias=unknown, scale=unknown, sigma=sigma)
    d = len(accel.bias)
    names = ANGLES[d] if accel.skewed else ()
    k = len(names)
    return AccelIntrinsics(
        unit=unit,
        bias=_three(accel.bias),
        scale=_three(accel.scale),
        misalignment_rad=_named(names, accel.angles[:k]),
        sigma=IntrinsicsSigma(
            bias=_three(accel.sigma[:d]),
            scale=_three(accel.sigma[d : 2 * d]),
            misalignment_rad=_named(names, accel.sigma[2 * d : 2 * d + k]),
        ),
        matrix=_padded(accel.matrix),
        rms_mps2=accel.rms_mps2,
        disagreement_mps2=accel.tau_mps2,
    )


def _gyroscope(result: Intrinsics, gyro: Gyroscope) -> GyroIntrinsics:
    import numpy as np

    from calib.stages.imu.intrinsics import GYRO_ANGLES
    from calib.stages.imu.section import GyroIntrinsics, GyroSigma

    used = np.isfinite(gyro.scale)
    known = np.isfinite(gyro.scale_sigma) & used & (result.foreign is None)
    angle_known = np.isfinite(gyro.angle_sigma) & (result.foreign is None)
    bias, names = gyro.bias, tuple(GYRO_ANGLES)
    return GyroIntrinsics(
        unit="counts" if "g" in result.log.counts else "rad/s",
        bias=_three(np.where(used, bias.bias, math.nan)),
        scale=_three(np.where(known, gyro.scale, math.nan)),
        misalignment_rad=_named(names, np.where(angle_known, gyro.angles, math.nan)),
        sigma=GyroSigma(
            bias=_three(np.where(used, bias.sigma, math.nan)),
            scale=_three(np.where(known, gyro.scale_sigma, math.nan)),
            misalignment_rad=_named(names, np.where(angle_known, gyro.angle_sigma, math.nan)),
            sensitivity=None if bias.sensitivity_sigma is None else _padded(bias.sensitivity_sigma),
        ),
        matrix=_padded(gyro.matrix) if known[used].all() else None,
        start_bias=_three(np.where(used, gyro.initial_bias, math.nan)),
        sensitivity=None if bias.sensitivity is None else _padded(bias.sensitivity),
        rms_rad=gyro.rms_rad,
        turns=len(gyro.turns_s),
    )


def _intrinsics_plots(result: ImuIntrinsics) -> dict[str, Figure]:
    from calib.stages.imu.plots import intrinsics_plots

    return intrinsics_plots(result.evidence, result.verdict.word)


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
    solve_intrinsics,
    IntrinsicsOptions,
    sources="Log of rests in many poses, turns between.",
    several=False,
    optional=True,
    metavar="LOG",
    writes=("imu_intrinsics",),
    uses=("imu",),
    plots=_intrinsics_plots,
)


# ----------------------------------------------------------------------
# `calib imu tune`: logs in, gains of the angle filter out, with what they are worth beside 3/3.

_TILTED = 3.0
_RINGS = 0.5


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


@dataclass(frozen=True)
class TuneInputs:
    """Logs of one rate, densities of the sensor and where they are from, whether the up vector is used."""

    logs: Sequence[TuneLog]
    noise: Noise
    densities_from: str
    tilted: bool = False


def _read_tune(files: Files, rig: Rig, options: TuneOptions) -> TuneInputs:
    import numpy as np

    from calib.core.files import shown
    from calib.core.result import identity
    from calib.io.logs import read_log
    from calib.stages.imu.read import Reading, sensor_noise, tune_log

    how = Reading(options.rate == "up", options.reference)
    camera, plane = rig.camera, None
    if options.reference in ("auto", "camera"):
        plane = rig.current_plane(files.rig_path)
    if camera is not None and plane is not None:
        how = replace(how, camera=camera.optics, A_inverse=np.array(plane.A_inverse))
    logs: list[TuneLog] = []
    for path in files.paths:
        log = tune_log(read_log(path, options, files.remarks), how)
        files.remarks += log.said
        name = files.taken(path)
        # What is written to the rig's file does not depend on the folder.
        logs.append(replace(log, source=name, pieces=tuple(replace(p, source=name) for p in log.pieces)))
        first = logs[0].sampling.rate_hz
        if abs(log.sampling.rate_hz / first - 1.0) > _SAME_RATE:
            raise BadInputError(
                f"{shown(path)}: is sampled at {log.sampling.rate_hz:.4g} Hz, expected {first:.4g} Hz as in "
                f"{logs[0].source}"
            )
    if rig.imu is not None:
        files.hashes["imu"] = identity(rig.imu)
    if camera is not None and plane is not None and any(log.reference == "camera" for log in logs):
        files.hashes |= {"camera": identity(camera), "plane": identity(plane)}
    return TuneInputs(logs, *sensor_noise(rig, logs), how.tilted)


def solve_tune(inputs: TuneInputs) -> OrientationFilter:
    """Tune, judge on what was held back, and assemble the section."""
    import numpy as np

    from calib.core.result import finite_or_none, judged
    from calib.core.verdict import Finding, Verdict
    from calib.stages.imu.levelling import Levelling
    from calib.stages.imu.section import OrientationFilter
    from calib.stages.imu.tuning import tune

    logs = inputs.logs
    pieces = [piece for log in logs for piece in log.pieces]
    result = tune(pieces, inputs.noise)
    dt_s = float(np.median([log.sampling.period_s for log in logs]))
    chosen, mahony = result.recommended, result.mahony
    levelling = next((one.gains for one in result.candidates if isinstance(one.gains, Levelling)), None)
    held_out = [[one.Kp, one.Ki] for one in result.held_out]
    sigma: dict[str, float | None] = {}
    if held_out and chosen.name == "tuned":
        # The jackknife's deviation.
        spread = np.std(np.array(held_out), axis=0) * math.sqrt(len(held_out) - 1)
        sigma = dict(zip(("Kp_per_s", "Ki_per_s2"), spread.tolist(), strict=True))
    by: Literal["reference", "smoothed", "default"] = "default"
    if chosen.name != "3/3":
        by = "reference" if result.judge == "reference" else "smoothed"
    severity: Literal["poor", "remark"] = "poor" if result.judge == "none" else "remark"
    findings = [Finding(severity, text) for text in result.reasons]
    findings += [one for one in _of_sensors(logs) if one.severity != "remark"]
    firsts = np.cumsum([0, *(len(log.pieces) for log in logs)]).tolist()
    return OrientationFilter(
        filter="levelling" if chosen.gains is levelling else "mahony",
        Kp_per_s=mahony.Kp,
        Ki_per_s2=mahony.Ki,
        tau_s=None if levelling is None else levelling.tau_s,
        velocity_mps=None if levelling is None else levelling.velocity_mps,
        rate_hz=1.0 / dt_s,
        recommended=chosen.name,
        recommended_by=by,
        rate_of_angle="up vector" if inputs.tilted else "-gz",
        sigma=sigma,
        held_out=held_out,
        candidates={one.name: _candidate(one, dt_s) for one in result.candidates},
        densities={
            "gyro_radps_per_sqrt_Hz": result.noise.gyro,
            "walk_radps2_per_sqrt_Hz": result.noise.walk,
            "angle_rad_per_sqrt_Hz": result.noise.accel,
        },
        densities_from=inputs.densities_from,
        judged_s=result.judged_s,
        block_s=finite_or_none(result.block_s),
        logs=[_filter_log(log, result, k) for log, k in zip(logs, firsts, strict=False)],
        **judged(Verdict.of([*findings, *_of_tuning(result, logs, inputs.tilted)])),
    ).with_evidence((result, pieces))


def _parameters(gains: AngleFilter) -> dict[str, float]:
    """The parameters of a filter by their keys."""
    from calib.stages.imu.mahony import Mahony

    if isinstance(gains, Mahony):
        return {"Kp_per_s": gains.Kp, "Ki_per_s2": gains.Ki}
    return {"tau_s": gains.tau_s, "velocity_mps": gains.velocity_mps}


def _candidate(one: Candidate, dt_s: float) -> FilterCandidate:
    from calib.core.result import finite_or_none
    from calib.stages.imu.section import FilterCandidate
    from calib.stages.imu.tuning import gain_facts

    def interval(low: float, high: float) -> list[float] | None:
        return [math.degrees(low), math.degrees(high)] if math.isfinite(low) else None

    facts = gain_facts(one.gains, dt_s)
    return FilterCandidate(
        **_parameters(one.gains),
        poles=[[p.real, p.imag] for p in facts.poles],
        bandwidth_hz=facts.bandwidth_hz,
        noise_gain=facts.noise_gain,
        bias_gain_s=facts.bias_gain_s,
        bias_peak_s=facts.bias_peak_s,
        settling_s=finite_or_none(facts.settling_s),
        bias_settling_s=finite_or_none(facts.bias_settling_s),
        lag_s=finite_or_none(facts.lag_s),
        rmse_deg=_degrees(one.rmse_rad),
        interval_deg=interval(one.low_rad, one.high_rad),
        less_than_3_3_deg=_degrees(one.less_rad),
        less_interval_deg=interval(one.less_low_rad, one.less_high_rad),
        confidence=finite_or_none(one.confidence),
        whole_rmse_deg=_degrees(one.whole_rad),
    )


def _filter_log(log: TuneLog, result: Tuning, first: int) -> FilterLog:
    """A log whose first piece is the tuning's piece of this number."""
    from calib.stages.imu.section import FilterLog

    s, own = log.sampling, result.smoothed[first]
    return FilterLog(
        name=log.source,
        duration_s=s.duration_s,
        samples=s.samples,
        missing=s.missing,
        pieces=len(log.pieces),
        repeated_rows=s.repeated_rows,
        repeated_stamps=s.repeated_stamps,
        reference=log.reference or None,
        reference_offset_deg=math.degrees(result.offset_rad[first]) if log.reference else None,
        reference_lag_s=log.lag_s if log.reference else None,
        rate_error_degps_per_sqrt_Hz=None if own is None else math.degrees(own.gyro_noise),
        angle_error_deg_per_sqrt_Hz=None if own is None else math.degrees(own.accel_noise),
        smoothed_sigma_deg=None if own is None else math.degrees(own.sigma_rad),
        bias_degps=None if own is None else math.degrees(own.bias_radps),
    )


def _of_tuning(result: Tuning, logs: Sequence[TuneLog], tilted: bool) -> Iterator[Finding]:
    """What is to be known of the gains, and of the logs that they are from."""
    from calib.core.verdict import Finding
    from calib.stages.imu.mahony import Mahony
    from calib.stages.imu.tuning import contradictions

    pieces = [piece for log in logs for piece in log.pieces]
    yield from contradictions(pieces, result)
    gains, base = result.recommended.gains, result.candidates[0]
    if isinstance(gains, Mahony) and gains.Kp < 2.0 * _RINGS * math.sqrt(gains.Ki):
        yield Finding(
            "remark",
            f"The pair is damped by {gains.Kp / (2.0 * math.sqrt(gains.Ki)):.2f} only and rings: it serves a "
            "start from an unknown bias; a bias that is subtracted before allows a calmer one.",
        )
    for one in result.candidates[1:]:
        if one.name == "riccati" and one.whole_rad > 1.5 * base.whole_rad:
            yield Finding(
                "remark",
                "The settled Kalman filter, riccati, takes longer than these logs to learn the bias.",
            )
    worst = max((s.gyro_noise for s in result.smoothed if s is not None), default=0.0)
    if worst > _TILTED * result.noise.gyro and not tilted:
        yield Finding(
            "remark",
            f"-gz errs by {math.degrees(worst):.2g} deg/s/sqrt(Hz) as the angle's rate, the sensor by "
            f"{math.degrees(result.noise.gyro):.2g}: it may be tilted out of the plane or its scale be off; "
            "with all six axes --rate up takes the tilt out.",
        )
    if result.judge == "smoothed":
        yield Finding("remark", "Without a reference the logs are judged by their own smoothed angle.")
    for log in logs:
        if log.lag_s:
            yield Finding("remark", f"{log.source}: {log.reference} came {1e3 * log.lag_s:.1f} ms late.")


def _tune_plots(section: OrientationFilter) -> dict[str, Figure]:
    from calib.stages.imu.plots import tune_plots

    result, pieces = section.evidence
    return tune_plots(result, pieces, section)


def _tune_words(section: OrientationFilter) -> list[Block]:
    from calib.core.words import Line

    del section
    return [
        Line("noise: variance of the angle over that of the accelerometer's; peak: angle per rate's bias"),
        Line("each part of the logs is judged with gains of the others"),
    ]


tune = Stage(
    "imu tune",
    "Angle filter",
    """Tune angle filters on logs, judge them on parts they were not tuned on, and keep 3/3 unless one wins.

    Uses the sections imu, camera and plane of the rig's file where they are, and writes its section
    orientation_filter. Exits 1 when the logs do not allow a judgement.
    """,
    _read_tune,
    solve_tune,
    TuneOptions,
    sources="Logs of the rig in motion.",
    metavar="LOG...",
    writes=("orientation_filter",),
    uses=("imu", "imu_intrinsics", "camera", "plane"),
    words=_tune_words,
    plots=_tune_plots,
)


# ----------------------------------------------------------------------
# `calib imu drift`: the same logs through every way of getting the angle, and how each drifts.

_LEAST_UPRIGHT = 0.1
_ABOUT = {
    "truth": "error against true_phi_rad, without the first seconds",
    "rest": "angle in the stretches at rest, without their first seconds; the offset is against the "
    "accelerometer's mean angle",
    "nothing": "the log never rests and has no true_phi_rad, so that it shows no drift",
}
_INTERVALS = (
    "intervals allow for errors that hang together in time (white noise on a process of order one or a "
    "random walk, by restricted likelihood); RMSE is in motion, without the constant mount offset; a "
    "positive lag is late"
)


@dataclass(frozen=True)
class DriftOptions(LogOptions):
    """Which filters are compared."""

    peers: bool = option(True, "Run the filters of the extra peers as well.", flag="peers/--no-peers")


@dataclass(frozen=True)
class DriftInputs:
    """Logs, their hashes, the rig's gains, and whether filters of others run."""

    logs: Sequence[Readings]
    hashes: dict[str, str]
    tuned: Tuned | None
    peers: bool
    narrate: Callable[[str], None]


def _read_drift(files: Files, rig: Rig, options: DriftOptions) -> DriftInputs:
    from calib.io.logs import read_log
    from calib.stages.imu.levelling import Levelling
    from calib.stages.imu.mahony import Mahony
    from calib.stages.imu.read import drift_log
    from calib.stages.imu.tracks import Tuned

    read = [(path, drift_log(read_log(path, options, files.remarks))) for path in files.paths]
    logs = [replace(log, source=files.taken(path)) for path, log in read]
    tuned, section = None, rig.orientation_filter
    if section is not None:
        gains: AngleFilter = Mahony(section.Kp_per_s, section.Ki_per_s2)
        if section.filter == "levelling" and section.tau_s and section.velocity_mps:
            gains = Levelling(section.tau_s, section.velocity_mps)
        tuned = Tuned(gains, section.rate_of_angle == "up vector")
    return DriftInputs(logs, dict(files.hashes), tuned, options.peers, files.narrate)


def solve_drift(inputs: DriftInputs) -> Drift:
    """Every way of getting the angle on every log, and how each drifts."""
    from calib.core.result import judged
    from calib.core.verdict import Verdict
    from calib.stages.imu.drift import NOT_A_RANKING, analyse_drift, spread_of
    from calib.stages.imu.mahony import Mahony
    from calib.stages.imu.section import Drift, DriftGains, DriftSlopes

    tuned = inputs.tuned
    logs = [analyse_drift(log, tuned, inputs.peers, inputs.narrate) for log in inputs.logs]
    return Drift(
        note=NOT_A_RANKING,
        logs=[_drift_log(log) for log in logs],
        methods={
            one.name: DriftSlopes(
                mean_degps=_degrees(one.mean_radps), spread_degps=_degrees(one.spread_radps), logs=one.logs
            )
            for one in spread_of(logs)
        },
        provenance={"inputs": inputs.hashes},
        tuned=None
        if tuned is None
        else DriftGains(
            filter="mahony" if isinstance(tuned.gains, Mahony) else "levelling",
            **_parameters(tuned.gains),
            rate_of_angle="up vector" if tuned.up_vector else "-gz",
        ),
        **judged(Verdict.of(_of_sensors(inputs.logs))),
    ).with_evidence(logs)


def _drift_log(log: LogDrift) -> DriftOfLog:
    from calib.stages.imu.sampling import sampling_findings
    from calib.stages.imu.section import DriftOfLog

    remarks = [finding.text for finding in sampling_findings(log.sampling, source=log.source)]
    if log.upright < _LEAST_UPRIGHT:
        tilt = math.degrees(math.acos(math.sqrt(log.upright)))
        remarks.append(
            f"{log.source}: gravity is {tilt:.0f} degrees out of the sensor's x-y plane, where the angle "
            "atan2(ay, ax) is hardly defined; noise and drift of all methods are large for that reason"
        )
    return DriftOfLog(
        name=log.source,
        **_sampled(log.sampling),
        against=log.against,
        about=_ABOUT[log.against],
        judged_s=log.judged_s,
        moving_s=log.moving_s,
        methods={m.name: _method(m) for m in log.measures},
        skipped=list(log.skipped),
        remarks=remarks,
    )


def _method(m: Measures) -> DriftMethod:
    from calib.core.result import finite_or_none
    from calib.stages.imu.section import DriftMethod

    return DriftMethod(
        offset_deg=_degrees(m.offset_rad),
        slope_degps=_degrees(m.slope.value),
        sigma_degps=_degrees(m.slope.sigma),
        interval_degps=[_degrees(m.slope.low), _degrees(m.slope.high)],
        allan_1s_deg=_degrees(m.allan_1s_rad),
        allan_100s_deg=_degrees(m.allan_100s_rad),
        rmse_deg=_degrees(m.rmse_rad),
        lag_ms=finite_or_none(1e3 * m.lag_s),
    )


def _drift_document(result: Drift) -> dict[str, Any]:
    from calib.core.result import section_json

    return {"drift": section_json(result)}


def _drift_words(result: Drift) -> list[Block]:
    """A table of the methods for each log, then the slopes over all."""
    from calib.core.words import Line, described, listed

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


def _drift_plots(result: Drift) -> dict[str, Figure]:
    from calib.stages.imu.plots import drift_plots

    return drift_plots(result.evidence)


drift = Stage(
    "imu drift",
    "Drift of the angle",
    """Compare how the angle drifts by the chip, the sensors alone, the MM filter and filters of others.

    Tuned gains are read from the rig's file, to which nothing is written.
    """,
    _read_drift,
    solve_drift,
    DriftOptions,
    sources="Logs of the rig, at rest or in motion.",
    metavar="LOG...",
    uses=("imu", "imu_intrinsics", "orientation_filter"),
    document=_drift_document,
    words=_drift_words,
    plots=_drift_plots,
)

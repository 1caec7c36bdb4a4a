"""Results of the IMU's stages as sections of rig.yaml and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import one_line
from calib.core.result import finite_or_none
from calib.core.rig import Rig
from calib.stages.imu.allan import Term
from calib.stages.imu.drift import NOT_A_RANKING, LogDrift, Measures, spread_of
from calib.stages.imu.intrinsics import (
    ANGLES,
    GYRO_ANGLES,
    LEAST_SPAN,
    Gyroscope,
    Intrinsics,
    IntrinsicsJudgement,
)
from calib.stages.imu.mahony import Mahony
from calib.stages.imu.read import TuneLog
from calib.stages.imu.section import (
    AccelIntrinsics,
    FilterCandidate,
    FilterLog,
    GyroIntrinsics,
    GyroSigma,
    Imu,
    ImuDrift,
    ImuIntrinsics,
    ImuLog,
    IntrinsicsSigma,
    OrientationFilter,
)
from calib.stages.imu.static import AxisNoise, Drift, Judgement, Static, StaticLog
from calib.stages.imu.tracks import Tuned
from calib.stages.imu.tuning import Candidate, Smoothed, Tuning, gain_facts

# ----------------------------------------------------------------------
# The noise of an IMU out of Kalibr's imu.yaml; `calib.stages.imu.results.kalibr_imu` writes one.
#
# Kalibr has one number for all axes of a sensor and no biases. Both use the same definitions:
# continuous-time densities N [m/s^2/sqrt(Hz), rad/s/sqrt(Hz)] and K of the bias' random walk
# [m/s^3/sqrt(Hz), rad/s^2/sqrt(Hz)], slopes -1/2 and +1/2 of the Allan deviation (IEEE Std 952-1997, C.1).

_KEYS = {
    "accelerometer_noise_density": "accel_noise_mps2_per_sqrt_Hz",
    "accelerometer_random_walk": "accel_walk_mps3_per_sqrt_Hz",
    "gyroscope_noise_density": "gyro_noise_radps_per_sqrt_Hz",
    "gyroscope_random_walk": "gyro_walk_radps2_per_sqrt_Hz",
}


def from_kalibr_imu(document: Mapping[str, Any]) -> Imu:
    """The section `imu` of an imu.yaml, which may also lie under `imu0` as in Kalibr's results.

    Raises `BadInputError` naming the key that is missing or wrong.
    """
    inner = document.get("imu0")
    if isinstance(inner, Mapping):
        document = inner
    if not any(key in document for key in _KEYS):
        raise BadInputError(f"{next(iter(_KEYS))} is missing")
    # A file may be of one sensor only, then of it whole.
    values = {}
    for key, name in _KEYS.items():
        sensor = key.split("_")[0]
        if any(other.startswith(sensor) for other in document if isinstance(other, str)):
            values[name] = _number(document, key)
    rate_hz = _number(document, "update_rate")
    if rate_hz == 0.0:
        raise BadInputError("update_rate is 0, expected a positive number")
    unknown = (
        "gyro_bias_radps", "gyro_instability_radps", "accel_mean_mps2", "accel_instability_mps2",
        "gyro_step_radps", "accel_step_mps2",
    )  # fmt: skip
    section: dict[str, Any] = {name: [None] * 3 for name in unknown}
    section |= {name: [values.get(name)] * 3 for name in _KEYS.values()}
    section |= {"rate_hz": rate_hz, "verdict": "poor"}
    section["reasons"] = ["Imported from Kalibr's imu.yaml, which holds no biases and no error bars."]
    return Imu.model_validate(section)


def _number(document: Mapping[str, Any], key: str) -> float:
    if key not in document:
        raise BadInputError(f"{key} is missing")
    value = document[key]
    if isinstance(value, str):
        # YAML 1.1 takes 2e-3 for text.
        try:
            value = float(value)
        except ValueError:
            value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInputError(f"{key} is {one_line(repr(document[key]))[:60]}, expected a number")
    if not math.isfinite(value) or value < 0.0:
        raise BadInputError(f"{key} is {value:g}, expected a number that is not negative")
    return float(value)


# ----------------------------------------------------------------------
# An IMU at rest as the section `imu` of rig.yaml, and as Kalibr's imu.yaml.

Triple = list[float | None]
_IMUSECTIONS_KEYS = {
    "g": (
        "gyro_bias_radps",
        "gyro_noise_radps_per_sqrt_Hz",
        "gyro_instability_radps",
        "gyro_walk_radps2_per_sqrt_Hz",
        "gyro_step_radps",
    ),
    "a": (
        "accel_mean_mps2",
        "accel_noise_mps2_per_sqrt_Hz",
        "accel_instability_mps2",
        "accel_walk_mps3_per_sqrt_Hz",
        "accel_step_mps2",
    ),
}


def _triple(result: Static, kind: str, value: Callable[[AxisNoise], float]) -> Triple:
    by_axis = {noise.axis: value(noise) for noise in result.noise}
    return [finite_or_none(by_axis.get(kind + letter, math.nan)) for letter in "xyz"]


def _term(index: int) -> Callable[[AxisNoise], Term | None]:
    return lambda noise: None if noise.allan is None else (noise.allan.N, noise.allan.B, noise.allan.K)[index]


def _of(index: int, name: str) -> Callable[[AxisNoise], float]:
    def value(noise: AxisNoise) -> float:
        term = _term(index)(noise)
        return math.nan if term is None else float(getattr(term, name))

    return value


def _degrees(value: float | None) -> float | None:
    return None if value is None else finite_or_none(math.degrees(value))


def _log(log: StaticLog) -> ImuLog:
    s = log.sampling
    gyro, onchip = log.gyro, log.onchip
    return ImuLog(
        name=log.source,
        duration_s=s.duration_s,
        rest_s=log.rest_s,
        samples=s.samples,
        rate_hz=s.rate_hz,
        jitter_s=s.jitter_s,
        missing=s.missing,
        gaps=sum(not gap.split for gap in s.gaps),
        splits=sum(gap.split for gap in s.gaps),
        repeated_rows=s.repeated_rows,
        repeated_stamps=s.repeated_stamps,
        moves_s=[[motion.from_s, motion.to_s] for motion in log.motions],
        gyro_degps=_degrees(gyro.slope_radps if gyro else None),
        gyro_sigma_degps=_degrees(gyro.sigma_radps if gyro else None),
        onchip_degps=_degrees(onchip.slope_radps if onchip else None),
        onchip_sigma_degps=_degrees(onchip.sigma_radps if onchip else None),
    )


def _drift(slopes: list[Drift]) -> ImuDrift:
    values = np.degrees([slope.slope_radps for slope in slopes])
    spread = float(values.std(ddof=1)) if len(values) > 1 else None
    return ImuDrift(mean_degps=float(values.mean()), spread_degps=spread, logs=len(values))


def imu_section(result: Static, judgement: Judgement) -> Imu:
    """The `imu` section of an analysis of logs at rest."""
    values: dict[str, Triple] = {}
    sigma: dict[str, Triple] = {}
    below: dict[str, Triple] = {}
    steps = np.nanmin(
        [np.where(np.isnan(log.sampling.step), math.inf, log.sampling.step) for log in result.logs], axis=0
    )
    for kind, (bias, *terms, step) in _IMUSECTIONS_KEYS.items():
        values[bias] = _triple(result, kind, lambda noise: noise.bias)
        sigma[bias] = _triple(result, kind, lambda noise: noise.sigma)
        for index, key in enumerate(terms):
            values[key] = _triple(result, kind, _of(index, "value"))
            sigma[key] = _triple(result, kind, _of(index, "sigma"))
            below[key] = _triple(result, kind, _of(index, "below"))
        by_axis = dict(zip(result.axes, steps.tolist(), strict=True))
        values[step] = [finite_or_none(by_axis.get(kind + letter, math.nan)) for letter in "xyz"]
    drifts = {
        "gyro": [log.gyro for log in result.logs if log.gyro is not None],
        "onchip": [log.onchip for log in result.logs if log.onchip is not None],
    }

    def told(table: dict[str, Triple]) -> dict[str, Triple]:
        return {key: row for key, row in table.items() if any(value is not None for value in row)}

    return Imu.model_validate(
        {
            "rate_hz": result.rate_hz,
            **values,
            "sigma": told(sigma),
            "below": told(below),
            "drift": {name: _drift(slopes) for name, slopes in drifts.items() if slopes},
            "logs": [_log(log) for log in result.logs],
            "verdict": judgement.verdict,
            "reasons": list(judgement.reasons),
            "remarks": list(judgement.remarks),
            "advice": list(judgement.advice),
        }
    )


def _largest(section: Imu, key: str) -> tuple[float | None, bool]:
    """The largest of the axes, bounds counting where there is no estimate, and whether it is a bound."""
    estimates = [value for value in getattr(section, key) if value is not None]
    limits = [value for value in section.below.get(key, []) if value is not None]
    if not estimates and not limits:
        return None, False
    largest = max([*estimates, *limits])
    return largest, largest not in estimates


def kalibr_imu(section: Imu, topic: str = "/imu0") -> str:
    """Kalibr's imu.yaml: densities in continuous time, of each sensor's worst axis.

    What the logs do not show is given by its upper bound, which a comment says; a sensor that was not
    logged has no keys.
    """
    lines = []
    for name, kind in (("accelerometer", "a"), ("gyroscope", "g")):
        for key, what in (
            (_IMUSECTIONS_KEYS[kind][1], "noise_density"),
            (_IMUSECTIONS_KEYS[kind][3], "random_walk"),
        ):
            value, bound = _largest(section, key)
            unit = key.split("_", 2)[2].replace("_per_sqrt_Hz", "/sqrt(Hz)").replace("radps2", "rad/s^2")
            unit = unit.replace("mps3", "m/s^3").replace("mps2", "m/s^2").replace("radps", "rad/s")
            if value is not None:
                note = ", an upper bound: the log is too short to show it" if bound else ""
                lines.append(f"{name}_{what}: {value:.6e}  # {unit}{note}")
    lines += [f"rostopic: {topic}", f"update_rate: {section.rate_hz:.6f}"]
    return "\n".join(lines) + "\n"


# ----------------------------------------------------------------------
# An IMU's intrinsics as the section `imu_intrinsics` of rig.yaml.

_NONE: list[float | None] = [None, None, None]


def _three(values: FloatArray) -> list[float | None]:
    """x, y, z with null for what is not finite or not there."""
    out = [finite_or_none(value) for value in values.tolist()]
    return out + [None] * (3 - len(out))


def _named(names: Sequence[str], values: FloatArray) -> dict[str, float | None]:
    return {
        name: finite_or_none(value)
        for name, value in zip(names, values.tolist(), strict=True)
        if not math.isnan(value)
    }


def _padded(matrix: FloatArray) -> list[list[float]]:
    """A matrix (r, c) as rows of three, zero where there is nothing."""
    out = np.zeros((3, 3))
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    rows: list[list[float]] = out.tolist()
    return rows


def _accel(result: Intrinsics) -> AccelIntrinsics:
    unit: Literal["m/s2", "counts"] = "counts" if result.log.accel_unit == "counts" else "m/s2"
    accel = result.accel
    if accel is None:
        unknown = IntrinsicsSigma(bias=_NONE, scale=_NONE)
        return AccelIntrinsics(unit=unit, bias=_NONE, scale=_NONE, sigma=unknown)
    d = len(accel.bias)
    told = accel.span >= LEAST_SPAN
    nothing = np.full(d, math.inf)
    sigma = accel.sigma if told else np.full(len(accel.sigma), math.inf)
    names = ANGLES[d] if accel.skewed and told else ()
    k = len(names)
    return AccelIntrinsics(
        unit=unit,
        bias=_three(accel.bias if told else nothing),
        scale=_three(accel.scale if told else nothing),
        misalignment_rad=_named(names, accel.angles[:k]),
        sigma=IntrinsicsSigma(
            bias=_three(sigma[:d]),
            scale=_three(sigma[d : 2 * d]),
            misalignment_rad=_named(names, sigma[2 * d : 2 * d + k]),
        ),
        matrix=_padded(accel.matrix) if told else None,
        rms_mps2=accel.rms_mps2 if told else None,
        disagreement_mps2=accel.tau_mps2 if told else None,
    )


def _gyro(result: Intrinsics, gyro: Gyroscope) -> GyroIntrinsics:
    unit: Literal["rad/s", "counts"] = "counts" if result.log.gyro_unit == "counts" else "rad/s"
    used = np.isfinite(gyro.scale)
    told = np.isfinite(gyro.scale_sigma) & used & (result.foreign is None)
    angle_told = np.isfinite(gyro.angle_sigma) & (result.foreign is None)
    scale, angles = np.where(told, gyro.scale, math.nan), np.where(angle_told, gyro.angles, math.nan)
    bias, names = gyro.bias, tuple(GYRO_ANGLES)
    return GyroIntrinsics(
        unit=unit,
        bias=_three(np.where(used, bias.bias, math.nan)),
        scale=_three(scale),
        misalignment_rad=_named(names, angles),
        sigma=GyroSigma(
            bias=_three(np.where(used, bias.sigma, math.nan)),
            scale=_three(np.where(told, gyro.scale_sigma, math.nan)),
            misalignment_rad=_named(names, np.where(angle_told, gyro.angle_sigma, math.nan)),
            sensitivity=None if bias.sensitivity_sigma is None else _padded(bias.sensitivity_sigma),
        ),
        matrix=_padded(gyro.matrix) if told[used].all() else None,
        start_bias=_three(np.where(used, gyro.initial_bias, math.nan)),
        sensitivity=None if bias.sensitivity is None else _padded(bias.sensitivity),
        rms_rad=gyro.rms_rad,
        turns=len(gyro.turns_s),
    )


def intrinsics_section(result: Intrinsics, judgement: IntrinsicsJudgement) -> ImuIntrinsics:
    """The `imu_intrinsics` section of a calibration; what the log does not tell is null."""
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
        accel=_accel(result),
        gyro=None if result.gyro is None else _gyro(result, result.gyro),
        verdict=judgement.verdict,  # type: ignore[arg-type]  # pydantic checks the word
        reasons=list(judgement.reasons),
        remarks=list(judgement.remarks),
        advice=list(judgement.advice),
    )


# ----------------------------------------------------------------------
# A tuning of the angle filter as the section `orientation_filter` of rig.yaml.

_TILTED = 3.0
_RINGS = 0.5


def _tunesections_degrees(value: float) -> float | None:
    return finite_or_none(math.degrees(value))


def _pair(low: float, high: float) -> list[float] | None:
    return [math.degrees(low), math.degrees(high)] if math.isfinite(low) else None


def _candidate(one: Candidate, dt_s: float) -> FilterCandidate:
    facts = gain_facts(one.gains, dt_s)
    return FilterCandidate(
        Kp_per_s=one.gains.Kp,
        Ki_per_s2=one.gains.Ki,
        poles=[[p.real, p.imag] for p in facts.poles],
        bandwidth_hz=facts.bandwidth_hz,
        noise_gain=facts.noise_gain,
        bias_gain_s=facts.bias_gain_s,
        bias_peak_s=facts.bias_peak_s,
        settling_s=finite_or_none(facts.settling_s),
        bias_settling_s=finite_or_none(facts.bias_settling_s),
        lag_s=finite_or_none(facts.lag_s),
        rmse_deg=_tunesections_degrees(one.rmse_rad),
        interval_deg=_pair(one.low_rad, one.high_rad),
        less_than_3_3_deg=_tunesections_degrees(one.less_rad),
        less_interval_deg=_pair(one.less_low_rad, one.less_high_rad),
        confidence=finite_or_none(one.confidence),
        whole_rmse_deg=_tunesections_degrees(one.whole_rad),
    )


def _tunesections_log(log: TuneLog, offset_rad: float, smoothed: Smoothed | None) -> FilterLog:
    s = log.sampling
    own = smoothed
    return FilterLog(
        name=log.source,
        duration_s=s.duration_s,
        samples=s.samples,
        missing=s.missing,
        pieces=len(log.pieces),
        repeated_rows=s.repeated_rows,
        repeated_stamps=s.repeated_stamps,
        reference=log.reference or None,
        reference_offset_deg=math.degrees(offset_rad) if log.reference else None,
        reference_lag_s=log.lag_s if log.reference else None,
        rate_error_degps_per_sqrt_Hz=None if own is None else math.degrees(own.gyro_noise),
        angle_error_deg_per_sqrt_Hz=None if own is None else math.degrees(own.accel_noise),
        smoothed_sigma_deg=None if own is None else math.degrees(own.sigma_rad),
        bias_degps=None if own is None else math.degrees(own.bias_radps),
    )


def _remarks(result: Tuning, logs: Sequence[TuneLog], tilted: bool) -> list[str]:
    remarks = []
    chosen = result.recommended
    base = result.candidates[0]
    damping = chosen.gains.Kp / (2.0 * math.sqrt(chosen.gains.Ki)) if chosen.gains.Ki > 0.0 else math.inf
    if damping < _RINGS:
        remarks.append(
            f"The pair is damped by {damping:.2f} only and rings: it serves a start from an unknown bias; "
            "a bias that is subtracted before allows a calmer one."
        )
    remarks += [
        f"With gains that start large, {one.name}, {math.degrees(one.rmse_rad):.3f} deg are left, as "
        "the bias is learnt in a second or so."
        for one in result.candidates[3:]
        if one.rmse_rad < 0.9 * min(chosen.rmse_rad, base.rmse_rad)
    ]
    remarks += [
        "The settled Kalman filter, riccati, takes longer than these logs to learn the bias."
        for one in result.candidates[1:]
        if one.name == "riccati" and one.whole_rad > 1.5 * base.whole_rad
    ]
    worst = max((s.gyro_noise for s in result.smoothed if s is not None), default=0.0)
    if worst > _TILTED * result.noise.gyro and not tilted:
        remarks.append(
            f"-gz errs by {math.degrees(worst):.2g} deg/s/sqrt(Hz) as the angle's rate, the sensor by "
            f"{math.degrees(result.noise.gyro):.2g}: it may be tilted out of the plane or its scale be off; "
            "with all six axes --rate up takes the tilt out."
        )
    if result.judge == "smoothed":
        remarks.append("Without a reference the logs are judged by their own smoothed angle.")
    late = [log for log in logs if log.lag_s]
    remarks += [f"{log.source}: {log.reference} came {1e3 * log.lag_s:.1f} ms late." for log in late]
    return remarks


def filter_section(
    result: Tuning, logs: Sequence[TuneLog], densities_from: str, tilted: bool = False
) -> OrientationFilter:
    """The section of a tuning; `logs` are those that it was made from, in order."""
    dt_s = float(np.median([log.sampling.period_s for log in logs]))
    chosen: Mahony = result.recommended.gains
    sigma: dict[str, float | None] = {}
    halves = []
    if result.halves is not None:
        first, second = result.halves
        halves = [[first.Kp, first.Ki], [second.Kp, second.Ki]]
        if result.recommended.name == "tuned":
            sigma = {
                "Kp_per_s": 0.5 * abs(first.Kp - second.Kp),
                "Ki_per_s2": 0.5 * abs(first.Ki - second.Ki),
            }
    by: Literal["reference", "smoothed", "default"] = "default"
    if result.recommended.name != "3/3":
        by = "reference" if result.judge == "reference" else "smoothed"
    told, k = [], 0
    for log in logs:
        told.append(_tunesections_log(log, result.offset_rad[k], result.smoothed[k]))
        k += len(log.pieces)
    noise = result.noise
    return OrientationFilter(
        Kp_per_s=chosen.Kp,
        Ki_per_s2=chosen.Ki,
        rate_hz=1.0 / dt_s,
        recommended=result.recommended.name,
        recommended_by=by,
        rate_of_angle="up vector" if tilted else "-gz",
        sigma=sigma,
        halves=halves,
        candidates={one.name: _candidate(one, dt_s) for one in result.candidates},
        densities={
            "gyro_radps_per_sqrt_Hz": noise.gyro,
            "walk_radps2_per_sqrt_Hz": noise.walk,
            "angle_rad_per_sqrt_Hz": noise.accel,
        },
        densities_from=densities_from,
        judged_s=result.judged_s,
        block_s=finite_or_none(result.block_s),
        logs=told,
        verdict="poor" if result.judge == "none" else "ok",
        reasons=list(result.reasons),
        remarks=_remarks(result, logs, tilted),
    )


# ----------------------------------------------------------------------
# The drift comparison as plain values for the JSON document, and as sentences about the sampling.

_LEAST_UPRIGHT = 0.1

_ABOUT = {
    "truth": "error against true_phi_rad; slope, offset and Allan deviation without the first seconds",
    "rest": "angle in the stretches at rest, without their first seconds; the offset is against the "
    "accelerometer's mean angle",
    "nothing": "the log never rests and has no true_phi_rad, so that it shows no drift",
}


def tuned_filter(rig: Rig) -> Tuned | None:
    """What the section orientation_filter recommends, None where the rig has none."""
    section = rig.orientation_filter
    if section is None:
        return None
    return Tuned(Mahony(section.Kp_per_s, section.Ki_per_s2), section.rate_of_angle == "up vector")


def sampling_remarks(log: LogDrift) -> list[str]:
    """Sentences about gaps and repeated rows of a log, and about a sensor that lies flat."""
    s = log.sampling
    said = [
        f"{log.source}: split at a gap of {gap.duration_s:.4g} s after {gap.at_s:.2f} s"
        for gap in s.gaps
        if gap.split
    ]
    short = [gap for gap in s.gaps if not gap.split]
    if short:
        longest = max(short, key=lambda gap: gap.duration_s)
        said.append(
            f"{log.source}: {s.missing} samples missing in {len(short)} gap(s), the longest "
            f"{1e3 * longest.duration_s:.3g} ms after {longest.at_s:.2f} s; filled by straight lines"
        )
    if s.repeated_rows:
        share = s.repeated_rows / (s.samples + s.repeated_rows)
        said.append(f"{log.source}: {s.repeated_rows} rows ({share:.2%}) repeat the one before; dropped")
    if s.repeated_stamps:
        said.append(
            f"{log.source}: {s.repeated_stamps} time stamps ({s.repeated_stamps / s.samples:.2%}) repeat the "
            "one before with other readings; counted as samples of their own"
        )
    if log.upright < _LEAST_UPRIGHT:
        tilt = math.degrees(math.acos(math.sqrt(log.upright)))
        said.append(
            f"{log.source}: gravity is {tilt:.0f} degrees out of the sensor's x-y plane, where the angle "
            "atan2(ay, ax) is hardly defined; noise and drift of all methods are large for that reason"
        )
    return said


def _method(m: Measures) -> dict[str, Any]:
    degrees = math.degrees
    return {
        "offset_deg": degrees(m.offset_rad),
        "slope_degps": degrees(m.slope.value),
        "sigma_degps": degrees(m.slope.sigma),
        "interval_degps": [degrees(m.slope.low), degrees(m.slope.high)],
        "allan_1s_deg": degrees(m.allan_1s_rad),
        "allan_100s_deg": degrees(m.allan_100s_rad),
        "rmse_deg": degrees(m.rmse_rad),
        "lag_ms": 1e3 * m.lag_s,
    }


def _driftsections_log(log: LogDrift) -> dict[str, Any]:
    s = log.sampling
    return {
        "name": log.source,
        "duration_s": s.duration_s,
        "rate_hz": s.rate_hz,
        "jitter_s": s.jitter_s,
        "missing": s.missing,
        "gaps": sum(not gap.split for gap in s.gaps),
        "splits": sum(gap.split for gap in s.gaps),
        "repeated_rows": s.repeated_rows,
        "repeated_stamps": s.repeated_stamps,
        "against": log.against,
        "about": _ABOUT[log.against],
        "judged_s": log.judged_s,
        "moving_s": log.moving_s,
        "methods": {m.name: _method(m) for m in log.measures},
        "skipped": list(log.skipped),
        "remarks": sampling_remarks(log),
    }


def drift_document(
    logs: Sequence[LogDrift], hashes: dict[str, str], tuned: Tuned | None, remarks: Sequence[str] = ()
) -> dict[str, Any]:
    """The document's section `drift`; what a log does not show is not finite.

    Parameters
    ----------
    hashes : SHA-256 of each log by name.
    remarks : about reading the logs.
    """
    out: dict[str, Any] = {
        "note": NOT_A_RANKING,
        "logs": [_driftsections_log(log) for log in logs],
        "methods": {
            one.name: {
                "mean_degps": math.degrees(one.mean_radps),
                "spread_degps": math.degrees(one.spread_radps),
                "logs": one.logs,
            }
            for one in spread_of(logs)
        },
        "remarks": list(remarks),
        "provenance": {"inputs": hashes},
    }
    if tuned is not None:
        out["tuned"] = {
            "Kp_per_s": tuned.gains.Kp,
            "Ki_per_s2": tuned.gains.Ki,
            "rate_of_angle": "up vector" if tuned.up_vector else "-gz",
        }
    return out

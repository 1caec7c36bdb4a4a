"""An IMU at rest as the section `imu` of rig.yaml, and as Kalibr's imu.yaml."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from calib.imu.allan_fit import Term
from calib.imu.static import AxisNoise, Drift, Static, StaticLog
from calib.imu.static_verdict import Judgement
from calib.rig import finite_or_none
from calib.rig_imu import Imu, ImuDrift, ImuLog

__all__ = ["imu_section", "kalibr_imu"]

Triple = list[float | None]
_KEYS = {
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
    for kind, (bias, *terms, step) in _KEYS.items():
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
        for key, what in ((_KEYS[kind][1], "noise_density"), (_KEYS[kind][3], "random_walk")):
            value, bound = _largest(section, key)
            unit = key.split("_", 2)[2].replace("_per_sqrt_Hz", "/sqrt(Hz)").replace("radps2", "rad/s^2")
            unit = unit.replace("mps3", "m/s^3").replace("mps2", "m/s^2").replace("radps", "rad/s")
            if value is not None:
                note = ", an upper bound: the log is too short to show it" if bound else ""
                lines.append(f"{name}_{what}: {value:.6e}  # {unit}{note}")
    lines += [f"rostopic: {topic}", f"update_rate: {section.rate_hz:.6f}"]
    return "\n".join(lines) + "\n"

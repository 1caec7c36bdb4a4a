"""A tuning of the angle filter as the section `orientation_filter` of rig.yaml."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from calib.imu.gains import gain_facts
from calib.imu.heldout import Candidate
from calib.imu.mahony import Mahony
from calib.imu.smoother import Smoothed
from calib.imu.tuning import Tuning
from calib.rig import finite_or_none
from calib.rig_filter import FilterCandidate, FilterLog, OrientationFilter
from calib.tunelogs import TuneLog

__all__ = ["filter_section"]

_TILTED = 3.0
_RINGS = 0.5


def _degrees(value: float) -> float | None:
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
        rmse_deg=_degrees(one.rmse_rad),
        interval_deg=_pair(one.low_rad, one.high_rad),
        less_than_3_3_deg=_degrees(one.less_rad),
        less_interval_deg=_pair(one.less_low_rad, one.less_high_rad),
        confidence=finite_or_none(one.confidence),
        whole_rmse_deg=_degrees(one.whole_rad),
    )


def _log(log: TuneLog, offset_rad: float, smoothed: Smoothed | None) -> FilterLog:
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
        told.append(_log(log, result.offset_rad[k], result.smoothed[k]))
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

"""Figures of a controlled motion: errors, overshoot, settling, saturation.

All take evenly sampled truth, (n, ...), at the ticks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, rms
from calib.stages.actuator.kinematics import angle, forward
from calib.stages.control.references import Reference

_BAND = 0.02


@dataclass(frozen=True)
class Tracking:
    """How well a reference was followed.

    Attributes
    ----------
    rms_mm : (q1, q2). head_rms_mm : of the head's place. angle_rms_rad, largest_mm, largest_rad.
    rms_from_start_mm : (q1, q2) with the way from rest to the reference.
    rise_s, reach_s : time to 95 % of the first step and to all of it; None where there is none or never.
    overshoot_rad : beyond the step's end in its direction. settling_s : into 2 % of the step for good.
    jump_overshoot_rad, jump_settling_s : the same after the jump, 2 % of it.
    saturation : share of the ticks in which a command is at a limit, per pump.
    changes_pwm : mean change of a command from tick to tick.
    """

    rms_mm: tuple[float, float]
    head_rms_mm: float
    angle_rms_rad: float
    largest_mm: float
    largest_rad: float
    rms_from_start_mm: tuple[float, float]
    rise_s: float | None
    reach_s: float | None
    overshoot_rad: float | None
    settling_s: float | None
    jump_overshoot_rad: float | None
    jump_settling_s: float | None
    saturation: tuple[float, float]
    changes_pwm: float


def saturation_share(pwm: FloatArray, low: float, high: float) -> tuple[float, float]:
    """Share of the ticks in which each of two commands (n, 2) is at a limit."""
    at = ((pwm <= low) | (pwm >= high)).mean(axis=0)
    return float(at[0]), float(at[1])


def settling_s(tick_s: float, error: FloatArray, band: float) -> float | None:
    """Time after which errors (n,) stay within a band for good; None when the last one is outside."""
    outside = np.flatnonzero(np.abs(error) > band)
    last = int(outside[-1]) + 1 if len(outside) else 0
    return last * tick_s if last < len(error) else None


def _first_time_s(tick_s: float, hit: BoolArray) -> float | None:
    found = np.flatnonzero(hit)
    return float(found[0]) * tick_s if len(found) else None


def _rms_of_each(error: FloatArray) -> tuple[float, float]:
    return rms(error[:, 0]), rms(error[:, 1])


def _step(tick_s: float, phi: FloatArray, before: float, wanted: float) -> tuple[float, float | None]:
    """Overshoot [rad] of angles (n,) after a step between two, and when they settle."""
    over = float(np.max(np.sign(wanted - before) * (phi - wanted)))
    return max(over, 0.0), settling_s(tick_s, phi - wanted, _BAND * abs(wanted - before))


def tracking(
    reference: Reference, q_m: FloatArray, pwm: FloatArray, bellows_radius_m: float, low: float, high: float
) -> Tracking:
    """Figures of true lengths (n, 2) [m] and commands (n, 2) against a reference of n ticks.

    Of a reference given as an angle the lengths are free, and their errors are NaN.
    """
    h, t = reference.tick_s, reference.t_s
    phi = angle(q_m, bellows_radius_m)
    judged = t >= reference.judged_from_s - 1e-9
    if not judged.any():
        judged[:] = True
    free = reference.kind == "angle"
    wanted_m = np.full_like(q_m, np.nan) if free else reference.q_m
    error = 1e3 * (wanted_m - q_m)
    turned = reference.phi_rad - phi
    head = forward(q_m, bellows_radius_m)[:, :2] - forward(wanted_m, bellows_radius_m)[:, :2]
    rise = reach = over = settle = jump_over = jump_settle = None
    if free and len(np.unique(reference.phi_rad)) <= 2 and reference.phi_rad[0] != 0.0:
        jump = len(phi) if reference.jump_s is None else round(reference.jump_s / h)
        wanted, first = float(reference.phi_rad[0]), phi[:jump]
        along = np.sign(wanted) * first
        rise, reach = (_first_time_s(h, along >= share * abs(wanted)) for share in (0.95, 1.0))
        over, settle = _step(h, first, 0.0, wanted)
        if jump < len(phi):
            jump_over, jump_settle = _step(h, phi[jump:], wanted, float(reference.phi_rad[-1]))
    return Tracking(
        _rms_of_each(error[judged]),
        rms(1e3 * np.linalg.norm(head[judged], axis=1)),
        rms(turned[judged]),
        float(np.abs(error[judged]).max()),
        float(np.abs(turned[judged]).max()),
        _rms_of_each(error),
        rise,
        reach,
        over,
        settle,
        jump_over,
        jump_settle,
        saturation_share(pwm, low, high),
        float(np.abs(np.diff(pwm, axis=0)).mean()) if len(pwm) > 1 else 0.0,
    )

"""What was tuned and tried, as the section `controller` of rig.yaml and as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from calib.stages.actuator.pump import RateLimit
from calib.stages.control.laws import ComputedTorque, Model, Observer, Pid, largest_force_N, pwm_of_force
from calib.stages.control.linear import Margins, System
from calib.stages.control.references import Reference
from calib.stages.control.section import (
    ComputedTorqueGains,
    Controller,
    ControllerCriterion,
    ControllerMargins,
    OrientationGains,
    PositionGains,
    StaticMap,
)
from calib.stages.control.stage import Outcome
from calib.stages.control.tuning import (
    Criterion,
    Following,
    Point,
    Tuned,
    largest_angle,
    longest_m,
    orientation_loop,
    points_of,
    position_loop,
)

_MAP_ROWS = 41


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def margins_of(loop: str, points: tuple[Point, ...]) -> list[ControllerMargins]:
    """Margins at operating points for the file."""
    out = []
    for point in points:
        m: Margins = point.margins
        out.append(
            ControllerMargins(
                loop="orientation" if loop == "orientation" else "position",
                q_m=[float(f"{q:.6g}") for q in point.q_m],
                stable=bool(m.stable),
                gain=_or_none(m.gain),
                phase_rad=_or_none(m.phase_rad),
                delay_s=_or_none(m.delay_s),
                crossover_hz=float(m.crossover_hz),
                sensitivity=float(m.sensitivity),
            )
        )
    return out


def source_margins(model: Model, orientation: Tuned, position: Tuned) -> dict[str, list[ControllerMargins]]:
    """Margins that the source's gains have at the same points."""

    def of(loop: str, pid: Pid, tuned: Tuned) -> list[ControllerMargins]:
        def system(q: tuple[float, float]) -> System:
            make = orientation_loop if loop == "orientation" else position_loop
            return make(model, pid, q)

        return margins_of(loop, points_of(system, [point.q_m for point in tuned.points]))

    h = model.tick_s
    return {
        "PID 1000/1000/10": of("orientation", Pid(1000.0, 1000.0, 10.0, tick_s=h), orientation),
        "PD 15000/150": of("position", Pid(15000.0, 0.0, 150.0, tick_s=h), position),
        "PD 10000/1000": of("position", Pid(10000.0, 0.0, 1000.0, tick_s=h), position),
    }


def _static_map(model: Model) -> StaticMap:
    plant = model.plant
    most = float(largest_force_N(model).max())
    # Close together at small forces, where the map is steepest. Strengths apply to the force first.
    force = most / max(model.strength) * np.linspace(0.0, 1.0, _MAP_ROWS) ** 2
    scaled = force[:, None] * np.array(model.strength)
    pwm = pwm_of_force(model, np.maximum(scaled, 1e-9))[:, 0]
    return StaticMap(
        rest_length_m=plant.rest_length_m,
        bellows_radius_m=plant.bellows_radius_m,
        stiffness_N_per_m=[plant.stiffness_scale * k for k in plant.stiffness.padded],
        bending_N_per_rad2=plant.bending_N_per_rad2,
        strength=list(model.strength),
        force_pwm=[[float(f"{F:.6g}"), float(f"{u:.6g}")] for F, u in zip(force, pwm, strict=True)],
    )


def controller_section(
    model: Model,
    criterion: Criterion,
    orientation: Tuned,
    position: Tuned,
    back_s: float,
    share: float,
    anti_windup: dict[str, dict[str, float]],
    observer: Observer,
    control: ComputedTorque,
) -> Controller:
    """The section with its verdict: poor where back-calculation is not worth its name."""
    clamped, back = anti_windup["clamping"], anti_windup["back_calculation"]
    reasons = []
    over, limit = back["overshoot_after_jump_rad"], clamped["overshoot_after_jump_rad"] / 3.0
    if over > max(limit, 1e-3):
        reasons.append(
            f"After the jump back-calculation overshoots by {over:.3f} rad, more than a third of clamping's "
            f"{clamped['overshoot_after_jump_rad']:.3f} rad."
        )
    if back["rise_s"] > clamped["rise_s"] + model.tick_s + 1e-9:
        reasons.append(
            f"The first step is at 95 % after {back['rise_s']:.2f} s, later than with clamping "
            f"({clamped['rise_s']:.2f} s)."
        )
    law = model.pump.deflation
    turn, move = orientation.pid, position.pid
    return Controller(
        tick_s=model.tick_s,
        pwm_low=model.low_pwm,
        pwm_high=model.high_pwm,
        criterion=ControllerCriterion(
            gain_margin=criterion.gain,
            phase_margin_rad=criterion.phase_rad,
            sensitivity=criterion.sensitivity,
        ),
        orientation=OrientationGains(
            Kp_pwm_per_rad=turn.Kp,
            Ki_pwm_per_rad_s=turn.Ki,
            Kd_pwm_s_per_rad=turn.Kd,
            back_calculation_s=back_s,
            falling_share=share if math.isfinite(share) else None,
        ),
        position=PositionGains(Kp_pwm_per_m=move.Kp, Ki_pwm_per_m_s=move.Ki, Kd_pwm_s_per_m=move.Kd),
        feedforward=_static_map(model),
        computed_torque=ComputedTorqueGains(
            horizon_ticks=control.horizon_ticks,
            Kp_per_s2=control.Kp_per_s2,
            Kd_per_s=control.Kd_per_s,
            latency_s=observer.latency_s,
            observer_gain=[[float(f"{v:.6g}") for v in row] for row in observer.gain],
        ),
        lag_s=model.pump.lag_s,
        delay_ticks=model.pump.delay_ticks,
        falling_N_per_s=(
            law.falling_N_per_s if isinstance(law, RateLimit) and math.isfinite(law.falling_N_per_s) else None
        ),
        margins=[*margins_of("orientation", orientation.points), *margins_of("position", position.points)],
        anti_windup=anti_windup,
        verdict="poor" if reasons else "ok",
        reasons=reasons,
    )


def outcome_json(outcome: Outcome) -> dict[str, Any]:
    """Figures of a run as plain values."""
    told = asdict(outcome.figures)
    told = {key: list(value) if isinstance(value, tuple) else value for key, value in told.items()}
    if outcome.limited is not None:
        told["limited"] = outcome.limited
    return {"controller": outcome.controller, **told}


def reach_json(model: Model) -> dict[str, Any]:
    """What the pumps reach at rest."""
    return {
        "greatest_angle_rad": largest_angle(model),
        "greatest_length_m": longest_m(model),
        "greatest_force_N": largest_force_N(model).tolist(),
    }


def check_json(reference: Reference, found: Following) -> dict[str, Any]:
    """Whether a reference can be followed, and by how much not."""
    return {
        "reference": reference.name,
        "duration_s": reference.duration_s,
        "possible": found.possible,
        "at_s": found.at_s,
        "reason": found.reason,
        "missing_mm": 1e3 * float(np.abs(found.missing_m).max()),
        "fastest_rise_N_per_s": found.fastest_rise_N_per_s,
        "fastest_fall_N_per_s": found.fastest_fall_N_per_s,
        "approach_s": found.approach_s,
    }

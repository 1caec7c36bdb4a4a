"""Gains from the model: the strongest controller whose margins hold at every operating point.

Orientation, PID on one pump (4.1), (4.4). Of all gains with

    gain margin >= GM,  phase margin >= PM,  Ms <= M

at every operating point, the one with the largest Ki: after a step of an unknown force the integral of
the error is proportional to 1 / Ki, so this is the fastest recovery (Astrom and Hagglund's criterion).

Position, PD on both bellows beside a feed-forward (4.5), (4.8): the largest Kp under the same margins,
since what the feed-forward leaves is divided by 1 + Kp times the slope. The camera's latency and the
firmware's low-pass are in the loop.

The ratios Ki / Kp and Kd / Kp come from a grid; for each the largest gain is found by bisection on the
frequency responses, which are computed once, and the winner is checked by eigenvalues.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import ComplexArray, FloatArray
from calib.core.errors import BadInputError
from calib.stages.control import laws, loops
from calib.stages.control.reach import largest_angle, longest_m, reachable, unlike
from calib.stages.control.rig_model import Model, bent_rest
from calib.stages.control.section import ControllerCriterion

_INTEGRAL_S = np.concatenate([np.geomspace(0.01, 0.1, 6), np.geomspace(0.15, 4.0, 10)])
"""Behind pumps that fill faster than the head swings the gain at its resonance is the limit, and an integral
far stronger than the gain is what stays below."""
_LEAST = 1e-5
"""Of the largest gain: angles are no worse held without a controller."""
_DERIVATIVE_S = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2])
_BISECTIONS = 16


@dataclass(frozen=True)
class Point:
    """Margins at an operating point, the least of its channels and of all together."""

    q_m: tuple[float, float]
    margins: loops.Margins


@dataclass(frozen=True)
class Tuned:
    """Gains and their margins at every operating point."""

    pid: laws.Pid
    points: tuple[Point, ...]


def operating_angles(model: Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 15, 40, 65 and 90 % of the greatest angle, one pump alone.

    To both sides where the pumps are unlike.
    """
    most = [largest_angle(model, pump) for pump in range(1 + unlike(model))]
    rests = (bent_rest(model, share * one) for one in most for share in (0.15, 0.4, 0.65, 0.9))
    return tuple((float(q[0]), float(q[1])) for q in rests)


def operating_lengths(model: Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 10 to 95 % of the greatest elongation, and two that are bent.

    These to both sides where the pumps are unlike.
    """
    rest = model.plant.rest_length_m
    span = longest_m(model) - rest
    found = [(rest + s * span, rest + s * span) for s in (0.1, 0.35, 0.65, 0.95)]
    bent = [(rest + a * span, rest + b * span) for a, b in ((0.75, 0.25), (0.9, 0.5))]
    found += bent + [(b, a) for a, b in bent if unlike(model)]
    return tuple(q for q in found if bool(reachable(model, np.array(q))))


def orientation_loop(model: Model, pid: laws.Pid, q_m: tuple[float, float]) -> loops.System:
    """Loop of (4.1) about a rest: error of the angle, both controllers, rig, angle."""
    return loops.series(loops.pid_system(pid), _angle_rig(model, q_m))


def _angle_rig(model: Model, q_m: tuple[float, float]) -> loops.System:
    half, h = 0.5 / model.plant.bellows_radius_m, model.tick_s
    rig = loops.rig_system(model, np.array(q_m))
    return loops.series(
        loops.gain(np.array([[1.0], [-1.0]]), h), loops.series(rig, loops.gain(np.array([[half, -half]]), h))
    )


def position_loop(model: Model, pid: laws.Pid, q_m: tuple[float, float]) -> loops.System:
    """Loop of (4.5) about a rest: errors of the lengths, both controllers, rig, lengths as seen."""
    return loops.series(both_channels(pid), _position_rig(model, q_m))


def both_channels(pid: laws.Pid) -> loops.System:
    """A controller for each bellows."""
    return loops.side_by_side(loops.pid_system(pid), loops.pid_system(pid))


def _position_rig(model: Model, q_m: tuple[float, float]) -> loops.System:
    return loops.series(loops.rig_system(model, np.array(q_m)), loops.firmware_sensing(model))


def holds(criterion: ControllerCriterion, margins: loops.Margins) -> bool:
    """Whether margins satisfy the criterion; stability is part of it."""
    return (
        margins.stable
        and margins.gain >= criterion.gain_margin
        and margins.gain_down <= 1.0 / criterion.gain_margin
        and margins.phase_rad >= criterion.phase_margin_rad
        and margins.sensitivity <= criterion.sensitivity
    )


def _worst(margins: Sequence[loops.Margins]) -> loops.Margins:
    return loops.Margins(
        all(m.stable for m in margins),
        min(m.gain for m in margins),
        max(m.gain_down for m in margins),
        min(m.phase_rad for m in margins),
        min(m.delay_s for m in margins),
        max(m.crossover_hz for m in margins),
        max(m.sensitivity for m in margins),
    )


def _largest_factor(
    criterion: ControllerCriterion,
    shape: ComplexArray,
    rigs: Sequence[tuple[ComplexArray, ComplexArray]],
    omega: FloatArray,
    most: float,
) -> float:
    """Largest factor on a controller's response (k,) that keeps the margins at rigs; 0 if none.

    `rigs` are responses (k, n, n), each with its loci (k, n).
    """

    def good(factor: float) -> bool:
        C = factor * shape
        return all(
            holds(criterion, loops.margins_of_response(omega, one, True))
            for rig, together in rigs
            for one in loops.scalar_loops(C[:, None, None] * rig, C[:, None] * together)
        )

    low, high = _LEAST * most, most
    if not good(low):
        return 0.0
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _two_digits(value: float) -> float:
    """Down to two significant digits: nobody types more, and the margins hold."""
    if value == 0.0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1)
    return float(f"{math.floor(value / unit + 1e-9) * unit:.12g}")


def _search(
    model: Model,
    criterion: ControllerCriterion,
    at: Sequence[tuple[float, float]],
    rigs: Sequence[loops.System],
    controllers: Callable[[laws.Pid], loops.System],
    integrals_s: Sequence[float],
    most: float,
    merit: Callable[[laws.Pid], float],
) -> Tuned:
    omega = loops.frequencies(model.tick_s, 400)
    seen = [(L, loops.loci(L)) for L in (loops.response(rig, omega) for rig in rigs)]
    best: list[laws.Pid] = []
    for Ti in integrals_s:
        for Td in _DERIVATIVE_S.tolist():
            unit = laws.Pid(1.0, 0.0 if math.isinf(Ti) else 1.0 / Ti, Td, tick_s=model.tick_s)
            Kp = _largest_factor(
                criterion, loops.response(loops.pid_system(unit), omega)[:, 0, 0], seen, omega, most
            )
            if Kp > 0.0:
                Kp = _two_digits(Kp)
                gains = (_two_digits(Kp * unit.Ki), _two_digits(Kp * Td))
                best.append(laws.Pid(Kp, *gains, tick_s=model.tick_s))
    for pid in sorted(best, key=merit, reverse=True):
        worst = [_worst(loops.loop_margins(loops.series(controllers(pid), rig))) for rig in rigs]
        if all(holds(_slack(criterion), one) for one in worst):
            return Tuned(pid, tuple(map(Point, at, worst)))
    raise BadInputError(_no_gains(criterion, at, rigs))


def _no_gains(
    criterion: ControllerCriterion, at: Sequence[tuple[float, float]], rigs: Sequence[loops.System]
) -> str:
    """Why not even weak gains keep margins."""
    for q_m, rig in zip(at, rigs, strict=True):
        if (radius := loops.spectral_radius(rig)) >= 1.0:
            q1, q2 = (1e3 * q for q in q_m)
            grows_s = rig.tick_s / max(math.log(radius), 1e-9)
            return (
                f"controller: at lengths of {q1:.1f} and {q2:.1f} mm the head does not come to rest by "
                f"itself but goes away, 2.7 times as far in {grows_s:.2g} s, expected an actuator that does; "
                "look at mass_kg, gravity_mps2 and the creep of the actuator in rig.yaml"
            )
    phase = f"{math.degrees(criterion.phase_margin_rad):.3g} deg"
    return (
        f"controller: no gains reach a gain margin of {criterion.gain_margin:g}, a phase margin of {phase} "
        f"and a sensitivity of {criterion.sensitivity:g} at every operating point, expected a lower demand"
    )


def _slack(criterion: ControllerCriterion) -> ControllerCriterion:
    """The criterion less what rounding the gains to two digits may cost."""
    return ControllerCriterion(
        gain_margin=1.0 + 0.98 * (criterion.gain_margin - 1.0),
        phase_margin_rad=0.98 * criterion.phase_margin_rad,
        sensitivity=1.02 * criterion.sensitivity,
    )


def tune_orientation(model: Model, criterion: ControllerCriterion) -> Tuned:
    """PID of the angle with the largest Ki [PWM/rad/s].

    Raises `BadInputError` where no gains hold the margins.
    """
    at = operating_angles(model)
    rigs = [_angle_rig(model, q) for q in at]
    return _search(
        model, criterion, at, rigs, loops.pid_system, _INTEGRAL_S.tolist(), 2e4, lambda pid: pid.Ki
    )


def tune_position(model: Model, criterion: ControllerCriterion) -> Tuned:
    """PD of the lengths with the largest Kp [PWM/m], the firmware's filters in the loop.

    Raises `BadInputError` where no gains hold the margins.
    """
    at = operating_lengths(model)
    rigs = [_position_rig(model, q) for q in at]
    return _search(model, criterion, at, rigs, both_channels, [math.inf], 4e5, lambda pid: pid.Kp)

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

from calib.arrays import ComplexArray, FloatArray
from calib.control.inverse_model import Model
from calib.control.linear import (
    System,
    bent_rest,
    closed_loop,
    firmware_sensing,
    gain,
    pid_system,
    response,
    rig_system,
    series,
    side_by_side,
    spectral_radius,
)
from calib.control.margins import Margins, break_at, frequencies, loop_margins, margins_of_response
from calib.control.pid import Pid
from calib.control.reach import largest_angle, longest_m, reachable
from calib.errors import BadInputError

__all__ = [
    "Criterion",
    "Point",
    "Tuned",
    "holds",
    "operating_angles",
    "operating_lengths",
    "orientation_loop",
    "position_loop",
    "tune_orientation",
    "tune_position",
]

_INTEGRAL_S = np.geomspace(0.15, 4.0, 10)
_DERIVATIVE_S = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2])
_BISECTIONS = 16


@dataclass(frozen=True)
class Criterion:
    """Margins that every operating point has to have.

    Attributes
    ----------
    gain, phase_rad, sensitivity : least gain margin, least phase margin, greatest Ms.

    Raises `BadInputError` for margins that no loop can have or that are none.
    """

    gain: float = 2.0
    phase_rad: float = math.pi / 3.0
    sensitivity: float = 2.0

    def __post_init__(self) -> None:
        if not 1.0 < self.gain < 100.0:
            raise BadInputError(f"gain margin: found {self.gain:g}, expected a factor above 1")
        if not 0.0 < self.phase_rad < 0.5 * math.pi:
            raise BadInputError(
                f"phase margin: found {math.degrees(self.phase_rad):g} deg, expected 0 to 90 deg"
            )
        if not 1.0 < self.sensitivity < 100.0:
            raise BadInputError(f"sensitivity: found {self.sensitivity:g}, expected more than 1")


@dataclass(frozen=True)
class Point:
    """Margins at an operating point, the least of its channels."""

    q_m: tuple[float, float]
    margins: Margins


@dataclass(frozen=True)
class Tuned:
    """Gains and their margins at every operating point."""

    pid: Pid
    points: tuple[Point, ...]


def operating_angles(model: Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 15, 40, 65 and 90 % of the greatest angle, one pump alone."""
    most = largest_angle(model)
    rests = (bent_rest(model, share * most) for share in (0.15, 0.4, 0.65, 0.9))
    return tuple((float(q[0]), float(q[1])) for q in rests)


def operating_lengths(model: Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 10 to 95 % of the greatest elongation, and two that are bent."""
    rest = model.plant.rest_length_m
    span = longest_m(model) - rest
    found = [(rest + s * span, rest + s * span) for s in (0.1, 0.35, 0.65, 0.95)]
    found += [(rest + a * span, rest + b * span) for a, b in ((0.75, 0.25), (0.9, 0.5))]
    return tuple(q for q in found if bool(reachable(model, np.array(q))))


def orientation_loop(model: Model, pid: Pid, q_m: tuple[float, float]) -> System:
    """Loop of (4.1) about a rest: error of the angle, both controllers, rig, angle."""
    h = model.tick_s
    return series(pid_system(pid), _angle_rig(model, q_m, h))


def _angle_rig(model: Model, q_m: tuple[float, float], h: float) -> System:
    half = 0.5 / model.plant.bellows_radius_m
    rig = rig_system(model, np.array(q_m))
    return series(gain(np.array([[1.0], [-1.0]]), h), series(rig, gain(np.array([[half, -half]]), h)))


def _position_rig(model: Model, q_m: tuple[float, float], sensing: bool) -> System:
    rig = rig_system(model, np.array(q_m))
    return series(rig, firmware_sensing(model)) if sensing else rig


def position_loop(model: Model, pid: Pid, q_m: tuple[float, float], sensing: bool = True) -> System:
    """Loop of (4.5) about a rest: errors of the lengths, both controllers, rig, lengths as seen."""
    both = side_by_side(pid_system(pid), pid_system(pid))
    return series(both, _position_rig(model, q_m, sensing))


def holds(criterion: Criterion, margins: Margins) -> bool:
    """Whether margins satisfy the criterion; stability is part of it."""
    return (
        margins.stable
        and margins.gain >= criterion.gain
        and margins.gain_down <= 1.0 / criterion.gain
        and margins.phase_rad >= criterion.phase_rad
        and margins.sensitivity <= criterion.sensitivity
    )


def _worst(margins: Sequence[Margins]) -> Margins:
    return Margins(
        all(m.stable for m in margins),
        min(m.gain for m in margins),
        max(m.gain_down for m in margins),
        min(m.phase_rad for m in margins),
        min(m.delay_s for m in margins),
        max(m.crossover_hz for m in margins),
        max(m.sensitivity for m in margins),
    )


def points_of(
    loop: Callable[[tuple[float, float]], System], at: Sequence[tuple[float, float]]
) -> tuple[Point, ...]:
    """Margins of a loop at operating points, the least of its channels at each."""
    return tuple(Point(q, _worst(loop_margins(loop(q)))) for q in at)


def _strongest(
    criterion: Criterion, shape: ComplexArray, rigs: Sequence[ComplexArray], omega: FloatArray, most: float
) -> float:
    """Largest factor on a controller's response (k,) that keeps the margins at rigs (k, n, n); 0 if none."""

    def good(factor: float) -> bool:
        for rig in rigs:
            L = factor * shape[:, None, None] * rig
            for i in range(L.shape[1]):
                if not holds(criterion, margins_of_response(omega, break_at(L, i), True)):
                    return False
        return True

    low, high = 1e-3 * most, most
    if not good(low):
        return 0.0
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _rounded(value: float) -> float:
    """Down to two significant digits: nobody types more, and the margins hold."""
    if value == 0.0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1)
    return float(f"{math.floor(value / unit + 1e-9) * unit:.12g}")


def _searched(
    model: Model,
    criterion: Criterion,
    rigs: Sequence[System],
    integrals_s: Sequence[float],
    most: float,
    merit: Callable[[Pid], float],
    loop: Callable[[Pid, int], System],
) -> Pid:
    omega = frequencies(model.tick_s, 400)
    seen = [response(rig, omega) for rig in rigs]
    best: list[Pid] = []
    for Ti in integrals_s:
        for Td in _DERIVATIVE_S.tolist():
            unit = Pid(1.0, 0.0 if math.isinf(Ti) else 1.0 / Ti, Td, tick_s=model.tick_s)
            Kp = _strongest(criterion, response(pid_system(unit), omega)[:, 0, 0], seen, omega, most)
            if Kp > 0.0:
                Kp = _rounded(Kp)
                gains = (_rounded(Kp * unit.Ki), _rounded(Kp * Td))
                best.append(Pid(Kp, *gains, tick_s=model.tick_s))
    best.sort(key=merit, reverse=True)
    for pid in best:
        if all(spectral_radius(closed_loop(loop(pid, i))) < 1.0 for i in range(len(rigs))):
            worst = [_worst(loop_margins(loop(pid, i))) for i in range(len(rigs))]
            if all(holds(_slack(criterion), one) for one in worst):
                return pid
    raise BadInputError(
        f"controller: no gains reach a gain margin of {criterion.gain:g} and a phase margin of "
        f"{math.degrees(criterion.phase_rad):.3g} deg at every operating point, expected a lower demand"
    )


def _slack(criterion: Criterion) -> Criterion:
    """The criterion less what rounding the gains to two digits may cost."""
    return Criterion(
        1.0 + 0.98 * (criterion.gain - 1.0), 0.98 * criterion.phase_rad, 1.02 * criterion.sensitivity
    )


def tune_orientation(
    model: Model, criterion: Criterion, at: Sequence[tuple[float, float]] | None = None
) -> Tuned:
    """PID of the angle with the largest Ki [PWM/rad/s].

    Raises `BadInputError` where no gains hold the margins.
    """
    points = operating_angles(model) if at is None else tuple(at)
    rigs = [_angle_rig(model, q, model.tick_s) for q in points]
    pid = _searched(
        model, criterion, rigs, _INTEGRAL_S.tolist(), 2e4, lambda p: p.Ki,
        lambda p, i: series(pid_system(p), rigs[i]),
    )  # fmt: skip
    return Tuned(pid, points_of(lambda q: orientation_loop(model, pid, q), points))


def tune_position(
    model: Model,
    criterion: Criterion,
    at: Sequence[tuple[float, float]] | None = None,
    sensing: bool = True,
) -> Tuned:
    """PD of the lengths with the largest Kp [PWM/m], `sensing` with the firmware's filters in the loop.

    Raises `BadInputError` where no gains hold the margins.
    """
    points = operating_lengths(model) if at is None else tuple(at)
    rigs = [_position_rig(model, q, sensing) for q in points]
    pid = _searched(
        model, criterion, rigs, [math.inf], 4e5, lambda p: p.Kp,
        lambda p, i: series(side_by_side(pid_system(p), pid_system(p)), rigs[i]),
    )  # fmt: skip
    return Tuned(pid, points_of(lambda q: position_loop(model, pid, q, sensing), points))

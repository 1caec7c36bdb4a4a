"""Experiments of chapter 4 with a controller at every tick: angle, elongation, ellipse."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from calib.actuator.integrate import rig_at_rest
from calib.arrays import FloatArray
from calib.control.feedforward import FeedForward
from calib.control.loop import (
    LoopState,
    OrientationControl,
    PositionControl,
    step_orientation,
    step_position,
)
from calib.control.pid import Pid
from calib.control.setpoints import AngleSteps, Ellipse, PolynomialElongation
from calib.errors import BadInputError
from calib.twin.experiment import UNSET, Figures, at_rest, or_none, tick_times
from calib.twin.feedback import Seen
from calib.twin.measures import step_response
from calib.twin.rig import SimulatedRig
from calib.twin.simulate import Law, Run, simulate

__all__ = ["EllipseTrack", "Elongation", "Orientation"]

Pair = tuple[float, float]

_ORIENTATION: dict[str, Pid] = {
    "p": Pid(1000.0),
    "pid": Pid(1000.0, 1000.0, 10.0),
    "clamping": Pid(1000.0, 1000.0, 10.0, clamping=True),
}
_POSITION: dict[str, tuple[Pid, bool]] = {
    "pd+ff": (Pid(15000.0, 0.0, 150.0), True),
    "pd": (Pid(15000.0, 0.0, 150.0), False),
    "pid": (Pid(15000.0, 8000.0, 150.0), False),
}


def _one_of(what: str, value: str, known: Iterable[str]) -> None:
    if value not in known:
        raise BadInputError(f"{what}: found {value!r}, expected one of {', '.join(known)}")


def _tuned(rig: SimulatedRig, pid: Pid, Kp: float, Ki: float, Kd: float) -> Pid:
    """The controller with the gains that were given in place of its own, at the rig's tick."""
    own = ((Kp, pid.Kp), (Ki, pid.Ki), (Kd, pid.Kd))
    P, I, D = (default if or_none(given) is None else given for given, default in own)  # noqa: E741  the field's letters
    return replace(pid, Kp=P, Ki=I, Kd=D, tick_s=rig.pump.tick_s)


@dataclass(frozen=True)
class Orientation:
    """The angle alone, with P, PID or PID with clamping (4.1 - 4.4); a jump at 5 s (Fig. 4.7).

    `controller` is p, pid or clamping with the gains of Figs. 4.2 and 4.4, which Kp, Ki, Kd replace.
    """

    duration_s: float = 10.0
    controller: str = "pid"
    Kp: float = UNSET
    Ki: float = UNSET
    Kd: float = UNSET
    reference_rad: float = 0.7
    jump_to_rad: float = 0.3
    jump_at_s: float = 5.0
    sign: int = 1

    def __post_init__(self) -> None:
        _one_of("controller", self.controller, _ORIENTATION)

    def _law(self, rig: SimulatedRig, ticks: int) -> Law:
        pid = _tuned(rig, _ORIENTATION[self.controller], self.Kp, self.Ki, self.Kd)
        control = OrientationControl(pid, self.sign)
        steps = AngleSteps((self.reference_rad, self.jump_to_rad), (self.jump_at_s,))
        wanted = steps.angle_rad(tick_times(rig, ticks) + 1e-9).tolist()

        def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, Pair]:
            memory, command = step_orientation(control, memory, wanted[k], seen.phi_rad)
            return memory, command.pwm

        return law

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        return simulate(rig, at_rest(rig), self._law(rig, ticks), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        jump = max(min(round(self.jump_at_s / run.tick_s), len(run.pwm)), 1)
        before, after = run.phi_rad[:jump], run.phi_rad[jump:]
        rise = step_response(run.tick_s, before, self.reference_rad)
        figures: Figures = {"reach_s": rise.reach_s, "peak_rad": rise.peak, "settle_s": rise.settle_s}
        if len(after):
            down = np.sign(self.jump_to_rad - self.reference_rad)
            figures["overshoot_after_jump_rad"] = max(float(np.max(down * (after - self.jump_to_rad))), 0.0)
        return figures


def _position_law(control: PositionControl, wanted_m: FloatArray) -> Law:
    rows = wanted_m.tolist()

    def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, Pair]:
        memory, command = step_position(control, memory, (rows[k][0], rows[k][1]), seen.q_m)
        return memory, command.pwm

    return law


def _errors_mm(run: Run, wanted_m: FloatArray) -> FloatArray:
    return np.asarray(1e3 * (wanted_m - run.states[:, :2]))


@dataclass(frozen=True)
class Elongation:
    """Both bellows along (4.7), held after 5 s (Fig. 4.12).

    `controller` is pd+ff, pd or pid with the gains of Fig. 4.12, which Kp, Ki, Kd replace.
    `start_m` is the length at the start, by default the rest length; the source's run began at 68.1 mm.
    """

    duration_s: float = 10.0
    controller: str = "pd+ff"
    Kp: float = UNSET
    Ki: float = UNSET
    Kd: float = UNSET
    start_m: float = UNSET

    def __post_init__(self) -> None:
        _one_of("controller", self.controller, _POSITION)

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        pid, feed = _POSITION[self.controller]
        control = PositionControl(
            _tuned(rig, pid, self.Kp, self.Ki, self.Kd), FeedForward() if feed else None
        )
        law = _position_law(control, PolynomialElongation().bellows_m(tick_times(rig, ticks)))
        start = rig_at_rest(rig.plant, rig.pump, length_m=or_none(self.start_m))
        return simulate(rig, start, law, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        error = _errors_mm(run, PolynomialElongation().bellows_m(run.t_s))
        figures: Figures = {"largest_error_mm": float(np.abs(error).max())}
        late = error[run.t_s >= 6.0]
        if len(late):
            figures["static_error_mm"] = float(late.mean())
        return figures


@dataclass(frozen=True)
class EllipseTrack:
    """The head around the ellipse (4.9) with PD and feed-forward (Figs. 4.14 - 4.18)."""

    duration_s: float = 20.0
    chord: str = "exact"
    Kp: float = 10000.0
    Kd: float = 1000.0
    feedforward: bool = True

    def __post_init__(self) -> None:
        Ellipse(chord=self.chord)

    def _wanted(self, rig: SimulatedRig, t_s: FloatArray) -> FloatArray:
        return Ellipse(chord=self.chord).bellows_m(t_s, rig.plant.bellows_radius_m)

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        pid = Pid(self.Kp, 0.0, self.Kd, tick_s=rig.pump.tick_s)
        control = PositionControl(pid, FeedForward() if self.feedforward else None)
        law = _position_law(control, self._wanted(rig, tick_times(rig, ticks)))
        return simulate(rig, at_rest(rig), law, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        error = _errors_mm(run, self._wanted(run.rig, run.t_s))[run.t_s >= 2.0]
        if not len(error):
            return {}
        return {
            "rms_error_q1_mm": float(np.sqrt(np.mean(error[:, 0] ** 2))),
            "rms_error_q2_mm": float(np.sqrt(np.mean(error[:, 1] ** 2))),
        }

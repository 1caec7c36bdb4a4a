"""Controllers on the simulated rig: which there are, one run of each, and the anti-windup by trial.

This module runs the twin on purpose. What is tried here is a controller before the hardware: the twin
with the identified parameters is the plant, its sensors are simulated, and nothing that was recorded
is processed.

    p, pid, clamping        angle, with the source's gains (4.1 - 4.4)
    back                    the same PID with back-calculation
    pd, pd+ff, pd+map       lengths; without feed-forward, with the line of (4.6), with the identified map
    torque                  lengths; computed torque with the observer
    tuned-pid, tuned-pd     back-calculation and map with the gains of the section `controller`

Any of them runs on any reference: one given as an angle has the lengths of one pump alone, one given as
lengths has an angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.camera.model import undistort
from calib.stages.control.laws import (
    ANGLE_PIDS,
    LENGTHS_PD,
    BackOrientation,
    ComputedTorque,
    FeedForward,
    Pid,
    computed_torque_step,
    feed_forward,
    wanted_motion,
)
from calib.stages.control.observer import design_observer
from calib.stages.control.reach import largest_angle
from calib.stages.control.references import Reference, built_in, from_angles
from calib.stages.control.rig_model import Model, Pair, feed_forward_pwm
from calib.stages.control.section import Controller
from calib.stages.control.tracking import Tracking, tracking
from calib.twin.rig import SimulatedRig, rig_from_file
from calib.twin.scenarios import angle_law, at_rest, length_law
from calib.twin.simulate import Law, Run, Seen, simulate

CONTROLLERS = (
    "p", "pid", "clamping", "back", "pd", "pd+ff", "pd+map", "torque", "tuned-pid", "tuned-pd",
)  # fmt: skip

_ANGLE = ("p", "pid", "clamping", "back", "tuned-pid", "torque")
_LENGTHS = ("pd", "pd+ff", "pd+map", "tuned-pd", "torque")
_ELLIPSE_PD = Pid(10000.0, 0.0, 1000.0)
_BACK_S, _SHARE = 4.0, 0.4


@dataclass(frozen=True)
class Outcome:
    """A controller on a reference.

    Attributes
    ----------
    controller : its name.
    run : the simulated run.
    figures : errors and all that.
    limited : share of the ticks in which the pumps could not give what was wanted, None where unknown.
    """

    controller: str
    run: Run
    figures: Tracking
    limited: float | None


def controlled(rig: Rig, limits: Pair | None, other: Rig | None = None) -> tuple[SimulatedRig, Model]:
    """A simulated machine with the parameters of a rig, and what controllers know of it.

    Parameters
    ----------
    other : a rig whose actuator and pumps the machine has in place of those that controllers know.
    """
    machine, tick_s = rig_from_file(rig), 1.0 / rig.tick_hz
    machine = replace(machine, pump=machine.pump.at(tick_s))
    model = replace(control_model(machine, rig.controller, limits), **_sensed(rig, machine))
    if other is not None:
        own = other.machine
        machine = replace(machine, plant=own.plant, pump=own.pump.at(tick_s), strength=own.strength)
    return machine, model


def _sensed(rig: Rig, machine: SimulatedRig) -> dict[str, Any]:
    """What the board makes of pictures, by the sections `align` and `lowpass` where they are."""
    late = machine.tracker.latency_s if rig.align is None else rig.align.time_offset_s
    low = () if rig.lowpass is None else tuple((*one.b, *one.a) for one in rig.lowpass.sections)
    return {"latency_s": max(late, 0.0), "lowpass": low}


def control_model(rig: SimulatedRig, section: Controller | None = None, limits: Pair | None = None) -> Model:
    """What controllers know of a rig. Raises `BadInputError` for PWM limits that no motor has."""
    low, high = (0.0, 255.0) if section is None else (section.pwm_low, section.pwm_high)
    if limits is not None:
        low, high = limits
    return Model(rig.plant, rig.pump, rig.strength, low, high)


def suited(reference: Reference) -> tuple[str, ...]:
    """Controllers of the kind of a reference: of the angle, or of both lengths."""
    return _ANGLE if reference.kind == "angle" else _LENGTHS


def controllers_for(reference: Reference, section: Controller | None) -> tuple[str, ...]:
    """Controllers that suit a reference, tuned ones only where they have been tuned."""
    return tuple(one for one in suited(reference) if section is not None or not one.startswith("tuned"))


def _with_limits(model: Model, pid: Pid) -> Pid:
    return replace(pid, low=model.low_pwm, high=model.high_pwm, tick_s=model.tick_s)


def _orientation(model: Model, reference: Reference, pid: Pid) -> Law:
    return angle_law(_with_limits(model, pid), reference.phi_rad)


def _back(reference: Reference, back: BackOrientation) -> Law:
    wanted = reference.phi_rad.tolist()
    return lambda k, seen: back.step(wanted[k], seen.phi_rad)


def _position(model: Model, reference: Reference, pid: Pid, extra: str) -> Law:
    added = np.zeros_like(reference.q_m)
    if extra == "map":
        added = feed_forward_pwm(model, reference.q_m)
    elif extra == "ff":
        added = feed_forward(FeedForward(), reference.q_m)
    return length_law(_with_limits(model, pid), reference.q_m, added)


class _Torque:
    """Computed torque with its observer."""

    def __init__(
        self, rig: SimulatedRig, model: Model, reference: Reference, control: ComputedTorque, sensors: bool
    ) -> None:
        tracker = rig.tracker
        latency = tracker.latency_s if sensors else 0.0
        self.observer = design_observer(model, latency_s=latency, marker_offset_m=tracker.marker_offset_m)
        self.wanted = wanted_motion(model, reference.q_m)
        self.control, self.sensors = control, sensors
        view = rig.view
        self.camera = view.camera
        A = view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m])
        self.to_plane = np.linalg.inv(A) @ view.camera.K
        self.limited = 0

    def _marker(self, seen: Seen) -> Pair:
        if seen.marker_px[0] != seen.marker_px[0]:
            return float("nan"), float("nan")
        ray = undistort(self.camera, np.array([seen.marker_px]))[0]
        p = self.to_plane @ np.array([ray[0], ray[1], 1.0])
        return float(p[0] / p[2]), float(p[1] / p[2])

    def __call__(self, k: int, seen: Seen) -> Pair:
        if self.sensors:
            rate = -sum(row[2] for row in seen.imu) / len(seen.imu) if seen.imu else float("nan")
            self.observer.correct(self._marker(seen), rate)
        else:
            self.observer.y[:2] = seen.q_m
        pwm, limited = computed_torque_step(self.control, self.observer, self.wanted, k)
        self.limited += limited
        self.observer.predict(pwm)
        return pwm


def _tuned(section: Controller | None) -> Controller:
    if section is None:
        raise BadInputError("controller: no gains have been tuned, run calib control tune first")
    return section


def _back_calculation(
    model: Model, pid: Pid, back_s: float, share: float | None, sign: int = 1
) -> BackOrientation:
    own = replace(pid, tick_s=model.tick_s)
    return BackOrientation(own, back_s, model, float("inf") if share is None else share, sign)


def _law(
    name: str,
    rig: SimulatedRig,
    model: Model,
    reference: Reference,
    section: Controller | None,
    sensors: bool,
) -> Law:
    if name in ANGLE_PIDS:
        return _orientation(model, reference, ANGLE_PIDS[name])
    if name == "back":
        return _back(reference, _back_calculation(model, ANGLE_PIDS["pid"], _BACK_S, _SHARE))
    if name == "tuned-pid":
        own = _tuned(section).orientation
        pid = Pid(own.Kp_pwm_per_rad, own.Ki_pwm_per_rad_s, own.Kd_pwm_s_per_rad)
        return _back(
            reference, _back_calculation(model, pid, own.back_calculation_s, own.falling_share, own.sign)
        )
    if name == "tuned-pd":
        gains = _tuned(section).position
        pid = Pid(gains.Kp_pwm_per_m, gains.Ki_pwm_per_m_s, gains.Kd_pwm_s_per_m)
        return _position(model, reference, pid, "map")
    if name == "torque":
        known = None if section is None else section.computed_torque
        control = ComputedTorque()
        if known is not None:
            control = ComputedTorque(known.horizon_ticks, known.Kp_per_s2, known.Kd_per_s)
        return _Torque(rig, model, reference, control, sensors)
    pid = _ELLIPSE_PD if reference.name == "ellipse" else LENGTHS_PD
    return _position(model, reference, pid, name.partition("+")[2])


def run_controller(
    name: str,
    rig: SimulatedRig,
    model: Model,
    reference: Reference,
    section: Controller | None = None,
    seed: int = 0,
    feedback: str = "sensors",
) -> Outcome:
    """Run a controller along a reference, from rest.

    Parameters
    ----------
    rig : what is controlled. model : what the controller knows of it.
    feedback : "sensors" or "truth".

    Raises `BadInputError` for tuned gains that are not there, and as `simulate`.
    """
    law = _law(name, rig, model, reference, section, feedback == "sensors")
    run, figures = _tried(rig, model, reference, law, seed, feedback)
    return Outcome(name, run, figures, law.limited / len(run.pwm) if isinstance(law, _Torque) else None)


def _tried(
    rig: SimulatedRig, model: Model, reference: Reference, law: Law, seed: int, feedback: str
) -> tuple[Run, Tracking]:
    """A run from rest, and how well it follows the reference."""
    run = simulate(rig, at_rest(rig), law, len(reference.q_m), seed, feedback)
    return run, tracking(
        reference, run.states[:, :2], run.pwm, rig.plant.bellows_radius_m, model.low_pwm, model.high_pwm
    )


def _jump_within(model: Model) -> Reference:
    """The jump between two angles, both smaller for an actuator that does not bend so far."""
    jump = built_in(model, "jump")
    part = _OF_LARGEST * largest_angle(model) / float(jump.phi_rad.max())
    if part >= 1.0:
        return jump
    return replace(from_angles(model, jump.name, part * jump.phi_rad), from_rest=True, jump_s=jump.jump_s)


_OF_LARGEST = 0.9
_TIMES_S = (0.5, 1.0, 2.0, 4.0)
_SHARES = (0.25, 0.4, 0.7)


def tune_back_calculation(
    rig: SimulatedRig, model: Model, pid: Pid, progress: Callable[[int, int], None]
) -> tuple[float, float, dict[str, dict[str, float]]]:
    """Time and share of the falling rate with the least overshoot after the jump, and what each does.

    Only such settings count whose first step is at 95 % no later than with clamping, a tick apart; where
    there is none the fastest is taken. The true state is fed back, so that noise decides nothing.
    """
    reference = _jump_within(model)
    clamped = _jump(rig, model, reference, _orientation(model, reference, replace(pid, clamping=True)))
    plain = _jump(rig, model, reference, _orientation(model, reference, pid))
    found: dict[Pair, dict[str, float]] = {}
    for T, share in product(_TIMES_S, _SHARES):
        progress(len(found), len(_TIMES_S) * len(_SHARES))
        found[T, share] = _jump(
            rig, model, reference, _back(reference, _back_calculation(model, pid, T, share))
        )

    def merit(setting: Pair) -> Pair:
        late = max(found[setting]["rise_s"] - clamped["rise_s"] - model.tick_s, 0.0)
        return round(late, 6), found[setting]["overshoot_after_jump_rad"]

    best = min(found, key=merit)
    return *best, {"pid": plain, "clamping": clamped, "back_calculation": found[best]}


def _jump(rig: SimulatedRig, model: Model, reference: Reference, law: Law) -> dict[str, float]:
    _, figures = _tried(rig, model, reference, law, 0, "truth")
    return {
        "overshoot_after_jump_rad": figures.jump_overshoot_rad or 0.0,
        "rise_s": reference.duration_s if figures.rise_s is None else figures.rise_s,
    }

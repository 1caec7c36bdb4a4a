"""The experiments of the source on the simulated rig, by name, with and without a controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from calib.core.arrays import FloatArray, rms
from calib.core.errors import BadInputError, UsageError
from calib.core.result import Section
from calib.core.rig import Rig
from calib.core.schema import contradiction, validated
from calib.core.units import parse_duration_s
from calib.io.logs import Log
from calib.stages.actuator.kinematics import angle
from calib.stages.actuator.simulate import RigState, rig_at_rest
from calib.stages.actuator.swing import decrement
from calib.stages.control.laws import (
    ANGLE_PIDS,
    LENGTHS_PD,
    Channel,
    FeedForward,
    Pid,
    feed_forward,
    saturate,
)
from calib.stages.control.references import Ellipse, PolynomialElongation
from calib.stages.control.tracking import settling_s
from calib.twin.rig import SimulatedRig, rig_from_file
from calib.twin.sensors import stream, uniform
from calib.twin.simulate import Law, Run, Seen, count_ticks, run_log
from calib.twin.simulate import simulate as run_loop

# ----------------------------------------------------------------------
# Figures by which the source describes its experiments, read off simulated runs.
#
# All take evenly sampled truth. Where a curve crosses a level between two samples the crossing is found
# on the straight line between them.


@dataclass(frozen=True)
class StepResponse:
    """Response to a step from rest; times from the step, None for what does not happen.

    Attributes
    ----------
    reach_s : first time at the set-point.
    peak : greatest value.
    settle_s : time after which the error stays within 2 % of the set-point.
    """

    reach_s: float | None
    peak: float
    settle_s: float | None


_BAND, _FALLEN = 0.02, 0.05
"""Shares: of the set-point, within which a response has settled; of the first value, below which it fell."""


def step_response(tick_s: float, values: FloatArray, wanted: float) -> StepResponse:
    """Response (n,), sampled from the step on, to a rising step to `wanted`."""
    above = np.nonzero(values >= wanted)[0]
    reach = None
    if len(above):
        i = int(above[0])
        part = 0.0 if i == 0 else (wanted - values[i - 1]) / (values[i] - values[i - 1])
        reach = float((i - 1 + part) * tick_s) if i else 0.0
    settle = settling_s(tick_s, values - wanted, _BAND * abs(wanted))
    return StepResponse(reach, float(values.max()), settle)


def fall_time_s(tick_s: float, values: FloatArray) -> float | None:
    """Time until values (n,), sampled from the beginning of the fall on, are below 5 % of the first."""
    below = np.nonzero(values < _FALLEN * values[0])[0]
    return float(below[0] * tick_s) if len(below) else None


# ----------------------------------------------------------------------
# What the scenarios have in common: how they are run, and small helpers.

Figures = dict[str, float | None]
"""Figures of a run by name; None for what did not happen."""

Plain = Annotated[float, Field(allow_inf_nan=False)]
"""A number, or its text as it is typed."""
Numbers = Annotated[
    tuple[Plain, ...], BeforeValidator(lambda given: given.split(",") if isinstance(given, str) else given)
]
"""Numbers, or their text with commas between them."""


class Scenario(Section):
    """An experiment: its length unless told otherwise, how it is run, and figures of the result."""

    duration_s: Plain = 10.0

    def start(self, rig: SimulatedRig) -> RigState:
        """The state before the first tick."""
        return at_rest(rig)

    def drive(self, rig: SimulatedRig, ticks: int) -> FloatArray | Law:
        """Commands (ticks, 2), or the controller."""
        del rig
        return np.zeros((ticks, 2))

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        """The simulated run. Raises `BadInputError` as `calib.twin.simulate.simulate`."""
        return run_loop(rig, self.start(rig), self.drive(rig, ticks), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        """By which the source describes the experiment."""
        return _span(run)


def at_rest(rig: SimulatedRig) -> RigState:
    """The rig at rest, straight, with the pumps off."""
    return rig_at_rest(rig.plant, rig.pump)


def tick_times(rig: SimulatedRig, ticks: int) -> FloatArray:
    """Times of the ticks (n,) [s]."""
    return rig.pump.tick_s * np.arange(ticks, dtype=np.float64)


def elongation_mm(run: Run) -> FloatArray:
    """Length of the backbone beyond the rest length (n,) [mm] at the ticks."""
    return np.asarray(1e3 * (run.states[:, :2].mean(axis=1) - run.plant.rest_length_m))


def _span(run: Run) -> Figures:
    q = run.states[:, :2]
    return {"shortest_bellows_mm": float(1e3 * q.min()), "longest_bellows_mm": float(1e3 * q.max())}


# ----------------------------------------------------------------------
# Experiments without a controller: rest, swing, steps, deflation, and signals for identification.

_PRBS = 3
"""Stream of the random commands."""


def _pwm(rig: SimulatedRig, volt: float) -> float:
    # 6 V is a PWM value of 127.5 in the source, so it is not rounded here.
    supply = rig.pump.static.supply_V
    if not 0.0 <= volt <= supply:
        raise BadInputError(f"found {volt:g} V for a motor, expected 0 to {supply:g}, its supply")
    return 255.0 * volt / supply


class Static(Scenario):
    """At rest, pumps off, for the noise and drift of the sensors (Fig. 2.4)."""

    duration_s: Plain = 60.0
    onchip: bool = True

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        rig = replace(rig, imu=replace(rig.imu, onchip=self.onchip or rig.imu.onchip))
        return super().run(rig, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        if not run.rig.imu.onchip or len(run.sensors.onchip_rad) < 2:
            return {}
        slope = np.polyfit(run.sensors.imu.taken_s, run.sensors.onchip_rad, 1)[0]
        return {"onchip_drift_degps": float(np.degrees(slope))}


class SwingRelease(Scenario):
    """Released from an angle with the hoses off (3.3)."""

    duration_s: Plain = 5.0
    phi_rad: Plain = 0.5
    length_m: Plain | None = None

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        start = rig_at_rest(rig.free_plant, rig.pump, self.phi_rad, self.length_m)
        return run_loop(rig, start, np.zeros((ticks, 2)), ticks, seed, feedback, rig.free_plant)

    def figures(self, run: Run) -> Figures:
        nodes = run.trajectory.nodes
        t = run.trajectory.node_s * np.arange(len(nodes), dtype=np.float64)
        try:
            swing = decrement(t, angle(nodes[:, :2], run.plant.bellows_radius_m))
        except BadInputError:
            return {}
        figures: Figures = {"damping_ratio": swing.zeta, "frequency_hz": swing.frequency_hz}
        # The middle of the oscillation at every extreme but the first and the last.
        peak, middle_s = swing.peak, swing.peak_at_s[1:-1]
        middle_rad = 0.25 * (peak[:-2] + 2.0 * peak[1:-1] + peak[2:])
        # One and four periods after the release; the first extreme still has the release in it.
        for name, at_s in (("offset_after_a_period_rad", 0.25), ("offset_after_1s_rad", 1.0)):
            if middle_s[-1] >= at_s:
                figures[name] = float(middle_rad[np.argmin(np.abs(middle_s - at_s))])
        return figures


class Steps(Scenario):
    """Both motors at 6, 8, 10 and 12 V in turn, with time to deflate after each (Fig. 2.12)."""

    duration_s: Plain = 56.0
    volts: Numbers = (6.0, 8.0, 10.0, 12.0)
    on_s: Plain = 6.0
    off_s: Plain = 8.0

    def drive(self, rig: SimulatedRig, ticks: int) -> FloatArray:
        pwm, t = np.zeros((ticks, 2)), tick_times(rig, ticks)
        for i, volt in enumerate(self.volts):
            begin = i * (self.on_s + self.off_s)
            pwm[(t >= begin) & (t < begin + self.on_s)] = _pwm(rig, volt)
        return pwm

    def figures(self, run: Run) -> Figures:
        mm, figures = elongation_mm(run), Figures()
        for i, volt in enumerate(self.volts):
            end = round((i * (self.on_s + self.off_s) + self.on_s) / run.tick_s)
            if end < len(mm):
                figures[f"elongation_at_{volt:g}V_mm"] = float(mm[end])
        return figures


class Deflate(Scenario):
    """Both motors at a voltage, then off (Fig. 3.24)."""

    duration_s: Plain = 14.0
    volt: Plain = 12.0
    off_at_s: Plain = 5.0

    def drive(self, rig: SimulatedRig, ticks: int) -> FloatArray:
        pwm = np.where(tick_times(rig, ticks) < self.off_at_s - 1e-9, _pwm(rig, self.volt), 0.0)
        return np.stack([pwm, pwm], axis=1)

    def figures(self, run: Run) -> Figures:
        mm, off = elongation_mm(run), round(self.off_at_s / run.tick_s)
        if off >= len(mm):
            return {}
        return {"inflated_mm": float(mm[off]), "deflation_s": fall_time_s(run.tick_s, mm[off:])}


class Chirp(Scenario):
    """Both motors swept through frequencies, the second a quarter of a turn behind, for identification."""

    duration_s: Plain = 40.0
    middle_pwm: Plain = 170.0
    amplitude_pwm: Plain = 70.0
    from_hz: Annotated[Plain, Field(gt=0.0)] = 0.05
    to_hz: Plain = 2.0

    @model_validator(mode="after")
    def _rising(self) -> Chirp:
        if self.to_hz < self.from_hz:
            raise contradiction(f"to_hz is {self.to_hz:g}, expected at least from_hz, {self.from_hz:g}")
        return self

    def drive(self, rig: SimulatedRig, ticks: int) -> FloatArray:
        t, growth = tick_times(rig, ticks), np.log(self.to_hz / self.from_hz)
        span = ticks * rig.pump.tick_s
        cycles = self.from_hz * (t if growth == 0.0 else span / growth * np.expm1(growth * t / span))
        phase = 2.0 * np.pi * cycles
        waves = np.stack([np.sin(phase), np.cos(phase)], axis=1)
        return np.clip(np.floor(self.middle_pwm + self.amplitude_pwm * waves + 0.5), 0.0, 255.0)


class Prbs(Scenario):
    """Each motor jumps at random between two values, at random times, for identification."""

    duration_s: Plain = 40.0
    low_pwm: Plain = 105.0
    high_pwm: Plain = 235.0
    hold_s: Annotated[Plain, Field(gt=0.0)] = 0.5

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        hold = max(round(self.hold_s / rig.pump.tick_s), 1)
        bits = uniform(stream(seed, _PRBS), 2 * (ticks // hold + 1)).reshape(-1, 2) < 0.5
        pwm = np.repeat(np.where(bits, self.low_pwm, self.high_pwm), hold, axis=0)[:ticks]
        return run_loop(rig, at_rest(rig), np.clip(pwm, 0.0, 255.0), ticks, seed, feedback)


# ----------------------------------------------------------------------
# Experiments of chapter 4 with a controller at every tick: angle, elongation, ellipse.

Pair = tuple[float, float]

# Control of angle and of lengths (Fig. 4.1, 4.6, 4.10): one error and one PID controller for each
# bellows, the feed-forward where there is one, and the limits:
#
#     orientation   e = (s, -s)(phi_ref - phi)            (4.1), s = +1 or -1
#     position      e = q_ref - q,  u + u_ff(q_ref)       (4.5), (4.6), (4.8)
#
# The text under (4.1) says that bellows 2 has to extend when phi < phi_ref; the formula drives bellows
# 1, which agrees with phi = (q1 - q2) / (2 r_B) of (3.3). `sign` is +1 for the formula, -1 for a rig
# whose hoses are crossed. Feed-forward and saturated values are not fed back.


def _limited(pid: Pid, u1: float, u2: float) -> Pair:
    return saturate(u1, pid.low, pid.high), saturate(u2, pid.low, pid.high)


def angle_law(pid: Pid, wanted_rad: FloatArray, sign: int = 1) -> Law:
    """Control of the angle (4.1) along (n,) [rad]."""
    wanted, first, second = wanted_rad.tolist(), Channel(pid), Channel(pid)

    def law(k: int, seen: Seen) -> Pair:
        error = sign * (wanted[k] - seen.phi_rad)
        return _limited(pid, first.step(error), second.step(-error))

    return law


def length_law(pid: Pid, wanted_m: FloatArray, added_pwm: FloatArray) -> Law:
    """Control of the lengths (4.5) along (n, 2) [m], with a feed-forward (n, 2)."""
    wanted, added = wanted_m.tolist(), added_pwm.tolist()
    first, second = Channel(pid), Channel(pid)

    def law(k: int, seen: Seen) -> Pair:
        u1, u2 = first.step(wanted[k][0] - seen.q_m[0]), second.step(wanted[k][1] - seen.q_m[1])
        return _limited(pid, u1 + added[k][0], u2 + added[k][1])

    return law


class _Controlled(Scenario):
    """A scenario with gains that stand in place of its controller's own."""

    Kp: Plain | None = None
    Ki: Plain | None = None
    Kd: Plain | None = None

    def _tuned(self, rig: SimulatedRig, pid: Pid) -> Pid:
        """The controller at the rig's tick."""
        given = {name: getattr(self, name) for name in ("Kp", "Ki", "Kd")}
        own = {name: value for name, value in given.items() if value is not None}
        return replace(pid, **own, tick_s=rig.pump.tick_s)


class Orientation(_Controlled):
    """The angle alone, with P, PID or PID with clamping (4.1 - 4.4); a jump at 5 s (Fig. 4.7).

    `controller` is p, pid or clamping with the gains of Figs. 4.2 and 4.4, which Kp, Ki, Kd replace.
    """

    controller: Literal["p", "pid", "clamping"] = "pid"
    reference_rad: Plain = 0.7
    jump_to_rad: Plain = 0.3
    jump_at_s: Plain = 5.0
    sign: Annotated[Literal[1, -1], BeforeValidator(int)] = 1

    def drive(self, rig: SimulatedRig, ticks: int) -> Law:
        early = tick_times(rig, ticks) + 1e-9 < self.jump_at_s
        wanted = np.where(early, self.reference_rad, self.jump_to_rad)
        return angle_law(self._tuned(rig, ANGLE_PIDS[self.controller]), wanted, self.sign)

    def figures(self, run: Run) -> Figures:
        jump = max(min(round(self.jump_at_s / run.tick_s), len(run.pwm)), 1)
        before, after = run.phi_rad[:jump], run.phi_rad[jump:]
        rise = step_response(run.tick_s, before, self.reference_rad)
        figures: Figures = {"reach_s": rise.reach_s, "peak_rad": rise.peak, "settle_s": rise.settle_s}
        if len(after):
            down = np.sign(self.jump_to_rad - self.reference_rad)
            figures["overshoot_after_jump_rad"] = max(float(np.max(down * (after - self.jump_to_rad))), 0.0)
        return figures


def _line(wanted_m: FloatArray, feed: bool) -> FloatArray:
    return feed_forward(FeedForward(), wanted_m) if feed else np.zeros_like(wanted_m)


def _errors_mm(run: Run, wanted_m: FloatArray) -> FloatArray:
    return np.asarray(1e3 * (wanted_m - run.states[:, :2]))


class Elongation(_Controlled):
    """Both bellows along (4.7), held after 5 s (Fig. 4.12).

    `controller` is pd+ff, pd or pid with the gains of Fig. 4.12, which Kp, Ki, Kd replace.
    `start_m` is the length at the start, by default the rest length; the source's run began at 68.1 mm.
    """

    controller: Literal["pd+ff", "pd", "pid"] = "pd+ff"
    start_m: Plain | None = None

    def start(self, rig: SimulatedRig) -> RigState:
        return rig_at_rest(rig.plant, rig.pump, length_m=self.start_m)

    def drive(self, rig: SimulatedRig, ticks: int) -> Law:
        pid = replace(LENGTHS_PD, Ki=8000.0 if self.controller == "pid" else 0.0)
        wanted = PolynomialElongation().bellows_m(tick_times(rig, ticks))
        return length_law(self._tuned(rig, pid), wanted, _line(wanted, self.controller == "pd+ff"))

    def figures(self, run: Run) -> Figures:
        error = _errors_mm(run, PolynomialElongation().bellows_m(run.t_s))
        figures: Figures = {"largest_error_mm": float(np.abs(error).max())}
        late = error[run.t_s >= 6.0]
        if len(late):
            figures["static_error_mm"] = float(late.mean())
        return figures


class EllipseTrack(Scenario):
    """The head around the ellipse (4.9) with PD and feed-forward (Figs. 4.14 - 4.18)."""

    duration_s: Plain = 20.0
    chord: Literal["exact", "thesis"] = "exact"
    Kp: Plain = 10000.0
    Kd: Plain = 1000.0
    feedforward: bool = True

    def _wanted(self, rig: SimulatedRig, t_s: FloatArray) -> FloatArray:
        return Ellipse(chord=self.chord).bellows_m(t_s, rig.plant.bellows_radius_m)

    def drive(self, rig: SimulatedRig, ticks: int) -> Law:
        wanted = self._wanted(rig, tick_times(rig, ticks))
        pid = Pid(self.Kp, 0.0, self.Kd, tick_s=rig.pump.tick_s)
        return length_law(pid, wanted, _line(wanted, self.feedforward))

    def figures(self, run: Run) -> Figures:
        error = _errors_mm(run, self._wanted(run.rig, run.t_s))[run.t_s >= 2.0]
        if not len(error):
            return {}
        return {"rms_error_q1_mm": rms(error[:, 0]), "rms_error_q2_mm": rms(error[:, 1])}


# ----------------------------------------------------------------------
# The experiments of the source on the simulated rig, by name.
#
# Open loop: `static`, `swing` (3.3), `steps` (Fig. 2.12), `deflate` (Fig. 3.24), `chirp` and `prbs` for
# identification. Closed loop at 60 Hz: `orientation` (4.1), `elongation` (4.7), `ellipse` (4.9).
#
# With the nominal plant and `feedback="truth"` they give (thesis in brackets)
#
#     swing from 0.5 rad       damping ratio 0.055 (0.0513), 4.0 Hz, offset 41 -> 6 mrad after 1 s
#     steady elongation        1.88 / 11.11 / 21.73 / 26.56 mm at 6 / 8 / 10 / 12 V (26 mm at 12 V)
#     deflation                5.05 s to 5 % (about 5 s)
#     PID to 0.7 rad           reached at 0.91 s (0.95), peak 0.742 rad (0.7288), settled at 2.4 s (2.3)
#     P 500/1000/2000/5000     at most 0.375 / 0.535 / 0.630 / 0.699 rad (0.7 is never reached)
#     PD + feed-forward, 4.7   error at most 2.00 mm (2.149), static -0.23 mm (about -0.3)
#     anti-windup on a jump    overshoot halved (almost none)
#
# What the model does not reproduce: the wobble of the ellipse at 4 - 5 s and its poor second half
# (Figs. 4.14 - 4.18), the overshoot that the source's own simulation has after deflation (Fig. 3.24), an
# anti-windup without overshoot (Fig. 4.7), and, while both pumps are alike (see `strength`), the
# different lengths of the two bellows in Figs. 4.12 and 4.13.

SCENARIOS: dict[str, type[Scenario]] = {
    "static": Static,
    "swing": SwingRelease,
    "steps": Steps,
    "deflate": Deflate,
    "orientation": Orientation,
    "elongation": Elongation,
    "ellipse": EllipseTrack,
    "chirp": Chirp,
    "prbs": Prbs,
}
"""What `make_scenario` knows; `rig`, a folder with all of them, is in `calib.twin.folder`."""


def make_scenario(name: str, options: Mapping[str, object] | None = None) -> Scenario:
    """A scenario by name, with options as values or as they are typed, such as `{"Kp": "500"}`.

    Raises `UsageError` for a name, an option or a value that the scenario cannot have.
    """
    if name not in SCENARIOS:
        raise UsageError(f"SCENARIO: {name!r} is not one of {', '.join([*SCENARIOS, 'rig'])}")
    try:
        return validated(SCENARIOS[name], dict(options or {}), "scenario", name)
    except BadInputError as error:
        raise UsageError(str(error)) from error


def run_scenario(
    scenario: Scenario,
    rig: SimulatedRig,
    seed: int = 0,
    feedback: str = "sensors",
    duration_s: float | None = None,
) -> Run:
    """Run a scenario on a rig for its own duration or for `duration_s` [s]; the same seed, the same run.

    Raises `BadInputError` as `simulate`.
    """
    duration = scenario.duration_s if duration_s is None else duration_s
    return scenario.run(rig, count_ticks(duration, rig.pump.tick_s), seed, feedback)


def simulate(
    scenario: str,
    rig: Rig | None = None,
    *,
    seed: int = 0,
    feedback: str = "sensors",
    duration: float | str | None = None,
    **settings: object,
) -> Log:
    """Simulate an experiment; its log has the truth in columns of its own.

    Parameters
    ----------
    scenario : one of `SCENARIOS`. rig : what to simulate; the nominal rig without.
    seed : of all noise; the same seed, the same log.
    feedback : what controllers get: "sensors", filtered as in the firmware, or "truth".
    duration : [s], or with a unit such as "10s"; that of the scenario without.
    settings : options of the scenario, such as Kp=500.

    Raises `UsageError`, `BadInputError` as `make_scenario` and `run_scenario`.
    """
    if seed < 0:
        raise UsageError(f"seed is {seed!r}, expected a whole number from 0 on")
    machine = SimulatedRig() if rig is None else rig_from_file(rig)
    plan = make_scenario(scenario, settings)
    duration_s = parse_duration_s(duration, "duration") if isinstance(duration, str) else duration
    return run_log(run_scenario(plan, machine, seed, feedback, duration_s), scenario)

"""The experiments of the source on the simulated rig, by name, with and without a controller."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError, UsageError
from calib.core.rig import Rig
from calib.core.units import parse_duration_s
from calib.io.logs import Log
from calib.stages.actuator.simulate import RigState, rig_at_rest
from calib.stages.control.laws import (
    FeedForward,
    LoopState,
    Pid,
    feed_forward,
    saturate,
    step_orientation,
    step_position,
)
from calib.stages.control.references import Ellipse, PolynomialElongation
from calib.twin.rig import SimulatedRig, rig_from_file
from calib.twin.sensors import stream, uniform
from calib.twin.simulate import Law, Run, Seen, log_of
from calib.twin.simulate import simulate as run_loop

# ----------------------------------------------------------------------
# Figures by which the source describes its experiments, read off simulated runs.
#
# All take evenly sampled truth. Where a curve crosses a level between two samples the crossing is found
# on the straight line between them.


@dataclass(frozen=True)
class Swing:
    """A decaying oscillation.

    Attributes
    ----------
    damping_ratio : zeta by (3.39), (3.40) on peak-to-peak amplitudes, mean over the first half periods.
    frequency_hz : mean over the same.
    offset_at_s, offset_rad : middle of the oscillation at every extreme but the first and last.
    """

    damping_ratio: float
    frequency_hz: float
    offset_at_s: FloatArray
    offset_rad: FloatArray


def swing_decay(t_s: FloatArray, phi_rad: FloatArray, half_periods: int = 8) -> Swing:
    """Decay of a swing that is released at the first sample, from its first half periods.

    Peak-to-peak amplitudes do not see an offset that decays slowly; on the raw curve (3.39) yields
    about 0.004. The offset at an extreme is (a + 2 b + c) / 4 of it and its neighbours.

    Raises `BadInputError` when there are fewer than three extremes.
    """
    inner = phi_rad[1:-1]
    rising, falling = inner > phi_rad[:-2], inner < phi_rad[:-2]
    turn = np.nonzero((rising & (inner >= phi_rad[2:])) | (falling & (inner <= phi_rad[2:])))[0] + 1
    if len(turn) < 2:
        raise BadInputError(f"swing: found {len(turn) + 1} extremes, expected at least 3")
    # The parabola through three samples has its extreme between them.
    a, b, c = phi_rad[turn - 1], phi_rad[turn], phi_rad[turn + 1]
    bend = a - 2.0 * b + c
    shift = 0.5 * (a - c) / np.where(bend == 0.0, 1.0, bend)
    at = np.concatenate([[t_s[0]], t_s[turn] + float(t_s[1] - t_s[0]) * shift])
    value = np.concatenate([[phi_rad[0]], b - 0.25 * (a - c) * shift])
    used = min(half_periods, len(turn))
    swings = np.abs(np.diff(value[: used + 1]))
    delta = 2.0 * float(np.mean(np.log(swings[:-1] / swings[1:])))
    return Swing(
        delta / math.hypot(delta, 2.0 * math.pi),
        0.5 * used / float(at[used] - at[0]),
        at[1:-1],
        0.25 * (value[:-2] + 2.0 * value[1:-1] + value[2:]),
    )


@dataclass(frozen=True)
class StepResponse:
    """Response to a step from rest; times from the step, None for what does not happen.

    Attributes
    ----------
    reach_s : first time at the set-point.
    peak : greatest value.
    settle_s : time after which the error stays within the band.
    """

    reach_s: float | None
    peak: float
    settle_s: float | None


def step_response(tick_s: float, values: FloatArray, wanted: float, band: float = 0.02) -> StepResponse:
    """Response (n,), sampled from the step on, to a rising step to `wanted`; band as a share of it."""
    above = np.nonzero(values >= wanted)[0]
    reach = None
    if len(above):
        i = int(above[0])
        part = 0.0 if i == 0 else (wanted - values[i - 1]) / (values[i] - values[i - 1])
        reach = float((i - 1 + part) * tick_s) if i else 0.0
    outside = np.nonzero(np.abs(values - wanted) > band * abs(wanted))[0]
    last = int(outside[-1]) + 1 if len(outside) else 0
    return StepResponse(reach, float(values.max()), last * tick_s if last < len(values) else None)


def fall_time_s(tick_s: float, values: FloatArray, share: float = 0.05) -> float | None:
    """Time until values (n,), sampled from the beginning of the fall on, are below a share of the first."""
    below = np.nonzero(values < share * values[0])[0]
    return float(below[0] * tick_s) if len(below) else None


# ----------------------------------------------------------------------
# What the scenarios have in common: their interface, and small helpers.

UNSET = float("nan")
"""Default of a number that then follows from something else."""

Figures = dict[str, float | None]
"""Figures of a run by name; None for what did not happen."""


class Scenario(Protocol):
    """An experiment: its length unless told otherwise, how it is run, and figures of the result."""

    @property
    def duration_s(self) -> float: ...

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run: ...

    def figures(self, run: Run) -> Figures: ...


def or_none(value: float) -> float | None:
    """A number, or None for `UNSET`."""
    return None if value != value else value


def at_rest(rig: SimulatedRig) -> RigState:
    """The rig at rest, straight, with the pumps off."""
    return rig_at_rest(rig.plant, rig.pump)


def tick_times(rig: SimulatedRig, ticks: int) -> FloatArray:
    """Times of the ticks (n,) [s]."""
    return rig.pump.tick_s * np.arange(ticks, dtype=np.float64)


def elongation_mm(run: Run) -> FloatArray:
    """Length of the backbone beyond the rest length (n,) [mm] at the ticks."""
    return np.asarray(1e3 * (run.states[:, :2].mean(axis=1) - run.plant.rest_length_m))


# ----------------------------------------------------------------------
# Experiments without a controller: rest, swing, steps, deflation, and signals for identification.

_PRBS = 3
"""Stream of the random commands."""


def _pwm(rig: SimulatedRig, volt: float) -> float:
    # 6 V is a PWM value of 127.5 in the source, so it is not rounded here.
    supply = float(getattr(rig.pump.static, "supply_V", 12.0))
    return min(max(255.0 * volt / supply, 0.0), 255.0)


@dataclass(frozen=True)
class Static:
    """At rest, pumps off, for the noise and drift of the sensors (Fig. 2.4)."""

    duration_s: float = 60.0
    onchip: bool = True

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        rig = replace(rig, imu=replace(rig.imu, onchip=self.onchip or rig.imu.onchip))
        return run_loop(rig, at_rest(rig), np.zeros((ticks, 2)), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        if not run.rig.imu.onchip or len(run.onchip_rad) < 2:
            return {}
        slope = np.polyfit(run.imu.taken_s, run.onchip_rad, 1)[0]
        return {"onchip_drift_degps": float(np.degrees(slope))}


@dataclass(frozen=True)
class SwingRelease:
    """Released from an angle with the hoses off (3.3)."""

    duration_s: float = 5.0
    phi_rad: float = 0.5
    length_m: float = UNSET

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        start = rig_at_rest(rig.free_plant, rig.pump, self.phi_rad, or_none(self.length_m))
        return run_loop(rig, start, np.zeros((ticks, 2)), ticks, seed, feedback, rig.free_plant)

    def figures(self, run: Run) -> Figures:
        t = run.trajectory.node_s * np.arange(len(run.trajectory.nodes), dtype=np.float64)
        q = run.trajectory.nodes
        try:
            swing = swing_decay(t, (q[:, 0] - q[:, 1]) / (2.0 * run.plant.bellows_radius_m))
        except BadInputError:
            return {}
        figures: Figures = {"damping_ratio": swing.damping_ratio, "frequency_hz": swing.frequency_hz}
        # One and four periods after the release; the first extreme still has the release in it.
        for name, at_s in (("offset_after_a_period_rad", 0.25), ("offset_after_1s_rad", 1.0)):
            if swing.offset_at_s[-1] >= at_s:
                nearest = int(np.argmin(np.abs(swing.offset_at_s - at_s)))
                figures[name] = float(swing.offset_rad[nearest])
        return figures


@dataclass(frozen=True)
class Steps:
    """Both motors at 6, 8, 10 and 12 V in turn, with time to deflate after each (Fig. 2.12)."""

    duration_s: float = 56.0
    volts: tuple[float, ...] = (6.0, 8.0, 10.0, 12.0)
    on_s: float = 6.0
    off_s: float = 8.0

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        pwm, t = np.zeros((ticks, 2)), tick_times(rig, ticks)
        for i, volt in enumerate(self.volts):
            begin = i * (self.on_s + self.off_s)
            pwm[(t >= begin) & (t < begin + self.on_s)] = _pwm(rig, volt)
        return run_loop(rig, at_rest(rig), pwm, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        mm, figures = elongation_mm(run), Figures()
        for i, volt in enumerate(self.volts):
            end = round((i * (self.on_s + self.off_s) + self.on_s) / run.tick_s)
            if end < len(mm):
                figures[f"elongation_at_{volt:g}V_mm"] = float(mm[end])
        return figures


@dataclass(frozen=True)
class Deflate:
    """Both motors at a voltage, then off (Fig. 3.24)."""

    duration_s: float = 14.0
    volt: float = 12.0
    off_at_s: float = 5.0

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        on = tick_times(rig, ticks) < self.off_at_s - 1e-9
        pwm = np.where(on, _pwm(rig, self.volt), 0.0)
        return run_loop(rig, at_rest(rig), np.stack([pwm, pwm], axis=1), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        mm, off = elongation_mm(run), round(self.off_at_s / run.tick_s)
        if off >= len(mm):
            return {}
        return {"inflated_mm": float(mm[off]), "deflation_s": fall_time_s(run.tick_s, mm[off:])}


@dataclass(frozen=True)
class Chirp:
    """Both motors swept through frequencies, the second a quarter of a turn behind, for identification."""

    duration_s: float = 40.0
    middle_pwm: float = 170.0
    amplitude_pwm: float = 70.0
    from_hz: float = 0.05
    to_hz: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 < self.from_hz <= self.to_hz:
            raise BadInputError(
                f"chirp: found {self.from_hz:g} to {self.to_hz:g} Hz, expected rising frequencies"
            )

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        t, growth = tick_times(rig, ticks), np.log(self.to_hz / self.from_hz)
        span = ticks * rig.pump.tick_s
        cycles = self.from_hz * (t if growth == 0.0 else span / growth * np.expm1(growth * t / span))
        phase = 2.0 * np.pi * cycles
        waves = np.stack([np.sin(phase), np.cos(phase)], axis=1)
        pwm = np.clip(np.floor(self.middle_pwm + self.amplitude_pwm * waves + 0.5), 0.0, 255.0)
        return run_loop(rig, at_rest(rig), pwm, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        return _span(run)


@dataclass(frozen=True)
class Prbs:
    """Each motor jumps at random between two values, at random times, for identification."""

    duration_s: float = 40.0
    low_pwm: float = 105.0
    high_pwm: float = 235.0
    hold_s: float = 0.5

    def __post_init__(self) -> None:
        if not self.hold_s > 0.0:
            raise BadInputError(f"prbs hold_s: found {self.hold_s:g} s, expected a positive time")

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        hold = max(round(self.hold_s / rig.pump.tick_s), 1)
        bits = uniform(stream(seed, _PRBS), 2 * (ticks // hold + 1)).reshape(-1, 2) < 0.5
        pwm = np.repeat(np.where(bits, self.low_pwm, self.high_pwm), hold, axis=0)[:ticks]
        return run_loop(rig, at_rest(rig), np.clip(pwm, 0.0, 255.0), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        return _span(run)


def _span(run: Run) -> Figures:
    q = run.states[:, :2]
    return {"shortest_bellows_mm": float(1e3 * q.min()), "longest_bellows_mm": float(1e3 * q.max())}


# ----------------------------------------------------------------------
# Experiments of chapter 4 with a controller at every tick: angle, elongation, ellipse.

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
        if self.sign not in (1, -1):
            raise BadInputError(f"sign of the orientation error: found {self.sign}, expected 1 or -1")

    def _law(self, rig: SimulatedRig, ticks: int) -> Law:
        pid = _tuned(rig, _ORIENTATION[self.controller], self.Kp, self.Ki, self.Kd)
        early = tick_times(rig, ticks) + 1e-9 < self.jump_at_s
        wanted = np.where(early, self.reference_rad, self.jump_to_rad).tolist()

        def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, Pair]:
            memory, (u1, u2) = step_orientation(pid, memory, wanted[k], seen.phi_rad, self.sign)
            return memory, (saturate(u1), saturate(u2))

        return law

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        return run_loop(rig, at_rest(rig), self._law(rig, ticks), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        jump = max(min(round(self.jump_at_s / run.tick_s), len(run.pwm)), 1)
        before, after = run.phi_rad[:jump], run.phi_rad[jump:]
        rise = step_response(run.tick_s, before, self.reference_rad)
        figures: Figures = {"reach_s": rise.reach_s, "peak_rad": rise.peak, "settle_s": rise.settle_s}
        if len(after):
            down = np.sign(self.jump_to_rad - self.reference_rad)
            figures["overshoot_after_jump_rad"] = max(float(np.max(down * (after - self.jump_to_rad))), 0.0)
        return figures


def _position_law(pid: Pid, feed: bool, wanted_m: FloatArray) -> Law:
    rows, line = wanted_m.tolist(), FeedForward()

    def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, Pair]:
        q1, q2 = rows[k]
        memory, (u1, u2) = step_position(pid, memory, (q1, q2), seen.q_m)
        if feed:
            u1, u2 = u1 + feed_forward(line, q1), u2 + feed_forward(line, q2)
        return memory, (saturate(u1), saturate(u2))

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
        pid = _tuned(rig, pid, self.Kp, self.Ki, self.Kd)
        law = _position_law(pid, feed, PolynomialElongation().bellows_m(tick_times(rig, ticks)))
        start = rig_at_rest(rig.plant, rig.pump, length_m=or_none(self.start_m))
        return run_loop(rig, start, law, ticks, seed, feedback)

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
        _one_of("chord", self.chord, ("exact", "thesis"))

    def _wanted(self, rig: SimulatedRig, t_s: FloatArray) -> FloatArray:
        return Ellipse(chord=self.chord).bellows_m(t_s, rig.plant.bellows_radius_m)

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run:
        pid = Pid(self.Kp, 0.0, self.Kd, tick_s=rig.pump.tick_s)
        law = _position_law(pid, self.feedforward, self._wanted(rig, tick_times(rig, ticks)))
        return run_loop(rig, at_rest(rig), law, ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        error = _errors_mm(run, self._wanted(run.rig, run.t_s))[run.t_s >= 2.0]
        if not len(error):
            return {}
        return {
            "rms_error_q1_mm": float(np.sqrt(np.mean(error[:, 0] ** 2))),
            "rms_error_q2_mm": float(np.sqrt(np.mean(error[:, 1] ** 2))),
        }


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
# anti-windup without overshoot (Fig. 4.7), and, while both pumps are alike (see `pump_strength`), the
# different lengths of the two bellows in Figs. 4.12 and 4.13.

SCENARIOS: dict[str, type[Any]] = {
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


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _value(name: str, text: str, default: object) -> object:
    """An option's text as a value of the default's kind."""
    try:
        if isinstance(default, bool):
            return {"true": True, "yes": True, "false": False, "no": False}[text.strip().lower()]
        if isinstance(default, tuple):
            return tuple(_finite(part) for part in text.split(","))
        if isinstance(default, int):
            return int(text)
        if isinstance(default, float):
            return _finite(text)
    except (KeyError, ValueError):
        kinds = {bool: "true or false", tuple: "numbers separated by commas", int: "a whole number"}
        kind = kinds.get(type(default), "a number")
        raise UsageError(f"{name}: {text!r} is not {kind}") from None
    return text


def make_scenario(name: str, options: Mapping[str, str] | None = None) -> Scenario:
    """A scenario by name, with options as they are typed, such as `{"Kp": "500"}`.

    Raises `UsageError` for a name, an option or a value that is not known, `BadInputError` for one
    that the scenario cannot run with.
    """
    if name not in SCENARIOS:
        raise UsageError(f"SCENARIO: {name!r} is not one of {', '.join([*SCENARIOS, 'rig'])}")
    kind = SCENARIOS[name]
    defaults = {f.name: f.default for f in fields(kind)}
    values = {}
    for key, text in (options or {}).items():
        if key not in defaults or key == "duration_s":
            known = ", ".join(k for k in defaults if k != "duration_s")
            raise UsageError(f"{key}: is no option of the scenario {name}, expected one of {known}")
        values[key] = _value(key, text, defaults[key])
    scenario: Scenario = kind(**values)
    return scenario


def run_scenario(
    scenario: Scenario,
    rig: SimulatedRig,
    seed: int = 0,
    feedback: str = "sensors",
    duration_s: float | None = None,
) -> Run:
    """Run a scenario on a rig for its own duration or for `duration_s` [s]; the same seed, the same run.

    Raises `BadInputError` as `simulate`, and for a duration that is not a number.
    """
    duration = scenario.duration_s if duration_s is None else duration_s
    if not math.isfinite(duration):
        raise BadInputError(f"duration: found {duration}, expected a time")
    return scenario.run(rig, round(duration / rig.pump.tick_s), seed, feedback)


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
    machine = SimulatedRig() if rig is None else rig_from_file(rig)
    plan = make_scenario(scenario, {name: as_typed(value) for name, value in settings.items()})
    duration_s = parse_duration_s(duration, "duration") if isinstance(duration, str) else duration
    return log_of(run_scenario(plan, machine, seed, feedback, duration_s), scenario)


def as_typed(value: object) -> str:
    """A setting as it is typed, such as "500" for 500.0."""
    if isinstance(value, list | tuple):
        return ",".join(as_typed(one) for one in value)
    if isinstance(value, bool):
        return str(value).lower()
    return repr(int(value)) if isinstance(value, float) and value == math.floor(value) else str(value)

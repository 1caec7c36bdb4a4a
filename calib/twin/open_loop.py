"""Experiments without a controller: rest, swing, steps, deflation, and signals for identification."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.actuator.integrate import rig_at_rest
from calib.errors import BadInputError
from calib.twin.background import uniform
from calib.twin.experiment import UNSET, Figures, at_rest, elongation_mm, or_none, tick_times
from calib.twin.measures import fall_time_s, swing_decay
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import stream
from calib.twin.simulate import Run, simulate

__all__ = ["Chirp", "Deflate", "Prbs", "Static", "Steps", "SwingRelease"]

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
        return simulate(rig, at_rest(rig), np.zeros((ticks, 2)), ticks, seed, feedback)

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
        return simulate(rig, start, np.zeros((ticks, 2)), ticks, seed, feedback, rig.free_plant)

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
        return simulate(rig, at_rest(rig), pwm, ticks, seed, feedback)

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
        return simulate(rig, at_rest(rig), np.stack([pwm, pwm], axis=1), ticks, seed, feedback)

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
        return simulate(rig, at_rest(rig), pwm, ticks, seed, feedback)

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
        return simulate(rig, at_rest(rig), np.clip(pwm, 0.0, 255.0), ticks, seed, feedback)

    def figures(self, run: Run) -> Figures:
        return _span(run)


def _span(run: Run) -> Figures:
    q = run.states[:, :2]
    return {"shortest_bellows_mm": float(1e3 * q.min()), "longest_bellows_mm": float(1e3 * q.max())}

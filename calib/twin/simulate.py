"""The simulated rig at work: plant, pumps, sensors and controller, tick by tick, and the log of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.io.logs import Log
from calib.stages.actuator.dynamics import Coefficients, coefficients
from calib.stages.actuator.kinematics import forward, inverse_coefficients
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import PumpCoefficients, delayed, pump_coefficients, static_force_N
from calib.stages.actuator.simulate import STATE, RigState, check_start, largest_step_s
from calib.stages.actuator.simulate import run as run_kernel
from calib.stages.control.laws import LoopState
from calib.stages.imu.mahony import Mahony, MahonyState, advance
from calib.stages.lowpass.filters import Design, design_lowpass
from calib.twin.rig import SimulatedRig, workspace_homography
from calib.twin.sensors import (
    ImuNoise,
    TrackerNoise,
    Trajectory,
    draw_imu_noise,
    draw_tracker_noise,
    head_motion,
    measure,
    onchip_angle_rad,
    track,
)

# ----------------------------------------------------------------------
# What the thesis's firmware makes of its sensors, tick by tick: the measurement that closes the loop.
#
#     IMU, 100 Hz    ->  MM filter 3/3                                                  phi      (2.3)
#     camera, 60 Hz  ->  homography without undistortion  ->  marker                           (2.11),
# (2.12)
#                    ->  head by the marker's offset and phi                                   (A.1)
#                    ->  first-order low-pass, 1 Hz at 60 Hz                            x, y
#     x, y, phi      ->  series of the inverse kinematics                               q1, q2   (3.12),
# (3.14)
#
# Time stamps are not used: the firmware counts samples. Where the camera found nothing the last marker
# is held. Latency, bias, mount angle and lens are not corrected either, so that a loop closed over
# these values errs as the real one does.

_F_SERIES = tuple(float(c) for c in inverse_coefficients())


@dataclass(frozen=True)
class Seen:
    """What a controller is given: the head's angle [rad] and the bellows' lengths [m].

    With sensors also the readings since the last tick, for a controller with an observer of its own:
    the marker [px], NaN where nothing was found, and (ax, ay, gz) of each IMU sample.
    """

    phi_rad: float
    q_m: tuple[float, float]
    marker_px: tuple[float, float] = (math.nan, math.nan)
    imu: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Firmware:
    """Constants of the firmware.

    Attributes
    ----------
    to_plane : (3, 3) pixels to metres, A^-1 of (2.11).
    bellows_radius_m, rest_length_m : of the actuator; the second until the first frame.
    marker_offset_m : d of (A.1).
    imu_rate_hz : rate that the angle filter counts on.
    mahony : filter of the angle. lowpass : (6,) section of first order.
    """

    to_plane: FloatArray
    bellows_radius_m: float
    rest_length_m: float
    marker_offset_m: float
    imu_rate_hz: float
    mahony: Mahony = field(default_factory=Mahony)
    lowpass: FloatArray = field(default_factory=lambda: design_lowpass(Design()).exact[0])


@dataclass(frozen=True)
class FirmwareState:
    """Memory of the firmware; None before the first sample of each sensor.

    Attributes
    ----------
    angle : of the MM filter.
    marker_m : last marker in the plane.
    x, y : head before the low-pass and behind it.
    """

    angle: MahonyState | None = None
    marker_m: tuple[float, float] | None = None
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None


def add_imu(
    firmware: Firmware, state: FirmwareState, ax_mps2: float, ay_mps2: float, gz_radps: float
) -> FirmwareState:
    """State after one sample of the IMU; the first one sets the angle to the accelerometer's."""
    phi_acc, before, gains = math.atan2(ay_mps2, ax_mps2), state.angle, firmware.mahony
    if before is None:
        return replace(state, angle=MahonyState(phi_acc, 0.0))
    dt_s = 1.0 / firmware.imu_rate_hz
    phi, integral = advance(
        before.phi_rad, before.integral_radps, phi_acc, -gz_radps, dt_s, gains.Kp, gains.Ki
    )
    return replace(state, angle=MahonyState(phi, integral))


def _marker(firmware: Firmware, u: float, v: float) -> tuple[float, float]:
    H = firmware.to_plane
    s = 1.0 / (H[2, 0] * u + H[2, 1] * v + H[2, 2])
    return (
        float(s * (H[0, 0] * u + H[0, 1] * v + H[0, 2])),
        float(s * (H[1, 0] * u + H[1, 1] * v + H[1, 2])),
    )


def _low_passed(firmware: Firmware, before: tuple[float, float] | None, x: float) -> tuple[float, float]:
    """Input and output of the low-pass after one sample; the first one passes as it is."""
    if before is None:
        return x, x
    b0, a1 = float(firmware.lowpass[0]), float(firmware.lowpass[4])
    return x, b0 * (x + before[0]) - a1 * before[1]


def _bellows(x: float, y: float, phi: float, bellows_radius_m: float) -> tuple[float, float]:
    """q1, q2 [m] by (3.12) with the series (3.14) in place of f."""
    w, f = phi * phi, 0.0
    for coefficient in reversed(_F_SERIES):
        f = f * w + coefficient
    length = 0.5 * math.hypot(x, y) * f
    return length + bellows_radius_m * phi, length - bellows_radius_m * phi


def add_frame(
    firmware: Firmware, state: FirmwareState, u_px: float, v_px: float
) -> tuple[FirmwareState, Seen]:
    """State after a tick's frame, NaN where the camera found nothing, and what the controller gets."""
    phi = 0.0 if state.angle is None else state.angle.phi_rad
    marker = state.marker_m if math.isnan(u_px) else _marker(firmware, u_px, v_px)
    if marker is None:
        turned = firmware.bellows_radius_m * phi
        return state, Seen(phi, (firmware.rest_length_m + turned, firmware.rest_length_m - turned))
    x = marker[0] - firmware.marker_offset_m * math.sin(phi)
    y = marker[1] - firmware.marker_offset_m * math.cos(phi)
    low_x, low_y = _low_passed(firmware, state.x, x), _low_passed(firmware, state.y, y)
    q = _bellows(low_x[1], low_y[1], phi, firmware.bellows_radius_m)
    return FirmwareState(state.angle, marker, low_x, low_y), Seen(phi, q)


# ----------------------------------------------------------------------
# The simulated rig at work: plant, pumps, sensors and controller, tick by tick, and the log of it.
#
# At tick k the controller gets what it sees at that moment, its command starts its way to the pumps,
# and the plant moves on to tick k + 1. What it sees is either the truth or what the firmware has made
# of the sensors' readings by then (`calib.twin.simulate`): the IMU samples up to the tick, and the camera's
# picture that was exposed one latency earlier. Without a controller the commands are known beforehand
# and all ticks are run at once.
#
# The log has one row per tick, with the marker and the commands given in that tick, and one per IMU
# sample in between. Its true_* columns are the state at the row's own time stamp.

FEEDBACKS = ("sensors", "truth")

LONGEST_S = 7200.0
"""Longer runs are refused before they fill the memory: two hours are 1.2 million rows."""

_SUBSTEPS = 20
_NODES_PER_TICK = 5
"""Steps of 0.83 ms; at 60 Hz nodes 1/300 s apart, so that 100 Hz samples fall on nodes."""

Pair = tuple[float, float]
Law = Callable[[int, LoopState, Seen], tuple[LoopState, Pair]]
"""A controller: tick, its memory and what it sees in; memory and PWM values out."""


@dataclass(frozen=True)
class Run:
    """A simulated experiment.

    Attributes
    ----------
    rig : the rig it was done on.
    plant : the plant, which is not the rig's where the hoses were off.
    trajectory : true states.
    pwm : (n, 2) commands given at the ticks.
    tick_s : period of the ticks.
    seen : (n, 3) angle and lengths that the controller got at each tick, None in open loop.
    tracker, pixels : noise of the frames and the reported pixels (n, 2), NaN where nothing was found.
    imu, accel_mps2, gyro_radps, onchip_rad : noise of the samples and readings (m, 3), (m, 3), (m,).
    """

    rig: SimulatedRig
    plant: Plant
    trajectory: Trajectory
    pwm: FloatArray
    tick_s: float
    seen: FloatArray | None
    tracker: TrackerNoise
    pixels: FloatArray
    imu: ImuNoise
    accel_mps2: FloatArray
    gyro_radps: FloatArray
    onchip_rad: FloatArray

    @property
    def t_s(self) -> FloatArray:
        """Times of the ticks (n,) [s]."""
        return self.tick_s * np.arange(len(self.pwm), dtype=np.float64)

    @property
    def states(self) -> FloatArray:
        """True states (n, 10) at the ticks."""
        return self.trajectory.nodes[: len(self.pwm) * _NODES_PER_TICK : _NODES_PER_TICK]

    @property
    def phi_rad(self) -> FloatArray:
        """True angle (n,) [rad] at the ticks."""
        return (self.states[:, 0] - self.states[:, 1]) / (2.0 * self.plant.bellows_radius_m)


class _Plant:
    """Compiled plant and pumps with all that stays the same from tick to tick."""

    def __init__(self, rig: SimulatedRig, plant: Plant) -> None:
        self.rig = rig
        self.tick_s = rig.pump.tick_s
        self.c: Coefficients = coefficients(plant)
        self.p: PumpCoefficients = pump_coefficients(rig.pump)
        self.strength = np.array(rig.pump_strength)
        step, largest = self.tick_s / _SUBSTEPS, largest_step_s(plant)
        if step > largest:
            raise BadInputError(
                f"actuator: a step of {step:.3g} s is too large for its stiffness and damping, which need "
                f"{largest:.3g} s or less; expected a softer or heavier actuator"
            )

    def advance(self, row: FloatArray, arriving_pwm: FloatArray, at_s: float, out: FloatArray) -> None:
        """Write the nodes (5 n, 10) of the n ticks in which the commands (n, 2) act."""
        static = static_force_N(self.rig.pump, arriving_pwm) * self.strength
        every = _SUBSTEPS // _NODES_PER_TICK
        stopped = run_kernel(self.c, self.p, row, static, self.tick_s, _SUBSTEPS, every, out)
        if stopped >= 0:
            raise BadInputError(
                f"simulation: at {at_s + (stopped + 1) * self.tick_s / _SUBSTEPS:.4g} s a bellows "
                "has no length left or the actuator turns more than a full circle; expected smaller forces "
                "or a stiffer actuator"
            )


class _Sensors:
    """Readings of one run, taken in any number of portions."""

    def __init__(self, rig: SimulatedRig, plant: _Plant, ticks: int, seed: int) -> None:
        self.rig, self.c = rig, plant.c
        times = plant.tick_s * np.arange(ticks, dtype=np.float64)
        self.tracker = draw_tracker_noise(rig.tracker, times, seed)
        self.imu = draw_imu_noise(rig.imu, ticks * plant.tick_s, seed)
        samples = len(self.imu.taken_s)
        self.pixels = np.full((ticks, 2), np.nan)
        self.accel, self.gyro = np.zeros((samples, 3)), np.zeros((samples, 3))
        self.onchip = np.zeros(samples)
        self.due: IntArray = np.searchsorted(self.imu.taken_s, times + 1e-9, side="right")

    def take_frames(self, trajectory: Trajectory, frames: slice) -> None:
        rig = self.rig
        states = trajectory.at(self.tracker.exposed_s[frames])
        self.pixels[frames] = track(rig.view, rig.tracker, self.tracker, frames, states[:, :2], self.c.r)

    def take_samples(self, trajectory: Trajectory, samples: slice) -> None:
        motion = head_motion(self.c, trajectory.at(self.imu.taken_s[samples]))
        self.accel[samples], self.gyro[samples] = measure(self.rig.imu, self.imu, samples, motion)
        if self.rig.imu.onchip:
            self.onchip[samples] = onchip_angle_rad(self.rig.imu, self.imu, samples, motion)


class _Eyes:
    """The firmware at work: from the readings up to a tick to what the controller sees."""

    def __init__(self, rig: SimulatedRig, sensors: _Sensors) -> None:
        self.firmware = Firmware(
            np.asarray(np.linalg.inv(workspace_homography(rig.view)), dtype=np.float64),
            rig.plant.bellows_radius_m,
            rig.plant.rest_length_m,
            rig.tracker.marker_offset_m,
            rig.imu.rate_hz,
        )
        self.sensors = sensors
        self.state = FirmwareState()

    def look(self, k: int, past: Trajectory) -> Seen:
        sensors = self.sensors
        samples = slice(int(sensors.due[k - 1]) if k else 0, int(sensors.due[k]))
        readings: list[tuple[float, float, float]] = []
        if samples.stop > samples.start:
            sensors.take_samples(past, samples)
            force, rate = sensors.accel[samples].tolist(), sensors.gyro[samples].tolist()
            readings = [(ax, ay, gz) for (ax, ay, _), (_, _, gz) in zip(force, rate, strict=True)]
            for ax, ay, gz in readings:
                self.state = add_imu(self.firmware, self.state, ax, ay, gz)
        sensors.take_frames(past, slice(k, k + 1))
        u, v = sensors.pixels[k].tolist()
        self.state, seen = add_frame(self.firmware, self.state, u, v)
        return replace(seen, marker_px=(u, v), imu=tuple(readings))


def _truth(row: FloatArray, bellows_radius_m: float) -> Seen:
    q1, q2 = row[:2].tolist()
    return Seen((q1 - q2) / (2.0 * bellows_radius_m), (q1, q2))


def _close_loop(
    plant: _Plant, law: Law, start: RigState, nodes: FloatArray, eyes: _Eyes | None, ticks: int
) -> tuple[FloatArray, FloatArray]:
    """Fill the nodes; returns the commands (n, 2) and what the controller saw (n, 3)."""
    per, node_s = _NODES_PER_TICK, plant.tick_s / _NODES_PER_TICK
    pwm, seen = np.empty((ticks, 2)), np.empty((ticks, 3))
    memory, waiting = LoopState(), list(start.waiting_pwm)
    for k in range(ticks):
        here = per * k
        if eyes is None:
            view = _truth(nodes[here], plant.c.r)
        else:
            view = eyes.look(k, Trajectory(node_s, nodes[: here + 1]))
        memory, command = law(k, memory, view)
        pwm[k] = command
        seen[k] = view.phi_rad, *view.q_m
        waiting.append(command)
        arriving = np.array([waiting.pop(0)])
        plant.advance(nodes[here], arriving, k * plant.tick_s, nodes[here + 1 : here + per + 1])
    return pwm, seen


def simulate(
    rig: SimulatedRig,
    start: RigState,
    drive: FloatArray | Law,
    ticks: int,
    seed: int = 0,
    feedback: str = "sensors",
    plant: Plant | None = None,
) -> Run:
    """Run the rig for some ticks.

    Parameters
    ----------
    start : state and commands on their way, as `rig_at_rest` gives it.
    drive : commands (ticks, 2), or the controller.
    seed : of everything random; the same seed gives the same run.
    feedback : "sensors" or "truth", what a controller gets.
    plant : instead of the rig's, as for a swing with the hoses off.

    Raises
    ------
    BadInputError for a start without lengths, parameters too stiff for the step, a motion that leaves
    the model, and a run of more than `LONGEST_S`.
    """
    if feedback not in FEEDBACKS:
        raise BadInputError(f"feedback: found {feedback!r}, expected one of {', '.join(FEEDBACKS)}")
    tick_s = rig.pump.tick_s
    if not 1 <= ticks <= LONGEST_S / tick_s:
        raise BadInputError(
            f"duration: found {ticks * tick_s:g} s, expected {tick_s:.3g} s (one tick) to {LONGEST_S:g} s"
        )
    check_start(start.row)
    body = rig.plant if plant is None else plant
    moving = _Plant(rig, body)
    sensors = _Sensors(rig, moving, ticks, seed)
    nodes = np.empty((ticks * _NODES_PER_TICK + 1, len(STATE)))
    nodes[0] = start.row
    whole = Trajectory(tick_s / _NODES_PER_TICK, nodes)
    seen: FloatArray | None = None
    if callable(drive):
        eyes = _Eyes(rig, sensors) if feedback == "sensors" else None
        pwm, seen = _close_loop(moving, drive, start, nodes, eyes, ticks)
    else:
        pwm = np.asarray(drive, dtype=np.float64)
        before = np.array(start.waiting_pwm, dtype=np.float64).reshape(-1, 2)
        moving.advance(start.row, delayed(rig.pump, pwm, before), 0.0, nodes[1:])
    if seen is None or feedback == "truth":
        sensors.take_frames(whole, slice(0, ticks))
        sensors.take_samples(whole, slice(0, len(sensors.imu.taken_s)))
    else:
        # The samples after the last tick, which no controller saw.
        sensors.take_samples(whole, slice(int(sensors.due[-1]), len(sensors.imu.taken_s)))
    return Run(
        rig,
        body,
        whole,
        pwm,
        tick_s,
        seen,
        sensors.tracker,
        sensors.pixels,
        sensors.imu,
        sensors.accel,
        sensors.gyro,
        sensors.onchip,
    )


def log_of(run: Run, source: str = "simulated") -> Log:
    """The log of a run: ticks and IMU samples merged by their time stamps, with the truth."""
    ticks, samples = len(run.pwm), len(run.imu.stamp_s)
    t = np.concatenate([run.tracker.stamp_s, run.imu.stamp_s])
    order = np.argsort(t, kind="stable")
    columns: dict[str, FloatArray] = {}

    def at_ticks(name: str, values: FloatArray) -> None:
        columns[name] = np.concatenate([values, np.full(samples, np.nan)])[order]

    def at_samples(name: str, values: FloatArray) -> None:
        columns[name] = np.concatenate([np.full(ticks, np.nan), values])[order]

    at_ticks("u_px", run.pixels[:, 0])
    at_ticks("v_px", run.pixels[:, 1])
    for axis, name in enumerate("xyz"):
        at_samples(f"a{name}_mps2", run.accel_mps2[:, axis])
        at_samples(f"g{name}_radps", run.gyro_radps[:, axis])
    at_ticks("pwm1", run.pwm[:, 0])
    at_ticks("pwm2", run.pwm[:, 1])
    if run.rig.imu.onchip:
        at_samples("onchip_phi_rad", run.onchip_rad)
    t = t[order]
    q = run.trajectory.at(t)[:, :2]
    pose = forward(q, run.plant.bellows_radius_m)
    columns["true_q1_m"], columns["true_q2_m"] = q[:, 0].copy(), q[:, 1].copy()
    columns["true_x_m"], columns["true_y_m"] = pose[:, 0].copy(), pose[:, 1].copy()
    columns["true_phi_rad"] = pose[:, 2].copy()
    return Log(source, t, columns, np.arange(2, len(t) + 2, dtype=np.int64))

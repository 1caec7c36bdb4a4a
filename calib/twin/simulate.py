"""The simulated rig at work: plant, pumps, sensors and controller, tick by tick, and the log of it.

At tick k the controller gets what it sees at that moment, its command starts its way to the pumps,
and the plant moves on to tick k + 1. What it sees is either the truth or what the firmware has made
of the sensors' readings by then (`calib.stages.estimator.baseline`): the IMU samples up to the tick,
and the camera's picture that was exposed one latency earlier. Latency, bias, mount angle and lens are not
corrected there, so that a loop closed over these values errs as the real one does. Without a controller
the commands are known beforehand and all ticks are run at once.

The log has one row per tick, with the marker and the commands given in that tick, and one per IMU
sample in between. Its true_* columns are the state at the row's own time stamp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.io.logs import Log
from calib.stages.actuator.dynamics import Coefficients, coefficients
from calib.stages.actuator.kinematics import angle, forward
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import delayed, pump_coefficients, settling_force_N
from calib.stages.actuator.simulate import STATE, RigState, check_start, largest_step_s
from calib.stages.actuator.simulate import run as run_kernel
from calib.stages.estimator.baseline import Baseline, BaselineSetup, undistorting_nothing
from calib.stages.estimator.kinematic import Rows
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import (
    Trajectory,
    draw_imu_noise,
    draw_tracker_noise,
    head_motion,
    measure,
    onchip_angle_rad,
    track,
)


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


FEEDBACKS = ("sensors", "truth")

LONGEST_S = 7200.0
"""Longer runs are refused before they fill the memory: two hours are 1.2 million rows."""

_SUBSTEPS = 20
_NODES_PER_TICK = 5
"""Steps of 0.83 ms; at 60 Hz nodes 1/300 s apart, so that 100 Hz samples fall on nodes."""

Pair = tuple[float, float]
Law = Callable[[int, Seen], Pair]
"""A controller, called at one tick after the other: tick and what it sees in, PWM values out."""


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
    sensors : what camera and IMU have read.
    """

    rig: SimulatedRig
    plant: Plant
    trajectory: Trajectory
    pwm: FloatArray
    tick_s: float
    seen: FloatArray | None
    sensors: Sensors

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
        return angle(self.states[:, :2], self.plant.bellows_radius_m)


class _Plant:
    """Compiled plant and pumps with all that stays the same from tick to tick."""

    def __init__(self, rig: SimulatedRig, plant: Plant) -> None:
        self.rig = rig
        self.tick_s = rig.pump.tick_s
        self.c: Coefficients = coefficients(plant)
        self.p = pump_coefficients(rig.pump)
        self.held = np.zeros((2, 2))
        step, largest = self.tick_s / _SUBSTEPS, largest_step_s(plant)
        if step > largest:
            raise BadInputError(
                f"actuator: a step of {step:.3g} s is too large for its stiffness and damping, which need "
                f"{largest:.3g} s or less; expected a softer or heavier actuator"
            )

    def advance(self, row: FloatArray, arriving_pwm: FloatArray, at_s: float, out: FloatArray) -> None:
        """Write the nodes (5 n, 10) of the n ticks in which the commands (n, 2) act."""
        static = settling_force_N(self.rig.pump, arriving_pwm, self.rig.strength, self.held)
        every = _SUBSTEPS // _NODES_PER_TICK
        stopped = run_kernel(self.c, self.p, row, static, self.tick_s, _SUBSTEPS, every, out)
        if stopped >= 0:
            raise BadInputError(
                f"simulation: at {at_s + (stopped + 1) * self.tick_s / _SUBSTEPS:.4g} s a bellows "
                "has no length left or the actuator turns more than a full circle; expected smaller forces "
                "or a stiffer actuator"
            )


class Sensors:
    """Readings of one run, taken in any number of portions.

    Attributes
    ----------
    tracker, pixels : noise of the frames and the reported pixels (n, 2), NaN where nothing was found.
    imu, accel_mps2, gyro_radps, onchip_rad : noise of the samples and readings (m, 3), (m, 3), (m,).
    """

    def __init__(self, rig: SimulatedRig, plant: _Plant, ticks: int, seed: int) -> None:
        self.rig, self.c = rig, plant.c
        times = plant.tick_s * np.arange(ticks, dtype=np.float64)
        self.tracker = draw_tracker_noise(rig.tracker, times, seed)
        self.imu = draw_imu_noise(rig.imu, ticks * plant.tick_s, seed)
        samples = len(self.imu.taken_s)
        self.pixels = np.full((ticks, 2), np.nan)
        self.accel_mps2, self.gyro_radps = np.zeros((samples, 3)), np.zeros((samples, 3))
        self.onchip_rad = np.zeros(samples)
        self.due: IntArray = np.searchsorted(self.imu.taken_s, times + 1e-9, side="right")

    def take_frames(self, trajectory: Trajectory, frames: slice) -> None:
        rig = self.rig
        states = trajectory.at(self.tracker.exposed_s[frames])
        self.pixels[frames] = track(rig.view, rig.tracker, self.tracker, frames, states[:, :2], self.c.r)

    def take_samples(self, trajectory: Trajectory, samples: slice) -> None:
        motion = head_motion(self.c, trajectory.at(self.imu.taken_s[samples]))
        readings = measure(self.rig.imu, self.imu, samples, motion)
        self.accel_mps2[samples], self.gyro_radps[samples] = readings
        if self.rig.imu.onchip:
            self.onchip_rad[samples] = onchip_angle_rad(self.rig.imu, self.imu, samples, motion)


WORKSPACE_M = (-0.06, 0.05, 0.06, 0.11)
"""Where the board of a rig without a lens model was laid for its plane."""


class _Eyes:
    """The firmware at work: from the readings up to a tick to what the controller sees."""

    def __init__(self, rig: SimulatedRig, sensors: Sensors) -> None:
        view = rig.view
        to_plane = undistorting_nothing(view.camera, view.R_CW, view.t_CW_m, WORKSPACE_M)
        plant, offset_m = rig.plant, rig.tracker.marker_offset_m
        self.firmware = Baseline(
            BaselineSetup(to_plane, plant.bellows_radius_m, plant.rest_length_m, offset_m, rig.imu.rate_hz)
        )
        self.sensors = sensors

    def look(self, k: int, past: Trajectory) -> Seen:
        sensors = self.sensors
        samples = slice(int(sensors.due[k - 1]) if k else 0, int(sensors.due[k]))
        count = samples.stop - samples.start
        if count:
            sensors.take_samples(past, samples)
        sensors.take_frames(past, slice(k, k + 1))
        # The samples since the last tick, then its picture.
        readings = np.full((count + 1, 5), np.nan)
        readings[:-1, 2:4], readings[:-1, 4] = sensors.accel_mps2[samples, :2], sensors.gyro_radps[samples, 2]
        readings[-1, :2] = sensors.pixels[k]
        kinds = np.full(count + 1, 2)
        kinds[-1] = 1
        _, q1, q2, phi, *_ = self.firmware.run(Rows(np.zeros(count + 1), readings, kinds))[-1].tolist()
        u, v = sensors.pixels[k].tolist()
        imu = tuple((ax, ay, gz) for ax, ay, gz in readings[:-1, 2:].tolist())
        return Seen(phi, (q1, q2), (u, v), imu)


def _close_loop(
    plant: _Plant, law: Law, start: RigState, nodes: FloatArray, eyes: _Eyes | None, ticks: int
) -> tuple[FloatArray, FloatArray]:
    """Fill the nodes; returns the commands (n, 2) and what the controller saw (n, 3)."""
    per, node_s = _NODES_PER_TICK, plant.tick_s / _NODES_PER_TICK
    pwm, seen = np.empty((ticks, 2)), np.empty((ticks, 3))
    waiting = list(start.waiting_pwm)
    for k in range(ticks):
        here = per * k
        if eyes is None:
            q1, q2 = nodes[here, :2].tolist()
            view = Seen(float(angle(nodes[here, :2], plant.c.r)), (q1, q2))
        else:
            view = eyes.look(k, Trajectory(node_s, nodes[: here + 1]))
        pwm[k] = command = law(k, view)
        seen[k] = view.phi_rad, *view.q_m
        waiting.append(command)
        arriving = np.array([waiting.pop(0)])
        plant.advance(nodes[here], arriving, k * plant.tick_s, nodes[here + 1 : here + per + 1])
    return pwm, seen


def count_ticks(duration_s: float, tick_s: float) -> int:
    """Ticks of a run. Raises `BadInputError` for none, and for a run of more than `LONGEST_S`."""
    if not 0.5 * tick_s < duration_s < LONGEST_S + 0.5 * tick_s:
        raise BadInputError(
            f"duration: found {duration_s:g} s, expected {tick_s:.3g} s (one tick) to {LONGEST_S:g} s"
        )
    return round(duration_s / tick_s)


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
    BadInputError as `count_ticks`, and for a start without lengths, parameters too stiff for the step, and a
    motion that leaves the model.
    """
    if feedback not in FEEDBACKS:
        raise BadInputError(f"feedback: found {feedback!r}, expected one of {', '.join(FEEDBACKS)}")
    tick_s = rig.pump.tick_s
    count_ticks(ticks * tick_s, tick_s)
    check_start(start.row)
    body = rig.plant if plant is None else plant
    moving = _Plant(rig, body)
    sensors = Sensors(rig, moving, ticks, seed)
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
    return Run(rig, body, whole, pwm, tick_s, seen, sensors)


def run_log(run: Run, source: str = "simulated") -> Log:
    """The log of a run: ticks and IMU samples merged by their time stamps, with the truth."""
    sensors = run.sensors
    ticks, samples = len(run.pwm), len(sensors.imu.stamp_s)
    t = np.concatenate([sensors.tracker.stamp_s, sensors.imu.stamp_s])
    order = np.argsort(t, kind="stable")
    columns: dict[str, FloatArray] = {}

    def at_ticks(name: str, values: FloatArray) -> None:
        columns[name] = np.concatenate([values, np.full(samples, np.nan)])[order]

    def at_samples(name: str, values: FloatArray) -> None:
        columns[name] = np.concatenate([np.full(ticks, np.nan), values])[order]

    at_ticks("u_px", sensors.pixels[:, 0])
    at_ticks("v_px", sensors.pixels[:, 1])
    for axis, name in enumerate("xyz"):
        at_samples(f"a{name}_mps2", sensors.accel_mps2[:, axis])
        at_samples(f"g{name}_radps", sensors.gyro_radps[:, axis])
    at_ticks("pwm1", run.pwm[:, 0])
    at_ticks("pwm2", run.pwm[:, 1])
    if run.rig.imu.onchip:
        at_samples("onchip_phi_rad", sensors.onchip_rad)
    t = t[order]
    q = run.trajectory.at(t)[:, :2]
    pose = forward(q, run.plant.bellows_radius_m)
    columns["true_q1_m"], columns["true_q2_m"] = q[:, 0].copy(), q[:, 1].copy()
    columns["true_x_m"], columns["true_y_m"] = pose[:, 0].copy(), pose[:, 1].copy()
    columns["true_phi_rad"] = pose[:, 2].copy()
    return Log(source, t, columns, np.arange(2, len(t) + 2, dtype=np.int64))

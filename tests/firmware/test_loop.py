"""Processor in the loop: the AVR's program closes the loop around the simulated rig, as float64 does.

Sensors, plant and pumps are the twin's; at each tick the newest sample and the marker go into the simulated
ATmega328P, and its commands into the pumps. With commands that are not rounded to whole numbers the loop is
continuous but for the camera's whole pixels, so the two runs stay together to what rounding makes of a
command, 0.01 PWM, times what the pumps make of it: 26.6 mm at 255 PWM, 1e-6 m, and 1e-6 / r_B = 1e-4 rad.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest
from firmware_build import Process, avr, host, write
from firmware_rigs import header

from calib.actuator.integrate import rig_at_rest
from calib.control.setpoints import Ellipse
from calib.firmware.conformance import MODE_ORIENTATION, MODE_POSITION, Inputs, Reference
from calib.firmware.literals import values
from calib.firmware.vectors import binary32
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import Trajectory
from calib.twin.simulate import _NODES_PER_TICK, _Plant, _Sensors


class _Python:
    """The reference, asked in the same way as a program."""

    def __init__(self) -> None:
        self.reference = Reference(values(header().literals))

    def send(self, given: Inputs) -> None:
        self.pwm = self.reference.step(given).pwm

    def receive(self) -> tuple[float, float]:
        return self.pwm


class _Program:
    """A program's commands."""

    def __init__(self, command: list[str]) -> None:
        self.process = Process(command)
        self.send = self.process.send

    def receive(self) -> tuple[float, float]:
        pwm = self.process.receive().numbers[0, 7:]
        return float(pwm[0]), float(pwm[1])


def _run(processor: _Python | _Program, wanted: np.ndarray, mode: int) -> np.ndarray:
    """Lengths (n, 2) at the ticks of a loop that the processor closes.

    A command takes two ticks to the pumps, so the plant can move on while the processor computes.
    """
    rig = SimulatedRig()
    ticks = len(wanted)
    plant = _Plant(rig, rig.plant)
    sensors = _Sensors(rig, plant, ticks, 5)
    start = rig_at_rest(rig.plant, rig.pump)
    nodes = np.empty((ticks * _NODES_PER_TICK + 1, start.row.size))
    nodes[0] = start.row
    waiting = list(start.waiting_pwm)
    imu = (9.81, 0.0, 0.0)
    for k in range(ticks):
        here = _NODES_PER_TICK * k
        past = Trajectory(plant.tick_s / _NODES_PER_TICK, nodes[: here + 1])
        due = slice(int(sensors.due[k - 1]) if k else 0, int(sensors.due[k]))
        if due.stop > due.start:
            sensors.take_samples(past, due)
            (ax, ay, _), gz = sensors.accel[due.stop - 1].tolist(), float(sensors.gyro[due.stop - 1, 2])
            imu = (ax, ay, gz)
        sensors.take_frames(past, slice(k, k + 1))
        u, v = sensors.pixels[k].tolist()
        pair = (float(wanted[k, 0]), float(wanted[k, 1]))
        processor.send(binary32(Inputs(u, v, *imu, pair, not math.isnan(u), True, mode)))
        plant.advance(
            nodes[here], np.array([waiting.pop(0)]), 0.0, nodes[here + 1 : here + _NODES_PER_TICK + 1]
        )
        waiting.append(processor.receive())
    return nodes[::_NODES_PER_TICK, :2]


def _experiment(name: str) -> tuple[np.ndarray, int]:
    times = np.arange(0.0, 20.0 if name == "ellipse" else 5.0, 1.0 / 60.0)
    if name == "ellipse":
        return Ellipse().bellows_m(times, SimulatedRig().plant.bellows_radius_m), MODE_POSITION
    return np.full((len(times), 2), 0.7), MODE_ORIENTATION


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ellipse", "step"])
@pytest.mark.parametrize("where", ["host", "avr"])
def test_the_loop_closed_by_the_processor_is_that_of_float64(tmp_path: Path, name: str, where: str) -> None:
    made = header()
    write(tmp_path, made)
    command = avr(tmp_path)[0] if where == "avr" else host(tmp_path)
    wanted, mode = _experiment(name)
    expected = _run(_Python(), wanted, mode)
    program = _Program(command)
    began = time.perf_counter()
    found = _run(program, wanted, mode)
    speed = len(wanted) / 60.0 / (time.perf_counter() - began)
    program.process.close()
    difference = np.abs(found - expected).max()
    print(f"{name} on {where}: lengths differ by {difference:.2g} m at most, {speed:.0f} times real time")
    assert difference < 1e-6
    # The loop did something.
    assert np.ptp(expected[:, 0]) > 0.005

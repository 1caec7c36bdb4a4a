"""Processor in the loop: the AVR's program closes the loop around the simulated rig, as float64 does.

Sensors, plant and pumps are the twin's, compiled (`firmware_plant.py`); at each tick the newest sample and
the marker go into the simulated ATmega328P, and its commands into the pumps. With commands that are not
rounded to whole numbers the loop is continuous but for the camera's whole pixels and, with the fused
estimator, its telling rest from motion, so the two runs stay together to what rounding makes of a command,
0.01 PWM, times what the pumps make of it: 26.6 mm at 255 PWM, 1e-6 m, and 1e-6 / r_B = 1e-4 rad. Times are in
`tests/bench/firmware_loop.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from firmware_build import Process, Simulated, avr, host, write
from firmware_plant import Loop
from firmware_rigs import header

from calib.stages.control.references import Ellipse
from calib.stages.firmware.conformance import MODE_ORIENTATION, MODE_POSITION, Inputs, binary32, reference_of
from calib.stages.firmware.literals import values
from calib.twin.rig import SimulatedRig


class _Processor(Protocol):
    def tick(self, numbers: np.ndarray, seen: bool, mode: int) -> np.ndarray: ...


class _Python:
    """The reference, asked in the same way as a program."""

    def __init__(self, kind: str, fused: bool) -> None:
        self.reference = reference_of(values(header(kind).literals), fused=fused)

    def tick(self, numbers: np.ndarray, seen: bool, mode: int) -> np.ndarray:
        u, v, ax, ay, gz, first, second = numbers.tolist()
        given = Inputs(u, v, ax, ay, gz, (first, second), seen, True, mode)
        return np.array(self.reference.step(binary32(given)).pwm)


class _Host:
    """A program on this machine, through its pipes."""

    def __init__(self, command: list[str]) -> None:
        self.process = Process(command)

    def tick(self, numbers: np.ndarray, seen: bool, mode: int) -> np.ndarray:
        u, v, ax, ay, gz, first, second = numbers.tolist()
        self.process.send(Inputs(u, v, ax, ay, gz, (first, second), seen, True, mode))
        return self.process.receive().numbers[0, 7:]


class Avr:
    """The AVR in a simulator within this process."""

    def __init__(self, command: list[str]) -> None:
        self.program = Simulated(command)
        self._floats = self.program.record[:28].view("<f4")
        self._pwm = self.program.result[28:36].view("<f4")

    def tick(self, numbers: np.ndarray, seen: bool, mode: int) -> np.ndarray:
        """Commands (2,) for the readings and reference (7,)."""
        self._floats[:] = numbers
        self.program.record[28:] = seen, 1, mode
        self.program.tick()
        return self._pwm.astype(np.float64)


def closed(processor: _Processor, wanted: np.ndarray, mode: int) -> np.ndarray:
    """Lengths (n + 1, 2) at the ticks of a loop that the processor closes; `wanted` (n, 2)."""
    loop = Loop(SimulatedRig(), len(wanted))
    for k, pair in enumerate(wanted):
        seen = loop.look(k)
        loop.record[5:] = pair
        loop.move(k, processor.tick(loop.record, seen, mode))
    return loop.lengths()


def experiment(name: str) -> tuple[np.ndarray, int]:
    """References (n, 2) at the ticks, and the controller's mode."""
    times = np.arange(0.0, 20.0 if name == "ellipse" else 5.0, 1.0 / 60.0)
    if name == "ellipse":
        return Ellipse().bellows_m(times, SimulatedRig().plant.bellows_radius_m), MODE_POSITION
    return np.full((len(times), 2), 0.7), MODE_ORIENTATION


@pytest.mark.parametrize("name", ["ellipse", "step"])
@pytest.mark.parametrize(
    ("where", "kind", "fused"),
    [("host", "nominal", False), ("avr", "nominal", False), ("avr", "twin", True)],
)
def test_the_loop_closed_by_the_processor_is_that_of_float64(
    tmp_path: Path, name: str, where: str, kind: str, fused: bool
) -> None:
    write(tmp_path, header(kind))
    switch = ["-DCALIB_FUSED=1"] if fused else []
    wanted, mode = experiment(name)
    expected = closed(_Python(kind, fused), wanted, mode)
    program = Avr(avr(tmp_path, *switch)[0]) if where == "avr" else _Host(host(tmp_path, *switch))
    found = closed(program, wanted, mode)
    if isinstance(program, _Host):
        program.process.close()
    difference = np.abs(found - expected).max()
    print(f"{name} on {where}, {'fused' if fused else 'MM'}: lengths differ by {difference:.2g} m at most")
    assert difference < 1e-6
    # The loop did something.
    assert np.ptp(expected[:, 0]) > 0.005

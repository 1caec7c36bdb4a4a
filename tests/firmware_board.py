"""A simulated board with the sketch, and around it the simulated rig with all errors of its sensors.

The processor is simavr's, plant and sensors are the twin's. A `Board` is a serial port as
`calib.io.experiments.Port` wants one, whose clock is the simulation's.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pty
import shutil
import time
import tty
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path

import numpy as np
from firmware_build import Built
from scipy.signal import butter, sosfilt_zi

from calib.stages.actuator.pump import settling_force_N
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.actuator.simulate import run as run_kernel
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import (
    _read,
    draw_imu_noise,
    draw_tracker_noise,
    head_motion,
    measure,
    track,
)
from calib.twin.simulate import _Plant

__all__ = ["Board", "serve"]

_NUMBERS = count()
_STEP_S = 1.0 / 1200.0
_FELT_HZ = 400.0
_ACCEL_HZ = {code: (7.8125 * 2**code, 15.625 * 2**code) for code in range(8)}
_GYRO_HZ = {0: (523, 2000), 1: (230, 2000), 2: (116, 1000), 3: (47, 400),
            4: (23, 200), 5: (12, 100), 6: (64, 200), 7: (32, 100)}  # fmt: skip
"""Bandwidths by their codes as in the BNO055's data sheet, 3.5.2, with the rates of the BMI055 inside it."""
_PULLED_RAD = 0.45


class _Sensor:
    """One sensor of the BNO055: a low-pass of order two, and registers that change at a rate of its own.

    Parameters
    ----------
    table : bandwidth and rate [Hz] by the code in its configuration. clock : its oscillator by the board's.
    """

    def __init__(self, table: Mapping[int, tuple[float, float]], clock: float) -> None:
        self._table, self._clock = table, clock
        self._code = -1
        self._count = -1
        self.value = np.zeros(3)

    def feel(self, code: int, felt: np.ndarray) -> None:
        """Take readings (1, 3) `_FELT_HZ` times a second."""
        if code != self._code:
            self._code = code
            bandwidth, self._rate_hz = self._table[code]
            (self._form,) = butter(2, min(bandwidth, 0.45 * _FELT_HZ), fs=_FELT_HZ, output="sos").tolist()
            self._memory = list(sosfilt_zi([self._form])[0][:, None] * felt)
        # For one sample a tenth of what scipy's sosfilt takes.
        b0, b1, b2, _, a1, a2 = self._form
        (x,), (first, second) = felt, self._memory
        self.value = y = b0 * x + first
        self._memory = [b1 * x - a1 * y + second, b2 * x - a2 * y]

    def due(self, time_s: float) -> bool:
        """Whether the registers take the value now."""
        count = int(time_s * self._rate_hz * self._clock)
        new, self._count = count != self._count, count
        return new


class Board:
    """The board and the rig, from the supply's coming on.

    Attributes
    ----------
    duty : what drives the pumps. time_s : since the start. states : (n, 10) of the plant at the pictures.

    The camera has `frame_hz` pictures a second by its own oscillator.
    """

    def __init__(self, built: Built, seconds: float = 200.0, seed: int = 1, frame_hz: float = 60.7) -> None:
        # A library of its own, since the simulator lives in its variables.
        library = Path(built.program).with_suffix(f".{next(_NUMBERS)}.so")
        shutil.copy(built.library, library)
        self._rig = ctypes.CDLL(str(library))
        self._rig.rig_pass.argtypes = [ctypes.c_double]
        assert self._rig.rig_open(built.program.encode()) == 0
        self.rig = SimulatedRig()
        self.plants = (_Plant(self.rig, self.rig.plant), _Plant(self.rig, self.rig.free_plant))
        self.hoses_off = self.held = False
        self.row = rig_at_rest(self.rig.plant, self.rig.pump).row.copy()
        delay = round(self.rig.pump.delay_ticks * self.rig.pump.tick_s / _STEP_S)
        self._waiting = deque([(0, 0)] * delay)
        self._settling = cache(self._settling_N)
        self._past = deque([self.row[:2].copy()], maxlen=round(self.rig.tracker.latency_s / _STEP_S) + 1)
        self._imu = draw_imu_noise(replace(self.rig.imu, rate_hz=_FELT_HZ), seconds, seed)
        # Its oscillator is as good as such are.
        clock = 1.0 + 0.01 * (seed % 5 - 2)
        self._chip = _Sensor(_ACCEL_HZ, clock), _Sensor(_GYRO_HZ, clock)
        self._frame_s = 1.0 / frame_hz
        frames = np.arange(int(seconds * frame_hz)) * self._frame_s
        self._tracker = draw_tracker_noise(self.rig.tracker, frames, seed)
        self._shown = np.zeros(10, dtype=np.int32)
        self._taken = np.zeros(1 << 16, dtype=np.uint8)
        self._out = np.empty((1, 10))
        self._steps = 0
        self._release_s = np.inf
        self.time_s = 0.0
        self.duty = (0, 0)
        self.states: list[np.ndarray] = []
        self.cut = False
        self._sense(0)
        self._show_imu()
        self._show_picture(0)

    def _sense(self, k: int) -> None:
        """What both sensors of the BNO055 feel, through the low-pass of each."""
        plant = self.plants[self.hoses_off]
        motion = head_motion(plant.c, self.row[None])
        if self.held:
            motion = replace(motion, ddphi_radps2=np.zeros(1), acceleration_mps2=np.zeros((1, 2)))
        exact = replace(self.rig.imu, accel_step_mps2=0.0, gyro_step_radps=0.0)
        both = int(self._rig.rig_bandwidths())
        codes = (both >> 2 & 7, both >> 11 & 7)
        for one, code, felt in zip(
            self._chip, codes, measure(exact, self._imu, slice(k, k + 1), motion), strict=True
        ):
            one.feel(code, felt)

    def _show_imu(self) -> None:
        """New values in the registers, where it is time."""
        imu, (force, rate) = self.rig.imu, self._chip
        if force.due(self.time_s):
            self._shown[:3] = np.rint(
                100.0 * _read(force.value, (0.0,) * 3, 0.0, imu.accel_step_mps2, imu.accel_range_mps2)
            )
        if rate.due(self.time_s):
            self._shown[3:6] = np.rint(
                900.0 * _read(rate.value, (0.0,) * 3, 0.0, imu.gyro_step_radps, imu.gyro_range_radps)
            )

    def _show_picture(self, k: int) -> None:
        q = self._past[0][None]
        u, v = track(self.rig.view, self.rig.tracker, self._tracker, slice(k, k + 1), q, self.plants[0].c.r)[
            0
        ]
        self._shown[6] = not np.isnan(u)
        self._shown[7:9] = (0, 0) if np.isnan(u) else (u, v)
        self._shown[9] = k + 1
        self.states.append(self.row.copy())

    def _settling_N(self, duty: tuple[int, int], hoses_off: bool) -> np.ndarray:
        """Where the forces (1, 2) [N] of a command settle."""
        held = self.plants[hoses_off].held
        return settling_force_N(self.rig.pump, np.array([duty], dtype=float), self.rig.strength, held)

    def _step(self) -> None:
        """The processor and the rig, a step further."""
        both = self._rig.rig_pass(1e6 * _STEP_S)
        assert both >= 0
        self.duty = (both & 255, both >> 8)
        self._waiting.append(self.duty)
        arriving = self._waiting.popleft()
        if self.hoses_off:
            arriving = (0, 0)
        if self.held and self.time_s >= self._release_s:
            self.held = False
        if not self.held:
            plant = self.plants[self.hoses_off]
            static = self._settling(arriving, self.hoses_off)
            assert run_kernel(plant.c, plant.p, self.row, static, _STEP_S, 1, 1, self._out) < 0
            self.row = self._out[0].copy()
        self._past.append(self.row[:2].copy())
        self._steps += 1
        before, self.time_s = self.time_s, self._steps * _STEP_S
        for period, show in ((1.0 / _FELT_HZ, self._sense), (self._frame_s, self._show_picture)):
            k = int(self.time_s / period + 1e-9)
            if k != int(before / period + 1e-9):
                show(k)
        self._show_imu()
        self._rig.rig_show(ctypes.c_void_p(self._shown.ctypes.data))

    def hear(self, words: str) -> None:
        """What a person does who is told something."""
        if "hoses" in words:
            self.hoses_off = "hoses off" in words
            self.row = rig_at_rest(self.plants[self.hoses_off].rig.plant, self.rig.pump).row.copy()
        if words.startswith("pull"):
            self.row = rig_at_rest(self.rig.free_plant, self.rig.pump, _PULLED_RAD).row.copy()
            self.held, self._release_s = True, np.inf
        if words == "let go":
            self._release_s = self.time_s + 0.7

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.time_s + seconds - 1e-9
        while self.time_s < end:
            self._step()

    def read(self) -> bytes:
        """What came in the next few milliseconds."""
        self.run(6.0 * _STEP_S)
        return self.everything()

    def everything(self) -> bytes:
        """All that came and was not read."""
        count = self._rig.rig_take(ctypes.c_void_p(self._taken.ctypes.data))
        return self._taken[:count].tobytes()

    def write(self, data: bytes) -> None:
        """Bytes for the board, unless the computer is cut off."""
        if not self.cut:
            self._rig.rig_give(data, len(data))

    def reset(self) -> None:
        """Press the board's button."""
        self._rig.rig_reset()

    def now_s(self) -> float:
        """The simulation's time."""
        return self.time_s


def serve(board: Board, until: Callable[[], bool], name: Callable[[str], None]) -> None:
    """Put the board behind a terminal of this machine, in its time or slower, until told to stop.

    Parameters
    ----------
    name : takes the terminal's name, once it is there.
    """
    ours, theirs = pty.openpty()
    for end in (ours, theirs):
        tty.setraw(end)
    os.set_blocking(ours, False)
    name(os.ttyname(theirs))
    began = time.monotonic() - board.time_s
    try:
        while not until():
            with contextlib.suppress(BlockingIOError, OSError):
                board.write(os.read(ours, 4096))
            data = board.read()
            with contextlib.suppress(BlockingIOError):
                os.write(ours, data)
            time.sleep(max(0.0, board.time_s - (time.monotonic() - began)))
    finally:
        os.close(ours)
        os.close(theirs)

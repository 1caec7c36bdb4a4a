"""Compiling the estimator's functions at their first use, half of them in a process of its own.

Numba holds a lock while it compiles, so threads gain nothing. What another process has compiled is found in
numba's cache on disk. Where there is none, or no second processor, everything is compiled here.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from calib.compilation import on_compiling
from calib.estimator.driven_setup import Drive
from calib.estimator.filter import Filter
from calib.estimator.kernel import NOISE
from calib.estimator.sensors import SENSOR
from calib.estimator.setup import Rows, Setup, Start
from calib.estimator.smoother import smooth

__all__ = ["driven_elsewhere", "serve", "warm"]

_LONGEST_S = 600.0
_COMMAND = "import sys; sys.path[:] = {path!r}; from calib.warming import serve; serve({smoothed})"


def _few() -> Rows:
    """Three samples of an IMU at rest, enough for every function to be called."""
    readings = np.full((3, 5), np.nan)
    readings[:, 2:] = 9.81, 0.0, 0.0
    return Rows(np.array([0.0, 0.01, 0.02]), readings, np.full(3, 2))


def _nominal() -> Setup:
    """Any set-up: what is compiled depends on the types alone."""
    start = Start(np.zeros(len(SENSOR)), np.ones(len(SENSOR)))
    return Setup(np.ones(24), np.ones(len(NOISE)), start, 0.02)


def warm(setup: Setup, smoothed: bool = False) -> None:
    """Have the kinematic filter's functions, and with `smoothed` its smoother's, before the first row."""
    rows = _few()
    out = Filter(setup).run(rows)
    if smoothed:
        smooth(setup, rows, out)


@contextmanager
def driven_elsewhere(wanted: bool, smoothed: bool = False) -> Iterator[None]:
    """Compile the driven model's functions in another process when anything is compiled in this block.

    It has ended when the block ends. Where all is in numba's cache nothing is started.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command = _COMMAND.format(path=sys.path, smoothed=smoothed)
        with contextlib.suppress(OSError):
            started.append(
                subprocess.Popen(
                    [sys.executable, "-c", command],
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                )
            )  # fmt: skip

    try:
        with on_compiling(start) if wanted else contextlib.nullcontext():
            yield
        for other in started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                other.wait(_LONGEST_S)
    finally:
        for other in started:
            other.kill()
            other.wait()


def serve(smoothed: bool) -> None:
    """Compile what the driven model needs, in a process of its own."""
    from calib.estimator.driven_filter import DrivenFilter
    from calib.estimator.driven_smoother import smooth_driven

    rows, pwm, setup, drive = _few(), np.full((3, 2), np.nan), _nominal(), Drive()
    out = DrivenFilter(setup, drive).run(rows, pwm)
    if smoothed:
        smooth_driven(setup, drive, rows, pwm, out)

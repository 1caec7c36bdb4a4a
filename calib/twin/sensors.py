"""What sensors on the simulated head could sense: its true motion at any time, and when it is logged.

The plant is simulated on a regular grid of nodes. Between them the bellows' lengths follow the cubic
that takes lengths and rates over from both nodes, and their rates its derivative (1.1e-8 m and 1.0e-5 m/s
from the truth in a swing with nodes 1/300 s apart). Creep and forces change slowly and are
interpolated linearly. Accelerations come from the equations of motion in the interpolated state.

`calib.twin.camera_sensor` and `calib.twin.imu_sensor` make measurements of it. Every random number of a
log is drawn before the simulation from streams of its own, so that closing the loop over the sensors
or not does not change the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.actuator.dynamics import Coefficients
from calib.actuator.kernel import derivative
from calib.arrays import FloatArray
from calib.twin.background import gaussian_noise, uniform
from calib.twin.kernel import head_rows, states_between

__all__ = ["HeadMotion", "Trajectory", "head_motion", "normal", "stamps", "stream"]


def stream(seed: int, *purpose: int) -> np.random.PCG64:
    """Random bits for one purpose; other purposes and seeds have streams of their own."""
    # Not a tuple as the seed: zeros at its end count for nothing.
    return np.random.PCG64(np.random.SeedSequence(seed, spawn_key=purpose))


def normal(bits: np.random.PCG64, rows: int, columns: int = 1) -> FloatArray:
    """Normal numbers (rows, columns) of mean 0 and deviation 1, the same on every machine."""
    return gaussian_noise(bits, (rows, columns))


@dataclass(frozen=True)
class Trajectory:
    """States on a regular grid.

    Attributes
    ----------
    node_s : distance of the nodes [s]; the first is at 0.
    nodes : (n, 10) rows of `kernel.STATE`.
    """

    node_s: float
    nodes: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """States (m, 10) at the times (m,) [s], those before the first and after the last node held."""
        return states_between(self.node_s, self.nodes, t_s)


@dataclass(frozen=True)
class HeadMotion:
    """Motion of the head in the world frame.

    Attributes
    ----------
    phi_rad, dphi_radps, ddphi_radps2 : (m,) angle and its derivatives.
    position_m, acceleration_mps2 : (m, 2).
    """

    phi_rad: FloatArray
    dphi_radps: FloatArray
    ddphi_radps2: FloatArray
    position_m: FloatArray
    acceleration_mps2: FloatArray


def head_motion(c: Coefficients, states: FloatArray) -> HeadMotion:
    """Motion of the head (m) in the states (m, 10), accelerations by the equations of motion."""
    ddq = np.empty((len(states), 2))
    for i, row in enumerate(states):
        ddq[i] = derivative(c, row[:6], row[8], row[9])[2:4]
    rows = head_rows(c.r, states, ddq)
    return HeadMotion(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:5], rows[:, 5:7])


def stamps(
    t_s: FloatArray, jitter_s: float, duplicated: float, bits: np.random.PCG64, late: FloatArray | None = None
) -> FloatArray:
    """Time stamps (n,) that a logger gives to samples taken at the times (n,) [s].

    Jitter is normal. A sample that waits in a buffer gets the stamp of the one before it, with the
    probability `duplicated`. Stamps never run backwards and are whole microseconds.

    Parameters
    ----------
    late : (n,) further delay of each sample [s].
    """
    noisy = t_s + jitter_s * normal(bits, len(t_s))[:, 0]
    if late is not None:
        noisy = noisy + late
    noisy = np.maximum.accumulate(np.maximum(np.rint(noisy * 1e6) * 1e-6, 0.0)) if len(noisy) else noisy
    twice = uniform(bits, len(t_s)) < duplicated
    if len(twice):
        twice[0] = False
    source = np.maximum.accumulate(np.where(twice, 0, np.arange(len(t_s))))
    return np.asarray(noisy[source])

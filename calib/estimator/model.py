"""The kinematic process: how the head moves when nothing is known of what drives it.

Angle and length each follow

    dp = v dt + dw_p,   dv = (a - v / T_v) dt,   da = -a / T_a dt + dw_a

with white noise w_p, w_a: an acceleration that forgets after T_a and a rate that dies after T_v
(Singer 1970 with friction). One level of noise cannot serve rest and swing, so a bank of levels runs side
by side as an interacting multiple model (Blom and Bar-Shalom 1988): before each event a level i starts
from the mixture of all levels j with the weights of j having turned into i. The sensors' quantities
are constant but for a slow random walk.

A step of more than `LARGEST_STEP_S` is taken in parts, so that the series for the transition,
I + A h + A^2 h^2 / 2 + A^3 h^3 / 6, and that for its noise hold.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.compiled import compiled

__all__ = [
    "LARGEST_STEP_S",
    "LEVELS",
    "Kinematic",
    "Level",
    "axis_noise",
    "axis_transition",
]

LARGEST_STEP_S = 0.02


@dataclass(frozen=True)
class Level:
    """Process noise of one level, for phi [rad] and for the length [m].

    Attributes
    ----------
    name : for what it is made.
    accel_phi_radps2, accel_length_mps2 : standard deviation of the acceleration.
    memory_s : T_a of both. friction_s : T_v of the length; that of phi is infinite.
    walk_phi, walk_length : density of w_p [rad/sqrt(s), m/sqrt(s)].
    """

    name: str
    accel_phi_radps2: float
    accel_length_mps2: float
    memory_s: float
    friction_s: float
    walk_phi: float
    walk_length: float

    def numbers(self) -> list[float]:
        """(1/T_a, 1/T_v, density of w_a, of w_p) of phi and then of the length."""
        b, c = 1.0 / self.friction_s, 1.0 / self.memory_s
        return [
            c, 0.0, 2.0 * self.accel_phi_radps2**2 * c, self.walk_phi**2,
            c, b, 2.0 * self.accel_length_mps2**2 * c, self.walk_length**2,
        ]  # fmt: skip


LEVELS = (
    Level("rest", 1.0, 3e-4, 0.04, 0.08, 5e-6, 1.5e-5),
    Level("drift", 1.0, 8e-3, 0.04, 7.5, 5e-6, 3e-6),
    Level("move", 20.0, 0.05, 0.02, 1.0, 1.3e-4, 2.6e-5),
    Level("swing", 120.0, 0.8, 0.05, 50.0, 7e-4, 6e-5),
)
"""From rest over the slow and quick motion of the pumps to a free swing.

Found by a random search for the least errors on simulated rigs whose parameters vary. Rest and drift have
the same angle, so that the gyroscope has no say in which of them it is: ten times as fast as the camera,
it would outvote the pictures, which alone see a slow change of length.
"""


@dataclass(frozen=True)
class Kinematic:
    """Parameters of the process.

    Attributes
    ----------
    levels : the bank.
    switch_hz : rate at which one level turns into another.
    sensor_walk : (13,) densities of the walk of `sensors.SENSOR`, unit per sqrt(s).
    """

    levels: tuple[Level, ...] = LEVELS
    switch_hz: float = 0.1
    sensor_walk: tuple[float, ...] = (
        2e-5,
        3e-3,
        1e-3,
        1e-6,
        1e-6,
        1e-7,
        1e-7,
        1e-7,
        1e-8,
        1e-8,
        1e-6,
        1e-6,
        1e-6,
    )
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(level.name for level in self.levels))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Levels (M, 8) and squared walks (13,) for the compiled functions."""
        return np.array([level.numbers() for level in self.levels]), np.array(self.sensor_walk) ** 2


@compiled(inlined=True)
def axis_transition(c: float, b: float, h: float) -> tuple[float, float, float, float, float]:
    """Entries f01, f02, f11, f12, f22 of the transition of (p, v, a) over h [s]; c = 1/T_a, b = 1/T_v."""
    h2, h3 = 0.5 * h * h, h * h * h / 6.0
    return (
        h - b * h2 + b * b * h3,
        h2 - (b + c) * h3,
        1.0 - b * h + b * b * h2 - b * b * b * h3,
        h - (b + c) * h2 + (b * b + b * c + c * c) * h3,
        1.0 - c * h + c * c * h2 - c * c * c * h3,
    )


@compiled(inlined=True)
def axis_noise(q: float, walk: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Entries pp, pv, pa, vv, va, aa of the noise over h [s] for the densities q of w_a, walk of w_p."""
    h2 = h * h
    h3 = h2 * h
    return (
        walk * h + q * h2 * h3 / 20.0,
        q * h2 * h2 / 8.0,
        q * h3 / 6.0,
        q * h3 / 3.0,
        q * h2 / 2.0,
        q * h,
    )

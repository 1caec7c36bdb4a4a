"""A log as an identification sees it, and what simulated rigs would have shown in its place.

A `Track` holds the commands by ticks and what was measured of the head: angle and length with the square
root of the inverse of their covariance, so that whitened residuals of a perfect model have deviation one.

The rig is at rest before the first tick, bent and stretched as the start says; commands before it are
zero. Between ticks the states follow the cubic through values and rates at both ends (4e-5 rad at 4 Hz).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.actuator.batch import simulate_batch
from calib.actuator.identify_parameters import Nominal, made
from calib.actuator.integrate import state_row
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["SUBSTEPS", "Start", "Track", "heads_of"]

SUBSTEPS = 12
"""Steps per tick of 1/60 s: 1.4 ms, of fourth order."""


@dataclass(frozen=True)
class Start:
    """Angle [rad] and length [m] at rest before the first tick."""

    phi_rad: float
    length_m: float


@dataclass(frozen=True)
class Track:
    """One log.

    Attributes
    ----------
    name : for messages. tick_s : period of the commands.
    pwm : (n, 2) commands, row k at the time k tick_s. hoses : whether the pumps are connected.
    t_s : (m,) times of the measured rows. head : (m, 2) angle [rad] and length [m].
    whitening : (m, 2, 2) turns errors of `head` into numbers of deviation one.
    """

    name: str
    tick_s: float
    pwm: FloatArray
    hoses: bool
    t_s: FloatArray
    head: FloatArray
    whitening: FloatArray

    def __post_init__(self) -> None:
        m = len(self.t_s)
        if self.head.shape != (m, 2) or self.whitening.shape != (m, 2, 2) or self.pwm.shape[1:] != (2,):
            raise BadInputError(f"{self.name}: found arrays that do not match")
        if m == 0 or len(self.pwm) < 2:
            raise BadInputError(f"{self.name}: found no rows to identify from")

    @property
    def start(self) -> Start:
        """Median of the first five rows, which outliers do not move."""
        phi, length = np.median(self.head[:5], axis=0).tolist()
        return Start(phi, length)


def heads_of(
    track: Track,
    nominal: Nominal,
    sets: Sequence[Mapping[str, float]],
    starts: Sequence[Start],
    delay_s: float,
    threads: int = 2,
) -> tuple[FloatArray, FloatArray]:
    """Angle and length at the track's rows, and their rates, for sets of parameters: (sets, m, 2) each.

    Parameters
    ----------
    delay_s : the rows show the head as it was this much earlier.

    A set whose motion leaves the model is NaN.
    """
    pairs = [made(nominal, values, track.hoses, track.tick_s) for values in sets]
    r = nominal.plant.bellows_radius_m
    rows = np.stack(
        [state_row(plant, s.phi_rad, s.length_m) for (plant, _), s in zip(pairs, starts, strict=True)]
    )
    last = float(track.t_s[-1] - delay_s)
    ticks = min(max(int(np.ceil(last / track.tick_s)) + 1, 2), len(track.pwm))
    substeps = max(round(SUBSTEPS * 60.0 * track.tick_s), 4)
    states, _ = simulate_batch(
        [p for p, _ in pairs], [u for _, u in pairs], track.pwm[:ticks], rows, substeps, threads
    )
    states = np.concatenate([rows[:, None, :], states], axis=1)
    half = 0.5 / r
    y = np.stack([(states[..., 0] - states[..., 1]) * half, 0.5 * (states[..., 0] + states[..., 1])], axis=-1)
    dy = np.stack(
        [(states[..., 2] - states[..., 3]) * half, 0.5 * (states[..., 2] + states[..., 3])], axis=-1
    )
    at = np.clip((track.t_s - delay_s) / track.tick_s, 0.0, float(ticks))
    k = np.minimum(at.astype(np.int64), ticks - 1)
    x = (at - k)[None, :, None]
    h = track.tick_s
    y0, y1, d0, d1 = y[:, k], y[:, k + 1], h * dy[:, k], h * dy[:, k + 1]
    rise = y1 - y0
    curve, bend = 3.0 * rise - 2.0 * d0 - d1, d0 + d1 - 2.0 * rise
    value = y0 + x * (d0 + x * (curve + x * bend))
    rate = (d0 + x * (2.0 * curve + 3.0 * x * bend)) / h
    return np.asarray(value), np.asarray(rate)

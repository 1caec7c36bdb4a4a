"""A log as an identification sees it, and what simulated rigs would have shown in its place.

A `Track` holds the commands by ticks and what was measured of the head: angle and length with the square
root of the inverse of their covariance, so that whitened residuals of a perfect model have deviation one.

The rig is at rest before the first tick, bent and stretched as the start says, or in motion there, with
rates, creep and forces that are unknown too. Commands before it are zero, or of a start in motion the first
one. Between ticks the states follow the cubic through values and rates at both ends (4e-5 rad at 4 Hz).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from calib.actuator.batch import simulate_batch
from calib.actuator.identify_parameters import Nominal, made
from calib.actuator.integrate import state_row
from calib.actuator.parameters import Plant
from calib.actuator.pump import Pump
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["COMPONENTS", "SUBSTEPS", "Start", "Track", "heads_of"]

SUBSTEPS = 12
"""Steps per tick of 1/60 s: 1.4 ms, of fourth order."""


@dataclass(frozen=True)
class Start:
    """State before the first tick: angle and length, and what is zero at rest with the pumps off.

    Attributes
    ----------
    phi_rad, length_m, dphi_radps, dlength_mps : of the head.
    creep1_N, creep2_N : z of (3.45). force1_N, force2_N : of the pumps. lag1_N, lag2_N : of their lags, which
        are below the forces while air leaves at its limit.
    """

    phi_rad: float
    length_m: float
    dphi_radps: float = 0.0
    dlength_mps: float = 0.0
    creep1_N: float = 0.0
    creep2_N: float = 0.0
    force1_N: float = 0.0
    force2_N: float = 0.0
    lag1_N: float = 0.0
    lag2_N: float = 0.0

    def row(self, plant: Plant) -> FloatArray:
        """The row (10,) of `kernel.STATE`."""
        row = state_row(plant, self.phi_rad, self.length_m, (self.force1_N, self.force2_N))
        turning = plant.bellows_radius_m * self.dphi_radps
        row[2:4] = self.dlength_mps + turning, self.dlength_mps - turning
        row[4:8] = self.creep1_N, self.creep2_N, self.lag1_N, self.lag2_N
        return row


COMPONENTS = tuple(field.name for field in fields(Start))
"""Names of a start's values, those of rest first, those that only pumps have last."""


@dataclass(frozen=True)
class Track:
    """One log.

    Attributes
    ----------
    name : for messages. tick_s : period of the commands.
    pwm : (n, 2) commands, row k at the time k tick_s. hoses : whether the pumps are connected.
    t_s : (m,) times of the measured rows. head : (m, 2) angle [rad] and length [m].
    whitening : (m, 2, 2) turns errors of `head` into numbers of deviation one.
    moving : a guess of the start where the log begins in motion, None where it begins at rest.
    """

    name: str
    tick_s: float
    pwm: FloatArray
    hoses: bool
    t_s: FloatArray
    head: FloatArray
    whitening: FloatArray
    moving: Start | None = None

    def __post_init__(self) -> None:
        m = len(self.t_s)
        if self.head.shape != (m, 2) or self.whitening.shape != (m, 2, 2) or self.pwm.shape[1:] != (2,):
            raise BadInputError(f"{self.name}: found arrays that do not match")
        if m == 0 or len(self.pwm) < 2:
            raise BadInputError(f"{self.name}: found no rows to identify from")

    @property
    def start(self) -> Start:
        """Median of the first five rows, which outliers do not move; of a log in motion its guess."""
        if self.moving is not None:
            return self.moving
        phi, length = np.median(self.head[:5], axis=0).tolist()
        return Start(phi, length)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Values of the start that are not known: of `COMPONENTS` the first 2, 6 or 10."""
        return COMPONENTS[: 2 if self.moving is None else 10 if self.hoses else 6]


def heads_of(
    track: Track,
    nominal: Nominal,
    sets: Sequence[Mapping[str, float]],
    starts: Sequence[Start],
    delay_s: float,
    threads: int = 2,
    pairs: Sequence[tuple[Plant, Pump]] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Angle and length at the track's rows, and their rates, for sets of parameters: (sets, m, 2) each.

    Parameters
    ----------
    delay_s : the rows show the head as it was this much earlier.
    pairs : plants and pumps of the sets, where they have been made before.

    A set whose motion leaves the model is NaN.
    """
    if pairs is None:
        pairs = [made(nominal, values, track.hoses, track.tick_s) for values in sets]
    r, pwm = nominal.plant.bellows_radius_m, track.pwm
    if track.moving is not None:
        # The batch knows no commands before the first; those on their way are put in by hand.
        late = np.maximum(np.arange(len(pwm)) - nominal.pump.delay_ticks, 0)
        pwm, pairs = pwm[late], [(plant, replace(pump, delay_ticks=0)) for plant, pump in pairs]
    rows = np.stack([start.row(plant) for (plant, _), start in zip(pairs, starts, strict=True)])
    last = float(track.t_s[-1] - delay_s)
    ticks = min(max(int(np.ceil(last / track.tick_s)) + 1, 2), len(track.pwm))
    substeps = max(round(SUBSTEPS * 60.0 * track.tick_s), 4)
    states, _ = simulate_batch(
        [p for p, _ in pairs], [u for _, u in pairs], pwm[:ticks], rows, substeps, threads
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

"""Whether a log begins in motion, and a first guess of the state there.

Hoses off. Angle and rate at the beginning are those of a damped swing fitted to the first second,

    phi(t) = m + exp(-zeta w t) (a cos w t + b sin w t),

linear in m, a, b for each w and zeta of a grid, which is finer about the best of a coarse one. A swing that
is let go has hardly any rate at its beginning; one that is cut out of a longer log has.

Pumps connected. A log whose head is away from the straight rest at its beginning is taken to be in motion,
slowly: rates by straight lines, forces as they would hold the head.
"""

from __future__ import annotations

import math

import numpy as np

from calib.actuator.identify_decrement import without_outliers
from calib.actuator.identify_tracks import Start
from calib.actuator.parameters import Plant
from calib.arrays import FloatArray
from calib.control.inverse_model import holding_force

__all__ = ["start_in_motion", "swing_at_beginning"]

_FIRST_S = 1.0
_SLOW_S = 0.25
_HERTZ = np.geomspace(1.0, 10.0, 70)
_NEAR = np.linspace(0.96, 1.04, 17)
_ZETA = (0.02, 0.035, 0.05, 0.07, 0.1, 0.15)
_FEWEST = 12
_SHARE = 0.3
_SURE = 6.0
_LEAST_RADPS = 0.2
_AWAY_RAD = 0.06
_AWAY_M = 0.004


def _swing(t: FloatArray, phi: FloatArray, w: float, zeta: float) -> tuple[float, float, float, float, float]:
    """Sum of squares, and what `swing_at_beginning` returns, of one w [rad/s] and zeta."""
    decay = np.exp(-zeta * w * t)
    A = np.stack([np.ones_like(t), decay * np.cos(w * t), decay * np.sin(w * t)], axis=1)
    # A second of readings tells the three apart, so the normal equations do.
    inverse = np.linalg.solve(A.T @ A, A.T)
    m, a, b = (inverse @ phi).tolist()
    residual = phi - A @ np.array([m, a, b])
    noise = float(np.linalg.norm(residual)) / math.sqrt(max(len(t) - 5, 1))
    by = w * (inverse[2] - zeta * inverse[1])
    return (
        float(residual @ residual),
        m + a,
        w * (b - zeta * a),
        noise * float(np.linalg.norm(by)),
        w * math.hypot(a, b),
    )


def swing_at_beginning(t_s: FloatArray, phi_rad: FloatArray) -> tuple[float, float, float, float]:
    """Angle [rad], rate [rad/s], the rate's standard deviation and w times the amplitude, at t = 0.

    The times (n,) begin at 0 or shortly after; a second of them is used, single wrong readings replaced.
    """
    some = t_s <= _FIRST_S
    t, phi = t_s[some], without_outliers(phi_rad[some])[0]
    tried = [(_swing(t, phi, w, zeta), w) for w in (2.0 * math.pi * _HERTZ).tolist() for zeta in _ZETA]
    middle = min(tried)[1]
    near = [middle * share for share in _NEAR.tolist()]
    best = min(_swing(t, phi, w, zeta) for w in near for zeta in _ZETA)
    return best[1:]


def start_in_motion(
    t_s: FloatArray, head: FloatArray, hoses: bool, plant: Plant, rest_noise_rad: float
) -> Start | None:
    """A guess of the start of a log that begins in motion; None for one that begins at rest.

    Parameters
    ----------
    t_s, head : (n,) times from the beginning [s] and (n, 2) angle [rad] and length [m].
    rest_noise_rad : standard deviation of a reading of the angle.
    """
    if len(t_s) < _FEWEST:
        return None
    phi, length = np.median(head[:5], axis=0).tolist()
    if hoses:
        away = max(_AWAY_RAD, _SURE * rest_noise_rad)
        if abs(phi) < away and abs(length - plant.rest_length_m) < _AWAY_M:
            return None
        some = t_s <= max(_SLOW_S, float(t_s[4]))
        rates = np.polyfit(t_s[some], head[some], 1)[0].tolist()
        turned = plant.bellows_radius_m * phi
        F = np.maximum(holding_force(plant, np.array([length + turned, length - turned])), 0.0).tolist()
        return Start(phi, length, rates[0], rates[1], 0.0, 0.0, *F, *F)
    at_0, rate, sigma, fastest = swing_at_beginning(t_s, head[:, 0])
    if abs(rate) < max(_SHARE * fastest, _SURE * sigma, _LEAST_RADPS):
        return None
    return Start(at_0, length, rate)

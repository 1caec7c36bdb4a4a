"""Gain, phase and delay margins of discrete loops, and the least distance from -1.

A loop with several channels is broken at one of them with the others closed,

    L_i = L_ii - L_io (I + L_oo)^-1 L_oi,

o the others. Its margins are read off the frequency response between zero and half the sampling rate:

    gain margin    least factor, above or below 1, at which L passes -1: 1 / |L| where L is real and negative
    phase margin   least angle between L and -1 where |L| = 1
    delay margin   phase margin over frequency, least
    Ms             largest |1 / (1 + L)|, the sensitivity

Crossings are refined on a straight line between two frequencies. Whether the closed loop is stable at
all is asked of its eigenvalues and not of these curves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import ComplexArray, FloatArray
from calib.control.linear import System, closed_loop, response, spectral_radius

__all__ = ["Margins", "break_at", "frequencies", "gain_to_instability", "loop_margins", "margins_of_response"]


@dataclass(frozen=True)
class Margins:
    """Margins of one loop; infinite where nothing is crossed.

    Attributes
    ----------
    stable : of the closed loop.
    gain : factor on the loop up to the limit of stability; gain_down the one below 1, 0 without.
    phase_rad, delay_s : at the crossing of |L| = 1 that gives the least.
    crossover_hz : highest frequency with |L| = 1, 0 without.
    sensitivity : Ms.
    """

    stable: bool
    gain: float
    gain_down: float
    phase_rad: float
    delay_s: float
    crossover_hz: float
    sensitivity: float


def frequencies(tick_s: float, count: int = 2000) -> FloatArray:
    """Angular frequencies (count,) [rad/s] from far below the pumps' lag up to half the sampling rate."""
    top = math.pi / tick_s
    return np.geomspace(1e-4 * top, top, count)


def margins_of_response(omega: FloatArray, L: ComplexArray, stable: bool) -> Margins:
    """Margins of a loop's frequency response (k,) at rising angular frequencies (k,) [rad/s]."""
    up, down = math.inf, 0.0
    for i in np.flatnonzero(np.diff(np.signbit(L.imag))):
        a, b = L[i], L[i + 1]
        real = a.real + (b.real - a.real) * (a.imag / (a.imag - b.imag))
        if real < -1e-300:
            factor = float(-1.0 / real)
            if factor >= 1.0:
                up = min(up, factor)
            else:
                down = max(down, factor)
    # At half the rate L is real by itself.
    if L[-1].real < 0.0 and abs(L[-1].imag) < 1e-9 * abs(L[-1]):
        factor = -1.0 / float(L[-1].real)
        up, down = (min(up, factor), down) if factor >= 1.0 else (up, max(down, factor))
    phase, late, crossover = math.inf, math.inf, 0.0
    size = np.log(np.maximum(np.abs(L), 1e-300))
    for i in np.flatnonzero(np.diff(np.signbit(size))):
        s = float(size[i] / (size[i] - size[i + 1]))
        w = float(omega[i] + s * (omega[i + 1] - omega[i]))
        turn = np.angle(L[i + 1] / L[i])
        angle = float(np.angle(L[i]) + s * turn + math.pi)
        angle = (angle + math.pi) % (2.0 * math.pi) - math.pi
        phase = min(phase, abs(angle))
        # A delay turns L clockwise: what is ahead of -1 by this much comes there after so long.
        late = min(late, (angle % (2.0 * math.pi)) / w)
        crossover = max(crossover, w / (2.0 * math.pi))
    sensitivity = float(np.max(1.0 / np.maximum(np.abs(1.0 + L), 1e-300)))
    return Margins(stable, up, down, phase, late, crossover, sensitivity)


def break_at(L: ComplexArray, channel: int) -> ComplexArray:
    """Scalar loop (k,) at one channel of a loop (k, n, n) with the others closed."""
    n = L.shape[1]
    others = [i for i in range(n) if i != channel]
    own: ComplexArray = L[:, channel, channel]
    if not others:
        return own
    rest = np.linalg.solve(np.eye(n - 1) + L[:, others][:, :, others], L[:, others, channel][..., None])
    return np.asarray(own - (L[:, channel, None][:, :, others] @ rest)[:, 0, 0], dtype=np.complex128)


def loop_margins(loop: System, omega: FloatArray | None = None) -> list[Margins]:
    """Margins of each channel of a square loop, negative feedback."""
    w = frequencies(loop.tick_s) if omega is None else omega
    L = response(loop, w)
    stable = spectral_radius(closed_loop(loop)) < 1.0
    return [margins_of_response(w, break_at(L, i), stable) for i in range(len(loop.D))]


def gain_to_instability(loop: System, channel: int = 0, most: float = 1e4) -> float:
    """Gain margin by brute force: the factor on a channel at which an eigenvalue leaves the unit circle.

    Bisection after the first of growing factors that is unstable; infinite when none up to `most` is.
    """

    def stable(factor: float) -> bool:
        scale = np.ones(len(loop.D))
        scale[channel] = factor
        scaled = replace(loop, C=loop.C * scale[:, None], D=loop.D * scale[:, None])
        return spectral_radius(closed_loop(scaled)) < 1.0

    low = 1.0
    if not stable(low):
        return 1.0
    high = low
    while stable(high):
        low, high = high, high * 1.05
        if high > most:
            return math.inf
    for _ in range(50):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low

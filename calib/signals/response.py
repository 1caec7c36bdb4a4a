"""What a low-pass does to a signal: gain, delay, step response, noise, and filtering itself.

All sections (k, 6) have a gain of 1 at zero frequency and their zeros at z = -1, as those of
`calib.signals.design`. A numerator (1 + z^-1)^n then delays every frequency by n / 2 samples, and with
D(z) = 1 + a1 z^-1 + a2 z^-2 the group delay of a section is

    tau = n / 2 - Re[ (a1 z^-1 + 2 a2 z^-2) / D(z) ],   n / 2 - (a1 + 2 a2) / (1 + a1 + a2) at zero frequency.

Signals are filtered in the transposed direct form II,

    y = b0 x + s1,   s1' = b1 x - a1 y + s2,   s2' = b2 x - a2 y,

started from s1 = (1 - b0) x_0, s2 = (b2 - a2) x_0 as if x_0 had been there for ever: no transient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import brentq
from scipy.signal import sosfilt

from calib.arrays import FloatArray

__all__ = [
    "StepResponse",
    "cutoff_hz",
    "dc_delay_s",
    "decibels",
    "filter_signal",
    "frequency_response",
    "group_delay_s",
    "noise_gain",
    "settled_state",
    "step_response",
]

_FLOOR_DB = -400.0


@dataclass(frozen=True)
class StepResponse:
    """Answer to a step from 0 to 1 at t = 0.

    Attributes
    ----------
    t_s, values : (n,) samples; the first is the one with the step.
    rise_s : time from 10 % to 90 %, between samples by interpolation.
    settling_s : after this the answer stays within 2 %.
    overshoot : largest value beyond 1.
    """

    t_s: FloatArray
    values: FloatArray
    rise_s: float
    settling_s: float
    overshoot: float


def _z(f_hz: FloatArray, rate_hz: float) -> npt.NDArray[np.complex128]:
    return np.asarray(np.exp(-2j * np.pi * np.asarray(f_hz) / rate_hz))


def frequency_response(sections: FloatArray, f_hz: FloatArray, rate_hz: float) -> npt.NDArray[np.complex128]:
    """H (n,) at frequencies (n,) [Hz] of sections (k, 6)."""
    z = _z(f_hz, rate_hz)
    H = np.ones(z.shape, dtype=np.complex128)
    for b0, b1, b2, _, a1, a2 in sections:
        H *= (b0 + z * (b1 + z * b2)) / (1.0 + z * (a1 + z * a2))
    return H


def decibels(H: npt.NDArray[np.complex128] | FloatArray) -> FloatArray:
    """20 log10 |H|, at least -400."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(H), 10.0 ** (_FLOOR_DB / 20.0))))


def group_delay_s(sections: FloatArray, f_hz: FloatArray, rate_hz: float) -> FloatArray:
    """Group delay (n,) [s] at frequencies (n,) [Hz]."""
    z = _z(f_hz, rate_hz)
    samples = np.zeros(z.shape)
    for _, _, b2, _, a1, a2 in sections:
        samples += (1.0 if b2 != 0.0 else 0.5) - np.real(z * (a1 + 2.0 * z * a2) / (1.0 + z * (a1 + z * a2)))
    return np.asarray(samples / rate_hz)


def dc_delay_s(sections: FloatArray, rate_hz: float) -> float:
    """Delay [s] of slow motion: the group delay at zero frequency."""
    return float(group_delay_s(sections, np.zeros(1), rate_hz)[0])


def cutoff_hz(sections: FloatArray, rate_hz: float) -> float:
    """Frequency [Hz] at which the power is halved."""

    def above_half(f: float) -> float:
        return float(np.abs(frequency_response(sections, np.array([f]), rate_hz)[0])) ** 2 - 0.5

    return float(brentq(above_half, 0.0, 0.5 * rate_hz, xtol=1e-15 * rate_hz, rtol=1e-12))


def settled_state(sections: FloatArray, first: FloatArray) -> FloatArray:
    """State (k, 2, ...) after `first` (...) has been the input for ever."""
    state = np.stack([1.0 - sections[:, 0], sections[:, 2] - sections[:, 5]], axis=1)
    return np.asarray(state.reshape(*state.shape, *([1] * np.ndim(first))) * first)


def filter_signal(sections: FloatArray, x: FloatArray) -> FloatArray:
    """Filtered signal (n, ...) along the first axis, started without a transient; `x` has no NaN."""
    if len(x) == 0:
        return np.array(x, dtype=np.float64)
    y, _ = sosfilt(sections, x, axis=0, zi=settled_state(sections, np.asarray(x[0])))
    return np.asarray(y, dtype=np.float64)


def step_response(sections: FloatArray, rate_hz: float) -> StepResponse:
    """Answer to a step, as long as it takes to settle to a thousandth."""
    delay = dc_delay_s(sections, rate_hz) * rate_hz
    count = int(min(max(8.0 * delay, 16.0) + 1, 4_000_000))
    while True:
        y = np.asarray(sosfilt(sections, np.ones(count)), dtype=np.float64)
        outside = np.nonzero(np.abs(y - 1.0) > 1e-3)[0]
        if len(outside) == 0 or outside[-1] < 0.9 * count or count > 2_000_000:
            break
        count *= 2
    t = np.arange(count) / rate_hz
    late = np.nonzero(np.abs(y - 1.0) > 0.02)[0]
    return StepResponse(
        t,
        y,
        _crossing_s(t, y, 0.9, rate_hz) - _crossing_s(t, y, 0.1, rate_hz),
        0.0 if len(late) == 0 else float((late[-1] + 1) / rate_hz),
        max(0.0, float(y.max()) - 1.0),
    )


def _crossing_s(t_s: FloatArray, y: FloatArray, level: float, rate_hz: float) -> float:
    """First time [s] at which y reaches a level; before the first sample it was 0."""
    i = int(np.argmax(y >= level))
    before = 0.0 if i == 0 else float(y[i - 1])
    return float(t_s[i]) - (float(y[i]) - level) / (float(y[i]) - before) / rate_hz


def noise_gain(sections: FloatArray) -> float:
    """Variance of the output over that of a white input: sum of the squared impulse response.

    The stationary covariance P = A P A' + B B' of the cascade's state gives C P C' + D^2.
    """
    A, B, C, D = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    for b0, b1, b2, _, a1, a2 in sections:
        second = b2 != 0.0
        n = 2 if second else 1
        As = np.array([[-a1, 1.0], [-a2, 0.0]])[:n, :n]
        Bs = np.array([[b1 - a1 * b0], [b2 - a2 * b0]])[:n]
        Cs = np.array([[1.0, 0.0]])[:, :n]
        A = np.block([[A, np.zeros((len(A), n))], [Bs @ C, As]])
        B = np.vstack([B, Bs @ D])
        C = np.hstack([b0 * C, Cs])
        D = b0 * D
    P = solve_discrete_lyapunov(A, B @ B.T)
    return float((C @ P @ C.T + D @ D.T)[0, 0])

"""The first-order low-pass of the camera's positions (2.2.2): 1 Hz at 60 Hz.

The analogue filter 1 / (1 + s / w) becomes, by the bilinear transform with its cut-off kept
(K = tan(pi f / rate)),

    y_k = b0 (x_k + x_(k-1)) - a1 y_(k-1),   b0 = K / (1 + K),   a1 = (K - 1) / (K + 1).

b0 = 0.04979798 and a1 = -0.90040404 for 1 Hz at 60 Hz. The source does not print the order; with
this one slow motion arrives 1 / (2 pi f) = 0.159 s late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from calib.errors import BadInputError

__all__ = ["LowPass", "LowPassState", "coefficients", "settled", "step"]


@dataclass(frozen=True)
class LowPass:
    """Cut-off and sampling rate [Hz].

    Raises `BadInputError` for a cut-off outside (0, rate / 2).
    """

    cutoff_hz: float = 1.0
    rate_hz: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 < self.cutoff_hz < 0.5 * self.rate_hz < math.inf:
            raise BadInputError(
                f"low-pass: found a cut-off of {self.cutoff_hz:g} Hz at {self.rate_hz:g} Hz, "
                "expected one between zero and half the rate"
            )


@dataclass(frozen=True)
class LowPassState:
    """Input and output of the sample before."""

    x1: float
    y1: float


@lru_cache(maxsize=64)
def coefficients(parameters: LowPass) -> tuple[float, float]:
    """b0 and a1."""
    K = math.tan(math.pi * parameters.cutoff_hz / parameters.rate_hz)
    return K / (1.0 + K), (K - 1.0) / (K + 1.0)


def settled(value: float) -> LowPassState:
    """State after `value` has been the input for ever, so that a log starts without a transient."""
    return LowPassState(value, value)


def step(parameters: LowPass, state: LowPassState, sample: float) -> LowPassState:
    """State after one sample; its `y1` is the output."""
    b0, a1 = coefficients(parameters)
    return LowPassState(sample, b0 * (sample + state.x1) - a1 * state.y1)

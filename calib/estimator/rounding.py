"""Whole pixels: what a rounded reading says of the place that was rounded.

A tracker reports round(z), z = h + jitter, h the pixel that the state predicts. With z ~ N(m, S) before,
a reading r says that z lies in [r - g / 2, r + g / 2] for a grid g, no more. The truncated normal
distribution (Johnson, Kotz and Balakrishnan 1994, 13.134) has

    Z = Phi(b) - Phi(a),   E = m + sqrt(S) (n(a) - n(b)) / Z,
    V = S (1 + (a n(a) - b n(b)) / Z - ((n(a) - n(b)) / Z)^2)

with a, b the ends in units of sqrt(S). Matching the state's moments to it is the update by the equivalent
Gaussian reading: innovation (E - m) S / (S - V) with variance S^2 / (S - V). A Gaussian reading of
variance g^2 / 12 instead would let an average over many equal readings pass for more than it says.
"""

from __future__ import annotations

import math

from calib.estimator.compiled import compiled

__all__ = ["truncated", "update_terms"]

_ROOT = math.sqrt(0.5)
_NORM = 1.0 / math.sqrt(2.0 * math.pi)
_FAR = 6.0


@compiled()
def truncated(a: float, b: float) -> tuple[float, float, float]:
    """Log of the probability of [a, b], mean and variance within it, of a standard normal number.

    Beyond six deviations, where the differences cancel, the interval's end and an exponential tail
    stand for them.
    """
    if a > b:
        a, b = b, a
    flip = a + b < 0.0
    if flip:
        a, b = -b, -a
    if a > _FAR:
        # A tail: exponential with the rate a + 1 / a, cut at b.
        rate = a + 1.0 / a
        width = (b - a) * rate
        cut = math.exp(-width) if width < 700.0 else 0.0
        whole = -math.expm1(-width)
        log_z = -0.5 * a * a + math.log(_NORM / rate) + math.log(whole)
        mean = a + (1.0 - width * cut / whole) / rate
        variance = (1.0 - width * width * cut / (whole * whole)) / (rate * rate)
        variance = max(variance, 1e-6 * (b - a) * (b - a))
    else:
        # With erfc both ends keep their digits on the right-hand side.
        z = 0.5 * (math.erfc(a * _ROOT) - math.erfc(b * _ROOT))
        width = b - a
        if width < 1e-3:
            middle = 0.5 * (a + b)
            z = width * _NORM * math.exp(-0.5 * middle * middle)
            mean, variance = middle - middle * width * width / 12.0, width * width / 12.0
        else:
            na, nb = _NORM * math.exp(-0.5 * a * a), _NORM * math.exp(-0.5 * b * b)
            scale = 1.0 / z
            mean = (na - nb) * scale
            variance = 1.0 + (a * na - b * nb) * scale - mean * mean
            variance = min(max(variance, 1e-3 * min(1.0, width * width / 12.0)), 1.0)
        log_z = math.log(z)
    return log_z, -mean if flip else mean, variance


@compiled()
def update_terms(innovation: float, spread: float, jitter: float, grid: float) -> tuple[float, float, float]:
    """Equivalent Gaussian reading of a rounded one: innovation, its whole variance S, log likelihood.

    Parameters
    ----------
    innovation : reading minus the predicted pixel.
    spread : variance of the predicted pixel. jitter : variance of the tracker's jitter.
    grid : step of the readings [px]; 0 for readings that are not rounded.
    """
    S = spread + jitter
    if not grid > 0.0:
        return innovation, S, -0.5 * (innovation * innovation / S + math.log(2.0 * math.pi * S))
    root = math.sqrt(S)
    scale = 1.0 / root
    log_z, mean, variance = truncated((innovation - 0.5 * grid) * scale, (innovation + 0.5 * grid) * scale)
    gain = 1.0 - variance
    if gain < 1e-9:
        # The interval holds nearly all of the distribution: nothing is learnt.
        return 0.0, S * 1e9, log_z
    scale = 1.0 / gain
    return root * mean * scale, S * scale, log_z

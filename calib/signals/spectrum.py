"""Motion and jitter of a logged position, told apart by their spectrum.

Motion of a heavy thing is slow, quantisation and tracking errors are spread over all frequencies. So
the power density (Welch 1967) falls from the motion to a floor. Outliers are no jitter: samples beyond six
standard deviations from the median of five (Hampel 1974) are replaced by it first. Of the segments'
densities the mean holds motion however short it was, and the median P counts disturbances little.
The motion ends at the last frequency f_m of the lower half of the band at which the mean is above six
times its own floor. The jitter has the density

    N(f) = F below f_m (motion hides it there),   N(f) = P(f) above,

with F the median of P over the upper half. A filter H leaves the jitter sigma^2 = sum of N |H|^2 df.
Where motion reaches a tenth of the rate, F may be its tail and not the jitter's: the spectrum is then
called not flat, and a log at rest is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import detrend, savgol_filter, welch

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.signals.response import frequency_response, noise_gain

__all__ = ["FEWEST", "Spectrum", "grid_step", "jitter_after", "motion_lost", "quantisation_hz", "spectrum"]

FEWEST = 64
"""Ticks below which nothing is said of a spectrum."""

_SEGMENT_S = 8.0
_FLOOR_TIMES = 6.0
"""The pixel grid's sawtooth stands up to three times above the floor and is jitter."""
_FLAT = 4.0
_HIGHEST_MOTION = 0.1
"""Parts of the rate. A random walk, which has no floor, seems to end at 0.12."""
_OUTLIER_SIGMAS = 6.0


@dataclass(frozen=True)
class Spectrum:
    """Power density of one coordinate, one-sided, in squared units of the signal per Hz.

    Attributes
    ----------
    rate_hz : samples per second.
    f_hz : (n,) frequencies [Hz], without zero.
    jitter_density, motion_density : (n,) of each; the sum over all is about the signal's.
    floor : density of the jitter below the motion.
    motion_hz : where the motion ends, 0 without motion.
    flat : whether the upper half of the band looks like jitter alone.
    outliers : samples that were replaced.
    """

    rate_hz: float
    f_hz: FloatArray
    jitter_density: FloatArray
    motion_density: FloatArray
    floor: float
    motion_hz: float
    flat: bool
    outliers: int = 0

    @property
    def jitter(self) -> float:
        """Standard deviation of the jitter, unfiltered."""
        return math.sqrt(_jitter_power(self, np.ones(len(self.f_hz)), 1.0))


def spectrum(x: FloatArray, rate_hz: float) -> Spectrum:
    """Spectrum of a coordinate (n,) on ticks.

    Raises `BadInputError` for fewer than 64 ticks.
    """
    if len(x) < FEWEST:
        raise BadInputError(f"has {len(x)} camera ticks without a long gap, expected at least {FEWEST}")
    x, outliers = _without_outliers(x)
    # With at least four segments a median is one; half-overlapping ones of n / 2.5 make four.
    segment = int(min(max(32, round(_SEGMENT_S * rate_hz)), 2048, len(x) / 2.5))
    mean, median = _density(x, rate_hz, segment, "mean"), _density(x, rate_hz, segment, "median")
    f = np.arange(1.0, len(mean) + 1.0) * (rate_hz / segment)
    upper = f >= 0.25 * rate_hz
    floor, floor_of_means = float(np.median(median[upper])), float(np.median(mean[upper]))
    nothing = (1e-13 * float(np.abs(x).max())) ** 2
    above = np.nonzero(_smoothed(mean[~upper]) > max(_FLOOR_TIMES * floor_of_means, nothing))[0]
    end = int(above[-1]) + 1 if len(above) else 0
    thirds = [float(np.mean(part)) for part in np.array_split(mean[upper], 3)]
    flat = f[end - 1] <= _HIGHEST_MOTION * rate_hz if end else True
    flat = flat and thirds[0] <= max(_FLAT * min(thirds[1:]), nothing)
    moving = np.arange(len(f)) < end
    return Spectrum(
        rate_hz,
        f,
        np.asarray(np.where(moving, floor, median), dtype=np.float64),
        np.asarray(np.where(moving, np.maximum(mean - floor_of_means, 0.0), 0.0)),
        floor,
        float(f[end - 1]) if end else 0.0,
        bool(flat),
        outliers,
    )


def _without_outliers(x: FloatArray) -> tuple[FloatArray, int]:
    """The signal with the median of five in place of outliers, and how many there were.

    The spread is taken from the 95 % quantile: on a pixel grid more than half of the differences are zero.
    """
    middle = np.asarray(median_filter(x, 5, mode="nearest"), dtype=np.float64)
    away = np.abs(x - middle)
    sigma = float(np.quantile(away, 0.95)) / 1.96
    out = away > _OUTLIER_SIGMAS * sigma if sigma > 0.0 else np.zeros(len(x), dtype=np.bool_)
    return np.where(out, middle, x), int(out.sum())


def _density(x: FloatArray, rate_hz: float, segment: int, average: Literal["mean", "median"]) -> FloatArray:
    _, P = welch(x - x.mean(), rate_hz, nperseg=segment, detrend=_without_line, average=average)
    return np.asarray(P[1:-1], dtype=np.float64)


def _without_line(segments: FloatArray) -> FloatArray:
    return np.asarray(detrend(segments, axis=-1, type="linear"), dtype=np.float64)


def _smoothed(P: FloatArray) -> FloatArray:
    """Running geometric mean of three, so that one low value does not end the motion."""
    tiny = np.finfo(np.float64).tiny
    padded = np.log(np.maximum(np.pad(P, 1, mode="edge"), tiny))
    return np.asarray(np.exp(np.convolve(padded, np.full(3, 1 / 3), mode="valid")))


def jitter_after(of: Spectrum, sections: FloatArray) -> float:
    """Standard deviation of the jitter behind a filter; the floor's part exactly, the rest by the sum."""
    H2 = np.abs(frequency_response(sections, of.f_hz, of.rate_hz)) ** 2
    return math.sqrt(_jitter_power(of, H2, noise_gain(sections)))


def _jitter_power(of: Spectrum, H2: FloatArray, gain: float) -> float:
    """Variance of the jitter; the floor's part exactly, so that filters narrower than a bin are right."""
    df = float(of.f_hz[1] - of.f_hz[0])
    excess = float(np.sum((of.jitter_density - of.floor) * H2)) * df
    return max(of.floor * 0.5 * of.rate_hz * gain + excess, 0.0)


def motion_lost(of: Spectrum, sections: FloatArray, delay_s: float) -> float:
    """Share of the motion's amplitude (RMS) that is not passed unchanged with this delay.

    sqrt( sum of M |H - exp(-i w delay)|^2 / sum of M ); 0 without motion.
    """
    M = of.motion_density
    if not np.any(M > 0.0):
        return 0.0
    H = frequency_response(sections, of.f_hz, of.rate_hz)
    error = np.abs(H - np.exp(-2j * np.pi * of.f_hz * delay_s)) ** 2
    return math.sqrt(float(np.sum(M * error) / np.sum(M)))


def grid_step(pixels: FloatArray) -> float:
    """Step [px] that all values (n,) are multiples of, to 1e-6 px; 0 where there is none above 0.01 px."""
    values = np.unique(np.round(pixels, 6))
    steps = np.diff(values)
    if len(steps) == 0:
        return 0.0
    step = float(steps.min())
    whole = np.abs(values / step - np.round(values / step))
    return step if step > 0.01 and float(whole.max()) < 1e-3 else 0.0


def quantisation_hz(pixels: FloatArray, step_px: float, rate_hz: float) -> FloatArray:
    """Frequencies (3,) of the sawtooth that rounding adds to motion: quartiles of |speed| / step.

    A marker that moves at w px/s crosses w / step grid lines a second. The speed (n,) is that of a cubic
    through half a second; what is slower than a line in two seconds is rest and not
    counted; NaN where all is. Frequencies above half the rate are folded back.
    """
    window = max(5, int(0.5 * rate_hz) | 1)
    if step_px <= 0.0 or len(pixels) < window:
        return np.full(3, np.nan)
    speed = np.abs(savgol_filter(pixels, window, 3, deriv=1, delta=1.0 / rate_hz))
    lines = speed[speed > 0.5 * step_px] / step_px
    if len(lines) == 0:
        return np.full(3, np.nan)
    f = np.percentile(lines, [25.0, 50.0, 75.0])
    return np.asarray(np.abs((f + 0.5 * rate_hz) % rate_hz - 0.5 * rate_hz))

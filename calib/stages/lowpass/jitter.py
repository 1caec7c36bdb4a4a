"""Where a log's camera saw the marker: ticks, motion and jitter, and the low-pass of least delay for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.lowpass import filters
from calib.stages.lowpass.filters import Design, Filter

# ----------------------------------------------------------------------
# Samples with time stamps as the firmware sees them: one value per tick.
#
# The firmware counts ticks and does not look at clocks: a tick uses the newest sample, and where the camera
# found nothing the last one is held. So samples are put on a uniform grid: a sample belongs to the tick that
# is nearest to its time stamp (jitter below half a tick changes nothing), of several in one tick the last
# counts, and a tick without a sample holds the one before. After a gap longer than `LONGEST_HOLD_S` a new
# piece begins, filtered from rest, because what was held so long is no position any more.

LONGEST_HOLD_S = 1.0


@dataclass(frozen=True)
class Piece:
    """Ticks without a long gap.

    Attributes
    ----------
    t_s : (n,) times of the ticks [s], `1 / rate` apart.
    values : (n, d) one sample each.
    """

    t_s: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class Ticks:
    """A signal on ticks.

    Attributes
    ----------
    rate_hz : ticks per second.
    pieces : in order of time, each with at least one tick.
    held : ticks that repeat the sample before.
    dropped : samples that shared a tick with a later one.
    """

    rate_hz: float
    pieces: tuple[Piece, ...]
    held: int
    dropped: int

    @property
    def longest(self) -> Piece:
        """The longest piece, of equal ones the first."""
        return max(self.pieces, key=lambda piece: len(piece.t_s))


def resample_to_ticks(t_s: FloatArray, values: FloatArray, rate_hz: float) -> Ticks:
    """The samples (n, d), one or more, taken at times (n,) that do not run backwards, one per tick."""
    breaks = np.nonzero(np.diff(t_s) > max(LONGEST_HOLD_S, 2.0 / rate_hz))[0] + 1
    pieces, held, dropped = [], 0, 0
    for first, last in zip([0, *breaks.tolist()], [*breaks.tolist(), len(t_s)], strict=True):
        k = np.floor(_phase(t_s[first:last], rate_hz) + 0.5).astype(np.int64)
        k -= k[0]
        newest = np.nonzero(np.append(np.diff(k) > 0, True))[0]
        ticks = np.arange(k[-1] + 1)
        source = np.searchsorted(k[newest], ticks, side="right") - 1
        pieces.append(Piece(t_s[first] + ticks / rate_hz, values[first:last][newest[source]]))
        held += len(ticks) - len(newest)
        dropped += len(k) - len(newest)
    return Ticks(rate_hz, tuple(pieces), held, dropped)


def _phase(t_s: FloatArray, rate_hz: float) -> FloatArray:
    """Times in ticks, shifted so that most stamps lie near whole numbers.

    A clock that is a little off the rate drifts through the grid; then a tick is held or a sample
    dropped now and then, as in the firmware.
    """
    phase = (t_s - t_s[0]) * rate_hz
    early = phase[: max(1, min(len(phase), 64))]
    turn = np.angle(np.mean(np.exp(2j * np.pi * early))) / (2.0 * np.pi)
    return np.asarray(phase - turn)


# ----------------------------------------------------------------------
# Motion and jitter of a logged position, told apart by their spectrum.
#
# Motion of a heavy thing is slow, quantisation and tracking errors are spread over all frequencies. So the
# power density (Welch 1967) falls from the motion to a floor. Outliers are no jitter: samples beyond six
# standard deviations from the median of five (Hampel 1974) are replaced by it first. Of the segments'
# densities the mean holds motion however short it was, and the median P counts disturbances little. The
# motion ends at the last frequency f_m of the lower half of the band at which the mean is above six times its
# own floor. The jitter has the density
#
#     N(f) = F below f_m (motion hides it there),   N(f) = P(f) above,
#
# with F the median of P over the upper half. A filter H leaves the jitter sigma^2 = sum of N |H|^2 df.
# Where motion reaches a tenth of the rate, F may be its tail and not the jitter's: the spectrum is then
# called not flat, and a log at rest is needed.

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
    from scipy.ndimage import median_filter

    middle = np.asarray(median_filter(x, 5, mode="nearest"), dtype=np.float64)
    away = np.abs(x - middle)
    sigma = float(np.quantile(away, 0.95)) / 1.96
    out = away > _OUTLIER_SIGMAS * sigma if sigma > 0.0 else np.zeros(len(x), dtype=np.bool_)
    return np.where(out, middle, x), int(out.sum())


def _density(x: FloatArray, rate_hz: float, segment: int, average: Literal["mean", "median"]) -> FloatArray:
    from scipy.signal import detrend, welch

    _, P = welch(x - x.mean(), rate_hz, nperseg=segment, detrend=detrend, average=average)
    return np.asarray(P[1:-1], dtype=np.float64)


def _smoothed(P: FloatArray) -> FloatArray:
    """Running geometric mean of three, so that one low value does not end the motion."""
    tiny = np.finfo(np.float64).tiny
    padded = np.log(np.maximum(np.pad(P, 1, mode="edge"), tiny))
    return np.asarray(np.exp(np.convolve(padded, np.full(3, 1 / 3), mode="valid")))


def jitter_after(of: Spectrum, sections: FloatArray) -> float:
    """Standard deviation of the jitter behind a filter; the floor's part exactly, the rest by the sum."""
    H2 = np.abs(filters.frequency_response(sections, of.f_hz, of.rate_hz)) ** 2
    return math.sqrt(_jitter_power(of, H2, filters.noise_gain(sections)))


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
    H = filters.frequency_response(sections, of.f_hz, of.rate_hz)
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
    """Frequencies (3,) of the sawtooth that rounding adds to motion, quartiles of |speed| / step; else none.

    A marker that moves at w px/s crosses w / step grid lines a second. The speed (n,) is that of a cubic
    through half a second; what is slower than a line in two seconds is rest and not
    counted. Frequencies above half the rate are folded back.
    """
    from scipy.signal import savgol_filter

    window = max(5, int(0.5 * rate_hz) | 1)
    if step_px <= 0.0 or len(pixels) < window:
        return np.zeros(0)
    speed = np.abs(savgol_filter(pixels, window, 3, deriv=1, delta=1.0 / rate_hz))
    lines = speed[speed > 0.5 * step_px] / step_px
    if len(lines) == 0:
        return np.zeros(0)
    f = np.percentile(lines, [25.0, 50.0, 75.0])
    return np.asarray(np.abs((f + 0.5 * rate_hz) % rate_hz - 0.5 * rate_hz))


# ----------------------------------------------------------------------
# The low-pass of least delay that leaves no more than a wanted jitter.
#
# For every family and order the jitter behind the filter rises with the cut-off, so the highest cut-off that
# keeps it is found by bisection; of these filters the one with the least delay at zero frequency is
# suggested. In white jitter a filter of first order and every one with a single pair of poles have the same
# product of delay and noise bandwidth, 1/4, which sampling and a log's scatter part by some percent. So
# delays within 7 % count as equal: of those the one wins that changes the shape of the log's motion least
# (`motion_lost`), and without motion the one of lowest order.

_TIE = 0.07
_LOWEST = 1e-4
"""Lowest cut-off that is tried, in parts of the rate."""
_HIGHEST = 0.45
_SAME_SHAPE = 0.01
_HALVINGS = 16
"""Of the logarithm of the range: to 2 in ten thousand."""


@dataclass(frozen=True)
class Candidate:
    """A filter that leaves the wanted jitter.

    Attributes
    ----------
    filter : with a cut-off of three digits.
    delay_s : at zero frequency.
    jitter : standard deviation left, of the worse coordinate.
    motion_lost : share of the motion that does not arrive unchanged after this delay, of the worse one.
    """

    filter: Filter
    delay_s: float
    jitter: float
    motion_lost: float


@dataclass(frozen=True)
class Suggestion:
    """The filter to take, and the best of each family and order, least delay first."""

    best: Candidate
    candidates: tuple[Candidate, ...]


def _worst(spectra: Sequence[Spectrum], filter_: Filter) -> float:
    return max(jitter_after(one, filter_.exact) for one in spectra)


def _candidate(spectra: Sequence[Spectrum], wanted: float, order: int, family: str) -> Candidate | None:
    rate = spectra[0].rate_hz

    def at(cutoff_hz: float) -> Filter:
        return filters.design_lowpass(Design(cutoff_hz, rate, order, family))

    low, high = _LOWEST * rate, _HIGHEST * rate
    try:
        at(low)
    except BadInputError:
        # Single precision has no such slow filter of this order; the slowest it has lies above.
        low = 3e-3 * rate
    if _worst(spectra, at(low)) > wanted:
        return None
    if _worst(spectra, at(high)) > wanted:
        for _ in range(_HALVINGS):
            middle = math.sqrt(low * high)
            if _worst(spectra, at(middle)) > wanted:
                high = middle
            else:
                low = middle
    else:
        low = high
    filter_ = at(_three_digits_below(low))
    delay_s = filters.dc_delay_s(filter_.sections, rate)
    lost = max(motion_lost(one, filter_.sections, delay_s) for one in spectra)
    return Candidate(filter_, delay_s, _worst(spectra, filter_), lost)


def _three_digits_below(value: float) -> float:
    power = math.floor(math.log10(value)) - 2
    return float(f"{math.floor(value / 10.0**power * (1 + 1e-12))}e{power}")


def _amount(value: float, unit: str) -> str:
    return f"{1e3 * value:.3g} mm" if unit == "m" else f"{value:.3g} {unit}"


def suggest(
    spectra: Sequence[Spectrum],
    wanted: float,
    orders: Sequence[int] = (),
    families: Sequence[str] = (),
    unit: str = "m",
) -> Suggestion:
    """The filter of least delay for a jitter of at most `wanted`, in the spectra's unit.

    Parameters
    ----------
    spectra : of each coordinate, at the same rate; each has to keep to `wanted`.
    orders, families : to choose from; all where empty.
    unit : of the jitter, for messages.

    Raises
    ------
    BadInputError
        Where there is no jitter, not more than is wanted, or none of the filters leaves so little.
    """
    unfiltered = max(one.jitter for one in spectra)
    has, most = _amount(unfiltered, unit), _amount(wanted, unit)
    if unfiltered == 0.0:
        raise BadInputError("has no jitter at all: its values never change, or only so slowly as motion does")
    if wanted >= unfiltered:
        raise BadInputError(
            f"jitters by {has} unfiltered, not more than the {most} that is wanted; no low-pass is needed"
        )
    found = [
        _candidate(spectra, wanted, order, family)
        for order in (orders or range(1, filters.LARGEST_ORDER + 1))
        # The families differ from the second order on.
        for family in (families or (filters.FAMILIES if order > 1 or orders else filters.FAMILIES[:1]))
    ]
    candidates = sorted((one for one in found if one is not None), key=lambda one: one.delay_s)
    if not candidates:
        raise BadInputError(
            f"jitters by {has} unfiltered and no low-pass here leaves only {most}; ask for more"
        )
    tied = [one for one in candidates if one.delay_s <= (1.0 + _TIE) * candidates[0].delay_s]
    least = min(one.motion_lost for one in tied)
    same = [one for one in tied if one.motion_lost <= least + _SAME_SHAPE]
    best = min(same, key=lambda one: (one.filter.design.order, one.delay_s))
    return Suggestion(best, tuple(candidates))


@dataclass(frozen=True)
class Positions:
    """Where a log's camera saw the marker.

    Attributes
    ----------
    source : name for messages.
    unit : "m" on the plane where the rig has one, "px" otherwise. scale : to that of the file, mm or px.
    names : of the two coordinates.
    rate_hz : of the log.
    ticks : the coordinates (n, 2).
    pixels : the same in pixels, for the grid that they lie on.
    spectra : of each coordinate, over the longest piece.
    """

    source: str
    unit: str
    names: tuple[str, str]
    rate_hz: float
    ticks: Ticks
    pixels: Ticks
    spectra: tuple[Spectrum, Spectrum]

    @property
    def scale(self) -> float:
        """See above."""
        return 1e3 if self.unit == "m" else 1.0

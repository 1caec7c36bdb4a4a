"""Filters of sampled signals: design, response, rounding, choice, and the signals they are chosen for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from calib.core.arrays import ComplexArray, FloatArray
from calib.core.errors import BadInputError

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


def on_ticks(t_s: FloatArray, values: FloatArray, rate_hz: float) -> Ticks:
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
# Low-pass filters in second-order sections, with coefficients that binary32 holds exactly.
#
# The analogue prototype has its poles p_i normalised so that |H| = 1 / sqrt(2) at 1 rad/s. The bilinear
# transform with the cut-off kept, s = (1 / K) (z - 1) / (z + 1) and K = tan(pi f / rate), gives
#
#     z_i = (1 + K p_i) / (1 - K p_i)
#
# and as many zeros at z = -1. A pair of poles makes a section
#
#     H(z) = g (1 + 2 z^-1 + z^-2) / (1 + a1 z^-1 + a2 z^-2),   g = (1 + a1 + a2) / 4,
#
# a single one g (1 + z^-1) / (1 + a1 z^-1) with g = (1 + a1) / 2. First a1 and a2 are rounded, on a grid
# on which g is a binary32, too; then g follows from them. So H(1) is 1 and not nearly 1, the zeros stay
# at -1, and a position at rest is reported where it is. A pair of zeros +-j w of the prototype lies at
# 1 + c z^-1 + z^-2 with 2 + c = 4 K^2 w^2 / (1 + K^2 w^2), which takes the place of 4 in g.
#
# Families: Butterworth (flattest gain), Bessel (flattest delay, Thomson 1949), and critical: n equal real
# poles -1 / sqrt(2^(1/n) - 1), which never overshoot. Chebyshev's and the elliptic filters fall faster behind
# the cut-off and delay more: ripples of 0.5 dB below it (I, elliptic), 40 dB above it (II, elliptic).

FAMILIES = ("butterworth", "bessel", "critical")
LARGEST_ORDER = 8
_RIPPLE_DB, _STOP_DB = 0.5, 40.0

_FINEST, _COARSEST = 30, 22
"""Grids 2^-k that a1 and a2 are rounded to; on the coarsest g is a binary32 for every stable section."""


@dataclass(frozen=True)
class Design:
    """What a person chooses: -3 dB cut-off and sampling rate [Hz], order, family.

    Raises `BadInputError` for a cut-off outside (0, rate / 2) and an order outside 1 .. 8.
    """

    cutoff_hz: float = 1.0
    rate_hz: float = 60.0
    order: int = 1
    family: str = "butterworth"

    def __post_init__(self) -> None:
        if not 0.0 < self.cutoff_hz < 0.5 * self.rate_hz < math.inf:
            raise BadInputError(
                f"low-pass: the cut-off is {self.cutoff_hz:g} Hz at {self.rate_hz:g} samples/s, expected "
                f"one between zero and half the rate, {0.5 * self.rate_hz:g} Hz"
            )
        if not 1 <= self.order <= LARGEST_ORDER:
            raise BadInputError(f"low-pass: the order is {self.order}, expected 1 to {LARGEST_ORDER}")


@dataclass(frozen=True)
class Filter:
    """A designed filter.

    Attributes
    ----------
    design : what was asked for.
    exact : (k, 6) sections b0, b1, b2, 1, a1, a2 in double precision.
    sections : (k, 6) the same with values that binary32 holds exactly; each has a gain of exactly 1 at
        zero frequency. Slow poles come first; of an odd order the first section has b2 = a2 = 0.
    """

    design: Design
    exact: FloatArray = field(repr=False)
    sections: FloatArray = field(repr=False)

    @property
    def stable(self) -> bool:
        """Whether the rounded sections are: |a2| < 1 and |a1| < 1 + a2 (Jury), exactly."""
        a1, a2 = self.sections[:, 4], self.sections[:, 5]
        return bool(np.all(np.abs(a2) < 1.0) and np.all(np.abs(a1) < 1.0 + a2))

    @property
    def pole_radius(self) -> float:
        """Largest modulus of the rounded sections' poles."""
        return float(np.abs(digital_poles(self.sections)).max())


def prototype(family: str, order: int) -> tuple[FloatArray, ComplexArray]:
    """Zeros w (order // 2,) at +-j w, infinite for none, and poles (order,), with |H(j)| = 1 / sqrt(2)."""
    far = np.full(order // 2, np.inf)
    if family == "butterworth":
        angle = np.pi * (2.0 * np.arange(order) + order + 1.0) / (2.0 * order)
        return far, np.asarray(np.exp(1j * angle))
    if family == "critical":
        return far, np.full(order, -1.0 / math.sqrt(math.expm1(math.log(2.0) / order)), dtype=np.complex128)
    from scipy.optimize import brentq
    from scipy.signal import besselap, cheb1ap, cheb2ap, ellipap

    if family == "bessel":
        return far, np.asarray(besselap(order, norm="mag")[1], dtype=np.complex128)
    designs: dict[str, Callable[[], Any]] = {
        "chebyshev1": lambda: cheb1ap(order, _RIPPLE_DB),
        "chebyshev2": lambda: cheb2ap(order, _STOP_DB),
        "elliptic": lambda: ellipap(order, _RIPPLE_DB, _STOP_DB),
    }
    zeros, poles, _ = designs[family]()
    w: FloatArray = np.sort(np.imag(zeros)[np.imag(zeros) > 0.0])

    def above_half(at: float) -> float:
        return float(np.prod(1.0 - (at / w) ** 2) / np.abs(np.prod(1.0 - 1j * at / poles))) ** 2 - 0.5

    # The gain falls from the ripples' end at 1, or from 0, to the first zero.
    cut = float(brentq(above_half, 0.0 if family == "chebyshev2" else 1.0, w[0] if len(w) else 1e3))
    return (w / cut if len(w) else far), np.atleast_1d(poles / cut).astype(np.complex128)


def digital_poles(sections: FloatArray) -> ComplexArray:
    """Poles of sections (k, 6) in the z plane, two of each, one of a section with a2 = 0."""
    found: list[ComplexArray] = []
    for section in sections:
        last = 6 if section[5] != 0.0 else 5
        found.append(np.asarray(np.roots(section[3:last]), dtype=np.complex128))
    return np.concatenate(found)


def _placed(design: Design) -> list[tuple[float, float | None, float]]:
    """a1, a2 and 2 + c of each section, a2 None for a single pole; slow poles first."""
    K = math.tan(math.pi * design.cutoff_hz / design.rate_hz)
    zeros, poles = prototype(design.family, design.order)
    upper = poles[poles.imag > 1e-9]
    real = poles[np.abs(poles.imag) <= 1e-9].real
    pairs = [
        (float(-2.0 * (1.0 - w) / (1.0 - q + w)), float((1.0 + q + w) / (1.0 - q + w)))
        for q, w in ((2.0 * K * p.real, K * K * abs(p) ** 2) for p in upper[np.argsort(-upper.real)])
    ]
    single = [(1.0 + K * float(p)) / (1.0 - K * float(p)) for p in real]
    pairs += [
        (-(single[i] + single[i + 1]), single[i] * single[i + 1])
        for i in range(len(single) % 2, len(single), 2)
    ]
    across = (4.0 / (1.0 + (K * zeros) ** -2.0)).tolist()
    first: list[tuple[float, float | None, float]] = [(-single[0], None, 4.0)] if len(single) % 2 else []
    return first + [(*pair, one) for pair, one in zip(pairs, across, strict=True)]


def _section(a1: float, a2: float | None, across: float, places: int | None = None) -> list[float]:
    """b0, b1, b2, 1, a1, a2; with `places` a1 and a2 are rounded, and b0 where it does not follow."""
    if places is not None:
        a1, a2 = _on_grid(a1, places), None if a2 is None else _on_grid(a2, places)
    if a2 is None:
        g = 0.5 * (1.0 + a1)
        return [g, g, 0.0, 1.0, a1, 0.0]
    g = (1.0 + a1 + a2) / across
    if places is not None and across != 4.0:
        g = _on_grid(g, places)
    return [g, 1.0 + a1 + a2 - 2.0 * g, g, 1.0, a1, a2]


def _rounded_section(a1: float, a2: float | None, across: float) -> list[float]:
    """The section whose every coefficient is a binary32; sums of multiples of 2^-30 are exact here."""
    section: list[float] = []
    for places in range(_FINEST, _COARSEST - 1, -1):
        section = _section(a1, a2, across, places)
        if all(float(np.float32(b)) == b for b in section[:2]):
            break
    return section


def _on_grid(value: float, places: int) -> float:
    return float(np.float32(math.ldexp(round(math.ldexp(value, places)), -places)))


def design_lowpass(design: Design) -> Filter:
    """The filter, exact and rounded.

    Raises `BadInputError` where no rounded filter is stable: the cut-off is too low for the rate.
    """
    placed = _placed(design)
    out = Filter(
        design,
        np.array([_section(*one) for one in placed]),
        np.array([_rounded_section(*one) for one in placed]),
    )
    if not out.stable:
        raise BadInputError(
            f"low-pass: with coefficients of single precision a cut-off of {design.cutoff_hz:g} Hz at "
            f"{design.rate_hz:g} samples/s and order {design.order} is not stable, expected a higher "
            "cut-off, a lower rate or a lower order"
        )
    return out


# ----------------------------------------------------------------------
# What a low-pass does to a signal: gain, delay, step response, noise, and filtering itself.
#
# All sections (k, 6) have a gain of 1 at zero frequency and a numerator of order n that reads the same from
# both ends, which delays every frequency by n / 2 samples. With D(z) = 1 + a1 z^-1 + a2 z^-2 the group delay
# of a section is
#
#     tau = n / 2 - Re[ (a1 z^-1 + 2 a2 z^-2) / D(z) ],   n / 2 - (a1 + 2 a2) / (1 + a1 + a2) at 0 Hz.
#
# Signals are filtered in the transposed direct form II,
#
#     y = b0 x + s1,   s1' = b1 x - a1 y + s2,   s2' = b2 x - a2 y,
#
# started from s1 = (1 - b0) x_0, s2 = (b2 - a2) x_0 as if x_0 had been there for ever: no transient.

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


def _z(f_hz: FloatArray, rate_hz: float) -> ComplexArray:
    return np.asarray(np.exp(-2j * np.pi * np.asarray(f_hz) / rate_hz))


def frequency_response(sections: FloatArray, f_hz: FloatArray, rate_hz: float) -> ComplexArray:
    """H (n,) at frequencies (n,) [Hz] of sections (k, 6)."""
    z = _z(f_hz, rate_hz)
    H = np.ones(z.shape, dtype=np.complex128)
    for b0, b1, b2, _, a1, a2 in sections:
        H *= (b0 + z * (b1 + z * b2)) / (1.0 + z * (a1 + z * a2))
    return H


def decibels(H: ComplexArray) -> FloatArray:
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
    from scipy.optimize import brentq

    def above_half(f: float) -> float:
        return float(np.abs(frequency_response(sections, np.array([f]), rate_hz)[0])) ** 2 - 0.5

    return float(brentq(above_half, 0.0, 0.5 * rate_hz, xtol=1e-15 * rate_hz, rtol=1e-12))


def settled_state(sections: FloatArray, first: FloatArray) -> FloatArray:
    """State (k, 2, ...) after `first` (...) has been the input for ever."""
    state = np.stack([1.0 - sections[:, 0], sections[:, 2] - sections[:, 5]], axis=1)
    return np.asarray(state.reshape(*state.shape, *([1] * np.ndim(first))) * first)


def filter_signal(sections: FloatArray, x: FloatArray) -> FloatArray:
    """Filtered signal (n, ...), n > 0, along the first axis, started without a transient; `x` has no NaN."""
    from scipy.signal import sosfilt

    y, _ = sosfilt(sections, x, axis=0, zi=settled_state(sections, np.asarray(x[0])))
    return np.asarray(y, dtype=np.float64)


def step_response(sections: FloatArray, rate_hz: float) -> StepResponse:
    """Answer to a step, as long as it takes to settle to a thousandth."""
    from scipy.signal import sosfilt

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
    from scipy.linalg import solve_discrete_lyapunov

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
# How far from a constant input the filter comes to rest in binary32, in the forms that the firmware runs:
#
#     pair:    v3 = x - s2, v1 = A1 s1 + A2 v3, v2 = s2 + (A2 s1 + A3 v3), s1' = 2 v1 - s1, s2' = 2 v2 - s2,
#              y = v2 + Z (v1 - s1), A3 = (1 + a1 + a2) / 4, A1 = A3 - a1 / 2, A2 = sqrt(A1 A3),
#              Z = (b0 - A3) / A2 for zeros that are not at z = -1
#     single:  v = b0 (x - s), y = s + v, s' = y + v
#
# Both work on the difference of input and output, so that a slow filter rests within a step of binary32,
# where the direct form of the same coefficients stays off by the step over 1 + a1 + a2 (Jackson 1970).

_STARTS = 16
_LONGEST = 20_000


def state_variable_gains(a1: float, a2: float, b0: float) -> list[float]:
    """A1, A2, A3 and Z of a pair (Simper 2013)."""
    A3 = 0.25 * (1.0 + a1 + a2)
    A1 = A3 - 0.5 * a1
    A2 = math.sqrt(A1 * A3)
    return [A1, A2, A3, (b0 - A3) / A2]


def rest_error_binary32(filter_: Filter) -> float:
    """Largest distance from 1 at which the filter comes to rest in binary32, from starts around 1.

    Relative: at a position of 0.1 m the distance is a tenth of it in metres.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    starts = np.linspace(0.0, 2.0, _STARTS, dtype=np.float32)
    y, state = starts, [[np.zeros_like(starts), starts] for _ in filter_.sections]
    # The firmware's order: pairs first.
    rows = filter_.sections[np.argsort(filter_.sections[:, 5] == 0.0, kind="stable")]
    forms = [
        [np.float32(x) for x in (state_variable_gains(a1, a2, b0) if a2 != 0.0 else [b0])]
        for b0, _, _, _, a1, a2 in rows.tolist()
    ]
    slowest = float(np.abs(digital_poles(filter_.sections)).max())
    for _ in range(int(min(25.0 / max(1.0 - slowest, 1e-6) + 200, _LONGEST))):
        y = np.full_like(starts, one)
        for form, s in zip(forms, state, strict=True):
            if len(form) == 1:
                v = form[0] * (y - s[1])
                y = s[1] + v
                s[1] = y + v
                continue
            A1, A2, A3, Z = form
            v3 = y - s[1]
            v1 = A1 * s[0] + A2 * v3
            v2 = s[1] + (A2 * s[0] + A3 * v3)
            y = np.asarray(v2 + Z * (v1 - s[0]))
            s[0], s[1] = two * v1 - s[0], two * v2 - s[1]
    return float(np.abs(y.astype(np.float64) - 1.0).max())


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
        return design_lowpass(Design(cutoff_hz, rate, order, family))

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
    delay_s = dc_delay_s(filter_.sections, rate)
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
        for order in (orders or range(1, LARGEST_ORDER + 1))
        # The families differ from the second order on.
        for family in (families or (FAMILIES if order > 1 or orders else FAMILIES[:1]))
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

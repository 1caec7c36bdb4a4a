"""Low-pass filters of sampled signals: design, response, and what single precision makes of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.core.arrays import ComplexArray, FloatArray
from calib.core.errors import BadInputError

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


def _place_sections(design: Design) -> list[tuple[float, float | None, float]]:
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
        a1, a2 = _round_to_grid(a1, places), None if a2 is None else _round_to_grid(a2, places)
    if a2 is None:
        g = 0.5 * (1.0 + a1)
        return [g, g, 0.0, 1.0, a1, 0.0]
    g = (1.0 + a1 + a2) / across
    if places is not None and across != 4.0:
        g = _round_to_grid(g, places)
    return [g, 1.0 + a1 + a2 - 2.0 * g, g, 1.0, a1, a2]


def _rounded_section(a1: float, a2: float | None, across: float) -> list[float]:
    """The section whose every coefficient is a binary32; sums of multiples of 2^-30 are exact here."""
    section: list[float] = []
    for places in range(_FINEST, _COARSEST - 1, -1):
        section = _section(a1, a2, across, places)
        if all(float(np.float32(b)) == b for b in section[:2]):
            break
    return section


def _round_to_grid(value: float, places: int) -> float:
    return float(np.float32(math.ldexp(round(math.ldexp(value, places)), -places)))


def design_lowpass(design: Design) -> Filter:
    """The filter, exact and rounded.

    Raises `BadInputError` where no rounded filter is stable: the cut-off is too low for the rate.
    """
    placed = _place_sections(design)
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

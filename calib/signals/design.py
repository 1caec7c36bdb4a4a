"""Low-pass filters in second-order sections, with coefficients that binary32 holds exactly.

The analogue prototype has its poles p_i normalised so that |H| = 1 / sqrt(2) at 1 rad/s. The bilinear
transform with the cut-off kept, s = (1 / K) (z - 1) / (z + 1) and K = tan(pi f / rate), gives

    z_i = (1 + K p_i) / (1 - K p_i)

and as many zeros at z = -1. A pair of poles makes a section

    H(z) = g (1 + 2 z^-1 + z^-2) / (1 + a1 z^-1 + a2 z^-2),   g = (1 + a1 + a2) / 4,

a single one g (1 + z^-1) / (1 + a1 z^-1) with g = (1 + a1) / 2. First a1 and a2 are rounded, on a grid
on which g is a binary32, too; then g follows from them. So H(1) is 1 and not nearly 1, the zeros stay
at -1, and a position at rest is reported where it is.

Families: Butterworth (flattest gain), Bessel (flattest delay, Thomson 1949), and critical: n equal real
poles -1 / sqrt(2^(1/n) - 1), which never overshoot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import ComplexArray, FloatArray
from calib.errors import BadInputError

__all__ = [
    "FAMILIES",
    "LARGEST_ORDER",
    "Design",
    "Filter",
    "analogue_poles",
    "design_lowpass",
    "digital_poles",
]

FAMILIES = ("butterworth", "bessel", "critical")
LARGEST_ORDER = 8

_FINEST, _COARSEST = 30, 22
"""Grids 2^-k that a1 and a2 are rounded to; on the coarsest g is a binary32 for every stable section."""


@dataclass(frozen=True)
class Design:
    """What a person chooses: -3 dB cut-off and sampling rate [Hz], order, family.

    Raises `BadInputError` for a cut-off outside (0, rate / 2), an order outside 1 .. 8, and an unknown
    family.
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
        if self.family not in FAMILIES:
            raise BadInputError(
                f"low-pass: the family is {self.family!r}, expected one of {', '.join(FAMILIES)}"
            )


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


def analogue_poles(family: str, order: int) -> ComplexArray:
    """Poles (order,) of the prototype with |H| = 1 / sqrt(2) at 1 rad/s."""
    if family == "butterworth":
        angle = np.pi * (2.0 * np.arange(order) + order + 1.0) / (2.0 * order)
        return np.asarray(np.exp(1j * angle))
    if family == "critical":
        return np.full(order, -1.0 / math.sqrt(math.expm1(math.log(2.0) / order)), dtype=np.complex128)
    # Reverse Bessel polynomial: theta_n(s) = sum of (2n - k)! / (2^(n-k) k! (n-k)!) s^k.
    rising = [
        math.factorial(2 * order - k) // (2 ** (order - k) * math.factorial(k) * math.factorial(order - k))
        for k in range(order + 1)
    ]
    poles = np.roots(np.array(rising[::-1], dtype=np.float64)).astype(np.complex128)
    return np.asarray(poles / _half_power_frequency(poles), dtype=np.complex128)


def _half_power_frequency(poles: ComplexArray) -> float:
    """Frequency [rad/s] at which an all-pole filter of unit gain has half its power, by bisection."""

    def power(w: float) -> float:
        return float(np.prod(np.abs(poles) ** 2 / np.abs(1j * w - poles) ** 2))

    low, high = 0.0, 2.0 * float(np.abs(poles).max())
    for _ in range(200):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (middle, high) if power(middle) > 0.5 else (low, middle)
    return 0.5 * (low + high)


def digital_poles(sections: FloatArray) -> ComplexArray:
    """Poles of sections (k, 6) in the z plane, two of each, one of a section with a2 = 0."""
    found: list[ComplexArray] = []
    for section in sections:
        last = 6 if section[5] != 0.0 else 5
        found.append(np.asarray(np.roots(section[3:last]), dtype=np.complex128))
    return np.concatenate(found)


def _denominators(design: Design) -> list[tuple[float, float | None]]:
    """a1 and a2 of each section, a2 None for a single pole; slow poles first."""
    K = math.tan(math.pi * design.cutoff_hz / design.rate_hz)
    poles = analogue_poles(design.family, design.order)
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
    first: list[tuple[float, float | None]] = [(-single[0], None)] if len(single) % 2 else []
    return first + pairs


def _section(a1: float, a2: float | None) -> list[float]:
    if a2 is None:
        g = 0.5 * (1.0 + a1)
        return [g, g, 0.0, 1.0, a1, 0.0]
    g = 0.25 * (1.0 + a1 + a2)
    return [g, 2.0 * g, g, 1.0, a1, a2]


def _rounded_section(a1: float, a2: float | None) -> list[float]:
    """The section whose every coefficient is a binary32; sums of multiples of 2^-30 are exact here."""
    section: list[float] = []
    for places in range(_FINEST, _COARSEST - 1, -1):
        section = _section(_on_grid(a1, places), None if a2 is None else _on_grid(a2, places))
        if float(np.float32(section[0])) == section[0]:
            break
    return section


def _on_grid(value: float, places: int) -> float:
    return float(np.float32(math.ldexp(round(math.ldexp(value, places)), -places)))


def design_lowpass(design: Design) -> Filter:
    """The filter, exact and rounded.

    Raises `BadInputError` where no rounded filter is stable: the cut-off is too low for the rate.
    """
    denominators = _denominators(design)
    out = Filter(
        design,
        np.array([_section(a1, a2) for a1, a2 in denominators]),
        np.array([_rounded_section(a1, a2) for a1, a2 in denominators]),
    )
    if not out.stable:
        raise BadInputError(
            f"low-pass: with coefficients of single precision a cut-off of {design.cutoff_hz:g} Hz at "
            f"{design.rate_hz:g} samples/s and order {design.order} is not stable, expected a higher "
            "cut-off, a lower rate or a lower order"
        )
    return out

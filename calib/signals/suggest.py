"""The low-pass of least delay that leaves no more than a wanted jitter.

For every family and order the jitter behind the filter rises with the cut-off, so the highest cut-off that
keeps it is found by bisection; of these filters the one with the least delay at zero frequency is
suggested. In white jitter a filter of first order and every one with a single pair of poles have
the same product of delay and noise bandwidth, 1/4, which sampling and a log's scatter part by some
percent. So delays within 7 % count as equal: of those the one wins that changes the shape of the log's
motion least (`calib.signals.spectrum.motion_lost`), and without motion the one of lowest order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from calib.errors import BadInputError
from calib.signals.design import FAMILIES, LARGEST_ORDER, Design, Filter, design_lowpass
from calib.signals.response import dc_delay_s
from calib.signals.spectrum import Spectrum, jitter_after, motion_lost

__all__ = ["Candidate", "Suggestion", "suggest"]

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

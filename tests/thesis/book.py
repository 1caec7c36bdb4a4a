"""The book: all claims in the order of the source, and the table of what came of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from thesis import (
    claims_camera,
    claims_control,
    claims_dynamics,
    claims_filters,
    claims_fit,
    claims_imu,
    claims_kinematics,
    claims_pump,
    claims_setpoints,
)
from thesis.outcome import BASES, Claim, Finding, Outcome

__all__ = ["BOOK", "Examined", "by_basis", "count", "examine", "rows", "select"]

BOOK: tuple[Claim, ...] = (
    *claims_imu.CLAIMS,
    *claims_camera.CLAIMS,
    *claims_filters.CLAIMS,
    *claims_pump.STATIC,
    *claims_kinematics.CLAIMS,
    *claims_dynamics.CLAIMS,
    *claims_fit.CLAIMS,
    *claims_pump.DYNAMIC,
    *claims_control.CLAIMS,
    *claims_setpoints.CLAIMS,
)
"""Every claim once."""


@dataclass(frozen=True)
class Examined:
    """A claim and what came of it."""

    claim: Claim
    finding: Finding


def select(words: Sequence[str]) -> tuple[Claim, ...]:
    """Claims whose name begins with one of the words, all without words."""
    if not words:
        return BOOK
    return tuple(one for one in BOOK if one.id.startswith(tuple(words)))


def examine(
    claims: Iterable[Claim] = BOOK, progress: Callable[[int, int], None] | None = None
) -> tuple[Examined, ...]:
    """Compute claims, one after the other; nothing is remembered from an earlier run of the program."""
    chosen, out = tuple(claims), []
    for done, one in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen))
        out.append(Examined(one, one.check()))
    return tuple(out)


def count(examined: Iterable[Examined]) -> dict[Outcome, int]:
    """How many claims came to each outcome, those without any too."""
    found = Counter(one.finding.outcome for one in examined)
    return {outcome: found[outcome] for outcome in Outcome}


def by_basis(examined: Iterable[Examined]) -> dict[str, dict[Outcome, int]]:
    """How many claims of each basis came to each outcome."""
    found = tuple(examined)
    return {basis: count(one for one in found if one.claim.basis == basis) for basis in BASES}


def rows(examined: Iterable[Examined]) -> list[dict[str, str | bool | Mapping[str, float]]]:
    """The table as plain values, for a JSON document or a page."""
    return [
        {
            "id": one.claim.id,
            "where": one.claim.where,
            "claim": one.claim.says,
            "printed": one.claim.printed,
            "kind": one.claim.kind,
            "basis": one.claim.basis,
            "ours": one.finding.ours,
            "simulated": one.finding.simulated,
            "outcome": one.finding.outcome.value,
            "how": one.finding.how,
            "numbers": dict(one.finding.numbers),
        }
        for one in examined
    ]

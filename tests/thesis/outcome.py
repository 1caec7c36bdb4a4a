"""What a claim is, and what can come of computing it again.

A claim is a statement of the source that a computation can touch, with one small function that computes
it. Its kind says what that takes:

    math    follows from the equations alone
    plant   needs the actuator; the simulated rig stands in for it
    data    needs measurements of the source that are not published

What comes of it is one of three. Of a claim about the plant, `reproduced` means that the simulated rig
shows it, within `TWIN_TOLERANCE` where it is a number; what it does not show is not thereby wrong, only
not reproducible.

How much that is worth depends on what our figure rests on, its basis:

    equations   an identity, a series or a limit; no number of any rig
    printed     arithmetic on numbers that the source prints
    twin        a run or a sensor of the simulated rig, with other figures fixed beforehand
    chosen      the same, but this very figure was put in or looked at when the rig's nominal parameters
                were chosen: it shows that the text agrees with one model, and is no evidence for either
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum

__all__ = [
    "BASES",
    "KINDS",
    "TWIN_TOLERANCE",
    "Claim",
    "Finding",
    "Outcome",
    "claim",
    "exactly",
    "near",
    "on_twin",
]

TWIN_TOLERANCE = 0.10
"""Share by which a figure of the simulated rig may differ from the printed one to count as reproduced."""

KINDS = ("math", "plant", "data")

BASES = ("equations", "printed", "twin", "chosen")


class Outcome(Enum):
    """What came of computing a claim again."""

    REPRODUCED = "reproduced"
    REFUTED = "refuted"
    UNMEASURED = "not reproducible without its measurements"


@dataclass(frozen=True)
class Finding:
    """Result of a claim's computation.

    Attributes
    ----------
    ours : our figure, as it is read. how : the computation and what follows from it, in words.
    numbers : the same figures by name, SI units or those of the name.
    simulated : whether ours comes from a run or a sensor of the simulated rig.
    """

    ours: str
    outcome: Outcome
    how: str
    numbers: Mapping[str, float] = field(default_factory=dict)
    simulated: bool = False


@dataclass(frozen=True)
class Claim:
    """One statement of the source.

    Attributes
    ----------
    id : name in the list of claims. where : section, equation or figure.
    says : what is claimed. printed : the figure as printed, "-" without one.
    kind : of `KINDS`. basis : of `BASES`. check : computes it.
    """

    id: str
    where: str
    says: str
    printed: str
    kind: str
    basis: str
    check: Callable[[], Finding]


def claim(
    name: str, where: str, says: str, printed: str = "-", kind: str = "math", *, basis: str
) -> Callable[[Callable[[], Finding]], Claim]:
    """Turn a function that computes a statement into the `Claim`."""

    def made(check: Callable[[], Finding]) -> Claim:
        return Claim(name, where, says, printed, kind, basis, check)

    return made


def exactly(holds: bool) -> Outcome:
    """Reproduced or refuted."""
    return Outcome.REPRODUCED if holds else Outcome.REFUTED


def on_twin(shown: bool) -> Outcome:
    """Reproduced when the simulated rig shows it, otherwise open."""
    return Outcome.REPRODUCED if shown else Outcome.UNMEASURED


def near(ours: float | None, printed: float, share: float = TWIN_TOLERANCE) -> bool:
    """Whether a figure is within a share of the printed one."""
    return ours is not None and abs(ours - printed) <= share * abs(printed)

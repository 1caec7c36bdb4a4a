"""The book: every claim of the source with what came of computing it again, and the words of its figures.

thesis.yaml states the claims and what has to hold for each within which tolerance; the functions of
`sensing`, `mechanics` and `control` compute values; the outcome follows from both by `outcome_of`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.core.plot import Plot
from thesis import control, mechanics, sensing
from thesis.plot import curves_of
from thesis.runs import Values

KINDS = ("math", "plant", "data")
BASES = {
    "equations": "from the equations alone",
    "printed": "from printed numbers",
    "twin": "on the simulated rig, with other figures fixed beforehand",
    "chosen": "with a value that was chosen by this very figure",
}
_CONDITION = re.compile(r"(?:([<>]) )?(\S+?)(?: \+- (\S+?)( %)?)?")


class Outcome(Enum):
    """What came of computing a claim again."""

    REPRODUCED = "reproduced"
    REFUTED = "refuted"
    CONSTRUCTED = "consistent by construction"
    UNMEASURED = "not reproducible without its measurements"


@dataclass(frozen=True)
class Claim:
    """One statement of the source; thesis.yaml says what the fields are."""

    id: str
    where: str
    statement: str
    kind: str
    basis: str
    ours: str
    how: str
    printed: str = "-"
    expect: Mapping[str, str | float] = field(default_factory=dict)
    tolerance: str = ""


@dataclass(frozen=True)
class Examined:
    """A claim, the values of its computation and what came of it; `ours` and `how` are the words for it."""

    claim: Claim
    values: Values
    outcome: Outcome
    ours: str
    how: str


@dataclass(frozen=True)
class Drawing:
    """The words of a figure; thesis.yaml says what the fields are."""

    number: str
    file: str
    title: str
    source: str
    note: str
    boxes: Sequence[Any] = ()
    sums: Sequence[Any] = ()
    wires: Sequence[Any] = ()

    @property
    def path(self) -> str:
        """Name of its file, such as figure_3_12_bellows_after_release.svg."""
        return f"figure_{self.number.replace('.', '_')}_{self.file}.svg"

    def make(self) -> tuple[Plot | None, Values]:
        """Its curves, None for a scheme, and the values in its words."""
        plot, values = _computed(f"figure_{self.number.replace('.', '_')}")
        return plot, values


def _computed(name: str) -> Any:
    (function,) = (getattr(one, name) for one in (sensing, mechanics, control) if hasattr(one, name))
    return function()


def holds(condition: str | float, value: float) -> bool:
    """Whether a value meets a condition: `5`, `5 +- 0.1`, `5 +- 10 %`, `< 5` or `> 5`; `1/60` is a number."""
    match = _CONDITION.fullmatch(str(condition))
    if match is None:
        raise ValueError(f"condition {condition!r}: expected such as '5 +- 10 %' or '< 5'")
    sign, number, off, percent = match.groups()
    bound = float(Fraction(number))
    if sign:
        return value < bound if sign == "<" else value > bound
    return abs(value - bound) <= float(off or 0.0) * (0.01 * abs(bound) if percent else 1.0)


def outcome_of(claim: Claim, values: Values) -> Outcome:
    """What came of a claim.

    What was chosen to come out neither proves nor refutes a text. Nor does a simulated rig refute what was
    seen on another one; it can only not show it.
    """
    if not claim.expect:
        return Outcome.UNMEASURED
    if all(holds(condition, float(values[name])) for name, condition in claim.expect.items()):
        return Outcome.CONSTRUCTED if claim.basis == "chosen" else Outcome.REPRODUCED
    of_text = claim.basis in ("equations", "printed") or (claim.basis == "twin" and claim.kind == "math")
    return Outcome.REFUTED if of_text else Outcome.UNMEASURED


def examine(claim: Claim) -> Examined:
    """Compute a claim."""
    values: Values = _computed(claim.id.replace(".", "_"))
    simulated = claim.basis == "twin" or (claim.basis == "chosen" and claim.kind != "math")
    ours = claim.ours.format(**values) + (" (simulated)" if simulated else "")
    return Examined(claim, values, outcome_of(claim, values), ours, claim.how.format(**values))


def _read() -> tuple[tuple[Claim, ...], tuple[Drawing, ...]]:
    text = yaml.safe_load(Path(__file__).with_name("thesis.yaml").read_text(encoding="utf-8"))
    return tuple(Claim(**one) for one in text["claims"]), tuple(Drawing(**one) for one in text["figures"])


BOOK, ALBUM = _read()
"""Every claim and every figure once, in the order of the source."""


def select(words: Sequence[str]) -> tuple[Claim, ...]:
    """Claims whose name begins with one of the words, all without words."""
    return tuple(one for one in BOOK if not words or one.id.startswith(tuple(words)))


def counted(examined: Iterable[Examined]) -> str:
    """How many claims came to each outcome, in words."""
    numbers = Counter(one.outcome for one in examined)
    return ", ".join(f"{numbers[outcome]} {outcome.value}" for outcome in Outcome if numbers[outcome])


def row(one: Examined) -> dict[str, Any]:
    """A claim as plain values, for a JSON document."""
    claim = one.claim
    return {
        "id": claim.id,
        "where": claim.where,
        "claim": claim.statement,
        "printed": claim.printed,
        "kind": claim.kind,
        "basis": claim.basis,
        "expected": dict(claim.expect),
        "tolerance": claim.tolerance,
        "values": one.values,
        "ours": one.ours,
        "outcome": one.outcome.value,
        "how": one.how,
    }


def words(examined: Sequence[Examined]) -> list[str]:
    """The table of claims, the computation of each, and the sums, line by line."""
    cells = [("claim", "where", "kind", "basis", "outcome", "our figure")]
    cells += [
        (e.claim.id, e.claim.where, e.claim.kind, e.claim.basis, e.outcome.value, e.ours) for e in examined
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    for one in examined:
        printed = "" if one.claim.printed == "-" else f"; printed: {one.claim.printed}"
        lines.append(f"{one.claim.id}: {one.claim.statement}{printed}")
        if one.claim.expect:
            expected = ", ".join(f"{name} {condition}" for name, condition in one.claim.expect.items())
            lines.append(f"  expected: {expected}; tolerance: {one.claim.tolerance}")
        lines.append(f"  {one.outcome.value}: {one.how}")
    lines.append(f"{len(examined)} of {len(BOOK)} claims: {counted(examined)}")
    for basis, meaning in BASES.items():
        some = [one for one in examined if one.claim.basis == basis]
        if some:
            lines.append(f"  {len(some):2d} {meaning}: {counted(some)}")
    return lines


def golden_figure(plot: Plot | None, values: Values) -> dict[str, Any]:
    """What a test holds of a figure: its values, and of each curve the size and means of x, y and |y|."""
    curves = [] if plot is None else curves_of(plot)
    means = [[float(np.nanmean(v)) for v in (curve.x, curve.y, np.abs(curve.y))] for curve in curves]
    return {"values": values, "curves": [[len(c.x), *mean] for c, mean in zip(curves, means, strict=True)]}


def golden() -> dict[str, Any]:
    """What tests hold of the whole book."""
    return {
        "claims": {e.claim.id: {"outcome": e.outcome.value, "values": e.values} for e in map(examine, BOOK)},
        "figures": {one.number: golden_figure(*one.make()) for one in ALBUM},
    }

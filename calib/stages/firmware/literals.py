"""Numbers as literals of C, text that cannot leave a comment, and the named values of a header.

A header is a list of groups; a group holds constants that belong together, with lines of comment before
them. Literals have nine significant digits, which is enough for any binary32.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calib.core.errors import BadInputError

_SMALLEST_NORMAL = 1.1754943508222875e-38
_LARGEST = 3.4028234663852886e38


@dataclass(frozen=True)
class Constant:
    """A float macro: its name, value, and what a reader has to know (unit, range, source, sign)."""

    name: str
    value: float
    comment: str


@dataclass(frozen=True)
class Whole:
    """An integer macro, which #if can compare."""

    name: str
    value: int
    comment: str


@dataclass(frozen=True)
class Table:
    """A float array that code indexes, `static const`."""

    name: str
    values: tuple[float, ...]
    comment: str


@dataclass(frozen=True)
class Macro:
    """A macro made of others; it has no value of its own."""

    name: str
    body: str
    comment: str


Item = Constant | Whole | Table | Macro


@dataclass(frozen=True)
class Group:
    """Constants that belong together.

    Attributes
    ----------
    notes : lines of the comment before them, the first one the title.
    defaults : says which of them rig.yaml does not have; empty where it has all.
    """

    notes: tuple[str, ...]
    items: tuple[Item, ...]
    defaults: str = ""


def float_literal(value: float, key: str) -> str:
    """A C literal that a compiler reads back as the binary32 nearest to `value`.

    Nine significant digits are enough for any binary32. Raises `BadInputError` for NaN, infinity,
    and magnitudes that binary32 holds only as subnormal or not at all; `key` names the value.
    """
    if not math.isfinite(value) or abs(value) > _LARGEST:
        raise BadInputError(f"{key} is {value!r}, which no float constant of C can hold")
    if value != 0.0 and abs(value) < _SMALLEST_NORMAL:
        raise BadInputError(f"{key} is {value!r}, too small for a normal float; set it to zero")
    # No sign on zero: -0.0 would tell two headers of the same rig apart.
    text = f"{float(np.float32(value)) + 0.0:.9g}"
    if not any(c in text for c in ".e"):
        text += ".0"
    elif "." not in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}.0e{exponent}"
    return text + "f"


def comment_text(text: str) -> str:
    """Text that cannot end a C comment or start a trigraph, whatever it was: one line of ASCII."""
    plain = text.encode("unicode_escape").decode("ascii")
    # A backslash would continue a line or, with trigraphs, mean something else.
    return plain.replace("\\", "|").replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def _of_item(item: Item) -> Iterator[tuple[str, str]]:
    if isinstance(item, Table):
        for i, value in enumerate(item.values):
            yield f"{item.name}[{i}]", float_literal(value, f"{item.name}[{i}]")
    elif isinstance(item, Whole):
        yield item.name, str(item.value)
    elif isinstance(item, Constant):
        yield item.name, float_literal(item.value, item.name)


def literals(groups: tuple[Group, ...]) -> dict[str, str]:
    """Every value as it stands in the header by name, entries of a table as NAME[i].

    Raises `BadInputError` for what a float cannot hold.
    """
    return {name: text for group in groups for item in group.items for name, text in _of_item(item)}


def values(literal: Mapping[str, str]) -> dict[str, float]:
    """What a compiler makes of the literals: binary32 values as Python floats."""
    return {
        name: float(np.float32(text[:-1])) if text.endswith("f") else float(int(text))
        for name, text in literal.items()
    }

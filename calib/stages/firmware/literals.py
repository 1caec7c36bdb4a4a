"""Numbers as literals of C, text that cannot leave a comment, and the values that stand in a header.

Literals have nine significant digits, which is enough for any binary32.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from calib.core.errors import BadInputError

_SMALLEST_NORMAL = 1.1754943508222875e-38
_CONSTANT = re.compile(
    r"^#define (CALIB_\w+) (\S+) /\*|^static const float (\w+)\[\d+\] CALIB_IN_FLASH = \{([^}]*)\}", re.M
)


def float_literal(value: float) -> str:
    """A C literal that a compiler reads back as the binary32 nearest to `value`."""
    with np.errstate(over="ignore"):
        # No sign on zero: -0.0 would tell two headers of the same rig apart.
        text = f"{float(np.float32(value)) + 0.0:.9g}"
    if not any(c in text for c in ".en"):
        text += ".0"
    elif "e" in text and "." not in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}.0e{exponent}"
    return text + "f"


def comment_text(text: str) -> str:
    """Text that cannot end a C comment or start a trigraph, whatever it was: one line of ASCII."""
    plain = text.encode("unicode_escape").decode("ascii")
    # A backslash would continue a line or, with trigraphs, mean something else.
    return plain.replace("\\", "|").replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def literals(header: str) -> dict[str, str]:
    """Every number in the text of a header by name, entries of a table as NAME[i].

    Raises `BadInputError` for one that a float of C holds only as subnormal or not at all.
    """
    found: dict[str, str] = {}
    for name, literal, table, entries in _CONSTANT.findall(header):
        rows = [text.strip() for text in entries.split(",") if text.strip()]
        found |= {f"{table}[{i}]": text for i, text in enumerate(rows)} if table else {name: literal}
    for name, value in values(found).items():
        if not math.isfinite(value) or 0.0 < abs(value) < _SMALLEST_NORMAL:
            raise BadInputError(
                f"{name} is {value:.3g}, which no normal float of C can hold; set it to zero, or repair it"
            )
    return found


def values(literal: Mapping[str, str]) -> dict[str, float]:
    """What a compiler makes of the literals: binary32 values as Python floats."""
    return {
        name: float(np.float32(text[:-1])) if text.endswith("f") else float(int(text))
        for name, text in literal.items()
    }

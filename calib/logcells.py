"""The compiled scanner of log files: decimal numbers out of comma-separated lines, exactly rounded.

A number of at most 19 digits m 10^e with |m| < 2^53 and |e| <= 22 is the correctly rounded quotient
or product of two numbers that double precision holds exactly (Clinger 1990), so the compiled loop
gives the same bits as Python's `float`. Anything else (longer numbers, `nan`, words, quotes) is left
to the caller, cell by cell, with its place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from calib.arrays import FloatArray, IntArray

__all__ = ["ODD_COLUMNS", "POWERS", "scan"]

ODD_COLUMNS = ("row", "slot", "start", "end")
"""What is noted about a cell that is left to the caller; slot -1 is a whole line."""

POWERS: FloatArray = np.array([10.0**k for k in range(23)])
"""10^0 .. 10^22, all exact."""

_EXACT = 1 << 53
_COMMA, _NEWLINE, _RETURN, _SPACE, _TAB, _QUOTE, _HASH = 44, 10, 13, 32, 9, 34, 35
_PLUS, _MINUS, _DOT, _ZERO, _NINE, _E, _SMALL_E = 43, 45, 46, 48, 57, 69, 101


@njit(cache=True, nogil=True, error_model="numpy")
def scan(
    text: npt.NDArray[np.uint8],
    slots: IntArray,
    powers: FloatArray,
    values: FloatArray,
    lines: IntArray,
    odd: IntArray,
) -> tuple[int, int, int]:
    """Numbers of whole lines, each ended by a line feed.

    Parameters
    ----------
    text : (bytes,) of the lines.
    slots : (columns,) for each column of the file its column in `values`, or -1 to pass over it.
    powers : 10^0 .. 10^22.
    values : (rows, slots) written; NaN where a cell is blank or left to the caller.
    lines : (rows,) written, number of each row's line, from 0.
    odd : (cells, 4) written, see `ODD_COLUMNS`, places within `text`.

    Returns
    -------
    rows, lines, and cells left to the caller.
    """
    columns = slots.shape[0]
    size = text.shape[0]
    rows, line, strange = 0, 0, 0
    i = 0
    while i < size:
        start_of_line = i
        # An empty line is no row, and neither is a comment.
        j = i
        while j < size and (text[j] == _SPACE or text[j] == _TAB or text[j] == _RETURN):
            j += 1
        comment = j < size and text[j] == _HASH
        while comment and j < size and text[j] != _NEWLINE:
            j += 1
        if j < size and text[j] == _NEWLINE:
            i = j + 1
            line += 1
            continue
        for slot in range(values.shape[1]):
            values[rows, slot] = np.nan
        column = 0
        whole = False
        ended = False
        while not ended:
            # One cell: text[begin:i] up to a comma or the end of the line.
            begin = i
            while i < size and (text[i] == _SPACE or text[i] == _TAB):
                i += 1
            slot = slots[column] if column < columns else -1
            if slot >= 0:
                negative = False
                if i < size and (text[i] == _MINUS or text[i] == _PLUS):
                    negative = text[i] == _MINUS
                    i += 1
                m, digits, exponent = 0, 0, 0
                while i < size and _ZERO <= text[i] <= _NINE:
                    if digits < 19:
                        m = m * 10 + (text[i] - _ZERO)
                    digits += 1
                    i += 1
                if i < size and text[i] == _DOT:
                    i += 1
                    while i < size and _ZERO <= text[i] <= _NINE:
                        if digits < 19:
                            m = m * 10 + (text[i] - _ZERO)
                        digits += 1
                        exponent -= 1
                        i += 1
                good = 0 < digits <= 18
                if good and i < size and (text[i] == _E or text[i] == _SMALL_E):
                    i += 1
                    down = False
                    if i < size and (text[i] == _MINUS or text[i] == _PLUS):
                        down = text[i] == _MINUS
                        i += 1
                    power, places = 0, 0
                    while i < size and _ZERO <= text[i] <= _NINE:
                        if places < 4:
                            power = power * 10 + (text[i] - _ZERO)
                        places += 1
                        i += 1
                    good = 0 < places <= 4
                    exponent += -power if down else power
                while i < size and (text[i] == _SPACE or text[i] == _TAB or text[i] == _RETURN):
                    i += 1
                at_end = i < size and (text[i] == _COMMA or text[i] == _NEWLINE)
                blank = digits == 0 and at_end
                if blank:
                    for k in range(begin, i):
                        blank = blank and (text[k] == _SPACE or text[k] == _TAB or text[k] == _RETURN)
                if good and at_end and m < _EXACT and -22 <= exponent <= 22:
                    value = m * powers[exponent] if exponent >= 0 else m / powers[-exponent]
                    values[rows, slot] = -value if negative else value
                elif not blank:
                    odd[strange, 0], odd[strange, 1], odd[strange, 2] = rows, slot, begin
                    while i < size and text[i] != _COMMA and text[i] != _NEWLINE:
                        whole = whole or text[i] == _QUOTE
                        i += 1
                    for k in range(begin, i):
                        whole = whole or text[k] == _QUOTE
                    odd[strange, 3] = i
                    strange += 1
            else:
                while i < size and text[i] != _COMMA and text[i] != _NEWLINE:
                    whole = whole or text[i] == _QUOTE
                    i += 1
            column += 1
            ended = i >= size or text[i] == _NEWLINE
            i += 1
        if whole or column != columns:
            # Quoted cells may hold commas and a line may be too short: the caller looks at all of it.
            while strange > 0 and odd[strange - 1, 0] == rows and odd[strange - 1, 1] >= 0:
                strange -= 1
            odd[strange, 0], odd[strange, 1], odd[strange, 2], odd[strange, 3] = (
                rows,
                -1,
                start_of_line,
                i - 1,
            )
            strange += 1
        lines[rows] = line
        rows += 1
        line += 1
    return rows, line, strange

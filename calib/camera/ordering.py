"""The order of a checkerboard's corners: one rule for every picture.

Quarter turns of a grid keep its hand, so a grid that is not mirrored stays so. Of the turns that give
the board's columns and rows, the rule takes those with the dark square outward of corner (0, 0), where
the colours differ between turns, and of these the one whose columns axis points most to the right.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import FloatArray

__all__ = ["canonical_turn", "orderings", "turned_colours"]

_TIE = 1e-9


def turned_colours(colours: FloatArray, turns: int) -> FloatArray:
    """Colours of a grid after quarter turns of its order.

    Parameters
    ----------
    colours : (rows, columns), positive where the square between growing column and growing row of a
        corner is bright. A quarter turn swaps the two squares that this can mean.
    """
    return np.asarray((-1.0) ** turns * np.rot90(colours, turns))


def canonical_turn(points: FloatArray, colours: FloatArray, columns: int, rows: int) -> int | None:
    """Quarter turns (for `numpy.rot90`) that bring a grid into the order of the rule.

    Parameters
    ----------
    points : (r, c, 2) corners, not mirrored; r x c is rows x columns or columns x rows.
    colours : (r, c) as in `turned_colours`.

    Returns
    -------
    None when the grid has another size.
    """
    turns = [k for k in range(4) if np.rot90(colours, k).shape == (rows, columns)]
    if not turns:
        return None
    i, j = np.indices((rows, columns))
    parity = 1.0 - 2.0 * ((i + j) % 2)
    # Outward of corner (0, 0) is the colour of the square across it, between growing column and row.
    bright = {k: float(np.sum(np.sign(turned_colours(colours, k)) * parity)) > 0 for k in turns}
    if len(set(bright.values())) == 2:
        turns = [k for k in turns if not bright[k]]

    def rightward(turn: int) -> tuple[float, float]:
        grid = np.rot90(points, turn)
        du, dv = np.mean(grid[:, -1] - grid[:, 0], axis=0)
        cosine = float(du / max(np.hypot(du, dv), _TIE))
        # Of two that point straight up and down the one that points down.
        return round(cosine / _TIE) * _TIE, float(dv)

    return max(turns, key=rightward)


def orderings(pixels: FloatArray, columns: int, rows: int) -> tuple[FloatArray, ...]:
    """The same corners in every order that a board of this shape allows, the given one first.

    Parameters
    ----------
    pixels : (columns * rows, 2), row by row.

    Returns
    -------
    The order after no and half a turn, or for square boards after 0, 1, 2, 3 quarter turns; each
    (columns * rows, 2) and none mirrored.
    """
    grid = pixels.reshape(rows, columns, 2)
    turns = range(4) if columns == rows else (0, 2)
    return tuple(np.ascontiguousarray(np.rot90(grid, turn)).reshape(-1, 2) for turn in turns)

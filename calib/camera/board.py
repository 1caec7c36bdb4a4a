"""The checkerboard: inner corners on a plane, in metres.

Corner (column i, row j) has index `j * columns + i` and lies at `(i, j) * square_m`. Seen from the
printed side the columns axis, turned by a quarter clockwise, gives the rows axis, so that with the
image's axes (u right, v down) the grid is never mirrored and the board's z axis points away from the
camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray

__all__ = ["Board"]


@dataclass(frozen=True)
class Board:
    """A checkerboard with `columns` x `rows` inner corners and squares of `square_m` metres."""

    columns: int
    rows: int
    square_m: float

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def half_turn_looks_the_same(self) -> bool:
        """Whether the colours repeat after half a turn: no picture tells the first corner from the last.

        The square at (i, j) of columns + 1 by rows + 1 squares has the colour (i + j) mod 2; half a
        turn moves it to a square of colour (columns + rows - i - j) mod 2.
        """
        return (self.columns + self.rows) % 2 == 0

    def points_m(self) -> FloatArray:
        """Inner corners on the board's plane, shape (columns * rows, 2), metres, row by row."""
        rows, columns = np.mgrid[0 : self.rows, 0 : self.columns]
        return np.stack([columns.ravel(), rows.ravel()], axis=1) * float(self.square_m)

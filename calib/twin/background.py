"""A cluttered desk behind the board, and random numbers that are the same on every machine.

Only elementwise arithmetic in double precision and NumPy's raw bit streams are used: NumPy promises
to keep those, while the distributions on top of them may change between versions, and sums in an
order of the processor's choosing may change between machines.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import FloatArray

__all__ = ["clutter", "gaussian_noise", "uniform"]

_BYTES_PER_NORMAL = 16
_OBJECTS = 16


def uniform(bits: np.random.PCG64, count: int) -> FloatArray:
    """`count` uniform numbers in [0, 1), shape (count,), from the raw stream of `bits`."""
    raw = np.asarray(bits.random_raw(count), dtype=np.uint64)
    return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53


def gaussian_noise(bits: np.random.PCG64, shape: tuple[int, int]) -> FloatArray:
    """Normal noise of mean 0 and deviation 1: standardised sums of 16 random bytes, an exact integer sum.

    The tails end at 6.9 and the excess kurtosis is -0.075, which no picture of 256 levels can show.
    """
    words = np.asarray(bits.random_raw(shape[0] * shape[1] * _BYTES_PER_NORMAL // 8), dtype="<u8")
    total = words.view(np.uint8).reshape(*shape, _BYTES_PER_NORMAL).sum(axis=-1, dtype=np.int64)
    deviation = math.sqrt(_BYTES_PER_NORMAL * (256**2 - 1) / 12)
    noise: FloatArray = (total - _BYTES_PER_NORMAL * 127.5) / deviation
    return noise


def _value_noise(bits: np.random.PCG64, width: int, height: int, cell_px: float) -> FloatArray:
    """Smooth random surface in [-1, 1], shape (height, width), with bumps of about `cell_px`."""
    columns, rows = int(width / cell_px) + 2, int(height / cell_px) + 2
    knots = 2.0 * uniform(bits, columns * rows).reshape(rows, columns) - 1.0

    def along(count: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], FloatArray]:
        position = np.arange(count) / cell_px
        cell = np.floor(position).astype(np.intp)
        t = position - cell
        return cell, t * t * (3.0 - 2.0 * t)

    (i, s), (j, t) = along(width), along(height)
    upper = knots[:, i] + s * (knots[:, i + 1] - knots[:, i])
    return upper[j] + t[:, None] * (upper[j + 1] - upper[j])


def _distance_rectangle(x: FloatArray, y: FloatArray, half_x: float, half_y: float) -> FloatArray:
    """Signed distance to a rectangle's outline, negative inside (an octagonal norm at the corners)."""
    return np.maximum(np.abs(x) - half_x, np.abs(y) - half_y)


def _distance_disc(x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
    """Signed distance to a circle, negative inside."""
    return np.sqrt(x * x + y * y) - radius


def clutter(size_px: tuple[int, int], seed: int) -> FloatArray:
    """Reflectance of a desk strewn with papers, discs, frames and cables, without any checkerboard.

    Parameters
    ----------
    size_px : (width, height).

    Returns
    -------
    (height, width) in [0.03, 0.95].
    """
    width, height = size_px
    bits = np.random.PCG64(seed)
    scale = float(max(width, height))
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    tone = float(uniform(bits, 1)[0])
    picture = 0.26 + 0.24 * tone + np.zeros((height, width))
    for cell, strength in ((0.31, 0.07), (0.083, 0.03), (0.019, 0.015)):
        picture += strength * _value_noise(bits, width, height, max(2.0, cell * scale))
    grain = _value_noise(bits, width, height, max(2.0, 0.012 * scale))
    for _ in range(_OBJECTS):
        draw = [float(value) for value in uniform(bits, 10)]
        angle = math.pi * draw[2]
        c, s = math.cos(angle), math.sin(angle)
        du, dv = u - width * (1.2 * draw[0] - 0.1), v - height * (1.2 * draw[1] - 0.1)
        x, y = c * du + s * dv, c * dv - s * du
        size = scale * (0.03 + 0.12 * draw[3])
        kind = int(5 * draw[4])
        if kind == 0:  # a disc, such as a mug from above, with a rim
            distance = _distance_disc(x, y, 0.6 * size)
            if draw[9] > 0.5:
                distance = np.abs(distance) - 0.12 * size
        elif kind == 1:  # a cable: a long, slightly bent line
            bend = (draw[5] - 0.5) / scale
            distance = np.abs(y - bend * x * x) - scale * (0.003 + 0.005 * draw[9])
        elif kind == 2:  # the outline of a frame
            distance = np.abs(_distance_rectangle(x, y, size, size * (0.4 + draw[5]))) - 0.08 * size
        elif kind == 3:  # a pen
            distance = _distance_rectangle(x, y, 1.6 * size, scale * (0.006 + 0.008 * draw[5]))
        else:  # a book or a sheet of paper
            distance = _distance_rectangle(x, y, size, size * (0.5 + draw[5]))
        softness = 1.0 + 0.006 * scale * draw[6]
        coverage = np.clip(0.5 - distance / softness, 0.0, 1.0)
        shade = 0.06 + 0.66 * draw[7] + 0.08 * (draw[8] - 0.5) * (du + dv) / size + 0.03 * grain
        shadow = 0.3 * np.clip(0.6 - distance / (0.03 * scale), 0.0, 1.0)
        picture = (1.0 - coverage) * picture * (1.0 - shadow) + coverage * shade
    return np.clip(picture, 0.03, 0.95)

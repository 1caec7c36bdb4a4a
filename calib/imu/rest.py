"""Motion in a log that claims to be at rest.

The log is cut into windows of about a second. A window moves where on any axis

- its standard deviation is more than `TIMES_SPREAD` times that of the quiet windows, or above what no
  sensor has at rest (`MOST_GYRO_RADPS`, `MOST_ACCEL_MPS2`);
- its mean differs from the one before by more than `TIMES_MEAN` times the quiet windows' differences.

Quiet is the lower quartile of all windows, so that up to three quarters of a log may be in motion. A
random walk of the bias raises all differences alike and is not taken for motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.imu.sampling import Part

__all__ = ["MOST_ACCEL_MPS2", "MOST_GYRO_RADPS", "Motion", "quiet_spread", "rest_parts"]

MOST_GYRO_RADPS = 0.02
MOST_ACCEL_MPS2 = 0.4
TIMES_SPREAD = 3.0
TIMES_MEAN = 8.0
_WINDOW_S = 1.0
_FEWEST = 20
_QUARTILE_OF_NORMAL = 0.3186393639643752


@dataclass(frozen=True)
class Motion:
    """A stretch of time in which the log moves, and the axis that shows it most, by its number."""

    from_s: float
    to_s: float
    axis: int


def _window(period_s: float) -> int:
    return max(_FEWEST, round(_WINDOW_S / period_s))


def _windows(part: Part, size: int) -> FloatArray:
    """Readings (w, size, axes) of whole windows; the rest of the part belongs to the last."""
    count = len(part.values) // size
    return part.values[: count * size].reshape(count, size, -1)


def quiet_spread(parts: tuple[Part, ...], period_s: float) -> FloatArray:
    """Standard deviation (axes,) within the quiet windows; zeros where there is no whole window."""
    size = _window(period_s)
    spreads = [_windows(part, size).std(axis=1) for part in parts if len(part.values) >= size]
    if not spreads:
        return np.zeros(parts[0].values.shape[1])
    return np.asarray(np.quantile(np.concatenate(spreads), 0.25, axis=0))


def rest_parts(
    parts: tuple[Part, ...], period_s: float, gyro: BoolArray, step: FloatArray
) -> tuple[tuple[Part, ...], tuple[Motion, ...]]:
    """The parts without their moving windows, and where these are.

    Parameters
    ----------
    parts : of one log.
    gyro : (axes,) which axes are rates of rotation.
    step : (axes,) quantisation steps, NaN for none.
    """
    size = _window(period_s)
    coarse = np.nan_to_num(step)
    most = np.where(gyro, MOST_GYRO_RADPS, MOST_ACCEL_MPS2)
    quiet = np.maximum(quiet_spread(parts, period_s), 0.3 * coarse)
    means = [_windows(part, size).mean(axis=1) for part in parts if len(part.values) >= 2 * size]
    steps = [np.abs(np.diff(mean, axis=0)) for mean in means]
    jump = np.zeros(len(gyro))
    if steps:
        jump = np.quantile(np.concatenate(steps), 0.25, axis=0) / _QUARTILE_OF_NORMAL
    # Few windows may agree by chance; white noise alone gives this much.
    jump = np.maximum(jump, np.sqrt(2.0 / size) * quiet) + 1e-12
    still: list[Part] = []
    motions: list[Motion] = []
    for part in parts:
        if len(part.values) < size:
            still.append(part)
            continue
        w = _windows(part, size)
        excess = w.std(axis=1) / np.minimum(TIMES_SPREAD * quiet + 1e-12, most)
        change = np.abs(np.diff(w.mean(axis=1), axis=0)) / (TIMES_MEAN * jump)
        # Coming to rest is no motion of the window that follows.
        shaken = (excess > 1.0).any(axis=1)
        change[shaken[:-1]] = 0.0
        excess[1:] = np.maximum(excess[1:], change)
        moving = (excess > 1.0).any(axis=1)
        for start, stop, moves in _runs(moving):
            begin, end = start * size, stop * size if stop < len(w) else len(part.values)
            if moves:
                axis = int(np.argmax(excess[start:stop].max(axis=0)))
                motions.append(Motion(part.start_s + begin * period_s, part.start_s + end * period_s, axis))
            else:
                inside = (part.places >= begin) & (part.places < end)
                still.append(
                    Part(
                        part.start_s + begin * period_s,
                        part.values[begin:end],
                        part.rows[inside],
                        part.places[inside] - begin,
                    )
                )
    return tuple(still), tuple(motions)


def _runs(flags: BoolArray) -> list[tuple[int, int, bool]]:
    """First, behind the last, and value of each run of equal flags."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(flags)) + 1, [len(flags)]]).tolist()
    return [(a, b, bool(flags[a])) for a, b in pairwise(edges)]

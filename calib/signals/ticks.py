"""Samples with time stamps as the firmware sees them: one value per tick.

The firmware counts ticks and does not look at clocks: a tick uses the newest sample, and where the camera
found nothing the last one is held. So samples are put on a uniform grid: a sample belongs to the tick that is
nearest to its time stamp (jitter below half a tick changes nothing), of several in one tick the
last counts, and a tick without a sample holds the one before. After a gap longer than `LONGEST_HOLD_S`
a new piece begins, filtered from rest, because what was held so long is no position any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError

__all__ = ["LONGEST_HOLD_S", "Piece", "Ticks", "on_ticks", "sampling_rate_hz"]

LONGEST_HOLD_S = 1.0


@dataclass(frozen=True)
class Piece:
    """Ticks without a long gap.

    Attributes
    ----------
    t_s : (n,) times of the ticks [s], `1 / rate` apart.
    values : (n, d) one sample each.
    held : (n,) ticks that repeat the sample before.
    """

    t_s: FloatArray
    values: FloatArray
    held: BoolArray


@dataclass(frozen=True)
class Ticks:
    """A signal on ticks.

    Attributes
    ----------
    rate_hz : ticks per second.
    pieces : in order of time, each with at least one tick.
    dropped : samples that shared a tick with a later one.
    """

    rate_hz: float
    pieces: tuple[Piece, ...]
    dropped: int

    @property
    def held(self) -> int:
        """Ticks that repeat the sample before."""
        return sum(int(piece.held.sum()) for piece in self.pieces)

    @property
    def longest(self) -> Piece:
        """The longest piece, of equal ones the first."""
        return max(self.pieces, key=lambda piece: len(piece.t_s))


def sampling_rate_hz(t_s: FloatArray) -> float:
    """Samples per second from the median of the steps of time (n,) [s]; equal stamps are passed over.

    Raises `BadInputError` where there are not two different times.
    """
    steps = np.diff(t_s)
    steps = steps[steps > 0.0]
    if len(steps) == 0:
        raise BadInputError("has no two samples at different times, expected a series")
    return float(1.0 / np.median(steps))


def on_ticks(t_s: FloatArray, values: FloatArray, rate_hz: float) -> Ticks:
    """The samples (n, d), taken at times (n,) that do not run backwards, one per tick.

    Raises `BadInputError` for no samples.
    """
    if len(t_s) == 0:
        raise BadInputError("has no samples")
    breaks = np.nonzero(np.diff(t_s) > max(LONGEST_HOLD_S, 2.0 / rate_hz))[0] + 1
    pieces, dropped = [], 0
    for first, last in zip([0, *breaks.tolist()], [*breaks.tolist(), len(t_s)], strict=True):
        k = np.floor(_phase(t_s[first:last], rate_hz) + 0.5).astype(np.int64)
        k -= k[0]
        newest = np.nonzero(np.append(np.diff(k) > 0, True))[0]
        ticks = np.arange(k[-1] + 1)
        source = np.searchsorted(k[newest], ticks, side="right") - 1
        taken = newest[source]
        pieces.append(
            Piece(t_s[first] + ticks / rate_hz, values[first:last][taken], np.asarray(k[taken] != ticks))
        )
        dropped += len(k) - len(newest)
    return Ticks(rate_hz, tuple(pieces), dropped)


def _phase(t_s: FloatArray, rate_hz: float) -> FloatArray:
    """Times in ticks, shifted so that most stamps lie near whole numbers.

    A clock that is a little off the rate drifts through the grid; then a tick is held or a sample
    dropped now and then, as in the firmware.
    """
    phase = (t_s - t_s[0]) * rate_hz
    early = phase[: max(1, min(len(phase), 64))]
    turn = np.angle(np.mean(np.exp(2j * np.pi * early))) / (2.0 * np.pi)
    return np.asarray(phase - turn)

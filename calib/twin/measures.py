"""Figures by which the source describes its experiments, read off simulated runs.

All take evenly sampled truth. Where a curve crosses a level between two samples the crossing is found
on the straight line between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["StepResponse", "Swing", "fall_time_s", "step_response", "swing_decay"]


@dataclass(frozen=True)
class Swing:
    """A decaying oscillation.

    Attributes
    ----------
    damping_ratio : zeta by (3.39), (3.40) on peak-to-peak amplitudes, mean over the first half periods.
    frequency_hz : mean over the same.
    offset_at_s, offset_rad : middle of the oscillation at every extreme but the first and last.
    """

    damping_ratio: float
    frequency_hz: float
    offset_at_s: FloatArray
    offset_rad: FloatArray


def swing_decay(t_s: FloatArray, phi_rad: FloatArray, half_periods: int = 8) -> Swing:
    """Decay of a swing that is released at the first sample, from its first half periods.

    Peak-to-peak amplitudes do not see an offset that decays slowly; on the raw curve (3.39) yields
    about 0.004. The offset at an extreme is (a + 2 b + c) / 4 of it and its neighbours.

    Raises `BadInputError` when there are fewer than three extremes.
    """
    inner = phi_rad[1:-1]
    rising, falling = inner > phi_rad[:-2], inner < phi_rad[:-2]
    turn = np.nonzero((rising & (inner >= phi_rad[2:])) | (falling & (inner <= phi_rad[2:])))[0] + 1
    if len(turn) < 2:
        raise BadInputError(f"swing: found {len(turn) + 1} extremes, expected at least 3")
    # The parabola through three samples has its extreme between them.
    a, b, c = phi_rad[turn - 1], phi_rad[turn], phi_rad[turn + 1]
    bend = a - 2.0 * b + c
    shift = 0.5 * (a - c) / np.where(bend == 0.0, 1.0, bend)
    at = np.concatenate([[t_s[0]], t_s[turn] + float(t_s[1] - t_s[0]) * shift])
    value = np.concatenate([[phi_rad[0]], b - 0.25 * (a - c) * shift])
    used = min(half_periods, len(turn))
    swings = np.abs(np.diff(value[: used + 1]))
    delta = 2.0 * float(np.mean(np.log(swings[:-1] / swings[1:])))
    return Swing(
        delta / math.hypot(delta, 2.0 * math.pi),
        0.5 * used / float(at[used] - at[0]),
        at[1:-1],
        0.25 * (value[:-2] + 2.0 * value[1:-1] + value[2:]),
    )


@dataclass(frozen=True)
class StepResponse:
    """Response to a step from rest; times from the step, None for what does not happen.

    Attributes
    ----------
    reach_s : first time at the set-point.
    peak : greatest value.
    settle_s : time after which the error stays within the band.
    """

    reach_s: float | None
    peak: float
    settle_s: float | None


def step_response(tick_s: float, values: FloatArray, wanted: float, band: float = 0.02) -> StepResponse:
    """Response (n,), sampled from the step on, to a rising step to `wanted`; band as a share of it."""
    above = np.nonzero(values >= wanted)[0]
    reach = None
    if len(above):
        i = int(above[0])
        part = 0.0 if i == 0 else (wanted - values[i - 1]) / (values[i] - values[i - 1])
        reach = float((i - 1 + part) * tick_s) if i else 0.0
    outside = np.nonzero(np.abs(values - wanted) > band * abs(wanted))[0]
    last = int(outside[-1]) + 1 if len(outside) else 0
    return StepResponse(reach, float(values.max()), last * tick_s if last < len(values) else None)


def fall_time_s(tick_s: float, values: FloatArray, share: float = 0.05) -> float | None:
    """Time until values (n,), sampled from the beginning of the fall on, are below a share of the first."""
    below = np.nonzero(values < share * values[0])[0]
    return float(below[0] * tick_s) if len(below) else None

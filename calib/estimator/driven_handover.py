"""Which of two models speaks: the driven one while it explains the pictures, else the kinematic one.

Both filters predict every picture. With s the sum over pictures of the log likelihood of the driven filter
minus that of the kinematic one, each term cut to +-`CUT` and forgotten over `MEMORY_S`, the driven one's
weight is

    w = 1 / (1 + exp(-(s - OFFSET) / SOFT)).

Pictures are compared since they alone see the length. Likelihoods only compare two predictions, though,
and a wrong model of the plant may still predict better than one that knows nothing. So the driven filter
must agree with itself as well: over what is in memory the mean of each sensor's innovations, which a wrong
force moves first, and their mean square are chi-square, and what they exceed that by is taken from s. A
restart or a reading that only the driven filter rejects counts against it too.

Means are mixed by the weight, and what they differ by is added to the covariance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.estimator.driven_filter import DrivenFilter
from calib.estimator.driven_setup import Drive
from calib.estimator.driven_smoother import smooth_driven
from calib.estimator.filter import Filter
from calib.estimator.sensors import head_position
from calib.estimator.setup import OUT, Rows, Setup
from calib.estimator.smoother import smooth

__all__ = ["HANDOVER_STATE", "Handover", "blended", "new_handover", "smooth_both", "weigh"]

HANDOVER_STATE = 14
"""Entries: time, s, and for each sensor a count, the sum of NIS and the sums of its innovations."""

CUT, MEMORY_S = 6.0, 1.0
OFFSET, SOFT = -4.0, 1.5
AGAIN, BEGIN = -40.0, -12.0
"""s after a restart, and at the first start of a filter that has to find its state; a smoother has not."""
PULLED, PULL = 10.0, 0.5
EXCEEDED, EXCESS = 0.25, 20.0
_E, _NIS, _GATED, _LL, _FLAGS = (
    OUT.index(name) for name in ("e_u", "nis_camera", "gated_camera", "log_likelihood", "flags")
)


def new_handover() -> FloatArray:
    """Memory of `weigh` before the first row."""
    memory = np.zeros(HANDOVER_STATE)
    memory[0] = np.nan
    return memory


@njit(cache=True, nogil=True, error_model="numpy")
def _distrust(memory: FloatArray) -> float:
    """What the driven filter's innovations in memory cost it."""
    cost = 0.0
    for sensor in range(3):
        at = 2 + 4 * sensor
        count = memory[at]
        if count < 6.0:
            continue
        # Of white innovations (sum)^2 / count is chi-square with one degree for each axis.
        pull = (memory[at + 2] ** 2 + memory[at + 3] ** 2) / count
        cost += PULL * max(pull - PULLED, 0.0)
        degrees = 1.0 if sensor == 2 else 2.0
        excess = memory[at + 1] / (degrees * count) - 1.0
        cost += EXCESS * max(excess - 4.0 / math.sqrt(degrees * count) - EXCEEDED, 0.0)
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def weigh(
    driven: FloatArray, kinematic: FloatArray, memory: FloatArray, begin: float, weight: FloatArray
) -> None:
    """Weight (n,) of the driven model after each row of both outputs (n, len(OUT)).

    `begin` is s where the driven filter has not started.
    """
    for row in range(len(driven)):
        t = driven[row, 0]
        step = t - memory[0] if t > memory[0] else 0.0
        memory[0] = t
        keep = math.exp(-step / MEMORY_S)
        for k in range(1, HANDOVER_STATE):
            memory[k] *= keep
        gated, other = driven[row, _GATED], kinematic[row, _GATED]
        if gated == 0.0 and other == 0.0:
            difference = driven[row, _LL] - kinematic[row, _LL]
            memory[1] += min(max(difference, -CUT), CUT)
        elif gated == 1.0 and other == 0.0:
            memory[1] -= CUT
        for sensor in range(3):
            at, e = 2 + 4 * sensor, _E + 2 * sensor
            if driven[row, _GATED + sensor] == 0.0:
                memory[at] += 1.0
                memory[at + 1] += driven[row, _NIS + sensor]
                memory[at + 2] += driven[row, e]
                if sensor < 2:
                    memory[at + 3] += driven[row, e + 1]
            elif driven[row, _GATED + sensor] == 1.0 and kinematic[row, _GATED + sensor] == 0.0:
                memory[1] -= 0.5 * CUT
        flags = int(driven[row, _FLAGS])
        if flags & 97:
            # Restarted, time jumped, or not started.
            memory[1:] = 0.0
            memory[1] = AGAIN if flags & 33 else begin
        s = memory[1] - _distrust(memory)
        weight[row] = 1.0 / (1.0 + math.exp(min(max(-(s - OFFSET) / SOFT, -40.0), 40.0)))


@njit(cache=True, nogil=True, error_model="numpy")
def _positions(out: FloatArray) -> None:
    for k in range(len(out)):
        out[k, 7], out[k, 8] = head_position(out[k, 5], out[k, 6])


def blended(driven: FloatArray, kinematic: FloatArray, weight: FloatArray) -> FloatArray:
    """Both outputs (n, len(OUT)) mixed by the weight (n,) of the driven one, which is written beside them.

    Innovations and gates are those of the filter that has the greater weight, flags of the kinematic one.
    """
    w = np.where(np.isfinite(driven[:, 5]), weight, 0.0)
    driven = np.where((w > 0.0)[:, None], driven, kinematic)
    out = np.where((w >= 0.5)[:, None], driven, kinematic)
    columns = [1, 2, 3, 4, 5, 6, 9]
    out[:, columns] = w[:, None] * driven[:, columns] + (1.0 - w)[:, None] * kinematic[:, columns]
    _positions(out)
    for sigma, value in ((10, 1), (11, 2), (12, 5)):
        apart = driven[:, value] - kinematic[:, value]
        variance = w * driven[:, sigma] ** 2 + (1.0 - w) * kinematic[:, sigma] ** 2
        out[:, sigma] = np.sqrt(variance + w * (1.0 - w) * apart**2)
    for name in ("flags", "swing_weight", "rest_weight"):
        out[:, OUT.index(name)] = kinematic[:, OUT.index(name)]
    out[:, OUT.index("driven_weight")] = w
    return out


class Handover:
    """Both filters at work and the weighing of them; rows and commands in, estimates out."""

    def __init__(self, setup: Setup, drive: Drive) -> None:
        self._kinematic, self._driven = Filter(setup), DrivenFilter(setup, drive)
        self._memory = new_handover()

    def run_each(self, rows: Rows, pwm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Estimates of the driven and of the kinematic filter (n, len(OUT)), and the driven one's weight."""
        driven, kinematic = self._driven.run(rows, pwm), self._kinematic.run(rows)
        weight = np.empty(len(rows))
        weigh(driven, kinematic, self._memory, BEGIN, weight)
        return driven, kinematic, weight

    def run(self, rows: Rows, pwm: FloatArray) -> FloatArray:
        """Estimates (n, len(OUT)) of rows with commands (n, 2); call again with the rows that follow."""
        return blended(*self.run_each(rows, pwm))


def smooth_both(
    setup: Setup, drive: Drive, rows: Rows, pwm: FloatArray, driven: FloatArray, kinematic: FloatArray
) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) of both models, weighed by what both sides of a row say.

    Parameters
    ----------
    driven, kinematic : (n, len(OUT)) of the filters on the same rows.
    """
    weight, after = np.empty(len(rows)), np.empty(len(rows))
    weigh(driven, kinematic, new_handover(), 0.0, weight)
    back = driven[::-1].copy()
    back[:, 0] = -back[:, 0]
    weigh(back, kinematic[::-1].copy(), new_handover(), 0.0, after)
    return blended(
        smooth_driven(setup, drive, rows, pwm, driven),
        smooth(setup, rows, kinematic),
        np.minimum(weight, after[::-1]),
    )

"""What a pump's model cannot explain: runs that settle apart at the same PWM, and where runs leave it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.actuator.identify_pump import PumpFit
from calib.actuator.identify_pump_models import PumpRecord, simulate_pump

__all__ = ["Departure", "Group", "departures", "jumps", "settled_groups"]

_SETTLED_S = 1.0
_APART = 0.05
_LONG_S = 0.3
_STEADY_PWM = 3.0
_JUMP_S = 0.1


@dataclass(frozen=True)
class Group:
    """Runs that settle at the same value under nearly the same PWM.

    Attributes
    ----------
    value, spread : mean and standard deviation of the settled values.
    pwm : least and greatest PWM while settled. names : of the runs.
    """

    value: float
    spread: float
    pwm: tuple[float, float]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Departure:
    """Where a run leaves the model: time from its start [s], error there after, and whether PWM had moved."""

    name: str
    at_s: float
    error: float
    pwm_moved: bool


def settled_groups(records: Sequence[PumpRecord]) -> tuple[Group, ...]:
    """Groups of runs by the value of their last second, for runs near full PWM then.

    Two groups are apart by more than a twentieth of the largest value.
    """
    ends = []
    for record in records:
        late = record.t_s >= record.t_s[-1] - _SETTLED_S
        pwm = record.pwm[late]
        if float(np.median(pwm)) >= 0.85 * 255.0 and float(np.ptp(record.value)) > 0.0:
            value = float(np.median(record.value[late]))
            ends.append((value, record.name, float(np.quantile(pwm, 0.05)), float(pwm.max())))
    ends.sort()
    groups: list[list[tuple[float, str, float, float]]] = []
    for end in ends:
        if groups and end[0] - groups[-1][-1][0] <= _APART * max(abs(e[0]) for e in ends):
            groups[-1].append(end)
        else:
            groups.append([end])
    return tuple(
        Group(
            float(np.mean([e[0] for e in group])),
            float(np.std([e[0] for e in group])),
            (min(e[2] for e in group), max(e[3] for e in group)),
            tuple(e[1] for e in group),
        )
        for group in groups
    )


def departures(fit: PumpFit, records: Sequence[PumpRecord]) -> tuple[Departure, ...]:
    """Runs whose error grows beyond a twentieth of their range and stays there, and when it began."""
    out = []
    for record in records:
        error = record.value - simulate_pump(fit.model, fit.theta, record, fit.shape)
        limit = _APART * float(np.ptp(record.value))
        large = np.abs(error) > limit
        # The last stretch of large errors, up to the end of the run.
        small = np.nonzero(~large)[0]
        first = int(small[-1]) + 1 if len(small) else 0
        if first >= len(error) or record.t_s[-1] - record.t_s[first] < _LONG_S:
            continue
        # Back to where the error was last within a quarter of that.
        near = np.nonzero(np.abs(error[: first + 1]) < 0.25 * limit)[0]
        begin = int(near[-1]) if len(near) else first
        before = (record.t_s <= record.t_s[begin]) & (record.t_s > record.t_s[begin] - _LONG_S)
        moved = float(np.ptp(record.pwm[before])) > _STEADY_PWM
        out.append(
            Departure(
                record.name,
                float(record.t_s[begin] - record.t_s[0]),
                float(np.median(error[first:])),
                moved,
            )
        )
    return tuple(out)


def jumps(records: Sequence[PumpRecord]) -> tuple[tuple[str, float, float], ...]:
    """Runs that begin with a jump: name, its size, and the value before it.

    A jump is a rise within a tenth of a second that is more than twice as fast as that of the
    tenth after it, and more than a twentieth of the range.
    """
    out = []
    for record in records:
        t, y = record.t_s - record.t_s[0], record.value
        found = []
        for k in np.nonzero(t < 0.3)[0].tolist():
            after = np.searchsorted(t, t[k] + 0.4 * _JUMP_S)
            later = np.searchsorted(t, t[k] + 1.4 * _JUMP_S)
            if later >= len(t):
                break
            rise, next_rise = float(y[after] - y[k]), float(y[later] - y[after])
            slope = next_rise / max(float(t[later] - t[after]), 1e-9) * float(t[after] - t[k])
            if rise > 2.0 * max(slope, 0.0) and rise > _APART * float(np.ptp(y)):
                found.append((rise - slope, float(y[k])))
        if found:
            out.append((record.name, *max(found)))
    return tuple(out)

"""Signals: the readings of a log as arrays, and what is wrong about the sensors that they come from.

`Log.signals` is the way from a log to arrays. It takes the rows in which all the columns that are asked for
have a reading, drops rows that were written twice, and holds the samples' times to the stamps
(`calib.solve.clock`). What it finds of sensors that are stuck, absent or turned the wrong way are findings
for the verdict of whoever uses them; `Watch` finds the same block by block in a log that is streamed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.verdict import Finding, Severity
from calib.io.columns import ACCEL, GYRO, MEASURED, turning
from calib.io.logs import Log
from calib.solve.clock import TimeAxis, time_axis

IMU = (*GYRO, *ACCEL)
IN_PLANE = ("gz_radps", "ax_mps2", "ay_mps2")
"""What the angle in the plane takes."""

_NEEDED = (*IN_PLANE, "u_px", "v_px")
"""What an estimate of the head takes; without the others it does as well."""
_FEWEST = 20
"""With fewer readings a sensor that never changes may be one with coarse steps."""
_TURNED_RAD = 0.05
_AGREES, _CONTRADICTS = 0.3, 1.0
_WINDOW = 20_000


@dataclass(frozen=True)
class Signals:
    """Readings of some columns of a log, sample by sample.

    Attributes
    ----------
    source : name for messages.
    names : of the columns.
    stamps_s : (n,) time stamps, which do not go back.
    values : (n, names) readings in SI, NaN where rows are taken that have some of them only.
    rows, lines : (n,) rows of the log, and their lines in the file.
    repeated_rows : rows that were written twice and are left out.
    findings : on the sensors.
    """

    source: str
    names: tuple[str, ...]
    stamps_s: FloatArray
    values: FloatArray
    rows: IntArray
    lines: IntArray
    repeated_rows: int = 0
    findings: tuple[Finding, ...] = ()

    def __len__(self) -> int:
        return len(self.stamps_s)

    def __getitem__(self, name: str) -> FloatArray:
        return np.ascontiguousarray(self.values[:, self.names.index(name)])

    @cached_property
    def axis(self) -> TimeAxis:
        """When the samples were taken."""
        return time_axis(self.stamps_s)

    @property
    def t_s(self) -> FloatArray:
        """(n,) times at which the samples were taken."""
        return self.axis.t_s

    @property
    def stuck(self) -> tuple[str, ...]:
        """Columns of the IMU that never change."""
        many = np.isfinite(self.values).sum(axis=0) >= _FEWEST
        least, most = np.fmin.reduce(self.values), np.fmax.reduce(self.values)
        named = zip(self.names, many & (most == least), strict=True)
        return tuple(name for name, stuck in named if stuck and name in IMU)

    def refuse_stuck(self, *names: str, hint: str = "") -> None:
        """Raise `BadInputError` for the first of these columns that never changes."""
        for name in names:
            if name in self.stuck:
                value = self[name][np.isfinite(self[name])][0]
                raise BadInputError(
                    f"{self.source}: {name} never changes, it is stuck at {value:.6g}; expected the noise of "
                    f"a sensor{hint}"
                )

    def refuse_mirrored(self) -> None:
        """Raise `BadInputError` where the accelerometer's angle turns against the gyroscope's."""
        for finding in self.findings:
            if finding.severity == "inconsistent":
                raise BadInputError(f"{self.source}: {finding.text}; {finding.advice}")

    def without(self, *names: str) -> Signals:
        """The same without some columns."""
        kept = [k for k, name in enumerate(self.names) if name not in names]
        return Signals(
            self.source, tuple(self.names[k] for k in kept), self.stamps_s, self.values[:, kept], self.rows,
            self.lines, self.repeated_rows, self.findings,
        )  # fmt: skip


def check_time(log: Log) -> None:
    """Raise `BadInputError` at the first row whose time is earlier than that of the row before."""
    back = np.nonzero(np.diff(log.t_s) < 0.0)[0]
    if len(back):
        i = int(back[0]) + 1
        raise BadInputError(
            f"{log.source}, line {log.lines[i]}: t_s goes back from {log.t_s[i - 1]:.6f} "
            f"to {log.t_s[i]:.6f}, expected time to run forward"
        )


def refuse_counts(log: Log, names: Sequence[str]) -> None:
    """Raise `BadInputError` for the first of these columns that is in counts."""
    for name in names:
        if name in log.columns and log.map is not None and log.unit(name) == "counts":
            column = log.map.sources[name].column
            raise BadInputError(
                f"{log.source}: {name} is in counts, expected a unit; calib imu intrinsics finds the scale: "
                f"add it to {log.map.folder}, such as {name}: {{column: {column}, factor: 0.0024}}"
            )


def signals_of(
    log: Log, names: Sequence[str], optional: Sequence[str], counts: bool, partly: bool
) -> Signals:
    """Readings of the columns `names`, and of those optional ones that have any.

    Parameters
    ----------
    counts : take columns in counts as they are.
    partly : take rows with a reading in any of the columns, not in all of them.

    Raises
    ------
    BadInputError for columns in counts otherwise, for time that goes back, for a column that is not there or
    holds no number, and for columns that never have a reading in the same row.
    """
    lacking = [name for name in names if name not in log.columns]
    if lacking:
        raise BadInputError(f"{log.source}: has no {_listed(lacking)}, expected {_listed(names)} beside t_s")
    blank = [name for name in names if np.isnan(log.columns[name]).all()]
    if blank:
        raise BadInputError(f"{log.source}: {_listed(blank)} hold{'s' * (len(blank) == 1)} no number")
    more = [n for n in optional if n in log.columns and n not in names and np.isfinite(log.columns[n]).any()]
    wanted = (*names, *more)
    if not wanted:
        raise BadInputError(f"{log.source}: has no reading of {_listed(optional)}")
    if not counts:
        refuse_counts(log, wanted)
    rows = log.sampled(*wanted) if not partly else _any(log, wanted)
    if len(rows) == 0:
        raise BadInputError(f"{log.source}: no row has all of {', '.join(wanted)}, expected them together")
    check_time(log)
    values = np.stack([log.columns[name][rows] for name in wanted], axis=1)
    stamps = log.t_s[rows]
    same = np.all((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])), axis=1)
    twice = (np.diff(stamps) == 0.0) & same
    if twice.any():
        kept = np.concatenate([[True], ~twice])
        rows, stamps, values = rows[kept], stamps[kept], values[kept]
    watch = Watch(tuple(name for name in (*names, *optional) if name in IMU))
    watch.add(log)
    findings = tuple(watch.findings(stuck=False))
    return Signals(log.source, wanted, stamps, values, rows, log.lines[rows], int(twice.sum()), findings)


def _any(log: Log, names: Sequence[str]) -> IntArray:
    return np.nonzero(np.logical_or.reduce([np.isfinite(log.columns[name]) for name in names]))[0]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


@dataclass
class Watch:
    """What the blocks of a log show of its sensors.

    Attributes
    ----------
    names : columns that are used, and so ought to have readings.
    """

    names: tuple[str, ...] = MEASURED
    _there: dict[str, bool] = field(default_factory=dict)
    _count: dict[str, int] = field(default_factory=dict)
    _least: dict[str, float] = field(default_factory=dict)
    _most: dict[str, float] = field(default_factory=dict)
    _mirrored: Finding | None = None
    _known: bool = False

    def add(self, log: Log) -> None:
        """Rows that follow."""
        for name in self.names:
            if name not in log.columns:
                continue
            self._there[name] = True
            column = log.columns[name]
            finite = column[np.isfinite(column)]
            if len(finite):
                self._count[name] = self._count.get(name, 0) + len(finite)
                self._least[name] = min(self._least.get(name, math.inf), float(finite.min()))
                self._most[name] = max(self._most.get(name, -math.inf), float(finite.max()))
        if not self._known and all(name in log.columns and name in self.names for name in IN_PLANE):
            self._known, self._mirrored = _mirrored(log)

    def has(self, *names: str) -> bool:
        """Whether each of these columns has a reading."""
        return all(self._count.get(name) for name in names)

    def findings(self, stuck: bool = True) -> list[Finding]:
        """What is wrong about the sensors, with `stuck` those among them that never change."""
        out = []
        for name in self.names:
            if name in self._there and not self._count.get(name):
                severity: Severity = "poor" if name in _NEEDED else "remark"
                out.append(Finding(severity, f"{name} has no reading in any row"))
            elif stuck and (
                name in IMU and self._count.get(name, 0) >= _FEWEST and self._least[name] == self._most[name]
            ):
                out.append(
                    Finding(
                        "inconsistent",
                        f"{name} never changes, it is stuck at {self._least[name]:.6g}",
                        "check the sensor and its wiring",
                    )
                )
        return [*out, self._mirrored] if self._mirrored is not None else out


def _mirrored(log: Log) -> tuple[bool, Finding | None]:
    """Whether a log turns far enough to tell which way, and what is wrong about it."""
    rows = log.sampled(*IN_PLANE)[:_WINDOW]
    if len(rows) < 2 * _FEWEST:
        return False, None
    gz, ax, ay = (log.columns[name][rows] for name in IN_PLANE)
    t_s = np.maximum.accumulate(log.t_s[rows])
    if not t_s[-1] > t_s[0]:
        return False, None
    found = turning(t_s, np.stack([ax, ay], axis=1), -gz, [1.0, -1.0])
    if found.turned_rad < _TURNED_RAD:
        return False, None
    if found.misfit[-1.0] > _AGREES or found.misfit[1.0] < _CONTRADICTS:
        return found.misfit[1.0] < _AGREES, None
    middle = math.atan2(float(np.median(ay)), float(np.median(ax)))
    names = {n: log.map.sources[n].column if log.map is not None else n for n in IN_PLANE}
    if abs(abs(middle) - 0.5 * math.pi) < 0.25 * math.pi:
        what = "ax_mps2 and ay_mps2 are swapped"
        lines = f"ax_mps2: {names['ay_mps2']} and ay_mps2: {names['ax_mps2']}"
    else:
        what = "gz_radps, or one of ax_mps2 and ay_mps2, has the wrong sign"
        lines = f"gz_radps: {{column: {names['gz_radps']}, factor: -1}}"
    folder = log.map.folder if log.map is not None else "columns.yaml"
    return True, Finding(
        "inconsistent",
        f"the accelerometer's angle turns against the gyroscope's: {what}",
        f"if so, add to {folder} the line{'s' * (' and ' in lines)} {lines}",
    )

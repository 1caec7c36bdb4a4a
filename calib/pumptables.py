"""Tables of a pump's recordings: time, PWM, and pressure or force, in columns of whatever name.

A CSV with a header. The columns are those that are asked for, else the first whose name is known:

    time        t_s, time, time_s, timestamp, timestamp_s, t
    PWM         pwm, pwm1, pwm_input, pwm_main
    value       pressure_kpa, feedback_kpa, pressure, force_n, force

upper or lower case. Values are kPa unless the name says newton. Rows more than `STATIC_S` apart, each
with a PWM of its own, are settled values; a column `mode` then tells parts that do not belong together,
as inflation and suction. Other rows are a recording over time.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.actuator.identify_pump_models import PumpRecord
from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import read_text, shown
from calib.units import plain_number

__all__ = ["STATIC_S", "PumpTable", "Settled", "read_columns", "read_pump_table"]

STATIC_S = 0.9
_TIME = ("t_s", "time", "time_s", "timestamp", "timestamp_s", "t")
_PWM = ("pwm", "pwm1", "pwm_input", "pwm_main")
_VALUE = ("pressure_kpa", "feedback_kpa", "pressure", "force_n", "force")
_MOST_BAD = 0.05
_FEWEST = 20
_SHORTEST_S = 0.5
_JUMP = 20.0


@dataclass(frozen=True)
class Settled:
    """Settled values (n,) at PWM values (n,), of one mode."""

    name: str
    pwm: FloatArray
    value: FloatArray


@dataclass(frozen=True)
class PumpTable:
    """What a table holds: a recording over time, or settled values by mode; and sentences about it."""

    unit: str
    record: PumpRecord | None
    settled: tuple[Settled, ...]
    said: tuple[str, ...]


def read_columns(path: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, rows of cells, and the number of each row's line in a CSV.

    Raises `BadInputError` for a file without header or rows and for a row of another length.
    """
    header: list[str] = []
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(read_text(path)))
    try:
        for cells in reader:
            if not cells or not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
                continue
            if not header:
                header = [cell.strip() for cell in cells]
                continue
            if len(cells) != len(header):
                raise BadInputError(
                    f"{shown(path)}, line {reader.line_num}: has {len(cells)} cells, expected {len(header)}"
                )
            rows.append(cells)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise BadInputError(
            f"{shown(path)}, line {reader.line_num}: is not comma-separated: {error}"
        ) from error
    if not header:
        raise BadInputError(f"{shown(path)}: is empty, expected a header and rows")
    if not rows:
        raise BadInputError(f"{shown(path)}: has a header but no rows")
    return header, rows, lines


def find_column(path: Path, header: list[str], wanted: str | None, known: tuple[str, ...], what: str) -> int:
    """Index of a column, the one asked for or the first known name."""
    low = [name.lower() for name in header]
    if wanted is not None:
        if wanted.lower() not in low:
            raise BadInputError(f"{shown(path)}: has no column {wanted}, found {', '.join(header)[:120]}")
        return low.index(wanted.lower())
    for name in known:
        if name in low:
            return low.index(name)
    raise BadInputError(
        f"{shown(path)}: has no {what}, found columns {', '.join(header)[:120]}; "
        f"expected for instance {known[0]}"
    )


def number(cell: str, path: Path, line: int, name: str) -> float:
    """A cell as a number, NaN where it is blank or says nan. Raises `BadInputError` for other words."""
    word = cell.strip()
    if not word:
        return math.nan
    value = plain_number(word)
    if value is None:
        raise BadInputError(f"{shown(path)}, line {line}: {name} is {shown(word[:40])!r}, expected a number")
    return value if math.isfinite(value) else math.nan


def read_pump_table(
    path: Path,
    time: str | None = None,
    pwm: str | None = None,
    value: str | None = None,
    unit: str | None = None,
) -> PumpTable:
    """A table of a pump.

    Parameters
    ----------
    time, pwm, value : names of the columns, recognised by default. unit : "kPa" or "N".

    Raises
    ------
    BadInputError for missing columns, text for a number, PWM outside 0 .. 255, time that runs back or
    jumps, and tables that are too short.
    """
    header, rows, lines = read_columns(path)
    what = "pressure or force"
    at = [
        find_column(path, header, wanted, known, name)
        for wanted, known, name in ((time, _TIME, "time"), (pwm, _PWM, "PWM"), (value, _VALUE, what))
    ]
    table = np.array(
        [[number(row[k], path, line, header[k]) for k in at] for row, line in zip(rows, lines, strict=True)]
    )
    said = []
    good = np.isfinite(table).all(axis=1)
    if not good.all():
        bad = int((~good).sum())
        if bad > max(_MOST_BAD * len(table), 1.0) or bad == len(table):
            first = lines[int(np.nonzero(~good)[0][0])]
            raise BadInputError(
                f"{shown(path)}: {bad} of {len(table)} rows have a blank or nan, the first in line {first}, "
                f"expected numbers"
            )
        said.append(f"{shown(path)}: {bad} rows with a blank or nan are left out")
    table, kept = table[good], [k for k in range(len(rows)) if good[k]]
    t, u, y = table.T
    name = shown(path.name)
    if unit is None:
        unit = "N" if header[at[2]].lower().startswith("force") else "kPa"
        if header[at[2]].lower() == "pressure":
            said.append(f"takes the column {header[at[2]]} for kPa")
    outside = np.nonzero((u < 0.0) | (u > 255.0))[0]
    if len(outside):
        line = lines[kept[int(outside[0])]]
        raise BadInputError(f"{shown(path)}, line {line}: PWM is {u[outside[0]]:g}, expected 0 to 255")
    back = np.nonzero(np.diff(t) < 0.0)[0]
    if len(back):
        line = lines[kept[int(back[0]) + 1]]
        raise BadInputError(
            f"{shown(path)}, line {line}: time goes back from {t[back[0]]:g} to {t[back[0] + 1]:g} s"
        )
    if len(t) > 1 and float(np.median(np.diff(t))) >= STATIC_S:
        return PumpTable(unit, None, _settled(name, header, [rows[k] for k in kept], u, y), tuple(said))
    return PumpTable(unit, _record(path, name, t, u, y, [lines[k] for k in kept]), (), tuple(said))


def _settled(
    name: str, header: list[str], rows: list[list[str]], u: FloatArray, y: FloatArray
) -> tuple[Settled, ...]:
    low = [column.lower() for column in header]
    if "mode" not in low:
        return (Settled(name, u, y),)
    modes = [row[low.index("mode")].strip() for row in rows]
    out = []
    for mode in dict.fromkeys(modes):
        mine = np.array([m == mode for m in modes])
        out.append(Settled(f"{name}, {shown(mode)}", u[mine], y[mine]))
    return tuple(out)


def _record(
    path: Path, name: str, t: FloatArray, u: FloatArray, y: FloatArray, lines: list[int]
) -> PumpRecord:
    new = np.concatenate([[True], np.diff(t) > 0.0])
    t, u, y = t[new], u[new], y[new]
    kept = [line for line, keep in zip(lines, new.tolist(), strict=True) if keep]
    if len(t) < _FEWEST or t[-1] - t[0] < _SHORTEST_S:
        span = float(t[-1] - t[0]) if len(t) else 0.0
        raise BadInputError(
            f"{shown(path)}: has {len(t)} rows over {span:.3g} s, expected at least {_FEWEST} rows and "
            f"{_SHORTEST_S:g} s"
        )
    steps = np.diff(t)
    far = np.nonzero(steps > max(_JUMP * float(np.median(steps)), 0.5))[0]
    if len(far):
        k = int(far[0])
        raise BadInputError(
            f"{shown(path)}, line {kept[k + 1]}: time jumps from {t[k]:g} to {t[k + 1]:g} s; "
            "cut the table there"
        )
    return PumpRecord(name, t, u, y)

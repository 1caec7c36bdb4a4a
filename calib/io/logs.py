"""Logs: time stamps with the readings of camera, IMU and pumps, as CSV, Parquet or bags.

A log in text has a header and one row per sample: a time and any of `calib.io.columns.COLUMNS`, in any order,
and under other names and in other units as far as `calib.io.columns` knows them. A blank cell means that this
sensor was not sampled in that row, so a 60 Hz camera and a 100 Hz IMU may interleave. Cells are separated by
commas, semicolons or tabs; where not by commas, numbers may have a decimal comma. The text is UTF-8 or
UTF-16, its lines end as on any system. Times may be dates, as `2024-05-01T12:00:00.25Z`. Other columns are
kept out of the way: they are named in `Log.unknown` and not read. Blank lines and lines that begin with # are
passed over; without a header the last of these, or columns.yaml, names the columns. A cell that says nan or
inf counts as blank; how many there were is in `Log.passed`. A last line that is cut short, as in a log
that is still being written, is left out. Where the time is a counter of 16 or 32 bits that begins again, as
millis() does after 49.7 days and micros() after 71.6 minutes, it is counted on.

Reading goes in blocks, so that a log longer than the memory can be streamed (`iter_log`); `read_log` holds
the whole and refuses more than 200 million cells. What `Log.signals` makes of a log is at the end.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from calib.core.arguments import checked
from calib.core.arrays import BoolArray, FloatArray, IntArray, runs
from calib.core.errors import BadInputError
from calib.core.files import check_readable, is_bag, one_line, shown, to_be
from calib.core.geometry import in_picture
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Finding, Severity
from calib.core.words import BLANK, InWords, Line, Table, all_of, counted, several
from calib.core.words import Block as Words
from calib.core.writing import Kind, column_names, write_atomically
from calib.io.columns import (
    ACCEL,
    ALL_TAKEN,
    COLUMNS,
    GYRO,
    MEASURED,
    POSE,
    PRESSURES,
    TRUE,
    UNITS,
    Block,
    ColumnMap,
    Passed,
    column_map,
    columns_file,
    find_columns,
    kind_of,
    settled,
    turning,
)
from calib.io.tables import GENERAL, TIME, open_text, parquet_blocks, table_bytes, text_blocks
from calib.solve.clock import SPLIT_S, TimeAxis, time_axis

_MOST_CELLS = 200_000_000
"""Numbers that `read_log` takes, 1.6 GB; blocks of text have no such limit."""
_COUNTERS, _DAY_S = (1 << 16, 1 << 32), 86400
_WRAPS_WITHIN = 20.0
"""Usual steps from the last time before a counter begins again to the first one after."""


_BEGINNING = 1000


@dataclass(frozen=True, repr=False)
class Log(InWords):
    """Rows of a log in SI.

    Attributes
    ----------
    source : name for messages.
    t_s : (n,) time stamps [s].
    columns : (n,) values by name, NaN where a cell is blank; only columns that the file has.
    lines : (n,) number of each row's line in the file, or of the row in a table without lines.
    map : where the columns come from; None for a log that was not read from a file.
    unknown : names of the columns that were not read.
    passed : what was not taken as it stands.
    """

    source: str
    t_s: FloatArray
    columns: Mapping[str, FloatArray]
    lines: IntArray
    map: ColumnMap | None = None
    unknown: tuple[str, ...] = ()
    passed: Passed = ALL_TAKEN

    def __len__(self) -> int:
        return len(self.t_s)

    def blocks(self) -> list[Words]:
        """Length, and of each column how many readings it has, the least and the greatest."""
        span = (
            f", {np.nanmin(self.t_s):g} to {np.nanmax(self.t_s):g} s" if np.isfinite(self.t_s).any() else ""
        )
        rows = []
        for name, column in self.columns.items():
            there = column[np.isfinite(column)]
            ends = (f"{end:.6g}" for end in (there.min(), there.max())) if len(there) else (BLANK, BLANK)
            rows.append((name, str(len(there)), *ends))
        table = Table(("column", "readings", "least", "greatest"), tuple(rows))
        return [Line(f"{one_line(self.source)}: {counted(len(self), 'row')}{span}"), table]

    @staticmethod
    @checked
    def load(path: str | Path, options: LogOptions = NOTHING_STATED) -> Log:
        """The log of a file: CSV, Parquet, a bag. Raises `BadInputError` as `read_log`."""
        return read_log(Path(path), options)

    @checked
    def save(self, path: str | Path) -> None:
        """Write as .csv or .parquet; never over a recording. Raises `BadInputError`."""
        write_log(Path(path), self, SIMULATED if set(TRUE) & set(self.columns) else LOG)

    def sampled(self, *names: str, partly: bool = False) -> IntArray:
        """Indices of the rows in which all these columns have a value, or any; none where one is missing."""
        if not names or any(name not in self.columns for name in names):
            return np.zeros(0, dtype=np.int64)
        of = np.logical_or if partly else np.logical_and
        return np.nonzero(of.reduce([np.isfinite(self.columns[name]) for name in names]))[0]

    @property
    def beginning(self) -> dict[str, FloatArray]:
        """The first readings of each sensor by column, which tell one recording from another."""
        read = {
            name: self.columns[name] for name in (*IMU, *_MARKER, *PRESSURES, *POSE) if name in self.columns
        }
        return {name: column[np.isfinite(column)][:_BEGINNING] for name, column in read.items()}

    def unit(self, name: str) -> str:
        """The unit in which a column stands in the file, that of its name for a log that was made up."""
        return self.map.sources[name].unit if self.map is not None else next(iter(UNITS[kind_of(name)]))

    def signals(
        self, *names: str, optional: Sequence[str] = (), counts: bool = False, partly: bool = False
    ) -> Signals:
        """Readings of these columns and of those optional ones that have any.

        Parameters
        ----------
        counts : take columns in counts as they are.
        partly : take rows with a reading in any of the columns, not in all of them.

        Raises
        ------
        BadInputError for columns in counts otherwise, for time that goes back, for a column that is not there
        or holds no number, and for columns that never have a reading in the same row.
        """
        lacking = [name for name in names if name not in self.columns]
        if lacking:
            has = f"has no {all_of(lacking)}, expected {all_of(names)} beside t_s"
            raise BadInputError(f"{self.source}: {has}{self.where_else(*lacking)}")
        blank = [name for name in names if np.isnan(self.columns[name]).all()]
        if blank:
            raise BadInputError(f"{self.source}: {all_of(blank)} hold{'s' * (len(blank) == 1)} no number")
        others = [name for name in optional if name in self.columns and name not in names]
        wanted = (*names, *(name for name in others if np.isfinite(self.columns[name]).any()))
        if not wanted:
            raise BadInputError(f"{self.source}: has no reading of {all_of(optional)}")
        if not counts:
            refuse_counts(self, wanted)
        check_time(self)
        apart = None if partly else _apart(self, wanted)
        log = self if apart is None else apart
        rows = log.sampled(*wanted, partly=partly)
        if len(rows) == 0:
            raise BadInputError(
                f"{log.source}: no row has all of {', '.join(wanted)}, expected them together"
            )
        watch = Watch(tuple(name for name in (*names, *optional) if name in IMU))
        watch.add(log)
        for a, b in watch.held:
            rows = rows[(rows < a) | (rows >= b)]
        values = np.stack([log.columns[name][rows] for name in wanted], axis=1)
        stamps = log.t_s[rows]
        # Of a burst, in which rows of other sensors lie between, both are readings.
        twice = _again(stamps, values.T) & (np.diff(rows) == 1)
        if twice.any():
            kept = np.concatenate([[True], ~twice])
            rows, stamps, values = rows[kept], stamps[kept], values[kept]
        findings = (*watch.findings(stuck=False), *([_APART] if apart is not None else []))
        return Signals(log.source, wanted, stamps, values, rows, log.lines[rows], int(twice.sum()), findings)

    def where_else(self, *names: str) -> str:
        """What to do where one of the columns that are not read holds `names`; empty where all are read."""
        if self.map is None or not self.unknown:
            return ""
        found = several([f"`{one_line(name)[:40]}`" for name in self.unknown])
        lines = f"the line{'s' * (len(names) > 1)} {all_of([f'{name}: NAME' for name in names])}"
        return f"; found {found}, which are not read: if one is meant, add to {self.map.folder} {lines}"

    def remarks(self) -> list[str]:
        """Sentences on what the columns were read as, and on what was not taken as it stands."""
        read_as = self.map.narration if self.map is not None else ""
        return [*([read_as] if read_as else []), *(f"{self.source}: {one}" for one in self.passed.sentences)]


def _logs(columns: ColumnMap, blocks: Iterator[Block]) -> Iterator[Log]:
    """Blocks in SI; the readings of the first tell the units that nobody states."""
    blocks = _counted_on(blocks, columns.evidence.get("time") == "dates")
    first = next((block for block in blocks if len(block.lines)), None)
    if first is None:
        return
    known = settled(columns, first.cells)
    unknown = known.unknown
    for block in chain([first], blocks):
        named = {n: known.sources[n].si(kind_of(n), v) for n, v in block.cells.items() if n != "t_s"}
        t_s = known.sources["t_s"].si("time", block.cells["t_s"])
        yield Log(known.source, t_s, named, block.lines, known, unknown, block.passed)


_MOST = {"accel": 4000.0, "gyro": 140.0, "pixel": 1e5}
"""Twice what the widest cheap accelerometers and gyroscopes read (200 g, 4000 deg/s), and any picture."""
_MARKER = ("u_px", "v_px")
_MOST_OUTSIDE, _SENTINELS = 0.05, 2


def _places(log: Log) -> tuple[IntArray, FloatArray]:
    """Rows (n,) with the marker's place, and the places (n, 2)."""
    rows = log.sampled(*_MARKER)
    at = np.stack([log.columns[name][rows] for name in _MARKER], axis=1) if len(rows) else np.zeros((0, 2))
    return rows, at


def _in_picture(log: Log, size_px: tuple[int, int]) -> Log:
    """The log with blanks for markers outside of pictures of this width and height, and for those at (0, 0).

    Raises `BadInputError` where there are many, unless they hold the same few numbers, as those of a tracker
    that says so that it has lost the marker. No marker has its middle on the pixel in the corner.
    """
    rows, at = _places(log)
    outside = ~in_picture(at, size_px) | ~at.any(axis=1)
    if not outside.any():
        return log
    if outside.mean() > _MOST_OUTSIDE and len(np.unique(at[outside], axis=0)) > _SENTINELS:
        (u, v), line = at[outside][0], log.lines[rows[outside][0]]
        raise BadInputError(
            f"{log.source}, line {line}: the marker is at ({u:g}, {v:g}) px, outside the picture of "
            f"{size_px[0]}x{size_px[1]} px that the camera was calibrated with, as {int(outside.sum())} of "
            f"{len(rows)} times; check resolution, order and signs of u_px and v_px"
        )
    columns = dict(log.columns)
    for name in _MARKER:
        columns[name] = columns[name].copy()
        columns[name][rows[outside]] = np.nan
    return replace(log, columns=columns, passed=log.passed + Passed(outside=int(outside.sum())))


def within(log: Log) -> Log:
    """The log with blanks for cells that no sensor can have given."""
    far = {
        name: np.flatnonzero(np.abs(values) > _MOST.get(kind_of(name), math.inf))
        for name, values in log.columns.items()
        if log.unit(name) != "counts"
    }
    return _blanked(log, far, lambda count, first: Passed(beyond=count, first=first))


def _blanked(log: Log, cells: Mapping[str, IntArray], passed: Callable[[int, str], Passed]) -> Log:
    """The log with blanks for these cells, rows by column; `passed` gets their number and the first one."""
    columns, told = dict(log.columns), log.passed
    for name, rows in cells.items():
        if len(rows):
            told += passed(len(rows), f"{name} is {columns[name][rows[0]]:.6g} in line {log.lines[rows[0]]}")
            columns[name] = columns[name].copy()
            columns[name][rows] = np.nan
    return log if told == log.passed else replace(log, columns=columns, passed=told)


_AROUND, _MOVING_PX = 4, 0.3
"""Pictures before and after one over which the marker's speed is taken, and pixels from one to the next."""
_FEWEST_CHANGES, _IN_PHASE, _REPEATING = 40, 0.97, 0.05
"""How many changes, or pictures in motion, tell that cells are held; share of the changes in one phase; and
share of pictures in motion that repeat above that of whole pixels: below 0 in 24 sound logs."""


def held_places(log: Log) -> str:
    """What shows that cells of the marker's place hold their last value between pictures; empty otherwise.

    Such places are late by up to a period of the camera.
    """
    _, at = _places(log)
    if len(at) <= 2 * _AROUND + _FEWEST_CHANGES:
        return ""
    same = np.concatenate([[False], (np.diff(at, axis=0) == 0.0).all(axis=1)])
    changes = np.flatnonzero(~same)[1:]
    for every in range(2, 11) if len(changes) >= _FEWEST_CHANGES else ():
        if np.bincount(changes % every).max() > _IN_PHASE * len(changes):
            return f"the marker's place changes in one of {every} cells alone, always in step; others hold it"
    before, after = at[_AROUND:-_AROUND] - at[: -2 * _AROUND], at[2 * _AROUND :] - at[_AROUND:-_AROUND]
    # A marker that goes half a pixel stays on its pixel half of the times, without any jitter.
    stays = np.maximum(1.0 - np.abs(before + after) / (2 * _AROUND), 0.0).prod(axis=1)
    # One picture of something else moves on one side of most.
    speed = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) / _AROUND
    moving, repeats = speed > _MOVING_PX, same[_AROUND:-_AROUND]
    if moving.sum() < _FEWEST_CHANGES or np.mean((repeats - stays)[moving]) < _REPEATING:
        return ""
    share = f"{100.0 * repeats[moving].mean():.0f} %"
    return f"{share} of the marker's places repeat where it moves; cells hold it"


_GYRO_RANGES = tuple(math.radians(r) for r in (125.0, 245.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0))
_ACCEL_RANGES = tuple(g * GRAVITY_MPS2 for g in (2.0, 4.0, 8.0, 16.0, 32.0))
_CLIPPED_IN_A_ROW = 3


def clipped(values: FloatArray, gyro: bool) -> BoolArray:
    """Which readings (n,) are at the end of a range that sensors have, where some stay there in a row."""
    out = np.zeros(len(values), dtype=np.bool_)
    known = values[np.isfinite(values)]
    for extreme in (known.max(initial=0.0), known.min(initial=0.0)):
        ends = _GYRO_RANGES if gyro else _ACCEL_RANGES
        if any(0.999 * end <= abs(extreme) <= 1.0005 * end for end in ends):
            held = max((stop - start for start, stop in runs(known == extreme)), default=0)
            out |= (values == extreme) & (held >= _CLIPPED_IN_A_ROW)
    return out


def unclipped(log: Log) -> Log:
    """The log with blanks for readings of the IMU at the end of their range: the truth is beyond."""
    names = (name for name in IMU if name in log.columns and log.unit(name) != "counts")
    end = {name: np.flatnonzero(clipped(log.columns[name], kind_of(name) == "gyro")) for name in names}
    return _blanked(log, end, lambda count, first: Passed(clipped=count, end=first))


def _counted_on(blocks: Iterator[Block], dates: bool) -> Iterator[Block]:
    """Blocks whose times run on where they are those of a counter that begins again, or of the next day."""
    before, size, laps = math.nan, 0, 0
    for block in blocks:
        t = block.cells["t_s"]
        steps = np.diff(t, prepend=before)
        size = size or _counter(t, steps, (_DAY_S,) if dates else _COUNTERS)
        before = float(t[-1]) if len(t) else before
        if size:
            again = steps < -0.5 * size
            ahead = laps + size * np.cumsum(again)
            laps = int(ahead[-1]) if len(t) else laps
            passed = block.passed + Passed(wraps=int(again.sum()))
            block = replace(block, cells={**block.cells, "t_s": t + ahead}, passed=passed)
        yield block


def _counter(t: FloatArray, steps: FloatArray, sizes: Sequence[int]) -> int:
    """Which of the sizes a counter has that times (n,) are those of, where it begins again; 0 otherwise."""
    back, usual = steps[steps < 0.0], steps[steps > 0.0]
    if not len(back) or not len(usual) or (sizes is _COUNTERS and not np.array_equal(t, np.floor(t))):
        return 0
    most = _WRAPS_WITHIN * float(np.median(usual))
    # A counter that is printed as a signed number goes on from minus half its size.
    low, high = (0, 1) if t.min() >= 0.0 else (-0.5, 0.5)
    fits = (n for n in sizes if low * n <= t.min() and t.max() < high * n and (back + n <= most).all())
    return next(fits, 0)


def iter_rows(
    stream: BinaryIO, source: str, path: Path | None = None, options: LogOptions = NOTHING_STATED
) -> Iterator[Log]:
    """Blocks of the rows of a text log that is open; raises as `iter_log`.

    Parameters
    ----------
    path : where it lies, beside which columns.yaml is looked for.
    """
    yield from _logs(*text_blocks(stream, source, path or Path(source), options))


def _iter_csv(path: Path, options: LogOptions) -> Iterator[Log]:
    with to_be("read", path), open_text(path) as stream:
        yield from iter_rows(stream, shown(path), path, options)


def _iter_bag(path: Path, options: LogOptions) -> Iterator[Log]:
    """A bag's rows, of which what its topics and `options` say are the units."""
    from calib.io.bags import bag_blocks

    with bag_blocks(path, options.topics) as (left_out, blocks):
        first = next(blocks)
        columns = column_map(shown(path), path, 1, tuple(first.cells), columns_file(path, options), options)
        yield from (replace(log, unknown=left_out) for log in _logs(columns, chain([first], blocks)))


def log_of(source: str, path: Path, cells: Mapping[str, FloatArray], options: LogOptions) -> Log:
    """A log of columns (n,) by name, `t_s` among them, that were read from a file of another kind.

    Raises `BadInputError` for units that contradict the readings.
    """
    columns = column_map(source, path, 1, tuple(cells), columns_file(path, options), options)
    lines = np.arange(1, len(cells["t_s"]) + 1, dtype=np.int64)
    (log,) = _logs(columns, iter([Block(cells, lines)]))
    return within(log)


def iter_log(
    path: Path,
    options: LogOptions = NOTHING_STATED,
    as_it_is: bool = False,
    picture_px: tuple[int, int] | None = None,
) -> Iterator[Log]:
    """Blocks of a log in turn, each a `Log` of some ten thousand rows at most.

    Text, Parquet, a bag (see `calib.io.bags`), or what a board with the sketch sent (`calib.io.serial`).
    Cells that hold more than any sensor gives count as blank, unless it is wanted `as_it_is`, and so do
    markers outside of the camera's pictures, where their size is known.

    Raises
    ------
    BadInputError
        For a pipe or a device, which may never end; for a file that cannot be read, has no time, a row
        without time or with too few cells, or a cell that is no number, with the number of the line; for
        units that are not known or contradict the readings; for pictures of another size; for a Parquet
        file that unpacks to too much.
    """
    from calib.io.serial import STREAMS, stream_text

    bag, ending = is_bag(path), path.suffix.lower()
    if not bag and path.is_dir():
        parts = sorted(part.name for part in path.iterdir() if part.suffix.lower() in (".db3", ".mcap"))
        if parts:
            raise BadInputError(
                f"{shown(path)}: has no metadata.yaml, which ends the recording of a ROS 2 bag; write it "
                f"with ros2 bag reindex, or give {shown(parts[0])} itself"
            )
    if not (bag and path.is_dir()):
        check_readable(path)
    if not bag and options.topics is not None:
        raise BadInputError(f"{shown(path)}: has columns, expected a bag where topics are given")
    if bag:
        blocks = _iter_bag(path, options)
    elif ending in STREAMS:
        blocks = iter_rows(io.BytesIO(stream_text(path).encode()), shown(path))
    else:
        blocks = _logs(*parquet_blocks(path, options)) if ending == ".parquet" else _iter_csv(path, options)
    if as_it_is:
        return blocks
    return (within(log) if picture_px is None else _in_picture(within(log), picture_px) for log in blocks)


def columns_of(path: Path, options: LogOptions = NOTHING_STATED) -> tuple[str, ...] | None:
    """Columns that a log has by its header, whatever is in them; None where it cannot be told."""
    from calib.io.serial import STREAMS

    try:
        if is_bag(path) or path.suffix.lower() in (".parquet", *STREAMS):
            return tuple(next(iter_log(path, options)).columns)
        check_readable(path)
        with open_text(path) as stream:
            columns, _ = text_blocks(stream, shown(path), path, options)
        return tuple(name for name in columns.sources if name != "t_s")
    except (BadInputError, OSError, StopIteration):
        return None


def beside(path: Path) -> list[Path]:
    """Files beside a log that say what is in it: which topic of a bag is which column, and columns.yaml."""
    from calib.io.bags import find_topics

    found = [find_topics(path) if is_bag(path) else None, find_columns(path)]
    return [one for one in found if one is not None]


def read_log(
    path: Path,
    options: LogOptions = NOTHING_STATED,
    remarks: list[str] | None = None,
    picture_px: tuple[int, int] | None = None,
) -> Log:
    """A whole log, of at most 200 million cells that are read; sentences on it are added to `remarks`.

    Raises `BadInputError` as `iter_log`, and for a log without rows or with more cells.
    """
    blocks, cells = list[Log](), 0
    for block in iter_log(path, options, picture_px=picture_px):
        blocks.append(block)
        cells += len(block) * (2 + len(block.columns))
        if cells > _MOST_CELLS:
            raise BadInputError(
                f"{shown(path)}: has more than {_MOST_CELLS // 1_000_000} million cells, which is more than "
                "is read at once; cut it into parts"
            )
    if not blocks:
        raise BadInputError(f"{shown(path)}: has a header but no rows")
    first = blocks[0]
    log = replace(
        first,
        t_s=np.concatenate([block.t_s for block in blocks]),
        columns={name: np.concatenate([block.columns[name] for block in blocks]) for name in first.columns},
        lines=np.concatenate([block.lines for block in blocks]),
        passed=sum((block.passed for block in blocks), ALL_TAKEN),
    )
    log = in_order(log)
    if remarks is not None:
        remarks += log.remarks()
    return log


def in_order(log: Log) -> Log:
    """The log with rows sorted by time, where those of each writer are in order; else as it is.

    Sensors that are read by threads of their own write rows with columns of their own, as they come.
    """
    late = log.t_s < np.maximum.accumulate(log.t_s)
    if not late.any() or not log.columns:
        return log
    blank = np.stack([np.isnan(column) for column in log.columns.values()], axis=1)
    writer = np.unique(np.packbits(blank, axis=1), axis=0, return_inverse=True)[1].ravel()
    by_writer = np.argsort(writer, kind="stable")
    back = np.diff(log.t_s[by_writer]) < 0.0
    if (back & (np.diff(writer[by_writer]) == 0)).any():
        return log
    return _of_rows(log, np.argsort(log.t_s, kind="stable"), Passed(sorted=int(late.sum())))


def _of_rows(log: Log, rows: IntArray | BoolArray, passed: Passed) -> Log:
    """Some rows of a log, or all in another order, and what that has passed over."""
    columns = {name: column[rows] for name, column in log.columns.items()}
    passed = log.passed + passed
    return replace(log, t_s=log.t_s[rows], columns=columns, lines=log.lines[rows], passed=passed)


def once(log: Log) -> Log:
    """The log without rows that say what the one before says, at its time, which are no other readings."""
    again = _again(log.t_s, log.columns.values())
    if not again.any():
        return log
    return _of_rows(log, np.concatenate([[True], ~again]), Passed(twice=int(again.sum())))


def _again(t_s: FloatArray, columns: Iterable[FloatArray]) -> BoolArray:
    """Which rows (n - 1,) but the first of all say what the one before says, at its time."""
    again: BoolArray = np.diff(t_s) == 0.0
    for column in columns:
        again &= (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
    return again


def log_text(log: Log) -> str:
    """CSV of a log: time to the microsecond, values to nine digits, blank where NaN.

    The columns come in the order of `COLUMNS`. The same log gives the same text.
    """
    names = [name for name in COLUMNS if name in log.columns]
    values = np.column_stack([log.t_s, *(log.columns[name] for name in names)])
    kinds = [TIME] + [GENERAL] * len(names)
    return ",".join(["t_s", *names]) + "\n" + table_bytes(values, kinds).decode()


def _parquet_bytes(log: Log) -> bytes:
    import pyarrow
    from pyarrow import parquet

    table = {"t_s": log.t_s, **{name: log.columns[name] for name in COLUMNS if name in log.columns}}
    sink = io.BytesIO()
    parquet.write_table(
        pyarrow.table({k: pyarrow.array(v, from_pandas=True) for k, v in table.items()}), sink
    )
    return sink.getvalue()


def _holds_log(path: Path) -> bool:
    names = column_names(path)
    return names[0] == "t_s" and set(names[1:]) <= set(COLUMNS)


LOG = Kind("a log", (".csv", ".parquet"), _holds_log, recorded=True)
SIMULATED = Kind("a simulated log", LOG.endings, lambda path: not set(TRUE).isdisjoint(column_names(path)))


def write_log(path: Path, log: Log, kind: Kind | None = None) -> None:
    """Write a log atomically, as Parquet where the name ends so and as CSV otherwise.

    Raises `BadInputError` where the place cannot be written.
    """
    parquet = path.suffix.lower() == ".parquet"
    write_atomically(path, _parquet_bytes(log) if parquet else log_text(log), kind)


# ----------------------------------------------------------------------
# Signals: the readings of a log as arrays, and what is wrong about the sensors that they come from.
#
# `Log.signals` is the way from a log to arrays. It takes the rows in which all the columns that are asked for
# have a reading, drops rows that were written twice, and holds the samples' times to the stamps
# (`calib.solve.clock`). What it finds of sensors that are stuck, absent or turned the wrong way are findings
# for the verdict of whoever uses them; `Watch` finds the same block by block in a log that is streamed.

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
_CHECK_GYRO = "check the gyroscope and its wiring"
_CHECK_IMU = "check the IMU's wiring and the bus that reads it"
_HELD_S, _HELD_CHANCE, _OTHERS_REPEAT = 1.0, 1e-12, 0.5
"""Readings of a whole IMU that are the same for so long, and how likely that is by their steps alone; of one
axis, and the most that other axes of the sensor repeat theirs meanwhile."""
_BIN_S, _BINS, _DEAD = 0.5, 10, 3
_UPRIGHT, _LEAST_MPS2 = 0.75, 3.0
_FELT_RAD, _ANSWERED = 0.03, 0.1
"""2 degrees, RMS: for half a second 0.03 g, of which a gyroscope that works shows more than a tenth."""
_MOST_BIAS_RADPS = 0.35
"""20 deg/s, the zero-rate output that the MPU-6050's data sheet allows."""
_CARRIED_MPS = 0.3
"""What carries a rig without turning it is slower, RMS, and would feel the same as a turn."""
_STUCK_S, _SHAKEN_RAD = 1.0, 0.1
"""A reading that stays the same for so long while the accelerometer is shaken by 0.1 g."""


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        return f"{one_line(self.source)}: {counted(len(self), 'reading')} of {', '.join(self.names)}"

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
        return replace(self, names=tuple(self.names[k] for k in kept), values=self.values[:, kept])


_BEHIND = 4
"""Rows in a row that are earlier than one before them, by which a clock was set back."""


def check_time(log: Log) -> None:
    """Raise `BadInputError` at the first row whose time is earlier than that of the row before."""
    back = np.nonzero(np.diff(log.t_s) < 0.0)[0]
    if len(back):
        i = int(back[0]) + 1
        # Rows in disorder fall back again and again, those after a clock's step stay behind for long.
        below = int(np.count_nonzero(log.t_s < np.maximum.accumulate(log.t_s)))
        once = len(back) == 1 and log.t_s[i - 1] - log.t_s[i] > SPLIT_S
        anew = once or below > _BEHIND * len(back)
        advice = (
            "the recorder has begun anew, or its clock was set: cut the log there"
            if anew
            else "sort its rows"
        )
        raise BadInputError(
            f"{log.source}, line {log.lines[i]}: t_s goes back from {log.t_s[i - 1]:.6f} "
            f"to {log.t_s[i]:.6f}, expected time to run forward; {advice}"
        )


def refuse_counts(log: Log, names: Sequence[str]) -> None:
    """Raise `BadInputError` for the first of these columns that is in counts."""
    for name in names:
        if name in log.columns and log.map is not None and log.unit(name) == "counts":
            column = log.map.sources[name].column
            # An MPU6050's at its finest ranges.
            scale = "unit: g, factor: 6.1e-05" if kind_of(name) == "accel" else "unit: deg/s, factor: 0.00763"
            raise BadInputError(
                f"{log.source}: {name} is in counts, expected a unit; the data sheet or calib imu intrinsics "
                f"has the scale: add it to {log.map.folder}, such as {name}: {{column: {column}, {scale}}}"
            )


_APART = Finding(
    "remark",
    "accelerometer and gyroscope have rows of their own; the accelerometer is read on straight lines between",
)
_FAR_APART = 5.0
"""Steps of the accelerometer from which on what lies between is not known."""


def _apart(log: Log, names: Sequence[str]) -> Log | None:
    """The log with the accelerometer's readings at the gyroscope's times; None where they share their rows.

    Some drivers send each sensor by itself, at a rate of its own.
    """
    accel, gyro = ([name for name in names if kind_of(name) == kind] for kind in ("accel", "gyro"))
    if not accel or not gyro or len(accel) + len(gyro) < len(names):
        return None
    of, at = log.sampled(*accel), log.sampled(*gyro)
    if min(len(of), len(at)) < _FEWEST or 2 * len(log.sampled(*names)) >= min(len(of), len(at)):
        return None
    t, wanted = log.t_s[of], log.t_s[at]
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    known = (wanted >= t[0]) & (wanted <= t[-1])
    known &= t[after] - t[after - 1] <= _FAR_APART * float(np.median(np.diff(t)))
    columns = dict(log.columns)
    for name in accel:
        columns[name] = np.full(len(log), np.nan)
        columns[name][at] = np.where(known, np.interp(wanted, t, log.columns[name][of]), np.nan)
    return replace(log, columns=columns)


@dataclass
class Watch:
    """What the blocks of a log show of its sensors.

    Attributes
    ----------
    names : columns that are used, and so ought to have readings.
    held : rows of the last block, from and to, in which the whole IMU repeats one reading.
    """

    names: tuple[str, ...] = MEASURED
    held: list[tuple[int, int]] = field(default_factory=list)
    _seen: dict[str, tuple[int, float, float]] = field(default_factory=dict)
    _mirrored: Finding | None = None
    _known: bool = False
    _unmoved: Finding | None = None
    _stopped: Finding | None = None
    _stuck: Finding | None = None

    def add(self, log: Log) -> None:
        """Rows that follow."""
        for name in set(self.names) & set(log.columns):
            count, least, most = self._seen.get(name, (0, math.inf, -math.inf))
            finite = log.columns[name][np.isfinite(log.columns[name])]
            if len(finite):
                least, most = min(least, float(finite.min())), max(most, float(finite.max()))
            self._seen[name] = count + len(finite), least, most
        self._stuck = self._stuck or _frozen(log, self.names)
        if all(name in log.columns and name in self.names for name in IN_PLANE):
            if not self._known:
                self._known, self._mirrored = _mirrored(log)
            self._unmoved = self._unmoved or _unmoved(log)
        self.held = _held(log) if set(self.names) & set(IMU) else []
        self._stopped = self._stopped or _stopped(log, self.held)

    def has(self, *names: str) -> bool:
        """Whether each of these columns has a reading."""
        return all(name in self._seen and self._seen[name][0] for name in names)

    def findings(self, stuck: bool = True) -> list[Finding]:
        """What is wrong about the sensors, with `stuck` those among them that never change."""
        out = []
        for name in (name for name in self.names if name in self._seen):
            count, least, most = self._seen[name]
            if not count:
                severity: Severity = "poor" if name in _NEEDED else "remark"
                out.append(Finding(severity, f"{name} has no reading in any row"))
            elif stuck and name in IMU and count >= _FEWEST and least == most:
                text = f"{name} never changes, it is stuck at {least:.6g}"
                out.append(Finding("inconsistent", text, "check the sensor and its wiring"))
        # A reading that never changes is said as that.
        _, least, most = self._seen.get("gz_radps", (0, 0.0, 0.0))
        alive = least != most
        more = (
            self._stopped,
            self._stuck or self._mirrored,
            self._unmoved if alive and not self._stuck else None,
        )
        return [*out, *(one for one in more if one is not None)]


def _held(log: Log) -> list[tuple[int, int]]:
    """Rows, from and to, in which the whole IMU repeats one reading for longer than chance and steps explain.

    Of an IMU with at least one axis of each sensor and three in all; the first of equal readings is not among
    them. A log that never changes has no such rows.
    """
    names = [name for name in IMU if name in log.columns]
    rows = log.sampled(*names)
    if len(names) < 3 or not set(names) & set(ACCEL) or not set(names) & set(GYRO) or len(rows) < _FEWEST:
        return []
    same = np.logical_and.reduce(_repeats(log, names, rows))
    return [(int(rows[a + 1]), int(rows[b]) + 1) for a, b in _lasting(same, log.t_s[rows])]


def _repeats(log: Log, names: Sequence[str], rows: IntArray) -> BoolArray:
    """Whether each of these columns repeats its reading in a row, (names, rows - 1)."""
    values = np.stack([log.columns[name][rows] for name in names])
    return np.asarray(values[:, 1:] == values[:, :-1])


def _lasting(same: BoolArray, t_s: FloatArray) -> list[tuple[int, int]]:
    """Runs of repetitions, from and to, longer than chance and steps explain; none where all are."""
    share = float(same.mean())
    if not 0.0 < share < 1.0:
        return []
    least = max(math.log(_HELD_CHANCE) / math.log(share), _FEWEST)
    return [(a, b) for a, b in runs(same) if b - a >= least and t_s[b] - t_s[a] >= _HELD_S]


def _frozen(log: Log, names: Sequence[str]) -> Finding | None:
    """The first of these columns that repeats one reading while other axes of its sensor go on changing."""
    for sensor in (GYRO, ACCEL):
        axes = [name for name in sensor if name in log.columns]
        rows = log.sampled(*axes)
        if len(axes) < 2 or len(rows) < _FEWEST:
            continue
        same = _repeats(log, axes, rows)
        for k, name in enumerate(axes):
            others = np.delete(same, k, axis=0)
            for a, b in _lasting(same[k], log.t_s[rows]) if name in names else ():
                if others[:, a:b].mean() < _OTHERS_REPEAT:
                    value, stamps = log.columns[name][rows[a]], log.t_s[rows]
                    text = f"{name} is stuck at {value:.6g} from {stamps[a]:.1f} to {stamps[b]:.1f} s"
                    return Finding("inconsistent", f"{text}, while other axes go on changing", _CHECK_IMU)
    return None


def _stopped(log: Log, held: Sequence[tuple[int, int]]) -> Finding | None:
    """That the whole IMU stops answering, where it does."""
    if not held:
        return None
    (a, b), more = held[0], len(held) - 1
    text = f"all readings of the IMU stay the same from {log.t_s[a]:.1f} to {log.t_s[b - 1]:.1f} s"
    text += f" and {more} more time{'s' * (more > 1)}" if more else ""
    return Finding("poor", f"{text}; they tell nothing", _CHECK_IMU)


def _unmoved(log: Log) -> Finding | None:
    """Where the accelerometer moves and the gyroscope is stuck, or does not answer its turns.

    For the latter both angles are averaged over half a second and compared about their straight lines over
    five seconds, which take a bias out; a line that is steeper than a bias is a turn. A sensor that is
    carried without turning feels its acceleration, whose velocity stays small. Of a sensor that tilts the
    angle turns about all three axes (`calib.stages.imu.tracks`); far out of the plane it is none.
    """
    tilts = "az_mps2" in log.columns
    if tilts and not all(name in log.columns for name in IMU):
        return None
    rows = log.sampled(*(IMU if tilts else IN_PLANE))
    if len(rows) < 2 * _FEWEST:
        return None
    t_s = np.maximum.accumulate(log.t_s[rows])
    gz, ax, ay = (log.columns[name][rows] for name in IN_PLANE)
    leant, rate, across = np.unwrap(np.arctan2(ay, ax)), -gz, ax * ax + ay * ay
    upright = across > _LEAST_MPS2**2
    if tilts:
        gx, gy, az = (log.columns[name][rows] for name in ("gx_radps", "gy_radps", "az_mps2"))
        rate = rate + az * (gx * ax + gy * ay) / np.maximum(across, 1e-9)
        upright &= across > _UPRIGHT * (across + az * az)
    turned = np.cumsum(rate * np.diff(t_s, prepend=t_s[0]))
    edges = np.flatnonzero(np.diff(gz, prepend=np.nan, append=np.nan) != 0.0)
    long = np.flatnonzero(np.diff(edges) >= _FEWEST)
    for a, b in zip(edges[long].tolist(), edges[long + 1].tolist(), strict=True):
        lasting = t_s[b - 1] - t_s[a] >= _STUCK_S and upright[a:b].mean() > 0.9
        if lasting and float(leant[a:b].std()) > _SHAKEN_RAD:
            return Finding(
                "inconsistent",
                f"gz_radps is stuck at {gz[a]:.6g} from {t_s[a]:.1f} to {t_s[b - 1]:.1f} s, where the "
                "accelerometer moves",
                _CHECK_GYRO,
            )
    starts = np.flatnonzero(np.diff(np.floor((t_s - t_s[0]) / _BIN_S), prepend=-1.0))
    size = np.diff(np.append(starts, len(t_s)))
    if len(starts) < _BINS:
        return None
    bins = np.stack([np.add.reduceat(x, starts) / size for x in (t_s, leant, turned, upright)])
    windows = np.lib.stride_tricks.sliding_window_view(bins, _BINS, axis=1).transpose(1, 0, 2)
    t, angles, flat = windows[:, 0], windows[:, 1:3], windows[:, 3].min(axis=1) > 0.9
    flat &= t[:, -1] - t[:, 0] < 2.0 * _BINS * _BIN_S
    k = t - t.mean(axis=1, keepdims=True)
    angles = angles - angles.mean(axis=2, keepdims=True)
    slope = np.einsum("wt,wat->wa", k, angles) / np.maximum((k * k).sum(axis=1), 1e-12)[:, None]
    angles = angles - slope[:, :, None] * k[:, None, :]
    felt_rad, turned_rad = angles.std(axis=2).T
    carried_mps = GRAVITY_MPS2 * _BIN_S * np.cumsum(angles[:, 0], axis=1).std(axis=1)
    felt, answered = flat & (felt_rad > _FELT_RAD), turned_rad >= _ANSWERED * felt_rad
    still = (carried_mps > _CARRIED_MPS) & (np.abs(slope[:, 1]) < _MOST_BIAS_RADPS)
    dead = np.flatnonzero(felt & ~answered & still)
    # In hours of handling some push looks like a turn: in few windows, or between turns that are answered.
    if len(dead) < min(_DEAD, len(felt)):
        return None
    if np.count_nonzero((felt & answered)[dead[0] : dead[-1]]) > len(dead):
        return None
    most = dead[np.argmax(felt_rad[dead])]
    return Finding(
        "inconsistent",
        f"gz_radps does not turn from {t_s[starts[dead[0]]]:.1f} s on where the accelerometer's angle "
        f"turns, by {math.degrees(felt_rad[most]):.2g} deg at about {t[most].mean():.0f} s",
        _CHECK_GYRO,
    )


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

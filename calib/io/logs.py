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
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from calib.core.arguments import checked
from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.files import check_readable, is_bag, one_line, shown, to_be
from calib.core.geometry import in_picture
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.verdict import Finding
from calib.core.words import BLANK, InWords, Line, Table, all_of, counted, several
from calib.core.words import Block as Words
from calib.core.writing import Kind, column_names, write_atomically
from calib.io import tables
from calib.io.columns import (
    COLUMNS,
    IMU,
    MARKER,
    POSE,
    PRESSURES,
    TRUE,
    ColumnMap,
    column_map,
    columns_file,
    find_columns,
    kind_of,
    own_unit,
)
from calib.io.inferred_units import infer_units
from calib.io.sensor_faults import FEWEST, Watch, at_range_end, marker_places
from calib.io.tables import Block, Passed
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
    passed: Passed = tables.ALL_TAKEN

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
            name: self.columns[name] for name in (*IMU, *MARKER, *PRESSURES, *POSE) if name in self.columns
        }
        return {name: column[np.isfinite(column)][:_BEGINNING] for name, column in read.items()}

    def unit(self, name: str) -> str:
        """The unit in which a column stands in the file, that of its name for a log that was made up."""
        return self.map.sources[name].unit if self.map is not None else own_unit(name)

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
        apart = None if partly else _accel_at_gyro_times(self, wanted)
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
        twice = _repeats_row_before(stamps, values.T) & (np.diff(rows) == 1)
        if twice.any():
            kept = np.concatenate([[True], ~twice])
            rows, stamps, values = rows[kept], stamps[kept], values[kept]
        if not set(wanted) & set(IMU):
            stamps = _stamps_in_bursts(self, rows, stamps)
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


def _in_si(columns: ColumnMap, blocks: Iterator[Block]) -> Iterator[Log]:
    """Blocks in SI; the readings of the first tell the units that nobody states."""
    blocks = _unwrap_time(blocks, columns.evidence.get("time") == "dates")
    first = next((block for block in blocks if len(block.lines)), None)
    if first is None:
        return
    known = infer_units(columns, first.cells)
    unknown = known.unknown
    for block in chain([first], blocks):
        named = {n: known.sources[n].si(kind_of(n), v) for n, v in block.cells.items() if n != "t_s"}
        t_s = known.sources["t_s"].si("time", block.cells["t_s"])
        yield Log(known.source, t_s, named, block.lines, known, unknown, block.passed)


_MOST = {"accel": 4000.0, "gyro": 140.0, "pixel": 1e5}
"""Twice what the widest cheap accelerometers and gyroscopes read (200 g, 4000 deg/s), and any picture."""
_MOST_OUTSIDE, _SENTINELS = 0.05, 2


def _blank_outside_picture(log: Log, size_px: tuple[int, int]) -> Log:
    """The log with blanks for markers outside of pictures of this width and height, and for those at (0, 0).

    Raises `BadInputError` where there are many, unless they hold the same few numbers, as those of a tracker
    that says so that it has lost the marker. No marker has its middle on the pixel in the corner.
    """
    rows, at = marker_places(log)
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
    for name in MARKER:
        columns[name] = columns[name].copy()
        columns[name][rows[outside]] = np.nan
    return replace(log, columns=columns, passed=log.passed + Passed(outside=int(outside.sum())))


def blank_impossible(log: Log) -> Log:
    """The log with blanks for cells that no sensor can have given."""
    far = {
        name: np.flatnonzero(np.abs(values) > _MOST.get(kind_of(name), math.inf))
        for name, values in log.columns.items()
        if log.unit(name) != "counts"
    }
    return _blanked(log, far, lambda count, first: Passed(implausible=count, first_implausible=first))


def _blanked(log: Log, cells: Mapping[str, IntArray], passed: Callable[[int, str], Passed]) -> Log:
    """The log with blanks for these cells, rows by column; `passed` gets their number and the first one."""
    columns, told = dict(log.columns), log.passed
    for name, rows in cells.items():
        if len(rows):
            told += passed(len(rows), f"{name} is {columns[name][rows[0]]:.6g} in line {log.lines[rows[0]]}")
            columns[name] = columns[name].copy()
            columns[name][rows] = np.nan
    return log if told == log.passed else replace(log, columns=columns, passed=told)


def blank_clipped(log: Log) -> Log:
    """The log with blanks for readings of the IMU at the end of their range: the truth is beyond."""
    names = (name for name in IMU if name in log.columns and log.unit(name) != "counts")
    end = {name: np.flatnonzero(at_range_end(log.columns[name], kind_of(name) == "gyro")) for name in names}
    return _blanked(log, end, lambda count, first: Passed(clipped=count, first_clipped=first))


def _unwrap_time(blocks: Iterator[Block], dates: bool) -> Iterator[Block]:
    """Blocks whose times run on where they are those of a counter that begins again, or of the next day."""
    before, size, laps = math.nan, 0, 0
    for block in blocks:
        t = block.cells["t_s"]
        steps = np.diff(t, prepend=before)
        size = size or _counter_size(t, steps, (_DAY_S,) if dates else _COUNTERS)
        before = float(t[-1]) if len(t) else before
        if size:
            again = steps < -0.5 * size
            ahead = laps + size * np.cumsum(again)
            laps = int(ahead[-1]) if len(t) else laps
            passed = block.passed + Passed(wraps=int(again.sum()))
            block = replace(block, cells={**block.cells, "t_s": t + ahead}, passed=passed)
        yield block


def _counter_size(t: FloatArray, steps: FloatArray, sizes: Sequence[int]) -> int:
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
    yield from _in_si(*tables.text_blocks(stream, source, path or Path(source), options))


def _iter_csv(path: Path, options: LogOptions) -> Iterator[Log]:
    with to_be("read", path), tables.open_text(path) as stream:
        yield from iter_rows(stream, shown(path), path, options)


def _iter_bag(path: Path, options: LogOptions) -> Iterator[Log]:
    """A bag's rows, of which what its topics and `options` say are the units."""
    from calib.io.bags import bag_blocks

    with bag_blocks(path, options.topics) as (left_out, blocks):
        first = next(blocks)
        columns = column_map(shown(path), path, 1, tuple(first.cells), columns_file(path, options), options)
        yield from (replace(log, unknown=left_out) for log in _in_si(columns, chain([first], blocks)))


def log_from_cells(source: str, path: Path, cells: Mapping[str, FloatArray], options: LogOptions) -> Log:
    """A log of columns (n,) by name, `t_s` among them, that were read from a file of another kind.

    Raises `BadInputError` for units that contradict the readings.
    """
    columns = column_map(source, path, 1, tuple(cells), columns_file(path, options), options)
    lines = np.arange(1, len(cells["t_s"]) + 1, dtype=np.int64)
    (log,) = _in_si(columns, iter([Block(cells, lines)]))
    return blank_impossible(log)


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
    elif ending == ".parquet":
        blocks = _in_si(*tables.parquet_blocks(path, options))
    else:
        blocks = _iter_csv(path, options)
    if as_it_is:
        return blocks
    return (
        blank_impossible(log)
        if picture_px is None
        else _blank_outside_picture(blank_impossible(log), picture_px)
        for log in blocks
    )


def read_column_names(path: Path, options: LogOptions = NOTHING_STATED) -> tuple[str, ...] | None:
    """Columns that a log has by its header, whatever is in them; None where it cannot be told."""
    from calib.io.serial import STREAMS

    try:
        if is_bag(path) or path.suffix.lower() in (".parquet", *STREAMS):
            return tuple(next(iter_log(path, options)).columns)
        check_readable(path)
        with tables.open_text(path) as stream:
            columns, _ = tables.text_blocks(stream, shown(path), path, options)
        return tuple(name for name in columns.sources if name != "t_s")
    except (BadInputError, OSError, StopIteration):
        return None


def companion_files(path: Path) -> list[Path]:
    """Files beside a log that say what is in it: which topic of a bag is which column, and columns.yaml."""
    from calib.io.bag_topics import find_topics

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
        passed=sum((block.passed for block in blocks), tables.ALL_TAKEN),
    )
    log = sort_rows(log)
    if remarks is not None:
        remarks += log.remarks()
    return log


def sort_rows(log: Log) -> Log:
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
    return _select_rows(log, np.argsort(log.t_s, kind="stable"), Passed(reordered=int(late.sum())))


def _select_rows(log: Log, rows: IntArray | BoolArray, passed: Passed) -> Log:
    """Some rows of a log, or all in another order, and what that has passed over."""
    columns = {name: column[rows] for name, column in log.columns.items()}
    passed = log.passed + passed
    return replace(log, t_s=log.t_s[rows], columns=columns, lines=log.lines[rows], passed=passed)


def drop_repeated_rows(log: Log) -> Log:
    """The log without rows that say what the one before says, at its time, which are no other readings."""
    again = _repeats_row_before(log.t_s, log.columns.values())
    if not again.any():
        return log
    return _select_rows(log, np.concatenate([[True], ~again]), Passed(repeated=int(again.sum())))


def _repeats_row_before(t_s: FloatArray, columns: Iterable[FloatArray]) -> BoolArray:
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
    kinds = [tables.TIME] + [tables.GENERAL] * len(names)
    return ",".join(["t_s", *names]) + "\n" + tables.table_bytes(values, kinds).decode()


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
# Signals: the readings of a log as arrays.
#
# `Log.signals` is the way from a log to arrays. It takes the rows in which all the columns that are asked for
# have a reading, drops rows that were written twice, and holds the samples' times to the stamps
# (`calib.solve.clock`). What it finds of sensors that are stuck, absent or turned the wrong way
# (`calib.io.sensor_faults`) are findings for the verdict of whoever uses them.


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
        many = np.isfinite(self.values).sum(axis=0) >= FEWEST
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
_IN_BURSTS = 0.25
"""Share of samples that bear the stamp of the one before."""
_FAR_APART = 5.0
"""Steps of the accelerometer from which on what lies between is not known."""


def _stamps_in_bursts(log: Log, rows: IntArray, stamps_s: FloatArray) -> FloatArray:
    """Stamps of rows (n,), of those that hold an IMU sample too its time, where these come in bursts.

    All rows of a burst bear the stamp of the last one, a picture among them like the sample beside it.
    """
    felt = log.sampled(*(name for name in IMU if name in log.columns), partly=True)
    beside = np.isin(rows, felt, assume_unique=True)
    if not beside.any() or float(np.mean(np.diff(log.t_s[felt]) == 0.0)) < _IN_BURSTS:
        return stamps_s
    axis = time_axis(log.t_s[felt])
    if axis.burst == 1:
        return stamps_s
    times = np.where(beside, axis.t_s[np.searchsorted(felt, rows).clip(max=len(felt) - 1)], stamps_s)
    return np.asarray(np.maximum.accumulate(times))


def _accel_at_gyro_times(log: Log, names: Sequence[str]) -> Log | None:
    """The log with the accelerometer's readings at the gyroscope's times; None where they share their rows.

    Some drivers send each sensor by itself, at a rate of its own.
    """
    accel, gyro = ([name for name in names if kind_of(name) == kind] for kind in ("accel", "gyro"))
    if not accel or not gyro or len(accel) + len(gyro) < len(names):
        return None
    of, at = log.sampled(*accel), log.sampled(*gyro)
    if min(len(of), len(at)) < FEWEST or 2 * len(log.sampled(*names)) >= min(len(of), len(at)):
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

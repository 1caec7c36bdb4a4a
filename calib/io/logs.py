"""Logs: time stamps with the readings of camera, IMU and pumps, as CSV, Parquet or bags.

A CSV log has a header and one row per sample: `t_s` and any of `COLUMNS`, in any order. A blank cell means
that this sensor was not sampled in that row, so a 60 Hz camera and a 100 Hz IMU may interleave. Columns of
other names are kept out of the way: they are named in `Log.unknown` and not read. Blank lines and lines
that begin with # are passed over. A cell that says nan or inf counts as blank; how many there were is in
`Log.not_finite`. A last line that is cut short, as in a log that is still being written, is left out.

Nothing is said here about whether the numbers make sense; `check_time` is there for verbs that need
time to run forward.

Reading goes in blocks, so that a log longer than the memory can be streamed (`iter_log`); `read_log`
holds the whole and refuses more than 200 million cells.
"""

from __future__ import annotations

import csv
import importlib
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError, pip_install
from calib.core.files import shown, write_atomically
from calib.core.units import plain_number

MEASURED = (
    "u_px",
    "v_px",
    "ax_mps2",
    "ay_mps2",
    "az_mps2",
    "gx_radps",
    "gy_radps",
    "gz_radps",
    "pwm1",
    "pwm2",
    "onchip_phi_rad",
)
"""What a rig logs; `u_px, v_px` is the marker in distorted pixels, `onchip_phi_rad` the IMU's own angle."""

TRUE = ("true_q1_m", "true_q2_m", "true_phi_rad", "true_x_m", "true_y_m")
"""What only the simulated rig knows, at the row's `t_s`; (x, y) is the head. For scoring."""

COLUMNS = (*MEASURED, *TRUE)

BLANK = " and count as blank"
ROWS_MISSING = "; their rows count as missing"
"""What cells that are not finite count as, for `Log.passed_over`."""

_BLOCK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 16
_MAX_COLUMNS = 1000
_MOST_CELLS = 200_000_000
"""Numbers that `read_log` takes, 1.6 GB; blocks have no such limit."""


def passed_over(not_finite: int, truncated: bool, counts: str = BLANK) -> list[str]:
    """Sentences on cells that are not finite, with what they count as, and on a last line cut short."""
    said = [f"{not_finite} cells say nan or inf{counts}"] if not_finite else []
    return [*said, "the last line is cut short and left out"] if truncated else said


@dataclass(frozen=True)
class Log:
    """Rows of a log.

    Attributes
    ----------
    source : name for messages.
    t_s : (n,) time stamps [s], as they are in the file.
    columns : (n,) values by name, NaN where a cell is blank; only columns that the file has.
    lines : (n,) number of each row's line in the file, or of the row in a table without lines.
    unknown : names of the columns that were not read.
    not_finite : cells that said nan or inf; in Parquet nan is a blank.
    truncated : whether the last line was cut short and left out.
    """

    source: str
    t_s: FloatArray
    columns: Mapping[str, FloatArray]
    lines: IntArray
    unknown: tuple[str, ...] = ()
    not_finite: int = 0
    truncated: bool = False

    def __len__(self) -> int:
        return len(self.t_s)

    def sampled(self, *names: str) -> IntArray:
        """Indices of the rows in which all these columns have a value; none where one is missing."""
        if not names or any(name not in self.columns for name in names):
            return np.zeros(0, dtype=np.int64)
        return np.nonzero(np.logical_and.reduce([~np.isnan(self.columns[name]) for name in names]))[0]

    def passed_over(self, counts: str = BLANK) -> list[str]:
        """Sentences on cells that are not finite, with what they count as, and on a last line cut short."""
        return [f"{self.source}: {one}" for one in passed_over(self.not_finite, self.truncated, counts)]


def check_time(log: Log) -> None:
    """Raise `BadInputError` at the first row whose time is earlier than that of the row before."""
    back = np.nonzero(np.diff(log.t_s) < 0.0)[0]
    if len(back):
        i = int(back[0]) + 1
        raise BadInputError(
            f"{log.source}, line {log.lines[i]}: t_s goes back from {log.t_s[i - 1]:.6f} "
            f"to {log.t_s[i]:.6f}, expected time to run forward"
        )


@dataclass(frozen=True)
class _Layout:
    """Which column of the file goes where."""

    source: str
    header: tuple[str, ...]
    known: tuple[str, ...]
    slots: IntArray

    @property
    def unknown(self) -> tuple[str, ...]:
        return tuple(name for name in self.header if name not in self.known)


def _layout(source: str, line: int, header: Iterable[str]) -> _Layout:
    names = tuple(name.strip() for name in header)
    if len(names) > _MAX_COLUMNS:
        raise BadInputError(
            f"{source}, line {line}: has {len(names)} columns, expected at most {_MAX_COLUMNS}"
        )
    for name in ("t_s", *COLUMNS):
        if names.count(name) > 1:
            raise BadInputError(f"{source}, line {line}: has the column {name} twice")
    if "t_s" not in names:
        found = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        hint = ""
        if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
            hint = " (columns are separated by commas)"
        raise BadInputError(f"{source}, line {line}: has no column t_s, found {shown(found[:200])!r}{hint}")
    known = ("t_s", *(name for name in COLUMNS if name in names))
    slots = np.array([known.index(name) if name in known else -1 for name in names], dtype=np.int64)
    return _Layout(source, names, known, slots)


def _number(layout: _Layout, text: str, slot: int, line: int) -> float:
    """A cell that is not a plain number: NaN for blank, inf for what says nan or inf."""
    word = text.strip()
    if not word:
        return math.nan
    value = plain_number(word)
    if value is None:
        raise BadInputError(
            f"{layout.source}, line {line}: {layout.known[slot]} is {shown(word[:40])!r}, expected a number"
        )
    return value if math.isfinite(value) else math.inf


def _cells(layout: _Layout, text: str, line: int) -> list[str]:
    try:
        cells = next(csv.reader([text], strict=True))
    except (csv.Error, StopIteration) as error:
        raise BadInputError(f"{layout.source}, line {line}: is not comma-separated: {error}") from error
    if len(cells) != len(layout.header):
        raise BadInputError(
            f"{layout.source}, line {line}: has {len(cells)} cells, "
            f"expected {len(layout.header)} as in the header"
        )
    return cells


def _block(layout: _Layout, text: bytes, first_line: int) -> tuple[Log, int]:
    """Rows of whole lines, and the number of the next line."""
    from calib.io.cells import POWERS, scan

    raw = np.frombuffer(text, dtype=np.uint8)
    most = text.count(b"\n")
    values = np.empty((most, len(layout.known)))
    lines = np.empty(most, dtype=np.int64)
    odd = np.empty((text.count(b",") + most + 1, 4), dtype=np.int64)
    rows, passed, strange = scan(raw, layout.slots, POWERS, values, lines, odd)
    values, lines = values[:rows], lines[:rows] + first_line
    for row, slot, start, end in odd[:strange].tolist():
        piece, line = text[start:end].decode("utf-8", "replace"), int(lines[row])
        if slot >= 0:
            values[row, slot] = _number(layout, piece, slot, line)
            continue
        for at, cell in zip(layout.slots.tolist(), _cells(layout, piece.rstrip("\r"), line), strict=True):
            if at >= 0:
                values[row, at] = _number(layout, cell, at, line)
    return _log(layout, values, lines), first_line + passed


def _log(layout: _Layout, values: FloatArray, lines: IntArray) -> Log:
    bad = np.nonzero(~np.isfinite(values[:, 0]))[0]
    if len(bad):
        raise BadInputError(f"{layout.source}, line {lines[bad[0]]}: has no time t_s, expected a number")
    # Blank cells are NaN already; words that say nan or inf were read as inf to tell them apart.
    infinite = np.isinf(values)
    values = np.where(infinite, np.nan, values)
    columns = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(layout.known) if k > 0}
    return Log(
        layout.source,
        np.ascontiguousarray(values[:, 0]),
        columns,
        lines,
        layout.unknown,
        int(infinite.sum()),
    )


def _header(stream: BinaryIO, source: str) -> tuple[_Layout, int]:
    """The layout by the first line that is neither blank nor a comment, and the number of the next."""
    line, raw = 1, stream.readline(_LONGEST_LINE)
    while raw.endswith(b"\n") and (not raw.strip() or raw.lstrip(b"\xef\xbb\xbf").startswith(b"#")):
        line, raw = line + 1, stream.readline(_LONGEST_LINE)
    where = f"{source}, line {line}"
    if not raw.strip():
        raise BadInputError(f"{source}: is empty, expected a header and rows")
    if len(raw) == _LONGEST_LINE and not raw.endswith(b"\n"):
        raise BadInputError(f"{where}: has more than {_LONGEST_LINE} characters, expected a header")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{where}: is not UTF-8 text (byte {error.start}), expected a header") from error
    if "\0" in text:
        raise BadInputError(f"{where}: has a zero byte, expected a text file")
    try:
        return _layout(source, line, next(csv.reader([text.rstrip("\r\n")], strict=True))), line + 1
    except csv.Error as error:
        raise BadInputError(f"{where}: is not comma-separated: {error}") from error


def iter_rows(stream: BinaryIO, source: str) -> Iterator[Log]:
    """Blocks of the rows of a CSV log that is open; raises as `iter_log`."""
    layout, line = _header(stream, source)
    rest = b""
    while data := stream.read(_BLOCK_BYTES):
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            rest += data
            if len(rest) > 2 * _BLOCK_BYTES:
                raise BadInputError(f"{source}, line {line}: does not end, expected a text file")
            continue
        block, line = _block(layout, rest + data[:cut], line)
        rest = data[cut:]
        if len(block):
            yield block
    if rest.strip():
        yield _last(layout, rest, line)


def _iter_csv(path: Path) -> Iterator[Log]:
    try:
        with path.open("rb") as stream:
            yield from iter_rows(stream, shown(path))
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error


def _last(layout: _Layout, text: bytes, line: int) -> Log:
    """The last line without its end: a row, or the beginning of one."""
    nothing = _log(layout, np.empty((0, len(layout.known))), np.empty(0, dtype=np.int64))
    if text.count(b",") < len(layout.header) - 1:
        return replace(nothing, truncated=True)
    return _block(layout, text + b"\n", line)[0]


def _iter_parquet(path: Path) -> Iterator[Log]:
    source = shown(path)
    try:
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise BadInputError(f"{source}: reading Parquet needs pyarrow: {pip_install('logs')}") from error
    try:
        file = parquet.ParquetFile(path, pre_buffer=False)
        layout = _layout(source, 1, file.schema_arrow.names)
        first = 1
        for batch in file.iter_batches(batch_size=65536, columns=list(layout.known)):
            columns = [_parquet_column(layout, batch.column(name), name) for name in layout.known]
            values = np.stack(columns, axis=1)
            values[:, 1:][np.isneginf(values[:, 1:])] = np.inf
            yield _log(layout, values, np.arange(first, first + len(values), dtype=np.int64))
            first += len(values)
    except (OSError, ValueError) as error:
        if isinstance(error, BadInputError):
            raise
        raise BadInputError(f"{source}: is not a Parquet file that can be read: {error}") from error


def _parquet_column(layout: _Layout, column: Any, name: str) -> FloatArray:
    try:
        return np.asarray(column.cast("float64").to_numpy(zero_copy_only=False), dtype=np.float64)
    except Exception as error:
        raise BadInputError(f"{layout.source}: {name} holds {column.type}, expected numbers") from error


def iter_log(path: Path, topics: Path | None = None) -> Iterator[Log]:
    """Blocks of a log in turn, each a `Log` of some ten thousand rows at most; a block may have none.

    CSV, Parquet, a bag (see `calib.io.bags`), of which `topics` may say what is where, or what a board with
    the sketch sent (`calib.io.serial`).

    Raises
    ------
    BadInputError
        For a file that cannot be read, has no `t_s`, a row without time or with too few cells, or a cell
        that is no number: with the number of the line.
    """
    from calib.io.bags import is_bag, iter_bag
    from calib.io.serial import STREAMS, iter_stream

    if is_bag(path):
        return iter_bag(path, topics)
    if topics is not None:
        raise BadInputError(f"{shown(path)}: has columns, expected a bag where topics are given")
    ending = path.suffix.lower()
    if ending in STREAMS:
        return iter_stream(path)
    return _iter_parquet(path) if ending == ".parquet" else _iter_csv(path)


def read_log(path: Path, topics: Path | None = None) -> Log:
    """A whole log, of at most 200 million cells that are read.

    Raises `BadInputError` as `iter_log`, and for a log without rows or with more cells.
    """
    blocks, cells = list[Log](), 0
    for block in iter_log(path, topics):
        blocks.append(block)
        cells += len(block) * (2 + len(block.columns))
        if cells > _MOST_CELLS:
            raise BadInputError(
                f"{shown(path)}: has more than {_MOST_CELLS // 1_000_000} million cells, which is more than "
                "is read at once; cut it into parts"
            )
    if not sum(len(block) for block in blocks):
        raise BadInputError(f"{shown(path)}: has a header but no rows")
    first = blocks[0]
    return Log(
        first.source,
        np.concatenate([block.t_s for block in blocks]),
        {name: np.concatenate([block.columns[name] for block in blocks]) for name in first.columns},
        np.concatenate([block.lines for block in blocks]),
        first.unknown,
        sum(block.not_finite for block in blocks),
        blocks[-1].truncated,
    )


def log_text(log: Log) -> str:
    """CSV of a log: time to the microsecond, values to nine digits, blank where NaN.

    The columns come in the order of `COLUMNS`. The same log gives the same text.
    """
    from calib.io.cells import GENERAL, TIME, table_bytes

    names = [name for name in COLUMNS if name in log.columns]
    values = np.column_stack([log.t_s, *(log.columns[name] for name in names)])
    kinds = np.array([TIME] + [GENERAL] * len(names))
    return ",".join(["t_s", *names]) + "\n" + table_bytes(values, kinds).decode()


def _parquet_bytes(log: Log, path: Path) -> bytes:
    try:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise BadInputError(f"{shown(path)}: writing Parquet needs pyarrow: {pip_install('logs')}") from error
    table = {"t_s": log.t_s, **{name: log.columns[name] for name in COLUMNS if name in log.columns}}
    sink = io.BytesIO()
    parquet.write_table(arrow.table({k: arrow.array(v, from_pandas=True) for k, v in table.items()}), sink)
    return sink.getvalue()


def write_log(path: Path, log: Log) -> None:
    """Write a log atomically, as Parquet where the name ends so and as CSV otherwise.

    Raises `BadInputError` where the place cannot be written.
    """
    parquet = path.suffix.lower() == ".parquet"
    write_atomically(path, _parquet_bytes(log, path) if parquet else log_text(log))

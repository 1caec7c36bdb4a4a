"""Logs: time stamps with the readings of camera, IMU and pumps, as CSV, Parquet or bags.

A log in text has a header and one row per sample: a time and any of `calib.io.columns.COLUMNS`, in any order,
and under other names and in other units as far as `calib.io.columns` knows them. A blank cell means that this
sensor was not sampled in that row, so a 60 Hz camera and a 100 Hz IMU may interleave. Cells are separated by
commas, semicolons or tabs; where not by commas, numbers may have a decimal comma. The text is UTF-8 or
UTF-16, its lines end as on any system. Times may be dates, as `2024-05-01T12:00:00.25Z`. Other columns are
kept out of the way: they are named in `Log.unknown` and not read. Blank lines and lines that begin with # are
passed over; without a header the last of these, or columns.yaml, names the columns. A cell that says nan or
inf counts as blank; how many there were is in `Log.not_finite`. A last line that is cut short, as in a log
that is still being written, is left out. Where the time is a counter of 16 or 32 bits that begins again, as
millis() does after 49.7 days and micros() after 71.6 minutes, it is counted on.

Reading goes in blocks, so that a log longer than the memory can be streamed (`iter_log`); `read_log` holds
the whole and refuses more than 200 million cells. Text is parsed by pyarrow; a block that it declines is
read line by line, which gives the same numbers, or a sentence with the number of the line.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.files import check_readable, shown
from calib.core.stage import NOTHING_STATED, LogOptions
from calib.core.units import plain_number
from calib.core.writing import Kind, column_names, write_atomically
from calib.io.columns import (
    COLUMNS,
    TRUE,
    UNITS,
    ColumnMap,
    ColumnsFile,
    column_map,
    find_columns,
    kind_of,
    known_name,
    read_columns_file,
    settled,
)

if TYPE_CHECKING:
    from calib.io.signals import Signals

_BLOCK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 16
_MAX_COLUMNS = 1000
_MOST_CELLS = 200_000_000
"""Numbers that `read_log` takes, 1.6 GB; blocks of text have no such limit."""
_COUNTERS = (1 << 16, 1 << 32)
_WRAPS_WITHIN = 20.0
"""Usual steps from the last time before a counter begins again to the first one after."""
_MOST_BYTES, _MOST_GROWTH = 1 << 28, 200
"""What a Parquet file may unpack to: so many bytes, or so many times its own size where that is more."""


def passed_over(not_finite: int, truncated: bool, wraps: int) -> list[str]:
    """Sentences on cells that are not finite, on a last line cut short, on a time that begins again."""
    return [
        *([f"{not_finite} cells say nan or inf and count as blank"] if not_finite else []),
        *(["the last line is cut short and left out"] if truncated else []),
        *([f"the time is a counter that begins again {wraps} times, and is counted on"] if wraps else []),
    ]


@dataclass(frozen=True)
class Log:
    """Rows of a log in SI.

    Attributes
    ----------
    source : name for messages.
    t_s : (n,) time stamps [s].
    columns : (n,) values by name, NaN where a cell is blank; only columns that the file has.
    lines : (n,) number of each row's line in the file, or of the row in a table without lines.
    map : where the columns come from; None for a log that was not read from a file.
    unknown : names of the columns that were not read.
    not_finite : cells that said nan or inf; in Parquet nan is a blank.
    truncated : whether the last line was cut short and left out.
    wraps : how often the counter that is the time began again.
    """

    source: str
    t_s: FloatArray
    columns: Mapping[str, FloatArray]
    lines: IntArray
    map: ColumnMap | None = None
    unknown: tuple[str, ...] = ()
    not_finite: int = 0
    truncated: bool = False
    wraps: int = 0

    def __len__(self) -> int:
        return len(self.t_s)

    @staticmethod
    def load(path: str | Path, options: LogOptions = NOTHING_STATED) -> Log:
        """The log of a file: CSV, Parquet, a bag. Raises `BadInputError` as `read_log`."""
        return read_log(Path(path), options)

    def save(self, path: str | Path) -> None:
        """Write as .csv or .parquet; never over a recording. Raises `BadInputError`."""
        write_log(Path(path), self, SIMULATED if set(TRUE) & set(self.columns) else LOG)

    def sampled(self, *names: str) -> IntArray:
        """Indices of the rows in which all these columns have a value; none where one is missing."""
        if not names or any(name not in self.columns for name in names):
            return np.zeros(0, dtype=np.int64)
        return np.nonzero(np.logical_and.reduce([~np.isnan(self.columns[name]) for name in names]))[0]

    def unit(self, name: str) -> str:
        """The unit in which a column stands in the file, that of its name for a log that was made up."""
        return self.map.sources[name].unit if self.map is not None else next(iter(UNITS[kind_of(name)]))

    def signals(
        self, *names: str, optional: Sequence[str] = (), counts: bool = False, partly: bool = False
    ) -> Signals:
        """Readings of these columns and of those optional ones that the log has.

        Raises `BadInputError` as `calib.io.signals.signals_of`.
        """
        from calib.io.signals import signals_of

        return signals_of(self, names, tuple(optional), counts, partly)

    def remarks(self) -> list[str]:
        """Sentences on what the columns were read as, on cells that are not finite, on a cut last line."""
        read_as = self.map.narration if self.map is not None else ""
        passed = passed_over(self.not_finite, self.truncated, self.wraps)
        return [*([read_as] if read_as else []), *(f"{self.source}: {one}" for one in passed)]


@dataclass(frozen=True)
class _Block:
    """Cells of some rows as they are in the file, by column, `t_s` among them; NaN where one is blank."""

    cells: Mapping[str, FloatArray]
    lines: IntArray
    not_finite: int = 0
    truncated: bool = False
    wraps: int = 0


@dataclass(frozen=True)
class _Text:
    """How a text is made up: its columns, the marks between cells and in numbers, whether times are dates."""

    source: str
    columns: ColumnMap
    separator: str
    decimal: str
    dates: bool = False

    @property
    def slots(self) -> dict[str, int]:
        """Number of each column that is read, in the file."""
        return {name: self.columns.names.index(one.column) for name, one in self.columns.sources.items()}


def _logs(columns: ColumnMap, blocks: Iterator[_Block]) -> Iterator[Log]:
    """Blocks in SI; the readings of the first tell the units that nobody states."""
    blocks = _counted_on(blocks)
    first = next((block for block in blocks if len(block.lines)), None)
    if first is None:
        return
    known = settled(columns, first.cells)
    unknown = known.unknown
    for block in chain([first], blocks):
        named = {n: known.sources[n].si(kind_of(n), v) for n, v in block.cells.items() if n != "t_s"}
        t_s = known.sources["t_s"].si("time", block.cells["t_s"])
        yield Log(
            known.source, t_s, named, block.lines, known, unknown, block.not_finite, block.truncated,
            block.wraps,
        )  # fmt: skip


def _counted_on(blocks: Iterator[_Block]) -> Iterator[_Block]:
    """Blocks whose times run on where they are those of a counter that begins again."""
    before, size, laps = math.nan, 0, 0
    for block in blocks:
        t = block.cells["t_s"]
        steps = np.diff(t, prepend=before)
        size = size or _counter(t, steps)
        before = float(t[-1]) if len(t) else before
        if size:
            again = steps < -0.5 * size
            ahead = laps + size * np.cumsum(again)
            laps = int(ahead[-1]) if len(t) else laps
            block = replace(block, cells={**block.cells, "t_s": t + ahead}, wraps=int(again.sum()))
        yield block


def _counter(t: FloatArray, steps: FloatArray) -> int:
    """Size of the counter that times (n,) are those of, where it begins again; 0 otherwise."""
    back, usual = steps[steps < 0.0], steps[steps > 0.0]
    if not len(back) or not len(usual) or not np.array_equal(t, np.floor(t)):
        return 0
    most = _WRAPS_WITHIN * float(np.median(usual))
    fits = (n for n in _COUNTERS if t.min() >= 0.0 and t.max() < n and (back + n <= most).all())
    return next(fits, 0)


def _number(text: _Text, word: str, column: str, line: int) -> float:
    """A cell: NaN for blank, inf for what says nan or inf."""
    word = word.strip()
    if not word:
        return math.nan
    date = text.dates and column == "t_s"
    value = _date_s(word) if date else plain_number(word.replace(",", ".") if text.decimal == "," else word)
    if value is None:
        expected = _DATE if date else "a number" + f", or in all rows {_DATE}" * (column == "t_s")
        raise BadInputError(
            f"{text.source}, line {line}: {column} is {shown(word[:40])!r}, expected {expected}"
        )
    return value if math.isfinite(value) else math.inf


_DATE = "a date such as 2024-05-01T12:00:00.25"


def _date_s(word: str) -> float | None:
    """Seconds since 1970 of a date with a time of day, in UTC where no zone is given; None for other text."""
    try:
        date = datetime.fromisoformat(word)
    except ValueError:
        return None
    since = (date if date.tzinfo else date.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return 1000 * (since // timedelta(microseconds=1)) / 1e9


def _with_dates(columns: ColumnMap) -> ColumnMap:
    """The map where the times are dates, which have been made seconds."""
    time = replace(columns.sources["t_s"], unit="s", stated="file", factor=1.0, offset=0.0)
    return replace(columns, sources={**columns.sources, "t_s": time}, evidence={"time": "dates"})


def _split(where: str, line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator, strict=True))
    except (csv.Error, StopIteration) as error:
        kind = {",": "comma", ";": "semicolon", "\t": "tab"}[separator]
        raise BadInputError(f"{where}: is not {kind}-separated: {error}") from error


_NO_ZONE = re.compile(rb"\A[^\n]*?\d\d:\d\d:\d\d(?:\.\d+)?(?![\d.Z+-])")
_PASSED_OVER = re.compile(rb"(?:^|\n)[ \t\r]*(?:[#\n]|$)")
"""A blank line or a comment."""


def _parsed(text: _Text, data: bytes, first_line: int) -> tuple[_Block, int]:
    """Rows of whole lines, and the number of the next line."""
    count = data.count(b"\n")
    lines = np.arange(first_line, first_line + count, dtype=np.int64)
    if _PASSED_OVER.search(data, 0, len(data) - 1):
        every = data.split(b"\n")[:-1]
        rows = [n for n, line in enumerate(every) if line.strip() and not line.lstrip().startswith(b"#")]
        data, lines = b"".join(every[n] + b"\n" for n in rows), lines[rows]
    block = _by_pyarrow(text, data, lines) or _by_lines(text, data, lines)
    bad = np.nonzero(~np.isfinite(block.cells["t_s"]))[0]
    if len(bad):
        raise BadInputError(f"{text.source}, line {block.lines[bad[0]]}: has no time t_s, expected a number")
    return block, first_line + count


def _by_pyarrow(text: _Text, data: bytes, lines: IntArray) -> _Block | None:
    """The rows by pyarrow; None where it declines, or may see other rows than there are lines."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    if not len(lines):
        return None
    named = [str(k) for k in range(len(text.columns.names))]
    wanted = {name: str(slot) for name, slot in text.slots.items()}
    kinds = dict.fromkeys(wanted.values(), pyarrow.float64())
    if text.dates:
        kinds[wanted["t_s"]] = pyarrow.timestamp("ns", None if _NO_ZONE.search(data) else "UTC")
    try:
        table = arrow_csv.read_csv(
            pyarrow.py_buffer(data),
            read_options=arrow_csv.ReadOptions(
                column_names=named, use_threads=False, block_size=len(data) + 1
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=text.separator, ignore_empty_lines=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=kinds,
                include_columns=list(wanted.values()),
                null_values=[""],
                decimal_point=text.decimal,
            ),
        )
    except pyarrow.ArrowInvalid:
        return None
    if table.num_rows != len(lines):
        return None
    cells, odd = {}, 0
    for name, number in wanted.items():
        column = table.column(number)
        values = _floats(column)
        infinite = np.isinf(values)
        odd += int(np.count_nonzero(np.isnan(values))) - column.null_count + int(np.count_nonzero(infinite))
        values[infinite] = np.nan
        cells[name] = values
    return _Block(cells, lines, odd)


def _floats(column: Any) -> FloatArray:
    """Doubles (n,) of an Arrow column, seconds of dates, NaN for nothing; `to_numpy` would load pandas."""
    import pyarrow

    if pyarrow.types.is_timestamp(column.type):
        whole = column.cast(pyarrow.timestamp("ns", column.type.tz)).cast("int64")
        return _floats(whole.cast("float64", safe=False)) / 1e9
    array = column.combine_chunks() if isinstance(column, pyarrow.ChunkedArray) else column
    valid, data = array.buffers()
    rows = slice(array.offset, array.offset + len(array))
    values = np.frombuffer(data, dtype=np.float64)[rows].copy()
    if valid is not None:
        values[np.unpackbits(np.frombuffer(valid, dtype=np.uint8), bitorder="little")[rows] == 0] = np.nan
    return values


def _by_lines(text: _Text, data: bytes, lines: IntArray) -> _Block:
    """The rows line by line, with a sentence for what cannot be read."""
    values = np.empty((len(lines), len(text.slots)))
    count = len(text.columns.names)
    for row, (raw, line) in enumerate(zip(data.split(b"\n"), lines.tolist(), strict=False)):
        where = f"{text.source}, line {line}"
        cells = _split(where, raw.decode("utf-8", "replace").rstrip("\r"), text.separator)
        if len(cells) != count:
            raise BadInputError(f"{where}: has {len(cells)} cells, expected {count} as in the header")
        for k, (name, slot) in enumerate(text.slots.items()):
            values[row, k] = _number(text, cells[slot], name, line)
    infinite = np.isinf(values)
    values[infinite] = np.nan
    cells_of = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(text.slots)}
    return _Block(cells_of, lines, int(infinite.sum()))


def _separator(line: str) -> str:
    """The mark between the cells of a first line, which may hold decimal commas or marks in quotes."""
    for mark in ";\t":
        if line.count(mark) > line.count(",") or (mark in line and _numeric(line.split(mark), mark)):
            return mark
    return ","


def _numeric(cells: Sequence[str], separator: str) -> bool:
    """Whether cells are those of a row and not of a header."""
    words = [cell.strip() for cell in cells if cell.strip()]
    if separator != ",":
        words = [word.replace(",", ".") for word in words]
    return bool(words) and all(plain_number(w) is not None or _date_s(w) is not None for w in words)


def _opened(stream: BinaryIO, source: str, path: Path, options: LogOptions) -> tuple[_Text, bytes, int]:
    """How the text is made up, the beginning of its rows, which was read on the way, and their line.

    The header is the first line that is neither blank nor a comment.
    """
    given = options.columns or find_columns(path)
    file = None if given is None else read_columns_file(given)
    line, comment, raw = 1, "", stream.readline(_LONGEST_LINE)
    while raw.endswith(b"\n") and (not raw.strip() or raw.lstrip(b"\xef\xbb\xbf").startswith(b"#")):
        comment = raw.decode("utf-8-sig", "replace").lstrip("#% ").rstrip("\r\n") or comment
        line, raw = line + 1, stream.readline(_LONGEST_LINE)
    where = f"{source}, line {line}"
    if not raw.strip():
        raise BadInputError(f"{source}: is empty, expected a header and rows")
    if len(raw) == _LONGEST_LINE and not raw.endswith(b"\n"):
        raise BadInputError(f"{where}: has more than {_LONGEST_LINE} characters, expected a header")
    try:
        head = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{where}: is not UTF-8 text (byte {error.start}), expected a header") from error
    if "\0" in head:
        raise BadInputError(f"{where}: has a zero byte, expected a text file")
    separator = (file and file.separator) or _separator(head)
    names = _split(where, head.rstrip("\r\n"), separator)
    if len(names) > _MAX_COLUMNS:
        raise BadInputError(f"{where}: has {len(names)} columns, expected at most {_MAX_COLUMNS}")
    rows = b""
    if _numeric(names, separator):
        names, rows = _without_header(where, path, names, comment, separator, file), raw
    columns = column_map(source, path, line, names, file, options)
    start = rows + stream.read(_BLOCK_BYTES)
    head = start[: 1 << 14].decode("utf-8", "replace")
    comma = separator != "," and bool(re.search(r"(?:^|[\s;])[-+]?\d+,\d+(?:[eE][-+]?\d+)?(?:$|[\s;])", head))
    decimal = (file and file.decimal) or ("," if comma else ".")
    dates = _has_dates(head, columns.names.index(columns.sources["t_s"].column), separator)
    text = _Text(source, _with_dates(columns) if dates else columns, separator, decimal, dates)
    return text, start, line if rows else line + 1


def _has_dates(head: str, slot: int, separator: str) -> bool:
    """Whether the times in the first row are dates."""
    row = next((row for row in head.split("\n") if row.strip() and not row.lstrip().startswith("#")), "")
    cells = row.split(separator)
    word = cells[slot].strip().strip('"') if slot < len(cells) else ""
    return plain_number(word) is None and _date_s(word) is not None


def _without_header(
    where: str, path: Path, cells: list[str], comment: str, separator: str, file: ColumnsFile | None
) -> list[str]:
    """Names of a file's columns that begins with numbers: columns.yaml's or those of the comment above."""
    numbers = [str(k + 1) for k in range(len(cells))]
    if file is not None and file.names:
        if len(file.names) != len(cells):
            raise BadInputError(
                f"{where}: has {len(cells)} cells, expected {len(file.names)} as in the names of "
                f"{shown(file.path)}"
            )
        return list(file.names)
    if file is not None and any(one.column in numbers for one in file.sources.values()):
        return numbers
    named = [name.strip() for name in comment.split(separator)]
    if len(named) == len(cells) and any((known_name(name) or ("",))[0] == "t_s" for name in named):
        return named
    raise BadInputError(
        f"{where}: holds numbers, expected a header; add to {shown(path.with_name('columns.yaml'))} the line "
        f"names: [t_s, ...] with the names of its {len(cells)} columns"
    )


def iter_rows(
    stream: BinaryIO, source: str, path: Path | None = None, options: LogOptions = NOTHING_STATED
) -> Iterator[Log]:
    """Blocks of the rows of a text log that is open; raises as `iter_log`.

    Parameters
    ----------
    path : where it lies, beside which columns.yaml is looked for.
    """
    text, data, line = _opened(stream, source, path or Path(source), options)
    yield from _logs(text.columns, _blocks(text, stream, data, line))


def _blocks(text: _Text, stream: BinaryIO, data: bytes, line: int) -> Iterator[_Block]:
    rest = b""
    while data:
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            rest += data
            if len(rest) > 2 * _BLOCK_BYTES:
                raise BadInputError(f"{text.source}, line {line}: does not end, expected a text file")
        else:
            block, line = _parsed(text, rest + data[:cut], line)
            rest = data[cut:]
            if len(block.lines):
                yield block
        data = stream.read(_BLOCK_BYTES)
    if not rest.strip() or rest.lstrip().startswith(b"#"):
        return
    # The last line without its end: a row, or the beginning of one.
    if rest.count(text.separator.encode()) < len(text.columns.names) - 1:
        nothing = {name: np.empty(0) for name in text.slots}
        yield _Block(nothing, np.empty(0, dtype=np.int64), truncated=True)
    else:
        yield _parsed(text, rest + b"\n", line)[0]


class _Recoded(io.RawIOBase):
    """Bytes of a text in UTF-8 with the line ends of Unix."""

    def __init__(self, stream: BinaryIO, encoding: str, to: str) -> None:
        self._text = io.TextIOWrapper(stream, encoding, "replace")
        self._to, self._rest = to, b""

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any) -> int:
        self._rest = self._rest or self._text.read(1 << 16).encode(self._to)
        size = min(len(room), len(self._rest))
        room[:size], self._rest = self._rest[:size], self._rest[size:]
        return size


@contextmanager
def _open_text(path: Path) -> Iterator[BinaryIO]:
    """A stream of a text file, of UTF-16 and of line ends without a line feed made UTF-8 with them."""
    with path.open("rb") as stream:
        start = stream.peek()
        if start.startswith((b"\xff\xfe", b"\xfe\xff")):
            yield io.BufferedReader(_Recoded(stream, "utf-16", "utf-8"))
        elif b"\r" in start and b"\n" not in start:
            yield io.BufferedReader(_Recoded(stream, "latin-1", "latin-1"))
        else:
            yield stream


def _iter_csv(path: Path, options: LogOptions) -> Iterator[Log]:
    try:
        with _open_text(path) as stream:
            yield from iter_rows(stream, shown(path), path, options)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error


def _iter_parquet(path: Path, options: LogOptions) -> Iterator[Log]:
    import pyarrow
    from pyarrow import parquet

    source = shown(path)
    given = options.columns or find_columns(path)
    try:
        file = parquet.ParquetFile(path, pre_buffer=False)
        named = read_columns_file(given) if given is not None else None
        columns = column_map(source, path, 1, file.schema_arrow.names, named, options)
        time = file.schema_arrow.field(columns.sources["t_s"].column).type
        columns = _with_dates(columns) if pyarrow.types.is_timestamp(time) else columns
        _check_growth(path, file.metadata, [one.column for one in columns.sources.values()])
        yield from _logs(columns, _parquet_blocks(file, columns))
    except (OSError, ValueError) as error:
        if isinstance(error, BadInputError):
            raise
        raise BadInputError(f"{source}: is not a Parquet file that can be read: {error}") from error


def _check_growth(path: Path, metadata: Any, read: Sequence[str]) -> None:
    """Raise `BadInputError` where the columns that are read unpack to more than their budget.

    A column of equal numbers takes a few bytes however long it is, so rows count as well as what pages
    unpack to.
    """
    most = max(_MOST_BYTES, _MOST_GROWTH * path.stat().st_size)
    unpacked = 0
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(metadata.num_columns)):
            if column.path_in_schema in read:
                unpacked += max(column.total_uncompressed_size, 8 * max(group.num_rows, column.num_values))
    if unpacked > most:
        raise BadInputError(
            f"{shown(path)}: has {metadata.num_rows} rows, which unpack to {unpacked / 1e6:.0f} MB from "
            f"{path.stat().st_size / 1e6:.2g}, expected at most {most / 1e6:.0f}; cut it into parts"
        )


def _parquet_blocks(file: Any, columns: ColumnMap) -> Iterator[_Block]:
    first, read = 1, [one.column for one in columns.sources.values()]
    for batch in file.iter_batches(batch_size=65536, columns=read):
        cells, odd = {}, 0
        for name, one in columns.sources.items():
            values = _parquet_column(columns.source, batch.column(one.column), one.column).copy()
            infinite = np.isinf(values)
            values[infinite] = np.nan
            cells[name], odd = values, odd + int(infinite.sum())
        lines = np.arange(first, first + len(batch), dtype=np.int64)
        bad = np.nonzero(~np.isfinite(cells["t_s"]))[0]
        if len(bad):
            raise BadInputError(f"{columns.source}, line {lines[bad[0]]}: has no time t_s, expected a number")
        first += len(batch)
        yield _Block(cells, lines, odd)


def _parquet_column(source: str, column: Any, name: str) -> FloatArray:
    import pyarrow

    try:
        if pyarrow.types.is_timestamp(column.type):
            return _floats(column)
        return np.asarray(column.cast("float64").to_numpy(zero_copy_only=False), dtype=np.float64)
    except Exception as error:
        raise BadInputError(f"{source}: {name} holds {column.type}, expected numbers") from error


def _iter_bag(path: Path, options: LogOptions) -> Iterator[Log]:
    """A bag's rows, of which what its topics and `options` say are the units."""
    from calib.io.bags import iter_bag

    blocks = iter_bag(path, options.topics)
    first = next(blocks, None)
    if first is None:
        return
    given = options.columns or find_columns(path)
    file = None if given is None else read_columns_file(given)
    columns = column_map(first.source, path, 1, ("t_s", *first.columns), file, options)
    cells = (
        _Block({"t_s": b.t_s, **b.columns}, b.lines, b.not_finite, b.truncated)
        for b in chain([first], blocks)
    )
    yield from (replace(log, unknown=first.unknown) for log in _logs(columns, cells))


def log_of(source: str, path: Path, cells: Mapping[str, FloatArray], options: LogOptions) -> Log:
    """A log of columns (n,) by name, `t_s` among them, that were read from a file of another kind.

    Raises `BadInputError` for units that contradict the readings.
    """
    given = options.columns or find_columns(path)
    file = None if given is None else read_columns_file(given)
    columns = column_map(source, path, 1, tuple(cells), file, options)
    lines = np.arange(1, len(cells["t_s"]) + 1, dtype=np.int64)
    (log,) = _logs(columns, iter([_Block(cells, lines)]))
    return log


def iter_log(path: Path, options: LogOptions = NOTHING_STATED) -> Iterator[Log]:
    """Blocks of a log in turn, each a `Log` of some ten thousand rows at most.

    Text, Parquet, a bag (see `calib.io.bags`), or what a board with the sketch sent (`calib.io.serial`).

    Raises
    ------
    BadInputError
        For a pipe or a device, which may never end; for a file that cannot be read, has no time, a row
        without time or with too few cells, or a cell that is no number, with the number of the line; for
        units that are not known or contradict the readings; for a Parquet file that unpacks to too much.
    """
    from calib.io.bags import is_bag
    from calib.io.serial import STREAMS, iter_stream

    if not (is_bag(path) and path.is_dir()):
        check_readable(path)
    if is_bag(path):
        return _iter_bag(path, options)
    if options.topics is not None:
        raise BadInputError(f"{shown(path)}: has columns, expected a bag where topics are given")
    ending = path.suffix.lower()
    if ending in STREAMS:
        return iter_stream(path)
    return _iter_parquet(path, options) if ending == ".parquet" else _iter_csv(path, options)


def columns_of(path: Path, options: LogOptions = NOTHING_STATED) -> tuple[str, ...] | None:
    """Columns that a log has by its header, whatever is in them; None where it cannot be told."""
    from calib.io.bags import is_bag
    from calib.io.serial import STREAMS

    try:
        if is_bag(path) or path.suffix.lower() in (".parquet", *STREAMS):
            return tuple(next(iter_log(path, options)).columns)
        check_readable(path)
        with _open_text(path) as stream:
            text, _, _ = _opened(stream, shown(path), path, options)
        return tuple(name for name in text.columns.sources if name != "t_s")
    except (BadInputError, OSError, StopIteration):
        return None


def beside(path: Path) -> list[Path]:
    """Files beside a log that say what is in it: which topic of a bag is which column, and columns.yaml."""
    from calib.io.bags import find_topics, is_bag

    found = [find_topics(path) if is_bag(path) else None, find_columns(path)]
    return [one for one in found if one is not None]


def read_log(path: Path, options: LogOptions = NOTHING_STATED) -> Log:
    """A whole log, of at most 200 million cells that are read.

    Raises `BadInputError` as `iter_log`, and for a log without rows or with more cells.
    """
    blocks, cells = list[Log](), 0
    for block in iter_log(path, options):
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
    return replace(
        first,
        t_s=np.concatenate([block.t_s for block in blocks]),
        columns={name: np.concatenate([block.columns[name] for block in blocks]) for name in first.columns},
        lines=np.concatenate([block.lines for block in blocks]),
        not_finite=sum(block.not_finite for block in blocks),
        truncated=blocks[-1].truncated,
        wraps=sum(block.wraps for block in blocks),
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


LOG = Kind("a log", (".csv", ".parquet"), _holds_log)
SIMULATED = Kind("a simulated log", LOG.endings, lambda path: not set(TRUE).isdisjoint(column_names(path)))


def write_log(path: Path, log: Log, kind: Kind = LOG) -> None:
    """Write a log atomically, as Parquet where the name ends so and as CSV otherwise.

    Raises `BadInputError` where the place cannot be written.
    """
    parquet = path.suffix.lower() == ".parquet"
    write_atomically(path, _parquet_bytes(log) if parquet else log_text(log), kind)

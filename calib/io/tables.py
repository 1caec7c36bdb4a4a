"""Tables of logs: text and Parquet as blocks of numbers by column, see `calib.io.logs`.

Text is parsed by pyarrow; a block that it declines is read line by line, which gives the same numbers, or a
sentence with the number of the line. `table_bytes` writes such text.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.files import one_line, read_bytes, read_text, shown
from calib.core.options import LogOptions
from calib.core.units import plain_number
from calib.core.words import several
from calib.io.columns import ColumnMap, ColumnsFile, column_map, columns_file, known_name

_BLOCK_BYTES = 1 << 20
_LONGEST_LINE = 1 << 16
_MAX_COLUMNS = 1000
_MOST_RECODED = 1 << 27
_MOST_BYTES, _MOST_GROWTH = 1 << 28, 200
"""What a Parquet file may unpack to: so many bytes, or so many times its own size where that is more."""


@dataclass(frozen=True)
class Passed:
    """What of a log's cells and rows was not taken as it stands.

    Attributes
    ----------
    not_finite : cells that said nan or inf; in Parquet nan is a blank.
    implausible : cells that hold more than any sensor gives. first_implausible : the first of them, in words.
    clipped : readings at the end of their sensor's range. first_clipped : the first of them, in words.
    outside : pictures that put the marker outside of them or at (0, 0).
    truncated : whether the last line was cut short and left out.
    wraps : how often the counter that is the time began again.
    reordered : rows that stood below a later one, and were put where they belong.
    repeated : rows that say what the one before says, at its time, and were left out.
    prose : lines of words alone between the rows, as a board prints them.
    damaged : lines that are no row, few among many. first_damaged : what is wrong with the first of them.
    odd_times : what is odd about the times of a bag's messages, in words.
    """

    not_finite: int = 0
    implausible: int = 0
    first_implausible: str = ""
    truncated: bool = False
    wraps: int = 0
    outside: int = 0
    clipped: int = 0
    first_clipped: str = ""
    reordered: int = 0
    repeated: int = 0
    prose: int = 0
    damaged: int = 0
    first_damaged: str = ""
    odd_times: str = ""

    def __add__(self, later: Passed) -> Passed:
        both = ((getattr(self, one.name), getattr(later, one.name)) for one in fields(self))
        # Numbers add up; of words the first ones count.
        return Passed(*(a + b if type(a) is int else a or b for a, b in both))

    @property
    def sentences(self) -> list[str]:
        """One for each kind that there is."""
        blank = "and count as blank"
        kinds = (
            (self.not_finite, f"{self.not_finite} cells say nan or inf {blank}"),
            (
                self.implausible,
                f"{self.implausible} cells hold more than any sensor gives "
                f"({self.first_implausible}) {blank}",
            ),
            (self.outside, f"{self.outside} pictures put the marker outside of them or at (0, 0) {blank}"),
            (
                self.clipped,
                f"{self.clipped} readings are at the end of a sensor's range ({self.first_clipped}) {blank}",
            ),
            (self.truncated, "the last line is cut short and left out"),
            (self.wraps, f"the time begins again {self.wraps} times, as counters and days do; counted on"),
            (
                self.reordered,
                f"{self.reordered} rows stand below a later one, each sensor's own in order; sorted",
            ),
            (self.repeated, f"{self.repeated} rows are written twice; left out"),
            (self.prose, f"{self.prose} lines between the rows hold words and no number; passed over"),
            (self.damaged == 1, f"a line came damaged and is left out, {self.first_damaged}"),
            (
                self.damaged > 1,
                f"{self.damaged} lines came damaged and are left out, the first {self.first_damaged}",
            ),
        )
        return [sentence for there, sentence in (*kinds, (self.odd_times, self.odd_times)) if there]


ALL_TAKEN = Passed()


@dataclass(frozen=True)
class Block:
    """Cells of some rows as they are in the file, by column, `t_s` among them; NaN where one is blank.

    Attributes
    ----------
    lines : (n,) number of each row's line, or of the row in a table without lines.
    """

    cells: Mapping[str, FloatArray]
    lines: IntArray
    passed: Passed = ALL_TAKEN


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
        return {name: self.columns.names.index(column) for name, column in self.columns.read.items()}


def _number(text: _Text, word: str, column: str, line: int) -> float:
    """A cell: NaN for blank, inf for what says nan or inf."""
    word = word.strip()
    if word in _BLANK:
        return math.nan
    date = text.dates and column == "t_s"
    plain = word.replace("\N{MINUS SIGN}", "-")
    value = _date_s(word) if date else plain_number(plain.replace(",", ".") if text.decimal == "," else plain)
    if value is None:
        expected = _DATE if date else "a number" + f", or in all rows {_DATE}" * (column == "t_s")
        raise BadInputError(
            f"{text.source}, line {line}: {column} is {shown(word[:40])!r}, expected {expected}"
        )
    return value if math.isfinite(value) else math.inf


_BLANK = ("", "NA", "N/A", "n/a", "#N/A", "null", "NULL", "None", "-", "--")
"""Cells of a sensor that was not sampled, as R, pandas, Excel, JavaScript, Python and people write them."""
_DATE = "a date such as 2024-05-01T12:00:00.25"
_DAY_FIRST = re.compile(r"\A(\d\d)\.(\d\d)\.(\d{4}) +")
_TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:[.,:]\d+)?)")


def _date_s(word: str) -> float | None:
    """Seconds since 1970 of a date with a time of day, in UTC where no zone is given, or since midnight of a
    time of day alone; None for other text.
    """
    if of_day := _TIME_OF_DAY.fullmatch(word):
        hours, minutes, seconds = of_day.groups()
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(re.sub("[,:]", ".", seconds))
    try:
        date = datetime.fromisoformat(_DAY_FIRST.sub(r"\3-\2-\1T", word))
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
        kind = {",": "comma", ";": "semicolon", "\t": "tab", " ": "blank"}[separator]
        raise BadInputError(f"{where}: is not {kind}-separated: {error}") from error


_NO_ZONE = re.compile(rb"\A[^\n]*?\d\d:\d\d:\d\d(?:\.\d+)?(?![\d.Z+-])")
_WORD = re.compile(r"\W*[^\W\d_]")
_PASSED_OVER = re.compile(rb"(?:^|\n)[ \t\r]*(?:[#\n]|$)")
"""A blank line or a comment."""
_BEGINS = (b"#", b"\n\n", b"\n\r", b"\n ", b"\n\t")
"""One of these is in text with such a line, unless it is the first; to look for them takes a tenth."""


def _parsed(text: _Text, data: bytes, first_line: int) -> tuple[Block, int]:
    """Rows of whole lines, and the number of the next line."""
    if text.separator == " ":
        data = b"\n".join(b" ".join(line.split()) for line in data.split(b"\n"))
    count = data.count(b"\n")
    lines = np.arange(first_line, first_line + count, dtype=np.int64)
    suspect = data[:1].isspace() or any(one in data for one in _BEGINS)
    if suspect and _PASSED_OVER.search(data, 0, len(data) - 1):
        every = data.split(b"\n")[:-1]
        rows = [n for n, line in enumerate(every) if line.strip() and not line.lstrip().startswith(b"#")]
        data, lines = b"".join(every[n] + b"\n" for n in rows), lines[rows]
    return _parsed_by_pyarrow(text, data, lines) or _parsed_by_line(text, data, lines), first_line + count


def _timed(columns: ColumnMap, blocks: Iterator[Block]) -> Iterator[Block]:
    """The blocks, with the times of rows that are numbered. Raises `BadInputError` for a row without time."""
    row = 0
    for block in blocks:
        if columns.rate_hz:
            times = np.arange(row, row + len(block.lines)) / columns.rate_hz
            block, row = replace(block, cells={"t_s": times, **block.cells}), row + len(times)
        bad = np.nonzero(~np.isfinite(block.cells["t_s"]))[0]
        if len(bad):
            where = f"{columns.source}, line {block.lines[bad[0]]}"
            raise BadInputError(f"{where}: has no time t_s, expected a number")
        yield block


def _parsed_by_pyarrow(text: _Text, data: bytes, lines: IntArray) -> Block | None:
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
                include_columns=list(kinds),
                null_values=list(_BLANK),
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
        cells[name] = _floats(column)
        odd += int(np.count_nonzero(np.isnan(cells[name]))) - column.null_count + _blanked(cells[name])
    return Block(cells, lines, Passed(odd))


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


def _blanked(values: FloatArray) -> int:
    """How many values were infinite, which are blank from now on."""
    infinite = np.isinf(values)
    values[infinite] = np.nan
    return int(np.count_nonzero(infinite))


def _parsed_by_line(text: _Text, data: bytes, lines: IntArray) -> Block:
    """The rows line by line; what a board says between is no row, nor is a damaged line where few are.

    Raises `BadInputError` with a sentence for what cannot be read.
    """
    values = np.empty((len(lines), len(text.slots)))
    passed, taken = Passed(), np.ones(len(lines), dtype=np.bool_)
    first: BadInputError | None = None
    spared = max(len(lines) // _ROWS_PER_DAMAGED, int(len(lines) > 0 and lines[0] > _ROWS_PER_DAMAGED))
    for row, (raw, line) in enumerate(zip(data.split(b"\n"), lines.tolist(), strict=False)):
        words = raw.decode("utf-8", "replace").rstrip("\r")
        if _is_prose(text, words):
            taken[row], passed = False, passed + Passed(prose=1)
            continue
        try:
            values[row] = _row(text, words, line)
        except BadInputError as error:
            first = first or error
            taken[row], passed = False, passed + Passed(damaged=1)
            if passed.damaged > spared:
                raise first from None
    values, lines = values[taken], lines[taken]
    odd = _blanked(values)
    cells_of = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(text.slots)}
    damage = str(first).removeprefix(f"{text.source}, ").partition(";")[0] if first else ""
    return Block(cells_of, lines, passed + Passed(odd, first_damaged=damage))


_ROWS_PER_DAMAGED = 200
"""One row in so many may be damaged, as a serial line damages them."""


def _row(text: _Text, words: str, line: int) -> list[float]:
    """The numbers of a line. Raises `BadInputError`."""
    where, count = f"{text.source}, line {line}", len(text.columns.names)
    cells = _split(where, words, text.separator)
    if len(cells) != count:
        raise BadInputError(
            f"{where}: has {len(cells)} cells, expected {count} as in the header; take out a line that came "
            "damaged"
        )
    return [_number(text, cells[slot], name, line) for name, slot in text.slots.items()]


def _is_prose(text: _Text, line: str) -> bool:
    """Whether a line begins with a word and has no number in any cell."""
    if not _WORD.match(line):
        return False
    cells = [cell.strip(' "') for cell in line.split(text.separator)]
    return not any(cell in _BLANK[1:] or _numeric([cell], text.separator) for cell in cells)


def _separator(line: str) -> str:
    """The mark between the cells of a first line, which may hold decimal commas or marks in quotes."""
    for mark in ";\t":
        if line.count(mark) > line.count(",") or (mark in line and _numeric(line.split(mark), mark)):
            return mark
    return ","


def _separator_of_log(line: str) -> str:
    """The mark between the cells of a log's first line, which may be blanks."""
    mark, words = _separator(line), line.split()
    if mark != "," or "," in line or len(words) < 3:
        return mark
    named = any((known_name(word) or ("",))[0] == "t_s" for word in words)
    return " " if named or _numeric(words, " ") else ","


def _numeric(cells: Sequence[str], separator: str) -> bool:
    """Whether cells are those of a row and not of a header."""
    words = [cell.strip() for cell in cells if cell.strip()]
    if separator != ",":
        words = [word.replace(",", ".") for word in words]
    return bool(words) and all(plain_number(w) is not None or _date_s(w) is not None for w in words)


def _layout_of(stream: BinaryIO, source: str, path: Path, options: LogOptions) -> tuple[_Text, bytes, int]:
    """How the text is made up, the beginning of its rows, which was read on the way, and their line."""
    file = columns_file(path, options)
    line, raw, comment, ahead, above = _first_line(stream, file)
    where, head = f"{source}, line {line}", _decoded(raw)
    _check_is_text(source, where, raw, file)
    separator = (file and file.separator) or _separator_of_log(head)
    names = head.split() if separator == " " else _split(where, head.rstrip("\r\n"), separator)
    if len(names) > _MAX_COLUMNS:
        raise BadInputError(f"{where}: has {len(names)} columns, expected at most {_MAX_COLUMNS}")
    rows = b""
    if _numeric(names, separator):
        names, rows = _without_header(where, path, names, comment, separator, file), raw
    start = rows + ahead + stream.read(_BLOCK_BYTES)
    head = start[: 1 << 14].decode("utf-8", "replace")
    # Boards that print a mark after each cell print one at the end of the row, and often none in the header.
    cells = _first_row(head, separator)
    if len(cells) == len(names) + 1 and not cells[-1].strip():
        names = [*names, ""]
    elif len(cells) == len(names) - 1 and not names[-1].strip():
        names = names[:-1]
    columns = replace(column_map(source, path, line, names, file, options), above=above)
    comma = separator != "," and bool(re.search(r"(?:^|[\s;])[-+]?\d+,\d+(?:[eE][-+]?\d+)?(?:$|[\s;])", head))
    decimal = (file and file.decimal) or ("," if comma else ".")
    time = columns.sources["t_s"].column
    dates = bool(time) and _has_dates(cells, columns.names.index(time))
    text = _Text(source, _with_dates(columns) if dates else columns, separator, decimal, dates)
    return text, start, line if rows else line + 1


def _first_line(stream: BinaryIO, file: ColumnsFile | None) -> tuple[int, bytes, str, bytes, str]:
    """The header, or the first row of a table without: its number and bytes.

    That is the first line that is neither blank nor a comment, unless a header follows within `_MOST_ABOVE`
    lines: what a board or a terminal says stands above it. Then come the last comment, the lines that were
    read beyond, and in words where the table begins, where something stands above it.
    """
    line, comment, raw = 1, "", stream.readline(_LONGEST_LINE)
    while raw.endswith(b"\n") and (
        not raw.strip() or raw.lstrip(b"\xef\xbb\xbf \t").startswith((b"#", b"//"))
    ):
        comment = raw.decode("utf-8-sig", "replace").lstrip("#%/ \t").rstrip("\r\n") or comment
        line, raw = line + 1, stream.readline(_LONGEST_LINE)
    if _is_header(raw, file):
        return line, raw, comment, b"", ""
    following = list(_lines_up_to_a_header(stream, file))
    if not following or not _is_header(following[-1], file):
        return line, raw, comment, b"".join(following), ""
    line += len(following)
    said = one_line(raw.decode("utf-8", "replace").strip())[:40]
    return line, following[-1], comment, b"", f"the table from line {line} on, below `{said}`"


def _check_is_text(source: str, where: str, raw: bytes, file: ColumnsFile | None) -> None:
    """Raise `BadInputError` where the first line (`where`) of a file is none of a text table."""
    if not raw.strip():
        raise BadInputError(f"{source}: is empty, expected a header and rows")
    if len(raw) == _LONGEST_LINE and not raw.endswith(b"\n"):
        raise BadInputError(f"{where}: has more than {_LONGEST_LINE} characters, expected a header")
    if not _is_header(raw, file):
        try:
            raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise BadInputError(
                f"{where}: is not UTF-8 text (byte {error.start}), expected a header; save a spreadsheet as "
                "CSV, unpack what is packed"
            ) from error
    if b"\0" in raw:
        raise BadInputError(f"{where}: has a zero byte, expected a text file")


_MOST_ABOVE = 50


def _lines_up_to_a_header(stream: BinaryIO, file: ColumnsFile | None) -> Iterator[bytes]:
    """The next lines, at most so many, up to one that is a header."""
    for _ in range(_MOST_ABOVE):
        raw = stream.readline(_LONGEST_LINE)
        if raw:
            yield raw
        if not raw.endswith(b"\n") or _is_header(raw, file):
            return


def _decoded(raw: bytes) -> str:
    """A line of UTF-8, or of the code page of Windows, which spreadsheets write."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", "replace")


def _is_header(raw: bytes, file: ColumnsFile | None) -> bool:
    """Whether a line names the time and another column, or three columns."""
    text = _decoded(raw).strip()
    names = [
        name.strip().strip('"') for name in text.split((file and file.separator) or _separator_of_log(text))
    ]
    stated = {one.column: column for column, one in file.sources.items()} if file else {}
    known = [(stated[name],) if name in stated else known_name(name) for name in names]
    found = {one[0] for one in known if one is not None}
    return ("t_s" in found and len(found) > 1) or len(found) > 2


def _first_row(head: str, separator: str) -> list[str]:
    """Cells of the first row; none without one."""
    row = next((row for row in head.split("\n") if row.strip() and not row.lstrip().startswith("#")), "")
    return row.split() if separator == " " else row.rstrip("\r").split(separator)


def _has_dates(cells: Sequence[str], slot: int) -> bool:
    """Whether the times in a row are dates."""
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
    named = comment.split() if separator == " " else [name.strip() for name in comment.split(separator)]
    if len(named) == len(cells) and any((known_name(name) or ("",))[0] == "t_s" for name in named):
        return named
    raise BadInputError(
        f"{where}: holds numbers, expected a header; add to {shown(path.with_name('columns.yaml'))} the line "
        f"names: [t_s, ...] with the names of its {len(cells)} columns"
    )


def text_blocks(
    stream: BinaryIO, source: str, path: Path, options: LogOptions
) -> tuple[ColumnMap, Iterator[Block]]:
    """Columns of a text log that is open, and its rows; columns.yaml is looked for beside `path`."""
    text, data, line = _layout_of(stream, source, path, options)
    return text.columns, _timed(text.columns, _blocks(text, stream, data, line))


def _blocks(text: _Text, stream: BinaryIO, data: bytes, line: int) -> Iterator[Block]:
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
    cells = rest.split() if text.separator == " " else rest.split(text.separator.encode())
    if len(cells) < len(text.columns.names):
        nothing = {name: np.empty(0) for name in text.slots}
        yield Block(nothing, np.empty(0, dtype=np.int64), Passed(truncated=True))
    else:
        yield _parsed(text, rest + b"\n", line)[0]


TIME, GENERAL, WHOLE = "%.6f", "%.9g", "%.0f"
"""How a column is written: six decimals; nine significant digits, shortest; no decimals."""
_ROWS_AT_ONCE = 4096


def table_bytes(values: FloatArray, kinds: Sequence[str]) -> bytes:
    """Rows (n, columns) as comma-separated lines, each column as its kind says; NaN is a blank cell."""
    line, parts = ",".join(kinds) + "\n", []
    for k in range(0, len(values), _ROWS_AT_ONCE):
        rows = values[k : k + _ROWS_AT_ONCE]
        text = line * len(rows) % tuple(rows.ravel().tolist())
        parts.append(text.replace("nan", "").encode())
    return b"".join(parts)


_MONITOR = re.compile(rb"^\d\d:\d\d:\d\d\.\d+ -> ?", re.MULTILINE)


@contextmanager
def open_text(path: Path) -> Iterator[BinaryIO]:
    """A stream of a text file, of UTF-16 and of line ends without a line feed made UTF-8 with them, and
    without the time that a serial monitor puts before each line.

    Raises `BadInputError` for more than 128 MB of these.
    """
    with path.open("rb") as stream:
        start = stream.peek()
        wide = start.startswith((b"\xff\xfe", b"\xfe\xff"))
        if wide or (b"\r" in start and b"\n" not in start) or _MONITOR.match(start):
            data = read_bytes(path, _MOST_RECODED)
            data = data.decode("utf-16", "replace").encode() if wide else data
            yield io.BytesIO(_MONITOR.sub(b"", re.sub(rb"\r\n?", b"\n", data)))
        else:
            yield stream


def parquet_blocks(path: Path, options: LogOptions) -> tuple[ColumnMap, Iterator[Block]]:
    """Columns of a log in Parquet, and its rows."""
    import pyarrow
    from pyarrow import parquet

    named = columns_file(path, options)
    with _parquet_errors(shown(path)):
        file = parquet.ParquetFile(path, pre_buffer=False)
        columns = column_map(shown(path), path, 1, file.schema_arrow.names, named, options)
        read = columns.read
        if "t_s" in read and pyarrow.types.is_timestamp(file.schema_arrow.field(read["t_s"]).type):
            columns = _with_dates(columns)
        for name in read.values():
            # A text that comes often stands in the file once.
            kind = file.schema_arrow.field(name).type
            if not (pyarrow.types.is_primitive(kind) or pyarrow.types.is_null(kind)):
                raise BadInputError(f"{columns.source}: {name} holds {kind}, expected numbers")
        _check_growth(path, file.metadata, read.values())
    return columns, _timed(columns, _parquet_blocks(file, columns))


@contextmanager
def _parquet_errors(source: str) -> Iterator[None]:
    try:
        yield
    except BadInputError:
        raise
    except (OSError, ValueError) as error:
        raise BadInputError(f"{source}: is not a Parquet file that can be read: {error}") from error


def _check_growth(path: Path, metadata: Any, read: Collection[str]) -> None:
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


def _parquet_blocks(file: Any, columns: ColumnMap) -> Iterator[Block]:
    first, read = 1, columns.read
    with _parquet_errors(columns.source):
        for batch in file.iter_batches(batch_size=65536, columns=list(read.values())):
            cells, odd = {}, 0
            for name, column in read.items():
                cells[name] = _parquet_column(columns.source, batch.column(column), column).copy()
                odd += _blanked(cells[name])
            block = Block(cells, np.arange(first, first + len(batch), dtype=np.int64), Passed(odd))
            first += len(batch)
            yield block


def _parquet_column(source: str, column: Any, name: str) -> FloatArray:
    import pyarrow

    try:
        if pyarrow.types.is_timestamp(column.type):
            return _floats(column)
        return np.asarray(column.cast("float64").to_numpy(zero_copy_only=False), dtype=np.float64)
    except Exception as error:
        raise BadInputError(f"{source}: {name} holds {column.type}, expected numbers") from error


# ----------------------------------------------------------------------
# Small tables that a person writes: cells as text, each with its line.


@dataclass(frozen=True)
class Cells:
    """A small CSV: its header, rows of cells, and the number of each row's line.

    Attributes
    ----------
    commas : whether numbers may have a decimal comma, as no comma separates the cells.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    commas: bool = False

    def column(self, wanted: str | None, known: Sequence[str], what: str) -> int:
        """Index of a column, the one asked for or the first known name. Raises `BadInputError`."""
        low, names = [name.lower() for name in self.header], several(self.header, 8)
        if wanted is not None and wanted.lower() not in low:
            raise BadInputError(f"{shown(self.path)}: has no column {wanted}, found {names}")
        name = next((name for name in (known if wanted is None else (wanted.lower(),)) if name in low), None)
        if name is None:
            raise BadInputError(
                f"{shown(self.path)}: has no {what}, found columns {names}; expected for instance {known[0]}"
            )
        return low.index(name)

    def numbers(self, *columns: int) -> FloatArray:
        """Values (rows, columns), NaN for what is blank or not finite. Raises `BadInputError` for words."""
        rows = zip(self.rows, self.lines, strict=True)
        return np.array([[self._number(row[k], line, k) for k in columns] for row, line in rows])

    def _number(self, cell: str, line: int, column: int) -> float:
        word = cell.strip()
        plain = word.replace(",", ".") if self.commas else word
        value = plain_number(plain) if word else math.nan
        if value is None:
            raise BadInputError(
                f"{shown(self.path)}, line {line}: {self.header[column]} is {shown(word[:40])!r}, expected a "
                "number"
            )
        return value if math.isfinite(value) else math.nan


def read_cells(path: Path, comments: bool = True) -> Cells:
    """The cells of a CSV; with `comments` without the rows that begin with #.

    Raises `BadInputError` for a file without header or rows and for a row of another length.
    """
    header: list[str] = []
    rows: list[list[str]] = []
    lines: list[int] = []
    text = read_text(path)
    lines_of_text = (line.strip() for line in text.splitlines())
    # Where a decimal comma is usual, spreadsheets put semicolons between the cells.
    separator = _separator(next((s for s in lines_of_text if s and not (comments and s[0] == "#")), ""))
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells) or (comments and cells[0].lstrip().startswith("#")):
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
        raise BadInputError(f"{shown(path)}, line {reader.line_num}: is no row of cells: {error}") from error
    if not header:
        raise BadInputError(f"{shown(path)}: is empty, expected a header and rows")
    if not rows:
        raise BadInputError(f"{shown(path)}: has a header but no rows")
    return Cells(path, header, rows, lines, separator != ",")

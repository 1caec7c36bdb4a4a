"""Outcomes as rows of a Parquet file, in blocks, and one column of it at a time.

Columns: name, serial, source, kind, verdict, code, sentence, reasons, seconds, peak_MB, `verdict.STAGE` for
each stage, `SECTION.NAME` and `SECTION.NAME.sigma` for each constant, and at last outlier_z and outlier_of,
the constant that stands out most against the fleet. A rig without a number has a null there.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import shown
from calib.fleet.extra import needed
from calib.fleet.outcome import Outcome

__all__ = ["Table", "column", "texts", "with_columns", "write_outcomes", "write_table"]

_TEXTS = ("name", "serial", "source", "kind", "verdict", "sentence", "reasons")
_BLOCK = 512
_MOST_COLUMNS = 4000


class Table:
    """A Parquet file that is read a column at a time."""

    def __init__(self, path: Path) -> None:
        self._file = needed("pyarrow.parquet").ParquetFile(path)
        self.rows = int(self._file.metadata.num_rows)
        self.names = tuple(str(name) for name in self._file.schema_arrow.names)

    def __enter__(self) -> Table:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, name: str) -> Any:
        """A column as an Arrow array."""
        return self._file.read(columns=[name]).column(0)

    def blocks(self) -> Iterator[Any]:
        """The rows in blocks."""
        yield from self._file.iter_batches(_BLOCK)


def column(table: Table, name: str) -> FloatArray:
    """Numbers (n,) of a column, NaN for nulls and for a column that is not there."""
    if name not in table.names:
        return np.full(table.rows, np.nan)
    return np.asarray(table.read(name).to_numpy(zero_copy_only=False), dtype=np.float64)


def texts(table: Table, name: str) -> list[str]:
    """Texts of a column, "" for nulls."""
    return [value or "" for value in table.read(name).to_pylist()]


def write_outcomes(path: Path, names: Sequence[str], outcome: Callable[[str], Outcome | None]) -> None:
    """Write a row for each name; `outcome` is asked twice for each, for the columns and for the rows.

    Raises `BadInputError` when the file cannot be written.
    """
    pa = needed("pyarrow")
    stages: dict[str, None] = {}
    values: dict[str, None] = {}
    for name in names:
        found = outcome(name)
        if found is not None and len(values) < _MOST_COLUMNS:
            stages |= dict.fromkeys(found.stages)
            values |= dict.fromkeys(found.values)
    fields = [pa.field(name, pa.string()) for name in _TEXTS]
    fields.insert(5, pa.field("code", pa.int16()))
    fields += [pa.field("seconds", pa.float64()), pa.field("peak_MB", pa.float64())]
    fields += [pa.field(f"verdict.{stage}", pa.string()) for stage in stages]
    for value in values:
        fields += [pa.field(value, pa.float64()), pa.field(f"{value}.sigma", pa.float64())]

    def rows() -> Iterator[dict[str, Any]]:
        for name in names:
            found = outcome(name)
            if found is not None:
                yield _row(found)

    write_table(path, pa.schema(fields), rows())


def _row(outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": outcome.name,
        "serial": outcome.serial,
        "source": outcome.source,
        "kind": outcome.kind,
        "verdict": outcome.status,
        "code": outcome.code,
        "sentence": outcome.sentence,
        "reasons": "\n".join(outcome.reasons),
        "seconds": outcome.seconds,
        "peak_MB": outcome.peak_MB,
    }
    row |= {f"verdict.{stage}": status for stage, status in outcome.stages.items()}
    for name, (value, sigma) in outcome.values.items():
        row[name], row[f"{name}.sigma"] = value, sigma
    return row


def write_table(path: Path, schema: Any, rows: Iterable[dict[str, Any]]) -> None:
    """Write rows in blocks; the file appears under its name when it is whole.

    Raises `BadInputError` when it cannot be written.
    """
    pa = needed("pyarrow")

    def blocks() -> Iterator[Any]:
        left = iter(rows)
        while block := list(islice(left, _BLOCK)):
            yield pa.RecordBatch.from_pylist(block, schema=schema)

    _write(path, schema, blocks())


def with_columns(source: Path, path: Path, added: dict[str, Any]) -> None:
    """Copy a table with columns added, each an Arrow array of as many rows, block by block."""
    pa = needed("pyarrow")
    with Table(source) as table:
        schema = table._file.schema_arrow
        for name, values in added.items():
            schema = schema.append(pa.field(name, values.type))

        def blocks() -> Iterator[Any]:
            at = 0
            for block in table.blocks():
                parts = [values.slice(at, block.num_rows) for values in added.values()]
                yield pa.RecordBatch.from_arrays([*block.columns, *parts], schema=schema)
                at += block.num_rows

        _write(path, schema, blocks())


def _write(path: Path, schema: Any, blocks: Iterator[Any]) -> None:
    between = path.with_name(f".{path.name}.tmp")
    try:
        with between.open("wb") as stream:
            with needed("pyarrow.parquet").ParquetWriter(stream, schema, compression="zstd") as writer:
                for block in blocks:
                    writer.write_batch(block)
            stream.flush()
            os.fsync(stream.fileno())
        between.replace(path)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            between.unlink()

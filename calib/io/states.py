"""The states that `calib replay` writes, block by block: CSV, Parquet or MCAP by the file's ending."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError, package, pip_install
from calib.core.files import shown
from calib.core.writing import Kind, column_names, head, replacing
from calib.io.columns import STATES, are_states
from calib.io.tables import GENERAL, TIME, WHOLE, table_bytes

# ----------------------------------------------------------------------
# States as MCAP: JSON messages that Foxglove and PlotJuggler show without a plug-in.
#
# `/states` holds every column, with a JSON schema; `/head` is the head as foxglove.PoseInFrame in the
# frame `world` of `calib.stages.actuator.kinematics` (x to the right, y along the straight actuator): a
# turn by
# -phi about z takes the head's frame at rest to the one now. Time is that of the log, from its zero.

Add = Callable[[FloatArray], None]
"""Adds rows (n, columns) to a file that is being written."""

STATES_TOPIC, HEAD = "/states", "/head"

_NUMBER = {"type": "number"}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
_POSE = {
    "title": "foxglove.PoseInFrame",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": {
            "title": "foxglove.Pose",
            "type": "object",
            "properties": {
                "position": {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)},
                "orientation": {"type": "object", "properties": dict.fromkeys("xyzw", _NUMBER)},
            },
        },
    },
}


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else "null"


@contextmanager
def _mcap(path: Path, stream: IO[bytes], names: tuple[str, ...]) -> Iterator[Add]:
    """States in MCAP, chunk by chunk; the same rows give the same bytes.

    Raises `BadInputError` without the extra logs, and for a time before zero, which MCAP cannot tell.
    """
    needed = f"{shown(path)}: writing MCAP needs mcap: {pip_install('logs')}"
    writer: Any = package("mcap.writer", needed).Writer(stream)
    pose_at = tuple(names.index(name) for name in ("x_m", "y_m", "phi_rad"))
    writer.start(library="calib")
    # A column that is not known in a row is null there.
    listed: dict[str, Any] = {"timestamp": _TIME} | {name: {"type": ["number", "null"]} for name in names}
    listed["t_s"] = _NUMBER

    def channel(topic: str, described: dict[str, Any]) -> int:
        schema = writer.register_schema(described["title"], "jsonschema", json.dumps(described).encode())
        return int(writer.register_channel(topic, "json", schema))

    states = channel(STATES_TOPIC, {"title": "calib.States", "type": "object", "properties": listed})
    head = channel(HEAD, _POSE)

    def add(values: FloatArray) -> None:
        for row in values.tolist():
            stamp = round(row[0] * 1e9)
            if stamp < 0:
                raise BadInputError(
                    f"{shown(path)}: t_s is {row[0]:.6f}, expected no time before 0 in MCAP; "
                    "write .csv or .parquet"
                )
            time = f'{{"timestamp":{{"sec":{stamp // 1_000_000_000},"nsec":{stamp % 1_000_000_000}}}'
            cells = ",".join(f'"{name}":{_cell(value)}' for name, value in zip(names, row, strict=True))
            writer.add_message(states, stamp, f"{time},{cells}}}".encode(), stamp)
            x, y, phi = (row[k] for k in pose_at)
            if math.isfinite(x + y + phi):
                turn = f'"x":0,"y":0,"z":{math.sin(-0.5 * phi):.9g},"w":{math.cos(0.5 * phi):.9g}'
                place = f'"x":{x:.9g},"y":{y:.9g},"z":0'
                pose = f'{{"position":{{{place}}},"orientation":{{{turn}}}}}'
                text = f'{time},"frame_id":"world","pose":{pose}}}'
                writer.add_message(head, stamp, text.encode(), stamp)

    yield add
    writer.finish()


# ----------------------------------------------------------------------
# The states file that `calib replay` writes, block by block: CSV, Parquet or MCAP by its ending.

ENDINGS = (".csv", ".parquet", ".mcap")
"""Of the formats; any other ending is written as CSV."""


def _holds_states(path: Path) -> bool:
    start = head(path, 512)
    if start.startswith(b"\x89MCAP0"):
        # The header names the library.
        return b"calib" in start
    return are_states(column_names(path))


STATES_FILE = Kind("states", ENDINGS, _holds_states)

_GROUP_ROWS = 1 << 17


def is_whole(name: str) -> bool:
    """Whether a column holds whole numbers."""
    return name.startswith("gated") or name == "flags"


@contextmanager
def _csv(stream: IO[bytes], names: tuple[str, ...]) -> Iterator[Add]:
    """Lines with time to the microsecond, counts without decimals, all else to nine digits."""
    kinds = [WHOLE if is_whole(name) else TIME if name == "t_s" else GENERAL for name in names]
    stream.write((",".join(names) + "\n").encode())

    def add(values: FloatArray) -> None:
        stream.write(table_bytes(values, kinds))

    yield add


@contextmanager
def _parquet(stream: IO[bytes], names: tuple[str, ...]) -> Iterator[Add]:
    """Row groups of some hundred thousand rows; counts are integers, NaN is null."""
    import pyarrow
    from pyarrow import parquet

    arrow: Any = pyarrow
    schema = arrow.schema([(name, arrow.int64() if is_whole(name) else arrow.float64()) for name in names])
    # Values hardly repeat, so a dictionary saves nothing; their first bytes do, which this encoding puts
    # side by side: with snappy smaller than plain zstd, and in less than half of its time.
    split = {name: "BYTE_STREAM_SPLIT" for name in names if not is_whole(name)}
    waiting: list[FloatArray] = []

    def write() -> None:
        arrays = []
        for name, column in zip(names, np.concatenate(waiting).T.copy(), strict=True):
            blank = np.isnan(column)
            values = np.where(blank, 0.0, column).astype(np.int64) if is_whole(name) else column
            arrays.append(arrow.array(values, mask=blank))
        writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))
        waiting.clear()

    def add(values: FloatArray) -> None:
        waiting.append(values)
        if sum(map(len, waiting)) >= _GROUP_ROWS:
            write()

    options: Any = {"compression": "snappy", "use_dictionary": False, "column_encoding": split}
    with parquet.ParquetWriter(stream, schema, **options) as writer:
        yield add
        if waiting:
            write()


@contextmanager
def states_writer(path: Path, names: tuple[str, ...] = STATES, kind: Kind = STATES_FILE) -> Iterator[Add]:
    """A function that adds rows (n, columns) to a table, as states or another `kind`; NaN is blank or null.

    The table appears under its name when it is whole.

    Raises `BadInputError` where the place cannot be written, or the format needs the extra logs.
    """
    formats: dict[str, Any] = {".parquet": _parquet, ".mcap": partial(_mcap, path)}
    opened = formats.get(path.suffix.lower(), _csv)
    with replacing(path, kind) as stream, opened(stream, names) as add:
        yield add

"""The states that `calib replay` writes, block by block: CSV, Parquet or MCAP by the file's ending."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError, pip_install
from calib.core.files import shown
from calib.core.writing import Kind, column_names, head, replacing

# ----------------------------------------------------------------------
# States as MCAP: JSON messages that Foxglove and PlotJuggler show without a plug-in.
#
# `/states` holds every column, with a JSON schema; `/head` is the head as foxglove.PoseInFrame in the
# frame `world` of `calib.stages.actuator.kinematics` (x to the right, y along the straight actuator): a
# turn by
# -phi about z takes the head's frame at rest to the one now. Time is that of the log, from its zero.

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


class McapStates:
    """A states file in MCAP, chunk by chunk; the same rows give the same bytes.

    Raises `BadInputError` without the extra logs, and for a time before zero, which MCAP cannot tell.
    """

    def __init__(self, stream: IO[bytes], names: tuple[str, ...], path: Path) -> None:
        try:
            writer: Any = importlib.import_module("mcap.writer")
        except ImportError as error:
            raise BadInputError(f"{shown(path)}: writing MCAP needs mcap: {pip_install('logs')}") from error
        self._path, self._names = path, names
        self._pose_at = tuple(names.index(name) for name in ("x_m", "y_m", "phi_rad"))
        self._writer = writer.Writer(stream)
        self._writer.start(library="calib")
        # A column that is not known in a row is null there.
        listed: dict[str, Any] = {"timestamp": _TIME} | {name: {"type": ["number", "null"]} for name in names}
        listed["t_s"] = _NUMBER
        described = {"title": "calib.States", "type": "object", "properties": listed}
        self._states = self._channel(STATES_TOPIC, described)
        self._head = self._channel(HEAD, _POSE)

    def _channel(self, topic: str, described: dict[str, Any]) -> int:
        schema = self._writer.register_schema(
            described["title"], "jsonschema", json.dumps(described).encode()
        )
        return int(self._writer.register_channel(topic, "json", schema))

    def add(self, values: FloatArray) -> None:
        """Rows (n, columns)."""
        names = self._names
        for row in values.tolist():
            stamp = round(row[0] * 1e9)
            if stamp < 0:
                raise BadInputError(
                    f"{shown(self._path)}: t_s is {row[0]:.6f}, expected no time before 0 in MCAP; "
                    "write .csv or .parquet"
                )
            time = f'{{"timestamp":{{"sec":{stamp // 1_000_000_000},"nsec":{stamp % 1_000_000_000}}}'
            cells = ",".join(f'"{name}":{_cell(value)}' for name, value in zip(names, row, strict=True))
            self._put(self._states, stamp, f"{time},{cells}}}")
            x, y, phi = (row[k] for k in self._pose_at)
            if math.isfinite(x + y + phi):
                turn = f'"x":0,"y":0,"z":{math.sin(-0.5 * phi):.9g},"w":{math.cos(0.5 * phi):.9g}'
                place = f'"x":{x:.9g},"y":{y:.9g},"z":0'
                pose = f'{{"position":{{{place}}},"orientation":{{{turn}}}}}'
                self._put(self._head, stamp, f'{time},"frame_id":"world","pose":{pose}}}')

    def _put(self, channel: int, stamp: int, text: str) -> None:
        self._writer.add_message(channel, stamp, text.encode(), stamp)

    def end(self) -> None:
        """Write the last chunk and the index."""
        self._writer.finish()

    def abandon(self) -> None:
        """Nothing is held."""


# ----------------------------------------------------------------------
# The states file that `calib replay` writes, block by block: CSV, Parquet or MCAP by its ending.

STATES = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", "nis_camera", "nis_accel", "nis_gyro",
    "gated_camera", "gated_accel", "gated_gyro", "flags", "rest_weight", "swing_weight",
    "driven_weight",
)  # fmt: skip
"""Columns of the states file."""

ENDINGS = (".csv", ".parquet", ".mcap")
"""Of the formats; any other ending is written as CSV."""


def _holds_states(path: Path) -> bool:
    start = head(path, 512)
    if start.startswith(b"\x89MCAP0"):
        # The header names the library.
        return b"calib" in start
    return column_names(path)[: len(_FIRST)] == _FIRST


_FIRST = STATES[:6]
STATES_FILE = Kind("states", ENDINGS, _holds_states)

_GROUP_ROWS = 1 << 17


class StatesFile(Protocol):
    """A states file that is being written."""

    def add(self, values: FloatArray) -> None:
        """Rows (n, columns); NaN becomes a blank cell or a null."""
        ...

    def end(self) -> None:
        """Write what is left."""
        ...

    def abandon(self) -> None:
        """Let go of the stream; what was written is of no use."""
        ...


def is_whole(name: str) -> bool:
    """Whether a column holds whole numbers."""
    return name.startswith("gated") or name == "flags"


class CsvStates:
    """Lines with time to the microsecond, counts without decimals, all else to nine digits."""

    def __init__(self, stream: IO[bytes], names: tuple[str, ...]) -> None:
        from calib.io.cells import GENERAL, TIME, WHOLE, table_bytes

        kinds = [WHOLE if is_whole(name) else TIME if name == "t_s" else GENERAL for name in names]
        self._stream, self._kinds, self._text = stream, np.array(kinds), table_bytes
        stream.write((",".join(names) + "\n").encode())

    def add(self, values: FloatArray) -> None:
        """Rows (n, columns)."""
        self._stream.write(self._text(values, self._kinds))

    def end(self) -> None:
        """Nothing waits."""

    def abandon(self) -> None:
        """Nothing is held."""


class ParquetStates:
    """Row groups of some hundred thousand rows; counts are integers, NaN is null."""

    def __init__(self, stream: IO[bytes], names: tuple[str, ...]) -> None:
        import pyarrow
        from pyarrow import parquet

        self._arrow: Any = pyarrow
        kinds = {True: self._arrow.int64(), False: self._arrow.float64()}
        self._schema = self._arrow.schema([(name, kinds[is_whole(name)]) for name in names])
        # Values hardly repeat, so a dictionary saves nothing; their first bytes do, which this encoding puts
        # side by side: with snappy smaller than plain zstd, and in less than half of its time.
        split = {name: "BYTE_STREAM_SPLIT" for name in names if not is_whole(name)}
        self._writer = parquet.ParquetWriter(
            stream, self._schema, compression="snappy", use_dictionary=False, column_encoding=split
        )
        self._waiting: list[FloatArray] = []
        self._rows = 0

    def add(self, values: FloatArray) -> None:
        """Rows (n, columns)."""
        self._waiting.append(values)
        self._rows += len(values)
        if self._rows >= _GROUP_ROWS:
            self._write()

    def _write(self) -> None:
        if not self._rows:
            return
        columns = np.concatenate(self._waiting).T.copy()
        self._waiting, self._rows = [], 0
        arrays = []
        for field, column in zip(self._schema, columns, strict=True):
            blank = np.isnan(column)
            values = np.where(blank, 0.0, column).astype(np.int64) if is_whole(field.name) else column
            arrays.append(self._arrow.array(values, mask=blank))
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    def end(self) -> None:
        """Write the last row group and the footer."""
        self._write()
        self._writer.close()

    def abandon(self) -> None:
        """Close while there is a stream to close on; later the package would complain."""
        with contextlib.suppress(Exception):
            self._writer.close()


def _opened(path: Path, stream: IO[bytes], names: tuple[str, ...]) -> StatesFile:
    ending = path.suffix.lower()
    if ending == ".parquet":
        return ParquetStates(stream, names)
    if ending == ".mcap":
        return McapStates(stream, names, path)
    return CsvStates(stream, names)


def _filled(states: StatesFile) -> Iterator[StatesFile]:
    try:
        yield states
        states.end()
    except BaseException:
        states.abandon()
        raise


@contextmanager
def states_writer(
    path: Path, names: tuple[str, ...] = STATES, kind: Kind = STATES_FILE
) -> Iterator[StatesFile]:
    """Write a table block by block, as states or another `kind`; it appears under its name when it is whole.

    Raises `BadInputError` where the place cannot be written, or the format needs the extra logs.
    """
    with replacing(path, kind) as stream:
        yield from _filled(_opened(path, stream, names))

"""States as MCAP: JSON messages that Foxglove and PlotJuggler show without a plug-in.

`/states` holds every column, with a JSON schema; `/head` is the head as foxglove.PoseInFrame in the
frame `world` of `calib.actuator.kinematics` (x to the right, y along the straight actuator): a turn by
-phi about z takes the head's frame at rest to the one now. Time is that of the log, from its zero.
"""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path
from typing import IO, Any

from calib.arrays import FloatArray
from calib.errors import BadInputError, pip_install
from calib.files import shown

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

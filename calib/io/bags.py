"""Logs in bags: ROS 1 `.bag`, ROS 2 folders and `.db3`, MCAP (ROS messages or JSON)."""

from __future__ import annotations

import bz2
import importlib
import io
import json
import math
import operator
import os
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any, BinaryIO, Protocol

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError, CalibError, package, pip_install
from calib.core.files import check_readable, one_line, quoted, read_yaml_mapping, shown, to_be
from calib.core.words import several
from calib.io.columns import COLUMNS
from calib.io.tables import Block, Passed

# ----------------------------------------------------------------------
# Which field of which topic of a bag is which column of a log.
#
# A bag holds messages by topic; `calib.io.logs` knows columns. What goes where stands in a YAML file,
# `NAME.topics.yaml` beside the bag, or `topics.yaml` in its folder:
#
#     time: stamp                # header.stamp where a message has one (default), or received
#     topics:
#       /imu/data: imu           # accelerations and rates of sensor_msgs/Imu
#       /camera/marker:          # any message: column and path of the field
#         u_px: point.x
#         v_px: point.y
#       /command:
#         pwm1: data[0]
#         gz_radps: {field: rates.z, factor: 0.017453292519943295}
#
# Without `topics` the only topic of sensor_msgs/Imu is the IMU, `marker` (a point) the marker and `pwm` (an
# array) the commands, in whatever namespace; fields of JSON messages that bear a column's name are that
# column. Topics without messages are passed over.

IMU = {
    "ax_mps2": "linear_acceleration.x",
    "ay_mps2": "linear_acceleration.y",
    "az_mps2": "linear_acceleration.z",
    "gx_radps": "angular_velocity.x",
    "gy_radps": "angular_velocity.y",
    "gz_radps": "angular_velocity.z",
}
"""Fields of sensor_msgs/Imu."""

_POINTS = {
    "geometry_msgs/PointStamped": "point.",
    "geometry_msgs/Point": "",
    "geometry_msgs/Vector3Stamped": "vector.",
    "geometry_msgs/Vector3": "",
}
_ARRAY = re.compile(r"std_msgs/(Float|U?Int)(8|16|32|64)MultiArray")
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d{1,6}\])*)")
_PRESETS = ("imu", "marker", "pwm")
_SHOWN = 8


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, its type as package/Name, the fields of its JSON schema, whether it has any
    messages."""

    name: str
    kind: str
    fields: tuple[str, ...] = ()
    used: bool = True


def in_use(topics: Sequence[Topic]) -> Sequence[Topic]:
    """Those that have messages; all where none has."""
    return [topic for topic in topics if topic.used] or topics


@dataclass(frozen=True)
class Field:
    """Where a column comes from: path of the field, and what it is multiplied by."""

    column: str
    path: str
    factor: float = 1.0


@dataclass(frozen=True)
class TopicMap:
    """Fields by topic; `stamped` whether the time is the message's own, `source` for messages."""

    source: str
    topics: Mapping[str, tuple[Field, ...]]
    stamped: bool = True

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns that come out, in the order of `calib.io.logs.COLUMNS`."""
        named = {field.column for fields in self.topics.values() for field in fields}
        return tuple(name for name in COLUMNS if name in named)


def find_topics(path: Path) -> Path | None:
    """The file of topics that lies beside a bag, or in it if it is a folder; None without."""
    places = [path.with_name(f"{path.stem}.topics.yaml"), path.with_name("topics.yaml")]
    if path.is_dir():
        places = [path / "topics.yaml", path.with_name(f"{path.name}.topics.yaml"), places[1]]
    return next((place for place in places if place.is_file()), None)


def topic_map(bag: Path, topics: Sequence[Topic], given: Path | None = None) -> TopicMap:
    """What is read of a bag: as `given` says, as the file beside it says, or the defaults.

    Raises `BadInputError` naming the key for what is wrong, the topics of the bag for one it lacks.
    """
    place = find_topics(bag) if given is None else given
    return _defaults(bag, topics) if place is None else _from_file(place, bag, topics)


def _listed(topics: Sequence[Topic]) -> str:
    named = [f"{one_line(topic.name)[:80]} ({one_line(topic.kind)[:60]})" for topic in topics]
    return several(named, _SHOWN) or "none"


def _preset(kind: str, topic: Topic) -> dict[str, str] | None:
    """Columns and paths of what is expected of a topic, None where its type has none."""
    if kind == "imu":
        return dict(IMU) if topic.kind == "sensor_msgs/Imu" else None
    if kind == "marker" and topic.kind in _POINTS:
        return {"u_px": _POINTS[topic.kind] + "x", "v_px": _POINTS[topic.kind] + "y"}
    if kind == "pwm" and _ARRAY.fullmatch(topic.kind):
        return {"pwm1": "data[0]", "pwm2": "data[1]"}
    return None


_EXPECTED = {
    "imu": "sensor_msgs/Imu",
    "marker": "geometry_msgs/PointStamped, Point, Vector3Stamped or Vector3",
    "pwm": "std_msgs/Float32MultiArray or another array of numbers",
}


def _fields(columns: Mapping[str, str]) -> tuple[Field, ...]:
    return tuple(Field(column, path) for column, path in columns.items())


def _defaults(bag: Path, topics: Sequence[Topic]) -> TopicMap:
    source = shown(bag)
    found: dict[str, tuple[Field, ...]] = {}
    topics = in_use(topics)
    imus = [topic for topic in topics if topic.kind == "sensor_msgs/Imu"]
    hint = f"say which in {shown(bag.stem)}.topics.yaml beside it"
    if len(imus) > 1:
        raise BadInputError(f"{source}: has {len(imus)} topics of sensor_msgs/Imu: {_listed(imus)}; {hint}")
    for topic in topics:
        named = topic.name.rsplit("/", 1)[-1]
        kind = "imu" if topic in imus else named if named in ("marker", "pwm") else ""
        columns = _preset(kind, topic) if kind else None
        if columns is None:
            columns = {name: name for name in topic.fields if name in COLUMNS}
        if columns:
            found[topic.name] = _fields(columns)
    if not found:
        from calib.io.states import HEAD, STATES_TOPIC

        if {STATES_TOPIC, HEAD} <= {topic.name for topic in topics}:
            raise BadInputError(f"{source}: holds states that calib replay has written, expected a log")
        raise BadInputError(
            f"{source}: has no topic that is known by itself, found {_listed(topics)}; {hint}"
        )
    return _checked(TopicMap(source, found))


def _from_file(place: Path, bag: Path, topics: Sequence[Topic]) -> TopicMap:
    source, document = shown(place), read_yaml_mapping(place)
    for key in document:
        if key not in ("time", "topics"):
            raise BadInputError(f"{source}: {one_line(key)[:60]} is not known, expected time or topics")
    time = document.get("time", "stamp")
    if time not in ("stamp", "received"):
        raise BadInputError(f"{source}: time is {quoted(time)}, expected stamp or received")
    if "topics" not in document:
        return replace(_defaults(bag, topics), stamped=time == "stamp")
    listed = document["topics"]
    if not isinstance(listed, dict) or not listed:
        raise BadInputError(f"{source}: topics is {quoted(listed)}, expected topics with their columns")
    there = {topic.name: topic for topic in topics}
    found = {}
    for name, wanted in listed.items():
        if name not in there:
            raise BadInputError(
                f"{source}: the topic {quoted(name)} is not in {shown(bag)}, which has {_listed(topics)}"
            )
        found[name] = _wanted(f"{source}: topics.{one_line(name)[:80]}", wanted, there[name])
    return _checked(TopicMap(source, found, time == "stamp"))


def _wanted(where: str, wanted: Any, topic: Topic) -> tuple[Field, ...]:
    """The fields that one entry of the file asks for."""
    known = wanted in _PRESETS if isinstance(wanted, str) else isinstance(wanted, dict) and wanted
    if not known:
        raise BadInputError(f"{where} is {quoted(wanted)}, expected {', '.join(_PRESETS)} or columns")
    if isinstance(wanted, str):
        columns = _preset(wanted, topic)
        if columns is None:
            raise BadInputError(
                f"{where} is of type {one_line(topic.kind)[:60]}, expected {_EXPECTED[wanted]}"
            )
        return _fields(columns)
    fields = []
    for column, path in wanted.items():
        if column not in COLUMNS:
            raise BadInputError(
                f"{where}: {quoted(column)} is no column, expected one of {', '.join(COLUMNS)}"
            )
        entry: dict[str, Any] = (
            path if isinstance(path, dict) and set(path) <= {"field", "factor"} else {"field": path}
        )
        path, factor = entry.get("field"), entry.get("factor", 1.0)
        if not isinstance(path, str) or not all(_STEP.fullmatch(step) for step in path.split(".")):
            raise BadInputError(
                f"{where}.{column} is {quoted(path)}, expected a field such as point.x or data[0]"
            )
        if isinstance(factor, bool) or not isinstance(factor, int | float) or not math.isfinite(factor):
            raise BadInputError(f"{where}.{column}: the factor is {quoted(factor)}, expected a number")
        fields.append(Field(column, path, float(factor)))
    return tuple(fields)


def _checked(found: TopicMap) -> TopicMap:
    """The map, if no column comes from two topics."""
    origin: dict[str, str] = {}
    for topic, fields in found.topics.items():
        for field in fields:
            if field.column in origin:
                names = f"{one_line(origin[field.column])[:80]} and {one_line(topic)[:80]}"
                raise BadInputError(f"{found.source}: {field.column} comes from two topics, {names}")
            origin[field.column] = topic
    return found


def reader_of(source: str, topic: str, field: Field) -> Callable[[Any], float]:
    """A function from a message to a column's value; NaN for a null.

    The function raises `BadInputError` where the message has no such field or it is no number.
    """
    steps: list[str | int] = [
        name if name else int(index) for name, index in re.findall(r"([A-Za-z_]\w*)|\[(\d+)\]", field.path)
    ]
    where = f"{source}: {one_line(topic)[:80]}: {field.path} (for {field.column})"
    factor = field.factor

    def found(message: Any) -> Any:
        value = message
        for step in steps:
            if isinstance(step, int) and isinstance(value, Sequence) and not value:
                # Nothing was detected.
                return None
            try:
                value = (
                    value[step] if isinstance(step, int) or isinstance(value, dict) else getattr(value, step)
                )
            except (AttributeError, KeyError, IndexError, TypeError):
                raise BadInputError(
                    f"{where} is not in the message, which has {_named(value, step)}"
                ) from None
        return value

    named = [step for step in steps if isinstance(step, str)]
    quick = operator.attrgetter(field.path) if len(named) == len(steps) else found

    def read(message: Any) -> float:
        try:
            value = found(message) if isinstance(message, dict) else quick(message)
        except AttributeError:
            value = found(message)
        if isinstance(value, float):
            return value * factor
        if value is None:
            return math.nan
        try:
            if isinstance(value, str | bytes | bytearray):
                raise TypeError
            return float(value) * factor
        except (TypeError, ValueError, OverflowError):
            raise BadInputError(f"{where} is {quoted(value)}, expected a number") from None

    return read


def _named(value: Any, step: str | int) -> str:
    """What stands where a field was looked for in vain."""
    if isinstance(step, int):
        try:
            return f"{len(value)} elements there"
        except TypeError:
            return f"{quoted(value)} there"
    names = list(value) if isinstance(value, dict) else list(getattr(value, "__dataclass_fields__", ()))
    names = [one_line(str(name))[:40] for name in names if not str(name).startswith("__")]
    return ", ".join(names[:_SHOWN]) if names else f"{quoted(value)} there"


# ----------------------------------------------------------------------
# From the messages of a bag to the rows of a log, in the order of their time.
#
# Topics are recorded as they arrive, so stamps of two topics interleave out of order by some
# milliseconds; messages are held for `WINDOW_S` and sorted. Those with one stamp and different columns
# make one row. Stamps that count from the epoch are told from the first row on, so that a double holds
# them to the nanosecond; others, as of a simulation, stay as they are.

WINDOW_S = 2.0
"""How long a message is waited for that arrives after one with a later stamp."""

_ROWS = 16384
_EPOCH_NS = 10**17
"""Three years: no log of a rig's own clock is longer."""


class Source(Protocol):
    """Messages of an opened bag.

    Attributes
    ----------
    topics : what it holds. truncated : whether it was found to end early, known after the last message.
    """

    @property
    def topics(self) -> tuple[Topic, ...]: ...

    @property
    def truncated(self) -> bool: ...

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of reception [ns] and decoded message, in the order of the file."""
        ...


def _stamp(message: Any) -> int | None:
    """A message's own time [ns], None without: header.stamp, or what JSON messages call timestamp."""
    if isinstance(message, dict):
        header = message.get("header")
        stamp = header.get("stamp") if isinstance(header, dict) else message.get("timestamp")
        if not isinstance(stamp, dict):
            return None
        sec, nsec = stamp.get("sec"), stamp.get("nsec", stamp.get("nanosec", 0))
    else:
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        sec, nsec = getattr(stamp, "sec", None), getattr(stamp, "nanosec", 0)
    if not isinstance(sec, int) or not isinstance(nsec, int):
        return None
    whole = sec * 1_000_000_000 + nsec
    return whole if 0 < whole < 2**63 else None


def _merged(stamps: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray, int]:
    """Rows of one stamp as one, where no column has two values, and how many said the same again.

    Rows are sorted.
    """
    if len(stamps) < 2 or not np.any(stamps[1:] == stamps[:-1]):
        return stamps, values, 0
    begin = np.nonzero(np.concatenate([[True], stamps[1:] != stamps[:-1]]))[0]
    there = ~np.isnan(values)
    most = np.maximum.reduceat(np.where(there, values, -np.inf), begin, axis=0)
    least = np.minimum.reduceat(np.where(there, values, np.inf), begin, axis=0)
    alone = np.all(most <= least, axis=1)
    group = np.cumsum(np.concatenate([[True], stamps[1:] != stamps[:-1]])) - 1
    keep = ~alone[group]
    keep[begin] = True
    out = values.copy()
    out[begin[alone]] = np.where(least < np.inf, least, np.nan)[alone]
    again = np.add.reduceat(there.astype(np.int64), begin, axis=0)[alone].max(axis=1, initial=1) - 1
    return stamps[keep], out[keep], int(again.sum())


# ----------------------------------------------------------------------
# Whose clock the topics of a bag are stamped by, as far as the times of reception tell.

_OTHER_CLOCK_S = 1.0
"""What stamps of two topics may be apart from their reception: a camera that works for long is no clock."""


@dataclass
class _Clock:
    """Times of a topic's messages: how many have a header without a stamp, by how much stamps are before the
    reception at least, and the first and the last."""

    unset: int = 0
    late_ns: float = math.inf
    first_ns: float = math.inf
    last_ns: float = -math.inf

    def time(self, message: Any, received_ns: int, stamped: bool) -> int:
        """The message's time [ns]."""
        stamp = _stamp(message) if stamped else None
        if stamp is None:
            stamp = received_ns
            self.unset += stamped and getattr(message, "header", None) is not None
        self.late_ns = min(self.late_ns, received_ns - stamp)
        self.first_ns, self.last_ns = min(self.first_ns, stamp), max(self.last_ns, stamp)
        return stamp


def _odd_times(source: str, clocks: Mapping[str, _Clock]) -> str:
    """A sentence on topics by another clock than the others, or without stamps; "" for none.

    Raises `BadInputError` where topics by two clocks have no time in common.
    """
    by_late = sorted((clock.late_ns, name) for name, clock in clocks.items() if math.isfinite(clock.late_ns))
    if not by_late:
        return ""
    (least_ns, low), (most_ns, high) = by_late[0], by_late[-1]
    if most_ns - least_ns > 1e9 * _OTHER_CLOCK_S:
        said = (
            f"{one_line(high)[:80]} has stamps {most_ns / 1e9:.3f} s before their reception, "
            f"{one_line(low)[:80]} {least_ns / 1e9:.3f} s"
        )
        a, b = clocks[low], clocks[high]
        if a.first_ns > b.last_ns or b.first_ns > a.last_ns:
            raise BadInputError(
                f"{source}: {said}: two clocks with no time in common; the line time: received in a "
                "topics.yaml beside it takes the times of reception"
            )
        return f"{said}, as of two clocks"
    unset = [name for name, clock in clocks.items() if clock.unset]
    if unset:
        count = sum(clocks[name].unset for name in unset)
        names = several([one_line(name)[:80] for name in unset])
        return f"{count} messages of {names} have no stamp in their header; taken when they were received"
    return ""


def _chunks(
    source: str, stream: Source, topics: TopicMap, clocks: dict[str, _Clock]
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Stamps and values in the order of the file, some thousand messages at a time; `clocks` are filled."""
    slots = {name: k for k, name in enumerate(topics.columns)}
    readers: dict[str, list[tuple[int, Callable[[Any], float]]]] = {
        name: [(slots[field.column], reader_of(source, name, field)) for field in fields]
        for name, fields in topics.topics.items()
    }
    stamps, values = np.empty(_ROWS, dtype=np.int64), np.full((_ROWS, len(slots)), np.nan)
    filled = 0
    for name, received, message in stream.messages(list(readers)):
        stamps[filled] = clocks[name].time(message, received, topics.stamped)
        row = values[filled]
        for slot, read in readers[name]:
            row[slot] = read(message)
        filled += 1
        if filled == _ROWS:
            yield stamps, values
            stamps, values, filled = np.empty_like(stamps), np.full_like(values, np.nan), 0
    if filled:
        yield stamps[:filled], values[:filled]


def rows_from_messages(source: str, stream: Source, topics: TopicMap) -> Iterator[Block]:
    """Blocks of a log; a block may have no rows, and there is at least one.

    Raises `BadInputError` for a message without an expected field.
    """
    columns = topics.columns
    clocks = {name: _Clock() for name in topics.topics}
    start, first = None, 1

    def made(stamps: IntArray, values: FloatArray) -> Block:
        nonlocal start, first
        infinite = int(np.count_nonzero(np.isinf(values)))
        stamps, values, twice = _merged(stamps, np.where(np.isinf(values), np.nan, values))
        if start is None and len(stamps):
            start = int(stamps[0]) if stamps[0] >= _EPOCH_NS else 0
        t_s = (stamps - (start or 0)) / 1e9
        lines = np.arange(first, first + len(stamps), dtype=np.int64)
        first += len(stamps)
        named = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(columns)}
        return Block({"t_s": t_s, **named}, lines, Passed(infinite, twice=twice))

    stamps, values = np.empty(0, dtype=np.int64), np.empty((0, len(columns)))
    try:
        for more, others in _chunks(source, stream, topics, clocks):
            # Rows that nothing can precede any more.
            ready = int(np.searchsorted(stamps, stamps[-1] - int(WINDOW_S * 1e9))) if len(stamps) else 0
            if ready:
                yield made(stamps[:ready], values[:ready])
            stamps, values = np.concatenate([stamps[ready:], more]), np.concatenate([values[ready:], others])
            order = np.argsort(stamps, kind="stable")
            stamps, values = stamps[order], values[order]
        last = made(stamps, values)
        passed = last.passed + Passed(truncated=stream.truncated, times=_odd_times(source, clocks))
        yield replace(last, passed=passed)
    except OverflowError as error:
        raise BadInputError(f"{source}: has a time that is none: {error}") from error


# ----------------------------------------------------------------------
# Packed parts of bags, unpacked within a bound: a kilobyte may stand for gigabytes.
#
# The packages that read bags unpack what they find, however much that becomes. So an MCAP file's chunks
# are looked at before it is read, chunks and messages of ROS bags are unpacked here, and a bag that is packed
# as a whole, which is unpacked on the disk, may not grow more than logs do.

MOST_BYTES = 1 << 28
"""Of one record, chunk or message, packed or not."""

_MOST_GROWTH = 200
_NAME_NODE, _ARRAY_NODE, _SEQUENCE_NODE = 2, 3, 4
"""Kinds of nodes in a field's type."""
_PIECE = 1 << 20


class BoundedFile(io.BufferedReader):
    """A file that makes no room for more bytes than it has, whatever it says of the length of a part."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As the base class."""
        if size is not None and size > _PIECE:
            size = min(size, max(0, self._size - self.tell()))
        return super().read(size)


class BoundedPath(type(Path())):  # type: ignore[misc]  # a Path is made as one of two classes
    """A path whose files are `BoundedFile`, for readers that open them by themselves."""

    def open(self, mode: str = "r", *others: Any, **more: Any) -> Any:
        """As the base class."""
        return BoundedFile(self) if mode == "rb" else super().open(mode, *others, **more)


def _zstd() -> Any:
    """The package that `rosbags` uses: Python's own from 3.14 on."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return importlib.import_module("backports.zstd")


def _decompressor(packing: str) -> Any:
    if packing == "bz2":
        return bz2.BZ2Decompressor()
    if packing == "lz4":
        return importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    return _zstd().ZstdDecompressor()


def unpacked(packing: str, data: bytes) -> bytes:
    """What is packed as "bz2", "lz4" or "zstd". Raises `ValueError` for more than `MOST_BYTES`."""
    out = _at_most(packing, data)
    if len(out) > MOST_BYTES:
        raise ValueError(f"a part of it unpacks to more than {MOST_BYTES / 1e6:.0f} MB")
    return out


def bound_chunks(reader: Any) -> None:
    """Let an opened reader of ROS 1 bags unpack its chunks by `unpacked`."""
    kinds = {id(bz2.decompress): "bz2", id(importlib.import_module("lz4.frame").decompress): "lz4"}
    for place, chunk in reader.chunks.items():
        if chunk.datasize > MOST_BYTES:
            raise ValueError(f"a chunk has {chunk.datasize / 1e6:.0f} MB")
        packing = kinds.get(id(chunk.decompressor))
        if packing is not None:
            reader.chunks[place] = chunk._replace(decompressor=partial(unpacked, packing))


def check_types(kinds: Mapping[str, Any]) -> None:
    """Raise `ValueError` for message types of which no bytes at all may stand for endless elements.

    Parameters
    ----------
    kinds : constants and fields by the type's name, as `rosbags` has them; a field is its name and a node.
    """
    known: dict[str, bool] = {}

    def empty(node: Any) -> bool:
        kind, inner = int(node[0]), node[1]
        if kind == _NAME_NODE:
            return nothing(inner)
        if kind in (_ARRAY_NODE, _SEQUENCE_NODE) and empty(inner[0]):
            raise ValueError("a type of its messages has many elements that hold nothing")
        return False

    def nothing(name: str) -> bool:
        if name not in known:
            known[name] = False
            # No field is passed over: each may be what is looked for.
            found = [empty(node) for _, node in kinds[name][1]] if name in kinds else [False]
            known[name] = all(found)
        return known[name]

    for name in kinds:
        nothing(name)


def check_mcap(path: Path, stream: BinaryIO) -> None:
    """Refuse a chunk that unpacks to more than there is room for, whatever it says of itself."""
    errors = importlib.import_module("mcap.exceptions")
    records = importlib.import_module("mcap.stream_reader").StreamReader(
        stream, emit_chunks=True, record_size_limit=MOST_BYTES
    )
    try:
        for record in records.records:
            if type(record).__name__ == "Chunk" and (size := _unpacked_size(record)) > MOST_BYTES:
                raise BadInputError(
                    f"{shown(path)}: a chunk unpacks to {size / 1e6:.0f} MB or more, expected at most "
                    f"{MOST_BYTES / 1e6:.0f}"
                )
    except (errors.EndOfFile, struct.error):
        # How much of a file that ends early can be used is seen when it is read.
        pass
    stream.seek(0)


def _unpacked_size(chunk: Any) -> int:
    """Bytes that a chunk unpacks to, at least, where that is beyond what is allowed."""
    size = int(chunk.uncompressed_size)
    if chunk.compression == "zstd":
        told = int(importlib.import_module("zstandard").frame_content_size(chunk.data))
        return max(size, told if told >= 0 else len(_at_most("zstd", chunk.data)))
    if chunk.compression == "lz4" and 255 * len(chunk.data) > MOST_BYTES:
        return max(size, len(_at_most("lz4", chunk.data)))
    return size


def _at_most(packing: str, data: bytes) -> bytes:
    found: bytes = _decompressor(packing).decompress(data, MOST_BYTES + 1)
    return found


def check_folder_of_bag(path: Path) -> str:
    """How the messages of a ROS 2 bag's folder are packed: "zstd", or "" where they are not.

    Raises `BadInputError` where its metadata are no YAML, or a file of it unpacks to too much.
    """
    told = read_yaml_mapping(path / "metadata.yaml").get("rosbag2_bagfile_information")
    if not isinstance(told, dict):
        raise BadInputError(f"{shown(path)}: has a metadata.yaml without rosbag2_bagfile_information")
    mode, listed = str(told.get("compression_mode") or "").lower(), told.get("relative_file_paths")
    files = [path / PurePath(str(name)).name for name in listed] if isinstance(listed, list) else []
    for file in files:
        if not file.is_file():
            raise BadInputError(f"{shown(file)}: is not there, expected a file of the bag")
        if mode == "file":
            _check_growth(file)
        elif told.get("storage_identifier") == "mcap":
            with BoundedFile(file) as stream:
                check_mcap(file, stream)
    return "zstd" if mode == "message" else ""


def _check_growth(file: Path) -> None:
    most, size = max(MOST_BYTES, _MOST_GROWTH * file.stat().st_size), 0
    with file.open("rb") as packed, _zstd().open(packed, "rb") as stream:
        while piece := stream.read(_PIECE):
            size += len(piece)
            if size > most:
                raise BadInputError(f"{shown(file)}: unpacks to more than {most / 1e6:.0f} MB")


# ----------------------------------------------------------------------
# Logs in bags: ROS 1 `.bag`, ROS 2 folders and `.db3`, MCAP (ROS messages or JSON).
#
# The readers are those of the packages `rosbags` and `mcap` (extra logs). Both hand out one message at a
# time, so nothing grows with the length of a bag but its index.

_MOST_TOPICS = 10000


@contextmanager
def bag_blocks(path: Path, topics: Path | None = None) -> Iterator[tuple[tuple[str, ...], Iterator[Block]]]:
    """Topics of a bag that are left out, and blocks of its rows; `topics` is a file that says what is where.

    Raises
    ------
    BadInputError
        Without the extra logs, for a bag that cannot be read, a topic it lacks, a field that its messages
        lack, and a value that is no number.
    """
    with opened_bag(path) as stream:
        read = topic_map(path, stream.topics, topics)
        left_out = tuple(one.name for one in stream.topics if one.used and one.name not in read.topics)
        yield left_out, rows_from_messages(shown(path), stream, read)


@contextmanager
def opened_bag(path: Path) -> Iterator[Source]:
    """The messages of a bag; what goes wrong while they are read is a `BadInputError` as well."""
    if not path.is_dir():
        check_readable(path)
    opened = _mcap if path.is_file() and path.suffix.lower() == ".mcap" else _rosbag
    try:
        with to_be("read", path), opened(path) as stream:
            yield stream
    except CalibError:
        raise
    except Exception as error:
        # Damaged bytes make the packages raise nearly anything, and which is not part of their interface.
        said = one_line(str(error) or type(error).__name__)[:160]
        raise BadInputError(
            f"{shown(path)}: is not a bag that can be read: {said}; if its recording was cut, {_mend(path)}"
        ) from error


def _mend(path: Path) -> str:
    """What mends a bag whose recorder did not end it."""
    tools = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "sqlite3's .recover"}
    endings = (file.suffix.lower() for file in (path.iterdir() if path.is_dir() else [path]))
    return f"mend it with {next((tools[e] for e in endings if e in tools), 'ros2 bag reindex')}"


def _module(path: Path, name: str) -> Any:
    what, of = f"reading {path.suffix.lstrip('.') or 'bags'}", name.split(".")[0]
    return package(name, f"{shown(path)}: {what} needs the package {of}: {pip_install('logs')}")


def _kind(name: str) -> str:
    """A message type as package/Name, as ROS 1 writes it."""
    return name.replace("/msg/", "/")


_ZSTD_FRAME = b"\x28\xb5\x2f\xfd"
"""The beginning of what is packed; a message begins with a zero."""


class _RosBag:
    """A bag that `rosbags` has opened."""

    def __init__(self, reader: Any, packing: str) -> None:
        self._reader, self._packing = reader, packing
        self.truncated = False
        kinds = {connection.topic: _kind(connection.msgtype) for connection in reader.connections}
        used = {connection.topic for connection in reader.connections if connection.msgcount}
        self.topics = tuple(Topic(name, kinds[name], used=name in used) for name in sorted(kinds))

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = set(names)
        connections = [item for item in self._reader.connections if item.topic in wanted]
        for connection, received, data in self._reader.messages(connections=connections):
            # The file of a bag without its folder does not say that its messages are packed.
            if self._packing or (self._reader.is2 and data[:4] == _ZSTD_FRAME):
                data = unpacked("zstd", data)
            yield connection.topic, received, self._reader.deserialize(data, connection.msgtype)


@contextmanager
def _rosbag(path: Path) -> Iterator[Source]:
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BadInputError(
            f"{shown(path)}: is a folder without metadata.yaml, expected a log or a ROS 2 bag"
        )
    reader = _module(path, "rosbags.highlevel")
    typesys = _module(path, "rosbags.typesys")
    # Bags older than ROS 2 Iron do not say how their messages are made up.
    known = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    packing = check_folder_of_bag(path) if path.is_dir() else ""
    with reader.AnyReader([BoundedPath(path)], default_typestore=known) as opened:
        check_types(opened.typestore.fielddefs)
        for one in opened.readers:
            if hasattr(one, "chunks"):
                bound_chunks(one)
            elif packing:
                # Its own way to unpack messages has no bound.
                one.storage.metadata = one.storage.metadata._replace(compression_mode=None)
        yield _RosBag(opened, packing)


class _Mcap:
    """An MCAP file: with its index in the order of time, without in the order of the file."""

    def __init__(self, path: Path, stream: Any) -> None:
        self._path, self._stream = path, stream
        self.truncated = False
        reader = _module(path, "mcap.reader")
        self._errors = _module(path, "mcap.exceptions")
        self._make = {
            True: lambda: reader.SeekingReader(stream, record_size_limit=MOST_BYTES),
            False: lambda: reader.NonSeekingReader(stream, record_size_limit=MOST_BYTES),
        }
        check_mcap(path, stream)
        summary = self._summary()
        self._indexed = summary is not None
        # Sorting costs a third of the time, and most writers close a chunk before they begin the next.
        chunks = [] if summary is None else summary.chunk_indexes
        spans = sorted((c.chunk_start_offset, c.message_start_time, c.message_end_time) for c in chunks)
        self._jumbled = any(after[1] < before[2] for before, after in pairwise(spans))
        channels: dict[str, tuple[Any, Any]] = {}
        used = set[str]()
        if summary is not None:
            counts = {} if summary.statistics is None else summary.statistics.channel_message_counts
            for channel in summary.channels.values():
                channels[channel.topic] = (summary.schemas.get(channel.schema_id), channel)
                # Without counts any may have messages.
                used |= {channel.topic} if counts.get(channel.id) or not counts else set()
        else:
            for schema, channel, _ in self._all(None):
                channels.setdefault(channel.topic, (schema, channel))
            used = set(channels)
        if self.truncated and not channels:
            raise BadInputError(f"{shown(path)}: ends within its first messages; {_mend(path)}")
        if len(channels) > _MOST_TOPICS:
            raise BadInputError(f"{shown(path)}: has {len(channels)} topics, expected at most {_MOST_TOPICS}")
        self.topics = tuple(
            replace(_mcap_topic(name, *channels[name]), used=name in used) for name in sorted(channels)
        )

    def _summary(self) -> Any:
        """The index at the end; None for a file that was not closed."""
        try:
            summary = self._make[True]().get_summary()
        except (self._errors.McapError, ValueError, EOFError):
            return None
        return summary if summary is not None and summary.channels else None

    def _all(self, names: list[str] | None) -> Iterator[tuple[Any, Any, Any]]:
        self._stream.seek(0)
        reader = self._make[self._indexed]()
        try:
            yield from reader.iter_messages(topics=names, log_time_order=self._jumbled)
        except (self._errors.EndOfFile, struct.error):
            self.truncated = True

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        decoders: dict[int, Callable[[bytes], Any]] = {}
        for schema, channel, message in self._all(list(names)):
            decode = decoders.get(channel.id)
            if decode is None:
                decode = decoders[channel.id] = _decoder(self._path, schema, channel)
            yield channel.topic, message.log_time, decode(message.data)


def _mcap_topic(name: str, schema: Any, channel: Any) -> Topic:
    fields: tuple[str, ...] = ()
    if channel.message_encoding == "json" and schema is not None and schema.encoding == "jsonschema":
        described = json.loads(schema.data)
        listed = described.get("properties") if isinstance(described, dict) else None
        fields = tuple(listed) if isinstance(listed, dict) else ()
    return Topic(name, _kind(schema.name) if schema is not None and schema.name else "no type", fields)


def _decoder(path: Path, schema: Any, channel: Any) -> Callable[[bytes], Any]:
    """From bytes to a message; types are taken from the file's own schema."""
    where = f"{shown(path)}: {one_line(channel.topic)[:80]}"
    if channel.message_encoding == "json":
        return json.loads
    encodings = {"cdr": ("ros2msg", "ros2idl"), "ros1": ("ros1msg",)}
    if channel.message_encoding not in encodings or schema is None:
        found = one_line(f"{channel.message_encoding}")[:40]
        raise BadInputError(f"{where} is encoded as {found!r}, expected json, cdr or ros1")
    if schema.encoding not in encodings[channel.message_encoding]:
        found = one_line(f"{schema.encoding}")[:40]
        raise BadInputError(f"{where} has a schema in {found!r}, expected ros2msg, ros2idl or ros1msg")
    typesys = _module(path, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    text = schema.data.decode("utf-8")
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
    if schema.encoding == "ros2idl":
        rule = "=" * 80 + "\n"
        parts = [part.split("\n", 1)[1] for part in text.split(rule) if part] if rule in text else [text]
        for part in parts:
            store.register(typesys.get_types_from_idl(part))
    else:
        store.register(typesys.get_types_from_msg(text, name))
    check_types(store.fielddefs)
    read = store.deserialize_ros1 if channel.message_encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, name)


@contextmanager
def _mcap(path: Path) -> Iterator[Source]:
    _module(path, "mcap.reader")
    with BoundedFile(path) as stream:
        yield _Mcap(path, stream)

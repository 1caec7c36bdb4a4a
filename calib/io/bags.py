"""Logs in bags: ROS 1 `.bag`, ROS 2 folders and `.db3`, MCAP (ROS messages or JSON)."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError, CalibError, package, pip_install
from calib.core.files import check_readable, one_line, shown, to_be
from calib.core.words import several
from calib.io import unpacking
from calib.io.bag_topics import Topic, TopicMap, field_reader, topic_map
from calib.io.tables import Block, Passed

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
        name: [(slots[field.column], field_reader(source, name, field)) for field in fields]
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
        return Block({"t_s": t_s, **named}, lines, Passed(infinite, repeated=twice))

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
        passed = last.passed + Passed(truncated=stream.truncated, odd_times=_odd_times(source, clocks))
        yield replace(last, passed=passed)
    except OverflowError as error:
        raise BadInputError(f"{source}: has a time that is none: {error}") from error


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
                data = unpacking.unpacked("zstd", data)
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
    packing = unpacking.check_folder_of_bag(path) if path.is_dir() else ""
    with reader.AnyReader([unpacking.BoundedPath(path)], default_typestore=known) as opened:
        unpacking.check_types(opened.typestore.fielddefs)
        for one in opened.readers:
            if hasattr(one, "chunks"):
                unpacking.bound_chunks(one)
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
            True: lambda: reader.SeekingReader(stream, record_size_limit=unpacking.MOST_BYTES),
            False: lambda: reader.NonSeekingReader(stream, record_size_limit=unpacking.MOST_BYTES),
        }
        unpacking.check_mcap(path, stream)
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
    unpacking.check_types(store.fielddefs)
    read = store.deserialize_ros1 if channel.message_encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, name)


@contextmanager
def _mcap(path: Path) -> Iterator[Source]:
    _module(path, "mcap.reader")
    with unpacking.BoundedFile(path) as stream:
        yield _Mcap(path, stream)

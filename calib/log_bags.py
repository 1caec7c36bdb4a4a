"""Logs in bags: ROS 1 `.bag`, ROS 2 folders and `.db3`, MCAP (ROS messages or JSON).

The readers are those of the packages `rosbags` and `mcap` (extra logs). Both hand out one message at a
time, so nothing grows with the length of a bag but its index.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from calib.errors import BadInputError, CalibError, pip_install
from calib.files import check_readable, one_line, shown
from calib.log_messages import Source, rows_from_messages
from calib.log_topics import Topic, topic_map
from calib.log_unpacking import (
    MOST_BYTES,
    BoundedFile,
    BoundedPath,
    bound_chunks,
    check_folder_of_bag,
    check_mcap,
    check_types,
    unpacked,
)
from calib.logs import Log

BAGS = (".bag", ".db3", ".mcap")
"""Endings of bags; a ROS 2 bag may also be a folder."""

_MOST_TOPICS = 10000


def is_bag(path: Path) -> bool:
    """Whether a path is read as a bag: by its ending, or as a folder with a bag's metadata."""
    return path.suffix.lower() in BAGS or (path / "metadata.yaml").is_file()


def iter_bag(path: Path, topics: Path | None = None) -> Iterator[Log]:
    """Blocks of the log in a bag; `topics` is a file that says what is where, see `calib.log_topics`.

    Raises
    ------
    BadInputError
        Without the extra logs, for a bag that cannot be read, a topic it lacks, a field that its messages
        lack, and a value that is no number.
    """
    source = shown(path)
    if path.is_file() or not path.is_dir():
        check_readable(path)
    opened = _mcap if path.is_file() and path.suffix.lower() == ".mcap" else _rosbag
    try:
        with opened(path) as stream:
            found = topic_map(path, stream.topics, topics)
            yield from rows_from_messages(source, stream, found)
    except CalibError:
        raise
    except OSError as error:
        raise BadInputError(f"{source}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        # Damaged bytes make the packages raise nearly anything, and which is not part of their interface.
        said = one_line(str(error) or type(error).__name__)[:160]
        raise BadInputError(f"{source}: is not a bag that can be read: {said}") from error


def _module(path: Path, name: str, package: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        what = f"reading {path.suffix.lstrip('.') or 'bags'}"
        raise BadInputError(
            f"{shown(path)}: {what} needs the package {package}: {pip_install('logs')}"
        ) from error


def _kind(name: str) -> str:
    """A message type as package/Name, as ROS 1 writes it."""
    return name.replace("/msg/", "/")


class _RosBag:
    """A bag that `rosbags` has opened."""

    def __init__(self, reader: Any, packing: str) -> None:
        self._reader, self._packing = reader, packing
        self.truncated = False
        kinds = {connection.topic: _kind(connection.msgtype) for connection in reader.connections}
        self.topics = tuple(Topic(name, kinds[name]) for name in sorted(kinds))

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = set(names)
        connections = [item for item in self._reader.connections if item.topic in wanted]
        for connection, received, data in self._reader.messages(connections=connections):
            data = unpacked(self._packing, data) if self._packing else data
            yield connection.topic, received, self._reader.deserialize(data, connection.msgtype)


@contextmanager
def _rosbag(path: Path) -> Iterator[Source]:
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BadInputError(
            f"{shown(path)}: is a folder without metadata.yaml, expected a log or a ROS 2 bag"
        )
    reader = _module(path, "rosbags.highlevel", "rosbags")
    typesys = _module(path, "rosbags.typesys", "rosbags")
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
        reader = _module(path, "mcap.reader", "mcap")
        self._errors = _module(path, "mcap.exceptions", "mcap")
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
        if summary is not None:
            for channel in summary.channels.values():
                channels[channel.topic] = (summary.schemas.get(channel.schema_id), channel)
        else:
            for schema, channel, _ in self._all(None):
                channels.setdefault(channel.topic, (schema, channel))
        if len(channels) > _MOST_TOPICS:
            raise BadInputError(f"{shown(path)}: has {len(channels)} topics, expected at most {_MOST_TOPICS}")
        self.topics = tuple(_mcap_topic(name, *channels[name]) for name in sorted(channels))

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
        except self._errors.EndOfFile:
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
    typesys = _module(path, "rosbags.typesys", "rosbags")
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
    _module(path, "mcap.reader", "mcap")
    with BoundedFile(path) as stream:
        yield _Mcap(path, stream)

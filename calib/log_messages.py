"""From the messages of a bag to the rows of a log, in the order of their time.

Topics are recorded as they arrive, so stamps of two topics interleave out of order by some
milliseconds; messages are held for `WINDOW_S` and sorted. Those with one stamp and different columns
make one row. Stamps that count from the epoch are told from the first row on, so that a double holds
them to the nanosecond; others, as of a simulation, stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.errors import BadInputError
from calib.log_topics import Topic, TopicMap, reader_of
from calib.logs import Log

__all__ = ["WINDOW_S", "Source", "rows_from_messages"]

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


@dataclass
class _Sorter:
    """Rows that wait for earlier ones."""

    stamps: IntArray
    values: FloatArray

    def take(self, stamps: IntArray, values: FloatArray, last: bool) -> tuple[IntArray, FloatArray]:
        """Add rows; those that nothing can precede any more, all at the end."""
        stamps, values = np.concatenate([self.stamps, stamps]), np.concatenate([self.values, values])
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
        ready = len(stamps)
        if not last and ready:
            ready = int(np.searchsorted(stamps, stamps[-1] - int(WINDOW_S * 1e9)))
        self.stamps, self.values = stamps[ready:], values[ready:]
        return stamps[:ready], values[:ready]


def _merged(stamps: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Rows of one stamp as one, where no column has two values; rows are sorted."""
    if len(stamps) < 2 or not np.any(stamps[1:] == stamps[:-1]):
        return stamps, values
    begin = np.nonzero(np.concatenate([[True], stamps[1:] != stamps[:-1]]))[0]
    there = ~np.isnan(values)
    counts = np.add.reduceat(there.astype(np.int64), begin, axis=0)
    sums = np.add.reduceat(np.where(there, values, 0.0), begin, axis=0)
    alone = np.all(counts <= 1, axis=1)
    group = np.cumsum(np.concatenate([[True], stamps[1:] != stamps[:-1]])) - 1
    keep = ~alone[group]
    keep[begin] = True
    out = values.copy()
    out[begin[alone]] = np.where(counts > 0, sums, np.nan)[alone]
    return stamps[keep], out[keep]


def _chunks(source: str, stream: Source, topics: TopicMap) -> Iterator[tuple[IntArray, FloatArray]]:
    """Stamps and values in the order of the file, some thousand messages at a time."""
    slots = {name: k for k, name in enumerate(topics.columns)}
    readers: dict[str, list[tuple[int, Callable[[Any], float]]]] = {
        name: [(slots[field.column], reader_of(source, name, field)) for field in fields]
        for name, fields in topics.topics.items()
    }
    stamps, values = np.empty(_ROWS, dtype=np.int64), np.full((_ROWS, len(slots)), np.nan)
    filled = 0
    for name, received, message in stream.messages(list(readers)):
        stamp = _stamp(message) if topics.stamped else None
        stamps[filled] = received if stamp is None else stamp
        row = values[filled]
        for slot, read in readers[name]:
            row[slot] = read(message)
        filled += 1
        if filled == _ROWS:
            yield stamps, values
            stamps, values, filled = np.empty_like(stamps), np.full_like(values, np.nan), 0
    if filled:
        yield stamps[:filled], values[:filled]


def rows_from_messages(source: str, stream: Source, topics: TopicMap) -> Iterator[Log]:
    """Blocks of a log; a block may have no rows, and there is at least one.

    Raises `BadInputError` for a message without an expected field.
    """
    unknown = tuple(topic.name for topic in stream.topics if topic.name not in topics.topics)
    columns = topics.columns
    sorter = _Sorter(np.empty(0, dtype=np.int64), np.empty((0, len(columns))))
    start, first = None, 1

    def made(stamps: IntArray, values: FloatArray) -> Log:
        nonlocal start, first
        infinite = int(np.count_nonzero(np.isinf(values)))
        stamps, values = _merged(stamps, np.where(np.isinf(values), np.nan, values))
        if start is None and len(stamps):
            start = int(stamps[0]) if stamps[0] >= _EPOCH_NS else 0
        t_s = (stamps - (start or 0)) / 1e9
        lines = np.arange(first, first + len(stamps), dtype=np.int64)
        first += len(stamps)
        named = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(columns)}
        return Log(source, t_s, named, lines, unknown, infinite)

    try:
        waiting = (sorter.stamps, sorter.values)
        for following in _chunks(source, stream, topics):
            block = made(*sorter.take(*waiting, False))
            if len(block):
                yield block
            waiting = following
        yield replace(made(*sorter.take(*waiting, True)), truncated=stream.truncated)
    except OverflowError as error:
        raise BadInputError(f"{source}: has a time that is none: {error}") from error

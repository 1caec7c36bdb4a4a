"""The bytes that a board with the example sketch sent, kept in a file, as a log.

What `calib record` does with a port: frames are found and checked, a board that restarts begins the log
anew, and lost frames leave a gap in the time.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

from calib.errors import BadInputError
from calib.files import check_readable, shown
from calib.logs import Log, iter_rows

__all__ = ["STREAMS", "iter_stream"]

STREAMS = (".bin", ".serial")
"""Endings of such files."""

_CHUNK = 1 << 16
_MOST_BYTES = 1 << 28


def iter_stream(path: Path) -> Iterator[Log]:
    """Blocks of the log. Raises `BadInputError` for a file without a frame, or one that is too large."""
    from calib.firmware.recording import record

    size = check_readable(path)
    if size > _MOST_BYTES:
        raise BadInputError(f"{shown(path)}: is larger than {_MOST_BYTES / 1e6:g} MB")
    ended = False

    def read() -> bytes:
        nonlocal ended
        data = stream.read(_CHUNK)
        ended = not data
        return data

    try:
        with path.open("rb") as stream:
            result = record(read, lambda ticks: not ended)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error
    if not ended:
        # For a port Ctrl-C is the end of the log; of a file it would be half.
        raise KeyboardInterrupt
    if not result.ticks:
        raise BadInputError(
            f"{shown(path)}: holds no frame of the example sketch, only {result.skipped} other bytes"
        )
    yield from iter_rows(io.BytesIO(result.text.encode()), shown(path))

"""The stream of a board, in reads of any length, up to the log that is written from it."""

from __future__ import annotations

import binascii
from pathlib import Path
from unittest import mock

MODULES = ("calib.io.serial",)

MOST_BYTES = 1000

WORDS = (
    b"\xa5\x5a",
    b"\xa5",
    b"\x5a",
    b"\xa5\x5a\x4e",
    b"\xff\xff",
    b"\x00\x00\x80\x7f",
    b"\x00\x00\xc0\x7f",
)


def check(data: bytes, folder: Path) -> None:
    """Every byte is in a frame, skipped or waiting; how the reads fall changes nothing; the log is read."""
    from calib.io import serial as telemetry

    # The same numbers as `checksum`, a hundred times as fast.
    with mock.patch.object(telemetry, "checksum", lambda body: binascii.crc_hqx(body, 0xFFFF)):
        _check(data, folder)


def _check(data: bytes, folder: Path) -> None:
    from sentframes import encoded

    from calib.core.errors import BadInputError
    from calib.io.logs import read_log
    from calib.io.serial import Decoder, record
    from calib.stages.firmware.check import read_frames

    whole = Decoder()
    frames = list(whole.feed(data))
    size = len(encoded(frames[0])) if frames else 0
    assert whole.skipped + len(frames) * size + len(whole._waiting) == len(data)
    assert len(whole._waiting) < 300
    step = 1 + len(data) % 7
    parts = Decoder()
    pieces = [data[k : k + step] for k in range(0, len(data), step)]
    split = [frame for piece in pieces for frame in parts.feed(piece)]
    assert list(map(repr, split)) == list(map(repr, frames))
    assert (parts.skipped, parts.damaged) == (whole.skipped, whole.damaged)
    waiting = pieces[::-1]
    logs: dict[int, str] = {}

    def write(run: int, text: str) -> None:
        logs[run] = logs.get(run, "") + text

    result = record(waiting.pop, lambda _: bool(waiting), write)
    assert result.opening + sum(run.ticks for run in result.runs) <= len(frames)
    assert sorted(logs) == list(range(len(result.runs)))
    for number, run in enumerate(result.runs):
        path = folder / f"log{number}.csv"
        path.write_text(logs[number])
        assert len(read_log(path)) == run.ticks
        try:
            again = read_frames(path)
        except BadInputError:
            # A float of a board may be no number, which no log's row is.
            continue
        assert len(again) == run.ticks

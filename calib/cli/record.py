"""`calib record`: what a board with the example sketch sends, as a log."""

from __future__ import annotations

import time
from itertools import count
from pathlib import Path
from typing import Annotated, BinaryIO

import typer

from calib.cli.common import JsonOption, document, narrate, say
from calib.core.errors import BadInputError, UsageError, pip_install

_SILENT_S = 10.0


def record(
    port: Annotated[str, typer.Argument(help="Serial port, such as /dev/ttyUSB0 or COM3.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Log to write, .csv.")],
    duration: Annotated[str | None, typer.Option(help="How long, such as 20s; else until Ctrl-C.")] = None,
    ticks: Annotated[int | None, typer.Option(min=1, help="Stop after this many ticks.")] = None,
    baud: Annotated[int, typer.Option(min=300, help="Speed of the port.")] = 115200,
    as_json: JsonOption = False,
) -> None:
    """Record a board's ticks: camera, IMU and commands as a log, and what the board made of them.

    Ticks are written as they come. A board that restarts begins another log beside the first.
    """
    from calib.core.files import shown
    from calib.core.units import parse_duration_s
    from calib.core.writing import appending, check_writable, writes_through
    from calib.io.logs import LOG
    from calib.io.serial import record as run

    try:
        import serial
    except ModuleNotFoundError as error:
        raise UsageError(f"calib record needs pyserial: {pip_install('serial')}") from error
    duration_s = None if duration is None else parse_duration_s(duration, "--duration")
    if output.is_file() and output.stat().st_size:
        raise BadInputError(
            f"{shown(output)}: is there, and a recording cannot be made again; give another name, or move it"
        )
    check_writable(output, LOG)
    try:
        line = serial.Serial(port, baud, timeout=0.1)
    except (serial.SerialException, OSError, ValueError) as error:
        raise BadInputError(f"{shown(port)}: cannot be opened: {_reason(error)}") from error
    began = time.monotonic()
    if duration_s is None and ticks is None:
        narrate("recording; Ctrl-C ends it")

    def read() -> bytes:
        try:
            return bytes(line.read(max(1, line.in_waiting)))
        except (serial.SerialException, OSError) as error:
            raise BadInputError(f"{shown(port)}: the board is gone: {_reason(error)}") from error

    def more(so_far: int) -> bool:
        passed = time.monotonic() - began
        if so_far == 0 and passed > _SILENT_S:
            raise BadInputError(
                f"{shown(port)}: no frame within {_SILENT_S:g} s, expected the example sketch at {baud} baud"
            )
        if ticks is not None and so_far >= ticks:
            return False
        return duration_s is None or passed < duration_s

    logs: list[tuple[Path, BinaryIO]] = []

    def write(number: int, text: str) -> None:
        """Append at once: what came is on the disk when the computer stops."""
        if number == len(logs):
            path = output if number == 0 or writes_through(output) else _beside(output)
            logs.append((path, appending(path, LOG)))
            if number:
                narrate(f"the board restarted; from there on the log is {shown(path)}")
        stream = logs[number][1]
        stream.write(text.encode())
        stream.flush()

    try:
        with line:
            result = run(read, more, write)
    finally:
        for _, stream in logs:
            stream.close()
    if not result.runs:
        raise BadInputError(f"{shown(port)}: no frame came, expected the example sketch at {baud} baud")
    if result.opening:
        narrate(f"opening the port restarted the board; {result.opening} ticks from before are left out")
    told = {
        "logs": [
            {"log": shown(path), "ticks": one.ticks, "lost": one.lost}
            for (path, _), one in zip(logs, result.runs, strict=True)
        ],
        "restarts": len(result.runs) - 1,
        "ticks_before_opening": result.opening,
        "damaged_frames": result.damaged,
        "bytes_skipped": result.skipped,
    }
    if as_json:
        document("record", {"record": told})
        return
    for (path, _), one in zip(logs, result.runs, strict=True):
        say(f"{one.ticks} ticks written to {shown(path)}, {one.lost} lost")
    if result.damaged:
        say(f"{result.damaged} frames came damaged")


def _beside(output: Path) -> Path:
    """A name for the log of a further start that is not taken."""
    numbered = (output.with_stem(f"{output.stem}-{k}") for k in count(2))
    return next(path for path in numbered if not path.exists())


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)

"""`calib record`: what a board with the example sketch sends, as a log."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

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
    """Record a board's ticks: camera, IMU and commands as a log, and what the board made of them."""
    from calib.core.files import shown
    from calib.core.units import parse_duration_s
    from calib.core.writing import check_writable, write_atomically
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

    with line:
        result = run(read, more)
    if not result.ticks:
        raise BadInputError(f"{shown(port)}: no frame came, expected the example sketch at {baud} baud")
    write_atomically(output, result.text, LOG)
    told = {
        "log": shown(output),
        "ticks": result.ticks,
        "lost": result.lost,
        "restarts": result.restarts,
        "damaged_frames": result.damaged,
        "bytes_skipped": result.skipped,
    }
    if as_json:
        document("record", {"record": told})
    else:
        say(f"{result.ticks} ticks written to {shown(output)}, {result.lost} lost, {result.damaged} damaged")


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)

"""`calib record`: what a board with the example sketch sends, and what it is asked to do meanwhile."""

from __future__ import annotations

import contextlib
import errno
import sys
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import typer

from calib.cli.common import JsonOption, document, narrate, refuse_recorded, say
from calib.core.errors import BadInputError, UsageError, pip_install
from calib.core.files import shown, to_be
from calib.core.units import parse_duration_s
from calib.core.writing import appending, check_writable, make_folder, writes_through

if TYPE_CHECKING:
    from calib.io.experiments import Board

_SILENT_S, _FELL_SILENT_S = 10.0, 3.0
_CUT_S = 0.5
_ALL = "all"


class _Port:
    """A serial port of this computer, as `calib.io.experiments.Port`."""

    def __init__(self, name: str, baud: int) -> None:
        try:
            import serial
        except ModuleNotFoundError as error:
            raise UsageError(f"calib record needs pyserial: {pip_install('serial')}") from error
        self.name, self.now_s = shown(name), time.monotonic
        if Path(name).is_file():
            raise BadInputError(
                f"{self.name}: is a file, expected a serial port such as /dev/ttyUSB0 or COM3; calib convert "
                "reads bytes that were recorded"
            )
        self._errors = (serial.SerialException, OSError)
        try:
            # Two programs that read one port get half of what comes each.
            self.line = serial.Serial(name, baud, timeout=0.02, write_timeout=1.0, exclusive=True)
        except (*self._errors, ValueError) as error:
            why = _reason(error)
            if getattr(error, "errno", None) in (errno.EAGAIN, errno.EBUSY):
                why = "another program has it open, as a serial monitor or another calib record; close that"
            raise BadInputError(f"{self.name}: cannot be opened: {why}") from error

    def read(self) -> bytes:
        try:
            return bytes(self.line.read(max(1, self.line.in_waiting)))
        except self._errors as error:
            raise BadInputError(f"{self.name}: the board is gone: {_reason(error)}") from error

    def write(self, data: bytes) -> None:
        try:
            self.line.write(data)
        except self._errors as error:
            raise BadInputError(f"{self.name}: the board is gone: {_reason(error)}") from error


def record(
    port: Annotated[str, typer.Argument(help="Serial port, such as /dev/ttyUSB0 or COM3.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Log to write, .csv; the rig's folder with --do all.")
    ],
    do: Annotated[
        str | None,
        typer.Option(
            help="What the rig shall do: static, swing, ellipse, steps, deflate, chirp or prbs, in open loop "
            "within the envelope; or all that calib run wants, one after the other."
        ),
    ] = None,
    level: Annotated[
        int, typer.Option(min=10, max=100, help="Greatest command of --do, in % of what the envelope allows.")
    ] = 100,
    yes: Annotated[bool, typer.Option("--yes", help="Do not wait for Enter before an experiment.")] = False,
    duration: Annotated[
        str | None, typer.Option(metavar="TIME", help="How long, such as 20s; else until Ctrl-C.")
    ] = None,
    ticks: Annotated[int | None, typer.Option(min=1, help="Stop after this many ticks.")] = None,
    baud: Annotated[int, typer.Option(min=300, help="Speed of the port.")] = 115200,
    as_json: JsonOption = False,
) -> None:
    """Record a board: its ticks and what it made of them, or samples of its sensors while it moves the rig.

    The latter with --do. What comes is written as it comes. Without --do a board that restarts begins
    another log beside the first.
    """
    duration_s = None if duration is None else parse_duration_s(duration, "--duration")
    if do != _ALL and output.suffix.lower() != ".csv" and not writes_through(output):
        raise UsageError(
            f"{shown(output)}: expected a name that ends in .csv; a folder goes with --do all alone"
        )
    if do is None:
        _ticks(port, output, duration_s, ticks, baud, as_json)
        return
    from calib.io.experiments import EXPERIMENTS

    if do not in (*EXPERIMENTS, _ALL):
        raise UsageError(f"--do: found {do}, expected one of {', '.join((*EXPERIMENTS, _ALL))}")
    if ticks is not None or (duration_s is not None and do == _ALL):
        raise UsageError("--do: an experiment has its own length; --duration goes with a single one")
    _experiments(port, output, do, 0.01 * level, duration_s, yes, baud, as_json)


def _experiments(
    port: str,
    output: Path,
    do: str,
    level: float,
    duration_s: float | None,
    yes: bool,
    baud: int,
    as_json: bool,
) -> None:
    from dataclasses import replace

    from calib.io.experiments import PROGRAMME, Board, experiment, perform
    from calib.io.logs import LOG

    if do == _ALL:
        logs = [(name, output / "logs" / f"{name}.csv") for name in PROGRAMME]
        plans = [(name, path) for name, path in logs if not _complete(path, experiment(name).seconds)]
        for name, path in logs:
            if (name, path) not in plans:
                narrate(f"{shown(path)}: is there, and is kept")
        if plans:
            make_folder(output / "logs")
    else:
        refuse_recorded(output)
        check_writable(output, LOG)
        plans = [(do, output)]
    results: list[dict[str, Any]] = []
    if plans:
        line = _Port(port, baud)
        with line.line:
            board = Board(line, line.name)
            _greeted(board)
            try:
                for name, path in plans:
                    plan = experiment(name)
                    if duration_s is not None:
                        plan = replace(plan, seconds=duration_s)
                    which = f"{PROGRAMME.index(name) + 1} of {len(PROGRAMME)}: " if do == _ALL else ""
                    narrate(f"{which}{name}, {plan.seconds:g} s; {plan.asks}")
                    _ready(yes)
                    with to_be("written", path), appending(path, LOG) as stream:
                        done = perform(board, plan, level, _writer(stream), narrate)
                    results.append({"log": shown(path), **vars(done)})
                    if not as_json:
                        say(f"{shown(path)}: {done.words}")
                    if done.damaged:
                        narrate(f"{done.damaged} frames came damaged")
            finally:
                board.close()
    missing = [name for name in ("images", "images/plane") if do == _ALL and not (output / name).is_dir()]
    if as_json:
        document("record", {"record": {"logs": results, "missing": missing}})
    elif do == _ALL:
        say(f"all {len(PROGRAMME)} logs are in {shown(output / 'logs')}")
        if missing:
            say(f"missing: pictures of the board in {' and '.join(shown(output / name) for name in missing)}")
        else:
            say(f"next: calib run {shown(output)}")


def _greeted(board: Board) -> None:
    """Say what the board is."""
    from calib.io.serial import FAULTS

    hello = board.hello
    imu = {1: "BNO055", 2: "MPU6050"}.get(hello.imu, f"IMU {hello.imu}")
    camera = {1: "Pixy2 on SPI", 2: "Pixy2 on I2C"}.get(hello.camera, f"camera {hello.camera}")
    narrate(
        f"{board.name}: {imu}, {camera}, constants {hello.identity:08X}"
        f"{'' if hello.has_plane else ' without a plane'}, commands up to {hello.open_high} PWM"
    )
    if hello.kept:
        narrate(f"before its last reset: {FAULTS.get(hello.kept, hello.kept)}")


def _ready(yes: bool) -> None:
    """Wait for the person; what came meanwhile is of no log."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError("--do waits for Enter before each experiment, and no terminal is there; give --yes")
    narrate("Enter begins, Ctrl-C ends")
    sys.stdin.readline()


def _writer(stream: BinaryIO) -> Callable[[str], None]:
    def write(text: str) -> None:
        stream.write(text.encode())
        stream.flush()

    return write


def _complete(path: Path, seconds: float) -> bool:
    """Whether a log with samples is there. Raises `BadInputError` for one that was cut."""
    if not path.is_file() or not path.stat().st_size:
        return False
    try:
        last = float(path.read_bytes().rstrip().rsplit(b"\n", 1)[-1].split(b",", 1)[0])
    except ValueError:
        last = 0.0
    if last < seconds - _CUT_S:
        raise BadInputError(
            f"{shown(path)}: has {last:.1f} s, expected {seconds:g} s: a recording that was cut; "
            "move it away, and run this again"
        )
    return True


def _ticks(
    port: str, output: Path, duration_s: float | None, ticks: int | None, baud: int, as_json: bool
) -> None:
    from calib.io.logs import LOG
    from calib.io.serial import ALIVE
    from calib.io.serial import record as run

    refuse_recorded(output)
    check_writable(output, LOG)
    line = _Port(port, baud)
    began = said = came = time.monotonic()
    count_then = 0
    if duration_s is None and ticks is None:
        narrate("recording; Ctrl-C ends it")

    def more(so_far: int) -> bool:
        nonlocal said, came, count_then
        now = time.monotonic()
        passed = now - began
        if so_far != count_then:
            came, count_then = now, so_far
        if so_far == 0 and passed > _SILENT_S:
            raise BadInputError(
                f"{line.name}: no frame within {_SILENT_S:g} s, expected the example sketch at {baud} baud"
            )
        if so_far and now - came > _FELL_SILENT_S:
            raise BadInputError(
                f"{line.name}: the board fell silent after {came - began:.1f} s; what came until then is in "
                f"{shown(output)}; look at cable and supply, and record again"
            )
        if now - said > 0.1:
            line.write(ALIVE)
            said = now
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
        _writer(logs[number][1])(text)

    try:
        with line.line, to_be("written", output):
            result = run(line.read, more, write)
    finally:
        for _, stream in logs:
            # What the disk had no place for has been told.
            with contextlib.suppress(OSError):
                stream.close()
    if not result.runs:
        raise BadInputError(f"{line.name}: no frame came, expected the example sketch at {baud} baud")
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

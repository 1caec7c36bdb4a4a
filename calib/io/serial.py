"""The bytes of a board with the example sketch: frames checked and decoded, recorded, read as a log."""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.core.errors import BadInputError
from calib.core.files import check_readable, shown

# ----------------------------------------------------------------------
# Frames that the sketch sends: found in a stream of bytes, checked, and written as a log.
#
#     A5 5A | length | payload | CRC-16        (0x1021 from 0xFFFF over length and payload), little-endian
#
# The payload holds the id of the header, the tick rate, a sequence number, what went into the tick and what
# came out. After garbage the search goes on one byte behind the false start, so no whole frame is lost to
# bytes that look like the beginning of one. The log has the columns that `calib.io.logs` knows and, beside
# them, the board's own: everything that is needed to compute the tick again.

_SYNC = b"\xa5\x5a"
_PAYLOAD = struct.Struct("<IIHBB7f9fH5B")
_UNGUARDED = struct.Struct("<IIHBB7f9fH")
"""Of sketches before the guard."""

BOARD_COLUMNS = (
    "sequence", "rate_mhz", "calib_id", "marker_seen", "imu_read", "mode",
    "board_u_px", "board_v_px", "reference_1", "reference_2",
    "board_phi_rad", "board_marker_x_m", "board_marker_y_m", "board_head_x_m", "board_head_y_m",
    "board_q1_m", "board_q2_m", "board_flags",
)  # fmt: skip
"""Columns of the log that are the board's own."""

GUARD_COLUMNS = ("duty_1", "duty_2", "guard_state", "guard_fault", "kept_fault")
"""Those of the guard, which older logs lack."""

_LOG_COLUMNS = ("t_s", "u_px", "v_px", "ax_mps2", "ay_mps2", "gz_radps", "pwm1", "pwm2")


MODE_OFF, MODE_ORIENTATION, MODE_POSITION = 0, 1, 2


@dataclass(frozen=True)
class Inputs:
    """One tick's readings, as `calib_inputs`.

    Attributes
    ----------
    u_px, v_px : marker as the camera reports it.
    ax_mps2, ay_mps2, gz_radps : IMU.
    reference : angle [rad] and anything, or both lengths [m].
    marker_seen, imu_read : whether something came in.
    mode : of the controller.
    """

    u_px: float
    v_px: float
    ax_mps2: float
    ay_mps2: float
    gz_radps: float
    reference: tuple[float, float] = (0.0, 0.0)
    marker_seen: bool = True
    imu_read: bool = True
    mode: int = MODE_OFF

    @staticmethod
    def of(numbers: Sequence[float], sensors: int, mode: int) -> Inputs:
        """Inputs from `numbers`, `sensors` and mode."""
        u, v, ax, ay, gz, r1, r2 = map(float, numbers)
        return Inputs(u, v, ax, ay, gz, (r1, r2), bool(sensors & 1), bool(sensors & 2), mode)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Marker, IMU and reference: seven numbers."""
        return (self.u_px, self.v_px, self.ax_mps2, self.ay_mps2, self.gz_radps, *self.reference)

    @property
    def sensors(self) -> int:
        """1 for a marker and 2 for a sample of the IMU."""
        return int(self.marker_seen) + 2 * int(self.imu_read)


@dataclass(frozen=True)
class Outputs:
    """What a tick gives, as `calib_outputs`, without the whole numbers for a timer."""

    phi_rad: float
    marker_m: tuple[float, float]
    head_m: tuple[float, float]
    q_m: tuple[float, float]
    pwm: tuple[float, float]
    flags: int

    @staticmethod
    def of(numbers: Sequence[float], flags: int) -> Outputs:
        """Outputs from `numbers` and flags."""
        phi, X, Y, x, y, q1, q2, p1, p2 = numbers
        return Outputs(phi, (X, Y), (x, y), (q1, q2), (p1, p2), flags)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Angle, marker, head, lengths, commands: nine numbers."""
        return (self.phi_rad, *self.marker_m, *self.head_m, *self.q_m, *self.pwm)


GUARD_RUN, GUARD_FAULT = 2, 3
FAULTS = {
    1: "the IMU was lost",
    2: "the IMU was frozen",
    3: "the camera was lost",
    4: "the camera was frozen",
    5: "marker and angle disagreed",
    6: "a reference was beyond the envelope",
    7: "the loop was late",
    8: "the computer fell silent",
    16: "the actuator was beyond the envelope",
    17: "a length changed faster than the envelope allows",
    18: "a pump was at full power for too long",
    19: "the self-test failed",
    20: "the watchdog stopped the loop",
}
"""What CALIB_FAULT_... of the guard mean."""


@dataclass(frozen=True)
class Guard:
    """What the guard of a board said in a tick.

    Attributes
    ----------
    duty : whole numbers that drove the pumps. state : 0 boot, 1 armed, 2 run, 3 fault. fault : a key of
        `FAULTS`, 0 for none. kept : of the last reset.
    """

    duty: tuple[int, int] = (0, 0)
    state: int = 0
    fault: int = 0
    kept: int = 0

    @staticmethod
    def of(numbers: Sequence[int]) -> Guard:
        """The guard from `numbers`."""
        first, second, state, fault, kept = numbers
        return Guard((first, second), state, fault, kept)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Duty, state, fault, kept: five numbers."""
        return (*self.duty, self.state, self.fault, self.kept)


@dataclass(frozen=True)
class Frame:
    """One tick of a board.

    Attributes
    ----------
    identity : CALIB_ID of its header. rate_mhz : ticks in 1000 s. sequence : counts up to 65535.
    guard : None of sketches without one.
    """

    identity: int
    rate_mhz: int
    sequence: int
    given: Inputs
    out: Outputs
    guard: Guard | None = None


def checksum(data: bytes) -> int:
    """CRC-16 with the polynomial 0x1021 from 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def encoded(frame: Frame) -> bytes:
    """The frame as a board sends it."""
    given, out = frame.given, frame.out
    head = (frame.identity, frame.rate_mhz, frame.sequence, given.sensors, given.mode)
    numbers = (*head, *given.numbers, *out.numbers, out.flags)
    guard = frame.guard
    payload = _UNGUARDED.pack(*numbers) if guard is None else _PAYLOAD.pack(*numbers, *guard.numbers)
    body = bytes([len(payload)]) + payload
    return _SYNC + body + struct.pack("<H", checksum(body))


class Decoder:
    """Frames out of a stream that may begin anywhere and hold anything.

    Attributes
    ----------
    skipped : bytes that belonged to no frame so far. damaged : frames whose checksum was wrong.
    """

    def __init__(self) -> None:
        self._waiting = bytearray()
        self.skipped = 0
        self.damaged = 0

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Take more of the stream; the frames that are complete now."""
        waiting = self._waiting
        waiting += data
        while True:
            start = waiting.find(_SYNC)
            if start < 0:
                # The last byte may be the first of a mark.
                drop = len(waiting) - (1 if waiting[-1:] == _SYNC[:1] else 0)
                self.skipped += drop
                del waiting[:drop]
                return
            self.skipped += start
            del waiting[:start]
            if len(waiting) < 3:
                return
            length = waiting[2]
            if length not in (_PAYLOAD.size, _UNGUARDED.size):
                self.skipped += 1
                del waiting[:1]
                continue
            end = 3 + length + 2
            if len(waiting) < end:
                return
            body = bytes(waiting[2 : end - 2])
            if checksum(body) != int.from_bytes(waiting[end - 2 : end], "little"):
                self.damaged += 1
                self.skipped += 1
                del waiting[:1]
                continue
            kind = _PAYLOAD if length == _PAYLOAD.size else _UNGUARDED
            identity, rate, sequence, sensors, mode, *rest = kind.unpack(body[1:])
            del waiting[:end]
            given, out = Inputs.of(rest[:7], sensors, mode), Outputs.of(rest[7:16], rest[16])
            guard = Guard.of(rest[17:]) if kind is _PAYLOAD else None
            yield Frame(identity, rate, sequence, given, out, guard)


def csv_header() -> str:
    """First line of a log of frames."""
    return ",".join((*_LOG_COLUMNS, *BOARD_COLUMNS, *GUARD_COLUMNS)) + "\n"


def csv_row(frame: Frame, tick: int) -> str:
    """A line of the log.

    Parameters
    ----------
    tick : number since the first frame, from the sequence numbers.
    """
    g = frame.given

    def text(value: float) -> str:
        return f"{value:.9g}"

    marker = [text(g.u_px), text(g.v_px)] if g.marker_seen else ["", ""]
    imu = [text(v) for v in (g.ax_mps2, g.ay_mps2, g.gz_radps)]
    time = f"{1e3 * tick / frame.rate_mhz:.9g}" if frame.rate_mhz else "0"
    whole = [frame.sequence, frame.rate_mhz, frame.identity, int(g.marker_seen), int(g.imu_read), g.mode]
    board = [g.u_px, g.v_px, *g.reference, *frame.out.numbers[:7]]
    sensors = [*marker, *(imu if g.imu_read else ["", "", ""])]
    cells = [time, *sensors, *map(text, frame.out.pwm), *map(str, whole), *map(text, board)]
    guard = [""] * len(GUARD_COLUMNS) if frame.guard is None else map(str, frame.guard.numbers)
    return ",".join([*cells, str(frame.out.flags), *guard]) + "\n"


def frame_from_row(row: dict[str, str]) -> Frame:
    """The frame of a line of the log, by column; `KeyError` or `ValueError` for another line."""
    number = {name: float(row[name]) for name in (*BOARD_COLUMNS, "pwm1", "pwm2")}
    imu = [float(row[name]) if row[name] else 0.0 for name in ("ax_mps2", "ay_mps2", "gz_radps")]
    sensors = int(number["marker_seen"]) + 2 * int(number["imu_read"])
    into = (number["board_u_px"], number["board_v_px"], *imu, number["reference_1"], number["reference_2"])
    out = [number[name] for name in (*BOARD_COLUMNS[10:17], "pwm1", "pwm2")]
    guard = [row.get(name) for name in GUARD_COLUMNS]
    return Frame(
        int(number["calib_id"]),
        int(number["rate_mhz"]),
        int(number["sequence"]),
        Inputs.of(into, sensors, int(number["mode"])),
        Outputs.of(out, int(number["board_flags"])),
        Guard.of([int(value or 0) for value in guard]) if all(guard) else None,
    )


# ----------------------------------------------------------------------
# Recording a board: from reads of a port to the text of a log.


_OPENING_S = 3.0
"""Opening a port restarts the usual boards; what came from before that, in less time, is of no run."""


@dataclass(frozen=True)
class Run:
    """What came from one start of a board: rows, and sequence numbers that never came."""

    ticks: int
    lost: int


@dataclass(frozen=True)
class Recording:
    """What came in.

    Attributes
    ----------
    runs : one for each start of the board. opening : ticks from before the port's opening restarted it.
    skipped : bytes outside frames. damaged : frames with a wrong checksum.
    """

    runs: tuple[Run, ...]
    opening: int
    skipped: int
    damaged: int


def record(
    read: Callable[[], bytes], more: Callable[[int], bool], write: Callable[[int, str], None]
) -> Recording:
    """Read until told to stop; each start of the board is a log of its own.

    Parameters
    ----------
    read : the next bytes of the port, b"" when none came within its timeout.
    more : whether to go on, given the ticks so far of the run at hand.
    write : appends text to the log of a run, counted from 0, as it comes; to the first after `_OPENING_S`.
    """
    decoder = Decoder()
    lines, held = [csv_header()], True
    runs: list[Run] = []
    last: Frame | None = None
    ticks = tick = lost = opening = 0
    try:
        while more(ticks):
            for frame in decoder.feed(read()):
                if last is not None and frame.sequence == 0 and last.sequence != 0xFFFF:
                    if held:
                        opening = ticks
                    else:
                        write(len(runs), "".join(lines))
                        runs.append(Run(ticks, lost))
                    lines, last, held = [csv_header()], None, False
                    ticks = tick = lost = 0
                if last is not None:
                    step = (frame.sequence - last.sequence) & 0xFFFF
                    lost += max(step - 1, 0)
                    tick += step
                lines.append(csv_row(frame, tick))
                ticks += 1
                last = frame
                held = held and 1e3 * tick < _OPENING_S * frame.rate_mhz
            if not held:
                write(len(runs), "".join(lines))
                lines.clear()
    except KeyboardInterrupt:
        # Stopping by hand is the usual end; what came so far is the log, and nothing may stop its writing.
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except BadInputError:
        # The board is gone; what it sent is not.
        if ticks:
            write(len(runs), "".join(lines))
        raise
    if ticks:
        write(len(runs), "".join(lines))
        runs.append(Run(ticks, lost))
    return Recording(tuple(runs), opening, decoder.skipped, decoder.damaged)


# ----------------------------------------------------------------------
# The bytes that a board with the example sketch sent, kept in a file, as a log.
#
# What `calib record` does with a port: frames are found and checked, lost frames leave a gap in the time.
# Where the board restarted the log is that of its last start.

STREAMS = (".bin", ".serial")
"""Endings of such files."""

_CHUNK = 1 << 16
_MOST_BYTES = 1 << 28


def stream_text(path: Path) -> str:
    """The log as CSV. Raises `BadInputError` for a file without a frame, or one that is too large."""

    size = check_readable(path)
    if size > _MOST_BYTES:
        raise BadInputError(f"{shown(path)}: is larger than {_MOST_BYTES / 1e6:g} MB")
    ended = False
    logs: dict[int, list[str]] = {}

    def read() -> bytes:
        nonlocal ended
        data = stream.read(_CHUNK)
        ended = not data
        return data

    try:
        with path.open("rb") as stream:
            result = record(
                read, lambda ticks: not ended, lambda run, text: logs.setdefault(run, []).append(text)
            )
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error
    if not ended:
        # For a port Ctrl-C is the end of the log; of a file it would be half.
        raise KeyboardInterrupt
    if not result.runs:
        raise BadInputError(
            f"{shown(path)}: holds no frame of the example sketch, only {result.skipped} other bytes"
        )
    return "".join(logs[len(result.runs) - 1])

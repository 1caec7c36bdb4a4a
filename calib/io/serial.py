"""The bytes of a board with the example sketch: frames checked and decoded, recorded, read as a log."""

from __future__ import annotations

import io
import math
import signal
import struct
from binascii import crc_hqx
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.core.errors import BadInputError
from calib.core.files import read_bytes, shown

# ----------------------------------------------------------------------
# Frames between computer and board, see `calib_link.h`:
#
#     A5 5A | version | kind | length | payload | CRC-16     (0x1021 from 0xFFFF, from version to payload)
#
# little-endian. A tick holds all that went into it and came out; samples of the IMU and pictures hold their
# own times. Sketches of before sent ticks alone, with neither version nor kind. After garbage the search
# goes on one byte behind the false start, so no whole frame is lost to bytes that look like the beginning
# of one. A log of ticks has the columns that `calib.io.logs` knows and, beside them, the board's own:
# everything that is needed to compute the tick again.

_SYNC = b"\xa5\x5a"
VERSION = 2
_HELLO, _TICK, _IMU, _PICTURE, _ALIVE, _SET, _CLEAR = 1, 2, 3, 4, 16, 17, 18
_UNGUARDED, _UNTIMED = struct.Struct("<IIHBB7f9fH"), struct.Struct("<IIHBB7f9fH5B")
"""Ticks of sketches before the guard, and before frames had a version: their length stands in its place."""
_PAYLOADS = {
    _HELLO: struct.Struct("<HII6B"),
    _TICK: struct.Struct("<IIIHBB8f9fH5B"),
    _IMU: struct.Struct("<HI6f"),
    _PICTURE: struct.Struct("<HIHB2f6B"),
}

_PUNCTUAL = struct.Struct("<IIIHBB7f9fH5B")
"""Ticks of sketches that did not tell how late their pictures were."""

BOARD_COLUMNS = (
    "sequence", "rate_mhz", "calib_id", "marker_seen", "imu_read", "mode",
    "board_u_px", "board_v_px", "reference_1", "reference_2",
    "board_phi_rad", "board_marker_x_m", "board_marker_y_m", "board_head_x_m", "board_head_y_m",
    "board_q1_m", "board_q2_m", "board_flags",
)  # fmt: skip
"""Columns of the log that are the board's own."""

GUARD_COLUMNS = ("duty_1", "duty_2", "guard_state", "guard_fault", "kept_fault")
"""Those of the guard, which older logs lack."""

_LATE = "late_ticks"
"""How late a tick's picture was, which older logs lack."""

_LOG_COLUMNS = ("t_s", "u_px", "v_px", "ax_mps2", "ay_mps2", "gz_radps", "pwm1", "pwm2")

SAMPLE_COLUMNS = (
    "t_s", "u_px", "v_px", "ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps",
    "pwm1", "pwm2", "sequence", "guard_state", "guard_fault", "overruns",
)  # fmt: skip
"""Columns of a log of samples: a row for each sample of the IMU, each picture and each command."""


MODE_OFF, MODE_ORIENTATION, MODE_POSITION = 0, 1, 2


@dataclass(frozen=True)
class Inputs:
    """One tick's readings, as `calib_inputs`.

    Attributes
    ----------
    u_px, v_px : marker as the camera reports it.
    ax_mps2, ay_mps2, gz_radps : IMU.
    reference : angle [rad] and anything, or both lengths [m].
    late_ticks : since the picture had its time in the logs, 0 to 1 tick.
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
    late_ticks: float = 0.0

    @staticmethod
    def of(numbers: Sequence[float], sensors: int, mode: int) -> Inputs:
        """Inputs from `numbers`, `sensors` and mode."""
        u, v, ax, ay, gz, r1, r2, late = map(float, numbers)
        return Inputs(u, v, ax, ay, gz, (r1, r2), bool(sensors & 1), bool(sensors & 2), mode, late)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Marker, IMU, reference and lateness: eight numbers."""
        sensors = (self.u_px, self.v_px, self.ax_mps2, self.ay_mps2, self.gz_radps)
        return (*sensors, *self.reference, self.late_ticks)

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
    21: "a pump was on for too long in open loop",
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
    guard : None of sketches without one. t_us : time of the IMU's sample by the board's clock, which begins
        anew after 2**32; None of sketches that did not tell it.
    """

    identity: int
    rate_mhz: int
    sequence: int
    given: Inputs
    out: Outputs
    guard: Guard | None = None
    t_us: int | None = None


@dataclass(frozen=True)
class Hello:
    """What a board is.

    Attributes
    ----------
    sequence : of the next sample; 0 at the board's start. open_high : greatest command in open loop, PWM.
    kept : fault of the last reset. imu : 1 BNO055, 2 MPU6050. camera : 1 Pixy2 on SPI, 2 on I2C.
    has_plane : whether it can control. mode : that the sketch was built for.
    """

    sequence: int
    identity: int
    rate_mhz: int
    open_high: int
    kept: int
    imu: int
    camera: int
    has_plane: int
    mode: int


@dataclass(frozen=True)
class ImuSample:
    """A sample of the IMU: specific force [m/s^2] and rate [rad/s], three axes each, at a time."""

    sequence: int
    t_us: int
    force: tuple[float, float, float]
    rate: tuple[float, float, float]


@dataclass(frozen=True)
class Picture:
    """What a picture showed at a time, and what the pumps got `after_us` later.

    Attributes
    ----------
    overruns : samples of the IMU that were left out since recording began, as the loop came too late.
    """

    sequence: int
    t_us: int
    after_us: int
    seen: bool
    marker_px: tuple[float, float]
    guard: Guard
    overruns: int


Message = Frame | Hello | ImuSample | Picture


def checksum(data: bytes) -> int:
    """CRC-16 with the polynomial 0x1021 from 0xFFFF."""
    return crc_hqx(data, 0xFFFF)


def _framed(kind: int, payload: bytes) -> bytes:
    body = bytes([VERSION, kind, len(payload)]) + payload
    return _SYNC + body + struct.pack("<H", checksum(body))


ALIVE = _framed(_ALIVE, b"")
"""A sign of life for the board."""
CLEAR = _framed(_CLEAR, b"")
"""A person has looked: faults that stay end."""


def setting(samples: bool, pumps: tuple[int, int] | None = None) -> bytes:
    """What the board shall send, samples or ticks, and what its pumps get in open loop, None for nothing."""
    first, second = pumps or (0, 0)
    return _framed(_SET, bytes([samples, pumps is not None, first, second]))


def _decoded(kind: int, payload: bytes) -> Message:
    numbers = _layout(kind, len(payload)).unpack(payload)
    if kind == _TICK:
        return _tick(numbers[1:], numbers[0])
    if kind == _HELLO:
        return Hello(*numbers)
    if kind == _IMU:
        sequence, t_us, *axes = numbers
        return ImuSample(sequence, t_us, (axes[0], axes[1], axes[2]), (axes[3], axes[4], axes[5]))
    sequence, t_us, after_us, seen, u, v, *guard, overruns = numbers
    return Picture(sequence, t_us, after_us, bool(seen), (u, v), Guard.of(guard), overruns)


def _layout(kind: int, length: int) -> struct.Struct:
    return _PUNCTUAL if (kind, length) == (_TICK, _PUNCTUAL.size) else _PAYLOADS[kind]


def _tick(numbers: Sequence[Any], t_us: int | None) -> Frame:
    identity, rate, sequence, sensors, mode, *rest = numbers
    if len(rest) != 23:
        # A sketch that does not tell how late its pictures are.
        rest.insert(7, 0.0)
    given, out = Inputs.of(rest[:8], sensors, mode), Outputs.of(rest[8:17], rest[17])
    guard = Guard.of(rest[18:]) if len(rest) > 18 else None
    return Frame(identity, rate, sequence, given, out, guard, t_us)


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

    def feed(self, data: bytes) -> Iterator[Message]:
        """Take more of the stream; the frames that are complete now."""
        waiting = self._waiting
        waiting += data
        while True:
            start = waiting.find(_SYNC)
            if start < 0:
                # The last byte may be the first of a mark.
                self._skip(len(waiting) - (1 if waiting[-1:] == _SYNC[:1] else 0))
                return
            self._skip(start)
            if len(waiting) < 5:
                return
            old = {one.size: one for one in (_UNGUARDED, _UNTIMED)}.get(waiting[2])
            begin = 3 if old else 5
            if old is None and not (waiting[2] == VERSION and waiting[3] in _PAYLOADS
                                    and waiting[4] == _layout(waiting[3], waiting[4]).size):  # fmt: skip
                self._skip(1)
                continue
            end = begin + waiting[begin - 1]
            if len(waiting) < end + 2:
                return
            body = bytes(waiting[2:end])
            if checksum(body) != int.from_bytes(waiting[end : end + 2], "little"):
                self.damaged += 1
                self._skip(1)
                continue
            del waiting[: end + 2]
            yield _tick(old.unpack(body[1:]), None) if old else _decoded(body[1], body[3:])

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._waiting[:count]


def csv_header() -> str:
    """First line of a log of frames."""
    return ",".join((*_LOG_COLUMNS, *BOARD_COLUMNS, *GUARD_COLUMNS, _LATE)) + "\n"


def text(value: float) -> str:
    """A float as logs have it."""
    return f"{value:.9g}"


def csv_rows(frame: Frame, time_s: float) -> list[tuple[float, str]]:
    """Lines of a log of ticks with their times: a picture that is older than its tick, and the tick."""
    g, rows = frame.given, []
    marker = [text(g.u_px), text(g.v_px)] if g.marker_seen else ["", ""]
    if g.marker_seen and 0.0 < g.late_ticks <= 1.0 and frame.rate_mhz:
        shown_s = time_s - 1e3 * g.late_ticks / frame.rate_mhz
        blank = [""] * (len(_LOG_COLUMNS) - 3 + len(BOARD_COLUMNS) + len(GUARD_COLUMNS) + 1)
        rows.append((shown_s, ",".join([text(shown_s), *marker, *blank]) + "\n"))
        marker = ["", ""]
    imu = [text(v) for v in (g.ax_mps2, g.ay_mps2, g.gz_radps)]
    whole = [frame.sequence, frame.rate_mhz, frame.identity, int(g.marker_seen), int(g.imu_read), g.mode]
    board = [g.u_px, g.v_px, *g.reference, *frame.out.numbers[:7]]
    sensors = [*marker, *(imu if g.imu_read else ["", "", ""])]
    cells = [text(time_s), *sensors, *map(text, frame.out.pwm), *map(str, whole), *map(text, board)]
    guard = [""] * len(GUARD_COLUMNS) if frame.guard is None else map(str, frame.guard.numbers)
    rows.append((time_s, ",".join([*cells, str(frame.out.flags), *guard, text(g.late_ticks)]) + "\n"))
    return rows


def frame_from_row(row: dict[str, str]) -> Frame:
    """The frame of a line of the log, by column; `KeyError` or `ValueError` for another line."""
    number = {name: float(row[name]) for name in (*BOARD_COLUMNS, "pwm1", "pwm2")}
    imu = [float(row[name]) if row[name] else 0.0 for name in ("ax_mps2", "ay_mps2", "gz_radps")]
    sensors = int(number["marker_seen"]) + 2 * int(number["imu_read"])
    reference = number["reference_1"], number["reference_2"]
    into = (number["board_u_px"], number["board_v_px"], *imu, *reference, float(row.get(_LATE) or 0.0))
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
    """What came from one start of a board: ticks or samples, and sequence numbers that never came."""

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


_HELD_S = 0.2


class Rows:
    """Lines of a log from what one start of a board sends: times from zero, losses counted.

    Attributes
    ----------
    samples : whether it is a log of samples, None before anything came. count, lost : ticks or samples that
        came, and that never came. time_s : of the last one.

    A picture comes after samples that are younger. So that a log's times never go back, lines of the last
    `_HELD_S` wait for those before them.
    """

    def __init__(self) -> None:
        self.samples: bool | None = None
        self.count = self.lost = 0
        self.time_s = 0.0
        self._last: tuple[int, int | None] | None = None
        self._held: list[tuple[float, str]] = []

    def begins_anew(self, message: Message) -> bool:
        """Whether the message is of another start of the board, or another kind of log, than those before."""
        if self._last is None:
            return False
        sequence, t_us = self._last
        if isinstance(message, Hello):
            return message.sequence == 0 and sequence != 0xFFFF
        back = t_us is not None and message.t_us is not None and _since_s(message.t_us, t_us) < -_HELD_S
        again = isinstance(message, Frame) and message.sequence == 0 and sequence != 0xFFFF
        return back or again or isinstance(message, Frame) == self.samples

    def take(self, message: Message) -> str:
        """Its lines, with the log's first line before them; empty for one that is none of a log."""
        if isinstance(message, Hello):
            return ""
        lines = ""
        if self._last is None:
            self.samples = not isinstance(message, Frame)
            lines = csv_header() if isinstance(message, Frame) else ",".join(SAMPLE_COLUMNS) + "\n"
        else:
            sequence, t_us = self._last
            step = (message.sequence - sequence) & 0xFFFF
            self.lost += max(step - 1, 0)
            if message.t_us is not None and t_us is not None:
                self.time_s += _since_s(message.t_us, t_us)
            elif isinstance(message, Frame) and message.rate_mhz:
                self.time_s += 1e3 * step / message.rate_mhz
        self._last = (message.sequence, message.t_us)
        self.count += 1
        if isinstance(message, Frame):
            rows = csv_rows(message, self.time_s)
        else:
            rows = _sample_rows(message, self.time_s)
        # A picture from before the first message is of no use.
        self._held += [row for row in rows if row[0] >= 0.0]
        return lines + self._before(self.time_s - _HELD_S)

    def rest(self) -> str:
        """The lines that still wait, at the end."""
        return self._before(math.inf)

    def _before(self, time_s: float) -> str:
        self._held.sort(key=lambda row: row[0])
        count = bisect_left(self._held, time_s, key=lambda row: row[0])
        ready, self._held = self._held[:count], self._held[count:]
        return "".join(line for _, line in ready)


def _since_s(now_us: int, before_us: int) -> float:
    """Seconds between two readings of the board's clock, which begins anew after 2**32."""
    return 1e-6 * ((now_us - before_us + (1 << 31) & 0xFFFFFFFF) - (1 << 31))


def _sample_rows(message: ImuSample | Picture, time_s: float) -> list[tuple[float, str]]:
    """One line of a sample, two of a picture, with times: what it showed, and what the pumps got then."""
    if isinstance(message, ImuSample):
        axes = map(text, (*message.force, *message.rate))
        return [(time_s, f"{time_s:.6f},,,{','.join(axes)},,,{message.sequence},,,\n")]
    guard, after_s = message.guard, time_s + 1e-6 * message.after_us
    marker = ",".join(map(text, message.marker_px)) if message.seen else ","
    told = f"{guard.state},{guard.fault},{message.overruns}"
    return [
        (time_s, f"{time_s:.6f},{marker},,,,,,,,,{message.sequence},,,\n"),
        (after_s, f"{after_s:.6f},,,,,,,,,{guard.duty[0]},{guard.duty[1]},,{told}\n"),
    ]


class _Recorder:
    """Logs of the starts of a board, written as they come; the first is held back for `_OPENING_S`."""

    def __init__(self, write: Callable[[int, str], None]) -> None:
        self._write, self._lines, self._held = write, "", True
        self.rows, self.runs, self.opening = Rows(), list[Run](), 0

    def take(self, message: Message) -> None:
        """A message, which may be the first of another start."""
        if self.rows.begins_anew(message):
            if self._held:
                self.opening += self.rows.count
            else:
                self.end()
            self.rows, self._lines, self._held = Rows(), "", False
        self._lines += self.rows.take(message)
        self._held = self._held and self.rows.time_s < _OPENING_S

    def flush(self) -> None:
        """Write what is known to be of this start."""
        if not self._held and self._lines:
            self._write(len(self.runs), self._lines)
            self._lines = ""

    def end(self) -> None:
        """Write the rest of this start's log, where anything came."""
        if self.rows.count:
            self._write(len(self.runs), self._lines + self.rows.rest())
            self.runs.append(Run(self.rows.count, self.rows.lost))


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
    decoder, recorder = Decoder(), _Recorder(write)
    try:
        while more(recorder.rows.count):
            for message in decoder.feed(read()):
                recorder.take(message)
            recorder.flush()
    except KeyboardInterrupt:
        # Stopping by hand is the usual end; what came so far is the log, and nothing may stop its writing.
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except BadInputError:
        # The board is gone; what it sent is not.
        recorder.end()
        raise
    recorder.end()
    return Recording(tuple(recorder.runs), recorder.opening, decoder.skipped, decoder.damaged)


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
    stream, ended = io.BytesIO(read_bytes(path, _MOST_BYTES)), False
    logs: dict[int, list[str]] = {}

    def read() -> bytes:
        nonlocal ended
        data = stream.read(_CHUNK)
        ended = not data
        return data

    result = record(read, lambda ticks: not ended, lambda run, text: logs.setdefault(run, []).append(text))
    if not ended:
        # For a port Ctrl-C is the end of the log; of a file it would be half.
        raise KeyboardInterrupt
    if not result.runs:
        raise BadInputError(
            f"{shown(path)}: holds no frame of the example sketch, only {result.skipped} other bytes"
        )
    return "".join(logs[len(result.runs) - 1])

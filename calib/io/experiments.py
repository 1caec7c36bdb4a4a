"""What a rig is asked to do while a board records it: the experiments that `calib run` wants, in open loop.

The board holds the commands against its envelope and sends samples with times of its own clock. It stops the
pumps when nothing has come from here for `calib_link.h`'s CALIB_LINK_SILENT_MS; `Board` says something every
`_PERIOD_S`.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from calib.core.errors import BadInputError
from calib.io import serial

# ----------------------------------------------------------------------
# Commands as shares of the greatest one, by the time since the beginning.

Shares = tuple[float, float]

_LEVELS = ((0.55, 0.55), (0.7, 0.7), (0.85, 0.85), (1.0, 1.0), (0.9, 0.0), (0.0, 0.9))
"""Together for the pumps, each alone for the angle's damping with the hoses on."""

_STEP_ON_S, _STEP_OFF_S = 2.5, 2.5
_SLOW_S = 10.0
_DEAD = 0.4
"""Share below which the nominal pump gives no pressure."""

_CHIRP_HZ = (0.05, 2.0)
_CHIRP_S = 40.0


def _steps(t: float) -> Shares:
    which, within = divmod(t, _STEP_ON_S + _STEP_OFF_S)
    return _LEVELS[int(which) % len(_LEVELS)] if within < _STEP_ON_S else (0.0, 0.0)


def _deflate(t: float) -> Shares:
    return (1.0, 1.0) if t < 5.0 else (0.0, 0.0)


def _around(wave: float) -> float:
    """From the dead zone to the top, for a wave from -1 to 1."""
    return _DEAD + (1.0 - _DEAD) * 0.5 * (1.0 + wave)


def _ellipse(t: float) -> Shares:
    """The head goes slowly to both sides, while the length changes twice as often."""
    turn = 2.0 * math.pi * t / _SLOW_S
    return _around(math.sin(turn)), _around(-math.sin(turn))


def _chirp(t: float) -> Shares:
    """Rising frequencies, the second pump a quarter of a turn behind."""
    low, high = _CHIRP_HZ
    growth = math.log(high / low) / _CHIRP_S
    turn = 2.0 * math.pi * low * math.expm1(growth * t) / growth
    return _around(math.sin(turn)), _around(math.cos(turn))


def _prbs(t: float) -> Shares:
    """Each pump jumps at random between two values, the same ones in each recording."""
    drawn = random.Random(int(2.0 * t))
    return drawn.choice((_DEAD, 0.9)), drawn.choice((_DEAD, 0.9))


@dataclass(frozen=True)
class Experiment:
    """One recording.

    Attributes
    ----------
    seconds : its length. asks : what the person does before. command : both pumps by the time, as shares of
        the greatest command; None with the pumps off. by_hand : whether a head is pulled aside and let go.
    """

    seconds: float
    asks: str
    command: Callable[[float], Shares] | None = None
    by_hand: bool = False


_HOSES = "hoses on"
EXPERIMENTS = {
    "static": Experiment(60.0, "do not touch the table"),
    "swing": Experiment(5.0, "hoses off, the head free and at rest", by_hand=True),
    "ellipse": Experiment(20.0, _HOSES, _ellipse),
    "steps": Experiment(len(_LEVELS) * (_STEP_ON_S + _STEP_OFF_S), _HOSES, _steps),
    "deflate": Experiment(14.0, _HOSES, _deflate),
    "chirp": Experiment(_CHIRP_S, _HOSES, _chirp),
    "prbs": Experiment(40.0, _HOSES, _prbs),
}
PROGRAMME = ("static1", "swing1", "swing2", "swing3", "ellipse", "steps", "deflate")
"""Logs that `calib run` wants, by name."""


def experiment(name: str) -> Experiment:
    """That of a log's name, which may end in a number."""
    return EXPERIMENTS[name.rstrip("0123456789")]


# ----------------------------------------------------------------------
# The board, and one experiment with it.

_PERIOD_S, _LEAST_S = 0.04, 0.012
_RESTARTS_S = 3.0
"""A bootloader waits for a second or two before a board that restarted says so."""
_ANSWER_S = 12.0
"""A usual board restarts when its port is opened, and computes its self-test."""

_BACKLOG_S = 0.3
"""Longer than it takes to read all that a computer and its driver keep of a port that nobody reads."""
_RUN_S = 5.0
MOST_PWM = 250
"""Below the greatest command, which the board allows for a few seconds only."""

_PULLED_RAD = (math.radians(12.0), math.radians(50.0))
_STILL_RADPS, _LET_GO_RADPS = 0.15, 0.6
_STILL_S, _SLIP_S, _BEFORE_S, _HAND_S = 0.8, 0.05, 0.06, 60.0
_AT_REST, _TOLD_EVERY_S = 50, 2.0


class Port(Protocol):
    """A serial port and a clock."""

    def read(self) -> bytes:
        """What has come, b"" when nothing came within a tenth of a second."""

    def write(self, data: bytes) -> None: ...

    def now_s(self) -> float: ...


@dataclass(frozen=True)
class Done:
    """What an experiment gave.

    Attributes
    ----------
    seconds : of the log. imu, markers : samples, and pictures that showed the marker. lost : messages
        that never came. damaged : frames. overruns : samples that the board left out.
    """

    seconds: float
    imu: int
    markers: int
    lost: int
    damaged: int
    overruns: int

    @property
    def words(self) -> str:
        """In one line."""
        per_s = 1.0 / max(self.seconds, 1e-3)
        rates = f"IMU {self.imu * per_s:.1f} Hz, marker {self.markers * per_s:.1f} Hz"
        return f"{self.seconds:.1f} s, {rates}, {self.lost} lost, {self.overruns} overruns"


class Board:
    """A board that sends samples. Raises `BadInputError` where none answers, or one that cannot record."""

    def __init__(self, port: Port, name: str) -> None:
        self.port, self.name = port, name
        self.decoder = serial.Decoder()
        self._pumps: tuple[int, int] | None = None
        self._said: tuple[int, int] | None = None
        self._said_s = -math.inf
        self.hello = self._greet()

    def _greet(self) -> serial.Hello:
        began, ticks = self.port.now_s(), False
        for message in self.messages():
            if isinstance(message, serial.Hello):
                return message
            ticks = ticks or isinstance(message, serial.Frame)
            if self.port.now_s() - began > _ANSWER_S:
                break
        if ticks:
            raise BadInputError(
                f"{self.name}: the board's sketch only sends ticks; write and flash it anew (calib firmware)"
            )
        raise BadInputError(
            f"{self.name}: no answer within {_ANSWER_S:g} s, expected the sketch that calib firmware writes"
        )

    def messages(self) -> Iterator[serial.Message | None]:
        """All that comes, for ever; None where nothing has. Says every `_PERIOD_S` what is wanted."""
        while True:
            now = self.port.now_s()
            # The board's buffer holds a few frames only.
            if now - self._said_s >= (_PERIOD_S if self._said == self._pumps else _LEAST_S):
                self.port.write(serial.setting(True, self._pumps))
                self._said, self._said_s = self._pumps, now
            found = False
            for message in self.decoder.feed(self.port.read()):
                found = True
                yield message
            if not found:
                yield None

    def pumps(self, pumps: tuple[int, int] | None) -> None:
        """Commands from now on, None for off."""
        self._pumps = pumps

    def close(self) -> None:
        """Pumps off, whatever happened."""
        self._pumps = None
        self.port.write(serial.setting(True))


def perform(
    board: Board, plan: Experiment, level: float, write: Callable[[str], None], tell: Callable[[str], None]
) -> Done:
    """Do an experiment, and write its log as it comes.

    Parameters
    ----------
    level : share of the greatest command. write : takes lines. tell : takes what the person is to do.

    Raises `BadInputError` where the board restarts, falls silent, or does not let the pumps run.
    """
    board.port.write(serial.CLEAR)
    _pass_over_backlog(board)
    _wait_for(board, lambda message: isinstance(message, serial.ImuSample), "its IMU gives no samples")
    before = _wait_for_release(board, tell) if plan.by_hand else []
    try:
        if plan.command is not None:
            board.pumps((0, 0))
            _wait_for(board, _lets_run, "it does not let the pumps run")
        return _recorded(board, plan, level, write, before)
    finally:
        board.pumps(None)


def _recorded(
    board: Board, plan: Experiment, level: float, write: Callable[[str], None], before: list[serial.Message]
) -> Done:
    rows, imu, markers, overruns = serial.Rows(), 0, 0, 0
    first_overruns: int | None = None
    top = level * min(board.hello.open_high, MOST_PWM)
    damaged, heard_s = board.decoder.damaged, board.port.now_s()
    queue, came = deque(before), board.messages()
    try:
        while rows.time_s < plan.seconds:
            message = queue.popleft() if queue else next(came)
            now = board.port.now_s()
            if plan.command is not None:
                first, second = plan.command(rows.time_s)
                board.pumps((round(top * first), round(top * second)))
            if not isinstance(message, serial.ImuSample | serial.Picture):
                _check_goes_on(board, rows, message, now - heard_s)
                continue
            heard_s = now
            write(rows.take(message))
            if isinstance(message, serial.ImuSample):
                imu += 1
                continue
            markers += message.seen
            first_overruns = message.overruns if first_overruns is None else first_overruns
            overruns = message.overruns - first_overruns
            if plan.command is not None and message.guard.state == serial.GUARD_FAULT:
                raise BadInputError(
                    f"{board.name}: after {rows.time_s:.1f} s the guard stopped the pumps: "
                    f"{serial.FAULTS.get(message.guard.fault, message.guard.fault)}; see the envelope in "
                    "rig.yaml, or record with a lower --level"
                )
    finally:
        write(rows.rest())
    return Done(rows.time_s, imu, markers, rows.lost, board.decoder.damaged - damaged, overruns)


def _check_goes_on(
    board: Board, rows: serial.Rows, message: serial.Hello | serial.Frame | None, silent_s: float
) -> None:
    """Raise `BadInputError` where the board has restarted, or has sent no sample for long."""
    hello = message if isinstance(message, serial.Hello) else None
    if isinstance(message, serial.Frame) or (hello is not None and rows.begins_anew(hello)):
        why = _fault(0 if hello is None else hello.kept)
        raise BadInputError(
            f"{board.name}: the board restarted after {rows.time_s:.1f} s{why}; record this again"
        )
    if silent_s > _RESTARTS_S:
        raise BadInputError(
            f"{board.name}: the board fell silent after {rows.time_s:.1f} s; record this again"
        )


def _fault(number: int) -> str:
    """A fault of the guard in brackets; empty for none that is known."""
    return f" ({serial.FAULTS[number]})" if number in serial.FAULTS else ""


def _lets_run(message: serial.Message) -> bool:
    return isinstance(message, serial.Picture) and message.guard.state == serial.GUARD_RUN


def _pass_over_backlog(board: Board) -> None:
    """Read what waits from before, as while a person took the hoses off; none of it belongs into the log."""
    began = board.port.now_s()
    for _ in board.messages():
        if board.port.now_s() - began > _BACKLOG_S:
            return


def _wait_for(board: Board, there: Callable[[serial.Message], bool], lacks: str) -> None:
    """Until a message of some kind comes."""
    began, fault = board.port.now_s(), 0
    for message in board.messages():
        if message is not None and there(message):
            return
        if isinstance(message, serial.Picture):
            fault = message.guard.fault or fault
        if board.port.now_s() - began > _RUN_S:
            break
    raise BadInputError(f"{board.name}: the board answers, but {lacks}{_fault(fault)}")


def _wait_for_release(board: Board, tell: Callable[[str], None]) -> list[serial.Message]:
    """Say what to do with the head; what came in the last moment before it swings."""
    recent: deque[tuple[float, serial.Message]] = deque()
    pull = _Pull(tell, board.port.now_s())
    for message in board.messages():
        now = board.port.now_s()
        if now - pull.began_s > _HAND_S:
            raise BadInputError(
                f"{board.name}: the head was not pulled aside and let go within {_HAND_S:g} s"
            )
        if not isinstance(message, serial.ImuSample | serial.Picture):
            continue
        recent.append((now, message))
        while recent[0][0] < now - _BEFORE_S:
            recent.popleft()
        if isinstance(message, serial.ImuSample) and pull.ends_with(message, now):
            return [one for _, one in recent]
    raise AssertionError("unreachable")


class _Pull:
    """A head that a person pulls aside, holds and lets go, and what the person is told to do.

    The angle at rest is taken first, so that it does not matter how the IMU is mounted.
    """

    def __init__(self, tell: Callable[[str], None], now_s: float) -> None:
        self.tell, self.began_s = tell, now_s
        self._rest: list[tuple[float, float]] = []
        self._zero_rad: float | None = None
        self._moved_s = self._told_s = self._calm_s = -math.inf
        self._held = False

    def ends_with(self, sample: serial.ImuSample, now_s: float) -> bool:
        """Whether the head is let go in this sample."""
        x, y, _ = sample.force
        if self._zero_rad is None:
            self._rest.append((x, y))
            if len(self._rest) >= _AT_REST:
                self._zero_rad = math.atan2(sum(y for _, y in self._rest), sum(x for x, _ in self._rest))
                self.tell("pull the head aside by 20 to 30 degrees, and hold it")
                self.began_s = now_s
            return False
        spin = abs(sample.rate[2])
        if self._held and spin > _LET_GO_RADPS:
            return True
        angle = abs(math.remainder(math.atan2(y, x) - self._zero_rad, 2.0 * math.pi))
        if spin <= _STILL_RADPS and _PULLED_RAD[0] <= angle <= _PULLED_RAD[1]:
            self._calm_s = now_s
            if not self._held and now_s - max(self._moved_s, self.began_s) > _STILL_S:
                self._held = True
                self.tell("let go")
        # A head that is let go is slow for a sample as well.
        elif not self._held or now_s - self._calm_s >= _SLIP_S:
            self._moves(angle, now_s)
        return False

    def _moves(self, angle_rad: float, now_s: float) -> None:
        self._moved_s = now_s
        if self._held:
            self.tell("it moved slowly: hold it")
        self._held = False
        if now_s - self._told_s > _TOLD_EVERY_S:
            self._told_s = now_s
            self.tell(f"  {math.degrees(angle_rad):.0f} degrees")

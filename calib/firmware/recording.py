"""Recording a board: from reads of a port to the text of a log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calib.firmware.telemetry import Decoder, Frame, csv_header, csv_row

__all__ = ["Recording", "record"]


@dataclass(frozen=True)
class Recording:
    """What came in.

    Attributes
    ----------
    text : the log. ticks : its rows. lost : sequence numbers that never came. restarts : of the board.
    skipped : bytes outside frames. damaged : frames with a wrong checksum.
    """

    text: str
    ticks: int
    lost: int
    restarts: int
    skipped: int
    damaged: int


def record(read: Callable[[], bytes], more: Callable[[int], bool]) -> Recording:
    """Read until told to stop; a board that restarts begins the log anew.

    Parameters
    ----------
    read : the next bytes of the port, b"" when none came within its timeout.
    more : whether to go on, given the ticks so far.
    """
    decoder, lines = Decoder(), [csv_header()]
    last: Frame | None = None
    tick = lost = restarts = 0
    try:
        while more(len(lines) - 1):
            for frame in decoder.feed(read()):
                if last is not None and frame.sequence == 0 and last.sequence != 0xFFFF:
                    # What an earlier start sent belongs to another run.
                    lines, last, tick, lost = [csv_header()], None, 0, 0
                    restarts += 1
                if last is not None:
                    step = (frame.sequence - last.sequence) & 0xFFFF
                    lost += max(step - 1, 0)
                    tick += step
                lines.append(csv_row(frame, tick))
                last = frame
    except KeyboardInterrupt:
        # Stopping by hand is the usual end; what came so far is the log.
        pass
    return Recording("".join(lines), len(lines) - 1, lost, restarts, decoder.skipped, decoder.damaged)

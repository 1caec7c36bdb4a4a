"""Recording: what is lost, what is damaged, and a board that restarts."""

from __future__ import annotations

from dataclasses import replace

from firmware_rigs import header

from calib.io.serial import Frame, Recording, encoded, record
from calib.stages.firmware.vectors import vectors


def _frames(count: int, first: int = 0) -> list[Frame]:
    vector = vectors(header(), 2)[0]
    w = vector.wanted
    one = Frame(1, 60000, 0, vector.given, w.phi_rad, w.marker_m, w.head_m, w.q_m, w.pwm, w.flags)
    return [replace(one, sequence=(first + k) & 0xFFFF) for k in range(count)]


def _recorded(stream: bytes, portion: int = 61) -> Recording:
    parts = [stream[i : i + portion] for i in range(0, len(stream), portion)]

    def read() -> bytes:
        return parts.pop(0)

    return record(read, lambda ticks: bool(parts))


def test_lost_and_damaged_frames_are_counted_and_leave_a_gap_in_time() -> None:
    frames = [encoded(f) for f in _frames(10)]
    frames[4] = b""
    frames[7] = frames[7][:20] + b"?" + frames[7][21:]
    result = _recorded(b"garbage" + b"".join(frames))
    assert (result.ticks, result.lost, result.damaged, result.restarts) == (8, 2, 1, 0)
    times = [round(60.0 * float(line.split(",")[0])) for line in result.text.splitlines()[1:]]
    assert times == [0, 1, 2, 3, 5, 6, 8, 9]


def test_sequence_numbers_go_round() -> None:
    result = _recorded(b"".join(encoded(f) for f in _frames(6, 0xFFFD)))
    assert (result.ticks, result.lost, result.restarts) == (6, 0, 0)
    last = float(result.text.splitlines()[-1].split(",")[0])
    assert abs(last - 5.0 / 60.0) < 1e-9


def test_a_restart_begins_the_log_anew() -> None:
    stream = b"".join(encoded(f) for f in [*_frames(5, 100), *_frames(3)])
    result = _recorded(stream)
    assert (result.ticks, result.restarts, result.lost) == (3, 1, 0)


def test_ctrl_c_keeps_what_came() -> None:
    frames = [encoded(f) for f in _frames(4)]

    def read() -> bytes:
        if not frames:
            raise KeyboardInterrupt
        return frames.pop(0)

    assert record(read, lambda ticks: True).ticks == 4

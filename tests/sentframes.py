"""Frames as a board sends them."""

from __future__ import annotations

import struct

from calib.io.serial import (
    _HELLO,
    _IMU,
    _PAYLOADS,
    _PICTURE,
    _PUNCTUAL,
    _SYNC,
    _TICK,
    _UNGUARDED,
    _UNTIMED,
    Hello,
    ImuSample,
    Message,
    Picture,
    _framed,
    checksum,
)


def encoded(frame: Message, punctual: bool = False) -> bytes:
    """The frame as a board sends it; a tick without a time or lateness as sketches of before did."""
    if isinstance(frame, Hello):
        return _framed(_HELLO, _PAYLOADS[_HELLO].pack(*vars(frame).values()))
    if isinstance(frame, ImuSample):
        return _framed(
            _IMU,
            _PAYLOADS[_IMU].pack(frame.sequence, frame.t_us, *frame.force, *frame.rate),
        )
    if isinstance(frame, Picture):
        times = (frame.sequence, frame.t_us, frame.after_us, frame.seen)
        rest = (*frame.marker_px, *frame.guard.numbers, frame.overruns)
        return _framed(_PICTURE, _PAYLOADS[_PICTURE].pack(*times, *rest))
    given, out, guard = frame.given, frame.out, frame.guard
    punctual = punctual or guard is None or frame.t_us is None
    head = (frame.identity, frame.rate_mhz, frame.sequence, given.sensors, given.mode)
    numbers = (*head, *given.numbers[: 7 if punctual else 8], *out.numbers, out.flags)
    if guard is not None and frame.t_us is not None:
        layout = _PUNCTUAL if punctual else _PAYLOADS[_TICK]
        return _framed(_TICK, layout.pack(frame.t_us, *numbers, *guard.numbers))
    payload = _UNGUARDED.pack(*numbers) if guard is None else _UNTIMED.pack(*numbers, *guard.numbers)
    body = bytes([len(payload)]) + payload
    return _SYNC + body + struct.pack("<H", checksum(body))

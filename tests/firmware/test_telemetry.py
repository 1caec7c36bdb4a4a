"""Frames: there and back, and found again after anything."""

from __future__ import annotations

import binascii
import csv
import io
import math

from hypothesis import given, settings
from hypothesis import strategies as st

from calib.io.serial import Decoder, Frame, checksum, csv_header, csv_row, encoded, frame_from_row
from calib.stages.firmware.conformance import Inputs
from calib.stages.firmware.vectors import binary32

floats = st.floats(width=32, allow_nan=False)


def frame(sequence: int, value: float = 0.25, **more: object) -> Frame:
    """A frame with this sequence number."""
    inputs = Inputs(158.0, 80.5, 9.81, value, -0.125, (0.08, 0.0805), mode=2)
    return Frame(
        0xDEADBEEF,
        60000,
        sequence,
        binary32(inputs),
        value,
        (0.5, 1.0),
        (0.25, 2.0),
        (0.0625, 4.0),
        (1.0, 255.0),
        3,
    )


@given(st.binary(max_size=64))
def test_the_checksum_is_the_one_of_the_standard_library(data: bytes) -> None:
    assert checksum(data) == binascii.crc_hqx(data, 0xFFFF)


@given(st.integers(0, 65535), floats)
def test_there_and_back(sequence: int, value: float) -> None:
    sent = frame(sequence, value)
    decoder = Decoder()
    assert list(decoder.feed(encoded(sent))) == [sent]
    assert decoder.skipped == 0


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=90), min_size=1, max_size=6), st.integers(1, 50))
def test_every_whole_frame_is_found_between_garbage(garbage: list[bytes], portion: int) -> None:
    """Whatever stands between frames, even beginnings of frames, costs none of them."""
    sent = [frame(k) for k in range(len(garbage))]
    stream = b"".join(noise + encoded(f) for noise, f in zip(garbage, sent, strict=True))
    # A false start may wait for as many bytes as a frame has.
    stream += bytes(90)
    decoder = Decoder()
    found = [f for i in range(0, len(stream), portion) for f in decoder.feed(stream[i : i + portion])]
    assert found == sent


def test_a_false_start_in_front_of_a_frame_costs_nothing() -> None:
    whole = encoded(frame(7))
    decoder = Decoder()
    assert [f.sequence for f in decoder.feed(whole[:40] + whole + whole)] == [7, 7]
    assert decoder.damaged == 1
    assert decoder.skipped == 40


def test_a_damaged_byte_costs_its_own_frame_only() -> None:
    stream = bytearray(b"".join(encoded(frame(k)) for k in range(3)))
    stream[len(stream) // 2] ^= 0x10
    assert [f.sequence for f in Decoder().feed(bytes(stream) + bytes(90))] == [0, 2]


def test_a_row_of_the_log_holds_the_frame() -> None:
    for sent in (frame(3), frame(4, math.pi)):
        text = csv_header() + csv_row(sent, 3)
        (row,) = csv.DictReader(io.StringIO(text))
        assert float(row["t_s"]) == 0.05
        assert frame_from_row(row) == frame_from_row(row)
        # binary32 survives nine digits.
        assert encoded(frame_from_row(row)) == encoded(sent)


def test_what_was_not_seen_is_blank() -> None:
    from dataclasses import replace

    sent = frame(0)
    blind = replace(sent, given=replace(sent.given, marker_seen=False, imu_read=False))
    (row,) = csv.DictReader(io.StringIO(csv_header() + csv_row(blind, 0)))
    assert [row[name] for name in ("u_px", "v_px", "ax_mps2", "gz_radps")] == ["", "", "", ""]
    assert frame_from_row(row).given.marker_seen is False

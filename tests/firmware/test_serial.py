"""What a board sends: frames found again after anything, recordings, and the check against the reference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_rigs import header
from hypothesis import given, settings
from hypothesis import strategies as st
from sentframes import encoded

from calib.core.errors import BadInputError
from calib.io.logs import read_log
from calib.io.serial import (
    Decoder,
    Frame,
    Guard,
    ImuSample,
    Inputs,
    Outputs,
    Picture,
    Recording,
    Rows,
    Run,
    csv_header,
    csv_rows,
    frame_from_row,
    record,
)
from calib.stages.firmware.check import check_frames, read_frames
from calib.stages.firmware.vectors import binary32, vectors

floats = st.floats(width=32, allow_nan=False)


def frame(sequence: int, value: float = 0.25, **more: object) -> Frame:
    """A frame with this sequence number."""
    inputs = Inputs(158.0, 80.5, 9.81, value, -0.125, (0.08, 0.0805), mode=2)
    return Frame(
        0xDEADBEEF,
        60000,
        sequence,
        binary32(inputs),
        Outputs(value, (0.5, 1.0), (0.25, 2.0), (0.0625, 4.0), (1.0, 255.0), 3),
    )


@given(st.integers(0, 65535), floats)
def test_there_and_back(sequence: int, value: float) -> None:
    sent = frame(sequence, value)
    decoder = Decoder()
    assert list(decoder.feed(encoded(sent))) == [sent]
    assert decoder.skipped == 0


def test_a_sketch_that_does_not_tell_how_late_its_pictures_are_is_read() -> None:
    sent = replace(frame(3), guard=Guard((7, 9), 2, 0, 0), t_us=5000)
    assert list(Decoder().feed(encoded(sent, punctual=True))) == [sent]
    late = replace(sent, given=replace(sent.given, late_ticks=0.625))
    assert list(Decoder().feed(encoded(late))) == [late]


def test_a_late_picture_is_a_row_of_its_time() -> None:
    late = replace(frame(5), given=replace(frame(5).given, late_ticks=0.5))
    (shown_s, shown), (at_s, tick) = csv_rows(late, 0.1)
    assert (at_s - shown_s) * 60.0 == pytest.approx(0.5)
    names = csv_header().strip().split(",")
    rows = [dict(zip(names, line.strip().split(","), strict=True)) for line in (shown, tick)]
    assert rows[0]["u_px"] == "158" and rows[1]["u_px"] == rows[0]["sequence"] == ""
    assert binary32(frame_from_row(rows[1]).given) == late.given


def test_times_of_a_log_never_go_back() -> None:
    """A picture comes with the tick, after samples that were taken since; the clock begins anew meanwhile."""
    rows, wrap, text = Rows(), 2**32 - 30_000, ""
    for k in range(40):
        t_us = wrap + 10_000 * k
        text += rows.take(ImuSample(2 * k, t_us & 0xFFFFFFFF, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))
        old_us = (t_us - 7_000) & 0xFFFFFFFF
        picture = Picture(2 * k + 1, old_us, 9_000, True, (float(k), 1.0), Guard(), 0)
        assert not rows.begins_anew(picture)
        text += rows.take(picture)
    table = [line.split(",") for line in (text + rows.rest()).splitlines()[1:]]
    times = np.array([float(row[0]) for row in table])
    assert (np.diff(times) >= 0.0).all() and times[0] == 0.0 and times[-1] == pytest.approx(0.392)
    assert [float(row[1]) for row in table if row[1]] == list(range(1, 40))
    assert rows.begins_anew(ImuSample(0, 100, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))


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


def _frames(count: int, first: int = 0) -> list[Frame]:
    vector = vectors(header().values, 2)[0]
    w = vector.wanted
    one = Frame(1, 60000, 0, vector.given, w)
    return [replace(one, sequence=(first + k) & 0xFFFF) for k in range(count)]


def _recorded(stream: bytes, portion: int = 61) -> tuple[Recording, dict[int, str]]:
    parts = [stream[i : i + portion] for i in range(0, len(stream), portion)]
    logs: dict[int, str] = {}

    def write(run: int, text: str) -> None:
        logs[run] = logs.get(run, "") + text

    return record(lambda: parts.pop(0), lambda ticks: bool(parts), write), logs


def test_lost_and_damaged_frames_are_counted_and_leave_a_gap_in_time() -> None:
    frames = [encoded(f) for f in _frames(10)]
    frames[4] = b""
    frames[7] = frames[7][:20] + b"?" + frames[7][21:]
    result, logs = _recorded(b"garbage" + b"".join(frames))
    assert result.runs == (Run(8, 2),)
    assert (result.damaged, result.opening) == (1, 0)
    times = [round(60.0 * float(line.split(",")[0])) for line in logs[0].splitlines()[1:]]
    assert times == [0, 1, 2, 3, 5, 6, 8, 9]


def test_ctrl_c_keeps_what_came() -> None:
    frames = [encoded(f) for f in _frames(4)]

    def read() -> bytes:
        if not frames:
            raise KeyboardInterrupt
        return frames.pop(0)

    written: list[str] = []
    result = record(read, lambda ticks: True, lambda run, text: written.append(text))
    assert result.runs == (Run(4, 0),)
    assert len("".join(written).splitlines()) == 5


def test_each_start_of_the_board_is_a_log_and_what_opening_cut_short_is_none() -> None:
    frames = [encoded(f) for f in _frames(400)]
    result, logs = _recorded(b"".join((*frames[:40], *frames, *frames[:250], *frames[:3])))
    assert result.runs == (Run(400, 0), Run(250, 0), Run(3, 0))
    assert result.opening == 40
    assert [len(logs[k].splitlines()) for k in range(3)] == [401, 251, 4]


def test_ticks_are_written_as_they_come() -> None:
    frames, seen = [encoded(f) for f in _frames(400)], []
    written: list[str] = []

    def read() -> bytes:
        seen.append("".join(written).count("\n"))
        return frames.pop(0)

    record(read, lambda ticks: bool(frames), lambda run, text: written.append(text))
    # Lines of the last fifth of a second wait for older ones.
    assert seen[100] == 0 and seen[300] == 301 - 13


def _frames_check(ticks: int = 120) -> list[Frame]:
    identity = header().identity
    made = []
    for k, vector in enumerate(vectors(header().values, ticks)):
        w = vector.wanted
        made.append(Frame(identity, 60000, k, vector.given, w))
    return made


def _text(frames: list[Frame]) -> str:
    lines = [line for k, frame in enumerate(frames) for _, line in csv_rows(frame, k / 60)]
    return "".join([csv_header(), *lines])


def _log(path: Path, frames: list[Frame]) -> Path:
    path.write_text(_text(frames))
    return path


def test_a_good_board_passes(tmp_path: Path) -> None:
    result = check_frames(header(), read_frames(_log(tmp_path / "log.csv", _frames_check())), "log.csv")
    assert (result.ticks, result.verdict.reasons, result.missing_after, result.flags_differ) == (
        120,
        [],
        None,
        0,
    )
    # Nine digits of the log, times 24000 PWM/m.
    assert max(result.worst.values()) < 1e-5


def test_a_board_with_the_fused_estimator_is_known_by_its_flags(tmp_path: Path) -> None:
    identity = header("fused").identity
    frames = []
    for k, vector in enumerate(vectors(header("fused").values, 120, fused=True)):
        w = vector.wanted
        frames.append(Frame(identity, 60000, k, vector.given, w))
    result = check_frames(header("fused"), read_frames(_log(tmp_path / "log.csv", frames)), "log.csv")
    assert (result.ticks, result.verdict.reasons, result.flags_differ) == (120, [], 0)
    without = [replace(frame, identity=header().identity) for frame in frames]
    with pytest.raises(BadInputError, match=r"log\.csv: the board runs the fused estimator, for which"):
        check_frames(header(), without, "log.csv")


def test_a_wrong_value_is_named_with_its_tick() -> None:
    frames = _frames_check()
    q1, q2 = frames[41].out.q_m
    frames[41] = replace(frames[41], out=replace(frames[41].out, q_m=(q1 + 1e-5, q2)))
    result = check_frames(header(), frames, "log.csv")
    assert result.verdict.reasons == ["tick 41 is the first that differs, in q_m"]
    other = replace(frames[30].out, flags=frames[30].out.flags ^ 0x10)
    frames[30] = replace(frames[30], out=other)
    result = check_frames(header(), frames, "log.csv")
    assert result.verdict.reasons == ["tick 30 is the first that differs, in flags"]
    assert result.flags_differ == 1


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t_s,u_px\n0,1\n")
    with pytest.raises(BadInputError, match="has no column sequence, expected a log of calib record"):
        read_frames(path)
    path.write_text(csv_header())
    with pytest.raises(BadInputError, match="holds no tick of a board"):
        read_frames(path)
    _log(path, _frames_check(3))
    path.write_text(path.read_text().replace(",60000,", ",sixty,", 1))
    with pytest.raises(BadInputError, match=r"line 2 is no tick of a board"):
        read_frames(path)


FRAME = Frame(
    7, 60_000, 0, Inputs(160.0, 104.0, 9.75, 0.25, 0.0, (0.065, 0.066), True, True, 0),
    Outputs(0.125, (0.0, 0.08), (0.0, 0.065), (0.065, 0.065), (128.0, 64.0), 0),
)  # fmt: skip


def _frames_log_serial(count: int = 300) -> list[Frame]:
    frames = []
    for k in range(count):
        given = replace(FRAME.given, u_px=float(k), marker_seen=k % 3 != 0, imu_read=k % 7 != 0)
        frames.append(replace(FRAME, sequence=k, given=given))
    return frames


@pytest.mark.parametrize("ending", [".bin", ".serial"])
def test_frames_are_rows(ending: str, tmp_path: Path) -> None:
    frames, path, table = _frames_log_serial(), tmp_path / f"log{ending}", tmp_path / "log.csv"
    path.write_bytes(b"boot: hello\r\n\xa5" + b"".join(map(encoded, frames)) + encoded(frames[0])[:20])
    table.write_text(_text(frames))
    log, same = read_log(path), read_log(table)
    assert log.columns.keys() == same.columns.keys() and log.t_s.tolist() == same.t_s.tolist()
    for name, values in log.columns.items():
        assert np.array_equal(values, same.columns[name], equal_nan=True), name
    assert len(log.sampled("u_px")) == 200 and log.t_s[60] == pytest.approx(1.0)


def test_lost_frames_leave_a_gap_and_a_restart_begins_anew(tmp_path: Path) -> None:
    frames, path = _frames_log_serial(), tmp_path / "log.bin"
    path.write_bytes(b"".join(encoded(frame) for frame in (*frames[:50], *frames[:10], *frames[20:])))
    log = read_log(path)
    assert len(log) == 290
    assert np.diff(log.t_s).max() == pytest.approx(11 / 60)

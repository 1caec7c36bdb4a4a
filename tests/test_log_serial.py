"""What a board sent, as a log: the same as `calib record` makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.io.logs import read_log
from calib.io.serial import Frame, csv_header, csv_row, encoded
from calib.stages.firmware.conformance import Inputs

FRAME = Frame(
    7, 60_000, 0, Inputs(160.0, 104.0, 9.75, 0.25, -0.5, (0.065, 0.066), True, True, 0), 0.125, (0.0, 0.08),
    (0.0, 0.065), (0.065, 0.065), (128.0, 64.0), 0,
)  # fmt: skip


def _frames(count: int = 300) -> list[Frame]:
    frames = []
    for k in range(count):
        given = replace(FRAME.given, u_px=float(k), marker_seen=k % 3 != 0, imu_read=k % 7 != 0)
        frames.append(replace(FRAME, sequence=k, given=given))
    return frames


@pytest.mark.parametrize("ending", [".bin", ".serial"])
def test_frames_are_rows(ending: str, tmp_path: Path) -> None:
    frames, path, table = _frames(), tmp_path / f"log{ending}", tmp_path / "log.csv"
    path.write_bytes(b"boot: hello\r\n\xa5" + b"".join(map(encoded, frames)) + encoded(frames[0])[:20])
    table.write_text(csv_header() + "".join(csv_row(frame, k) for k, frame in enumerate(frames)))
    log, same = read_log(path), read_log(table)
    assert log.columns.keys() == same.columns.keys() and log.t_s.tolist() == same.t_s.tolist()
    for name, values in log.columns.items():
        assert np.array_equal(values, same.columns[name], equal_nan=True), name
    assert len(log.sampled("u_px")) == 200 and log.t_s[60] == pytest.approx(1.0)


def test_lost_frames_leave_a_gap_and_a_restart_begins_anew(tmp_path: Path) -> None:
    frames, path = _frames(), tmp_path / "log.bin"
    path.write_bytes(b"".join(encoded(frame) for frame in (*frames[:50], *frames[:10], *frames[20:])))
    log = read_log(path)
    assert len(log) == 290
    assert np.diff(log.t_s).max() == pytest.approx(11 / 60)


@pytest.mark.parametrize("data", [b"", b"t_s,u_px\n0,1\n", bytes(range(256)) * 40, b"\xa5\x5a" * 5000])
def test_no_frame_at_all(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(data)
    with pytest.raises(BadInputError, match=r"log\.bin: holds no frame of the example sketch, only \d+"):
        read_log(path)

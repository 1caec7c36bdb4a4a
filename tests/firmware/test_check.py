"""A board's log against the reference: a good board passes, each kind of bad one is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from firmware_rigs import header

from calib.core.errors import BadInputError
from calib.io.serial import Frame, csv_header, csv_row
from calib.stages.firmware.check import check_frames, read_frames
from calib.stages.firmware.header import identity_of
from calib.stages.firmware.vectors import vectors


def _frames(ticks: int = 120) -> list[Frame]:
    identity = int(identity_of(header())[:8], 16)
    made = []
    for k, vector in enumerate(vectors(header(), ticks)):
        w = vector.wanted
        made.append(
            Frame(identity, 60000, k, vector.given, w.phi_rad, w.marker_m, w.head_m, w.q_m, w.pwm, w.flags)
        )
    return made


def _log(path: Path, frames: list[Frame]) -> Path:
    path.write_text(csv_header() + "".join(csv_row(f, k) for k, f in enumerate(frames)))
    return path


def test_a_good_board_passes(tmp_path: Path) -> None:
    result = check_frames(header(), read_frames(_log(tmp_path / "log.csv", _frames())), "log.csv")
    assert (result.ticks, result.reasons, result.missing_after, result.flags_differ) == (120, [], None, 0)
    # Nine digits of the log, times 24000 PWM/m.
    assert max(result.worst.values()) < 1e-5


def test_a_board_with_the_fused_estimator_is_known_by_its_flags(tmp_path: Path) -> None:
    identity = int(identity_of(header("fused"))[:8], 16)
    frames = []
    for k, vector in enumerate(vectors(header("fused"), 120, fused=True)):
        w = vector.wanted
        frames.append(
            Frame(identity, 60000, k, vector.given, w.phi_rad, w.marker_m, w.head_m, w.q_m, w.pwm, w.flags)
        )
    result = check_frames(header("fused"), read_frames(_log(tmp_path / "log.csv", frames)), "log.csv")
    assert (result.ticks, result.reasons, result.flags_differ) == (120, [], 0)
    without = [replace(frame, identity=int(identity_of(header())[:8], 16)) for frame in frames]
    with pytest.raises(BadInputError, match=r"log\.csv: the board runs the fused estimator, for which"):
        check_frames(header(), without, "log.csv")


def test_a_wrong_value_is_named_with_its_tick() -> None:
    frames = _frames()
    frames[41] = replace(frames[41], q_m=(frames[41].q_m[0] + 1e-5, frames[41].q_m[1]))
    result = check_frames(header(), frames, "log.csv")
    assert result.reasons == ["tick 41 is the first that differs, in q_m"]
    frames[30] = replace(frames[30], flags=frames[30].flags ^ 0x10)
    result = check_frames(header(), frames, "log.csv")
    assert result.reasons == ["tick 30 is the first that differs, in flags"]
    assert result.flags_differ == 1


def test_nan_is_no_small_difference() -> None:
    frames = _frames()
    frames[3] = replace(frames[3], phi_rad=float("nan"))
    assert check_frames(header(), frames, "log.csv").first_bad == (3, "phi_rad")


def test_it_ends_where_a_frame_is_missing() -> None:
    frames = _frames()
    del frames[50]
    result = check_frames(header(), frames, "log.csv")
    assert (result.ticks, result.missing_after, result.reasons) == (50, 50, [])


def test_other_constants_and_late_starts_are_refused() -> None:
    with pytest.raises(
        BadInputError, match=r"log\.csv: the board runs the constants [0-9A-F]{8}, rig\.yaml gives"
    ):
        check_frames(header("full"), _frames(), "log.csv")
    with pytest.raises(BadInputError, match=r"log\.csv: begins with tick 5, expected 0"):
        check_frames(header(), _frames()[5:], "log.csv")


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t_s,u_px\n0,1\n")
    with pytest.raises(BadInputError, match="has no column sequence, expected a log of calib record"):
        read_frames(path)
    path.write_text(csv_header())
    with pytest.raises(BadInputError, match="holds no tick of a board"):
        read_frames(path)
    _log(path, _frames(3))
    path.write_text(path.read_text().replace(",60000,", ",sixty,", 1))
    with pytest.raises(BadInputError, match=r"line 2 is no tick of a board"):
        read_frames(path)

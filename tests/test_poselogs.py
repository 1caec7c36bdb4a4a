"""Logs and imu_tk's files are read; what they cannot be is said with the option to give."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from imu_poses import AXES, Sensor, in_counts, sphere_poses
from imu_poses import pose_log as made

from calib.errors import BadInputError
from calib.logs import Log
from calib.poselogs import pose_log, read_pose_files, read_pose_log

NAMES = [f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES]
READINGS = made(sphere_poses(8), Sensor())
COUNTS = made(sphere_poses(8), in_counts(Sensor()), counts=True)


def _log(values: np.ndarray = READINGS.values, names: list[str] = NAMES, t: np.ndarray | None = None) -> Log:
    t = READINGS.t_s[: len(values)] if t is None else t
    columns = dict(zip(names, values.T, strict=True))
    return Log("log.csv", t, columns, np.arange(2, len(t) + 2))


def _file(path: Path, t: np.ndarray, values: np.ndarray) -> Path:
    text = "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in np.column_stack([t, values]).tolist())
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


def test_units_are_converted_and_counts_kept() -> None:
    scale = np.array([180 / np.pi] * 3 + [1 / 9.80665] * 3)
    assert pose_log(_log()).values.tolist() == READINGS.values.tolist()
    assert pose_log(_log(READINGS.values * scale), "g", "deg/s").values == pytest.approx(READINGS.values)
    counts = pose_log(_log(COUNTS.values), "counts", "counts")
    assert (counts.accel_unit, counts.gyro_unit) == ("counts", "counts")
    assert counts.values.tolist() == COUNTS.values.tolist()


@pytest.mark.parametrize(
    ("factor", "units", "words"),
    [
        ([1] * 3 + [1 / 9.80665] * 3, ("m/s2", "rad/s"), "in g, expected m/s\\^2; give --acc-unit g"),
        ([1] * 3 + [400] * 3, ("m/s2", "rad/s"), "in raw counts, expected m/s\\^2; give --acc-unit counts"),
        ([1] * 3 + [4] * 3, ("m/s2", "rad/s"), "expected about 9.81; see --acc-unit"),
        ([180 / np.pi] * 3 + [1] * 3, ("m/s2", "rad/s"), "if it is in deg/s, give --gyro-unit deg/s"),
        ([1e6] * 3 + [1] * 3, ("m/s2", "deg/s"), "if it is in counts, give --gyro-unit counts"),
        ([1e4] * 3 + [1] * 3, ("m/s2", "deg/s"), "see --gyro-unit"),
    ],
)
def test_wrong_units_are_refused(factor: list[float], units: tuple[str, str], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        pose_log(_log(READINGS.values * np.array(factor)), *units)


def test_an_offset_in_counts_is_told_from_a_rate() -> None:
    with pytest.raises(BadInputError, match="give --gyro-unit counts"):
        pose_log(_log(COUNTS.values), "counts", "rad/s")


def test_logs_without_what_is_needed_are_refused() -> None:
    ok = READINGS.values
    for log, words in (
        (_log(ok[:, :0], []), "has no IMU"),
        (_log(np.full_like(ok, np.nan)), "hold no number"),
        (_log(ok[:, :3], NAMES[:3]), "has no accelerometer"),
        (_log(ok[:1]), "has 1 IMU sample"),
        (_log(np.zeros_like(ok)), "all IMU readings are zero"),
        (_log(t=READINGS.t_s[::-1]), "line 3: t_s goes back"),
    ):
        with pytest.raises(BadInputError, match=words):
            pose_log(log)


def test_a_stuck_axis_is_named() -> None:
    values = READINGS.values.copy()
    values[:, 4] = 0.25
    with pytest.raises(BadInputError, match=r"ay is stuck at 0\.25"):
        pose_log(_log(values))
    values = READINGS.values.copy()
    values[:, 5] = 0.5
    with pytest.raises(BadInputError, match=r"az is stuck at 0\.5.*give --planar"):
        pose_log(_log(values))
    assert pose_log(_log(values), planar=True).axes == ("gz", "ax", "ay")


def test_cells_that_say_nan_are_missing_rows(tmp_path: Path) -> None:
    lines = [
        f"{t:.6f}," + ",".join(f"{v:.9g}" for v in row)
        for t, row in zip(READINGS.t_s, READINGS.values, strict=True)
    ]
    lines[500] = lines[500].rsplit(",", 1)[0] + ",nan"
    path = tmp_path / "log.csv"
    path.write_text("t_s," + ",".join(NAMES) + "\n" + "\n".join(lines) + "\n")
    log, said = read_pose_log(path)
    assert len(log.t_s) == len(READINGS.t_s) - 1
    assert "1 cells say nan or inf" in said[0]


@pytest.mark.parametrize("ending", ["mat", "mat.gz"])
def test_files_of_imu_tk(tmp_path: Path, ending: str) -> None:
    a = _file(tmp_path / f"acc.{ending}", COUNTS.t_s, COUNTS.values[:, 3:])
    w = _file(tmp_path / f"gyro.{ending}", COUNTS.t_s, COUNTS.values[:, :3])
    log, said = read_pose_files(a, w, "counts", "counts")
    assert said == []
    assert log.axes == AXES
    assert log.values == pytest.approx(COUNTS.values, rel=1e-8)
    assert read_pose_files(a, None, "counts")[0].axes == AXES[3:]


def test_other_times_of_the_gyroscope_are_bridged(tmp_path: Path) -> None:
    a = _file(tmp_path / "acc.mat", READINGS.t_s, READINGS.values[:, 3:])
    t = READINGS.t_s[:-1] + 0.005
    w = _file(tmp_path / "gyro.mat", t, np.column_stack([np.sin(t), t / 100.0, np.cos(t)]))
    log, said = read_pose_files(a, w)
    assert "put on those by straight lines" in said[0]
    assert log.values[:, 0] == pytest.approx(np.sin(log.t_s), abs=1e-4)
    late = _file(tmp_path / "late.mat", t + 500.0, np.column_stack([t, t, t]))
    with pytest.raises(BadInputError, match="expected the times of"):
        read_pose_files(a, late)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 1 2 3\n0.1 1 2\n", "line 2: is '0.1 1 2', expected four numbers"),
        ("0 1 2 3\n0.1 1 x 2\n", "line 2"),
        ("0.1 1 2 3\n0 1 2 3\n", "line 2: the time goes back"),
        ("# nothing\n", "has no readings"),
    ],
)
def test_files_that_are_no_readings(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "acc.mat"
    path.write_text(text)
    with pytest.raises(BadInputError, match=words):
        read_pose_files(path)


def test_a_broken_gzip_is_said(tmp_path: Path) -> None:
    path = tmp_path / "acc.mat.gz"
    path.write_bytes(gzip.compress(b"0 1 2 3\n" * 100)[:30])
    with pytest.raises(BadInputError, match="is not a gzip file that can be read"):
        read_pose_files(path)

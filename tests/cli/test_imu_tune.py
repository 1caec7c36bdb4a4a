"""`calib imu tune` from the command line: what it writes and says, and how it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armlogs import Arm, swung, write

from calib.core.rig import read_rig

Run = Callable[..., object]


def test_table_section_and_json(calib: Run, tmp_path: Path) -> None:
    log, rig = write(tmp_path / "arm.csv", swung(0)), tmp_path / "rig.yaml"
    said = calib("imu", "tune", log, "--rig", rig)
    assert said.code == 0
    for words in ("recommended: tuned", "held-out error, deg", "poles", "judged by truth", "verdict: ok"):
        assert words in said.out
    section = read_rig(rig).orientation_filter
    assert section is not None
    assert section.recommended_by == "reference"
    tuned, three = section.candidates["tuned"], section.candidates["3/3"]
    assert (section.Kp_per_s, section.Ki_per_s2) == (tuned.Kp_per_s, tuned.Ki_per_s2)
    assert tuned.rmse_deg is not None
    assert three.rmse_deg is not None
    assert tuned.rmse_deg < 0.6 * three.rmse_deg
    assert tuned.interval_deg is not None
    assert tuned.interval_deg[0] < tuned.rmse_deg < tuned.interval_deg[1]
    assert set(read_rig(rig).provenance.inputs["orientation_filter"]) == {"arm.csv"}
    other = tmp_path / "other.yaml"
    document = json.loads(calib("imu", "tune", log, "--rig", other, "--json").out)
    assert (document["schema"], document["verb"]) == (1, "imu tune")
    assert document["orientation_filter"]["reasons"] == section.reasons
    assert other.read_bytes() == rig.read_bytes()


def test_without_a_reference_and_with_figures(calib: Run, tmp_path: Path) -> None:
    log = write(tmp_path / "arm.csv", swung(1), truth=False)
    folder = tmp_path / "figures"
    said = calib("imu", "tune", log, "--rig", tmp_path / "rig.yaml", "--figures", folder)
    assert said.code == 0
    assert "recommended: tuned" in said.out
    assert "judged by their own smoothed angle" in said.out
    assert sorted(path.name for path in folder.iterdir()) == ["tune_errors.png", "tune_gains.png"]


def test_a_short_log_keeps_three_three(calib: Run, tmp_path: Path) -> None:
    log, rig = write(tmp_path / "arm.csv", swung(1, duration_s=5.0), truth=False), tmp_path / "rig.yaml"
    said = calib("imu", "tune", log, "--rig", rig)
    assert said.code == 1
    assert "expected at least 8 s: 3/3 is kept" in said.out
    section = read_rig(rig).orientation_filter
    assert section is not None
    assert (section.Kp_per_s, section.Ki_per_s2, section.verdict) == (3.0, 3.0, "poor")


def test_the_cameras_angle_of_a_simulated_rig(calib: Run, rig: Path, tmp_path: Path) -> None:
    log = tmp_path / "o.csv"
    assert calib("simulate", "orientation", "-o", log, "--rig", rig, "--duration", "15s").code == 0
    said = calib("imu", "tune", log, "--rig", rig, "--reference", "camera")
    assert said.code == 0
    assert "judged by camera" in said.out
    section = read_rig(rig).orientation_filter
    assert section is not None
    lag = section.logs[0].reference_lag_s
    assert lag is not None
    assert 0.01 < lag < 0.05
    assert {"camera", "plane", "o.csv"} <= set(read_rig(rig).provenance.inputs["orientation_filter"])


@pytest.fixture
def arm() -> Arm:
    return swung(0)


def _refused(calib: Run, path: Path, *words: str) -> str:
    ended = calib("imu", "tune", path, "--rig", path.parent / "rig.yaml", *words)
    assert ended.code == 3
    assert ended.out == ""
    assert not (path.parent / "rig.yaml").exists()
    return ended.sentence


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,u_px\n0,1\n1,2\n", "log.csv: has no IMU"),
        ("t_s,ax_mps2,ay_mps2\n0,9,1\n1,9,2\n", "has no readings in gz_radps"),
        ("t_s,ax_mps2,ay_mps2,gz_radps\n0,9.8,0,0\n", "log.csv: has 1 IMU sample"),
        (
            "t_s,ax_mps2,ay_mps2,gz_radps\n" + "".join(f"{i},0,0,0\n" for i in range(99)),
            "log.csv: all IMU readings are zero",
        ),
        (
            "t_s,ax_mps2,ay_mps2,gz_radps\n" + "".join(f"{i},nan,nan,nan\n" for i in range(99)),
            "log.csv: has no readings in",
        ),
        ("t_s,ax_mps2,ay_mps2,gz_radps\n1,9.8,0,0.1\n0,9.7,0.1,0\n", "log.csv, line 3: t_s goes back"),
    ],
)
def test_what_is_no_log_of_an_imu(calib: Run, tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert words in _refused(calib, path)


def test_a_stuck_axis(calib: Run, arm: Arm, tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", replace(arm, gz=np.full(len(arm.t_s), 0.25)))
    assert "gz never changes, it is stuck at 0.25" in _refused(calib, path)


def test_units_are_refused_and_then_converted(calib: Run, arm: Arm, tmp_path: Path) -> None:
    scaled = replace(arm, ax=arm.ax / 9.80665, ay=arm.ay / 9.80665, gz=np.degrees(arm.gz))
    path = write(tmp_path / "log.csv", scaled)
    assert "give --acc-unit g" in _refused(calib, path)
    assert "give --gyro-unit deg/s" in _refused(calib, path, "--acc-unit", "g")
    rig = tmp_path / "converted.yaml"
    units = ("--acc-unit", "g", "--gyro-unit", "deg/s")
    assert calib("imu", "tune", path, "--rig", rig, *units).code == 0
    plain = tmp_path / "plain.yaml"
    assert calib("imu", "tune", write(tmp_path / "si.csv", arm), "--rig", plain).code == 0
    one, other = read_rig(rig).orientation_filter, read_rig(plain).orientation_filter
    assert one is not None
    assert other is not None
    assert one.Kp_per_s == pytest.approx(other.Kp_per_s, rel=1e-3)


def test_nan_cells_count_as_missing(calib: Run, arm: Arm, tmp_path: Path) -> None:
    gz = arm.gz.copy()
    gz[100:110] = np.nan
    path = write(tmp_path / "log.csv", replace(arm, gz=gz))
    ended = calib("imu", "tune", path, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "10 cells say nan or inf; their rows count as missing" in ended.err
    assert "10 samples missing in 1 gaps" in ended.err


def test_duplicates_a_short_gap_and_an_hour(calib: Run, arm: Arm, tmp_path: Path) -> None:
    rows = np.arange(3000)
    rows = np.sort(np.concatenate([np.delete(rows, [700, 701]), [200, 500, 900, 1300, 1700, 2500]]))
    t = arm.t_s.copy()
    t[1500:] += 3600.0
    path = write(tmp_path / "log.csv", replace(arm, t_s=t), rows=rows)
    ended = calib("imu", "tune", path, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "6 rows (0.20%) repeat the one before; dropped" in ended.err
    assert "2 samples missing in 1 gaps, the longest of 0.03 s at 6.99 s; filled" in ended.err
    assert "split at a gap of 3600 s after 14.99 s" in ended.err
    assert "30 s in 2 piece(s)" in ended.out
    assert "recommended: tuned" in ended.out


def test_repeated_stamps(calib: Run, arm: Arm, tmp_path: Path) -> None:
    t = arm.t_s.copy()
    late = np.array([300, 800, 1300, 1800, 2300, 2800])
    t[late] = t[late - 1]
    path = write(tmp_path / "log.csv", replace(arm, t_s=t))
    ended = calib("imu", "tune", path, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "6 samples (0.20%) bear the stamp of the one before; put on an even grid" in ended.err
    section = read_rig(tmp_path / "rig.yaml").orientation_filter
    assert section is not None
    assert (section.logs[0].samples, section.logs[0].missing) == (3000, 0)


def test_logs_of_different_rates(calib: Run, arm: Arm, tmp_path: Path) -> None:
    one = write(tmp_path / "one.csv", arm)
    two = write(tmp_path / "two.csv", arm, rows=np.arange(0, 3000, 2))
    ended = calib("imu", "tune", one, two, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert "is sampled at 50 Hz, expected 100 Hz as in one.csv" in ended.sentence

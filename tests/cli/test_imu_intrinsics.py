"""`calib imu intrinsics` from the command line: what it writes and says, and how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from imu_poses import AXES, G, PoseLog, Sensor, in_counts, pose_log, sphere_poses, tilts
from outside import outside

from calib.cli.imu import intrinsics
from calib.core.errors import BadInputError, UsageError
from calib.core.rig import read_rig

HEAD = "t_s," + ",".join(f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES) + "\n"


def _write(path: Path, log: PoseLog) -> Path:
    rows = np.column_stack([log.t_s, log.values]).tolist()
    path.write_text(HEAD + "".join(",".join(f"{cell:.9g}" for cell in row) + "\n" for row in rows))
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write(tmp_path_factory.mktemp("poses") / "poses.csv", pose_log(sphere_poses(24), Sensor()))


def test_section_and_table(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("geometry: {workspace_m: [-0.06, 0.04, 0.06, 0.11]}\n")
    intrinsics(log, gravity=G, rig=rig)
    out = capsys.readouterr().out
    for words in (
        "accel bias, m/s^2",
        "gyro scale, ratio",
        "accel zx",
        "in 24 poses more than 5 degrees apart",
        "23 turns miss",
        "verdict: ok",
    ):
        assert words in out
    after = read_rig(rig)
    assert after.geometry is not None
    section = after.imu_intrinsics
    assert section is not None
    assert section.accel.scale == pytest.approx([1.012, 0.991, 1.006], abs=3e-4)
    assert section.gyro is not None
    assert section.gyro.scale == pytest.approx([1.01, 0.985, 0.993], abs=1e-3)
    assert set(after.provenance.inputs["imu_intrinsics"]) == {"poses.csv"}


def test_one_json_document_and_the_same_bytes(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.yaml", "b.yaml"):
        intrinsics(log, gravity=G, rig=tmp_path / name, as_json=True)
    out = capsys.readouterr().out
    document = json.loads(out[: out.index("\n}\n") + 2])
    assert (document["schema"], document["verb"]) == (1, "imu intrinsics")
    assert document["imu_intrinsics"]["verdict"] == "ok"
    assert len(document["imu_intrinsics"]["accel"]["sigma"]["scale"]) == 3
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()


def test_one_pose_is_unidentifiable_but_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _write(tmp_path / "log.csv", pose_log(sphere_poses(1), Sensor()))
    with pytest.raises(typer.Exit) as ending:
        intrinsics(path, rig=tmp_path / "rig.yaml")
    assert ending.value.exit_code == 1
    out = capsys.readouterr().out
    assert "verdict: unidentifiable" in out
    assert "put it down in 24 poses or more" in out
    section = read_rig(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.accel.scale == [None, None, None]


def test_a_plane_with_its_short_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = _write(tmp_path / "good.csv", pose_log(tilts(np.radians(np.arange(0, 720, 45))), Sensor()))
    intrinsics(good, gravity=G, planar=True, rig=tmp_path / "rig.yaml")
    section = read_rig(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.planar
    assert section.accel.scale[:2] == pytest.approx([1.012, 0.991], abs=5e-4)
    arc = _write(tmp_path / "arc.csv", pose_log(tilts(np.radians([-30, 0, 30, -20, 20])), Sensor()))
    with pytest.raises(typer.Exit):
        intrinsics(arc, gravity=G, planar=True, rig=tmp_path / "rig.yaml")
    assert "tilt about z by 45 degrees at a time" in capsys.readouterr().out


def test_units_are_refused_and_then_converted(tmp_path: Path) -> None:
    log = pose_log(sphere_poses(24), Sensor())
    scale = np.array([180.0 / np.pi] * 3 + [1.0 / 9.80665] * 3)
    path = _write(tmp_path / "log.csv", PoseLog("log", AXES, log.t_s, log.values * scale))
    rig = tmp_path / "rig.yaml"
    with pytest.raises(BadInputError, match="give --acc-unit g"):
        intrinsics(path, rig=rig)
    with pytest.raises(BadInputError, match="give --gyro-unit deg/s"):
        intrinsics(path, acc_unit="g", rig=rig)
    assert not rig.exists()
    intrinsics(path, gravity=G, acc_unit="g", gyro_unit="deg/s", rig=rig)
    section = read_rig(rig).imu_intrinsics
    assert section is not None
    assert section.accel.scale == pytest.approx([1.012, 0.991, 1.006], abs=3e-4)


def test_counts_gaps_and_repeated_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = pose_log(sphere_poses(30), in_counts(Sensor()), counts=True)
    t = log.t_s.copy()
    t[6350:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(len(t)), [900, 901]), np.arange(100, 700, 20)]))
    path = _write(tmp_path / "log.csv", PoseLog("log", AXES, t[rows], log.values[rows]))
    intrinsics(path, gravity=G, acc_unit="counts", gyro_unit="counts", rig=tmp_path / "rig.yaml")
    out = capsys.readouterr().out
    assert "accel scale, counts per m/s^2" in out
    assert "2 samples missing in 1 gap(s), the longest 30 ms after 8.99 s" in out
    assert "split at a gap of 3600 s after 63.49 s" in out
    assert "30 rows (0.18%) repeat the one before; dropped" in out
    section = read_rig(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.gyro is not None
    assert section.gyro.scale == pytest.approx((4800.0 * Sensor().gyro_scale).tolist(), rel=1e-3)


def test_words_that_do_not_fit_together(log: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    for wrong in ({}, {"log": log, "accel": log}, {"log": log, "gyro": log}, {"log": log, "gravity": 981.0}):
        with pytest.raises(UsageError):
            intrinsics(**wrong, rig=rig)
    assert not rig.exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,u_px\n0,1\n1,2\n", "log.csv: has no IMU"),
        (HEAD + "0,0,0,0,0,0,9.8\n", "log.csv: has 1 IMU sample"),
        (HEAD + "".join(f"{i},0,0,0,0,0,0\n" for i in range(200)), "log.csv: all IMU readings are zero"),
        (HEAD + "".join(f"{i},nan,nan,nan,nan,nan,nan\n" for i in range(200)), "hold no number"),
        (HEAD + "".join(f"{i},0,0,0.{i},9.{i},1,1.{i}\n" for i in range(9)), "gx is stuck at 0"),
        (HEAD + "1,0,0,0,9,1,1\n0,0.1,0,0,9,1,1\n", "log.csv, line 3: t_s goes back"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    program = "from calib.cli.main import main; main()"
    command = [sys.executable, "-c", program, "imu", "intrinsics", "log.csv"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stdout == ""
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "rig.yaml").exists()


def test_the_recording_of_imu_tk_with_figures(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = outside(shared_data / "imu_tk")
    intrinsics(
        accel=folder / "xsens_acc.mat.gz",
        gyro=folder / "xsens_gyro.mat.gz",
        gravity=9.81744,
        acc_unit="counts",
        gyro_unit="counts",
        rig=tmp_path / "rig.yaml",
        figures=tmp_path / "figures",
    )
    out = capsys.readouterr().out
    assert "verdict: ok" in out
    assert "the gyroscope's bias follows the pose" in out
    section = read_rig(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.accel.scale == pytest.approx([414.42, 412.05, 414.61], rel=1e-3)
    assert section.accel.rms_mps2 is not None
    assert section.accel.rms_mps2 <= 0.00165
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"imu_poses.png", "imu_residuals.png"}

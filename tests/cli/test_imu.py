"""`calib imu static, intrinsics, drift, tune` from the command line: what they write, say and refuse."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from armlogs import Arm, swung, write
from imu_poses import G, Sensor, pose_log, sphere_poses, tilts
from outside import outside

from calib.cli.verbs import verb
from calib.core.rig import Rig
from calib.io.logs import Log, log_text, read_log, write_log
from calib.solve.clock import time_axis
from calib.stages import stage
from calib.stages.imu.tracks import missing
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log

from .conftest import Run


def _called(name: str) -> Callable[..., None]:
    """A verb that may be called with some of its options."""
    command = verb(stage(name))
    defaults = {one.name: one.default for one in inspect.signature(command).parameters.values()}
    return lambda sources=None, **values: command(**{**defaults, "sources": sources, **values})


static, intrinsics = _called("imu static"), _called("imu intrinsics")
ZEROS = "".join(f"{i / 100},0,0,0,0,0,0\n" for i in range(200))
BLANKS = ZEROS.replace(",0", ",nan")
HEAD = "t_s,gx_radps,gy_radps,gz_radps,ax_mps2,ay_mps2,az_mps2\n"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three logs of the simulated rig at rest."""
    folder = tmp_path_factory.mktemp("logs")
    plan, paths = make_scenario("static"), []
    for seed in range(3):
        path = folder / f"static{seed}.csv"
        path.write_text(log_text(run_log(run_scenario(plan, SimulatedRig(), seed, "truth", 20.0))))
        paths.append(path)
    return paths


def _write(path: Path, values: np.ndarray, t_s: np.ndarray | None = None) -> Path:
    t = 0.01 * np.arange(len(values)) if t_s is None else t_s
    rows = np.column_stack([t, values]).tolist()
    path.write_text(HEAD + "".join(",".join(f"{cell:.9g}" for cell in row) + "\n" for row in rows))
    return path


def _at_rest(n: int = 3000) -> np.ndarray:
    noise = np.array([2e-3] * 3 + [0.02] * 3)
    return noise * np.random.default_rng(0).normal(size=(n, 6)) + [0.004, -0.003, 0.006, 9.8, 0.2, 0.1]


def test_of_several_logs_one_that_cannot_be_used_is_left_out(
    calib: Run, logs: list[Path], tmp_path: Path
) -> None:
    """It is named, and more than a fifth of the logs make the result poor."""
    rig, spoilt, moved = tmp_path / "rig.yaml", tmp_path / "spoilt.csv", tmp_path / "moved.csv"
    lines = logs[0].read_text().splitlines()
    spoilt.write_text("\n".join([*lines[:300], *("abc" + line for line in lines[300:])]) + "\n")
    sound = [_write(tmp_path / f"rest{k}.csv", _at_rest() + 1e-4 * k) for k in range(4)]
    said = "1 of 5 logs cannot be used and is left out: spoilt.csv, line 301: t_s is 'abc"
    ended = calib("imu", "static", sound[0], spoilt, *sound[1:], "--rig", rig)
    assert ended.code == 0
    assert f"(remark) {said}" in ended.out
    section = Rig.load(rig).imu
    assert section is not None
    assert [log.name for log in section.logs] == [path.name for path in sound]
    assert "spoilt.csv" not in section.inputs
    assert str(tmp_path) not in rig.read_text()
    # A copy would count twice.
    copies = [tmp_path / "copy.csv", tmp_path / "copy.parquet"]
    copies[0].write_bytes(sound[0].read_bytes())
    Log.load(sound[1]).save(copies[1])
    ended = calib("imu", "static", *sound, *copies, "--rig", rig)
    assert ended.code == 0
    assert "(remark) 2 of 6 logs cannot be used and are left out: copy.csv: is the same reco" in ended.out
    assert "copy.parquet: is the same recording as rest1.csv" in ended.out
    # What is found as the log is worked on, too.
    moved.write_text(HEAD + "".join(f"{k / 100},{k % 7},{k % 5},1,9,{k % 3},1\n" for k in range(2000)))
    ended = calib("imu", "static", sound[0], moved, "--rig", rig)
    assert ended.code == 1
    assert "- 1 of 2 logs cannot be used and is left out: moved.csv: is never at rest" in ended.out
    # A name that was mistyped, and where most cannot be used.
    gone = tmp_path / "gone.csv"
    assert "gone.csv: cannot be read" in calib("imu", "static", *sound, gone, "--rig", rig).sentence
    assert "spoilt.csv, line 301" in calib("imu", "static", spoilt, moved, sound[0], "--rig", rig).sentence


def test_section_table_and_kalibr(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, exported = tmp_path / "rig.yaml", tmp_path / "imu.yaml"
    rig.write_text("geometry: {workspace_m: [-0.06, 0.04, 0.06, 0.11]}\n")
    static(logs, output=exported, rig=rig)
    shown = capsys.readouterr()
    assert "verdict: ok" in shown.out
    assert "drift of the angle" in shown.out
    after = Rig.load(rig)
    assert after.geometry is not None
    section = after.imu
    assert section is not None
    assert section.gyro_bias_radps[2] == pytest.approx(0.006, abs=5e-4)
    assert [log.name for log in section.logs] == ["static0.csv", "static1.csv", "static2.csv"]
    slopes = []
    for path in logs:
        log = read_log(path)
        rows = log.sampled("onchip_phi_rad")
        t_s = time_axis(log.t_s[rows]).t_s
        slopes.append(np.degrees(np.polyfit(t_s, log.columns["onchip_phi_rad"][rows], 1)[0]))
    assert section.drift["onchip"].mean_degps == pytest.approx(np.mean(slopes), rel=1e-6)
    assert section.drift["onchip"].spread_degps == pytest.approx(np.std(slopes, ddof=1), rel=1e-6)
    assert set(after.provenance.inputs["imu"]) == {path.name for path in logs}
    assert yaml.safe_load(exported.read_text())["update_rate"] == pytest.approx(100.0, rel=1e-4)


def test_motion_is_poor_but_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = _at_rest()
    values[1000:1200, 2] += 0.5 * np.sin(0.1 * np.arange(200))
    with pytest.raises(typer.Exit) as ending:
        static([_write(tmp_path / "log.csv", values)], rig=tmp_path / "rig.yaml")
    assert ending.value.exit_code == 1
    assert "log.csv: moves from 10.0 to 12.0 s, seen most in gz" in capsys.readouterr().out
    section = Rig.load(tmp_path / "rig.yaml").imu
    assert section is not None
    assert section.verdict.word == "poor"
    assert section.logs[0].moves_s == [[pytest.approx(10.0, abs=0.05), pytest.approx(12.0, abs=0.05)]]


@pytest.mark.parametrize("verb_", ["static", "intrinsics", "drift", "tune"])
def test_units_are_refused_and_then_converted(calib: Run, tmp_path: Path, verb_: str) -> None:
    """And the answer is that of the same log in SI units."""
    values = pose_log(sphere_poses(24), Sensor()).values if verb_ == "intrinsics" else _at_rest()
    if verb_ == "tune":
        arm = swung(0)
        values[:, 2:5] = np.stack([arm.gz, arm.ax, arm.ay], axis=1)
    in_units = values * ([180.0 / np.pi] * 3 + [1.0 / 9.80665] * 3)
    log, rig = _write(tmp_path / "log.csv", in_units), tmp_path / "rig.yaml"
    words = ("imu", verb_, log, "--rig", rig, "--json", *(["--no-peers"] if verb_ == "drift" else []))
    ended = calib(*words)
    assert ended.code == 3 and "so it is in g" in ended.sentence and "give --acc-unit g" in ended.sentence
    ended = calib(*words, "--acc-unit", "g")
    assert ended.code == 3 and "give --gyro-unit deg/s" in ended.sentence
    assert not rig.exists()
    converted = calib(*words, "--acc-unit", "g", "--gyro-unit", "deg/s")
    _write(log, values)
    numbers, wanted = (
        [float(word) for word in re.findall(r"-?\d+\.\d+(?:e[-+]\d+)?", out)]
        for out in (converted.out, calib(*words).out)
    )
    assert converted.code == 0 and len(numbers) > 20
    assert numbers == pytest.approx(wanted, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("verb_", ["static", "intrinsics", "drift"])
def test_bad_input_is_one_sentence(calib: Run, tmp_path: Path, verb_: str) -> None:
    refused = [
        ("t_s,u_px\n0,1\n1,2\n", "log.csv: has no IMU"),
        (HEAD + ZEROS, "log.csv: all IMU readings are zero"),
        (HEAD + BLANKS, "hold no number"),
        (HEAD + "1,0,0,0,9,1,1\n0,0.1,0,0,9,1,1\n", "log.csv, line 3: t_s goes back"),
    ]
    if verb_ == "static":
        refused.append((HEAD + "0,0,0,0,0,0,9.8\n", "log.csv: has 1 IMU sample"))
    if verb_ == "drift":
        refused.append((HEAD + "0,0,0,0,9.8,0,0\n0.01,0,0,0.01,9.81,0.1,0\n", "log.csv: is 0.02 s long"))
    for text, words in refused:
        (tmp_path / "log.csv").write_text(text)
        ended = calib("imu", verb_, "log.csv", cwd=tmp_path)
        assert (ended.code, ended.out) == (3, "")
        assert words in ended.sentence
        assert len(ended.err.splitlines()) == 1
        assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.slow
def test_figures_are_drawn(logs: list[Path], tmp_path: Path) -> None:
    static(logs[:1], figures=tmp_path / "figures", rig=tmp_path / "rig.yaml")
    found = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert found == ["imu_allan.png", "imu_drift.png", "imu_static_1.png"]


def test_a_recording_of_a_real_sensor(shared_data: Path, tmp_path: Path) -> None:
    path = outside(shared_data / "imufusion" / "sensor_data.csv")
    table = np.genfromtxt(path, delimiter=",", skip_header=1)[:, :7]
    rest = table[table[:, 0] - table[0, 0] < 11.0]
    log = _write(tmp_path / "log.csv", rest[:, 1:], rest[:, 0])
    static([log], acc_unit="g", gyro_unit="deg/s", rig=tmp_path / "rig.yaml")
    section = Rig.load(tmp_path / "rig.yaml").imu
    assert section is not None
    # A sensor of this kind has about 0.01 deg/s/sqrt(Hz).
    densities = np.degrees([value for value in section.gyro_noise_radps_per_sqrt_Hz if value is not None])
    assert np.all((densities > 0.003) & (densities < 0.04))
    assert section.rate_hz == pytest.approx(100.0, rel=1e-3)


def test_a_plane_with_its_short_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = _write(tmp_path / "good.csv", pose_log(tilts(np.radians(np.arange(0, 720, 45))), Sensor()).values)
    intrinsics(good, gravity=G, planar=True, rig=tmp_path / "rig.yaml")
    section = Rig.load(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.planar
    assert section.accel.scale[:2] == pytest.approx([1.012, 0.991], abs=5e-4)
    arc = _write(tmp_path / "arc.csv", pose_log(tilts(np.radians([-30, 0, 30, -20, 20])), Sensor()).values)
    with pytest.raises(typer.Exit):
        intrinsics(arc, gravity=G, planar=True, rig=tmp_path / "rig.yaml")
    assert "tilt about z by 45 degrees at a time" in capsys.readouterr().out


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
    section = Rig.load(tmp_path / "rig.yaml").imu_intrinsics
    assert section is not None
    assert section.accel.scale == pytest.approx([414.42, 412.05, 414.61], rel=1e-3)
    assert section.accel.rms_mps2 is not None
    assert section.accel.rms_mps2 <= 0.00165
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"imu_poses.png", "imu_residuals.png"}


@pytest.fixture(scope="module")
def moves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the simulated rig in motion."""
    path = tmp_path_factory.mktemp("moves") / "moves.csv"
    path.write_text(log_text(run_log(run_scenario(make_scenario("chirp"), SimulatedRig(), 0, "truth", 20.0))))
    return path


def test_filters_of_others_run_on_the_same_log(calib: Run, moves: Path, tmp_path: Path) -> None:
    ended = calib("imu", "drift", moves, "--json", "--rig", tmp_path / "rig.yaml")
    methods = json.loads(ended.out)["drift"]["logs"][0]["methods"]
    skipped = json.loads(ended.out)["drift"]["logs"][0]["skipped"]
    for name in ("Mahony", "Madgwick", "imufusion", "VQF"):
        if missing(name):
            assert any(sentence.startswith(f"{name}: the package") for sentence in skipped)
        else:
            assert methods[name]["rmse_deg"] < methods["accelerometer alone"]["rmse_deg"]
            assert f"running {name}" in ended.err


@pytest.mark.slow
def test_figures_are_drawn_in_imu_drift(calib: Run, logs: list[Path], moves: Path, tmp_path: Path) -> None:
    words = ("imu", "drift", *logs[:2], moves, "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert calib(*words, "--figures", tmp_path / "figures").code == 0
    found = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert found == ["drift_angles.png", "drift_motion_3.png", "drift_slopes.png"]


def test_a_log_that_never_rests_and_has_no_truth_is_drawn(
    calib: Run, logs: list[Path], moves: Path, tmp_path: Path
) -> None:
    """It shows no slope, as logs of real rigs in motion do."""
    log = read_log(moves)
    bare = replace(log, columns={n: v for n, v in log.columns.items() if not n.startswith("true_")})
    write_log(tmp_path / "log.csv", bare)
    both = logs[0], tmp_path / "log.csv"
    words = ("imu", "drift", *both, "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert calib(*words, "--figures", tmp_path / "figures").code == 0
    assert (tmp_path / "figures" / "drift_slopes.png").exists()


def test_a_gyroscope_that_sticks_is_no_ok(calib: Run, moves: Path, tmp_path: Path) -> None:
    head, *rows = moves.read_text().splitlines()
    gz = head.split(",").index("gz_radps")
    for row, line in enumerate(rows):
        cells = line.split(",")
        if cells[gz] and float(cells[0]) > 8.0:
            cells[gz] = "0.0125"
            rows[row] = ",".join(cells)
    log = tmp_path / "log.csv"
    log.write_text("\n".join([head, *rows]) + "\n")
    ended = calib("imu", "drift", log, "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 1
    assert (
        "log.csv: gz_radps is stuck at 0.0125 from 8.0 to 20.0 s, while other axes go on changing"
        in ended.out
    )


@pytest.mark.parametrize("verb_", ["static", "drift"])
def test_repeats_and_gaps_are_handled_and_reported(calib: Run, tmp_path: Path, verb_: str) -> None:
    t = 0.01 * np.arange(3000)
    t[2000:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(3000), [1000]), np.arange(100, 700, 100)]))
    values = _at_rest()[rows]
    if verb_ == "drift":
        values[:, 0] = 0.002
    log = _write(tmp_path / "log.csv", values, t[rows])
    ended = calib("imu", verb_, log, "--rig", tmp_path / "rig.yaml", *(["--no-peers"] * (verb_ == "drift")))
    assert "1 sample missing in 1 gap, the longest 20 ms after 9.99 s" in ended.out
    assert "split at a gap of 3600 s after 19.99 s" in ended.out
    assert "6 rows (0.20%) repeat the one before; dropped" in ended.out
    assert ended.code == 0
    if verb_ == "drift":
        assert "(remark) log.csv: gx_radps never changes, it is stuck at 0.002; left out" in ended.out
        # The gyroscope alone is begun anew after the hour.
        line = next(line for line in ended.out.splitlines() if "gyroscope alone" in line)
        assert float(line.split()[3]) == pytest.approx(-0.34, abs=0.03)


def test_a_recorder_that_writes_each_row_twice_loses_none(calib: Run, tmp_path: Path) -> None:
    rows = np.repeat(np.arange(3000), 2)
    log = _write(tmp_path / "log.csv", _at_rest()[rows], 0.01 * rows)
    ended = calib("imu", "static", log, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "log.csv: 3000 rows (50.00%) repeat the one before; dropped" in ended.out
    some = np.sort(np.concatenate([np.arange(3000), np.arange(0, 3000, 4)]))
    log = _write(tmp_path / "some.csv", _at_rest()[some], 0.01 * some)
    assert calib("imu", "static", log, "--rig", tmp_path / "rig.yaml").code == 1


@pytest.mark.parametrize("kept", [0.3, 0.5])
def test_half_of_the_samples_missing_is_poor_as_a_tenth_is(calib: Run, tmp_path: Path, kept: float) -> None:
    """No steady rate is seen, so gaps were not counted, and noise 1.6 times the true one was ok."""
    rows = np.flatnonzero(np.random.default_rng(2).random(3000) < kept)
    log = _write(tmp_path / "log.csv", _at_rest()[rows], 0.01 * rows)
    ended = calib("imu", "static", log, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 1
    assert "of the samples are missing" in ended.out
    uneven = np.sort(np.random.default_rng(3).uniform(0.0, 30.0, 3000))
    log = _write(tmp_path / "uneven.csv", _at_rest(), uneven)
    assert "samples are missing" not in calib("imu", "static", log, "--rig", tmp_path / "rig.yaml").out


def test_without_a_reference_and_with_figures(calib: Run, tmp_path: Path) -> None:
    log = write(tmp_path / "arm.csv", swung(1), truth=False)
    folder = tmp_path / "figures"
    said = calib("imu", "tune", log, "--rig", tmp_path / "rig.yaml", "--figures", folder)
    assert said.code == 0
    assert re.search(r"recommended +levelling", said.out)
    assert "judged by their own smoothed angle" in said.out
    assert sorted(path.name for path in folder.iterdir()) == ["tune_errors.png", "tune_gains.png"]


def test_the_cameras_angle_of_a_simulated_rig(calib: Run, rig: Path, tmp_path: Path) -> None:
    log = tmp_path / "o.csv"
    assert calib("simulate", "orientation", "-o", log, "--rig", rig, "--duration", "15s").code == 0
    said = calib("imu", "tune", log, "--rig", rig, "--reference", "camera")
    assert said.code == 0
    assert "judged by" in said.out and "camera" in said.out
    section = Rig.load(rig).orientation_filter
    assert section is not None
    lag = section.logs[0].reference_lag_s
    assert lag is not None
    assert 0.01 < lag < 0.05
    assert {"camera", "plane", "o.csv"} <= set(Rig.load(rig).provenance.inputs["orientation_filter"])


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
        ("t_s,ax_mps2,ay_mps2,gz_radps\n0,9.8,0,0\n", "log.csv: has 1 IMU sample"),
        ("t_s,ax_mps2,ay_mps2,gz_radps\n1,9.8,0,0.1\n0,9.7,0.1,0\n", "log.csv, line 3: t_s goes back"),
    ],
)
def test_what_is_no_log_of_an_imu(calib: Run, tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert words in _refused(calib, path)


def test_duplicates_a_short_gap_and_an_hour(calib: Run, arm: Arm, tmp_path: Path) -> None:
    rows = np.arange(3000)
    rows = np.sort(np.concatenate([np.delete(rows, [700, 701]), [200, 500, 900, 1300, 1700, 2500]]))
    t = arm.t_s.copy()
    t[1500:] += 3600.0
    path = write(tmp_path / "log.csv", replace(arm, t_s=t), rows=rows)
    ended = calib("imu", "tune", path, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "6 rows (0.20%) repeat the one before; dropped" in ended.err
    assert "2 samples missing in 1 gap, the longest 30 ms after 6.99 s; filled" in ended.err
    assert "split at a gap of 3600 s after 14.99 s" in ended.err
    section = Rig.load(tmp_path / "rig.yaml").orientation_filter
    assert section is not None and section.recommended == "levelling"
    assert section.logs[0].pieces == 2 and section.logs[0].duration_s == pytest.approx(30.0, abs=0.1)


def test_a_truth_in_the_log_changes_no_gain(calib: Run, tmp_path: Path) -> None:
    log = run_log(run_scenario(make_scenario("ellipse"), SimulatedRig(), 4, "truth", 12.0))
    kept = {name: values for name, values in log.columns.items() if not name.startswith("true_")}
    found = []
    for name, columns in (("with", log.columns), ("without", kept)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text(log_text(replace(log, columns=columns)))
        words = ("--json", "--rig", tmp_path / name / "rig.yaml")
        found.append(json.loads(calib("imu", "tune", tmp_path / name / "log.csv", *words).out))
    assert found[0] == found[1]

"""`calib imu static` from the command line: what it writes and says, and how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from outside import outside

from calib.cli.imu import static
from calib.core.errors import BadInputError
from calib.core.rig import read_rig
from calib.io.logs import log_text, read_log
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

HEAD = "t_s,gx_radps,gy_radps,gz_radps,ax_mps2,ay_mps2,az_mps2\n"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three logs of the simulated rig at rest."""
    folder = tmp_path_factory.mktemp("logs")
    plan, paths = make_scenario("static"), []
    for seed in range(3):
        path = folder / f"static{seed}.csv"
        path.write_text(log_text(log_of(run_scenario(plan, SimulatedRig(), seed, "truth", 20.0))))
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


def test_section_table_and_kalibr(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, exported = tmp_path / "rig.yaml", tmp_path / "imu.yaml"
    rig.write_text("geometry: {workspace_m: [-0.06, 0.04, 0.06, 0.11]}\n")
    static(logs, imu_yaml=exported, rig=rig)
    shown = capsys.readouterr()
    assert "verdict: ok" in shown.out
    assert "drift of the angle, deg/s" in shown.out
    after = read_rig(rig)
    assert after.geometry is not None
    section = after.imu
    assert section is not None
    assert section.gyro_bias_radps[2] == pytest.approx(0.006, abs=5e-4)
    assert [log.name for log in section.logs] == ["static0.csv", "static1.csv", "static2.csv"]
    slopes = []
    for path in logs:
        log = read_log(path)
        rows = log.sampled("onchip_phi_rad")
        slopes.append(np.degrees(np.polyfit(log.t_s[rows], log.columns["onchip_phi_rad"][rows], 1)[0]))
    assert section.drift["onchip"].mean_degps == pytest.approx(np.mean(slopes), rel=1e-6)
    assert section.drift["onchip"].spread_degps == pytest.approx(np.std(slopes, ddof=1), rel=1e-6)
    assert set(after.provenance.inputs["imu"]) == {path.name for path in logs}
    assert yaml.safe_load(exported.read_text())["update_rate"] == pytest.approx(100.0, rel=1e-4)


def test_one_json_document_and_the_same_bytes(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.yaml", "b.yaml"):
        static(logs[:1], rig=tmp_path / name, as_json=True)
    out = capsys.readouterr().out
    document = json.loads(out[: out.index("\n}\n") + 2])
    assert (document["schema"], document["verb"]) == (1, "imu static")
    assert document["imu"]["verdict"] == "ok"
    assert len(document["imu"]["sigma"]["gyro_bias_radps"]) == 3
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()


def test_motion_is_poor_but_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = _at_rest()
    values[1000:1200, 2] += 0.5 * np.sin(0.1 * np.arange(200))
    with pytest.raises(typer.Exit) as ending:
        static([_write(tmp_path / "log.csv", values)], rig=tmp_path / "rig.yaml")
    assert ending.value.exit_code == 1
    assert "log.csv: moves from 10.0 to 12.0 s, seen most in gz" in capsys.readouterr().out
    section = read_rig(tmp_path / "rig.yaml").imu
    assert section is not None
    assert section.verdict == "poor"
    assert section.logs[0].moves_s == [[pytest.approx(10.0, abs=0.05), pytest.approx(12.0, abs=0.05)]]


def test_a_stuck_axis_is_poor(tmp_path: Path) -> None:
    values = _at_rest()
    values[:, 4] = 0.2
    with pytest.raises(typer.Exit) as ending:
        static([_write(tmp_path / "log.csv", values)], rig=tmp_path / "rig.yaml")
    assert ending.value.exit_code == 1


def test_gaps_and_repeated_rows_are_handled_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = 0.01 * np.arange(3000)
    t[2000:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(3000), [1000, 1001]), np.arange(100, 700, 100)]))
    static([_write(tmp_path / "log.csv", _at_rest()[rows], t[rows])], rig=tmp_path / "rig.yaml")
    out = capsys.readouterr().out
    assert "2 samples missing in 1 gap(s), the longest 30 ms after 9.99 s" in out
    assert "split at a gap of 3600 s after 19.99 s" in out
    assert "6 rows (0.20%) repeat the one before; dropped" in out


def test_units_are_refused_and_then_converted(tmp_path: Path) -> None:
    scale = np.array([180.0 / np.pi] * 3 + [1.0 / 9.80665] * 3)
    path = _write(tmp_path / "log.csv", _at_rest() * scale)
    with pytest.raises(BadInputError, match="give --acc-unit g"):
        static([path], rig=tmp_path / "rig.yaml")
    with pytest.raises(BadInputError, match="give --gyro-unit deg/s"):
        static([path], acc_unit="g", rig=tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()
    static([path], acc_unit="g", gyro_unit="deg/s", rig=tmp_path / "rig.yaml")
    section = read_rig(tmp_path / "rig.yaml").imu
    assert section is not None
    assert section.gyro_bias_radps[2] == pytest.approx(0.006, abs=2e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,u_px\n0,1\n1,2\n", "log.csv: has no IMU"),
        (HEAD + "0,0,0,0,0,0,9.8\n", "log.csv: has 1 IMU sample"),
        (HEAD + "".join(f"{i},0,0,0,0,0,0\n" for i in range(200)), "log.csv: all IMU readings are zero"),
        (HEAD + "".join(f"{i},nan,nan,nan,nan,nan,nan\n" for i in range(200)), "hold no number"),
        (HEAD + "1,0,0,0,9,1,1\n0,0.1,0,0,9,1,1\n", "log.csv, line 3: t_s goes back"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", "from calib.cli.main import main; main()", "imu", "static", "log.csv"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stdout == ""
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
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
    section = read_rig(tmp_path / "rig.yaml").imu
    assert section is not None
    # A sensor of this kind has about 0.01 deg/s/sqrt(Hz).
    densities = np.degrees([value for value in section.gyro_noise_radps_per_sqrt_Hz if value is not None])
    assert np.all((densities > 0.003) & (densities < 0.04))
    assert section.rate_hz == pytest.approx(100.0, rel=1e-3)

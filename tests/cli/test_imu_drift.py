"""`calib imu drift` from the command line: what it says, what it refuses, and how it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.core.rig import hash_of
from calib.io.logs import log_text
from calib.stages.imu.tracks import missing
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

Run = Callable[..., Any]
HEAD = "t_s,gx_radps,gy_radps,gz_radps,ax_mps2,ay_mps2,az_mps2\n"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two logs at rest and one in motion of the simulated rig."""
    folder = tmp_path_factory.mktemp("logs")
    out = {}
    for name, scenario, seed in (("a", "static", 0), ("b", "static", 1), ("moves", "chirp", 0)):
        run = run_scenario(make_scenario(scenario), SimulatedRig(), seed, "truth", 20.0)
        out[name] = folder / f"{name}.csv"
        out[name].write_text(log_text(log_of(run)))
    return out


def _at_rest(n: int = 3000) -> np.ndarray:
    noise = np.array([2e-3] * 3 + [0.02] * 3)
    return noise * np.random.default_rng(0).normal(size=(n, 6)) + [0.004, -0.003, 0.006, 9.8, 0.2, 0.1]


def _write(path: Path, values: np.ndarray, t_s: np.ndarray | None = None) -> Path:
    t = 0.01 * np.arange(len(values)) if t_s is None else t_s
    rows = np.column_stack([t, values]).tolist()
    path.write_text(HEAD + "".join(",".join(f"{cell:.9g}" for cell in row) + "\n" for row in rows))
    return path


def test_the_table_and_what_it_warns_of(calib: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "orientation_filter: {Kp_per_s: 1.0, Ki_per_s2: 0.25, rate_hz: 100.0, recommended: tuned, "
        "recommended_by: reference, verdict: ok}\n"
    )
    before = rig.read_bytes()
    ended = calib("imu", "drift", *logs.values(), "--no-peers", "--rig", rig)
    assert ended.code == 0
    assert "a slope alone does not rank filters" in ended.out
    assert "rejects a constant gyro bias entirely" in ended.out
    assert "slope over the logs, deg/s" in ended.out
    for name in ("on the chip", "gyroscope alone", "accelerometer alone", "MM tuned", "with up vector"):
        assert name in ended.out
    assert rig.read_bytes() == before
    assert "moves.csv: 20 s at 100 Hz" in ended.out


def test_one_json_document(calib: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    words = ("imu", "drift", *logs.values(), "--no-peers", "--json", "--rig", tmp_path / "rig.yaml")
    ended = calib(*words)
    assert ended.code == 0
    document = json.loads(ended.out)
    assert (document["schema"], document["verb"]) == (1, "imu drift")
    section = document["drift"]
    assert section["provenance"]["inputs"] == {path.name: hash_of(path) for path in logs.values()}
    rest, _, moves = section["logs"]
    # The simulated gyroscope has a bias of about 0.006 rad/s, the chip drifts by about 0.145 degrees/s.
    assert rest["methods"]["gyroscope alone"]["slope_degps"] == pytest.approx(-0.35, abs=0.03)
    assert 0.02 < rest["methods"]["on the chip"]["slope_degps"] < 0.4
    low, high = rest["methods"]["MM 3/3"]["interval_degps"]
    assert low < 0.0 < high
    assert rest["methods"]["MM 3/3"]["allan_100s_deg"] is None
    assert rest["methods"]["MM 3/3"]["rmse_deg"] is None
    assert 0.0 < moves["methods"]["MM 3/3"]["rmse_deg"] < moves["methods"]["accelerometer alone"]["rmse_deg"]
    assert moves["methods"]["gyroscope alone"]["lag_ms"] == pytest.approx(-5.0, abs=2.0)
    assert any("no section orientation_filter" in sentence for sentence in rest["skipped"])
    spread = section["methods"]["gyroscope alone"]
    slopes = [log["methods"]["gyroscope alone"]["slope_degps"] for log in section["logs"]]
    assert spread["mean_degps"] == pytest.approx(np.mean(slopes))
    assert spread["spread_degps"] == pytest.approx(np.std(slopes, ddof=1))
    assert calib(*words).out == ended.out
    assert not (tmp_path / "rig.yaml").exists()


def test_filters_of_others_run_on_the_same_log(calib: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    ended = calib("imu", "drift", logs["moves"], "--json", "--rig", tmp_path / "rig.yaml")
    methods = json.loads(ended.out)["drift"]["logs"][0]["methods"]
    skipped = json.loads(ended.out)["drift"]["logs"][0]["skipped"]
    for name in ("Mahony", "Madgwick", "imufusion", "VQF"):
        if missing(name):
            assert any(sentence.startswith(f"{name}: the package") for sentence in skipped)
        else:
            assert methods[name]["rmse_deg"] < methods["accelerometer alone"]["rmse_deg"]
            assert f"running {name}" in ended.err


@pytest.mark.slow
def test_figures_are_drawn(calib: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    words = ("imu", "drift", *logs.values(), "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert calib(*words, "--figures", tmp_path / "figures").code == 0
    found = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert found == ["drift_angles.png", "drift_motion_3.png", "drift_slopes.png"]


def test_repeats_and_gaps_are_handled_and_reported(calib: Run, tmp_path: Path) -> None:
    t = 0.01 * np.arange(3000)
    t[2000:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(3000), [1000]), np.arange(100, 700, 100)]))
    log = _write(tmp_path / "log.csv", _at_rest()[rows], t[rows])
    ended = calib("imu", "drift", log, "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "1 samples missing in 1 gap(s), the longest 20 ms after 9.99 s" in ended.out
    assert "split at a gap of 3600 s after 19.99 s" in ended.out
    assert "6 rows (0.20%) repeat the one before; dropped" in ended.out
    # The gyroscope alone is begun anew after the hour.
    line = next(line for line in ended.out.splitlines() if "gyroscope alone" in line)
    assert float(line.split()[3]) == pytest.approx(-0.34, abs=0.03)


def test_units_are_named_and_converted(calib: Run, tmp_path: Path) -> None:
    scale = np.array([180.0 / np.pi] * 3 + [1.0 / 9.80665] * 3)
    log = _write(tmp_path / "log.csv", _at_rest() * scale)
    words = ("imu", "drift", log, "--no-peers", "--rig", tmp_path / "rig.yaml")
    ended = calib(*words)
    assert (ended.code, "so it is in g" in ended.sentence) == (3, True)
    assert "give --acc-unit g" in ended.sentence
    ended = calib(*words, "--acc-unit", "g")
    assert ended.code == 3
    assert "give --gyro-unit deg/s" in ended.sentence
    ended = calib(*words, "--acc-unit", "g", "--gyro-unit", "deg/s", "--json")
    slope = json.loads(ended.out)["drift"]["logs"][0]["methods"]["gyroscope alone"]["slope_degps"]
    assert slope == pytest.approx(-np.degrees(0.006), abs=0.02)


def test_nan_counts_as_missing(calib: Run, tmp_path: Path) -> None:
    log = _write(tmp_path / "log.csv", _at_rest())
    lines = log.read_text().splitlines(keepends=True)
    lines[1500] = "14.99,nan,nan,nan,nan,nan,nan\n"
    log.write_text("".join(lines))
    ended = calib("imu", "drift", log, "--no-peers", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "6 cells say nan or inf; their rows count as missing" in ended.out
    assert "1 samples missing in 1 gap(s)" in ended.out


def test_an_axis_that_is_not_needed_may_be_stuck(calib: Run, tmp_path: Path) -> None:
    values = _at_rest()
    values[:, 5] = 0.1
    log = _write(tmp_path / "log.csv", values)
    ended = calib("imu", "drift", log, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 0
    assert "az never changes, it is stuck at 0.1; left out" in ended.out
    assert "these need three axes, and az is not in the log" in ended.out


_STUCK = HEAD + "".join(f"{i / 100},0,0,{i % 7 / 1000},9.8,0.2,{i % 5 / 10}\n" for i in range(500))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,u_px\n0,1\n1,2\n", "log.csv: has no IMU"),
        (HEAD + "0,0,0,0,0,0,9.8\n", "log.csv: has 1 IMU sample"),
        (HEAD + "".join(f"{i},0,0,0,0,0,0\n" for i in range(200)), "log.csv: all IMU readings are zero"),
        (_STUCK, "log.csv: ax never changes, it is stuck at 9.8"),
        (HEAD + "".join(f"{i},nan,nan,nan,nan,nan,nan\n" for i in range(200)), "has no readings in gz_radps"),
        (HEAD + "1,0,0,0,9,1,1\n0,0.1,0,0,9,1,1\n", "log.csv, line 3: t_s goes back"),
        (HEAD + "0,0,0,0,9.8,0,0\n0.01,0,0,0.01,9.81,0.1,0\n", "log.csv: is 0.02 s long"),
    ],
)
def test_bad_input_is_one_sentence(calib: Run, tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    ended = calib("imu", "drift", "log.csv", cwd=tmp_path)
    assert ended.code == 3
    assert ended.out == ""
    assert words in ended.sentence
    assert not (tmp_path / "rig.yaml").exists()


def test_bad_gains_are_one_sentence(calib: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("orientation_filter: {Kp_per_s: fast}\n")
    ended = calib("imu", "drift", logs["a"], "--rig", rig)
    assert ended.code == 3
    assert "orientation_filter" in ended.sentence

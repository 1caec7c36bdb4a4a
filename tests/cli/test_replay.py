"""`calib replay` from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from estimatorlogs import simulated

from calib.io.logs import Log, write_log
from calib.io.states import STATES

Run = Callable[..., Any]


@pytest.fixture
def log_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a simulated log, changed on the way."""

    def make(name: str = "swing", seed: int = 0, change: Callable[[Log], Log] | None = None) -> Path:
        log = simulated(name, seed)[1]
        path = tmp_path / f"{name}{seed}.csv"
        write_log(path, log if change is None else change(log))
        return path

    return make


@pytest.fixture
def aligned(rig: Path) -> Path:
    """A rig.yaml with a section align for the nominal simulated rig."""
    document = yaml.safe_load(rig.read_text())
    document["align"] = {
        "time_offset_s": 0.0252,
        "mount_angle_rad": 0.0201,
        "gyro_scale": 0.0055,
        "gyro_bias_radps": 0.0062,
        "marker_offset_m": 0.01502,
        "accel_bias_mps2": [0.05, -0.041],
        "rest_angle_rad": 0.016,
        "accel_scale": [0.003, -0.002],
        "imu_lever_m": 0.006,
        "plane_shift_m": [0.0, 0.0],
        "plane_stretch": 0.0,
        "jitter_px": 0.3,
        "outlier_share": 0.003,
        "accel_noise_mps2": [0.0158, 0.0158],
        "gyro_noise_radps": 0.0026,
        "verdict": "ok",
        "sigma": {
            "time_offset_s": 5e-4,
            "mount_angle_rad": 3e-4,
            "gyro_scale": 1e-3,
            "gyro_bias_radps": 5e-4,
            "marker_offset_m": 3e-5,
            "accel_bias_mps2": [0.02, 0.002],
        },
    }
    rig.write_text(yaml.safe_dump(document))
    return rig


def without(*names: str) -> Callable[[Log], Log]:
    return lambda log: replace(log, columns={k: v for k, v in log.columns.items() if k not in names})


def read_states(path: Path) -> dict[str, np.ndarray]:
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def test_a_log_becomes_states_with_their_deviations(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path, states = log_file("ellipse"), tmp_path / "states.csv"
    ended = calib("replay", path, "--rig", aligned, "-o", states, "--json")
    assert ended.code == 0
    told = json.loads(ended.out)["replay"]["logs"][0]
    assert told["verdict"] == "ok"
    assert told["rmse"]["mean_q_mm"] < 0.25 and told["rmse"]["phi_deg"] < 0.06
    assert told["compared"]["baseline"]["mean_q_mm"] > 2.0 * told["rmse"]["mean_q_mm"]
    assert 0.2 < told["jitter_px"] < 0.4
    for name in ("camera", "accel", "gyro"):
        assert 0.2 < told["sensors"][name]["nis"] / told["sensors"][name]["degrees"] < 2.0
    got = read_states(states)
    assert tuple(got) == STATES
    log = simulated("ellipse")[1]
    assert len(got["t_s"]) == len(log)
    for name in STATES[:13]:
        assert np.isfinite(got[name]).all()
    late = got["t_s"] > 2.0
    error = got["q1_m"] - log.columns["true_q1_m"]
    assert 1e3 * np.sqrt(np.mean(error[late] ** 2)) == pytest.approx(told["rmse"]["q1_mm"], rel=1e-3)


def test_the_same_log_gives_the_same_bytes(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path, both = log_file(), [tmp_path / "a.csv", tmp_path / "b.csv"]
    said = [calib("replay", path, "--rig", aligned, "-o", states).out for states in both]
    assert both[0].read_bytes() == both[1].read_bytes()
    assert said[0] == said[1] and "RMSE after 2 s" in said[0] and "baseline" in said[0]


def test_smoothing_is_better(calib: Run, aligned: Path, log_file: Callable[..., Path]) -> None:
    ended = calib("replay", log_file("elongation"), "--rig", aligned, "--smooth", "--json")
    told = json.loads(ended.out)["replay"]["logs"][0]
    assert told["estimator"] == "smoothed"
    assert told["rmse"]["mean_q_mm"] < 0.8 * told["compared"]["filter"]["mean_q_mm"]


def test_the_baseline_can_be_asked_for(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    states = tmp_path / "states.csv"
    ended = calib("replay", log_file(), "--rig", aligned, "--estimator", "baseline", "-o", states, "--json")
    told = json.loads(ended.out)["replay"]["logs"][0]
    assert ended.code == 0 and told["estimator"] == "baseline"
    assert told["rmse"]["mean_q_mm"] > told["compared"]["fused"]["mean_q_mm"]
    assert "sigma_q1_m" not in states.read_text().splitlines()[0]
    assert calib("replay", log_file(), "--estimator", "baseline", "--smooth").code == 2


def test_several_logs_go_to_a_folder_with_figures(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    logs = [log_file("swing", 0), log_file("elongation", 0)]
    ended = calib(
        "replay", *logs, "--rig", aligned, "-o", tmp_path / "out", "--figures", tmp_path / "figures"
    )
    assert ended.code == 0
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["elongation0_states.csv", "swing0_states.csv"]
    assert len(list((tmp_path / "figures").glob("*.png"))) == 6


def test_without_align_it_works_and_says_what_is_assumed(
    calib: Run, rig: Path, log_file: Callable[..., Path]
) -> None:
    ended = calib("replay", log_file("ellipse"), "--rig", rig)
    assert "no section align" in ended.out


def test_one_sensor_alone_is_degraded(calib: Run, aligned: Path, log_file: Callable[..., Path]) -> None:
    blind = log_file("ellipse", 0, without("u_px", "v_px"))
    ended = calib("replay", blind, "--rig", aligned)
    assert ended.code == 1 and "has no pictures" in ended.out
    numb = log_file(
        "ellipse", 0, without("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps")
    )
    ended = calib("replay", numb, "--rig", aligned)
    assert ended.code == 1 and "has no IMU" in ended.out


def test_pictures_need_a_camera_and_a_plane(
    calib: Run, rig: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path = log_file()
    ended = calib("replay", path, "--rig", tmp_path / "none.yaml")
    assert ended.code == 3 and "no camera" in ended.sentence and "calib intrinsics" in ended.sentence
    document = yaml.safe_load(rig.read_text())
    del document["plane"]
    rig.write_text(yaml.safe_dump(document))
    ended = calib("replay", path, "--rig", rig)
    assert ended.code == 3 and "no plane" in ended.sentence and "calib extrinsics" in ended.sentence


def test_logs_that_cannot_be_used_end_in_a_sentence(calib: Run, rig: Path, tmp_path: Path) -> None:
    for text, expected in (
        ("t_s\n0.0\n", "neither camera nor IMU"),
        ("t_s,u_px,v_px\n", "no rows"),
        ("t_s,u_px,v_px\n0.0,1.0,x\n", "expected a number"),
    ):
        path = tmp_path / "bad.csv"
        path.write_text(text)
        ended = calib("replay", path, "--rig", rig)
        assert ended.code == 3 and expected in ended.sentence


def test_nan_and_infinity_in_cells_count_as_blank(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path, states = log_file(), tmp_path / "states.csv"
    lines = path.read_text().splitlines()
    for at, word in ((50, "nan"), (80, "inf"), (120, "-inf")):
        cells = lines[at].split(",")
        lines[at] = ",".join([cells[0], *(word if cell else "" for cell in cells[1:])])
    path.write_text("\n".join(lines) + "\n")
    ended = calib("replay", path, "--rig", aligned, "-o", states)
    assert ended.code in (0, 1) and "say nan or inf" in ended.out
    got = read_states(states)
    for name in STATES[:13]:
        assert np.isfinite(got[name]).all()


def test_a_bad_align_section_is_named(calib: Run, aligned: Path, log_file: Callable[..., Path]) -> None:
    document = yaml.safe_load(aligned.read_text())
    document["align"]["mount_angle_rad"] = "straight"
    aligned.write_text(yaml.safe_dump(document))
    ended = calib("replay", log_file(), "--rig", aligned)
    assert ended.code == 3 and "align.mount_angle_rad" in ended.sentence


@pytest.mark.slow
def test_tuning_writes_the_estimator_section(
    calib: Run, aligned: Path, log_file: Callable[..., Path]
) -> None:
    path = log_file("swing", 0)
    ended = calib("replay", path, "--rig", aligned, "--tune", "--json")
    assert ended.code in (0, 1)
    section = yaml.safe_load(aligned.read_text())["estimator"]
    assert 0.2 < section["jitter_px"] < 0.4 and len(section["levels"]) == 4
    assert section["gain_per_row"] > -1e-6
    assert json.loads(ended.out)["estimator"]["verdict"] == section["verdict"]
    assert calib("replay", path, "--rig", aligned).code in (0, 1)


def test_states_as_parquet_and_mcap_and_a_bag_as_a_log(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    """Whatever the formats, the same log gives the same states."""
    from bags import write_bag
    from pyarrow import parquet

    from calib.io.logs import read_log

    path = log_file("swing")
    log = read_log(path)
    (tmp_path / "bags").mkdir()
    messages = []
    for i, t in enumerate(log.t_s.tolist()):
        stamp = 10**18 + round(t * 1e6) * 1000
        for kind, names in (("imu", IMU), ("marker", ("u_px", "v_px")), ("pwm", ("pwm1", "pwm2"))):
            values = tuple(float(log.columns[name][i]) for name in names)
            if all(value == value for value in values):
                messages.append((kind, stamp, values))
    bag = write_bag(tmp_path / "bags", "ros1", messages)
    outs = [tmp_path / f"states{ending}" for ending in (".csv", ".parquet", ".mcap")]
    for out in outs:
        assert calib("replay", bag, "--rig", aligned, "-o", out, "--model", "kinematic").code == 0
    assert calib("replay", path, "--rig", aligned, "-o", tmp_path / "t.csv", "--model", "kinematic").code == 0
    table, wanted = read_states(outs[0]), read_states(tmp_path / "t.csv")
    stored = parquet.read_table(outs[1])
    for name in ("t_s", "q1_m", "q2_m", "phi_rad", "sigma_phi_rad", "flags"):
        held = stored[name].cast("float64").to_numpy()
        assert np.allclose(table[name], held, rtol=5.1e-9, atol=5.1e-7)
        assert np.allclose(table[name], wanted[name], rtol=1e-6, atol=1e-9), name
    assert outs[2].read_bytes().startswith(b"\x89MCAP0\r\n")


IMU = ("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps")


def test_names_of_several_logs_stay_in_the_folder(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    """Line breaks and equal names become names of their own; no link out of the folder is followed."""
    path, out = log_file("swing"), tmp_path / "out"
    logs = [tmp_path / "a" / "same.csv", tmp_path / "b" / "same.csv", tmp_path / "a" / "=x\n.csv"]
    for log in logs:
        log.parent.mkdir(exist_ok=True)
        log.write_bytes(path.read_bytes())
    assert calib("replay", *logs, "--rig", aligned, "-o", out, "--format", "parquet").code == 0
    names = sorted(item.name for item in out.iterdir())
    assert len(names) == 3 and all(name.endswith("_states.parquet") for name in names)
    assert not any(mark in name for name in names for mark in "\n=/")
    elsewhere = tmp_path / "elsewhere.parquet"
    elsewhere.write_text("mine")
    (out / "same_states.parquet").unlink()
    (out / "same_states.parquet").symlink_to(elsewhere)
    ended = calib("replay", *logs, "--rig", aligned, "-o", out, "--format", "parquet")
    assert ended.code == 3 and "is a link out of" in ended.err and ended.err.count("\n") == 1
    assert elsewhere.read_text() == "mine"


def test_a_log_too_long_to_be_smoothed_is_refused(
    calib: Run, aligned: Path, log_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calib.stages.estimator.replay._SMOOTHED_ROWS", 100)
    path = log_file("swing")
    ended = calib("replay", path, "--rig", aligned, "--smooth", "--model", "kinematic")
    assert ended.code == 3 and "has more than 100 rows, which smoothing would hold in memory" in ended.err
    assert calib("replay", path, "--rig", aligned, "--model", "kinematic").code == 0

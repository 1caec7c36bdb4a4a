"""`calib align` and `calib replay` from the command line: what they find, write, say and refuse."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from align_trials import twin_log
from estimatorlogs import ALIGNED, pushed_log, simulated

from calib.core.arrays import FloatArray
from calib.core.rig import Rig
from calib.io.columns import STATES
from calib.io.logs import Log, write_log
from calib.stages.firmware.header import make_header
from calib.twin.rig import SimulatedRig

from .conftest import Run

RIG = SimulatedRig()


@pytest.fixture(scope="module")
def logs() -> dict[str, Log]:
    swing = twin_log(RIG, "swing", {"phi_rad": "0.5"}, 11)
    ellipse = twin_log(RIG, "ellipse", {}, 12)
    return {"swing": swing, "ellipse": ellipse, "static": twin_log(RIG, "static", {}, 13, 10.0)}


def _put(folder: Path, name: str, log: Log, **changed: FloatArray | None) -> Path:
    columns = {key: value for key, value in log.columns.items() if not key.startswith("true_")}
    for key, value in changed.items():
        if value is None:
            del columns[key]
        else:
            columns[key] = value
    path = folder / f"{name}.csv"
    write_log(path, replace(log, columns=columns))
    return path


def test_a_rig_is_aligned(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    paths = [_put(tmp_path, name, logs[name]) for name in ("swing", "ellipse")]
    figures = tmp_path / "figures"
    done = calib("align", *paths, "--rig", rig, "--figures", figures)
    assert done.code == 0, done.err
    assert "verdict: ok" in done.out
    assert "time offset of pictures, ms" in done.out
    section = Rig.load(rig).align
    assert section is not None
    # Nothing but the logs and the calibrated camera and plane; the truth is that of the simulated rig.
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)
    assert section.mount_angle_rad == pytest.approx(0.02, abs=np.radians(0.1))
    offset = section.sigma["time_offset_s"]
    assert isinstance(offset, float)
    assert abs(section.time_offset_s - 0.025) < 4.0 * offset
    read = {"swing.csv", "ellipse.csv", "camera", "plane", "geometry"}
    assert set(Rig.load(rig).provenance.inputs["align"]) == read
    assert {path.name for path in figures.iterdir()} == {
        "align_correlation.png", "align_residuals_1.png", "align_residuals_2.png",
    }  # fmt: skip


def test_at_rest_the_offset_is_not_observable(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    done = calib("align", _put(tmp_path, "static", logs["static"]), "--rig", rig)
    assert done.code == 1
    assert "verdict: unidentifiable" in done.out
    assert "the logs hardly move" in done.out
    assert "the mount angle and the accelerometer's bias along y are nearly one number" in done.out
    section = Rig.load(rig).align
    assert section is not None
    rest = section.sigma["rest_angle_rad"]
    assert isinstance(rest, float)
    assert rest < np.radians(0.1)


def test_signs_that_are_turned_in_the_logs_are_told_to_the_board(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    """An IMU upside down: without that the board would take the angle for its negative."""
    columns = logs["swing"].columns
    turned = {name: -columns[name] for name in ("ay_mps2", "gz_radps")}
    path = _put(tmp_path, "swing", logs["swing"], **turned)
    (tmp_path / "columns.yaml").write_text(
        "".join(f"{name}: {{column: {name}, factor: -1}}\n" for name in turned)
    )
    done = calib("align", path, "--rig", rig)
    assert (done.code, "ay_mps2, gz_radps: the sign is turned" in done.out) == (1, True)
    assert "state -1 for ay_mps2, -1 for gz_radps in geometry.imu_sign" in done.out
    before = rig.read_text()
    rig.write_text(before + "geometry: {imu_sign: [1, 1, -1]}\n")
    assert "ay_mps2: the sign is turned" in calib("align", path, "--rig", rig).out
    rig.write_text(before + "geometry: {imu_sign: [1, -1, -1]}\n")
    done = calib("align", path, "--rig", rig)
    assert "the sign is turned" not in done.out
    header = make_header(Rig.load(rig), "rig.yaml").values
    assert [header[f"CALIB_IMU_SIGN_{axis}"] for axis in ("AX", "AY", "GZ")] == [1, -1, -1]


def test_a_rig_without_camera_or_plane(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    path = _put(tmp_path, "swing", logs["swing"])
    (tmp_path / "new").mkdir()
    done = calib("align", path, cwd=tmp_path / "new")
    assert done.code == 3
    assert "run calib intrinsics first" in done.sentence
    bare = tmp_path / "bare.yaml"
    bare.write_text(rig.read_text().split("plane:")[0])
    done = calib("align", path, "--rig", bare)
    assert done.code == 3
    assert "run calib extrinsics first" in done.sentence
    done = calib("identify", path, "--rig", tmp_path / "baer.yaml")
    assert done.code == 3 and "there is no such file; did you mean bare.yaml?" in done.sentence


def _times(log: Log, change: Callable[[FloatArray], FloatArray]) -> Log:
    return replace(log, t_s=change(log.t_s.copy()))


def _first(log: Log, rows: int) -> Log:
    columns = {name: value[:rows] for name, value in log.columns.items()}
    return replace(log, t_s=log.t_s[:rows], columns=columns, lines=log.lines[:rows])


def _backwards(t: FloatArray) -> FloatArray:
    t[300:] -= 1.0
    return t


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda log: (log, {"u_px": None, "v_px": None}), "has no picture of the marker"),
        (lambda log: (log, {"ax_mps2": None, "ay_mps2": None, "gz_radps": None}), "has no gyroscope"),
        (lambda log: (_times(log, _backwards), {}), "t_s goes back"),
        (lambda log: (_first(log, 4), {}), "has no stretch of 1 s"),
        (lambda log: (log, {"gz_radps": 57.2958 * log.columns["gz_radps"]}), "the gyroscope reaches 584"),
        (lambda log: (log, {"gz_radps": -log.columns["gz_radps"]}), "geometry: {imu_sign: [1, -1, -1]}"),
        (
            lambda log: (log, {"ax_mps2": log.columns["ay_mps2"], "ay_mps2": log.columns["ax_mps2"]}),
            "swapped or one has the wrong sign",
        ),
        (lambda log: (log, {"ay_mps2": -log.columns["ay_mps2"]}), "swapped or one has the wrong sign"),
        (
            lambda log: (log, {"gz_radps": 0.0 * log.columns["gz_radps"]}),
            "gz_radps never changes, it is stuck at 0",
        ),
        (lambda log: (log, {"u_px": log.columns["u_px"] + 4000.0}), "px, outside the picture of 316x208"),
    ],
)
def test_bad_logs_end_in_a_sentence(
    make: Callable[[Log], tuple[Log, dict[str, FloatArray | None]]], words: str, calib: Run,
    logs: dict[str, Log], rig: Path, tmp_path: Path,
) -> None:  # fmt: skip
    before = rig.read_bytes()
    log, changed = make(logs["swing"])
    done = calib("align", _put(tmp_path, "log", log, **changed), "--rig", rig)
    assert done.code == 3
    assert words in done.sentence
    assert rig.read_bytes() == before


def test_an_hour_of_jump_splits_the_log(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    log = _times(logs["swing"], lambda t: np.where(t > 2.0, t + 3600.0, t))
    done = calib("align", _put(tmp_path, "log", log), "--rig", rig)
    assert done.code in (0, 1)
    assert "split at 1 gap(s)" in done.out
    section = Rig.load(rig).align
    assert section is not None
    assert section.logs[0].stretches == 2
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)


@pytest.mark.parametrize("of_all", [True, False])
def test_dropouts_of_the_recorder_split_the_log(
    of_all: bool, calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    """The angle is not known over .7 s; drawn straight there it made the time offset .25 s."""
    log = logs["swing"]
    lost = (log.t_s > 1.5) & (log.t_s < 2.2)
    lacking = [n for n in log.columns if n[0] in "ag" or (of_all and n in ("u_px", "v_px"))]
    changed = {n: np.where(lost, np.nan, log.columns[n]) for n in lacking}
    done = calib("align", _put(tmp_path, "log", log, **changed), "--rig", rig)
    assert done.code in (0, 1)
    assert "split at 1 gap(s) of the gyroscope" in done.out
    section = Rig.load(rig).align
    assert section is not None
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)


def test_pictures_of_something_else(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    log, rng = logs["swing"], np.random.default_rng(0)
    seen = np.isfinite(log.columns["u_px"])
    u = np.where(seen, rng.integers(0, 316, len(log)), np.nan)
    v = np.where(seen, rng.integers(0, 208, len(log)), np.nan)
    done = calib("align", _put(tmp_path, "log", log, u_px=u, v_px=v), "--rig", rig)
    assert done.code == 1
    assert "verdict: unidentifiable" in done.out
    assert "show something else than the marker" in done.out


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
    document["align"] = ALIGNED
    rig.write_text(yaml.safe_dump(document))
    return rig


def without(*names: str) -> Callable[[Log], Log]:
    return lambda log: replace(log, columns={k: v for k, v in log.columns.items() if k not in names})


def read_states(path: Path) -> dict[str, np.ndarray]:
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def test_rows_that_are_written_twice_count_once(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    """As readings of their own they made innovations repeat, 0.48 with the one before."""
    once, twice = log_file("ellipse"), tmp_path / "twice.csv"
    head, *rows = once.read_text().splitlines()
    twice.write_text("\n".join([head, *(row for row in rows for _ in range(2))]) + "\n")
    states = []
    for path in (once, twice):
        ended = calib("replay", path, "--rig", aligned, "-o", tmp_path / "states.csv")
        assert ended.code == 0
        states.append((tmp_path / "states.csv").read_text())
    assert f"{len(rows)} rows are written twice; left out" in ended.out + ended.err
    assert states[0] == states[1]


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


def test_the_equations_can_be_checked_on_filterpy(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path, states = log_file("ellipse", change=lambda log: _first(log, 400)), tmp_path / "states.csv"
    ended = calib("replay", path, "--rig", aligned, "--estimator", "filterpy", "-o", states, "--json")
    assert ended.code == 0
    told = json.loads(ended.out)["replay"]["logs"][0]
    (remark,) = [one for one in told["remarks"] if "compiled filter" in one]
    assert float(remark.split(" at most ")[1].split()[0]) <= 1e-9
    assert len(read_states(states)["t_s"]) == 400 and told["rmse"]["mean_q_mm"] < 0.4
    refused = calib("replay", path, "--rig", aligned, "--estimator", "filterpy", "--smooth")
    assert refused.code == 2 and "--estimator filterpy: cannot be smoothed" in refused.err


def test_a_log_of_a_moment_is_not_judged(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    path = log_file("ellipse", change=lambda log: _first(log, 12))
    ended = calib("replay", path, "--rig", aligned, "-o", tmp_path / "states.csv")
    assert ended.code == 1 and "the log is too short: innovations are judged from 2 s on" in ended.out


def test_states_are_no_better_than_the_alignment(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path
) -> None:
    rig = Rig.load(aligned)
    assert rig.align is not None
    rig.align.doubt(["one swing alone"])
    rig.save(tmp_path / "poor.yaml")
    for path, word in ((aligned, "ok"), (tmp_path / "poor.yaml", "poor")):
        ended = calib("replay", log_file("ellipse"), "--rig", path, "-o", tmp_path / "states.csv", "--json")
        told = json.loads(ended.out)["replay"]["logs"][0]
        assert told["verdict"] == word
        assert ("align is poor; what follows from it is no better" in told["reasons"]) == (word == "poor")


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


def test_one_sensor_alone_is_degraded(calib: Run, aligned: Path, log_file: Callable[..., Path]) -> None:
    blind = log_file("ellipse", 0, without("u_px", "v_px"))
    ended = calib("replay", blind, "--rig", aligned)
    assert ended.code == 1 and "has no pictures" in ended.out
    assert "the pictures, other than" not in ended.out
    numb = log_file(
        "ellipse", 0, without("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps")
    )
    ended = calib("replay", numb, "--rig", aligned)
    assert ended.code == 1 and "has no IMU" in ended.out


def test_a_rig_without_pumps_is_not_asked_for_its_bellows(
    calib: Run, aligned: Path, logs: dict[str, Log], tmp_path: Path
) -> None:
    for pwm, asked in ((None, False), (logs["ellipse"].columns["pwm1"], True)):
        log = _put(tmp_path, "log", logs["ellipse"], pwm1=pwm, pwm2=pwm)
        assert ("the bellows' radius" in calib("replay", log, "--rig", aligned).out) == asked


def test_a_clock_that_several_readings_share_is_told(
    calib: Run, aligned: Path, logs: dict[str, Log], tmp_path: Path
) -> None:
    stepped = _times(logs["ellipse"], lambda t: np.floor(t / 0.05) * 0.05)
    ended = calib("replay", _put(tmp_path, "stepped", stepped), "--rig", aligned)
    assert ended.code == 1
    assert "- t_s comes in steps of 50 ms, each of which several readings share" in ended.out


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


def test_a_log_that_fails_does_not_keep_others_from_being_written(
    calib: Run, aligned: Path, log_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad, odd, good = tmp_path / "bad.csv", log_file("swing", 1), log_file("swing", 0)
    bad.write_text("t_s,u_px,v_px\n0.0,1.0,x\n")
    smoothed = "calib.stages.estimator.replay.smooth_log"

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    ended = calib("replay", bad, good, "--rig", aligned, "-o", tmp_path / "one", "--json")
    assert ended.code == 3
    assert "line 2: v_px is 'x'" in ended.err
    assert ended.sentence == "1 of 2 files failed: bad.csv"
    assert [log["source"] for log in json.loads(ended.out)["replay"]["logs"]] == [good.name]
    assert len(list((tmp_path / "one").iterdir())) == 1
    monkeypatch.setattr(smoothed, fails)
    ended = calib("replay", bad, odd, "--rig", aligned, "--smooth")
    assert ended.code == 70
    assert f"{odd.name}: internal error: LinAlgError: singular" in ended.err
    assert ended.sentence == f"2 of 2 files failed: bad.csv, {odd.name}"


def test_a_head_that_a_hand_pushes_is_followed(calib: Run, aligned: Path, tmp_path: Path) -> None:
    """Its length came 40 ms late: 0.35 mm off, of which 77 % was within two deviations, and ok."""
    log = pushed_log(0)
    write_log(tmp_path / "pushed.csv", log)
    done = calib("replay", "pushed.csv", "--rig", aligned, "-o", "states.csv", cwd=tmp_path)
    assert done.code == 0, done.out
    states = read_states(tmp_path / "states.csv")
    late = states["t_s"] > 2.0
    off = (states["q1_m"] - np.interp(states["t_s"], log.t_s, log.columns["true_q1_m"]))[late]
    assert np.sqrt(np.mean(off**2)) < 2.3e-4
    assert np.mean(np.abs(off) < 2.0 * states["sigma_q1_m"][late]) > 0.9


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


@pytest.fixture
def ellipse(log_file: Callable[..., Path]) -> Path:
    return log_file("ellipse", change=lambda log: _first(log, int((log.t_s < 6.0).sum())))


def test_commands_are_used_where_the_log_has_them(calib: Run, rig: Path, ellipse: Path) -> None:
    states = ellipse.with_name("states.csv")
    found = {}
    for model in ("auto", "kinematic", "driven"):
        done = calib("replay", str(ellipse), "--rig", str(rig), "--model", model, "-o", str(states), "--json")
        document = json.loads(done.out)["replay"]["logs"][0]
        found[model] = document["rmse"]["mean_q_mm"]
        if model == "kinematic":
            assert document["driven_share"] is None
            assert np.isnan(read_states(states)["driven_weight"]).all()
        elif model == "auto":
            assert 0.3 < document["driven_share"] <= 1.0
            assert (read_states(states)["driven_weight"] > 0.5).mean() > 0.3
    assert found["auto"] < found["kinematic"]
    assert found["driven"] < found["kinematic"]


def test_the_driven_model_wants_commands(calib: Run, rig: Path, log_file: Callable[..., Path]) -> None:
    path = log_file("swing", change=without("pwm1", "pwm2"))
    refused = calib("replay", path, "--rig", rig, "--model", "driven")
    assert refused.code == 3
    assert "commands" in refused.err
    assert calib("replay", path, "--rig", rig, "--json").code in (0, 1)


def test_a_plant_that_cannot_be_is_named(calib: Run, rig: Path, ellipse: Path) -> None:
    rig.write_text(rig.read_text() + "\nknown: {pump: {lag_s: -1.0}}\n")
    refused = calib("replay", str(ellipse), "--rig", str(rig))
    assert refused.code == 3
    assert "pump.lag_s" in refused.err


def _captured(log: Log, noise_m: float = 3e-4) -> dict[str, FloatArray | None]:
    """The tip by motion capture in the rows of the pictures, which go, with the truth in its own columns."""
    seen, noise = np.isfinite(log.columns["u_px"]), np.random.default_rng(5)
    columns = {"tip_x_m": "true_x_m", "tip_y_m": "true_y_m", "tip_phi_rad": "true_phi_rad"}
    pose = {name: np.where(seen, log.columns[true], np.nan) for name, true in columns.items()}
    for name, sigma in zip(pose, (noise_m, noise_m, 0.005), strict=True):
        pose[name] = pose[name] + sigma * noise.standard_normal(len(log))
    return {"u_px": None, "v_px": None, **pose}


def test_the_place_of_the_tip_stands_in_for_pictures(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    """Nobody knows the base to a hair: sigma holds 0.3 mm for the tip and 0.2 mm for the base."""
    log, columns = logs["ellipse"], _captured(logs["ellipse"])
    assert columns["tip_y_m"] is not None
    columns["tip_y_m"] += 3e-4
    path, states = _put(tmp_path, "captured", log, **columns), tmp_path / "states.csv"
    done = calib("replay", path, "--rig", rig, "-o", states, "--figures", tmp_path / "figures", "--json")
    assert done.code == 0, done.err
    (told,) = json.loads(done.out)["replay"]["logs"]
    assert set(told["sensors"]) == {"pose", "accel", "gyro"}
    assert told["jitter_px"] is None
    assert told["pose_noise_mm"] == pytest.approx(0.3, rel=0.2)
    q = read_states(states)
    late = q["t_s"] > 2.0
    for name in ("q1_m", "q2_m"):
        error = (q[name] - log.columns[f"true_{name}"])[late]
        sigma = np.sqrt(np.mean(q[f"sigma_{name}"][late] ** 2))
        assert 0.5 * sigma < np.sqrt(np.mean(error**2)) < 1.5 * sigma < 6e-4
    assert calib("replay", path, "--rig", rig, "--tune").code == 3


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("mirrored", "off the arc from the base"),
        ("frozen", "stays the same to the digit from 3.0 to 6.0 s"),
        ("millimetres", "look at the unit of tip_x_m and tip_y_m"),
        ("space", "expected tip_x_m, tip_y_m without tip_z_m"),
    ],
)
def test_a_pose_that_is_not_what_it_says_is_told(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path, fault: str, told: str
) -> None:
    log = logs["ellipse"]
    columns, t = _captured(log), log.t_s
    x, y = columns["tip_x_m"], columns["tip_y_m"]
    assert x is not None and y is not None
    if fault == "mirrored":
        columns["tip_x_m"] = -x
    elif fault == "frozen":
        held = np.isfinite(x) & (t >= 3.0) & (t <= 6.02)
        x[held], y[held] = x[held][0], y[held][0]
    elif fault == "millimetres":
        columns |= {"tip_x_m": 1e3 * x, "tip_y_m": 1e3 * y}
    else:
        columns |= {"tip_z_m": 0.0 * x} | dict.fromkeys(("ax_mps2", "ay_mps2", "gz_radps"))
    done = calib("replay", _put(tmp_path, fault, log, **columns), "--rig", rig, "--model", "kinematic")
    assert done.code == (3 if fault in ("millimetres", "space") else 1)
    assert told in done.out + done.err


def test_a_pose_beside_pictures_scores_the_states(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    log = logs["ellipse"]
    pose = {name: column for name, column in _captured(log).items() if column is not None}
    done = calib(
        "replay", _put(tmp_path, "both", log, **pose), "--rig", rig, "--model", "kinematic", "--json"
    )
    (told,) = json.loads(done.out)["replay"]["logs"]
    assert 0.25 < told["rmse"]["mean_q_mm"] < 0.6
    assert "nees" not in told["rmse"]
    assert "errors are against the tip's pose and hold its noise and delay" in told["remarks"]

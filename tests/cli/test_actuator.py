"""`calib identify, validate, simulate` from the command line: what they write, say and refuse."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from identifytrials import log_file, pump_records, rig_file, varied

import calib as python
from calib.cli.simulate import simulate
from calib.core.errors import BadInputError, UsageError
from calib.core.options import PoseOptions
from calib.core.rig import Rig
from calib.core.stage import Files
from calib.io.logs import read_log
from calib.stages.actuator.section import LAG, Known, KnownActuator, KnownPump
from calib.stages.actuator.validate import IMPROVED, ORIGINAL, begun_track, compare, models_of
from calib.twin.rig import SimulatedRig

from .conftest import Run


@pytest.fixture(scope="module")
def swings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("swings")
    angles = ("0.5", "-0.4")
    return [
        log_file(folder / f"swing{k}.csv", SimulatedRig(), "swing", k, 5.0, phi_rad=phi)
        for k, phi in enumerate(angles)
    ]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, paths = tmp_path_factory.mktemp("tables"), []
    for record in pump_records(LAG, np.array([0.06, 25.0, 0.5, 1e6]), 3):
        path = folder / f"{record.name}.csv"
        rows = np.stack([record.t_s, record.pwm, record.value], axis=1).tolist()
        path.write_text("Time,PWM,Pressure\n" + "".join(",".join(f"{c:.6g}" for c in r) + "\n" for r in rows))
        paths.append(path)
    return paths


def _edit(path: Path, to: Path, change: Callable[[list[str], dict[str, int]], list[str] | None]) -> Path:
    """A copy of a log with its rows changed or, where `change` says None, left out."""
    lines = path.read_text().splitlines()
    where = {name: k for k, name in enumerate(lines[0].split(","))}
    rows = [change(line.split(","), where) for line in lines[1:]]
    to.write_text("\n".join([lines[0], *(",".join(r) for r in rows if r is not None)]) + "\n")
    return to


def test_swings_fill_the_section(calib: Run, rig: Path, swings: list[Path], tmp_path: Path) -> None:
    ended = calib("identify", *swings, "--rig", rig, "--figures", tmp_path / "figures")
    assert ended.code in (0, 1)
    for words in (
        "stiffness (of the nominal)",
        "creep lambda2 and creep lambda3 enter only as a product",
        "held phi",
        "zeta by peaks",
    ):
        assert words in ended.out
    row = next(line.split() for line in ended.out.splitlines() if line.startswith("  length at rest"))
    assert len(row[3]) == len("0.06497") and len(row[4]) == len("0.00035"), row
    section = yaml.safe_load(rig.read_text())["actuator"]
    for name, truth in (("stiffness_scale", 1.0), ("damping_scale_free_swing", 3.3), ("lambda1_per_s", 3.0)):
        assert abs(section[name] - truth) < 4.0 * section["sigma"][name]
    assert set(yaml.safe_load(rig.read_text())["provenance"]["inputs"]["actuator"]) == {
        *(p.name for p in swings),
        *("known", "camera", "plane", "align"),
    }
    assert (tmp_path / "figures" / "identify_motion.png").exists()
    # The simulation takes the file as it is.
    assert calib("simulate", "swing", "-o", tmp_path / "x.csv", "--rig", rig, "--duration", "1s").code == 0


def test_the_function_returns_both_sections(rig: Path, swings: list[Path]) -> None:
    actuator, pump = python.identify(str(swings[0].parent / "swing*.csv"), Rig.load(rig), hold_back=False)
    assert pump is None
    assert abs(actuator.stiffness_scale - 1.0) < 4.0 * actuator.sigma["stiffness_scale"]
    sections = {"known", "camera", "plane", "align"}
    assert set(actuator.inputs) == {*(path.name for path in swings), *sections}
    assert {"motion", "residuals", "parameters"} <= set(python.plots(actuator))


def test_no_result_is_its_own_prior(calib: Run, rig: Path, swings: list[Path], tmp_path: Path) -> None:
    first = rig.with_name("first.yaml")
    assert calib("identify", *swings, "--rig", rig, "--no-hold-back").code in (0, 1)
    first.write_bytes(rig.read_bytes())
    # It does not matter what another result in the file says.
    wrong = yaml.safe_load(rig.read_text())
    wrong["actuator"] |= {"stiffness_scale": 1.3, "damping_scale_free_swing": 9.0, "lambda1_per_s": 7.0}
    wrong["pump"] = {"lag_s": 1.9, "sigma": {"lag_s": 0.01}, "verdict": "poor"}
    rig.write_text(yaml.safe_dump(wrong, sort_keys=False))
    assert calib("identify", *swings, "--rig", rig, "--no-hold-back").code in (0, 1)
    assert yaml.safe_load(rig.read_text())["actuator"] == yaml.safe_load(first.read_text())["actuator"]


def test_what_is_known_is_kept_and_said(calib: Run, rig: Path, swings: list[Path]) -> None:
    known = {"stiffness_scale": 1.0, "mass_kg": 0.0166, "sigma": {"mass_kg": 2e-4}}
    rig.write_text(rig.read_text() + yaml.safe_dump({"known": {"actuator": known}}))
    ended = calib("identify", *swings, "--rig", rig, "--no-hold-back")
    assert ended.code in (0, 1)
    assert "not estimated, for known states it: stiffness (of the nominal)" in ended.out
    assert "known with a standard deviation, which went in: mass" in ended.out
    after = yaml.safe_load(rig.read_text())
    assert after["known"]["actuator"] == known
    assert "stiffness_scale" not in after["actuator"]
    assert after["actuator"]["sigma"]["mass_kg"] <= 2e-4


def test_logs_that_cannot_be_used_end_in_a_sentence(
    calib: Run, rig: Path, swings: list[Path], tmp_path: Path
) -> None:
    log = swings[0]

    def late(row: list[str], where: dict[str, int]) -> list[str]:
        t = float(row[where["t_s"]])
        row[where["t_s"]] = f"{t + (60.0 if t > 2.0 else 0.0):.6f}"
        return row

    def short(row: list[str], where: dict[str, int]) -> list[str] | None:
        return row if float(row[where["t_s"]]) < 0.4 else None

    def mute(row: list[str], where: dict[str, int]) -> list[str]:
        row[where["pwm1"]] = row[where["pwm2"]] = ""
        return row

    def blind(row: list[str], where: dict[str, int]) -> list[str]:
        if row[where["u_px"]]:
            row[where["u_px"]] = "nan"
        return row

    def share(row: list[str], where: dict[str, int]) -> list[str]:
        row[where["pwm1"]] = "0.9" if row[where["pwm1"]] else ""
        return row

    def percent(row: list[str], where: dict[str, int]) -> list[str]:
        if row[where["pwm1"]]:
            row[where["pwm1"]], row[where["pwm2"]] = "100", "39.2"
        return row

    for change, words in (
        (share, "pwm1 and pwm2 are 0.9 at most, expected 0 to 255"),
        (percent, "pwm1 and pwm2 are 100 at most and not whole, as a percentage"),
        (late, "the clock jumps"),
        (short, "expected at least 40"),
        (mute, "has no commands"),
        (blind, "has no marker"),
    ):
        ended = calib("identify", _edit(log, tmp_path / "log.csv", change), "--rig", rig)
        assert ended.code == 3
        assert words in ended.sentence
    assert "actuator" not in yaml.safe_load(rig.read_text())


def test_a_log_at_rest_names_what_it_cannot_tell(calib: Run, rig: Path, tmp_path: Path) -> None:
    still = log_file(tmp_path / "static.csv", SimulatedRig(), "static", 0, 4.0)
    ended = calib("identify", still, "--rig", rig)
    assert ended.code == 3
    for words in ("cannot tell any parameter", "stiffness (of the nominal)", "bending", "creep lambda1"):
        assert words in ended.sentence


@pytest.mark.slow
def test_a_pump_and_both_its_models(calib: Run, tables: list[Path], tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib(
        "identify", "pump", *tables[:2], "--held", tables[2], "--rig", rig, "--figures", tmp_path / "f"
    )
    assert ended.code in (0, 1)
    for words in ("linear lag", "orifice flow", "RMS on files not fitted, kPa", "RMS on the tables kept out"):
        assert words in ended.out
    section = yaml.safe_load(rig.read_text())["pump"]
    assert section["lag_s"] == pytest.approx(0.5, rel=0.03)
    assert section["identified"]["better"] == "linear lag"
    assert (tmp_path / "f" / "pump_runs.png").exists()
    # Tables of two folders may have one name.
    alike = [tmp_path / place / "runs.csv" for place in ("a", "b")]
    for table, path in zip(tables, alike, strict=False):
        path.parent.mkdir()
        path.write_bytes(table.read_bytes())
    document = json.loads(calib("identify", "pump", *alike, "--rig", rig, "--json").out)
    models = document["pump"]["identified"]["models"].values()
    assert all(set(one["held_by_file"]) == {"runs.csv", "runs.csv (2)"} for one in models)
    document = json.loads(calib("identify", "pump", *tables[:1], "--rig", rig, "--json").out)
    assert document["verb"] == "identify pump"


def test_pump_tables_that_cannot_be_used(calib: Run, tables: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    text = tables[0].read_text()
    for changed, words in (
        (text.replace("Pressure", "Flow"), "has no pressure or force"),
        (text.replace("PWM", "Duty"), "has no PWM"),
        ("\n".join(text.splitlines()[:6]) + "\n", "has 5 rows"),
        (text.replace("\n0.5,", "\n90.5,"), "time"),
        (text.replace("\n0.5,", "\n0.5,nan,"), "cells"),
    ):
        path.write_text(changed)
        ended = calib("identify", "pump", path, "--rig", tmp_path / "rig.yaml")
        assert ended.code == 3
        assert words in ended.sentence


def test_springs_from_weights(calib: Run, tmp_path: Path) -> None:
    eps = np.linspace(0.003, 0.026, 9)
    mass_g = 2.0 * (47.7 + 1092.9 * eps) * eps / 9.81e-3
    path, rig = tmp_path / "weights.csv", tmp_path / "rig.yaml"
    path.write_text(
        "mass_g,elongation_mm\n"
        + "".join(f"{m:.4f},{1e3 * e:.4f}\n" for m, e in zip(mass_g, eps, strict=True))
    )
    rig.write_text("schema: 2\nactuator: {verdict: ok, remarks: [of logs], advice: [another log]}\n")
    ended = calib("identify", "stiffness", path, "--rig", rig, "--figures", tmp_path / "f")
    assert ended.code == 0
    assert "order 2 (used)" in ended.out and "of logs" not in ended.out and "next:" not in ended.out
    section = yaml.safe_load(rig.read_text())["actuator"]
    assert section["k0_N_per_m"] == pytest.approx(47.7, rel=1e-3)
    assert (tmp_path / "f" / "identify_stiffness.png").exists()
    path.write_text("mass_g\n1\n")
    assert calib("identify", "stiffness", path, "--rig", rig).code == 3
    path.write_text("elongation_m,force_N\n0.005,1\n10,2\n")
    ended = calib("identify", "stiffness", path, "--rig", rig)
    assert ended.code == 3
    assert "line 3: elongation_m is 10, expected at most 1; of another unit?" in ended.sentence


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_file(tmp_path_factory.mktemp("log") / "swing.csv", SimulatedRig(), "swing", 0, 3.0)


def _rig(folder: Path, **sections: Any) -> Path:
    path = folder / "rig.yaml"
    rig_file(path, **sections)
    return path


def test_both_models_in_one_table_and_figures(calib: Run, tmp_path: Path, log: Path) -> None:
    rig = _rig(
        tmp_path, known=Known(actuator=KnownActuator(stiffness_scale=0.8, damping_scale_free_swing=5.0))
    )
    drawn = tmp_path / "drawn"
    ended = calib("validate", log, "--rig", rig, "--figures", drawn, "--json")
    assert ended.code == 0, ended.err
    (told,) = json.loads(ended.out)["validate"]["logs"]
    assert list(told["models"]) == ["original", "nominal", "improved"]
    # The log is of the nominal rig, so the other parameters are worse.
    phi = {name: model["phi"] for name, model in told["models"].items()}
    assert phi["nominal"]["rms_rad"] < 0.02 < phi["improved"]["rms_rad"]
    assert phi["original"]["rms_rad"] > 3.0 * phi["nominal"]["rms_rad"]
    assert told["smaller_by_percent"]["nominal"]["phi"] > 60.0
    ratio = phi["original"]["norm_rad"] / phi["original"]["rms_rad"]
    assert ratio == pytest.approx(told["poses"] ** 0.5)
    assert [path.name for path in drawn.iterdir()] == ["validate_model.png"]


def test_a_log_with_its_true_parameters(tmp_path: Path) -> None:
    """The start is the estimator's, which by then another file has had compiled."""
    rig, truth = varied(2)
    keys = ("stiffness_scale", "damping_scale_pumps_connected", "bending_N_per_rad2", "lambda1_per_s")
    keys += "lambda2_N_per_m", "damping_scale_free_swing", "rest_length_m"
    actuator = {key: truth[key] for key in keys}
    pump = {key: truth[key] for key in ("lag_s", "lag_ratio", "falling_N_per_s")}
    pump["strength"] = [truth["strength1"], truth["strength2"]]
    path = tmp_path / "rig.yaml"
    stated = Known(actuator=KnownActuator(**actuator, lambda3=-1.0), pump=KnownPump(**pump))
    known = rig_file(path, known=stated)
    log = log_file(tmp_path / "log.csv", rig, "prbs", 1, 6.0)
    files = Files((log,), path)
    track, start = begun_track(files, log, known, PoseOptions(truth=True))
    found = compare(track, models_of(known), start)
    assert found.how == "truth" and found.hoses
    assert found.errors[IMPROVED]["q1"].rms < 1e-5 and found.errors[IMPROVED]["phi"].rms < 1e-3
    assert found.improvement_percent("q1") > 99.0
    track, start = begun_track(Files((log,), path), log, known, PoseOptions())
    seen = compare(track, models_of(known), start)
    assert seen.how == "pictures"
    # The marker's place comes in whole pixels of a third of a millimetre and more.
    assert 1e-4 < seen.errors[IMPROVED]["q1"].rms < 1e-3
    assert seen.errors[IMPROVED]["q1"].fit_percent > seen.errors[ORIGINAL]["q1"].fit_percent


def test_bad_input_is_one_sentence(calib: Run, tmp_path: Path, log: Path) -> None:
    ended = calib("validate", log, cwd=tmp_path)
    assert ended.code == 3 and "camera" in ended.sentence
    short = tmp_path / "short.csv"
    short.write_text("\n".join(log.read_text().splitlines()[:40]) + "\n")
    ended = calib("validate", short, "--rig", _rig(tmp_path))
    assert ended.code == 3 and "short.csv" in ended.sentence


def test_a_log_and_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate("swing", tmp_path / "log.csv", duration="2s")
    shown = capsys.readouterr()
    log = read_log(tmp_path / "log.csv")
    assert len(log) == 120 + 200
    assert f"swing: 2 s, 320 rows written to {tmp_path / 'log.csv'}" in shown.out
    assert "damping_ratio 0.0544" in shown.out
    assert "simulated" in shown.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scenario": "wobble"}, "SCENARIO: 'wobble' is not one of"),
        ({"duration": "-1s"}, "--duration: '-1s' is not positive"),
        ({"scenario": "rig", "duration": "1s"}, "--set and --duration do not apply"),
    ],
)
def test_words_that_do_not_fit(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        simulate(**{"scenario": "swing", "output": tmp_path / "log.csv", **arguments})
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"settings": ["length_m=-0.065"]}, "expected positive lengths"),
        ({"duration": "3h"}, "duration: found 10800 s"),
        ({"rig": Path("none.yaml")}, r"none\.yaml: cannot be read: there is no such file"),
        ({"output": Path("nowhere/log.csv")}, "there is no folder"),
    ],
)
def test_input_that_cannot_be_used(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        simulate(**{"scenario": "swing", "output": tmp_path / "log.csv", **arguments})
    assert not any(tmp_path.iterdir())

"""`calib validate` from the command line: what it says, and that it writes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from identifytrials import log_file, rig_file

from calib.twin.rig import SimulatedRig

Run = Callable[..., Any]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_file(tmp_path_factory.mktemp("log") / "swing.csv", SimulatedRig(), "swing", 0, 3.0)


def _rig(folder: Path, **sections: Any) -> Path:
    path = folder / "rig.yaml"
    rig_file(path, **sections)
    return path


def test_a_log_against_the_original_model_alone(calib: Run, tmp_path: Path, log: Path) -> None:
    rig = _rig(tmp_path)
    before = rig.read_bytes()
    ended = calib("validate", log, "--rig", rig)
    assert ended.code == 0, ended.err
    assert "swing.csv: " in ended.out and "from pictures, hoses off" in ended.out
    assert "phi, rad, original" in ended.out and "phi, rad, nominal" in ended.out
    assert "improved" not in ended.out and "start by the estimator" in ended.out
    assert "has no section actuator or pump: the improved model has nominal parameters" in ended.err
    assert rig.read_bytes() == before


def test_both_models_in_one_table_and_figures(calib: Run, tmp_path: Path, log: Path) -> None:
    rig = _rig(tmp_path, actuator={"stiffness_scale": 0.8, "damping_scale_free_swing": 5.0})
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


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("LOG", "--states", "a.csv", "--states", "b.csv"), "2 files for 1 logs"),
        (("LOG", "--states", "a.csv", "--truth"), "--truth: takes the true columns"),
    ],
)
def test_options_that_do_not_go_together(
    calib: Run, tmp_path: Path, log: Path, words: tuple[str, ...], sentence: str
) -> None:
    given = [log if word == "LOG" else word for word in words]
    ended = calib("validate", *given, cwd=tmp_path)
    assert ended.code == 2 and sentence in ended.sentence
    assert not list(tmp_path.iterdir())


def test_bad_input_is_one_sentence(calib: Run, tmp_path: Path, log: Path) -> None:
    ended = calib("validate", log, cwd=tmp_path)
    assert ended.code == 3 and "camera" in ended.sentence
    rig = _rig(tmp_path, actuator={"stiffness_scale": -1.0})
    ended = calib("validate", log, "--rig", rig)
    assert ended.code == 3 and "actuator.stiffness_scale" in ended.sentence
    short = tmp_path / "short.csv"
    short.write_text("\n".join(log.read_text().splitlines()[:40]) + "\n")
    ended = calib("validate", short, "--rig", _rig(tmp_path))
    assert ended.code == 3 and "short.csv" in ended.sentence

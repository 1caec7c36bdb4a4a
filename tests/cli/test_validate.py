"""`calib validate` from the command line: what it says, and that it writes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from identifytrials import log_file, rig_file

from calib.claims.album import ALBUM
from calib.claims.book import BOOK
from calib.twin.rig import SimulatedRig

Run = Callable[..., Any]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_file(tmp_path_factory.mktemp("log") / "swing.csv", SimulatedRig(), "swing", 0, 3.0)


def _rig(folder: Path, **sections: Any) -> Path:
    path = folder / "rig.yaml"
    rig_file(path, **sections)
    return path


@pytest.mark.slow
def test_without_a_log_the_book_is_examined(calib: Run, tmp_path: Path) -> None:
    ended = calib("validate", cwd=tmp_path)
    assert ended.code == 0, ended.err
    lines = ended.out.splitlines()
    assert [line.split()[0] for line in lines[1 : 1 + len(BOOK)]] == [claim.id for claim in BOOK]
    assert f"{len(BOOK)} of {len(BOOK)} claims: " in ended.out
    assert "printed: 4.45e-5" in ended.out and "refuted: " in ended.out
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_book_as_one_document_and_the_same_again(calib: Run, tmp_path: Path) -> None:
    first, again = (calib("validate", "--claims", "--json", cwd=tmp_path) for _ in range(2))
    assert first.code == 0 and first.out == again.out
    told = json.loads(first.out)
    assert (told["schema"], told["verb"], told["validate"]["logs"]) == (1, "validate", [])
    claims = {one["id"]: one for one in told["validate"]["claims"]}
    assert len(claims) == len(BOOK) and told["validate"]["not_examined"] == 0
    assert sum(told["validate"]["outcomes"].values()) == len(BOOK)
    assert claims["kin.rotation"]["outcome"] == "refuted" and claims["ctl.p"]["simulated"] is True


@pytest.mark.slow
def test_figures_of_the_source_and_their_index(calib: Run, tmp_path: Path) -> None:
    ended = calib("validate", "--figures", "drawn", "--json", cwd=tmp_path)
    assert ended.code == 0, ended.err
    told = json.loads(ended.out)["validate"]["figures"]
    assert len(told) == len(ALBUM) + 2 and {path.name for path in (tmp_path / "drawn").iterdir()} == set(told)
    index = json.loads((tmp_path / "drawn" / "figures.json").read_text())["figures"]
    assert [row["number"] for row in index] == [one.number for one in ALBUM]
    assert "49 simulated figures" in ended.err


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
    assert "claims" not in json.loads(ended.out)["validate"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--truth",), "need a LOG"),
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

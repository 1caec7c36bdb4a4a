"""rig.yaml from the command line: what no rig has is refused by every verb, in the same sentence."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from identifytrials import log_file

from calib.twin.rig import SimulatedRig

from .conftest import Run

BAD = yaml.safe_load((Path(__file__).parent / "rig_values.yaml").read_text())


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_file(tmp_path_factory.mktemp("log") / "steps.csv", SimulatedRig(), "steps", 0, 3.0)


def _verbs(rig: Path, log: Path, out: Path) -> list[tuple[str | Path, ...]]:
    return [
        ("replay", log, "--rig", rig, "--model", "driven"),
        ("replay", log, "--rig", rig, "--model", "kinematic"),
        ("simulate", "swing", "--duration", "1s", "-o", out / "x.csv", "--rig", rig),
        ("control", "check", "elongation", "--rig", rig),
        ("control", "tune", "--rig", rig),
        ("firmware", "-o", out / "firmware", "--rig", rig),
        ("validate", log, "--rig", rig),
        ("identify", log, "--rig", rig),
        ("align", log, "--rig", rig),
        ("report", rig),
        ("run", rig.parent, "-o", out / "out"),
        ("diff", rig, rig),
    ]


@pytest.mark.parametrize("at", range(len(BAD)), ids=[f"{one['line']}, schema {one['schema']}" for one in BAD])
def test_every_verb_refuses_it_in_the_same_sentence(
    calib: Run, rig: Path, log: Path, tmp_path: Path, at: int
) -> None:
    """Three verbs in turn for each value, so that each verb meets many."""
    bad: dict[str, Any] = BAD[at]
    text = rig.read_text()
    assert text.startswith("schema: 2\n")
    rig.write_text((text if bad["schema"] == 2 else text.removeprefix("schema: 2\n")) + bad["line"] + "\n")
    before = rig.read_bytes()
    (tmp_path / "logs").mkdir()
    shutil.copy(log, tmp_path / "logs")
    for words in _verbs(rig, log, tmp_path)[at % 4 :: 4]:
        ended = calib(*words)
        assert (ended.code, ended.sentence) == (3, f"{rig}: {bad['says']}"), words
    assert rig.read_bytes() == before


def test_a_file_of_a_later_schema_is_left_alone(calib: Run, rig: Path) -> None:
    rig.write_text(rig.read_text().replace("schema: 2", "schema: 3") + "holograms: {a: 1}\n")
    ended = calib("firmware", "--rig", rig)
    assert ended.code == 3
    assert "schema is 3, and this version of calib reads files up to 2" in ended.sentence


def test_what_a_person_wrote_into_a_file_of_schema_1_is_known_afterwards(
    calib: Run, rig: Path, project_root: Path
) -> None:
    text = rig.read_text().removeprefix("schema: 2\n")
    rig.write_text(text + "actuator: {mass_kg: 0.018, sigma: {mass_kg: 0.001}}\npump: {lag_s: 0.6}\n")
    assert calib("extrinsics", project_root / "images" / "plane", "--rig", rig).code == 0
    after = yaml.safe_load(rig.read_text())
    assert after["schema"] == 2
    assert after["known"] == {
        "actuator": {"mass_kg": 0.018, "sigma": {"mass_kg": 0.001}},
        "pump": {"lag_s": 0.6},
    }
    assert "actuator" not in after and "pump" not in after

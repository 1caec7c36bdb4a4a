"""The work on one rig: every failure is an outcome, and nothing is left behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.fleet import task
from calib.fleet.manifest import RigSpec
from calib.fleet.outcome import SAME
from calib.fleet.task import FleetOptions, calibrate_rig, peak_memory_MB, program


def _folder(tmp_path: Path) -> Path:
    images = tmp_path / "rig" / "images"
    images.mkdir(parents=True)
    (images / "a.png").write_bytes(b"no picture")
    (images / "board.yaml").write_text("corners: [7, 5]\nsquare_m: 0.02\n")
    return images.parent


def test_pictures_that_are_none_fail_alone_and_are_not_tried_twice(tmp_path: Path) -> None:
    spec = RigSpec("a", str(_folder(tmp_path)), "7")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    found = calibrate_rig(spec, FleetOptions(), scratch=str(scratch)).outcome
    assert (found.name, found.serial, found.status, found.code) == ("a", "7", "failed", 3)
    assert found.stages == {"intrinsics": "failed", "extrinsics": "skipped", "distortion": "blocked"}
    assert "a.png" in found.sentence and found.key and found.seconds > 0.0
    assert not list(scratch.iterdir())
    # The same inputs again: as before. Another option, or another byte: not.
    assert calibrate_rig(spec, FleetOptions(), found.key).outcome.status == SAME
    other = RigSpec("a", spec.source, "7", (("model", "radial2"),))
    assert calibrate_rig(other, FleetOptions(), found.key).outcome.status == "failed"
    (tmp_path / "rig" / "images" / "a.png").write_bytes(b"still no picture")
    assert calibrate_rig(spec, FleetOptions(), found.key).outcome.status == "failed"


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    found = calibrate_rig(RigSpec("a", str(tmp_path / "none")), FleetOptions()).outcome
    assert (found.status, found.code, found.key) == ("failed", 3, "")
    assert found.sentence.endswith("is not there, expected the rig's folder")


def test_a_fault_of_the_program_is_an_outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(*_: object) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(task, "run_stages", faulty)
    found = calibrate_rig(RigSpec("a", str(_folder(tmp_path))), FleetOptions()).outcome
    assert (found.status, found.code) == ("broken", 70)
    assert found.sentence == "internal error: ZeroDivisionError: oh"


def test_memory_and_program() -> None:
    assert peak_memory_MB() > 10.0
    assert len(program()) == 64 and program() == program()


def test_the_outcome_has_no_secret_in_it() -> None:
    found = calibrate_rig(RigSpec("a", "nothing://user:word@host/a?key=1"), FleetOptions()).outcome
    assert found.source == "nothing://host/a" and found.status == "failed"
    assert "word" not in found.sentence and "key" not in found.sentence

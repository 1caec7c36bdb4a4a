"""The table of stages: each after those whose sections it reads, each verb with the options it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from running_trials import make_folder

from calib.cli.app import app
from calib.cli.run import is_available
from calib.rig import SECTIONS
from calib.running.folder import read_folder
from calib.running.stages import STAGES, Stage, jobs_of, urgency


def test_every_stage_comes_after_what_it_reads() -> None:
    written: dict[str, str] = {}
    for stage in STAGES:
        for name in (*stage.needs, *stage.uses):
            assert name in SECTIONS
            later = [other.name for other in STAGES if name in other.writes]
            assert not later or name in written or name not in stage.needs, (stage.name, name)
            # A section that a later stage writes would make the two wait for each other.
            assert name in written or not later, (stage.name, name)
        written |= dict.fromkeys(stage.writes, stage.name)


def test_names_are_unique_and_safe() -> None:
    names = [stage.name for stage in STAGES]
    assert len(set(names)) == len(names)
    assert all(name.replace("-", "").isalnum() for name in names)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_verb_has_the_options_that_the_runner_gives(stage: Stage) -> None:
    assert is_available(stage.verb)
    command: Any = typer.main.get_command(app)
    for word in stage.verb:
        command = command.commands[word]
    options = {name for parameter in command.params for name in parameter.opts}
    assert {"--rig", "--json"} <= options
    assert not stage.figures or "--figures" in options
    assert not stage.output or "-o" in options


def test_what_there_is_no_verb_for() -> None:
    assert is_available(("imu", "static"))
    assert not is_available(("imu",))
    assert not is_available(("imu", "nonsense"))
    assert not is_available(("nonsense",))


def test_a_folder_with_little_says_what_is_lacking(tmp_path: Path) -> None:
    folder = read_folder(make_folder(tmp_path / "rig"))
    jobs = {job.name: job for job in jobs_of(folder)}
    assert jobs["intrinsics"].planned is not None
    assert "images/plane" in jobs["extrinsics"].reason
    assert "logs/static" in jobs["imu-static"].reason
    assert {"replay-one", "replay-two"} <= set(jobs)
    assert jobs["replay-one"].planned is not None
    assert "IMU" in jobs["align"].reason


def test_plane_with_a_link_out_is_not_handed_to_the_verb(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    (root / "images" / "plane").mkdir()
    (root / "images" / "plane" / "p.png").write_bytes(b"p")
    (tmp_path / "secret.png").write_bytes(b"s")
    (root / "images" / "plane" / "q.png").symlink_to(tmp_path / "secret.png")
    jobs = {job.name: job for job in jobs_of(read_folder(root))}
    assert jobs["extrinsics"].planned is None
    assert "link out of the folder" in jobs["extrinsics"].reason


def test_what_others_wait_for_is_more_urgent_than_they_are() -> None:
    first = urgency()
    for stage in STAGES:
        for other in STAGES:
            if set(stage.writes) & {*other.needs, *other.uses}:
                assert first[stage.name] >= first[other.name] + stage.seconds
    assert min(first["identify"], first["control"]) > first["replay"] > first["firmware"]

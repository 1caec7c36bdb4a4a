"""The table of stages: each after those whose sections it reads, each verb with the options it is given."""

from __future__ import annotations

from pathlib import Path

from running_trials import make_folder

from calib.core.rig import SECTIONS
from calib.runner.folder import read_folder
from calib.runner.graph import STAGES, jobs_of


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

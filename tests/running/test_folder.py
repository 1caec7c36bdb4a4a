"""What a rig folder holds, odd names and links included."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trials import make_folder, run_small

from calib.core.errors import BadInputError
from calib.runner.folder import read_folder, with_topics


def test_kinds_of_logs_and_their_columns(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    (root / "logs" / "static1.csv").write_text("# a note\n\nt_s, gz_radps\n0,1\n")
    (root / "logs" / "poses.csv").write_text("t_s,ax_mps2\n")
    (root / "logs" / "notes.txt").write_text("none")
    (root / "logs" / ".hidden.csv").write_text("t_s\n")
    folder = read_folder(root)
    assert {log.slug: log.kind for log in folder.logs} == {
        "one": "motion", "two": "motion", "poses": "poses", "static1": "rest",
    }  # fmt: skip
    static = next(log for log in folder.logs if log.kind == "rest")
    assert static.columns == ("t_s", "gz_radps")
    assert static.has("gz_radps") and not static.has("ax_mps2")


@pytest.mark.parametrize("make", ["nothing", "empty", "file"])
def test_what_is_no_rig_folder(tmp_path: Path, make: str) -> None:
    path = tmp_path / "rig"
    if make == "empty":
        path.mkdir()
    elif make == "file":
        path.write_text("")
    with pytest.raises(BadInputError, match="rig"):
        read_folder(path)


def test_links_out_of_the_folder_are_left_out_and_named(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    secret = tmp_path / "secret.csv"
    secret.write_text("t_s,u_px,v_px\n0,1,2\n")
    (root / "logs" / "linked.csv").symlink_to(secret)
    (root / "logs" / "within.csv").symlink_to(root / "logs" / "one.csv")
    (root / "logs" / "dangling.csv").symlink_to(tmp_path / "nowhere")
    (root / "images" / "c.png").symlink_to(secret)
    folder = read_folder(root)
    assert [log.slug for log in folder.logs] == ["one", "two", "within"]
    assert [path.name for path in folder.pictures] == ["a.png", "b.png"]
    assert len(folder.left_out) == 3
    assert any("link out of the folder" in sentence for sentence in folder.left_out)
    followed = read_folder(root, follow_links=True)
    assert [log.slug for log in followed.logs] == ["linked", "one", "two", "within"]


def test_a_linked_folder_of_logs_is_a_link_out_as_well(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x.csv").write_text("t_s\n")
    for path in (root / "logs").iterdir():
        path.unlink()
    (root / "logs").rmdir()
    (root / "logs").symlink_to(tmp_path / "other")
    assert read_folder(root).logs == ()


@pytest.mark.parametrize("name", ["a\nb", "a..", "-rf", "<script>", "a;b'\"", "é", "x" * 200, "a b"])
def test_odd_names_stay_inside_and_run(tmp_path: Path, name: str) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    (root / "logs" / f"{name}.csv").write_text("t_s,u_px,v_px\n0,1,2\n")
    run_small(root, out)
    states = sorted(path.name for path in (out / "states").iterdir())
    assert len(states) == 3
    assert all(path.parent.parent == tmp_path or path.is_relative_to(out) for path in out.rglob("*"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "rig"]
    assert all(part.isascii() and part.isprintable() for part in states)


def test_bags_are_logs_with_the_file_that_explains_them(tmp_path: Path) -> None:
    import numpy as np
    from bags import readings, write_bag

    root = make_folder(tmp_path / "rig")
    bag = write_bag(root / "logs", "json", readings(np.random.default_rng(0), 0.2))
    log = next(log for log in read_folder(root).logs if log.path == bag)
    assert log.has("u_px", "gz_radps", "pwm1") and not log.has("true_q1_m")
    topics = root / "logs" / "log.topics.yaml"
    topics.write_text("topics:\n  /imu/data: {gz_radps: gz_radps}\n")
    folder = read_folder(root)
    log = next(log for log in folder.logs if log.path == bag)
    assert log.columns == ("gz_radps",) and topics in folder.files()
    assert with_topics([bag, bag]) == (bag, topics)
    topics.rename(tmp_path / "elsewhere.yaml")
    topics.symlink_to(tmp_path / "elsewhere.yaml")
    assert all(log.path != bag for log in read_folder(root).logs)
    topics.unlink()
    bag.write_bytes(b"\x89MCAP0\r\nbroken")
    assert next(log for log in read_folder(root).logs if log.path == bag).columns is None

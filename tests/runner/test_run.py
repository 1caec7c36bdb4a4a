"""The run: what is reused, what a failure stops, faults and kills at every write, and what a folder holds."""

from __future__ import annotations

import copy
import errno
import json
import os
import random
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from pages import finished_run
from running_trials import CALLS, Inline, exit_code, make_folder, run_small

from calib.core.errors import BadInputError
from calib.core.rig import KINDS
from calib.core.workers import Task
from calib.io.columns import STATES
from calib.runner.decision import read_summary
from calib.runner.folder import read_folder
from calib.runner.graph import HIDDEN, STEPS, Job, Runner, jobs_of, opened_run
from calib.runner.outputs import run_folder
from calib.show.page import keep_pictures, page_text, write_page

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="killing is POSIX's")


@pytest.fixture(autouse=True)
def _no_calls() -> None:
    CALLS.clear()


def _status(ended: Sequence[Job]) -> dict[str, str]:
    return {job.name: job.status for job in ended}


def _bytes(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "lock"
    }


def test_second_run_reuses_all_and_gives_the_same_bytes(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    before = _bytes(out)
    CALLS.clear()
    ended = run_small(root, out)
    assert CALLS == []
    assert all(job.reused for job in ended if job.status == "ok")
    assert _bytes(out) == before


def test_one_changed_log_runs_one_stage(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    CALLS.clear()
    (root / "logs" / "two.csv").write_text("t_s,u_px,v_px\n0,7,7\n")
    run_small(root, out)
    assert CALLS == ["each-two"]


def test_states_of_a_log_that_is_gone_go_and_other_files_stay(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    (out / "states" / "mine.csv").write_text("kept")
    (root / "logs" / "two.csv").unlink()
    run_small(root, out)
    assert sorted(p.name for p in (out / "states").iterdir()) == ["mine.csv", "one.csv"]


def test_a_failure_stops_only_what_needs_it(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    ended = run_small(root, out, Inline({"first": 3}))
    status = _status(ended)
    assert status["first"] == "failed"
    assert status["lone"] == "ok"
    assert {status[name] for name in ("second", "each-one", "firmware")} == {"blocked"}
    reasons = {job.name: job.reason for job in ended}
    assert reasons["first"] == "first cannot"
    assert "First has failed" in reasons["second"]
    assert exit_code(out) == 3
    # A failure is tried again, and what it stopped goes on.
    CALLS.clear()
    run_small(root, out)
    assert exit_code(out) == 0
    assert "lone" not in CALLS and "first" in CALLS


def test_the_low_pass_is_shown_on_the_first_log_that_can_be_used(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    step = next(step for step in STEPS if step.name == "lowpass")

    class Fails(Inline):
        def start(self, task: Task) -> None:
            self.codes = {"lowpass": 3 if task.arguments[4].get("log") == root / "logs" / "one.csv" else 0}
            super().start(task)

    with opened_run(out, root):
        (job,) = run_folder(
            Runner(read_folder(root), out, Fails(), steps=(replace(step, writes=()),)), page=False
        ).ended
    assert CALLS == ["lowpass", "lowpass"]
    assert job.status == "ok"
    assert job.inputs == (root / "logs" / "two.csv",)


def test_a_poor_result_is_used_and_kept_poor(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    for _ in range(2):
        ended = run_small(root, out, Inline({"first": 1}))
        assert _status(ended)["first"] == "poor"
        assert ended[0].reason == "it is weak"
        assert _status(ended)["firmware"] == "ok"
        assert exit_code(out) == 1
    assert CALLS.count("first") == 1


def test_what_a_person_states_is_kept_and_an_old_result_is_not(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    text = "estimator: {jitter_px: 99.0, verdict: ok}\nactuator: {mass_kg: 0.018}\n"
    (root / "rig.yaml").write_text(text + "geometry: {workspace_m: [0, 0, 1, 1]}\n")
    run_small(root, tmp_path / "out")
    rig = yaml.safe_load((tmp_path / "out" / "rig.yaml").read_text())
    assert rig["known"] == {"actuator": {"mass_kg": 0.018}}
    assert rig["geometry"]["workspace_m"] == [0.0, 0.0, 1.0, 1.0]
    assert rig["estimator"]["jitter_px"] < 20.0


def test_a_damaged_result_is_made_again(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    before = _bytes(out)
    (out / HIDDEN / "stages" / "each-one" / "states.csv").write_text("torn")
    (out / HIDDEN / "stages" / "second" / "result.json").write_text("{")
    (out / HIDDEN / "stages" / "lone" / "document.json").write_text(
        '{"schema": 1, "lone": {"verdict": "ok"}}'
    )
    CALLS.clear()
    run_small(root, out)
    assert sorted(CALLS) == ["each-one", "lone", "second"]
    assert _bytes(out) == before


def test_an_input_that_changes_meanwhile_is_refused(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"

    def during(name: str) -> None:
        if name == "each-one":
            with (root / "logs" / "one.csv").open("a") as stream:
                stream.write("1,2,3\n")

    ended = run_small(root, out, Inline(during=during))
    assert "changed while it was read" in next(job.reason for job in ended if job.name == "each-one")
    assert not (out / "states" / "one.csv").exists()
    run_small(root, out)
    assert exit_code(out) == 0


def test_links_in_the_output_folder_are_refused(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    (tmp_path / "elsewhere").mkdir()
    out.mkdir()
    (out / "states").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadInputError, match="symbolic link"):
        run_small(root, out)
    assert not any((tmp_path / "elsewhere").iterdir())


def test_the_folder_itself_is_no_output_folder(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    with pytest.raises(BadInputError, match="folder that is read"), opened_run(root / "logs", root):
        pass


def _writes(out: Path, kill_at: int | None) -> int:
    """Run in a child that is killed at its n-th write; returns how many writes it saw, -1 when killed."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        seen = 0

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal seen
            writes = event in ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod")
            if event == "open" and isinstance(arguments[2], int):
                writes = bool(arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            if writes:
                seen += 1
                if seen == kill_at:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        try:
            run_small(out.parent / "rig", out)
            os.write(write, str(seen).encode())
        finally:
            os._exit(0)
    os.close(write)
    told = os.read(read, 64)
    os.close(read)
    os.waitpid(child, 0)
    return int(told) if told else -1


@pytest.mark.slow
def test_killed_at_any_write_it_ends_in_the_same_bytes(tmp_path: Path) -> None:
    make_folder(tmp_path / "rig")
    whole = tmp_path / "whole"
    count = _writes(whole, None)
    assert count > 60
    wanted = _bytes(whole)
    for kill_at in range(1, count + 1):
        out = tmp_path / f"out{kill_at}"
        assert _writes(out, kill_at) == -1
        assert _writes(out, None) > 0
        assert _bytes(out) == wanted, kill_at


KILL = -1
"""In place of an error's number: the process is killed there."""
WRITES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "os.chown", "os.link")


def _whole_run(root: Path, out: Path) -> None:
    """All that `calib run` writes, with verbs that take no time."""
    run_small(root, out)
    keep_pictures(read_folder(root).pictures, out / HIDDEN / "pictures")
    write_page(out / "rig.yaml")


def _in_child(root: Path, out: Path, number: int, fail_at: int = 0, largest: int | None = None) -> str:
    """Run in a child in which a write fails; returns how it ended, and how many writes there were."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        seen = 0

        def count() -> None:
            nonlocal seen
            seen += 1
            if seen == fail_at and number == KILL:
                os.kill(os.getpid(), signal.SIGKILL)
            if seen == fail_at:
                raise OSError(number, os.strerror(number))

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            flags = arguments[2] if event == "open" else 0
            opened = isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            if event in WRITES or opened:
                count()

        fsync = os.fsync

        def synced(descriptor: int) -> None:
            count()
            fsync(descriptor)

        told = {"end": "done"}
        try:
            sys.addaudithook(hook)
            os.fsync = synced
            if largest is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))
            _whole_run(root, out)
        except BadInputError as error:
            told["end"] = f"refused: {error}"
        except BaseException as error:
            told["end"] = f"fault: {error!r} {traceback.format_exc()}"
        finally:
            os.write(write, json.dumps({**told, "seen": seen}).encode())
            os._exit(0)
    os.close(write)
    told = b""
    while part := os.read(read, 65536):
        told += part
    os.close(read)
    os.waitpid(child, 0)
    if not told:
        return "0 killed"
    ended = json.loads(told)
    return f"{ended['seen']} {ended['end']}"


def _check_public(out: Path, known: tuple[dict[str, bytes], ...]) -> None:
    """Every file that a person sees is one of a whole run, or is whole by itself."""
    for path in out.rglob("*"):
        name = path.relative_to(out).as_posix()
        if not path.is_file() or HIDDEN in path.parts or path.name.endswith(".tmp"):
            continue
        if name == "rig.yaml":
            assert isinstance(yaml.safe_load(path.read_text()), dict)
        elif name == "report.html":
            assert path.read_text().rstrip().endswith("</html>")
        elif name.startswith("firmware/"):
            assert path.read_text().endswith("]\n")
        else:
            assert path.read_bytes() in [one[name] for one in known if name in one], name


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, dict[str, bytes], dict[str, bytes]]:
    """A rig folder after a change, the results from before it, and the bytes of both."""
    root, out = make_folder(tmp_path / "rig"), tmp_path / "before"
    _whole_run(root, out)
    old = _bytes(out)
    (root / "images" / "a.png").write_bytes(b"another")
    (root / "logs" / "two.csv").unlink()
    (root / "logs" / "new.csv").write_text("t_s,u_px,v_px\n0,7,7\n")
    wanted = tmp_path / "wanted"
    shutil.copytree(out, wanted)
    _whole_run(root, wanted)
    return root, out, old, _bytes(wanted)


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, KILL])
def test_a_fault_at_any_write_is_one_sentence_and_the_next_run_ends_the_same(
    folders: tuple[Path, Path, dict[str, bytes], dict[str, bytes]], tmp_path: Path, number: int
) -> None:
    root, before, old, wanted = folders
    shutil.copytree(before, tmp_path / "counted")
    count = int(_in_child(root, tmp_path / "counted", number).split()[0])
    assert count > 80
    refused = 0
    # Permission is refused where the disk is full: every third write will do.
    for fail_at in range(1, count + 1, 3 if number == errno.EACCES else 1):
        out = tmp_path / f"out{fail_at}"
        shutil.copytree(before, out)
        ended = _in_child(root, out, number, fail_at).split(" ", 1)[1]
        assert ended in ("done", "killed") or ended.startswith("refused: "), (fail_at, ended)
        refused += ended != "done"
        _check_public(out, (old, wanted))
        assert _in_child(root, out, number).endswith(" done"), fail_at
        assert _bytes(out) == wanted, fail_at
        shutil.rmtree(out)
    assert refused > count // 16


@pytest.mark.few(0, 3)
@pytest.mark.parametrize("largest", [0, 1, 40, 300, 1000, 4000])
def test_files_that_cannot_grow(
    folders: tuple[Path, Path, dict[str, bytes], dict[str, bytes]], tmp_path: Path, largest: int
) -> None:
    """The kernel itself refuses to write, as on a full disk: in the middle of a file."""
    root, before, old, wanted = folders
    out = tmp_path / "out"
    shutil.copytree(before, out)
    ended = _in_child(root, out, 0, 0, largest).split(" ", 1)[1]
    assert ended == "done" or (ended.startswith("refused: ") and "File too large" in ended), ended
    _check_public(out, (old, wanted))
    assert not list(out.rglob("*.tmp"))
    assert _in_child(root, out, 0).endswith(" done")
    assert _bytes(out) == wanted


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
    # Where there is nothing else, the sentence on the folder says so.
    for path in (*root.glob("images/[ab].png"), *root.glob("logs/*.csv")):
        path.unlink()
    with pytest.raises(BadInputError, match=r"found .*; images/c\.png: is a link out of the folder"):
        read_folder(root)


def test_logs_of_one_stem_have_states_of_their_own(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    for ending in ("tsv", "parquet", "mcap"):
        (root / "logs" / f"one.{ending}").write_text("")
    assert len({log.slug for log in read_folder(root).logs}) == 5


def test_logs_of_a_bending_arm_are_told_their_verb(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    assert not read_folder(root).left_out
    (root / "logs" / "arm_1.csv").write_text("t_s,p_cmd1_kpa,p1_kpa\n0,1,1\n")
    (said,) = read_folder(root).left_out
    assert said == "logs/: of a bending arm, which calib identify arm takes: arm_1.csv"


def test_what_is_not_where_it_is_expected_is_named(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    assert read_folder(root).left_out == ()
    for name in ("images/day1", "images/dropped", "logs/tag1", "logs/.git", "notes", "plane"):
        (root / name).mkdir()
    for name in (
        "logs/swing1.txt",
        "logs/columns.yaml",
        "logs/one.columns.yaml",
        "logs/~$one.csv",
        "images/Thumbs.db",
        "images/view1.gif",
        "images/board.mp4",
        "rig.yml",
        "swing2.csv",
    ):
        (root / name).write_text("")
    for name in ("logs/states.csv", "states.csv"):
        (root / name).write_text(f"{','.join(STATES)}\n")
    (root / "swing2.csv").write_text("t_s,gz_radps\n0.0,0.1\n0.01,0.1\n")
    (root / "weights.csv").write_text("mass_g,elongation_mm\n0.0,0.1\n")
    read = read_folder(root)
    assert [sentence.split(" left out")[0] for sentence in read.left_out] == [
        "rig.yml: was",
        "plane: was",
        "swing2.csv: was",
        "images/: day1",
        "images/: board.mp4, view1.gif",
        "logs/: tag1",
        "logs/: swing1.txt",
        "logs/: states that calib replay has written,",
    ]
    assert [log.slug for log in read.logs] == ["one", "two"]
    for name in ("a.png", "b.png"):
        (root / "images" / name).unlink()
    assert [path.name for path in read_folder(root).pictures] == ["board.mp4"]
    other = tmp_path / "other"
    (other / "Images").mkdir(parents=True)
    if not (other / "images").is_dir():
        with pytest.raises(BadInputError, match="found Images; Images: was left out, expected"):
            read_folder(other)


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


def test_of_the_plane_one_video_is_read(tmp_path: Path) -> None:
    plane = make_folder(tmp_path / "rig") / "images" / "plane"
    plane.mkdir(exist_ok=True)
    for name in ("rest.mp4", "rest2.mp4"):
        (plane / name).write_text("")
    folder = read_folder(tmp_path / "rig")
    (job,) = (job for job in jobs_of(folder) if job.name == "extrinsics")
    assert job.paths == job.inputs == (plane.absolute() / "rest.mp4",)
    assert folder.left_out == (
        "images/plane/: rest2.mp4 left out, expected pictures, or where there are none one video",
    )


def test_states_are_those_of_motion_or_of_pictures(tmp_path: Path) -> None:
    logs = make_folder(tmp_path / "rig") / "logs"
    imu = "t_s,ax_mps2,ay_mps2,gz_radps\n0,1,2,3\n"
    for name in ("static1", "poses", "swing"):
        (logs / f"{name}.csv").write_text(imu)
    (logs / "static2.csv").write_text("t_s,u_px,v_px\n0,1,2\n")
    jobs = [job for job in jobs_of(read_folder(tmp_path / "rig")) if job.step.name == "replay"]
    skipped = [job.name for job in jobs if job.status == "skipped"]
    assert len(jobs) == 6 and skipped == ["replay-poses", "replay-static1"]


def test_every_stage_comes_after_what_it_reads() -> None:
    written: dict[str, str] = {}
    for stage in STEPS:
        for name in (*stage.needs, *stage.uses):
            assert name in KINDS
            later = [other.name for other in STEPS if name in other.writes]
            assert not later or name in written or name not in stage.needs, (stage.name, name)
            # A section that a later stage writes would make the two wait for each other.
            assert name in written or not later, (stage.name, name)
        written |= dict.fromkeys(stage.writes, stage.name)


WRONG: tuple[Any, ...] = (None, 0, 1.5, True, "", "<script>alert(1)</script>", [], {}, [1], ["a"], {"a": 1})


def _paths(value: Any, start: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [start, *(path for key, one in inner for path in _paths(one, (*start, key)))]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    rig = finished_run(tmp_path_factory.mktemp("page"))
    return rig, json.loads((rig.parent / ".calib" / "run.json").read_text())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[" * 100_000,
        "\0",
    ],
)
def test_what_is_no_summary(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    assert read_summary(tmp_path / "run.json") is None
    assert read_summary(tmp_path / "none.json") is None


def test_a_page_of_any_summary(run: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Values of other kinds, and keys that are gone: the page is made, of the rig's sections if need be."""
    rig, told = run
    place = tmp_path / "rig.yaml"
    place.write_bytes(rig.read_bytes())
    (tmp_path / ".calib").mkdir()
    dice = random.Random(1)
    for _ in range(30):
        other = copy.deepcopy(told)
        path = dice.choice(_paths(other)[1:])
        parent = other
        for key in path[:-1]:
            parent = parent[key]
        if dice.random() < 0.3:
            del parent[path[-1]]
        else:
            parent[path[-1]] = dice.choice(WRONG)
        (tmp_path / ".calib" / "run.json").write_text(json.dumps(other))
        assert "<script>alert" not in page_text(place), path

"""The run: what is run, what is reused, what a failure stops, and what is left when it is killed."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
import yaml
from running_trials import CALLS, Inline, make_folder, run_small

from calib.core.errors import BadInputError
from calib.runner.graph import HIDDEN, Done, opened
from calib.runner.outputs import exit_code

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="killing is POSIX's")


@pytest.fixture(autouse=True)
def _no_calls() -> None:
    CALLS.clear()


def _status(ended: list[Done]) -> dict[str, str]:
    return {done.job.name: done.status for done in ended}


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
    assert all(done.reused for done in ended if done.status == "ok")
    assert _bytes(out) == before


def test_one_changed_log_runs_one_stage(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    CALLS.clear()
    (root / "logs" / "two.csv").write_text("t_s,u_px,v_px\n0,7,7\n")
    run_small(root, out)
    assert CALLS == ["each-two"]


def test_a_changed_picture_runs_what_depends_on_it(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    run_small(root, out)
    CALLS.clear()
    (root / "images" / "a.png").write_bytes(b"another")
    run_small(root, out)
    assert sorted(CALLS) == ["each-one", "each-two", "firmware", "first", "second"]


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
    reasons = {done.job.name: done.reason for done in ended}
    assert reasons["first"] == "first cannot"
    assert "First has failed" in reasons["second"]
    assert exit_code(ended) == 3
    # A failure is tried again, and what it stopped goes on.
    CALLS.clear()
    assert exit_code(run_small(root, out)) == 0
    assert "lone" not in CALLS and "first" in CALLS


def test_a_poor_result_is_used_and_kept_poor(tmp_path: Path) -> None:
    root, out = make_folder(tmp_path / "rig"), tmp_path / "out"
    for _ in range(2):
        ended = run_small(root, out, Inline({"first": 1}))
        assert _status(ended)["first"] == "poor"
        assert ended[0].reason == "it is weak"
        assert _status(ended)["firmware"] == "ok"
        assert exit_code(ended) == 1
    assert CALLS.count("first") == 1


def test_no_pictures_skips_what_needs_them(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    for path in (root / "images").iterdir():
        path.unlink()
    ended = run_small(root, tmp_path / "out")
    assert _status(ended)["first"] == "skipped"
    assert "no pictures" in next(d.reason for d in ended if d.job.name == "second")
    assert exit_code(ended) == 1


def test_a_section_that_the_person_wrote_is_used_where_nothing_learns_it(tmp_path: Path) -> None:
    root = make_folder(tmp_path / "rig")
    (root / "rig.yaml").write_text("first: {value_m: 0.5}\ngeometry: {workspace_m: [0, 0, 1, 1]}\n")
    for path in (root / "images").iterdir():
        path.unlink()
    run_small(root, tmp_path / "out")
    rig = yaml.safe_load((tmp_path / "out" / "rig.yaml").read_text())
    assert rig["second"]["twice_m"] == 1.0
    assert rig["geometry"]["workspace_m"] == [0.0, 0.0, 1.0, 1.0]


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
    assert "changed while it was read" in next(d.reason for d in ended if d.job.name == "each-one")
    assert not (out / "states" / "one.csv").exists()
    assert exit_code(run_small(root, out)) == 0


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
    with pytest.raises(BadInputError, match="folder that is read"), opened(root / "logs", root):
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

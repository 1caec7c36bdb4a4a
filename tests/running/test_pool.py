"""Processes that run verbs: what was said, exit codes, and one that dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from calib.running.pool import Command, Pool


def _command(folder: Path, name: str, *words: str) -> Command:
    return Command(name, words, folder / f"{name}.out", folder / f"{name}.err")


@pytest.mark.slow
def test_verbs_one_after_another_and_one_that_dies(tmp_path: Path) -> None:
    with Pool(1) as pool:
        pool.start(_command(tmp_path, "version", "--version"))
        assert not pool.free
        assert list(pool.finished()) == [("version", 0)]
        assert (tmp_path / "version.out").read_text().startswith("calib ")
        pool.start(_command(tmp_path, "wrong", "firmware", "--rig", str(tmp_path / "none.yaml")))
        assert list(pool.finished()) == [("wrong", 3)]
        assert "has no camera yet" in (tmp_path / "wrong.err").read_text()
        pool.start(_command(tmp_path, "long", "simulate", "steps", "-o", str(tmp_path / "x.csv")))
        (process, _), *_ = pool._busy.values()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        assert list(pool.finished()) == [("long", 70)]
        pool.start(_command(tmp_path, "again", "--version"))
        assert list(pool.finished()) == [("again", 0)]


@pytest.mark.slow
def test_another_process_is_made_ready_with_the_first(tmp_path: Path) -> None:
    with Pool(2) as pool:
        pool.start(_command(tmp_path, "one", "--version"))
        ((ready, _),) = pool._idle
        pool.start(_command(tmp_path, "two", "--version"))
        assert [process for process, _ in pool._busy.values()][1] is ready
        ended: dict[str, int] = {}
        while len(ended) < 2:
            ended |= dict(pool.finished())
        assert ended == {"one": 0, "two": 0}

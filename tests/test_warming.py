"""Compiling ahead: nothing is left to compile when the first row comes."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from drivenlogs import commands_of, driven_log
from estimatorlogs import rows_from, setup_for
from numba import njit

from calib import warming
from calib.compilation import on_compiling
from calib.estimator.driven_filter import DrivenFilter
from calib.estimator.driven_setup import Drive
from calib.estimator.filter import Filter
from calib.estimator.setup import Rows
from calib.warming import driven_elsewhere, serve, warm


def _compile() -> None:
    def double(a: float) -> float:
        return 2.0 * a

    assert njit(double)(1.0) == 2.0


def test_nothing_is_left_to_compile() -> None:
    rig, log = driven_log("ellipse", 1)
    setup, rows, pwm = setup_for(rig, 1), rows_from(log), commands_of(log)
    some = Rows(rows.t_s[:200], rows.readings[:200], rows.kinds[:200])
    warm(setup)
    serve(False)
    heard: list[int] = []
    with on_compiling(lambda: heard.append(1)):
        out = Filter(setup).run(some)
        DrivenFilter(setup, Drive()).run(some, pwm[:200])
    assert heard == []
    assert np.isfinite(out[100:, 5]).all()


class _Other:
    """In place of a process."""

    seen: list[Any]

    def __init__(self, words: list[str], **_: object) -> None:
        self.seen.append(words)

    def wait(self, *_: object) -> None:
        self.seen.append("waited")

    def kill(self) -> None:
        self.seen.append("killed")


@pytest.mark.parametrize("wanted", [True, False])
def test_a_process_is_started_once_and_waited_for(wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    _Other.seen = []
    monkeypatch.setattr(warming.subprocess, "Popen", _Other)
    with driven_elsewhere(wanted, True):
        _compile()
        _compile()
    assert [word for word in _Other.seen if isinstance(word, str)] == ["waited", "killed", "waited"] * wanted
    assert [word[0] for word in _Other.seen if isinstance(word, list)] == [sys.executable] * wanted
    if wanted:
        assert _Other.seen[0][2].endswith("serve(True)")


def test_where_nothing_is_compiled_nothing_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    _Other.seen = []
    monkeypatch.setattr(warming.subprocess, "Popen", _Other)
    with driven_elsewhere(True):
        pass
    assert _Other.seen == []


def test_a_process_that_cannot_be_started_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError("no processes left")

    monkeypatch.setattr(subprocess, "Popen", refused)
    with driven_elsewhere(True):
        _compile()

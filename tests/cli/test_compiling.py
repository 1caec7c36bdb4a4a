"""Telling of compiling: once, on a terminal, and the verb stays what it was."""

from __future__ import annotations

import inspect
import sys

import pytest
from numba import njit

from calib.cli.common import SENTENCE, telling


def _verb(count: int, twice: bool = False) -> int:
    def double(a: int) -> int:
        return 2 * a

    return int(njit(double)(count) + (njit(double)(count) if twice else 0))


@pytest.mark.parametrize("terminal", [True, False])
def test_it_is_said_once_to_a_person(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    assert telling(_verb)(3, twice=True) == 12
    assert capsys.readouterr().err.splitlines() == ([SENTENCE] if terminal else [])


def test_the_verb_keeps_its_words() -> None:
    assert inspect.signature(telling(_verb)) == inspect.signature(_verb)
    assert telling(_verb).__name__ == "_verb"

"""Noticing that numba compiles: once, and only what is not there yet."""

from __future__ import annotations

from numba import njit

from calib.compilation import on_compiling


def test_the_first_compilation_is_noticed_and_no_other() -> None:
    def plus(a: float) -> float:
        return a + 1.0

    one, two, heard = njit(plus), njit(plus), []
    with on_compiling(lambda: heard.append(1)):
        assert one(1.0) == 2.0
        assert two(2.0) == 3.0
    assert heard == [1]
    with on_compiling(lambda: heard.append(2)):
        assert one(3.0) == 4.0
    assert heard == [1]


def test_nobody_listens_after_the_block() -> None:
    def minus(a: float) -> float:
        return a - 1.0

    heard: list[int] = []
    with on_compiling(lambda: heard.append(1)):
        pass
    assert njit(minus)(1.0) == 0.0
    assert heard == []

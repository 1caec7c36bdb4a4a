"""Stages in threads: order, bounds, errors, and no thread that stays."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from calib.relay import ahead, behind


def test_items_come_in_their_order_and_the_thread_ends() -> None:
    before = threading.active_count()
    assert list(ahead(iter(range(1000)))) == list(range(1000))
    assert threading.active_count() == before


def test_reading_ahead_is_bounded() -> None:
    made = []

    def source() -> Iterator[int]:
        for k in range(100):
            made.append(k)
            yield k

    for k in ahead(source(), depth=3):
        # Three wait, one is in the hand of the other thread, and one may just have been made.
        assert len(made) <= k + 6


def test_an_error_of_the_source_comes_behind_its_items() -> None:
    def source() -> Iterator[int]:
        yield 1
        raise ValueError("broken")

    stream = ahead(source())
    assert next(stream) == 1
    with pytest.raises(ValueError, match="broken"):
        next(stream)


def test_leaving_early_ends_the_source() -> None:
    before = threading.active_count()
    stream = ahead(iter(range(10**9)))
    assert next(stream) == 0
    stream.close()
    assert threading.active_count() == before


def test_what_is_handed_on_is_finished_in_order_before_the_block_ends() -> None:
    done: list[int] = []
    before = threading.active_count()
    with behind(done.append) as hand:
        for k in range(1000):
            hand(k)
    assert done == list(range(1000))
    assert threading.active_count() == before


@pytest.mark.parametrize("count", [1, 1000])
def test_an_error_in_finishing_is_raised(count: int) -> None:
    def finish(item: int) -> None:
        raise ValueError(f"item {item}")

    def work() -> None:
        with behind(finish) as hand:
            for k in range(count):
                hand(k)

    with pytest.raises(ValueError, match="item 0"):
        work()


def test_an_error_of_the_caller_waits_for_what_was_handed_on() -> None:
    done: list[int] = []

    def work() -> None:
        with behind(done.append) as hand:
            hand(1)
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        work()
    assert done == [1]

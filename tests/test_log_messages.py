"""Messages to rows: sorted, merged where they are of one time, in blocks of any size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.io.bags import WINDOW_S, Field, Topic, TopicMap, rows_from_messages

MAP = TopicMap("x.yaml", {"/a": (Field("u_px", "u"), Field("v_px", "v")), "/b": (Field("gz_radps", "g"),)})


class Messages:
    """A bag in memory: topic, stamp and body."""

    truncated = False
    topics = (Topic("/a", "A"), Topic("/b", "B"), Topic("/c", "C"))

    def __init__(self, items: Iterable[tuple[str, int, dict[str, Any]]]) -> None:
        self._items = list(items)

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = set(names)
        return iter([item for item in self._items if item[0] in wanted])


def rows(
    items: Iterable[tuple[str, int, dict[str, Any]]], topics: TopicMap = MAP
) -> tuple[np.ndarray, list[Any]]:
    blocks = list(rows_from_messages("log", Messages(items), topics))
    columns = [np.concatenate([block.columns[name] for block in blocks]) for name in topics.columns]
    return np.column_stack([np.concatenate([block.t_s for block in blocks]), *columns]), blocks


def test_the_epoch_is_the_first_row_and_a_simulated_time_is_kept() -> None:
    start = 1_700_000_000_000_000_000
    late, _ = rows([("/b", start + k, {"g": k}) for k in (1000, 0, 2000)])
    assert late[:, 0].tolist() == [0.0, 1e-6, 2e-6] and late[:, 3].tolist() == [0, 1000, 2000]
    early, _ = rows([("/b", 3_000_000_000 + k, {"g": k}) for k in range(2)])
    assert early[:, 0].tolist() == [3.0, 3.000000001]


@pytest.mark.parametrize(
    ("body", "seconds"),
    [
        ({"header": {"stamp": {"sec": 2, "nanosec": 500_000_000}}}, 2.5),
        ({"header": {"stamp": {"sec": 2, "nsec": 500_000_000}}}, 2.5),
        ({"timestamp": {"sec": 2, "nsec": 500_000_000}}, 2.5),
        ({"timestamp": {"sec": 0, "nsec": 0}}, 4.0),
        ({"timestamp": {"sec": 10**30, "nsec": 0}}, 4.0),
        ({"timestamp": {"sec": "2"}}, 4.0),
        ({"timestamp": 2.5}, 4.0),
        ({"header": None}, 4.0),
        ({}, 4.0),
    ],
)
def test_the_stamp_of_a_message_or_its_reception(body: dict[str, Any], seconds: float) -> None:
    found, _ = rows([("/b", 4_000_000_000, {"g": 1.0, **body})])
    assert found[0, 0] == seconds
    received = TopicMap(MAP.source, MAP.topics, stamped=False)
    assert rows([("/b", 4_000_000_000, {"g": 1.0, **body})], received)[0][0, 0] == 4.0


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 40)), max_size=60),
    st.integers(1, 9),
    st.randoms(use_true_random=False),
)
def test_blocks_of_any_size_give_the_same_rows(items: list[tuple[str, int]], size: int, random: Any) -> None:
    """Messages that are late by less than the window come in order, however they are cut."""
    step = int(1e9 * WINDOW_S / 50)
    messages = [
        (name, (10 * (k // 2) + at) * step, {"u": k, "v": -k, "g": k}) for k, (name, at) in enumerate(items)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calib.io.bags._ROWS", size)
        cut, blocks = rows(messages)
    whole, _ = rows(messages)
    assert np.array_equal(np.sort(cut[:, 0]), cut[:, 0])
    assert np.concatenate([block.lines for block in blocks]).tolist() == list(range(1, len(cut) + 1))
    assert np.array_equal(cut, whole, equal_nan=True)

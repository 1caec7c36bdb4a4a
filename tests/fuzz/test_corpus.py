"""What the fuzzer has kept, and neighbours of it: every reader answers with a result or one sentence."""

from __future__ import annotations

import importlib
import random
from pathlib import Path

import pytest
from fuzz.harness import TARGETS, corpus, mutate, only_inside, run
from hypothesis import given, settings
from hypothesis import strategies as st

INPUTS = [(target, path) for target in TARGETS for path in corpus(target)]


@pytest.mark.parametrize(
    ("target", "path"), INPUTS, ids=lambda one: one if isinstance(one, str) else one.name
)
def test_an_input_that_was_kept(tmp_path: Path, target: str, path: Path) -> None:
    check = importlib.import_module(f"fuzz.{target}").check
    with only_inside(tmp_path):
        run(check, path.read_bytes(), tmp_path)


@pytest.mark.parametrize("target", TARGETS)
def test_seeds_are_taken(tmp_path: Path, target: str) -> None:
    """Each target has an input that is read whole, or nothing behind the first refusal would be tried."""
    check = importlib.import_module(f"fuzz.{target}").check
    seeds = [path for path in corpus(target) if path.name.startswith("seed")]
    assert "" in [run(check, path.read_bytes(), tmp_path) for path in seeds]


@pytest.mark.parametrize("target", TARGETS)
def test_neighbours_of_the_seeds(tmp_path_factory: pytest.TempPathFactory, target: str) -> None:
    module = importlib.import_module(f"fuzz.{target}")
    seeds = [path.read_bytes() for path in corpus(target) if path.name.startswith("seed")]
    folder = tmp_path_factory.mktemp(target)

    @settings(max_examples=20 if target == "rig_yaml" else 60, deadline=None, derandomize=True)
    @given(st.sampled_from(seeds), st.integers(0, 2**32))
    def each(data: bytes, number: int) -> None:
        with only_inside(folder):
            run(module.check, mutate(data, module.WORDS, random.Random(number)), folder)

    each()


@pytest.mark.parametrize("target", TARGETS)
@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=300))
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, target: str, data: bytes) -> None:
    run(importlib.import_module(f"fuzz.{target}").check, data, tmp_path_factory.mktemp(target))


def test_the_harness_sees_what_is_forbidden(tmp_path: Path) -> None:
    """Writing elsewhere, starting a program, and a sentence of two lines are findings."""

    def outside(_: bytes, __: Path) -> None:
        (tmp_path / "elsewhere").write_text("")

    inside = tmp_path / "inside"
    inside.mkdir()
    with pytest.raises(AssertionError, match="wrote outside"), only_inside(inside):
        run(outside, b"", inside)
    assert not (tmp_path / "elsewhere").exists()

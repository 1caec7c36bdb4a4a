"""Bounded YAML: small texts that stand for large things are refused before they are loaded."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core.bounded_yaml import MAX_NODES, YamlProblem, load

DOUBLING = "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))

BOMBS = {
    "aliases": ("a0: &a0 [x, x]\n" + DOUBLING, f"expands to more than {MAX_NODES} values"),
    "merged keys": (
        "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 60)),
        "line 2: merges keys with <<",
    ),
    "pairs": (
        "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} !!pairs [k: *a{i - 1}]\n" for i in range(1, 3)),
        "line 2: has the tag !!pairs",
    ),
    "ordered": ("a: !!omap [k: 1]\n", "line 1: has the tag !!omap"),
    "a set": ("a: !!set {k}\n", "line 1: has the tag !!set"),
    "sexagesimal": ("a: 1" + ":1" * 400_000, "line 1: is not YAML that can be read: a number of 800001"),
    "digits": ("a: " + "9" * 5000, "line 1: is not YAML that can be read: a number of 5000"),
    "hexadecimal": ("a: 0x" + "f" * 5000, "a number of 5002"),
    "float": ("a: !!float 1" + ":1" * 5000, "a number of 10001"),
    "flow": ("a: " + "[" * 100_000, "line 1: is not YAML that can be read: nested more than 40 deep"),
    "blocks": ("? " * 100_000 + "a", "nested more than 40 deep"),
    "itself": ("a: &a [*a]\n", "expands to more than"),
    "many": ("- a\n" * (MAX_NODES + 1), f"has more than {MAX_NODES} values"),
    "code": ("a: !!python/object/apply:os.system [ls]", "is not YAML: could not determine a constructor"),
    "integers of nothing": ("a: !!int ''", "is not YAML that can be read"),
    "no boolean": ("a: !!bool maybe", "is not YAML that can be read"),
    "no date": ("a: !!timestamp today", "is not YAML that can be read"),
    "a list as a key": ("? [a, b]\n: c\n", "is not YAML: found unhashable key"),
    "zero byte": ("a: \0", "is not YAML: control characters are not allowed"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_grows_is_refused_with_its_line(name: str) -> None:
    text, says = BOMBS[name]
    with pytest.raises(YamlProblem) as refused:
        load(text)
    assert says in str(refused.value)
    assert str(refused.value).isprintable()


LEAVES = st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(allow_nan=False) | st.text()
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=30
)


@settings(max_examples=60, deadline=None)
@given(VALUES)
def test_what_is_written_comes_back(value: object) -> None:
    text = yaml.safe_dump(value, allow_unicode=True)
    assert load(text) == yaml.safe_load(text)


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="ab:&*<>-?[]{}!|%#'\"\n 01.~=@`,\t\\", max_size=60))
def test_any_text_is_loaded_or_refused_in_one_line(text: str) -> None:
    try:
        load(text)
    except YamlProblem as problem:
        assert "\n" not in str(problem)
        assert str(problem).endswith(problem.said)

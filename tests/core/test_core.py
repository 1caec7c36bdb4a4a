"""Files written whole or not at all, bounded YAML, quantities with units, errors as seen, compilation."""

from __future__ import annotations

import ast
import errno
import math
import os
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core import compilation, writing
from calib.core.bounded_yaml import YamlProblem, load
from calib.core.errors import BadInputError, CalibError, ReaderGoneError, UsageError
from calib.core.files import check_readable, file_sha256, read_bytes, read_text, read_yaml_mapping
from calib.core.units import parse_corners, parse_duration_s, parse_length_m, plain_number
from calib.core.words import number
from calib.core.writing import check_folder, check_writable, write_atomically


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write_atomically(path, "old")
    path.chmod(0o640)
    write_atomically(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


@pytest.mark.parametrize("at", ["write", "fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_the_old_file_survives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, failure: BaseException
) -> None:
    path = tmp_path / "rig.yaml"
    write_atomically(path, "old")

    def fail(*_: object, **__: object) -> None:
        raise failure

    if at == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    elif at == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        monkeypatch.setattr(writing.os, "fdopen", fail)
    expected = BadInputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


def test_a_link_is_followed_and_stays(tmp_path: Path) -> None:
    (tmp_path / "real.yaml").write_text("old")
    (tmp_path / "rig.yaml").symlink_to("real.yaml")
    write_atomically(tmp_path / "rig.yaml", "new")
    assert (tmp_path / "rig.yaml").is_symlink()
    assert (tmp_path / "real.yaml").read_text() == "new"


def test_unwritable_places_are_known_before_work(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no folder"):
        check_writable(tmp_path / "nowhere" / "rig.yaml")
    with pytest.raises(BadInputError, match="is a folder"):
        check_writable(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1, 2", "line"),
        ("a: !!python/object/apply:os.system [ls]\n", "not YAML"),
        ("x: " + "[" * 3000, "not YAML"),
        ("a: [{b: 1, c: 2, b: 3}]\n", "line 1: the key b was given before"),
        ("a: 1\n---\nb: 2\n", "another document"),
    ],
)
def test_wrong_yaml_is_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=says) as caught:
        read_yaml_mapping(path)
    assert "\n" not in str(caught.value)
    assert "board.yaml" in str(caught.value)


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(b"view,\xff\xfe")
    with pytest.raises(BadInputError, match="UTF-8"):
        read_text(path)


def test_what_is_no_regular_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_bytes(b"12345")
    assert check_readable(tmp_path / "file") == 5
    with pytest.raises(BadInputError, match="is a pipe or a device"):
        read_bytes(tmp_path / "pipe")
    with pytest.raises(BadInputError, match="is a folder"):
        read_bytes(tmp_path)
    with pytest.raises(BadInputError, match="No such file"):
        read_bytes(tmp_path / "gone")
    with pytest.raises(BadInputError, match="is larger than 4e-06 MB"):
        read_bytes(tmp_path / "file", most=4)


def test_read_only_files_and_loops_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(BadInputError, match="is read-only"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInputError, match="leads back to itself"):
        write_atomically(tmp_path / "loop", "new")


def test_devices_are_written_through() -> None:
    write_atomically(Path("/dev/null"), "x")
    assert Path("/dev/null").is_char_device()


def test_folders_are_known_before_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    check_folder(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
    with pytest.raises(BadInputError, match="file is a file"):
        check_folder(tmp_path / "file" / "b")


def test_the_hash_of_a_file_of_any_size(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(b"abc")
    assert file_sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    for other, says in ((tmp_path, "is a folder"), (tmp_path / "none", "cannot be read")):
        with pytest.raises(BadInputError, match=says):
            file_sha256(other)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BadInputError, match="is a pipe or a device"):
        file_sha256(tmp_path / "pipe")


DOUBLING = "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
BOMBS = {
    "aliases": ("a0: &a0 [x, x]\n" + DOUBLING, "expands to more than 200000 values"),
    "pairs": (
        "a0: &a0 [x, x]\n"
        + "".join(f"a{i}: &a{i} !!pairs [k: *a{i - 1}, l: *a{i - 1}]\n" for i in range(1, 40)),
        "expands to more than",
    ),
    "merged": (
        "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 40)),
        "expands to more than",
    ),
    "an alias of nothing": ("a: *b\n", "is not YAML: found undefined alias"),
    "sexagesimal": ("a: 1" + ":1" * 400_000, "line 1: is not YAML that can be read: a number of 800001"),
    "hexadecimal": ("a: 0x" + "f" * 5000, "a number of 5002"),
    "float": ("a: !!float 1" + ":1" * 5000, "a number of 10001"),
    "blocks": ("? " * 100_000 + "a", "nested more than 40 deep"),
    "itself": ("a: &a [*a]\n", "expands to more than"),
    "code": ("a: !!python/object/apply:os.system [ls]", "is not YAML: could not determine a constructor"),
    "no boolean": ("a: !!bool maybe", "is not YAML that can be read"),
    "no date": ("a: !!timestamp today", "is not YAML that can be read"),
    "tab": ("a:\n\tb: 1\n", "line 2: is not YAML: a tab indents the line, expected spaces"),
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


@pytest.mark.parametrize(
    ("text", "metres"), [("20mm", 0.02), ("2 cm", 0.02), ("0.02m", 0.02), ("1in", 0.0254), ("2e1mm", 0.02)]
)
def test_lengths(text: str, metres: float) -> None:
    assert parse_length_m(text, "--square") == pytest.approx(metres, rel=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "20",
        "0mm",
        "nan mm",
        "20 mm mm",
    ],
)
def test_wrong_lengths_name_the_option(text: str) -> None:
    with pytest.raises(UsageError, match="--square"):
        parse_length_m(text, "--square")


@pytest.mark.parametrize(
    ("text", "seconds"), [("10s", 10.0), ("500 ms", 0.5), ("2min", 120.0), ("1.5h", 5400.0)]
)
def test_durations(text: str, seconds: float) -> None:
    assert parse_duration_s(text, "--duration") == pytest.approx(seconds, rel=1e-15)
    with pytest.raises(UsageError, match="--duration"):
        parse_duration_s(f"-{text}", "--duration")


@given(st.integers(3, 200), st.integers(3, 200), st.sampled_from(["x", "X", ",", " x "]))
def test_corners(columns: int, rows: int, by: str) -> None:
    assert parse_corners(f"{columns}{by}{rows}") == (columns, rows)


@pytest.mark.parametrize(
    "text",
    [
        "7",
        "7x5x3",
        "7 5",
    ],
)
def test_wrong_corners(text: str) -> None:
    with pytest.raises(UsageError, match="--corners"):
        parse_corners(text)


@pytest.mark.parametrize(("word", "value"), [("1.5", 1.5), ("-2e-3", -2e-3), ("inf", math.inf), (".5", 0.5)])
def test_plain_number_reads_decimals(word: str, value: float) -> None:
    assert plain_number(word) == value


@pytest.mark.parametrize(
    "word",
    [
        "",
        "1,5",
        "1 2",
    ],
)
def test_plain_number_takes_no_other_words(word: str) -> None:
    assert plain_number(word) is None


def test_exit_codes() -> None:
    assert (CalibError.exit_code, BadInputError.exit_code, UsageError.exit_code) == (3, 3, 2)
    assert ReaderGoneError("").exit_code == 141


@given(st.text())
def test_a_message_moves_no_cursor(text: str) -> None:
    shown = str(BadInputError(text))
    assert shown.isprintable()
    assert not text.isprintable() or shown == text


def test_what_was_quoted_stays_to_be_seen() -> None:
    assert str(BadInputError("a.csv: view \x1b[2J\n is é")) == r"a.csv: view \x1b[2J\n is é"


def test_an_error_goes_between_processes() -> None:
    error = pickle.loads(pickle.dumps(BadInputError("a\nb")))
    assert isinstance(error, BadInputError)
    assert str(error) == r"a\nb"


# ----------------------------------------------------------------------
# What numba compiles.


@pytest.mark.parametrize(
    ("file", "made_from"),
    [
        ("estimator/driven.py", "actuator/kinematics.py"),
        ("camera/verdict.py", "camera/checks.py"),
    ],
)
def test_what_is_kept_is_compiled_anew_after_a_change_of_what_it_imports(file: str, made_from: str) -> None:
    """By way of others, and whether a name or a whole module is imported."""
    stages = Path(compilation.__file__).parents[1] / "stages"
    assert stages / made_from in compilation._sources(stages / file)


def test_imports_in_parentheses_and_by_another_name_are_followed(tmp_path: Path) -> None:
    file, core = tmp_path / "kernel.py", Path(compilation.__file__).parent
    file.write_text("from calib.core import (\n    arrays,\n    units as u,\n)\n")
    assert {core / "arrays.py", core / "units.py"} <= compilation._sources(file)


def test_of_two_processes_that_need_a_function_one_compiles_it(tmp_path: Path) -> None:
    (tmp_path / "compiled_once.py").write_text(
        "from calib.core.compilation import kernel, on_compiling\n"
        "@kernel()\n"
        "def total(values):\n"
        "    found = 0.0\n"
        "    for value in values:\n"
        "        found += value\n"
        "    return found\n"
    )
    program = (
        "import numpy as np, compiled_once as c\n"
        "input()\n"
        "with c.on_compiling(lambda: print('compiled')):\n"
        "    assert c.total(np.ones(3)) == 3.0\n"
    )
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for one in both:
        assert one.stdin is not None
        one.stdin.write("\n")
        one.stdin.flush()
    told = [one.communicate(timeout=120)[0] for one in both]
    assert [one.returncode for one in both] == [0, 0]
    assert sorted(told) == ["", "compiled\n"]
    assert not list(tmp_path.rglob("*.lock"))


def test_sets_of_numbas_options_are_alike_as_before() -> None:
    from numba.core.compiler import Flags

    def flags(**values: bool) -> Flags:
        made = Flags()
        for name, value in values.items():
            setattr(made, name, value)
        return made

    # nrt is off by itself.
    alike = [flags(), flags(nrt=False)], [flags(no_cfunc_wrapper=True), flags(no_cfunc_wrapper=True)]
    assert all(a == b and hash(a) == hash(b) for a, b in alike)
    assert flags(nrt=True) not in [
        flags(),
        flags(no_cfunc_wrapper=True),
        flags(nrt=True, no_cfunc_wrapper=True),
        None,
    ]


def test_constants_in_calls_are_compiled_once() -> None:
    program = (
        "from calib.core.compilation import kernel\n"
        "@kernel(arrays=False)\n"
        "def scaled(value, twice):\n"
        "    return 2.0 * value if twice else value\n"
        "@kernel(arrays=False)\n"
        "def both(value):\n"
        "    return scaled(value, True) + scaled(value, False) + scaled(value, value > 0.0)\n"
        "assert both(1.0) == 5.0\n"
        "print(len(scaled.signatures))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [(4.53716, 14499.2, "4.5"), (560.03, 14499.2, "560"), (463.27, 123.4, "460"), (14499.2, 14499.2, "14000"),
     (273.4081, 0.05, "273.408"), (0.1, 12.0, "0"), (0.0, 120.0, "0"), (123456.0, None, "123456")],
)  # fmt: skip
def test_a_value_has_the_digits_that_its_deviation_leaves(
    value: float, sigma: float | None, text: str
) -> None:
    assert number(value, sigma) == text


def test_no_module_gives_a_name_twice() -> None:
    """In a long module a second constant of one name silently takes the place of the first."""
    twice = []
    for path in Path(compilation.__file__).parents[1].rglob("*.py"):
        module = ast.parse(path.read_text(encoding="utf-8"))
        names = Counter(
            target.id
            for node in module.body
            for target in getattr(node, "targets", [getattr(node, "target", None)])
            if isinstance(target, ast.Name)
        )
        twice += [f"{path.name}: {name}" for name, count in names.items() if count > 1]
    assert not twice

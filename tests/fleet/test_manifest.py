"""Manifests: what is read from CSV and YAML, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.runner.task import is_url, read_manifest, without_secrets


def _csv(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "m.csv"
    path.write_text(text)
    return path


def test_csv_and_yaml_say_the_same(tmp_path: Path) -> None:
    from_csv = read_manifest(
        _csv(tmp_path, "name,path,serial,model,made by\na 1,rigs/a,AX-07,radial2,me\nb,s3://bucket/b,,,\n")
    )
    yaml = tmp_path / "m.yaml"
    yaml.write_text(
        "rigs:\n- {name: a 1, path: rigs/a, serial: AX-07, model: radial2, made by: me}\n"
        "- {name: b, path: 's3://bucket/b'}\n"
    )
    from_yaml = read_manifest(yaml)
    assert from_csv == from_yaml
    a, b = from_csv.rigs
    assert (
        a.source == str(tmp_path / "rigs/a") and a.options == (("model", "radial2"),) and a.serial == "AX-07"
    )
    assert b.source == "s3://bucket/b" and b.options == () and is_url(b.source) and not is_url(a.source)
    assert from_csv.ignored == ("made by",)


def test_options_for_all_and_for_one(tmp_path: Path) -> None:
    yaml = tmp_path / "m.yml"
    yaml.write_text(
        "options: {model: radial2, square: 20mm}\nrigs:\n- {name: a, path: a}\n"
        "- {name: b, path: b, model: brown5}\n"
    )
    a, b = read_manifest(yaml).rigs
    assert dict(a.options) == {"model": "radial2", "square": "20mm"}
    assert dict(b.options) == {"model": "brown5", "square": "20mm"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("\n", "is empty"),
        ("name,path\n", "names no rigs"),
        ("name,folder\na,b\n", "line 1: has no column path"),
        ("name,path,path\na,b,c\n", "column 'path' twice"),
        ("name,path\na,b\nA,c\n", "line 3: the name 'A' is that of line 2"),
        ("name,path\n../a,b\n", "line 2: the name '../a' begins with a dot"),
        ("name,path\na/../b,b\n", "has '/' in it"),
        ("name,path\na\\b,b\n", "in it, expected letters"),
        ('name,path\n"a\nb",b\n', r"line 3: the name 'a\\nb' has '\\n' in it"),
        ("name,path\n,b\n", "is empty, expected a name"),
        ("name,path\na,\n", "a has no path"),
        ("name,path\na,b,c\n", "line 2: has 3 cells, the header 2"),
        ('name,path\n"a,b\n', "is not CSV"),
        ("name,path\na,zip::s3://x\n", "chains several"),
        ("name,path,model\na,b,lens\n", "model of a is 'lens'"),
        ("name,path,corners\na,b,7\n", "corners of a"),
        (f"name,path\n{'a' * 81},b\n", "longer than 80"),
    ],
)
def test_what_is_no_manifest_is_told_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInputError) as error:
        read_manifest(_csv(tmp_path, text))
    assert said in str(error.value).replace("\\\\", "\\").replace("\\", "\\\\") or said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rigs: 3\n", "no list rigs"),
        ("rigs: [a]\n", "rig 1: is no mapping"),
        ("rigs: []\n", "names no rigs"),
        ("rigs: [{name: [1], path: a}]\n", "name is"),
        ("fleet: []\n", "fleet is not a key"),
        ("rigs: []\noptions: {colour: red}\n", "options.colour"),
        ("rigs: [{name: a, path: b}]\noptions: 3\n", "options is no mapping"),
    ],
)
def test_what_is_no_yaml_manifest(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=said):
        read_manifest(path)


@given(st.text(max_size=12))
def test_a_name_that_is_taken_is_a_safe_folder(name: str) -> None:
    from calib.runner.task import _problem_of_name

    if _problem_of_name(name) == "":
        path = Path("root") / name
        assert path.parent == Path("root") and path.name == name and name.isprintable()


def test_no_secret_is_kept() -> None:
    assert without_secrets("https://user:word@host:1/a/b?key=1") == "https://host:1/a/b"
    assert without_secrets("s3://bucket/a") == "s3://bucket/a"
    assert without_secrets("/data/a?b@c") == "/data/a?b@c"

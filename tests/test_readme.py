"""The README's Python examples run as they stand, one after the other, and leave nothing in the checkout."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from calib.cli.app import app

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.S | re.M)


def blocks_of(text: str) -> list[tuple[int, str]]:
    """Python blocks with the number of the line before their first."""
    return [(text.count("\n", 0, found.start(1)), found.group(1)) for found in BLOCK.finditer(text)]


def test_every_python_block_runs(
    project_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = blocks_of((project_root / "README.md").read_text(encoding="utf-8"))
    assert blocks
    before = sorted(item.name for item in project_root.iterdir())
    monkeypatch.chdir(project_root)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    names: dict[str, object] = {"__name__": "readme"}
    for line, block in blocks:
        # Later blocks use what earlier ones found; a traceback names the README's own line.
        exec(compile("\n" * line + block, "README.md", "exec"), names)
        assert capsys.readouterr().out.strip(), f"README.md, line {line}: prints nothing"
    assert sorted(item.name for item in project_root.iterdir()) == before


def test_blocks_are_found_with_their_lines() -> None:
    text = "a\n\n```python\nx = 1\n```\n\n```\nnot this\n```\n\n```python\ny = 2\nz = 3\n```\n"
    assert blocks_of(text) == [(3, "x = 1\n"), (11, "y = 2\nz = 3\n")]


def _verbs(command: Any, words: tuple[str, ...] = ("calib",)) -> Iterator[tuple[str, ...]]:
    for name, inner in getattr(command, "commands", {}).items():
        if getattr(inner, "commands", None):
            yield from _verbs(inner, (*words, name))
        else:
            yield (*words, name)


def test_every_verb_is_explained_and_shown(project_root: Path) -> None:
    """Each verb stands in the table, and further below with what it prints."""
    text = (project_root / "README.md").read_text(encoding="utf-8")
    verbs = [" ".join(words) for words in _verbs(get_command(app))]
    assert len(verbs) > 25
    table = [line for line in text.splitlines() if line.startswith("| `calib ")]
    named = [" ".join(words.split()) for line in table for words in re.findall(r"calib [^`]*", line)]
    heads = {" ".join(verb.split()[:2]) for verb in verbs}
    assert not [head for head in heads if not any(name.startswith(head) for name in named)]
    shown = re.findall(r"^    \$ (calib .*)$", text, re.M)
    assert not [verb for verb in verbs if not any(f"{line} ".startswith(f"{verb} ") for line in shown)]

"""The README's Python examples run as they stand, one after the other, and leave nothing in the checkout."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

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

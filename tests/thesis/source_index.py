"""Index of the figures that correspond to those of the source: a table of them, and a sheet to look at."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.core.files import write_atomically

__all__ = ["Entry", "write_index"]

_STYLE = (
    "body{font:15px/1.4 sans-serif;margin:1.5rem;color:#1d2730}"
    "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(20rem,1fr));gap:1.5rem}"
    "figure{margin:0}img{width:100%;height:auto;border:1px solid #d3d8dd}"
    "figcaption{font-size:13px;color:#66727d}"
    "figure{margin:0}img{width:100%;height:auto;border:1px solid #d3d8dd}"
    "figcaption{font-size:13px;color:#66727d}"
)


@dataclass(frozen=True)
class Entry:
    """One figure: its number and title, its file, what it was drawn from and what can be read off it."""

    number: str
    title: str
    file: str
    source: str
    note: str
    numbers: Mapping[str, float]


def _sheet(entries: Sequence[Entry]) -> str:
    parts = []
    for one in entries:
        name, title, source = (html.escape(text) for text in (one.file, one.title, one.source))
        parts.append(
            f'<figure><a href="{name}"><img src="{name}" alt="{title}" loading="lazy"></a>'
            f"<figcaption><b>{one.number}</b> {title}. Drawn from: {source}.</figcaption></figure>"
        )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Figures, simulated</title>'
        f"<style>{_STYLE}</style><h1>Figures of the source, drawn from simulated runs</h1>"
        f"<p>{len(entries)} figures. None shows a measurement.</p><main>{''.join(parts)}</main></html>\n"
    )


def write_index(folder: Path, entries: Sequence[Entry]) -> list[Path]:
    """Write `figures.json` and `index.html` of the figures in a folder; the files written.

    Raises `BadInputError` where a file cannot be written.
    """
    rows = [
        {
            "number": one.number,
            "title": one.title,
            "file": one.file,
            "simulated": True,
            "drawn_from": one.source,
            "note": one.note,
            "numbers": dict(one.numbers),
        }
        for one in entries
    ]
    table, page = folder / "figures.json", folder / "index.html"
    write_atomically(table, (json.dumps({"schema": 1, "figures": rows}, indent=1) + "\n").encode())
    write_atomically(page, _sheet(entries).encode())
    return [table, page]

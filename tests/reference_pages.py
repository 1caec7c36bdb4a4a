"""Pages of the manual that follow from the code, so that a test can tell when they are out of date.

    python tests/reference_pages.py

writes them anew. `verbs.md` follows from the signatures and docstrings of the command line's functions, not
from the text of --help, which depends on typer's version and the terminal's width.
"""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from calib.cli.app import app

MANUAL = Path(__file__).resolve().parent.parent / "calib" / "docs"

_HEAD = """# Verbs

`python tests/reference_pages.py` generates this page from the command line's docstrings and options.

`calib VERB ... [--rig rig.yaml] [--json]`. Results go to stdout, narration to stderr. `--json` prints one
JSON document instead of words. `--figures DIR` draws figures. Quantities carry their unit: `--square 20mm`,
`--cutoff 1Hz`. `calib VERB --help` prints the same options.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | done and written, but the result fails its quality gate |
| 2 | wrong usage |
| 3 | bad input: one sentence names the file, line or key, the value, what was expected, and what to do |
| 70 | a fault of `calib`; `CALIB_DEBUG=1` shows where |
| 130 | interrupted |
| 141 | the reader of stdout went away |
"""

_KINDS = {str: "text", int: "integer", float: "number", Path: "path", bool: "flag"}


def pages() -> dict[str, str]:
    """Path below the manual and text of each generated page."""
    return {"reference/verbs.md": verbs_page()}


def verbs() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Words and function of each verb, in the order of --help."""
    for command in app.registered_commands:
        if command.callback is not None and command.name is not None:
            yield f"calib {command.name}", command.callback
    for group in app.registered_groups:
        inner = group.typer_instance
        assert inner is not None
        for command in inner.registered_commands:
            if command.callback is not None and command.name is not None:
                yield f"calib {group.name} {command.name}", command.callback


def verbs_page() -> str:
    """The page of all verbs: a table of contents, then each with its arguments and options."""
    every = sorted(verbs())
    parts = [_HEAD, "| verb | what it does |", "|---|---|"]
    for words, function in every:
        anchor = words.replace(" ", "-")
        parts.append(f"| [`{words}`](#{anchor}) | {_summary(function)} |")
    for words, function in every:
        parts += ["", f"## {words}", "", *_verb(words, function)]
    return "\n".join(parts) + "\n"


def _summary(function: Callable[..., Any]) -> str:
    """First sentence of the docstring, as one line of a table."""
    first = (inspect.getdoc(function) or "").split("\n\n", 1)[0]
    return _cell(" ".join(first.split()))


def _verb(words: str, function: Callable[..., Any]) -> Iterator[str]:
    hints = typing.get_type_hints(function, include_extras=True)
    usage, rows = [words], []
    for name, parameter in inspect.signature(function).parameters.items():
        hint, info = hints[name].__origin__, hints[name].__metadata__[0]
        required = parameter.default is inspect.Parameter.empty
        if isinstance(info, typer.models.ArgumentInfo):
            label = info.metavar or name.rstrip("_").upper()
            several = "..." if typing.get_origin(hint) is list and not label.endswith("...") else ""
            usage.append(f"{label}{several}" if required else f"[{label}{several}]")
            rows.append((f"`{label}`", hint, info, parameter.default))
        else:
            decls = [decl for decl in (info.default, *info.param_decls) if isinstance(decl, str)]
            label = ", ".join(f"`{decl}`" for decl in decls) or f"`--{name.replace('_', '-')}`"
            if required:
                long = decls[-1] if decls else f"--{name.replace('_', '-')}"
                usage.append(f"{long} {info.metavar or _kind(hint).upper()}")
            rows.append((label, hint, info, parameter.default))
    yield "```text"
    yield f"{' '.join(usage)} [options]"
    yield "```"
    for paragraph in (inspect.getdoc(function) or "").split("\n\n"):
        yield ""
        yield " ".join(paragraph.split())
    yield ""
    yield "| argument or option | value | default | meaning |"
    yield "|---|---|---|---|"
    for label, hint, info, default in rows:
        cells = (label, _value(hint, info), _default(default), info.help or "")
        yield f"| {' | '.join(map(_cell, cells))} |"


def _value(hint: Any, info: Any) -> str:
    named = isinstance(info, typer.models.OptionInfo) and info.metavar is not None and hint is not bool
    kind = info.metavar if named else _kind(hint)
    low, high = info.min, info.max
    if low is not None and high is not None:
        kind += f", {low} to {high}"
    elif low is not None:
        kind += f", at least {low}"
    return kind


def _kind(hint: Any) -> str:
    """A type in words: of a choice its values, of a list what it repeats."""
    origin = typing.get_origin(hint)
    if origin is typing.Literal:
        return ", ".join(f"`{value}`" for value in typing.get_args(hint))
    if origin is list:
        return f"{_kind(typing.get_args(hint)[0])}, may be repeated"
    if origin in (types.UnionType, typing.Union):
        return _kind(next(one for one in typing.get_args(hint) if one is not type(None)))
    return _KINDS[hint]


def _default(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return "required"
    return "" if value is None or value is False or value == [] else f"`{value}`"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


if __name__ == "__main__":
    for path, text in pages().items():
        (MANUAL / path).write_text(text, encoding="utf-8")

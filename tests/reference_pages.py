"""Pages of the manual that follow from the code, so that a test can tell when they are out of date.

    python tests/reference_pages.py

writes them anew. `verbs.md` follows from the signatures and docstrings of the command line's functions, not
from the text of --help, which depends on typer's version and the terminal's width. `rig-yaml.md` follows from
the schema's classes: keys, types, ranges and defaults from their JSON schema, units from the keys' endings,
meanings from the docstrings.
"""

from __future__ import annotations

import ast
import fnmatch
import inspect
import itertools
import math
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel

from calib.cli.app import command_line
from calib.core.rig import KINDS, kind_of

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
    return {"reference/verbs.md": verbs_page(), "reference/rig-yaml.md": rig_page()}


def verbs() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Words and function of each verb, in the order of --help."""
    app = command_line()
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


_RIG_HEAD = """# Keys of rig.yaml

`python tests/reference_pages.py` generates this page from the schema. [Files](files.md) says which verb
writes which section.

A key ends with its unit. `[]` stands for the entries of a list, `NAME` for a name. A key without a default is
required in its section. Values must be finite. These keys have the same meaning in every section:

| key | meaning |
|---|---|
| `sigma` | standard deviations by key; null where the data do not bound one |
| `covariance` | `order`: names of the rows; `values`: the matrix |
| `verdict` | one of the words that the section's text lists |
| `reasons`, `remarks`, `advice` | why the verdict is so; what does not change it; what to record next |
"""

_COMMON = ("sigma", "covariance", "verdict", "reasons", "remarks", "advice")

_UNITS = {
    **{one: one for one in ("px", "mm", "m", "rad", "deg", "s", "kg", "N", "V", "kPa", "ticks")},
    **{f"{one}{power}": f"{one}^{power}" for one in ("m", "s", "rad") for power in (2, 3, 4)},
    **{f"{one}ps{power}": f"{one}/s^{power}" for one in ("m", "rad") for power in (2, 3)},
    **{f"{one}ps": f"{one}/s" for one in ("m", "rad", "deg")},
    "kgm2": "kg m^2",
    "hz": "Hz",
    "Hz": "Hz",
    "db": "dB",
    "pwm": "PWM",
}
"""Units by the last words of keys."""


def rig_page() -> str:
    """The page of rig.yaml: a table of keys for each section."""
    parts = [_RIG_HEAD.rstrip()]
    for name, section in sections().items():
        schema = section.model_json_schema()
        parts += ["", f"## {name}", "", _plain(inspect.getdoc(section) or "").split(" Attributes ---", 1)[0]]
        words = schema["properties"].get("verdict")
        if words is not None:
            parts[-1] += f" Verdict: {_type(words, schema)}."
        parts += ["", "| key | unit | type and range | default | meaning |", "|---|---|---|---|---|"]
        for key, entry, meaning in _keys("", schema, schema, section):
            default = "" if "default" not in entry else _written(entry["default"])
            cells = (f"`{key}`", unit(key), _type(entry, schema), default, meaning)
            parts.append(f"| {' | '.join(map(_cell, cells))} |")
    return "\n".join(parts) + "\n"


def sections() -> dict[str, type[BaseModel]]:
    """The class of each section of rig.yaml, in the order of the file."""
    return {name: kind_of(name) for name in KINDS}


def _keys(
    before: str, part: Mapping[str, Any], whole: Mapping[str, Any], kind: type[BaseModel]
) -> Iterator[tuple[str, Mapping[str, Any], str]]:
    """Dotted key, schema and meaning of every value; the parts of a section follow its own keys."""
    described = meanings(kind)
    for name, entry in part["properties"].items():
        if name in _COMMON and not before:
            continue
        inner, suffix = _inner(entry, whole)
        if inner is None:
            yield before + name, entry, described.get(name, "")
        else:
            yield from _keys(f"{before}{name}{suffix}.", inner, whole, _class_of(kind, inner["title"]))


def _inner(entry: Mapping[str, Any], whole: Mapping[str, Any]) -> tuple[Mapping[str, Any] | None, str]:
    """The part that a key holds, alone, in a list or by name, and what stands for that in the dotted key."""
    for one in (entry, *entry.get("anyOf", ()), *entry.get("allOf", ())):
        if "$ref" in one:
            return whole["$defs"][one["$ref"].rsplit("/", 1)[-1]], ""
        if "$ref" in one.get("items", {}):
            return whole["$defs"][one["items"]["$ref"].rsplit("/", 1)[-1]], "[]"
        if isinstance(one.get("additionalProperties"), dict) and "$ref" in one["additionalProperties"]:
            return whole["$defs"][one["additionalProperties"]["$ref"].rsplit("/", 1)[-1]], ".NAME"
    return None, ""


def _class_of(kind: type[BaseModel], title: str) -> type[BaseModel]:
    """The class of a part, which stands in the module of its section or in one that this imports."""
    for one in kind.__mro__:
        found = getattr(inspect.getmodule(one), title, None)
        if found is not None:
            return typing.cast("type[BaseModel]", found)
    raise LookupError(title)


def meanings(kind: type[BaseModel]) -> dict[str, str]:
    """What labels, the docstring's list of attributes and the text behind single fields say of each key."""
    parts = getattr(kind, "model_fields", {})
    out = {name: field.title for name, field in parts.items() if field.title}
    for one in reversed(kind.__mro__[: kind.__mro__.index(BaseModel if parts else object)]):
        listed = (inspect.getdoc(one) or "").partition("Attributes\n----------\n")[2]
        entries = re.split(r"(?:^|(?<=[.,] )|\n)((?:[\w*]+, )*[\w*]+) : ", listed)
        for names, text in zip(entries[1::2], entries[2::2], strict=True):
            for name in names.split(", "):
                keys = fnmatch.filter(getattr(one, "model_fields", one.__annotations__), name)
                out.update(dict.fromkeys(keys, _plain(text).rstrip(",")))
        named: list[ast.AnnAssign] = []
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        assert isinstance(tree, ast.ClassDef)
        for line in tree.body:
            if isinstance(line, ast.AnnAssign):
                # A text belongs to the fields before it, up to an empty line.
                named = [*named, line] if named and named[-1].end_lineno == line.lineno - 1 else [line]
            elif isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant):
                out.update({ast.unparse(one.target): _plain(str(line.value.value)) for one in named})
                named = []
    return out


def _plain(text: str) -> str:
    """Text on one line, without its references to modules."""
    return re.sub(r"[,;]? (?:see|of) `calib\.[\w.]+`", "", " ".join(text.split()))


def unit(key: str) -> str:
    """The unit that a key ends with: its last words that are units, as rad/s/sqrt(Hz)."""
    words = re.split(r"_", key.rsplit(".", 1)[-1])
    first = len(words)
    while first > 0 and (words[first - 1] in _UNITS or words[first - 1] in ("per", "sqrt")):
        first -= 1
    # A key may be a unit's letter itself, as `k` or `s` alone.
    parts: list[list[str]] = [[]]
    for before, word in itertools.pairwise(["", *words[max(first, 1) :]]):
        if word == "per":
            parts.append([])
        elif word != "sqrt":
            parts[-1].append(f"sqrt({_UNITS[word]})" if before == "sqrt" else _UNITS[word])
    above, *below = (" ".join(part) for part in parts)
    return "/".join([above or "1", *(f"({one})" if " " in one else one for one in below)]) if below else above


def _type(entry: Mapping[str, Any], whole: Mapping[str, Any]) -> str:
    """A type in words with its range."""
    if "anyOf" in entry:
        return " or ".join(_type(one, whole) for one in entry["anyOf"])
    if "const" in entry or "enum" in entry:
        return ", ".join(f"`{one}`" for one in entry.get("enum", [entry.get("const")]))
    if "pattern" in entry:
        return ", ".join(f"`{one}`" for one in re.findall(r"\w+", entry["pattern"]))
    kind = entry.get("type", "")
    if kind == "array":
        low, high = entry.get("minItems"), entry.get("maxItems")
        count = "" if low is None else f" of {low}" if low == high else f" of {low} to {high}"
        return f"list{count}: {_type(entry.get('items', {}), whole)}"
    if kind == "object":
        inner = entry.get("additionalProperties")
        return f"by name: {_type(inner, whole)}" if isinstance(inner, dict) else "keys with values"
    return {"string": "text", "boolean": "true or false", "integer": "whole number"}.get(kind, kind) + _range(
        entry
    )


def _range(entry: Mapping[str, Any]) -> str:
    limits = dict(entry)
    if limits.get("exclusiveMinimum", -math.inf) >= limits.get("minimum", math.inf):
        # A type's own limit, narrowed by the key's.
        del limits["minimum"]
    if "minimum" in limits and "maximum" in limits:
        return f", {limits['minimum']:g} to {limits['maximum']:g}"
    return "".join(f", {sign} {limits[key]:g}" for key, sign in _LIMITS.items() if key in limits)


_LIMITS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def _written(value: Any) -> str:
    return "null" if value is None else f"`{value}`"


if __name__ == "__main__":
    for path, text in pages().items():
        (MANUAL / path).write_text(text, encoding="utf-8")

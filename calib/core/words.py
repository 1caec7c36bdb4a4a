"""A result in words: the same blocks for the terminal, the page and a notebook, from the fields' own labels.

A field is shown when `quantity` gave it a label. Its unit is the end of its key, as everywhere in rig.yaml,
unless the field asks for another one to be shown in.
"""

from __future__ import annotations

import html
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeGuard

from calib.core.units import UNITS, unit_of
from calib.core.verdict import LEADS, Verdict

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

BLANK = "\N{EN DASH}"
"""What stands for a value that is not there."""

_SCALES = {
    ("m", "mm"): 1e3,
    ("s", "ms"): 1e3,
    ("rad", "mrad"): 1e3,
    ("rad", "°"): math.degrees(1.0),
    ("rad/s", "°/s"): math.degrees(1.0),
    ("kg", "g"): 1e3,
    ("", "%"): 1e2,
}
"""What a value in the unit of the file is multiplied by to be shown in another."""

_AXES = ("x", "y", "z")
_WIDEST = 108
"""Characters of a table's line."""
_LONGEST = 60
"""Text longer than this stands in a line of its own."""


@dataclass(frozen=True)
class Table:
    """Rows of cells under a head; the first column stands left, the others right."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    title: str = ""


@dataclass(frozen=True)
class Line:
    """A sentence; `kind` is "" or "verdict", "reason", "remark", "advice"."""

    text: str
    kind: str = ""


Block = Table | Line


def number(value: float | None, sigma: float | None = None, places: int | None = None) -> str:
    """A value with the digits that its deviation leaves, else with `places`, else with six figures."""
    if value is None or not math.isfinite(value):
        return BLANK
    if isinstance(value, int):
        return str(value)
    if sigma is not None and math.isfinite(sigma) and sigma > 0.0:
        places = 1 - math.floor(math.log10(sigma))
        if places < 0 and 0.0 < abs(value) < 1e9:
            # Tens and hundreds that the deviation leaves open are no digits either, but for two of the value.
            places = max(places, 1 - math.floor(math.log10(abs(value))))
            return f"{round(value, places):z.{max(places, 0)}f}"
        if not (0 <= places <= 12 and abs(value) < 1e9):
            places = None
    return f"{value:.6g}" if places is None else f"{value:z.{places}f}"


def short(value: float) -> str:
    """A value to four digits, whole numbers as they are."""
    if isinstance(value, int) or (value == round(value) and abs(value) < 1e7):
        return str(round(value))
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


class InWords(ABC):
    """A value that a person who types its name sees in words, in a notebook as tables."""

    @abstractmethod
    def blocks(self) -> Iterable[Block]:
        """The words."""

    def __repr__(self) -> str:
        return "\n".join(as_text(list(self.blocks())))

    def _repr_html_(self) -> str:
        return as_html(list(self.blocks()))


def described(result: BaseModel) -> list[Block]:
    """A result as tables and sentences: its quantities, its lists of parts, its verdict."""
    blocks = list(_parts(result))
    verdict = getattr(result, "verdict", None)
    if isinstance(verdict, Verdict):
        blocks += getattr(result, "more_words", tuple)()
        blocks += of_verdict(verdict)
    return blocks


def facts(section: BaseModel) -> list[tuple[str, str]]:
    """The few values that stand for a section, as label and text with unit; those that it has."""
    sigmas = getattr(section, "sigma", None)
    out: list[tuple[str, str]] = []
    for key, field, value in _labelled(section):
        extra = _extra(field)
        wanted, bars = extra.get("fact"), _named(sigmas, key)
        unit, scale, places = _shown(key, field)
        if isinstance(wanted, list):
            for item in wanted:
                name = _AXES[item] if isinstance(item, int) else as_words(str(item)).replace("max", "at most")
                one = value[item] if isinstance(item, int) else _named(value, str(item))
                own = unit or unit_of(str(item))
                bar = bars[item] if isinstance(bars, list) and isinstance(item, int) else None
                out.append((f"{field.title}, {name}", f"{_fact(one, bar, scale, places)} {own}".strip()))
        elif wanted and isinstance(value, bool | str):
            out.append((str(field.title), _word(value)))
        elif wanted:
            text = _fact(value, bars, scale, places)
            out.append((str(field.title), f"{text} {unit}".strip()))
    return [(label, text) for label, text in out if not text.startswith(BLANK)]


def _fact(value: Any, bar: Any, scale: float, places: int | None) -> str:
    """A value with its deviation; to four digits where nothing says how many it has."""
    if isinstance(value, float) and math.isfinite(value) and bar is None and places is None:
        return short(scale * value)
    return _vector([value], [bar], scale, places)[0]


def of_verdict(verdict: Verdict) -> list[Line]:
    """The verdict's word and sentences."""
    return [Line(text, kind) for kind, text in verdict.lines]


Rows = list[tuple[str, ...]]


def _is_part(value: Any) -> TypeGuard[BaseModel]:
    """Whether a value is a section or a part of one; pydantic itself takes long to load."""
    return hasattr(type(value), "model_fields")


def _parts(section: BaseModel) -> Iterator[Block]:
    """Numbers in a table, x y z in another, then lists and long texts."""
    scalars, vectors, later = _gathered(section, "")
    if scalars:
        bars = any(row[2] for row in scalars)
        head: tuple[str, ...] = ("", "value", "sigma") if bars else ("", "value")
        yield Table(head, tuple(row if bars else row[:2] for row in scalars))
    if vectors:
        longest = max(len(row) for row in vectors)
        head = ("", *_AXES[: longest - 1])
        yield Table(head, tuple((*row, *("",) * (longest - len(row))) for row in vectors))
    yield from later


def _gathered(section: BaseModel, prefix: str) -> tuple[Rows, Rows, list[Block]]:
    """Rows of numbers and of vectors, and what stands by itself, of a section and its parts."""
    scalars: Rows = []
    vectors: Rows = []
    later: list[Block] = []
    sigmas, bounds = getattr(section, "sigma", None), getattr(section, "below", None)
    for key, field, value in _labelled(section):
        label, bars = f"{prefix}{field.title}", _named(sigmas, key)
        unit, scale, places = _shown(key, field)
        parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
        first = next(iter(parts), None)
        if _is_part(value):
            inner = _gathered(value, f"{label} ")
            scalars += [*inner[0], *_unlabelled(value, sigmas, f"{label} ")]
            vectors += inner[1]
            later += inner[2]
        elif _is_part(first):
            later.append(listed(label, value))
        elif isinstance(value, Mapping):
            for name, one in value.items():
                # A table of values may hold several units, each at the end of its name.
                own = unit_of(name) or unit
                wide = _scaled(bars.get(name), scale) if isinstance(bars, Mapping) else None
                cell = one if isinstance(one, str) else number(_scaled(one, scale), wide, places)
                bar = "" if wide is None else number(wide, wide)
                scalars.append((_with_unit(f"{label} {as_words(name)}", own), cell, bar))
        elif isinstance(value, list) and all(isinstance(one, int) for one in value):
            scalars.append((_with_unit(label, unit), " x ".join(str(one) for one in value), ""))
        elif isinstance(value, list) and len(value) in (2, 3) and not isinstance(first, str | list):
            cells = _vector(value, bars, scale, places, _named(bounds, key))
            vectors.append((_with_unit(label, unit), *cells))
        elif isinstance(value, list):
            scalars.append((label, ", ".join(str(one) for one in value), ""))
        elif isinstance(value, str) and len(value) > _LONGEST:
            later.append(Line(f"{label}: {value}"))
        elif isinstance(value, bool | str):
            scalars.append((label, _word(value), ""))
        else:
            wide = _scaled(bars, scale) if isinstance(bars, int | float) else None
            unbounded = isinstance(sigmas, Mapping) and key in sigmas and wide is None
            bar = "not bounded" if unbounded else "" if wide is None else number(wide, wide)
            scalars.append((_with_unit(label, unit), number(_scaled(value, scale), wide, places), bar))
    return scalars, vectors, later


def _unlabelled(part: BaseModel, sigmas: Any, prefix: str) -> Iterator[tuple[str, str, str]]:
    """Numbers of a part whose keys are their own labels, as k1: those that are not zero or were estimated."""
    for key, field in type(part).model_fields.items():
        value, sigma = getattr(part, key), _named(sigmas, key)
        if field.title is None and isinstance(value, float) and (value != 0.0 or sigma is not None):
            bar = number(sigma, sigma) if isinstance(sigma, float) else ""
            yield (f"{prefix}{key}", number(value, sigma if isinstance(sigma, float) else None), bar)


def _word(value: bool | str) -> str:
    return value if isinstance(value, str) else "yes" if value else "no"


def _labelled(section: BaseModel) -> Iterator[tuple[str, FieldInfo, Any]]:
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        if field.title and value is not None and value != [] and value != {}:
            yield key, field, value


def _extra(field: FieldInfo) -> Mapping[str, Any]:
    """How a field is shown, as `quantity` was told."""
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def _shown(key: str, field: FieldInfo) -> tuple[str, float, int | None]:
    """Unit that a field is shown in, what its value is multiplied by for it, digits behind the point."""
    extra = _extra(field)
    unit = unit_of(key)
    show = {"deg": "°", "deg/s": "°/s"}.get(str(extra.get("show") or ""), str(extra.get("show") or ""))
    places = extra.get("digits")
    scale = _SCALES[unit, show] if show and show != unit else 1.0
    return show or unit, scale, places if isinstance(places, int) else None


def _scaled(value: float | None, scale: float) -> float | None:
    return value if value is None or scale == 1.0 else value * scale


def as_words(name: str) -> str:
    """A key without its unit, or keys that dots join."""
    keys = re.split(r"\.(?=[a-zA-Z])", name)
    if len(keys) > 1:
        return " ".join(map(as_words, keys))
    end = next((end for end in UNITS if name.endswith(end)), "")
    return name.removesuffix(end).replace("_", " ")


def _with_unit(label: str, unit: str) -> str:
    return f"{label}, {unit}" if unit else label


def _named(values: Any, key: str) -> Any:
    """A value of a mapping or of a section by its name, None where there is none."""
    return values.get(key) if isinstance(values, Mapping) else getattr(values, key, None)


def _vector(
    values: Sequence[Any], sigma: Any, scale: float, places: int | None, below: Any = None
) -> list[str]:
    """Values with their deviations, and the bounds of those that have no value."""
    bars, bounds = (
        one if isinstance(one, list) and len(one) == len(values) else [None] * len(values)
        for one in (sigma, below)
    )
    out = []
    for value, bar, bound in zip(values, bars, bounds, strict=True):
        wide = _scaled(bar, scale)
        text = number(_scaled(value, scale), wide, places)
        if text == BLANK:
            out.append(text if bound is None else f"< {_scaled(bound, scale):.2g}")
        else:
            out.append(text if wide is None else f"{text} ± {number(wide, wide)}")
    return out


def _cell(value: Any, scale: float, places: int | None, bar: float | None = None) -> str:
    """A value, or those of a list, of a list of lists with commas between the inner ones.

    `bar` is the deviation that says how many digits they have.
    """
    if isinstance(value, list):
        cells = [_cell(one, scale, places, bar) for one in value]
        return (", " if any(isinstance(one, list) for one in value) else " ").join(cells)
    return (
        _word(value)
        if isinstance(value, bool | str)
        else number(_scaled(value, scale), _scaled(bar, scale), places)
    )


def several(names: Sequence[str], most: int = 6) -> str:
    """Names for a sentence, each once, those beyond `most` counted."""
    names = list(dict.fromkeys(names))
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def counted(count: int, one: str) -> str:
    """A number of things, whose plural ends in s."""
    return f"{count} {one}{'s' * (count != 1)}"


def all_of(names: Sequence[str]) -> str:
    """Names for a sentence, as a, b and c."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


_MOST_NAMES = 8
"""Names that a sentence tells at most."""


def nearest(name: str, names: Iterable[str]) -> str:
    """The end of a sentence that asks for the most alike of some names, or else tells a few of them."""
    import difflib

    known = list(names)
    alike = difflib.get_close_matches(name, known, 1)
    if alike:
        return f"; did you mean {alike[0]}?"
    return f"; expected one of {', '.join(known)}" if 0 < len(known) <= _MOST_NAMES else ""


def listed(label: str, parts: Mapping[str, Any] | Sequence[Any]) -> Table:
    """Parts of one kind as a table, a row for each, with their names in front where they have some."""
    named = parts if isinstance(parts, Mapping) else {str(i): one for i, one in enumerate(parts)}
    shown = {
        key
        for one in named.values()
        for key, _, value in _labelled(one)
        if not (_is_part(value) or isinstance(value, Mapping))
    }
    columns: dict[str, FieldInfo] = {}
    for one in named.values():
        columns |= {key: field for key, field in type(one).model_fields.items() if key in shown}
    head = [_with_unit(str(field.title), _shown(key, field)[0]) for key, field in columns.items()]
    rows = []
    for name, one in named.items():
        cells = [name] if named is parts else []
        sigmas = getattr(one, "sigma", None)
        for key, field in columns.items():
            value = getattr(one, key)
            _, scale, places = _shown(key, field)
            by = _extra(field).get("digits_by")
            if by or isinstance(value, list | bool | str):
                cells.append(_cell(value, scale, places, getattr(one, str(by), None)))
            else:
                cells.append(*_vector([value], [_named(sigmas, key)], scale, places))
        rows.append(tuple(cells))
    return Table(((label, *head) if named is parts else tuple(head)), tuple(rows), label)


def as_text(blocks: Sequence[Block], widest: int = _WIDEST) -> list[str]:
    """Blocks as lines for a terminal, tables of more than `widest` characters in sheets."""
    out: list[str] = []
    for block in blocks:
        if isinstance(block, Line):
            out.append(LEADS.get(block.kind, "") + block.text)
            continue
        if block.title and block.head[0] != block.title:
            out.append(f"{block.title}:")
        whole = [block.head, *block.rows]
        widths = [max(len(row[i]) for row in whole) for i in range(len(block.head))]
        for columns in _in_sheets(widths, widest):
            for row in whole:
                cells = [row[0].ljust(widths[0]), *(row[i].rjust(widths[i]) for i in columns)]
                out.append("  " + "  ".join(cells).rstrip())
    return out


def _in_sheets(widths: Sequence[int], widest: int) -> list[list[int]]:
    """Columns behind the first, in as many tables below each other as a line's width asks for."""
    sheets: list[list[int]] = [[]]
    used = widths[0]
    for i, width in enumerate(widths[1:], 1):
        if sheets[-1] and used + 2 + width > widest:
            sheets.append([])
            used = widths[0]
        sheets[-1].append(i)
        used += 2 + width
    return sheets


def as_html(blocks: Sequence[Block]) -> str:
    """Blocks as HTML, for a notebook and for the page."""
    out: list[str] = []
    for block in blocks:
        if isinstance(block, Line):
            out.append(f'<p class="{block.kind or "line"}">{html.escape(block.text)}</p>')
            continue
        title = f"<caption>{html.escape(block.title)}</caption>" if block.title else ""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in block.head)
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in block.rows
        )
        out.append(f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>")
    return "\n".join(out)

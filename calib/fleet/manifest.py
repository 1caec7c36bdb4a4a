"""The manifest of a fleet: one row per rig, as CSV or YAML.

    name     what its results are called                path    its folder, or the URL of one
    serial   optional: its place in the order of making
    corners, square, model, loss, board                 optional: as the options of `calib intrinsics`

A CSV has these as its header. A YAML file has a list `rigs` of such mappings, and perhaps `options` that
hold for all. Relative paths start at the manifest's folder.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib.errors import BadInputError, CalibError
from calib.files import one_line, read_text, read_yaml_mapping, shown
from calib.units import parse_corners, parse_square_m

__all__ = [
    "OPTIONS",
    "Manifest",
    "RigSpec",
    "is_url",
    "read_manifest",
    "serial_number",
    "twice_told",
    "without_secrets",
]

OPTIONS = ("corners", "square", "model", "loss", "board")
"""What may differ from rig to rig."""

_CHOICES = {
    "model": ("auto", "pinhole", "radial2", "radial3", "brown5", "rational8"),
    "loss": ("none", "huber", "cauchy"),
    "board": ("rigid", "warp", "released", "auto"),
}
_COLUMNS = ("name", "path", "serial", *OPTIONS)
_SIGNS = frozenset(" -_.+#=@()")
_LONGEST = 80
_MOST_BYTES = 200_000_000
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


@dataclass(frozen=True)
class RigSpec:
    """A rig of the manifest.

    Attributes
    ----------
    name : safe as the name of a folder.
    source : absolute path of its folder, or a URL.
    serial : as written, "" without.
    options : of its camera, by name.
    """

    name: str
    source: str
    serial: str = ""
    options: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Manifest:
    """All rigs in their order, and the columns that mean nothing here."""

    rigs: tuple[RigSpec, ...]
    ignored: tuple[str, ...]


def is_url(source: str) -> bool:
    """Whether a source is a URL and not a path."""
    return _SCHEME.match(source) is not None


def without_secrets(source: str) -> str:
    """A source as it may be shown and kept: a URL without user, password and query, a path as it is."""
    if not is_url(source):
        return source
    scheme, _, rest = source.partition("://")
    host, slash, path = rest.partition("?")[0].partition("/")
    return one_line(f"{scheme}://{host.rpartition('@')[2]}{slash}{path}")


def serial_number(serial: str) -> float | None:
    """The number in a serial: all of it, or the digits at its end, as 17 of AX-0017. None without."""
    found = re.search(r"(\d{1,15})\D{0,2}$", serial)
    return float(found.group(1)) if found else None


def read_manifest(path: Path) -> Manifest:
    """The rigs of a manifest.

    Raises `BadInputError`, with line or entry, for a manifest without rigs, names that are no names, the
    same name twice, and options that `calib intrinsics` would refuse.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        rows, ignored = _from_yaml(path)
    else:
        rows, ignored = _from_csv(path)
    root, rigs, seen = path.absolute().parent, list[RigSpec](), dict[str, str]()
    for where, row in rows:
        rig = _rig(f"{shown(path)}, {where}", row, root)
        # Folders that differ in capitals only are one folder on some systems.
        before = seen.setdefault(rig.name.casefold(), where)
        if before != where:
            raise BadInputError(f"{shown(path)}, {where}: the name {rig.name!r} is that of {before}")
        rigs.append(rig)
    if not rigs:
        raise BadInputError(f"{shown(path)}: names no rigs, expected at least one row with name and path")
    return Manifest(tuple(rigs), ignored)


def twice_told(rigs: Iterable[RigSpec]) -> tuple[str, ...]:
    """Sentences on what several rigs have in common though it should be a rig's own."""
    said = []
    for what, key in (("folder", "source"), ("serial number", "serial")):
        seen, again = set[str](), list[str]()
        for rig in rigs:
            value = getattr(rig, key)
            if value and value in seen:
                again.append(rig.name)
            seen.add(value)
        if again:
            verb = "rig has" if len(again) == 1 else "rigs have"
            said.append(f"{len(again)} {verb} the {what} of one before, the first is {again[0]}")
    return tuple(said)


def _from_csv(path: Path) -> tuple[Iterator[tuple[str, Mapping[str, Any]]], tuple[str, ...]]:
    text = read_text(path, _MOST_BYTES)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        head = [name.strip() for name in next(reader, [])]
    except csv.Error as error:
        raise BadInputError(f"{shown(path)}, line 1: is not CSV: {error}") from error
    if not any(head):
        raise BadInputError(f"{shown(path)}: is empty, expected a header with name and path")
    for name in ("name", "path"):
        if name not in head:
            found = one_line(", ".join(head))[:80]
            raise BadInputError(f"{shown(path)}, line 1: has no column {name}, found {found}")
    twice = next((name for name in head if name and head.count(name) > 1), None)
    if twice is not None:
        raise BadInputError(f"{shown(path)}, line 1: has the column {one_line(twice)!r} twice")

    def rows() -> Iterator[tuple[str, Mapping[str, Any]]]:
        try:
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                where = f"line {reader.line_num}"
                if len(cells) != len(head):
                    raise BadInputError(
                        f"{shown(path)}, {where}: has {len(cells)} cells, the header {len(head)}"
                    )
                yield where, dict(zip(head, cells, strict=True))
        except csv.Error as error:
            raise BadInputError(f"{shown(path)}, line {reader.line_num}: is not CSV: {error}") from error

    return rows(), tuple(one_line(name) for name in head if name and name not in _COLUMNS)


def _from_yaml(path: Path) -> tuple[Iterator[tuple[str, Mapping[str, Any]]], tuple[str, ...]]:
    whole = read_yaml_mapping(path)
    unknown = next((key for key in whole if key not in ("rigs", "options")), None)
    if unknown is not None:
        raise BadInputError(
            f"{shown(path)}: {one_line(unknown)} is not a key that is known here, expected rigs and options"
        )
    listed, common = whole.get("rigs"), whole.get("options") or {}
    if not isinstance(listed, list):
        raise BadInputError(f"{shown(path)}: has no list rigs, expected one entry for each rig")
    if not isinstance(common, dict):
        raise BadInputError(f"{shown(path)}: options is no mapping, expected for instance model: radial2")
    strange = next((key for key in common if key not in OPTIONS), None)
    if strange is not None:
        raise BadInputError(
            f"{shown(path)}: options.{one_line(str(strange))} is not one of {', '.join(OPTIONS)}"
        )
    ignored: dict[str, None] = {}

    def rows() -> Iterator[tuple[str, Mapping[str, Any]]]:
        for number, entry in enumerate(listed, start=1):
            where = f"rig {number}"
            if not isinstance(entry, dict):
                raise BadInputError(f"{shown(path)}, {where}: is no mapping, expected name and path")
            yield where, {**common, **entry}

    for entry in listed:
        if isinstance(entry, dict):
            ignored |= dict.fromkeys(one_line(str(key)) for key in entry if key not in _COLUMNS)
    return rows(), tuple(ignored)


def _text(where: str, row: Mapping[str, Any], key: str) -> str:
    value = row.get(key)
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise BadInputError(f"{where}: {key} is {one_line(repr(value))[:60]}, expected text")
    return str(value).strip(" \t")


def _rig(where: str, row: Mapping[str, Any], root: Path) -> RigSpec:
    name = _text(where, row, "name")
    problem = _problem_of_name(name)
    if problem:
        raise BadInputError(f"{where}: the name {one_line(repr(name))[:60]} {problem}")
    source = _text(where, row, "path")
    if not source:
        raise BadInputError(f"{where}: {name} has no path, expected the rig's folder")
    if not source.isprintable():
        raise BadInputError(f"{where}: the path of {name} has control characters in it")
    if "::" in source and "://" in source:
        raise BadInputError(f"{where}: the URL of {name} chains several with '::', expected a plain one")
    if not is_url(source):
        source = str(root / source)
    serial = _text(where, row, "serial")
    if len(serial) > _LONGEST or not serial.isprintable():
        raise BadInputError(f"{where}: the serial of {name} is no short text")
    options = []
    for key in OPTIONS:
        value = _text(where, row, key)
        if value:
            _check_option(f"{where}: {key} of {name}", key, value)
            options.append((key, value))
    return RigSpec(name, source, serial, tuple(options))


def _problem_of_name(name: str) -> str:
    if not name:
        return "is empty, expected a name for the rig's results"
    if len(name.encode()) > _LONGEST:
        return f"is longer than {_LONGEST} bytes"
    if name[0] in ".- " or name[-1] in ". ":
        return "begins with a dot or a dash, or ends with a dot"
    wrong = next((c for c in name if not (c.isalnum() or c in _SIGNS)), None)
    if wrong is not None:
        signs = "".join(sorted(_SIGNS)).strip()
        return f"has {one_line(wrong)!r} in it, expected letters, digits and {signs}"
    return ""


def _check_option(where: str, key: str, value: str) -> None:
    try:
        if key == "corners":
            parse_corners(value)
        elif key == "square":
            parse_square_m(value)
    except CalibError as error:
        raise BadInputError(f"{where}: {error}") from error
    if key in _CHOICES and value not in _CHOICES[key]:
        raise BadInputError(f"{where} is {one_line(value)!r}, expected one of {', '.join(_CHOICES[key])}")

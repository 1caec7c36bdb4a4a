"""Values of a file against their schema, and one sentence for what is wrong: file, key, value, expectation.

Ranges stand in the schemas once. Here they become words, with the question that mostly answers it: was the
number typed in another unit?
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

from calib.core.errors import BadInputError, UnknownKeyError
from calib.core.files import one_line, quoted, shown
from calib.core.units import plain_number, unit_of
from calib.core.words import counted, nearest

Kind = TypeVar("Kind", bound=BaseModel)

_EXPECTED = {
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "dataclass_type": "keys with values",
    "dict_type": "keys with values",
    "finite_number": "a finite number",
    "float_parsing": "a number",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "invalid_key": "text as a key",
    "list_type": "a list",
    "model_attributes_type": "keys with values",
    "model_type": "keys with values",
    "string_type": "text",
    "tuple_type": "a list",
}
"""What pydantic's kinds of error ask for, in words."""

_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_OUT_OF_RANGE = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")

_MOST = 1e40
"""Of any number in a file, so that sums of squares and their products can be formed."""

_SMALLER = {
    "m": (1e-3, "millimetres"),
    "s": (1e-3, "milliseconds"),
    "kg": (1e-3, "grams"),
    "V": (1e-3, "millivolt"),
    "N/rad²": (1e-3, "mN/rad²"),
    "rad": (math.radians(1.0), "degrees"),
    "rad/s": (math.radians(1.0), "degrees per second"),
}
"""Units that a number too large is often typed in, and what they are of the right one."""


def validated(kind: type[Kind], values: Any, source: Path | str, key: str = "") -> Kind:
    """Values as the model that their schema asks for.

    Parameters
    ----------
    source : the file's name, and key : where in it the values stand, for the sentence.

    Raises `BadInputError` for the first thing that is wrong, `UnknownKeyError` for a key.
    """
    _refuse_endless(values, source, key)
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raised = UnknownKeyError if error.errors()[0]["type"] in _UNKNOWN else BadInputError
        raise raised(f"{shown(source)}: {_sentence(kind, error, key)}") from error


def _refuse_endless(value: Any, source: Path | str, key: str) -> None:
    """Raise `BadInputError` for numbers whose products are beyond what a float holds."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, part in parts:
        _refuse_endless(part, source, f"{key}.{name}" if key else str(name))
    if isinstance(value, int | float) and _MOST < abs(value) < math.inf:
        raise BadInputError(
            f"{shown(source)}: {one_line(key)} is {quoted(value)}, expected at most {_MOST:g}"
        )


def contradiction(text: str) -> PydanticCustomError:
    """An error that a model's validator raises of values that cannot stand together; `text` names the key."""
    return PydanticCustomError("contradiction", "{text}", {"text": text})


def _sentence(kind: type[BaseModel], error: ValidationError, under: str) -> str:
    first = error.errors()[0]
    how, value = first["type"], first.get("input")
    place, part, around = _place(kind, first["loc"])
    key = one_line(".".join(str(name) for name in (*([under] if under else []), *place)))
    if how == "contradiction":
        return f"{key}.{first['msg']}"
    if how == "missing":
        made_up = "; calib writes it, and of a section that you make up it is ok"
        return f"{key} is missing{made_up if place[-1] == 'verdict' else ''}"
    if how in _UNKNOWN:
        return f"{key} is not a key that is known here{nearest(str(place[-1]), around.get('properties', {}))}"
    message = first["msg"]
    expected = message[0].lower() + message[1:]
    for lead in ("value error, ", "input should be ", "expected "):
        expected = expected.removeprefix(lead)
    expected = _EXPECTED.get(how, expected)
    if how in ("too_short", "too_long"):
        limit = first["ctx"]["min_length" if how == "too_short" else "max_length"]
        exact = part.get("minItems") == part.get("maxItems")
        words = "" if exact else "at least " if how == "too_short" else "at most "
        expected = words + counted(limit, "value")
    elif how in _OUT_OF_RANGE and isinstance(value, int | float):
        expected = _range(part, _unit(place), value)
        return f"{key} is {value:g}, expected {expected}"
    elif how in ("float_type", "int_type") and isinstance(value, str) and plain_number(value) is not None:
        expected += " (without quotes, and in YAML an exponent needs a point and a sign, as 2.0e-2)"
    elif how == "float_type" and _unit(place):
        expected += f" ({_unit(place)})"
    if isinstance(value, dict):
        return f"{key}: expected {expected}"
    return f"{key} is {quoted(value)}, expected {expected}"


def _unit(place: list[int | str]) -> str:
    """Unit at the end of the last key that has one."""
    return next((unit for part in reversed(place) if (unit := unit_of(str(part)))), "")


def _range(part: Mapping[str, Any], unit: str, value: float) -> str:
    """What a number may be, from its JSON schema, and whether it looks like one in another unit."""
    least = part.get("minimum", part.get("exclusiveMinimum"))
    most = part.get("maximum", part.get("exclusiveMaximum"))
    above = "above" if "exclusiveMinimum" in part else "at least"
    below = "below" if "exclusiveMaximum" in part else "at most"
    of = f" {unit}" if unit else ""
    if most is None:
        return f"{above} {least:g}{of}"
    if least is None:
        return f"{below} {most:g}{of}"
    factor, other = _SMALLER.get(unit, (0.0, ""))
    asked = f"; is it in {other}?" if other and value > most and least <= factor * value <= most else ""
    if "exclusiveMinimum" in part or "exclusiveMaximum" in part:
        return f"{above} {least:g} and {below} {most:g}{of}{asked}"
    return f"{least:g} to {most:g}{of}{asked}"


def _place(
    kind: type[BaseModel], loc: tuple[int | str, ...]
) -> tuple[list[int | str], dict[str, Any], dict[str, Any]]:
    """Keys that lead to a place in a model, and the JSON schemas of what stands there and around it.

    Of a value that may be of several kinds, pydantic puts the kind among the keys; it is left out here.
    """
    whole = kind.model_json_schema()
    part: dict[str, Any] = whole
    around, place = part, []
    for name in loc:
        kinds = _kinds(part, whole)
        if len(kinds) > 1:
            part = next(one for one in kinds if (one.get("type") == "array") == str(name).startswith("list"))
            continue
        around = kinds[0]
        place.append(name)
        if isinstance(name, int):
            part = around.get("items", {})
        else:
            part = around.get("properties", {}).get(name) or around.get("additionalProperties") or {}
    return place, (_kinds(part, whole) or [{}])[0], around


def _kinds(part: Any, whole: dict[str, Any]) -> list[dict[str, Any]]:
    """What a value may be, references followed, null left out."""
    if not isinstance(part, dict):
        return [{}]
    if "$ref" in part:
        return _kinds(whole["$defs"][part["$ref"].rpartition("/")[2]], whole)
    if several := part.get("anyOf") or part.get("oneOf"):
        return [kind for one in several if one.get("type") != "null" for kind in _kinds(one, whole)]
    return [part]

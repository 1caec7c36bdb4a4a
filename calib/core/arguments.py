"""What a person gives a Python function, against the types that the function declares."""

from __future__ import annotations

import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from calib.core.errors import UsageError
from calib.core.files import quoted

Given = ParamSpec("Given")
Returned = TypeVar("Returned")

_WORDS = {
    bool: "True or False",
    int: "a whole number",
    float: "a finite number",
    str: "text",
    Path: "a path",
    NoneType: "None",
}


class _OtherTypeError(Exception):
    """A value is not of the type that is asked for."""


def taken(value: Any, kind: Any, what: str, or_words: str = "") -> Any:
    """A value as this type: a number, `bool`, `str`, `Path`, `Literal`, another class, a tuple or a union.

    Numbers and arrays of numpy become Python's, a whole number that is a float becomes an int, any sequence
    a tuple, text a path, and one path or text alone a tuple where several are possible.

    Parameters
    ----------
    what : function and keyword, for the sentence. or_words : what else it takes, for the sentence.

    Raises `UsageError` for a value that is none, and for a number that is not finite.
    """
    try:
        return _as(value, kind)
    except _OtherTypeError as error:
        plain = value is None or isinstance(value, bool | int | float | str | bytes | list | tuple | dict)
        found = quoted(value) if plain else f"of type {type(value).__name__}"
        raise UsageError(f"{what} is {found}, expected {_words(kind)}{or_words}") from error


def _as(value: Any, kind: Any) -> Any:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        for part in parts:
            try:
                return _as(value, part)
            except _OtherTypeError:
                continue
    elif kind is Any:
        return value
    elif kind is Path and isinstance(value, str | os.PathLike):
        return Path(value)
    elif origin is tuple:
        return _as_tuple(value, parts)
    elif origin is Literal or kind in (bool, int, float):
        plain = value.tolist() if hasattr(value, "tolist") else value
        if origin is Literal and isinstance(plain, str) and plain in parts:
            return plain
        if kind is bool and isinstance(plain, bool):
            return plain
        if kind in (int, float) and isinstance(plain, int | float) and not isinstance(plain, bool):
            # An integer may be larger than any float.
            if kind is float and abs(plain) <= sys.float_info.max:
                return float(plain)
            if kind is int and (isinstance(plain, int) or plain.is_integer()):
                return int(plain)
    elif isinstance(value, origin or kind):
        return value
    raise _OtherTypeError


def _as_tuple(value: Any, parts: tuple[Any, ...]) -> tuple[Any, ...]:
    several = parts[-1] is Ellipsis
    if several and isinstance(value, str | os.PathLike):
        value = (value,)
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        raise _OtherTypeError
    members = tuple(value)
    kinds = parts[:1] * len(members) if several else parts
    if len(members) != len(kinds):
        raise _OtherTypeError
    return tuple(_as(one, kind) for one, kind in zip(members, kinds, strict=True))


def _words(kind: Any) -> str:
    """What is asked for, for a sentence; None goes without saying beside others."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(_words(part) for part in parts if part is not NoneType)
    if origin is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if origin is tuple and parts[-1] is Ellipsis:
        return f"{_words(parts[0])} or several"
    if origin is tuple:
        return f"({', '.join(part.__name__ for part in parts)})"
    name = getattr(origin or kind, "__name__", kind)
    load = f", as of calib.{name}.load(path)" if hasattr(kind, "load") else ""
    return _WORDS.get(kind) or f"a {name}{load}"


def checked(function: Callable[Given, Returned], name: str = "") -> Callable[Given, Returned]:
    """The same function, under this name or its own, whose arguments are `taken` as it annotates them.

    What it takes by any name goes through as it is.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Given.args, **keywords: Given.kwargs) -> Returned:
        given, kinds = signature.bind(*args, **keywords), get_type_hints(function)
        for one, value in given.arguments.items():
            if signature.parameters[one].kind is not inspect.Parameter.VAR_KEYWORD:
                given.arguments[one] = taken(value, kinds.get(one, Any), f"calib.{call.__qualname__}: {one}")
        return function(*given.args, **given.kwargs)

    call.__name__, call.__qualname__ = name or function.__name__, name or function.__qualname__
    return call

"""The decorator of functions that are called for every event of a log."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

__all__ = ["compiled"]

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def compiled(
    inlined: bool = False,
) -> Callable[[Callable[Parameters, Returned]], Callable[Parameters, Returned]]:
    """Compile a function that makes no arrays, without counting references to those it gets.

    Counting them for a dozen arrays in each call took a third of a filter's time. Numba keeps the option
    `_nrt` for itself; without it all works the same, only slower. A product and a sum stay two roundings:
    where they may be one, the last digits depend on the order in which functions happen to be compiled.

    Parameters
    ----------
    inlined : whether it becomes part of its caller. A call passes seven numbers for each array.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
    if inlined:
        options["forceinline"] = True
    return cast("Callable[[Callable[Parameters, Returned]], Callable[Parameters, Returned]]", njit(**options))

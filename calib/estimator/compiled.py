"""The decorator of functions that are called for every event of a log."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit

__all__ = ["compiled"]

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def compiled(
    contract: bool = False,
) -> Callable[[Callable[Parameters, Returned]], Callable[Parameters, Returned]]:
    """Compile a function that makes no arrays, without counting references to those it gets.

    Counting them for a dozen arrays in each call took a third of a filter's time. Numba keeps the option
    `_nrt` for itself; without it all works the same, only slower.

    Parameters
    ----------
    contract : whether a product and a sum may be one instruction with one rounding.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
    if contract:
        options["fastmath"] = {"contract"}
    return cast("Callable[[Callable[Parameters, Returned]], Callable[Parameters, Returned]]", njit(**options))

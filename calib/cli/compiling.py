"""Telling a person who waits that functions are being compiled."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar

__all__ = ["telling"]

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")

SENTENCE = "compiling what this needs, once for this installation: up to a minute"


def telling(verb: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """A verb that says so once, on a terminal, when it has something compiled at its first use."""

    @functools.wraps(verb)
    def told(*args: Parameters.args, **options: Parameters.kwargs) -> Returned:
        if not sys.stderr.isatty():
            return verb(*args, **options)
        from calib.cli.common import narrate
        from calib.compilation import on_compiling

        with on_compiling(lambda: narrate(SENTENCE)):
            return verb(*args, **options)

    return told

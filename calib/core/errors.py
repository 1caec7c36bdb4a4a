"""The errors that a user sees: one sentence each, with the exit code that goes with it."""

from __future__ import annotations

import importlib
from typing import Any

EXIT_DONE = 0
EXIT_POOR = 1
"""Done and written, but the result fails its quality gate."""
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_INTERNAL = 70
"""A mistake of the program's own; nothing that a user can put right."""
EXIT_READER_GONE = 141

DISTRIBUTION = "calib-rig"
"""Name on the package index, where `calib` belongs to another project."""


def pip_install(extra: str) -> str:
    """The command that installs an extra of this project, for the end of a sentence."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


class CalibError(Exception):
    """Base of the errors that end a command with one sentence instead of a traceback."""

    exit_code = EXIT_BAD_INPUT

    def __init__(self, message: str = "") -> None:
        # A cell or a key that is quoted may hold what moves a terminal's cursor.
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """Text as a terminal may get it: line breaks and other control characters escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def package(name: str, needed: str) -> Any:
    """A module of a package that not everybody has. Raises `BadInputError` with what is needed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise BadInputError(needed) from error


class BadInputError(CalibError):
    """Something that was read is not what it has to be; the message names file, line or key."""


class UnknownKeyError(BadInputError):
    """A file has a key that nothing reads."""


class CopyError(BadInputError):
    """A file holds what another one holds that was read, which would count twice."""


class NoSectionError(BadInputError):
    """The rig's file lacks a section that is needed."""


class UsageError(CalibError):
    """The words of the command line do not fit together."""

    exit_code = EXIT_USAGE


class SomeFailedError(CalibError):
    """Some of several files could not be worked on; each had its sentence, and the others are done."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class ReaderGoneError(CalibError):
    """Nobody reads stdout any more, as when `head` has seen enough; there is no one to tell."""

    exit_code = EXIT_READER_GONE


def end_of(error: BaseException) -> tuple[int, str]:
    """Exit code and sentence of an error that ends a command, with the place of a fault in this package."""
    if isinstance(error, CalibError):
        return error.exit_code, str(error)
    if isinstance(error, MemoryError):
        return EXIT_BAD_INPUT, "out of memory; the input is larger than this machine can hold"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return EXIT_BAD_INPUT, f"{where}{error.strerror or error}"
    if isinstance(error, ModuleNotFoundError) and not (error.name or "calib").startswith("calib"):
        return (
            EXIT_BAD_INPUT,
            f"the Python package {error.name} is not there; install {DISTRIBUTION} with pip again",
        )
    where, trace = "", error.__traceback__
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", ""))
        if module.startswith("calib."):
            where = f" ({module}, line {trace.tb_lineno})"
        trace = trace.tb_next
    words = " ".join(str(error).split())[:200]
    what = f"{type(error).__name__}{': ' if words else ''}{words}{where}"
    return EXIT_INTERNAL, f"internal error: {what}; please report it (CALIB_DEBUG=1 shows more)"

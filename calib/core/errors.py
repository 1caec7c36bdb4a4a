"""The errors that a user sees: one sentence each, with the exit code that goes with it."""

from __future__ import annotations

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
        super().__init__("".join(_visible(c) for c in message) if not message.isprintable() else message)


def _visible(character: str) -> str:
    if character.isprintable():
        return character
    return character.encode("unicode_escape").decode("ascii")


class BadInputError(CalibError):
    """Something that was read is not what it has to be; the message names file, line or key."""


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

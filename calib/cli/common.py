"""What all verbs share: options, narration, progress and the JSON document."""

from __future__ import annotations

import contextlib
import functools
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar

import typer

from calib.core.errors import BadInputError, CalibError, ReaderGoneError, UsageError
from calib.core.files import one_line, shown
from calib.core.stage import ProgressCall, finite
from calib.core.words import Table, as_text
from calib.core.writing import stdout_is_taken, writes_through

# ----------------------------------------------------------------------
# Telling a person who waits that functions are being compiled.

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")

SENTENCE = "compiling what this needs, once for this installation: up to a minute"


def telling(verb: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """A verb that says so once, on a terminal, when it has something compiled at its first use."""

    # What typer and the manual read; Python 3.14 would hand on a function's own annotations alone.
    @functools.wraps(verb, assigned=(*functools.WRAPPER_ASSIGNMENTS, "__annotations__"))
    def told(*args: Parameters.args, **options: Parameters.kwargs) -> Returned:
        if not sys.stderr.isatty():
            return verb(*args, **options)
        from calib.core.compilation import on_compiling

        with on_compiling(lambda: narrate(SENTENCE)):
            return verb(*args, **options)

    return told


# ----------------------------------------------------------------------
# What all verbs share: options, narration, progress and the JSON document.

RigOption = Annotated[Path, typer.Option("--rig", help="The rig's file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of words.")]
FiguresOption = Annotated[
    Path | None, typer.Option("--figures", help="Folder to draw figures into, made if needed.")
]


def check_log_name(output: Path) -> None:
    """Raise `UsageError` for a name that a log cannot have."""
    if output.suffix.lower() not in (".csv", ".parquet") and not writes_through(output):
        raise UsageError(f"{shown(output)}: expected a name that ends in .csv or .parquet")


def refuse_recorded(output: Path) -> None:
    """Raise `BadInputError` where a recording is already."""
    if output.is_file() and output.stat().st_size:
        raise BadInputError(
            f"{shown(output)}: is there, and a recording cannot be made again; give another name, or move it"
        )


def narrate(message: str) -> None:
    """A line for the person who watches, on stderr; whether it arrives changes nothing."""
    with contextlib.suppress(OSError):
        sys.stderr.write(one_line(message) + "\n")
        sys.stderr.flush()


def say(message: str = "") -> None:
    """A line of the result, on stdout."""
    emit(one_line(message) + "\n")


def emit(text: str) -> None:
    """Text of the result as it is, on stdout; on stderr where a file was asked for there."""
    try:
        (sys.stderr if stdout_is_taken() else sys.stdout).write(text)
    except BrokenPipeError as error:
        raise ReaderGoneError("") from error
    except OSError as error:
        raise CalibError(f"standard output: cannot be written: {error.strerror or error}") from error


def document(verb: str, sections: dict[str, Any]) -> None:
    """Print the JSON document of a verb; what is not finite becomes null."""
    emit_json(finite({"schema": 1, "verb": verb, **sections}))


def emit_json(whole: dict[str, Any]) -> None:
    """Print a JSON document."""
    emit(json.dumps(whole, indent=1, allow_nan=False, ensure_ascii=True) + "\n")


def answer(as_json: bool, verb: str, told: dict[str, Any], *lines: str) -> None:
    """Print what a verb has to say: its document, or lines."""
    if as_json:
        document(verb, told)
        return
    for line in lines:
        say(line)


@contextmanager
def progress_bar(label: str) -> Iterator[ProgressCall]:
    """A bar on stderr while a person watches, nothing otherwise."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def say_table(head: list[str], rows: list[list[str]]) -> None:
    """A table of the result, on stdout, the first column to the left and the others to the right."""
    for line in as_text([Table(tuple(head), tuple(map(tuple, rows)))], sys.maxsize):
        say(line)

"""The command `calib`: what it sets up, and how errors end it.

The verbs are imported once all that is in place, so that Ctrl-C is answered early, too.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from typing import Any, NoReturn, TextIO

from calib.core.compiled import choose_folder
from calib.core.errors import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_INTERNAL,
    EXIT_READER_GONE,
    CalibError,
    UsageError,
)
from calib.core.files import one_line

# Small matrices gain nothing from BLAS threads, and sums then do not depend on their number.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
# No plugin of pydantic is wanted, and the search for them loads every installed package's metadata.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
choose_folder()

_EXIT_INTERRUPTED = 130
_AGAIN_S = 3.0
"""How long the answer to Ctrl-C may take before it is raised again."""


def main() -> NoReturn:
    """Run the command; every failure is one sentence on stderr and an exit code.

    With CALIB_DEBUG=1 in the environment an unforeseen failure shows where it happened, and what
    libraries write to stderr is not held back.
    """
    debug = os.environ.get("CALIB_DEBUG") == "1"
    _prepare_streams(debug)
    with warnings.catch_warnings():
        if not sys.warnoptions and not debug:
            warnings.simplefilter("ignore")
        with _interrupts_that_are_not_lost():
            code = _flushed(_run(debug))
    if code == _EXIT_INTERRUPTED and _still_working():
        # Nothing waits for threads and processes that are still searching, or were just being started.
        os._exit(code)
    sys.exit(code)


@contextlib.contextmanager
def _interrupts_that_are_not_lost() -> Iterator[None]:
    """Take SIGTERM and the terminal's end as Ctrl-C, and raise it again where it came while nothing could be
    raised, as in a finaliser or a callback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    again = hasattr(signal, "setitimer")

    def interrupt(*_: object) -> None:
        if again:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        raise KeyboardInterrupt

    # What whoever started this process has told it to ignore stays ignored.
    taken: dict[int, Any] = {
        number: before
        for number in (getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP"))
        if number is not None
        and (before := signal.getsignal(number)) in (signal.default_int_handler, signal.SIG_DFL)
    }
    if again and taken:
        taken[signal.SIGALRM] = signal.getsignal(signal.SIGALRM)
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        if again:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, before in taken.items():
            signal.signal(number, before)


def _still_working() -> bool:
    import multiprocessing

    return threading.active_count() > 1 or bool(multiprocessing.active_children())


def _run(debug: bool) -> int:
    try:
        from calib.cli.app import app
        from calib.core.command import one_command

        empty = next((word for word in sys.argv[1:] if not word or re.fullmatch(r"--[a-z-]+=", word)), None)
        if empty is not None:
            raise UsageError(f"an argument is empty: {empty!r}")
        with one_command():
            app(prog_name="calib")
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else EXIT_DONE
        if code == _EXIT_INTERRUPTED:
            return _interrupted()
        return code
    except CalibError as error:
        return _ended(str(error), error.exit_code)
    except KeyboardInterrupt:
        return _interrupted()
    except MemoryError:
        return _ended("out of memory; the input is larger than this machine can hold", EXIT_BAD_INPUT)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _ended(f"{where}{error.strerror or error}", EXIT_BAD_INPUT)
    except Exception as error:
        if debug:
            traceback.print_exc()
        return _ended(
            f"internal error: {_described(error)}; please report it (CALIB_DEBUG=1 shows more)", EXIT_INTERNAL
        )
    return EXIT_DONE


def _ended(message: str, code: int) -> int:
    if message:
        with contextlib.suppress(OSError):
            sys.stderr.write(f"calib: {one_line(' '.join(message.split()))}\n")
    return code


def _interrupted() -> int:
    if hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread():
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return _ended("interrupted; files that were there before are unchanged or whole", _EXIT_INTERRUPTED)


def _described(error: BaseException) -> str:
    """Kind and words of an exception, and where in this package it came from."""
    where = ""
    trace = error.__traceback__
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", ""))
        if module.startswith("calib."):
            where = f" ({module}, line {trace.tb_lineno})"
        trace = trace.tb_next
    words = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}{': ' if words else ''}{words}{where}"


def _prepare_streams(debug: bool) -> None:
    """Standard streams that exist, take any text, and are not written to by libraries in C."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  open while the process lives
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  open while the process lives
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file's name may hold what the terminal's encoding has not.
        sys.stdout.reconfigure(errors="backslashreplace")
    if not debug and sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        # libpng and libjpeg print their complaints; ours go to a descriptor of our own.
        own = os.dup(2)
        encoding = sys.stderr.encoding
        sys.stderr = os.fdopen(own, "w", buffering=1, encoding=encoding, errors="backslashreplace")
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 2)
        os.close(nothing)


def _flushed(code: int) -> int:
    """Exit code after all of stdout has been written, or could not be; narration may be lost."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = code or EXIT_READER_GONE
        _emptied(sys.stdout)
    except OSError as error:
        code = _ended(f"standard output: cannot be written: {error.strerror or error}", EXIT_BAD_INPUT)
        _emptied(sys.stdout)
    try:
        sys.stderr.flush()
    except OSError:
        _emptied(sys.stderr)
    return code


def _emptied(stream: TextIO) -> None:
    """What is left in the buffer would be tried again, and complained of, at the interpreter's end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())

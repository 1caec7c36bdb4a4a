"""The command `calib`: what it sets up, and how errors end it.

The verbs are imported once all that is in place, so that Ctrl-C is answered early, too.
"""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import os
import re
import sys
import threading
import traceback
import warnings
from typing import NoReturn, TextIO

from calib.cli.interrupts import Interrupts
from calib.core.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERNAL, EXIT_READER_GONE, UsageError, end_of
from calib.core.files import one_line

# Small matrices gain nothing from BLAS threads, and sums then do not depend on their number.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
# No plugin of pydantic is wanted, and the search for them loads every installed package's metadata.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
# What modules make stays; looking through it for garbage takes a tenth of a start.
gc.set_threshold(100_000, 20, 20)

_EXIT_INTERRUPTED = 130
_INTERRUPTED = "interrupted; files that were there before are unchanged or whole"


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
        if not debug:
            # It has much to say of a home that it cannot write to, and draws as well without one.
            logging.getLogger("matplotlib").setLevel(logging.ERROR)
        interrupts = Interrupts()
        with interrupts.taken(_leave):
            code = _flushed(_run(debug, interrupts))
    if code == _EXIT_INTERRUPTED and _still_working():
        # Nothing waits for threads and processes that are still searching, or were just being started.
        os._exit(code)
    sys.exit(code)


def _leave() -> None:
    """End the process from another thread, while the main one cannot be reached."""
    _ended(_INTERRUPTED, _EXIT_INTERRUPTED)
    os._exit(_EXIT_INTERRUPTED)


def _still_working() -> bool:
    import multiprocessing

    return threading.active_count() > 1 or bool(multiprocessing.active_children())


def _run(debug: bool, interrupts: Interrupts) -> int:
    try:
        from calib.cli.app import command_line
        from calib.core.command import one_command

        empty = next((word for word in sys.argv[1:] if not word or re.fullmatch(r"--[a-z-]+=", word)), None)
        if empty is not None:
            raise UsageError(f"an argument is empty: {empty!r}")
        with one_command():
            command_line(sys.argv[1:])(prog_name="calib")
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else EXIT_DONE
        if code == _EXIT_INTERRUPTED:
            interrupts.settle()
            return _ended(_INTERRUPTED, code)
        return code
    except KeyboardInterrupt:
        interrupts.settle()
        return _ended(_INTERRUPTED, _EXIT_INTERRUPTED)
    except Exception as error:
        code, sentence = end_of(error)
        if code == EXIT_INTERNAL and interrupts.came:
            # A library that drops the interruption goes on with what it has not done.
            interrupts.settle()
            return _ended(_INTERRUPTED, _EXIT_INTERRUPTED)
        if code == EXIT_INTERNAL and debug:
            traceback.print_exc()
        return _ended(sentence, code)
    return EXIT_DONE


def _ended(message: str, code: int) -> int:
    if message:
        with contextlib.suppress(OSError):
            sys.stderr.write(f"calib: {one_line(' '.join(message.split()))}\n")
    return code


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

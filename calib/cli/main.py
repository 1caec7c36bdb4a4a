"""The command `calib`: its verbs, and how errors end it."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

# Small matrices gain nothing from BLAS threads, and sums then do not depend on their number.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")

import typer

from calib import __version__
from calib.cli.board import board
from calib.cli.distortion import distortion
from calib.cli.exchange import export_camera, import_camera
from calib.cli.extrinsics import extrinsics
from calib.cli.firmware import firmware
from calib.cli.intrinsics import intrinsics
from calib.errors import EXIT_BAD_INPUT, CalibError

__all__ = ["app", "main"]

app = typer.Typer(
    name="calib",
    help="Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(value: bool) -> None:
    if value:
        sys.stdout.write(f"calib {__version__}\n")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", help="Show the version and leave.", callback=_show_version, is_eager=True
    ),
) -> None:
    pass


app.command("intrinsics")(intrinsics)
app.command("extrinsics")(extrinsics)
app.command("distortion")(distortion)
app.command("firmware")(firmware)
app.command("board")(board)
app.command("export")(export_camera)
app.command("import")(import_camera)


def _say(message: str) -> None:
    sys.stderr.write(f"calib: {' '.join(message.split())}\n")


def main() -> NoReturn:
    """Run the command; every foreseen failure is one sentence on stderr and an exit code."""
    try:
        app()
    except CalibError as error:
        _say(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _say("interrupted; files that were there before are unchanged")
        sys.exit(130)
    except BrokenPipeError:
        # The reader of stdout went away, as `head` does.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except MemoryError:
        _say("out of memory; the input is larger than this machine can hold")
        sys.exit(EXIT_BAD_INPUT)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _say(f"{where}{error.strerror or error}")
        sys.exit(EXIT_BAD_INPUT)
    sys.exit(0)

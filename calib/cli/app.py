"""The verbs of `calib`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from calib.cli.common import telling
from calib.cli.verbs import OneByDefault, group, verb
from calib.core import __version__
from calib.stages import STAGES, stage

_VERBS = [
    "run",
    "intrinsics",
    "live",
    "extrinsics",
    "distortion",
    "lowpass",
    "imu",
    "align",
    "replay",
    "identify",
    "control",
    "validate",
    "firmware",
    "fleet",
    "sweep",
    "record",
    "track",
    "join",
    "convert",
    "board",
    "simulate",
    "export",
    "import",
    "report",
    "diff",
    "doctor",
    "docs",
]
"""In the order of --help."""
_GROUPS = {
    "imu": "Understand an IMU: its bias, its noise, its drift.",
    "identify": "Identify the actuator from LOG..., a pump from tables, springs from weights; all with error "
    "bars. calib identify LOG... is identify logs, or identify arm of logs with pressures.",
    "control": "Try controllers on the identified model before the hardware.",
}
_ELSEWHERE = {
    "sweep": "fleet.sweep",
    "board": "camera.board",
    "export": "camera.export_camera",
    "import": "camera.import_camera",
}
"""Module and function of verbs that have no module of their name."""
_COMPILE = ("run", "align", "replay", "validate", "fleet", "sweep", "simulate")
"""Verbs whose first use compiles functions; those of groups say so by themselves."""


def command_line(words: Sequence[str] = ()) -> typer.Typer:
    """The command with all its verbs, or with the one that a line of words begins with.

    To import and declare them all takes as long as to calibrate a camera from a few pictures.
    """
    made = typer.Typer(
        name="calib",
        help="Calibrate a cheap camera and an IMU on a machine, down to the constants in its firmware.",
        epilog="Begin with calib run -o demo, a simulated rig, or with calib docs tutorial.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback()(_options)
    for name in words[:1] if words and words[0] in _VERBS else _VERBS:
        if name in _GROUPS:
            kind = OneByDefault if name == "identify" else TyperGroup
            made.add_typer(group(name, _GROUPS[name], kind), name=name)
        else:
            made.command(name)(_verb(name))
    return made


def _verb(name: str) -> Callable[..., Any]:
    if name in STAGES:
        function = verb(stage(name))
    else:
        module, _, own = _ELSEWHERE.get(name, f"{name}.{name}").partition(".")
        function = getattr(importlib.import_module(f"calib.cli.{module}"), own)
    return telling(function) if name in _COMPILE else function


def _show_version(value: bool) -> None:
    if value:
        sys.stdout.write(f"calib {__version__}\n")
        raise typer.Exit


def _options(
    version: bool = typer.Option(
        False, "--version", help="Show the version and leave.", callback=_show_version, is_eager=True
    ),
) -> None:
    pass

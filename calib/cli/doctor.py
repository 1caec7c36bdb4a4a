"""`calib doctor`: whether the installation is whole, and which optional tools are there."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from calib.cli.common import JsonOption, document, say, say_table
from calib.core.errors import EXIT_POOR


def doctor(
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave out the trial of the whole camera chain.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check the installation: Python, libraries, compiled code, a small trial, and optional tools.

    Exits 1 when something that calib needs is missing or does not work.
    """
    from calib.runner.doctor import examine

    checks = examine(quick)
    bad = [check for check in checks if check.needed and not check.good]
    if as_json:
        gate = [c.name for c in bad] or "passed"
        document("doctor", {"checks": [asdict(check) for check in checks], "gate": gate})
    else:
        rows = [
            [c.name, "ok" if c.good else "MISSING" if c.needed else "not there", c.found, c.what_for]
            for c in checks
        ]
        say_table(["", "", "found", "for"], rows)
        say(f"verdict: {'poor, ' + ', '.join(c.name for c in bad) if bad else 'ok'}")
    if bad:
        raise typer.Exit(EXIT_POOR)

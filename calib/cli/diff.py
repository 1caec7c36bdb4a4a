"""`calib diff`: what changed between two calibrations, and whether it is more than their error bars."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.common import JsonOption, document, narrate, say, say_table
from calib.core.words import number, several

if TYPE_CHECKING:
    from calib.core.diff import Change, RigDiff


def diff(
    before: Annotated[Path, typer.Argument(help="rig.yaml of one calibration.")],
    after: Annotated[Path, typer.Argument(help="rig.yaml of the other.")],
    every: Annotated[
        bool, typer.Option("--all", help="Show every constant that differs, not only the foremost.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Page to write: both over the picture and on the plane."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two calibrations, in standard deviations and in millimetres on the plane.

    Exits 0 whatever has changed; the two are taken as independent of each other.
    """
    from calib.core.rig import Rig

    one, other = Rig.load(before), Rig.load(after)
    found = one.diff(other)
    if output is not None:
        from calib.core.command import note_inputs
        from calib.core.files import shown
        from calib.core.writing import check_writable
        from calib.show.diff import write_diff_page
        from calib.show.page import PAGE

        note_inputs([before, after])
        check_writable(output, PAGE)
        write_diff_page(output, one, other, (shown(before), shown(after)), found)
        narrate(f"page written to {shown(output)}")
    if as_json:
        document("diff", asdict(found))
        return
    _tell(found, every)


_SHOWN = 20


def _tell(found: RigDiff, every: bool) -> None:
    both = [c for c in found.changes if c.before is not None and c.after is not None]
    say(f"{found.compared} constants are in both, {len(both)} of them differ")
    rows = [_row(change) for change in (both if every else both[:_SHOWN])]
    if rows:
        say_table(["constant", "before", "after", "difference", "unit", "in sigma", ""], rows)
    if len(rows) < len(both):
        say(f"  {len(both) - len(rows)} more (--all shows them)")
    alone = [
        c for c in found.changes if c.section.partition(".")[0] not in (*found.only_before, *found.only_after)
    ]
    for words, names in (
        ("only before", [*found.only_before, *(f"{c.section}.{c.name}" for c in alone if c.after is None)]),
        ("only after", [*found.only_after, *(f"{c.section}.{c.name}" for c in alone if c.before is None)]),
        ("also different", [f"{section} ({', '.join(keys)})" for section, keys in found.others.items()]),
        ("learnt from other inputs", found.other_inputs),
    ):
        if names:
            say(f"{words}: {several(names, len(names) if every else _SHOWN)}")
    for one in found.verdicts:
        say("verdict of {section}: {before} before, {after} after".format(**one))
    plane = found.plane
    if found.pictures_px is not None:
        before, after = ("x".join(map(str, size)) for size in found.pictures_px)
        say(
            f"the cameras have pictures of two sizes, {before} px before and {after} px after: "
            "their pixels are not compared, so that there is no difference in millimetres"
        )
    elif plane is None:
        say("no plane in both, or none of the workspace in the picture: no difference in millimetres")
    else:
        bar = "" if not plane.sigma_mm else f", sigma {plane.sigma_mm:.4f} mm"
        say(
            f"a marker in the workspace is read {plane.mean_mm:.4f} mm elsewhere on average, "
            f"{plane.largest_mm:.4f} mm at most{bar}: {_judged(plane.significant)}"
        )
    bare = sum(change.significant is None for change in both)
    also = f"; {bare} without error bars differ{'s' * (bare == 1)}" if bare else ""
    say(f"in all: {'significant' if found.significant else 'nothing beyond the error bars'}{also}")


def _row(change: Change) -> list[str]:
    assert change.before is not None and change.after is not None
    return [
        f"{change.section}.{change.name}",
        number(change.before, change.sigma),
        number(change.after, change.sigma),
        f"{change.after - change.before:+.3g}",
        change.unit,
        "-" if change.sigmas is None else f"{change.sigmas:.1f}",
        _judged(change.significant),
    ]


def _judged(significant: bool | None) -> str:
    return "no error bars" if significant is None else "significant" if significant else "not significant"

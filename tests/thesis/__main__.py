"""`python tests/thesis`: the table of claims; `--figures DIR` draws, `--robustness N` tries other rigs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

if not __package__:
    # Run by its folder: its modules are to be those of the package.
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from thesis.album import ALBUM
from thesis.book import BOOK, Examined, by_basis, count, examine, rows, select
from thesis.outcome import Outcome
from thesis.robustness import report
from thesis.source_figures import write_source_figures

_BASIS = {
    "equations": "from the equations alone",
    "printed": "from printed numbers",
    "twin": "on the simulated rig, with other figures fixed beforehand",
    "chosen": "on the simulated rig, this very figure among those it was chosen by",
}


def _table(cells: list[list[str]]) -> list[str]:
    """Lines of a table of words, every column to the left."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]


def _words(examined: tuple[Examined, ...]) -> list[str]:
    """What came of the claims: a table, the computation of each, and the sums."""
    table = [["claim", "where", "kind", "basis", "outcome", "our figure"]]
    details = []
    for claim, finding in ((one.claim, one.finding) for one in examined):
        ours = finding.ours + (" (simulated)" if finding.simulated else "")
        table.append([claim.id, claim.where, claim.kind, claim.basis, finding.outcome.value, ours])
        printed = "" if claim.printed == "-" else f"; printed: {claim.printed}"
        details.append(f"{claim.id}: {claim.says}{printed}")
        details.append(f"  {finding.outcome.value}: {finding.how}")
    total = ", ".join(f"{number} {outcome.value}" for outcome, number in count(examined).items())
    sums = [f"{len(examined)} of {len(BOOK)} claims: {total}"]
    for basis, outcomes in by_basis(examined).items():
        sums.append(
            f"  {sum(outcomes.values()):2d} {_BASIS[basis]}: {outcomes[Outcome.REPRODUCED]} reproduced, "
            f"{outcomes[Outcome.REFUTED]} refuted, {outcomes[Outcome.UNMEASURED]} open"
        )
    return [*_table(table), *details, *sums]


def main() -> None:
    parser = argparse.ArgumentParser(prog="thesis", description=__doc__)
    parser.add_argument("claims", nargs="*", help="beginnings of the names of claims, all without any")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw the source's figures into a folder")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of words")
    parser.add_argument("--robustness", type=int, metavar="N", help="try N other rigs instead")
    options = parser.parse_args()
    if options.robustness:
        report(options.robustness)
        return
    if options.figures is not None:
        paths = write_source_figures(options.figures, ALBUM)
        print(f"{len(paths) - 2} simulated figures, {paths[-1]} shows them all", file=sys.stderr)
    examined = examine(select(options.claims))
    if options.json:
        print(json.dumps(rows(examined), indent=1))
    else:
        print("\n".join(_words(examined)))


if __name__ == "__main__":
    main()

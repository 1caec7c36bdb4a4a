"""Compute the claims of the source document again, and draw its figures from simulated runs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

if not __package__:
    # Run by its folder: its modules are to be those of the package.
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from thesis.book import ALBUM, examine, golden, row, select, words
from thesis.robustness import report
from thesis.sheets import write_figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="thesis", description=__doc__)
    parser.add_argument("claims", nargs="*", help="beginnings of the names of claims, all without any")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw the source's figures into a folder")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of words")
    parser.add_argument("--robustness", type=int, metavar="N", help="try N other rigs instead")
    parser.add_argument("--golden", action="store_true", help="write golden.json, which the tests hold, anew")
    options = parser.parse_args()
    if options.golden:
        Path(__file__).with_name("golden.json").write_text(json.dumps(golden(), indent=1) + "\n")
        return
    if options.robustness:
        report(options.robustness)
        return
    if options.figures is not None:
        paths = write_figures(options.figures, ALBUM)
        print(f"{len(ALBUM)} simulated figures, {paths[-1]} shows them all", file=sys.stderr)
    examined = [examine(one) for one in select(options.claims)]
    if options.json:
        print(json.dumps([row(one) for one in examined], indent=1))
    else:
        print("\n".join(words(examined)))


if __name__ == "__main__":
    main()

"""Every job beside its peers in one table: `python tests/bench [--full]`.

Ratios of one run, medians of interleaved repetitions. Peers come with `pip install .[peers]`; mrcal and
mrgingham are Debian packages. A peer that is not there is skipped by name. --full adds a thousand views and
OpenCV's calibrateCameraExtended, which takes ten seconds. Ratios mean something on an idle machine only.
"""

from __future__ import annotations

import sys

import _here  # noqa: F401
import allan
import dynamics
import estimator
import mahony
import monte_carlo
import solver
import startup
import whole_process
import whole_run
from _rows import Row, print_rows


def main(full: bool) -> None:
    """Print the table, job by job."""
    found: list[Row] = whole_process.rows()
    solved = solver.rows((20, 100, 400, 1000) if full else (20, 100, 400), full)
    found += solved
    for job in (mahony, allan, estimator, dynamics, monte_carlo, startup, whole_run):
        found += job.rows()
    print_rows(found)
    print(solver.growth(solved))


if __name__ == "__main__":
    main("--full" in sys.argv)

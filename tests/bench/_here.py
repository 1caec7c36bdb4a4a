"""Imported first by each benchmark: one thread for OpenBLAS, the tests' modules, where files lie."""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

BENCH = Path(__file__).resolve().parent
TESTS = BENCH.parent
ROOT = TESTS.parent
sys.path[:0] = [str(TESTS), *(str(TESTS / part) for part in ("camera", "firmware"))]


def numbers(*usual: int) -> list[int]:
    """The whole numbers of the command line in their order, the usual ones for those not given."""
    given = [int(word) for word in sys.argv[1:] if word.isdigit()]
    return [*given, *usual[len(given) :]]

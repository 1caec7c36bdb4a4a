"""Speed of the Allan deviation, as a script: `python tests/bench/allan.py [--repeats N]`.

A log of ten hours at 100 Hz, in octaves, against allantools on the same readings and averaging times,
with the largest relative difference of the two; and the whole analysis of one axis, with bounds and fit.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import allantools
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from calib.stages.imu.allan import allan_variance, analyse, octaves

RATE_HZ = 100.0
HOURS = 10.0


def best(work: Callable[[], object], repeats: int) -> float:
    """Least time [s]: others may share the machine."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    y = np.random.default_rng(0).normal(size=round(HOURS * 3600.0 * RATE_HZ))
    m = octaves(len(y))

    def ours() -> np.ndarray:
        return np.sqrt(allan_variance([y], m))

    def theirs() -> np.ndarray:
        return np.asarray(allantools.oadev(y, rate=RATE_HZ, data_type="freq", taus=m / RATE_HZ)[1])

    difference = float(np.abs(ours() / theirs() - 1.0).max())
    mine, other = best(ours, repeats), best(theirs, repeats)
    print(f"{len(y)} samples, {len(m)} averaging times; relative difference {difference:.1e}")
    print(f"calib      {mine:.3f} s")
    print(f"allantools {other:.3f} s, ratio {mine / other:.3f} (wanted: below 0.5)")
    print(f"with degrees of freedom, bounds and fit {best(lambda: analyse([y], 1.0 / RATE_HZ), 1):.3f} s")


if __name__ == "__main__":
    main()

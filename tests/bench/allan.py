"""Speed of the Allan deviation: `python tests/bench/allan.py`.

A log of ten hours at 100 Hz, in octaves, against allantools on the same readings and averaging times,
with the largest relative difference of the two; and the whole analysis of one axis, with bounds and fit.
"""

from __future__ import annotations

import _here  # noqa: F401
import allantools
import numpy as np
from _rows import Row, fastest, print_rows

from calib.stages.imu.allan import allan_variance, analyse, octaves

RATE_HZ = 100.0
HOURS = 10.0


def rows() -> list[Row]:
    """One row."""
    y = np.random.default_rng(0).normal(size=round(HOURS * 3600.0 * RATE_HZ))
    m = octaves(len(y))

    def ours() -> np.ndarray:
        return np.sqrt(allan_variance([y], m))

    def theirs() -> np.ndarray:
        return np.asarray(allantools.oadev(y, rate=RATE_HZ, data_type="freq", taus=m / RATE_HZ)[1])

    difference = float(np.abs(ours() / theirs() - 1.0).max())
    whole = fastest(lambda: analyse([y], 1.0 / RATE_HZ), 1)
    note = f"{len(m)} averaging times differ by {difference:.0e}; with bounds and fit {whole:.2f} s"
    return [Row("Allan deviation of ten hours", "allantools", fastest(ours), fastest(theirs), 2.0, note=note)]


if __name__ == "__main__":
    print_rows(rows())

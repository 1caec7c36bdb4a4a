"""The driven filter: its speed, its errors beside the kinematic one's, and what each ingredient buys.

    python tests/bench/driven.py [FIRST_SEED] [COUNT] [short]

Rigs differ in plant, pumps and sensors by up to 8 %, alignments err within their deviations. Errors are those
of the mean over q1 and q2 in millimetres after two seconds, averaged over seeds. `short` leaves out what the
ingredients buy.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace

import _here
import numpy as np
from _rows import fastest
from drivenlogs import driven_log, errors_of, estimated
from estimatorlogs import SCENARIOS, rows_from, setup_for

from calib.stages.actuator.parameters import pumps_connected
from calib.stages.estimator.driven import Drive, DrivenFilter, smooth_driven
from calib.stages.estimator.kinematic import Setup

FULL = Drive()
KEYS = ("mean_q_mm", "phi_deg", "nees")


def _speed() -> None:
    rig, log = driven_log("ellipse", 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    out = DrivenFilter(setup, FULL).run(rows)
    best = fastest(lambda: DrivenFilter(setup, FULL).run(rows), 4, time.process_time)
    smoothed = fastest(lambda: smooth_driven(setup, FULL, rows, out), 4, time.process_time)
    span = float(log.t_s[-1])
    print(f"driven filter: {best / len(rows) * 1e6:.1f} us per row, {span / best:.0f} times real time")
    print(f"its smoother: {smoothed / len(rows) * 1e6:.1f} us per row")


def _without_rounding(setup: Setup) -> Setup:
    noise = setup.noise.copy()
    noise[0], noise[1] = math.sqrt(noise[0] ** 2 + 1.0 / 12.0), 0.0
    return replace(setup, noise=noise)


def _without_clock(setup: Setup) -> Setup:
    return replace(setup, camera_period_s=math.nan, imu_period_s=math.nan)


KNOWN = replace(FULL, sigma=tuple(1e-4 * value for value in FULL.sigma))
NO_CREEP = replace(FULL, plant=replace(pumps_connected(), creep=None), sigma_creep_N=1e-4)
NO_DISTURBANCE = replace(FULL, sigma_disturbance_N=1e-6, walk_disturbance=1e-7)


def main() -> None:
    """Print the tables."""
    _speed()
    first, count = _here.numbers(201, 5)
    print(f"{'':24s}" + "".join(f"{name:>26s}" for name in SCENARIOS))
    print(f"{'':24s}" + f"{'mm   deg  NEES':>26s}" * len(SCENARIOS))
    table: dict[str, list[list[list[float]]]] = {}
    for name in SCENARIOS:
        for seed in range(first, first + count):
            rig, log = driven_log(name, seed)
            setup, rows = setup_for(rig, seed), rows_from(log)
            outs, _ = estimated(setup, FULL, log)
            outs["driven, smoothed"] = smooth_driven(setup, FULL, rows, outs["driven"])
            if "short" not in sys.argv:
                outs |= {
                    "no rounding likelihood": DrivenFilter(_without_rounding(setup), FULL).run(rows),
                    "no clock": DrivenFilter(_without_clock(setup), FULL).run(rows),
                    "no parameter states": DrivenFilter(setup, KNOWN).run(rows),
                    "no creep": DrivenFilter(setup, NO_CREEP).run(rows),
                    "no disturbance states": DrivenFilter(setup, NO_DISTURBANCE).run(rows),
                }
            for label, out in outs.items():
                columns = table.setdefault(label, [[] for _ in SCENARIOS])
                columns[list(SCENARIOS).index(name)].append([errors_of(setup, out, log)[key] for key in KEYS])
    for label, columns in table.items():
        cells = ["{:.3f} {:.3f} {:5.1f}".format(*np.mean(column, axis=0)) for column in columns]
        print(f"{label:24s}" + "".join(f"{cell:>26s}" for cell in cells))


if __name__ == "__main__":
    main()

"""The driven filter: its speed, its errors beside the kinematic one's, and what each ingredient buys.

    python tests/bench/driven.py [FIRST_SEED] [COUNT] [short]

Rigs differ in plant, pumps and sensors by up to 8 %, alignments err within their deviations. Errors are those
of the mean over q1 and q2 in millimetres after two seconds, averaged over seeds. `short` leaves out what the
ingredients buy.
"""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from drivenlogs import driven_log
from estimatorlogs import SCENARIOS, rows_from, setup_for, truth

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.parameters import pumps_connected
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.driven import Drive, DrivenFilter, Handover, blended, smooth_both, smooth_driven
from calib.stages.estimator.kinematic import Setup

FULL = Drive()


def _error(out: FloatArray, log: Log, setup: Setup) -> tuple[float, float, float]:
    tally = Tally(setup.bellows_radius_m)
    tally.add(out, truth(log))
    found = tally.rmse()
    return found["mean_q_mm"], found["phi_deg"], found["nees"]


def _speed() -> None:
    rig, log = driven_log("ellipse", 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    best, smoothed = math.inf, math.inf
    for _ in range(4):
        driven = DrivenFilter(setup, FULL)
        began = time.process_time()
        out = driven.run(rows)
        best = min(best, time.process_time() - began)
        began = time.process_time()
        smooth_driven(setup, FULL, rows, out)
        smoothed = min(smoothed, time.process_time() - began)
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
    first = int(sys.argv[1]) if len(sys.argv) > 1 else 201
    ablation = "short" not in sys.argv
    seeds = range(first, first + (int(sys.argv[2]) if len(sys.argv) > 2 else 5))
    print(f"{'':24s}" + "".join(f"{name:>26s}" for name in SCENARIOS))
    print(f"{'':24s}" + f"{'mm   deg  NEES':>26s}" * len(SCENARIOS))
    table: dict[str, list[list[tuple[float, float, float]]]] = {}
    for name in SCENARIOS:
        for seed in seeds:
            rig, log = driven_log(name, seed)
            setup, rows = setup_for(rig, seed), rows_from(log)
            driven, kinematic, weight = Handover(setup, FULL).run_each(rows)
            outs = {
                "kinematic": kinematic,
                "driven": driven,
                "with handover": blended(driven, kinematic, weight),
                "driven, smoothed": smooth_driven(setup, FULL, rows, driven),
                "both, smoothed": smooth_both(setup, FULL, rows, driven, kinematic),
            }
            if ablation:
                outs |= {
                    "no rounding likelihood": DrivenFilter(_without_rounding(setup), FULL).run(rows),
                    "no clock": DrivenFilter(_without_clock(setup), FULL).run(rows),
                    "no parameter states": DrivenFilter(setup, KNOWN).run(rows),
                    "no creep": DrivenFilter(setup, NO_CREEP).run(rows),
                    "no disturbance states": DrivenFilter(setup, NO_DISTURBANCE).run(rows),
                }
            for label, out in outs.items():
                columns = table.setdefault(label, [[] for _ in SCENARIOS])
                columns[list(SCENARIOS).index(name)].append(_error(out, log, setup))
    for label, columns in table.items():
        cells = ["{:.3f} {:.3f} {:5.1f}".format(*np.mean(column, axis=0)) for column in columns]
        print(f"{label:24s}" + "".join(f"{cell:>26s}" for cell in cells))


if __name__ == "__main__":
    main()

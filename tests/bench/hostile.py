"""Random hostile logs through both filters and the smoother: no NaN, no rate above 1 m/s, no exception.

    python tests/bench/hostile.py [COUNT] [FIRST_SEED]

Each log is 2 to 3 s of a simulated one with up to four faults: a gap of 10 s, a blackout of either sensor,
5 % outliers, saturation, commands that are missing or wrong, frozen readings. The smoother gets every tenth.
The exit code is 1 when one broke; its seed is printed.
"""

from __future__ import annotations

import sys
import time

import _here
import numpy as np
from drivenlogs import hostile, unsound
from estimatorlogs import SCENARIOS, rows_from, setup_for, simulated

from calib.stages.estimator.driven import Drive, Handover, blended, smooth_both


def main(count: int, first: int) -> int:
    """Print what broke; the exit code."""
    sources = []
    for name in SCENARIOS:
        rig, log = simulated(name, 1)
        sources.append((name, setup_for(rig, 1), rows_from(log)))
    broken, fastest, began = 0, 0.0, time.process_time()
    for seed in range(first, first + count):
        name, setup, rows = sources[seed % len(sources)]
        rows = hostile(seed, rows)
        drive = Drive()
        try:
            driven, kinematic, weight = Handover(setup, drive).run_each(rows)
            out = blended(driven, kinematic, weight)
            parts = {"filter": out, "kinematic": kinematic, "driven": driven}
            if seed % 10 == 0:
                parts["smoother"] = smooth_both(setup, drive, rows, driven, kinematic)
            faults = {what: unsound(part) for what, part in parts.items()}
            fastest = max(fastest, float(np.nanmax(np.abs(out[:, 3:5]))))
        except (ArithmeticError, ValueError, IndexError) as error:
            faults = {"all": repr(error)}
        for what, fault in faults.items():
            if fault:
                broken += 1
                print(f"seed {seed}, {name}, {what}: {fault}", flush=True)
    seconds = time.process_time() - began
    print(f"{count} logs, {broken} faults, fastest {fastest:.2f} m/s, {seconds:.0f} CPU s")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(*_here.numbers(2000, 1)))

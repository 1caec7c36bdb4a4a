"""The fused estimator with constant gains beside the full kinematic filter and the source's pipeline.

    python tests/bench/constant_gain.py [FIRST_SEED] [SEEDS]

On simulated rigs whose plant, pumps, sensors and latency vary, with set-ups that err as a good alignment
does: mean error of both lengths [mm] and root mean square of the angle's [degrees] at the ticks after the
first half second. The gains' process noise was chosen on the seeds 1 to 4; the default are eight others.
`newest` has one sample of the IMU a tick, the newest of 100 Hz, whose age nothing tells; `mean` the mean rate
since the last tick (CALIB_RATE_IS_MEAN).
"""

from __future__ import annotations

import _here
import numpy as np
from drivenlogs import driven_log
from estimatorlogs import SCENARIOS, rows_from, setup_for, truth
from ticks import run_gains, ticks_of

from calib.stages.estimator.baseline import Baseline, BaselineSetup, undistorting_nothing
from calib.stages.estimator.constant_gain import design, tick_noise
from calib.stages.estimator.kinematic import Filter

NAMES = ("source", "full filter", "newest", "mean")


def _scored(name: str, seed: int) -> list[tuple[float, float]]:
    rig, log = driven_log(name, seed)
    setup, rows = setup_for(rig, seed), rows_from(log)
    known = np.flatnonzero(rows.kinds & 1)
    late, true, r = rows.t_s[known] > 0.5, truth(log)[known], setup.bellows_radius_m
    view = rig.view
    place = undistorting_nothing(view.camera, view.R_CW, view.t_CW_m, (-0.06, 0.04, 0.06, 0.11))
    source = Baseline(BaselineSetup(place, r)).run(rows)[known]
    full = Filter(setup).run(rows)[known]
    found = [source[:, (1, 2, 3)], full[:, (1, 2, 5)]]
    sensor = setup.start.sensor
    gains = design(tick_noise(setup), 60.0, float(sensor[7]), 0.5 * 0.065 + float(sensor[6]))
    for mean_rate in (False, True):
        out = run_gains(gains, setup, ticks_of(setup, rows, mean_rate), mean_rate)
        turned = r * out[:, 0]
        found.append(np.stack([out[:, 1] + turned, out[:, 1] - turned, out[:, 0]], axis=1))
    errors = [(each - true)[late] for each in found]
    return [
        (1e3 * float(np.abs(e[:, :2]).mean()), float(np.degrees(np.sqrt(np.mean(e[:, 2] ** 2)))))
        for e in errors
    ]


def main() -> None:
    """Print the table."""
    first, count = _here.numbers(11, 8)
    print("".join(f"{word:>24}" for word in ("mm, degrees", *NAMES)))
    for name in SCENARIOS:
        scores = np.mean([_scored(name, seed) for seed in range(first, first + count)], axis=0)
        print(f"{name:>24}" + "".join(f"{mm:>15.3f} {deg:>8.3f}" for mm, deg in scores), flush=True)


if __name__ == "__main__":
    main()

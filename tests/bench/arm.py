"""What intervals of a bending arm cover, as a script: `python tests/bench/arm.py [--sets N]`.

Sets of four simulated trials with motion capture's noise, each trial with a gain of its own (5 %), as an arm
that is never quite the same, and each set with parameters of its own, drawn from the priors. Each trial is
predicted from its command by a fit to the other three; of its samples those are counted that lie in the 95 %
interval that the errors on the others give. Wanted: 90 to 98 %. `calib identify arm` prints the same share of
real trials.
"""

from __future__ import annotations

import argparse
import math

import _here  # noqa: F401
import numpy as np
from armtrials import SCALE, simulated

from calib.stages.arm.identify import FULL, identify, mean_error
from calib.stages.arm.model import PARAMETERS

TRIALS, SPREAD = 4, 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=6)
    shares, errors = [], []
    for seed in range(parser.parse_args().sets):
        rng = np.random.default_rng(seed)
        z = np.clip(rng.normal(0.0, 0.7, len(PARAMETERS)), -1.5, 1.5)
        values = FULL.without("load").values(z, SCALE)
        gains = 1.0 + SPREAD * rng.normal(size=TRIALS)
        trials = [
            simulated(f"a_{k}", TRIALS * seed + k, gain=gain, values=values)
            for k, gain in enumerate(gains.tolist())
        ]
        found = identify(trials, compare=False)
        shares.append(found.coverage)
        errors.append(math.degrees(mean_error(found.held, "angle_rad")))
        print(
            f"set {seed}: held trials {errors[-1]:.2f} deg RMS, {100.0 * shares[-1]:.1f} % inside", flush=True
        )
    print(f"all: {np.mean(errors):.2f} deg, {100.0 * np.mean(shares):.1f} % inside (wanted: 90 to 98 %)")


if __name__ == "__main__":
    main()

"""The driven estimator where its model is wrong: never much worse than the kinematic one.

    python tests/bench/wrong_models.py [FIRST_SEED] [COUNT]

Rigs as those of `driven.py`, and then: `orifice`, pumps that deflate by another law; `hysteresis`, pumps that
follow their commands with a play of 8 % of the range; `quarter`, plant and pumps up to 25 % off. The error is
the mean over q1 and q2 in millimetres after two seconds, beside it that of phi in degrees and NEES (2
expected), averaged over seeds; `limit` is the kinematic target and a fifth. `share` is that of the rows in
which the driven model spoke.
"""

from __future__ import annotations

from dataclasses import replace

import _here
import numpy as np
from drivenlogs import errors_of, estimated, varied_drive
from estimatorlogs import SCENARIOS, setup_for

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.pump import Orifice
from calib.stages.estimator.driven import Drive
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import at_rest, make_scenario, run_scenario
from calib.twin.simulate import run_log, simulate

LIMIT = {"ellipse": 1.2 * 0.15, "step": 1.2 * 0.20, "elongation": 1.2 * 0.14}
ESTIMATORS = ("kinematic", "driven", "handover", "smoothed")
RANGE_PWM, PLAY = 255.0, 0.08


def played(pwm: FloatArray, width: float) -> FloatArray:
    """Commands (n, 2) behind a play of a width: what follows stays within half of it."""
    out = np.empty_like(pwm)
    held = pwm[0]
    for k, now in enumerate(pwm):
        held = np.clip(held, now - 0.5 * width, now + 0.5 * width)
        out[k] = np.where(now > 0.0, held, 0.0)
    return np.clip(out, 0.0, RANGE_PWM)


def made(kind: str, name: str, seed: int) -> tuple[SimulatedRig, Log]:
    """A rig of a kind and its log."""
    rig = varied_drive(seed, 0.25 if kind == "quarter" else 0.08)
    if kind == "orifice":
        rig = replace(rig, pump=replace(rig.pump, deflation=Orifice()))
    scenario, span = SCENARIOS[name]
    run = run_scenario(make_scenario(scenario), rig, seed, "sensors", span)
    if kind == "hysteresis":
        # The commands as they were, and a rig that follows them late.
        told = run.pwm
        run = simulate(rig, at_rest(rig), played(told, PLAY * RANGE_PWM), len(told), seed)
        run = replace(run, pwm=told)
    return rig, run_log(run)


def main() -> None:
    """Print the table."""
    first, count = _here.numbers(1, 4)
    print(f"{'':24s}" + "".join(f"{name:>23s}" for name in (*ESTIMATORS, "limit share")))
    print(f"{'':24s}" + f"{'mm   deg   NEES':>23s}" * len(ESTIMATORS))
    for kind in ("as known", "orifice", "hysteresis", "quarter"):
        for name, limit in LIMIT.items():
            if kind == "hysteresis" and name == "elongation":
                continue
            found, shares = [], []
            for seed in range(first, first + count):
                rig, log = made(kind, name, seed)
                setup = setup_for(rig, seed)
                outs, weight = estimated(setup, Drive(), log)
                rmse = [errors_of(setup, outs[name], log) for name in ESTIMATORS]
                found.append([[one["mean_q_mm"], one["phi_deg"], one["nees"]] for one in rmse])
                shares.append(float((weight[log.t_s > 2.0] > 0.5).mean()))
            means = np.mean(found, axis=0)
            cells = [f"{mm:.3f} {degrees:.3f} {nees:6.1f}" for mm, degrees, nees in means]
            cells.append(f"{limit:.3f} {np.mean(shares):.2f}")
            missed = "  MISSED" if means[ESTIMATORS.index("handover"), 0] > limit else ""
            print(f"{kind:12s}{name:12s}" + "".join(f"{c:>23s}" for c in cells) + missed, flush=True)


if __name__ == "__main__":
    main()

"""The driven estimator where its model is wrong: never much worse than the kinematic one.

    python tests/bench/wrong_models.py [FIRST_SEED] [COUNT]

Rigs as those of `driven.py`, and then: `orifice`, pumps that deflate by another law; `hysteresis`, pumps that
follow their commands with a play of 8 % of the range; `quarter`, plant and pumps up to 25 % off. The error is
the mean over q1 and q2 in millimetres after two seconds, averaged over seeds; `limit` is the kinematic target
and a fifth. `share` is that of the rows in which the driven model spoke.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from drivenlogs import commands_of, varied_drive
from estimatorlogs import SCENARIOS, rows_from, setup_for, truth

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.pump import Orifice
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.driven import Drive, Handover, blended, smooth_both
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import at_rest, make_scenario, run_scenario
from calib.twin.simulate import log_of, simulate

LIMIT = {"ellipse": 1.2 * 0.15, "step": 1.2 * 0.20, "elongation": 1.2 * 0.14}
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
    return rig, log_of(run)


def main() -> None:
    """Print the table."""
    first = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    print(
        f"{'':24s}{'kinematic':>10s}{'driven':>10s}{'handover':>10s}{'smoothed':>10s}{'limit':>10s}{'share':>8s}"
    )
    for kind in ("as known", "orifice", "hysteresis", "quarter"):
        for name, limit in LIMIT.items():
            if kind == "hysteresis" and name == "elongation":
                continue
            found = []
            for seed in range(first, first + count):
                rig, log = made(kind, name, seed)
                setup, rows, pwm = setup_for(rig, seed), rows_from(log), commands_of(log)
                driven, kinematic, weight = Handover(setup, Drive()).run_each(rows, pwm)
                both = blended(driven, kinematic, weight)
                errors = []
                for out in (
                    kinematic,
                    driven,
                    both,
                    smooth_both(setup, Drive(), rows, pwm, driven, kinematic),
                ):
                    tally = Tally(setup.bellows_radius_m)
                    tally.add(out, truth(log))
                    errors.append(tally.rmse()["mean_q_mm"])
                found.append([*errors, limit, float((weight[log.t_s > 2.0] > 0.5).mean())])
            *cells, share = np.mean(found, axis=0)
            missed = "  MISSED" if cells[2] > limit else ""
            print(
                f"{kind:12s}{name:12s}" + "".join(f"{c:10.3f}" for c in cells) + f"{share:8.2f}{missed}",
                flush=True,
            )


if __name__ == "__main__":
    main()

"""How many claims about the plant hold on rigs that nobody chose.

Every parameter of the nominal plant and its pumps is multiplied by exp(u), u even in +-0.15, which leaves
the rig passive. A claim that holds on the nominal rig and on few of these holds because the rig was chosen
so; one that holds on nearly all of them follows from the model's structure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.core.errors import BadInputError
from calib.stages.actuator.parameters import Creep, Stiffness
from calib.stages.actuator.pump import ElongationForce, RateLimit
from calib.twin.rig import SimulatedRig
from thesis.book import BOOK, Claim, examine
from thesis.runs import use

_SPREAD = 0.15


def varied(seed: int) -> SimulatedRig:
    """A rig about the nominal one; its pumps stretch it as far as the nominal ones would a softer rig."""
    f = np.exp(np.random.default_rng(seed).uniform(-_SPREAD, _SPREAD, 8)).tolist()
    rig = SimulatedRig()
    plant, pump = rig.plant, rig.pump
    assert isinstance(pump.static, ElongationForce)
    k0, k1 = plant.stiffness.coefficients
    plant = replace(
        plant,
        stiffness=Stiffness((k0 * f[0], k1 * f[1])),
        damping_scale=plant.damping_scale * f[2],
        bending_N_per_rad2=plant.bending_N_per_rad2 * f[3],
        creep=Creep(3.0 * f[4], 10.0 * f[5], -1.0),
    )
    pump = replace(pump, lag_s=pump.lag_s * f[6], deflation=RateLimit(0.4 * f[7]))
    return replace(rig, plant=plant, pump=pump, free_damping_scale=rig.free_damping_scale * f[2])


def _of_the_rig(claim: Claim) -> bool:
    return claim.basis in ("twin", "chosen") and claim.id.startswith(("dyn.", "lp.", "pump.", "ctl."))


def report(count: int) -> None:
    """Print on how many of `count` rigs each claim comes out as on the nominal one."""
    claims = [one for one in BOOK if _of_the_rig(one) and one.expect]
    nominal = {one.id: examine(one).outcome for one in claims}
    same, done = dict.fromkeys(nominal, 0), 0
    for seed in range(count):
        use(varied(seed))
        try:
            outcomes = {one.id: examine(one).outcome for one in claims}
        except BadInputError as error:
            print(f"seed {seed} left out: {error}")
            continue
        done += 1
        for name, outcome in outcomes.items():
            same[name] += outcome is nominal[name]
    use(SimulatedRig())
    for one in claims:
        print(
            f"{one.id:22s} {one.basis:8s} {nominal[one.id].value:42s} the same on {same[one.id]:2d} of {done}"
        )

"""The identified model read backwards: forces that hold or move the bellows, and the PWM that gives them.

Without motion the equations of `calib.actuator.dynamics` leave the forces of the pumps as

    P F = N(q, 0),                                                                      (3.43), (3.37)

springs with bending and gravity, for any two lengths. The source's feed-forward (4.6) is a line through
the steady elongation with both motors alike, which holds for stretching without bending only. In
motion

    P F = M(q) ddq + C(q, dq) dq + N(q, dq) - lambda3 z.                                 (3.33), (3.46)

The static force of a pump is turned around on a table of whole and quarter PWM values. It is zero in
the dead zone, so that every force above zero needs a PWM above it, and a falling piece of the printed
polynomials, where there is one, is passed over to the next value that gives more.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.actuator.dynamics import (
    coriolis_matrix,
    force_map,
    linearised,
    mass_matrix,
    resisting_forces,
)
from calib.actuator.parameters import Plant
from calib.actuator.pump import PWM_MAX, Pump, static_force_N
from calib.arrays import FloatArray
from calib.control.pid import PWM_MIN
from calib.errors import BadInputError

__all__ = [
    "Model",
    "creep_along",
    "feed_forward_pwm",
    "force_of_pwm",
    "holding_force",
    "largest_force_N",
    "moving_force",
    "pwm_of_force",
    "static_stiffness",
]

_STEP_PWM = 0.25


@dataclass(frozen=True)
class Model:
    """The identified rig as controllers know it.

    Attributes
    ----------
    plant, pump : as identified.
    strength : factors on the static forces of the two pumps.
    low_pwm, high_pwm : limits of the command [PWM].

    Raises `BadInputError` for limits that the motors do not have or with which no pump gives any force.
    """

    plant: Plant
    pump: Pump
    strength: tuple[float, float] = (1.0, 1.0)
    low_pwm: float = PWM_MIN
    high_pwm: float = PWM_MAX

    def __post_init__(self) -> None:
        whole = float(self.low_pwm).is_integer() and float(self.high_pwm).is_integer()
        if not PWM_MIN <= self.low_pwm < self.high_pwm <= PWM_MAX or not whole:
            raise BadInputError(
                f"PWM limits: found {self.low_pwm:g} to {self.high_pwm:g}, expected "
                f"whole numbers, {PWM_MIN:g} <= low < high <= {PWM_MAX:g}"
            )
        for i, strength in enumerate(self.strength):
            if not strength > 0.0:
                raise BadInputError(
                    f"strength of pump {i + 1}: found {strength:g}, expected a positive factor"
                )
        if float(np.max(static_force_N(self.pump, np.array([self.high_pwm])))) <= 0.0:
            raise BadInputError(
                f"PWM limits: at {self.high_pwm:g} the pumps give no force yet, expected a limit above "
                "their dead zone"
            )

    @property
    def tick_s(self) -> float:
        """Period of the commands."""
        return self.pump.tick_s


@lru_cache(maxsize=32)
def _table(pump: Pump, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Rising forces [N] and the PWM values that give them, the first at zero force."""
    pwm = np.unique(np.append(np.arange(low, high, _STEP_PWM), high))
    force = np.maximum.accumulate(static_force_N(pump, pwm))
    rising = np.concatenate([np.diff(force) > 0.0, [False]])
    # The last value of the dead zone, then every value that gives more than all before it.
    keep = np.concatenate([[False], np.diff(force) > 0.0]) | (rising & (force == force[0]))
    if not keep.any():
        keep[-1] = True
    return force[keep], pwm[keep]


def force_of_pwm(model: Model, pwm: FloatArray) -> FloatArray:
    """Force (..., 2) [N] that PWM values (..., 2) settle at, within the limits of the command."""
    limited = np.clip(np.asarray(pwm, dtype=np.float64), model.low_pwm, model.high_pwm)
    return np.asarray(static_force_N(model.pump, limited) * np.array(model.strength))


def largest_force_N(model: Model) -> FloatArray:
    """Greatest steady force (2,) [N] of the pumps."""
    force, _ = _table(model.pump, model.low_pwm, model.high_pwm)
    return np.asarray(force[-1] * np.array(model.strength))


def pwm_of_force(model: Model, force_N: FloatArray) -> FloatArray:
    """PWM values (..., 2) whose steady forces are the nearest to these (..., 2) [N].

    `low_pwm` for no force at all; for one that the pumps do not reach, the value that gives most.
    """
    force, pwm = _table(model.pump, model.low_pwm, model.high_pwm)
    wanted = np.asarray(force_N, dtype=np.float64) / np.array(model.strength)
    found = np.interp(wanted, force, pwm)
    return np.asarray(np.where(wanted <= force[0], model.low_pwm, found))


def _forces(plant: Plant, q: FloatArray, generalised: FloatArray) -> FloatArray:
    if plant.force_projection == "virtual_work":
        return generalised
    return np.asarray(np.linalg.solve(force_map(plant, q), generalised[..., None])[..., 0])


def holding_force(plant: Plant, q_m: FloatArray) -> FloatArray:
    """Forces (..., 2) [N] that hold the bellows at the lengths (..., 2) [m] after all creep."""
    q = np.asarray(q_m, dtype=np.float64)
    return _forces(plant, q, resisting_forces(plant, q, np.zeros_like(q)))


def moving_force(
    plant: Plant, q_m: FloatArray, dq_mps: FloatArray, ddq_mps2: FloatArray, z_N: FloatArray
) -> FloatArray:
    """Forces (..., 2) [N] that move the bellows so, with creep forces z (..., 2) [N]; all (..., 2)."""
    q, dq = np.asarray(q_m, dtype=np.float64), np.asarray(dq_mps, dtype=np.float64)
    inertia = np.einsum("...rc,...c->...r", mass_matrix(plant, q), np.asarray(ddq_mps2))
    swept = np.einsum("...rc,...c->...r", coriolis_matrix(plant, q, dq), dq)
    crept = plant.creep_rates[2] * np.asarray(z_N)
    return _forces(plant, q, np.asarray(inertia + swept + resisting_forces(plant, q, dq) - crept))


def creep_along(plant: Plant, tick_s: float, dq_mps: FloatArray) -> FloatArray:
    """Creep forces z (n, 2) [N] along rates (n, 2) [m/s] at evenly spaced times, from zero (3.45).

    Exact for rates that are straight lines between the times.
    """
    l1, l2, _ = plant.creep_rates
    dq = np.asarray(dq_mps, dtype=np.float64)
    z = np.zeros_like(dq)
    if l2 == 0.0:
        return z
    w = l1 * tick_s
    decay = np.exp(-w)
    if w > 1e-6:
        whole = (1.0 - decay) / l1
        late = (1.0 - whole / tick_s) / l1
    else:
        whole, late = tick_s, 0.5 * tick_s
    for k in range(1, len(dq)):
        z[k] = decay * z[k - 1] + l2 * ((whole - late) * dq[k - 1] + late * dq[k])
    return z


def static_stiffness(plant: Plant, q_m: FloatArray) -> FloatArray:
    """dF/dq (2, 2) [N/m] of `holding_force` at the lengths (2,), forces by virtual work."""
    A = linearised(plant, q_m)
    return np.asarray(-mass_matrix(plant, q_m) @ A[2:4, :2])


def feed_forward_pwm(model: Model, q_ref_m: FloatArray) -> FloatArray:
    """PWM (..., 2) that holds the lengths (..., 2) [m], in both bellows and with bending."""
    return pwm_of_force(model, holding_force(model.plant, q_ref_m))

"""The parameters that an identification can estimate, and how a vector of them becomes a rig.

Names and units are those of the rig's file. All are positive: the creep's lambda1 and lambda2 by their
bounds, so that with lambda3 < 0 every candidate is passive (3.45). lambda2 and lambda3 enter the motion
only by their product; lambda3 is among the parameters so that this is found and said, and is then fixed.

The static force of the pumps is either scaled for each bellows (`strength1`, `strength2`), or its map is
estimated: the steady elongations at 6, 8, 10 and 12 V, which are the cubic of (2.13), with the strength of
the second pump against the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.actuator.parameters import DAMPING_SCALE_FREE, DAMPING_SCALE_PUMPS, Creep, Plant
from calib.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = [
    "KNOTS_V",
    "PARAMETERS",
    "Nominal",
    "Spec",
    "StrengthForce",
    "candidates",
    "elongation_polynomial",
    "made",
    "values_of",
]

KNOTS_V = (6.0, 8.0, 10.0, 12.0)
"""Voltages at which the static map is estimated (Fig. 2.11)."""


@dataclass(frozen=True)
class Spec:
    """One parameter: unit, bounds, the size of a typical change, and what it acts on.

    `acts` is "all", "free" (swings with the hoses off) or "pumps"; `symbol` is the source's.
    """

    unit: str
    low: float
    high: float
    scale: float
    acts: str
    symbol: str


PARAMETERS: dict[str, Spec] = {
    "stiffness_scale": Spec("", 0.05, 20.0, 0.2, "all", "c_spr"),
    "damping_scale_free_swing": Spec("", 0.01, 200.0, 1.0, "free", "c_dmp"),
    "damping_scale_pumps_connected": Spec("", 0.01, 500.0, 5.0, "pumps", "c_dmp"),
    "bending_N_per_rad2": Spec("N/rad^2", 0.0, 10.0, 0.05, "all", "k_bnd"),
    "lambda1_per_s": Spec("1/s", 0.02, 60.0, 1.0, "all", "lambda1"),
    "lambda2_N_per_m": Spec("N/m", 0.01, 500.0, 3.0, "all", "lambda2"),
    "lambda3": Spec("", -50.0, -0.01, 0.3, "all", "lambda3"),
    "lag_s": Spec("s", 0.01, 10.0, 0.2, "pumps", "tau"),
    "strength1": Spec("", 0.05, 10.0, 0.2, "pumps", "strength1"),
    "strength2": Spec("", 0.05, 10.0, 0.2, "pumps", "strength2"),
    "falling_N_per_s": Spec("N/s", 0.01, 50.0, 0.1, "pumps", "R"),
    "laminar_s": Spec("s", 0.01, 50.0, 0.3, "pumps", "a"),
    "turbulent_s2_per_N": Spec("s^2/N", 0.0, 200.0, 0.3, "pumps", "b"),
    "elongation_6V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(6 V)"),
    "elongation_8V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(8 V)"),
    "elongation_10V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(10 V)"),
    "elongation_12V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(12 V)"),
}
"""All parameters in the order of tables."""

_ELONGATIONS = tuple(f"elongation_{volt:g}V_mm" for volt in KNOTS_V)


@dataclass(frozen=True)
class StrengthForce(ElongationForce):
    """The static force with a factor for each of two pumps."""

    strength: tuple[float, float] = (1.0, 1.0)

    def force_N(self, pwm: FloatArray) -> FloatArray:
        """Steady forces (..., 2) [N] of PWM values (..., 2)."""
        return np.asarray(super().force_N(pwm) * np.array(self.strength))


@dataclass(frozen=True)
class Nominal:
    """The rig as it is known before: what is not estimated, and where searches start.

    `plant` has the damping of connected pumps; `free_damping_scale` is c_dmp with the hoses off.
    """

    plant: Plant = field(default_factory=lambda: replace(Plant(), damping_scale=DAMPING_SCALE_PUMPS))
    free_damping_scale: float = DAMPING_SCALE_FREE
    pump: Pump = field(default_factory=Pump)
    strength: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        if not isinstance(self.pump.static, ElongationForce):
            raise BadInputError("pump: found a polynomial of the force, expected elongation_mm")
        if not self.plant.creep_rates[2] < 0.0 < self.plant.creep_rates[0]:
            raise BadInputError(
                "actuator: found creep that is not passive to start from, expected lambda1 > 0 > lambda3"
            )


def elongation_polynomial(elongation_mm: Sequence[float]) -> tuple[float, float, float, float]:
    """Coefficients of u^3 .. 1 through the steady elongations [mm] at `KNOTS_V`."""
    a, b, c, d = np.polyfit(KNOTS_V, np.asarray(elongation_mm, dtype=np.float64), 3).tolist()
    return a, b, c, d


def values_of(nominal: Nominal) -> dict[str, float]:
    """All parameters of a rig by name."""
    plant, pump = nominal.plant, nominal.pump
    l1, l2, l3 = plant.creep_rates
    law = pump.deflation
    orifice = law if isinstance(law, Orifice) else Orifice()
    falling = law.falling_N_per_s if isinstance(law, RateLimit) else 0.4
    assert isinstance(pump.static, ElongationForce)
    knots = np.polyval(pump.static.elongation_mm, KNOTS_V).tolist()
    return {
        "stiffness_scale": plant.stiffness_scale,
        "damping_scale_free_swing": nominal.free_damping_scale,
        "damping_scale_pumps_connected": plant.damping_scale,
        "bending_N_per_rad2": plant.bending_N_per_rad2,
        "lambda1_per_s": l1,
        "lambda2_N_per_m": l2,
        "lambda3": l3,
        "lag_s": pump.lag_s,
        "strength1": nominal.strength[0],
        "strength2": nominal.strength[1],
        "falling_N_per_s": falling,
        "laminar_s": orifice.laminar_s,
        "turbulent_s2_per_N": orifice.turbulent_s2_per_N,
        **dict(zip(_ELONGATIONS, knots, strict=True)),
    }


def candidates(nominal: Nominal, free: bool, pumps: bool, static_map: bool) -> tuple[str, ...]:
    """Parameters that logs of these kinds can tell at all, lambda3 with them.

    Parameters
    ----------
    free, pumps : whether there are swings with the hoses off, and logs with commands.
    static_map : estimate the elongations at `KNOTS_V` instead of the strength of the first pump.
    """
    wanted = {"all"} | ({"free"} if free else set()) | ({"pumps"} if pumps else set())
    names = [name for name, spec in PARAMETERS.items() if spec.acts in wanted]
    orifice = isinstance(nominal.pump.deflation, Orifice)
    left_out = {"falling_N_per_s"} if orifice else {"laminar_s", "turbulent_s2_per_N"}
    left_out |= {"strength1"} if static_map else set(_ELONGATIONS)
    return tuple(name for name in names if name not in left_out)


def made(nominal: Nominal, values: Mapping[str, float], hoses: bool, tick_s: float) -> tuple[Plant, Pump]:
    """Plant and pump with some parameters changed.

    Parameters
    ----------
    values : by name of `PARAMETERS`; the others keep their nominal value.
    hoses : whether the pumps are connected, which decides on the damping.
    """
    v = {**values_of(nominal), **values}
    plant = nominal.plant
    plant = replace(
        plant,
        stiffness_scale=v["stiffness_scale"],
        damping_scale=v["damping_scale_pumps_connected" if hoses else "damping_scale_free_swing"],
        bending_N_per_rad2=v["bending_N_per_rad2"],
        creep=Creep(v["lambda1_per_s"], v["lambda2_N_per_m"], v["lambda3"]),
    )
    static = nominal.pump.static
    assert isinstance(static, ElongationForce)
    law = nominal.pump.deflation
    curve = static.elongation_mm
    if any(name in values for name in _ELONGATIONS):
        curve = elongation_polynomial([v[name] for name in _ELONGATIONS])
    deflation = (
        RateLimit(v["falling_N_per_s"])
        if isinstance(law, RateLimit)
        else Orifice(v["laminar_s"], v["turbulent_s2_per_N"])
    )
    force = StrengthForce(
        curve, static.stiffness, static.supply_V, static.dead_zone_V, (v["strength1"], v["strength2"])
    )
    return plant, replace(nominal.pump, static=force, deflation=deflation, lag_s=v["lag_s"], tick_s=tick_s)

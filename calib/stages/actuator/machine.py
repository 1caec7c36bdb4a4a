"""The actuator with its pumps, as the sections of rig.yaml describe it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from calib.stages.actuator.parameters import DAMPING_SCALE_FREE, Plant, pumps_connected
from calib.stages.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.stages.actuator.section import plant_from


@dataclass(frozen=True)
class Machine:
    """The actuator with its pumps.

    Attributes
    ----------
    plant : with the pumps connected.
    free_damping_scale : c_dmp with the hoses off, for a free swing.
    pump, strength : both pumps, and factors on their static forces.
    """

    plant: Plant = field(default_factory=pumps_connected)
    free_damping_scale: float = DAMPING_SCALE_FREE
    pump: Pump = field(default_factory=Pump)
    strength: tuple[float, float] = (1.0, 1.0)

    @property
    def free_plant(self) -> Plant:
        """The plant with the hoses off."""
        return replace(self.plant, damping_scale=self.free_damping_scale)


def machine_from(actuator: Mapping[str, Any], pump: Mapping[str, Any]) -> Machine:
    """The machine of values by the keys of `ActuatorParameters` and `PumpParameters`; others are nominal.

    Raises `BadInputError` for values that no plant can have together.
    """
    plant = plant_from(actuator)
    strength = tuple(pump.get("strength", (1.0, 1.0)))
    return Machine(
        plant,
        actuator.get("damping_scale_free_swing", DAMPING_SCALE_FREE),
        _pump(pump, plant),
        (strength[0], strength[1]),
    )


def _pump(values: Mapping[str, Any], plant: Plant) -> Pump:
    def given(*keys: str) -> dict[str, Any]:
        return {key: values[key] for key in keys if key in values}

    static = given("supply_V", "dead_zone_V")
    if "elongation_mm" in values:
        # Measured on this rig, so its forces follow from this rig's springs.
        static |= {"elongation_mm": tuple(values["elongation_mm"]), "stiffness": plant.stiffness}
    orifice = values.get("deflation") == "orifice"
    deflation = (
        Orifice(**given("laminar_s", "turbulent_s2_per_N"))
        if orifice
        else RateLimit(**given("falling_N_per_s"))
    )
    return Pump(
        ElongationForce(**static),
        deflation,
        **given("lag_s", "lag_ratio", "delay_ticks", "tick_s", "play_pwm", "play_N"),
    )

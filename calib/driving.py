"""The driven model of a rig: plant and pumps from the sections `actuator` and `pump` of rig.yaml."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.actuator.parameters import Creep, Plant, Stiffness, pumps_connected
from calib.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.estimator.driven_model import PARAMETER
from calib.estimator.driven_setup import Drive
from calib.files import shown
from calib.logs import Log
from calib.rig import Rig
from calib.rig_actuator import Actuator, PumpSection, section_of

__all__ = ["drive_from_rig", "has_commands", "pwm_of"]

_LEAST_SHARE, _APART = 0.01, 0.003
"""Identified values are not taken to be nearer the truth than the first, nor what they tell together than
the second: an identification keeps mass and rest length as they are, and its model is not the actuator."""


def has_commands(log: Log) -> bool:
    """Whether a block says what the pumps were told."""
    return any(np.isfinite(pair).all() for pair in pwm_of(log))


def pwm_of(log: Log) -> FloatArray:
    """Commands (n, 2) of a block, NaN in rows without."""
    missing = np.full(len(log), np.nan)
    return np.stack([log.columns.get(name, missing) for name in ("pwm1", "pwm2")], axis=1)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def _plant(section: Actuator) -> Plant:
    nominal = pumps_connected()
    names = ("k0_N_per_m", "k1_N_per_m2", "k2_N_per_m3", "k3_N_per_m4")
    law = tuple(_or(getattr(section, n), k) for n, k in zip(names, nominal.stiffness.padded, strict=True))
    creep, gravity = Creep(), section.gravity_mps2 or nominal.gravity_mps2
    return Plant(
        mass_kg=_or(section.mass_kg, nominal.mass_kg),
        inertia_kgm2=_or(section.inertia_kgm2, nominal.inertia_kgm2),
        bellows_radius_m=_or(section.bellows_radius_m, nominal.bellows_radius_m),
        rest_length_m=_or(section.rest_length_m, nominal.rest_length_m),
        stiffness=Stiffness(law),
        stiffness_scale=_or(section.stiffness_scale, nominal.stiffness_scale),
        damping_ratio=_or(section.damping_ratio, nominal.damping_ratio),
        damping_scale=_or(section.damping_scale_pumps_connected, nominal.damping_scale),
        bending_N_per_rad2=_or(section.bending_N_per_rad2, nominal.bending_N_per_rad2),
        creep=Creep(
            _or(section.lambda1_per_s, creep.lambda1_per_s),
            _or(section.lambda2_N_per_m, creep.lambda2_N_per_m),
            _or(section.lambda3, creep.lambda3),
        ),
        gravity_mps2=(gravity[0], gravity[1]),
        force_projection=section.force_projection or nominal.force_projection,
    )


def _pump(section: PumpSection, plant: Plant) -> Pump:
    nominal, static = Pump(), ElongationForce()
    static = replace(
        static,
        supply_V=_or(section.supply_V, static.supply_V),
        dead_zone_V=_or(section.dead_zone_V, static.dead_zone_V),
    )
    if section.elongation_mm is not None:
        # Measured on this rig, so its forces follow from this rig's springs.
        a, b, c, d = section.elongation_mm
        static = replace(static, elongation_mm=(a, b, c, d), stiffness=plant.stiffness)
    limit, orifice = RateLimit(), Orifice()
    deflation: RateLimit | Orifice = RateLimit(_or(section.falling_N_per_s, limit.falling_N_per_s))
    if section.deflation == "orifice":
        deflation = Orifice(
            _or(section.laminar_s, orifice.laminar_s),
            _or(section.turbulent_s2_per_N, orifice.turbulent_s2_per_N),
        )
    return Pump(
        static,
        deflation,
        _or(section.lag_s, nominal.lag_s),
        int(_or(section.delay_ticks, nominal.delay_ticks)),
        _or(section.tick_s, nominal.tick_s),
    )


_SIGMA = {
    "stiffness": ("actuator", "stiffness_scale"),
    "log_damping": ("actuator", "damping_scale_pumps_connected"),
    "bending": ("actuator", "bending_N_per_rad2"),
    "strength1": ("pump", "strength"),
    "strength2": ("pump", "strength"),
    "lag": ("pump", "lag_s"),
    "deflation": ("pump", "falling_N_per_s"),
    "rest_length_m": ("actuator", "rest_length_m"),
    "mass": ("actuator", "mass_kg"),
    "creep_stiffness": ("actuator", "lambda2_N_per_m"),
    "creep_rate": ("actuator", "lambda1_per_s"),
}
"""Whose standard deviation, as a share of the value, a parameter has."""


def _deviation(section: Actuator | PumpSection, key: str, at: int, relative: bool) -> float | None:
    sigma, value = section.sigma.get(key), getattr(section, key)
    if isinstance(sigma, list):
        sigma, value = sigma[at], value[at] if isinstance(value, list) else value
    if sigma is None or value is None or not math.isfinite(sigma):
        return None
    if not relative:
        return float(sigma)
    return max(float(sigma) / abs(float(value)), _LEAST_SHARE) if value else None


def _covariance(actuator: Actuator, pump: PumpSection, sigma: dict[str, float]) -> FloatArray | None:
    """Covariance (11, 11) of the parameters: their deviations with the correlations of the identification.

    What was estimated apart since then, so that the deviation in the file is another one, is independent.
    """
    table, out = actuator.covariance, np.diag(np.array(list(sigma.values())) ** 2)
    if table is None:
        return None
    rows, names = [], []
    for name, (section, key) in _SIGMA.items():
        row = name if key == "strength" else key
        known = actuator if section == "actuator" else pump
        told = _deviation(known, key, int(name == "strength2"), relative=False)
        if not told or row not in table.order:
            continue
        at = table.order.index(row)
        if math.isclose(told * told, table.values[at][at], rel_tol=2e-3):
            rows.append(at)
            names.append(name)
    spread = np.sqrt([table.values[k][k] for k in rows])
    places = [PARAMETER.index(name) for name in names]
    together = np.array(table.values)[np.ix_(rows, rows)]
    correlation = 0.5 * (together + together.T) / np.outer(spread, spread)
    deviation = np.array([sigma[name] for name in names])
    out[np.ix_(places, places)] = correlation * np.outer(deviation, deviation)
    out[places, places] += _APART**2
    return np.asarray(out)


def drive_from_rig(rig: Rig, path: Path) -> Drive:
    """Plant and pumps with their deviations; what the file lacks is nominal.

    Raises `BadInputError` naming file and key for values that no plant has.
    """
    actuator = section_of(rig, "actuator", Actuator, path)
    pump = section_of(rig, "pump", PumpSection, path)
    try:
        plant = _plant(actuator)
        made = _pump(pump, plant)
    except BadInputError as error:
        raise BadInputError(f"{shown(path)}: actuator and pump: {error}") from error
    nominal = Drive()
    sigma = dict(zip(PARAMETER, nominal.sigma, strict=True))
    for name, (section, key) in _SIGMA.items():
        known = actuator if section == "actuator" else pump
        found = _deviation(known, key, int(name == "strength2"), name != "rest_length_m")
        if found is not None:
            # What was hardly identified differs from other rigs as they do from each other.
            sigma[name] = found if actuator.covariance is None else min(found, sigma[name])
    if actuator.covariance is not None and "mass_kg" not in actuator.sigma:
        # Forces, springs and mass have one scale, which the identification takes from the mass.
        sigma["mass"] = _LEAST_SHARE
    covariance = _covariance(actuator, pump, sigma)
    if covariance is not None:
        deviation = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(deviation, deviation)
        if not (np.abs(correlation).max() < 1.01 and np.linalg.eigvalsh(correlation)[0] > 0.0):
            raise BadInputError(
                f"{shown(path)}: actuator.covariance has correlations that no quantities have, expected a "
                "positive definite matrix"
            )
        sigma = dict(zip(PARAMETER, deviation.tolist(), strict=True))
    strength = pump.strength or list(nominal.strength)
    tuned = rig.estimator.driven if rig.estimator is not None else None
    if tuned is not None:
        nominal = replace(
            nominal,
            walk_disturbance=tuned.walk_disturbance_N_per_sqrt_s,
            walk_rates=(tuned.walk_turning_radps_per_sqrt_s, tuned.walk_growing_mps_per_sqrt_s),
            walk_forces=tuned.walk_forces_N_per_sqrt_s,
        )
    return replace(
        nominal,
        plant=plant,
        pump=made,
        strength=(strength[0], strength[1]),
        free_damping_scale=_or(actuator.damping_scale_free_swing, nominal.free_damping_scale),
        sigma=tuple(sigma.values()),
        covariance=covariance,
    )

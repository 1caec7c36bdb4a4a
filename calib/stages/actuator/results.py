"""The sections `actuator` and `pump` of rig.yaml: a rig to start an identification from, and its results."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.result import CovarianceTable, finite_or_none, section_json
from calib.core.rig import Rig
from calib.stages.actuator.identify import (
    PARAMETERS,
    Colour,
    Decrement,
    HeldLog,
    Judgement,
    Nominal,
    Prospect,
    Solution,
    StiffnessFit,
    Uncertainty,
    elongation_polynomial,
)
from calib.stages.actuator.parameters import DAMPING_SCALE_FREE, DAMPING_SCALE_PUMPS, Creep, Plant, Stiffness
from calib.stages.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.stages.actuator.section import Actuator, PumpSection, section_of

_LAW = ("k0_N_per_m", "k1_N_per_m2", "k2_N_per_m3", "k3_N_per_m4")


@dataclass(frozen=True)
class Identified:
    """Everything that `calib identify` has found of some logs."""

    solution: Solution
    uncertainty: Uncertainty
    colours: tuple[Colour, ...]
    rms: tuple[tuple[float, float], ...]
    held: tuple[HeldLog, ...]
    prospects: tuple[Prospect, ...]
    decrements: Mapping[str, tuple[Decrement, float | None]]
    sources: Mapping[str, str]
    judgement: Judgement


def nominal_of(rig: Rig, path: Path) -> Nominal:
    """The rig as its file knows it, nominal where the file says nothing.

    Creep that is not passive, as the source's own, cannot be searched from; the nominal one is taken.

    Raises `BadInputError` for keys that are not known and values that no rig has.
    """
    a = section_of(rig, "actuator", Actuator, path)
    p = section_of(rig, "pump", PumpSection, path)
    plant = Plant()

    def pick(value: float | None, default: float) -> float:
        return default if value is None else float(value)

    law = [pick(getattr(a, key), k) for key, k in zip(_LAW, plant.stiffness.padded, strict=True)]
    creep = Creep()
    rates = [
        pick(v, c) for v, c in zip((a.lambda1_per_s, a.lambda2_N_per_m, a.lambda3), creep.rates, strict=True)
    ]
    if rates[0] > 0.0 and rates[1] > 0.0 > rates[2]:
        creep = Creep(*rates)
    try:
        plant = replace(
            plant,
            mass_kg=pick(a.mass_kg, plant.mass_kg),
            inertia_kgm2=pick(a.inertia_kgm2, plant.inertia_kgm2),
            bellows_radius_m=pick(a.bellows_radius_m, plant.bellows_radius_m),
            rest_length_m=pick(a.rest_length_m, plant.rest_length_m),
            stiffness=Stiffness(tuple(law)) if any(getattr(a, key) for key in _LAW) else plant.stiffness,
            stiffness_scale=pick(a.stiffness_scale, 1.0),
            damping_ratio=pick(a.damping_ratio, plant.damping_ratio),
            damping_scale=pick(a.damping_scale_pumps_connected, DAMPING_SCALE_PUMPS),
            bending_N_per_rad2=pick(a.bending_N_per_rad2, plant.bending_N_per_rad2),
            creep=creep,
            gravity_mps2=plant.gravity_mps2
            if a.gravity_mps2 is None
            else (a.gravity_mps2[0], a.gravity_mps2[1]),
            force_projection=a.force_projection or plant.force_projection,
        )
        static = ElongationForce()
        if p.elongation_mm is not None:
            e = p.elongation_mm
            static = replace(static, elongation_mm=(e[0], e[1], e[2], e[3]), stiffness=plant.stiffness)
        static = replace(
            static,
            supply_V=pick(p.supply_V, static.supply_V),
            dead_zone_V=pick(p.dead_zone_V, static.dead_zone_V),
        )
        deflation: RateLimit | Orifice = RateLimit(pick(p.falling_N_per_s, RateLimit().falling_N_per_s))
        if p.deflation == "orifice":
            law_of_air = Orifice()
            deflation = Orifice(
                pick(p.laminar_s, law_of_air.laminar_s),
                pick(p.turbulent_s2_per_N, law_of_air.turbulent_s2_per_N),
            )
        pump = Pump()
        pump = Pump(
            static,
            deflation,
            pick(p.lag_s, pump.lag_s),
            int(pick(p.delay_ticks, pump.delay_ticks)),
            pick(p.tick_s, pump.tick_s),
        )
    except BadInputError as error:
        raise BadInputError(f"{shown(path)}: {error}") from error
    strength = (1.0, 1.0) if p.strength is None else (p.strength[0], p.strength[1])
    return Nominal(plant, pick(a.damping_scale_free_swing, DAMPING_SCALE_FREE), pump, strength)


def _delay(found: Identified) -> tuple[float, float] | None:
    """Dead time of the pumps [s] beyond that of the rig's file, and its deviation; None without pumps."""
    problem = found.solution.problem
    layout = problem.layout
    shared = [layout.delays[k] for k, track in enumerate(problem.tracks) if track.hoses]
    if not shared:
        return None
    at = layout.delay + shared[0]
    J = found.solution.J
    H = J.T @ J / found.uncertainty.scale**2
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    V = np.linalg.pinv(H / np.outer(size, size), rcond=1e-13) / np.outer(size, size)
    return float(found.solution.x[at]) - problem.delay_s, float(math.sqrt(max(V[at, at], 0.0)))


def _sigma_of(known: Uncertainty, names: list[str]) -> dict[str, Any]:
    return {name: finite_or_none(known.sigma[name]) for name in names if name in known.sigma}


def sections_from(found: Identified, rig: Rig, path: Path) -> dict[str, Actuator | PumpSection]:
    """The sections of an identification on top of what the file already says.

    `pump` is there only when a log has commands.
    """
    values, known = found.solution.values, found.uncertainty
    judged: dict[str, Any] = {
        "verdict": found.judgement.verdict,
        "reasons": list(found.judgement.reasons),
        "remarks": list(found.judgement.remarks),
        "advice": list(found.judgement.advice),
    }
    names = list(found.solution.problem.names)
    table = CovarianceTable(order=names, values=known.covariance.tolist())
    before = section_of(rig, "actuator", Actuator, path)
    mine = [name for name in names if name in Actuator.model_fields]
    update: dict[str, Any] = {name: values[name] for name in mine}
    creep = found.solution.problem.nominal.plant.creep_rates
    if {"lambda1_per_s", "lambda2_N_per_m"} & set(names):
        # The creep makes sense only whole.
        update = dict(zip(("lambda1_per_s", "lambda2_N_per_m", "lambda3"), creep, strict=True)) | update
    update |= judged | {"sigma": {**before.sigma, **_sigma_of(known, mine)}, "covariance": table}
    out: dict[str, Actuator | PumpSection] = {"actuator": before.model_copy(update=update)}
    if any(track.hoses for track in found.solution.problem.tracks):
        out["pump"] = _pump(found, section_of(rig, "pump", PumpSection, path), judged)
    return out


def _pump(found: Identified, before: PumpSection, judged: dict[str, Any]) -> PumpSection:
    values, known = found.solution.values, found.uncertainty
    nominal = found.solution.problem.nominal
    mine = [n for n in found.solution.problem.names if n in PumpSection.model_fields]
    update: dict[str, Any] = {name: values[name] for name in mine}
    sigma: dict[str, Any] = {**before.sigma, **_sigma_of(known, mine)}
    strengths = [n for n in ("strength1", "strength2") if n in values]
    if strengths:
        pair = [values.get("strength1", nominal.strength[0]), values.get("strength2", nominal.strength[1])]
        update["strength"] = pair
        sigma["strength"] = [finite_or_none(known.sigma.get(n, 0.0)) for n in ("strength1", "strength2")]
    knots = [n for n in PARAMETERS if n.startswith("elongation_")]
    if any(n in values for n in knots):
        from calib.stages.actuator.identify import values_of

        whole = {**values_of(nominal), **values}
        update["elongation_mm"] = list(elongation_polynomial([whole[n] for n in knots]))
        sigma |= _sigma_of(known, [n for n in knots if n in values])
    if isinstance(nominal.pump.deflation, Orifice):
        update["deflation"] = "orifice"
    delay = _delay(found)
    remarks = []
    if delay is not None:
        tick_s = nominal.pump.tick_s
        ticks = nominal.pump.delay_ticks + round(delay[0] / tick_s)
        if ticks >= 0:
            update["delay_ticks"] = float(ticks)
            sigma["delay_ticks"] = delay[1] / tick_s
            late = found.solution.problem.delay_s
            remarks.append(
                f"dead time {1e3 * (nominal.pump.delay_ticks * tick_s + delay[0]):.3g} +- "
                f"{1e3 * delay[1]:.2g} ms if pictures are {1e3 * late:.3g} ms late: "
                "logs of the camera tell their sum alone"
            )
    return before.model_copy(update=update | judged | {"remarks": remarks, "advice": [], "sigma": sigma})


def stiffness_section(fit: StiffnessFit, per_actuator: bool, rig: Rig, path: Path) -> Actuator:
    """The section with the springs of one bellows from a law of the table.

    Raises `BadInputError` for a law that is not positive over the elongations in use.
    """
    share = 0.5 if per_actuator else 1.0
    k = (share * fit.coefficients).tolist()
    Stiffness(tuple(k))
    before = section_of(rig, "actuator", Actuator, path)
    padded = k + [0.0] * (len(_LAW) - len(k))
    sigma = {key: share * float(s) for key, s in zip(_LAW, fit.sigma.tolist(), strict=False)}
    kept = {key: value for key, value in before.sigma.items() if key not in _LAW}
    update: dict[str, Any] = dict(zip(_LAW, padded, strict=True))
    return before.model_copy(update=update | {"sigma": {**kept, **sigma}})


def with_sections(rig: Rig, sections: Mapping[str, BaseModel]) -> Rig:
    """A rig with sections as plain values, as those who simulate read them."""
    return rig.model_copy(update={name: plain_section(section) for name, section in sections.items()})


def plain_section(section: BaseModel) -> dict[str, Any]:
    """A section as it stands in the file: no key that was never set, whole ticks as a whole number."""
    whole = {k: v for k, v in section_json(section).items() if not (k == "reasons" and v == [])}
    # Values first, what is said of them after.
    last = ("sigma", "covariance", "identified", "verdict", "reasons", "remarks", "advice")
    out = {k: v for k, v in whole.items() if k not in last} | {k: whole[k] for k in last if k in whole}
    if "delay_ticks" in out:
        out["delay_ticks"] = int(out["delay_ticks"])
    return out


def identified_json(found: Identified) -> dict[str, Any]:
    """What the document says beyond the sections."""
    s, u = found.solution, found.uncertainty
    return {
        "parameters": {
            name: {
                "value": value,
                "sigma": u.sigma[name],
                "unit": PARAMETERS[name].unit,
                "symbol": PARAMETERS[name].symbol,
                "inflation": u.inflation[name],
            }
            for name, value in s.values.items()
        },
        "correlation": {"order": list(s.problem.names), "values": u.correlation.tolist()},
        "fixed": dict(s.fixed),
        "starts": {"refined": s.starts, "agreeing": s.agreeing},
        "residual_scale": u.scale,
        "logs": [
            {
                "name": track.name,
                "poses": len(track.t_s),
                "source": found.sources.get(track.name, ""),
                "hoses": track.hoses,
                "phi_rms_rad": rms[0],
                "length_rms_m": rms[1],
                "white": colour.white,
                "lag1": list(colour.first),
                "lags_outside": colour.outside,
            }
            for track, rms, colour in zip(s.problem.tracks, found.rms, found.colours, strict=True)
        ],
        "held_back": [
            {
                "name": h.name,
                "fitted_phi_rad": h.fitted_phi_rad,
                "held_phi_rad": h.held_phi_rad,
                "fitted_length_m": h.fitted_length_m,
                "held_length_m": h.held_length_m,
            }
            for h in found.held
        ],
        "next": [
            {"name": p.name, "worst": p.worst, "worst_relative": p.worst_relative, "relative": p.relative}
            for p in found.prospects
        ],
        "decrement": {
            name: {"zeta": d.zeta, "sigma": d.sigma, "frequency_hz": d.frequency_hz, "zeta_of_fit": of_fit}
            for name, (d, of_fit) in found.decrements.items()
        },
    }

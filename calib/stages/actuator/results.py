"""Identification from logs: the machine it starts from, all that it finds, and the sections of rig.yaml."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.result import CovarianceTable, finite_or_none, judged, section_json
from calib.core.rig import Rig
from calib.core.verdict import Verdict
from calib.solve.information import scaled_inverse
from calib.stages.actuator.identify import (
    PARAMETERS,
    Colour,
    Progress,
    Solution,
    Track,
    colour_of,
    elongation_polynomial,
    fit_tracks,
    head_of,
    values_of,
)
from calib.stages.actuator.identify_pump import of_lag
from calib.stages.actuator.machine import Machine, machine_from
from calib.stages.actuator.parameters import Stiffness
from calib.stages.actuator.section import (
    CREEP,
    KNOTS,
    LAG,
    LAW,
    STRENGTHS,
    Actuator,
    Known,
    PumpSection,
    in_force,
)
from calib.stages.actuator.springs import StiffnessFit
from calib.stages.actuator.swing import Decrement, decrement
from calib.stages.actuator.uncertainty import (
    HeldLog,
    Prospect,
    Uncertainty,
    held_back,
    prospects,
    rms_by_track,
    uncertainty,
)
from calib.stages.actuator.verdict import judge


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
    verdict: Verdict


def beginning(rig: Rig) -> tuple[Machine, dict[str, float]]:
    """The machine that an identification from logs starts from, and the deviations of what a person states.

    Nominal values, over them the springs by weights and the pumps by their tables, over these what is known.
    What logs have told before is left out, so that no result is its own prior. In the second part zero stands
    for what is exact; a machine's creep, elongations and strengths have their names of `PARAMETERS`.
    """
    known = rig.known or Known()
    springs, _ = _kept(rig.actuator, LAW)
    tables, _ = _by_tables(rig)
    actuator = springs | {key: value for key, (value, _) in in_force(None, known.actuator).items()}
    stated = in_force(None, known.pump)
    machine = machine_from(actuator, tables | {key: value for key, (value, _) in stated.items()})
    sigma: dict[str, float] = {}
    for key, (_, one) in (in_force(None, known.actuator) | stated).items():
        if key == "strength":
            sigma |= dict(zip(STRENGTHS, one or (0.0, 0.0), strict=True))
        elif key == "elongation_mm":
            given = {} if known.pump is None else known.pump.sigma
            sigma |= {name: one if isinstance(one := given.get(name), float) else 0.0 for name in KNOTS}
        elif key in PARAMETERS:
            sigma[key] = one or 0.0
    return machine, sigma


def _by_tables(rig: Rig) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `calib identify pump` has found in tables, values and standard deviations."""
    before = rig.pump
    values, sigma = _kept(before, _OF_TABLES)
    model = None if before is None or before.identified is None else before.identified.models.get(LAG)
    told, deviations = ({}, {}) if model is None else of_lag(model, rig.machine.pump.tick_s)
    return values | told, sigma | deviations


_OF_TABLES = ("tick_s", "supply_V", "dead_zone_V")
"""Values of the pumps that logs do not tell."""


def simulated_heads(solution: Solution) -> list[FloatArray]:
    """Angle [rad] and length [m] (m, 2) of the identified rig at each log's poses, the offsets with them."""
    problem, x = solution.problem, solution.x
    return [head_of(problem, x, k) + x[problem.unknowns.offset] for k in range(len(problem.tracks))]


def _decrements(solution: Solution) -> dict[str, tuple[Decrement, float | None]]:
    """Damping of the free swings by peaks, and that of the fitted swing by the same rule."""
    out: dict[str, tuple[Decrement, float | None]] = {}
    for track, head in zip(solution.problem.tracks, simulated_heads(solution), strict=True):
        if track.hoses:
            continue
        noise = float(np.median(np.sqrt(np.sum(np.linalg.inv(track.whitening)[:, 0] ** 2, axis=1))))
        try:
            seen = decrement(track.t_s, track.head[:, 0], noise)
        except BadInputError:
            continue
        try:
            fitted = decrement(track.t_s, head[:, 0], noise).zeta
        except BadInputError:
            fitted = None
        out[track.name] = (seen, fitted)
    return out


def identify_logs(
    nominal: Machine,
    tracks: Sequence[Track],
    static_map: bool = False,
    hold_back: bool = True,
    progress: Progress | None = None,
    stated: Mapping[str, float] | None = None,
    either_law: bool = False,
) -> Identified:
    """Parameters of the actuator and the pumps from logs, with all that says what they are worth.

    `nominal` and `stated` are those of `beginning`, `either_law` as for `fit_tracks`.

    Raises `BadInputError` where the logs can tell nothing.
    """
    delay_s = float(np.median([track.delay_s for track in tracks]))
    solution = fit_tracks(
        nominal, tracks, static_map, delay_s, progress=progress, stated=stated, either_law=either_law
    )
    known = uncertainty(solution)
    colours = colour_of(solution)
    held = held_back(solution) if hold_back else []
    ahead = prospects(solution, known)
    return Identified(
        solution,
        known,
        colours,
        tuple(rms_by_track(solution.problem, solution.residual)),
        tuple(held),
        ahead,
        _decrements(solution),
        judge(solution, known, colours, held, ahead),
    )


def _delay(found: Identified) -> tuple[float, float] | None:
    """Dead time of the pumps [s] beyond that of the rig's file, and its deviation; None without pumps."""
    problem = found.solution.problem
    shared = [at for at, track in zip(problem.unknowns.delays, problem.tracks, strict=True) if track.hoses]
    if not shared:
        return None
    at, J = shared[0], found.solution.J
    V = scaled_inverse(J.T @ J / found.uncertainty.scale**2)
    return float(found.solution.x[at]) - problem.delay_s, float(math.sqrt(max(V[at, at], 0.0)))


def _told(found: Identified, keys: Collection[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of these keys that an identification has estimated or holds, and deviations of the former."""
    held, values, sigma = found.solution.problem.held, found.solution.values, found.uncertainty.sigma
    return (
        {name: value for name, value in {**held, **values}.items() if name in keys},
        {name: finite_or_none(sigma[name]) for name in values if name in keys},
    )


def sections_from(found: Identified, rig: Rig) -> tuple[Actuator, PumpSection | None]:
    """The sections of an identification; that of the pumps only where a log has commands.

    Of what the file says, the springs stay, and the damping that no log here can tell.
    """
    judgement = judged(found.verdict)
    problem = found.solution.problem
    names = list(problem.names)
    kinds = {track.hoses for track in problem.tracks}
    kept = [*LAW]
    kept += [] if False in kinds else ["damping_scale_free_swing"]
    kept += [] if True in kinds else ["damping_scale_pumps_connected"]
    section, sigma = _kept(rig.actuator, kept)
    if {"lambda1_per_s", "lambda2_N_per_m"} & {*names, *problem.held}:
        # The creep makes sense only whole.
        section |= dict(zip(CREEP, problem.nominal.plant.creep_rates, strict=True))
    values, deviations = _told(found, Actuator.model_fields)
    table = CovarianceTable(order=names, values=found.uncertainty.covariance.tolist())
    actuator = Actuator(
        **section | values, sigma=sigma | deviations, covariance=table, **judgement
    ).with_evidence(found)
    return actuator, _pump(found, rig, judgement).with_evidence(found) if True in kinds else None


def _kept(
    before: Actuator | PumpSection | None, keys: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values and standard deviations of some keys of a section."""
    if before is None:
        return {}, {}
    values = {key: getattr(before, key) for key in keys if getattr(before, key) is not None}
    return values, {key: before.sigma[key] for key in values if key in before.sigma}


def _pump(found: Identified, rig: Rig, judgement: dict[str, Any]) -> PumpSection:
    values, uncertainty = found.solution.values, found.uncertainty
    problem = found.solution.problem
    nominal = problem.nominal
    (section, sigma), (told, deviations) = _by_tables(rig), _told(found, PumpSection.model_fields)
    section |= told
    sigma |= deviations
    if "laminar_s" in values:
        section["deflation"] = "orifice"
    if any(n in values for n in STRENGTHS):
        section["strength"] = [values.get(n, one) for n, one in zip(STRENGTHS, nominal.strength, strict=True)]
        sigma["strength"] = [finite_or_none(uncertainty.sigma.get(n, 0.0)) for n in STRENGTHS]
    if any(n in values for n in KNOTS):
        whole = {**values_of(nominal), **values}
        section["elongation_mm"] = list(elongation_polynomial([whole[n] for n in KNOTS]))
        sigma |= _told(found, KNOTS)[1]
    delay = _delay(found)
    remarks = []
    if delay is not None:
        stated = None if rig.known is None or rig.known.pump is None else rig.known.pump.tick_s
        logged_s = next(track.tick_s for track in problem.tracks if track.hoses)
        dead_s = nominal.pump.at(logged_s).delay_ticks * logged_s + delay[0]
        tick_s = stated or logged_s
        if tick_s != nominal.pump.tick_s:
            section["tick_s"] = tick_s
        ticks = round(dead_s / tick_s)
        if ticks >= 0:
            section["delay_ticks"] = ticks
            sigma["delay_ticks"] = delay[1] / tick_s
            late = problem.delay_s
            remarks.append(
                f"dead time {1e3 * dead_s:.3g} +- "
                f"{1e3 * delay[1]:.2g} ms if pictures are {1e3 * late:.3g} ms late: "
                "logs of the camera tell their sum alone"
            )
    identified = None if rig.pump is None else rig.pump.identified
    return PumpSection(
        **section, sigma=sigma, identified=identified, **judgement | {"remarks": remarks, "advice": []}
    )


def stiffness_section(fit: StiffnessFit, per_actuator: bool, rig: Rig) -> Actuator:
    """The section with the springs of one bellows from a law of the table.

    Raises `BadInputError` for a law that is not positive over the elongations in use.
    """
    share = 0.5 if per_actuator else 1.0
    k = (share * fit.coefficients).tolist()
    Stiffness(tuple(k))
    padded = k + [0.0] * (len(LAW) - len(k))
    before: dict[str, Any] = {"verdict": "ok"} if rig.actuator is None else section_json(rig.actuator)
    # What calib identify remarked and advised is of its logs.
    before = {key: value for key, value in before.items() if key not in ("remarks", "advice")}
    sigma = {key: value for key, value in before.get("sigma", {}).items() if key not in LAW}
    sigma |= {key: share * float(s) for key, s in zip(LAW, fit.sigma.tolist(), strict=False)}
    return Actuator.model_validate(before | dict(zip(LAW, padded, strict=True)) | {"sigma": sigma})


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
                "scatter": u.scatter[name],
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
                "source": track.source,
                "hoses": track.hoses,
                "phi_rms_rad": rms[0],
                "length_rms_m": rms[1],
                "white": colour.white,
                "lag1": list(colour.first),
                "lags_outside": colour.outside,
            }
            for track, rms, colour in zip(s.problem.tracks, found.rms, found.colours, strict=True)
        ],
        "held_back": [asdict(h) for h in found.held],
        "next": [
            {"name": p.name, "worst": p.worst, "worst_relative": p.worst_relative, "relative": p.relative}
            for p in found.prospects
        ],
        "decrement": {
            name: {"zeta": d.zeta, "sigma": d.sigma, "frequency_hz": d.frequency_hz, "zeta_of_fit": of_fit}
            for name, (d, of_fit) in found.decrements.items()
        },
    }

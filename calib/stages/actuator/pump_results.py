"""What tables tell of a pump: both models compared, judged, and the section `pump` of rig.yaml."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.core.errors import BadInputError
from calib.core.result import finite_or_none, section_json
from calib.core.rig import Rig
from calib.stages.actuator.identify import Progress
from calib.stages.actuator.identify_pump import (
    LAG,
    MODELS,
    ORIFICE,
    Departure,
    Group,
    Held,
    Parameter,
    PumpFit,
    PumpRecord,
    Shape,
    StaticMap,
    cross_validate,
    departures,
    fit_pump,
    fit_static_map,
    held_by,
    jumps,
    settled_groups,
    with_run_sigma,
)
from calib.stages.actuator.parameters import SUPPLY_V
from calib.stages.actuator.pump import PWM_MAX, TICK_S
from calib.stages.actuator.read import PumpTable
from calib.stages.actuator.section import KnownPump, PumpIdentified, PumpModel, PumpSection, StaticMapSection

# ----------------------------------------------------------------------
# Both models on recordings, and the static maps of settled values.


@dataclass(frozen=True)
class PumpFound:
    """Everything that `calib identify pump` has found.

    Attributes
    ----------
    unit : of the values. records : recordings over time.
    fits, held : by model. asked : errors on recordings that were kept out on purpose, by model.
    between : standard deviation of where a run settles about the fit, by model.
    maps : static maps. groups, departs, leaps : what is not explained.
    """

    unit: str
    records: tuple[PumpRecord, ...]
    fits: dict[str, PumpFit]
    held: dict[str, list[Held]]
    asked: dict[str, list[Held]]
    between: dict[str, float]
    maps: tuple[StaticMap, ...]
    groups: tuple[Group, ...]
    departs: tuple[Departure, ...]
    leaps: tuple[tuple[str, float, float], ...]
    said: tuple[str, ...]

    @property
    def main_group(self) -> Group | None:
        """The largest group of runs, None where all settle alike or too few do."""
        if len(self.groups) < 2:
            return None
        return max(self.groups, key=lambda g: len(g.names))

    def held_rms(self, model: str, names: Sequence[str] | None = None) -> float | None:
        """RMS over recordings that were not fitted, each counting alike; None without any."""
        some = [h.rms for h in self.held[model] if names is None or h.name in names]
        return float(np.sqrt(np.mean(np.square(some)))) if some else None

    def settles(self, model: str) -> tuple[float, float, int, int] | None:
        """Level, half its 95 % interval for a further run, and how many of the held runs end inside that
        which the others give, of how many; None where fewer than three were held.

        Three deviations hold 95 % of any distribution with one peak (Vysochanskij and Petunin 1980).
        """
        ends = [h.settles for h in self.held[model] if math.isfinite(h.settles)]
        if len(ends) < _FEWEST_RUNS or "level" not in self.fits[model].sigma:
            return None
        inside = sum(
            abs(end)
            <= 3.0 * math.hypot(*(other for j, other in enumerate(ends) if j != k)) / math.sqrt(len(ends) - 1)
            for k, end in enumerate(ends)
        )
        fit = self.fits[model]
        return fit.values["level"], 3.0 * fit.sigma["level"], inside, len(ends)

    @property
    def better(self) -> str | None:
        """The model with the smaller error on recordings not fitted; None without recordings."""
        if not self.fits:
            return None
        return min(self.fits, key=lambda m: self.held_rms(m) or self.fits[m].rms)


def _chosen_shape(records: Sequence[PumpRecord], maps: Sequence[StaticMap]) -> Shape:
    """The static map's shape that lets the plain lag fit best: a straight line, or one of the tables'."""
    rising = [m for m in maps if m.end * float(np.median([r.value[-1] for r in records])) > 0.0]
    shapes = [Shape(), *(m.shape for m in rising)]
    if len(shapes) == 1:
        return shapes[0]
    # Judged by the model that a drop of the PWM can tell anything about.
    costs = [fit_pump(records, LAG, shape).cost for shape in shapes]
    return shapes[int(np.argmin(costs))]


def identify_pump(
    tables: Sequence[PumpTable], kept_out: Sequence[PumpTable] = (), progress: Progress | None = None
) -> PumpFound:
    """Dead time, lag, static map and flow of a pump, both models compared on recordings not fitted.

    Parameters
    ----------
    kept_out : tables that are predicted and not fitted.

    Raises
    ------
    BadInputError for tables of different units, and where nothing changes in any.
    """
    units = {table.unit for table in (*tables, *kept_out)}
    if len(units) != 1:
        raise BadInputError(f"pump: found tables in {' and '.join(sorted(units))}, expected one unit")
    said = [sentence for table in tables for sentence in table.said]
    records = []
    for table in tables:
        record = table.record
        if record is None:
            continue
        if not np.ptp(record.pwm) and float(np.ptp(record.value)) < 1e-9:
            said.append(f"{record.name}: neither PWM nor value ever changes; left out")
            continue
        records.append(record)
    settled = [part for table in tables for part in table.settled]
    maps = [fit_static_map(part.name, part.pwm, part.value) for part in settled]
    if not records and not maps:
        raise BadInputError("pump: neither PWM nor value ever changes in these tables, expected steps")
    fits: dict[str, PumpFit] = {}
    held: dict[str, list[Held]] = {}
    asked: dict[str, list[Held]] = {}
    between: dict[str, float] = {}
    if records:
        shape = _chosen_shape(records, maps)
        for done, model in enumerate(MODELS):
            if progress is not None:
                progress(done, len(MODELS))
            fits[model] = fit_pump(records, model, shape)
            held[model] = cross_validate(fits[model], records)
            fits[model], between[model] = with_run_sigma(fits[model], held[model])
            outside = [table.record for table in kept_out if table.record is not None]
            asked[model] = [held_by(fits[model], r) for r in outside]
    return PumpFound(
        units.pop(),
        tuple(records),
        fits,
        held,
        asked,
        between,
        tuple(maps),
        settled_groups(records) if records else (),
        departures(fits[ORIFICE], records) if records else (),
        jumps(records),
        tuple(said),
    )


# ----------------------------------------------------------------------
# What was found of a pump, judged and as the section `pump` of rig.yaml.

_MOST_SHARE = 0.05
_FEWEST_RUNS = 3
_MOST_VAGUE = 0.5


def unexplained(found: PumpFound) -> list[str]:
    """Sentences on what no function of the PWM explains."""
    out, unit = [], found.unit
    main = found.main_group
    if main is not None:
        parts = [
            f"{len(g.names)} at {g.value:.1f} {unit} ({', '.join(g.names)}; "
            f"PWM {g.pwm[0]:.0f} .. {g.pwm[1]:.0f})"
            for g in found.groups
        ]
        out.append(f"runs near full PWM settle apart: {'; '.join(parts)}; PWM does not say which")
    for d in found.departs:
        moved = "after the PWM had moved" if d.pwm_moved else "while the PWM stood still"
        out.append(
            f"{d.name} leaves the model {d.at_s:.2f} s after its start, {moved}, by {d.error:+.2f} {unit}"
        )
    for name, size, before in found.leaps:
        out.append(
            f"{name} begins with a jump of {size:.1f} {unit} within 0.1 s from {before:.2f} {unit}, as if "
            "the chamber had been under pressure behind a closed valve"
        )
    for m in found.maps:
        if m.outliers:
            values = ", ".join(f"{u:g}" for u in m.outliers)
            out.append(
                f"{m.name}: the settled values at PWM {values} lie off the map by more than four scatters"
            )
    return out


def judge_pump(found: PumpFound) -> tuple[str, list[str], list[str]]:
    """Verdict, reasons and remarks."""
    reasons, remarks = unexplained(found), list(dict.fromkeys(found.said))
    if not found.fits:
        remarks.append(
            "settled values alone: neither dead time nor lag can be told, expected a recording over time"
        )
        return "unidentifiable" if not found.maps else "poor" if reasons else "ok", reasons, remarks
    better = found.better
    assert better is not None
    fit = found.fits[better]
    span = max(float(r.value.max() - r.value.min()) for r in found.records)
    rms = found.held_rms(better)
    if rms is None:
        remarks.append("one recording alone: no error on recordings not fitted")
    elif rms > _MOST_SHARE * span:
        reasons.append(
            f"on recordings not fitted the {better} is off by {rms:.2f} {found.unit} (RMS), "
            f"{100.0 * rms / span:.0f} % of the range"
        )
    for name, sigma in fit.sigma.items():
        value = abs(fit.values[name])
        if (
            name not in ("laminar_s", "turbulent_s2", "hose_per_s", "chamber_s")
            and sigma > _MOST_VAGUE * value
        ):
            reasons.append(
                f"{name} of the {better} is known to {100.0 * sigma / max(value, 1e-12):.0f} % only"
            )
    settles = found.settles(better)
    if settles is not None:
        level, half, inside, count = settles
        remarks.append(
            f"a further run settles at {level:.1f} +- {half:.1f} {found.unit} at full PWM (95 %); "
            f"of {count} runs that were held back {inside} end inside what the others give"
        )
    if found.fits[LAG].shape.dead_pwm == 0.0:
        remarks.append(
            "dead zone and shape of the static map are not told by these recordings; it is taken as a "
            "straight line through zero (settled values at several PWM tell it)"
        )
    return "poor" if reasons else "ok", reasons, remarks


def _unit(parameter: Parameter, unit: str) -> str:
    if parameter.name == "rising_limit_per_s":
        return f"{unit}/s"
    return {"y": unit, "1/y": f"s^2/{unit}"}.get(parameter.unit, parameter.unit)


def parameter_rows(fit: PumpFit, unit: str) -> list[tuple[str, float, float | None, str, str]]:
    """Name, value, standard deviation, unit and remark of each parameter."""
    rows = []
    for parameter in MODELS[fit.model]:
        value = fit.values[parameter.name]
        rows.append(
            (
                parameter.name,
                value,
                fit.sigma.get(parameter.name),
                _unit(parameter, unit),
                fit.fixed.get(parameter.name, ""),
            )
        )
    return rows


def _model(found: PumpFound, name: str) -> PumpModel:
    fit, main = found.fits[name], found.main_group
    held = found.held[name]
    return PumpModel(
        parameters={n: v for n, v in fit.values.items() if n in fit.sigma},
        sigma={n: finite_or_none(s) for n, s in fit.sigma.items()},
        fixed=fit.fixed,
        fitted_rms=fit.rms,
        held_rms=found.held_rms(name),
        level_between_runs=finite_or_none(found.between[name]),
        held_rms_in_main_group=None if main is None else found.held_rms(name, main.names),
        held_by_file={h.name: h.rms for h in held},
        ahead_by_file={h.name: finite_or_none(h.ahead) for h in held},
    )


def pump_section(found: PumpFound, rig: Rig) -> PumpSection:
    """The section, with lag and dead time of the linear model where a recording tells them.

    Levels in kPa are no forces: they stay under `identified`. What logs have told of forces stays.
    """
    verdict, reasons, remarks = judge_pump(found)
    before: dict[str, Any] = {} if rig.pump is None else section_json(rig.pump)
    stated = rig.known.pump if rig.known is not None and rig.known.pump is not None else KnownPump()
    update: dict[str, Any] = {"verdict": verdict, "reasons": reasons, "remarks": remarks, "advice": []}
    sigma: dict[str, Any] = before.get("sigma", {})
    if found.fits:
        lag = found.fits[LAG]
        tick_s = stated.tick_s or before.get("tick_s", TICK_S)
        update |= {
            "lag_s": lag.values["lag_s"],
            "delay_ticks": round(lag.values["dead_time_s"] / tick_s),
        }
        sigma |= {"lag_s": lag.sigma["lag_s"], "delay_ticks": lag.sigma["dead_time_s"] / tick_s}
        dead = lag.shape.dead_pwm
        if dead > 0.0:
            of = [m for m in found.maps if m.shape == lag.shape]
            supply = stated.supply_V or before.get("supply_V", SUPPLY_V)
            update["dead_zone_V"] = supply * dead / PWM_MAX
            sigma["dead_zone_V"] = finite_or_none(supply * of[0].sigma["dead_pwm"] / PWM_MAX) if of else None
    maps = {
        m.name: StaticMapSection(
            end=m.end,
            dead_pwm=m.shape.dead_pwm,
            scale_pwm=m.shape.scale_pwm,
            saturates_pwm=m.saturates_pwm,
            scatter=m.scatter,
            sigma={k: finite_or_none(s) for k, s in m.sigma.items()},
            outliers_pwm=list(m.outliers),
        )
        for m in found.maps
        if math.isfinite(m.shape.scale_pwm)
    }
    identified = PumpIdentified.model_validate(
        {
            "unit": found.unit,
            "models": {name: _model(found, name) for name in found.fits},
            "better": found.better,
            "static": maps,
            "groups": [
                {"value": g.value, "spread": g.spread, "pwm": list(g.pwm), "files": list(g.names)}
                for g in found.groups
            ],
            "unexplained": unexplained(found),
        }
    )
    return PumpSection.model_validate(before | update | {"sigma": sigma, "identified": identified})

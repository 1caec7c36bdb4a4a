"""What was found of a pump, judged and as the section `pump` of rig.yaml."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from calib.actuator.identify_pump import PumpFit
from calib.actuator.identify_pump_models import LAG, MODELS, Parameter
from calib.actuator.pump import PWM_MAX, TICK_S
from calib.identification import PumpFound
from calib.rig import Rig, finite_or_none
from calib.rig_actuator import PumpIdentified, PumpModel, PumpSection, StaticMapSection, section_of

__all__ = ["judge_pump", "pump_section", "unexplained"]

_MOST_SHARE = 0.05
_MOST_VAGUE = 0.5
_FREE = 1e5


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
        held_rms_in_main_group=None if main is None else found.held_rms(name, main.names),
        held_by_file={h.name: h.rms for h in held},
        ahead_by_file={h.name: finite_or_none(h.ahead) for h in held},
    )


def pump_section(found: PumpFound, rig: Rig, path: Path) -> PumpSection:
    """The section, with lag and dead time of the linear model where a recording tells them.

    Levels in kPa are no forces: they stay under `identified`.
    """
    verdict, reasons, remarks = judge_pump(found)
    before = section_of(rig, "pump", PumpSection, path)
    update: dict[str, Any] = {"verdict": verdict, "reasons": reasons, "remarks": remarks}
    sigma: dict[str, Any] = dict(before.sigma)
    if found.fits:
        lag = found.fits[LAG]
        tick_s = before.tick_s or TICK_S
        update |= {
            "lag_s": lag.values["lag_s"],
            "delay_ticks": float(round(lag.values["dead_time_s"] / tick_s)),
        }
        sigma |= {"lag_s": lag.sigma["lag_s"], "delay_ticks": lag.sigma["dead_time_s"] / tick_s}
        dead = lag.shape.dead_pwm
        if dead > 0.0:
            of = [m for m in found.maps if m.shape == lag.shape]
            supply = before.supply_V or 12.0
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
    return before.model_copy(update=update | {"sigma": sigma, "identified": identified})

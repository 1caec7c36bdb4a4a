"""The pages of a fleet and of a sweep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.core import __version__
from calib.core.plot import SIGMA, Bars, Curve, Figure, Mark, Plot, Rule
from calib.core.units import unit_of
from calib.core.verdict import POOR
from calib.core.words import BLANK, as_words, counted, number, several
from calib.core.writing import write_atomically
from calib.runner.fleet import ConstantSummary, FleetSummary
from calib.runner.graph import STEPS
from calib.runner.sweep import Point, Sweep, SweepSummary
from calib.show.page import PAGE as A_PAGE
from calib.show.page import embedded, render

# ----------------------------------------------------------------------
# Figures of a fleet: a constant's histogram, and its values over the serial numbers.


def constant_figure(one: ConstantSummary) -> Figure:
    """How a constant is spread over the rigs, and what it does with the serial number."""
    name, unit = as_words(one.name), f" {one.unit}" if one.unit else ""
    value = f"{name} ({one.unit})" if one.unit else name
    width = (one.high - one.low) / max(len(one.counts), 1)
    at = one.low + width * (np.arange(len(one.counts)) + 0.5)
    outside = [
        f"{counted(n, 'rig')} lie{'s' * (n == 1)} {word}"
        for n, word in ((one.below, "below"), (one.above, "above"))
        if n
    ]
    panels = [
        Plot(
            value,
            "rigs",
            (Bars(at, np.array(one.counts), width), Rule("x", one.spread.median, "ink"))
            if width > 0.0
            else (),
            whole="y",
            empty="" if width else "All rigs have the same value.",
        )
    ]
    sentence = f"The line is the median{'; ' if outside else ''}{' and '.join(outside)}."
    drift = one.drift
    if drift is not None and one.points:
        serial, x = np.array(one.points).T
        ends = serial[[0, -1]]
        line = drift.at_middle + drift.slope * (ends - drift.middle)
        # A few far values are drawn at the edge, so that the others are told apart.
        reach = 5.0 * one.spread.scale or max(one.high - one.low, 1e-12)
        low = min(max(one.spread.low, one.spread.median - reach), *line)
        high = max(min(one.spread.high, one.spread.median + reach), *line)
        near = (low <= x) & (x <= high)
        marks: list[Mark] = [Curve(serial[near], x[near], kind="points")]
        if not near.all():
            marks.append(Curve(serial[~near], x[~near].clip(low, high), kind="crosses", colour="red"))
        marks.append(Curve(ends, line, colour="red" if one.drifts else "ink"))
        panels.append(Plot("serial number", value, marks))
        word = (
            "It drifts with the serial number" if one.drifts else "It has no drift that is more than chance"
        )
        slope, bar = number(drift.slope, drift.sigma), number(drift.sigma, drift.sigma)
        sentence += f" {word}: {slope} ± {bar}{unit} per number, over {counted(drift.count, 'rig')}."
        sentence += "" if near.all() else " Crosses are farther away than drawn."
    return Figure(f"{name} over {counted(one.spread.count, 'rig')}", sentence, panels, 2.2 * len(panels))


# ----------------------------------------------------------------------
# The page of a fleet: one HTML file that needs no network, from its summary.
#
# Whatever the number of rigs, the page holds so many bins, points and names and no more. Names and sentences
# are escaped, and a policy in the page lets no script run but its own.

PAGE = "fleet.html"
STYLE, SCRIPT = ("page.css", "fleet.css"), ("common.js",)
_MOST_DRAWN = 60
_KIND = {"ok": "ok", "poor": "poor", "failed": "failed", "broken": "failed", "lost": "failed"}
_STAGE_KIND: dict[str, str] = {**_KIND, **dict.fromkeys(POOR, "poor"), "blocked": "blocked"}


def write_fleet_page(path: Path, summary: FleetSummary) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, fleet_page_text(summary), A_PAGE)


def fleet_page_text(summary: FleetSummary) -> str:
    """The whole page."""
    # Of a constant of one rig there is nothing to draw.
    told = sorted((one for one in summary.constants if one.spread.count > 1), key=_interest)
    answer, headline = _answer(summary)
    return render(
        "fleet.html.j2",
        STYLE,
        SCRIPT,
        bool(told),
        version=__version__,
        summary=summary,
        rigs=counted(summary.rigs, "rig"),
        answer=answer,
        headline=headline,
        verdicts=[
            (verdict, count, _KIND.get(verdict, "skipped")) for verdict, count in summary.verdicts.items()
        ],
        stages=_stages(summary),
        cards=[_card(one) for one in told[:_MOST_DRAWN]],
        dropped=len(summary.constants) - len(told[:_MOST_DRAWN]),
        rows=[_row(one) for one in summary.constants],
        looks=[(look, _KIND.get(look.verdict, "skipped"), _z(look.z)) for look in summary.looks],
        limit=f"{summary.limit:.2f}" if math.isfinite(summary.limit) else "",
    )


def _answer(summary: FleetSummary) -> tuple[str, str]:
    bad = sum(count for verdict, count in summary.verdicts.items() if _KIND.get(verdict) == "failed")
    standing = sum(one.standing_out for one in summary.constants)
    drifting = [as_words(one.name) for one in summary.constants if one.drifts]
    parts = []
    if bad:
        parts.append(f"{bad} of {counted(summary.rigs, 'rig')} ha{'ve' if bad > 1 else 's'} no result")
    if summary.verdicts.get("poor"):
        poor = summary.verdicts["poor"]
        parts.append(f"{poor} {'are' if poor > 1 else 'is'} poor")
    if standing:
        parts.append(f"{standing} value{'s stand' if standing > 1 else ' stands'} out against the fleet")
    if drifting:
        drift = "drifts" if len(drifting) == 1 else "drift"
        parts.append(f"{several(drifting, 3)} {drift} with the serial number")
    if not parts:
        if summary.rigs == 1:
            return "yes", "the rig is ok"
        return "yes", f"all {summary.rigs} rigs are ok{'' if summary.remark else ', and none stands out'}"
    return ("no" if bad else "not-yet"), "; ".join(parts)


def _interest(one: ConstantSummary) -> tuple[int, float]:
    size = 0.0 if one.drift is None else abs(one.drift.z)
    return (0 if one.standing_out or one.drifts else 1), -(one.standing_out + size if one.drifts else 0.0)


def _z(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _stages(summary: FleetSummary) -> list[tuple[str, list[tuple[str, int, str]]]]:
    return [
        (_title(stage), [(v, n, _STAGE_KIND.get(v, "skipped")) for v, n in sorted(counts.items())])
        for stage, counts in summary.stages.items()
    ]


def _title(job: str) -> str:
    """A job's title from its name: that of its stage, and of its log where there are several."""
    step = max((one for one in STEPS if f"{job}-".startswith(f"{one.name}-")), key=lambda one: len(one.name))
    log = job.removeprefix(step.name).removeprefix("-")
    return f"{step.title} of {log}" if log else step.title


def _facts(one: ConstantSummary) -> list[tuple[str, str]]:
    spread = one.spread
    unit = f" {one.unit}" if one.unit else ""
    own = f"{spread.own:.2g}{unit}" if math.isfinite(spread.own) else BLANK
    return [
        ("median", f"{number(spread.median, spread.scale or None)}{unit}"),
        (f"spread, 1{SIGMA}", f"{spread.scale:.2g}{unit}"),
        ("of it between rigs", f"{spread.between:.2g}{unit}"),
        (f"a rig's own {SIGMA}", own),
        ("rigs", str(spread.count)),
    ]


def _card(one: ConstantSummary) -> dict[str, Any]:
    """A constant as the page shows it."""
    out = [(name, number(value, one.spread.scale or None), f"{z:+.1f}") for name, value, z in one.out[:8]]
    return {
        "name": as_words(one.name),
        "facts": _facts(one),
        "figure": embedded(constant_figure(one)),
        "drifts": one.drifts,
        "out": out,
        "more": max(0, one.standing_out - 8),
    }


def _row(one: ConstantSummary) -> Sequence[tuple[str, float | None]]:
    spread, drift = one.spread, one.drift

    def cell(value: float, text: str | None = None) -> tuple[str, float | None]:
        return (text or f"{value:.3g}", value) if math.isfinite(value) else ("", None)

    return [
        cell(spread.median, number(spread.median, spread.scale or spread.own)),
        # One value has no spread.
        cell(spread.scale if spread.count > 1 else math.nan),
        cell(spread.between if spread.count > 1 else math.nan),
        cell(spread.own),
        cell(float(spread.count), str(spread.count)),
        cell(float(one.standing_out), str(one.standing_out)),
        *(
            (cell(drift.slope, number(drift.slope, drift.sigma)), cell(drift.sigma))
            if drift
            else (("", None),) * 2
        ),
    ]


# ----------------------------------------------------------------------
# The page of a sweep: the best and the worst points, and the measure over each parameter.

SWEEP_PAGE = "sweep.html"


def write_sweep_page(path: Path, spec: Sweep, summary: SweepSummary) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, sweep_page_text(spec, summary), A_PAGE)


def sweep_page_text(spec: Sweep, summary: SweepSummary) -> str:
    """The whole page."""
    base = spec.base
    what = f"{base.kind} {base.name}" + (f" on {base.other}" if base.other else "")
    tables = [
        (title, summary.heads("point", _headed), [_sweep_page_row(point) for point in points])
        for title, points in (("Best points", summary.best), ("Worst points", summary.worst))
        if points
    ]
    return render(
        "sweep.html.j2",
        STYLE,
        SCRIPT,
        bool(summary.clouds),
        version=__version__,
        summary=summary,
        what=what,
        first=summary.first.told(_headed) if summary.first else "",
        measure=as_words(summary.measure),
        feedback=base.feedback,
        aim="the least is best" if spec.near is None else f"the nearest to {spec.near:g} is best",
        points=spec.points,
        draws=spec.draws.count,
        tables=tables,
        clouds=[embedded(_cloud(name, summary.measure, points)) for name, points in summary.clouds if points],
    )


def _sweep_page_row(point: Point) -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = [(f"#{point.point}", point.point)]
    for cell in point.cells:
        if isinstance(cell, float):
            out.append((f"{cell:.4g}", cell) if cell == cell else ("", None))
        else:
            out.append((str(cell), None))
    return out


def _cloud(name: str, measure: str, points: tuple[tuple[float, float], ...]) -> Figure:
    """The measure over one parameter."""
    x, y = np.array(points).T
    panel = Plot(_headed(name), _headed(measure), (Curve(x, y, kind="points"),))
    return Figure(f"{as_words(measure)} over {as_words(name)}", "", (panel,), 3.0)


def _headed(name: str) -> str:
    """A key as the name of an axis."""
    unit = unit_of(name)
    return as_words(name) + (f" ({unit})" if unit else "")

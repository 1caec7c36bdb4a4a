"""The pages of a fleet and of a sweep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from calib import __version__
from calib.core.words import BLANK, SIGMA, number
from calib.core.writing import write_atomically
from calib.runner.fleet import ConstantSummary, FleetSummary
from calib.runner.sweep import Point, SweepSpec, SweepSummary
from calib.show.page import PAGE as A_PAGE
from calib.show.page import render

# ----------------------------------------------------------------------
# Small pictures of a fleet as SVG text: a constant's histogram, and its values over the serial numbers.
#
# Only numbers go into them; colours are those of the page, so that they follow its theme.

_WIDE, _HIGH, _LEFT, _BELOW, _TOP = 420.0, 150.0, 8.0, 24.0, 8.0


def _start(label: str) -> list[str]:
    return [f'<svg class="plot" viewBox="0 0 {_WIDE:g} {_HIGH:g}" role="img" aria-label="{escape(label)}">']


def _text(x: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{_HIGH - 6:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def histogram_svg(one: ConstantSummary) -> str:
    """Bars over the values, a line at the median, and arrows for rigs that lie outside."""
    out = _start(f"Histogram of {one.name} over {one.spread.count} rigs")
    if not one.counts or not one.high > one.low:
        return "".join([*out, "</svg>"])
    width = (_WIDE - 2 * _LEFT) / len(one.counts)
    floor, most = _HIGH - _BELOW, max(*one.counts, 1)
    room = floor - _TOP
    for k, count in enumerate(one.counts):
        if count:
            high = room * count / most
            x = _LEFT + k * width
            step = (one.high - one.low) / len(one.counts)
            told = f"{one.low + k * step:.6g} to {one.low + (k + 1) * step:.6g}: {count}"
            out.append(
                f'<rect class="bar" x="{x + 0.5:.1f}" y="{floor - high:.1f}" width="{width - 1:.1f}" '
                f'height="{high:.1f}"><title>{told}</title></rect>'
            )
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDE - _LEFT}" y1="{floor}" y2="{floor}"/>')
    middle = _LEFT + (one.spread.median - one.low) / (one.high - one.low) * (_WIDE - 2 * _LEFT)
    out.append(f'<line class="median" x1="{middle:.1f}" x2="{middle:.1f}" y1="{_TOP}" y2="{floor}"/>')
    for x, count, sign in ((_LEFT, one.below, "\u2190"), (_WIDE - _LEFT, one.above, "\u2192")):
        if count:
            anchor = "start" if x == _LEFT else "end"
            told = f"{sign} {count}" if x == _LEFT else f"{count} {sign}"
            out.append(
                f'<text class="far" x="{x:.1f}" y="{_TOP + 10:.1f}" text-anchor="{anchor}">{told}</text>'
            )
    out.append(_text(_LEFT, number(one.low, one.spread.scale or None), "start"))
    out.append(_text(_WIDE - _LEFT, number(one.high, one.spread.scale or None), "end"))
    return "".join([*out, "</svg>"])


def drift_svg(one: ConstantSummary) -> str:
    """Values over the serial numbers with the robust line; "" without numbers. Far values sit at the edge."""
    drift = one.drift
    if drift is None or not one.points:
        return ""
    out = _start(f"{one.name} over the serial number")
    first, last = one.points[0][0], one.points[-1][0]
    across = max(last - first, 1e-12)
    reach = 5.0 * one.spread.scale or max(one.high - one.low, 1e-12)
    ends = [drift.at_middle + drift.slope * (t - drift.middle) for t in (first, last)]
    low = min(max(one.spread.low, one.spread.median - reach), *ends)
    high = max(min(one.spread.high, one.spread.median + reach), *ends)
    floor = _HIGH - _BELOW

    def place(t: float, x: float) -> tuple[float, float]:
        share = (min(max(x, low), high) - low) / max(high - low, 1e-300)
        return _LEFT + (t - first) / across * (_WIDE - 2 * _LEFT), floor - share * (floor - _TOP)

    for t, x in one.points:
        u, v = place(t, x)
        kind = "dot" if low <= x <= high else "dot far"
        out.append(f'<circle class="{kind}" cx="{u:.1f}" cy="{v:.1f}" r="2"/>')
    (x1, y1), (x2, y2) = place(first, ends[0]), place(last, ends[1])
    kind = "drifting" if one.drifts else "median"
    out.append(f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>')
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDE - _LEFT}" y1="{floor}" y2="{floor}"/>')
    out.append(_text(_LEFT, f"number {first:g}", "start"))
    out.append(_text(_WIDE - _LEFT, f"{last:g}", "end"))
    return "".join([*out, "</svg>"])


# ----------------------------------------------------------------------
# The page of a fleet: one HTML file that needs no network, from its summary.
#
# Whatever the number of rigs, the page holds so many bins, points and names and no more. Names and
# sentences
# are escaped, and a policy in the page lets no script run but its own.

PAGE = "fleet.html"
STYLE, SCRIPT = ("page.css", "fleet.css"), ("common.js",)
_MOST_DRAWN = 60
_KIND = {"ok": "ok", "poor": "poor", "failed": "failed", "broken": "failed", "lost": "failed"}
_STAGE_KIND = {"ok": "ok", "poor": "poor", "failed": "failed", "blocked": "blocked"}


@dataclass(frozen=True)
class _Card:
    """A constant as the page shows it."""

    name: str
    unit: str
    facts: tuple[tuple[str, str], ...]
    histogram: str
    drift: str
    sentence: str
    drifts: bool
    out: tuple[tuple[str, str, str], ...]
    more: int


def write_fleet_page(path: Path, summary: FleetSummary) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, fleet_page_text(summary), A_PAGE)


def fleet_page_text(summary: FleetSummary) -> str:
    """The whole page."""
    told = sorted(summary.constants, key=_interest)
    answer, headline = _answer(summary)
    return render(
        "fleet.html.j2",
        STYLE,
        SCRIPT,
        version=__version__,
        summary=summary,
        answer=answer,
        headline=headline,
        verdicts=[
            (verdict, count, _KIND.get(verdict, "skipped")) for verdict, count in summary.verdicts.items()
        ],
        stages=_stages(summary),
        cards=[_card(one) for one in told[:_MOST_DRAWN]],
        dropped=max(0, len(told) - _MOST_DRAWN),
        rows=[_row(one) for one in summary.constants],
        looks=[(look, _KIND.get(look.verdict, "skipped"), _z(look.z)) for look in summary.looks],
        limit=f"{summary.limit:.2f}" if math.isfinite(summary.limit) else "",
    )


def _answer(summary: FleetSummary) -> tuple[str, str]:
    bad = sum(count for verdict, count in summary.verdicts.items() if _KIND.get(verdict) == "failed")
    standing = sum(one.standing_out for one in summary.constants)
    drifting = [one.name for one in summary.constants if one.drifts]
    parts = []
    if bad:
        parts.append(f"{bad} of {summary.rigs} rigs ha{'ve' if bad > 1 else 's'} no result")
    if summary.verdicts.get("poor"):
        poor = summary.verdicts["poor"]
        parts.append(f"{poor} {'are' if poor > 1 else 'is'} poor")
    if standing:
        parts.append(f"{standing} value{'s stand' if standing > 1 else ' stands'} out against the fleet")
    if drifting:
        more = "" if len(drifting) <= 3 else f" and {len(drifting) - 3} more"
        parts.append(
            f"{', '.join(drifting[:3])}{more} drift{'s' if len(drifting) == 1 else ''} with the serial number"
        )
    if not parts:
        return "yes", f"all {summary.rigs} rigs are ok, and none stands out"
    return ("no" if bad else "not-yet"), "; ".join(parts)


def _interest(one: ConstantSummary) -> tuple[int, float]:
    size = 0.0 if one.drift is None else abs(one.drift.z)
    return (0 if one.standing_out or one.drifts else 1), -(one.standing_out + size if one.drifts else 0.0)


def _z(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _stages(summary: FleetSummary) -> list[tuple[str, list[tuple[str, int, str]]]]:
    return [
        (stage, [(v, n, _STAGE_KIND.get(v, "skipped")) for v, n in sorted(counts.items())])
        for stage, counts in summary.stages.items()
    ]


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


def _card(one: ConstantSummary) -> _Card:
    sentence = ""
    if one.drift is not None:
        d = one.drift
        word = "Drifts with the serial number" if one.drifts else "No drift that is more than chance"
        unit = f" {one.unit}" if one.unit else ""
        sentence = f"{word}: {d.slope:.3g} ± {d.sigma:.2g}{unit} per number, over {d.count} rigs."
    return _Card(
        one.name,
        one.unit,
        tuple(_facts(one)),
        histogram_svg(one),
        drift_svg(one),
        sentence,
        one.drifts,
        tuple((name, number(value, one.spread.scale or None), f"{z:+.1f}") for name, value, z in one.out[:8]),
        max(0, one.standing_out - 8),
    )


def _row(one: ConstantSummary) -> Sequence[tuple[str, float | None]]:
    spread, drift = one.spread, one.drift

    def cell(value: float, text: str | None = None) -> tuple[str, float | None]:
        return (text or f"{value:.3g}", value) if math.isfinite(value) else ("", None)

    return [
        cell(spread.median, number(spread.median, spread.scale or None)),
        cell(spread.scale),
        cell(spread.between),
        cell(spread.own),
        cell(float(spread.count), str(spread.count)),
        cell(float(one.standing_out), str(one.standing_out)),
        cell(drift.slope if drift else math.nan),
        cell(drift.sigma if drift else math.nan),
    ]


# ----------------------------------------------------------------------
# The page of a sweep: the best and the worst points, and the measure over each parameter.

SWEEP_PAGE = "sweep.html"
_SWEEP_PAGE_WIDE, _SWEEP_PAGE_HIGH, _SWEEP_PAGE_LEFT, _SWEEP_PAGE_BELOW, _SWEEP_PAGE_TOP = (
    420.0,
    210.0,
    8.0,
    26.0,
    18.0,
)


def write_sweep_page(path: Path, spec: SweepSpec, summary: SweepSummary) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, sweep_page_text(spec, summary), A_PAGE)


def sweep_page_text(spec: SweepSpec, summary: SweepSummary) -> str:
    """The whole page."""
    base = spec.base
    what = f"{base.kind} {base.name}" + (f" on {base.other}" if base.other else "")
    tables = [
        (title, _heads(summary, points), [_sweep_page_row(point) for point in points])
        for title, points in (("Best points", summary.best), ("Worst points", summary.worst))
        if points
    ]
    return render(
        "sweep.html.j2",
        STYLE,
        SCRIPT,
        version=__version__,
        summary=summary,
        what=what,
        feedback=base.feedback,
        aim="the least is best" if spec.near is None else f"the nearest to {spec.near:g} is best",
        points=spec.points,
        draws=spec.count,
        tables=tables,
        clouds=[
            (name, cloud_svg(name, summary.measure, points)) for name, points in summary.clouds if points
        ],
    )


def _heads(summary: SweepSummary, points: tuple[Point, ...]) -> list[str]:
    others = [name for name in summary.measures if name != summary.measure]
    names = [name for name, _ in points[0].values]
    return ["point", *names, f"{summary.measure}, median", "worst draw", *others]


def _sweep_page_row(point: Point) -> list[tuple[str, Any]]:
    cells = [*(value for _, value in point.values), point.median, point.worst]
    cells += [value for _, value in point.measures[1:]]
    out: list[tuple[str, Any]] = [(f"#{point.number}", point.number)]
    for cell in cells:
        if isinstance(cell, float):
            out.append((f"{cell:.4g}", cell) if cell == cell else ("", None))
        else:
            out.append((str(cell), None))
    return out


def cloud_svg(name: str, measure: str, points: tuple[tuple[float, float], ...]) -> str:
    """The measure over one parameter."""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    x0, x1, y0, y1 = min(xs), max(xs), min(ys), max(ys)
    floor = _SWEEP_PAGE_HIGH - _SWEEP_PAGE_BELOW
    label = escape(f"{measure} over {name}")
    box = f"0 0 {_SWEEP_PAGE_WIDE:g} {_SWEEP_PAGE_HIGH:g}"
    out = [f'<svg class="plot" viewBox="{box}" role="img" aria-label="{label}">']
    for x, y in points:
        u = _SWEEP_PAGE_LEFT + (x - x0) / (x1 - x0 or 1.0) * (_SWEEP_PAGE_WIDE - 2 * _SWEEP_PAGE_LEFT)
        v = floor - (y - y0) / (y1 - y0 or 1.0) * (floor - _SWEEP_PAGE_TOP)
        out.append(f'<circle class="dot" cx="{u:.1f}" cy="{v:.1f}" r="2.4"/>')
    left, right = _SWEEP_PAGE_LEFT, _SWEEP_PAGE_WIDE - _SWEEP_PAGE_LEFT
    out.append(f'<line class="axis" x1="{left}" x2="{right}" y1="{floor}" y2="{floor}"/>')
    for x, y, text, anchor in (
        (_SWEEP_PAGE_LEFT, _SWEEP_PAGE_HIGH - 6, f"{x0:.4g}", "start"),
        (_SWEEP_PAGE_WIDE - _SWEEP_PAGE_LEFT, _SWEEP_PAGE_HIGH - 6, f"{x1:.4g}", "end"),
        (_SWEEP_PAGE_LEFT, 11.0, f"{y1:.4g}", "start"),
        (_SWEEP_PAGE_LEFT, floor - 3, f"{y0:.4g}", "start"),
    ):
        out.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>')
    return "".join([*out, "</svg>"])

"""The page of a fleet: one HTML file that needs no network, from its summary.

Whatever the number of rigs, the page holds so many bins, points and names and no more. Names and sentences
are escaped, and a policy in the page lets no script run but its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calib import __version__
from calib.files import write_atomically
from calib.fleet.borrowing import Borrowing
from calib.fleet.summary import ConstantSummary, FleetSummary
from calib.report.fleet_svg import drift_svg, histogram_svg
from calib.report.rendering import render
from calib.rigvalues import BLANK, SIGMA, digits

__all__ = ["PAGE", "SCRIPT", "STYLE", "fleet_page_text", "write_fleet_page"]

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


def write_fleet_page(path: Path, summary: FleetSummary, borrowing: Borrowing | None = None) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, fleet_page_text(summary, borrowing))


def fleet_page_text(summary: FleetSummary, borrowing: Borrowing | None = None) -> str:
    """The whole page."""
    told = sorted(summary.constants, key=_interest)
    answer, headline = _answer(summary)
    return render(
        "fleet.html.j2",
        STYLE,
        SCRIPT,
        version=__version__,
        summary=summary,
        borrowing=borrowing,
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
        ("median", f"{digits(spread.median, spread.scale or None)}{unit}"),
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
        tuple((name, digits(value, one.spread.scale or None), f"{z:+.1f}") for name, value, z in one.out[:8]),
        max(0, one.standing_out - 8),
    )


def _row(one: ConstantSummary) -> Sequence[tuple[str, float | None]]:
    spread, drift = one.spread, one.drift

    def cell(value: float, text: str | None = None) -> tuple[str, float | None]:
        return (text or f"{value:.3g}", value) if math.isfinite(value) else ("", None)

    return [
        cell(spread.median, digits(spread.median, spread.scale or None)),
        cell(spread.scale),
        cell(spread.between),
        cell(spread.own),
        cell(float(spread.count), str(spread.count)),
        cell(float(one.standing_out), str(one.standing_out)),
        cell(drift.slope if drift else math.nan),
        cell(drift.sigma if drift else math.nan),
    ]

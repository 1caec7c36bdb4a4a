"""The page of a sweep: the best and the worst points, and the measure over each parameter."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from calib import __version__
from calib.files import write_atomically
from calib.fleet.sweeping import Point, SweepSummary
from calib.fleet.sweepspec import SweepSpec
from calib.report.fleet_page import SCRIPT, STYLE
from calib.report.rendering import render

__all__ = ["PAGE", "cloud_svg", "sweep_page_text", "write_sweep_page"]

PAGE = "sweep.html"
_WIDE, _HIGH, _LEFT, _BELOW, _TOP = 420.0, 210.0, 8.0, 26.0, 18.0


def write_sweep_page(path: Path, spec: SweepSpec, summary: SweepSummary) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, sweep_page_text(spec, summary))


def sweep_page_text(spec: SweepSpec, summary: SweepSummary) -> str:
    """The whole page."""
    base = spec.base
    what = f"{base.kind} {base.name}" + (f" on {base.other}" if base.other else "")
    tables = [
        (title, _heads(summary, points), [_row(point) for point in points])
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


def _row(point: Point) -> list[tuple[str, Any]]:
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
    floor = _HIGH - _BELOW
    label = escape(f"{measure} over {name}")
    out = [f'<svg class="plot" viewBox="0 0 {_WIDE:g} {_HIGH:g}" role="img" aria-label="{label}">']
    for x, y in points:
        u = _LEFT + (x - x0) / (x1 - x0 or 1.0) * (_WIDE - 2 * _LEFT)
        v = floor - (y - y0) / (y1 - y0 or 1.0) * (floor - _TOP)
        out.append(f'<circle class="dot" cx="{u:.1f}" cy="{v:.1f}" r="2.4"/>')
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDE - _LEFT}" y1="{floor}" y2="{floor}"/>')
    for x, y, text, anchor in (
        (_LEFT, _HIGH - 6, f"{x0:.4g}", "start"),
        (_WIDE - _LEFT, _HIGH - 6, f"{x1:.4g}", "end"),
        (_LEFT, 11.0, f"{y1:.4g}", "start"),
        (_LEFT, floor - 3, f"{y0:.4g}", "start"),
    ):
        out.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>')
    return "".join([*out, "</svg>"])

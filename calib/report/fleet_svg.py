"""Small pictures of a fleet as SVG text: a constant's histogram, and its values over the serial numbers.

Only numbers go into them; colours are those of the page, so that they follow its theme.
"""

from __future__ import annotations

from html import escape

from calib.fleet.summary import ConstantSummary
from calib.rigvalues import digits

__all__ = ["drift_svg", "histogram_svg"]

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
    out.append(_text(_LEFT, digits(one.low, one.spread.scale or None), "start"))
    out.append(_text(_WIDE - _LEFT, digits(one.high, one.spread.scale or None), "end"))
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

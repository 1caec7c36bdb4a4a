"""Small pictures of a fleet: well-formed, in their frame, and with names that are only text."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from calib.fleet.drift import drift_of
from calib.fleet.spread import spread_of
from calib.fleet.summary import ConstantSummary, _histogram
from calib.report.fleet_svg import drift_svg, histogram_svg


def _constant(x: np.ndarray, numbers: np.ndarray | None = None, name: str = "a.b_px") -> ConstantSummary:
    sigma = np.full(len(x), 0.1)
    spread = spread_of(x, sigma)
    drift = None if numbers is None else drift_of(numbers, x, sigma, spread)
    points = () if numbers is None else tuple(zip(numbers.tolist(), x.tolist(), strict=True))
    return ConstantSummary(name, "px", spread, *_histogram(x, spread), 4.0, 0, (), drift, True, points)


def test_bars_stand_for_all_rigs_within() -> None:
    x = np.append(np.random.default_rng(0).standard_normal(200), [50.0, -60.0, 70.0])
    one = _constant(x, name='"><script>')
    root = ElementTree.fromstring(histogram_svg(one))
    bars = [e for e in root if e.get("class") == "bar"]
    heights = [float(e.get("height", "0")) for e in bars]
    assert sum(one.counts) == 200 and (one.below, one.above) == (1, 2)
    assert len(bars) == sum(count > 0 for count in one.counts)
    assert max(heights) == pytest.approx(118.0, abs=0.1)
    assert [e.text for e in root if e.get("class") == "far"] == ["\u2190 1", "2 \u2192"]


def test_points_stay_in_the_frame() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(60.0)
    x = 5.0 + 0.3 * t + rng.standard_normal(60)
    x[7] = 1e6
    root = ElementTree.fromstring(drift_svg(_constant(x, t)))
    dots = [e for e in root if (e.get("class") or "").startswith("dot")]
    assert len(dots) == 60 and sum(e.get("class") == "dot far" for e in dots) == 1
    for e in dots:
        assert 0.0 <= float(e.get("cx", "-1")) <= 420.0 and 0.0 <= float(e.get("cy", "-1")) <= 150.0
    (line,) = [e for e in root if e.get("class") == "drifting"]
    assert float(line.get("y2", "0")) < float(line.get("y1", "0"))


def test_one_value_and_none() -> None:
    ElementTree.fromstring(histogram_svg(_constant(np.array([3.0]))))
    ElementTree.fromstring(histogram_svg(_constant(np.array([np.nan]))))
    assert drift_svg(_constant(np.array([3.0, 4.0]))) == ""

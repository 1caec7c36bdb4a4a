"""The page of a fleet: whole in itself, bounded, and harmless whatever rigs are called."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chromium import browser_or_skip

from calib.runner.fleet import Borrowing, FleetSummary, summarise, write_outcomes
from calib.runner.task import Outcome
from calib.show.fleet import PAGE, fleet_page_text, write_fleet_page

pytest.importorskip("pyarrow")

EVIL = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>"


class _Outline(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def _summary(path: Path, count: int, constants: int = 6) -> FleetSummary:
    rng = np.random.default_rng(3)
    known = {}
    for k in range(1, count + 1):
        values = {f"camera.c{i}_px": (100.0 + rng.standard_normal(), 0.1) for i in range(constants)}
        values["camera.fx_px"] = (273.0 + 0.05 * k + 0.2 * rng.standard_normal() + 40.0 * (k == 7), 0.1)
        bad = k == 3
        known[f"rig{k}"] = Outcome(
            f"rig{k}", EVIL if k == 7 else f"S{k}", "/x", "failed" if bad else "ok", 3 if bad else 0,
            EVIL if bad else "", stages={"intrinsics": "failed" if bad else "ok"},
            values={} if bad else values, seconds=1.0, peak_MB=90.0,
        )  # fmt: skip
    write_outcomes(path, list(known), known.get)
    return summarise(path)[0]


def test_whole_harmless_and_told(tmp_path: Path) -> None:
    found = _summary(tmp_path / "x.parquet", 60)
    text = fleet_page_text(found, Borrowing(3, {"fx_px": 0.5}, (("rig1", EVIL),), 1, 40))
    outline = _Outline()
    outline.feed(text)
    for tag, attributes in outline.tags:
        for name in ("src", "href", "action", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith("#"), (tag, target)
        assert not [name for name in attributes if name.startswith("on")], tag
    assert sum(tag == "script" for tag, _ in outline.tags) == 1
    assert not [tag for tag, _ in outline.tags if tag == "img"]
    assert not re.search(r"https?://", text)
    assert "1 of 60 rigs has no result" in text and "camera.fx_px drifts" in text
    assert "3 of 4 rigs borrowed" in text
    # The worst first: the one without a result, then the one that stands out.
    assert text.index("rig3</td>") < text.index("rig7</td>")
    assert fleet_page_text(found) == fleet_page_text(_summary(tmp_path / "y.parquet", 60))


def test_a_page_does_not_grow_with_the_fleet(tmp_path: Path) -> None:
    few = len(fleet_page_text(_summary(tmp_path / "a.parquet", 300, 2)))
    many = len(fleet_page_text(_summary(tmp_path / "b.parquet", 3000, 2)))
    assert many < 1.1 * few < 400_000


def test_in_a_browser(tmp_path: Path) -> None:
    browser = browser_or_skip(tmp_path / "profile")
    try:
        write_fleet_page(tmp_path / PAGE, _summary(tmp_path / "x.parquet", 60))
        browser.open(tmp_path / PAGE, 1100)
        assert browser.run("document.title") == "Fleet of 60 rigs"
        assert browser.run("document.querySelectorAll('.card svg').length") >= 7
        browser.run("document.querySelectorAll('#table th button')[2].click()")
        sort = "document.querySelectorAll('#table th')[2].getAttribute('aria-sort')"
        assert browser.run(sort) == "ascending"
        typed = "(() => { const e = document.getElementById('filter'); e.value = 'fx_px';"
        browser.run(f"{typed} e.dispatchEvent(new Event('input')); }})()")
        assert browser.run("document.querySelectorAll('.card:not([hidden])').length") == 1
    finally:
        browser.close()

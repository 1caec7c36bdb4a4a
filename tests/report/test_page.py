"""The page: whole and small in itself, harmless whatever the names, and usable in a real browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser, browser_or_skip
from pages import EVIL, finished_run
from PIL import Image

from calib.core.errors import BadInputError
from calib.runner.cache import Result
from calib.show.page import _AIM_BYTES, MOST_BYTES, _Budget, _chosen, page_text, write_page


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = finished_run(tmp_path_factory.mktemp("page"))
    write_page(rig)
    return rig


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = browser_or_skip(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


_LENGTH = """(() => {
  const line = document.querySelector('#view-picture line');
  const along = ['x', 'y'].map((axis) => line[axis + '2'].baseVal.value - line[axis + '1'].baseVal.value);
  return Math.hypot(...along);
})()"""
"""How long the first residual is drawn."""


def _typed(name: str, value: str) -> str:
    """Script that gives an input a value as a person would."""
    told = f"e.value = '{value}'; e.dispatchEvent(new Event('input'));"
    return f"(() => {{ const e = document.getElementById('{name}'); {told} }})()"


class _Outline(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))


def test_nothing_leads_out_of_the_page_and_nothing_breaks_in(rig: Path) -> None:
    text = page_text(rig)
    outline = _Outline()
    outline.feed(text)
    for tag, attributes in outline.tags:
        for name in ("src", "href", "action", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith(("data:image/", "#")) or target == "", (tag, target)
        assert not [name for name in attributes if name.startswith("on")], tag
    assert sum(tag == "script" for tag, _ in outline.tags) == 2
    assert "owned'</script>" not in text
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text)
    assert text.count("49.png") == 0


def test_same_run_same_bytes_and_no_place(rig: Path) -> None:
    text = page_text(rig)
    assert text == page_text(rig)
    assert str(rig.parent) not in text and "/tmp" not in text
    assert len(text.encode()) < MOST_BYTES


def test_a_rig_without_a_run_gives_a_page_of_constants(rig: Path, tmp_path: Path) -> None:
    alone = tmp_path / "rig.yaml"
    alone.write_bytes(rig.read_bytes())
    text = page_text(alone)
    assert "fx_px" in text and "273.410" in text
    assert 'class="figure"' not in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("actuator: {sigma: x}\npump: {sigma: {a: 1.0}}\n", "actuator.sigma is 'x'"),
        ("actuator: {verdict: poor, reasons: 5}\n", "actuator.reasons is 5"),
        ("pump: [1]\n", "pump is .* expected keys with values"),
    ],
)
def test_sections_that_mean_nothing_are_refused_by_their_key(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(BadInputError, match=says):
        page_text(tmp_path / "rig.yaml")


def test_too_many_figures_are_named_instead(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib.show.page.MOST_BYTES", 460_000)
    text = page_text(rig)
    assert len(text.encode()) < 460_000
    assert "Left out to keep this page small" in text


@pytest.mark.slow
@pytest.mark.parametrize("width", [1400, 400])
def test_in_a_browser_all_is_seen_and_nothing_overflows(rig: Path, browser: Browser, width: int) -> None:
    browser.open(rig.with_name("report.html"), width)
    assert browser.run("document.title") == "Calibration: no"
    assert browser.run("document.documentElement.scrollWidth") <= width
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert browser.run("document.documentElement.scrollWidth") <= width
    wide = browser.run(
        "[...document.querySelectorAll('main *, nav *')].filter((e) => !e.closest('.scroll, .unseen') &&"
        f" e.getBoundingClientRect().right > {width} + 1).map((e) => e.outerHTML.slice(0, 80))"
    )
    assert wide == []
    seen = browser.run(
        "[...document.querySelectorAll('main img')].map((e) => [e.complete, e.naturalWidth, e.offsetWidth])"
    )
    assert len(seen) == 3 + 4
    assert all(whole and natural > 0 and shown > 60 for whole, natural, shown in seen)
    assert browser.errors == []


@pytest.mark.slow
def test_clicks_and_keys(rig: Path, browser: Browser) -> None:
    browser.open(rig.with_name("report.html"), 1400)
    browser.click("button.view")
    assert browser.run("document.getElementById('view-dialog').open")
    assert browser.run("document.querySelectorAll('#view-picture circle').length") == 4
    first = browser.run("document.getElementById('view-title').textContent")
    browser.key("ArrowRight", 39)
    assert browser.run("document.getElementById('view-title').textContent") != first
    browser.run(_typed("gain", "0"))
    assert browser.run(_LENGTH) < 0.1
    browser.key("Escape", 27)
    assert not browser.run("document.getElementById('view-dialog').open")
    browser.click("button.figure")
    assert (
        browser.run("document.getElementById('figure-title').textContent")
        == "Reprojection errors of each view"
    )
    browser.click("#figure-dialog .close")
    assert not browser.run("document.getElementById('figure-dialog').open")
    assert browser.errors == []


@pytest.mark.slow
def test_tables_sort_and_the_filter_filters(rig: Path, browser: Browser) -> None:
    browser.open(rig.with_name("report.html"), 1400)
    head = "#constants-table th:nth-child(3) button"
    cells = "[...document.querySelectorAll('#constants-table td:nth-child(3)')]"
    values = f"{cells}.map((e) => Number(e.dataset.value))"
    browser.click(head)
    rising = browser.run(values)
    assert rising == sorted(rising) and len(rising) > 10
    browser.click(head)
    assert browser.run(values) == sorted(rising, reverse=True)
    assert browser.run("document.querySelector('#constants-table th:nth-child(3)').ariaSort") == "descending"
    browser.click("#constants-table th:nth-child(4) button")
    sigma = browser.run(
        "[...document.querySelectorAll('#constants-table td:nth-child(4)')].map((e) => e.dataset.value)"
    )
    known = [float(value) for value in sigma if value]
    assert known == sorted(known) and sigma[len(known) :] == [""] * (len(sigma) - len(known))
    browser.run(_typed("filter", "camera k1"))
    left = browser.run(
        "[...document.querySelectorAll('#constants-table tbody tr')].filter((e) => !e.hidden).length"
    )
    assert left == 1
    assert browser.errors == []


@pytest.mark.slow
def test_dark_light_print_and_keyboard(rig: Path, browser: Browser) -> None:
    browser.media(prefers_color_scheme="dark")
    browser.open(rig.with_name("report.html"), 1400)
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = browser.run(ground)
    browser.click("#theme")
    assert browser.run(ground) != dark
    browser.media(prefers_color_scheme="light")
    browser.open(rig.with_name("report.html"), 1400)
    assert browser.run(ground) != dark
    browser.key("Tab", 9)
    assert browser.run("document.activeElement.className") == "skip"
    assert browser.pdf().startswith(b"%PDF")
    named = [
        node for node in browser.accessible() if node["role"]["value"] in ("button", "image", "link", "img")
    ]
    nameless = [n for n in named if not n.get("ignored") and not n.get("name", {}).get("value")]
    # The thumbnails stand beside their names, within buttons that have one.
    assert nameless == []
    assert EVIL not in browser.run("document.title")
    assert browser.errors == []


def _drawn(root: Path, logs: int) -> list[Result | None]:
    """Results of as many logs, each with figures of about 40 kB."""
    made: list[Result | None] = []
    for log in range(logs):
        folder = root / f"replay-{log}"
        (folder / "figures").mkdir(parents=True)
        files = {}
        for k, part in enumerate(("errors", "innovations", "states")):
            noise = np.random.default_rng(3 * log + k).integers(0, 255, (200, 900), dtype=np.uint8)
            image = Image.fromarray(np.where(np.arange(900) % 5 == 0, noise, 255).astype(np.uint8))
            name = f"figures/replay_{log}_{part}.png"
            image.quantize(128).save(folder / name)
            files[name] = ""
        made.append(Result(folder, "", 0, files))
    return made


@pytest.mark.parametrize(("logs", "narrow"), [(4, False), (40, False), (130, True)])
def test_of_many_logs_the_states_come_first_and_the_page_stays_small(
    tmp_path: Path, logs: int, narrow: bool
) -> None:
    results = _drawn(tmp_path, logs)
    budget = _Budget(MOST_BYTES - 400_000)
    shown, width_px = _chosen(results, tmp_path / "figures", budget)
    stems = [path.stem for path in shown]
    assert budget.left >= 0
    assert sum(stem.endswith("states") for stem in stems) == logs
    assert bool(width_px) == narrow
    if logs == 4:
        assert len(shown) == 12
    else:
        assert len(shown) < 3 * logs
        assert narrow or budget.left >= MOST_BYTES - _AIM_BYTES

"""Pages of a run, a fleet and a sweep: whole, small, harmless whatever the names, usable in a browser."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pytest
from chromium import Browser, browser_or_skip
from markupsafe import escape
from pages import EVIL, finished_run

from calib.core.errors import BadInputError
from calib.runner.cache import Result
from calib.runner.decision import decide
from calib.runner.fleet import FleetSummary, RigSpec, summarise, table_of
from calib.runner.outcomes import Outcome
from calib.show import page
from calib.show.charts import library
from calib.show.fleet import PAGE, fleet_page_text, write_fleet_page
from calib.show.page import (
    MOST_BYTES,
    _Budget,
    _chosen,
    _resource,
    page_text,
    render,
    write_page,
)


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


_TO_EACH = (
    "document.querySelectorAll('details').forEach((one) => { one.open = true; });"
    "(async () => { for (const one of document.querySelectorAll('.chart')) {"
    "one.scrollIntoView({behavior: 'instant'}); await new Promise((done) => setTimeout(done, 700)); } })()"
)
"""Opens all and looks at each chart, which is drawn when it is seen."""


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
    # Views, the library, what is done with it, and four charts.
    assert sum(tag == "script" for tag, _ in outline.tags) == 3 + 4
    assert "owned'</script>" not in text
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text.replace(library(), ""))
    assert text.count("49.png") == 0


def test_views_that_have_no_room_are_counted(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no room" not in page_text(rig)
    largest = max(len(one["image"]) for one in page._views(rig.parent / ".calib", page._Budget(10**6))[0])
    monkeypatch.setattr(page, "_VIEWS_BYTES", largest)
    assert "2 more have no room on this page" in page_text(rig)


def test_same_run_same_bytes_and_no_place(rig: Path) -> None:
    text = page_text(rig)
    assert text == page_text(rig)
    assert str(rig.parent) not in text and "/tmp" not in text
    assert len(text.replace(library(), "").encode()) < MOST_BYTES


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


@pytest.mark.slow
@pytest.mark.parametrize("width", [1400, 400])
def test_in_a_browser_all_is_seen_and_nothing_overflows(rig: Path, browser: Browser, width: int) -> None:
    browser.open(rig.with_name("report.html"), width)
    assert browser.run("document.title") == "Calibration: no"
    assert browser.run("document.documentElement.scrollWidth") <= width
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert browser.run("document.documentElement.scrollWidth") <= width
    wide = browser.run(
        "[...document.querySelectorAll('main *, nav *')].filter((e) =>"
        f" !e.closest('.scroll, .unseen, .canvas svg') && e.getBoundingClientRect().right > {width} + 1)"
        ".map((e) => e.outerHTML.slice(0, 80))"
    )
    assert wide == []
    seen = browser.run(
        "[...document.querySelectorAll('main img')].map((e) => [e.complete, e.naturalWidth, e.offsetWidth])"
    )
    assert len(seen) == 3
    assert all(whole and natural > 0 and shown > 60 for whole, natural, shown in seen)
    browser.run(_TO_EACH)
    assert browser.run("document.querySelectorAll('.js-plotly-plot .main-svg').length") >= 4 * 2
    sizes = browser.run("[...document.querySelectorAll('.canvas')].map((e) => e.scrollWidth - e.clientWidth)")
    assert sizes == [0] * 4
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
    assert browser.errors == []


@pytest.mark.slow
def test_charts_show_what_was_given_and_zoom_together(rig: Path, browser: Browser) -> None:
    browser.open(rig.with_name("report.html"), 1400)
    browser.run(_TO_EACH)
    plot = "document.querySelector('.js-plotly-plot')"
    line = f"{plot}.data.find((trace) => trace.mode === 'lines' && !trace.fill)"
    x, y = browser.run(f"{line}.x"), browser.run(f"{line}.y")
    gap = [b for b in y if b is None]
    assert gap and len(x) == len(y) <= 520
    off = [b - np.sin(a) for a, b in zip(x, y, strict=True) if b is not None]
    assert np.abs(off).max() < 1e-3
    browser.run(f"Plotly.relayout({plot}, {{'xaxis.range': [2, 3]}}).then(() => 1)")
    # The second panel lies beside the first, the third one below it.
    assert browser.run(f"{plot}.layout.xaxis.matches") == "x3"
    titles = browser.run(
        "[...document.querySelectorAll('.chart figcaption strong')].map((e) => e.textContent)"
    )
    assert titles == ["Errors", EVIL, "States of one", "States of two"]
    said = browser.run(
        "[...document.querySelectorAll('.js-plotly-plot text')].map((e) => e.textContent).join()"
    )
    assert EVIL in said and "nothing was seen" in said
    assert (
        browser.run("document.querySelectorAll('.js-plotly-plot img, .js-plotly-plot a[href]').length") == 0
    )
    assert browser.errors == []


@pytest.mark.slow
def test_tables_sort_and_the_filter_filters(rig: Path, browser: Browser) -> None:
    browser.open(rig.with_name("report.html"), 1400)
    head = "#constants-table th:nth-child(3) button"
    cells = "[...document.querySelectorAll('#constants-table td:nth-child(3)')]"
    values = f"{cells}.map((e) => Number.parseFloat(e.textContent))"
    browser.click(head)
    rising = browser.run(values)
    assert rising == sorted(rising) and len(rising) > 10
    browser.click(head)
    assert browser.run(values) == sorted(rising, reverse=True)
    assert browser.run("document.querySelector('#constants-table th:nth-child(3)').ariaSort") == "descending"
    browser.click("#constants-table th:nth-child(4) button")
    sigma = browser.run(
        "[...document.querySelectorAll('#constants-table td:nth-child(4)')].map((e) => e.textContent)"
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
    browser.run(_TO_EACH)
    # Nothing that the Tab key reaches is hidden from a screen reader.
    tools = "document.querySelectorAll('.modebar button').length"
    hidden = "document.querySelectorAll('[aria-hidden=true] button, [role=img] button').length"
    assert browser.run(tools) >= 6 and browser.run(hidden) == 0
    named = [
        node for node in browser.accessible() if node["role"]["value"] in ("button", "image", "link", "img")
    ]
    nameless = [n for n in named if not n.get("ignored") and not n.get("name", {}).get("value")]
    # The thumbnails stand beside their names, within buttons that have one.
    assert nameless == []
    assert EVIL not in browser.run("document.title")
    assert browser.errors == []


def _drawn(root: Path, logs: int) -> list[Result | None]:
    """Results of as many logs, each with charts of about 20 kB."""
    made: list[Result | None] = []
    for log in range(logs):
        folder = root / f"replay-{log}"
        (folder / "figures").mkdir(parents=True)
        files = {}
        for k, part in enumerate(("errors", "innovations", "states")):
            name = f"figures/replay_{log}_{part}.json"
            told = {"title": f"{part} {log}", "note": "", "verdict": "ok", "arrays": [str(k) * 20_000]}
            (folder / name).write_text(json.dumps(told))
            files[name] = ""
        made.append(Result(folder, "", 0, files))
    return made


def test_the_page_has_the_words_of_each_stage_and_of_several_logs_one_table(tmp_path: Path) -> None:
    text = page_text(finished_run(tmp_path))
    assert EVIL not in text and text.count(str(escape(EVIL))) > 6
    # A section tells its own reasons; a stage without one has them among its words.
    assert "said elsewhere" not in text and "one is weak" in text and "two is weak" in text
    whole = text[text.index("States over all logs") :]
    one_table = whole[: whole.index("</table>")]
    rows = re.findall(r'<tr><td(?: class="long")?>(.+?)</td><td>camera</td>', one_table)
    assert rows == ["one.csv", str(escape(EVIL))]
    assert '<td class="number">0.2 ± 0.1</td>' in text


@pytest.mark.parametrize("logs", [4, 40, 130])
def test_of_many_logs_the_states_come_first_and_the_page_stays_small(tmp_path: Path, logs: int) -> None:
    results = _drawn(tmp_path, logs)
    budget = _Budget(MOST_BYTES - 400_000)
    shown = [path.stem for path in _chosen(results, budget)]
    assert budget.left >= 0
    states = sum(stem.endswith("states") for stem in shown)
    assert states == min(logs, (MOST_BYTES - 400_000) // 20_100)
    assert len(shown) == 12 if logs == 4 else len(shown) < 3 * logs


def _job(stage: str, status: str = "ok", **more: Any) -> dict[str, Any]:
    writes = {"intrinsics": ["camera"], "extrinsics": ["plane"]}.get(stage, [])
    flashed = stage in ("intrinsics", "extrinsics", "imu-static")
    reason = "" if status == "ok" else "for some reason"
    return {
        "name": stage, "stage": stage, "title": stage.title(), "log": None, "writes": writes,
        "flashed": flashed, "status": status, "reason": reason, "inputs": [], **more,
    }  # fmt: skip


def _whole(**statuses: str) -> dict[str, Any]:
    stages = ("intrinsics", "extrinsics", "imu-static", "replay", "firmware")
    return {"simulated": False, "jobs": [_job(s, statuses.get(s.replace("-", "_"), "ok")) for s in stages]}


SECTIONS = {"camera": {"verdict": "ok"}, "plane": {"verdict": "ok"}}


@pytest.mark.parametrize(
    ("statuses", "answer"),
    [
        ({}, "yes"),
        ({"replay": "poor"}, "with care"),
        ({"imu_static": "poor"}, "not yet"),
        ({"imu_static": "unidentifiable"}, "no"),
        ({"firmware": "poor"}, "not yet"),
        ({"extrinsics": "blocked"}, "no"),
        ({"firmware": "skipped"}, "no"),
    ],
)
def test_answers(statuses: dict[str, str], answer: str) -> None:
    assert decide(_whole(**statuses), SECTIONS).answer == answer


def test_what_the_data_do_not_support_is_said_of_what_failed_behind_it() -> None:
    found = decide(_whole(intrinsics="inconsistent", extrinsics="failed"), SECTIONS)
    assert found.headline == "“Extrinsics” failed; the data do not support “Intrinsics”"


def test_without_a_plane_logs_cannot_be_flashed_and_pictures_alone_can() -> None:
    told = _whole(extrinsics="skipped")
    camera = {"camera": {"verdict": "ok"}}
    logged = decide(told | {"logs": ["swing.csv"]}, camera)
    assert (logged.answer, logged.exit_code) == ("not yet", 1)
    pictures = decide(told | {"logs": []}, camera)
    assert (pictures.answer, pictures.exit_code) == ("yes", 0)
    both = decide(_whole(control="skipped") | {"logs": []}, camera | {"plane": {"verdict": "ok"}})
    assert (both.answer, "only with CALIB_I_KNOW" in both.headline) == ("yes", True)
    states = decide(_whole(control="skipped") | {"logs": ["swing.csv"]}, SECTIONS)
    assert (states.answer, "only with CALIB_I_KNOW" in states.headline) == ("yes", True)
    whole = decide(_whole() | {"logs": ["swing.csv"]}, {**SECTIONS, "controller": {"verdict": "ok"}})
    assert (whole.answer, "CALIB_I_KNOW" in whole.headline) == ("yes", False)


def test_what_is_lacking_comes_before_what_is_poor_for_want_of_it() -> None:
    told = _whole(imu_static="poor", firmware="poor") | {"logs": ["swing.csv"]}
    told["jobs"][0] |= {"status": "skipped", "reason": "no pictures in images/"}
    told["jobs"][1] |= {"status": "skipped", "reason": "needs camera: no pictures in images/"}
    found = decide(told, {})
    assert found.headline == "“Intrinsics” and “Extrinsics” are not known: no pictures in images/"
    assert (found.answer, found.lacking) == ("not yet", found.headline)
    assert decide(told, SECTIONS).headline == "“Imu-Static” is too weak"
    # Of pictures alone a plane is not wanted, and a weak camera is weak.
    told = _whole(intrinsics="poor", extrinsics="skipped") | {"logs": []}
    assert decide(told, {"camera": {"verdict": "poor"}}).headline == "“Intrinsics” is too weak"


def test_weak_points_are_grouped_by_reason() -> None:
    told = _whole()
    told["jobs"] += [_job("replay", "poor", log=f"{k}.csv", reason="the IMU is silent") for k in range(6)]
    (sentence,) = decide(told, SECTIONS).weak
    assert sentence == "Replay (0.csv, 1.csv, 2.csv, 3.csv and 2 more): the IMU is silent"
    told["jobs"] += [_job(one, "failed", reason="swing.csv: is in g") for one in ("align", "identify")]
    assert decide(told, SECTIONS).weak[1] == "Align, Identify: swing.csv: is in g"


def test_what_means_nothing_is_recorded_again_first() -> None:
    for word, at in (("unidentifiable", 0), ("ok", -1)):
        told = _whole(intrinsics=word, extrinsics="skipped")
        record = decide(told, {"camera": {"verdict": word, "advice": ["Tilt the board."]}}).record
        assert len(record) == 2 and record[at] == "Intrinsics: Tilt the board."


def test_what_is_known_or_waits_for_another_stage_is_not_asked_for() -> None:
    told = _whole(intrinsics="skipped", extrinsics="skipped", imu_static="skipped")
    told["jobs"][2]["inputs"] = ["logs/static1.csv"]
    (sentence,) = decide(told, {"camera": {"verdict": "ok"}}).record
    assert sentence.startswith("Extrinsics: a picture of the board")


def test_the_policy_is_that_of_the_script() -> None:
    values = {
        "version": "1", "summary": {}, "what": "<x>", "feedback": "", "aim": "", "points": 0, "draws": 0,
        "tables": [], "clouds": [], "measure": "m",
    }  # fmt: skip
    values["summary"] = {"cases": 1, "failed": 0, "why": "", "measure": "m", "as_before": 0}
    text = render("sweep.html.j2", ("page.css",), ("common.js",), False, **values)
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert script == _resource("common.js")
    digest = base64.b64encode(sha256(script.encode()).digest()).decode()
    assert f"sha256-{digest}" in text and "&lt;x&gt;" in text and "<x>" not in text
    both = render("sweep.html.j2", ("page.css",), ("common.js", "page.js"), False, **values)
    assert _resource("common.js") + _resource("page.js") in both and f"sha256-{digest}" not in both
    # Half of a character, as a file's name may hold.
    assert "\\udc80" in render("sweep.html.j2", (), (), False, **{**values, "what": "\udc80"})
    with pytest.raises(jinja2.UndefinedError):
        render("sweep.html.j2", (), (), False)


EVIL_FLEET = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>"


def _summary(count: int, constants: int = 6) -> FleetSummary:
    rng = np.random.default_rng(3)
    known = []
    for k in range(1, count + 1):
        values = {f"camera.c{i}_px": (100.0 + rng.standard_normal(), 0.1) for i in range(constants)}
        values["camera.fx_px"] = (273.0 + 0.05 * k + 0.2 * rng.standard_normal() + 40.0 * (k == 7), 0.1)
        bad = k == 3
        outcome = Outcome(
            name=f"rig{k}",
            status="failed" if bad else "ok",
            code=3 if bad else 0,
            sentence=EVIL_FLEET if bad else "",
            stages={"intrinsics": "failed" if bad else "ok"},
            values={} if bad else values,
        )
        known.append((RigSpec(f"rig{k}", "/x", EVIL_FLEET if k == 7 else f"S{k}"), outcome))
    return summarise(table_of(known))[0]


def test_whole_harmless_and_told() -> None:
    found = _summary(60)
    text = fleet_page_text(found)
    outline = _Outline()
    outline.feed(text)
    for tag, attributes in outline.tags:
        for name in ("src", "href", "action", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith("#"), (tag, target)
        assert not [name for name in attributes if name.startswith("on")], tag
    # A chart of each constant, the library, and what is done with it.
    assert sum(tag == "script" for tag, _ in outline.tags) == 7 + 2
    assert not [tag for tag, _ in outline.tags if tag == "img"]
    assert not re.search(r"https?://", text.replace(library(), ""))
    assert "1 of 60 rigs has no result" in text and "camera fx drifts" in text
    # The worst first: the one without a result, then the one that stands out.
    assert text.index("rig3</td>") < text.index("rig7</td>")
    assert fleet_page_text(found) == fleet_page_text(_summary(60))


def test_a_fleet_of_one_rig() -> None:
    text = fleet_page_text(_summary(1, 1))
    assert "Fleet of 1 rig<" in text and "2 more constants are in the table only" in text
    assert "<td>Camera</td>" in text and "Simulated." not in text
    rigs = [(RigSpec(f"rig{k}", "/x"), Outcome(name=f"rig{k}", simulated=k > 0)) for k in range(3)]
    assert "2 of 3 rigs are simulated" in fleet_page_text(summarise(table_of(rigs))[0])
    assert "1 rigs" not in text.replace(library(), "")


def test_a_page_does_not_grow_with_the_fleet() -> None:
    few, many = (len(fleet_page_text(_summary(rigs, 2)).replace(library(), "")) for rigs in (300, 3000))
    assert many < 1.1 * few < 400_000


def test_in_a_browser(tmp_path: Path) -> None:
    browser = browser_or_skip(tmp_path / "profile")
    try:
        write_fleet_page(tmp_path / PAGE, _summary(60))
        browser.open(tmp_path / PAGE, 1100)
        assert browser.run("document.title") == "Fleet of 60 rigs"
        browser.run(_TO_EACH)
        assert browser.run("document.querySelectorAll('.card .js-plotly-plot .main-svg').length") >= 7
        browser.size(390)
        (*_, why) = browser.run(
            "[...document.querySelectorAll('.looks td')].map(e => e.getBoundingClientRect().right)"
        )
        assert 300 < why <= 390
        browser.size(1100)
        browser.run("document.querySelectorAll('#table th button')[2].click()")
        sort = "document.querySelectorAll('#table th')[2].getAttribute('aria-sort')"
        assert browser.run(sort) == "ascending"
        typed = "(() => { const e = document.getElementById('filter'); e.value = 'fx drifts';"
        browser.run(f"{typed} e.dispatchEvent(new Event('input')); }})()")
        assert browser.run("document.querySelectorAll('.card:not([hidden])').length") == 1
    finally:
        browser.close()

"""README and manual: examples run, commands and links exist, and `calib docs` shows the pages offline."""

from __future__ import annotations

import json
import math
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import browser_or_skip
from goldens.goldens import kernels
from reference_pages import pages as generated_pages
from reference_pages import verbs
from typer.main import get_command

import calib
from calib.cli.app import command_line
from calib.cli.docs import MANUAL, docs, manual, page_of, slug, write_manual
from calib.cli.simulate import simulate
from calib.core.arrays import points_of
from calib.core.bounded_yaml import load
from calib.core.errors import DISTRIBUTION, SomeFailedError, UsageError, pip_install
from calib.core.rig import KINDS
from calib.io.columns import COLUMNS, STATES
from calib.stages import expanded
from calib.twin.scenarios import SCENARIOS

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
WITH_FILES = {"tour.md"}
"""Pages whose Python needs files of its own and has a test of its own."""

FENCE = re.compile(r"^(?P<indent> *)```(?P<kind>\w*)\n(?P<text>.*?)^ *```$", re.S | re.M)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
SHELL = 'calib() { "$PYTHON" -m calib "$@"; }; '


def documents() -> list[Path]:
    return [README, *sorted(MANUAL.rglob("*.md"))]


def blocks(text: str, kind: str) -> Iterator[tuple[int, str]]:
    """Fenced blocks of a kind, with the number of the line before their first."""
    for match in FENCE.finditer(text):
        if match["kind"] == kind:
            yield text.count("\n", 0, match.start("text")), match["text"]


def test_yaml_of_the_manual_is_yaml() -> None:
    found = [text for path in documents() for _, text in blocks(path.read_text(), "yaml")]
    assert len(found) > 5
    for text in found:
        assert isinstance(load(text), dict), text


def without_blocks(text: str) -> str:
    return FENCE.sub("", text)


def python_pages() -> list[Path]:
    return [
        path
        for path in documents()
        if path.name not in WITH_FILES and any(blocks(path.read_text(encoding="utf-8"), "python"))
    ]


@pytest.mark.parametrize("path", python_pages(), ids=lambda path: path.stem)
def test_python_blocks_run_and_leave_nothing(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(item.name for item in ROOT.iterdir())
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    names: dict[str, object] = {"__name__": path.stem}
    for line, block in blocks(path.read_text(encoding="utf-8"), "python"):
        # Later blocks use what earlier ones made; a traceback names the page's own line.
        exec(compile("\n" * line + block, path.name, "exec"), names)
        assert capsys.readouterr().out.strip(), f"{path.name}, line {line}: prints nothing"
    assert sorted(item.name for item in ROOT.iterdir()) == before


def test_the_tour_runs_as_in_a_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the shipped pictures and three short logs of the simulated rig, one statement after the other."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "images", "images")
    Path("logs").mkdir()
    for scenario, seconds in (("static", 10), ("swing", 6), ("ellipse", 6)):
        simulate(scenario, Path(f"logs/{scenario}.csv"), duration=f"{seconds}s")
    calib.Rig().with_sections({"camera": calib.intrinsics("images")}).save(Path("old.yaml"))
    parts = [block for _, block in blocks((MANUAL / "tour.md").read_text(encoding="utf-8"), "python")]
    names: dict[str, Any] = {}
    exec(compile("".join(parts), "tour.md", "exec"), names)
    rig, states = names["rig"], names["states"]
    assert rig.camera.verdict.ok and rig.align.sigma["time_offset_s"] < 1e-3
    assert states.to_pandas()["sigma_q1_m"].notna().all()
    saved = names["calib"].Rig.load("rig.yaml")
    assert saved.camera == rig.camera and saved.actuator == rig.actuator
    place = [[0.01, 0.06]]
    pixels = rig.plane.to_pixels(place, rig.camera)
    np.testing.assert_allclose(rig.plane.to_world(pixels, rig.camera), place, atol=1e-9)
    seen = np.array(rig.plane.R_CW)[:, :2] @ place[0] + rig.plane.t_CW_m
    np.testing.assert_allclose(rig.camera.project([seen, -seen]), [*pixels, [np.nan, np.nan]])
    with pytest.raises(UsageError, match="camera is of type Plane"):
        rig.plane.to_world(pixels, rig.plane)
    assert Path("firmware_constants/calib_constants.h").is_file()
    header = names["calib"].firmware(rig)
    assert pickle.loads(pickle.dumps(header)) == header
    assert "<table>" in rig.camera._repr_html_() and "<table>" in names["log"]._repr_html_()
    assert repr(names["log"]).startswith("ellipse: 1280 rows, 0 to 7.99")
    for one in (names["log"], header, rig.diff(saved), rig.camera.verdict, header.verdict):
        assert len(repr(one)) < 1500 and type(one).__name__ not in repr(one)
    assert set(names["calib"].plots(states)) == {
        f"ellipse_{one}" for one in ("states", "innovations", "errors")
    }
    with pytest.raises(SomeFailedError, match=r"1 of 2 files failed: no\.csv; no\.csv: cannot be read"):
        names["calib"].replay(["logs/ellipse.csv", "no.csv"], rig)
    again = names["calib"].Log.load("simulated.csv")
    assert len(again) == len(names["log"]) and "true_phi_rad" in again.columns


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: calib.intrinsics("images", square_m=25), "square_m: '25.0m' is not between 0.01 mm and"),
        (lambda: calib.intrinsics("images", square_m=-0.02), "square_m: '-0.02m' is not positive"),
        (
            lambda: calib.intrinsics("images", square_m=math.nan),
            "square_m is nan, expected a finite number (m)",
        ),
        (lambda: calib.intrinsics([]), "calib.intrinsics: found no paths; it takes: A folder of pictures"),
        (lambda: calib.intrinsics(np.zeros((48, 64))), "found float64, expected a path"),
        (lambda: calib.intrinsics({"images": 1}), "found dict, expected a path"),
        (
            lambda: calib.intrinsics("images", "rig.yaml"),
            "rig is 'rig.yaml', expected a Rig, as of calib.Rig.lo",
        ),
        (
            lambda: calib.intrinsics("images", corners=7),
            "calib.intrinsics: corners is 7, expected (int, int) or",
        ),
        (lambda: calib.intrinsics("images", corners=(1, 2)), "corners: '1,2' is not between 3x3 and 200x200"),
        (lambda: calib.intrinsics("images", keep_all="no"), "keep_all is 'no', expected True or False"),
        (lambda: calib.intrinsics("images", model=None), "model is None, expected one of auto, pinhole"),
        (lambda: calib.intrinsics("images", square="20mm"), "calib.intrinsics: square is not an option; did"),
        (lambda: calib.lowpass(order=2.5), "calib.lowpass: order is 2.5, expected a whole number"),
        (lambda: calib.lowpass(jitter=0.3), "jitter is 0.3, expected (float, str) or text as for --jitter"),
        (lambda: calib.imu.static("a", columns={}), "calib.imu.static: columns is {}, expected a path"),
        (
            lambda: calib.imu("a"),
            "calib.imu is no function by itself; call one of calib.imu.static, calib.imu",
        ),
        (lambda: calib.run("images", jobs="2"), "calib.run: jobs is '2', expected a whole number"),
        (lambda: calib.Log.load(None), "calib.Log.load: path is None, expected text or a path"),
        (lambda: calib.simulate("static", rig=2), "calib.simulate: rig is 2, expected a Rig, as of"),
        (lambda: calib.Rig().diff("rig.yaml"), "calib.Rig.diff: other is 'rig.yaml', expected a Rig"),
        (lambda: setattr(calib.Rig(), "cammera", None), "rig.cammera: there is no such section; did you"),
        (lambda: calib.Rig(plane=calib.Rig()), "rig.plane: found a value of type Rig, expected Plane"),
        (lambda: calib.plots(None), "calib.plots: result is None, expected a Result"),
        (lambda: calib.simulate("static", seed=-1), "seed is -1, expected a whole number from 0 on"),
        (lambda: points_of(np.zeros((2, 5)), 2), "found numbers of shape (2, 5), expected points (n, 2)"),
        (lambda: points_of([[1, 2], [3]], 2), "found no table of numbers, expected points (n, 2)"),
    ],
)
def test_what_a_function_cannot_take_is_one_sentence(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(UsageError, match=re.escape(sentence)):
        call()


def test_paths_may_come_from_a_generator(tmp_path: Path) -> None:
    (tmp_path / "day1" / "logs").mkdir(parents=True)
    for name in ("a.csv", "b.csv", "day1/logs/c.csv"):
        (tmp_path / name).touch()
    assert expanded(f"{tmp_path}/**/c.csv") == (tmp_path / "day1/logs/c.csv",)
    assert set(expanded(tmp_path.glob("*.csv"))) == {tmp_path / "a.csv", tmp_path / "b.csv"}


def test_the_readme_shows_what_its_first_command_prints() -> None:
    """Which a golden holds to what the command prints today."""
    shown = next(block for _, block in blocks(README.read_text(encoding="utf-8"), "text")).splitlines()
    golden = (ROOT / "tests" / "goldens" / "shipped" / "intrinsics.txt").read_text(encoding="utf-8")
    printed = golden.partition("--- stdout\n")[2].partition("--- stderr")[0].splitlines()
    compare(shown, printed[printed.index(shown[0]) :], "README.md")


def test_the_tutorial_shows_what_goldens_hold() -> None:
    """Camera and plane of the shipped pictures; the next test runs all blocks."""
    goldens = [path.read_text(encoding="utf-8") for path in (ROOT / "tests/goldens/shipped").glob("*.txt")]
    printed = {text.partition("\n")[0]: text.partition("--- stdout\n")[2] for text in goldens}
    compared = 0
    for line, block in blocks((MANUAL / "tutorial.md").read_text(encoding="utf-8"), "console"):
        command, *shown = block.splitlines()
        if golden := printed.get(command.rstrip("/")):
            rows = golden.partition("--- stderr")[0].splitlines()
            compare(shown, rows, f"tutorial.md, line {line}")
            compared += len(shown)
    assert compared > 40


@pytest.mark.slow
def test_the_tutorial_prints_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each console block, run in order. Numbers may differ by 2 % or by one in their last digit."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "images", "images")
    text = (MANUAL / "tutorial.md").read_text(encoding="utf-8")
    for _, block in blocks(text, "python"):
        names: dict[str, Path] = {}
        exec(compile(block, "tutorial.md", "exec"), names)
        names["zoomed"].rename(tmp_path / "zoomed")
    compared = 0
    for line, block in blocks(text, "console"):
        compared += shows_what_is_printed(block, f"tutorial.md, line {line}")
    assert compared > 50


def shows_what_is_printed(block: str, where: str, folder: Path | None = None) -> int:
    """Run the commands of a block and compare; how many lines it shows."""
    environment = {**os.environ, **kernels(), "PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    lines = block.splitlines()
    expected = [row for row in lines if not row.startswith("$ ")]
    printed = ""
    for command in (row.removeprefix("$ ") for row in lines if row.startswith("$ ")):
        done = subprocess.run(
            ["bash", "-c", SHELL + command],
            env=environment, capture_output=True, text=True, check=False, cwd=folder,
        )  # fmt: skip
        assert done.returncode in (0, 1), f"{where}: {command}: {done.stderr}"
        printed += done.stdout or done.stderr
    compare(expected, printed.splitlines(), where)
    return len(expected)


_RECORDED = {"imu intrinsics": "imu_tk", "identify arm": "softarm", "identify pump": "softbot"}
"""Verbs whose blocks in the manual show recordings, and the folders of these."""
_OTHER_FILES = (
    "live",
    "identify stiffness",
    "record",
    "track",
    "firmware --check",
    "fleet",
    "sweep",
    "doctor",
)
"""Verbs whose blocks in the reference show a board, files of a person, or what is installed."""


def shows(block: str, verbs: Iterable[str]) -> bool:
    return block.startswith(tuple(f"$ calib {verb}" for verb in verbs))


@pytest.mark.slow
def test_the_reference_prints_what_it_shows(tmp_path: Path) -> None:
    """Each block of output.md on the folder that its first command makes."""
    text, stale, compared = (MANUAL / "reference" / "output.md").read_text(encoding="utf-8"), [], 0
    for line, block in blocks(text, "console"):
        if shows(block, (*_RECORDED, *_OTHER_FILES)):
            continue
        folder = tmp_path / "twin" if (tmp_path / "twin").exists() else tmp_path
        try:
            compared += shows_what_is_printed(block, f"output.md, line {line}", folder)
        except AssertionError as error:
            stale.append(str(error))
    assert not stale, "\n".join(stale)
    assert compared > 200


@pytest.mark.slow
@pytest.mark.parametrize("verb", _RECORDED)
def test_the_manual_shows_what_recordings_give(shared_data: Path, tmp_path: Path, verb: str) -> None:
    for path in (shared_data / _RECORDED[verb]).iterdir():
        (tmp_path / path.name).symlink_to(path)
    compared = 0
    for page in ("reference/output.md", "howto/arm.md"):
        for line, block in blocks((MANUAL / page).read_text(encoding="utf-8"), "console"):
            if shows(block, [verb]):
                compared += shows_what_is_printed(block, f"{page}, line {line}", tmp_path)
    assert compared > 10


def compare(expected: list[str], printed: list[str], where: str) -> None:
    """Hold printed lines against a page; `...` stands for the rest of a line, or for any lines."""
    at = 0
    for row in expected:
        if row.strip() == "...":
            at = -1
            continue
        if at < 0:
            at = next((i for i, line in enumerate(printed) if alike(row, line)), len(printed))
        assert at < len(printed), f"{where}: {row!r} is not printed"
        assert alike(row, printed[at]), f"{where}: {row!r} is shown, {printed[at]!r} printed"
        printed, at = printed[at + 1 :], 0
    assert at < 0 or not printed, f"{where}: {printed} is printed as well"


def alike(shown: str, printed: str) -> bool:
    if shown.endswith("..."):
        # What stands before the dots is long enough to tell lines apart.
        return alike(shown[:-3], printed[: len(shown) - 3])
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    for one, other in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        last_digit = 10.0 ** -len(one.partition(".")[2])
        if abs(float(one) - float(other)) > max(0.02 * abs(float(one)), 1.01 * last_digit):
            return False
    return True


def test_the_comparison_notices_what_differs() -> None:
    compare(["a 1.00 b", "...", "c ..."], ["a 1.01 b", "x", "y", "c and more"], "")
    for expected in (["a 1.00 b"], ["a 1.10 b", "..."], ["a 1.00 b", "...", "z"], ["b", "..."]):
        with pytest.raises(AssertionError):
            compare(expected, ["a 1.01 b", "x", "y", "c and more"], "")


def test_hints_name_this_project_and_its_extras() -> None:
    """What a message says to install leads to this project, not to another one's package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == DISTRIBUTION and pip_install("logs") == f"pip install '{DISTRIBUTION}[logs]'"
    sources = {path: path.read_text(encoding="utf-8") for path in (ROOT / "calib").rglob("*.py")}
    extras = {name for text in sources.values() for name in re.findall(r"pip_install\([\"'](\w+)", text)}
    assert len(extras) >= 4 and extras <= set(project["optional-dependencies"])
    assert not [path for path, text in sources.items() if re.search(r"calib\[\w+\]|install the extra", text)]


def test_readme_is_one_screen_and_holds_the_set_up() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    set_up = re.findall(r"^    (python3 -m venv .*)$", text, re.M)
    assert len(set_up) == 2
    assert [".venv/bin/calib intrinsics images/" in set_up[0], "pytest" in set_up[1]] == [True, True]


@pytest.mark.parametrize("path", sorted(generated_pages()))
def test_generated_pages_are_up_to_date(path: str) -> None:
    assert (MANUAL / path).read_text(encoding="utf-8") == generated_pages()[path], (
        "refresh it: python tests/reference_pages.py"
    )


def test_the_reference_names_every_column_section_and_scenario() -> None:
    files = (MANUAL / "reference" / "files.md").read_text(encoding="utf-8")
    assert not [name for name in (*COLUMNS, *STATES, *KINDS) if f"`{name}`" not in files]
    rows = re.findall(
        r"^\| `(\w+)` \|.*\| (.*) \|$", (MANUAL / "howto" / "simulate.md").read_text(encoding="utf-8"), re.M
    )
    options = {name: re.findall(r"`(\w+)`", cell) for name, cell in rows}
    assert options.pop("rig") == []
    for name, kind in SCENARIOS.items():
        assert options.pop(name) == [field for field in kind.model_fields if field != "duration_s"], name
    assert not options


def test_named_scripts_exist() -> None:
    missing, count = [], 0
    for path in (*documents(), ROOT / ".github" / "CONTRIBUTING.md"):
        for name in re.findall(
            r"(?:python|pytest -s) (tests/[\w/]+(?:\.py)?)", path.read_text(encoding="utf-8")
        ):
            count += 1
            missing += [] if (ROOT / name).exists() else [f"{path.name}: {name}"]
    assert not missing
    assert count > 15


def test_every_verb_is_explained_and_shown() -> None:
    text = (MANUAL / "reference" / "output.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\$ (calib .*)$", text, re.M)
    words = [verb for verb, _ in verbs()]
    assert len(words) > 25
    assert not [verb for verb in words if not any(f"{line} ".startswith(f"{verb} ") for line in shown)]
    explained = "".join(
        path.read_text(encoding="utf-8") for path in documents() if path.parent.name != "reference"
    )
    assert not [verb for verb in words if not names_verb(verb, explained)]


def names_verb(verb: str, text: str) -> bool:
    """Whether a page outside the reference names a verb; the README's table leaves `calib` out."""
    short = verb.removeprefix("calib ")
    return verb in text or f"`{short}`" in text or (short == "identify logs" and "calib identify LOG" in text)


def quoted_commands() -> Iterator[tuple[str, str]]:
    """Page and words of every command line in a code block or between backticks."""
    for path in documents():
        text = path.read_text(encoding="utf-8")
        lines = re.findall(
            r"^ *(?:\$ )?(calib [^#\n]*)", "\n".join(m["text"] for m in FENCE.finditer(text)), re.M
        )
        plain = without_blocks(text)
        lines += re.findall(r"^ {4,}(calib [^#\n]*)", plain, re.M)
        lines += re.findall(r"`(?:\.venv/bin/)?(calib [a-z][^`]*)`", plain)
        for line in lines:
            yield path.name, line.split(" && ")[0].strip()


def test_quoted_commands_have_existing_verbs_and_options() -> None:
    wrong, count, whole = [], 0, get_command(command_line())
    for page, line in quoted_commands():
        words = shlex.split(line.replace("...", ""))[1:]
        command = whole
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        if words and words[0] and getattr(command, "commands", None) and command.name == "identify":
            command = command.commands["logs"]
        if command.name == "calib":
            wrong.append(f"{page}: {line}")
            continue
        known = {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
        known |= {"--help"}
        options = [word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)]
        wrong += [f"{page}: {line}: {option}" for option in options if option not in known]
        count += 1
    assert not wrong
    assert count > 60


def test_links_lead_somewhere() -> None:
    broken = []
    for path in documents():
        text = path.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)\s]+)\)", without_blocks(text)):
            if "://" in target:
                continue
            file, _, anchor = target.partition("#")
            there = (path.parent / file).resolve() if file else path
            if not there.exists():
                broken.append(f"{path.name}: {target}")
            elif anchor:
                heads = re.findall(r"^#+ (.*)$", without_blocks(there.read_text(encoding="utf-8")), re.M)
                if anchor not in map(slug, heads):
                    broken.append(f"{path.name}: {target}")
    assert not broken


def test_the_index_links_every_page_and_topics_are_unique() -> None:
    names = [page.name for page in manual()]
    assert sorted(names) == sorted(
        str(path.relative_to(MANUAL).with_suffix("").as_posix()) for path in MANUAL.rglob("*.md")
    )
    topics = [page.topic for page in manual()]
    assert len(set(topics)) == len(topics)
    assert all(page.text.startswith(f"# {page.title}\n") for page in manual())


def test_pages_show_offline_and_fit_small_windows(tmp_path: Path) -> None:
    folder = write_manual(manual(), tmp_path / "manual")
    browser = browser_or_skip(tmp_path / "profile")
    try:
        for page in manual():
            browser.open(folder / f"{page.name}.html", 360)
            assert browser.run("document.querySelector('h1').textContent") == page.title
            assert browser.run("document.querySelector('[aria-current]').textContent") == page.title
            assert browser.run("document.documentElement.scrollWidth") <= 360, page.name
        browser.open(folder / "howto" / "ros.html", 1200)
        hrefs = browser.run("[...document.querySelectorAll('a')].map(a => a.href)")
        files = [
            Path(href.removeprefix("file://").partition("#")[0]) for href in hrefs if href.startswith("file:")
        ]
        assert files and all(file.exists() for file in files)
        assert not browser.errors
    finally:
        browser.close()


def test_markup_in_pages_is_shown_and_not_obeyed(tmp_path: Path) -> None:
    (page,) = [one for one in manual() if one.topic == "limits"]
    evil = type(page)("limits", "<b>", "# <b>\n\n<script>alert(1)</script>\n")
    text = (write_manual([evil], tmp_path) / "limits.html").read_text(encoding="utf-8")
    assert "<script>" not in text and "<b>" not in text


def test_docs_opens_a_browser_or_prints_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    docs(topic="ros")
    printed = capsys.readouterr()
    path = Path(printed.out.strip())
    assert path.is_relative_to(tmp_path) and path.name == "ros.html" and path.is_file()
    assert not opened and "open this file" in printed.err
    monkeypatch.setenv("DISPLAY", ":0")
    docs(topic="ros")
    assert opened == [path.as_uri()] and "open this file" not in capsys.readouterr().err


def test_docs_without_a_folder_to_write_uses_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    docs()
    assert Path(capsys.readouterr().out.strip()).is_file()


def test_docs_prints_lists_and_refuses(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    docs(topic="limits", print_page=True)
    assert capsys.readouterr().out == (MANUAL / "limits.md").read_text(encoding="utf-8")
    docs(list_topics=True)
    assert len(capsys.readouterr().out.splitlines()) == len(manual())
    docs(topic="theory", output=tmp_path, as_json=True)
    told = json.loads(capsys.readouterr().out)["docs"]
    assert told["page"] == str(tmp_path / "theory.html") and told["topics"]["theory"] == "Theory"
    with pytest.raises(UsageError, match="did you mean tutorial"):
        page_of("tutorail", manual())
    with pytest.raises(UsageError, match="--list"):
        docs(topic="zzz")

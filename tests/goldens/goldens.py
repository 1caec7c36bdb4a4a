"""Goldens: what the command line answers for six small rigs, stored as text and compared.

Use. `python tests/goldens/goldens.py` runs every rig and prints what differs from the stored files;
`python tests/goldens/goldens.py twin_run poor` runs these rigs only; `--refresh` rewrites the
stored files, whose diff is then read and explained like any other change; `--keep FOLDER` leaves
the rigs' working folders there to look at. The exit code is 1 when something differs. A commit that
moves code leaves the goldens as they are; a commit that changes what a user sees refreshes them.
`tests/goldens/test_goldens.py` runs the same comparison under pytest.

Everything is driven through `python -m calib` in processes of their own, forked from one that has loaded
every module, and no name of `calib` is used, so that modules can move without a change here. The words of
a command are part of its golden: exit code, stdout, stderr, and the files that it wrote. Text must be
equal, spaces included. Numbers are equal to 1e-9 of their size on x86-64 with the numpy and scipy that
`.[test]` installs (`RELATIVE`, `FLOOR`); where
processors differ by more than that, a rule in `LOOSE` says so and why. Times taken, the program's version,
hashes and folders are replaced by marks before anything is stored. Of a states file every 50th row is kept,
of a page its
visible text.
"""

from __future__ import annotations

import argparse
import atexit
import difflib
import functools
import html.parser
import json
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
IMAGES = ROOT / "images"

SAME_DIGITS = platform.machine() in ("x86_64", "AMD64") and math.erf(0.25).hex() == "0x1.1af54e232d608p-2"
"""Whether this is a processor and a C library as those that stored the numbers.

Other processors have other kernels, and glibc 2.43 rounds erf otherwise: a search ends elsewhere within its
tolerance.
"""
RELATIVE = 1e-9 if SAME_DIGITS else 1e-4
"""Numbers are equal when they differ by less than this, relative to the greater one."""
FLOOR = 1e-15
"""Numbers that are both smaller than this are equal: what is left of a sum that cancels."""
EVERY = 50
"""Of a states file each of these rows is kept."""
SHORT = 9
"""A number of at most so many digits was formatted by someone: its decimals are compared as text is."""


@dataclass(frozen=True)
class Loose:
    """A line that processors do not agree on to `RELATIVE`, and why."""

    file: str
    line: str
    relative: float
    floor: float
    why: str


LOOSE: tuple[Loose, ...] = ()
if not SAME_DIGITS:
    LOOSE = (
        Loose(
            "poor/report.html.txt",
            r"^\| moved.csv ",
            0.01,
            0.01,
            "without a plane and an alignment the log hardly tells where it began",
        ),
    )

_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_HASH = re.compile(r"\b[0-9a-f]{40,}\b")
_TOOK = re.compile(r"(?<=: )([a-z ]+), \d+\.\d s(?= \(|$)", re.MULTILINE)


# --- running ------------------------------------------------------------------------------------------------


@dataclass
class Rig:
    """A working folder, and the goldens that its commands have given so far: text by the name of its file."""

    folder: Path
    goldens: dict[str, str] = field(default_factory=dict)

    def calib(self, *words: str, name: str = "", took: bool = False) -> None:
        """Run a command in the folder and keep what it says; `took` replaces the times that stages took.

        Without a name nothing is kept of it but that it must not fail: it prepares.
        """
        code, *outputs = _Forks.shared().run(words, self.folder)
        if not name:
            if code:
                raise RuntimeError(f"calib {' '.join(words)}: exit code {code}\n{outputs[1]}")
            return
        stdout, stderr = (self._marked(text, took) for text in outputs)
        if "--json" in words:
            stdout = as_json(stdout)
        parts = [f"$ calib {' '.join(words)}", f"exit {code}", "--- stdout", stdout.rstrip("\n")]
        parts += ["--- stderr", stderr.rstrip("\n")]
        self._add(f"{name}.txt", "\n".join(parts) + "\n")

    def keep(self, path: str, name: str = "") -> None:
        """Keep a file that a command wrote: states as a sample of rows, a page as its text."""
        text = (self.folder / path).read_text(encoding="utf-8")
        if path.endswith(".csv"):
            text = every_row(text)
        elif path.endswith(".html"):
            text = page_text(text)
        name = name or Path(path).name
        if name.endswith((".html", ".ino")):
            name += ".txt"
        self._add(name, self._marked(text))

    def write(self, path: str, text: str) -> None:
        """Write an input into the folder."""
        (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / path).write_text(text, encoding="utf-8")

    def pictures(self, views: tuple[str, ...] = (), plane: bool = True) -> None:
        """Copy the shipped pictures: all views, or those named."""
        (self.folder / "images").mkdir()
        for path in sorted(IMAGES.iterdir()):
            if path.is_file() and (not views or path.stem in views or path.suffix == ".yaml"):
                shutil.copy(path, self.folder / "images")
        if plane:
            shutil.copytree(IMAGES / "plane", self.folder / "images" / "plane")

    def _add(self, name: str, text: str) -> None:
        assert name not in self.goldens, name
        self.goldens[name] = text

    def _marked(self, text: str, took: bool = False) -> str:
        for path, mark in ((self.folder, "<rig>"), (ROOT, "<root>"), (Path(sys.executable), "<python>")):
            text = text.replace(str(path), mark)
        text = _HASH.sub("<hash>", text.replace(_version(), "<version>"))
        return _TOOK.sub(r"\1, <seconds> s", text) if took else text


_AVX512_SKX = 256
"""OpenCV's number of that set of instructions, which its Python names no more."""


def kernels() -> dict[str, str]:
    """Variables that choose kernels which all processors of today have.

    Those for AVX-512 sum in another order: corners move by 1e-7 px, sigmas by 1e-6 of their size.
    """
    if platform.machine() not in ("x86_64", "AMD64"):
        return {}
    chosen = {
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    }
    if cv2.checkHardwareSupport(_AVX512_SKX):
        # OpenCV complains where there is nothing to disable.
        chosen["OPENCV_CPU_DISABLE"] = "AVX512-SKX"
    return chosen


def _environment() -> dict[str, str]:
    """One width, no colours, one thread, this tree, and `kernels`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("CALIB_", "FORCE_"))}
    told = [str(ROOT), *filter(None, [kept.get("PYTHONPATH", "")])]
    fixed = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb", "PYTHONHASHSEED": "0", "LC_ALL": "C.UTF-8"}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    return kept | fixed | threads | kernels() | {"PYTHONPATH": os.pathsep.join(told)}


def _version() -> str:
    found = re.search(
        r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert found is not None
    return found[1]


class _Forks:
    """A process that has loaded all modules, which takes longer than most commands, and forks each."""

    SCRIPT = """
import contextlib, importlib, json, os, pkgutil, runpy, sys
import calib
for module in pkgutil.walk_packages(calib.__path__, "calib."):
    if module.name != "calib.__main__":
        with contextlib.suppress(ImportError):
            importlib.import_module(module.name)
for line in iter(sys.stdin.readline, ""):
    words, folder, *streams = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        for number, name in enumerate((os.devnull, *streams)):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.argv, code = ["calib", *words], 0
        try:
            runpy.run_module("calib", run_name="__main__")
        except SystemExit as ended:
            code = ended.code
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code or 0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""

    def __init__(self) -> None:
        self._streams = [Path(tempfile.mkstemp()[1]) for _ in range(2)]
        self._process = subprocess.Popen(
            [sys.executable, "-c", self.SCRIPT],
            env=_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        atexit.register(self._end)

    @staticmethod
    @functools.cache
    def shared() -> _Forks:
        """The one of this process."""
        return _Forks()

    def run(self, words: tuple[str, ...], folder: Path) -> tuple[int, str, str]:
        """Exit code, stdout and stderr of a command in a folder."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(
            json.dumps([words, str(folder), *map(str, self._streams)]), file=self._process.stdin, flush=True
        )
        code = int(self._process.stdout.readline())
        out, err = (path.read_text(encoding="utf-8") for path in self._streams)
        return code, out, err

    def _end(self) -> None:
        self._process.communicate()
        for path in self._streams:
            path.unlink()


# --- normal forms -------------------------------------------------------------------------------------------


def as_json(text: str) -> str:
    """A JSON document with one key on a line, rows of plain values on one, and without `seconds`."""
    try:
        return "\n".join(_json_lines(json.loads(text), ""))
    except json.JSONDecodeError:
        return text


def _json_lines(value: Any, indent: str) -> Iterator[str]:
    deeper = indent + " "
    if isinstance(value, dict) and value:
        yield "{"
        for key, entry in value.items():
            if key != "seconds":
                first, *rest = _json_lines(entry, deeper)
                yield f"{deeper}{json.dumps(key)}: {first}"
                yield from rest
        yield indent + "}"
    elif isinstance(value, list) and any(isinstance(entry, dict | list) and entry for entry in value):
        yield "["
        for entry in value:
            first, *rest = _json_lines(entry, deeper)
            yield deeper + first
            yield from rest
        yield indent + "]"
    else:
        yield json.dumps(value, ensure_ascii=False)


def every_row(text: str) -> str:
    """The header of a table, each of `EVERY` rows, and how many there are."""
    header, *rows = text.splitlines()
    return "\n".join([header, *rows[::EVERY], f"rows: {len(rows)}"]) + "\n"


class _Visible(html.parser.HTMLParser):
    """Text that a reader of a page sees, a block a line; cells of a row stand on one."""

    HIDDEN = frozenset(("script", "style", "svg", "head", "template"))
    INLINE = frozenset(("a", "abbr", "b", "code", "em", "i", "small", "span", "strong", "sub", "sup", "mark"))
    CELLS = frozenset(("td", "th"))

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = [""]
        self._hidden = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: ARG002  named by the base class
        if tag in self.HIDDEN:
            self._hidden += 1
        elif tag in self.CELLS:
            self.lines[-1] += " | "
        elif tag not in self.INLINE:
            self.lines.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in self.HIDDEN:
            self._hidden -= 1
        elif tag not in self.INLINE | self.CELLS:
            self.lines.append("")

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.lines[-1] += data


def page_text(text: str) -> str:
    """What can be read on a page, without its pictures."""
    reader = _Visible()
    reader.feed(text)
    lines = (" ".join(line.split()) for line in reader.lines)
    return "\n".join(line for line in lines if line) + "\n"


# --- the rigs -----------------------------------------------------------------------------------------------


def shipped(rig: Rig) -> None:
    """The shipped pictures, from the camera to the firmware, in words and as documents."""
    rig.pictures()
    verbs = (
        ("intrinsics", "images"),
        ("extrinsics", "images/plane"),
        ("distortion",),
        ("lowpass",),
        ("firmware",),
    )
    for words in verbs:
        rig.calib(*words, name=words[0])
    for words in verbs:
        rig.calib(*words, "--json", name=f"{words[0]}-json")
    rig.keep("rig.yaml")
    for name in ("calib_constants.h", "calib_pipeline.h", "calib_selftest.h", "firmware_constants.ino"):
        rig.keep(f"firmware_constants/{name}")
    rig.calib("intrinsics", "images", "--model", "brown5", "--skew", "--loss", "huber", "--board", "warp",
              "--rig", "other.yaml", name="intrinsics-brown5")  # fmt: skip
    rig.calib("diff", "rig.yaml", "other.yaml", name="diff")
    rig.calib("export", "opencv", "--json", name="export")


def twin_run(rig: Rig) -> None:
    """A simulated rig through `calib run`, with its page."""
    rig.pictures()
    rig.write("rig.yaml", "geometry: {marker_offset_m: 0.0150, marker_offset_sigma_m: 0.00005}\n")
    (rig.folder / "logs").mkdir()
    _simulate(rig, "static", "logs/static1.csv", 11, "20s")
    _simulate(rig, "swing", "logs/swing1.csv", 12)
    _simulate(rig, "ellipse", "logs/ellipse.csv", 13, "8s")
    _simulate(rig, "steps", "logs/steps.csv", 14, "10s")
    rig.calib("run", ".", "-o", "out", "--jobs", "1", name="run", took=True)
    for name in ("rig.yaml", "firmware/calib_constants.h", "report.html"):
        rig.keep(f"out/{name}")
    for path in sorted((rig.folder / "out" / "states").glob("*.csv")):
        rig.keep(str(path.relative_to(rig.folder)), f"states-{path.name}")
    rig.calib("report", "out/rig.yaml", "-o", "again.html", name="report")


def twin_words(rig: Rig) -> None:
    """Another rig, verb by verb, in words; its controllers were given the truth."""
    _camera(rig)
    _simulate(rig, "static", "static.csv", 21, "30s")
    _simulate(rig, "swing", "swing.csv", 22)
    _simulate(rig, "ellipse", "ellipse.csv", 23, "8s", "--feedback", "truth")
    _simulate(rig, "chirp", "chirp.csv", 24, "10s")
    rig.write("poses.csv", pose_log(seed=2))
    _verbs(rig, "chirp.csv")
    rig.calib("control", "run", "step", "--duration", "3s", name="control-run")
    rig.calib("lowpass", "--suggest", "ellipse.csv", name="lowpass-suggest")


def twin_json(rig: Rig) -> None:
    """A third rig, with another plant, verb by verb, as documents."""
    _camera(rig)
    rig.write("plant.yaml", "actuator: {stiffness_scale: 1.08, bellows_radius_m: 0.0126}\n")
    plant = ("--rig", "plant.yaml")
    _simulate(rig, "static", "static.csv", 31, "30s", *plant)
    _simulate(rig, "swing", "swing.csv", 32, "", *plant)
    _simulate(rig, "ellipse", "ellipse.csv", 33, "8s", *plant)
    _simulate(rig, "steps", "steps.csv", 34, "10s", *plant)
    rig.write("poses.csv", pose_log(seed=3))
    _verbs(rig, "steps.csv", "--json")
    rig.calib(
        "lowpass", "--cutoff", "2Hz", "--order", "2", "--log", "swing.csv", "--json", name="lowpass-log"
    )


def pump(rig: Rig) -> None:
    """Tables of a pump, and nothing else."""
    for k, top_pwm in enumerate((120, 160, 200, 240)):
        rig.write(f"run{k + 1}.csv", pump_table(top_pwm, seed=k))
    tables = ("run1.csv", "run2.csv", "run3.csv", "--held", "run4.csv")
    rig.calib("identify", "pump", *tables, "--json", name="identify-pump-json")
    rig.keep("rig.yaml")
    rig.calib("identify", "pump", "run1.csv", "--rig", "one.yaml", name="identify-pump")
    rig.calib("identify", "stiffness", "run1.csv", name="identify-stiffness")


def poor(rig: Rig) -> None:
    """What cannot be answered well: few views, no plane, logs that show nothing, files that are broken."""
    rig.pictures(("view01", "view02", "view03"), plane=False)
    (rig.folder / "logs").mkdir()
    _simulate(rig, "static", "logs/static1.csv", 41, "5s")
    _simulate(rig, "swing", "logs/moved.csv", 42, "2s")
    rig.calib("intrinsics", "images", "--model", "radial2", name="intrinsics")
    rig.calib("intrinsics", "images/view01.png", "--rig", "one.yaml", "--json", name="intrinsics-one-view")
    rig.calib("extrinsics", "images/plane", name="extrinsics-missing")
    rig.calib("distortion", name="distortion")
    rig.calib("imu", "static", "logs/moved.csv", name="imu-static-moved")
    rig.calib("imu", "static", "logs/static1.csv", "--json", name="imu-static-short")
    rig.calib("imu", "intrinsics", "logs/static1.csv", name="imu-intrinsics")
    rig.calib("imu", "tune", "logs/static1.csv", name="imu-tune")
    rig.calib("align", "logs/static1.csv", name="align-no-plane")
    rig.calib("replay", "logs/moved.csv", "-o", "states.csv", name="replay-no-plane")
    rig.calib("identify", "logs", "logs/static1.csv", "--truth", name="identify-static")
    rig.calib("control", "check", "jump", "--pwm-limits", "60,90", name="control-check")
    rig.calib("firmware", name="firmware")
    rig.keep("rig.yaml")
    shutil.copytree(IMAGES / "plane", rig.folder / "images" / "plane")
    rig.calib("extrinsics", "images/plane", name="extrinsics")
    rig.calib("align", "logs/static1.csv", "--json", name="align-static")
    rig.calib("replay", "logs/moved.csv", "-o", "states.csv", "--json", name="replay-no-align")
    rig.calib("validate", "logs/static1.csv", "--truth", name="validate-static")
    rig.calib("run", ".", "-o", "out", "--jobs", "1", name="run", took=True)
    rig.keep("out/report.html")
    _broken(rig)


def _broken(rig: Rig) -> None:
    """Inputs that are refused, each with its sentence."""
    head, *rows = (rig.folder / "logs" / "moved.csv").read_text(encoding="utf-8").splitlines()
    rig.write(
        "bad/word.csv",
        "\n".join([head, *rows[:40], *(row.replace(",", ",x", 1) for row in rows[40:])]) + "\n",
    )
    rig.write("bad/back.csv", "\n".join([head, *rows[:40], *rows[10:]]) + "\n")
    rig.write("bad/nothing.csv", "")
    rig.write("bad/header.csv", "a,b,c\n1,2,3\n")
    rig.write("bad/rig.yaml", "camera: {fx_px: [1\n")
    rig.write("bad/values.yaml", "camera: {model: radial2, fx_px: soft}\n")
    for name in ("word", "back", "nothing", "header", "missing"):
        rig.calib("imu", "static", f"bad/{name}.csv", "--rig", "none.yaml", name=f"refused-{name}")
    rig.calib("replay", "bad/word.csv", "-o", "states.csv", name="refused-replay")
    rig.calib("align", "bad/header.csv", name="refused-align")
    rig.calib("distortion", "--rig", "bad/rig.yaml", name="refused-yaml")
    rig.calib("distortion", "--rig", "bad/values.yaml", "--json", name="refused-values")
    rig.calib("firmware", "--rig", "none.yaml", name="refused-no-rig")
    rig.calib("identify", "pump", "bad/header.csv", name="refused-pump")
    rig.calib("lowpass", "--cutoff", "1", name="refused-unit")
    rig.calib("simulate", "dance", "-o", "x.csv", name="refused-scenario")
    rig.calib("replay", name="refused-usage")
    rig.calib("run", "nowhere", "-o", "out2", name="refused-run")


RIGS: dict[str, Callable[[Rig], None]] = {
    make.__name__: make for make in (shipped, pump, poor, twin_run, twin_words, twin_json)
}


def _simulate(rig: Rig, scenario: str, path: str, seed: int, duration: str = "", *more: str) -> None:
    length = ("--duration", duration) if duration else ()
    rig.calib("simulate", scenario, "-o", path, "--seed", str(seed), *length, *more)


def _camera(rig: Rig) -> None:
    rig.calib("intrinsics", str(IMAGES), "--model", "radial2")
    rig.calib("extrinsics", str(IMAGES / "plane"))


def _verbs(rig: Rig, driven: str, *how: str) -> None:
    """Every verb that takes logs, in the order in which they need each other; `driven` has commands."""
    moving = ("swing.csv", "ellipse.csv")
    rig.calib("imu", "static", "static.csv", *how, name="imu-static")
    rig.calib("imu", "intrinsics", "poses.csv", "--planar", *how, name="imu-intrinsics")
    rig.calib("imu", "tune", *moving, *how, name="imu-tune")
    rig.calib("imu", "drift", "static.csv", "swing.csv", "--no-peers", *how, name="imu-drift")
    rig.calib("align", *moving, "static.csv", "--marker-offset", "15mm", *how, name="align")
    rig.calib("identify", "logs", "swing.csv", driven, *how, name="identify-logs")
    for name, options in {
        "driven": (),
        "kinematic": ("--model", "kinematic"),
        "smooth": ("--smooth",),
        "baseline": ("--estimator", "baseline"),
    }.items():
        states = f"states-{name}.csv"
        rig.calib("replay", driven, "-o", states, *options, *how, name=f"replay-{name}")
        rig.keep(states)
    rig.calib("control", "tune", *how, name="control-tune")
    rig.calib("control", "check", "ellipse", "--duration", "8s", *how, name="control-check")
    rig.calib("validate", "swing.csv", driven, *how, name="validate")
    rig.calib("firmware", *how, name="firmware")
    rig.keep("rig.yaml")
    rig.keep("firmware_constants/calib_constants.h")


def pose_log(seed: int) -> str:
    """A log of an IMU that is tilted about z from rest to rest, with bias, scale and noise."""
    rng = np.random.default_rng(seed)
    angles, rates, rest, turn = [0.0] * 1000, [0.0] * 1000, 300, 200
    for k in range(16):
        start, by = math.radians(45.0 * k), math.radians(45.0)
        for i in range(turn):
            s = (i + 0.5) / turn
            angles.append(start + by * (s - math.sin(2 * math.pi * s) / (2 * math.pi)))
            rates.append(by * (1.0 - math.cos(2 * math.pi * s)) / (turn / 100.0))
        angles += [start + by] * rest
        rates += [0.0] * rest
    lines = ["t_s,ax_mps2,ay_mps2,az_mps2,gx_radps,gy_radps,gz_radps"]
    for k, (angle, rate) in enumerate(zip(angles, rates, strict=True)):
        noise = 0.01 * rng.standard_normal(3), 0.001 * rng.standard_normal(3)
        ax = 1.01 * 9.80665 * math.cos(angle) + 0.1 + noise[0][0]
        ay = 0.99 * 9.80665 * math.sin(angle) - 0.2 + noise[0][1]
        values = (
            ax,
            ay,
            0.05 + noise[0][2],
            0.01 + noise[1][0],
            noise[1][1] - 0.02,
            1.02 * -rate + noise[1][2],
        )
        lines.append(",".join([f"{k / 100:.2f}", *(f"{value:.6f}" for value in values)]))
    return "\n".join(lines) + "\n"


def pump_table(top_pwm: int, seed: int) -> str:
    """Pressure of a pump that is switched on, up and off: dead time, a lag and a root of the voltage."""
    rng = np.random.default_rng(seed)
    step_s, pressure = 0.02, 0.0
    lines = ["t_s,pwm,pressure_kPa"]
    for k in range(400):
        t = k * step_s
        pwm, before = (_pwm(at, top_pwm) for at in (t, t - 0.1))
        level = 30.0 * max(before - 30.0, 0.0) / 225.0
        pressure += step_s / (1.2 if level > pressure else 2.0) * (level - pressure)
        lines.append(f"{t:.2f},{pwm},{pressure + 0.05 * rng.standard_normal():.4f}")
    return "\n".join(lines) + "\n"


def _pwm(t_s: float, top: int) -> int:
    return 0 if t_s < 1.0 or t_s >= 6.0 else top // 2 if t_s < 3.0 else top


# --- comparing ----------------------------------------------------------------------------------------------


def answers(name: str, folder: Path) -> dict[str, str]:
    """Goldens of a rig as the program gives them now, worked out in an empty folder."""
    rig = Rig(folder.resolve())
    rig.folder.mkdir(parents=True, exist_ok=True)
    RIGS[name](rig)
    return rig.goldens


def stored(name: str) -> dict[str, str]:
    """Goldens of a rig as they are stored."""
    return {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / name).glob("*"))}


def store(name: str, goldens: dict[str, str]) -> None:
    """Write the goldens of a rig, and remove those that are no more."""
    shutil.rmtree(HERE / name, ignore_errors=True)
    (HERE / name).mkdir()
    for file, text in goldens.items():
        (HERE / name / file).write_text(text, encoding="utf-8")


def differences(name: str, now: dict[str, str]) -> list[str]:
    """What differs between a rig's stored goldens and those of now, a difference an entry."""
    before = stored(name)
    found = [f"{name}/{file}: stored, but no longer given" for file in before if file not in now]
    found += [f"{name}/{file}: given, but not stored" for file in now if file not in before]
    for file, text in before.items():
        if file in now:
            found += compare(f"{name}/{file}", text, now[file])
    return found


def compare(file: str, before: str, now: str) -> list[str]:
    """Differences of two texts: other words, and numbers that are not equal."""
    old, new = before.splitlines(), now.splitlines()
    old_words, new_words = ([_NUMBER.sub("#", line) for line in lines] for lines in (old, new))
    if old_words == new_words:
        blocks = [("equal", 0, len(old), 0, len(new))]
    else:
        blocks = difflib.SequenceMatcher(None, old_words, new_words, autojunk=False).get_opcodes()
    found = []
    for kind, i, i_end, j, j_end in blocks:
        if kind == "equal":
            for k in range(i_end - i):
                if old[i + k] != new[j + k]:
                    found += _numbers(file, i + k + 1, old[i + k], new[j + k])
        else:
            lines = [f"  stored: {line}" for line in old[i:i_end]] + [
                f"  now:    {line}" for line in new[j:j_end]
            ]
            found.append("\n".join([f"{file}:{i + 1}: other words", *lines]))
    return found


def _numbers(file: str, at: int, old: str, new: str) -> list[str]:
    """Difference of two lines of the same words."""
    rule = next((rule for rule in LOOSE if re.search(rule.file, file) and re.search(rule.line, old)), None)
    relative, floor = (rule.relative, rule.floor) if rule else (RELATIVE, FLOOR)
    worst = max(
        (_apart(a, b, relative, floor), a, b)
        for a, b in zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    )
    if worst[0] == 0.0:
        return []
    apart, a, b = worst
    return [f"{file}:{at}: {a} is now {b} ({apart:.1e})\n  stored: {old}\n  now:    {new}"]


def _apart(a: str, b: str, relative: float, floor: float) -> float:
    """Relative difference of two written numbers, 0 where they are equal."""
    x, y = float(a), float(b)
    size = max(abs(x), abs(y))
    if size <= floor:
        return 0.0
    if abs(x - y) > relative * size:
        return abs(x - y) / size
    formatted = SAME_DIGITS and all(sum(map(str.isdigit, text.split("e")[0])) <= SHORT for text in (a, b))
    return sys.float_info.epsilon if formatted and a != b else 0.0


def main() -> int:
    """Compare or refresh; 1 when something differs."""
    parser = argparse.ArgumentParser(description="Compare what the command line answers with what is stored.")
    parser.add_argument("rigs", nargs="*", metavar="RIG", help=f"of {', '.join(RIGS)}; all without one")
    parser.add_argument("--refresh", action="store_true", help="rewrite the stored goldens")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="folder to leave the working folders in")
    options = parser.parse_args()
    unknown = [name for name in options.rigs if name not in RIGS]
    if unknown:
        parser.error(f"unknown rig {unknown[0]}, expected of {', '.join(RIGS)}")
    differ = 0
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.rigs or RIGS:
            now = answers(name, (options.keep or Path(temporary)) / name)
            found = differences(name, now)
            differ += len(found)
            print("\n".join([*found, f"{name}: {len(now)} files, {len(found)} differences"]), flush=True)
            if options.refresh:
                store(name, now)
    return int(differ > 0 and not options.refresh)


if __name__ == "__main__":
    sys.exit(main())

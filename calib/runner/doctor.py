"""What `calib doctor` looks at: libraries and their versions, compiled code, a trial, optional tools."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calib.core.errors import pip_install

_LEAST_PYTHON = (3, 11)
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class Check:
    """One thing that was looked at; one that is not needed may be missing."""

    name: str
    needed: bool
    good: bool
    found: str
    what_for: str


_LIBRARIES = (
    ("numpy", "numpy", (2, 0)),
    ("scipy", "scipy", (1, 13)),
    ("opencv-python-headless", "cv2", (5, 0)),
    ("filterpy", "filterpy", (2, 0)),
    ("matplotlib", "matplotlib", (3, 9)),
    ("numba", "numba", (0, 60)),
    ("pyarrow", "pyarrow", (15, 0)),
    ("typer", "typer", (0, 20)),
    ("pydantic", "pydantic", (2, 8)),
    ("pyyaml", "yaml", (6, 0)),
    ("jinja2", "jinja2", (3, 1)),
    ("markdown-it-py", "markdown_it", (3, 0)),
)
"""Distribution, module and least version of what every installation has."""

_EXTRAS = (
    ("mcap", "mcap", f"logs and states in MCAP: {pip_install('logs')}"),
    ("rosbags", "rosbags", f"logs in ROS bags: {pip_install('logs')}"),
    ("uvicorn", "uvicorn", f"calib live: {pip_install('live')}"),
    ("starlette", "starlette", f"calib live: {pip_install('live')}"),
    ("pyserial", "serial", f"calib record: {pip_install('serial')}"),
    ("ahrs", "ahrs", f"filters of others in calib imu drift: {pip_install('peers')}"),
    ("imufusion", "imufusion", f"filters of others in calib imu drift: {pip_install('peers')}"),
    ("vqf", "vqf", f"filters of others in calib imu drift: {pip_install('peers')}"),
)

_TOOLS = (
    (("avr-gcc",), "compiling the firmware for the ATmega328P"),
    (("arduino-cli",), "flashing the example sketch from the command line"),
    (("gcc", "clang", "cc"), "compiling the firmware's self-test on this machine"),
    (("chromium", "chromium-browser", "google-chrome", "firefox"), "reading the page of calib run"),
)


def examine(quick: bool = False) -> list[Check]:
    """Look at everything; the trial, which takes a few seconds, is left out of a quick look."""
    checks = [
        _python(),
        *(_library(*one) for one in _LIBRARIES),
        _tried("folder for temporary files", _folder),
    ]
    if not quick:
        checks.append(_tried("compiled code", _compiled))
        checks.append(_tried("camera chain", _camera))
    checks += [_extra(*one) for one in _EXTRAS]
    checks += [_tool(names, what_for) for names, what_for in _TOOLS]
    return checks


def _python() -> Check:
    return Check(
        "Python", True, sys.version_info >= _LEAST_PYTHON, platform.python_version(), "at least 3.11"
    )


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:2])


def _library(name: str, module: str, least: tuple[int, int]) -> Check:
    words = f"at least {'.'.join(map(str, least))}"
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        version = ""
    try:
        importlib.import_module(module)
    except Exception as error:
        return Check(name, True, False, f"cannot be imported: {type(error).__name__}", words)
    # A module of another distribution (a system's own OpenCV) has no version here, and may do.
    return Check(
        name, True, not version or _numbers(version) >= least, version or "of unknown version", words
    )


def _extra(name: str, module: str, what_for: str) -> Check:
    if importlib.util.find_spec(module) is None:
        return Check(name, False, False, "-", what_for)
    try:
        return Check(name, False, True, importlib.metadata.version(name), what_for)
    except importlib.metadata.PackageNotFoundError:
        return Check(name, False, True, "of unknown version", what_for)


def _tool(names: tuple[str, ...], what_for: str) -> Check:
    path = next((found for found in map(shutil.which, names) if found), None)
    if path is None:
        return Check(" or ".join(names[:2]), False, False, "-", what_for)
    try:
        told = subprocess.run(
            [path, "--version"],
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
            errors="replace",
        ).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        told = ""
    version = re.search(r"\d+(\.\d+)+", told)
    return Check(Path(path).name, False, True, version.group() if version else "there", what_for)


def _tried(name: str, trial: Callable[[], str]) -> Check:
    try:
        return Check(name, True, True, trial(), "")
    except Exception as error:
        words = " ".join(str(error).split())[:80]
        return Check(name, True, False, f"{type(error).__name__}: {words}", "")


def _folder() -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial"
        path.write_bytes(b"calib")
        path.replace(path.with_name("moved"))
    return f"writable, {os.cpu_count() or 1} processors"


def _compiled() -> str:
    import numpy as np
    from numba import njit

    def plus(values: np.ndarray) -> float:
        whole = 0.0
        for value in values:
            whole += value
        return whole

    if njit(plus)(np.arange(5.0)) != 10.0:
        raise RuntimeError("adds wrongly")
    return "numba compiles"


def _camera() -> str:
    """Calibrate a camera whose truth is known, without pictures."""
    import numpy as np

    from calib.stages.camera.bundle import calibrate
    from calib.stages.camera.model import Board, Camera, View, pack, project

    truth = Camera("radial2", (640, 480), 600.0, 598.0, 0.0, 320.0, 241.0)
    target_m = Board(7, 5, 0.02).points_m()
    target = np.column_stack([target_m, np.zeros(len(target_m))])
    views = []
    for k in range(8):
        a, b = 0.5 * np.sin(0.8 * k), 0.5 * np.cos(0.8 * k)
        R_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        R_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        points_C = (target - target.mean(axis=0)) @ (R_x @ R_y).T + [0.01 * (k % 3 - 1), 0.0, 0.3]
        views.append(View(f"view {k}", target_m, project(truth, points_C)))
    found = calibrate(pack(views), truth.image_size_px, "radial2")
    wrong = abs(found.camera.fx_px - truth.fx_px)
    if not wrong < 1e-3:
        raise RuntimeError(f"focal length comes out {wrong:.2g} px off")
    return f"focal length to {wrong:.0e} px"

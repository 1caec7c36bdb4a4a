"""What `calib doctor` looks at: libraries and their versions, compiled code, a trial, optional tools."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from calib.core.errors import DISTRIBUTION, pip_install

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


_MODULES = {
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "markdown-it-py": "markdown_it",
    "pyserial": "serial",
    "pillow-heif": "pillow_heif",
}
"""Modules whose names are not those of their distributions."""

_EXTRAS = {
    "logs": "logs and states in MCAP, logs in ROS bags",
    "pictures": "pictures in HEIF",
    "serial": "calib record",
    "fleet": "calib fleet on a cluster and from URLs",
    "live": "calib live",
    "peers": "filters of others in calib imu drift",
}
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\[\w+\])?([^;]*)(?:;.*extra *== *['\"](\w+)['\"])?")

_TOOLS = (
    (("avr-gcc",), "compiling the firmware for the ATmega328P"),
    (("arduino-cli",), "flashing the example sketch from the command line"),
    (("gcc", "clang", "cc"), "compiling the firmware's self-test on this machine"),
    (("chromium", "chromium-browser", "google-chrome", "firefox"), "reading the page of calib run"),
)


def examine(quick: bool = False) -> list[Check]:
    """Look at everything; the trial, which takes a few seconds, is left out of a quick look."""
    libraries = list(_libraries())
    checks = [
        Check("Python", True, sys.version_info >= _LEAST_PYTHON, platform.python_version(), "at least 3.11"),
        *(one for one in libraries if one.needed),
        _tried("folder for temporary files", _folder),
    ]
    if not quick:
        checks.append(_tried("compiled code", _compiled))
        checks.append(_tried("camera chain", _camera))
    checks += [one for one in libraries if not one.needed]
    checks += [_tool(names, what_for) for names, what_for in _TOOLS]
    return checks


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:2])


def _libraries() -> Iterator[Check]:
    """What the installed distribution says that it needs, and its extras."""
    try:
        stated = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        yield Check(DISTRIBUTION, False, False, "-", "telling which libraries are needed")
        return
    for found in map(_REQUIREMENT.match, stated):
        if found is not None and (found[3] is None or found[3] in _EXTRAS):
            yield _library(found[1], found[2].strip(), found[3])


def _library(name: str, bounds: str, extra: str | None) -> Check:
    words = bounds if extra is None else f"{_EXTRAS[extra]}: {pip_install(extra)}"
    try:
        importlib.import_module(_MODULES.get(name, name))
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        # A module of another distribution (a system's own OpenCV) has no version here, and may do.
        return Check(name, extra is None, True, "of unknown version", words)
    except Exception as error:
        return Check(name, extra is None, False, f"cannot be imported: {type(error).__name__}", words)
    least = re.search(r">= *([\d.]+)", bounds)
    good = least is None or _numbers(version) >= _numbers(least[1])
    return Check(name, extra is None, good, version, words)


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
    """Calibrate the camera of the simulated rig from corners that are exact."""
    from calib.stages.camera.bundle import calibrate
    from calib.stages.camera.model import View, pack
    from calib.twin.pictures import BOARD, shots
    from calib.twin.pictures import CAMERA as truth
    from calib.twin.scene import PrintedBoard, corner_pixels

    printed = PrintedBoard(BOARD)
    views = [View(one.path, BOARD.points_m(), corner_pixels(truth, printed, one.pose)) for one in shots()]
    found = calibrate(pack(views), truth.image_size_px, "radial2")
    wrong = abs(found.camera.fx_px - truth.fx_px)
    if not wrong < 1e-3:
        raise RuntimeError(f"focal length comes out {wrong:.2g} px off")
    return f"focal length to {wrong:.0e} px"

"""What several tests share: where the real recordings lie, and that CI skips nothing for want of a tool."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Generator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from outside import NOT_HERE, RECORDINGS, outside

# As the command does before numpy is loaded: on a busy machine waiting threads make small solves 400 times
# slower (10.4 s and 0.024 s for one slope of a drift).
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# Commands that tests start read what the first of them has compiled, where images of containers keep Python
# from writing it: each took up to 2 s to compile `calib` again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell's script has what it starts with `&` ignore Ctrl-C, and the commands that tests start inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# In CI the same examples each time, so that a change is judged by what it changed; elsewhere always new ones.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

ROOT = Path(__file__).resolve().parent.parent


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, Any, Any]:
    """In CI, where every tool is installed, a skip is a failure, but for what is not part of the project."""
    report = yield
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        reason = str(report.longrepr[2])
        if NOT_HERE not in reason:
            report.outcome = "failed"
            report.longrepr = f"in CI a skip is a failure: {reason}"
    return report


SMOKE = (
    "core",
    "solve",
    "camera/test_lens.py",
    "actuator/test_kinematics.py",
    "io/test_logs.py",
    "lowpass",
    "firmware/test_constants.py",
)
"""A part of every floor of the house, for the inner loop: `pytest -m smoke`."""


@cache
def _is_smoke(path: Path) -> bool:
    return any(path.is_relative_to(ROOT / "tests" / part) for part in SMOKE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m smoke` the other files are not even read, which alone takes longer."""
    if config.getoption("markexpr") == "smoke" and collection_path.name.startswith("test_"):
        return None if _is_smoke(collection_path) else True
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what the inner loop runs, and what the fast tier leaves out of many like cases."""
    places: Counter[str] = Counter()
    for item in items:
        if few := item.get_closest_marker("few"):
            test = item.nodeid.partition("[")[0]
            if places[test] not in (few.args or (0,)):
                item.add_marker(pytest.mark.slow)
            places[test] += 1
        if _is_smoke(item.path) and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.smoke)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Thousands of tests and all modules stay to the end: the collector of garbage need not look at them."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The checkout under test."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings; the test skips without it."""
    return outside(RECORDINGS)

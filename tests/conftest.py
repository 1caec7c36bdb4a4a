"""What several tests share: where the real recordings lie, and that CI skips nothing for want of a tool."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from outside import NOT_HERE, outside

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


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The checkout under test."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings; the test skips without it."""
    return outside(Path(os.environ.get("CALIB_SHARED_DATA", ROOT.parent / "shared" / "data")))

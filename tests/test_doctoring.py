"""What the doctor looks at, and what it says of a library that is not there."""

from __future__ import annotations

import importlib
from typing import Any

import pytest

from calib.doctoring import examine


def test_this_installation_is_whole() -> None:
    checks = {check.name: check for check in examine()}
    assert [name for name, check in checks.items() if check.needed and not check.good] == []
    assert checks["camera chain"].found.startswith("focal length to")
    assert not checks["vqf"].needed


def test_a_broken_library_is_told_and_nothing_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = importlib.import_module

    def broken(name: str, *more: Any) -> Any:
        if name == "filterpy":
            raise ImportError("torn")
        return whole(name, *more)

    monkeypatch.setattr(importlib, "import_module", broken)
    check = next(check for check in examine(quick=True) if check.name == "filterpy")
    assert check.needed and not check.good and "ImportError" in check.found


def test_tools_that_are_missing_are_not_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    tools = [check for check in examine(quick=True) if not check.good]
    assert tools and not any(check.needed for check in tools)

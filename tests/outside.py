"""What is not part of the project and may be missing: recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

__all__ = ["NOT_HERE", "outside"]

NOT_HERE = "not part of the project and not here"


def outside(path: Path) -> Path:
    """The path; skips the test where nothing is there."""
    if not path.exists():
        pytest.skip(f"{path}: {NOT_HERE}; CALIB_SHARED_DATA names the folder of recordings")
    return path

"""What is not part of the project and may be missing: recordings."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

__all__ = ["NOT_HERE", "RECORDINGS", "outside"]

RECORDINGS = Path(
    os.environ.get("CALIB_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data"
)
"""Folder of real recordings."""

NOT_HERE = "not part of the project and not here"


def outside(path: Path) -> Path:
    """The path; skips the test where nothing is there."""
    if not path.exists():
        pytest.skip(f"{path}: {NOT_HERE}; CALIB_SHARED_DATA names the folder of recordings")
    return path

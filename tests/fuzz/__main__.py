"""Fuzz one of the readers; see `fuzz.harness`."""

from __future__ import annotations

import sys
from pathlib import Path

# Run by its folder: its modules are to be those of the package.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from fuzz.harness import main

main()

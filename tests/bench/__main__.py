"""All benchmarks in one go: `python -m tests.bench`; one of them: `python tests/bench/solver.py`."""

from __future__ import annotations

import runpy
from pathlib import Path

for script in sorted(Path(__file__).parent.glob("[a-z]*.py")):
    print(f"\n== {script.stem}")
    runpy.run_path(str(script), run_name="__main__")

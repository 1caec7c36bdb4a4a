"""What starting costs: `calib --help`, and `calib intrinsics images/` beside import and detection.

    python tests/bench/startup.py

Byte code is cached as after an installation.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile

import _here
from _rows import CALIB, Row, interleaved_processes, print_rows


def rows(repeats: int = 9) -> list[Row]:
    """Two rows."""
    with tempfile.TemporaryDirectory() as place:
        os.environ["PYTHONPYCACHEPREFIX"] = f"{place}/cache"
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        rig = f"{place}/rig.yaml"
        found = interleaved_processes(
            {
                "help": [*CALIB, "--help"],
                "python": [sys.executable, "-c", "pass"],
                "intrinsics": [*CALIB, "intrinsics", str(_here.ROOT / "images"), "--rig", rig, "--json"],
                "import": [sys.executable, "-c", "import cv2, numpy"],
            },
            repeats,
        )
    ours, help_ = found["intrinsics"], found["help"]
    detect = json.loads(ours.output)["seconds"]["detect"]
    return [
        Row("calib --help", "0.3 s", help_.seconds, 0.3, 1.0, help_.mib, None, "absolute"),
        Row("calib --help", "python -c pass", help_.seconds, found["python"].seconds, None, help_.mib),
        Row(
            "calib intrinsics images/", "import + detection", ours.seconds, found["import"].seconds + detect,
            1 / 1.5, ours.mib, found["import"].mib, f"of which detection {detect:.2f} s",
        ),
    ]  # fmt: skip


if __name__ == "__main__":
    print_rows(rows())

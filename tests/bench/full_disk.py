"""A run on a disk that is really full: `python tests/bench/full_disk.py`, as root on Linux.

A file system in memory of some kilobytes takes the results of a run with verbs that take no time. The run
has to end with one sentence and whole files; once there is room, the next one in the same bytes as one
that always had room.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

_TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(_TESTS), str(_TESTS / "running")]

import test_faults as faults
from running_trials import make_folder


def _mount(place: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], check=True)


def main() -> None:
    """Try all sizes."""
    ends: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        root, place = make_folder(Path(name) / "rig"), Path(name) / "disk"
        faults._whole_run(root, Path(name) / "wanted")
        wanted = faults._bytes(Path(name) / "wanted")
        place.mkdir()
        for kilobytes in range(8, 200, 8):
            _mount(place, f"size={kilobytes}k")
            try:
                end = faults._in_child(root, place / "out", 0).split(" ", 1)[1]
                full = end.startswith("refused: ") and "No space left on device" in end
                assert end == "done" or full, (kilobytes, end)
                faults._check_public(place / "out", (wanted,))
                ends["refused" if full else "done"] += 1
                _mount(place, "remount,size=8m")
                assert faults._in_child(root, place / "out", 0).endswith(" done")
                assert faults._bytes(place / "out") == wanted, kilobytes
            finally:
                subprocess.run(["umount", str(place)], check=True)
    print(f"{sum(ends.values())} sizes of disk: {dict(ends)}; all the same once there was room")


if __name__ == "__main__":
    main()

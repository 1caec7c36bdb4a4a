"""How often good sets are blamed and bad ones blessed, by the calibration that users get, and what it costs.

python tests/bench/verdict.py [sets of each kind, default 20]

Good sets are taken with the lens named; the lens is chosen by views held back. In brackets of how many sets
views have left. With the rational model stated half of its good sets are `poor`: noise alone puts a pole of
its coefficients into the picture, which cannot be undistorted beyond.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from sets import BAD, camera_of, good_set, take

from calib.core.errors import BadInputError
from calib.core.verdict import WORDS
from calib.stages.camera.intrinsics import calibrate_camera
from calib.stages.camera.model import MODELS, View


def _verdict(views: list[View], size_px: tuple[int, int]) -> tuple[str, bool]:
    """The word, and whether views left."""
    try:
        found = calibrate_camera(views, size_px)
    except BadInputError:
        return "refused", False
    return found.verdict.word, any(one.kind == "view" for one in found.left_out)


def _row(name: str, found: list[tuple[str, bool]]) -> None:
    words, left = Counter(word for word, _ in found), Counter(word for word, some in found if some)
    cells = [f"{words[w] or '.'}" + (f" ({left[w]})" if left[w] else "") for w in (*WORDS, "refused")]
    print(f"{name:42s}" + "".join(f"{cell:>16}" for cell in cells), flush=True)


def main(count: int) -> None:
    """Print the tables."""
    print(" " * 42 + "".join(f"{word:>16}" for word in (*WORDS, "refused")))
    for model in MODELS:
        sets = [good_set(2000 + seed, model) for seed in range(count)]
        _row(f"good, {model}", [_verdict(views, camera.image_size_px) for views, camera in sets])
    for name, (make, _) in BAD.items():
        sets = [make(np.random.default_rng([seed, 4242])) for seed in range(count)]
        _row(name, [_verdict(views, camera.image_size_px) for views, camera in sets])
    rng = np.random.default_rng(0)
    for views in (10, 17, 25, 50, 100, 200, 400, 1000):
        shots, began = take(rng, camera_of(), views), time.process_time()
        _verdict(shots, (640, 480))
        seconds = time.process_time() - began
        print(f"{views:5d} views of 35 points: {1e3 * seconds:6.0f} ms of one processor")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)

"""How often good sets are blamed and bad ones blessed, and what judging costs.

python tests/bench/verdict.py [sets of each kind, default 20]
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from pathlib import Path
from statistics import median

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from sets import BAD, camera_of, good_set, take

from calib.core.verdict import WORDS
from calib.stages.camera.bundle import calibrate, covariance
from calib.stages.camera.intrinsics import without_copies
from calib.stages.camera.model import MODELS, View, pack
from calib.stages.camera.verdict import judge


def _verdict(views: list[View], size_px: tuple[int, int], model: str) -> tuple[str, float]:
    fit = calibrate(without_copies(pack(views), size_px)[0], size_px, model)
    known = covariance(fit)
    began = time.process_time()
    found = judge(fit, known)
    return found.word, time.process_time() - began


def _row(name: str, tally: Counter[str]) -> None:
    print(f"{name:48s}" + "".join(f"{tally[verdict] or '.':>16}" for verdict in WORDS))


def main(count: int) -> None:
    print(" " * 48 + "".join(f"{verdict:>16}" for verdict in WORDS))
    for model in MODELS:
        tally: Counter[str] = Counter()
        for seed in range(count):
            views, camera = good_set(2000 + seed, model)
            tally[_verdict(views, camera.image_size_px, model)[0]] += 1
        _row(f"good, {model}", tally)
    for name, (make, _) in BAD.items():
        tally = Counter()
        for seed in range(count):
            views, camera = make(np.random.default_rng([seed, 4242]))
            model = "brown5" if seed % 2 and len(views) > 3 else "radial2"
            tally[_verdict(views, camera.image_size_px, model)[0]] += 1
        _row(name, tally)
    rng = np.random.default_rng(0)
    for views in (10, 17, 25, 50, 100, 200, 400, 1000):
        shots = take(rng, camera_of(), views)
        seconds = median(_verdict(shots, (640, 480), "radial2")[1] for _ in range(3))
        print(f"{views:5d} views of 35 points: {1e3 * seconds:6.0f} ms of one processor")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)

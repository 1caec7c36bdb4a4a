"""How often good sets are blamed and bad ones blessed, by the calibration that users get, and what it costs.

python tests/bench/verdict.py [sets of each kind, default 20]

Good sets are taken with the lens named; the lens is chosen by views held back. In brackets of how many sets
views have left. A set that is bad by some of its views may end ok without them: the last column tells, of the
bad sets that are ok, how many of fx, fy, cx and cy lie within two standard deviations of the truth. With the
rational model stated half of its good sets are `poor`: noise alone puts a pole of its coefficients into the
picture, which cannot be undistorted beyond.
"""

from __future__ import annotations

import time
from collections import Counter

import _here
import numpy as np
from sets import BAD, camera_of, good_set, take

from calib.core.errors import BadInputError
from calib.core.verdict import WORDS
from calib.stages.camera.intrinsics import calibrate_camera
from calib.stages.camera.model import INTRINSICS, MODELS, Camera, View, vector_from_camera


def _verdict(views: list[View], camera: Camera) -> tuple[str, bool, list[bool]]:
    """The word, whether views left, and which of fx, fy, cx and cy are right."""
    try:
        found = calibrate_camera(views, camera.image_size_px)
    except BadInputError:
        return "refused", False, []
    off = np.abs(found.calibration.block.intrinsics - vector_from_camera(camera))
    right = [bool(off[INTRINSICS.index(name)] < 2.0 * s) for name, s in found.covariance.sigma().items()]
    return found.verdict.word, any(one.kind == "view" for one in found.left_out), right[:4]


def _row(name: str, found: list[tuple[str, bool, list[bool]]], bad: bool = False) -> None:
    words, left = Counter(one[0] for one in found), Counter(one[0] for one in found if one[1])
    cells = [f"{words[w] or '.'}" + (f" ({left[w]})" if left[w] else "") for w in (*WORDS, "refused")]
    right = [value for word, _, values in found if bad and word == "ok" for value in values]
    cells.append(f"{sum(right)} of {len(right)}" if right else "")
    print(f"{name:42s}" + "".join(f"{cell:>16}" for cell in cells), flush=True)


def main(count: int) -> None:
    """Print the tables."""
    print(" " * 42 + "".join(f"{word:>16}" for word in (*WORDS, "refused", "ok and right")))
    for model in MODELS:
        sets = [good_set(2000 + seed, model) for seed in range(count)]
        _row(f"good, {model}", [_verdict(*one) for one in sets])
    for name, (make, _) in BAD.items():
        sets = [make(np.random.default_rng([seed, 4242])) for seed in range(count)]
        _row(name, [_verdict(*one) for one in sets], bad=True)
    rng = np.random.default_rng(0)
    for views in (10, 17, 25, 50, 100, 200, 400, 1000):
        shots, began = take(rng, camera_of(), views), time.process_time()
        calibrate_camera(shots, (640, 480))
        seconds = time.process_time() - began
        print(f"{views:5d} views of 35 points: {1e3 * seconds:6.0f} ms of one processor")


if __name__ == "__main__":
    main(*_here.numbers(20))

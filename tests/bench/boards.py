"""Boards found beside the best of OpenCV's three finders, over sets and what can happen to their pictures.

    python tests/bench/boards.py [--every N] [--only WORD] [FOLDER COLUMNSxROWS ...]

By default the sets of real recordings, every N-th picture. A picture counts for OpenCV where one of its
finders returns a grid that is even; it is listed where calib finds none. The last lines count boards found in
pictures that hold none.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import _here  # noqa: F401
import cv2
import numpy as np
from outside import RECORDINGS
from test_detection import (
    KINDS,
    VARIANTS,
    _finished,
    _jpeg,
    _opencv_classic,
    _opencv_exhaustive,
    _opencv_sb,
    _unsharp,
)

from calib.core.arrays import FloatArray, GrayImage
from calib.io.pictures import list_pictures, read_picture
from calib.stages.camera.corners import detect, find_size

SETS = {
    "opencv_left": (9, 6), "gloworm_qvga": (8, 6), "udacity_lane": (9, 6), "ocam_fish2": (8, 6),
    "sks_charuco_left": (13, 8),
}  # fmt: skip
_UNEVEN = 0.1
"""Typical distance of a corner from the middle of its neighbours, in squares, beyond which a grid is none."""


def _warped(gray: GrayImage, corners: Iterable[tuple[float, float]]) -> GrayImage:
    """The picture with its corners moved to these places, as shares of its sides."""
    height, width = gray.shape
    size = np.array([width, height])
    before = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    shape = cv2.getPerspectiveTransform(
        before.astype(np.float32), (np.array(list(corners)) * size).astype(np.float32)
    )
    return np.asarray(cv2.warpPerspective(gray, shape, (width, height), borderMode=cv2.BORDER_REPLICATE))


def _reflection(gray: GrayImage) -> GrayImage:
    """A lamp that shines in the middle of the picture, as on a glossy print."""
    height, width = gray.shape
    v, u = np.mgrid[0:height, 0:width]
    glow = np.exp(-((u - 0.45 * width) ** 2 + (v - 0.5 * height) ** 2) / (2 * (0.07 * width) ** 2))
    return np.clip(gray + 260.0 * glow, 0, 255).astype(np.uint8)


def _rolling(gray: GrayImage) -> GrayImage:
    """Rows read one after another while the camera pans: a shear of a twentieth of the width, and a bend."""
    height, width = gray.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    share = v / height
    return np.asarray(
        cv2.remap(
            gray,
            u + np.float32(0.05 * width) * share * share,
            v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def _turned(degrees: float) -> Callable[[GrayImage], GrayImage]:
    def turned(gray: GrayImage) -> GrayImage:
        height, width = gray.shape
        shape = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
        side = abs(shape[0, 0]), abs(shape[0, 1])
        wide = (
            int(np.ceil(height * side[1] + width * side[0])),
            int(np.ceil(height * side[0] + width * side[1])),
        )
        shape[:, 2] += (np.array(wide) - [width, height]) / 2
        return np.asarray(cv2.warpAffine(gray, shape, wide, flags=cv2.INTER_CUBIC, borderValue=120))

    return turned


def _shadow(gray: GrayImage) -> GrayImage:
    """Half of the picture at a third of the light, with a soft edge across it."""
    height, width = gray.shape
    v, u = np.mgrid[0:height, 0:width]
    share = 1.0 / (1.0 + np.exp(-((u - 0.5 * width) + 0.4 * (v - 0.5 * height)) / (0.006 * width)))
    return np.asarray(gray * (0.33 + 0.67 * share)).astype(np.uint8)


def _noisy(gray: GrayImage) -> GrayImage:
    rng = np.random.default_rng(int(gray[:8, :8].sum()))
    return np.clip(gray + rng.normal(0, 15, gray.shape), 0, 255).astype(np.uint8)


def _moved(gray: GrayImage) -> GrayImage:
    kernel = np.zeros((9, 9), np.float32)
    kernel[4, 1:8] = 1 / 7
    return np.asarray(cv2.filter2D(gray, -1, kernel))


FURTHER: dict[str, Callable[[GrayImage], GrayImage]] = {
    "x 0.7": lambda g: np.asarray(cv2.resize(g, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)),
    "x 1.5": lambda g: np.asarray(cv2.resize(g, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)),
    "noise 15": _noisy,
    "seen from the left": lambda g: _warped(g, [(0.0, 0.0), (0.9, 0.2), (0.9, 0.8), (0.0, 1.0)]),
    "seen from below": lambda g: _warped(g, [(0.25, 0.1), (0.75, 0.1), (1.0, 0.95), (0.0, 0.95)]),
    "reflection": _reflection,
    "rolling shutter": _rolling,
    "turned 37": _turned(37.0),
    "turned 90": lambda g: np.ascontiguousarray(np.rot90(g)),
    "negative": lambda g: np.asarray(255 - g),
    "shadow": _shadow,
    "moved 7 px": _moved,
    "underexposed": lambda g: (g / 8).astype(np.uint8),
    "overexposed": lambda g: np.clip(2.2 * g.astype(np.float32), 0, 255).astype(np.uint8),
    "JPEG 10, then sharpened": lambda g: _unsharp(1.0, 2.0)(_jpeg(g)),
    "sharpened, then JPEG 10": lambda g: _jpeg(_unsharp(1.0, 3.0)(g)),
    "half, sharpened": lambda g: _unsharp(1.0, 2.0)(
        np.asarray(cv2.resize(g, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    ),
    "out to the right": lambda g: np.ascontiguousarray(g[:, : int(0.62 * g.shape[1])]),
    "out at the top": lambda g: np.ascontiguousarray(g[int(0.3 * g.shape[0]) :]),
}
"""More that happens to pictures than `test_detection.VARIANTS`."""


def _uneven(corners: FloatArray, size: tuple[int, int]) -> float:
    """Median distance of corners from the middle of their neighbours in line, in squares."""
    grid = corners.reshape(size[1], size[0], 2)
    side = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
    off = [
        np.linalg.norm(grid[:, 1:-1] - 0.5 * (grid[:, 2:] + grid[:, :-2]), axis=-1).ravel(),
        np.linalg.norm(grid[1:-1] - 0.5 * (grid[2:] + grid[:-2]), axis=-1).ravel(),
    ]
    return float(np.median(np.concatenate(off))) / side


def on_set(folder: Path, size: tuple[int, int], every: int, only: str) -> tuple[int, int, int]:
    """Print a line for each variant; boards that calib, the best finder, and any finder found."""
    finders = (_opencv_classic, _opencv_sb, _opencv_exhaustive)
    pictures = [read_picture(path) for path in list_pictures([folder])[::every]]
    total = [0, 0, 0]
    print(
        f"\n{f'{folder.name}, {len(pictures)} pictures':28}   calib classic      SB SB exh.     any  lost",
        flush=True,
    )
    for name, change in (VARIANTS | FURTHER).items():
        if only not in name:
            continue
        counts, ours, union, lost = [0, 0, 0], 0, 0, []
        for picture in pictures:
            gray = change(picture.gray)
            mine = detect(gray, *size) is not None
            theirs = []
            for find in finders:
                corners = find(gray, size)
                theirs.append(corners is not None and _uneven(corners.astype(float), size) < _UNEVEN)
            counts = [count + one for count, one in zip(counts, theirs, strict=True)]
            ours, union = ours + mine, union + any(theirs)
            if any(theirs) and not mine:
                lost.append(picture.name)
        total = [total[0] + ours, total[1] + max(counts), total[2] + union]
        flag = "  <--" if ours < max(counts) else ""
        numbers = "".join(f"{count:8d}" for count in (ours, *counts, union))
        print(f"  {name:26}{numbers}  {' '.join(lost)}{flag}", flush=True)
    return total[0], total[1], total[2]


def without_a_board(seeds: range) -> None:
    """Boards found, of either size or any, where there is none."""
    sharpen = _unsharp(2.0, 2.0)
    for kind in KINDS:
        count = [0, 0, 0]
        for seed in seeds:
            rng = np.random.default_rng(seed)
            gray = _finished(kind(rng), rng)
            size = ((7, 5), (9, 6))[seed % 2]
            count[0] += detect(gray, *size) is not None
            count[1] += detect(sharpen(gray), *size) is not None
            count[2] += kind.__name__ != "_cut_board" and find_size(gray) is not None
        print(
            f"{kind.__name__.strip('_'):16}{count[0]:4d}, sharpened {count[1]}, of any size {count[2]}",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    words = argparse.ArgumentParser()
    words.add_argument("--every", type=int, default=4)
    words.add_argument("--only", default="")
    words.add_argument("--none", type=int, default=20, help="seeds of pictures without a board")
    words.add_argument("folders", nargs="*")
    told = words.parse_args()
    cv2.setNumThreads(1)
    began = time.process_time()
    sets = {RECORDINGS / name: size for name, size in SETS.items()}
    if told.folders:
        named = [word.split("x") for word in told.folders[1::2]]
        sets = {Path(f): (int(c), int(r)) for f, (c, r) in zip(told.folders[::2], named, strict=True)}
    total = np.zeros(3, dtype=int)
    for folder, size in sets.items():
        if folder.is_dir():
            total += on_set(folder, size, told.every, told.only)
        else:
            print(f"no folder {folder.name}")
    print(f"\nin all: calib {total[0]}, OpenCV's best of each line {total[1]}, any of its finders {total[2]}")
    if not told.only and not told.folders:
        print("\nboards found where there is none:")
        without_a_board(range(told.none))
    print(f"{time.process_time() - began:.0f} s of CPU")


if __name__ == "__main__":
    main()

"""The usual script: find, refine, calibrate; `python _opencv_script.py FOLDER COLUMNS ROWS SQUARE_M`."""

import sys
from pathlib import Path

import cv2
import numpy as np


def main(folder: str, columns: int, rows: int, square_m: float) -> None:
    """Print how many boards were found, and the RMS."""
    grid = np.zeros((columns * rows, 3), np.float32)
    grid[:, :2] = square_m * np.mgrid[0:columns, 0:rows].T.reshape(-1, 2)
    pictures = sorted(path for path in Path(folder).iterdir() if path.suffix in (".jpg", ".png"))
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    found, size = [], (0, 0)
    for path in pictures:
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        size = gray.shape[::-1]
        seen, corners = cv2.findChessboardCorners(gray, (columns, rows))
        if seen:
            found.append(cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), ends))
    rms = cv2.calibrateCamera([grid] * len(found), found, size, None, None)[0]
    print(f"{len(found)} of {len(pictures)} boards, RMS {rms:.3f} px")


main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))

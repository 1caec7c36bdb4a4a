"""The simulated tracker: a Pixy2 that reports the marker on the head as a whole pixel, 60 times a second.

The marker sits at the distance d along the head's tangent (A.1), is mapped by the plane's pose and
the lens into distorted pixels, and is found there with jitter, rounded to the pixel grid. Some frames
show something else instead (outliers), in some nothing is found (dropouts, blackouts), and what is
reported at a tick was exposed `latency_s` earlier.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.actuator.kinematics import MARKER_OFFSET_M, forward, marker_from_head
from calib.arrays import BoolArray, FloatArray
from calib.camera.model import Camera, project
from calib.errors import BadInputError
from calib.twin.background import uniform
from calib.twin.sensors import normal, stamps, stream

__all__ = ["Tracker", "TrackerNoise", "View", "draw_tracker_noise", "marker_pixels", "track"]

_PURPOSE = 1


@dataclass(frozen=True)
class View:
    """A camera and the pose R_CW (3, 3), t_CW_m (3,) of the world in its frame."""

    camera: Camera
    R_CW: FloatArray
    t_CW_m: FloatArray


@dataclass(frozen=True)
class Tracker:
    """Errors of the tracker.

    Attributes
    ----------
    marker_offset_m : d of (A.1).
    latency_s : time from the exposure to the tick that reads the result.
    jitter_px : standard deviation of the found position along each axis, before rounding.
    grid_px : the position is a multiple of this; zero leaves it as it is.
    outliers : probability that a frame shows another thing, `outlier_px` (least, most) away.
    dropouts : probability that nothing is found in a frame.
    blackouts_s : pairs (start, duration) without any frame.
    stamp_jitter_s : standard deviation of the time stamps.

    Raises `BadInputError` for values that no tracker has.
    """

    marker_offset_m: float = MARKER_OFFSET_M
    latency_s: float = 0.025
    jitter_px: float = 0.3
    grid_px: float = 1.0
    outliers: float = 0.003
    outlier_px: tuple[float, float] = (5.0, 20.0)
    dropouts: float = 0.004
    blackouts_s: tuple[tuple[float, float], ...] = ()
    stamp_jitter_s: float = 2e-4

    def __post_init__(self) -> None:
        for name, most in (("marker_offset_m", 0.5), ("latency_s", 1.0), ("stamp_jitter_s", 0.1)):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise BadInputError(f"tracker {name}: found {value:g}, expected 0 to {most:g}")
        for name in ("jitter_px", "grid_px"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise BadInputError(f"tracker {name}: found {getattr(self, name):g}, expected zero or more")
        for name in ("outliers", "dropouts"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise BadInputError(f"tracker {name}: found {getattr(self, name):g}, expected a probability")
        if len(self.outlier_px) != 2 or not 0.0 <= self.outlier_px[0] <= self.outlier_px[1] < math.inf:
            raise BadInputError(f"tracker outlier_px: found {self.outlier_px}, expected (least, most)")
        for pair in self.blackouts_s:
            if len(pair) != 2 or not all(0.0 <= value < math.inf for value in pair):
                raise BadInputError(f"tracker blackouts_s: found {pair}, expected (start, duration)")


@dataclass(frozen=True)
class TrackerNoise:
    """Everything random about the n frames of a log.

    Attributes
    ----------
    exposed_s : (n,) times of exposure.
    stamp_s : (n,) time stamps of the ticks that read them.
    offset_px : (n, 2) jitter and outliers.
    missing : (n,) frames in which nothing is found.
    """

    exposed_s: FloatArray
    stamp_s: FloatArray
    offset_px: FloatArray
    missing: BoolArray


def draw_tracker_noise(tracker: Tracker, tick_times_s: FloatArray, seed: int) -> TrackerNoise:
    """Noise of the frames that are read at the times (n,) [s]."""
    n = len(tick_times_s)
    bits = stream(seed, _PURPOSE)
    stamp = stamps(tick_times_s, tracker.stamp_jitter_s, 0.0, bits)
    offset = tracker.jitter_px * normal(bits, n, 2)
    chance, share, turn, lost = (uniform(bits, n) for _ in range(4))
    least, most = tracker.outlier_px
    radius = np.where(chance < tracker.outliers, least + (most - least) * share, 0.0)
    offset += radius[:, None] * np.stack([np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)], axis=-1)
    missing = lost < tracker.dropouts
    for start, duration in tracker.blackouts_s:
        missing |= (tick_times_s >= start) & (tick_times_s < start + duration)
    return TrackerNoise(tick_times_s - tracker.latency_s, stamp, offset, missing)


def marker_pixels(view: View, tracker: Tracker, q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Where the marker is seen (m, 2) [px] for bellows (m, 2) [m]; NaN behind the camera."""
    pose = forward(q_m, bellows_radius_m)
    marker = marker_from_head(pose[:, :2], pose[:, 2], tracker.marker_offset_m)
    R = view.R_CW
    points = marker[:, :1] * R[:, 0] + marker[:, 1:] * R[:, 1] + view.t_CW_m
    front = points[:, 2] > 0.0
    points = np.where(front[:, None], points, 1.0)
    return np.where(front[:, None], project(view.camera, points), np.nan)


def track(
    view: View,
    tracker: Tracker,
    noise: TrackerNoise,
    frames: slice,
    q_m: FloatArray,
    bellows_radius_m: float,
) -> FloatArray:
    """Reported pixels (m, 2) of the frames of `noise`, NaN where there are none.

    Parameters
    ----------
    q_m : (m, 2) lengths of the bellows at the frames' exposures.
    """
    pixels = marker_pixels(view, tracker, q_m, bellows_radius_m) + noise.offset_px[frames]
    if tracker.grid_px > 0.0:
        pixels = tracker.grid_px * np.floor(pixels / tracker.grid_px + 0.5)
    width, height = view.camera.image_size_px
    outside = (pixels < -0.5) | (pixels > np.array([width - 0.5, height - 0.5])) | np.isnan(pixels)
    gone = noise.missing[frames] | outside.any(axis=-1)
    return np.where(gone[:, None], np.nan, pixels)

"""The tracker against OpenCV's projection, and each of its errors against what was asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.actuator.kinematics import forward
from calib.twin.rig import nominal_view
from calib.twin.sensors import Tracker, draw_tracker_noise, marker_pixels, track

VIEW, RADIUS_M = nominal_view(), 0.0126
CLEAN = Tracker(latency_s=0.0, jitter_px=0.0, grid_px=0.0, outliers=0.0, dropouts=0.0, stamp_jitter_s=0.0)
FRAMES = np.arange(60_000) / 60.0


def _bellows(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    length, half = rng.uniform(0.065, 0.09, n), RADIUS_M * rng.uniform(-0.7, 0.7, n)
    return np.stack([length + half, length - half], axis=1)


def _still(tracker: Tracker, seed: int = 0, frames: np.ndarray = FRAMES) -> np.ndarray:
    noise = draw_tracker_noise(tracker, frames, seed)
    q = np.full((len(frames), 2), 0.0712)
    return track(VIEW, tracker, noise, slice(0, len(frames)), q, RADIUS_M)


def test_the_marker_is_where_opencv_projects_it() -> None:
    q = _bellows(300)
    x, y, phi = forward(q, RADIUS_M).T
    # (A.1): 15 mm beyond the head along its tangent.
    marker = np.stack([x + 0.015 * np.sin(phi), y + 0.015 * np.cos(phi), np.zeros_like(x)], axis=1)
    d = VIEW.camera.distortion[:5]
    expected, _ = cv2.projectPoints(marker, cv2.Rodrigues(VIEW.R_CW)[0], VIEW.t_CW_m, VIEW.camera.K, d)
    assert np.allclose(marker_pixels(VIEW, CLEAN, q, RADIUS_M), expected[:, 0], rtol=0.0, atol=1e-8)
    assert np.abs(np.ptp(expected[:, 0], axis=0)).min() > 20.0


def test_without_errors_it_reports_the_projection() -> None:
    q = _bellows(500)
    noise = draw_tracker_noise(CLEAN, FRAMES[:500], 3)
    reported = track(VIEW, CLEAN, noise, slice(0, 500), q, RADIUS_M)
    assert np.array_equal(reported, marker_pixels(VIEW, CLEAN, q, RADIUS_M))
    assert np.array_equal(noise.exposed_s, FRAMES[:500])


def test_frames_are_exposed_earlier_than_they_are_read() -> None:
    noise = draw_tracker_noise(replace(CLEAN, latency_s=0.03), FRAMES, 0)
    assert np.allclose(FRAMES - noise.exposed_s, 0.03, atol=1e-12)
    assert np.allclose(noise.stamp_s, FRAMES, atol=1e-6)


def test_pixels_are_whole_and_nearest() -> None:
    q = _bellows(500)
    tracker = replace(CLEAN, grid_px=1.0)
    noise = draw_tracker_noise(tracker, FRAMES[:500], 0)
    whole = track(VIEW, tracker, noise, slice(0, 500), q, RADIUS_M)
    assert np.array_equal(whole, np.rint(whole))
    assert np.abs(whole - marker_pixels(VIEW, CLEAN, q, RADIUS_M)).max() <= 0.5


def test_jitter_has_the_deviation_asked_for() -> None:
    error = _still(replace(CLEAN, jitter_px=0.3)) - _still(CLEAN)
    assert np.std(error, axis=0) == pytest.approx([0.3, 0.3], rel=0.02)
    assert abs(float(np.corrcoef(error.T)[0, 1])) < 0.02


def test_outliers_have_the_share_and_distance_asked_for() -> None:
    away = np.linalg.norm(_still(replace(CLEAN, outliers=0.02)) - _still(CLEAN), axis=1)
    bad = away > 1e-9
    assert float(bad.mean()) == pytest.approx(0.02, abs=4.0 * math.sqrt(0.02 / len(FRAMES)))
    assert away[bad].min() >= 5.0
    assert away[bad].max() <= 20.0
    assert away[bad].mean() == pytest.approx(12.5, abs=0.5)


def test_dropouts_and_blackouts_leave_nothing() -> None:
    missing = np.isnan(_still(replace(CLEAN, dropouts=0.05))).all(axis=1)
    assert float(missing.mean()) == pytest.approx(0.05, abs=4.0 * math.sqrt(0.05 / len(FRAMES)))
    dark = np.isnan(_still(replace(CLEAN, blackouts_s=((2.0, 0.4), (5.0, 0.1)))))
    assert np.array_equal(dark[:, 0], dark[:, 1])
    t = FRAMES[dark[:, 0]]
    assert len(t) == 24 + 6
    assert np.all(((t >= 2.0) & (t < 2.4)) | ((t >= 5.0) & (t < 5.1)))


def test_a_marker_outside_the_picture_or_behind_the_camera_is_not_found() -> None:
    noise = draw_tracker_noise(CLEAN, FRAMES[:2], 0)
    q = np.array([[0.07, 0.07], [0.5, 0.5]])
    reported = track(VIEW, CLEAN, noise, slice(0, 2), q, RADIUS_M)
    assert np.isfinite(reported[0]).all()
    assert np.isnan(reported[1]).all()
    behind = replace(VIEW, t_CW_m=np.array([0.0, 0.0, -1.0]))
    assert np.isnan(track(behind, CLEAN, noise, slice(0, 2), q, RADIUS_M)).all()


def test_the_same_seed_gives_the_same_frames_and_portions_the_same_as_the_whole() -> None:
    tracker, q = Tracker(), _bellows(600)
    noise = draw_tracker_noise(tracker, FRAMES[:600], 7)
    whole = track(VIEW, tracker, noise, slice(0, 600), q, RADIUS_M)
    again = draw_tracker_noise(tracker, FRAMES[:600], 7)
    portions = [
        track(VIEW, tracker, again, slice(i, i + 100), q[i : i + 100], RADIUS_M) for i in range(0, 600, 100)
    ]
    assert np.array_equal(whole, np.concatenate(portions), equal_nan=True)
    other = draw_tracker_noise(tracker, FRAMES[:600], 8)
    assert not np.array_equal(noise.offset_px, other.offset_px)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"latency_s": 25.0}, "tracker latency_s: found 25, expected 0 to 1"),
        ({"marker_offset_m": -0.015}, "tracker marker_offset_m: found -0.015"),
        ({"jitter_px": math.nan}, "tracker jitter_px: found nan"),
        ({"outliers": 1.5}, "tracker outliers: found 1.5, expected a probability"),
        ({"outlier_px": (20.0, 5.0)}, "tracker outlier_px"),
        ({"blackouts_s": ((1.0,),)}, "tracker blackouts_s"),
    ],
)
def test_what_no_tracker_has(change: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Tracker(**change)

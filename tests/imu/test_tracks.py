"""The angle by each method on a log whose truth is known."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from calib.imu import tracks
from calib.imu.mahony import Mahony, MahonySample, MahonyState, step
from calib.imu.sampling import Part
from calib.imu.tracks import DriftLog, Tuned, mean_angle, on_grid, tracks_of

PERIOD = 0.01
AXES = ("gx", "gy", "gz", "ax", "ay", "az")


def _log(
    n: int = 2000, axes: tuple[str, ...] = AXES, bias: float = 0.01
) -> tuple[DriftLog, Part, np.ndarray]:
    t = PERIOD * np.arange(n)
    phi, rate = 0.6 * np.sin(2.0 * t), 1.2 * np.cos(2.0 * t)
    whole = {
        "gx": 0.0 * t,
        "gy": 0.0 * t,
        "gz": -rate + bias,
        "ax": 9.81 * np.cos(phi),
        "ay": 9.81 * np.sin(phi),
        "az": 0.0 * t,
    }
    values = np.stack([whole[axis] for axis in axes], axis=1)
    log = DriftLog("log.csv", axes, t, values, t, phi + 0.1, np.zeros(0), np.zeros(0))
    places = np.arange(n)
    return log, Part(0.0, values, places, places), phi


def test_the_sensors_alone_and_the_filter() -> None:
    log, part, phi = _log()
    found, skipped = tracks_of(log, [part], PERIOD, Tuned(Mahony(1.0, 0.25)), peers=False)
    angles = {track.name: track.phi_rad[0] for track in found}
    assert list(angles) == [
        "on the chip",
        "gyroscope alone",
        "accelerometer alone",
        "MM 3/3",
        "MM tuned",
        "MM 3/3 with up vector",
    ]
    assert skipped == []
    t = PERIOD * np.arange(len(phi))
    # Sums of rates are half a step ahead, which a rate of 1.2 makes 0.006 of.
    assert np.abs(angles["gyroscope alone"] - phi + 0.01 * t).max() < 0.02
    assert np.allclose(angles["accelerometer alone"], phi)
    assert np.allclose(angles["on the chip"], phi + 0.1)
    # (2.3a) compares a new reading with the angle before it: a whole step ahead, 0.012, times
    # |3 i w + 3| / |(i w)^2 + 3 i w + 3| = 1.10 at w = 2.
    assert np.abs(angles["MM 3/3"] - phi)[1000:].max() < 1.15 * 0.012
    assert np.allclose(angles["MM 3/3 with up vector"], angles["MM 3/3"])
    # The filter is the one that goes on the microcontroller.
    state = MahonyState(float(angles["MM 3/3"][0]))
    for k in range(1, 300):
        gz, ax, ay = part.values[k, 2:5].tolist()
        state = step(Mahony(), state, MahonySample(ax, ay, gz, PERIOD))
        assert state.phi_rad == pytest.approx(angles["MM 3/3"][k], abs=1e-12)


def test_the_start_is_right_though_it_moves() -> None:
    log, part, _ = _log(bias=0.0)
    found, _ = tracks_of(log, [part], PERIOD, peers=False)
    angles = {track.name: track.phi_rad[0] for track in found}
    assert angles["gyroscope alone"][0] == pytest.approx(0.0, abs=0.007)
    assert angles["MM 3/3"][0] == pytest.approx(0.0, abs=0.007)


def test_what_is_left_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    log, part, _ = _log(axes=("gz", "ax", "ay"))
    log = DriftLog(
        log.source, log.axes, log.t_s, log.values, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)
    )
    found, skipped = tracks_of(log, [part], PERIOD)
    assert [track.name for track in found] == ["gyroscope alone", "accelerometer alone", "MM 3/3"]
    assert skipped[0] == "on the chip: the log has no column onchip_phi_rad"
    assert skipped[1].startswith("MM tuned: the rig's file has no section orientation_filter")
    assert "gx, gy, az is not in the log" in skipped[2]
    _, skipped = tracks_of(log, [part], PERIOD, Tuned(Mahony(), up_vector=True))
    assert skipped[1].startswith("MM tuned: it was tuned with the up vector")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    log, part, _ = _log()
    _, skipped = tracks_of(log, [part], PERIOD)
    assert sum("comes with the extra peers" in sentence for sentence in skipped) == 4


def test_a_peer_that_is_too_slow_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracks, "missing", lambda name: "")
    monkeypatch.setattr(tracks, "MOST_SAMPLES", {"Mahony": 10, "Madgwick": 10, "imufusion": 10, "VQF": 10})
    log, part, _ = _log()
    told: list[str] = []
    _, skipped = tracks_of(log, [part], PERIOD, told=told.append)
    assert sum("its loop is too slow for 2000 samples" in sentence for sentence in skipped) == 4
    assert told == []


def test_the_truth_on_the_grid() -> None:
    places = np.arange(100)
    parts = [Part(0.0, np.zeros((100, 1)), places, places), Part(5.0, np.zeros((100, 1)), places, places)]
    t = np.concatenate([np.arange(0.0, 0.5, 0.02), np.arange(0.8, 3.0, 0.02)])
    angle = np.angle(np.exp(1j * (3.0 + t)))
    first, second = on_grid(t, angle, parts, 0.01)
    at = 0.01 * np.arange(100)
    inside = (at <= 0.48) | (at >= 0.8)
    assert np.allclose(first[inside], 3.0 + at[inside])
    assert np.isnan(first[~inside]).all()
    assert np.isnan(second).all()


def test_mean_angle() -> None:
    assert abs(mean_angle(np.array([np.pi - 0.1, -np.pi + 0.3]))) == pytest.approx(np.pi - 0.1)

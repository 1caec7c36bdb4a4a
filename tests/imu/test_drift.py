"""Drift: biases, drifts and lags that were put into a log are recovered; the smoothed angle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import allantools
import numpy as np
import pytest
from armlogs import swung
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from calib.io.logs import Log
from calib.solve.clock import Part
from calib.stages.imu.drift import allan_at, analyse_drift, lag_s, slope_of
from calib.stages.imu.mahony import Mahony, advance, filter_log
from calib.stages.imu.read import Reading, drift_log, tune_log
from calib.stages.imu.sampling import Readings
from calib.stages.imu.tracks import Tuned, tracks_of
from calib.stages.imu.tuning import smooth_log

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
PERIOD = 0.01


def _log(
    phi: np.ndarray, rate: np.ndarray, bias: float = 0.006, seed: int = 0, tilt: float = 0.0
) -> Readings:
    """A sensor at the angle phi, out of the plane of gravity by `tilt`; no acceleration of its own."""
    rng = np.random.default_rng(seed)
    n = len(phi)
    t = PERIOD * np.arange(n)
    c, s = np.cos(tilt), np.sin(tilt)
    values = np.stack(
        [0 * t, 0 * t, -rate, 9.81 * c * np.cos(phi), 9.81 * c * np.sin(phi), 0 * t + 9.81 * s], axis=1
    )
    values += [0.0, 0.0, bias, 0.0, 0.0, 0.0]
    values[:, :3] += 2e-3 * rng.normal(size=(n, 3))
    values[:, 3:] += 0.02 * rng.normal(size=(n, 3))
    return Readings("log.csv", AXES, t, values)


def _at_rest(n: int = 24000, bias: float = 0.006, seed: int = 0) -> Readings:
    return _log(np.full(n, 0.2), np.zeros(n), bias, seed)


def test_a_log_at_rest() -> None:
    log = _at_rest()
    chip = 0.2 + 0.3 + np.radians(0.145) * log.t_s
    result = analyse_drift(replace(log, onchip_t_s=log.t_s, onchip_phi_rad=chip), peers=False).section
    found = result.methods
    on_chip, accel, gyro = (found[x] for x in ("on the chip", "accelerometer alone", "gyroscope alone"))
    assert (result.against, result.moving_s) == ("rest", 0.0)
    assert result.judged_s == pytest.approx(235.0, abs=0.1)
    assert on_chip.slope_degps == pytest.approx(0.145, rel=1e-6)
    middle = 0.5 * (5.0 + 240.0)
    assert math.radians(on_chip.offset_deg) == pytest.approx(0.3 + np.radians(0.145) * middle, abs=1e-3)
    low, high = gyro.interval_degps
    assert low < math.degrees(-0.006) < high
    # The filter takes the bias out whole: what is left is the accelerometer's.
    for name in ("accelerometer alone", "MM 3/3", "MM 3/3 with up vector"):
        low, high = found[name].interval_degps
        assert low < 0.0 < high
        assert abs(found[name].slope_degps) < math.degrees(1e-6)
        assert abs(found[name].offset_deg) < math.degrees(1e-4)
    # A ramp b t has the Allan deviation b tau / sqrt(2).
    assert math.radians(on_chip.allan_1s_deg) == pytest.approx(np.radians(0.145) / np.sqrt(2.0), rel=1e-6)
    assert math.radians(gyro.allan_100s_deg) == pytest.approx(0.6 / np.sqrt(2.0), rel=0.02)
    # White noise of the accelerometer falls with the root of the averaging time.
    assert math.radians(accel.allan_1s_deg) == pytest.approx(0.02 / 9.81 / 10.0, rel=0.1)
    assert all(m.rmse_deg is None and m.lag_ms is None for m in found.values())


def test_a_log_in_motion_with_truth() -> None:
    t = PERIOD * np.arange(6000)
    phi, rate = 0.5 * np.sin(3.0 * t), 1.5 * np.cos(3.0 * t)
    log = _log(phi, rate)
    late = 0.1 + 0.5 * np.sin(3.0 * (t - 0.03))
    log = replace(log, true_t_s=t, true_phi_rad=phi - 0.05, onchip_t_s=t, onchip_phi_rad=late)
    result = analyse_drift(log, peers=False).section
    found = result.methods
    on_chip, accel, gyro = (found[x] for x in ("on the chip", "accelerometer alone", "gyroscope alone"))
    assert result.against == "truth"
    assert result.moving_s == pytest.approx(60.0, abs=0.5)
    assert 1e-3 * on_chip.lag_ms == pytest.approx(0.03, abs=5e-4)
    # The constant mount offset is in the offset, not in the RMSE.
    assert math.radians(on_chip.offset_deg) == pytest.approx(0.15, abs=2e-3)
    assert math.radians(on_chip.rmse_deg) == pytest.approx(
        0.5 * 2.0 * np.sin(0.5 * 3.0 * 0.03) / np.sqrt(2.0), rel=0.02
    )
    assert math.radians(accel.rmse_deg) == pytest.approx(0.02 / 9.81, rel=0.05)
    assert math.radians(accel.offset_deg) == pytest.approx(0.05, abs=1e-3)
    assert math.radians(gyro.slope_degps) == pytest.approx(-0.006, rel=0.05)
    # Summing the rate of a step's end is half a step ahead.
    assert 1e-3 * gyro.lag_ms == pytest.approx(-0.5 * PERIOD, abs=5e-4)


def test_a_truth_that_comes_late_is_moved() -> None:
    t = PERIOD * np.arange(6000)
    phi, rate = 0.5 * np.sin(3.0 * t), 1.5 * np.cos(3.0 * t)
    log = replace(_log(phi, rate), true_t_s=t + 0.0148, true_phi_rad=phi)
    result = analyse_drift(log, peers=False).section
    accel = result.methods["accelerometer alone"]
    assert math.radians(accel.rmse_deg) == pytest.approx(0.02 / 9.81, rel=0.1)
    assert abs(accel.lag_ms) < 0.5
    assert "14.8 ms later" in result.remarks[0]


@pytest.mark.parametrize("late_s", [0.0148, 0.0])
def test_tuning_moves_a_truth_that_comes_late(late_s: float) -> None:
    """At 1 kHz, with a bias of 5 deg/s, which the ends of a stretch show."""
    t = 0.001 * np.arange(40_000)
    phi, rate = 0.5 * np.sin(0.6 * (t - late_s)), 0.3 * np.cos(0.6 * t)
    columns = {"ax_mps2": 9.8 * np.cos(phi), "ay_mps2": 9.8 * np.sin(phi), "gz_radps": 0.09 - rate}
    columns["gz_radps"] = columns["gz_radps"] + 0.004 * np.random.default_rng(0).normal(size=len(t))
    log = Log("log.csv", t, columns | {"true_phi_rad": phi}, np.arange(len(t)))
    assert tune_log(log, Reading(False, "truth")).lag_s == pytest.approx(late_s, abs=1e-3)


def test_a_truth_in_bursts_is_where_the_readings_are() -> None:
    t = PERIOD * np.arange(4000)
    turning = _log(0.5 * np.sin(0.6 * t), 0.3 * np.cos(0.6 * t)).values
    stamps = t[np.minimum(np.arange(4000) // 10 * 10 + 9, 3999)]
    columns = {"gz_radps": turning[:, 2], "ax_mps2": turning[:, 3], "ay_mps2": turning[:, 4]}
    log = Log("log.csv", stamps, columns | {"true_phi_rad": 0.5 * np.sin(0.6 * t)}, np.arange(4000))
    truth = analyse_drift(drift_log(log), peers=False).truth_rad
    assert truth is not None
    assert np.isfinite(truth[0]).mean() > 0.99


def test_a_truth_of_another_motion_is_told() -> None:
    t = PERIOD * np.arange(4000)
    phi, rate = 0.5 * np.sin(0.6 * t), 0.3 * np.cos(0.6 * t)
    log = replace(_log(phi, rate), true_t_s=t, true_phi_rad=phi)
    assert not analyse_drift(log, peers=False).findings
    (finding,) = analyse_drift(replace(log, true_phi_rad=-phi), peers=False).findings
    assert "rate and true_phi_rad contradict each other" in finding.text


Noise = Callable[[np.random.Generator, int], np.ndarray]


def _white(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.normal(size=n)


def _forgetting(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.asarray(lfilter([1.0], [1.0, -0.99], rng.normal(size=n)))


def _walk(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.cumsum(rng.normal(size=n))


def _both(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.normal(size=n) + 0.03 * np.cumsum(rng.normal(size=n))


def test_the_slope_is_that_of_a_straight_line() -> None:
    t = 0.01 * np.arange(5000)
    y = 0.3 + 0.02 * t + _white(np.random.default_rng(0), 5000)
    assert slope_of([y], 0.01).value == pytest.approx(np.polyfit(t, y, 1)[0], rel=1e-9)
    # Each stretch has an offset of its own.
    pieces = [0.02 * t[:2000] + 5.0, 0.02 * t[2000:] - 7.0]
    assert slope_of(pieces, 0.01).value == pytest.approx(0.02, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [_white, _forgetting, _walk, _both])
@pytest.mark.parametrize("n", [1000, 6000])
def test_the_interval_holds_the_slope(noise: Noise, n: int) -> None:
    rng = np.random.default_rng(n)
    held, naive, values = 0, 0, []
    for _ in range(120):
        y = 0.5 * 0.01 * np.arange(n) + noise(rng, n)
        slope = slope_of([y], 0.01)
        held += slope.low <= 0.5 <= slope.high
        values.append(slope.value)
        t = 0.01 * (np.arange(n) - 0.5 * (n - 1))
        white = np.std(y - y.mean() - slope.value * t) / np.sqrt((t * t).sum())
        naive += abs(slope.value - 0.5) <= 1.96 * white
    # 0.95 less the four deviations of 120 tries is 0.87; mixed noise on a short log is the hardest.
    assert held >= (0.80 if noise is _both else 0.87) * 120
    if noise in (_forgetting, _walk):
        assert naive < 0.5 * 120
    # The interval is not bought by being useless.
    assert np.median(np.abs(values)) < 1e3


def test_allan_deviation_against_allantools() -> None:
    y = _both(np.random.default_rng(2), 30000)
    for tau in (1.0, 100.0):
        _, found, _, _ = allantools.oadev(y, rate=100.0, data_type="freq", taus=[tau])
        assert allan_at([y], 0.01, tau) == pytest.approx(found[0], rel=1e-9)
    assert np.isnan(allan_at([y[:19000]], 0.01, 100.0))
    assert np.isnan(allan_at([], 0.01, 1.0))


@pytest.mark.parametrize("lag", [0.0, 0.0123, -0.0047, 0.1, 0.25])
def test_lag_to_a_fraction_of_a_sample(lag: float) -> None:
    t = 0.01 * np.arange(6000)

    def angle(at: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * np.sin(2.0 * at) + 0.2 * np.sin(9.0 * at + 1.0) + 0.1 * np.sin(3.3 * at))

    noisy = angle(t - lag) + 0.3 + 0.01 * t + 0.01 * np.random.default_rng(0).normal(size=len(t))
    assert lag_s([noisy[:2500], noisy[2500:]], [angle(t[:2500]), angle(t[2500:])], 0.01) == pytest.approx(
        lag, abs=5e-4
    )


@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_a_truth_is_placed_in_time_when_the_sensor_tilts(late_s: float) -> None:
    """There -gz is not the rate of the angle, and a truth in time seemed 8 ms early."""
    t = PERIOD * np.arange(3000)
    about_x, about_z = 0.6 * np.sin(2.0 * t) + 0.3, 0.5 * np.sin(2.6 * t) + 0.3 * np.sin(4.1 * t)
    turns = Rotation.from_euler("XYZ", np.stack([about_x, 0.4 * np.sin(1.7 * t), about_z], axis=1))
    up = turns.inv().apply([0.0, 1.0, 0.0])
    between = (turns[:-1].inv() * turns[1:]).as_rotvec() / PERIOD
    gyro = 0.5 * (np.vstack([between[:1], between]) + np.vstack([between, between[-1:]]))
    log = Readings("log.csv", AXES, t, np.concatenate([gyro, 9.80665 * up], axis=1))
    truth = np.unwrap(np.arctan2(up[:, 1], up[:, 0]))
    found = analyse_drift(replace(log, true_t_s=t + late_s, true_phi_rad=truth), peers=False).section
    lag_ms = found.methods["levelling in three axes"].lag_ms
    assert lag_ms is not None and abs(lag_ms) < 1.0
    assert bool(found.remarks) == bool(late_s)


def _log_tracks(
    n: int = 2000, axes: tuple[str, ...] = AXES, bias: float = 0.01
) -> tuple[Readings, Part, np.ndarray]:
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
    log = Readings("log.csv", axes, t, values, t, phi + 0.1)
    places = np.arange(n)
    return log, Part(t, values, places, places), phi


def test_the_sensors_alone_and_the_filter() -> None:
    log, part, phi = _log_tracks()
    found, skipped = tracks_of(log, [part], PERIOD, Tuned(Mahony(1.0, 0.25)), False, print)
    angles = {track.name: track.phi_rad[0] for track in found}
    assert list(angles) == [
        "on the chip",
        "gyroscope alone",
        "accelerometer alone",
        "MM 3/3",
        "levelling",
        "tuned",
        "MM 3/3 with up vector",
        "levelling in three axes",
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
    phi, integral = float(angles["MM 3/3"][0]), 0.0
    for k in range(1, 300):
        gz, ax, ay = part.values[k, 2:5].tolist()
        phi, integral = advance(phi, integral, math.atan2(ay, ax), -gz, PERIOD, 3.0, 3.0)
        assert phi == pytest.approx(angles["MM 3/3"][k], abs=1e-12)


N, K = math.radians(0.01), 1e-4


def _spread(error: np.ndarray) -> float:
    return float((error - error.mean()).std())


@pytest.mark.few(0)
@pytest.mark.parametrize("seed", range(4))
def test_beats_the_filter_on_a_swung_arm(seed: int) -> None:
    arm = swung(seed)
    found = smooth_log(arm.t_s, arm.phi_acc, -arm.gz, N, K)
    filtered = filter_log(Mahony(), arm.t_s, arm.phi_acc, -arm.gz)[0]
    assert _spread(found.phi_rad - arm.phi) < 0.3 * _spread(filtered - arm.phi)
    assert found.bias_radps == pytest.approx(0.005, abs=2e-3)


def test_a_straight_model_is_met_with_the_deviation_that_it_says() -> None:
    ratios, noise = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        t = 0.01 * np.arange(3000)
        phi = 0.3 * np.sin(0.5 * t)
        bias = 0.05 * rng.normal()
        rate = 0.15 * np.cos(0.5 * t) + bias + N / 0.1 * rng.normal(size=3000)
        # The rate of a sample holds for the step before it.
        rate[1:] += np.diff(phi) / 0.01 - 0.15 * np.cos(0.5 * t[1:])
        acc = phi + 0.02 * rng.normal(size=3000)
        found = smooth_log(t, acc, rate, N, K)
        ratios.append(np.sqrt(np.mean((found.phi_rad - phi) ** 2)) / found.sigma_rad)
        noise.append(found.accel_noise)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.35)
    assert np.median(noise) == pytest.approx(0.02 * 0.1, rel=0.5)

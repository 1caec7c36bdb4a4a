"""The comparison recovers biases, drifts and lags that were put into a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.drift import LogDrift, Measures, analyse_drift, spread_of
from calib.imu.tracks import DriftLog

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
PERIOD = 0.01
NONE = np.zeros(0)


def _log(
    phi: np.ndarray, rate: np.ndarray, bias: float = 0.006, seed: int = 0, tilt: float = 0.0
) -> DriftLog:
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
    return DriftLog("log.csv", AXES, t, values, NONE, NONE, NONE, NONE)


def _at_rest(n: int = 24000, bias: float = 0.006, seed: int = 0) -> DriftLog:
    return _log(np.full(n, 0.2), np.zeros(n), bias, seed)


def _by_name(result: LogDrift) -> dict[str, Measures]:
    return {m.name: m for m in result.measures}


def test_a_log_at_rest() -> None:
    log = _at_rest()
    chip = 0.2 + 0.3 + np.radians(0.145) * log.t_s
    result = analyse_drift(replace(log, onchip_t_s=log.t_s, onchip_phi_rad=chip), peers=False)
    found = _by_name(result)
    assert (result.against, result.moving_s) == ("rest", 0.0)
    assert result.judged_s == pytest.approx(235.0, abs=0.1)
    assert np.degrees(found["on the chip"].slope.value) == pytest.approx(0.145, rel=1e-6)
    middle = 0.5 * (5.0 + 240.0)
    assert found["on the chip"].offset_rad == pytest.approx(0.3 + np.radians(0.145) * middle, abs=1e-3)
    gyro = found["gyroscope alone"].slope
    assert gyro.low < -0.006 < gyro.high
    # The filter takes the bias out whole: what is left is the accelerometer's.
    for name in ("accelerometer alone", "MM 3/3", "MM 3/3 with up vector"):
        slope = found[name].slope
        assert slope.low < 0.0 < slope.high
        assert abs(slope.value) < 1e-6
        assert abs(found[name].offset_rad) < 1e-4
    # A ramp b t has the Allan deviation b tau / sqrt(2).
    assert found["on the chip"].allan_1s_rad == pytest.approx(np.radians(0.145) / np.sqrt(2.0), rel=1e-6)
    assert found["gyroscope alone"].allan_100s_rad == pytest.approx(0.6 / np.sqrt(2.0), rel=0.02)
    # White noise of the accelerometer falls with the root of the averaging time.
    assert found["accelerometer alone"].allan_1s_rad == pytest.approx(0.02 / 9.81 / 10.0, rel=0.1)
    assert all(np.isnan(m.rmse_rad) and np.isnan(m.lag_s) for m in result.measures)


def test_a_log_in_motion_with_truth() -> None:
    t = PERIOD * np.arange(6000)
    phi, rate = 0.5 * np.sin(3.0 * t), 1.5 * np.cos(3.0 * t)
    log = _log(phi, rate)
    late = 0.1 + 0.5 * np.sin(3.0 * (t - 0.03))
    log = replace(log, true_t_s=t, true_phi_rad=phi - 0.05, onchip_t_s=t, onchip_phi_rad=late)
    result = analyse_drift(log, peers=False)
    found = _by_name(result)
    assert result.against == "truth"
    assert result.moving_s == pytest.approx(60.0, abs=0.5)
    assert found["on the chip"].lag_s == pytest.approx(0.03, abs=5e-4)
    # The constant mount offset is in the offset, not in the RMSE.
    assert found["on the chip"].offset_rad == pytest.approx(0.15, abs=2e-3)
    assert found["on the chip"].rmse_rad == pytest.approx(
        0.5 * 2.0 * np.sin(0.5 * 3.0 * 0.03) / np.sqrt(2.0), rel=0.02
    )
    assert found["accelerometer alone"].rmse_rad == pytest.approx(0.02 / 9.81, rel=0.05)
    assert found["accelerometer alone"].offset_rad == pytest.approx(0.05, abs=1e-3)
    assert found["gyroscope alone"].slope.value == pytest.approx(-0.006, rel=0.05)
    # Summing the rate of a step's end is half a step ahead.
    assert found["gyroscope alone"].lag_s == pytest.approx(-0.5 * PERIOD, abs=5e-4)


def test_angles_may_turn_all_the_way_round() -> None:
    t = PERIOD * np.arange(4000)
    phi = 1.3 * t + 0.3 * np.sin(2.0 * t)
    log = _log(phi, 1.3 + 0.6 * np.cos(2.0 * t), bias=0.0)
    wrapped = np.angle(np.exp(1j * phi))
    found = _by_name(analyse_drift(replace(log, true_t_s=t, true_phi_rad=wrapped), peers=False))
    for name in ("gyroscope alone", "accelerometer alone", "MM 3/3"):
        assert found[name].rmse_rad < 0.02
        assert abs(found[name].offset_rad) < 0.02


def test_a_log_in_motion_without_truth_shows_its_rests() -> None:
    t = PERIOD * np.arange(6000)
    moving = (t > 20.0) & (t < 40.0)
    phi = np.where(moving, 0.5 * np.sin(3.0 * (t - 20.0)), 0.0) + np.where(t >= 40.0, 0.4, 0.0)
    result = analyse_drift(_log(phi, np.gradient(phi, PERIOD)), peers=False)
    found = _by_name(result)
    assert result.against == "rest"
    assert result.moving_s == pytest.approx(20.0, abs=2.0)
    assert result.judged_s == pytest.approx(30.0, abs=3.0)
    assert found["gyroscope alone"].slope.value == pytest.approx(-0.006, rel=0.03)
    assert np.isnan(found["MM 3/3"].rmse_rad)


def test_a_log_that_never_rests_shows_nothing() -> None:
    t = PERIOD * np.arange(3000)
    result = analyse_drift(_log(0.5 * np.sin(3.0 * t), 1.5 * np.cos(3.0 * t)), peers=False)
    assert result.against == "nothing"
    assert all(np.isnan(m.slope.value) and np.isnan(m.offset_rad) for m in result.measures)


def test_a_long_gap_splits_the_log() -> None:
    log = _at_rest(6000)
    t = log.t_s + np.where(np.arange(6000) >= 3000, 3600.0, 0.0)
    result = analyse_drift(replace(log, t_s=t), peers=False)
    assert len(result.start_s) == 2
    assert result.start_s[1] == pytest.approx(3630.0)
    # Over the gap itself the gyroscope would have gone astray by 21 rad.
    assert _by_name(result)["gyroscope alone"].slope.value == pytest.approx(-0.006, rel=0.03)


def test_mean_and_spread_over_logs() -> None:
    biases = (0.004, 0.006, 0.011)
    logs = [analyse_drift(_at_rest(3000, bias, k), peers=False) for k, bias in enumerate(biases)]
    spread = {one.name: one for one in spread_of(logs)}
    gyro = spread["gyroscope alone"]
    assert (gyro.mean_radps, gyro.logs) == (pytest.approx(-np.mean(biases), abs=3e-4), 3)
    assert gyro.spread_radps == pytest.approx(np.std(biases, ddof=1), abs=3e-4)
    assert spread["MM 3/3"].spread_radps < 1e-4
    assert np.isnan(spread_of(logs[:1])[0].spread_radps)


def test_bad_input_is_refused() -> None:
    log = _at_rest(3000)
    lacking = replace(log, axes=AXES[:4], values=log.values[:, :4])
    with pytest.raises(BadInputError, match=r"log\.csv: has no readings of ay"):
        analyse_drift(lacking)
    with pytest.raises(BadInputError, match="is 1 s long without a long gap"):
        analyse_drift(replace(log, t_s=log.t_s[:100], values=log.values[:100]))

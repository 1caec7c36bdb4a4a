"""Bias, noise and drift recovered from the simulated sensor, and intervals that hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.static import AXES, RestLog, analyse_static
from calib.imu.static_verdict import judge
from calib.twin.imu_sensor import Imu, draw_imu_noise, measure
from calib.twin.sensors import HeadMotion

IMU = Imu(gyro_scale=(0.0, 0.0, 0.0), accel_scale=(0.0, 0.0, 0.0), mount_angle_rad=0.0)


def _at_rest(n: int) -> HeadMotion:
    zero = np.zeros(n)
    return HeadMotion(zero, zero, zero, np.zeros((n, 2)), np.zeros((n, 2)))


def rest_log(imu: Imu, duration_s: float, seed: int, source: str = "log.csv") -> tuple[RestLog, np.ndarray]:
    """Readings of the simulated sensor, and what its biases are at the end, without the white noise."""
    noise = draw_imu_noise(imu, duration_s, seed)
    force, rate = measure(imu, noise, slice(None), _at_rest(len(noise.taken_s)))
    silent = draw_imu_noise(replace(imu, gyro_noise=0.0, accel_noise=0.0), duration_s, seed)
    end = np.concatenate([silent.gyro[-1], silent.accel[-1] + [9.81, 0.0, 0.0]])
    values = np.concatenate([rate, force], axis=1)
    return RestLog(source, AXES, noise.stamp_s, values, np.zeros(0), np.zeros(0)), end


def test_the_simulated_sensor_is_recovered() -> None:
    log, _ = rest_log(IMU, 300.0, 1)
    found = analyse_static([log])
    assert found.rate_hz == pytest.approx(100.0, rel=1e-4)
    assert judge(found).verdict == "ok"
    for k, noise in enumerate(found.noise):
        gyro = k < 3
        density = IMU.gyro_noise if gyro else IMU.accel_noise
        step = IMU.gyro_step_radps if gyro else IMU.accel_step_mps2
        # Rounding adds the variance step^2 / 12 to every sample.
        true = np.sqrt(density**2 + step**2 / 12.0 / IMU.rate_hz)
        assert noise.allan is not None
        assert abs(noise.allan.N.value - true) < 4.0 * noise.allan.N.sigma
        assert noise.allan.N.sigma < 0.01 * true
        assert found.logs[0].sampling.step[k] == pytest.approx(step, rel=1e-6)
    bias = found.noise[2]
    assert bias.low < IMU.gyro_bias_radps[2] < bias.high
    drift = found.logs[0].gyro
    assert drift is not None
    assert drift.slope_radps == pytest.approx(-bias.bias)
    assert drift.sigma_radps == pytest.approx(IMU.gyro_noise / np.sqrt(300.0), rel=0.1)


@pytest.mark.slow
def test_the_interval_holds_the_bias_that_is_met_after_the_log() -> None:
    held, naive, total = 0, 0, 0
    for seed in range(30):
        log, end = rest_log(replace(IMU, gyro_walk=3e-5, accel_walk=2e-4), 120.0, seed)
        for k, noise in enumerate(analyse_static([log]).noise):
            held += noise.low <= end[k] <= noise.high
            naive += abs(noise.bias - end[k]) <= 1.96 * noise.sigma_mean
            total += 1
    assert held >= 0.9 * total
    # White noise alone would promise far too much.
    assert naive <= 0.6 * total


@pytest.mark.slow
def test_densities_lie_in_their_intervals() -> None:
    imu = replace(IMU, gyro_walk=3e-4, accel_walk=2e-3, gyro_step_radps=0.0, accel_step_mps2=0.0)
    held_N, held_K, total = 0, 0, 0
    for seed in range(15):
        for k, noise in enumerate(analyse_static([rest_log(imu, 600.0, seed)[0]]).noise):
            assert noise.allan is not None
            density, walk = (imu.gyro_noise, imu.gyro_walk) if k < 3 else (imu.accel_noise, imu.accel_walk)
            held_N += noise.allan.N.low <= density <= noise.allan.N.high
            held_K += noise.allan.K.supported and noise.allan.K.low <= walk <= noise.allan.K.high
            total += 1
    assert held_N >= 0.88 * total
    assert held_K >= 0.85 * total


def test_several_logs_give_mean_and_spread() -> None:
    logs, biases = [], (0.004, 0.006, 0.011)
    for seed, bias in enumerate(biases):
        logs.append(rest_log(replace(IMU, gyro_bias_radps=(0.0, 0.0, bias)), 60.0, seed, f"{seed}.csv")[0])
    found = analyse_static(logs)
    gz = found.noise[2]
    assert gz.bias == pytest.approx(np.mean(biases), abs=2e-4)
    assert gz.spread == pytest.approx(np.std(biases, ddof=1), rel=0.1)
    # Student's 97.5 % point with two degrees of freedom is 4.30.
    assert gz.high - gz.bias == pytest.approx(4.3027 * gz.spread / np.sqrt(3.0), rel=1e-3)
    slopes = [log.gyro.slope_radps for log in found.logs if log.gyro is not None]
    assert np.allclose(slopes, -np.array(biases), atol=3e-4)
    one = analyse_static(logs[:1]).noise[2]
    assert np.isnan(one.spread)
    assert one.allan is not None
    assert gz.allan is not None
    assert gz.allan.N.sigma < 0.7 * one.allan.N.sigma


def test_the_drift_on_the_chip() -> None:
    log, _ = rest_log(IMU, 60.0, 3)
    rng = np.random.default_rng(3)
    wander = np.cumsum(1e-4 * rng.normal(size=len(log.t_s)))
    angle = np.angle(np.exp(1j * (3.0 + 0.01 * log.t_s + wander)))
    drift = analyse_static([replace(log, onchip_t_s=log.t_s, onchip_phi_rad=angle)]).logs[0].onchip
    assert drift is not None
    expected = np.polyfit(log.t_s, np.unwrap(angle), 1)[0]
    assert drift.slope_radps == pytest.approx(expected, rel=1e-9)
    # A walk of q per sample ends q sqrt(rate T) away, which over T is a slope of q sqrt(rate / T).
    assert drift.sigma_radps == pytest.approx(1e-4 * np.sqrt(100.0 / 60.0), rel=0.7)


def test_motion_is_left_out_and_makes_it_poor() -> None:
    log, _ = rest_log(IMU, 60.0, 4)
    moved = log.values.copy()
    moved[2000:2300, 2] += 0.3 * np.sin(0.05 * np.arange(300))
    found = analyse_static([replace(log, values=moved)])
    judged = judge(found)
    assert judged.verdict == "poor"
    assert "log.csv: moves from 20.0 to 23.0 s, seen most in gz" in judged.reasons[0]
    assert found.logs[0].gyro is None
    assert found.noise[2].bias == pytest.approx(IMU.gyro_bias_radps[2], abs=3e-4)


def test_a_stuck_axis_is_named() -> None:
    log, _ = rest_log(IMU, 60.0, 5)
    values = log.values.copy()
    values[:, 1] = -0.0031
    found = analyse_static([replace(log, values=values)])
    assert found.noise[1].allan is None
    judged = judge(found)
    assert judged.verdict == "poor"
    assert any("gy never changes: it is stuck at -0.0031" in reason for reason in judged.reasons)


def test_a_part_of_the_axes_is_enough() -> None:
    log, _ = rest_log(IMU, 60.0, 6)
    some = [2, 3, 4]
    found = analyse_static([replace(log, axes=tuple(AXES[k] for k in some), values=log.values[:, some])])
    assert [noise.axis for noise in found.noise] == ["gz", "ax", "ay"]
    assert found.logs[0].gyro is not None


def test_logs_that_do_not_go_together() -> None:
    one, _ = rest_log(IMU, 10.0, 7)
    other, _ = rest_log(replace(IMU, rate_hz=50.0), 10.0, 7, "other.csv")
    with pytest.raises(
        BadInputError, match=r"other\.csv: is sampled at 50 Hz, expected 100 Hz as in log\.csv"
    ):
        analyse_static([one, other])
    with pytest.raises(BadInputError, match=r"other\.csv: has the axes gx, gy, expected gx, gy, gz"):
        analyse_static([one, replace(other, axes=("gx", "gy"), values=other.values[:, :2])])
    with pytest.raises(BadInputError, match="expected at least one"):
        analyse_static([])
    short = replace(one, t_s=one.t_s[:50], values=one.values[:50])
    with pytest.raises(BadInputError, match=r"log\.csv: has 50 IMU samples without a long gap"):
        analyse_static([short])
    shaken = replace(one, values=one.values + 0.5 * np.sin(np.arange(len(one.t_s)))[:, None])
    with pytest.raises(BadInputError, match=r"log\.csv: is never at rest"):
        analyse_static([shaken])


def test_a_short_log_is_poor() -> None:
    log, _ = rest_log(IMU, 1.0, 8)
    reasons = judge(analyse_static([log])).reasons
    assert any("1 s at rest are too short" in reason for reason in reasons)

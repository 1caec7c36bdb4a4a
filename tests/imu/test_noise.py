"""Noise at rest: Allan variance, N, B and K, biases with intervals that hold, and the sampling of logs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import allantools
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from calib.solve.clock import Part
from calib.stages.imu.allan import (
    Term,
    _whitened,
    allan_variance,
    analyse,
    bounds,
    covariance_forms,
    degrees_of_freedom,
    design,
    spaced,
)
from calib.stages.imu.formats import from_kalibr, to_kalibr
from calib.stages.imu.sampling import AXES, Readings, regular_parts, rest_parts
from calib.stages.imu.section import Imu as ImuSection
from calib.stages.imu.static import analyse_static, judge, solve_static
from calib.twin.sensors import HeadMotion, Imu, draw_imu_noise, measure

IMU = Imu(gyro_scale=(0.0, 0.0, 0.0), accel_scale=(0.0, 0.0, 0.0), mount_angle_rad=0.0)


def _at_rest(n: int) -> HeadMotion:
    zero = np.zeros(n)
    return HeadMotion(zero, zero, zero, np.zeros((n, 2)))


def rest_log(imu: Imu, duration_s: float, seed: int, source: str = "log.csv") -> tuple[Readings, np.ndarray]:
    """Readings of the simulated sensor, and what its biases are at the end, without the white noise."""
    noise = draw_imu_noise(imu, duration_s, seed)
    force, rate = measure(imu, noise, slice(None), _at_rest(len(noise.taken_s)))
    silent = draw_imu_noise(replace(imu, gyro_noise=0.0, accel_noise=0.0), duration_s, seed)
    end = np.concatenate([silent.gyro[-1], silent.accel[-1] + [9.81, 0.0, 0.0]])
    values = np.concatenate([rate, force], axis=1)
    return Readings(source, AXES, noise.stamp_s, values), end


def test_the_simulated_sensor_is_recovered() -> None:
    log, _ = rest_log(IMU, 300.0, 1)
    found = analyse_static([log])
    assert found.rate_hz == pytest.approx(100.0, rel=1e-4)
    assert judge(found).ok
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
    assert abs(bias.bias - IMU.gyro_bias_radps[2]) < 1.96 * bias.sigma
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
            assert noise.allan is not None
            held += abs(noise.bias - end[k]) <= 1.96 * noise.sigma
            naive += abs(noise.bias - end[k]) <= 1.96 * noise.allan.N.value / np.sqrt(120.0)
            total += 1
    assert held >= 0.9 * total
    # White noise alone would promise far too much.
    assert naive <= 0.6 * total


def _within(term: Term, truth: float) -> bool:
    """Whether the 95 % interval holds the truth, as of the logarithm, which keeps it positive."""
    return abs(math.log(truth / term.value)) <= 1.96 * term.sigma / term.value


@pytest.mark.slow
def test_densities_lie_in_their_intervals() -> None:
    imu = replace(IMU, gyro_walk=3e-4, accel_walk=2e-3, gyro_step_radps=0.0, accel_step_mps2=0.0)
    held_N, held_K, total = 0, 0, 0
    for seed in range(15):
        for k, noise in enumerate(analyse_static([rest_log(imu, 600.0, seed)[0]]).noise):
            assert noise.allan is not None
            density, walk = (imu.gyro_noise, imu.gyro_walk) if k < 3 else (imu.accel_noise, imu.accel_walk)
            held_N += _within(noise.allan.N, density)
            held_K += noise.allan.K.supported and _within(noise.allan.K, walk)
            total += 1
    assert held_N >= 0.88 * total
    assert held_K >= 0.85 * total


def test_noise_that_long_times_alone_colour_is_white_at_short_ones() -> None:
    rng, n, period_s = np.random.default_rng(1), 120_000, 0.004
    share = math.exp(-period_s / 14.0)
    slow = lfilter([1.4 * math.sqrt(1.0 - share**2)], [1.0, -share], rng.normal(size=(2, n)))
    found = analyse([rng.normal(size=n) / math.sqrt(period_s) + slow[1]], period_s)
    assert found.fit_s[0] == period_s
    assert found.N.value == pytest.approx(1.0, abs=4.0 * found.N.sigma)


def test_a_covariance_that_sums_leave_indefinite_still_weighs() -> None:
    A = np.random.default_rng(0).normal(size=(5, 5))
    C = A @ A.T
    white = _whitened(C, np.eye(5))
    assert white @ C @ white.T == pytest.approx(np.eye(5), abs=1e-9)
    values, V = np.linalg.eigh(np.full((5, 5), 0.999) + 0.001 * np.eye(5))
    indefinite = (V * (values - 0.0015)) @ V.T
    assert np.abs(_whitened(indefinite, np.ones(5))).max() < 10.0


def test_several_logs_give_their_mean_and_its_spread() -> None:
    logs, biases = [], (0.004, 0.006, 0.011)
    for seed, bias in enumerate(biases):
        logs.append(rest_log(replace(IMU, gyro_bias_radps=(0.0, 0.0, bias)), 60.0, seed, f"{seed}.csv")[0])
    found = analyse_static(logs)
    gz = found.noise[2]
    assert gz.bias == pytest.approx(np.mean(biases), abs=2e-4)
    assert gz.sigma == pytest.approx(np.std(biases, ddof=1) / np.sqrt(3.0), rel=0.1)
    slopes = [log.gyro.slope_radps for log in found.logs if log.gyro is not None]
    assert np.allclose(slopes, -np.array(biases), atol=3e-4)
    one = analyse_static(logs[:1]).noise[2]
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
    assert judged.word == "poor"
    assert "log.csv: moves from 20.0 to 23.0 s, seen most in gz" in judged.reasons[0]
    assert found.logs[0].gyro is None
    assert found.noise[2].bias == pytest.approx(IMU.gyro_bias_radps[2], abs=3e-4)


def test_a_short_bump_in_a_long_log_is_cut_out_and_named() -> None:
    log, _ = rest_log(replace(IMU, gyro_walk=0.0, accel_walk=0.0), 600.0, 4)
    bumped = log.values.copy()
    bumped[20000:20150] += 0.5 * np.sin(0.4 * np.arange(150))[:, None]
    found = analyse_static([replace(log, values=bumped)])
    judged = judge(found)
    assert judged.word == "ok"
    assert any("moves from 200.0 to 202.0 s" in text for text in judged.remarks)
    assert found.noise[2].bias == pytest.approx(IMU.gyro_bias_radps[2], abs=1e-4)
    assert found.logs[0].gyro is not None
    # Touched, it lies in another pose afterwards.
    bumped[20150:, 4] += 9.8 * np.radians(0.5)
    assert "lies 0.5 deg otherwise" in " ".join(judge(analyse_static([replace(log, values=bumped)])).reasons)


@pytest.mark.parametrize("at_s", [120.0, 451.0])
def test_a_step_of_the_bias_is_told_with_what_it_does(at_s: float) -> None:
    log, _ = rest_log(replace(IMU, gyro_walk=0.0, accel_walk=0.0), 600.0, 5)
    stepped = log.values.copy()
    stepped[round(100.0 * at_s) :, 2] += np.radians(0.1)
    found = analyse_static([replace(log, values=stepped)])
    (step,) = found.logs[0].steps
    assert step.axis == 2 and step.at_s == pytest.approx(at_s, abs=3.0)
    assert step.size == pytest.approx(np.radians(0.1), rel=0.15)
    (told,) = [one.text for one in judge(found).findings if "steps by" in one.text]
    assert float(told.split("turns by ")[1].split(" deg")[0]) == pytest.approx(6.0, rel=0.15)


@pytest.mark.parametrize(
    ("axis", "size", "advice"), [(2, 0.01, "learn the bias at each rest"), (4, 0.05, "was touched then")]
)
def test_a_step_beyond_the_deviation_of_the_bias_makes_it_poor(axis: int, size: float, advice: str) -> None:
    log, _ = rest_log(replace(IMU, gyro_walk=0.0, accel_walk=0.0), 720.0, 5)
    stepped = log.values.copy()
    stepped[30000:, axis] += size
    judged = judge(analyse_static([replace(log, values=stepped)]))
    assert judged.word == "poor"
    assert any(f"the mean of {AXES[axis]} steps by" in text for text in judged.reasons)
    assert any(advice in text for text in judged.advice)


@pytest.mark.parametrize(
    ("sensor", "factor", "word", "told"),
    [
        *(("a", factor, "poor", "times gravity") for factor in (0.8, 1.4)),
        *(("a", factor, "ok", "times gravity") for factor in (0.95, 1.05)),
        ("g", math.pi / 180.0, "poor", "less than any small gyroscope"),
        *(("g", factor, "ok", "less than any small gyroscope") for factor in (1.0, 0.15)),
    ],
)
def test_a_scale_that_no_sensor_has_is_poor(sensor: str, factor: float, word: str, told: str) -> None:
    """Gravity tells an accelerometer's; a rate that was taken for degrees is too quiet."""
    log, _ = rest_log(Imu(), 120.0, 1)
    scaled = log.values * np.where([axis.startswith(sensor) for axis in AXES], factor, 1.0)
    judged = judge(analyse_static([replace(log, values=scaled)]))
    assert judged.word == word
    assert any(told in text for text in judged.reasons) == (word == "poor")


def test_a_rig_that_is_held_in_a_hand_is_not_at_rest() -> None:
    log, _ = rest_log(IMU, 120.0, 3)
    held = log.values.copy()
    share = np.exp(-2.0 * np.pi * 2.0 / 100.0)
    tremor = lfilter(
        [1.0 - share], [1.0, -share], np.random.default_rng(3).normal(size=(len(held), 3)), axis=0
    )
    held[:, :3] += 0.01 / tremor.std() * tremor
    judged = judge(analyse_static([replace(log, values=held)]))
    assert judged.word == "poor"
    assert any("more than any gyroscope has" in text for text in judged.reasons)


@pytest.mark.few(0)
@pytest.mark.parametrize(("axis", "size"), [(2, np.radians(0.3)), (4, 0.2)])
def test_a_bias_that_drifts_as_the_sensor_warms_up_makes_it_poor(axis: int, size: float) -> None:
    log, _ = rest_log(replace(IMU, gyro_walk=0.0, accel_walk=0.0), 720.0, 5)
    warm = log.values.copy()
    warm[:, axis] += size * (1.0 - np.exp(-log.t_s / 240.0))
    judged = judge(analyse_static([replace(log, values=warm)]))
    assert judged.word == "poor"
    assert any(f"the mean of {AXES[axis]} drifts by +" in text for text in judged.reasons)
    assert any("until its bias stays" in text for text in judged.advice)


def test_noise_and_a_walk_are_no_steps_and_no_drift() -> None:
    for seed in range(6):
        imu = replace(IMU, gyro_walk=3e-5 * 2.0**seed, accel_walk=3e-4)
        found = analyse_static([rest_log(imu, 400.0, seed)[0]])
        assert found.logs[0].steps == ()
        assert not any("drifts" in text for text in judge(found).reasons)


@pytest.mark.few(1, 2)
@pytest.mark.parametrize(
    ("axis", "size", "lasts_s", "word"),
    [(4, 0.005, 0.5, "ok"), (4, 0.005, 5.0, "ok"), (2, 0.002, 0.5, "poor")],
)
def test_coloured_noise_is_told_with_its_consequence(
    axis: int, size: float, lasts_s: float, word: str
) -> None:
    """0.005 m/s^2 are 0.03 deg; 0.002 rad/s, until a bias is learnt, more than 0.1."""
    log, _ = rest_log(replace(IMU, gyro_walk=0.0, accel_walk=0.0), 1200.0, 6)
    coloured = log.values.copy()
    share = np.exp(-1.0 / (100.0 * lasts_s))
    slow = lfilter(
        [np.sqrt(1.0 - share**2)], [1.0, -share], np.random.default_rng(6).normal(size=len(coloured))
    )
    coloured[:, axis] += size * slow
    judged = judge(analyse_static([replace(log, values=coloured)]))
    assert judged.word == word
    told = "trusts it by as much too" if word == "ok" else "do not describe it"
    assert any(
        f"{AXES[axis]}: its noise is coloured" in text and told in text
        for text in (*judged.reasons, *judged.remarks)
    )


def _held(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[::4], 4, axis=0)[: len(values)] / 2.0


def _filtered(values: np.ndarray) -> np.ndarray:
    """By a sensor's own low-pass at 5 Hz, of unit gain at rest."""
    share = np.exp(-2.0 * np.pi * 5.0 / 100.0)
    return np.asarray(lfilter([1.0 - share], [1.0, -share], values, axis=0))


@pytest.mark.parametrize("change", [_held, _filtered])
def test_white_noise_is_found_behind_a_filter_and_in_readings_that_are_held(
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    z = []
    for seed in range(8):
        white = change(np.random.default_rng(seed).normal(size=40_000))
        N = analyse([np.ascontiguousarray(white)], 0.01).N
        z.append((N.value - 0.1) / N.sigma)
    assert abs(np.mean(z)) < 1.6
    assert np.max(np.abs(z)) < 3.5


@pytest.mark.few(1)
@pytest.mark.parametrize(("spread", "told"), [(0.15, True), (0.3, True), (0.8, False)])
def test_readings_with_less_noise_than_a_step_have_a_bias_that_their_rounding_shifts(
    spread: float, told: bool
) -> None:
    step, z = 0.001, []
    for place in np.linspace(0.0, 0.9, 10):
        rng, bias = np.random.default_rng(3), (5.0 + place) * step
        gz = step * np.rint((bias + spread * step * rng.normal(size=30_000)) / step)
        values = np.column_stack([gz, rng.normal(9.81, 0.02, len(gz)), rng.normal(0.0, 0.02, len(gz))])
        log = Readings("log", ("gz", "ax", "ay"), 0.01 * np.arange(len(gz)), values)
        noise = analyse_static([log]).noise[0]
        assert (noise.rounded > 0.0) == told
        z.append((noise.bias - bias) / noise.sigma)
    assert np.max(np.abs(z)) < 3.0


def _nbs14() -> np.ndarray:
    n, out = 1234567890, []
    for _ in range(1000):
        out.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return np.array(out)


def test_the_published_set() -> None:
    found = np.sqrt(allan_variance([_nbs14()], np.array([1, 10, 100])))
    assert found == pytest.approx([0.2922319, 0.09159953, 0.03241343], rel=2e-7)


@pytest.mark.parametrize("walk", [0.0, 0.3])
def test_the_same_as_allantools(walk: float) -> None:
    rng = np.random.default_rng(1)
    y = 5.0 + rng.normal(size=5000) + walk * np.cumsum(rng.normal(size=5000))
    m = spaced(len(y))
    _, theirs, _, _ = allantools.oadev(y, rate=100.0, data_type="freq", taus=m / 100.0)
    assert np.allclose(np.sqrt(allan_variance([y], m)), theirs, rtol=1e-10)


@pytest.mark.parametrize(("kind", "alpha"), [(0, 0), (1, -1), (2, -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(kind: int, alpha: int) -> None:
    theta = np.zeros(3)
    theta[kind] = 0.7
    for n in (1000, 50_000):
        # Their sums leave out what discrete samples add below sixteen.
        m = np.array([16, 50, 100, n // 4])
        theirs = [
            allantools.edf_greenhall(alpha, 2, int(k), n + 1, overlapping=True, modified=False) for k in m
        ]
        assert np.allclose(degrees_of_freedom(m, [n], theta), theirs, rtol=0.05)


@pytest.mark.few(2)
@pytest.mark.parametrize(("white", "walk"), [(1.0, 0.0), (0.0, 1.0), (1.0, 0.1)])
def test_the_covariance_of_variances_is_met(white: float, walk: float) -> None:
    rng, n, m = np.random.default_rng(3), 300, np.array([2, 8, 9, 32])
    found = []
    for _ in range(4000):
        y = white * rng.normal(size=n)
        if walk:
            # The mean of a walk over a sample, not its value at the end.
            fine = np.cumsum(rng.normal(size=10 * n)) / np.sqrt(10.0)
            y = y + walk * fine.reshape(n, 10).mean(axis=1)
        found.append(allan_variance([y], m))
    theta = np.array([white**2, 0.0, walk**2])
    expected = np.einsum("ijpq,p,q->ij", covariance_forms(m, [n]), theta, theta)
    size = np.sqrt(np.diag(expected))
    assert np.allclose(np.mean(found, axis=0), design(m.astype(float)) @ theta, rtol=0.03)
    assert np.allclose(
        np.cov(np.array(found).T) / np.outer(size, size), expected / np.outer(size, size), atol=0.1
    )


def test_bounds_hold_two_thirds_of_the_time() -> None:
    rng, n, m = np.random.default_rng(4), 400, np.array([1, 10, 50])
    freedom = degrees_of_freedom(m, [n], np.array([1.0, 0.0, 0.0]))
    inside = np.zeros(3)
    for _ in range(1500):
        low, high = bounds(allan_variance([rng.normal(size=n)], m), freedom)
        inside += (low < 1.0 / np.sqrt(m)) & (1.0 / np.sqrt(m) < high)
    assert np.allclose(inside / 1500, 0.683, atol=0.05)


RATE_HZ = 100.0


def _readings(n: int, N: float, K: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = np.cumsum(K / np.sqrt(RATE_HZ) * rng.normal(size=n))
    return 0.01 + N * np.sqrt(RATE_HZ) * rng.normal(size=n) + walk


def test_white_noise_is_recovered_and_nothing_is_made_up() -> None:
    N, z, inside, made_up = 1e-3, [], 0, 0
    for seed in range(60):
        found = analyse([_readings(6000, N, 0.0, seed)], 1.0 / RATE_HZ)
        z.append((found.N.value - N) / found.N.sigma)
        inside += _within(found.N, N)
        made_up += found.K.supported + found.B.supported
    assert abs(np.mean(z)) < 0.5
    assert 0.75 < np.std(z) < 1.3
    assert inside >= 52
    assert made_up <= 3


@pytest.mark.slow
def test_a_random_walk_is_recovered_from_a_long_log() -> None:
    N, K, inside, values = 1e-3, 1e-3, 0, []
    for seed in range(40):
        found = analyse([_readings(60_000, N, K, seed)], 1.0 / RATE_HZ)
        assert found.K.supported
        inside += _within(found.K, K)
        values.append(found.K.value / K)
    assert inside >= 35
    assert np.median(values) == pytest.approx(1.0, abs=0.1)


def test_what_a_short_log_cannot_show_gets_a_bound() -> None:
    N, K, held = 1e-3, 1e-4, 0
    for seed in range(40):
        found = analyse([_readings(6000, N, K, seed)], 1.0 / RATE_HZ)
        held += found.K.supported or found.K.below > K
        assert found.K.supported or np.isnan(found.K.value)
        assert found.walk_within > 0.0
    assert held >= 36


def _flicker(n: int, seed: int) -> np.ndarray:
    """Noise of B = 1, which began long before."""
    # White noise of variance 1 at the period tau0 has the two-sided density tau0. Filtered by
    # (1 - 1/z)^(-1/2) it has 1 / (2 pi f) at low frequencies, which is B^2 / (2 pi f) with B = 1.
    f = np.arange(1, 2 * n + 1) / (4.0 * n)
    spectrum = np.fft.rfft(np.random.default_rng(seed).normal(size=4 * n))[1:] / np.sqrt(
        2.0 * np.sin(np.pi * f)
    )
    return np.fft.irfft(np.concatenate([[0.0], spectrum]), 4 * n)[:n]


def test_flicker_noise_is_taken_for_bias_instability() -> None:
    B = 2e-3
    found = analyse([B * _flicker(60_000, 5) + _readings(60_000, 1e-3, 0.0, 5)], 1.0 / RATE_HZ)
    assert found.B.supported
    assert found.B.value == pytest.approx(B, rel=0.2)


def test_flicker_noise_is_no_random_walk() -> None:
    """White noise is as large as the flicker at 10 s; the log lasts 600 s."""
    B, made_up, held = math.sqrt(0.1 / (2.0 * math.log(2.0) / math.pi)), 0, 0
    for seed in range(40):
        white = math.sqrt(10.0) * np.random.default_rng(seed).normal(size=6000)
        found = analyse([white + B * _flicker(6000, 100 + seed)], 0.1)
        made_up += found.K.supported
        held += found.B.below > B if not found.B.supported else _within(found.B, B)
        assert found.B.supported or not found.told_apart
    assert made_up <= 1
    assert held >= 36


def test_a_random_walk_beside_flicker_noise_lies_in_its_interval() -> None:
    """White noise is as large as each at 100 s; the log lasts two hours."""
    B, K, z = 0.1 / math.sqrt(2.0 * math.log(2.0) / math.pi), math.sqrt(3.0) / 100.0, []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        white, walk = rng.normal(size=(2, 7200))
        found = analyse([white + K * np.cumsum(walk) + B * _flicker(7200, 100 + seed)], 1.0)
        if found.K.supported:
            z.append(math.log(found.K.value / K) * found.K.value / found.K.sigma)
    assert len(z) >= 16
    assert math.sqrt(np.mean(np.square(z))) < 1.5


GYRO = np.array([True, False])
NONE = np.array([np.nan, np.nan])
NOISE = np.array([2.4e-3, 0.015])


def _part(values: np.ndarray, start_s: float = 5.0) -> tuple[Part, ...]:
    places = np.arange(len(values))
    return (Part(start_s + 0.01 * places, values, places, places),)


def _still(seed: int, n: int = 6000) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).normal(size=(n, 2)) + [0.006, 9.81]


def test_a_walking_bias_and_a_coarse_step_are_rest() -> None:
    rng = np.random.default_rng(1)
    walk = np.cumsum(1e-4 * rng.normal(size=(60_000, 2)), axis=0)
    assert rest_parts(_part(_still(2, 60_000) + walk), 0.01, GYRO, NONE)[1] == ()
    coarse = 0.02 * np.rint(_still(3) / 0.02)
    assert rest_parts(_part(coarse), 0.01, GYRO, np.array([0.02, 0.02]))[1] == ()


@pytest.mark.parametrize(("axis", "size"), [(0, 0.03), (1, 0.2)])
def test_a_knock_is_found_and_cut_out(axis: int, size: float) -> None:
    values = _still(4)
    values[2030:2090, axis] += size * np.sin(np.arange(60))
    parts, motions = rest_parts(_part(values), 0.01, GYRO, NONE)
    (motion,) = motions
    assert motion.axis == axis
    assert motion.from_s <= 5.0 + 20.3
    assert motion.to_s >= 5.0 + 20.9
    assert motion.to_s - motion.from_s <= 2.1
    assert [len(part.values) for part in parts] == [
        2000,
        6000 - 2000 - round((motion.to_s - motion.from_s) * 100),
    ]
    assert parts[1].places[0] == 0
    assert np.array_equal(parts[1].values, values[parts[1].rows])


def _log(n: int = 6000, jitter_s: float = 4e-4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.maximum.accumulate(0.01 * np.arange(n) + jitter_s * rng.normal(size=n))
    return t, rng.normal(size=(n, 2)) + np.array([0.0, 9.81])


def test_rate_and_jitter() -> None:
    t, values = _log()
    sampling, parts = regular_parts(Readings("log", ("gz", "ax"), t, values))
    assert sampling.rate_hz == pytest.approx(100.0, rel=1e-5)
    assert sampling.jitter_s == pytest.approx(4e-4, rel=0.1)
    assert (sampling.gaps, sampling.repeated_rows, sampling.repeated_stamps) == ((), 0, 0)
    assert len(parts) == 1
    assert np.array_equal(parts[0].values, values)
    assert np.isnan(sampling.step).all()


def test_a_short_gap_is_filled_and_the_time_axis_kept() -> None:
    t, values = _log(jitter_s=1e-4)
    keep = np.ones(6000, dtype=bool)
    keep[3000:3002] = False
    sampling, parts = regular_parts(Readings("log", ("gz", "ax"), t[keep], values[keep]))
    (gap,) = sampling.gaps
    assert (gap.missing, gap.split) == (2, False)
    assert gap.at_s == pytest.approx(29.99, abs=1e-3)
    assert gap.duration_s == pytest.approx(0.03, abs=1e-3)
    assert len(parts[0].values) == 6000
    filled = values[2999] + np.outer([1 / 3, 2 / 3], values[3002] - values[2999])
    assert np.allclose(parts[0].values[3000:3002], filled)
    assert np.array_equal(parts[0].values[3002:], values[3002:])


def test_a_long_gap_splits() -> None:
    t, values = _log()
    t[4000:] += 3600.0
    sampling, parts = regular_parts(Readings("log", ("gz", "ax"), t, values))
    assert [gap.split for gap in sampling.gaps] == [True]
    assert [len(part.values) for part in parts] == [4000, 2000]
    assert sampling.duration_s == pytest.approx(60.0, rel=1e-3)
    assert sampling.jitter_s == pytest.approx(4e-4, rel=0.15)
    assert np.array_equal(parts[1].values, values[4000:])
    assert parts[1].rows[0] == 4000


def _result(axes: tuple[str, ...] = AXES, walk: float = 0.0, n: int = 12_000) -> ImuSection:
    rng = np.random.default_rng(0)
    values = 1e-3 * rng.normal(size=(n, len(axes))) + walk * np.cumsum(
        rng.normal(size=(n, len(axes))), axis=0
    )
    return solve_static([Readings("a.csv", axes, 0.01 * np.arange(n), values)])


def test_kalibr_gets_the_worst_axis_in_continuous_time() -> None:
    # 1e-3 at 100 Hz is a density of 1e-4.
    text = to_kalibr(_result(walk=1e-4))
    document = yaml.safe_load(text)
    assert set(document) == {
        "accelerometer_noise_density",
        "accelerometer_random_walk",
        "gyroscope_noise_density",
        "gyroscope_random_walk",
        "rostopic",
        "update_rate",
    }
    assert document["gyroscope_noise_density"] == pytest.approx(1e-4, rel=0.1)
    assert document["gyroscope_random_walk"] == pytest.approx(1e-4 * np.sqrt(100.0), rel=0.4)
    assert "upper bound" not in text
    assert document["update_rate"] == pytest.approx(100.0)


KEYS = {
    "accelerometer_noise_density": "accel_noise_mps2_per_sqrt_Hz",
    "accelerometer_random_walk": "accel_walk_mps3_per_sqrt_Hz",
    "gyroscope_noise_density": "gyro_noise_radps_per_sqrt_Hz",
    "gyroscope_random_walk": "gyro_walk_radps2_per_sqrt_Hz",
}
# The four numbers of the EuRoC sequences' ADIS16448, as that data set's sensor.yaml gives them.
EUROC = (2.0e-3, 3.0e-3, 1.6968e-04, 1.9393e-05)
TEXT = (
    "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3e-3\n"
    "gyroscope_noise_density: 1.6968e-04\ngyroscope_random_walk: 1.9393e-05\n"
    "rostopic: /imu0\nupdate_rate: 200\n"
)
sizes = st.floats(1e-12, 1e3, allow_nan=False)


def _same(one: ImuSection, other: ImuSection) -> None:
    """Equal to the seven digits that are written."""
    assert one.rate_hz == pytest.approx(other.rate_hz, rel=6e-7, abs=6e-7)
    for name in KEYS.values():
        mine, theirs = getattr(one, name), getattr(other, name)
        assert mine == (theirs if None in theirs else pytest.approx(theirs, rel=6e-7))


@given(st.tuples(sizes, sizes, sizes, sizes), st.floats(1e-3, 1e5))
def test_there_and_back(values: tuple[float, ...], rate_hz: float) -> None:
    imu = from_kalibr({**dict(zip(KEYS, values, strict=True)), "update_rate": rate_hz})
    text = to_kalibr(imu, "/imu")
    again = from_kalibr(yaml.safe_load(text))
    _same(again, imu)
    assert to_kalibr(again, "/imu") == text


@pytest.mark.parametrize("nested", [False, True])
def test_a_file_as_kalibr_writes_it(nested: bool) -> None:
    document = yaml.safe_load(TEXT)
    imu = from_kalibr({"imu0": document} if nested else document)
    assert isinstance(imu, ImuSection) and imu.rate_hz == 200.0 and imu.verdict.word == "poor"
    for name, value in zip(KEYS.values(), EUROC, strict=True):
        assert getattr(imu, name) == [value] * 3

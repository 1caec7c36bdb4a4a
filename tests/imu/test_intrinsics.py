"""Intrinsics of accelerometer and gyroscope: truth recovered, sigma covered, what cannot be known named."""

from __future__ import annotations

import gzip
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from imu_poses import AXES, G, Readings, Sensor, in_counts, motion, pose_log, sphere_poses, tilts
from outside import outside
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

import calib.stages.imu.intrinsics
from calib.core.result import section_json
from calib.core.rig import Rig
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Verdict
from calib.solve.clock import Part
from calib.stages.imu.intrinsics import (
    ANGLES,
    PLACES,
    Accelerometer,
    Turns,
    _residual_and_jacobian,
    corrected,
    find_intrinsics,
    fit_accelerometer,
    judge_intrinsics,
    misalignment,
    misfit,
    misfit_covariance,
    protocol,
    solve_intrinsics,
    tangents,
    turn_directions,
)
from calib.stages.imu.sampling import Rest, find_rests, quiet_level, spread
from calib.stages.imu.section import ImuIntrinsics

SENSOR = Sensor()


@pytest.mark.parametrize("counts", [False, True])
def test_a_known_sensor_is_recovered_within_its_deviations(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    result = find_intrinsics(pose_log(sphere_poses(24), sensor, 1, counts), G)
    assert (len(result.rests), result.poses, result.planar) == (24, 24, False)
    accel = result.accel
    assert accel is not None
    truth = np.concatenate([sensor.accel_bias, sensor.accel_scale, sensor.accel_angles])
    assert np.abs((accel.parameters - truth) / accel.sigma).max() < 4.0
    assert accel.sigma[3:6].max() < 2e-4 * sensor.accel_scale.max()
    # Gravity that nobody stated is told, as it moves the scales by more than that.
    for gravity_mps2, told in ((G, False), (GRAVITY_MPS2, True)):
        remarks = judge_intrinsics(replace(result, gravity_mps2=gravity_mps2)).remarks
        assert any("9.83" in remark for remark in remarks) == told


def test_a_plane_is_seen_or_asked_for() -> None:
    log = pose_log(tilts(np.radians(np.arange(0, 360, 45))), SENSOR)
    seen = find_intrinsics(log, G)
    asked = find_intrinsics(log, G, planar=True)
    columns = [2, 3, 4]
    alone = find_intrinsics(replace(log, axes=("gz", "ax", "ay"), values=log.values[:, columns]), G)
    for result in (seen, asked, alone):
        assert result.planar
        assert result.accel is not None
        truth = np.concatenate([SENSOR.accel_bias[:2], SENSOR.accel_scale[:2], SENSOR.accel_angles[:1]])
        # The axes' lean out of the plane counts by its square.
        assert np.abs(result.accel.parameters - truth).max() < 2e-3
    assert (seen.asked, asked.asked) == (False, True)
    assert np.isnan(alone.lean_rad)
    assert seen.lean_rad == pytest.approx(0.03, abs=0.02)


def test_the_xsens_recording_of_imu_tk(shared_data: Path) -> None:
    folder = outside(shared_data / "imu_tk")
    tables = []
    for name in ("xsens_gyro.mat.gz", "xsens_acc.mat.gz"):
        with gzip.open(folder / name, "rt") as stream:
            tables.append(np.loadtxt(stream))
    values = np.hstack([table[:, 1:] for table in tables])
    result = find_intrinsics(Readings("xsens", AXES, tables[1][:, 0], values, counts="ag"), 9.81744)
    accel, gyro = result.accel, result.gyro
    assert accel is not None
    assert gyro is not None
    assert accel.scale == pytest.approx(np.array([414.42, 412.05, 414.61]), rel=1e-3)
    assert accel.bias == pytest.approx(np.array([33124, 33275, 32364]), abs=3.0)
    assert accel.rms_mps2 <= 0.00165
    assert len(result.rests) >= 35
    assert gyro.scale == pytest.approx(np.full(3, 4770.0), rel=0.005)
    assert gyro.bias.sensitivity is not None
    assert gyro.rms_rad < 0.003


PLAIN = Sensor()


def _truth(sensor: Sensor, d: int = 3) -> np.ndarray:
    angles = sensor.accel_angles[: len(ANGLES[d])]
    return np.concatenate([sensor.accel_bias[:d], sensor.accel_scale[:d], angles])


def _rests(
    up: np.ndarray,
    sensor: Sensor,
    rng: np.random.Generator,
    noise: float = 0.02,
    beyond: float = 0.0,
    counts: np.ndarray | None = None,
) -> list[Rest]:
    """Rests with these directions up (n, d), the mean of `counts` readings each."""
    n, d = up.shape
    p = _truth(sensor, d)
    size = sensor.accel_scale[:d].mean()
    A = misalignment(ANGLES[d], p[2 * d :], d) / p[d : 2 * d]
    force = (G + beyond * rng.normal(size=n))[:, None] * up
    counts = np.full(n, 300) if counts is None else counts
    x = force @ np.linalg.inv(A).T + p[:d]
    x += size * noise * rng.normal(size=x.shape) / np.sqrt(counts)[:, None]
    scatter = np.full(d, (size * noise) ** 2)
    return [
        Rest(0, 0, int(m), 0.0, 0.01 * m, row, scatter) for row, m in zip(x, counts.tolist(), strict=True)
    ]


def _ups(count: int) -> np.ndarray:
    return np.stack([pose.inv().apply([0.0, 0.0, 1.0]) for pose in sphere_poses(count)])


def _circle(count: int) -> np.ndarray:
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return np.stack([pose.inv().apply([0.0, 0.0, 1.0]) for pose in tilts(angles)])[:, :2]


@pytest.mark.parametrize("d", [2, 3])
def test_derivatives_agree_with_differences(d: int) -> None:
    rng = np.random.default_rng(d)
    p = _truth(PLAIN, d)
    x = G * rng.normal(size=(7, d))
    _, J = _residual_and_jacobian(p, x, G)
    for row in range(7):
        found = approx_fprime(
            p, lambda q, row=row: float(_residual_and_jacobian(q, x[row : row + 1], G)[0][0]), 1e-7
        )
        assert J[row] == pytest.approx(found, abs=2e-5)


@pytest.mark.parametrize("sensor", [PLAIN, in_counts(PLAIN)])
@pytest.mark.parametrize("d", [2, 3])
def test_a_known_truth_is_recovered_without_noise(sensor: Sensor, d: int) -> None:
    up = _ups(20) if d == 3 else _circle(8)
    rests = _rests(up, sensor, np.random.default_rng(0), noise=1e-9)
    fit = fit_accelerometer(rests, G, sensor is PLAIN)
    truth = _truth(sensor, d)
    assert fit.skewed
    assert np.abs((fit.parameters - truth) / np.maximum(np.abs(truth), 1e-2)).max() < 1e-6
    assert fit.directions == pytest.approx(up, abs=1e-7)
    means = np.stack([rest.mean for rest in rests])
    assert np.linalg.norm(corrected(fit.parameters, means), axis=1) == pytest.approx(G, rel=1e-8)


def test_poses_on_one_side_leave_bias_and_scale_apart_unknown() -> None:
    up = _ups(60)
    fit = fit_accelerometer(_rests(up[up[:, 2] > 0.75], PLAIN, np.random.default_rng(0)), G, True)
    assert fit.span < 0.02
    assert np.abs(fit.weakest[[2, 5]]).min() > 0.3


def test_residuals_that_are_small_by_chance_make_nothing_certain() -> None:
    """Thirteen poses leave four degrees of freedom: of forty sets one has a third of the usual residuals."""
    rng, up, truth = np.random.default_rng(3), _ups(13), _truth(PLAIN)
    fits = [fit_accelerometer(_rests(up, PLAIN, rng), G, True) for _ in range(40)]
    off = np.array([(fit.parameters - truth) / fit.sigma for fit in fits])
    assert np.abs(off).max() < 4.0
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("d", "beyond"), [(3, 0.0), (3, 0.004), (2, 0.0)])
def test_reported_deviations_are_those_of_many_repetitions(d: int, beyond: float) -> None:
    up = _ups(30) if d == 3 else _circle(16)
    rng = np.random.default_rng(11)
    lengths = rng.integers(100, 1000, len(up))
    truth = _truth(PLAIN, d)
    errors, sigmas = [], []
    for _ in range(250):
        fit = fit_accelerometer(_rests(up, PLAIN, rng, beyond=beyond, counts=lengths), G, True)
        errors.append(fit.parameters - truth)
        sigmas.append(fit.sigma)
    error, sigma = np.array(errors), np.array(sigmas)
    reported = np.sqrt((sigma**2).mean(axis=0))
    # The scale of the residuals, chi-square, counts where it is more than the noise asks for.
    dof = len(up) - len(truth)
    scale2 = 1.0 if beyond else np.maximum(rng.chisquare(dof, 100_000) / dof, 1.0).mean()
    assert error.std(axis=0) / reported == pytest.approx(np.full(len(truth), scale2**-0.5), abs=0.15)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * (reported / np.sqrt(250)).max()
    inside = np.abs(error) < 1.96 * sigma
    assert inside.mean() == pytest.approx(0.95, abs=0.02)


TRUTH = np.concatenate([SENSOR.gyro_scale, SENSOR.gyro_angles])


@pytest.mark.parametrize("counts", [False, True])
def test_scale_and_misalignment_are_recovered(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    quiet = replace(sensor, accel_noise=1e-4, gyro_noise=1e-5)
    gyro = find_intrinsics(pose_log(sphere_poses(24), quiet, counts=counts), G).gyro
    assert gyro is not None
    assert gyro.scale / quiet.gyro_scale == pytest.approx(np.ones(3), abs=2e-5)
    assert gyro.angles == pytest.approx(quiet.gyro_angles, abs=2e-5)
    assert gyro.bias.sensitivity is None
    assert gyro.initial_bias == pytest.approx(quiet.gyro_bias, rel=1e-3)
    T = gyro.matrix * gyro.scale
    for (i, j, sign), angle in zip(PLACES.values(), gyro.angles, strict=True):
        assert T[i, j] == pytest.approx(sign * angle)


def test_slow_turns_count_from_where_they_begin() -> None:
    gyro = find_intrinsics(pose_log(sphere_poses(20), SENSOR, rest_s=1.5, turn_s=8.0), G).gyro
    assert gyro is not None
    assert gyro.scale == pytest.approx(SENSOR.gyro_scale, abs=1e-3)
    assert gyro.bias.sigma.max() < 1e-3


def test_a_bias_that_follows_the_pose_is_told_from_one_that_does_not() -> None:
    S = 3e-4 * np.array([[0.2, 1.0, 0.5], [-1.0, 0.1, 0.3], [0.4, -0.7, 0.2]])
    poses = sphere_poses(30)
    following = find_intrinsics(pose_log(poses, replace(SENSOR, sensitivity=S)), G).gyro
    constant = find_intrinsics(pose_log(poses, SENSOR), G).gyro
    assert following is not None
    assert constant is not None
    assert constant.bias.sensitivity is None
    assert following.bias.sensitivity is not None
    assert following.bias.sensitivity_sigma is not None
    assert np.abs((following.bias.sensitivity - S) / following.bias.sensitivity_sigma).max() < 4.0
    assert np.abs((following.bias.bias - SENSOR.gyro_bias) / following.bias.sigma).max() < 4.0
    assert following.rms_rad < 1.5 * constant.rms_rad
    error = np.concatenate([following.scale, following.angles]) - TRUTH
    assert np.abs(error / np.concatenate([following.scale_sigma, following.angle_sigma])).max() < 4.0


def test_swapped_and_mirrored_axes_are_named() -> None:
    log = pose_log(sphere_poses(20), SENSOR)
    assert find_intrinsics(log, G).foreign is None
    P = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for swap in (P, -np.eye(3)):
        values = np.hstack([log.values[:, :3] @ swap, log.values[:, 3:]])
        found = find_intrinsics(replace(log, values=values), G).foreign
        assert found is not None
        assert found.tolist() == swap.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("planar", [False, True])
def test_reported_deviations_are_those_of_many_repetitions_in_gyroscope(
    monkeypatch: pytest.MonkeyPatch, planar: bool
) -> None:
    monkeypatch.setattr(calib.stages.imu.intrinsics, "MULTIPLES", (4.0,))
    flat = replace(SENSOR, accel_angles=np.array([0.011, 0.0, 0.0]), gyro_angles=np.zeros(6))
    sensor = flat if planar else SENSOR
    poses = tilts(np.radians(np.arange(0, 720, 45))) if planar else sphere_poses(24)
    free = [2] if planar else list(range(9))
    truth = np.concatenate([sensor.gyro_scale, sensor.gyro_angles])[free]
    t, w, f = motion(poses)
    errors, sigmas = [], []
    for seed in range(200):
        values = sensor.readings(w, f, np.random.default_rng(seed))
        gyro = find_intrinsics(Readings("log", AXES, t, values), G).gyro
        assert gyro is not None
        errors.append(np.concatenate([gyro.scale, gyro.angles])[free] - truth)
        sigmas.append(np.concatenate([gyro.scale_sigma, gyro.angle_sigma])[free])
    error, sigma = np.array(errors), np.array(sigmas)
    reported = np.sqrt((sigma**2).mean(axis=0))
    assert error.std(axis=0) / reported == pytest.approx(np.ones(len(free)), abs=0.15)
    dof = (len(poses) - 1) * (1 if planar else 2) - len(free)
    inside = np.abs(error) < stdtrit(dof, 0.975) * sigma
    # Of one parameter 200 repetitions tell the share to 0.015.
    assert inside.mean() == pytest.approx(0.95, abs=0.035 if planar else 0.02)


COLUMNS = [3, 4, 5]
PERIOD_S = 0.01


def _parts(values: np.ndarray) -> tuple[Part, ...]:
    rows = np.arange(len(values))
    return (Part(PERIOD_S * rows, values, rows, rows),)


def _log(poses: int = 8, **how: float) -> np.ndarray:
    _, w, f = motion(sphere_poses(poses), **how)
    return Sensor().readings(w, f, np.random.default_rng(3))


def test_rests_lie_inside_the_true_ones_and_fill_them() -> None:
    parts = _parts(_log(8, rest_s=4.0, turn_s=2.0, initial_s=10.0))
    s = spread(parts, COLUMNS, PERIOD_S)
    quiet = quiet_level(s, np.full(3, math.nan))
    rests = find_rests(parts, COLUMNS, s, 5.0 * quiet.zeta)
    assert len(rests) == 8
    for k, rest in enumerate(rests):
        start = 0.0 if k == 0 else 10.0 + 6.0 * k - 4.0
        stop = 10.0 if k == 0 else start + 4.0
        # A turn begins so slowly that its first and last tenths of a second hide in the noise.
        assert start - 0.2 < rest.from_s < start + 0.55
        assert stop - 0.55 < rest.to_s < stop + 0.2


def test_scatter_counts_correlation_between_readings() -> None:
    rng = np.random.default_rng(1)
    white = 0.02 * rng.normal(size=(40_003, 6))
    smooth = np.stack([white[k : k + 40_000] for k in range(4)]).mean(axis=0)
    for values in (white[:40_000], smooth):
        parts = _parts(values)
        (rest,) = find_rests(parts, COLUMNS, spread(parts, COLUMNS, PERIOD_S), math.inf)
        # The mean of four neighbours has a quarter of the variance and the same long-run one.
        assert rest.scatter == pytest.approx(0.02**2 * np.ones(3), rel=0.15)
        assert rest.mean == pytest.approx(values[rest.middle, COLUMNS].mean(axis=0))
        assert rest.samples == 40_000
        assert rest.duration_s == pytest.approx(400.0)


REST_S, TURN_S, FIRST_S, RATE_HZ = 3.0, 2.0, 20.0, 100.0


def _accelerometer(d: int, covariance: np.ndarray, sigma_rad: np.ndarray, up: np.ndarray) -> Accelerometer:
    k = {2: 1, 3: 3}[d]
    n = len(up)
    return Accelerometer(
        np.zeros(d), np.ones(d), np.zeros(k), np.sqrt(np.diag(covariance)), covariance, up, sigma_rad,
        np.zeros(n), np.ones(n), 0.0, 0.0, n - 2 * d - k, 0.25, np.zeros(2 * d + k), True,
    )  # fmt: skip


def _turns(poses: list, d: int, rng: np.random.Generator | None, noise: tuple[float, float]) -> Turns:
    """Turns of an ideal sensor with noise, between rests whose limits are known."""
    _, w, f = motion(poses, RATE_HZ, REST_S, TURN_S, FIRST_S)
    if d == 2:
        w = w * [0.0, 0.0, 1.0]
    gyro, accel = w.copy(), f[:, :d].copy()
    if rng is not None:
        accel += noise[0] * rng.normal(size=accel.shape)
        gyro += noise[1] * rng.normal(size=gyro.shape) * (np.array([0, 0, 1]) if d == 2 else 1)
    rests, at = [], 0
    for i in range(len(poses)):
        stop = at + round((FIRST_S if i == 0 else REST_S) * RATE_HZ)
        rests.append(
            Rest(
                0,
                at,
                stop,
                at / RATE_HZ,
                stop / RATE_HZ,
                accel[at:stop].mean(axis=0),
                np.full(d, noise[0] ** 2),
            )
        )
        at = stop + round(TURN_S * RATE_HZ)
    k = np.arange(len(rests) - 1)
    scatter = np.tile([0.0, 0.0, noise[1] ** 2] if d == 2 else [noise[1] ** 2] * 3, (len(rests), 1))
    return Turns(
        gyro,
        accel,
        np.array([rest.stop - 1 for rest in rests[:-1]]),
        np.array([rest.start for rest in rests[1:]]),
        k,
        rests,
        np.stack([gyro[rest.start : rest.stop].mean(axis=0) for rest in rests]),
        scatter,
        np.array([float(rest.samples) for rest in rests]),
        np.zeros(3),
        0,
        1.0 / RATE_HZ,
    )


@pytest.mark.parametrize("d", [2, 3])
def test_an_ideal_sensor_misses_nothing(d: int) -> None:
    poses = sphere_poses(12) if d == 3 else tilts(np.radians(np.arange(0, 360, 45)))
    turns = _turns(poses, d, None, (0.0, 0.0))
    n = len(poses)
    accel = _accelerometer(d, np.zeros((9, 9)) if d == 3 else np.zeros((5, 5)), np.zeros(n), np.zeros((n, d)))
    across = tangents(turns, accel)
    assert across.shape == (n - 1, d - 1, 3)
    off = misfit(turns, accel.parameters, turns.gyro, np.eye(3), across)
    assert np.abs(off).max() < 1e-4
    wrong = misfit(turns, accel.parameters, turns.gyro, 1.01 * np.eye(3), across)
    assert np.abs(wrong).max() > 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_the_covariance_is_that_of_many_repetitions(d: int) -> None:
    poses = sphere_poses(8) if d == 3 else tilts(np.radians(np.arange(0, 360, 45)))
    noise, bias_error, errors = (0.05, 0.002), 3e-4, []
    rng = np.random.default_rng(0)
    size = 9 if d == 3 else 5
    spread = np.concatenate([np.full(d, 2e-3), np.full(d, 2e-4), np.full(size - 2 * d, 5e-4)])
    clean = _turns(poses, d, None, noise)
    sigma = noise[0] / np.sqrt([rest.samples for rest in clean.rests]) / G
    accel = _accelerometer(d, np.diag(spread**2), sigma, np.zeros((len(poses), d)))
    across = tangents(clean, accel)
    bias_sigma = np.array([0.0, 0.0, bias_error]) if d == 2 else np.full(3, bias_error)
    M = np.diag([0.0, 0.0, 1.0]) if d == 2 else np.eye(3)
    for _ in range(1500):
        turns = _turns(poses, d, rng, noise)
        rates = turns.gyro - bias_sigma * rng.normal(size=3)
        parameters = accel.parameters + spread * rng.normal(size=size)
        errors.append(misfit(turns, parameters, rates, M, across))
    C = misfit_covariance(clean, accel, clean.gyro, M, across, bias_sigma, np.zeros(3))
    found = np.cov(np.array(errors).T)
    deviation = np.sqrt(np.diag(C))
    assert np.sqrt(np.diag(found)) / deviation == pytest.approx(np.ones(len(C)), abs=0.1)
    # Entries of a correlation matrix from so many repetitions are known to 0.026.
    assert np.abs((found - C) / np.outer(deviation, deviation)).max() < 0.13


def _turned(
    rates: np.ndarray, before: np.ndarray, starts: list[int], stops: list[int], h: float
) -> np.ndarray:
    out = np.empty((len(starts), 3))
    turn_directions(rates, np.array(starts), np.array(stops), before, h, out)
    return out


def test_several_turns_and_a_rate_that_changes() -> None:
    rng = np.random.default_rng(1)
    knots = rng.normal(size=(2, 3))
    t = np.linspace(0.0, 1.0, 201)
    rates = knots[0] + np.sin(2.0 * t)[:, None] * knots[1]
    # Many small turns with the rate in their middle, an integrator of another kind.
    fine = np.linspace(0.0, 1.0, 4_001)
    middle = 0.5 * (fine[1:] + fine[:-1])
    R = Rotation.identity()
    for row in (knots[0] + np.sin(2.0 * middle)[:, None] * knots[1]) * np.diff(fine)[:, None]:
        R = R * Rotation.from_rotvec(row)
    before = rng.normal(size=(2, 3))
    found = _turned(rates, before, [0, 50], [200, 50], 0.005)
    assert found[0] == pytest.approx(R.inv().apply(before[0]), abs=1e-5)
    assert found[1] == pytest.approx(before[1], abs=1e-15)


def _judge(log: Readings, gravity_mps2: float = G, planar: bool = False) -> Verdict:
    return judge_intrinsics(find_intrinsics(log, gravity_mps2, planar))


def _up(pose: Rotation) -> np.ndarray:
    return np.asarray(pose.inv().apply([0.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def good() -> Readings:
    return pose_log(sphere_poses(24), SENSOR)


@pytest.mark.parametrize(("axis", "sign", "word"), [(2, 1.0, "up"), (0, -1.0, "down"), (1, 1.0, "up")])
def test_a_side_that_lacks_is_named(axis: int, sign: float, word: str) -> None:
    poses = [pose for pose in sphere_poses(40) if sign * _up(pose)[axis] < 0.2]
    found = _judge(pose_log(poses, SENSOR))
    assert found.word == "poor"
    name = "xyz"[axis]
    assert any(f"no rest with the {name} axis {word}: the nearest is" in reason for reason in found.reasons)
    assert f"add rests with the {name} axis {word}" in found.advice


def test_six_poses_do_not_blame_the_unit_of_the_gyroscope() -> None:
    turns = (("x", 0.0), ("x", 180.0), ("x", 90.0), ("x", 270.0), ("y", 90.0), ("y", 270.0))
    six = [Rotation.from_euler(axis, angle, degrees=True) for axis, angle in turns]
    found = _judge(pose_log(six, SENSOR))
    assert found.word == "unidentifiable"
    assert not any("--gyro-unit" in advice for advice in found.advice)


def test_rests_hardly_more_than_parameters_tell_less_than_their_sigma(good: Readings) -> None:
    result = find_intrinsics(good, G)
    assert result.accel is not None
    sigma = np.repeat([1e-3, 1e-3, 3e-3], 3)
    few, many = (replace(result, accel=replace(result.accel, sigma=sigma, dof=dof)) for dof in (1, 12))
    assert judge_intrinsics(many).word == "ok"
    found = judge_intrinsics(few)
    assert found.word == "poor"
    assert "misalignment zx: known to 0.019 rad only, by 24 rests for 23 parameters" in found.reasons[-1]


def test_a_cap_of_the_sphere_is_unidentifiable() -> None:
    poses = [pose for pose in sphere_poses(90) if _up(pose)[2] > 0.8]
    found = _judge(pose_log(poses, SENSOR))
    assert found.word == "unidentifiable"
    mixed = next(reason for reason in found.reasons if reason.startswith("the poses do not tell"))
    assert "bias of z" in mixed
    assert "scale of z apart" in mixed
    assert any("no rest with the z axis down: the nearest is 1" in reason for reason in found.reasons)
    counts = _judge(pose_log(poses, in_counts(SENSOR), counts=True))
    assert counts.word == "unidentifiable"
    assert not any(reason.startswith("no rest with") for reason in counts.reasons)
    assert protocol(planar=False) in found.advice


@pytest.mark.slow
def test_axes_and_units_that_contradict_are_inconsistent(good: Readings) -> None:
    swapped = np.hstack([good.values[:, [1, 0, 2]] * [1, -1, 1], good.values[:, 3:]])
    found = _judge(replace(good, values=swapped))
    assert found.word == "inconsistent"
    assert "gx measures y, gy measures -x, gz measures z" in found.reasons[0]
    mirrored = np.hstack([-good.values[:, :3], good.values[:, 3:]])
    assert "that mirrors it" in _judge(replace(good, values=mirrored)).reasons[0]
    moon = _judge(good, 1.62)
    assert moon.word == "inconsistent"
    assert "check --acc-unit and --gravity" in moon.advice
    fast = np.hstack([1.8 * good.values[:, :3], good.values[:, 3:]])
    assert "check --gyro-unit" in _judge(replace(good, values=fast)).advice
    other = np.hstack([np.roll(good.values[:, :3], 300, axis=0), good.values[:, 3:]])
    assert _judge(replace(good, values=other)).word == "inconsistent"


def _section(log: Readings, planar: bool = False) -> ImuIntrinsics:
    section = solve_intrinsics(log, G, planar)
    again = Rig.of(yaml.safe_load(Rig(imu_intrinsics=section).text()), "rig.yaml").imu_intrinsics
    assert again is not None and section_json(again) == section_json(section)
    return section


@pytest.mark.parametrize("counts", [False, True])
def test_readings_are_corrected_by_what_is_written(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    section = _section(pose_log(sphere_poses(24), sensor, counts=counts))
    assert section.verdict.ok
    rng = np.random.default_rng(0)
    w, f = rng.normal(size=(5, 3)), G * rng.normal(size=(5, 3))
    raw = Sensor.readings(sensor, w, f, _Silent())
    assert section.gyro is not None
    for part, readings, truth, size in (
        (section.accel, raw[:, 3:], f, 3e-2),
        (section.gyro, raw[:, :3], w, 2e-3),
    ):
        assert part.unit == ("counts" if counts else {3e-2: "m/s2", 2e-3: "rad/s"}[size])
        found = (readings - np.array(part.bias, dtype=float)) @ np.array(part.matrix).T
        assert found == pytest.approx(truth, abs=size)
        assert set(part.sigma.misalignment_rad) == set(part.misalignment_rad)
    assert set(section.accel.misalignment_rad) == {"yz", "zy", "zx"}
    assert set(section.gyro.misalignment_rad) == {"yz", "zy", "xz", "zx", "xy", "yx"}


def test_axes_that_six_faces_take_to_be_square_are_in_sigma() -> None:
    turns = (("x", 0.0), ("x", 180.0), ("x", 90.0), ("x", 270.0), ("y", 90.0), ("y", 270.0))
    faces = [Rotation.from_euler(axis, angle, degrees=True) for axis, angle in turns]
    section = _section(pose_log([*faces, *faces[::-1], *faces[::2], *faces[1::2]], SENSOR))
    assert section.gyro is not None
    assert not section.accel.misalignment_rad
    assert any("0.01 rad" in remark for remark in section.verdict.remarks)
    for name, truth in zip(PLACES, SENSOR.gyro_angles, strict=True):
        angle, sigma = section.gyro.misalignment_rad[name], section.gyro.sigma.misalignment_rad[name]
        assert abs(angle - truth) < 3.0 * sigma


class _Silent:
    """A source of random numbers that are all zero."""

    def normal(self, size: tuple[int, int]) -> np.ndarray:
        return np.zeros(size)

"""Tuning: near the best gains of a grid with a reference and without, and 3/3 where nothing is better."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armlogs import swung
from outside import outside
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from calib.errors import BadInputError
from calib.imu.gains import DATA_SHEET
from calib.imu.mahony import Mahony
from calib.imu.mahony_batch import filter_log, filter_many, wrapped
from calib.imu.rate import planar_rate
from calib.imu.tuning import THREE, Piece, tune

GRID = [Mahony(a, b) for a in np.geomspace(0.03, 15.0, 25) for b in np.geomspace(1e-3, 30.0, 25)]


def _piece(seed: int, reference: bool, **options: float) -> Piece:
    arm = swung(seed, **options)
    return Piece("arm.csv", arm.t_s, arm.phi_acc, -arm.gz, arm.phi + 0.4 if reference else None)


def _error(phi: np.ndarray, truth: np.ndarray, offset: float) -> np.ndarray:
    return np.degrees(np.sqrt(np.mean(wrapped(phi - truth - offset) ** 2, axis=-1)))


@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_near_the_best_of_all_constant_gains(seed: int, reference: bool) -> None:
    truth = swung(seed).phi
    # The mount's angle is unknown: a reference that is off by a constant is as good.
    offset = tune([_piece(seed, True)], DATA_SHEET).offset_rad[0] + 0.4
    piece = _piece(seed, reference)
    found = tune([piece], DATA_SHEET)
    run = (piece.t_s, piece.phi_acc_rad, piece.rate_radps)
    best = _error(filter_many(GRID, *run), truth, offset).min()
    ours = _error(filter_log(found.recommended.gains, *run)[0], truth, offset)
    three = _error(filter_log(THREE, *run)[0], truth, offset)
    assert found.judge == ("reference" if reference else "smoothed")
    assert found.recommended.name == "tuned"
    assert ours < (1.08 if reference else 1.25) * best
    assert ours < three


def test_keeps_three_three_where_the_truth_is_three_three() -> None:
    arm = swung(1)
    phi = filter_log(THREE, arm.t_s, arm.phi_acc, -arm.gz)[0]
    rng = np.random.default_rng(0)
    reference = phi + 1e-3 * rng.normal(size=len(phi))
    found = tune([Piece("a.csv", arm.t_s, arm.phi_acc, -arm.gz, reference)], DATA_SHEET)
    assert found.recommended.gains == THREE
    assert found.reasons[-1] == "3/3 is kept."
    assert not any(one.wins for one in found.candidates)


def test_a_short_log_is_not_judged() -> None:
    found = tune([_piece(0, False, duration_s=6.0)], DATA_SHEET)
    assert (found.judge, found.recommended.gains, found.surface) == ("none", THREE, None)
    assert "expected at least 8 s: 3/3 is kept" in found.reasons[0]
    assert math.isnan(found.candidates[0].rmse_rad)


def test_a_rate_of_something_else_is_not_judged_by_the_log() -> None:
    arm = swung(0)
    rng = np.random.default_rng(0)
    rate = np.repeat(rng.normal(size=300), 10) + 0.0 * arm.gz
    found = tune([Piece("a.csv", arm.t_s, arm.phi_acc, rate)], DATA_SHEET)
    assert found.recommended.gains == THREE
    assert any("it is not the rate of the angle" in reason for reason in found.reasons)


def test_a_tilted_sensor_is_not_judged_by_the_log() -> None:
    piece = replace(_piece(0, False), in_plane=False)
    assert "tilts out of the plane" in tune([piece], DATA_SHEET).reasons[0]
    assert tune([replace(_piece(0, True), in_plane=False)], DATA_SHEET).recommended.name == "tuned"


def test_several_logs_and_blank_reference() -> None:
    pieces = [_piece(0, True), _piece(1, False), _piece(2, True)]
    reference = pieces[0].reference_rad
    assert reference is not None
    reference[500:900] = np.nan
    found = tune(pieces, DATA_SHEET)
    assert found.judged_s == pytest.approx(56.0)
    assert found.offset_rad[1] == 0.0
    assert found.recommended.name == "tuned"
    assert found.halves is not None


def test_no_logs() -> None:
    with pytest.raises(BadInputError, match="found none"):
        tune([], DATA_SHEET)


@pytest.mark.slow
def test_whatever_is_recommended_on_real_recordings_is_better(shared_data: Path) -> None:
    judged = won = 0
    for name in ("02_undisturbed_slow_rotation_B", "05_undisturbed_slow_rotation_with_breaks_B"):
        data = loadmat(outside(shared_data / "broad" / f"{name}.mat"))
        fs = float(data["sampling_rate"].squeeze())
        q = data["opt_quat"]
        known = ~np.isnan(q).any(axis=1)
        up = np.full((len(q), 3), np.nan)
        up[known] = Rotation.from_quat(q[known][:, [1, 2, 3, 0]]).inv().apply([0.0, 0.0, 1.0])
        for axes in ([1, 2, 0], [2, 0, 1]):
            force, gyro, u = data["imu_acc"][:, axes], data["imu_gyr"][:, axes], up[:, axes]
            felt = force / np.linalg.norm(force, axis=1, keepdims=True)
            inside = np.nan_to_num(u[:, 0] ** 2 + u[:, 1] ** 2) > 0.75
            edges = np.flatnonzero(np.diff(np.concatenate([[0], inside, [0]])))
            for a, b in edges.reshape(-1, 2).tolist():
                if b - a < 20.0 * fs:
                    continue
                t, phi = np.arange(b - a) / fs, np.arctan2(u[a:b, 1], u[a:b, 0])
                acc, rate = np.arctan2(force[a:b, 1], force[a:b, 0]), planar_rate(gyro[a:b], felt[a:b])
                blind = tune([Piece(name, t, acc, rate)], DATA_SHEET)
                seeing = tune([Piece(name, t, acc, rate, phi)], DATA_SHEET)
                errors = [
                    _error(filter_log(gains, t, acc, rate)[0], phi, seeing.offset_rad[0])
                    for gains in (THREE, blind.recommended.gains, seeing.recommended.gains)
                ]
                assert max(errors[1:]) <= errors[0] + 1e-9
                judged += 1
                won += errors[1] < 0.95 * errors[0]
    assert judged >= 10
    assert won >= 3

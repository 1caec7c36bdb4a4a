"""Verdicts on alignments: what is said of logs that do not move, are short, or show something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from align_trials import align_log, known, prior_settings, twin_log

from calib.estimator.align import Alignment, align
from calib.estimator.align_verdict import judge_align
from calib.estimator.sensors import SENSOR
from calib.twin.rig import SimulatedRig


@pytest.fixture(scope="module")
def found() -> Alignment:
    trial = known(SimulatedRig())
    logs = [align_log(twin_log(trial.rig, "swing", {"phi_rad": p}, k)) for k, p in enumerate(("0.5", "-0.4"))]
    return align(logs, prior_settings(trial.view))


def _with_sigma(found: Alignment, name: str, sigma: float) -> Alignment:
    covariance = found.covariance.copy()
    k = SENSOR.index(name)
    scale = sigma / np.sqrt(covariance[k, k])
    covariance[k] *= scale
    covariance[:, k] *= scale
    return replace(found, covariance=covariance)


def test_a_swing_is_good(found: Alignment) -> None:
    judged = judge_align(found)
    assert judged.verdict == "ok"
    assert judged.reasons == []


def test_an_unknown_offset(found: Alignment) -> None:
    judged = judge_align(_with_sigma(found, "time_offset_s", 3e-3))
    assert judged.verdict == "poor"
    assert "deviation of 3 ms" in judged.reasons[0]
    still = replace(found, logs=tuple(replace(log, turned_rad=1e-3) for log in found.logs))
    judged = judge_align(_with_sigma(still, "time_offset_s", 3e-2))
    assert judged.verdict == "unidentifiable"
    assert "the logs hardly move" in judged.reasons[0]
    assert any("free swing" in sentence for sentence in judged.advice)


def test_pictures_of_something_else(found: Alignment) -> None:
    for share, verdict in ((0.3, "poor"), (0.8, "unidentifiable")):
        logs = tuple(replace(log, outliers=int(share * log.pictures)) for log in found.logs)
        judged = judge_align(replace(found, logs=logs))
        assert judged.verdict == verdict
        assert "show something else than the marker" in judged.reasons[0]


def test_other_reasons(found: Alignment) -> None:
    short = replace(found, logs=tuple(replace(log, duration_s=1.2) for log in found.logs))
    assert "too short" in judge_align(short).reasons[0]
    assert "has not converged" in judge_align(replace(found, converged=False)).reasons[0]
    assert "0.5 times the turn" in judge_align(replace(found, factor=0.5)).reasons[0]
    assert judge_align(replace(found, factor=0.1)).verdict == "unidentifiable"
    assert "angle read at rest" in judge_align(replace(found, rest_angle_sigma=0.01)).reasons[0]
    odd = found.sensor.copy()
    odd[SENSOR.index("accel_bias_y_mps2")] = 2.0
    assert "is not to be expected" in judge_align(replace(found, sensor=odd)).reasons[0]


def test_what_is_not_told_apart_is_named(found: Alignment) -> None:
    rest = np.diag(found.prior**2)
    i, j = SENSOR.index("mount_angle_rad"), SENSOR.index("accel_bias_y_mps2")
    rest[i, j] = rest[j, i] = -0.9999 * found.prior[i] * found.prior[j]
    judged = judge_align(replace(found, covariance=rest))
    assert any(
        "the mount angle and the accelerometer's bias along y are nearly one" in r for r in judged.remarks
    )
    assert any("next to nothing of the gyroscope's bias" in remark for remark in judged.remarks)
    a, b = SENSOR.index("gyro_scale"), SENSOR.index("marker_offset_m")
    rest[a, b] = rest[b, a] = 0.99 * found.prior[a] * found.prior[b]
    judged = judge_align(replace(found, covariance=rest))
    assert any("the gyroscope's scale and the marker's offset d" in remark for remark in judged.remarks)

"""Models against logs: norms by hand, and a rig that is recovered from its own log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import log_file, rig_file, track, varied

from calib.actuator.identify_parameters import Nominal
from calib.identifying import TrackSource
from calib.logs import read_log, write_log
from calib.twin.rig import SimulatedRig
from calib.validating import (
    IMPROVED,
    NOMINAL,
    ORIGINAL,
    compare,
    estimated_start,
    validate_log,
)


def test_the_true_model_leaves_the_noise_and_another_one_more() -> None:
    values = {"stiffness_scale": 1.3, "bending_N_per_rad2": 0.25}
    source = TrackSource(track("prbs", values, noise=0.0), "truth", 0.025, ())
    nominal = Nominal()
    plant = replace(nominal.plant, stiffness_scale=1.3, bending_N_per_rad2=0.25)
    found = compare(source, {ORIGINAL: nominal, IMPROVED: replace(nominal, plant=plant)}, 0.0126)
    assert found.errors[IMPROVED]["phi"].rms < 1e-3
    assert found.errors[IMPROVED]["q1"].fit_percent > 98.0
    for quantity in ("q1", "q2", "phi"):
        assert found.improvement_percent(quantity) > 80.0
    # The angle and the two lengths say the same.
    q1, q2, phi = found.measured.T
    assert np.allclose(phi, (q1 - q2) / (2.0 * 0.0126), atol=1e-12)


def test_one_wrong_picture_does_not_decide() -> None:
    seen = track("free", noise=1.0)
    head = seen.head.copy()
    head[100] += (1.0, 0.02)
    clean, wrong = (
        compare(TrackSource(replace(seen, head=h), "pictures", 0.025, ()), {ORIGINAL: Nominal()}, 0.0126)
        for h in (seen.head, head)
    )
    assert wrong.replaced == clean.replaced + 1
    assert wrong.errors[ORIGINAL]["q1"].norm == pytest.approx(clean.errors[ORIGINAL]["q1"].norm, rel=0.02)
    assert wrong.improvement_percent("q1") is None


def test_a_log_with_its_true_parameters(tmp_path: Path) -> None:
    rig, truth = varied(2)
    keys = ("stiffness_scale", "damping_scale_pumps_connected", "bending_N_per_rad2", "lambda1_per_s")
    actuator = {key: truth[key] for key in (*keys, "lambda2_N_per_m", "damping_scale_free_swing")}
    pump = {key: truth[key] for key in ("lag_s", "falling_N_per_s")}
    pump["strength"] = [truth["strength1"], truth["strength2"]]
    path = tmp_path / "rig.yaml"
    known = rig_file(path, actuator={**actuator, "lambda3": -1.0}, pump=pump)
    log = log_file(tmp_path / "log.csv", rig, "prbs", 1, 6.0)
    found, _ = validate_log(log, known, path, truth=True)
    assert found.how == "truth" and found.hoses
    assert found.errors[IMPROVED]["q1"].rms < 1e-5 and found.errors[IMPROVED]["phi"].rms < 1e-3
    assert found.improvement_percent("q1") > 99.0
    seen, _ = validate_log(log, known, path)
    assert seen.how == "pictures"
    # The marker's place comes in whole pixels of a third of a millimetre and more.
    assert 1e-4 < seen.errors[IMPROVED]["q1"].rms < 1e-3
    assert seen.errors[IMPROVED]["q1"].fit_percent > seen.errors[ORIGINAL]["q1"].fit_percent


def test_the_start_is_the_estimators_and_no_models(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    known = rig_file(path)
    log = log_file(tmp_path / "log.csv", SimulatedRig(), "swing", 0, 3.0)
    whole = read_log(log)
    late = whole.t_s >= 0.76
    cut = tmp_path / "cut.csv"
    columns = {name: values[late] for name, values in whole.columns.items()}
    write_log(cut, replace(whole, t_s=whole.t_s[late], columns=columns, lines=whole.lines[late]))
    found = estimated_start(cut, known, path, float(whole.t_s[late][0]))
    assert found is not None
    q = np.stack([whole.columns["true_q1_m"], whole.columns["true_q2_m"]], axis=1)
    k = int(np.argmax(late))
    turn, stretch = np.array([1.0, -1.0]) / (2.0 * 0.0126), np.array([0.5, 0.5])
    rate = (q[k + 1] - q[k - 1]) / (whole.t_s[k + 1] - whole.t_s[k - 1])
    assert found.phi_rad == pytest.approx(float(q[k] @ turn), abs=0.02)
    assert found.length_m == pytest.approx(float(q[k] @ stretch), abs=5e-4)
    assert found.dphi_radps == pytest.approx(float(rate @ turn), abs=0.3)
    assert abs(found.dphi_radps) > 1.5
    told, said = validate_log(cut, known, path)
    assert told.start == "estimator" and any("begins in motion" in sentence for sentence in said)
    # The swing goes on as the model says; from rest it would be another one.
    assert told.errors[NOMINAL]["phi"].rms < 0.015
    assert told.errors[ORIGINAL]["phi"].rms > 3.0 * told.errors[NOMINAL]["phi"].rms
    blind = tmp_path / "blind.csv"
    no_imu = {name: v for name, v in columns.items() if name[:2] not in ("ax", "ay", "az", "gx", "gy", "gz")}
    write_log(blind, replace(whole, t_s=whole.t_s[late], columns=no_imu, lines=whole.lines[late]))
    assert estimated_start(blind, known, path, 0.8) is None

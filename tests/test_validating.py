"""Models against logs: norms by hand, and a rig that is recovered from its own log."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import log_file, rig_file, track, varied

from calib.actuator.identify_parameters import Nominal
from calib.errors import BadInputError
from calib.identifying import TrackSource
from calib.logs import read_log, write_log
from calib.rig import Rig, read_rig
from calib.twin.rig import SimulatedRig
from calib.validating import (
    IMPROVED,
    NOMINAL,
    ORIGINAL,
    compare,
    errors_of,
    estimated_start,
    models_of,
    validate_log,
)


def test_norms_by_hand() -> None:
    measured = np.array([[1.0, 2.0, 0.0], [3.0, 2.0, 1.0], [5.0, 2.0, 2.0], [7.0, 2.0, 3.0]])
    errors = errors_of(measured, measured + np.array([3.0, 0.0, -0.5]))
    assert errors["q1"].norm == pytest.approx(6.0) and errors["q1"].rms == pytest.approx(3.0)
    # About their mean of 4 the values have a norm of sqrt(20).
    assert errors["q1"].fit_percent == pytest.approx(100.0 * (1.0 - 6.0 / math.sqrt(20.0)))
    assert errors["q2"].norm == 0.0 and math.isnan(errors["q2"].fit_percent)
    assert errors["phi"].rms == pytest.approx(0.5)
    twice = errors_of(np.tile(measured, (2, 1)), np.tile(measured, (2, 1)) + 1.0)
    once = errors_of(measured, measured + 1.0)
    assert twice["q1"].norm == pytest.approx(math.sqrt(2.0) * once["q1"].norm)
    assert twice["q1"].rms == pytest.approx(once["q1"].rms)


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


def test_a_motion_that_leaves_the_model_is_not_known() -> None:
    nominal = Nominal()
    soft = replace(nominal, plant=replace(nominal.plant, stiffness_scale=0.05, bending_N_per_rad2=0.0))
    torn = replace(soft, strength=(10.0, 0.05))
    found = compare(TrackSource(track("prbs"), "truth", 0.025, ()), {ORIGINAL: torn}, 0.0126)
    assert math.isnan(found.errors[ORIGINAL]["q1"].norm)


def test_the_improved_model_is_that_of_the_sections(tmp_path: Path) -> None:
    assert list(models_of(Rig(), tmp_path / "rig.yaml")) == [ORIGINAL, NOMINAL]
    path = tmp_path / "rig.yaml"
    path.write_text("actuator: {stiffness_scale: 1.3}\npump: {lag_s: 0.5, strength: [1.1, 0.9]}\n")
    models = models_of(read_rig(path), path)
    assert models[NOMINAL] == Nominal()
    first = models[ORIGINAL].plant
    assert (first.bending_N_per_rad2, first.creep_rates[1], first.damping_scale) == (0.0, 0.0, 1.0)
    assert models[ORIGINAL].free_damping_scale == 1.0
    assert models[IMPROVED].plant.stiffness_scale == 1.3
    assert (models[IMPROVED].pump.lag_s, models[IMPROVED].strength) == (0.5, (1.1, 0.9))


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


def test_a_log_without_commands_is_refused(tmp_path: Path) -> None:
    log = log_file(tmp_path / "log.csv", SimulatedRig(), "swing", 0, 2.0)
    lines = [line.split(",") for line in log.read_text().splitlines()]
    keep = [k for k, name in enumerate(lines[0]) if not name.startswith("pwm")]
    log.write_text("\n".join(",".join(line[k] for k in keep) for line in lines) + "\n")
    path = tmp_path / "rig.yaml"
    known = rig_file(path)
    with pytest.raises(BadInputError, match="has no commands, expected pwm1 and pwm2"):
        validate_log(log, known, path)
    found, _ = validate_log(log, known, path, no_pwm=True)
    assert not found.hoses and found.errors[NOMINAL]["phi"].fit_percent > 80.0


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

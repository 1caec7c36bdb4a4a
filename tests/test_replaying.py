"""From a log and a rig.yaml to the estimator's rows and set-up."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from estimatorlogs import simulated

from calib.errors import BadInputError
from calib.estimator.model import LEVELS
from calib.estimator.sensors import SENSOR
from calib.logs import Log, write_log
from calib.replaying import (
    DEFAULTS,
    Periods,
    blocks,
    noise_at_rest,
    periods,
    rows_of,
    setup_from_rig,
    truth_of,
)
from calib.rig import Rig
from calib.rig_estimator import Estimator

ALIGN = {
    "time_offset_s": 0.031,
    "mount_angle_rad": 0.01,
    "rest_angle_rad": 0.01,
    "gyro_scale": 0.002,
    "gyro_bias_radps": 0.001,
    "accel_bias_mps2": [0.1, -0.2],
    "accel_scale": [0.001, 0.002],
    "imu_lever_m": 0.007,
    "marker_offset_m": 0.016,
    "plane_shift_m": [1e-5, 2e-5],
    "plane_stretch": 1e-4,
    "jitter_px": 0.4,
    "outlier_share": 0.0,
    "accel_noise_mps2": [0.02, 0.02],
    "gyro_noise_radps": 0.003,
    "verdict": "ok",
}
BLIND = Periods(math.nan, 0.01, 0.0, False, 0, 100)


def log_of(t: list[float], **columns: list[float]) -> Log:
    made = {name: np.array(values) for name, values in columns.items()}
    return Log("made", np.array(t), made, np.arange(len(t)))


def sensor(setup: object, name: str) -> tuple[float, float]:
    start = setup.start
    k = SENSOR.index(name)
    return float(start.sensor[k]), float(start.sensor_sigma[k])


def test_rates_and_kinds_of_rows_are_found() -> None:
    _, log = simulated("ellipse")
    found = periods(log)
    assert found.camera_s == pytest.approx(1.0 / 60.0, rel=0.02)
    assert found.imu_s == pytest.approx(0.01, rel=0.02)
    assert found.grid_px == 1.0 and found.ticks
    rows = rows_of(log, found.ticks)
    assert set(rows.kinds.tolist()) == {1, 2}
    lost = (rows.kinds == 1) & np.isnan(rows.readings[:, 0])
    assert lost.any()
    truth = truth_of(log)
    assert truth is not None and truth.shape == (len(log), 3)


def test_commands_in_rows_of_their_own_are_no_clock_of_the_camera() -> None:
    nan = math.nan
    log = log_of(
        [0.0, 0.01, 0.02, 0.03],
        u_px=[1.5, nan, nan, nan],
        v_px=[2.0, nan, nan, nan],
        pwm1=[nan, 5.0, 5.0, 5.0],
        gz_radps=[nan, nan, nan, 0.1],
    )
    found = periods(log)
    assert not found.ticks and found.grid_px == 0.0 and math.isnan(found.camera_s)
    assert rows_of(log, found.ticks).kinds.tolist() == [1, 0, 0, 2]
    assert truth_of(log) is None


def test_infinity_is_no_reading() -> None:
    log = log_of([0.0, 0.1], u_px=[math.inf, 1.0], v_px=[1.0, 2.0])
    rows = rows_of(log, False)
    assert rows.kinds.tolist() == [0, 1] and not np.isinf(rows.readings).any()


def test_without_sections_there_are_wide_priors_and_a_sentence() -> None:
    setup, said = setup_from_rig(Rig(), Path("rig.yaml"), BLIND)
    assert any("no section align" in sentence for sentence in said)
    assert any("no pictures" in sentence for sentence in said)
    for name, expected in DEFAULTS.items():
        assert sensor(setup, name) == pytest.approx(expected)
    assert setup.process.levels == LEVELS


def test_values_come_from_the_sections() -> None:
    made = Rig.model_validate(
        {
            "align": {**ALIGN, "sigma": {"time_offset_s": 0.001, "accel_bias_mps2": [0.01, 0.02]}},
            "actuator": {"bellows_radius_m": 0.014, "rest_length_m": 0.07},
            "estimator": {"jitter_px": 0.5, "verdict": "ok", "accel_noise_mps2": 0.03},
        }
    )
    setup, said = setup_from_rig(made, Path("rig.yaml"), BLIND)
    assert sensor(setup, "time_offset_s") == (0.031, 0.001)
    assert sensor(setup, "accel_bias_x_mps2") == (0.1, 0.01)
    assert sensor(setup, "accel_bias_y_mps2") == (-0.2, 0.02)
    assert sensor(setup, "mount_angle_rad") == (0.01, DEFAULTS["mount_angle_rad"][1])
    assert sensor(setup, "shift_y_m")[0] == 2e-5 and sensor(setup, "stretch")[0] == 1e-4
    assert setup.noise[4] == 0.003
    assert setup.bellows_radius_m == 0.014 and setup.start.head[1] == pytest.approx(0.074)
    assert setup.noise[0] == 0.5 and setup.noise[2] == setup.noise[3] == 0.03
    assert not any("align" in sentence for sentence in said)


def test_noise_is_that_at_rest_unless_the_moving_rig_shakes() -> None:
    size = {
        "rate_hz": 100.0, "gyro_noise_radps_per_sqrt_Hz": [None, None, 2e-4],
        "accel_noise_mps2_per_sqrt_Hz": [1.8e-3, 1e-3, None],
    }  # fmt: skip
    others = (
        "gyro_bias_radps", "gyro_instability_radps", "gyro_walk_radps2_per_sqrt_Hz", "accel_mean_mps2",
        "accel_instability_mps2", "accel_walk_mps3_per_sqrt_Hz", "gyro_step_radps", "accel_step_mps2",
    )  # fmt: skip
    imu = {**{name: [None, None, None] for name in others}, **size, "verdict": "ok"}
    made = Rig.model_validate({"align": ALIGN, "imu": imu})
    # 0.02 in the alignment: a little more than 0.018 at rest, twice as much as 0.01.
    np.testing.assert_allclose(noise_at_rest(made, BLIND), [0.018, 0.02, 0.002])
    np.testing.assert_allclose(
        setup_from_rig(made, Path("rig.yaml"), BLIND)[0].noise[2:5], [0.02, 0.02, 0.003]
    )
    tuned = {"jitter_px": 0.5, "verdict": "ok", "accel_noise_mps2": 0.03}
    assert noise_at_rest(Rig.model_validate({"imu": imu, "estimator": tuned}), BLIND) is None
    assert noise_at_rest(Rig.model_validate({"align": ALIGN}), BLIND) is None


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("actuator", "bellows_radius_m", "wide"),
        ("actuator", "bellows_radius_m", math.inf),
        ("actuator", "rest_length_m", -1),
    ],
)
def test_values_that_are_none_are_named(section: str, key: str, value: object) -> None:
    made = Rig.model_validate({section: {key: value}})
    with pytest.raises(BadInputError, match=f"rig.yaml: {section}.{key}"):
        setup_from_rig(made, Path("rig.yaml"), BLIND)


def test_the_covariance_of_the_alignment_is_carried() -> None:
    order = ["mount_angle_rad", "accel_bias_y_mps2"]
    values = [[1e-4, -9.8e-4], [-9.8e-4, 9.7e-3]]
    made = Rig.model_validate({"align": {**ALIGN, "covariance": {"order": order, "values": values}}})
    setup, _ = setup_from_rig(made, Path("rig.yaml"), BLIND)
    P = setup.start.covariance()
    at = [6 + SENSOR.index(name) for name in order]
    np.testing.assert_allclose(P[np.ix_(at, at)], values, rtol=1e-3)
    assert np.linalg.eigvalsh(P[6:, 6:])[0] > 0.0
    # Together they are known far better than either.
    both = np.array([9.81, 1.0])
    assert both @ P[np.ix_(at, at)] @ both < 1e-3 < 9.81**2 * P[at[0], at[0]]


def test_pictures_without_a_camera_are_refused() -> None:
    with pytest.raises(BadInputError, match="has no camera"):
        setup_from_rig(Rig(), Path("rig.yaml"), Periods(0.017, 0.01, 1.0, True, 10, 10))


def test_blocks_refuse_a_log_without_sensors(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    write_log(path, log_of([0.0], pwm1=[1.0]))
    with pytest.raises(BadInputError, match="neither camera nor IMU"):
        list(blocks(path))
    path.write_text("t_s,gz_radps\n")
    with pytest.raises(BadInputError, match="no rows"):
        list(blocks(path))


def test_the_section_of_the_estimator_is_part_of_the_schema() -> None:
    assert Estimator.model_validate({"jitter_px": 0.3, "verdict": "ok"}).levels == []

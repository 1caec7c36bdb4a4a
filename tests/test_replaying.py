"""From a log and a rig.yaml to the estimator's rows and set-up."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from calib.estimator.sensors import SENSOR
from calib.logs import Log
from calib.replaying import (
    Periods,
    noise_at_rest,
    periods,
    rows_of,
    setup_from_rig,
    truth_of,
)
from calib.rig import Rig

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

"""From files to an alignment's input, and to the section."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_trials import align_log, known, twin_log

from calib.aligning import PRIOR, align_section, read_align_log, settings_from_rig
from calib.errors import BadInputError
from calib.estimator.align import align
from calib.estimator.align_verdict import judge_align
from calib.estimator.sensors import SENSOR
from calib.logs import Log, write_log
from calib.replaying import Periods, setup_from_rig
from calib.rig import Camera, Distortion, Plane, Rig, read_rig, write_rig
from calib.twin.rig import SimulatedRig

RIG = SimulatedRig()
SIZE = RIG.view.camera.image_size_px


@pytest.fixture(scope="module")
def log() -> Log:
    return twin_log(RIG, "swing", {"phi_rad": "0.5"}, 1)


def _rig_file() -> Rig:
    view = RIG.view
    R, t, K = view.R_CW, view.t_CW_m, view.camera.K
    A = K @ np.column_stack([R[:, 0], R[:, 1], t])
    k1, k2 = view.camera.distortion[:2].tolist()
    camera = Camera(
        model="radial2",
        image_size_px=list(SIZE),
        fx_px=view.camera.fx_px,
        fy_px=view.camera.fy_px,
        cx_px=view.camera.cx_px,
        cy_px=view.camera.cy_px,
        distortion=Distortion(k1=k1, k2=k2),
        verdict="ok",
    )
    plane = Plane(
        R_CW=R.tolist(),
        t_CW_m=t.tolist(),
        A_px_per_m=A.tolist(),
        A_inverse=np.linalg.inv(A).tolist(),
        rms_px=0.0,
        rms_mm=0.0,
        sigma_marker_mm={"calibration_max": 0.06},
        verdict="ok",
    )
    return Rig(camera=camera, plane=plane)


def _changed(log: Log, **columns: object) -> Log:
    kept = dict(log.columns)
    for name, value in columns.items():
        if value is None:
            kept.pop(name)
        else:
            kept[name] = np.asarray(value)
    return replace(log, columns=kept)


def test_rows_of_both_sensors_are_taken_apart(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "log.csv", log)
    read, said = read_align_log(tmp_path / "log.csv", SIZE)
    assert read is not None
    assert said == []
    expected = align_log(log)
    assert np.allclose(read.pixels, expected.pixels)
    assert np.allclose(read.readings, expected.readings)
    assert np.allclose(read.imu_s, expected.imu_s, atol=1e-6)


def test_a_marker_outside_of_the_picture_counts_as_blank(log: Log, tmp_path: Path) -> None:
    u = log.columns["u_px"].copy()
    rows = np.flatnonzero(np.isfinite(u))
    u[rows[:7]] = -40.0
    write_log(tmp_path / "log.csv", _changed(log, u_px=u))
    read, said = read_align_log(tmp_path / "log.csv", SIZE)
    assert read is not None
    assert len(read.pixels) == len(rows) - 7
    assert "7 pictures put the marker outside the image" in said[0]


def test_a_log_without_a_sensor_is_passed_over(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "a.csv", _changed(log, u_px=None, v_px=None))
    write_log(tmp_path / "b.csv", _changed(log, gz_radps=None))
    write_log(tmp_path / "c.csv", _changed(log, ax_mps2=None, ay_mps2=None))
    for name, words in (("a", "has no picture of the marker"), ("b", "has no gyroscope")):
        read, said = read_align_log(tmp_path / f"{name}.csv", SIZE)
        assert read is None
        assert words in said[-1]
    read, said = read_align_log(tmp_path / "c.csv", SIZE)
    assert read is not None
    assert "has no accelerometer" in said[-1]


def test_units_that_are_others_are_refused(log: Log, tmp_path: Path) -> None:
    g = {name: log.columns[name] / 9.81 for name in ("ax_mps2", "ay_mps2")}
    write_log(tmp_path / "g.csv", _changed(log, **g))
    with pytest.raises(BadInputError, match="in g, expected m/s"):
        read_align_log(tmp_path / "g.csv", SIZE)
    write_log(tmp_path / "deg.csv", _changed(log, gz_radps=57.3 * log.columns["gz_radps"]))
    with pytest.raises(BadInputError, match="in deg/s, expected rad/s"):
        read_align_log(tmp_path / "deg.csv", SIZE)
    counts = {name: 1000.0 * log.columns[name] for name in ("ax_mps2", "ay_mps2")}
    write_log(tmp_path / "counts.csv", _changed(log, **counts))
    with pytest.raises(BadInputError, match=r"expected about 9\.81"):
        read_align_log(tmp_path / "counts.csv", SIZE)


def test_priors_come_from_the_file() -> None:
    settings = settings_from_rig(_rig_file(), Path("rig.yaml"), [])
    assert settings.sigma[SENSOR.index("shift_x_m")] == pytest.approx(0.06e-3 / np.sqrt(2.0))
    assert settings.mean[SENSOR.index("marker_offset_m")] == PRIOR["marker_offset_m"][0]
    given = settings_from_rig(_rig_file(), Path("rig.yaml"), [], 0.012)
    assert given.mean[SENSOR.index("marker_offset_m")] == 0.012
    with pytest.raises(BadInputError, match="run calib intrinsics first"):
        settings_from_rig(Rig(), Path("rig.yaml"), [])
    with pytest.raises(BadInputError, match="run calib extrinsics first"):
        settings_from_rig(_rig_file().model_copy(update={"plane": None}), Path("rig.yaml"), [])


def test_the_section_is_what_the_estimator_reads(log: Log, tmp_path: Path) -> None:
    whole = _rig_file()
    logs = [align_log(log)]
    found = align(logs, settings_from_rig(whole, Path("rig.yaml"), logs))
    section = align_section(found, judge_align(found))
    path = tmp_path / "rig.yaml"
    write_rig(path, whole.model_copy(update={"align": section}), {})
    back = read_rig(path)
    assert back.align == section
    assert section.covariance is not None
    assert section.covariance.order == list(SENSOR)
    setup, _ = setup_from_rig(back, path, Periods(1 / 60, 0.01, 1.0, False, 100, 100))
    for name in ("time_offset_s", "mount_angle_rad", "gyro_scale", "gyro_bias_radps", "marker_offset_m"):
        k = SENSOR.index(name)
        assert setup.start.sensor[k] == found.sensor[k]
        assert setup.start.sensor_sigma[k] == pytest.approx(found.sigma[k])
    truth = known(RIG).truth
    assert abs(section.time_offset_s - truth[SENSOR.index("time_offset_s")]) < 1e-3

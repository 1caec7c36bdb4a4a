"""From files to an alignment's input, and to the section."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from align_trials import align_log, known, twin_log
from scipy.stats import norm

from calib.aligning import align_section, read_align_log, settings_from_rig, with_drawn_marker
from calib.arrays import FloatArray
from calib.estimator.align import Alignment, align
from calib.estimator.align_verdict import judge_align
from calib.estimator.sensors import SENSOR
from calib.logs import Log, write_log
from calib.replaying import Periods, setup_from_rig
from calib.rig import Camera, Distortion, Geometry, Plane, Rig, read_rig, write_rig
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


def test_a_marker_outside_of_the_picture_counts_as_blank(log: Log, tmp_path: Path) -> None:
    u = log.columns["u_px"].copy()
    rows = np.flatnonzero(np.isfinite(u))
    u[rows[:7]] = -40.0
    write_log(tmp_path / "log.csv", _changed(log, u_px=u))
    read, said = read_align_log(tmp_path / "log.csv", SIZE)
    assert read is not None
    assert len(read.pixels) == len(rows) - 7
    assert "7 pictures put the marker outside the image" in said[0]


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


def _mixture(found: Alignment, drawn: float, sigma: float, doubt: float) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance after a reading of d of two kinds, by information matrices and their sum."""
    at = SENSOR.index("marker_offset_m")
    scale = found.sigma
    own, start = np.linalg.inv(found.covariance / np.outer(scale, scale)), found.sensor / scale
    means, covariances, weights = [], [], []
    for share, room in ((1.0 - doubt, sigma), (doubt, np.hypot(sigma, 3e-3))):
        information = own.copy()
        information[at, at] += (scale[at] / room) ** 2
        right = own @ start
        right[at] += drawn / room**2 * scale[at]
        covariances.append(np.linalg.inv(information))
        means.append(covariances[-1] @ right)
        weights.append(share * norm.pdf(drawn, found.sensor[at], np.hypot(scale[at], room)))
    share = np.array(weights) / np.sum(weights)
    mean = share @ np.array(means)
    covariance = sum(
        w * (C + np.outer(m - mean, m - mean)) for w, m, C in zip(share, means, covariances, strict=True)
    )
    return mean * scale, covariance * np.outer(scale, scale)


@pytest.mark.parametrize("apart", [-8.0, -1.5, 0.2, 2.0, 3.0, 8.0])
def test_the_drawing_is_one_more_reading_of_the_marker(log: Log, apart: float) -> None:
    found = align([align_log(log)], settings_from_rig(_rig_file(), Path("rig.yaml"), []))
    at = SENSOR.index("marker_offset_m")
    drawn = float(found.sensor[at] + apart * found.sigma[at])
    told, said = with_drawn_marker(found, Geometry(marker_offset_m=drawn, marker_offset_sigma_m=1e-4))
    mean, covariance = _mixture(found, drawn, 1e-4, 0.02)
    assert np.all(np.abs(told.sensor - mean) < 1e-5 * found.sigma)
    np.testing.assert_allclose(told.covariance, covariance, atol=1e-6 * found.sigma.max() ** 2, rtol=1e-4)
    np.testing.assert_array_equal(told.covariance, told.covariance.T)
    assert np.linalg.eigvalsh(told.covariance / np.outer(found.sigma, found.sigma)).min() > 0.0
    assert ("contradict" in said[0]) == (abs(apart) > 5.0)
    if abs(apart) < 1.0:
        assert told.sigma[at] < 2e-4 < found.sigma[at]
        # What was one number with the marker is known with it.
        assert told.sigma[SENSOR.index("imu_lever_m")] < 0.7 * found.sigma[SENSOR.index("imu_lever_m")]
        assert told.rest_angle_sigma <= found.rest_angle_sigma
        assert "as drawn" in said[0] and "measure it" not in said[0]


def test_a_drawing_that_nobody_wrote_down_is_doubted_more(log: Log) -> None:
    found = align([align_log(log)], settings_from_rig(_rig_file(), Path("rig.yaml"), []))
    nominal, said = with_drawn_marker(found, Geometry())
    written, _ = with_drawn_marker(found, Geometry(marker_offset_m=0.015))
    at = SENSOR.index("marker_offset_m")
    assert written.sigma[at] < nominal.sigma[at] < found.sigma[at]
    assert "measure it and write it down" in said[0]


def test_sigma_grows_where_the_marker_is_not_where_it_was_drawn() -> None:
    """Markers half a millimetre off, and nobody knows: sigma follows the error, a firm prior's does not."""
    rng = np.random.default_rng(4)
    at, own, drawn = SENSOR.index("marker_offset_m"), 2.5e-4, Geometry()
    covariance = np.diag(np.full(len(SENSOR), 1e-6))
    covariance[at, at] = own * own
    blank = Alignment(**{field.name: None for field in fields(Alignment)})
    mixed, firm = [], []
    room = drawn.marker_offset_sigma_m**2
    for _ in range(2000):
        true = drawn.marker_offset_m + rng.normal(0.0, 5e-4)
        sensor = np.zeros(len(SENSOR))
        sensor[at] = true + rng.normal(0.0, own)
        told, _ = with_drawn_marker(replace(blank, sensor=sensor, covariance=covariance), drawn)
        mixed.append((told.sensor[at] - true) ** 2 / told.covariance[at, at])
        mean = (sensor[at] * room + drawn.marker_offset_m * own**2) / (own**2 + room)
        firm.append((mean - true) ** 2 * (1.0 / room + 1.0 / own**2))
    assert np.mean(mixed) < 0.2 * np.mean(firm)

"""The first guess: offset, mount angle, splits, and gyroscopes in other units or the wrong way round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from align_trials import align_log, known, prior_settings, twin_log

from calib.errors import BadInputError
from calib.estimator.align_start import AlignLog, correlation, pieces_of, start
from calib.estimator.sensors import view_coefficients
from calib.twin.rig import SimulatedRig, nominal_view

RIG = SimulatedRig()
VIEW = nominal_view()
NUMBERS = view_coefficients(VIEW.camera, VIEW.R_CW, VIEW.t_CW_m)
MEAN = prior_settings(NUMBERS).mean


@pytest.fixture(scope="module")
def swing() -> AlignLog:
    return align_log(twin_log(RIG, "swing", {"phi_rad": "0.5"}, 1))


def test_a_swing_shows_offset_and_mount(swing: AlignLog) -> None:
    pieces, said = pieces_of([swing], NUMBERS, MEAN)
    first = start(pieces, [swing], 0.0)
    assert said == []
    assert first.moves
    assert first.time_offset_s == pytest.approx(0.025, abs=0.0051)
    assert first.factor == pytest.approx(1.0, abs=0.05)
    assert first.mount_angle_rad == pytest.approx(0.0158, abs=0.01)
    shown = correlation(pieces)
    assert shown.offset_s[np.argmax(shown.value)] == pytest.approx(0.025, abs=0.0051)


def test_at_rest_the_usual_offset_stays() -> None:
    log = align_log(twin_log(RIG, "static", {}, 2, 8.0))
    pieces, _ = pieces_of([log], NUMBERS, MEAN)
    first = start(pieces, [log], 0.03)
    assert not first.moves
    assert first.time_offset_s == pytest.approx(0.03, abs=1e-9)
    # At rest the accelerations are held near zero, in motion they are free.
    assert np.median(first.stretches[0].loose[:, 0]) < 0.01


def test_motion_is_left_free(swing: AlignLog) -> None:
    pieces, _ = pieces_of([swing], NUMBERS, MEAN)
    first = start(pieces, [swing], 0.0)
    assert np.median(first.stretches[0].loose[:, 0]) > 100.0


@pytest.mark.parametrize(("factor", "words"), [(57.2958, "in deg/s"), (-1.0, "the other way round")])
def test_a_gyroscope_in_other_units_is_refused(swing: AlignLog, factor: float, words: str) -> None:
    wrong = replace(swing, readings=swing.readings * np.array([1.0, 1.0, factor]))
    pieces, _ = pieces_of([wrong], NUMBERS, MEAN)
    with pytest.raises(BadInputError, match=words):
        start(pieces, [wrong], 0.025)


def test_an_hour_splits_and_a_moment_is_left_out(swing: AlignLog) -> None:
    late = np.where(swing.camera_s > 2.5, 3600.0, 0.0), np.where(swing.imu_s > 2.5, 3600.0, 0.0)
    jumped = replace(swing, camera_s=swing.camera_s + late[0], imu_s=swing.imu_s + late[1])
    few = replace(swing, camera_s=swing.camera_s[:30], pixels=swing.pixels[:30])
    pieces, said = pieces_of([jumped, few], NUMBERS, MEAN)
    assert [piece.log for piece in pieces] == [0, 0]
    assert len(said) == 2
    assert "split at 1 gap" in said[0]
    assert "has no stretch of 1 s" in said[1]


def test_outliers_are_not_taken_for_motion(swing: AlignLog) -> None:
    pixels = swing.pixels.copy()
    pixels[50::40] += 15.0
    pieces, _ = pieces_of([replace(swing, pixels=pixels)], NUMBERS, MEAN)
    assert not pieces[0].fine[50::40].any()
    assert pieces[0].fine.mean() > 0.9
    assert known(RIG).truth[7] == 0.025

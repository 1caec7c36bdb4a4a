"""What the driven filter starts from."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drivenlogs import varied_drive
from estimatorlogs import setup_for

from calib.estimator.driven_model import DRIVEN, DYNAMIC, INVOLVED, PLANT
from calib.estimator.driven_setup import Drive, commands


def test_the_prior_holds_hoses_off_and_on() -> None:
    x, P = Drive().start(setup_for(varied_drive(1)))
    at = DRIVEN.index("log_damping")
    off = math.log(3.3 / 16.0)
    assert abs(x[at] - off) < 1.1 * math.sqrt(P[at, at])
    assert abs(x[at]) < 1.1 * math.sqrt(P[at, at])
    assert np.all(np.linalg.eigvalsh(P) > 0.0)
    np.testing.assert_array_equal(
        P[INVOLVED:, INVOLVED:], setup_for(varied_drive(1)).start.covariance()[6:, 6:]
    )


def test_what_was_identified_together_starts_together() -> None:
    sigma = np.array(Drive().sigma)
    told = 0.01 * np.outer(sigma, sigma) + 0.01 * np.diag(sigma**2)
    deviation = np.sqrt(np.diag(told))
    drive = Drive(sigma=tuple(deviation.tolist()), covariance=told)
    _, P = drive.start(setup_for(varied_drive(1)))
    at = DRIVEN.index("log_damping")
    others = [k for k in range(DYNAMIC, INVOLVED) if k != at]
    np.testing.assert_array_equal(
        P[np.ix_(others, others)], told[np.ix_(*[np.subtract(others, DYNAMIC)] * 2)]
    )
    # Of the damping nobody knows yet whether the hoses are on.
    assert P[at, at] > 100.0 * told[1, 1]
    assert np.all(np.linalg.eigvalsh(P) > 0.0)


def test_pictures_are_put_at_their_exposure() -> None:
    setup = setup_for(varied_drive(2))
    assert setup.start.sensor[7] > 0.005
    assert Drive().start(setup)[0][DRIVEN.index("time_offset_s")] == pytest.approx(0.0, abs=1e-12)


def test_vectors_have_their_lengths() -> None:
    drive, setup = Drive(), setup_for(varied_drive(1))
    assert drive.numbers().shape == (len(PLANT),)
    assert drive.walk(setup).shape == (len(DRIVEN),)
    assert len(drive.sigma) == INVOLVED - DYNAMIC


def test_commands_become_static_forces_and_blank_ones_stay_blank() -> None:
    pwm = np.array([[0.0, 255.0], [np.nan, np.nan], [50.0, 300.0]])
    got = commands(Drive(strength=(1.0, 1.1)), pwm)
    assert np.isnan(got[1]).all()
    assert got[0, 0] == 0.0 and got[2, 0] == 0.0
    assert got[0, 1] == got[2, 1] == pytest.approx(1.1 * 2.04, rel=0.03)


def test_noise_at_rest_is_that_of_the_driven_filter_alone() -> None:
    setup = setup_for(varied_drive(1), 1)
    np.testing.assert_array_equal(Drive().noise(setup), setup.noise)
    own = Drive(imu_noise=(0.01, 0.02, 0.003)).noise(setup)
    np.testing.assert_array_equal(own[2:5], [0.01, 0.02, 0.003])
    np.testing.assert_array_equal(np.delete(own, [2, 3, 4]), np.delete(setup.noise, [2, 3, 4]))

"""Plant and pumps of the driven model from rig.yaml."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.actuator.pump import Orifice, RateLimit
from calib.driving import drive_from_rig, has_commands, pwm_of
from calib.errors import BadInputError
from calib.estimator.driven_model import PARAMETER
from calib.estimator.driven_setup import Drive
from calib.logs import Log
from calib.rig import Rig

HERE = Path("rig.yaml")


def test_an_empty_file_is_the_nominal_plant() -> None:
    drive, nominal = drive_from_rig(Rig(), HERE), Drive()
    np.testing.assert_array_equal(drive.numbers(), nominal.numbers())
    assert (drive.pump, drive.strength, drive.sigma) == (nominal.pump, nominal.strength, nominal.sigma)
    assert drive.free_damping_scale == nominal.free_damping_scale


def test_what_the_file_says_is_taken_with_its_deviations() -> None:
    rig = Rig.model_validate(
        {
            "actuator": {
                "mass_kg": 0.018,
                "k0_N_per_m": 50.0,
                "stiffness_scale": 1.1,
                "damping_scale_pumps_connected": 14.0,
                "damping_scale_free_swing": 3.0,
                "rest_length_m": 0.066,
                "sigma": {"mass_kg": 0.0009, "stiffness_scale": 0.001, "rest_length_m": 2e-4},
            },
            "pump": {
                "lag_s": 0.65,
                "delay_ticks": 3.0,
                "deflation": "orifice",
                "laminar_s": 1.2,
                "strength": [1.02, 0.97],
                "sigma": {"strength": [0.02, None], "lag_s": 0.013},
            },
        }
    )
    drive = drive_from_rig(rig, HERE)
    sigma = dict(zip(PARAMETER, drive.sigma, strict=True))
    nominal = dict(zip(PARAMETER, Drive().sigma, strict=True))
    assert drive.plant.mass_kg == 0.018 and drive.plant.stiffness.padded[0] == 50.0
    assert drive.plant.damping_scale == 14.0 and drive.free_damping_scale == 3.0
    assert drive.pump.delay_ticks == 3 and drive.pump.lag_s == 0.65
    assert drive.pump.deflation == Orifice(laminar_s=1.2)
    assert drive.strength == (1.02, 0.97)
    assert sigma["mass"] == pytest.approx(0.05)
    assert sigma["stiffness"] == 0.01
    assert sigma["rest_length_m"] == 2e-4
    assert sigma["strength1"] == pytest.approx(0.02 / 1.02) and sigma["strength2"] == nominal["strength2"]
    assert sigma["lag"] == pytest.approx(0.02)
    assert sigma["bending"] == nominal["bending"]


_TOLD = ("stiffness_scale", "lambda2_N_per_m", "lag_s", "strength1", "strength2", "damping_scale_free_swing")


def _identified(sigma: tuple[float, ...], correlation: float, lag_sigma: float | None = None) -> Rig:
    """A rig whose values were identified together, all pairs with one correlation."""
    share = np.full((len(sigma), len(sigma)), correlation) + (1.0 - correlation) * np.eye(len(sigma))
    table = {"order": list(_TOLD), "values": (share * np.outer(sigma, sigma)).tolist()}
    k, c, lag, first, second, free = sigma
    return Rig.model_validate(
        {
            "actuator": {
                "stiffness_scale": 1.1, "lambda2_N_per_m": 9.0, "damping_scale_free_swing": 3.0,
                "sigma": {"stiffness_scale": k, "lambda2_N_per_m": c, "damping_scale_free_swing": free},
                "covariance": table,
            },
            "pump": {
                "lag_s": 0.7, "strength": [1.0, 0.97],
                "sigma": {"lag_s": lag if lag_sigma is None else lag_sigma, "strength": [first, second]},
            },
        }
    )  # fmt: skip


def test_what_was_identified_together_stays_together() -> None:
    drive = drive_from_rig(_identified((0.022, 0.36, 0.014, 0.02, 0.0194, 0.1), 0.98), HERE)
    assert drive.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(drive.covariance)), drive.sigma, rtol=1e-12)
    assert np.linalg.eigvalsh(drive.covariance).min() > 0.0
    k, c, s1, s2 = (PARAMETER.index(n) for n in ("stiffness", "creep_stiffness", "strength1", "strength2"))
    deviation = np.sqrt(np.diag(drive.covariance))
    # Shares of the values, and 0.3 % of each that it has for itself.
    assert deviation[[k, c, s1]] == pytest.approx(np.hypot([0.02, 0.04, 0.02], 0.003))
    assert drive.covariance[k, c] == pytest.approx(0.98 * 0.02 * 0.04)
    assert drive.covariance[s1, s2] == pytest.approx(0.98 * 0.02 * 0.02)
    # The scale of forces and springs is that of the mass, which was kept.
    assert drive.sigma[PARAMETER.index("mass")] == 0.01
    bending = PARAMETER.index("bending")
    assert np.count_nonzero(drive.covariance[bending]) == 1
    assert drive.sigma[bending] == Drive().sigma[bending]


def test_correlations_that_cannot_be_are_refused() -> None:
    for correlation in (1.4, -0.9, 1e6):
        rig = _identified((0.022, 0.36, 0.014, 0.02, 0.0194, 0.1), correlation)
        with pytest.raises(
            BadInputError, match=r"rig\.yaml: actuator\.covariance has .* expected a positive"
        ):
            drive_from_rig(rig, HERE)


def test_what_was_estimated_apart_since_is_independent() -> None:
    drive = drive_from_rig(_identified((0.022, 0.36, 0.014, 0.02, 0.0194, 0.1), 0.9, lag_sigma=0.021), HERE)
    assert drive.covariance is not None
    lag = PARAMETER.index("lag")
    assert np.count_nonzero(drive.covariance[lag]) == 1
    assert drive.sigma[lag] == pytest.approx(0.03)


def test_what_was_hardly_identified_is_no_wider_than_rigs_differ() -> None:
    drive = drive_from_rig(_identified((0.5, 4.0, 0.6, 0.02, 0.0194, 0.1), 0.3), HERE)
    nominal = dict(zip(PARAMETER, Drive().sigma, strict=True))
    for name in ("stiffness", "creep_stiffness", "lag"):
        assert drive.sigma[PARAMETER.index(name)] == pytest.approx(np.hypot(nominal[name], 0.003))


def test_tuned_walks_are_taken() -> None:
    driven = {
        "walk_disturbance_N_per_sqrt_s": 1e-3, "walk_turning_radps_per_sqrt_s": 4e-3,
        "walk_growing_mps_per_sqrt_s": 2e-4, "walk_forces_N_per_sqrt_s": 5e-5,
    }  # fmt: skip
    rig = Rig.model_validate({"estimator": {"jitter_px": 0.3, "verdict": "ok", "driven": driven}})
    drive = drive_from_rig(rig, HERE)
    assert (drive.walk_disturbance, drive.walk_rates, drive.walk_forces) == (1e-3, (4e-3, 2e-4), 5e-5)


def test_a_rate_limit_is_the_default() -> None:
    drive = drive_from_rig(Rig.model_validate({"pump": {"falling_N_per_s": 0.5}}), HERE)
    assert drive.pump.deflation == RateLimit(0.5)


@pytest.mark.parametrize(
    ("sections", "told"),
    [
        ({"actuator": {"mass_kg": "heavy"}}, "actuator.mass_kg"),
        ({"pump": {"lag": 0.7}}, "pump.lag"),
        ({"actuator": {"k0_N_per_m": 1.0, "k1_N_per_m2": -5000.0}}, "stiffness"),
    ],
)
def test_what_no_plant_has_is_refused(sections: dict[str, object], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        drive_from_rig(Rig.model_validate(sections), HERE)


def test_commands_are_found_in_a_log() -> None:
    nan = np.nan
    columns = {"pwm1": np.array([nan, 5.0]), "pwm2": np.array([nan, 7.0])}
    log = Log("made", np.array([0.0, 0.1]), columns, np.arange(2))
    assert has_commands(log)
    np.testing.assert_array_equal(pwm_of(log), [[nan, nan], [5.0, 7.0]])
    del columns["pwm2"]
    assert not has_commands(Log("made", np.array([0.0, 0.1]), columns, np.arange(2)))

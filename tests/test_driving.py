"""Plant and pumps of the driven model from rig.yaml."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.driving import drive_from_rig
from calib.estimator.driven_model import PARAMETER
from calib.estimator.driven_setup import Drive
from calib.rig import Rig

HERE = Path("rig.yaml")


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

"""The search: truth without noise, what cannot be told, outliers, and nothing to tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identifytrials import track

from calib.actuator.identify_fit import fit_tracks
from calib.actuator.identify_parameters import Nominal
from calib.errors import BadInputError

TRUTH = {
    "stiffness_scale": 1.15,
    "damping_scale_free_swing": 2.8,
    "bending_N_per_rad2": 0.2,
    "lambda1_per_s": 2.5,
    "lambda2_N_per_m": 12.0,
}


def test_swings_without_noise_give_the_truth() -> None:
    tracks = [track("free", TRUTH, phi, noise=0.0) for phi in (0.5, -0.35)]
    found = fit_tracks(Nominal(), tracks, threads=1)
    for name, value in TRUTH.items():
        assert found.values[name] == pytest.approx(value, rel=0.01), name
    assert found.fixed == {"lambda3": "lambda2 and lambda3 enter only as a product; kept at -1"}
    assert found.agreeing >= 1


@pytest.mark.slow
def test_pumps_without_noise_give_the_truth() -> None:
    truth = {
        "lag_s": 0.6,
        "strength1": 1.05,
        "strength2": 0.95,
        "falling_N_per_s": 0.45,
        "bending_N_per_rad2": 0.2,
    }
    tracks = [
        track("prbs", truth, noise=0.1, duration_s=8.0),
        track("steps", truth, noise=0.1, duration_s=8.0),
    ]
    found = fit_tracks(Nominal(), tracks, threads=1)
    for name, value in truth.items():
        assert found.values[name] == pytest.approx(value, rel=0.03), name


def test_another_thing_in_place_of_the_marker_does_not_pull() -> None:
    tracks = []
    for seed, phi in enumerate((0.5, -0.35)):
        one = track("free", TRUTH, phi, noise=0.2, seed=seed)
        head = one.head.copy()
        head[np.random.default_rng(seed).integers(0, len(head), 5)] += [0.3, 0.01]
        tracks.append(replace(one, head=head))
    found = fit_tracks(Nominal(), tracks, threads=1)
    assert found.values["stiffness_scale"] == pytest.approx(1.15, rel=0.02)
    assert found.values["damping_scale_free_swing"] == pytest.approx(2.8, rel=0.05)


def test_what_a_log_cannot_tell_is_named_and_fixed() -> None:
    """Two pumps alike never bend the rig, so nothing is said about bending."""
    found = fit_tracks(Nominal(), [track("steps", duration_s=8.0)], threads=1)
    assert "bending_N_per_rad2" not in found.values
    assert "the logs" in found.fixed["bending_N_per_rad2"]
    assert "lag_s" in found.values


def test_a_rig_at_rest_tells_nothing() -> None:
    still = track("free", phi_rad=0.0, duration_s=2.0)
    with pytest.raises(BadInputError, match="cannot tell any parameter"):
        fit_tracks(Nominal(), [still], threads=1)
    with pytest.raises(BadInputError, match="found no log"):
        fit_tracks(Nominal(), [])

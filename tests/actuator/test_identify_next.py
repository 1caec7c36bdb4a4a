"""The next experiment: more information never hurts, and the best one is about what is unknown."""

from __future__ import annotations

import pytest
from identifytrials import track

from calib.actuator.identify_fit import fit_tracks
from calib.actuator.identify_next import EXPERIMENTS, prospects
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_sigma import uncertainty


def test_the_experiments_are_those_of_the_source() -> None:
    names = [one.name for one in EXPERIMENTS(0.065, 1.0 / 60.0)]
    assert names == ["static", "swing", "step", "ellipse", "elongation"]
    for one in EXPERIMENTS(0.065, 1.0 / 60.0):
        assert one.pwm.shape == (480, 2)
        assert 0.0 <= one.pwm.min() <= one.pwm.max() <= 255.0


def test_experiments_shrink_and_rest_does_not() -> None:
    found = fit_tracks(
        Nominal(), [track("free", phi_rad=p, seed=k) for k, p in enumerate((0.5, -0.4))], threads=1
    )
    known = uncertainty(found)
    ahead = {p.name: p for p in prospects(found, known)}
    for name, value in found.values.items():
        now = known.sigma[name] / abs(value)
        for one in ahead.values():
            assert one.relative[name] <= now * 1.001
        assert ahead["static"].relative[name] == pytest.approx(now, rel=0.05)
    worst = [p.worst_relative for p in prospects(found, known)]
    assert worst == sorted(worst)


def test_what_could_not_be_told_is_what_is_asked_for() -> None:
    found = fit_tracks(Nominal(), [track("steps", duration_s=8.0)], threads=1)
    best = prospects(found, uncertainty(found))[0]
    assert best.name in ("swing", "step", "ellipse")
    assert best.relative["bending_N_per_rad2"] < 0.2

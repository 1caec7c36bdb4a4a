"""Verdicts and the sentences that go with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identifytrials import track

from calib.actuator.identify_fit import Solution, fit_tracks
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_sigma import HeldLog, colour_of, uncertainty
from calib.actuator.identify_verdict import judge


@pytest.fixture(scope="module")
def solution() -> Solution:
    tracks = [track("free", phi_rad=phi, seed=k, noise=0.5) for k, phi in enumerate((0.5, -0.4))]
    return fit_tracks(Nominal(), tracks, threads=1)


def test_a_good_fit_is_ok_and_says_what_is_a_product(solution: Solution) -> None:
    good = HeldLog("free", 0.004, 3e-4, 0.004, 3e-4)
    told = judge(solution, uncertainty(solution), colour_of(solution), [good], [])
    assert (told.verdict, told.reasons) == ("ok", ())
    assert any("enter only as a product" in sentence for sentence in told.remarks)


def test_what_is_wrong_is_said(solution: Solution) -> None:
    known, colours = uncertainty(solution), colour_of(solution)
    bad = HeldLog("other", 0.004, 3e-4, 0.02, 3e-4)
    told = judge(solution, known, colours, [bad], [])
    assert told.verdict == "poor"
    assert "other: held back" in told.reasons[0]
    loud = judge(solution, replace(known, scale=4.0), colours, [], [])
    assert "4.0 times what the sensor's noise explains" in loud.reasons[0]
    assert any("one log alone" in sentence for sentence in loud.remarks)
    vague = replace(known, sigma={name: abs(v) for name, v in solution.values.items()})
    assert judge(solution, vague, colours, [], []).verdict == "poor"
    x = solution.x.copy()
    x[solution.problem.names.index("lambda1_per_s")] = 60.0
    assert any("at its bound" in s for s in judge(replace(solution, x=x), known, colours, [], []).reasons)


def test_a_blind_spot_is_unidentifiable(solution: Solution) -> None:
    blind = replace(solution, fixed={"lag_s": "the logs do not depend on it; kept at 0.7"})
    told = judge(blind, uncertainty(solution), colour_of(solution), [], [])
    assert told.verdict == "unidentifiable"
    assert told.reasons[0].startswith("lag_s is not identifiable from these logs")
    assert np.isfinite(solution.cost)

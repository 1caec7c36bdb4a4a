"""Free swings and the models against them: frequency, decay, and that the improved model is better."""

from __future__ import annotations

import numpy as np
import pytest

from thesis.drawn import Drawn, Plot
from thesis.drawn_swings import (
    IMPROVED,
    ORIGINAL,
    angle_after_release,
    bellows_after_release,
    fitted,
    other_rig,
    swing_of,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_the_swing_decays_about_a_middle_that_creeps_to_zero() -> None:
    made = _plot(angle_after_release)
    assert made.numbers["frequency_hz"] == pytest.approx(4.0, abs=0.1)
    assert 0.04 < made.numbers["zeta"] < 0.07
    peaks = made.curve("peaks that are used").y
    assert np.all(np.diff(np.abs(np.diff(peaks))) < 0.0)
    seen = made.curve("as the camera shows it")
    early = seen.y[(seen.x > 0.1) & (seen.x < 0.6)].mean()
    late = seen.y[seen.x > 3.0].mean()
    assert early > 5.0 * abs(late)


def test_the_bellows_comes_back_to_its_rest_length() -> None:
    made = _plot(bellows_after_release)
    q1 = made.curve("as the camera shows it").y
    assert q1[0] == pytest.approx(65.0 + 12.6 * 0.55, abs=1.2)
    assert q1[-60:].mean() == pytest.approx(65.0, abs=0.1)


def test_the_fit_finds_the_other_rig() -> None:
    plant, found = other_rig().plant, fitted().values
    assert found["stiffness_scale"] == pytest.approx(plant.stiffness_scale, abs=0.02)
    assert found["bending_N_per_rad2"] == pytest.approx(plant.bending_N_per_rad2, abs=0.02)
    assert found["damping_scale_free_swing"] == pytest.approx(3.0, abs=0.1)
    assert swing_of("other").phi_rad[0] == pytest.approx(0.55)


def test_the_improved_model_is_several_times_better_in_every_quantity() -> None:
    original, improved = ([_plot(one) for one in some] for some in (ORIGINAL[2:], IMPROVED))
    for before, after in zip(original, improved, strict=True):
        assert before.y == after.y
        assert after.numbers["norm"] < 0.2 * before.numbers["norm"]
        assert after.numbers["largest"] < 0.05 * before.numbers["largest"]
        assert after.numbers["model_hz"] == pytest.approx(after.numbers["rig_hz"], rel=0.005)
    # What the improved model leaves is the camera's noise.
    assert improved[2].numbers["rms"] == pytest.approx(0.004, rel=0.15)

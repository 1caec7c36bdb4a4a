"""Figures of an identification: legible, complete, repeatable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, kept
from identifytrials import track

from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_stiffness import fit_stiffness
from calib.actuatorsections import Identified
from calib.identification import identify_logs
from calib.identifying import TrackSource
from calib.report import identify_figures
from calib.report.identify_figures import write_identify_figures, write_stiffness_figure


@pytest.fixture(scope="module")
def found() -> Identified:
    tracks = [track("free"), track("free", phi_rad=-0.4, seed=1)]
    return identify_logs(Nominal(), [TrackSource(t, "test", 0.025, ()) for t in tracks])


def test_every_word_can_be_read(found: Identified, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    eps = np.linspace(0.002, 0.026, 10)
    force = (47.7 + 1092.9 * eps) * eps
    fits, best = fit_stiffness("w", eps, force)
    with kept(monkeypatch, identify_figures) as figures:
        write_identify_figures(tmp_path, found)
        write_stiffness_figure(tmp_path, eps, force, fits, best)
        names = ("motion", "residuals", "parameters", "damping", "stiffness")
        assert list(figures) == [f"identify_{name}.png" for name in names]
        for name, figure in figures.items():
            assert complaints(figure) == [], name


def test_the_same_numbers_give_the_same_bytes(found: Identified, tmp_path: Path) -> None:
    one = write_identify_figures(tmp_path / "a", found)
    two = write_identify_figures(tmp_path / "b", found)
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]

"""Figures of the low-pass: complete, repeatable, legible, and the lines are the filter's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.io.logs import Log, write_log
from calib.stages.lowpass import plots as lowpass_figures
from calib.stages.lowpass.filters import Design, design_lowpass
from calib.stages.lowpass.plots import write_lowpass_figures
from calib.stages.lowpass.stage import Positions, lowpass_section, positions_from_log

WORKSPACE = (-0.06, 0.04, 0.06, 0.11)


def _positions(folder: Path, still: bool = False, n: int = 3000) -> Positions:
    t = np.arange(n) / 60.0
    noise = (0.0 if still else 1.0) * np.random.default_rng(0).normal(size=(2, n))
    u = np.round(150 + 30 * np.sin(0.4 * t) * (t > 20) + 0.4 * noise[0])
    v = np.round(90 + 0.4 * noise[1])
    write_log(folder / "log.csv", Log("log.csv", t, {"u_px": u, "v_px": v}, np.arange(n)))
    return positions_from_log(folder / "log.csv", 60.0, None, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cutoff", "order", "family", "still"),
    [
        (1.0, 1, "butterworth", False),
        (1.0, 8, "butterworth", True),
        (20.0, 4, "bessel", False),
        (0.1, 3, "critical", False),
        (0.01, 2, "butterworth", False),
    ],
)
def test_all_figures_are_legible(
    cutoff: float, order: int, family: str, still: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, seen = design_lowpass(Design(cutoff, 60.0, order, family)), _positions(tmp_path, still)
    section = lowpass_section(made, WORKSPACE, seen)
    with kept(monkeypatch, lowpass_figures) as figures:
        write_lowpass_figures(tmp_path / "drawn", made, section, seen)
    with lowpass_figures.look():
        for name, figure in figures.items():
            assert complaints(figure) == [], name
        words = " ".join(text.get_text() for text in drawn_texts(figures["lowpass_log.png"]))
    assert ("never changes" in words) == still

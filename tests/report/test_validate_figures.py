"""Figures of a validation: drawn, legible, the same bytes again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, kept
from identifytrials import track

from calib.actuator.identify_parameters import Nominal
from calib.identifying import TrackSource
from calib.report import validate_figures
from calib.report.validate_figures import write_validate_figures
from calib.validating import IMPROVED, ORIGINAL, Comparison, compare


def _compared(kind: str, improved: bool = True) -> Comparison:
    nominal = Nominal()
    other = replace(nominal, plant=replace(nominal.plant, stiffness_scale=1.3))
    models = {ORIGINAL: nominal, IMPROVED: other} if improved else {ORIGINAL: nominal}
    source = TrackSource(track(kind, {"stiffness_scale": 1.3}), "pictures", 0.025, ())
    return compare(source, models, 0.0126)


def test_every_log_has_a_legible_figure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    long = replace(_compared("prbs"), name="a log with a long name " * 4)
    with kept(monkeypatch, validate_figures) as figures:
        write_validate_figures(tmp_path, [_compared("free", improved=False), long])
    assert list(figures) == ["validate_model_1.png", "validate_model_2.png"]
    for figure, models in zip(figures.values(), ((ORIGINAL,), (ORIGINAL, IMPROVED)), strict=True):
        assert complaints(figure) == []
        (drawn,) = figure.legends
        assert [text.get_text() for text in drawn.get_texts()] == ["measured", *models]


def test_curves_and_errors_are_those_of_the_comparison(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one = _compared("prbs")
    with kept(monkeypatch, validate_figures) as figures:
        write_validate_figures(tmp_path, [one])
    axes = figures["validate_model.png"].axes
    assert np.allclose(axes[0].lines[2].get_ydata(), 1e3 * one.simulated[IMPROVED][:, 0])
    errors = axes[5].lines[0].get_ydata()
    assert np.allclose(errors, one.measured[:, 2] - one.simulated[ORIGINAL][:, 2])


def test_a_model_without_a_curve_is_left_out_and_the_log_is_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one = _compared("prbs")
    gone = replace(one, simulated={**one.simulated, IMPROVED: np.full_like(one.measured, np.nan)})
    with kept(monkeypatch, validate_figures) as figures:
        write_validate_figures(tmp_path, [gone])
    (drawn,) = figures["validate_model.png"].legends
    assert [text.get_text() for text in drawn.get_texts()] == ["measured", ORIGINAL]


def test_the_same_bytes_again(tmp_path: Path) -> None:
    one = _compared("free")
    paths = [write_validate_figures(tmp_path / name, [one])[0] for name in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()

"""Figures of an alignment: complete, repeatable and legible, also where nothing moved."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from align_trials import align_log, known, prior_settings, twin_log
from figure_checks import complaints, drawn_texts, kept

from calib.estimator.align import Alignment, align
from calib.report import align_figures
from calib.report.align_figures import write_align_figures
from calib.twin.rig import SimulatedRig


def _found(scenario: str, duration_s: float, accelerometer: bool = True) -> Alignment:
    trial = known(SimulatedRig())
    log = align_log(twin_log(trial.rig, scenario, {}, 1, duration_s))
    if not accelerometer:
        log.readings[:, :2] = np.nan
    return align([log], prior_settings(trial.view))


@pytest.mark.parametrize(("scenario", "accelerometer"), [("swing", True), ("static", True), ("swing", False)])
def test_every_word_can_be_read(
    scenario: str, accelerometer: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = _found(scenario, 4.0, accelerometer)
    with kept(monkeypatch, align_figures) as figures:
        write_align_figures(tmp_path, found, "poor")
        assert set(figures) == {"align_correlation.png", "align_residuals_1.png"}
        for name, figure in figures.items():
            assert complaints(figure) == [], name
            words = [text.get_text() for text in drawn_texts(figure)]
            assert any("poor" in text for text in words)
            if name == "align_residuals_1.png":
                assert ("not sampled" in words) != accelerometer


def test_files_repeat_and_hold_a_picture(tmp_path: Path) -> None:
    found = _found("swing", 2.5)
    first = write_align_figures(tmp_path / "a", found)
    for path, again in zip(first, write_align_figures(tmp_path / "b", found), strict=True):
        assert path.read_bytes() == again.read_bytes()
        picture = cv2.imread(str(path))
        assert picture is not None
        # One for each log is coarser, so that a page has room for all.
        assert picture.shape[1] > (800 if "residuals" in path.name else 1000)
        assert picture.std() > 10.0

"""Figures of a tuning: legible, repeatable, also where nothing was judged."""

from __future__ import annotations

from pathlib import Path

import pytest
from armlogs import swung, write
from figure_checks import complaints, drawn_texts, kept

from calib.imu.gains import DATA_SHEET
from calib.imu.tuning import tune
from calib.report import tune_figures
from calib.report.tune_figures import write_tune_figures
from calib.tunelogs import Reading, read_tune_log
from calib.tunesections import filter_section


@pytest.mark.parametrize(("duration_s", "truth"), [(20.0, True), (20.0, False), (5.0, False)])
def test_every_word_can_be_read(
    duration_s: float, truth: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = read_tune_log(write(tmp_path / "arm.csv", swung(0, duration_s), truth), Reading())
    result = tune(log.pieces, DATA_SHEET)
    section = filter_section(result, [log], "a data sheet")
    with kept(monkeypatch, tune_figures) as figures:
        write_tune_figures(tmp_path, result, log.pieces, section)
        for name, figure in figures.items():
            assert complaints(figure) == [], name
            poor = any("poor" in text.get_text() for text in drawn_texts(figure))
            assert poor is (section.verdict == "poor")
    assert list(figures) == ["tune_gains.png", "tune_errors.png"]


@pytest.mark.slow
def test_files_repeat(tmp_path: Path) -> None:
    log = read_tune_log(write(tmp_path / "arm.csv", swung(0, 12.0)), Reading())
    result = tune(log.pieces, DATA_SHEET)
    section = filter_section(result, [log], "a data sheet")
    first = write_tune_figures(tmp_path / "a", result, log.pieces, section)
    again = write_tune_figures(tmp_path / "b", result, log.pieces, section)
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]

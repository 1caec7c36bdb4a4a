"""Figures of the low-pass: complete, repeatable, legible, and the lines are the filter's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.logs import Log, write_log
from calib.lowpass import Positions, lowpass_section, positions_from_log
from calib.report import lowpass_figures
from calib.report.lowpass_figures import log_window, write_lowpass_figures
from calib.signals.design import Design, design_lowpass
from calib.signals.response import decibels, filter_signal, frequency_response, group_delay_s

WORKSPACE = (-0.06, 0.04, 0.06, 0.11)


def _positions(folder: Path, still: bool = False, n: int = 3000) -> Positions:
    t = np.arange(n) / 60.0
    noise = (0.0 if still else 1.0) * np.random.default_rng(0).normal(size=(2, n))
    u = np.round(150 + 30 * np.sin(0.4 * t) * (t > 20) + 0.4 * noise[0])
    v = np.round(90 + 0.4 * noise[1])
    write_log(folder / "log.csv", Log("log.csv", t, {"u_px": u, "v_px": v}, np.arange(n)))
    return positions_from_log(folder / "log.csv", 60.0, None, None)


@pytest.mark.slow
def test_every_figure_is_written_and_the_bytes_repeat(tmp_path: Path) -> None:
    made, seen = design_lowpass(Design(1.0, 60.0, 2)), _positions(tmp_path)
    section = lowpass_section(made, WORKSPACE, seen)
    first = write_lowpass_figures(tmp_path / "a", made, section, seen)
    assert [path.name for path in first] == ["lowpass_response.png", "lowpass_log.png"]
    for path, again in zip(first, write_lowpass_figures(tmp_path / "b", made, section, seen), strict=True):
        assert path.read_bytes() == again.read_bytes()
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 10
    alone = write_lowpass_figures(tmp_path / "c", made, lowpass_section(made, WORKSPACE))
    assert [path.name for path in alone] == ["lowpass_response.png"]


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


def test_the_lines_are_the_filters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, seen = design_lowpass(Design(1.0, 60.0, 2)), _positions(tmp_path)
    section = lowpass_section(made, WORKSPACE, seen)
    with kept(monkeypatch, lowpass_figures) as figures:
        write_lowpass_figures(tmp_path / "drawn", made, section, seen)
    gain, delay, step, poles = figures["lowpass_response.png"].axes
    f, drawn = gain.lines[0].get_data()
    np.testing.assert_allclose(drawn, decibels(frequency_response(made.sections, np.asarray(f), 60.0)))
    f, drawn = delay.lines[0].get_data()
    np.testing.assert_allclose(drawn, group_delay_s(made.sections, np.asarray(f), 60.0))
    assert np.asarray(drawn)[0] == pytest.approx(0.225, abs=1e-3)
    assert step.lines[-1].get_ydata()[-1] == pytest.approx(1.0, abs=1e-3)
    assert len(poles.collections[0].get_offsets()) == 2
    before, after = (line.get_data() for line in figures["lowpass_log.png"].axes[0].lines[:2])
    whole = filter_signal(made.sections, seen.ticks.longest.values[:, 0])
    first = round(float(before[0][0]) * 60)
    np.testing.assert_allclose(after[1], whole[first : first + len(after[1])])


def test_the_window_is_where_things_move() -> None:
    t = np.arange(3000) / 60.0
    values = np.zeros((3000, 2))
    values[2000:2100, 1] = 5.0
    window = log_window(t, values, 10.0)
    assert window.start <= 2000 < window.stop
    assert t[window][-1] - t[window][0] == pytest.approx(10.0, abs=0.05)
    assert log_window(t[:500], values[:500], 10.0) == slice(0, 500)

"""Figures of the drift comparison: complete, repeatable and legible."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.imu.drift import LogDrift, analyse_drift
from calib.imu.mahony import Mahony
from calib.imu.tracks import DriftLog, Tuned
from calib.report import drift_figures
from calib.report.drift_figures import write_drift_figures

NONE = np.zeros(0)


def _log(source: str, moves: bool, truth: bool = False, seed: int = 0) -> LogDrift:
    t = 0.01 * np.arange(4000)
    phi = 0.5 * np.sin(2.0 * np.maximum(t - 10.0, 0.0)) if moves else 0.0 * t
    values = np.stack([-np.gradient(phi, 0.01), 9.81 * np.cos(phi), 9.81 * np.sin(phi)], axis=1)
    values += np.array([2e-3, 0.02, 0.02]) * np.random.default_rng(seed).normal(size=(4000, 3)) + [
        0.006,
        0.0,
        0.0,
    ]
    log = DriftLog(source, ("gz", "ax", "ay"), t, values, t, phi + 2e-3 * t, NONE, NONE)
    if truth:
        log = replace(log, true_t_s=t, true_phi_rad=phi)
    return analyse_drift(log, Tuned(Mahony(1.0, 0.25)))


SETS = {
    "one": lambda: [_log("static.csv", moves=False)],
    "several": lambda: [
        *(_log(f"static{k}.csv", moves=False, seed=k) for k in range(3)),
        _log("a$b$_写真_with_a_name_that_goes_on_and_on.csv", moves=True, truth=True),
        _log("no_truth.csv", moves=True),
    ],
}


@pytest.mark.parametrize("which", ["one", pytest.param("several", marks=pytest.mark.slow)])
def test_every_word_can_be_read(which: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    logs = SETS[which]()
    with kept(monkeypatch, drift_figures) as figures:
        write_drift_figures(tmp_path, logs)
        expected = ["drift_angles.png", "drift_slopes.png"]
        if which == "several":
            expected += ["drift_motion_4.png", "drift_motion_5.png"]
        assert list(figures) == expected
        for name, figure in figures.items():
            assert complaints(figure) == [], name
        words = "\n".join(text.get_text() for text in drawn_texts(figures["drift_angles.png"]))
    for name in ("on the chip", "gyroscope alone", "accelerometer alone", "MM 3/3", "MM tuned"):
        assert name in words
    assert "does not rank filters" in words.replace("\n", " ")


@pytest.mark.slow
def test_files_repeat_and_hold_a_picture(tmp_path: Path) -> None:
    logs = SETS["one"]()
    first = write_drift_figures(tmp_path / "a", logs)
    for path, again in zip(first, write_drift_figures(tmp_path / "b", logs), strict=True):
        assert path.read_bytes() == again.read_bytes()
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 10

"""Figures of an IMU at rest: complete, repeatable and legible, also for logs that are poor."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.imu.static import AXES, RestLog, Static, analyse_static
from calib.report import imu_figures
from calib.report.imu_figures import write_imu_figures


def _log(
    source: str, axes: tuple[str, ...] = AXES, n: int = 3000, seed: int = 0, onchip: bool = True
) -> RestLog:
    rng = np.random.default_rng(seed)
    scale = np.array([2e-3 if axis[0] == "g" else 0.02 for axis in axes])
    level = np.array([{"gz": 0.006, "ax": 9.81}.get(axis, 0.01) for axis in axes])
    values = level + scale * (
        rng.normal(size=(n, len(axes))) + 0.02 * np.cumsum(rng.normal(size=(n, len(axes))), 0)
    )
    t = 0.01 * np.arange(n)
    angle = 0.003 * t + 1e-4 * np.cumsum(rng.normal(size=n))
    return RestLog(source, axes, t, values, t if onchip else t[:0], angle if onchip else t[:0])


def _several() -> Static:
    return analyse_static([_log(f"static{k}.csv", seed=k) for k in range(2)])


def _moved() -> Static:
    log = _log("a$b$_\u5199\u771f_with_a_name_that_goes_on_and_on.csv", n=6000, onchip=False)
    values = log.values.copy()
    values[2000:2500] += 0.5 * np.sin(0.1 * np.arange(500))[:, None]
    values[:, 1] = 0.25
    return analyse_static(
        [RestLog(log.source, log.axes, log.t_s, values, log.onchip_t_s, log.onchip_phi_rad)]
    )


def _one_axis() -> Static:
    return analyse_static([_log("gz.csv", ("gz",), n=200, onchip=False)])


_SLOW = [pytest.param(result, marks=pytest.mark.slow) for result in (_several, _moved)]


@pytest.mark.parametrize("result", [*_SLOW, _one_axis])
def test_every_word_can_be_read(result: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert callable(result)
    with kept(monkeypatch, imu_figures) as figures:
        write_imu_figures(tmp_path, result(), "poor")
        for name, figure in figures.items():
            assert complaints(figure) == [], name
            assert any("poor" in text.get_text() for text in drawn_texts(figure))


@pytest.mark.slow
def test_files_repeat_and_hold_a_picture(tmp_path: Path) -> None:
    result = analyse_static([_log("static.csv")])
    first = write_imu_figures(tmp_path / "a", result)
    names = [path.name for path in first]
    assert names == ["imu_allan.png", "imu_drift.png", "imu_static_1.png"]
    for path, again in zip(first, write_imu_figures(tmp_path / "b", result), strict=True):
        assert path.read_bytes() == again.read_bytes()
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 10


def test_bounds_stand_for_what_is_not_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    white = RestLog(
        "w.csv", ("gz",), 0.01 * np.arange(3000), rng.normal(size=(3000, 1)) * 1e-3, np.zeros(0), np.zeros(0)
    )
    with kept(monkeypatch, imu_figures) as figures:
        write_imu_figures(tmp_path, analyse_static([white]))
        words = "\n".join(text.get_text() for text in drawn_texts(figures["imu_allan.png"]))
    # Readings of 1e-3 at 100 Hz have a density of 1e-4.
    assert any(start in words for start in ("N 9.", "N 0.0001"))
    assert "B <" in words
    assert "K <" in words

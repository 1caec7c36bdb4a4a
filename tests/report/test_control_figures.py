"""Figures of controllers: drawn, legible, the same bytes again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, kept

from calib.control.reach import follow, slowed
from calib.control.references import built_in, from_lengths
from calib.control.setpoints import Ellipse
from calib.controlling import control_model, run_controller
from calib.errors import BadInputError
from calib.report import control_figures
from calib.report.control_figures import write_check_figures, write_run_figures, write_tune_figures
from calib.twin.rig import SimulatedRig

RIG = SimulatedRig()
MODEL = control_model(RIG)


@pytest.mark.parametrize(
    ("name", "controllers"),
    [("jump", ("p", "pid", "clamping", "back")), ("ellipse", ("pd", "pd+ff", "pd+map", "torque"))],
)
def test_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, controllers: tuple[str, ...]
) -> None:
    reference = built_in(MODEL, name, 6.0)
    outcomes = [run_controller(one, RIG, MODEL, reference, feedback="truth") for one in controllers]
    with kept(monkeypatch, control_figures) as figures:
        write_run_figures(tmp_path, MODEL, reference, outcomes)
    assert complaints(figures["control_run.png"]) == []
    (drawn,) = figures["control_run.png"].legends
    assert set(controllers) <= {text.get_text() for text in drawn.get_texts()}


def test_checks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    t = MODEL.tick_s * np.arange(480)
    fast = from_lengths(MODEL, "fast", Ellipse(period_s=8.0).bellows_m(t, MODEL.plant.bellows_radius_m))
    slower = from_lengths(MODEL, "slow", slowed(MODEL, fast.q_m)[0])
    for reference, other in ((fast, slower), (built_in(MODEL, "ellipse"), None)):
        with kept(monkeypatch, control_figures) as figures:
            write_check_figures(tmp_path, MODEL, reference, follow(MODEL, reference.q_m), other)
        assert complaints(figures["control_check.png"]) == []


@pytest.mark.slow
def test_margins_and_bytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from calib.control.computed_torque import ComputedTorque
    from calib.control.observer import design_observer
    from calib.control.tuning import Criterion, tune_orientation, tune_position
    from calib.controlsections import controller_section

    criterion = Criterion()
    turn, move = tune_orientation(MODEL, criterion), tune_position(MODEL, criterion)
    anti = {
        name: {"overshoot_after_jump_rad": 0.1, "rise_s": 1.0} for name in ("clamping", "back_calculation")
    }
    section = controller_section(
        MODEL, criterion, turn, move, 1.0, 0.4, anti, design_observer(MODEL), ComputedTorque()
    )
    with kept(monkeypatch, control_figures) as figures:
        write_tune_figures(tmp_path, MODEL, section, turn, move)
    assert complaints(figures["control_margins.png"]) == []
    (one,) = write_tune_figures(tmp_path / "a", MODEL, section, turn, move)
    (two,) = write_tune_figures(tmp_path / "b", MODEL, section, turn, move)
    assert one.read_bytes() == two.read_bytes()


def test_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("")
    with pytest.raises(BadInputError, match="is a file, expected a folder"):
        write_run_figures(tmp_path / "f", MODEL, built_in(MODEL, "step"), [])

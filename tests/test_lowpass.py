"""Positions of a log, and the section lowpass: its numbers, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.io.logs import Log, write_log
from calib.stages.actuator.kinematics import marker_from_head
from calib.stages.lowpass.filters import Design, design_lowpass
from calib.stages.lowpass.stage import lowpass_section, positions_from_log
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

WORKSPACE = (-0.06, 0.04, 0.06, 0.11)


def _plane(rig: SimulatedRig) -> np.ndarray:
    view = rig.view
    return np.linalg.inv(view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m]))


def _write(path: Path, n: int = 600, **changes: object) -> Path:
    t = np.arange(n) / 60.0
    noise = np.random.default_rng(1).normal(size=(2, n))
    columns = {"u_px": np.round(150 + 20 * np.sin(t) + noise[0]), "v_px": np.round(90 + noise[1])}
    log = Log(path.name, t, columns, np.arange(2, n + 2))
    write_log(path, replace(log, **changes))
    return path


def test_positions_are_the_markers_on_the_plane(tmp_path: Path) -> None:
    rig = SimulatedRig()
    run = run_scenario(make_scenario("ellipse"), rig, 2, "sensors", 8.0)
    log = log_of(run)
    write_log(tmp_path / "log.csv", log)
    seen = positions_from_log(tmp_path / "log.csv", 60.0, rig.view.camera, _plane(rig))
    assert (seen.unit, seen.names) == ("m", ("x", "y"))
    piece = seen.ticks.longest
    truth = {name: log.columns[f"true_{name}"] for name in ("x_m", "y_m", "phi_rad")}
    true = marker_from_head(np.stack([truth["x_m"], truth["y_m"]], axis=1), truth["phi_rad"])
    at = np.stack([np.interp(piece.t_s - 0.025, log.t_s, true[:, i]) for i in (0, 1)], axis=1)
    # A pixel is about 1 mm there; medians pass over the outliers.
    assert np.all(np.median(np.abs(piece.values - at), axis=0) < 0.7e-3)
    assert np.all(np.ptp(at, axis=0) > 0.01)


def test_a_filter_that_single_precision_spoils_is_poor() -> None:
    section = lowpass_section(design_lowpass(Design(0.01, 60.0, 2)), WORKSPACE)
    assert section.verdict == "poor"
    assert "Rounded to single precision it cuts at" in section.reasons[0]
    assert "comes to rest up to" in section.reasons[1]


def test_a_marker_beyond_the_horizon(tmp_path: Path) -> None:
    A_inverse = np.eye(3)
    A_inverse[2] = [0.0, -1.0, 90.5]
    with pytest.raises(BadInputError, match=r"line \d+: the marker at .* is not on the rig's plane"):
        positions_from_log(_write(tmp_path / "log.csv"), 60.0, SimulatedRig().view.camera, A_inverse)

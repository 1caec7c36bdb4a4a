"""Positions of a log, and the section lowpass: its numbers, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from calib.actuator.kinematics import marker_from_head
from calib.errors import BadInputError
from calib.logs import Log, write_log
from calib.lowpass import lowpass_section, positions_from_log
from calib.rig import Rig, read_rig, write_rig
from calib.rig_lowpass import LowPass
from calib.signals.design import Design, design_lowpass
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


def test_without_a_plane_positions_are_pixels(tmp_path: Path) -> None:
    seen = positions_from_log(_write(tmp_path / "log.csv"), None, None, None)
    assert (seen.unit, seen.names) == ("px", ("u", "v"))
    assert seen.rate_hz == pytest.approx(60.0, rel=1e-3)
    section = lowpass_section(design_lowpass(Design(1.0, seen.ticks.rate_hz)), WORKSPACE, seen)
    assert section.log is not None
    assert section.log.axes["u"].jitter_before == pytest.approx(np.hypot(1.0, 12**-0.5), rel=0.2)
    assert section.log.axes["u"].jitter_after < 0.3
    assert section.log.axes["u"].motion_hz > section.log.axes["v"].motion_hz == 0.0
    # 20 px/s at most, and mostly above 10; rest has no frequency.
    assert 5.0 < section.log.axes["u"].quantisation_hz[1] < 20.0
    assert section.log.axes["v"].quantisation_hz == []


def test_the_section_survives_the_file(tmp_path: Path) -> None:
    made = design_lowpass(Design(1.0, 60.0, 3, "bessel"))
    section = lowpass_section(made, WORKSPACE)
    assert section.verdict == "ok"
    assert section.dead_band_mm["q15_step"] == pytest.approx(125.0 / 32768)
    assert section.attenuation_db["1Hz"] == pytest.approx(-3.01, abs=0.01)
    write_rig(tmp_path / "rig.yaml", Rig(lowpass=section), {"lowpass": {}})
    again = read_rig(tmp_path / "rig.yaml").lowpass
    assert again == section
    assert [[*part.b, *part.a] for part in section.sections] == made.sections.tolist()


def test_a_filter_that_single_precision_spoils_is_poor() -> None:
    section = lowpass_section(design_lowpass(Design(0.01, 60.0, 2)), WORKSPACE)
    assert section.verdict == "poor"
    assert "Rounded to single precision it cuts at" in section.reasons[0]
    assert "comes to rest up to" in section.reasons[1]


@pytest.mark.parametrize(
    "change",
    [
        {"order": 3},
        {"sections": [{"b": [0.1, 0.1, 0.0], "a": [1.0, -0.9, 0.0]}]},
        {"family": "elliptic"},
        {"cutoff_hz": -1.0},
        {"colour": "red"},
    ],
)
def test_sections_that_contradict_themselves(change: dict[str, object]) -> None:
    plain = lowpass_section(design_lowpass(Design()), WORKSPACE).model_dump()
    with pytest.raises(ValidationError):
        LowPass.model_validate(plain | change)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"columns": {"ax_mps2": np.zeros(600)}}, "has no columns u_px and v_px"),
        (
            {"columns": {"u_px": np.full(600, np.nan), "v_px": np.zeros(600)}},
            "has no row in which the camera",
        ),
        ({"t_s": np.arange(600)[::-1] / 60.0}, r"line 3: t_s goes back"),
        ({"t_s": np.arange(600) / 30.0}, r"has 30 camera samples/s, expected the 60 Hz"),
        ({"t_s": np.zeros(600)}, "has no two samples at different times"),
        ({"n": 1}, "has one row in which the camera saw the marker"),
        ({"n": 30}, "has 30 camera ticks without a long gap, expected at least 64"),
    ],
)
def test_logs_that_are_refused(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    n = changes.pop("n", 600)
    path = _write(tmp_path / "log.csv", n, **changes)
    with pytest.raises(BadInputError, match=rf"log\.csv.*{words}"):
        positions_from_log(path, 60.0, None, None)


def test_a_marker_beyond_the_horizon(tmp_path: Path) -> None:
    A_inverse = np.eye(3)
    A_inverse[2] = [0.0, -1.0, 90.5]
    with pytest.raises(BadInputError, match=r"line \d+: the marker at .* is not on the rig's plane"):
        positions_from_log(_write(tmp_path / "log.csv"), 60.0, SimulatedRig().view.camera, A_inverse)


def test_gaps_and_dropouts_are_told(tmp_path: Path) -> None:
    t = np.arange(600) / 60.0
    t[200:] += 3600.0
    u = 150 + np.random.default_rng(0).normal(size=600)
    u[220:520:8] = np.nan
    columns = {"u_px": u, "v_px": np.where(np.isnan(u), np.nan, 90.0)}
    seen = positions_from_log(_write(tmp_path / "log.csv", t_s=t, columns=columns), 60.0, None, None)
    section = lowpass_section(design_lowpass(Design()), WORKSPACE, seen)
    assert section.log is not None
    assert (section.log.pieces, section.log.held) == (2, 38)
    assert any("38 of 600 ticks" in remark for remark in section.remarks)
    assert any("split the log into 2 pieces" in remark for remark in section.remarks)

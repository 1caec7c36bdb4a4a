"""Recorded logs as references: the estimator's lengths, and what is taken for a recorded log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import log_file, rig_file

from calib.control.inverse_model import Model
from calib.controlreference import is_recorded, recorded_reference, wanted_reference
from calib.errors import BadInputError
from calib.logs import read_log, write_log
from calib.rig import Rig
from calib.twin.rig import SimulatedRig

RIG = SimulatedRig()
MODEL = Model(RIG.plant, RIG.pump, RIG.pump_strength)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log without any true column, and one with them beside it."""
    folder = tmp_path_factory.mktemp("recorded")
    whole = read_log(log_file(folder / "true.csv", RIG, "prbs", 3, 4.0))
    columns = {name: values for name, values in whole.columns.items() if not name.startswith("true")}
    write_log(folder / "log.csv", replace(whole, columns=columns))
    return folder


def test_a_log_without_truth_is_recorded_and_tables_are_not(recorded: Path, tmp_path: Path) -> None:
    assert is_recorded(recorded / "log.csv")
    assert not is_recorded(recorded / "true.csv")
    (tmp_path / "table.csv").write_text("t_s,q1_m,q2_m\n0,0.066,0.066\n")
    assert not is_recorded(tmp_path / "table.csv") and not is_recorded(tmp_path / "none.csv")


def test_its_lengths_are_those_of_the_rig(recorded: Path) -> None:
    path = recorded / "rig.yaml"
    known = rig_file(path)
    found = recorded_reference(recorded / "log.csv", known, path, MODEL)
    assert found.kind == "lengths" and found.name.endswith("log.csv")
    truth = read_log(recorded / "true.csv")
    t = found.t_s + float(truth.t_s[0])
    for i, name in enumerate(("true_q1_m", "true_q2_m")):
        error = found.q_m[:, i] - np.interp(t, truth.t_s, truth.columns[name])
        assert np.sqrt(np.mean(error[20:-20] ** 2)) < 5e-4
    same = wanted_reference(str(recorded / "log.csv"), MODEL, None, known, path)
    assert np.array_equal(same.q_m, found.q_m)


def test_names_and_tables_go_the_usual_way(recorded: Path) -> None:
    path = recorded / "rig.yaml"
    known = rig_file(path)
    assert wanted_reference("ellipse", MODEL, None, known, path).name == "ellipse"
    assert wanted_reference(str(recorded / "true.csv"), MODEL, None, known, path).kind == "lengths"
    with pytest.raises(BadInputError, match="a file has its own duration"):
        wanted_reference(str(recorded / "true.csv"), MODEL, 3.0, known, path)


def test_a_log_needs_the_camera_of_its_rig(recorded: Path) -> None:
    with pytest.raises(BadInputError, match=r"has no (camera|plane)"):
        recorded_reference(recorded / "log.csv", Rig(), recorded / "rig.yaml", MODEL)

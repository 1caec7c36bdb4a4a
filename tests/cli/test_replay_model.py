"""`calib replay --model`: which of the two models speaks, and that it is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimatorlogs import simulated

from calib.io.logs import write_log

Run = Callable[..., Any]


@pytest.fixture
def ellipse(tmp_path: Path) -> Path:
    path = tmp_path / "ellipse.csv"
    log = simulated("ellipse", 0)[1]
    rows = log.t_s < 6.0
    cut = {name: values[rows] for name, values in log.columns.items()}
    write_log(path, replace(log, t_s=log.t_s[rows], columns=cut, lines=log.lines[rows]))
    return path


def weights(path: Path) -> np.ndarray:
    table = np.genfromtxt(path, delimiter=",", names=True)
    return np.asarray(table["driven_weight"])


def test_commands_are_used_where_the_log_has_them(calib: Run, rig: Path, ellipse: Path) -> None:
    states = ellipse.with_name("states.csv")
    found = {}
    for model in ("auto", "kinematic", "driven"):
        done = calib("replay", str(ellipse), "--rig", str(rig), "--model", model, "-o", str(states), "--json")
        document = json.loads(done.out)["replay"]["logs"][0]
        found[model] = document["rmse"]["mean_q_mm"]
        if model == "kinematic":
            assert document["driven_share"] is None
            assert np.isnan(weights(states)).all()
        elif model == "auto":
            assert 0.3 < document["driven_share"] <= 1.0
            assert (weights(states) > 0.5).mean() > 0.3
    assert found["auto"] < found["kinematic"]
    assert found["driven"] < found["kinematic"]


def test_the_driven_model_wants_commands(calib: Run, rig: Path, tmp_path: Path) -> None:
    log = simulated("swing", 0)[1]
    columns = {name: values for name, values in log.columns.items() if not name.startswith("pwm")}
    path = tmp_path / "swing.csv"
    write_log(path, replace(log, columns=columns))
    refused = calib("replay", str(path), "--rig", str(rig), "--model", "driven")
    assert refused.code == 3
    assert "commands" in refused.err
    assert calib("replay", str(path), "--rig", str(rig), "--json").code in (0, 1)


def test_a_plant_that_cannot_be_is_named(calib: Run, rig: Path, ellipse: Path) -> None:
    rig.write_text(rig.read_text() + "\npump: {lag_s: -1.0}\n")
    refused = calib("replay", str(ellipse), "--rig", str(rig))
    assert refused.code == 3
    assert "pump.lag_s" in refused.err

"""`calib replay --tune`: the section that it makes of logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated
from identifytrials import rig_file

from calib.estimator.constant_gain import run_gains, ticks_of
from calib.estimator.gains import Gains
from calib.logs import write_log
from calib.tuning import gain_section, tuned_section


def test_constant_gains_are_those_of_the_set_up_and_stay_finite() -> None:
    rig, log = simulated("ellipse", 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    section = gain_section(setup, 60.0)
    assert section is not None
    assert section.delay_ticks == pytest.approx(60.0 * float(setup.start.sensor[7]))
    assert np.isfinite(run_gains(Gains(**section.model_dump()), setup, ticks_of(setup, rows))).all()


def test_a_log_with_commands_tunes_the_driven_model_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calib.tuning._MOST_ROWS", 400)
    _, log = simulated("ellipse", 1)
    first = np.arange(len(log)) < 400
    short = replace(log, t_s=log.t_s[first], columns={k: v[first] for k, v in log.columns.items()},
                    lines=log.lines[first])  # fmt: skip
    write_log(tmp_path / "told.csv", short)
    quiet = {k: v for k, v in short.columns.items() if not k.startswith("pwm")}
    write_log(tmp_path / "quiet.csv", replace(short, columns=quiet))
    path = tmp_path / "rig.yaml"
    rig = rig_file(path)
    found = tuned_section([tmp_path / "told.csv"], rig, path)
    assert found.driven is not None
    assert found.driven.walk_disturbance_N_per_sqrt_s > 0.0
    assert {"driven_disturbance", "driven_rates", "driven_forces"} <= set(found.sigma)
    assert tuned_section([tmp_path / "quiet.csv"], rig, path).driven is None

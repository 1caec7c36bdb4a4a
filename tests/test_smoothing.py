"""A whole log through filter and smoother."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from estimatorlogs import setup_for, simulated

from calib.estimator.setup import OUT
from calib.logs import Log
from calib.replaying import periods
from calib.smoothing import smooth_log
from calib.statesfile import STATES


def cut(log: Log, pieces: int) -> Iterator[Log]:
    for part in np.array_split(np.arange(len(log)), pieces):
        yield replace(log, t_s=log.t_s[part], columns={k: v[part] for k, v in log.columns.items()})


def test_blocks_make_no_difference_and_the_states_are_the_smoother_s(tmp_path: Path) -> None:
    rig, log = simulated("ellipse", 1)
    setup, found = setup_for(rig, 1), periods(log)
    after, before, traced = smooth_log(setup, found, cut(log, 4), tmp_path / "states.csv")
    again, _, _ = smooth_log(setup, found, [log], None)
    assert after.rmse() == again.rmse()
    assert after.rmse()["mean_q_mm"] < 0.7 * before.rmse()["mean_q_mm"]
    lines = (tmp_path / "states.csv").read_text().splitlines()
    assert lines[0].split(",") == list(STATES)
    assert len(lines) == 1 + len(log)
    q1 = [float(line.split(",")[1]) for line in lines[1:]]
    np.testing.assert_allclose(q1, traced[0][:, OUT.index("q1_m")], rtol=1e-8)

"""Figures of a replay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from estimatorlogs import rows_from, setup_for, simulated, truth

from calib.estimator.filter import Filter
from calib.estimator.setup import OUT
from calib.replay import Replayed, Trace
from calib.report.replay_figures import error_figure, innovation_figure, state_figure, write_replay_figures
from calib.report.style import look


def result() -> Replayed:
    rig, log = simulated("swing")
    out = Filter(setup_for(rig)).run(rows_from(log))
    trace = np.concatenate([out, truth(log) * 1.01, truth(log)], axis=1)
    return Replayed(
        "swing.csv", len(out), 5.0, "fused", {}, {}, {}, {}, 0.3, "ok", [], [], trace,
    )  # fmt: skip


def test_figures_are_written_and_repeat(tmp_path: Path) -> None:
    paths = write_replay_figures(tmp_path / "a", [result()])
    again = write_replay_figures(tmp_path / "b", [result()])
    assert [path.name for path in paths] == [
        "replay_swing_states.png", "replay_swing_innovations.png", "replay_swing_errors.png",
    ]  # fmt: skip
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in again]


def test_panels_hold_what_they_say() -> None:
    made = result()
    with look():
        for figure in (state_figure(made), innovation_figure(made), error_figure(made)):
            assert len(figure.axes) == 3
        line = next(line for line in error_figure(made).axes[0].lines if line.get_label() == "estimate")
    expected = 1e3 * (made.trace[:, 1] - made.trace[:, len(OUT) + 3])
    np.testing.assert_allclose(line.get_ydata(), expected)


def test_the_kinematic_model_s_rows_are_shaded_where_it_took_over() -> None:
    made = result()
    trace = made.trace.copy()
    trace[:, OUT.index("driven_weight")] = np.where(trace[:, 0] > 2.0, 0.1, 0.9)
    with look():
        labels = [
            [str(shade.get_label()) for shade in state_figure(one).axes[2].collections]
            for one in (made, replace(made, trace=trace))
        ]
    assert ["kinematic model speaks" in names for names in labels] == [False, True]


def test_logs_of_one_name_and_without_truth_or_innovations(tmp_path: Path) -> None:
    made = result()
    trace = made.trace.copy()
    trace[:, len(OUT) :] = np.nan
    trace[:, 13:24] = np.nan
    paths = write_replay_figures(tmp_path, [made, replace(made, trace=trace)])
    assert [path.name for path in paths][-1] == "replay_swing_2_states.png" and len(paths) == 4


def test_a_long_log_is_thinned_evenly() -> None:
    trace, rows = Trace(), np.arange(100_000.0)[:, None]
    for a in range(0, 100_000, 7919):
        trace.add(rows[a : a + 7919])
    kept = trace.values[:, 0]
    assert 5000 < len(kept) <= 24_000
    assert len(np.unique(np.diff(kept))) == 1

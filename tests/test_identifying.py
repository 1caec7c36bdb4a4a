"""Logs as tracks: pose from pictures and states, commands by ticks, and logs that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import log_file, rig_file

from calib.errors import BadInputError
from calib.identifying import TrackSource, read_track
from calib.logs import Log, read_log, write_log
from calib.twin.rig import SimulatedRig

RADIUS = 0.0126


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tracks")
    rig_file(path / "rig.yaml")
    log_file(path / "swing.csv", SimulatedRig(), "swing", 1, 4.0)
    log_file(path / "prbs.csv", SimulatedRig(), "prbs", 2, 4.0)
    return path


def _read(folder: Path, name: str, **options: object) -> TrackSource:
    rig = rig_file(folder / "rig.yaml")
    return read_track(folder / name, rig, folder / "rig.yaml", RADIUS, **options)


def _changed(folder: Path, name: str, **columns: np.ndarray | None) -> Path:
    log = read_log(folder / name)
    kept: dict[str, np.ndarray] = dict(log.columns)
    for key, value in columns.items():
        if value is None:
            kept.pop(key, None)
        else:
            kept[key] = value
    path = folder / f"changed_{name}"
    write_log(path, replace(log, columns=kept))
    return path


def test_pictures_give_the_true_pose_with_the_noise_that_is_said(folder: Path) -> None:
    seen, true = _read(folder, "prbs.csv"), _read(folder, "prbs.csv", truth=True)
    assert (seen.source, true.source) == ("pictures", "truth")
    at = seen.track.t_s - 0.025
    inside = at > 0.1
    truth = np.stack([np.interp(at, true.track.t_s, true.track.head[:, k]) for k in range(2)], axis=1)
    z = np.einsum("mij,mj->mi", seen.track.whitening, seen.track.head - truth)[inside]
    assert 0.7 < 1.4826 * np.median(np.abs(z)) < 1.5
    assert seen.delay_s == pytest.approx(0.025)


def test_commands_fall_on_even_ticks(folder: Path) -> None:
    one = _read(folder, "prbs.csv").track
    assert one.hoses
    assert one.tick_s == pytest.approx(1.0 / 60.0)
    log = read_log(folder / "prbs.csv")
    rows = log.sampled("pwm1", "pwm2")
    assert np.array_equal(one.pwm[: len(rows), 0], log.columns["pwm1"][rows])
    assert not _read(folder, "swing.csv").track.hoses


def test_a_swing_that_is_held_first_begins_where_it_is_let_go(folder: Path) -> None:
    log = read_log(folder / "swing.csv")
    t = np.concatenate([np.arange(60) / 60.0, log.t_s + 1.0])
    columns = {}
    for name, values in log.columns.items():
        first = values[log.sampled(name)[0]]
        columns[name] = np.concatenate([np.full(60, first), values])
    path = folder / "held.csv"
    write_log(path, Log("held", t, columns, np.arange(len(t), dtype=np.int64)))
    source = _read(folder, "held.csv")
    assert any("let go at" in sentence for sentence in source.said)
    assert source.track.t_s[-1] == pytest.approx(4.0, abs=0.15)


def test_states_stand_in_for_pictures(folder: Path) -> None:
    log = read_log(folder / "swing.csv")
    states = folder / "changed_swing_states.csv"
    q1, q2 = log.columns["true_q1_m"], log.columns["true_q2_m"]
    rows = np.stack([log.t_s, (q1 - q2) / (2.0 * RADIUS), 0.5 * (q1 + q2), np.full(len(q1), 1e-3)], axis=1)
    lines = [",".join(f"{c:.9g}" for c in row) for row in rows.tolist()]
    states.write_text("\n".join(["t_s,phi_rad,length_m,sigma_phi_rad", *lines]) + "\n")
    path = _changed(folder, "swing.csv", u_px=None, v_px=None)
    source = _read(folder, path.name)
    assert (source.source, source.delay_s, source.states) == ("states", 0.0, states)
    given = _read(folder, "swing.csv", states=states)
    assert np.allclose(given.track.head, source.track.head)
    states.unlink()
    with pytest.raises(BadInputError, match="has no marker"):
        _read(folder, path.name)

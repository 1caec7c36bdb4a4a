"""Logs as tracks: pose from pictures and states, commands by ticks, and logs that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import log_file, rig_file

from calib.errors import BadInputError
from calib.identifying import TrackSource, read_displacements, read_track
from calib.logs import Log, read_log, write_log
from calib.rig import Rig
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


def test_logs_that_cannot_be_used(folder: Path) -> None:
    without = _changed(folder, "swing.csv", pwm1=None, pwm2=None)
    with pytest.raises(BadInputError, match="has no commands, expected pwm1 and pwm2"):
        _read(folder, without.name)
    assert not _read(folder, without.name, no_pwm=True).track.hoses
    log = read_log(folder / "prbs.csv")
    for t, words in (
        (np.where(log.t_s > 2.0, log.t_s + 30.0, log.t_s), "the clock jumps from"),
        (np.where(log.t_s > 2.0, log.t_s - 1.0, log.t_s), "t_s goes back"),
    ):
        write_log(folder / "clock.csv", replace(log, t_s=t))
        with pytest.raises(BadInputError, match=words):
            _read(folder, "clock.csv")
    for t in (np.full(len(log), 1.0), 1e-12 * np.arange(len(log)) + np.where(log.t_s > 2.0, 5.0, 0.0)):
        write_log(folder / "clock.parquet", replace(log, t_s=t))
        with pytest.raises(BadInputError, match=r"s apart in the median|the clock jumps from|too short"):
            _read(folder, "clock.parquet")
    few = log.t_s < 0.5
    write_log(
        folder / "short.csv",
        replace(log, t_s=log.t_s[few], columns={k: v[few] for k, v in log.columns.items()}),
    )
    with pytest.raises(BadInputError, match=r"too short|expected at least 40"):
        _read(folder, "short.csv")
    big = _changed(folder, "prbs.csv", pwm1=3.0 * log.columns["pwm1"])
    with pytest.raises(BadInputError, match="expected 0 to 255"):
        _read(folder, big.name)
    with pytest.raises(BadInputError, match="run calib intrinsics first"):
        read_track(folder / "prbs.csv", Rig(), folder / "rig.yaml", RADIUS)


def test_words_that_say_nan_count_as_blank(folder: Path) -> None:
    text = (folder / "prbs.csv").read_text().splitlines()
    column = text[0].split(",").index("u_px")
    for k in range(1, 200):
        cells = text[k].split(",")
        if cells[column]:
            cells[column] = "nan"
        text[k] = ",".join(cells)
    (folder / "nan.csv").write_text("\n".join(text) + "\n")
    source = _read(folder, "nan.csv")
    assert "say nan or inf" in source.said[0]
    assert len(source.track.t_s) < len(_read(folder, "prbs.csv").track.t_s) - 20


def test_tables_of_weights(tmp_path: Path) -> None:
    path = tmp_path / "weights.csv"
    path.write_text("mass_g,elongation_mm\n0,0\n100,9.1\n200,15.2\n")
    eps, force = read_displacements(path)
    assert np.allclose(eps, [0.0, 0.0091, 0.0152])
    assert np.allclose(force, [0.0, 0.981, 1.962])
    path.write_text("mass_g,elongation_mm\n100,\n")
    with pytest.raises(BadInputError, match="line 2: has a blank"):
        read_displacements(path)
    path.write_text("volt,elongation_mm\n1,2\n")
    with pytest.raises(BadInputError, match="has no force"):
        read_displacements(path)

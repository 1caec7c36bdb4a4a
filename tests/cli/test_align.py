"""`calib align` as it is typed: what it finds, writes and says, and logs that are of no use."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_trials import twin_log

from calib.core.arrays import FloatArray
from calib.core.rig import read_rig
from calib.io.logs import Log, write_log
from calib.twin.rig import SimulatedRig

from .conftest import Run

RIG = SimulatedRig()


@pytest.fixture(scope="module")
def logs() -> dict[str, Log]:
    swing = twin_log(RIG, "swing", {"phi_rad": "0.5"}, 11)
    ellipse = twin_log(RIG, "ellipse", {}, 12)
    return {"swing": swing, "ellipse": ellipse, "static": twin_log(RIG, "static", {}, 13, 10.0)}


def _put(folder: Path, name: str, log: Log, **changed: FloatArray | None) -> Path:
    columns = {key: value for key, value in log.columns.items() if not key.startswith("true_")}
    for key, value in changed.items():
        if value is None:
            del columns[key]
        else:
            columns[key] = value
    path = folder / f"{name}.csv"
    write_log(path, replace(log, columns=columns))
    return path


def test_a_rig_is_aligned(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    paths = [_put(tmp_path, name, logs[name]) for name in ("swing", "ellipse")]
    figures = tmp_path / "figures"
    done = calib("align", *paths, "--rig", rig, "--figures", figures)
    assert done.code == 0, done.err
    assert "verdict: ok" in done.out
    assert "time offset of pictures, ms" in done.out
    section = read_rig(rig).align
    assert section is not None
    # Nothing but the logs and the calibrated camera and plane; the truth is that of the simulated rig.
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)
    assert section.mount_angle_rad == pytest.approx(0.02, abs=np.radians(0.1))
    offset = section.sigma["time_offset_s"]
    assert isinstance(offset, float)
    assert abs(section.time_offset_s - 0.025) < 4.0 * offset
    assert set(read_rig(rig).provenance.inputs["align"]) == {"swing.csv", "ellipse.csv"}
    assert {path.name for path in figures.iterdir()} == {
        "align_correlation.png", "align_residuals_1.png", "align_residuals_2.png",
    }  # fmt: skip


def test_json_and_the_same_bytes(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    path, again = _put(tmp_path, "swing", logs["swing"]), tmp_path / "again.yaml"
    again.write_bytes(rig.read_bytes())
    first = calib("align", path, "--rig", rig, "--json")
    assert calib("align", path, "--rig", again).code == first.code
    assert rig.read_bytes() == again.read_bytes()
    document = json.loads(first.out)
    assert (document["schema"], document["verb"]) == (1, "align")
    section = document["align"]
    assert len(section["covariance"]["values"]) == len(section["covariance"]["order"]) == 13
    assert set(section["sigma"]) >= {"time_offset_s", "mount_angle_rad", "rest_angle_rad", "accel_bias_mps2"}


def test_at_rest_the_offset_is_not_observable(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    done = calib("align", _put(tmp_path, "static", logs["static"]), "--rig", rig)
    assert done.code == 1
    assert "verdict: unidentifiable" in done.out
    assert "the logs hardly move" in done.out
    assert "the mount angle and the accelerometer's bias along y are nearly one number" in done.out
    section = read_rig(rig).align
    assert section is not None
    rest = section.sigma["rest_angle_rad"]
    assert isinstance(rest, float)
    assert rest < np.radians(0.1)


def test_a_rig_without_camera_or_plane(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    path = _put(tmp_path, "swing", logs["swing"])
    done = calib("align", path, "--rig", tmp_path / "new.yaml")
    assert done.code == 3
    assert "run calib intrinsics first" in done.sentence
    bare = tmp_path / "bare.yaml"
    bare.write_text(rig.read_text().split("plane:")[0])
    done = calib("align", path, "--rig", bare)
    assert done.code == 3
    assert "run calib extrinsics first" in done.sentence


def _times(log: Log, change: Callable[[FloatArray], FloatArray]) -> Log:
    return replace(log, t_s=change(log.t_s.copy()))


def _first(log: Log, rows: int) -> Log:
    columns = {name: value[:rows] for name, value in log.columns.items()}
    return replace(log, t_s=log.t_s[:rows], columns=columns, lines=log.lines[:rows])


def _backwards(t: FloatArray) -> FloatArray:
    t[300:] -= 1.0
    return t


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda log: (log, {"u_px": None, "v_px": None}), "has no picture of the marker"),
        (lambda log: (log, {"ax_mps2": None, "ay_mps2": None, "gz_radps": None}), "has no gyroscope"),
        (lambda log: (_times(log, _backwards), {}), "t_s goes back"),
        (lambda log: (_first(log, 4), {}), "has no stretch of 1 s"),
        (lambda log: (log, {"gz_radps": 57.2958 * log.columns["gz_radps"]}), "in deg/s, expected rad/s"),
        (lambda log: (log, {"gz_radps": -log.columns["gz_radps"]}), "the other way round"),
        (lambda log: (log, {"gz_radps": 0.0 * log.columns["gz_radps"]}), "gz_radps is always"),
        (lambda log: (log, {"u_px": log.columns["u_px"] + 4000.0}), "has no picture of the marker"),
    ],
)
def test_bad_logs_end_in_a_sentence(
    make: Callable[[Log], tuple[Log, dict[str, FloatArray | None]]], words: str, calib: Run,
    logs: dict[str, Log], rig: Path, tmp_path: Path,
) -> None:  # fmt: skip
    before = rig.read_bytes()
    log, changed = make(logs["swing"])
    done = calib("align", _put(tmp_path, "log", log, **changed), "--rig", rig)
    assert done.code == 3
    assert words in done.sentence
    assert rig.read_bytes() == before


def test_slow_motion_in_degrees_is_seen(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    log = logs["ellipse"]
    path = _put(tmp_path, "log", log, gz_radps=57.2958 * log.columns["gz_radps"])
    done = calib("align", path, "--rig", rig)
    assert done.code == 3
    assert "so it is in deg/s, expected rad/s" in done.sentence


def test_an_hour_of_jump_splits_the_log(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    log = _times(logs["swing"], lambda t: np.where(t > 2.0, t + 3600.0, t))
    done = calib("align", _put(tmp_path, "log", log), "--rig", rig)
    assert done.code in (0, 1)
    assert "split at 1 gap(s)" in done.err
    section = read_rig(rig).align
    assert section is not None
    assert section.logs[0].stretches == 2
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)


def test_cells_that_say_nan_count_as_blank(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    path = _put(tmp_path, "log", logs["swing"])
    lines = path.read_text().splitlines()
    for k, word in zip(range(40, 400, 20), ["nan", "inf", "-inf"] * 6, strict=True):
        cells = lines[k].split(",")
        lines[k] = ",".join([cells[0], *(word if cell else "" for cell in cells[1:])])
    path.write_text("\n".join(lines) + "\n")
    done = calib("align", path, "--rig", rig)
    assert done.code in (0, 1)
    assert "cells say nan or inf and count as blank" in done.err
    section = read_rig(rig).align
    assert section is not None
    assert section.time_offset_s == pytest.approx(0.025, abs=1e-3)


def test_pictures_of_something_else(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    log, rng = logs["swing"], np.random.default_rng(0)
    seen = np.isfinite(log.columns["u_px"])
    u = np.where(seen, rng.integers(0, 316, len(log)), np.nan)
    v = np.where(seen, rng.integers(0, 208, len(log)), np.nan)
    done = calib("align", _put(tmp_path, "log", log, u_px=u, v_px=v), "--rig", rig)
    assert done.code == 1
    assert "verdict: unidentifiable" in done.out
    assert "show something else than the marker" in done.out


def test_two_seconds_are_too_short(calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path) -> None:
    done = calib("align", _put(tmp_path, "log", _first(logs["swing"], 330)), "--rig", rig)
    assert done.code == 1
    assert "the logs are too short" in done.out


def test_a_log_without_pictures_beside_a_good_one(
    calib: Run, logs: dict[str, Log], rig: Path, tmp_path: Path
) -> None:
    good = _put(tmp_path, "good", logs["swing"])
    blind = _put(tmp_path, "blind", logs["ellipse"], u_px=None, v_px=None)
    done = calib("align", good, blind, "--rig", rig)
    assert done.code in (0, 1)
    assert "blind.csv: has no picture of the marker" in done.err
    assert set(read_rig(rig).provenance.inputs["align"]) == {"good.csv"}

"""From a log to arrays, and what is wrong about its sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.io.columns import IN_PLANE
from calib.io.logs import Log, read_log
from calib.io.sensor_faults import Watch

G = 9.80665


def _log(**changes: Any) -> Log:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(3000)
    phi = 0.5 * np.sin(1.3 * t)
    columns: dict[str, FloatArray] = {
        "gz_radps": -0.65 * np.cos(1.3 * t) + 0.003 * rng.normal(size=3000),
        "ax_mps2": G * np.cos(phi) + 0.02 * rng.normal(size=3000),
        "ay_mps2": G * np.sin(phi) + 0.02 * rng.normal(size=3000),
    }
    for name, value in changes.items():
        columns[name] = np.broadcast_to(value, (3000,)).copy()
    return Log("log.csv", t, columns, np.arange(2, 3002))


def test_rows_with_all_columns() -> None:
    log = _log(u_px=np.where(np.arange(3000) % 3 == 0, 100.0, np.nan))
    both = log.signals("u_px", "gz_radps")
    assert len(both) == 1000
    assert both.lines[:2].tolist() == [2, 5]
    assert np.array_equal(both["gz_radps"], log.columns["gz_radps"][::3])
    assert both.axis.rate_hz == pytest.approx(100.0 / 3.0)
    either = log.signals("u_px", optional=("gz_radps", "gx_radps"), partly=True)
    assert (len(either), either.names) == (3000, ("u_px", "gz_radps"))
    # What is infinite is no reading, in a log made in Python as in one that was read.
    wild = _log(gz_radps=np.where(np.arange(3000) < 7, np.inf, 0.1 * np.arange(3000)))
    assert [len(wild.signals("gz_radps", partly=some)) for some in (False, True)] == [2993, 2993]


def test_an_accelerometer_with_rows_of_its_own_is_read_between_them() -> None:
    """As some drivers send it: 200 Hz of one sensor and 63 of the other, no row with both."""
    t = 0.001 * np.arange(9000)
    gyro, accel = np.arange(9000) % 5 == 0, np.arange(9000) % 16 == 3
    accel[4000:4500] = False
    phi = 0.5 * np.sin(1.3 * t)
    columns = {
        "gz_radps": np.where(gyro & ~accel, -0.65 * np.cos(1.3 * t), np.nan),
        "ax_mps2": np.where(accel, G * np.cos(phi), np.nan),
        "ay_mps2": np.where(accel, G * np.sin(phi), np.nan),
    }
    signals = Log("log.csv", t, columns, np.arange(2, 9002)).signals(*IN_PLANE)
    assert np.abs(signals["ay_mps2"] - G * np.sin(0.5 * np.sin(1.3 * signals.t_s))).max() < 1e-3
    assert not ((signals.t_s > 4.005) & (signals.t_s < 4.495)).any()
    assert len(signals) > 0.85 * gyro.sum()
    assert any("rows of their own" in finding.text for finding in signals.findings)


def test_rows_that_were_written_twice_are_one_sample() -> None:
    log = _log()
    rows = np.sort(np.concatenate([np.arange(3000), np.arange(100, 2900, 480)]))
    twice = Log("log.csv", log.t_s[rows], {k: v[rows] for k, v in log.columns.items()}, log.lines[rows])
    signals = twice.signals(*IN_PLANE)
    assert (len(signals), signals.repeated_rows) == (3000, 6)
    assert np.array_equal(signals["ax_mps2"], log.columns["ax_mps2"])


def test_alike_pictures_of_a_burst_are_readings_of_their_own() -> None:
    """At rest, or between whole pixels: with rows of the IMU between them they were not written twice."""
    picture = np.arange(3000) % 2 == 0
    columns = {"u_px": np.where(picture, 100.0, np.nan), "gz_radps": np.where(picture, np.nan, 0.0)}
    t = np.repeat(0.04 * np.arange(375), 8)
    signals = Log("log.csv", t, columns, np.arange(2, 3002)).signals("u_px")
    assert (len(signals), signals.repeated_rows) == (1500, 0)


def test_a_picture_in_a_row_of_a_burst_was_taken_with_its_sample() -> None:
    """Five samples at a time, all with the stamp of the last one; every third has a picture."""
    taken = 0.01 * np.arange(3000)
    picture = np.arange(3000) % 3 == 1
    log = _log(u_px=np.where(picture, 100.0 + np.sin(taken), np.nan))
    log = replace(log, t_s=taken[np.arange(3000) // 5 * 5 + 4] + 0.003)
    assert np.abs(log.signals("u_px").t_s - taken[picture] - 0.003).max() < 1e-4


@pytest.mark.parametrize(
    ("changes", "severity", "words"),
    [
        ({}, "", ""),
        ({"gz_radps": 0.01}, "inconsistent", "gz_radps never changes, it is stuck at 0.01"),
        ({"ax_mps2": np.nan}, "poor", "ax_mps2 has no reading in any row"),
    ],
)
def test_a_watch_sees_what_is_stuck_or_absent(changes: dict[str, Any], severity: str, words: str) -> None:
    log, watch = _log(**changes), Watch()
    for part in np.array_split(np.arange(3000), 7):
        columns = {name: values[part] for name, values in log.columns.items()}
        watch.add(Log("log.csv", log.t_s[part], columns, log.lines[part]))
    found = watch.findings()
    assert [(one.severity, one.text) for one in found] == ([(severity, words)] if words else [])


def test_a_gyroscope_that_does_not_answer_is_named() -> None:
    log = _log()
    gz, t = log.columns["gz_radps"], log.t_s
    noise = 0.003 * np.random.default_rng(1).normal(size=3000)
    for spoilt, words in (
        (np.where(t > 20.0, gz[2000], gz), "gz_radps is stuck at"),
        (noise, "gz_radps does not turn from 0.0 s on"),
        (np.where(t > 20.0, noise, gz), "gz_radps does not turn from 20.0 s on"),
        (np.where(abs(t - 15.0) < 4.0, noise, gz), "gz_radps does not turn from 10.5 s on"),
        (0.05 * gz, "gz_radps does not turn from 0.0 s on"),
    ):
        with pytest.raises(BadInputError, match=words):
            _log(gz_radps=spoilt).signals(*IN_PLANE).refuse_mirrored()
    # At rest a coarse gyroscope says the same for long, and on a table that shakes it says nothing.
    rest = {"ax_mps2": G, "ay_mps2": 0.02 * np.random.default_rng(2).normal(size=3000)}
    for still in (np.where(t > 20.0, 0.01, 0.0), noise):
        assert _log(gz_radps=still, **rest).signals(*IN_PLANE).findings == ()
    shaken = _log(gz_radps=noise, ax_mps2=G, ay_mps2=5.0 * np.sin(40.0 * t))
    assert shaken.signals(*IN_PLANE).findings == ()
    # A slide goes to and fro by 0.2 m/s without turning.
    slid = _log(gz_radps=noise, ax_mps2=G, ay_mps2=0.2 * 2.5 * np.sqrt(2.0) * np.cos(2.5 * t))
    assert slid.signals(*IN_PLANE).findings == ()
    # Between two quick turns somebody pushes it.
    lean = 0.25 * (np.tanh((t - 8.0) / 0.1) + np.tanh((t - 13.9) / 0.1))
    force = G * np.exp(1j * lean) + 2.5j * (abs(t - 10.8) < 0.4)
    pushed = _log(gz_radps=noise - np.gradient(lean, t), ax_mps2=force.real, ay_mps2=force.imag)
    assert pushed.signals(*IN_PLANE).findings == ()
    # At 200 deg/s a lever of half a metre is felt by 0.6 g, and the rate stays the same.
    force = G * np.exp(3.5j * t) - 0.5 * 3.5**2
    turning = _log(gz_radps=noise - 3.5, ax_mps2=force.real, ay_mps2=force.imag)
    assert turning.signals(*IN_PLANE).findings == ()
    assert log.signals(*IN_PLANE).findings == ()


def test_a_tilted_sensor_turns_without_gz() -> None:
    """About x, with a third of gravity along z: the angle in the plane turns and gz does not."""
    t, noise = 0.01 * np.arange(3000), 0.003 * np.random.default_rng(1).normal(size=(3, 3000))
    turn, rate = 0.8 * np.sin(1.3 * t), 1.04 * np.cos(1.3 * t)
    log = _log(
        gx_radps=rate + noise[0], gy_radps=noise[1], gz_radps=noise[2],
        ax_mps2=0.94 * G, ay_mps2=0.34 * G * np.sin(turn), az_mps2=0.34 * G * np.cos(turn),
    )  # fmt: skip
    assert log.signals(*IN_PLANE, "az_mps2").findings == ()
    dead = Log(log.source, log.t_s, log.columns | {"gx_radps": noise[0]}, log.lines)
    assert len(dead.signals(*IN_PLANE, "az_mps2").findings) == 1


def test_axes_that_are_swapped_or_mirrored() -> None:
    right = _log()
    ax, ay, gz = (right.columns[name] for name in ("ax_mps2", "ay_mps2", "gz_radps"))
    assert right.signals(*IN_PLANE).findings == ()
    (swapped,) = _log(ax_mps2=ay, ay_mps2=ax).signals(*IN_PLANE).findings
    assert swapped.severity == "inconsistent"
    assert "ax_mps2 and ay_mps2 are swapped" in swapped.text
    assert "the lines ax_mps2: ay_mps2 and ay_mps2: ax_mps2" in swapped.advice
    (mirrored,) = _log(gz_radps=-gz).signals(*IN_PLANE).findings
    assert "gz_radps, or one of ax_mps2 and ay_mps2, has the wrong sign" in mirrored.text
    assert "gz_radps: {column: gz_radps, factor: -1}" in mirrored.advice
    with pytest.raises(BadInputError, match="turns against the gyroscope's: ax_mps2 and ay_mps2 are swapped"):
        _log(ax_mps2=ay, ay_mps2=ax).signals(*IN_PLANE).refuse_mirrored()


def test_a_head_that_swings_is_not_mirrored() -> None:
    """At 3 Hz the head's own acceleration outweighs gravity, and the angle by ax and ay is the other way."""
    t = 0.01 * np.arange(3000)
    phi, w = 0.3 * np.sin(19.0 * t), 19.0
    log = _log(
        gz_radps=-0.3 * w * np.cos(19.0 * t),
        ax_mps2=G * np.cos(phi),
        ay_mps2=G * np.sin(phi) - 0.06 * w**2 * phi,
    )
    assert log.signals(*IN_PLANE).findings == ()


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("u_px",), "log.csv: has no u_px, expected u_px beside t_s"),
        (("gx_radps", "gz_radps"), "log.csv: has no gx_radps, expected gx_radps and gz_radps beside t_s"),
        (("gy_radps",), "log.csv: gy_radps holds no number"),
    ],
)
def test_what_is_not_there(names: tuple[str, ...], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        _log(gy_radps=np.nan).signals(*names)


def test_time_that_goes_back_and_axes_that_are_stuck() -> None:
    log = _log(ay_mps2=0.5)
    with pytest.raises(BadInputError, match=r"ay_mps2 never changes, it is stuck at 0.5; expected the noise"):
        log.signals(*IN_PLANE).refuse_stuck(*IN_PLANE)
    log.t_s[10] = 0.0
    with pytest.raises(BadInputError, match=r"log.csv, line 12: t_s goes back from 0.090000 to 0.000000"):
        log.signals("gz_radps")


@pytest.mark.parametrize(
    ("steps", "advice"),
    [
        (np.random.default_rng(1).permutation(3000), "sort its rows"),
        (np.arange(3000)[::-1], "sort its rows"),
        (np.arange(3000) ^ 1, "sort its rows"),
        (np.arange(3000) % 1500, "cut the log there"),
        (np.arange(3000) - 25 * (np.arange(3000) >= 2000), "cut the log there"),
    ],
)
def test_rows_in_disorder_are_told_from_a_clock_that_was_set(steps: IntArray, advice: str) -> None:
    """Sorted, the rows from before and after a clock's step back would be mixed."""
    log = replace(_log(), t_s=0.01 * steps)
    with pytest.raises(BadInputError, match=advice):
        log.signals("gz_radps")


@pytest.fixture
def written(tmp_path: Path) -> Callable[[IntArray], Path]:
    """Writes these rows of a log of a gyroscope and an accelerometer at rest."""
    rng = np.random.default_rng(2)
    t = 0.01 * np.arange(3000)
    readings = rng.normal(size=(3000, 3)) * (0.002, 0.015, 0.015) + (0.004, G, 0.1)

    def write(rows: IntArray, readings: FloatArray = readings) -> Path:
        path = tmp_path / "log.csv"
        lines = [f"{t[k]:.6f},{','.join(f'{x:.6f}' for x in readings[k])}" for k in rows]
        path.write_text("\n".join([",".join(("t_s", *IN_PLANE)), *lines]) + "\n")
        return path

    return write


def test_rows_twice_or_out_of_order_say_nothing_of_units(written: Callable[[IntArray], Path]) -> None:
    twice = Log.load(written(np.repeat(np.arange(3000), 2))).signals(*IN_PLANE)
    assert (len(twice), twice.repeated_rows, twice.findings) == (3000, 3000, ())
    for rows in (np.arange(3000)[::-1], np.roll(np.arange(3000), 700).reshape(-1, 50)[::-1].ravel()):
        with pytest.raises(BadInputError, match=r"log\.csv, line \d+: t_s goes back from"):
            Log.load(written(rows)).signals(*IN_PLANE)


@pytest.mark.parametrize("name", IN_PLANE)
def test_wild_cells_count_as_blank(written: Any, name: str) -> None:
    readings = np.loadtxt(written(np.arange(3000)), delimiter=",", skiprows=1)[:, 1:]
    readings[[700, 1400, 2100], IN_PLANE.index(name)] = 1e6, -1e7, 1e300
    log = Log.load(written(np.arange(3000), readings))
    assert (log.passed.implausible, log.passed.first_implausible) == (3, f"{name} is 1e+06 in line 702")
    assert np.isnan(log.columns[name]).sum() == 3 and np.nanmax(np.abs(log.columns[name])) < 12.0
    assert any("3 cells hold more than any sensor gives" in one for one in log.remarks())


def _pictures(folder: Path, u: FloatArray, v: FloatArray) -> Path:
    path = folder / "seen.csv"
    t = np.arange(len(u)) / 60.0
    np.savetxt(path, np.stack([t, u, v], axis=1), "%.6f", ",", header="t_s,u_px,v_px", comments="")
    return path


@pytest.mark.parametrize(("factor", "sign"), [(2.0, 1.0), (1.0, -1.0)])
def test_pictures_of_another_camera_are_refused(tmp_path: Path, factor: float, sign: float) -> None:
    turn = np.linspace(0.0, 9.0, 600)
    path = _pictures(
        tmp_path, sign * factor * (160.0 + 80.0 * np.sin(turn)), factor * (100 + 50 * np.cos(turn))
    )
    assert len(read_log(path).sampled("u_px", "v_px")) == 600
    with pytest.raises(
        BadInputError, match=r"seen\.csv, line 2: the marker is at .* outside the picture of 316x208"
    ):
        read_log(path, picture_px=(316, 208))


@pytest.mark.parametrize(("lost", "count"), [((-1.0, -1.0), 300), ((0.0, 0.0), 300), ((400.0, 10.0), 3)])
def test_markers_outside_the_picture_count_as_blank(
    tmp_path: Path, lost: tuple[float, float], count: int
) -> None:
    at = np.full((600, 2), [-0.4, 207.4])
    at[100 : 100 + count] = lost
    remarks: list[str] = []
    log = read_log(_pictures(tmp_path, *at.T), remarks=remarks, picture_px=(316, 208))
    assert len(log.sampled("u_px", "v_px")) == 600 - count
    assert f"{count} pictures put the marker outside of them or at (0, 0)" in remarks[-1]


@pytest.mark.parametrize("every", [1, 8])
@pytest.mark.parametrize(("begin", "end"), [(0, 2000), (900, 1200), (1000, 3000)])
def test_an_imu_that_stops_answering(begin: int, end: int, every: int) -> None:
    # A board may read a sensor more often than that has something new to tell.
    held = np.arange(3000) // every * every
    held[begin:end] = held[begin]
    log = _log(az_mps2=0.02 * np.random.default_rng(3).normal(size=3000))
    log = replace(log, columns={name: values[held] for name, values in log.columns.items()})
    signals = log.signals(*IN_PLANE)
    gone = np.setdiff1d(np.arange(3000), signals.rows)
    assert abs(gone[0] - begin - 1) < every and abs(gone[-1] + 1 - end) < every
    (finding,) = (one for one in signals.findings if "all readings of the IMU stay the same" in one.text)
    assert finding.severity == "poor" and f"to {log.t_s[gone[-1]]:.1f} s" in finding.text


@pytest.mark.parametrize("name", ["gz_radps", "ax_mps2", "ay_mps2"])
@pytest.mark.parametrize(("begin", "end"), [(0, 1500), (1500, 3000), (1000, 1150)])
def test_an_axis_that_is_stuck_while_the_others_go_on(name: str, begin: int, end: int) -> None:
    rng = np.random.default_rng(5)
    log = _log(az_mps2=0.02 * rng.normal(size=3000), gx_radps=0.003 * rng.normal(size=3000))
    assert not log.signals(*IN_PLANE).findings
    column = log.columns[name].copy()
    column[begin:end] = column[begin]
    stuck = replace(log, columns={**log.columns, name: column})
    (finding,) = stuck.signals(*IN_PLANE).findings
    assert finding.severity == "inconsistent"
    assert finding.text.startswith(f"{name} is stuck at {column[begin]:.6g} from {log.t_s[begin]:.1f} to")
    others = [one for one in IN_PLANE if one != name]
    assert not any("is stuck" in one.text for one in stuck.signals(*others).findings)


@pytest.mark.parametrize("step", [0.01, 0.05, 0.3])
def test_an_axis_that_rests_within_its_step_is_not_stuck(step: float) -> None:
    """A coarse sensor repeats itself at rest, in all its axes alike, and changes in motion."""
    rng = np.random.default_rng(6)
    log = _log(az_mps2=0.02 * rng.normal(size=3000), gx_radps=0.003 * rng.normal(size=3000))
    moving = np.arange(3000) > 1000
    coarse = {name: np.rint(np.where(moving, v, 0.1 * v) / step) * step for name, v in log.columns.items()}
    assert not any("is stuck" in one.text for one in replace(log, columns=coarse).signals(*IN_PLANE).findings)


def test_an_imu_with_coarse_steps_has_not_stopped() -> None:
    log = _log(az_mps2=0.0)
    coarse = {name: np.rint(values / 0.05) * 0.05 for name, values in log.columns.items()}
    signals = replace(log, columns=coarse).signals(*IN_PLANE)
    assert len(signals) == 3000 and not any("stay the same" in one.text for one in signals.findings)

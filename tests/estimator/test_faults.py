"""Systematic faults of each column of a log: no verdict is ok where states are off by more than claimed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from drivenlogs import driven_log, varied_drive
from estimatorlogs import rows_from, setup_for, truth

from calib.core.arrays import FloatArray
from calib.core.verdict import Finding, Verdict
from calib.io.logs import Log
from calib.io.sensor_faults import Watch
from calib.stages.estimator.consistency import SENSORS, Tally
from calib.stages.estimator.driven import PARAMETER, SIGMA, Drive, Handover
from calib.stages.estimator.kinematic import OUT
from calib.stages.estimator.read import READINGS
from calib.stages.estimator.replay import (
    captured,
    consistent,
    contradicting,
    grown,
    jumped,
    sampled,
    throughout,
    untimely,
)

_LAST_PIXEL = {"u_px": 315.0, "v_px": 207.0}
_UNIT = {"u_px": 0.5, "v_px": 0.5, "ax_mps2": 1 / 9.81, "ay_mps2": 1 / 9.81, "gz_radps": 57.3}
_COLUMNS = (*_UNIT, "pwm1", "pwm2")
_SWAPS = (
    ("u_px", "v_px"), ("ax_mps2", "ay_mps2"), ("ax_mps2", "gz_radps"), ("ay_mps2", "gz_radps"),
    ("pwm1", "pwm2"),
)  # fmt: skip
_UNSEEN = {
    # Only the length along the axis is wrong, by a few millimetres, which a wrong plant explains as well.
    ("swing", "v_px", "other"), ("elongation", "v_px", "other"), ("elongation", "v_px", "late"),
    # Upright the reading is next to nothing: a wrong unit of it turns the angle by .1 degrees.
    ("elongation", "ay_mps2", "unit"), ("elongation", "ay_mps2", "doubled"),
}  # fmt: skip


def _shifted(log: Log, name: str, other: Log, late_s: float) -> FloatArray:
    """A column with the readings of another log, or of its own so much earlier."""
    rows, readings = log.sampled(name), other.columns[name][other.sampled(name)]
    out = np.full(len(log), np.nan)
    at = np.arange(len(rows)) % len(readings)
    if late_s:
        t = log.t_s[rows]
        at = np.clip(np.searchsorted(t, t - late_s, side="right") - 1, 0, None)
    out[rows] = readings[at]
    return out


def _faulty(log: Log, other: Log) -> Iterator[tuple[str, str, Log]]:
    """The log with one column after another spoilt, the column, and in which way."""
    for name in _COLUMNS:
        column = log.columns[name]
        ways = {
            "sign": _LAST_PIXEL.get(name, 0.0) - column,
            "unit": _UNIT.get(name, 255.0) * column,
            "frozen": np.where(np.isfinite(column), np.nanmedian(column), np.nan),
            "late": _shifted(log, name, log, 0.2),
            "doubled": 2.0 * column,
            "other": _shifted(log, name, other, 0.0),
        }
        for way, spoilt in ways.items():
            yield name, way, replace(log, columns={**log.columns, name: spoilt})
    for one, two in _SWAPS:
        swapped = {**log.columns, one: log.columns[two], two: log.columns[one]}
        yield one, f"for {two}", replace(log, columns=swapped)


def _judged(log: Log) -> tuple[str, float]:
    """The verdict's word, and the error against the truth in deviations, root mean square of the worst."""
    setup, tally, watch = setup_for(varied_drive(0)), Tally(0.0126), Watch(READINGS)
    estimate = Handover(setup, Drive())
    out, true = estimate.run(rows_from(log)), truth(log)
    tally.add(out, true)
    watch.add(log)
    checks = {sensor: check for sensor in SENSORS if (check := tally.check(sensor)) is not None}
    findings: list[Finding] = [
        *sampled(watch),
        *consistent(checks, tally.flags, len(out)),
        *contradicting(setup, estimate.sensor, tally.end_s - tally.start_s),
    ]
    late = out[:, 0] > out[0, 0] + 2.0
    places = [OUT.index(column) for column in ("q1_m", "q2_m", "phi_rad")]
    sigmas = [OUT.index(column) for column in ("sigma_q1_m", "sigma_q2_m", "sigma_phi_rad")]
    away = (out[late][:, places] - true[late]) / out[late][:, sigmas]
    return Verdict.of(findings).word, float(np.sqrt(np.mean(away**2, axis=0)).max())


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param("static", marks=pytest.mark.slow),
        "swing",
        pytest.param("step", marks=pytest.mark.slow),
        pytest.param("elongation", marks=pytest.mark.slow),
    ],
)
def test_no_verdict_is_ok_where_a_column_is_not_what_it_says(scenario: str) -> None:
    _, log = driven_log(scenario)
    _, other = driven_log("ellipse")
    word, away = _judged(log)
    assert word == "ok"
    assert away < 2.0
    believed, seen = [], 0
    for name, way, spoilt in _faulty(log, other):
        word, away = _judged(spoilt)
        seen += word != "ok"
        if word == "ok" and away > 3.0 and (scenario, name, way) not in _UNSEEN:
            believed.append(f"{name} {way}: {away:.1f}")
    assert not believed
    assert seen >= 20


def _delayed(log: Log, names: tuple[str, ...], samples: int) -> Log:
    """The log with columns whose readings come so many samples later."""
    columns = dict(log.columns)
    for name in names:
        rows = log.sampled(name)
        columns[name] = columns[name].copy()
        columns[name][rows[samples:]] = log.columns[name][rows[:-samples]]
    return replace(log, columns=columns)


@pytest.mark.few(0)
@pytest.mark.parametrize("scenario", ["swing", "ellipse", "step"])
@pytest.mark.parametrize(
    ("late", "samples", "told"),
    [
        (("ay_mps2",), 1, "ay_mps2 comes 10 ms after"),
        (("ay_mps2",), 5, "ay_mps2 comes 50 ms after"),
        (("gz_radps",), 1, "gz_radps comes 10 ms after"),
        (("ax_mps2", "ay_mps2", "gz_radps"), 5, "the IMU comes"),
    ],
)
def test_a_late_column_is_named(scenario: str, late: tuple[str, ...], samples: int, told: str) -> None:
    _, log = driven_log(scenario)
    setup = setup_for(varied_drive(0))
    assert not list(untimely(setup, rows_from(log)))
    (finding,) = untimely(setup, rows_from(_delayed(log, late, samples)))
    assert finding.severity == "inconsistent"
    assert told in finding.text


@pytest.mark.parametrize("scenario", ["static", "swing", "ellipse", "step", "elongation"])
def test_an_angle_that_gravity_contradicts_is_told(scenario: str) -> None:
    """Pictures two pixels aside, as of a camera that was moved: the angle is 2 degrees off."""
    _, log = driven_log(scenario)
    setup = setup_for(varied_drive(0))
    for aside_px in (0.0, 2.0):
        moved = replace(log, columns={**log.columns, "u_px": log.columns["u_px"] + aside_px})
        estimate = Handover(setup, Drive())
        estimate.run(rows_from(moved))
        told = [one.text for one in contradicting(setup, estimate.sensor, float(np.ptp(log.t_s)))]
        assert bool(told) == (aside_px > 0.0), told


@pytest.mark.parametrize("scenario", ["static", "ellipse"])
def test_a_camera_that_moved_along_the_actuator_is_told(scenario: str) -> None:
    """Pictures two pixels along it: q1 and q2 are 2 mm off, ten deviations, and nothing else tells."""
    _, log = driven_log(scenario)
    setup = setup_for(varied_drive(0))
    sigma = np.array(SIGMA)
    sigma[PARAMETER.index("rest_length_m")] = 3.5e-4
    drive = Drive(sigma=tuple(sigma), covariance=np.diag(sigma**2))
    for along_px in (0.0, -2.0, 2.0):
        moved = replace(log, columns={**log.columns, "v_px": log.columns["v_px"] + along_px})
        estimate = Handover(setup, drive)
        estimate.run(rows_from(moved))
        longer_m, sigma_m = estimate.longer_m
        assert bool(list(grown(longer_m, sigma_m))) == (along_px != 0.0), longer_m
        assert along_px * longer_m >= 0.0


@pytest.mark.parametrize("size", [3, 12])
def test_samples_of_a_burst_are_put_where_they_were_taken(size: int) -> None:
    """All bear the time of the last one, and were late by (size - 1) / 2 periods on average."""
    _, log = driven_log("ellipse")
    sampled = log.sampled("gz_radps")
    t = log.t_s.copy()
    for burst in np.split(sampled, range(size, len(sampled), size)):
        t[burst[0] : burst[-1] + 1] = t[burst[-1]]
    rows = rows_from(replace(log, t_s=t))
    off = (rows.taken_s - log.t_s)[sampled]
    # Single stamps of the log itself are late by a period.
    assert np.sqrt(np.mean(off**2)) < 1.5e-3, off
    assert not list(untimely(setup_for(varied_drive(0)), rows))


def test_a_clock_that_steps_midway_is_named() -> None:
    """The angle is off by 0.16 degrees, 7.6 of its deviations, after pictures that come 50 ms late."""
    _, log = driven_log("ellipse")
    imu = ("ax_mps2", "ay_mps2", "gz_radps")
    later, middle = _delayed(log, imu, 5), len(log) // 2
    columns = {**log.columns}
    for name in imu:
        columns[name] = np.concatenate([log.columns[name][:middle], later.columns[name][middle:]])
    (finding,) = untimely(setup_for(varied_drive(0)), rows_from(replace(log, columns=columns)))
    assert "the IMU comes" in finding.text
    assert finding.text.startswith("from ")


def test_what_a_few_rows_gain_is_no_delay() -> None:
    """Of 81 sound logs five were said to be late, most by a sample, for the jerks of pumps."""
    noise = np.random.default_rng(0).normal(-0.02, 0.5, 2000)
    assert throughout(noise + 0.1)
    noise[::400] += 60.0
    assert not throughout(noise)


def test_pictures_of_another_size_are_no_delay() -> None:
    """In each stretch they look like another one, which was named."""
    _, log = driven_log("ellipse")
    columns = {**log.columns, **{name: 0.97 * log.columns[name] for name in ("u_px", "v_px")}}
    (finding,) = untimely(setup_for(varied_drive(0)), rows_from(replace(log, columns=columns)))
    assert "by no one delay: as if from " in finding.text
    assert "the pictures' resolution" in finding.advice


def test_a_marker_that_stands_while_the_head_turns_is_named() -> None:
    """It was said to jump, as of a camera that has moved; at rest whole pixels repeat, and a bias turns."""
    for scenario in ("ellipse", "static"):
        _, log = driven_log(scenario)
        assert not list(captured(log, False))
        columns, seen = dict(log.columns), log.sampled("u_px")
        held = seen[(log.t_s[seen] >= 4.0) & (log.t_s[seen] <= 9.0)]
        for name in ("u_px", "v_px"):
            columns[name] = columns[name].copy()
            columns[name][held] = columns[name][held[0]]
        columns["gz_radps"] = columns["gz_radps"] + 0.05
        told = [one.text for one in captured(replace(log, columns=columns), False)]
        assert len(told) == (scenario == "ellipse")
        assert not told or told[0].startswith(
            "the marker's place stays the same to the digit from 4.0 to 9.0 s"
        )


@pytest.mark.parametrize("k", [0, 2, 5, 30, 54])
@pytest.mark.parametrize("gap_s", [0.0, 10.0])
def test_a_jump_before_a_gap_or_at_an_end_is_looked_at(k: int, gap_s: float) -> None:
    """Where too few pictures tell whether it stays, it does; two of these cases raised IndexError."""
    count = 61
    t_s = np.arange(count) / 60.0 + 10.0
    t_s[k + 1 :] += gap_s
    out = np.full((count, len(OUT)), np.nan)
    out[:, OUT.index("t_s")], out[:, OUT.index("flags")], out[:, OUT.index("gated_camera")] = t_s, 0.0, 0.0
    for name in ("e_u", "e_v", "nis_camera"):
        out[:, OUT.index(name)] = 0.1
    out[k:, OUT.index("e_v")] = 20.0 * 0.7 ** np.arange(count - k)
    tally = Tally(0.0126, rows=1, start_s=0.0)
    tally.add(out, None, np.column_stack([np.full(count, 150.0), 100.0 + 8.0 * (np.arange(count) >= k)]))
    assert len(list(jumped(tally))) == 1


def test_delays_are_not_looked_for_in_a_log_at_rest() -> None:
    _, log = driven_log("static")
    late = _delayed(log, ("gz_radps",), 5)
    assert not list(untimely(setup_for(varied_drive(0)), rows_from(late)))


@pytest.mark.few(0, 3)
@pytest.mark.parametrize("scenario", ["static", "ellipse"])
@pytest.mark.parametrize(
    ("name", "px", "lasts_s"),
    [
        ("v_px", 0.0, 99.0),
        ("v_px", 3.0, 99.0),
        ("u_px", -8.0, 99.0),
        # A reflection that is taken for the marker.
        ("v_px", 60.0, 0.1),
        ("v_px", 60.0, 0.4),
        ("v_px", 4.0, 0.5),
        ("v_px", 3.0, 0.1),
    ],
)
def test_a_camera_that_moves_is_named_with_the_time(
    scenario: str, name: str, px: float, lasts_s: float
) -> None:
    """By 2 px along the actuator lengths are off by 1.6 mm, 7 of their deviations, and it was ok."""
    _, log = driven_log(scenario)
    t_s = 6.0
    shifted = log.columns[name] + px * ((log.t_s >= t_s) & (log.t_s < t_s + lasts_s))
    moved = replace(log, columns={**log.columns, name: shifted})
    tally = Tally(0.0126)
    rows = rows_from(moved)
    tally.add(Handover(setup_for(varied_drive(0)), Drive()).run(rows), None, rows.readings[:, :2])
    said = [finding.text for finding in jumped(tally)]
    if px and lasts_s > 2.0:
        assert [text.startswith(f"at {t_s:.1f} s the marker jumps") for text in said] == [True]
    else:
        assert not said

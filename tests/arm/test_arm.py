"""A bending arm under a pressure valve: truth recovered, trials held back, poses read, bad logs refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from armtrials import SCALE, TRUE, columns_of, simulated
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import calib.stages.arm.identify as identification
from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.io.columns import QUATERNION, is_arm_log, known_name
from calib.io.logs import Log, read_log
from calib.stages.arm.frame import check_frame, fit_frame, frame_findings, resample_trial
from calib.stages.arm.identify import (
    FULL,
    _coverage,
    angle_error,
    best_baseline,
    fit,
    fit_errors,
    gain_over_baseline,
    half_width,
    identify,
    mean_error,
    parameter_errors,
    residuals_by_pressure,
)
from calib.stages.arm.model import (
    COMPLIANCE,
    NO_JUMP_KPA,
    PARAMETERS,
    STEP_S,
    Assembly,
    Trial,
    data_scale,
    drive_run,
    load_bends,
    parameters_on_day,
    segment_run,
)
from calib.stages.arm.recording import read_recording
from calib.stages.arm.stage import _beside_black_boxes, _outlying_trials


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    """Two trials of each of two days."""
    days = (("a", 1.0), ("a", 1.0), ("b", 1.1), ("b", 1.1))
    return [simulated(f"{day}_{k}", k, day, gain=gain, duration_s=20.0) for k, (day, gain) in enumerate(days)]


def test_a_fit_predicts_trials_that_it_has_not_seen(trials: list[Trial]) -> None:
    made = fit(trials, FULL.without("creep", "load"), SCALE)
    unseen = parameter_errors(
        parameters_on_day("b", made.values, made.days), simulated("b_2", 7, "b", gain=1.1)
    )
    assert math.degrees(unseen["angle_rad"]) < 0.5
    assert unseen["chord_m"] < 5e-4
    assert abs(made.values["lag_s"] / TRUE["lag_s"] - 1.0) < 0.1
    bends = {day: factors["bends_rad_per_kpa"] for day, factors in made.days.items()}
    assert abs(bends["b"] / bends["a"] - 1.1) < 0.03


def test_an_identification_beats_black_boxes_and_says_by_how_much(trials: list[Trial]) -> None:
    found = identify(trials, compare=False)
    assert set(found.held) == {"a_0", "a_1", "b_2", "b_3"}
    mean, half = gain_over_baseline(found, best_baseline(found, "angle_rad"), "angle_rad")
    assert mean > 0.2
    assert half > 0.0
    assert found.coverage > 0.9
    assert found.sigma["lag_s"] > 0.0
    assert "load" not in found.fit.assembly.parts
    # What a trial is for, it tells: a mass the compliance and the more the heavier, venting the settling.
    left = found.prospects
    name = "compliance_rad_per_Nm"
    assert left["steps with 200 g"][name] < left["steps with 100 g"][name] < 0.95
    assert left["open-loop steps"][name] == pytest.approx(1.0, abs=0.01)
    assert left["a vented start"]["settling_s"] < left["rests of 10 s"]["settling_s"]
    assert all(0.0 < share <= 1.0 + 1e-9 for one in left.values() for share in one.values())


@pytest.mark.parametrize("toe_kpa", [0.0, 60.0])
def test_a_segment_alone_lags_behind_what_its_pressure_bends(toe_kpa: float) -> None:
    one = simulated("a", 1)
    off = FULL.without("creep", "hysteresis", "settling", "load").values(np.zeros(len(PARAMETERS)), SCALE)
    p = np.full(len(one.t_s), 100.0)
    angle, _ = segment_run(one, off | {"toe_kpa": toe_kpa}, p)
    drives = 100.0**2 / (100.0 + toe_kpa)
    rest = off["rest_rad"] + drives * off["bends_rad_per_kpa"] / (1.0 + 100.0 * off["stiffens_per_kpa"])
    expected = rest + (one.begins[1] - rest) * np.exp(-one.t_s / off["lag_s"])
    np.testing.assert_allclose(angle, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("jump_kpa", "drains_s", "fills_s"),
    [(25.0, 40.0 / (1.2 * 125.0), 40.0 / (125.0 * 0.9)), (NO_JUMP_KPA, 40.0 / (1.2 * 100.0), 40.0 / 100.0)],
)
def test_a_pilot_crosses_the_overlap_in_its_time(jump_kpa: float, drains_s: float, fills_s: float) -> None:
    """Of 20 kPa to either side, with an error of 100 kPa, at 1/s. At about the chamber's 120 kPa the pilot
    fills at psi(.60) = .9 of its rate from a supply of 270 kPa; that of earlier files fills at any pressure.
    """
    tight = dict.fromkeys(("leak_per_s", "line_to_chamber", "input_s"), 1e-6) | {"overlap_kpa": 20.0}
    pilot = {"pilot_per_s": 1.0, "pilot_drains": 1.2, "pilot_jump_kpa": jump_kpa, "supply_kpa": 270.0}
    n = 60
    trial = replace(simulated("a", 1), command=np.full(n, 20.0), pressure_kpa=np.full(n, 120.0))
    fast = TRUE | tight | pilot | {"opening_kpa": 1.0}
    # From where supply opens the pilot drains through the overlap before the exhaust opens.
    falls = float(np.argmax(drive_run(trial, fast) < 119.0)) * STEP_S
    assert falls == pytest.approx(drains_s, abs=0.03)
    # Drained half-way, it fills as far again.
    half = round(0.5 * drains_s / STEP_S)
    up = replace(trial, command=np.where(np.arange(n) < half, 20.0, 220.0))
    rises = float(np.argmax(drive_run(up, fast) > 121.0) - half) * STEP_S
    assert rises == pytest.approx(0.5 * fills_s, abs=0.03)


def test_a_pump_fills_until_its_flow_leaves_by_the_orifice() -> None:
    pump = {
        "delivers_per_s": 0.5,
        "dead_command": 40.0,
        "stalls_kpa": 60.0,
        "orifice_per_s": 0.2,
        "seeps_per_s": 0.1,
    }
    n, none = 3000, np.zeros(0)
    for command, delivers in ((30.0, 0.0), (200.0, 80.0)):
        trial = Trial("a", "a", 0.0, STEP_S * np.arange(n), np.full(n, command), none, none, none, pwm=True)
        kpa = drive_run(trial, pump)[-1]
        ratio = 101.3 / (kpa + 101.3)
        psi = math.sqrt(1.0 - ((ratio - 0.3) / 0.7) ** 2)
        leaves = 0.2 * (kpa + 101.3) * psi + 0.1 * kpa
        assert delivers * (1.0 - kpa / 60.0) == pytest.approx(leaves, rel=0.01, abs=0.1)
    # What it delivers is told by no angle; its size is that of the air.
    assert (
        data_scale([replace(trial, angle_rad=np.linspace(0.0, 0.5, n), chord_m=np.full(n, 0.2))]).pressure_kpa
        > 100.0
    )


def test_an_arm_of_some_inertia_swings_about_where_it_comes_to_rest() -> None:
    values = FULL.without("hysteresis", "creep", "load", "settling").values(np.zeros(len(PARAMETERS)), SCALE)
    n, none = 1500, np.zeros(0)
    t = STEP_S * np.arange(n)
    start = Trial("a", "a", 0.0, t, none, np.where(t < 1.0, 0.0, 100.0), np.full(3, 0.13), np.full(3, 0.17))
    still, _ = segment_run(start, values, start.pressure_kpa)
    swings, _ = segment_run(start, values | {"swings_s": 0.2, "damps": 0.03}, start.pressure_kpa)
    assert swings.max() > still.max() + 0.3 * (still.max() - still[0])
    assert swings[-1] == pytest.approx(still[-1], abs=1e-3)
    high = np.flatnonzero((swings[1:-1] > swings[:-2]) & (swings[1:-1] > swings[2:]) & (t[1:-1] > 1.5))[:3]
    assert np.diff(t[high]).mean() == pytest.approx(2.0 * math.pi * 0.2, rel=0.05)


def test_a_load_bends_an_upright_arm_further() -> None:
    plain, loaded = simulated("a", 1), simulated("a", 1, load_kg=0.2)
    assert loaded.angle_rad[1000:].mean() > plain.angle_rad[1000:].mean() + math.radians(0.5)


@pytest.mark.parametrize(
    ("upright", "across", "finer"), [(3.0, 0.0, 1.0), (-3.0, 0.0, 10.0), (0.0, 1.0, 1.0)]
)
def test_a_soft_arms_compliance_is_found_from_one_loaded_trial(
    upright: float, across: float, finer: float
) -> None:
    """Fifteen times the usual one, that of an arm that hangs, and of one that lies."""
    soft = {**TRUE, "compliance_rad_per_Nm": upright, "compliance_across_rad_per_Nm": across}
    trials = [simulated(f"a_{k}", k, load_kg=load, values=soft) for k, load in enumerate((0.0, 0.0, 0.1))]
    made = fit(trials, FULL, replace(SCALE, finer=finer))
    for angle_rad in (0.3, 0.5):
        found, true = (
            load_bends(angle_rad, *(of[name] for name in COMPLIANCE)) for of in (made.values, soft)
        )
        assert found == pytest.approx(true, rel=0.15)


def test_the_interval_of_one_more_trial_follows_from_the_errors_on_held_ones() -> None:
    rng = np.random.default_rng(0)
    trials = rng.normal(size=(4000, 4, 2))
    inside = [
        np.abs(one[-1] @ [[1.0, 1.0], [1.0, -1.0]]) <= half_width(np.hypot(*one[:-1].T).tolist())
        for one in trials
    ]
    # Three trials, each with an offset and a gain of its own, tell what a fourth does.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert half_width([0.1, 0.1, 3.0]) > 3.0 * math.sqrt(3.0)
    assert math.isnan(half_width([1.0]))


def test_the_interval_of_trials_without_a_command_is_that_of_their_pressure(trials: list[Trial]) -> None:
    """There was none."""
    quiet = [replace(one, command=np.zeros(0)) for one in trials]
    made = fit(quiet, FULL.without("creep", "load"), SCALE)
    errors = {one.name: fit_errors(made, one) for one in quiet}
    assert all(0.0 < angle_error(one) < math.radians(1.0) for one in errors.values())
    assert _coverage(quiet, dict.fromkeys(errors, made), errors) > 0.9


# ----------------------------------------------------------------------
# The file.


@pytest.mark.parametrize(("error_deg", "severity"), [(1.2, "remark"), (4.0, "poor")])
def test_a_trial_apart_is_poor_where_it_matters(error_deg: float, severity: str) -> None:
    """Of a range of 57 deg, and others that are predicted to 0.4 deg."""
    errors = {"a": error_deg, "b": 0.4, "c": 0.4, "d": 0.4}
    held = {name: {"angle_rad": math.radians(error)} for name, error in errors.items()}
    found = SimpleNamespace(held=held, fit=SimpleNamespace(scale=replace(SCALE, angle_rad=1.0)))
    (finding,) = _outlying_trials(found)
    assert finding.severity == severity
    assert finding.text.startswith(f"a is predicted to {error_deg:.1f} deg from the others")


@pytest.mark.parametrize(
    ("errors_deg", "severity"),
    [((6.6, 3.8, 0.7), "remark"), ((5.3, 5.0, 5.6), "poor"), ((1.0, 1.1, 0.9), "remark")],
)
def test_a_black_box_that_is_better_by_chance_is_no_fault(
    errors_deg: tuple[float, ...], severity: str
) -> None:
    """One trial of three is predicted far worse, another far better; or all of them worse."""
    deg = math.radians(1.0)
    held = {
        name: {"angle_by_pressure_rad": x * deg, "angle_rad": math.nan, "chord_m": math.nan}
        for name, x in zip("abc", errors_deg, strict=True)
    }
    box = {
        name: held["a"] | {"angle_by_pressure_rad": x * deg}
        for name, x in zip("abc", (3.3, 2.9, 3.5), strict=True)
    }
    found = SimpleNamespace(held=held, others={"ARX 8 at 10 Hz": box}, fit=SimpleNamespace(scale=SCALE))
    (finding,) = _beside_black_boxes(found)
    assert finding.severity == severity


def test_an_arm_is_a_kind_of_actuator_in_the_file() -> None:
    small = Assembly(("lag", "segment", "chord"))
    section = {
        "kind": "pressure_arm",
        "parts": list(small.parts),
        "parameters": dict.fromkeys(small.names, 1.0),
    }
    rig = Rig.of({"schema": 2, "actuator": section | {"verdict": "ok"}}, "rig.yaml")
    assert rig.actuator is None
    assert rig.arm is not None
    assert "\nactuator:\n  kind: pressure_arm\n" in rig.text()
    before = Rig.of({"schema": 2, "arm": section | {"verdict": "ok"}}, "rig.yaml")
    assert before.text() == rig.text()
    old = Rig.of({"schema": 2, "arm": section | {"verdict": "ok", "days": {"a": 1.1}}}, "rig.yaml").arm
    assert old is not None
    assert old.parameters_on_day("a")["bends_rad_per_kpa"] == pytest.approx(1.1)
    assert old.parameters_on_day("another")["bends_rad_per_kpa"] == pytest.approx(1.1)
    fewer = {name: 2.0 for name in small.names if not name.startswith("lengthens")}
    old = Rig.of({"schema": 2, "arm": section | {"verdict": "ok", "parameters": fewer}}, "rig.yaml").arm
    assert old is not None
    assert old.parameters == fewer
    assert (old.parameters_on_day("a")["lengthens_s"], old.parameters_on_day("a")["lengthens_per_kpa"]) == (
        1.0,
        0.0,
    )
    names = [name for name in ("valve", *small.parts) if name != "lag"]
    # Twice without a load, as one rig must not change how another is read.
    for parts in (names, [*names, "load"], names):
        later = {"input_s", "pilot_jump_kpa", "compliance_across_rad_per_Nm"}
        plain = dict.fromkeys(set(Assembly(tuple(parts)).names) - later, 2.0)
        of = section | {"verdict": "ok", "parts": parts, "parameters": plain}
        old = Rig.of({"schema": 2, "arm": of}, "rig.yaml").arm
        assert old is not None
        assert old.parameters_on_day("a")["pilot_jump_kpa"] == NO_JUMP_KPA
        assert old.parameters_on_day("a")["compliance_across_rad_per_Nm"] == 0.0
    with pytest.raises(BadInputError, match=r"expected factors of .*bends_rad_per_kpa, not of lag_s"):
        Rig.of({"arm": section | {"verdict": "ok", "days": {"a": {"lag_s": 1.1}}}}, "rig.yaml")
    with pytest.raises(BadInputError, match="actuator is a pressure_arm and there is an arm"):
        Rig.of({"actuator": section, "arm": section}, "rig.yaml")
    with pytest.raises(BadInputError, match=r"rig\.yaml: actuator.*expected one part of valve, lag, pump"):
        Rig.of(
            {"schema": 2, "actuator": section | {"verdict": "ok", "parts": ["segment", "chord"]}}, "rig.yaml"
        )


# ----------------------------------------------------------------------
# Logs.


def _log(columns: dict[str, FloatArray], trial: Trial) -> Log:
    return Log("a.csv", trial.t_s, columns, np.arange(len(trial.t_s)) + 2)


def _from(
    row: int, columns: dict[str, FloatArray], trial: Trial
) -> tuple[FloatArray, dict[str, FloatArray], IntArray]:
    """Time, columns and line numbers of a log from a row on."""
    rows = slice(row, None)
    return trial.t_s[rows], {k: v[rows] for k, v in columns.items()}, np.arange(len(trial.t_s))[rows] + 2


def _turned(columns: dict[str, FloatArray], turn: Rotation, conjugated: bool) -> dict[str, FloatArray]:
    """The same arm in a world whose axes are others."""
    out = dict(columns)
    for of in ("base", "tip"):
        place = turn.apply(np.stack([columns[f"{of}_{k}_m"] for k in "xyz"], axis=1))
        read = Rotation.from_quat(np.stack([columns[f"{of}_q{k}"] for k in "xyzw"], axis=1))
        read = read * turn.inv() if conjugated else turn * read
        out |= {f"{of}_{k}_m": column for k, column in zip("xyz", place.T, strict=True)}
        out |= {f"{of}_q{k}": column for k, column in zip("xyzw", read.as_quat().T, strict=True)}
    return out


def _mounted(columns: dict[str, FloatArray], mount: Rotation, conjugated: bool) -> dict[str, FloatArray]:
    """The same with the tip's body turned against its link."""
    read = Rotation.from_quat(np.stack([columns[f"tip_q{k}"] for k in "xyzw"], axis=1))
    read = mount.inv() * read if conjugated else read * mount
    return columns | {f"tip_q{k}": column for k, column in zip("xyzw", read.as_quat().T, strict=True)}


_ARMS = {
    # Turn of the world, of the tip's body against its link, and the share of the angle and of the bow.
    "as simulated": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0),
    "another world": ((2.0, -1.0, 1.5), (0.0, 0.0, 0.0), 1.0),
    "tip a little askew": ((0.2, -0.1, 0.3), (0.2, 0.1, 0.0), 1.0),
    "tip on its side": ((0.2, -0.1, 0.3), (1.6, 0.0, 0.0), 1.0),
    "tip backwards": ((0.0, 0.0, 0.0), (0.0, 0.0, 3.3), 1.0),
    "tip anyhow": ((2.0, -1.0, 1.5), (1.2, -0.5, 2.1), 1.0),
    "a stiff arm": ((0.2, -0.1, 0.3), (0.0, 0.0, 0.0), 0.12),
}


@pytest.mark.parametrize("case", list(_ARMS))
@pytest.mark.parametrize("conjugated", [False, True])
def test_plane_axis_and_convention_are_found(conjugated: bool, case: str) -> None:
    """Whatever the axes of world and tip are, everything is told in the frame of the base."""
    turn, mount, share = _ARMS[case]
    trial = simulated("a", 1)
    begin = 0.0 if np.linalg.norm(mount) < 1.0 else trial.begins[1]
    trial = replace(trial, angle_rad=share * trial.angle_rad)
    columns = _mounted(columns_of(trial, conjugated), Rotation.from_rotvec(mount), conjugated)
    columns = _turned(columns, Rotation.from_rotvec(turn), conjugated)
    recording = read_recording(_log(columns, trial), "a")
    frame = fit_frame([recording])
    assert frame.axis is not None
    assert frame.direction is not None
    assert abs(frame.axis[2]) > 0.999
    assert frame.direction[1] > 0.99
    assert frame.leans == pytest.approx(0.55, abs=0.02)
    assert frame.planar_deg < 1.0
    assert frame.conjugated == conjugated
    assert any("look conjugated" in one.text for one in frame_findings(frame)) == conjugated
    assert any("as it is mounted" in one.text for one in frame_findings(frame)) == (begin > 0.0)
    again = resample_trial(recording, frame, "a", 0.0)
    away = again.angle_rad - trial.angle_rad[: len(again.angle_rad)]
    # A mount's own turn about the axis cannot be told from a bend; one that is taken off is the pose at rest.
    np.testing.assert_allclose(away, np.mean(away), atol=2e-3)
    assert np.mean(away) == pytest.approx(-begin, abs=0.04)


@pytest.mark.parametrize("zero_rad", [0.0, 3.0])
def test_poses_in_the_plane_give_the_same_trial(zero_rad: float) -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial, planar=True)
    columns["tip_phi_rad"] = np.remainder(columns["tip_phi_rad"] + zero_rad + np.pi, 2.0 * np.pi) - np.pi
    recording = read_recording(_log(columns, trial), "a")
    again = resample_trial(recording, fit_frame([recording]), "a", 0.0)
    away = again.angle_rad - trial.angle_rad[: len(again.angle_rad)]
    np.testing.assert_allclose(away, np.mean(away), atol=2e-3)
    assert np.mean(away) == pytest.approx(-trial.begins[1] if zero_rad else 0.0, abs=0.04)
    np.testing.assert_allclose(again.chord_m, trial.chord_m[: len(again.chord_m)], atol=2e-4)


@pytest.mark.parametrize("planar", [False, True])
def test_an_arm_that_rolls_up_most_of_a_turn_is_read_whole(planar: bool) -> None:
    """One that is at rest for most of a log, so that the mean is far from the middle of the range."""
    trial = simulated("a", 1)
    since = trial.t_s % 20.0
    bent = np.where(since < 15.0, 0.0, np.sin(np.pi * (since - 15.0) / 5.0) ** 2)
    trial = replace(trial, command=bent, pressure_kpa=200.0 * bent, angle_rad=4.5 * bent)
    recording = read_recording(_log(columns_of(trial, planar=planar), trial), "a")
    again = resample_trial(recording, fit_frame([recording]), "a", 0.0)
    np.testing.assert_allclose(again.angle_rad, trial.angle_rad[: len(again.angle_rad)], atol=2e-3)


def test_frozen_channels_and_jumps_are_findings() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    columns["tip_qz"] = columns["tip_qz"].copy()
    columns["tip_qz"][700] += 0.02
    recording = read_recording(_log(columns, trial), "a")
    texts = [one.text for one in recording.findings]
    assert any("p2_kpa, p3_kpa never change" in text for text in texts)
    assert any("1 poses are left out" in text for text in texts)
    assert recording.turned is not None
    assert np.flatnonzero(np.isnan(recording.turned[0, :, 0])).tolist() == [700]
    assert any("line 702: motion capture jumps by 2." in text for text in texts)
    fast = columns_of(replace(trial, angle_rad=0.4 + 0.4 * np.sin(5.0 * trial.t_s)))
    assert "jumps" not in _findings(fast, trial)


def _findings(columns: dict[str, FloatArray], trial: Trial) -> str:
    return "; ".join(
        f"{one.severity}: {one.text}" for one in read_recording(_log(columns, trial), "a").findings
    )


@pytest.mark.parametrize(
    ("column", "least_s", "words"),
    [
        (
            "p1_kpa",
            5.0,
            "poor: a: its pressure stands still from 10.0 to 15.0 s while its command moves: frozen",
        ),
        (
            "p_cmd1_kpa",
            15.0,
            "poor: a: its command stands still from 10.0 to 25.2 s while its pressure moves",
        ),
        ("tip", 5.0, "poor: a: its pose stands still from 10.0 to 15.0 s while its command moves: frozen"),
    ],
)
def test_a_signal_that_freezes_while_others_move_is_told(column: str, least_s: float, words: str) -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    assert "frozen" not in _findings(columns | {"p2_kpa": trial.t_s, "p3_kpa": trial.t_s}, trial)
    rows = slice(500, 501 + round(50 * least_s))
    for name in columns:
        if name.startswith(column):
            columns[name] = columns[name].copy()
            columns[name][rows] = columns[name][500]
    assert words in _findings(columns, trial)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_pressure_that_rests_in_the_dead_zone_of_its_pump_is_sound(share: float) -> None:
    """Or at the end of the supply; one that rests over the whole range of the command is frozen."""
    trial = simulated("a", 1)
    ramp = 1.0 - np.abs(1.0 - trial.t_s % 20.0 / 10.0)
    pressure = np.clip((ramp - 0.4) / 0.6, 0.0, 1.0) if share == 0.0 else np.minimum(ramp, 0.6)
    pressure = np.round(100.0 * pressure, 1)
    angle = 0.005 * pressure + 1e-6 * trial.pressure_kpa
    rests = replace(trial, command=200.0 * ramp, pressure_kpa=pressure, angle_rad=angle)
    assert "stands still" not in _findings(columns_of(rests), rests)
    still = np.where((trial.t_s > 20.0) & (trial.t_s < 30.0), share * 60.0, pressure)
    assert "pressure stands still" in _findings(columns_of(replace(rests, pressure_kpa=still)), rests)


@pytest.mark.parametrize(("falls_s", "frozen"), [(10.0, False), (25.0, True)])
def test_an_arm_that_settles_slowly_under_a_held_command_is_sound(falls_s: float, frozen: bool) -> None:
    trial = simulated("a", 1)
    t, noise = trial.t_s, trial.pressure_kpa
    moves = np.exp(-np.maximum(t - falls_s, 0.0) / 10.0) + 1e-6 * noise
    settles = replace(
        trial, command=np.where(t < 10.0, 200.0, 7.0), pressure_kpa=200.0 * moves, angle_rad=0.5 * moves
    )
    assert ("command stands still" in _findings(columns_of(settles), settles)) == frozen


def test_an_arm_that_settles_after_its_pressure_is_gone_is_sound() -> None:
    trial = simulated("a", 1)
    since = trial.t_s % 20.0
    pressure = np.where(since < 10.0, 40.0, np.maximum(40.0 * np.exp((10.0 - since) / 0.3) - 0.5, 0.0))
    lag = math.exp(-STEP_S / 3.0)
    angle = lfilter([1.0 - lag], [1.0, -lag], pressure / 40.0)
    vented = replace(trial, command=np.where(since < 10.0, 40.0, 0.0), pressure_kpa=pressure, angle_rad=angle)
    assert "poor" not in _findings(columns_of(vented), vented)


def test_a_command_that_nobody_knows_and_a_place_that_jumps_are_told() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    columns["p_cmd1_kpa"] = np.where(np.abs(trial.t_s - 20.0) < 2.0, np.nan, trial.command)
    columns["tip_y_m"] = columns["tip_y_m"] + 0.02 * (trial.t_s > 30.0)
    said = _findings(columns, trial)
    assert "poor: a: has no command from 18.0 to 22.0 s, which a free run needs" in said
    changes = np.diff(trial.command, prepend=np.nan) != 0.0
    sparse = columns_of(trial) | {"p_cmd1_kpa": np.where(changes, trial.command, np.nan)}
    assert "has no command" not in _findings(sparse, trial)
    assert "line 1503: motion capture jumps by 20" in said


def test_poses_that_were_not_seen_do_not_count() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial, planar=True)
    gone = np.abs(trial.t_s - 20.0) < 5.0
    columns["tip_phi_rad"] = np.where(gone, np.nan, columns["tip_phi_rad"])
    recording = read_recording(_log(columns, trial), "a")
    again = resample_trial(recording, fit_frame([recording]), "a", 0.0)
    assert again.unseen is not None
    assert again.unseen.sum() == pytest.approx(gone.sum(), abs=2)
    off = residuals_by_pressure(again, TRUE)["angle_rad"]
    assert len(off) == len(again.t_s) - again.unseen.sum()
    assert np.sqrt(np.mean(off**2)) < 5e-3


def test_an_arm_that_bends_to_negative_angles_is_the_same_arm() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial, planar=True)
    columns |= {"tip_phi_rad": -columns["tip_phi_rad"], "tip_x_m": 0.1 - columns["tip_x_m"]}
    columns |= {"base_x_m": np.full(len(trial.t_s), 0.1), "base_y_m": np.zeros(len(trial.t_s))}
    recording = read_recording(_log(columns, trial), "a")
    frame = fit_frame([recording])
    assert [one.text for one in frame_findings(frame)] == [
        "tip_phi_rad falls as the arm bends; the angle is counted as it grows with bending"
    ]
    again = resample_trial(recording, frame, "a", 0.0)
    np.testing.assert_allclose(again.angle_rad, trial.angle_rad[: len(again.angle_rad)], atol=2e-3)
    np.testing.assert_allclose(again.chord_m, trial.chord_m[: len(again.chord_m)], atol=2e-4)
    # A log that begins where the arm is bent most grows the same way.
    later = Log("a.csv", *_from(int(np.argmax(trial.angle_rad)), columns, trial))
    assert fit_frame([read_recording(later, "a")]).grows == -1.0
    # Beside poses that turn about some axis of their own it is the same arm too.
    poses = read_recording(_log(columns_of(trial), trial), "b")
    both = resample_trial(recording, fit_frame([poses, recording]), "a", 0.0)
    np.testing.assert_allclose(both.angle_rad, again.angle_rad)


def test_poses_about_another_axis_than_the_arms_are_refused() -> None:
    trial = simulated("a", 1)
    right, conjugated = (read_recording(_log(columns_of(trial, one), trial), "a") for one in (False, True))
    check_frame([right], fit_frame([right]))
    with pytest.raises(BadInputError, match="turns about an axis 180 deg from that of the arm"):
        check_frame([conjugated], fit_frame([right]))


@pytest.mark.slow
def test_an_arm_that_follows_its_pressure_closely_is_known_as_well() -> None:
    """Without creep, stops and stiffening: the usual errors would hold parameters at their priors."""
    plain = FULL.without("creep", "hysteresis", "settling", "load", "stiffening")
    true = plain.values(np.zeros(len(PARAMETERS)), SCALE) | {"lag_s": 1.0, "bends_rad_per_kpa": 0.004}
    trials = [replace(simulated(f"a_{k}", k, values=true), command=np.zeros(0)) for k in range(3)]
    found = identify(trials, compare=False)
    assert math.degrees(mean_error(found.held, "angle_by_pressure_rad")) < 0.3
    assert found.fit.scale.finer == 10.0
    assert found.coverage > 0.9
    assert found.fit.values["bends_rad_per_kpa"] == pytest.approx(0.004, rel=0.03)
    assert found.fit.values["lag_s"] == pytest.approx(1.0, rel=0.05)
    assert found.fit.values["stiffens_per_kpa"] < 2e-4


def test_a_trial_that_is_far_off_whatever_the_parts_outweighs_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trials = [SimpleNamespace(name=name) for name in "abcd"]
    monkeypatch.setattr(
        identification, "fit_errors", lambda e, _: {"angle_by_pressure_rad": e, "angle_rad": e}
    )
    plain, more = ({"a": 0.35} | dict.fromkeys("bcd", error) for error in (0.05, 0.02))
    assert identification._mean_held_error(trials, more) < 0.8 * identification._mean_held_error(
        trials, plain
    )


@pytest.mark.slow
def test_an_arm_that_first_takes_up_slack_has_a_toe() -> None:
    plain = FULL.without("load")
    values = plain.values(np.zeros(len(PARAMETERS)), SCALE)
    trials = [simulated(f"a_{k}", k, values=values | {"toe_kpa": 200.0}) for k in range(3)]
    found = identify(trials, compare=False)
    assert "toe" in found.fit.assembly.parts
    without = mean_error(found.others["without toe"], "angle_by_pressure_rad")
    assert mean_error(found.held, "angle_by_pressure_rad") < 0.8 * without


def test_a_chamber_lengthens_the_chord_with_its_pressure_before_the_arm_bends() -> None:
    start = simulated("a", 1)
    one = replace(start, pressure_kpa=np.zeros(len(start.t_s)))
    off = FULL.without("settling", "load").values(np.zeros(len(PARAMETERS)), SCALE)
    p = np.full(len(one.t_s), 100.0)
    p[0] = 0.0
    (angle, chord), (same, longer) = (
        segment_run(one, off | {"extends_m_per_kpa": extends}, p) for extends in (0.0, 1e-4)
    )
    np.testing.assert_allclose(same, angle)
    expected = 1e-2 * (1.0 - np.exp(-one.t_s / off["fill_s"]))
    np.testing.assert_allclose((longer - chord)[1:], expected[:-1], atol=1e-9)


@pytest.mark.slow
def test_an_arm_that_its_pressure_lengthens_has_an_extension() -> None:
    """5 % of the chord at the greatest pressure, as of an arm of plain silicone."""
    extends = 0.05 * SCALE.chord_m / SCALE.pressure_kpa
    values = FULL.without("load").values(np.zeros(len(PARAMETERS)), SCALE) | {"extends_m_per_kpa": extends}
    found = identify([simulated(f"a_{k}", k, values=values) for k in range(3)], compare=False)
    assert found.fit.values["extends_m_per_kpa"] == pytest.approx(extends, rel=0.1)
    assert mean_error(found.held, "chord_m") < 0.5 * mean_error(found.others["without extension"], "chord_m")


@pytest.mark.slow
def test_a_regulator_that_follows_its_command_is_a_lag() -> None:
    follows = FULL.without("creep", "load").driven_by("lag")
    true = follows.values(np.full(len(PARAMETERS), 0.3), SCALE)
    found = identify([simulated(f"a_{k}", k, values=true) for k in range(3)], compare=False)
    assert "lag" in found.fit.assembly.parts
    by_valve = mean_error(found.others["a valve for the lag"], "angle_rad")
    assert mean_error(found.held, "angle_rad") < 0.8 * by_valve


def test_units_that_no_arm_has_are_told() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    lengths = {name: 1e3 * columns[name] for name in columns if name.endswith("_m")}
    with pytest.raises(BadInputError, match="m apart, expected at most 3; columns"):
        read_recording(_log(columns | lengths, trial), "a")
    degrees = columns_of(trial, planar=True)
    degrees["tip_phi_rad"] = np.degrees(degrees["tip_phi_rad"])
    with pytest.raises(BadInputError, match=r"tip_phi_rad reaches .* rad, expected at most 6\.28; columns"):
        read_recording(_log(degrees, trial), "a")
    for factor, words in ((1e3, "columns.yaml takes Pa"), (0.01, "kPa at most, as bar would")):
        pressures = {name: factor * columns[name] for name in columns if name.endswith("_kpa")}
        try:
            said = [one.text for one in read_recording(_log(columns | pressures, trial), "a").findings]
        except BadInputError as error:
            said = [str(error)]
        assert any(words in text for text in said)
    assert "as psi would" not in _findings(columns, trial)
    for name, factor, words in (
        ("p1_kpa", 0.145, "as psi would"),
        ("p1_kpa", 0.01, "its pressure is 2.51 kPa at most, as bar would"),
        ("p_cmd1_kpa", 0.01, "its command is 2.7 kPa at most, as bar would"),
    ):
        assert words in _findings(columns | {name: factor * columns[name]}, trial)


def test_pressures_from_vacuum_are_told() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    assert "vacuum" not in _findings(columns, trial)
    # One that nobody vents and that stays below its command need not.
    held = replace(trial, pressure_kpa=102.0 + 0.4 * trial.pressure_kpa)
    assert "vacuum" not in _findings(columns_of(held), held)
    assert "poor: a: its pressure is 10" in _findings(columns | {"p1_kpa": columns["p1_kpa"] + 101.3}, trial)


def test_poses_of_zeros_were_not_seen() -> None:
    trial = simulated("a", 1)
    columns = {name: column.copy() for name, column in columns_of(trial).items()}
    for name in columns:
        if name.startswith("tip_"):
            columns[name][300:320] = 0.0
    recording = read_recording(_log(columns, trial), "a")
    assert recording.turned is not None
    assert np.flatnonzero(np.isnan(recording.turned[0]).any(axis=1)).tolist() == list(range(300, 320))
    assert "jumps" not in "; ".join(one.text for one in recording.findings)


def test_base_and_tip_that_are_swapped_are_told() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial, conjugated=True)
    other = {"base": "tip", "tip": "base"}
    swapped = {
        f"{other[of]}_{rest}": columns[name]
        for name in columns
        for of, _, rest in [name.partition("_")]
        if of in other
    }
    found = frame_findings(fit_frame([read_recording(_log(columns | swapped, trial), "a")]))
    assert any("1.55 of the tip's angle, expected about half of it" in one.text for one in found)


def test_quaternions_in_another_order_are_told() -> None:
    trial = simulated("a", 1)
    columns = columns_of(trial)
    for of in ("base", "tip"):
        w, x, y, z = (columns[f"{of}_q{k}"] for k in "wxyz")
        columns |= {f"{of}_q{k}": q for k, q in zip("wxyz", (x, y, z, w), strict=True)}
    found = frame_findings(fit_frame([read_recording(_log(columns, trial), "a")]))
    assert any("order of the quaternions" in one.advice for one in found)


def test_what_is_no_single_driven_arm_is_refused() -> None:
    trial = simulated("a", 1)
    both = columns_of(trial) | {"p_cmd2_kpa": trial.command}
    with pytest.raises(BadInputError, match=r"p_cmd1_kpa, p_cmd2_kpa change, expected one .* one is driven"):
        read_recording(_log(both, trial), "a")
    # A sensor of a chamber that nobody drives is noisy.
    noise = 0.05 * np.random.default_rng(0).normal(size=len(trial.t_s))
    uncommanded = {name: one for name, one in columns_of(trial).items() if name != "p_cmd1_kpa"}
    recording = read_recording(_log(uncommanded | {"p2_kpa": noise}, trial), "a")
    assert np.array_equal(recording.pressure, trial.pressure_kpa)
    bad = columns_of(trial)
    bad["tip_qw"] = 2.0 * bad["tip_qw"]
    with pytest.raises(BadInputError, match=r"line 2: the quaternion tip_qw, \.\.\. has norm 1\.9"):
        read_recording(_log(bad, trial), "a")


def test_pressures_are_read_by_their_unit(tmp_path: Path) -> None:
    assert known_name("p1_psi") == ("p1_kpa", "psi")
    assert known_name("P_cmd2 (bar)") == ("p_cmd2_kpa", "bar")
    assert known_name("p1") is None
    assert known_name("base_x_mm") == ("base_x_m", "mm")
    assert known_name("tip phi [deg]") == ("tip_phi_rad", "deg")
    assert known_name("tip_x") is None
    assert is_arm_log(["t_s", "p1_kpa"]) and is_arm_log(["t_s", "pwm2", *QUATERNION])
    assert not is_arm_log(["t_s", "pwm1", "u_px", *QUATERNION]) and not is_arm_log(["pwm1", "tip_x_m"])
    rows = "\n".join(f"{0.01 * k:.2f},{k % 7}" for k in range(40))
    (tmp_path / "a.csv").write_text(f"t_s,p1_psi\n{rows}\n", encoding="utf-8")
    assert read_log(tmp_path / "a.csv").columns["p1_kpa"][1] == pytest.approx(6.894757)


# ----------------------------------------------------------------------
# A real arm.


@pytest.mark.slow
def test_held_trials_of_a_real_arm_are_predicted_better_than_by_arx(shared_data: Path) -> None:
    folder = shared_data / "softarm"
    names = ["1006_1", "1006_4", "1006_7", "1009_1", "1009_4"]
    recordings = [read_recording(read_log(folder / f"{name}.csv"), name) for name in names]
    frame = fit_frame(recordings)
    assert frame.conjugated
    assert 0.53 < frame.leans < 0.57
    trials = [resample_trial(r, frame, r.name[:4], 0.2 if r.name == "1009_4" else 0.0) for r in recordings]
    found = identify(trials, compare=False)
    for quantity in ("angle_rad", "chord_m", "angle_by_pressure_rad"):
        mean, _ = gain_over_baseline(found, best_baseline(found, quantity), quantity)
        assert mean > 0.2, quantity

"""Identification: truth recovered within its sigma, what cannot be told named, logs and tracks."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import SIGMA, log_file, rig_file, track, varied

import calib
from calib.core.errors import BadInputError
from calib.core.options import PoseOptions
from calib.core.rig import Rig
from calib.core.stage import Files
from calib.io.experiments import EXPERIMENTS
from calib.io.logs import Log, read_log, write_log
from calib.stages.actuator import verdict
from calib.stages.actuator.identify import (
    PARAMETERS,
    Problem,
    Solution,
    Start,
    Track,
    _coarse,
    _left,
    _spread,
    _whole,
    _without_creep,
    colour_of,
    first_guess,
    fit_tracks,
    head_of,
    heads_of,
    jacobian,
    made,
    residuals,
    solve,
    start_of,
    values_of,
)
from calib.stages.actuator.identify_pump import Shape, fit_static_map
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import Orifice, RateLimit
from calib.stages.actuator.read import let_go, read_track, start_in_motion
from calib.stages.actuator.springs import fit_stiffness
from calib.stages.actuator.swing import decrement
from calib.stages.actuator.uncertainty import held_back, prospects, uncertainty
from calib.stages.actuator.validate import IMPROVED, ORIGINAL, compare
from calib.stages.actuator.verdict import Moved, by_logs, crossed, judge, moved_camera, own_delays, pump_delay
from calib.twin.rig import SimulatedRig

TRUTH = {
    "stiffness_scale": 1.15,
    "damping_scale_free_swing": 2.8,
    "bending_N_per_rad2": 0.2,
    "lambda1_per_s": 2.5,
    "lambda2_N_per_m": 12.0,
}


def test_swings_without_noise_give_the_truth() -> None:
    tracks = [track("free", TRUTH, phi, noise=0.0) for phi in (0.5, -0.35)]
    found = fit_tracks(Machine(), tracks)
    for name, value in TRUTH.items():
        assert found.values[name] == pytest.approx(value, rel=0.01), name
    assert found.fixed == {"lambda3": "creep lambda2 and creep lambda3 enter only as a product; kept at -1"}
    assert found.agreeing >= 1


@pytest.mark.slow
def test_pumps_without_noise_give_the_truth() -> None:
    truth = {
        "lag_s": 0.6,
        "strength1": 1.05,
        "strength2": 0.95,
        "falling_N_per_s": 0.45,
        "bending_N_per_rad2": 0.2,
    }
    tracks = [
        track("prbs", truth, noise=0.1, duration_s=8.0),
        track("steps", truth, noise=0.1, duration_s=8.0),
    ]
    found = fit_tracks(Machine(), tracks)
    for name, value in truth.items():
        assert found.values[name] == pytest.approx(value, rel=0.03), name


def test_a_search_leaves_what_is_known_where_it_is() -> None:
    """Mass and rest length went 14 and 19 deviations off, along a valley in which no fit came back."""
    names = ("mass_kg", "rest_length_m", "stiffness_scale", "lag_s", "lag_ratio")
    problem = Problem(Machine(), [track("prbs")], names, {}, stated={"mass_kg": 1.66e-4})
    coarse, known = _coarse(problem), values_of(Machine())
    assert coarse.names == ("stiffness_scale", "lag_s") and coarse.rough
    spread = _spread(coarse, known)
    assert 0.02 < spread[:, 1].min() < 0.08 < 0.7 < spread[:, 1].max() < 1.5
    x = spread[3] + 1e-4
    whole = _whole(problem, coarse, x)
    assert whole[:5].tolist() == [known["mass_kg"], known["rest_length_m"], *x[:2], known["lag_ratio"]]
    assert np.array_equal(whole[5:], x[2:])
    of_log = problem.spans[0]
    fine = residuals(replace(problem, rough=True), whole[None])[0, of_log]
    assert fine == pytest.approx(residuals(coarse, x[None])[0, of_log])


def test_another_thing_in_place_of_the_marker_does_not_pull() -> None:
    tracks = []
    for seed, phi in enumerate((0.5, -0.35)):
        one = track("free", TRUTH, phi, noise=0.2, seed=seed)
        head = one.head.copy()
        head[np.random.default_rng(seed).integers(0, len(head), 5)] += [0.3, 0.01]
        tracks.append(replace(one, head=head))
    found = fit_tracks(Machine(), tracks)
    assert found.values["stiffness_scale"] == pytest.approx(1.15, rel=0.02)
    assert found.values["damping_scale_free_swing"] == pytest.approx(2.8, rel=0.05)


@pytest.fixture(scope="module")
def of_steps() -> Solution:
    """Two pumps alike, which never bend the rig."""
    return fit_tracks(Machine(), [track("steps", duration_s=8.0)])


def test_what_a_log_cannot_tell_is_named_and_fixed(of_steps: Solution) -> None:
    assert "bending_N_per_rad2" not in of_steps.values
    assert "the logs" in of_steps.fixed["bending_N_per_rad2"]
    assert "lag_s" in of_steps.values


def test_what_a_person_states_is_fixed_or_a_prior() -> None:
    tracks = [track("free", TRUTH, phi, seed=k) for k, phi in enumerate((0.5, -0.35))]
    nominal = replace(Machine(), plant=replace(Machine().plant, stiffness_scale=1.15))
    fixed = fit_tracks(nominal, tracks, stated={"stiffness_scale": 0.0})
    assert "stiffness_scale" not in fixed.values and "stiffness_scale" not in fixed.fixed
    free, tight = (
        uncertainty(fit_tracks(nominal, tracks, stated={"stiffness_scale": sigma})).sigma
        for sigma in (10.0, 1e-5)
    )
    assert tight["stiffness_scale"] == pytest.approx(1e-5, rel=0.02)
    assert tight["stiffness_scale"] < 0.1 * free["stiffness_scale"]
    # A swing tells ratios to the moment of inertia, of which the mass makes m l0^2 / 4.
    doubt = fit_tracks(nominal, tracks, stated={"mass_kg": 0.05 * 0.0166})
    table = uncertainty(doubt)
    assert table.sigma["mass_kg"] == pytest.approx(0.05 * 0.0166, rel=0.05)
    turning = 0.25 * nominal.plant.mass_kg * nominal.plant.rest_length_m**2
    share = turning / (turning + nominal.plant.inertia_kgm2)
    doubted = math.hypot(0.05 * share, PARAMETERS["inertia_kgm2"].share * (1.0 - share))
    assert table.sigma["stiffness_scale"] == pytest.approx(1.15 * doubted, rel=0.05)
    both = [doubt.problem.names.index(name) for name in ("mass_kg", "stiffness_scale")]
    assert table.correlation[both[0], both[1]] == pytest.approx(0.05 * share / doubted, abs=0.02)


NAMES = (
    "stiffness_scale",
    "damping_scale_free_swing",
    "bending_N_per_rad2",
    "lambda1_per_s",
    "lag_s",
    "strength1",
)


def _problem() -> Problem:
    tracks = [track("free", duration_s=1.5), track("prbs", duration_s=1.5), track("steps", duration_s=1.5)]
    return Problem(Machine(), tracks, NAMES, {})


def test_derivatives_are_those_of_the_residuals() -> None:
    problem = _problem()
    x = first_guess(problem, values_of(Machine()))
    x[problem.unknowns.offset.start : problem.unknowns.starts[0].start] += 1e-3
    base, J = jacobian(problem, x)
    assert np.allclose(base, residuals(problem, x[None])[0], atol=1e-6)
    steps = 1e-4 * problem.unknowns.scale
    for k in range(len(x)):
        up, down = x.copy(), x.copy()
        up[k] += steps[k]
        down[k] -= steps[k]
        slope = (residuals(problem, up[None]) - residuals(problem, down[None]))[0] / (2.0 * steps[k])
        size = np.abs(slope).max()
        # A cubic between ticks is not smooth where the pumps' commands jump.
        assert np.abs(J[:, k] - slope).max() < 0.02 * size, k


def _cut(one: Track, from_s: float, moving: Start) -> Track:
    """The rest of a track from a tick on, begun in motion."""
    tick = round(from_s / one.tick_s)
    late = one.t_s >= tick * one.tick_s + 0.03
    return replace(
        one,
        pwm=one.pwm[tick:],
        t_s=one.t_s[late] - tick * one.tick_s,
        head=one.head[late],
        whitening=one.whitening[late],
        moving=moving,
    )


def test_a_log_in_motion_has_its_start_among_the_unknowns() -> None:
    moving = Start(0.1, 0.07, -0.5, 0.01, 0.02, -0.01, 0.5, 0.3, 0.4, 0.2)
    tracks = [track("free", duration_s=1.5), _cut(track("prbs", duration_s=2.5), 1.0, moving)]
    free = _cut(track("free", duration_s=2.5), 0.5, Start(0.1, 0.065, -2.0))
    problem = Problem(Machine(), [*tracks, free], NAMES, {})
    unknowns = problem.unknowns
    first = unknowns.starts[0].start
    assert [at.start - first for at in unknowns.starts] == [0, 2, 12]
    assert unknowns.size == first + 18
    x = first_guess(problem, values_of(Machine()))
    assert start_of(problem, x, 1) == moving
    assert start_of(problem, x, 2).dphi_radps == -2.0
    x[first:] += 1e-3 * unknowns.scale[first:]
    base, J = jacobian(problem, x)
    assert np.allclose(base, residuals(problem, x[None])[0], atol=1e-6)
    steps = 1e-3 * unknowns.scale
    for k in range(first, unknowns.size):
        up, down = x.copy(), x.copy()
        up[k] += steps[k]
        down[k] -= steps[k]
        slope = (residuals(problem, up[None]) - residuals(problem, down[None]))[0] / (2.0 * steps[k])
        assert np.abs(J[:, k] - slope).max() < 0.02 * np.abs(slope).max(), k


@pytest.mark.slow
def test_a_log_that_is_cut_out_of_a_longer_one_gives_the_same_parameters() -> None:
    values = {"stiffness_scale": 1.1, "lag_s": 0.6, "falling_N_per_s": 0.5, "strength2": 0.95}
    whole = track("prbs", values, duration_s=14.0)
    late = whole.t_s >= 4.03
    at = whole.t_s[late] - 4.0
    guess = start_in_motion(at - 0.025, whole.head[late], True, Machine().plant, SIGMA[0])
    assert guess is not None
    cut = _cut(whole, 4.0, guess)
    found = fit_tracks(Machine(), [cut], delay_s=0.025)
    known = uncertainty(found)
    for name, value in found.values.items():
        truth = values.get(name, values_of(Machine())[name])
        assert abs(value - truth) < 3.5 * known.sigma[name], name
    # Taken to begin at rest, the same rows give another rig, and stretches of them disagree on it.
    rest = fit_tracks(Machine(), [replace(cut, moving=None)], delay_s=0.025)
    sure = uncertainty(rest)
    off = {n: abs(v - values.get(n, values_of(Machine())[n])) / sure.sigma[n] for n, v in rest.values.items()}
    assert max(off.values()) < 3.5
    assert max(off[name] * sure.scatter[name] for name in off) > 6.0


def _coloured(one: Track, seed: int, memory: float = 0.9) -> Track:
    rng = np.random.default_rng(seed)
    e = rng.standard_normal((len(one.t_s), 2))
    for k in range(1, len(e)):
        e[k] = memory * e[k - 1] + np.sqrt(1.0 - memory**2) * e[k]
    return replace(one, head=one.head + np.array(SIGMA) * e)


@pytest.fixture(scope="module")
def solution() -> Solution:
    tracks = [track("free", phi_rad=phi, seed=k) for k, phi in enumerate((0.5, -0.4))]
    return fit_tracks(Machine(), tracks)


def test_coloured_residuals_raise_the_deviations(solution: Solution) -> None:
    tracks = [_coloured(track("free", phi_rad=phi, noise=0.0), k) for k, phi in enumerate((0.5, -0.4))]
    problem = replace(solution.problem, tracks=tracks)
    x, cost, residual, J = solve(problem, solution.x)
    again = replace(solution, problem=problem, x=x, cost=cost, residual=residual, J=J)
    assert max(uncertainty(again).inflation.values()) > 1.5
    assert not any(colour.white for colour in colour_of(again))


@pytest.mark.parametrize(("sharper", "severity"), [(1.0, "poor"), (20.0, "remark")])
def test_what_a_model_misses_counts_in_millimetres(solution: Solution, sharper: float, severity: str) -> None:
    """Of a camera that sees more than a Pixy2 residuals are many deviations, and little."""
    tracks = [replace(one, whitening=sharper * one.whitening) for one in solution.problem.tracks]
    problem, residual = replace(solution.problem, tracks=tracks), 4.0 * solution.residual
    unlike = replace(solution, problem=problem, residual=residual, J=sharper * solution.J)
    found = judge(unlike, uncertainty(unlike), colour_of(unlike), [], [])
    (one,) = (one for one in found.findings if "what the sensor's noise explains" in one.text)
    assert one.severity == severity


def test_residuals_that_last_for_seconds_count_as_few(
    solution: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the pumps have a play, which the model does not know."""
    slow = [np.sin(0.6 * np.pi * one.t_s)[:, None] * np.ones(2) for one in solution.problem.tracks]
    priors = np.zeros(len(solution.problem.unknowns.priors))
    lasting = replace(solution, residual=np.concatenate([*(one.ravel() for one in slow), priors]))
    raised = uncertainty(lasting).inflation
    monkeypatch.setattr("calib.stages.actuator.uncertainty._LONGEST_S", 0.0)
    briefly = uncertainty(lasting).inflation
    assert all(raised[name] >= briefly[name] for name in raised)
    assert max(raised[name] / briefly[name] for name in raised) > 1.3


def test_deviations_hold_what_logs_disagree_on(solution: Solution) -> None:
    """As where the damping is not of the model's law. It was 2.9 and 5.7 deviations off those of both."""
    assert max(uncertainty(solution).scatter.values()) == 1.0
    name, dampings = "damping_scale_free_swing", (2.8, 3.8)
    tracks = [
        track("free", {name: one}, phi, seed=k)
        for k, (one, phi) in enumerate(zip(dampings, (0.5, -0.4), strict=True))
    ]
    found = fit_tracks(Machine(), tracks)
    known = uncertainty(found)
    off = [abs(one - found.values[name]) / known.sigma[name] for one in dampings]
    assert max(off) < 2.0
    assert max(off) * known.scatter[name] > 5.0
    verdict = judge(found, known, colour_of(found), [], [])
    assert any("stretches of the logs disagree on it" in one.text for one in verdict.findings)


@pytest.mark.parametrize("every", [1, 4])
def test_commands_that_come_more_slowly_than_they_are_sent_are_told(every: int) -> None:
    whole = track("prbs")
    one = replace(whole, tick_s=every * whole.tick_s, pwm=whole.pwm[::every])
    names = ("damping_scale_pumps_connected", "lag_s", "strength1", "strength2")
    problem = Problem(Machine(), [one], names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    verdict = judge(found, uncertainty(found), colour_of(found), [], [])
    told = [one.text for one in verdict.findings if "its commands come every 66.7 ms" in one.text]
    assert len(told) == (every > 1)


def test_deviations_are_those_of_repeated_logs() -> None:
    """Of one rig: by what two rigs differ in length at rest and inertia does not scatter from log to log."""
    tracks = [track("free", phi_rad=phi, seed=k) for k, phi in enumerate((0.5, -0.4))]
    solution = fit_tracks(Machine(), tracks, stated={"rest_length_m": 0.0, "inertia_kgm2": 0.0})
    found = []
    for seed in range(12):
        tracks = [track("free", phi_rad=phi, seed=50 + 2 * seed + k) for k, phi in enumerate((0.5, -0.4))]
        found.append(solve(replace(solution.problem, tracks=tracks), solution.x, 10)[0])
    P = len(solution.problem.names)
    spread = np.std([x[:P] for x in found], axis=0, ddof=1)
    ratio = spread / np.array(list(uncertainty(solution).sigma.values()))
    # Twelve draws scatter by a fifth.
    assert np.all((ratio > 0.45) & (ratio < 1.7))


@pytest.mark.slow
def test_a_creep_that_is_not_there_is_left_at_none(tmp_path: Path) -> None:
    """Kept at its nominal 10 N/m the springs make up for it: 16 to 30 % off, 50 to 80 deviations."""
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    for seed in (0, 3):
        rig, truth = varied(seed)
        rig, tracks = replace(rig, plant=replace(rig.plant, creep=None)), []
        for k, phi in enumerate(("0.5", "-0.4")):
            path = log_file(tmp_path / f"{k}.csv", rig, "swing", 10 * seed + k, 8.0, phi_rad=phi)
            tracks.append(read_track(Files((path,), rig_yaml), path, known, Machine(), PoseOptions()))
        found = fit_tracks(Machine(), tracks)
        assert {**found.problem.held, **found.values}["lambda2_N_per_m"] < 0.2
        sigma = uncertainty(found).sigma
        for name in ("stiffness_scale", "damping_scale_free_swing", "bending_N_per_rad2", "rest_length_m"):
            assert abs(found.values[name] - truth[name]) < 3.0 * sigma[name], name


def test_a_creep_that_noise_makes_is_left_at_none() -> None:
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lambda1_per_s", "lambda2_N_per_m")
    problem = Problem(Machine(), [track("steps", {"lambda2_N_per_m": 0.0}, seed=1)], names, {})
    start = {**values_of(Machine()), "lambda1_per_s": 5.0, "lambda2_N_per_m": 0.1}
    x, cost, residual, J = solve(problem, first_guess(problem, start))
    noisy = Solution(problem, x, residual, J, cost, {}, 1, 1)
    assert noisy.values["lambda2_N_per_m"] == pytest.approx(0.9, abs=0.1)
    assert "no creep" in _without_creep(noisy).fixed["lambda2_N_per_m"]


def test_a_log_held_back_is_predicted_as_well_as_fitted(solution: Solution) -> None:
    held = held_back(solution)
    assert [h.name for h in held] == ["free", "free"]
    for h in held:
        assert h.held_phi_rad == pytest.approx(h.fitted_phi_rad, rel=0.1)
        assert h.fitted_phi_rad == pytest.approx(SIGMA[0], rel=0.15)
    alone = replace(solution, problem=replace(solution.problem, tracks=solution.problem.tracks[:1]))
    assert held_back(alone) == []


@pytest.mark.few(0, 2)
@pytest.mark.parametrize("other", [{}, {"stiffness_scale": 1.05}, {"lag_s": 0.8}])
def test_a_log_of_another_plant_is_contradicted_and_one_that_tells_more_is_not(
    other: dict[str, float],
) -> None:
    """Steps of both pumps alike move the length, so that they leave the angle of a prbs open by 5 mrad."""
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lag_s", "falling_N_per_s")
    problem = Problem(Machine(), [track("prbs"), track("steps", other, seed=1)], names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    held = held_back(found)
    verdict = judge(found, uncertainty(found), colour_of(found), held, [])
    contradicted = [one.text for one in verdict.findings if "the other logs contradict" in one.text]
    assert bool(contradicted) is bool(other)
    assert all((log.chance < 1e-6) is bool(other) for log in held)
    if not other:
        blamed = replace(held[0], held_phi_rad=3.0 * held[0].fitted_phi_rad)
        assert judge(found, uncertainty(found), colour_of(found), [blamed], []).word == "ok"


@pytest.mark.few(0, 2)
@pytest.mark.parametrize("ticks", [0, 1, 5, -5])
def test_commands_of_one_pump_that_come_late_are_named(ticks: int) -> None:
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lag_s", "lag_ratio", "falling_N_per_s")
    tracks = []
    for one in (track("prbs"), track("steps", seed=1)):
        pwm, pump = one.pwm.copy(), int(ticks < 0)
        at = np.maximum(np.arange(len(pwm)) - abs(ticks), 0)
        pwm[:, pump] = one.pwm[at, pump]
        tracks.append(replace(one, pwm=pwm))
    problem = Problem(Machine(), tracks, names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    delay = pump_delay(found)
    assert delay is not None
    late_s, sigma = delay
    named = [one.text for one in judge(found, uncertainty(found), colour_of(found), [], []).findings]
    named = [text for text in named if " as the rig answers them" in text]
    if ticks:
        assert late_s == pytest.approx(ticks / 60.0, rel=0.3)
        assert named[0].startswith("pwm1" if ticks > 0 else "pwm2")
    else:
        assert abs(late_s) < 4.0 * sigma
        assert not named


@pytest.mark.parametrize(
    ("name", "share"),
    [("stiffness_scale", 1.0), ("stiffness_scale", 1.2), ("rest_length_m", 1.0), ("rest_length_m", 0.93)],
)
def test_what_is_stated_is_held_against_the_logs(name: str, share: float) -> None:
    truth = values_of(Machine())[name]
    nominal = replace(Machine(), plant=replace(Machine().plant, **{name: share * truth}))
    names = ("damping_scale_pumps_connected", "lag_s", "falling_N_per_s", "strength2")
    problem = Problem(nominal, [track("prbs"), track("chirp", seed=2)], names, {}, stated={name: 0.0})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(nominal)))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    value, sigma = by_logs(found)[name]
    said = [one.text for one in judge(found, uncertainty(found), colour_of(found), [], []).findings]
    assert any(" in known, and about " in text for text in said) == (share != 1.0)
    assert abs(value - truth) < max(5.0 * sigma, 0.2 * abs(share - 1.0) * truth)


@pytest.mark.parametrize("share", [1.0, 0.9])
def test_what_is_known_with_a_deviation_is_held_against_the_fit(share: float) -> None:
    nominal = replace(Machine(), plant=replace(Machine().plant, rest_length_m=share * 0.065))
    names = ("rest_length_m", "damping_scale_pumps_connected", "lag_s", "strength2")
    problem = Problem(nominal, [track("prbs")], names, {}, stated={"rest_length_m": 3e-4})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(nominal)))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    said = [one.text for one in judge(found, uncertainty(found), colour_of(found), [], []).findings]
    assert any("length at rest is 0.0585 +- 0.0003 m beforehand" in text for text in said) == (share != 1.0)


@pytest.mark.parametrize(("full", "unit"), [(255.0, ""), (100.0, "unit: percent"), (1.0, "factor: 255")])
def test_commands_in_other_units_are_named(full: float, unit: str) -> None:
    tracks = [replace(one, pwm=one.pwm * full / 255.0) for one in (track("prbs"), track("chirp", seed=2))]
    problem = Problem(Machine(), tracks, ("stiffness_scale",), {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    fixed = dict.fromkeys(("strength1", "strength2"), "the logs do not depend on it")
    found = Solution(problem, x, residual, J, cost, fixed, 1, 1)
    verdict = judge(found, uncertainty(found), colour_of(found), [], [])
    assert any("below which the pumps give no force" in one.text for one in verdict.findings) == bool(unit)
    assert any("pwm1: {column: pwm1, " + unit in one.advice for one in verdict.findings) == bool(unit)


@pytest.mark.few(0, 1)
@pytest.mark.parametrize("swapped", [(), (1,), (0, 1)])
def test_pumps_that_are_swapped_are_named(swapped: tuple[int, ...]) -> None:
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lag_s", "falling_N_per_s")
    tracks = [track("prbs"), track("chirp", seed=2)]
    for k in swapped:
        tracks[k] = replace(tracks[k], pwm=tracks[k].pwm[:, ::-1].copy())
    problem = Problem(Machine(), tracks, names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    said = [one.text for one in judge(found, uncertainty(found), colour_of(found), [], []).findings]
    named = {text.partition(":")[0] for text in said if "bends away from the pump that pushes" in text}
    assert named == {tracks[k].name for k in swapped}


def test_a_controller_that_pushes_against_unlike_pumps_has_none_swapped() -> None:
    """The stronger pump bends the head, and is driven less: a model of like pumps bends the other way."""
    one = track("steps")
    pwm = np.where(one.t_s[:, None] < 2.5, 200.0 + np.array([3.0, -3.0]), 0.0)
    nominal, unlike = Machine(), Machine(strength=(0.9, 1.1))
    problem = Problem(nominal, [replace(one, pwm=pwm)], (), {})
    x = first_guess(problem, {})
    model, seen = (head_of(replace(problem, nominal=rig), x, 0) for rig in (nominal, unlike))
    assert np.corrcoef(model[:, 0], seen[:, 0])[0, 1] < -0.9
    problem = replace(problem, tracks=[replace(one, pwm=pwm, head=seen)])
    alike = crossed(Solution(problem, x, np.zeros(0), np.zeros((0, 0)), 0.0, {}, 1, 1))
    assert alike[one.name] > 0.9


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_pictures_late_in_one_log_alone_are_named(late_s: float) -> None:
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lag_s")
    tracks = [track("prbs"), track("steps", delay_s=0.025 + late_s)]
    problem = Problem(Machine(), tracks, names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    apart = {name: late / sigma for name, late, sigma in own_delays(found)}
    verdict = judge(found, uncertainty(found), colour_of(found), [], [])
    named = [one.text for one in verdict.findings if one.severity == "inconsistent"]
    if late_s:
        assert apart["steps"] > 20.0
        assert len(named) == 1
        assert "its pictures come" in named[0]
    else:
        assert max(map(abs, apart.values())) < 4.0
        assert verdict.word == "ok"


@pytest.mark.few(0, 3)
@pytest.mark.parametrize(("which", "from_s"), [(0, 2.0), (1, 1.5), (1, 0.0), (None, 0.0)])
def test_a_camera_that_moves_in_a_log_or_between_logs_is_named(which: int | None, from_s: float) -> None:
    tracks = [track("prbs"), replace(track("prbs", seed=1), name="other")]
    if which is not None:
        one = tracks[which]
        shift = np.array([0.01, -0.001]) * (one.t_s >= from_s)[:, None]
        tracks[which] = replace(one, head=one.head + shift)
    names = ("stiffness_scale", "damping_scale_pumps_connected", "lag_s", "bending_N_per_rad2")
    problem = Problem(Machine(), tracks, names, {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    verdict = judge(found, uncertainty(found), colour_of(found), [], [])
    said = [one for one in verdict.findings if "its pictures are shifted" in one.text]
    # Poses alone do not tell it from a pump that has lost a part of its strength midway.
    assert all("or a pump answers otherwise" in one.text and "the pumps" in one.advice for one in said)
    assert verdict.word == ("ok" if which is None else "inconsistent")
    assert len(said) == (which is not None)
    if which is not None:
        moved = moved_camera(found)
        assert moved is not None
        # Which of two logs stands apart as a whole nothing tells.
        assert not from_s or moved.name == tracks[which].name
        assert moved.from_s == pytest.approx(from_s, abs=0.2)
        assert abs(moved.length_m) == pytest.approx(1e-3, rel=0.2)


@pytest.mark.parametrize(("phi_rad", "length_m", "word"), [(1e-3, 5e-5, "ok"), (0.01, 5e-5, "inconsistent")])
def test_a_move_that_a_fine_camera_alone_sees_is_none(
    phi_rad: float, length_m: float, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = Problem(Machine(), [track("prbs")], ("stiffness_scale", "lag_s"), {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    moved = Moved("prbs", 1.0, phi_rad, length_m, readings=5.0, deviations=50.0)
    monkeypatch.setattr(verdict, "moved_camera", lambda _: moved)
    assert judge(found, uncertainty(found), colour_of(found), [], []).word == word


@pytest.mark.slow
def test_recovery_on_twenty_rigs(tmp_path: Path) -> None:
    """Noisy sensors: 95 % intervals cover the truth in 90 - 100 %, and all is within 3 sigma."""
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    z = []
    for seed in range(20):
        rig, truth = varied(seed)
        tracks = []
        for k, phi in enumerate(("0.5", "-0.4", "0.6")):
            path = log_file(tmp_path / f"{k}.csv", rig, "swing", 10 * seed + k, 8.0, phi_rad=phi)
            tracks.append(read_track(Files((path,), rig_yaml), path, known, Machine(), PoseOptions()))
        found = fit_tracks(Machine(), tracks)
        sigma = uncertainty(found).sigma
        assert set(found.fixed) == {"lambda3"}
        z += [(value - truth[name]) / sigma[name] for name, value in found.values.items()]
    inside = float(np.mean(np.abs(z) < 1.96))
    assert 0.9 <= inside <= 1.0
    assert np.abs(z).max() < 3.0


@pytest.mark.slow
def test_recovery_with_the_pumps_connected(tmp_path: Path) -> None:
    """All of the pumps' parameters beside the plant's, from two logs with commands.

    Stiffness and forces share one scale, which the length at rest is part of: errors are made independent.
    """
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    z = []
    for seed in range(4):
        rig, truth = varied(seed)
        tracks = []
        for k, (kind, duration_s) in enumerate((("prbs", 15.0), ("deflate", 12.0))):
            path = log_file(tmp_path / f"{kind}.csv", rig, kind, 10 * seed + k, duration_s)
            tracks.append(read_track(Files((path,), rig_yaml), path, known, Machine(), PoseOptions()))
        found = fit_tracks(Machine(), tracks)
        L = np.linalg.cholesky(uncertainty(found).covariance)
        assert {"lag_s", "strength1", "strength2", "falling_N_per_s"} <= set(found.values)
        z += np.linalg.solve(L, [value - truth[name] for name, value in found.values.items()]).tolist()
    assert np.mean(np.abs(z) < 1.96) >= 0.9
    assert np.abs(z).max() < 3.0


def test_an_orifice_is_found_from_springs_that_the_limited_rate_has_bent() -> None:
    """Under a limited rate the springs come out at .29 of the nominal, and the rate is not told."""
    known = Machine()
    true = replace(known, pump=replace(known.pump, deflation=Orifice(1.2, 0.001)))
    tracks = [track("prbs", duration_s=8.0, nominal=true), track("free", nominal=true)]
    found = fit_tracks(known, tracks, either_law=True)
    assert "air leaves by an orifice" in found.law
    assert found.values["stiffness_scale"] == pytest.approx(1.0, abs=0.02)
    assert found.values["laminar_s"] == pytest.approx(1.2, abs=0.03)
    said = [one.text for one in judge(found, uncertainty(found), colour_of(found), [], []).findings]
    untold = r"\(turbulent\) is .* \+- .*: these logs do not tell it from zero"
    assert any(re.search(untold, text) for text in said)


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        (RateLimit(0.35), 1),
        pytest.param(Orifice(0.9, 1.3), 1, marks=pytest.mark.slow),
        pytest.param(Orifice(0.9, 1.3), 3, marks=pytest.mark.slow),
    ],
)
def test_the_law_of_deflation_is_found(law: RateLimit | Orifice, seed: int, tmp_path: Path) -> None:
    """Seed 3 from the limited rate alone: springs of .26, turbulence of 4.2 +- .5."""
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    rig, _ = varied(seed)
    rig = replace(rig, pump=replace(rig.pump, deflation=law, lag_ratio=1.0))
    path = log_file(tmp_path / "deflate.csv", rig, "deflate", 1, 12.0)
    tracks = [read_track(Files((path,), rig_yaml), path, known, Machine(), PoseOptions())]
    found = fit_tracks(Machine(), tracks, either_law=True)
    assert type(found.problem.nominal.pump.deflation) is type(law)
    assert bool(found.law) is isinstance(law, Orifice)
    sigma = uncertainty(found).sigma
    for name in {*asdict(law)} & {*found.values}:
        assert abs(found.values[name] - asdict(law)[name]) < 3.5 * sigma[name], name
    assert {*asdict(law)} & {*found.values}


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "play", [{}, {"play_pwm": 18.0}, pytest.param({"play_N": 0.14}, marks=pytest.mark.slow)]
)
def test_a_play_is_found_where_there_is_one(play: dict[str, float], tmp_path: Path) -> None:
    rig_yaml = tmp_path / "rig.yaml"
    known = rig_file(rig_yaml)
    rig, truth = varied(5)
    rig = replace(rig, pump=replace(rig.pump, **play))
    kinds = {"ellipse": 16.0, "orientation": 16.0, "swing": 8.0}
    paths = [log_file(tmp_path / f"{kind}.csv", rig, kind, 1, span_s) for kind, span_s in kinds.items()]
    tracks = [read_track(Files((p,), rig_yaml), p, known, Machine(), PoseOptions()) for p in paths]
    found = fit_tracks(Machine(), tracks)
    sigma = uncertainty(found).sigma
    assert {"play_pwm", "play_N"} & {*found.values} == {*play}
    assert ("of the misfit" in found.law) is bool(play)
    for name, width in play.items():
        assert abs(found.values[name] - width) < 3.5 * sigma[name] < 0.2 * width
    for name in {*truth} & {*found.values}:
        assert abs(found.values[name] - truth[name]) < 3.5 * sigma[name], name


def test_rows_that_both_models_miss_say_nothing_of_either() -> None:
    problem = Problem(Machine(), [track("prbs")], ("stiffness_scale", "lag_s"), {})
    x, cost, residual, J = solve(problem, first_guess(problem, values_of(Machine())))
    found = Solution(problem, x, residual, J, cost, {}, 1, 1)
    worse, strays = 1.5 * residual, np.zeros_like(residual)
    strays[10:110:2] = 500.0
    seen = replace(found, residual=residual + strays)
    assert _left(problem, worse, found) > 1.5
    assert _left(problem, worse + strays, seen) == pytest.approx(_left(problem, worse, found), rel=0.05)
    # What the other model meets is counted.
    assert _left(problem, residual, seen) < 0.1
    # Where both miss most rows, the one that misses them by less is the better.
    off = np.zeros_like(residual)
    off[: problem.spans[-1].stop] = 100.0
    assert _left(problem, 0.5 * off, replace(found, residual=off)) == pytest.approx(0.5, rel=0.05)


@pytest.mark.few(1)
@pytest.mark.parametrize("tick_s", [0.01, 1.0 / 30.0])
def test_the_boards_tick_is_that_of_the_commands(tick_s: float, tmp_path: Path) -> None:
    known = rig_file(tmp_path / "rig.yaml")
    rig, truth = varied(7)
    rig = replace(rig, pump=rig.pump.at(tick_s))
    paths = [log_file(tmp_path / f"{kind}.csv", rig, kind, 1, 12.0) for kind in ("prbs", "ellipse")]
    known.actuator, known.pump = calib.identify(paths, known)
    assert known.pump.tick_s == known.machine.pump.tick_s == pytest.approx(tick_s, rel=1e-12)
    # Pictures are 25 ms late for whoever has no alignment; the commands' delay and that are one number.
    late_s = rig.pump.delay_ticks * tick_s + rig.tracker.latency_s - 0.025
    assert abs(known.pump.delay_ticks * tick_s - late_s) < 0.5 * tick_s + 2e-3
    assert abs(known.pump.lag_s - truth["lag_s"]) < 4.0 * known.pump.sigma["lag_s"]
    assert known.tick_hz == pytest.approx(1.0 / tick_s)


@pytest.mark.parametrize("kind", ["free", "prbs"])
def test_interpolated_heads_agree_with_fine_steps(kind: str) -> None:
    one = track(kind, noise=0.0)
    start = Start(0.5 if kind == "free" else 0.0, 0.065)
    head, rate = heads_of(one, [made(Machine(), {}, one.hoses, one.tick_s)], [start], 0.025)
    # The track's own values lie on straight lines between steps of 1.7 ms.
    assert np.abs(head[0] - one.head).max() < 3e-4
    later, _ = heads_of(one, [made(Machine(), {}, one.hoses, one.tick_s)], [start], 0.026)
    moved = (head - later) / 1e-3
    inner = (one.t_s > 0.1) & (one.t_s < one.t_s[-1] - 0.1)
    assert np.abs(moved - rate)[0, inner].max() < 0.05 * np.abs(rate).max()


def test_experiments_shrink_and_rest_does_not() -> None:
    """The camera's offset hides the length at rest in all logs alike, and its prior counts once."""
    tracks = [track("free", phi_rad=p, seed=k) for k, p in enumerate((0.5, -0.4))]
    found = fit_tracks(Machine(), tracks, stated=dict.fromkeys(("inertia_kgm2", "stiffness_scale"), 0.0))
    known = uncertainty(found)
    assert "rest_length_m" in found.values
    ahead = {p.name: p for p in prospects(found, known)}
    for name, value in found.values.items():
        now = known.sigma[name] / abs(value)
        for one in ahead.values():
            assert one.relative[name] <= now * 1.001
        assert ahead["static"].relative[name] == pytest.approx(now, rel=0.05)
    worst = [p.worst_relative for p in prospects(found, known)]
    assert worst == sorted(worst) and set(ahead) == set(EXPERIMENTS)


def test_what_could_not_be_told_is_what_is_asked_for(of_steps: Solution) -> None:
    best, *_, last = prospects(of_steps, uncertainty(of_steps))
    assert best.name in ("prbs", "chirp") and last.name == "static"
    assert best.relative["bending_N_per_rad2"] < 0.2


T = np.arange(480) / 60.0


def _swing(zeta: float = 0.05, hz: float = 4.0, offset: float = 0.0, phase_rad: float = 0.0) -> np.ndarray:
    w = 2.0 * np.pi * hz
    swing = 0.5 * np.exp(-zeta * w * T) * np.cos(w * np.sqrt(1.0 - zeta**2) * T + phase_rad)
    return swing + offset * np.exp(-T / 0.4)


@pytest.mark.parametrize("zeta", [0.01, 0.0513, 0.12])
def test_the_ratio_of_an_ideal_swing(zeta: float) -> None:
    found = decrement(T, _swing(zeta))
    assert found.zeta == pytest.approx(zeta, rel=0.03)
    assert found.frequency_hz == pytest.approx(4.0 * np.sqrt(1.0 - zeta**2), rel=0.01)


def test_sigma_covers_swings_that_a_log_begins_anywhere_in() -> None:
    rng = np.random.default_rng(0)
    phases = np.linspace(0.0, 2.0 * np.pi, 50, endpoint=False)
    noise = 2e-3 * rng.standard_normal((len(phases), len(T)))
    found = [decrement(T, _swing(phase_rad=phases[i]) + noise[i], 2e-3) for i in range(len(phases))]
    z = np.array([(one.zeta - 0.05) / one.sigma for one in found])
    assert np.mean(np.abs(z) < 2.0) > 0.9
    assert abs(z.mean()) < 0.5
    np.testing.assert_allclose([one.frequency_hz for one in found], 4.0 * np.sqrt(1.0 - 0.05**2), rtol=5e-3)


def test_an_offset_that_creeps_does_not_count() -> None:
    assert decrement(T, _swing(offset=0.04)).zeta == pytest.approx(0.05, rel=0.05)


U = np.arange(100.0, 256.0, 5.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_truth_is_recovered_beside_outliers(sign: float) -> None:
    rng = np.random.default_rng(3)
    y = sign * (20.0 * Shape(95.0, 30.0).of(U) + 0.2 * rng.standard_normal(len(U)))
    y[10] += sign * 6.0
    found = fit_static_map("table", U, y)
    assert found.fit.end == pytest.approx(sign * 20.0, abs=3.5 * found.fit.sigma["end"])
    assert found.shape.dead_pwm == pytest.approx(95.0, abs=3.5 * found.fit.sigma["dead_pwm"])
    assert found.shape.scale_pwm == pytest.approx(30.0, abs=3.5 * found.fit.sigma["scale_pwm"])
    assert U[10] in found.fit.outliers_pwm
    assert found.fit.scatter == pytest.approx(0.2, rel=0.5)
    assert abs(found.of(np.array([found.fit.saturates_pwm]))[0]) == pytest.approx(0.95 * abs(found.fit.end))


EPS = np.linspace(0.002, 0.027, 12)


def _force(*k: float, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    clean = sum(c * EPS ** (n + 1) for n, c in enumerate(k))
    return np.asarray(clean + noise * np.random.default_rng(seed).standard_normal(len(EPS)))


@pytest.mark.parametrize("law", [(60.0,), (47.7, 1092.9)])
def test_the_order_and_the_coefficients_are_found(law: tuple[float, ...]) -> None:
    fits, best = fit_stiffness("weights", EPS, _force(*law))
    assert fits[best].order == len(law)
    assert np.all(np.abs(fits[best].coefficients - law) < 3.5 * fits[best].sigma)
    assert fits[best].force_N(np.zeros(1))[0] == 0.0
    assert fits[best].rms_N < fits[best].left_out_rms_N


def test_deviations_are_those_of_repeated_tables_in_identify_stiffness() -> None:
    found = [fit_stiffness("w", EPS, _force(47.7, 1092.9, seed=s))[0][1] for s in range(200)]
    spread = np.std([f.coefficients for f in found], axis=0)
    assert np.allclose(spread, np.mean([f.sigma for f in found], axis=0), rtol=0.15)
    seen = np.corrcoef(np.array([f.coefficients for f in found]).T)[0, 1]
    assert seen == pytest.approx(found[0].correlation[0, 1], abs=0.03)


RADIUS = 0.0126


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tracks")
    rig_file(path / "rig.yaml")
    log_file(path / "swing.csv", SimulatedRig(), "swing", 1, 4.0)
    log_file(path / "prbs.csv", SimulatedRig(), "prbs", 2, 4.0)
    return path


def _read(folder: Path, name: str, truth: bool = False, states: Path | None = None) -> Track:
    rig, path = rig_file(folder / "rig.yaml"), folder / name
    files = Files((path,), folder / "rig.yaml")
    return read_track(files, path, rig, Machine(), PoseOptions(truth=truth), states)


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


def test_states_at_each_tick_are_taken_whole(folder: Path) -> None:
    """Of stamps in whole microseconds every third was taken for a second one of its tick."""
    t = np.arange(240) / 60.0
    rows = [f"{s:.6f},{0.3 * math.cos(25.0 * s):.6f},0.065,0.004" for s in t.tolist()]
    states = folder / "swing_states.csv"
    states.write_text("\n".join(["t_s,phi_rad,length_m,sigma_phi_rad", *rows]) + "\n")
    assert len(_read(folder, "swing.csv", states=states).t_s) >= 236


@pytest.mark.parametrize("least", [0, 70])
def test_a_command_that_is_written_where_it_changes_holds(folder: Path, least: int) -> None:
    """And where it hardly ever does: `least` makes one command of all below it."""
    log = read_log(folder / "prbs.csv")
    rows = log.sampled("pwm1", "pwm2")
    pwm = np.stack([log.columns[name] for name in ("pwm1", "pwm2")], axis=1)
    pwm[pwm < least] = least
    every = _changed(folder, "prbs.csv", pwm1=pwm[:, 0].copy(), pwm2=pwm[:, 1].copy())
    told = _read(folder, every.name)
    assert (np.diff(pwm[rows], axis=0) == 0.0).all(axis=1).mean() > 0.5
    pwm[rows[1:][(np.diff(pwm[rows], axis=0) == 0.0).all(axis=1)]] = np.nan
    held = _read(folder, _changed(folder, "prbs.csv", pwm1=pwm[:, 0], pwm2=pwm[:, 1]).name)
    assert held.tick_s == pytest.approx(1 / 60)
    differ = np.any(told.pwm[: len(held.pwm)] != held.pwm[: len(told.pwm)], axis=1)
    assert differ.mean() < 0.02


def test_a_command_that_is_spoilt_is_left_out_and_many_are_refused(folder: Path) -> None:
    log = read_log(folder / "prbs.csv")
    whole, rows = _read(folder, "prbs.csv"), log.sampled("pwm1", "pwm2")
    pwm = log.columns["pwm1"].copy()
    pwm[rows[100]] = 300.0
    one, files = _changed(folder, "prbs.csv", pwm1=pwm.copy()), Files((), folder / "rig.yaml")
    held = read_track(files, one, Rig.load(files.rig_path), Machine(), PoseOptions())
    assert any("300.0" in text and "1 of" in text and "left out" in text for text in files.remarks)
    assert held.pwm.max() <= 255.0
    assert np.any(held.pwm != whole.pwm, axis=1).sum() <= 1
    pwm[rows[::50]] = 300.0
    with pytest.raises(BadInputError, match=r"line \d+: pwm is \[300\.0, .*expected 0 to 255$"):
        _read(folder, _changed(folder, "prbs.csv", pwm1=pwm).name)


def test_pictures_that_share_their_time_stamps(folder: Path) -> None:
    """Six at a time, of a clock in steps of 0.1 s: a period apart; refused where nothing tells how far."""
    log = read_log(folder / "swing.csv")
    path = folder / "coarse.csv"
    write_log(path, replace(log, t_s=np.floor(10.0 * log.t_s) / 10.0))
    fine, coarse = _read(folder, "swing.csv"), _read(folder, path.name)
    late = coarse.t_s - fine.t_s
    # Half a period of the camera; they are 29 ms off where stamps are taken for times.
    assert np.std(late) < 8e-3, late
    kept = np.random.default_rng(0).random(len(log)) < 0.4
    columns = {name: column[kept] for name, column in log.columns.items()}
    write_log(path, replace(log, t_s=np.floor(10.0 * log.t_s[kept]) / 10.0, columns=columns))
    with pytest.raises(BadInputError, match=r"time stamps, in steps of 100 ms"):
        _read(folder, path.name)


def test_pictures_give_the_true_pose_with_the_noise_that_is_said(folder: Path) -> None:
    seen, true = _read(folder, "prbs.csv"), _read(folder, "prbs.csv", truth=True)
    assert (seen.source, true.source) == ("pictures", "truth")
    at = seen.t_s - 0.025
    inside = at > 0.1
    truth = np.stack([np.interp(at, true.t_s, true.head[:, k]) for k in range(2)], axis=1)
    z = np.einsum("mij,mj->mi", seen.whitening, seen.head - truth)[inside]
    assert 0.7 < 1.4826 * np.median(np.abs(z)) < 1.5
    assert seen.delay_s == pytest.approx(0.025)


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
    assert source.begin_s == pytest.approx(1.0, abs=0.05)
    assert source.t_s[-1] == pytest.approx(4.0, abs=0.15)


@pytest.mark.parametrize("gyro", [True, False])
def test_a_pixel_that_flickers_does_not_let_the_head_go(folder: Path, gyro: bool) -> None:
    log = read_log(folder / "swing.csv")
    held = np.arange(0.0, 2.0, 1.0 / 60.0)
    rng = np.random.default_rng(1)
    columns = {}
    for name, values in log.columns.items():
        first = values[log.sampled(name)[0]]
        before = np.full(len(held), first)
        if name == "u_px":
            before += (rng.random(len(held)) < 0.5).astype(np.float64)
        if name == "gz_radps":
            before += rng.normal(0.0, 0.003, len(held))
        if gyro or name != "gz_radps":
            columns[name] = np.concatenate([before, values])
    t = np.concatenate([held, log.t_s + 2.0])
    path = folder / "flickering.csv"
    write_log(path, Log("held", t, columns, np.arange(len(t), dtype=np.int64)))
    source = _read(folder, "flickering.csv")
    assert source.begin_s == pytest.approx(2.0, abs=0.005 if gyro else 0.03)


@pytest.mark.parametrize("jitter_px", [0.1, 0.3, 0.45])
def test_whole_pixels_of_a_held_head_are_no_swing(jitter_px: float) -> None:
    """Held for 3 s at any place in a pixel of 0.023 rad, then let go from a small angle."""
    rng, pixel = np.random.default_rng(0), 0.023
    t = np.arange(600) / 60.0
    s = np.maximum(t - 3.0, 0.0)
    for place in np.linspace(0.15, 0.15 + pixel, 100):
        phi = place * np.exp(-1.2 * s) * np.cos(25.0 * s)
        seen = pixel * np.round(phi / pixel + rng.normal(0.0, jitter_px, len(t)))
        at = let_go(t, seen, pixel * float(np.hypot(jitter_px, 0.29)))
        assert at is not None and 3.0 <= t[at] < 3.1


def test_states_stand_in_for_pictures(folder: Path) -> None:
    log = read_log(folder / "swing.csv")
    states = folder / "changed_swing_states.csv"
    q1, q2 = log.columns["true_q1_m"], log.columns["true_q2_m"]
    rows = np.stack([log.t_s, (q1 - q2) / (2.0 * RADIUS), 0.5 * (q1 + q2), np.full(len(q1), 1e-3)], axis=1)
    lines = [",".join(f"{c:.9g}" for c in row) for row in rows.tolist()]
    states.write_text("\n".join(["t_s,phi_rad,length_m,sigma_phi_rad", *lines]) + "\n")
    path = _changed(folder, "swing.csv", u_px=None, v_px=None)
    source = _read(folder, path.name)
    assert (source.source, source.delay_s) == ("states", 0.0)
    given = _read(folder, "swing.csv", states=states)
    assert np.allclose(given.head, source.head)
    states.unlink()
    with pytest.raises(BadInputError, match="has no marker"):
        _read(folder, path.name)


@pytest.mark.parametrize("every", [1, 2])
def test_a_swing_begins_where_it_is_let_go_whatever_the_camera_s_rate(folder: Path, every: int) -> None:
    log = read_log(folder / "swing.csv")
    seen = np.isin(np.arange(len(log)), log.sampled("u_px", "v_px")[::every])
    slow = {name: np.where(seen, log.columns[name], np.nan) for name in ("u_px", "v_px")}
    start = _read(folder, _changed(folder, "swing.csv", **slow).name).start
    assert start.phi_rad == pytest.approx(log.columns["true_phi_rad"][0], abs=0.1)


PLANT = Plant()


def _started(one: Track, from_s: float = 0.0) -> object:
    some = one.t_s >= from_s + 0.025
    t, head = one.t_s[some] - from_s - 0.025, one.head[some]
    return start_in_motion(t, head, one.hoses, PLANT, SIGMA[0])


@pytest.mark.few(0)
@pytest.mark.parametrize("seed", range(5))
def test_swings_that_are_let_go_begin_at_rest_and_cut_ones_do_not(seed: int) -> None:
    one = track("free", phi_rad=0.2 + 0.1 * seed, seed=seed)
    assert _started(one) is None
    # A quarter of a period after an extreme the rate is greatest.
    phi = np.abs(one.head[:, 0] - np.median(one.head[:, 0]))
    cut = one.t_s[30 + int(np.argmin(phi[30:45]))]
    begun = _started(one, float(cut))
    assert begun is not None and abs(begun.dphi_radps) > 1.0


def test_pumps_that_are_on_already_are_seen_by_the_pose() -> None:
    one = track("steps")
    assert _started(one) is None
    begun = _started(one, 1.5)
    assert begun is not None
    # Both pumps alike: no angle, and the force that holds the length.
    assert abs(begun.phi_rad) < 0.01 and begun.length_m > PLANT.rest_length_m + 0.01
    assert begun.force1_N == pytest.approx(begun.force2_N, abs=0.1) and begun.force1_N > 0.5
    assert begun.gap1_N == 0.0 and begun.creep1_N == 0.0


@pytest.mark.parametrize("tick", [75, 105])
def test_a_log_that_begins_in_motion_is_fitted_to_its_minimum(tick: int) -> None:
    """Below its lag a force says nothing, and beside that its derivative is none."""
    one = track(
        "prbs", {"stiffness_scale": 1.3, "strength1": 1.2, "strength2": 1.1, "lag_s": 0.3}, duration_s=6.0
    )
    from_s = tick * one.tick_s
    moving, late = _started(one, from_s), one.t_s >= from_s + 0.035
    assert isinstance(moving, Start)
    head, whitening = one.head[late], one.whitening[late]
    cut = replace(
        one, pwm=one.pwm[tick:], t_s=one.t_s[late] - from_s, head=head, whitening=whitening, moving=moving
    )
    problem = Problem(Machine(), [cut], ("stiffness_scale", "lag_s", "strength1", "strength2"), {})
    x, cost, _, _ = solve(problem, first_guess(problem, values_of(Machine())), 40)
    # White residuals leave .45 of their number.
    assert cost < 0.46 * 2 * len(cut.t_s)
    assert x[0] == pytest.approx(1.3, abs=0.01)


def test_the_true_model_leaves_the_noise_and_another_one_more() -> None:
    values = {"stiffness_scale": 1.3, "bending_N_per_rad2": 0.25}
    source = replace(track("prbs", values, noise=0.0), delay_s=0.025)
    nominal = Machine()
    plant = replace(nominal.plant, stiffness_scale=1.3, bending_N_per_rad2=0.25)
    found = compare(source, {ORIGINAL: nominal, IMPROVED: replace(nominal, plant=plant)})
    assert found.errors[IMPROVED]["phi"].rms < 1e-3
    assert found.errors[IMPROVED]["q1"].fit_percent > 98.0
    for quantity in ("q1", "q2", "phi"):
        assert found.improvement_percent(quantity) > 80.0
    # The angle and the two lengths say the same.
    q1, q2, phi = found.measured.T
    assert np.allclose(phi, (q1 - q2) / (2.0 * 0.0126), atol=1e-12)


def test_one_wrong_picture_does_not_decide() -> None:
    seen = track("free", noise=1.0)
    head = seen.head.copy()
    head[100] += (1.0, 0.02)
    clean, wrong = (
        compare(replace(seen, head=h, delay_s=0.025), {ORIGINAL: Machine()}) for h in (seen.head, head)
    )
    assert wrong.replaced == clean.replaced + 1
    assert wrong.errors[ORIGINAL]["q1"].norm == pytest.approx(clean.errors[ORIGINAL]["q1"].norm, rel=0.02)
    assert wrong.improvement_percent("q1") is None


@pytest.mark.parametrize("hertz", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("held_s", [0.0, 0.12, 0.2, 0.4])
def test_a_head_that_is_held_for_a_moment_is_seen_to_be_let_go(hertz: float, held_s: float) -> None:
    t = np.arange(0.0, 4.0, 0.01)
    swung_s = np.maximum(t - held_s - 0.005, 0.0) if held_s else t
    rate = np.exp(-0.3 * swung_s) * np.sin(2.0 * np.pi * hertz * swung_s)
    k = let_go(t, 3.0 * rate + np.random.default_rng(1).normal(0.0, 0.003, len(t)), 0.003)
    if held_s:
        assert k is not None and held_s < t[k] < held_s + 0.02 + 0.04 / hertz
    else:
        assert k is None

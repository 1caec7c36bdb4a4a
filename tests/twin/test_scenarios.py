"""The experiments of the source: the acceptance figures, and what is said of wrong names and options.

The figures are those of the nominal plant with true feedback; each must be met within 5 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.core.errors import BadInputError, UsageError
from calib.io.logs import log_text
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.control.laws import LoopState, Pid, PidState, saturate, step
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import SCENARIOS, Figures, make_scenario, run_scenario
from calib.twin.simulate import Run, Seen, log_of, simulate

RIG = SimulatedRig()
WITHIN = 0.05


def _do(
    name: str, duration_s: float | None = None, feedback: str = "truth", **options: str
) -> tuple[Run, Figures]:
    scenario = make_scenario(name, options)
    run = run_scenario(scenario, RIG, 0, feedback, duration_s)
    return run, scenario.figures(run)


def test_swing_damping_frequency_and_offset() -> None:
    _, figures = _do("swing")
    assert figures["damping_ratio"] == pytest.approx(0.055, rel=WITHIN)
    assert figures["frequency_hz"] == pytest.approx(4.0, rel=WITHIN)
    assert figures["offset_after_a_period_rad"] == pytest.approx(0.041, rel=WITHIN)
    assert figures["offset_after_1s_rad"] == pytest.approx(0.006, rel=WITHIN)


@pytest.mark.parametrize(("volt", "elongation_mm"), [(6, 1.88), (8, 11.11), (10, 21.73), (12, 26.56)])
def test_steady_elongations(volt: int, elongation_mm: float) -> None:
    run, figures = _do("steps", 45.0, volts=str(volt), on_s="40")
    assert figures[f"elongation_at_{volt}V_mm"] == pytest.approx(elongation_mm, rel=WITHIN)
    # And without any bending.
    assert np.abs(run.phi_rad).max() < 1e-12


def test_deflation_takes_5_s() -> None:
    _, figures = _do("deflate")
    assert figures["deflation_s"] == pytest.approx(5.05, rel=WITHIN)


def test_pid_to_a_constant_angle() -> None:
    _, figures = _do("orientation", 5.0)
    assert figures["reach_s"] == pytest.approx(0.92, rel=WITHIN)
    assert figures["peak_rad"] == pytest.approx(0.742, rel=WITHIN)
    assert figures["settle_s"] == pytest.approx(2.37, rel=WITHIN)


@pytest.mark.parametrize(("Kp", "angle_rad"), [(500, 0.375), (1000, 0.535), (2000, 0.63), (5000, 0.698)])
def test_proportional_control_never_reaches(Kp: int, angle_rad: float) -> None:
    _, figures = _do("orientation", 5.0, controller="p", Kp=str(Kp))
    assert figures["reach_s"] is None
    assert figures["peak_rad"] == pytest.approx(angle_rad, rel=WITHIN)


def test_pd_with_feed_forward_along_the_elongation() -> None:
    _, figures = _do("elongation")
    assert figures["largest_error_mm"] == pytest.approx(2.00, rel=WITHIN)
    assert figures["static_error_mm"] == pytest.approx(-0.23, rel=WITHIN)


def test_without_feed_forward_it_stays_short_and_with_an_integral_it_winds_up() -> None:
    _, pd = _do("elongation", controller="pd")
    _, pid = _do("elongation", controller="pid")
    assert pd["static_error_mm"] is not None
    assert pid["largest_error_mm"] is not None
    assert pd["static_error_mm"] > 10.0
    assert pid["largest_error_mm"] > 3.0 * 2.0
    # Nothing happens before about 2 s, as in Fig. 4.12.
    run, _ = _do("elongation", controller="pid")
    q = run.states[:, 0]
    assert 1.0 < float(run.t_s[np.nonzero(q > 0.066)[0][0]]) < 3.0


def test_clamping_halves_the_overshoot_of_a_jump_and_slows_the_first_rise() -> None:
    _, plain = _do("orientation")
    _, clamped = _do("orientation", controller="clamping")
    ratio = clamped["overshoot_after_jump_rad"] / plain["overshoot_after_jump_rad"]
    assert ratio == pytest.approx(0.5, abs=0.08)
    assert clamped["reach_s"] > 3.0 * plain["reach_s"]


def test_with_the_saturated_output_remembered_clamping_never_reaches() -> None:
    pid = Pid(1000.0, 1000.0, 10.0, clamping=True)

    def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, tuple[float, float]]:
        error = 0.7 - seen.phi_rad
        first, u1 = step(pid, memory.first, error)
        second, u2 = step(pid, memory.second, -error)
        u1, u2 = saturate(u1), saturate(u2)
        return LoopState(PidState(u1, first.e1, first.e2), PidState(u2, second.e1, second.e2)), (u1, u2)

    run = simulate(RIG, rig_at_rest(RIG.plant, RIG.pump), law, 300, 0, "truth")
    assert run.phi_rad.max() < 0.7


def test_the_ellipse_is_followed_with_both_chords() -> None:
    width = {}
    for chord in ("exact", "thesis"):
        run, figures = _do("ellipse", chord=chord)
        assert max(v for v in figures.values() if v is not None) < 1.0
        late = run.t_s > 2.0
        q = run.states[late, :2]
        length, phi = q.mean(axis=1), run.phi_rad[late]
        x = length * np.sinc(phi / (2.0 * np.pi)) * np.sin(0.5 * phi)
        width[chord] = np.ptp(x)
    assert width["exact"] == pytest.approx(0.030, abs=0.003)
    assert width["thesis"] == pytest.approx(0.015, abs=0.003)


def test_over_its_sensors_the_loop_still_works() -> None:
    _, figures = _do("orientation", feedback="sensors")
    assert figures["reach_s"] == pytest.approx(0.92, rel=0.1)
    assert 0.68 < figures["peak_rad"] < 0.8
    _, figures = _do("elongation", feedback="sensors")
    assert abs(figures["static_error_mm"]) < 1.5
    _, figures = _do("ellipse", feedback="sensors")
    assert max(v for v in figures.values() if v is not None) < 3.0


def test_signals_for_identification_move_both_bellows_apart() -> None:
    for name in ("chirp", "prbs"):
        run, figures = _do(name)
        q = run.states[:, :2]
        assert figures["longest_bellows_mm"] - figures["shortest_bellows_mm"] > 15.0
        assert abs(float(np.corrcoef(q[300:].T)[0, 1])) < 0.9
        assert np.abs(run.phi_rad).max() > 0.2
        assert 0.0 <= run.pwm.min() <= run.pwm.max() <= 255.0
    chirp, _ = _do("chirp", from_hz="0.5", to_hz="0.5", duration_s=20.0)
    crossings = np.count_nonzero(np.diff(1 * (chirp.pwm[:, 0] > 170.0)) > 0)
    assert crossings == pytest.approx(10, abs=1)
    swept, _ = _do("chirp", duration_s=40.0)
    middle = np.nonzero(np.diff(1 * (swept.pwm[:, 0] > 170.0)))[0]
    assert np.diff(middle)[-1] < np.diff(middle)[0] / 10


def test_prbs_depends_on_the_seed_and_holds_its_values() -> None:
    scenario = make_scenario("prbs")
    first, second, other = (run_scenario(scenario, RIG, seed, "truth", 20.0).pwm for seed in (1, 1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)
    changes = np.nonzero(np.any(np.diff(first, axis=0) != 0.0, axis=1))[0] + 1
    assert np.all(changes % 30 == 0)


def test_rest_is_rest_with_the_chips_angle_in_the_log() -> None:
    run, figures = _do("static", 10.0)
    assert np.ptp(run.trajectory.nodes[:, :2]) == 0.0
    assert 0.0 < figures["onchip_drift_degps"] < 0.4
    assert len(log_of(run).sampled("onchip_phi_rad")) == 1000


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_scenario_gives_a_log_of_the_length_asked_for(name: str) -> None:
    for duration_s in (0.05, 1.0):
        run, _ = _do(name, duration_s)
        assert len(run.pwm) == round(60.0 * duration_s)
        log = log_of(run)
        assert log.t_s[-1] <= duration_s + 0.01
        assert not any(word in log_text(log) for word in ("nan", "inf"))


def test_another_tick_rate_is_obeyed() -> None:
    rig = replace(RIG, pump=replace(RIG.pump, tick_s=0.01))
    run = run_scenario(make_scenario("orientation"), rig, 0, "truth", 5.0)
    assert len(run.pwm) == 500
    assert run.phi_rad[-1] == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("wobble", {}, "SCENARIO: 'wobble' is not one of static, swing, .*, prbs, rig"),
        ("swing", {"phi": "1"}, "phi: is no option of the scenario swing, expected one of phi_rad, length_m"),
        ("swing", {"duration_s": "1"}, "duration_s: is no option"),
        ("swing", {"phi_rad": "half"}, "phi_rad: 'half' is not a number"),
        ("orientation", {"Kp": "nan"}, "Kp: 'nan' is not a number"),
        ("orientation", {"sign": "1.5"}, "sign: '1.5' is not a whole number"),
        ("ellipse", {"feedforward": "maybe"}, "feedforward: 'maybe' is not true or false"),
        ("steps", {"volts": "6;8"}, "volts: '6;8' is not numbers separated by commas"),
    ],
)
def test_words_that_are_not_known(name: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_scenario(name, options)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("orientation", {"controller": "lqr"}, "controller: found 'lqr', expected one of p, pid, clamping"),
        ("elongation", {"controller": "pdf"}, r"expected one of pd\+ff, pd, pid"),
        ("ellipse", {"chord": "tan"}, "chord: found 'tan', expected one of exact, thesis"),
        ("swing", {"length_m": "-0.065"}, "expected positive lengths"),
        ("swing", {"phi_rad": "20"}, "expected positive lengths"),
        ("elongation", {"start_m": "-0.01"}, "expected positive lengths"),
        ("orientation", {"sign": "2"}, "found 2, expected 1 or -1"),
        ("chirp", {"from_hz": "0"}, "chirp: found 0 to 2 Hz"),
        ("prbs", {"hold_s": "0"}, "prbs hold_s: found 0 s"),
    ],
)
def test_numbers_that_no_experiment_can_have(name: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        run_scenario(make_scenario(name, options), RIG, 0, "truth", 1.0)


def test_a_duration_that_is_no_number() -> None:
    with pytest.raises(BadInputError, match="duration: found nan"):
        run_scenario(make_scenario("static"), RIG, duration_s=float("nan"))

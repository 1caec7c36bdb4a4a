"""The simulated rig at work: the source's figures, the actuator's own simulation, the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open_loop
import pytest

from calib.core.errors import BadInputError, UsageError
from calib.io.columns import MEASURED, TRUE
from calib.io.logs import log_text
from calib.stages.actuator.parameters import Plant, Stiffness
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.control.laws import Channel, Pid, saturate
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import SCENARIOS, Figures, make_scenario, run_scenario
from calib.twin.sensors import Imu, Tracker, marker_pixels
from calib.twin.simulate import Law, Run, Seen, run_log, simulate

RIG = SimulatedRig()
PERFECT = replace(
    RIG,
    tracker=Tracker(
        latency_s=0.0, jitter_px=0.0, grid_px=0.0, outliers=0.0, dropouts=0.0, stamp_jitter_s=0.0
    ),
    imu=Imu(
        mount_angle_rad=0.0,
        gyro_bias_radps=(0.0, 0.0, 0.0),
        accel_bias_mps2=(0.0, 0.0, 0.0),
        stamp_jitter_s=0.0,
        duplicated_stamps=0.0,
    ),
)


def _commands(ticks: int, seed: int = 0) -> np.ndarray:
    return (
        np.repeat(np.random.default_rng(seed).integers(90, 256, (ticks // 15 + 1, 2)), 15, axis=0)[:ticks]
        * 1.0
    )


def _run(drive: np.ndarray | Law, ticks: int, rig: SimulatedRig = RIG, **options: object) -> Run:
    return simulate(rig, rig_at_rest(rig.plant, rig.pump), drive, ticks, **options)


def _playing(pwm: np.ndarray, kept: list[Seen]) -> Law:
    """A controller that plays commands and keeps what it sees."""

    def law(k: int, seen: Seen) -> tuple[float, float]:
        kept.append(seen)
        return float(pwm[k, 0]), float(pwm[k, 1])

    return law


def test_the_states_are_those_of_the_actuators_own_simulation() -> None:
    pwm = _commands(300)
    run = _run(pwm, 300)
    own = open_loop.simulate(RIG.plant, RIG.pump, pwm, substeps=20)
    assert np.allclose(run.states, own.states[:-1], rtol=0.0, atol=1e-12)
    assert np.allclose(run.trajectory.nodes[-1], own.states[-1], rtol=0.0, atol=1e-12)
    assert run.seen is None


@pytest.mark.parametrize("feedback", ["truth", "sensors"])
def test_a_loop_that_plays_commands_is_the_open_loop(feedback: str) -> None:
    pwm, kept = _commands(200), []
    closed = _run(_playing(pwm, kept), 200, feedback=feedback)
    opened = _run(pwm, 200)
    # The kernel works in (l, phi): handing (q1, q2) over at each tick costs a rounding.
    assert np.allclose(closed.trajectory.nodes, opened.trajectory.nodes, rtol=0.0, atol=1e-12)
    # Sensing in portions or at once, the readings are the same.
    assert np.array_equal(closed.sensors.pixels, opened.sensors.pixels, equal_nan=True)
    assert np.array_equal(closed.sensors.accel_mps2, opened.sensors.accel_mps2)
    assert np.array_equal(closed.sensors.gyro_radps, opened.sensors.gyro_radps)
    assert len(kept) == 200


def test_sensor_feedback_comes_late_and_wrong_but_close() -> None:
    t = np.arange(900) / 60.0
    pwm = 170.0 + 40.0 * np.stack([np.sin(t), np.cos(t)], axis=1)
    run = _run(_playing(pwm, []), 900, feedback="sensors")
    assert run.seen is not None
    late = t > 3.0
    phi_error = (run.seen[:, 0] - run.phi_rad)[late]
    # The mount angle of 20 mrad is not corrected.
    assert phi_error.mean() == pytest.approx(0.02, abs=0.01)
    q_error = (run.seen[:, 1:] - run.states[:, :2])[late]
    assert 1e-4 < np.sqrt(np.mean(q_error**2)) < 2e-3
    # The low-pass and the latency make the lengths late by about 0.16 s + 0.025 s.
    length, seen = run.states[:, :2].mean(axis=1)[late], run.seen[:, 1:].mean(axis=1)[late]
    lags = np.arange(0, 30)
    misfit = [np.std(seen[lag:] - length[: len(length) - lag]) for lag in lags]
    assert 8 <= int(np.argmin(misfit)) <= 14


def test_frames_show_the_past_and_samples_the_present() -> None:
    pwm = _commands(240)
    late = replace(PERFECT, tracker=replace(PERFECT.tracker, latency_s=0.03))
    run = _run(pwm, 240, late)
    exposed = run.trajectory.at(run.t_s - 0.03)[:, :2]
    expected = marker_pixels(late.view, late.tracker, exposed, RIG.plant.bellows_radius_m)
    assert np.array_equal(run.sensors.pixels, expected)
    dphi = run.trajectory.at(run.sensors.imu.taken_s)
    rate = (dphi[:, 2] - dphi[:, 3]) / (2.0 * RIG.plant.bellows_radius_m)
    assert np.abs(run.sensors.gyro_radps[:, 2] / 1.006 + rate).max() < 0.02


def test_the_log_has_rows_of_ticks_and_of_samples_in_the_order_of_time() -> None:
    log = run_log(_run(_commands(600), 600, PERFECT))
    assert len(log) == 600 + 1000
    assert np.all(np.diff(log.t_s) >= 0.0)
    ticks, samples = log.sampled("pwm1", "pwm2"), log.sampled("ax_mps2", "gz_radps")
    assert (len(ticks), len(samples)) == (600, 1000)
    assert not set(ticks.tolist()) & set(samples.tolist())
    assert np.array_equal(log.sampled("u_px", "v_px"), ticks)
    assert np.allclose(np.diff(log.t_s[ticks]), 1.0 / 60.0, atol=2e-6)
    assert np.allclose(np.diff(log.t_s[samples]), 0.01, atol=2e-6)
    assert set(log.columns) == {*MEASURED, *TRUE} - {"onchip_phi_rad"}


def test_the_same_seed_gives_the_same_bytes() -> None:
    texts = [log_text(run_log(_run(_commands(120), 120, seed=seed))) for seed in (3, 3, 4)]
    assert texts[0] == texts[1] != texts[2]


def test_a_step_too_large_for_the_stiffness_is_detected() -> None:
    stiff = replace(RIG, plant=Plant(stiffness=Stiffness((3e6,)), creep=None))
    with pytest.raises(
        BadInputError, match=r"a step of 0\.000833 s is too large for its stiffness and damping"
    ):
        _run(_commands(60), 60, stiff)


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


def test_pid_to_a_constant_angle() -> None:
    _, figures = _do("orientation", 5.0)
    assert figures["reach_s"] == pytest.approx(0.92, rel=WITHIN)
    assert figures["peak_rad"] == pytest.approx(0.742, rel=WITHIN)
    assert figures["settle_s"] == pytest.approx(2.37, rel=WITHIN)


@pytest.mark.parametrize(
    ("Kp", "angle_rad"),
    [
        (500, 0.375),
        (5000, 0.698),
    ],
)
def test_proportional_control_never_reaches(Kp: int, angle_rad: float) -> None:
    _, figures = _do("orientation", 5.0, controller="p", Kp=str(Kp))
    assert figures["reach_s"] is None
    assert figures["peak_rad"] == pytest.approx(angle_rad, rel=WITHIN)


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
    channels = Channel(pid), Channel(pid)

    def saturated(channel: Channel, error: float) -> float:
        u = channel.step(error)
        channel.sum += saturate(u) - u
        return saturate(u)

    def law(k: int, seen: Seen) -> tuple[float, float]:
        error = 0.7 - seen.phi_rad
        return saturated(channels[0], error), saturated(channels[1], -error)

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


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_scenario_gives_a_log_of_the_length_asked_for(name: str) -> None:
    for duration_s in (0.05, 1.0):
        run, _ = _do(name, duration_s)
        assert len(run.pwm) == round(60.0 * duration_s)
        log = run_log(run)
        assert log.t_s[-1] <= duration_s + 0.01
        assert not any(word in log_text(log) for word in ("nan", "inf"))


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("wobble", {}, "SCENARIO: 'wobble' is not one of static, swing, .*, prbs, rig"),
        ("orientation", {"Kp": "nan"}, "orientation.Kp is 'nan', expected a finite number"),
        ("orientation", {"controler": "p"}, "orientation.controler is not a key .*; did you mean controller"),
        ("orientation", {"controller": "lqr"}, "controller is 'lqr', expected 'p', 'pid' or 'clamping'"),
        ("steps", {"volts": "6;8"}, "steps.volts.0 is '6;8', expected a number"),
        ("prbs", {"hold_s": "0"}, "prbs.hold_s is '0', expected greater than 0"),
        ("chirp", {"from_hz": "2.5"}, "chirp.to_hz is 2, expected at least from_hz, 2.5"),
    ],
)
def test_words_that_are_not_known(name: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_scenario(name, options)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("swing", {"length_m": "-0.065"}, "expected positive lengths"),
        ("elongation", {"start_m": "-0.01"}, "expected positive lengths"),
        ("prbs", {"duration_s": "1e9"}, "duration: found 1e\\+09 s, expected 0.0167 s .one tick. to 7200 s"),
        ("steps", {"volts": "99"}, "found 99 V for a motor, expected 0 to 12, its supply"),
    ],
)
def test_numbers_that_no_experiment_can_have(name: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        run_scenario(make_scenario(name, {"duration_s": "1"} | options), RIG, 0, "truth")

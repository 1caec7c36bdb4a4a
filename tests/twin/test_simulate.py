"""The simulated rig at work: against the actuator's own simulation, in time, in its log, and its refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.io.logs import COLUMNS, log_text
from calib.stages.actuator import simulate as integrate
from calib.stages.actuator.kinematics import forward
from calib.stages.actuator.parameters import Plant, Stiffness
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.control.laws import LoopState
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import Imu, Tracker, marker_pixels
from calib.twin.simulate import LONGEST_S, Law, Run, Seen, log_of, simulate

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

    def law(k: int, memory: LoopState, seen: Seen) -> tuple[LoopState, tuple[float, float]]:
        kept.append(seen)
        return memory, (float(pwm[k, 0]), float(pwm[k, 1]))

    return law


def test_the_states_are_those_of_the_actuators_own_simulation() -> None:
    pwm = _commands(300)
    run = _run(pwm, 300)
    own = integrate.simulate(RIG.plant, RIG.pump, pwm, substeps=20)
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
    assert np.array_equal(closed.pixels, opened.pixels, equal_nan=True)
    assert np.array_equal(closed.accel_mps2, opened.accel_mps2)
    assert np.array_equal(closed.gyro_radps, opened.gyro_radps)
    assert len(kept) == 200


def test_true_feedback_is_the_state_at_the_tick() -> None:
    kept: list[Seen] = []
    run = _run(_playing(_commands(100), kept), 100, feedback="truth")
    assert run.seen is not None
    assert np.array_equal(run.seen[:, 1:], run.states[:, :2])
    assert np.allclose(run.seen[:, 0], run.phi_rad)


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


def test_a_command_acts_after_the_delay_in_ticks() -> None:
    pwm = np.zeros((12, 2))
    pwm[4:] = 255.0
    force = _run(pwm, 12).states[:, 8]
    assert np.all(force[: 4 + RIG.pump.delay_ticks + 1] == 0.0)
    assert force[4 + RIG.pump.delay_ticks + 1] > 0.0


def test_unequal_pumps_bend_the_actuator() -> None:
    rig = replace(RIG, pump_strength=(1.0, 0.9))
    assert _run(np.full((300, 2), 255.0), 300, rig).phi_rad[-1] > 0.05
    assert abs(_run(np.full((300, 2), 255.0), 300).phi_rad[-1]) < 1e-12


def test_frames_show_the_past_and_samples_the_present() -> None:
    pwm = _commands(240)
    late = replace(PERFECT, tracker=replace(PERFECT.tracker, latency_s=0.03))
    run = _run(pwm, 240, late)
    exposed = run.trajectory.at(run.t_s - 0.03)[:, :2]
    expected = marker_pixels(late.view, late.tracker, exposed, RIG.plant.bellows_radius_m)
    assert np.array_equal(run.pixels, expected)
    dphi = run.trajectory.at(run.imu.taken_s)
    rate = (dphi[:, 2] - dphi[:, 3]) / (2.0 * RIG.plant.bellows_radius_m)
    assert np.abs(run.gyro_radps[:, 2] / 1.006 + rate).max() < 0.02


def test_the_log_has_rows_of_ticks_and_of_samples_in_the_order_of_time() -> None:
    log = log_of(_run(_commands(600), 600, PERFECT))
    assert len(log) == 600 + 1000
    assert np.all(np.diff(log.t_s) >= 0.0)
    ticks, samples = log.sampled("pwm1", "pwm2"), log.sampled("ax_mps2", "gz_radps")
    assert (len(ticks), len(samples)) == (600, 1000)
    assert not set(ticks.tolist()) & set(samples.tolist())
    assert np.array_equal(log.sampled("u_px", "v_px"), ticks)
    assert np.allclose(np.diff(log.t_s[ticks]), 1.0 / 60.0, atol=2e-6)
    assert np.allclose(np.diff(log.t_s[samples]), 0.01, atol=2e-6)
    assert set(log.columns) == set(COLUMNS) - {"onchip_phi_rad"}


def test_the_true_columns_are_the_state_at_the_rows_time() -> None:
    rig = replace(RIG, imu=replace(RIG.imu, onchip=True))
    run = _run(_commands(300), 300, rig)
    log = log_of(run)
    assert len(log.sampled("onchip_phi_rad")) == 500
    q = np.stack([log.columns["true_q1_m"], log.columns["true_q2_m"]], axis=1)
    assert np.array_equal(q, run.trajectory.at(log.t_s)[:, :2])
    x, y, phi = forward(q, RIG.plant.bellows_radius_m).T
    assert np.array_equal(log.columns["true_phi_rad"], phi)
    assert np.array_equal(log.columns["true_x_m"], x)
    assert np.array_equal(log.columns["true_y_m"], y)


def test_the_same_seed_gives_the_same_bytes() -> None:
    texts = [log_text(log_of(_run(_commands(120), 120, seed=seed))) for seed in (3, 3, 4)]
    assert texts[0] == texts[1] != texts[2]


def test_the_noise_does_not_depend_on_what_the_loop_is_closed_over() -> None:
    pwm = _commands(120)
    truth = _run(_playing(pwm, []), 120, feedback="truth", seed=5)
    sensors = _run(_playing(pwm, []), 120, feedback="sensors", seed=5)
    assert np.array_equal(truth.accel_mps2, sensors.accel_mps2)
    assert np.array_equal(truth.pixels, sensors.pixels, equal_nan=True)


def test_a_step_too_large_for_the_stiffness_is_detected() -> None:
    stiff = replace(RIG, plant=Plant(stiffness=Stiffness((3e6,)), creep=None))
    with pytest.raises(
        BadInputError, match=r"a step of 0\.000833 s is too large for its stiffness and damping"
    ):
        _run(_commands(60), 60, stiff)


def test_a_motion_that_leaves_the_model_is_detected() -> None:
    # Bellows so soft that the pumps turn the head more than a full circle.
    soft = replace(RIG, plant=replace(RIG.plant, stiffness=Stiffness((0.5,)), bending_N_per_rad2=0.0))
    pwm = np.zeros((600, 2))
    pwm[:, 0] = 255.0
    with pytest.raises(BadInputError, match=r"simulation: at .* s a bellows has no length left"):
        _run(pwm, 600, soft)


@pytest.mark.parametrize("ticks", [0, -5, math.ceil(LONGEST_S * 60.0) + 1])
def test_durations_out_of_bounds(ticks: int) -> None:
    with pytest.raises(BadInputError, match="duration: found"):
        _run(np.zeros((1, 2)), ticks)


def test_a_feedback_that_is_not_known() -> None:
    with pytest.raises(BadInputError, match="feedback: found 'guess', expected one of sensors, truth"):
        _run(np.zeros((5, 2)), 5, feedback="guess")


def test_a_start_without_lengths() -> None:
    start = rig_at_rest(RIG.plant, RIG.pump)
    bad = replace(start, row=np.concatenate([[-0.065, 0.065], start.row[2:]]))
    with pytest.raises(BadInputError, match="expected positive lengths"):
        simulate(RIG, bad, np.zeros((5, 2)), 5)

"""Controllers on the simulated rig: the figures that were promised, and how they are measured."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from control_models import NOMINAL

from calib.stages.control.references import BUILT_IN, Reference, built_in, from_lengths
from calib.stages.control.tracking import tracking
from calib.stages.control.trial import CONTROLLERS, Outcome, control_model, run_controller
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import EllipseTrack, Elongation, Orientation

RIG = SimulatedRig()
MODEL = control_model(RIG)


def _run(
    name: str, reference: Reference, feedback: str = "sensors", rig: SimulatedRig = RIG, seed: int = 0
) -> Outcome:
    return run_controller(name, rig, MODEL, reference, None, seed, feedback)


def _jump(name: str, feedback: str) -> tuple[float, float]:
    figures = _run(name, built_in(MODEL, "jump"), feedback).figures
    assert figures.jump_overshoot_rad is not None and figures.rise_s is not None
    return figures.jump_overshoot_rad, figures.rise_s


@pytest.mark.parametrize("feedback", ["truth", "sensors"])
def test_back_calculation_overshoots_by_a_third_of_clamping_at_most(feedback: str) -> None:
    """On the jump at 5 s, the same gains; the first rise is not slowed, against either of the source's."""
    plain, clamped = _jump("pid", feedback), _jump("clamping", feedback)
    back = _jump("back", feedback)
    assert back[0] <= clamped[0] / 3.0 < plain[0]
    assert back[1] <= plain[1] + 1.01 * MODEL.tick_s
    assert back[1] < clamped[1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_computed_torque_on_the_ellipse_with_sensors(seed: int) -> None:
    """At least three times better than PD with feed-forward, as the source and as the model have it."""
    reference = built_in(MODEL, "ellipse")
    line = _run("pd+ff", reference, seed=seed).figures
    found = _run("torque", reference, seed=seed).figures
    # The way from rest to the start of the ellipse takes 0.1 s at full power and counts for both.
    assert 3.0 * max(found.rms_mm) < min(line.rms_mm)
    assert 3.0 * found.head_rms_mm < line.head_rms_mm
    assert 3.0 * found.angle_rms_rad < line.angle_rms_rad
    assert 2.0 * max(found.rms_from_start_mm) < min(line.rms_from_start_mm)
    assert 2.0 * max(found.rms_mm) < max(_run("pd+map", reference, seed=seed).figures.rms_mm)


@pytest.mark.slow
def test_computed_torque_on_a_rig_that_is_not_the_model() -> None:
    """Pumps 10 % weaker and 5 % stronger, a stiffer plant: the observer's force makes up for it."""
    plant = replace(RIG.plant, stiffness_scale=1.1, bending_N_per_rad2=0.2)
    other = replace(RIG, plant=plant, strength=(0.95, 1.1))
    reference = built_in(MODEL, "ellipse")
    line = _run("pd+ff", reference, rig=other).figures
    found = _run("torque", reference, rig=other).figures
    assert 3.0 * found.head_rms_mm < line.head_rms_mm
    assert max(found.rms_mm) < 0.3


def test_the_map_holds_what_the_line_does_not() -> None:
    """Bent and held for long, feedback from the truth: the line of (4.6) knows stretching only."""
    q = np.tile([0.085, 0.072], (360, 1))
    reference = replace(from_lengths(MODEL, "bent", q), judged_from_s=4.0)
    line, known = (_run(name, reference, "truth").figures for name in ("pd+ff", "pd+map"))
    assert known.largest_mm < 0.05 < 0.3 < line.largest_mm


def test_the_source_s_controllers_are_those_of_the_twin() -> None:
    """The same commands to the last one as the scenarios of `calib simulate`."""
    scenarios = (
        ("pid", "jump", Orientation()),
        ("clamping", "jump", Orientation(controller="clamping")),
        ("pd+ff", "elongation", Elongation()),
        ("pd", "elongation", Elongation(controller="pd")),
        ("pd+ff", "ellipse", EllipseTrack()),
    )
    for name, reference, scenario in scenarios:
        theirs = scenario.run(RIG, 400, 3, "truth")
        ours = _run(name, built_in(MODEL, reference, 400 * MODEL.tick_s), "truth", seed=3)
        assert np.array_equal(ours.run.pwm, theirs.pwm), name


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if not name.startswith("tuned")])
@pytest.mark.parametrize("reference", BUILT_IN)
def test_every_controller_on_every_reference(name: str, reference: str) -> None:
    """Commands are whole numbers within limits of the rig's own, and nothing leaves the model."""
    model = control_model(RIG, None, (5.0, 240.0))
    wanted = built_in(model, reference, 1.5)
    outcome = run_controller(name, RIG, model, wanted)
    pwm = outcome.run.pwm
    assert pwm.shape == (90, 2) and np.array_equal(pwm, np.round(pwm))
    assert pwm.min() >= 5.0 and pwm.max() <= 240.0
    assert (outcome.limited is not None) == (name == "torque")


def test_the_same_seed_the_same_run() -> None:
    reference = built_in(MODEL, "ellipse", 1.0)
    one, two, other = (_run("torque", reference, seed=s).run.pwm for s in (4, 4, 5))
    assert np.array_equal(one, two) and not np.array_equal(one, other)


def test_a_controller_may_read_the_sensors_themselves() -> None:
    """The samples of each tick once, in order, and the marker as the tracker reports it."""
    from calib.twin.scenarios import at_rest
    from calib.twin.simulate import Seen, simulate

    read: list[Seen] = []

    def law(k: int, seen: Seen) -> tuple[float, float]:
        read.append(seen)
        return 0.0, 0.0

    run = simulate(RIG, at_rest(RIG), law, 60, 1, "sensors")
    rows = [row for seen in read for row in seen.imu]
    assert np.array_equal(np.array(rows)[:, 2], run.sensors.gyro_radps[: len(rows), 2])
    assert np.array_equal(np.array(rows)[:, :2], run.sensors.accel_mps2[: len(rows), :2])
    assert 98 <= len(rows) <= 100
    assert np.array_equal(np.array([seen.marker_px for seen in read]), run.sensors.pixels, equal_nan=True)


R, H = NOMINAL.plant.bellows_radius_m, NOMINAL.tick_s


def _tracking(reference: Reference, q: np.ndarray, pwm: np.ndarray | None = None):
    return tracking(reference, q, np.zeros_like(q) if pwm is None else pwm, R, 0.0, 255.0)


def test_the_figures_of_a_step_and_a_jump() -> None:
    reference = built_in(NOMINAL, "jump")
    t = reference.t_s
    phi = np.where(t < 5.0, np.minimum(0.7 * t, 0.75), np.maximum(0.75 - 0.3 * (t - 5.0), 0.25))
    phi[(t >= 2.0) & (t < 5.0)] = 0.701
    phi[t >= 8.0] = 0.301
    q = 0.08 + R * np.stack([phi, -phi], axis=1)
    found = _tracking(reference, q)
    assert found.rise_s == pytest.approx(0.95, abs=1.01 * H)
    assert found.reach_s == pytest.approx(1.0, abs=1.01 * H)
    assert found.overshoot_rad == pytest.approx(0.05, abs=1e-9)
    assert found.settling_s == pytest.approx(2.0, abs=H)
    assert found.jump_overshoot_rad == pytest.approx(0.05, abs=1e-9)
    assert found.jump_settling_s == pytest.approx(3.0, abs=H)
    assert math.isnan(found.rms_mm[0]) and math.isnan(found.head_rms_mm)

"""Cases of a sweep: the same numbers as the verbs, and failures that are results."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.control.references import built_in
from calib.controlling import control_model, run_controller
from calib.fleet.sweepspec import Base, Case
from calib.fleet.sweeptask import run_case, run_cases
from calib.rig import Rig, rig_text
from calib.sections import imported_camera_section
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario

_CONTROLLER = Base("controller", "pid", "step", "", "truth", 1.0, "auto")
_SCENARIO = Base("scenario", "orientation", "", "", "truth", 2.0, "auto")


def test_the_measures_are_those_of_a_single_run() -> None:
    found = run_case(_CONTROLLER, Case(0, 0, 0, ()), 0)
    rig = SimulatedRig()
    model = control_model(rig)
    single = run_controller("pid", rig, model, built_in(model, "step", 1.0), None, 0, "truth").figures
    assert found["angle_rms_rad"] == single.angle_rms_rad
    assert (found["saturation_1"], found["saturation_2"]) == single.saturation
    assert found["rms_mm_1"] is None and math.isnan(single.rms_mm[0])


def test_options_of_a_scenario_and_a_changed_plant() -> None:
    values = (("scenario.Kp", 500.0), ("scenario.controller", "p"), ("actuator.stiffness_scale", 1.0))
    found = run_case(_SCENARIO, Case(0, 0, 0, values), 0)
    plan = make_scenario("orientation", {"Kp": "500", "controller": "p"})
    assert found == plan.figures(run_scenario(plan, SimulatedRig(), 0, "truth", 2.0))
    stiffer = run_case(_SCENARIO, Case(1, 1, 0, (*values[:2], ("actuator.stiffness_scale", 1.3))), 0)
    assert stiffer["peak_rad"] is not None and found["peak_rad"] is not None
    assert stiffer["peak_rad"] < found["peak_rad"]


def test_noise_belongs_to_the_draw() -> None:
    base = Base("scenario", "orientation", "", "", "sensors", 1.0, "auto")
    one, same, other = (run_case(base, Case(n, n, draw, ()), 3) for n, draw in ((0, 0), (9, 0), (1, 1)))
    assert one == same and one != other


def test_a_case_that_cannot_be_is_a_result() -> None:
    wrong = Case(1, 1, 0, (("actuator.mass_kg", 5000.0),))
    unknown = Case(2, 2, 0, (("scenario.colour", "red"),))
    good, *bad = run_cases(_SCENARIO, (Case(0, 0, 0, ()), wrong, unknown), 0)
    assert good.measures and good.sentence == ""
    assert "actuator.mass_kg is 5000" in bad[0].sentence and bad[0].measures == {}
    assert "colour: is no option" in bad[1].sentence


@pytest.mark.slow
def test_a_filter_is_scored_against_the_truth() -> None:
    A = CAMERA.K @ np.column_stack([PLANE.R_CW[:, :2], PLANE.t_m])
    plane = {
        "R_CW": PLANE.R_CW.tolist(),
        "t_CW_m": PLANE.t_m.tolist(),
        "A_px_per_m": A.tolist(),
        "A_inverse": np.linalg.inv(A).tolist(),
        "rms_px": 0.0,
        "rms_mm": 0.0,
        "verdict": "ok",
    }
    camera = imported_camera_section(CAMERA, "truth").model_dump()
    text = rig_text(Rig.model_validate({"camera": camera, "plane": plane}))
    base = Base("filter", "fused", "swing", text, "sensors", 4.0, "kinematic")
    found = run_case(base, Case(0, 0, 0, ()), 0)
    assert found["nees"] is not None and 0.1 < found["nees"] < 10.0
    assert found["mean_q_mm"] is not None and found["baseline_mean_q_mm"] is not None
    assert found["mean_q_mm"] < found["baseline_mean_q_mm"]

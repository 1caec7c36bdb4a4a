"""Outcomes as JSON: every figure a plain value."""

from __future__ import annotations

import json

import pytest

from calib.control.reach import follow
from calib.control.references import built_in
from calib.controlling import control_model, run_controller
from calib.controlsections import check_json, outcome_json, reach_json
from calib.twin.rig import SimulatedRig

RIG = SimulatedRig()
MODEL = control_model(RIG)


def test_an_outcome() -> None:
    reference = built_in(MODEL, "ellipse", 3.0)
    told = outcome_json(run_controller("torque", RIG, MODEL, reference))
    assert told["controller"] == "torque" and len(told["rms_mm"]) == 2
    assert 0.0 <= told["limited"] <= 1.0 and told["rise_s"] is None
    json.dumps(told)
    assert "limited" not in outcome_json(run_controller("pd", RIG, MODEL, reference))


def test_a_check() -> None:
    reference = built_in(MODEL, "step")
    told = check_json(reference, follow(MODEL, reference.path_m(MODEL.plant.rest_length_m)))
    assert told["possible"] is False and told["at_s"] == 0.0 and "jumps" in told["reason"]
    easy = built_in(MODEL, "ellipse")
    told = check_json(easy, follow(MODEL, easy.q_m))
    assert told["possible"] is True and told["at_s"] is None and told["missing_mm"] < 0.25
    json.dumps(told)


def test_what_is_reached() -> None:
    told = reach_json(MODEL)
    assert told["greatest_length_m"] == pytest.approx(0.09157, abs=1e-5)
    assert told["greatest_angle_rad"] == pytest.approx(0.896, abs=1e-3)
    json.dumps(told)

"""The section `estimator` of rig.yaml."""

from __future__ import annotations

from dataclasses import asdict

import pytest
from pydantic import ValidationError

from calib.estimator.gains import TickNoise, design
from calib.rig_estimator import Estimator, EstimatorGain

LEVEL = {
    "name": "move",
    "accel_phi_radps2": 20.0,
    "accel_length_mps2": 0.05,
    "memory_s": 0.02,
    "friction_s": 1.0,
    "walk_phi_rad_per_sqrt_s": 1e-4,
    "walk_length_m_per_sqrt_s": 0.0,
}
GAIN = asdict(design(TickNoise(8e-3, 4e-4, 2e-3, 0.03), 60.0, 0.025, 0.0475))


def test_what_is_written_is_read_again() -> None:
    section = Estimator.model_validate(
        {"jitter_px": 0.3, "levels": [LEVEL], "constant_gain": GAIN, "verdict": "ok"}
    )
    assert Estimator.model_validate(section.model_dump()) == section


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"jitter_px": 0.0}, "jitter_px"),
        ({"jitter_px": float("nan")}, "jitter_px"),
        ({"levels": [{**LEVEL, "memory_s": -1.0}]}, "memory_s"),
        ({"gyro_noise_radps": "0.1"}, "gyro_noise_radps"),
        ({"colour": 1}, "colour"),
        ({"verdict": "good"}, "verdict"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Estimator.model_validate({"jitter_px": 0.3, "verdict": "ok", **change})


@pytest.mark.parametrize("change", [{"delay_ticks": 9.0}, {"slow": 1.0}, {"lever_m": 0.0}, {"bias": None}])
def test_gains_that_no_controller_can_run_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(change))):
        EstimatorGain.model_validate({**GAIN, **change})

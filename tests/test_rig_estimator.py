"""The section `estimator` of rig.yaml."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from calib.rig_estimator import Estimator, EstimatorAxisGain

LEVEL = {
    "name": "move",
    "accel_phi_radps2": 20.0,
    "accel_length_mps2": 0.05,
    "memory_s": 0.02,
    "friction_s": 1.0,
    "walk_phi_rad_per_sqrt_s": 1e-4,
    "walk_length_m_per_sqrt_s": 0.0,
}
AXIS = {"F": [[1.0, 0.1], [0.0, 1.0]], "H": [[1.0, 0.0]], "K": [[0.3], [-0.1]], "sigma": [0.1, 0.2]}


def test_what_is_written_is_read_again() -> None:
    gain = {
        "rate_hz": 60.0,
        "delay_ticks": 2,
        "phi_level": "a",
        "length_level": "b",
        "phi": AXIS,
        "length": AXIS,
    }
    section = Estimator.model_validate(
        {"jitter_px": 0.3, "levels": [LEVEL], "constant_gain": gain, "verdict": "ok"}
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


@pytest.mark.parametrize("change", [{"F": [[1.0, 0.1]]}, {"K": [[0.3]]}, {"sigma": [0.1]}, {"H": [[1.0]]}])
def test_matrices_have_to_fit(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match="expected F of n x n"):
        EstimatorAxisGain.model_validate({**AXIS, **change})

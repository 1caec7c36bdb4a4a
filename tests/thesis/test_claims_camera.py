"""Claims about the camera: figures, and that outcomes follow from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thesis import claims_camera
from thesis.outcome import Outcome


def test_the_lens_left_out_explains_half_of_the_error() -> None:
    error = claims_camera.mean_error.check().numbers["mean_error_px"]
    assert 0.1 < error < 0.31


def test_the_spread_of_the_coefficients_covers_the_truth() -> None:
    numbers = claims_camera.distortion.check().numbers
    for name, truth in (("k1", -0.2201), ("k2", 0.5494)):
        assert abs(numbers[name] - truth) < 3.0 * numbers[f"sigma_{name}"]


def test_with_the_intrinsics_the_map_is_exact() -> None:
    numbers = claims_camera.homography.check().numbers
    assert numbers["with_K_error_px"] < 1e-9 < 100.0 < numbers["printed_error_px"]
    assert claims_camera.scale.check().numbers["error"] < 1e-12


def test_a_line_bows_as_the_sign_says() -> None:
    numbers = claims_camera.naming.check().numbers
    # Ends at a radius of 0.5, the middle at 0.4: x k1 (0.25 - 0.16).
    assert numbers["bow_positive"] == pytest.approx(0.4 * 0.2 * 0.09)
    assert numbers["bow_negative"] == pytest.approx(-0.4 * 0.2 * 0.09)


def test_another_lens_has_other_outcomes(monkeypatch: pytest.MonkeyPatch) -> None:
    weak = replace(claims_camera.CAMERA, distortion=np.array([-0.004, -0.001, 0, 0, 0, 0, 0, 0.0]))
    monkeypatch.setattr(claims_camera, "CAMERA", weak)
    assert claims_camera.negligible.check().outcome is Outcome.REPRODUCED


def test_the_turning_point_of_mustache_distortion() -> None:
    numbers = claims_camera.mustache.check().numbers
    assert numbers["turns_at"] == pytest.approx(np.sqrt(0.6 * 0.2201 / 0.5494))
    assert numbers["turns_at"] < numbers["corner"]


def test_the_inverse_polynomial_and_the_offset() -> None:
    assert claims_camera.no_closed_form.check().numbers["max_error_px"] <= 0.01
    assert claims_camera.offset.check().numbers["error_m"] < 1e-15
    assert claims_camera.points.check().numbers["points"] == 595

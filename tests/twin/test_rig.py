"""The simulated rig from a rig.yaml: what is taken over, and one sentence for a wrong unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography
from calib.core.rig import read_rig
from calib.stages.actuator.pump import Orifice, RateLimit, static_force_N
from calib.stages.camera.model import Camera, project
from calib.stages.camera.results import camera_from_section
from calib.twin.rig import SimulatedRig, nominal_view, rig_from_file, workspace_homography
from calib.twin.sensors import View


@pytest.fixture
def rig(tmp_path: Path):
    def _rig(text: str) -> SimulatedRig:
        path = tmp_path / "rig.yaml"
        path.write_text(text)
        read = read_rig(path)
        camera = None if read.camera is None else camera_from_section(read.camera)
        return rig_from_file(read, "rig.yaml", camera)

    return _rig


def test_an_empty_file_is_the_nominal_rig(rig) -> None:
    made = rig("provenance: {version: 0.1.0}\n")
    assert made.plant == SimulatedRig().plant
    assert made.pump == SimulatedRig().pump
    assert made.imu == SimulatedRig().imu
    assert made.plant.damping_scale == 16.0
    assert made.free_plant.damping_scale == 3.3


def test_numbers_of_the_actuator_are_taken_over(rig) -> None:
    made = rig(
        "actuator: {mass_kg: 0.02, rest_length_m: 0.07, k0_N_per_m: 50, k2_N_per_m3: 10.0,\n"
        "  lambda1_per_s: 2, damping_scale_free_swing: 3.0, damping_scale_pumps_connected: 12,\n"
        "  gravity_mps2: [0, 9.81], force_projection: head, sigma: {mass_kg: 0.001}, verdict: ok}\n"
    )
    assert (made.plant.mass_kg, made.plant.rest_length_m) == (0.02, 0.07)
    assert made.plant.stiffness.padded == (50.0, 1092.9, 10.0, 0.0)
    assert made.plant.creep_rates == (2.0, 10.0, -1.0)
    assert (made.plant.damping_scale, made.free_plant.damping_scale) == (12.0, 3.0)
    assert made.plant.gravity_mps2 == (0.0, 9.81)
    assert made.plant.force_projection == "head"


def test_numbers_of_the_pumps_are_taken_over(rig) -> None:
    made = rig("pump: {lag_s: 0.5, delay_ticks: 3, falling_N_per_s: 0.5, strength: [1.0, 0.95]}\n")
    assert (made.pump.lag_s, made.pump.delay_ticks) == (0.5, 3)
    assert made.pump.deflation == RateLimit(0.5)
    assert made.pump_strength == (1.0, 0.95)
    made = rig("pump: {deflation: orifice, laminar_s: 0.9}\n")
    assert isinstance(made.pump.deflation, Orifice)
    assert made.pump.deflation.laminar_s == 0.9


def test_a_measured_elongation_is_reached_with_the_rigs_own_springs(rig) -> None:
    made = rig("actuator: {k0_N_per_m: 80}\npump: {elongation_mm: [-0.1493, 3.756, -25.87, 54.13]}\n")
    force = float(static_force_N(made.pump, np.array(255.0)))
    eps = 0.0265636
    assert force == pytest.approx((80.0 + 1092.9 * eps) * eps, rel=1e-4)
    # Without it the pumps are as strong as they are, whatever the springs.
    unchanged = rig("actuator: {k0_N_per_m: 80}\n")
    assert unchanged.pump == SimulatedRig().pump


def test_numbers_of_the_sensors_are_taken_over(rig) -> None:
    made = rig(
        "twin:\n  tracker: {latency_s: 0.04, blackouts_s: [[2, 0.4]], outlier_px: [6, 9]}\n"
        "  imu: {mount_angle_rad: -0.05, gyro_bias_radps: [0, 0, 0.01], onchip: true}\n"
    )
    assert made.tracker.latency_s == 0.04
    assert made.tracker.blackouts_s == ((2.0, 0.4),)
    assert made.tracker.outlier_px == (6.0, 9.0)
    assert made.imu.gyro_bias_radps == (0.0, 0.0, 0.01)
    assert made.imu.onchip


def test_a_calibrated_camera_and_plane_are_taken_over(rig) -> None:
    view = nominal_view()
    A = view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m])
    made = rig(
        "camera: {model: pinhole, image_size_px: [640, 480], fx_px: 500.0, fy_px: 500.0, cx_px: 320.0,\n"
        "  cy_px: 240.0, verdict: ok}\n"
        f"plane: {{R_CW: {view.R_CW.tolist()}, t_CW_m: {view.t_CW_m.tolist()}, A_px_per_m: {A.tolist()},\n"
        f"  A_inverse: {np.linalg.inv(A).tolist()}, rms_px: 0.1, rms_mm: 0.1, verdict: ok}}\n"
    )
    assert made.view.camera.image_size_px == (640, 480)
    assert made.view.camera.fx_px == 500.0
    assert np.array_equal(made.view.R_CW, view.R_CW)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "actuator: {rest_length_m: 65}",
            "actuator.rest_length_m is 65, expected metres between 0.005 and 1; is it in millimetres?",
        ),
        ("actuator: {rest_length_m: -0.065}", "actuator.rest_length_m is -0.065, expected metres between"),
        (
            "actuator: {rest_length_mm: 65}",
            "actuator.rest_length_mm is not a key that is known here; expected rest_length_m",
        ),
        ("actuator: {rest_length_m: 65mm}", "actuator.rest_length_m is '65mm', expected a number (metres)"),
        ("actuator: {mass_kg: 16.6}", "is it in grams?"),
        ("actuator: {bending_N_per_rad2: 169.49}", "is it in mN/rad^2?"),
        ("actuator: {mass_kg: true}", "actuator.mass_kg is True, expected a number"),
        ("actuator: {mass_kg: .nan}", "actuator.mass_kg is nan, expected a number"),
        ("actuator: {gravity_mps2: 9.81}", "actuator.gravity_mps2 is 9.81, expected 2 numbers"),
        ("actuator: {colour: red}", "actuator.colour is not a key that is known here"),
        ("actuator: [1, 2]", "actuator is [1, 2], expected keys with values"),
        ("actuator: {force_projection: sideways}", "actuator: force projection: found 'sideways'"),
        (
            "actuator: {lambda1_per_s: -0.1047, lambda2_N_per_m: -14.98, lambda3: -1.854}",
            "make the plant unstable: it leaves rest at 0.249 1/s",
        ),
        (
            "pump: {lag_s: 700}",
            "pump.lag_s is 700, expected seconds between 0.001 and 60; is it in milliseconds?",
        ),
        ("pump: {delay_ticks: 1.5}", "pump.delay_ticks is 1.5, expected a whole number"),
        ("pump: {deflation: quick}", "pump.deflation is 'quick', expected 'rate_limit' or 'orifice'"),
        ("pump: {strength: [1, -1]}", "pump: pump strength: found (1.0, -1.0)"),
        ("twin: {radio: {}}", "twin.radio is not a key that is known here"),
        ("twin: {tracker: {latency_s: 25}}", "twin.tracker: tracker latency_s: found 25, expected 0 to 1"),
        ("twin: {tracker: {latency_ms: 25}}", "twin.tracker.latency_ms is not a key that is known here"),
        ("twin: {imu: {onchip: 1}}", "twin.imu.onchip is 1, expected true or false"),
        ("twin: {imu: {lever_m: 0.006}}", "twin.imu.lever_m is 0.006, expected a list of numbers"),
        ("twin: {imu: {lever_m: [0, 6]}}", "twin.imu: imu lever_m: found (0.0, 6.0)"),
        ("twin: {imu: {lever_m: [0, far]}}", "twin.imu.lever_m is [0, 'far'], expected a list of numbers"),
    ],
)
def test_one_sentence_for_what_is_wrong(rig, text: str, words: str) -> None:
    with pytest.raises(BadInputError) as found:
        rig(text + "\n")
    message = str(found.value)
    assert message.startswith("rig.yaml: ")
    assert words in message
    assert "\n" not in message


def test_the_homography_without_a_lens_model_is_the_nearest() -> None:
    view = nominal_view()
    x, y = np.meshgrid(np.linspace(-0.04, 0.04, 7), np.linspace(0.08, 0.105, 5))
    world = np.stack([x.ravel(), y.ravel()], axis=1)
    pixels = project(view.camera, world @ view.R_CW[:, :2].T + view.t_CW_m)
    fitted = np.linalg.norm(apply_homography(workspace_homography(view), world) - pixels, axis=1)
    A = view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m])
    naive = np.linalg.norm(apply_homography(A, world) - pixels, axis=1)
    assert fitted.max() < 0.2 < 0.5 < naive.max()
    ideal = View(Camera("pinhole", (316, 208), 273.4, 272.6, 0.0, 160.7, 101.9), view.R_CW, view.t_CW_m)
    H = workspace_homography(ideal)
    assert np.allclose(H / H[2, 2], A / A[2, 2], rtol=1e-8, atol=1e-9)


def test_a_camera_that_looks_elsewhere_is_refused() -> None:
    view = nominal_view()
    with pytest.raises(BadInputError, match="does not see the actuator's workspace"):
        workspace_homography(View(view.camera, view.R_CW, view.t_CW_m + np.array([1.0, 0.0, 0.0])))

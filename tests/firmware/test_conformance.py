"""The reference against the project's filters, kinematics and controllers, which it does not use."""

from __future__ import annotations

import math

import numpy as np
import pytest
from firmware_rigs import header

from calib.stages.actuator.kinematics import head_from_marker, inverse_series
from calib.stages.camera.model import Camera, undistort
from calib.stages.control.laws import (
    FeedForward,
    LoopState,
    OrientationControl,
    Pid,
    PositionControl,
    step_orientation,
    step_position,
)
from calib.stages.firmware.conformance import MODE_ORIENTATION, MODE_POSITION, Inputs, Reference
from calib.stages.firmware.literals import values
from calib.stages.firmware.vectors import binary32
from calib.stages.imu.mahony import Mahony, MahonySample, MahonyState
from calib.stages.imu.mahony import step as step_angle
from calib.stages.lowpass.filters import LowPass, settled
from calib.stages.lowpass.filters import step as step_lowpass
from calib.twin.pictures import CAMERA, PLANE

TICKS = 600


def _ticks(mode: int) -> list[Inputs]:
    made = []
    for k in range(TICKS):
        phi = 0.9 * math.sin(0.02 * k)
        made.append(
            binary32(
                Inputs(
                    158.0 + 60.0 * math.sin(0.017 * k),
                    130.0 + 40.0 * math.cos(0.011 * k),
                    9.81 * math.cos(phi) + 0.4 * math.sin(0.5 * k),
                    9.81 * math.sin(phi) + 0.4 * math.cos(0.7 * k),
                    -0.9 * 0.02 * 60.0 * math.cos(0.02 * k),
                    (0.085 + 0.02 * math.sin(0.03 * k), 0.08)
                    if mode == MODE_POSITION
                    else (0.7 * math.sin(0.01 * k), 0),
                    mode=mode,
                )
            )
        )
    return made


def _true_marker(camera: Camera, u: float, v: float) -> np.ndarray:
    """The point of the plane that the camera shows at a pixel, by the ray through it."""
    x, y = undistort(camera, np.array([[u, v]]))[0]
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    normal = R[:, 2]
    ray = np.array([x, y, 1.0])
    return np.asarray((R.T @ (ray * (normal @ t) / (normal @ ray) - t))[:2])


@pytest.mark.parametrize("mode", [MODE_ORIENTATION, MODE_POSITION])
def test_every_stage_is_the_projects_own(mode: int) -> None:
    """Stage by stage, each fed with what the reference had before it; binary32 constants cost 1e-6."""
    constants = values(header().literals)
    reference = Reference(constants)
    angle: MahonyState | None = None
    lowpass, x, y = LowPass(), None, None
    loop = LoopState()
    turning = OrientationControl(Pid(1000.0, 1000.0, 10.0, clamping=True), whole_pwm=False)
    stretching = PositionControl(Pid(15000.0, 0.0, 150.0), FeedForward(), whole_pwm=False)
    for given in _ticks(mode):
        out = reference.step(given)
        if angle is None:
            angle = MahonyState(math.atan2(given.ay_mps2, given.ax_mps2), 0.0)
        else:
            angle = step_angle(
                Mahony(), angle, MahonySample(given.ax_mps2, given.ay_mps2, given.gz_radps, 1.0 / 60.0)
            )
        assert out.phi_rad == pytest.approx(angle.phi_rad, abs=2e-6)
        # The polynomial undoes the lens to 0.01 px, 0.3 mm/px.
        assert np.abs(np.array(out.marker_m) - _true_marker(CAMERA, given.u_px, given.v_px)).max() < 5e-6
        head = head_from_marker(np.array(out.marker_m), np.array(out.phi_rad))
        x = settled(head[0]) if x is None else step_lowpass(lowpass, x, head[0])
        y = settled(head[1]) if y is None else step_lowpass(lowpass, y, head[1])
        assert out.head_m == pytest.approx((x.y1, y.y1), abs=3e-7)
        q = inverse_series(np.array([*out.head_m, out.phi_rad]), 0.0126)
        assert out.q_m == pytest.approx(q, abs=1e-8)
        if mode == MODE_POSITION:
            loop, command = step_position(stretching, loop, given.reference, out.q_m)
        else:
            loop, command = step_orientation(turning, loop, given.reference[0], out.phi_rad)
        assert out.pwm == pytest.approx(command.pwm, abs=1e-3)


def test_at_rest_the_low_pass_is_exact() -> None:
    reference = Reference(values(header("full").literals))
    given = binary32(Inputs(150.3, 140.7, 9.7, 1.1, 0.0))
    outs = [reference.step(given) for _ in range(3000)]
    head = head_from_marker(
        np.array(outs[-1].marker_m), np.array(outs[-1].phi_rad), reference.c["MARKER_OFFSET_M"]
    )
    assert outs[-1].head_m == pytest.approx(head, abs=1e-9)


def test_back_calculation_brings_the_integral_back() -> None:
    """With the angle out of reach the command stays near its limit instead of winding up."""
    reference = Reference(values(header("full").literals))
    given = binary32(Inputs(150.0, 140.0, 9.81, 0.0, 0.013, (1.4, 0.0), mode=MODE_ORIENTATION))
    for _ in range(3000):
        reference.step(given)
    away = binary32(Inputs(150.0, 140.0, 9.81, 0.0, 0.013, (-0.3, 0.0), mode=MODE_ORIENTATION))
    lowered = [reference.step(away).pwm[0] for _ in range(60)]
    assert reference.c["ORIENTATION_BACK"] == pytest.approx(1.0 / (60.0 * 0.4), rel=1e-6)
    assert lowered[-1] == reference.c["PUMP_LOW_PWM"]


def test_the_delayed_angle_is_that_of_the_picture() -> None:
    """With the offset of two ticks the marker is put back with the angle of two ticks ago."""
    reference = Reference(values(header("full").literals))
    assert reference.c["TIME_OFFSET_TICKS"] == 2
    for given in _ticks(MODE_ORIENTATION)[:5]:
        out = reference.step(given)
    assert reference.memory.past[-1] == out.phi_rad
    assert len(reference.memory.past) == 2

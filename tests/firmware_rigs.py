"""Rigs for the tests of the firmware: the nominal one, and one that has everything."""

from __future__ import annotations

from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np

from calib.core.rig import Rig
from calib.stages.estimator.constant_gain import TickNoise, design
from calib.stages.firmware.header import Header, make_header
from calib.stages.lowpass.filters import Design, design_lowpass
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.rig import SimulatedRig

__all__ = ["header", "rig"]


def _camera(**more: Any) -> dict[str, Any]:
    names = ("fx_px", "fy_px", "skew_px", "cx_px", "cy_px")
    k1, k2 = CAMERA.distortion[:2].tolist()
    section: dict[str, Any] = {name: float(getattr(CAMERA, name)) for name in names}
    section |= {"model": "radial2", "image_size_px": list(CAMERA.image_size_px)}
    section |= {"distortion": {"k1": k1, "k2": k2}, "verdict": "ok"}
    return section | more


def _plane(camera: dict[str, Any], tilt_rad: float | None = None) -> dict[str, Any]:
    K = np.array(
        [
            [camera["fx_px"], camera["skew_px"], camera["cx_px"]],
            [0.0, camera["fy_px"], camera["cy_px"]],
            [0, 0, 1],
        ]
    )
    R, t = np.array(PLANE.R_CW), np.array(PLANE.t_m)
    if tilt_rad is not None:
        c, s = np.cos(tilt_rad), np.sin(tilt_rad)
        R, t = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), np.array([0.0, -0.065, 0.28])
    A = K @ np.column_stack([R[:, 0], R[:, 1], t])
    return {
        "R_CW": R.tolist(),
        "t_CW_m": t.tolist(),
        "A_px_per_m": A.tolist(),
        "A_inverse": np.linalg.inv(A).tolist(),
        "rms_px": 0.0,
        "rms_mm": 0.0,
        "verdict": "ok",
    }


def _align() -> dict[str, Any]:
    return {
        "time_offset_s": 0.035,
        "mount_angle_rad": 0.05,
        "rest_angle_rad": 0.06,
        "gyro_scale": 0.02,
        "gyro_bias_radps": 0.013,
        "accel_bias_mps2": [0.1, 0.1],
        "accel_scale": [0.004, -0.003],
        "imu_lever_m": 0.0,
        "marker_offset_m": 0.0147,
        "plane_shift_m": [0.0, 0.0],
        "plane_stretch": 0.0,
        "jitter_px": 0.1,
        "outlier_share": 0.0,
        "accel_noise_mps2": [0.1, 0.1],
        "gyro_noise_radps": 0.01,
        "verdict": "ok",
    }


def _twin() -> dict[str, Any]:
    rig = SimulatedRig()
    imu, angle = rig.imu, rig.imu.mount_angle_rad
    return {
        "time_offset_s": rig.tracker.latency_s,
        "mount_angle_rad": angle,
        "rest_angle_rad": angle,
        "gyro_scale": imu.gyro_scale[2],
        "gyro_bias_radps": imu.gyro_bias_radps[2],
        "accel_bias_mps2": list(imu.accel_bias_mps2[:2]),
        "accel_scale": list(imu.accel_scale[:2]),
        "marker_offset_m": rig.tracker.marker_offset_m,
    }


def _controller() -> dict[str, Any]:
    return {
        "tick_s": 1.0 / 60.0,
        "pwm_low": 5.0,
        "pwm_high": 250.0,
        "criterion": {"gain_margin": 2.0, "phase_margin_rad": 0.8, "sensitivity": 2.0},
        "orientation": {
            "Kp_pwm_per_rad": 800.0,
            "Ki_pwm_per_rad_s": 900.0,
            "Kd_pwm_s_per_rad": 12.0,
            "back_calculation_s": 0.4,
        },
        "position": {"Kp_pwm_per_m": 12000.0, "Ki_pwm_per_m_s": 8000.0, "Kd_pwm_s_per_m": 300.0},
        "feedforward": {
            "rest_length_m": 0.065,
            "bellows_radius_m": 0.0126,
            "stiffness_N_per_m": [47.7, 1092.9, 0.0, 0.0],
            "bending_N_per_rad2": 0.17,
            "strength": [1.0, 0.98],
            "force_pwm": [[0.0, 99.9], [0.3, 140.0], [1.0, 195.0], [2.04, 255.0]],
        },
        "lag_s": 0.7,
        "delay_ticks": 2,
        "verdict": "ok",
    }


def _gain(delay_s: float) -> dict[str, Any]:
    noise = TickNoise(camera_rad=8.6e-3, camera_m=4.3e-4, gyro_radps=2e-3, accel_rad=0.025)
    return asdict(design(noise, 60.0, delay_s, 0.0475))


def _estimator(delay_s: float) -> dict[str, Any]:
    return {"jitter_px": 0.3, "constant_gain": _gain(delay_s), "verdict": "ok"}


def _lowpass(family: str = "butterworth", order: int = 3) -> dict[str, Any]:
    made = design_lowpass(Design(2.0, 60.0, order, family))
    rows = made.sections.tolist()
    return {
        "family": family,
        "order": order,
        "cutoff_hz": 2.0,
        "rate_hz": 60.0,
        "sections": [{"b": row[:3], "a": row[3:]} for row in rows],
        "rounded_cutoff_hz": 2.0,
        "pole_radius": 0.9,
        "dc_delay_s": 0.1,
        "largest_delay_s": 0.1,
        "noise_gain": 0.1,
        "verdict": "ok",
    }


@cache
def rig(kind: str = "nominal") -> Rig:
    """A rig with camera and plane; "full" with every section, "levelling" the same with that angle filter.

    "fisheye" has a lens of 110 degrees, and an elliptic low-pass. "plain" has no lens, and a low-pass of
    order 8. "tilted" sees the plane from the side, a metre away at the picture's edge. "fused" has what that
    estimator needs, "twin" the same with the sensors of the nominal simulated rig.
    """
    camera = _camera()
    sections: dict[str, Any] = {"camera": camera, "plane": _plane(camera)}
    if kind == "fisheye":
        lens = {"k1": 0.03, "k2": -0.01, "k3": 0.004, "k4": -0.001}
        camera = _camera(model="fisheye4", distortion=lens, fx_px=164.0, fy_px=164.5)
        sections = {"camera": camera, "plane": _plane(camera), "lowpass": _lowpass("elliptic")}
    if kind == "tilted":
        sections["plane"] = _plane(camera, np.radians(60.0))
    if kind == "plain":
        camera, control = _camera(model="pinhole", distortion={}), _controller()
        control["orientation"]["sign"] = -1
        sections = {"camera": camera, "plane": _plane(camera), "lowpass": _lowpass("elliptic", 8)}
        sections["controller"] = control
    if kind == "fused":
        sections |= {"align": {**_align(), "time_offset_s": 0.025}, "estimator": _estimator(0.025)}
    if kind == "twin":
        sections |= {"align": _align() | _twin(), "estimator": _estimator(0.025)}
    if kind in ("full", "levelling"):
        lens = {"k1": -0.2201, "k2": 0.5494, "p1": 0.002, "p2": -0.003, "k3": 0.0}
        camera = _camera(model="brown5", distortion=lens, skew_px=0.8)
        sections = {
            "camera": camera,
            "plane": _plane(camera),
            "align": _align(),
            "estimator": _estimator(0.035),
            "lowpass": _lowpass(),
            "controller": _controller(),
            "orientation_filter": {
                "Kp_per_s": 2.2,
                "Ki_per_s2": 1.4,
                "rate_hz": 100.0,
                "recommended": "tuned",
                "recommended_by": "reference",
                "verdict": "ok",
            },
            "actuator": {"bellows_radius_m": 0.0131, "rest_length_m": 0.066},
        }
    if kind == "levelling":
        sections["orientation_filter"] |= {"filter": "levelling", "tau_s": 1.5, "velocity_mps": 0.05}
    return Rig.of(sections, "rig.yaml")


@cache
def header(kind: str = "nominal") -> Header:
    """The header of that rig."""
    return make_header(rig(kind), "rig.yaml")

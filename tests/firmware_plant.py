"""The simulated rig one tick at a time in compiled code, for loops that a processor closes.

Plant and pumps are `calib.stages.actuator.simulate.run`; the sensors' arithmetic is the twin's written for
one sample, with the twin's noise. `tests/firmware/test_plant.py` holds both against `calib.twin.simulate`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.core.arrays import FloatArray
from calib.stages.actuator.pump import ElongationForce
from calib.stages.actuator.simulate import derivative, rig_at_rest
from calib.stages.actuator.simulate import run as run_kernel
from calib.twin.rig import SimulatedRig
from calib.twin.sensors import head_rows, states_between
from calib.twin.simulate import _NODES_PER_TICK, _SUBSTEPS, _Plant, _Sensors

__all__ = ["Loop"]

_PER = _NODES_PER_TICK


@dataclass(frozen=True)
class _Numbers:
    """Camera, plane, tracker, IMU and pumps as arrays for the compiled functions."""

    view: FloatArray
    imu: FloatArray
    pump: FloatArray


def _numbers(rig: SimulatedRig) -> _Numbers:
    camera, imu, static = rig.view.camera, rig.imu, rig.pump.static
    assert isinstance(static, ElongationForce)
    parts = [
        rig.view.R_CW[:, 0],
        rig.view.R_CW[:, 1],
        rig.view.t_CW_m,
        [camera.fx_px, camera.fy_px, camera.skew_px, camera.cx_px, camera.cy_px],
        camera.distortion,
        [rig.tracker.marker_offset_m, rig.tracker.grid_px, *camera.image_size_px],
    ]
    mount = imu.mount_angle_rad
    readings = [
        *(math.cos(mount), math.sin(mount), *imu.lever_m, *imu.gravity_mps2),
        *(1.0 + imu.accel_scale[0], 1.0 + imu.accel_scale[1], 1.0 + imu.gyro_scale[2]),
        *(imu.accel_step_mps2, imu.accel_range_mps2, imu.gyro_step_radps, imu.gyro_range_radps),
    ]
    spring = [*static.stiffness.coefficients, 0.0, 0.0, 0.0, 0.0][:4]
    pump = [*static.elongation_mm, static.supply_V, static.dead_zone_V, *spring]
    return _Numbers(
        np.concatenate([np.asarray(part, dtype=np.float64) for part in parts]),
        np.array(readings),
        np.array([*pump, *rig.pump_strength]),
    )


@njit(cache=True, error_model="numpy")
def _coarse(value: float, step: float, limit: float) -> float:
    if step <= 0.0:
        return min(max(value, -limit), limit)
    most = math.floor(limit / step + 1e-9)
    return step * min(max(math.floor(value / step + 0.5), -most), most)


@njit(cache=True, error_model="numpy")
def _sample(n: FloatArray, motion: FloatArray, accel: FloatArray, gyro: FloatArray, out: FloatArray) -> None:
    """a_x, a_y, g_z of the head's motion (7,) with the noise (3,), (3,) of the sample."""
    s, cosine, dphi, ddphi = math.sin(motion[0]), math.cos(motion[0]), motion[1], motion[2]
    arm_x, arm_y = cosine * n[2] + s * n[3], cosine * n[3] - s * n[2]
    f_x = motion[5] + ddphi * arm_y - dphi * dphi * arm_x - n[4]
    f_y = motion[6] - ddphi * arm_x - dphi * dphi * arm_y - n[5]
    x, y = -(s * f_x + cosine * f_y), cosine * f_x - s * f_y
    out[2] = _coarse(n[6] * (n[0] * x - n[1] * y) + accel[0], n[9], n[10])
    out[3] = _coarse(n[7] * (n[1] * x + n[0] * y) + accel[1], n[9], n[10])
    out[4] = _coarse(-n[8] * dphi + gyro[2], n[11], n[12])


@njit(cache=True, error_model="numpy")
def _picture(r: float, n: FloatArray, state: FloatArray, offset: FloatArray, out: FloatArray) -> bool:
    """u, v of the marker of a state (10,) with jitter and outliers (2,); whether it was seen."""
    phi, length = (state[0] - state[1]) / (2.0 * r), 0.5 * (state[0] + state[1])
    h = 0.5 * phi
    rho = length * (math.sin(h) / h if h != 0.0 else 1.0)
    d = n[22]
    X, Y = rho * math.sin(h) + d * math.sin(phi), rho * math.cos(h) + d * math.cos(phi)
    p1, p2, p3 = n[0] * X + n[3] * Y + n[6], n[1] * X + n[4] * Y + n[7], n[2] * X + n[5] * Y + n[8]
    if not p3 > 0.0:
        return False
    x, y = p1 / p3, p2 / p3
    k1, k2, t1, t2, k3, k4, k5, k6 = n[14], n[15], n[16], n[17], n[18], n[19], n[20], n[21]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2.0 * t1 * x * y + t2 * (r2 + 2.0 * x * x)
    yd = y * radial + t1 * (r2 + 2.0 * y * y) + 2.0 * t2 * x * y
    u, v = n[9] * xd + n[11] * yd + n[12] + offset[0], n[10] * yd + n[13] + offset[1]
    if n[23] > 0.0:
        u, v = n[23] * math.floor(u / n[23] + 0.5), n[23] * math.floor(v / n[23] + 0.5)
    out[0], out[1] = u, v
    return -0.5 <= u <= n[24] - 0.5 and -0.5 <= v <= n[25] - 0.5


@njit(cache=True, error_model="numpy")
def _force(n: FloatArray, pwm: float, strength: float) -> float:
    u = n[4] * pwm / 255.0
    eps = 1e-3 * (((n[0] * u + n[1]) * u + n[2]) * u + n[3])
    if u < n[5] or eps < 0.0:
        eps = 0.0
    return float((((n[9] * eps + n[8]) * eps + n[7]) * eps + n[6]) * eps * strength)


class Loop:
    """A rig from rest, tick by tick: `look`, then `move` with the commands of two ticks before.

    Attributes
    ----------
    record : (7,) u, v, a_x, a_y, g_z of the last look, and room for a reference.
    """

    def __init__(self, rig: SimulatedRig, ticks: int, seed: int = 5) -> None:
        self._plant = _Plant(rig, rig.plant)
        self._sensors = _Sensors(rig, self._plant, ticks, seed)
        start = rig_at_rest(rig.plant, rig.pump)
        self.nodes = np.empty((ticks * _PER + 1, start.row.size))
        self.nodes[0] = start.row
        self._waiting = [np.array(pair, dtype=np.float64) for pair in start.waiting_pwm]
        self._n = _numbers(rig)
        self.record = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0, 0.0])

    def look(self, k: int) -> bool:
        """Write the readings of tick k, the IMU's where a sample came; whether a marker was seen."""
        c, node_s, past = self._plant.c, self._plant.tick_s / _PER, self.nodes[: _PER * k + 1]
        imu, tracker, due = self._sensors.imu, self._sensors.tracker, self._sensors.due
        last = int(due[k]) - 1
        if last >= 0 and (k == 0 or due[k] > due[k - 1]):
            states = states_between(node_s, past, imu.taken_s[last : last + 1])
            rates = derivative(c, states[0, :6], states[0, 8], states[0, 9])
            motion = head_rows(c.r, states, rates[2:4].reshape(1, 2))[0]
            _sample(self._n.imu, motion, imu.accel[last], imu.gyro[last], self.record)
        if tracker.missing[k]:
            return False
        state = states_between(node_s, past, tracker.exposed_s[k : k + 1])[0]
        return bool(_picture(c.r, self._n.view, state, tracker.offset_px[k], self.record))

    def move(self, k: int, pwm: FloatArray) -> None:
        """Give the commands (2,) of tick k, and let the plant move on to the next tick."""
        plant, n, at = self._plant, self._n.pump, _PER * k
        self._waiting.append(pwm)
        arriving = self._waiting.pop(0)
        static = np.array([[_force(n, arriving[0], n[10]), _force(n, arriving[1], n[11])]])
        room = self.nodes[at + 1 : at + _PER + 1]
        every = _SUBSTEPS // _PER
        assert run_kernel(plant.c, plant.p, self.nodes[at], static, plant.tick_s, _SUBSTEPS, every, room) < 0

    def lengths(self) -> FloatArray:
        """Lengths of the bellows at the ticks (n + 1, 2)."""
        return self.nodes[::_PER, :2]

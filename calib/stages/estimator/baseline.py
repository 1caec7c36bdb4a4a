"""The source's own pipeline, run on a log: what the fused estimator is compared with.

    IMU     ->  MM filter 3/3 at the rate it counts on                            phi       (2.3)
    camera  ->  homography without undistortion  ->  marker                              (2.11), (2.12)
            ->  head by the marker's offset and phi                                       (A.1)
            ->  first-order low-pass, 1 Hz at 60 Hz                               x, y
    x, y, phi  ->  series of the inverse kinematics                               q1, q2  (3.12), (3.14)

It counts samples and looks at no time stamp. Latency, bias, mount angle and lens are not corrected. Where
the camera found nothing the last marker is held. It has no covariance; its output at a row is what it has
made of all rows up to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.io.columns import BASELINE
from calib.stages.actuator.kinematics import inverse_coefficients
from calib.stages.camera.model import Camera
from calib.stages.camera.pose import homography_with_lens
from calib.stages.estimator.kinematic import Rows

_SERIES = np.array([float(c) for c in inverse_coefficients()])
_MEMORY = 12


@dataclass(frozen=True)
class BaselineSetup:
    """Constants of the pipeline.

    Attributes
    ----------
    to_plane : (3, 3), pixels to metres, A^-1 of (2.11).
    bellows_radius_m, rest_length_m, marker_offset_m : r_B, the length before the first picture, d.
    imu_rate_hz, camera_rate_hz : rates that the filters count on.
    Kp, Ki : gains of the MM filter. cutoff_hz : of the low-pass.
    """

    to_plane: FloatArray
    bellows_radius_m: float
    rest_length_m: float = 0.065
    marker_offset_m: float = 0.015
    imu_rate_hz: float = 100.0
    camera_rate_hz: float = 60.0
    Kp: float = 3.0
    Ki: float = 3.0
    cutoff_hz: float = 1.0


def undistorting_nothing(
    camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, workspace_m: Sequence[float]
) -> FloatArray:
    """A^-1 (3, 3) of `homography_with_lens`, as a calibration without a lens finds it.

    Raises `BadInputError` where the camera does not see enough of the workspace.
    """
    H = homography_with_lens(camera, R_CW, t_CW_m, workspace_m)
    if H is None:
        raise BadInputError("plane: the camera does not see the workspace")
    return np.asarray(np.linalg.inv(H), dtype=np.float64)


@kernel()
def _run(
    t: FloatArray, readings: FloatArray, kinds: IntArray, numbers: FloatArray, to_plane: FloatArray,
    series: FloatArray, memory: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    radius, offset, period, Kp, Ki, b0, a1 = (
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6],
    )  # fmt: skip
    for row in range(len(t)):
        ax, ay, gz = readings[row, 2], readings[row, 3], readings[row, 4]
        if kinds[row] & 2 and not (math.isnan(ax) or math.isnan(ay) or math.isnan(gz)):
            angle = math.atan2(ay, ax)
            if memory[0] == 0.0:
                memory[0], memory[1] = 1.0, angle
            else:
                e = angle - memory[1]
                e -= 2.0 * math.pi * math.floor(e / (2.0 * math.pi) + 0.5)
                memory[2] += Ki * e * period
                memory[1] += (Kp * e + memory[2] - gz) * period
        phi = memory[1]
        if kinds[row] & 1:
            u, v = readings[row, 0], readings[row, 1]
            if not (math.isnan(u) or math.isnan(v)):
                s = 1.0 / (to_plane[2, 0] * u + to_plane[2, 1] * v + to_plane[2, 2])
                memory[4] = s * (to_plane[0, 0] * u + to_plane[0, 1] * v + to_plane[0, 2])
                memory[5] = s * (to_plane[1, 0] * u + to_plane[1, 1] * v + to_plane[1, 2])
                memory[3] = 1.0
            if memory[3] == 1.0:
                x, y = memory[4] - offset * math.sin(phi), memory[5] - offset * math.cos(phi)
                if memory[6] == 0.0:
                    memory[6], memory[7], memory[8], memory[9], memory[10] = 1.0, x, x, y, y
                else:
                    memory[8] = b0 * (x + memory[7]) - a1 * memory[8]
                    memory[10] = b0 * (y + memory[9]) - a1 * memory[10]
                    memory[7], memory[9] = x, y
                w, f = phi * phi, 0.0
                for k in range(len(series) - 1, -1, -1):
                    f = f * w + series[k]
                memory[11] = 0.5 * math.hypot(memory[8], memory[10]) * f
        length = memory[11]
        out[row, 0] = t[row]
        out[row, 1], out[row, 2] = length + radius * phi, length - radius * phi
        out[row, 3], out[row, 4], out[row, 5], out[row, 6] = phi, length, memory[8], memory[10]


class Baseline:
    """The pipeline at work: rows in, estimates out."""

    def __init__(self, setup: BaselineSetup) -> None:
        self.setup = setup
        self._memory = np.zeros(_MEMORY)
        self._memory[10] = self._memory[11] = setup.rest_length_m
        K = math.tan(math.pi * setup.cutoff_hz / setup.camera_rate_hz)
        self._numbers = np.array(
            [
                setup.bellows_radius_m, setup.marker_offset_m, 1.0 / setup.imu_rate_hz, setup.Kp, setup.Ki,
                K / (1.0 + K), (K - 1.0) / (K + 1.0),
            ]
        )  # fmt: skip

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(BASELINE)) at the rows; call again with the rows that follow."""
        out = np.empty((len(rows), len(BASELINE)))
        _run(
            rows.t_s, rows.readings, rows.kinds, self._numbers, self.setup.to_plane, _SERIES, self._memory,
            out,
        )  # fmt: skip
        return out

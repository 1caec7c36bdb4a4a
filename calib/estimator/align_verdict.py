"""Whether an alignment can be used, and what its logs could not tell apart.

What has to be known is the time offset and the angle read at rest. Of the others a combination is
often known much better than each alone: with the correlation r of two quantities, a part sqrt(1 - r^2) of
their deviations is left once the other is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calib.arrays import BoolArray
from calib.estimator.align import Alignment
from calib.estimator.sensors import SENSOR

__all__ = ["NAMES", "AlignJudgement", "judge_align"]

NAMES = {
    "gyro_bias_radps": "the gyroscope's bias",
    "accel_bias_x_mps2": "the accelerometer's bias along x",
    "accel_bias_y_mps2": "the accelerometer's bias along y",
    "mount_angle_rad": "the mount angle",
    "gyro_scale": "the gyroscope's scale",
    "imu_lever_m": "the IMU's place along the head",
    "marker_offset_m": "the marker's offset d",
    "time_offset_s": "the time offset",
    "shift_x_m": "the plane's shift along x",
    "shift_y_m": "the plane's shift along y",
    "stretch": "the plane's stretch",
    "accel_scale_x": "the accelerometer's scale along x",
    "accel_scale_y": "the accelerometer's scale along y",
}

_OFFSET_S = (1e-3, 1e-2)
_REST_RAD = math.radians(0.1)
_OUTLIERS = (0.2, 0.5)
_SHORT_S = 3.0
_JITTER_PX = 1.5
_FACTOR, _NO_FACTOR = 0.2, 0.5
_BEYOND_PRIOR = 4.0
_NOTHING_LEARNT = 0.8
_INSEPARABLE = 0.98
_TURNED_RAD = 0.02
_SWING = "a log of a free swing, let go at 20 degrees, shows the time offset within a millisecond"
_TILT = "slow motion to large angles both ways tells the mount angle from the accelerometer's bias"


@dataclass
class AlignJudgement:
    """Verdict ok, poor or unidentifiable, with sentences."""

    verdict: Literal["ok", "poor", "unidentifiable"] = "ok"
    reasons: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)

    def lower(self, to: Literal["poor", "unidentifiable"], reason: str) -> None:
        """A reason why the verdict is not better."""
        if self.verdict != "unidentifiable":
            self.verdict = to
        self.reasons.append(reason)


def _data(found: Alignment, out: AlignJudgement) -> None:
    pictures = sum(log.pictures for log in found.logs)
    outliers = sum(log.outliers for log in found.logs)
    share = outliers / max(pictures, 1)
    if share > _OUTLIERS[0]:
        out.lower(
            "unidentifiable" if share > _OUTLIERS[1] else "poor",
            f"{100.0 * share:.0f} % of {pictures} pictures show something else than the marker",
        )
    duration = sum(log.duration_s for log in found.logs)
    if duration < _SHORT_S:
        out.lower(
            "poor", f"the logs are too short: {duration:.2g} s together, expected {_SHORT_S:g} s or more"
        )
    if not found.converged:
        out.lower("poor", f"the fit has not converged after {found.steps} steps")
    if found.noise.jitter_px > _JITTER_PX:
        out.lower(
            "poor",
            f"pictures miss the fit by {found.noise.jitter_px:.2g} px; camera, plane or constant curvature "
            "do not hold",
        )
    turned = max((log.turned_rad for log in found.logs), default=0.0)
    if turned > _TURNED_RAD and abs(found.factor - 1.0) > _FACTOR:
        out.lower(
            "unidentifiable" if abs(found.factor - 1.0) > _NO_FACTOR else "poor",
            f"the camera sees {found.factor:.2g} times the turn that the gyroscope feels",
        )


def _known(found: Alignment, out: AlignJudgement) -> None:
    sigma = found.sigma
    offset = float(sigma[SENSOR.index("time_offset_s")])
    if offset > _OFFSET_S[0]:
        turned = max((log.turned_rad for log in found.logs), default=0.0)
        why = ""
        if turned < _TURNED_RAD:
            why = f": the logs hardly move (phi by {math.degrees(turned):.2g} degrees)"
        words = "is not observable, its deviation is" if offset > _OFFSET_S[1] else "has a deviation of"
        out.lower(
            "unidentifiable" if offset > _OFFSET_S[1] else "poor",
            f"the time offset {words} {1e3 * offset:.2g} ms, expected 1 ms{why}",
        )
        out.advice.append(_SWING)
    if found.rest_angle_sigma > _REST_RAD:
        out.lower(
            "poor",
            f"the angle read at rest is known to {math.degrees(found.rest_angle_sigma):.2g} degrees, "
            "expected 0.1 degrees",
        )
    for k, name in enumerate(SENSOR):
        away = abs(found.sensor[k] - found.mean[k]) / found.prior[k]
        if away > _BEYOND_PRIOR:
            out.lower("poor", f"{NAMES[name]} came out as {found.sensor[k]:.3g}, which is not to be expected")


def _groups(tied: BoolArray) -> list[list[int]]:
    """Groups of two or more quantities that are tied to each other, directly or by others."""
    left, groups = set(range(len(tied))), []
    while left:
        group, new = set(), {min(left)}
        while new:
            group |= new
            new = {k for i in new for k in np.flatnonzero(tied[i]).tolist()} - group
        left -= group
        if len(group) > 1:
            groups.append(sorted(group))
    return groups


def _separable(found: Alignment, out: AlignJudgement) -> None:
    sigma = found.sigma
    R = found.covariance / sigma / sigma[:, None]
    mount, bias = SENSOR.index("mount_angle_rad"), SENSOR.index("accel_bias_y_mps2")
    unlearnt = [k for k in range(len(SENSOR)) if sigma[k] > _NOTHING_LEARNT * found.prior[k]]
    if sigma[mount] > 2.0 * found.rest_angle_sigma or R[mount, bias] < -_INSEPARABLE:
        out.remarks.append(
            "the mount angle and the accelerometer's bias along y are nearly one number "
            f"(correlation {R[mount, bias]:.3f}): together, as the angle read at rest at phi = 0, they are "
            f"{math.degrees(found.rest_angle_rad):.3f} +- {math.degrees(found.rest_angle_sigma):.3f} deg, "
            f"the mount angle alone {math.degrees(found.sensor[mount]):.2f} +- "
            f"{math.degrees(sigma[mount]):.2f} deg"
        )
        if sigma[mount] > _REST_RAD:
            out.advice.append(_TILT)
    for group in _groups(np.abs(R) > _INSEPARABLE):
        if set(group) != {mount, bias}:
            words = [NAMES[SENSOR[k]] for k in group]
            out.remarks.append(
                f"hardly told apart from each other: {', '.join(words[:-1])} and {words[-1]}; what they do "
                "together is known much better than each, see the covariance"
            )
    if unlearnt:
        out.remarks.append(
            "the logs say next to nothing of " + ", ".join(NAMES[SENSOR[k]] for k in unlearnt)
            + ": as assumed beforehand"
        )  # fmt: skip


def judge_align(found: Alignment) -> AlignJudgement:
    """Verdict on an alignment."""
    out = AlignJudgement()
    _data(found, out)
    _known(found, out)
    _separable(found, out)
    if not np.isfinite(found.covariance).all():
        out.lower("unidentifiable", "the covariance is not finite")
    return out

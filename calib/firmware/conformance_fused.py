"""The tick with the fused estimator in float64, what CALIB_FUSED 1 is held against.

As `calib.firmware.conformance`: the header's constants, exact functions, the order of decisions of
`calib_pipeline.h`. Rest or motion, and a picture left out or not, are taken from the firmware's flags where
they are given, with the distance of the reference's own value from the limit where it would have decided
otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from calib.firmware.conformance import (
    ACCEL_WEAK,
    ANGLE_LIMIT,
    BY_FUSED,
    BY_MEAN_RATE,
    IMU_HELD,
    MARKER_HELD,
    MOVING,
    REJECTED,
    Inputs,
    Pair,
    Reference,
    clip,
    older,
)

__all__ = ["FusedReference", "reference_of"]


@dataclass
class _Fused:
    """What the estimator remembers; `past` are the last ticks' angles, the oldest first.

    `chord` is that of the time of the picture.
    """

    length: float
    past: list[float]
    bias: float = 0.0
    half: float = 0.0
    rate: float = 0.0
    slow: float = 0.0
    boost: int = 0
    moving: int = 0
    rejected: int = 0
    chord: float = 0.0

    def follow(self, more: float) -> None:
        """Correct the length, and the chord by as much."""
        self.length += more
        self.chord += more


def _sinc(h: float) -> float:
    return math.sin(h) / h if h else 1.0


class FusedReference(Reference):
    """The tick in float64.

    Parameters
    ----------
    values, undistort : as of `Reference`. mean_rate : CALIB_RATE_IS_MEAN.
    """

    def __init__(
        self, values: Mapping[str, float], undistort: bool | None = None, mean_rate: bool = False
    ) -> None:
        self.mean_rate = mean_rate
        super().__init__(values, undistort)

    def start(self) -> None:
        """Forget everything, as calib_start."""
        super().start()
        self.fused = _Fused(self.c["REST_LENGTH_M"], [0.0] * int(self.c["FUSED_TICKS"]))

    def _turn(self, given: Inputs) -> tuple[int, bool, float, float]:
        """Flags, whether the IMU's sample is used, and gravity along and across the head."""
        c, m, f = self.c, self.memory, self.fused
        A = B = 0.0
        flags, sampled = 0, self._sampled(given)
        if sampled:
            ax, ay = c["IMU_SIGN_AX"] * given.ax_mps2, c["IMU_SIGN_AY"] * given.ay_mps2
            A = c["FUSED_ACCEL_11"] * ax + c["FUSED_ACCEL_12"] * ay - c["FUSED_ACCEL_1"]
            B = c["FUSED_ACCEL_21"] * ax + c["FUSED_ACCEL_22"] * ay - c["FUSED_ACCEL_2"]
            rate = c["IMU_SIGN_GZ"] * given.gz_radps
            half = c["FUSED_HALF_BIAS_RAD"] - c["FUSED_HALF_DT_S"] * rate
            if max(abs(A), abs(B)) <= c["FUSED_ACCEL_WEAK"]:
                flags = ACCEL_WEAK
            if min(m.imu_age, m.marker_age) <= c["HOLD_TICKS"]:
                before = half if self.mean_rate or m.imu_age else f.half
                m.phi += half + before + f.bias
            elif flags:
                sampled = False
            else:
                m.phi = clip(math.atan2(B, A), c["PHI_LIMIT_RAD"])
                f.past = [m.phi] * len(f.past)
            f.half = half
        if sampled:
            m.imu_age = 0
        else:
            m.imu_age = older(m.imu_age)
            self._counted("imu")
            flags |= IMU_HELD
        return flags, sampled, A, B

    def _picture(
        self, then: float, age: int, afresh: bool, sampled: bool, decided: int | None
    ) -> tuple[int, float, bool, float]:
        """Flags, correction of the angle, whether it stands alone, and what was undecided [m]."""
        c, m, f, flags, undecided = self.c, self.memory, self.fused, 0, 0.0
        sh, ch, d = math.sin(0.5 * then), math.cos(0.5 * then), c["MARKER_OFFSET_M"]
        X, Y = m.marker
        across, along = X * ch - (Y + d) * sh, X * sh + (Y - d) * ch
        if afresh or f.rejected >= c["FUSED_PATIENCE"]:
            f.chord, f.length, f.rate, f.slow, f.rejected = along, along / _sinc(0.5 * then), 0.0, 0.0, 0
            f.boost, f.moving = int(c["FUSED_BOOST_TICKS"]), int(c["FUSED_MOVING_TICKS"])
        e = along - f.chord
        if f.boost:
            f.boost -= 1
            f.follow(c["FUSED_BOOST"] * e)
            return 0, clip(c["FUSED_BOOST_PHI_PER_M"] * across, c["FUSED_BOOST"]), True, 0.0
        far = max(abs(across), abs(e)) - c["FUSED_GATE_M"]
        rejected = far > 0.0
        if decided is not None and bool(decided & REJECTED) != rejected:
            rejected, undecided = not rejected, abs(far)
        if rejected:
            f.rejected += 1
            f.rate *= c["FUSED_RATE_DECAY"]
            m.marker_age = older(age)
            self._counted("rejected")
            return REJECTED, 0.0, False, undecided
        f.rejected = 0
        f.slow += c["FUSED_SLOW"] * (e - f.slow)
        over = max(abs(f.slow) - c["FUSED_MOVING_M"], abs(f.rate) - c["FUSED_STILL_M"])
        moves = over > 0.0
        if decided is not None and bool(decided & MOVING) != moves:
            moves, undecided = not moves, max(undecided, abs(over))
        if moves:
            f.moving, flags = int(c["FUSED_MOVING_TICKS"]), MOVING
        else:
            f.moving = max(f.moving - 1, 0)
        if f.moving:
            f.follow(c["FUSED_MOVING_LENGTH"] * e)
            f.rate += c["FUSED_MOVING_RATE"] * e
        else:
            f.follow(c["FUSED_REST_LENGTH"] * e)
            f.rate *= c["FUSED_RATE_DECAY"]
        gain = c["FUSED_PHI_PER_M"] if sampled else c["FUSED_ALONE_PHI_PER_M"]
        return flags, gain * across, not sampled, undecided

    def _estimate(self, given: Inputs, decided: int | None) -> tuple[int, Pair, Pair, float]:
        c, m, f = self.c, self.memory, self.fused
        age, undecided = m.marker_age, 0.0
        flags, sampled, A, B = self._turn(given)
        flags |= BY_FUSED | (BY_MEAN_RATE if self.mean_rate else 0)
        seen, afresh = self._marker(given)
        flags |= seen
        line = [*f.past, m.phi]
        then = line[0] + (c["FUSED_PART"] * (line[1] - line[0]) if f.past else 0.0)
        correction = 0.0
        if sampled and not flags & ACCEL_WEAK:
            whole = c["FUSED_ACCEL_GAIN"]
            pull = B * math.cos(then) - A * math.sin(then) - whole * (m.phi - then)
            correction = clip(pull, whole)
        f.length += f.rate
        f.chord = _sinc(0.5 * then) * (f.length - c["FUSED_DELAY_TICKS"] * f.rate)
        if flags & MARKER_HELD:
            f.rate *= c["FUSED_RATE_DECAY"]
        else:
            told, more, alone, undecided = self._picture(then, age, afresh, sampled, decided)
            flags |= told
            correction = more if alone else correction + more
        limit = c["PHI_LIMIT_RAD"]
        if sampled and not f.boost:
            f.bias = clip(f.bias + c["FUSED_BIAS"] * correction, c["MM_INTEGRAL_LIMIT_RAD"])
        m.phi += correction
        if abs(m.phi) > limit:
            m.phi = clip(m.phi, limit)
            flags |= ANGLE_LIMIT
        if f.past:
            f.past = [*(clip(angle + correction, limit) for angle in f.past[1:]), m.phi]
        turned = c["BELLOWS_RADIUS_M"] * m.phi
        head = (f.chord * math.sin(0.5 * then), f.chord * math.cos(0.5 * then))
        return flags, head, (f.length + turned, f.length - turned), undecided


def reference_of(
    values: Mapping[str, float], undistort: bool | None = None, fused: bool = False, mean_rate: bool = False
) -> Reference:
    """The reference for CALIB_FUSED and CALIB_RATE_IS_MEAN."""
    return FusedReference(values, undistort, mean_rate) if fused else Reference(values, undistort)

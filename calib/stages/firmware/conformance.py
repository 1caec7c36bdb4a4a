"""What the firmware has to compute, in float64: the reference that C, AVR and boards are held against.

It takes the constants of a header as a compiler reads them, rounded to binary32, and inputs in the same
precision, so that what differs is the firmware's own rounding and its polynomials alone. Those it does not
share: angle, sine and cosine are the library's here. The order of decisions is that of `calib_pipeline.h`.

Decisions on computed values (integration left out or not) can fall either way when the value lies within
rounding of the limit. `step` therefore takes what the firmware decided, and reports how far its own value
was from the limit where it would have decided otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.io.serial import MODE_OFF, MODE_ORIENTATION, MODE_POSITION, Inputs, Outputs

MARKER_HELD, HORIZON, IMU_HELD, ACCEL_WEAK = 0x1, 0x2, 0x4, 0x8
ANGLE_LIMIT, STALE, BAD_REFERENCE = 0x10, 0x20, 0x40
CLAMPED, SATURATED = (0x80, 0x100), (0x200, 0x400)
REJECTED, MOVING, BY_MEAN_RATE, BY_FUSED = 0x800, 0x1000, 0x4000, 0x8000

COUNTERS = ("marker", "horizon", "imu", "stale", "reference", "saturated", "rejected")

REFERENCE_LIMIT = 6.3
_NEVER = 0xFFFF

Pair = tuple[float, float]


def binary32(given: Inputs) -> Inputs:
    """Inputs as the firmware gets them."""
    with np.errstate(over="ignore"):
        return Inputs.of(np.array(given.numbers, dtype=np.float32).tolist(), given.sensors, given.mode)


@dataclass(frozen=True)
class Wanted(Outputs):
    """What a tick has to give.

    Attributes
    ----------
    undecided_pwm : how far outputs were from the limits where the firmware decided otherwise on them.
    undecided_m : the same of the fused estimator's gate and of its telling rest from motion.
    """

    undecided_pwm: float = 0.0
    undecided_m: float = 0.0


@dataclass
class _Memory:
    phi: float = 0.0
    integral: float = 0.0
    level: float = 0.0
    before: float = 0.0
    ticks: int = 0
    step: int = 0
    marker: tuple[float, float] = (0.0, 0.0)
    lowpass: list[list[float]] = field(default_factory=list)
    sum: list[float] = field(default_factory=lambda: [0.0, 0.0])
    error: list[float] = field(default_factory=lambda: [0.0, 0.0])
    past: list[float] = field(default_factory=list)
    marker_age: int = _NEVER
    imu_age: int = _NEVER
    mode: int = MODE_OFF


def older(age: int) -> int:
    """An age after one more tick; what was never heard stays so."""
    return age if age >= _NEVER - 1 else age + 1


def late(given: Inputs) -> float:
    """Ticks, 0 to 1, by which the picture comes later than the logs' delay says."""
    known = 0.0 <= given.late_ticks <= 1.0 and math.copysign(1.0, given.late_ticks) > 0.0
    return given.late_ticks if known else 1.0


def decide(own: bool, decided: int | None, bit: int, off: float) -> tuple[bool, float]:
    """A decision as the firmware's flags have it, and where that is another how far it was from the limit.

    Parameters
    ----------
    decided : flags of the firmware, None where the reference decides. off : distance of the reference's value
        from the limit.
    """
    differs = decided is not None and bool(decided & bit) != own
    return own != differs, off if differs else 0.0


def clip(value: float, limit: float) -> float:
    """A value within +-limit."""
    return min(max(value, -limit), limit)


class Reference:
    """The tick in float64.

    Parameters
    ----------
    values : constants by their names in the header, see `header.values`.
    undistort : CALIB_UNDISTORT; by default 1 where the camera has a lens.
    """

    def __init__(self, values: Mapping[str, float], undistort: bool | None = None) -> None:
        self.c = {name.removeprefix("CALIB_"): value for name, value in values.items()}
        self.undistort = bool(self.c.get("CAMERA_HAS_LENS", 0)) if undistort is None else undistort
        self.start()

    def start(self) -> None:
        """Forget everything, as calib_start."""
        pairs, singles = int(self.c["LOWPASS_PAIRS"]), int(self.c["LOWPASS_SINGLES"])
        self.memory = _Memory(
            lowpass=[[0.0] * (2 * pairs + singles) for _ in range(2)],
            past=[0.0] * (int(self.c["TIME_OFFSET_TICKS"]) + 1),
            integral=self.c["MM_GYRO_BIAS_DT_RAD"],
        )
        self.count = dict.fromkeys(COUNTERS, 0)

    def _count(self, name: str) -> None:
        self.count[name] = min(self.count[name] + 1, 0xFFFF)

    def _usable_sample(self, given: Inputs) -> bool:
        """Whether the IMU's sample can be used; written so that NaN fails."""
        c = self.c
        limit, ax, ay = c["IMU_ACCEL_LIMIT_MPS2"], given.ax_mps2, given.ay_mps2
        good = abs(ax) <= limit and abs(ay) <= limit and abs(given.gz_radps) <= c["IMU_RATE_LIMIT_RADPS"]
        return given.imu_read and good

    def _angle(self, given: Inputs) -> int:
        c, m, flags = self.c, self.memory, 0
        ax, ay, gz = given.ax_mps2, given.ay_mps2, given.gz_radps
        if not self._usable_sample(given):
            m.imu_age = older(m.imu_age)
            self._count("imu")
            return IMU_HELD
        ax = c["IMU_SIGN_AX"] * ax - c["IMU_ACCEL_BIAS_X_MPS2"]
        ay = c["IMU_ACCEL_RATIO"] * (c["IMU_SIGN_AY"] * ay - c["IMU_ACCEL_BIAS_Y_MPS2"])
        gz = c["IMU_SIGN_GZ"] * gz
        levelling = bool(c["LEVELLING"])
        afresh = m.imu_age > c["HOLD_TICKS"] // 2 if levelling else m.imu_age == _NEVER
        if levelling and not afresh:
            m.phi += (m.imu_age + 1) * (m.integral - 0.5 * c["MM_DT_S"] * (gz + m.before))
        m.before = gz
        if max(abs(ax), abs(ay)) <= c["IMU_ACCEL_WEAK_MPS2"]:
            if afresh:
                m.imu_age = older(m.imu_age)
                self._count("imu")
                return ACCEL_WEAK | IMU_HELD
            flags, e = ACCEL_WEAK, 0.0
        else:
            e = math.remainder(math.atan2(ay, ax) - c["IMU_MOUNT_ANGLE_RAD"] - m.phi, 2.0 * math.pi)
        if afresh:
            m.phi += e
            m.level, m.ticks, m.step = 0.0, 0, 0
        elif levelling:
            i, S = m.step, m.level + e
            m.phi += c[f"calib_levelling_angle[{i}]"] * S
            m.integral = clip(m.integral + c[f"calib_levelling_bias[{i}]"] * S, c["MM_INTEGRAL_LIMIT_RAD"])
            m.level = S - c[f"calib_levelling_sum[{i}]"] * S
            if i < c["LEVELLING_STEPS"] - 1:
                m.ticks += 1
                m.step += m.ticks >= c[f"calib_levelling_until[{i}]"]
        else:
            m.integral = clip(m.integral + c["MM_KI_DT2"] * e, c["MM_INTEGRAL_LIMIT_RAD"])
            m.phi += c["MM_KP_DT"] * e + m.integral - c["MM_DT_S"] * gz
        m.imu_age = 0
        return flags | self._limit_angle()

    def _limit_angle(self) -> int:
        """Cut the angle to its limit; the flag where that cuts."""
        phi, limit = self.memory.phi, self.c["PHI_LIMIT_RAD"]
        self.memory.phi = clip(phi, limit)
        return ANGLE_LIMIT if abs(phi) > limit else 0

    def undistorted(self, u_px: float, v_px: float) -> tuple[float, float]:
        """Normalised coordinates without the lens, by the header's polynomial."""
        c = self.c
        yd = (v_px - c["CAMERA_CY_PX"]) * c["CAMERA_PER_FY"]
        xd = (u_px - c["CAMERA_CX_PX"] - c["CAMERA_SKEW_PX"] * yd) * c["CAMERA_PER_FX"]

        def radial(r2: float) -> float:
            # By Horner, as far from the picture a power is no float.
            more = 0.0
            for i in range(int(c["LENS_INVERSE_ORDER"]), 0, -1):
                more = r2 * (more + c[f"LENS_INVERSE_C{i}"])
            return 1.0 + more

        P = radial(xd * xd + yd * yd)
        x, y = xd * P, yd * P
        for _ in range(int(c["LENS_DECENTERING_STEPS"])):
            r2, p1, p2 = x * x + y * y, c["CAMERA_P1"], c["CAMERA_P2"]
            a = xd - (2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
            b = yd - (p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
            P = radial(a * a + b * b)
            x, y = a * P, b * P
        return x, y

    def _on_plane(self, u: float, v: float) -> list[tuple[float, float, float]]:
        """The terms of X W, Y W and W [1/m] of a pixel's place in the plane (2.11)."""
        stem, c = "PLANE_RAW", self.c
        if self.undistort:
            stem, (u, v) = "PLANE_NORMALISED", self.undistorted(u, v)
        return [(c[f"{stem}_{i}1"] * u, c[f"{stem}_{i}2"] * v, c[f"{stem}_{i}3"]) for i in (1, 2, 3)]

    def on_plane(self, u: float, v: float) -> tuple[float, float, float]:
        """X W, Y W and W [1/m] of a pixel's place in the plane."""
        X, Y, W = (sum(terms) for terms in self._on_plane(u, v))
        return X, Y, W

    def rounding_m(self, u: float, v: float) -> float:
        """What half a bit in each term moves that place by [m]: more the farther away it is."""
        (X, Y, W), sizes = self.on_plane(u, v), [sum(map(abs, t)) for t in self._on_plane(u, v)]
        away = max(sizes[0] + abs(X / W) * sizes[2], sizes[1] + abs(Y / W) * sizes[2])
        return away / abs(W) * 2.0**-24

    def _marker(self, given: Inputs) -> tuple[int, bool]:
        c, m, flags = self.c, self.memory, MARKER_HELD
        u, v = given.u_px, given.v_px
        inside = c["HAS_PLANE"] and -0.5 <= u <= c["CAMERA_GREATEST_U_PX"]
        if given.marker_seen and inside and -0.5 <= v <= c["CAMERA_GREATEST_V_PX"]:
            X, Y, W = self.on_plane(u, v)
            if c["PLANE_LEAST_PER_M" if self.undistort else "PLANE_RAW_LEAST_PER_M"] < W:
                m.marker, flags = (X / W, Y / W), 0
            else:
                flags = MARKER_HELD | HORIZON
                self._count("horizon")
        if flags:
            self._count("marker")
            m.marker_age = older(m.marker_age)
            return flags, False
        afresh = m.marker_age > c["HOLD_TICKS"]
        m.marker_age = 0
        return 0, afresh

    def _angle_at_exposure(self, given: Inputs) -> float:
        """The angle when the picture was exposed."""
        line = [*self.memory.past, self.memory.phi]
        return float(np.interp(1.0 + self.c["TIME_OFFSET_PART"] - late(given), np.arange(len(line)), line))

    def _lowpass(self, axis: int, x: float, afresh: bool) -> float:
        """Direct form on the difference equation's own coefficients, unlike the firmware's forms."""
        c, memory = self.c, self.memory
        sections = int(c["LOWPASS_PAIRS"]) + int(c["LOWPASS_SINGLES"])
        if afresh:
            memory.lowpass[axis] = [x] * (4 * sections)
        s = memory.lowpass[axis]
        for i in range(sections):
            b = [c[f"LOWPASS_{i + 1}_B{j}"] for j in range(3)]
            a1, a2 = c[f"LOWPASS_{i + 1}_A1"], c[f"LOWPASS_{i + 1}_A2"]
            x1, x2, y1, y2 = s[4 * i : 4 * i + 4]
            y = b[0] * x + b[1] * x1 + b[2] * x2 - a1 * y1 - a2 * y2
            s[4 * i : 4 * i + 4] = [x, x1, y, y1]
            x = y
        return x

    def bellows(self, x: float, y: float, phi: float, then: float) -> tuple[float, float]:
        """Lengths of the bellows by (3.12) with the series (3.14) of the angle that belongs to the head."""
        c = self.c
        f = sum(c[f"INVERSE_F{n}_PER_RAD{2 * n}"] * then ** (2 * n) for n in range(4))
        length, turned = 0.5 * math.hypot(x, y) * f, c["BELLOWS_RADIUS_M"] * phi
        return length + turned, length - turned

    def feed_forward(self, q_ref_m: float) -> float:
        """(4.6), or the table."""
        c = self.c
        if not c["FF_USE_TABLE"]:
            if q_ref_m < c["FF_FROM_M"]:
                return 0.0
            u = c["FF_SLOPE_PWM_PER_M"] * q_ref_m - c["FF_MINUS_PWM"]
            return min(u, c["FF_LIMIT_PWM"])
        at, last = (q_ref_m - c["FF_TABLE_FROM_M"]) * c["FF_TABLE_PER_STEP"], int(c["FF_TABLE_SIZE"]) - 1
        if at < 0.0:
            return 0.0
        i = min(int(at), last)
        low, high = c[f"calib_ff_table_pwm[{i}]"], c[f"calib_ff_table_pwm[{min(i + 1, last)}]"]
        return low + (min(at, last) - i) * (high - low)

    def _stop_pumps(self) -> tuple[float, float]:
        self.memory.sum, self.memory.error = [0.0, 0.0], [0.0, 0.0]
        return self.c["PUMP_LOW_PWM"], self.c["PUMP_LOW_PWM"]

    def _control(
        self, given: Inputs, q: tuple[float, float], decided: int | None
    ) -> tuple[tuple[float, float], int, float]:
        c, m = self.c, self.memory
        position = given.mode == MODE_POSITION
        if given.mode != m.mode:
            self._stop_pumps()
            m.mode = given.mode
        if not position and given.mode != MODE_ORIENTATION:
            return self._stop_pumps(), 0, 0.0
        if m.imu_age > c["HOLD_TICKS"] or (position and m.marker_age > c["HOLD_TICKS"]):
            self._count("stale")
            return self._stop_pumps(), STALE, 0.0
        wanted = given.reference if position else given.reference[:1]
        if not all(abs(r) <= REFERENCE_LIMIT for r in wanted):
            self._count("reference")
            return self._stop_pumps(), BAD_REFERENCE, 0.0
        if position:
            stem, unit = "POSITION", "M"
            errors = [r - length for r, length in zip(given.reference, q, strict=True)]
            extra = [self.feed_forward(r) for r in given.reference]
        else:
            stem, unit = "ORIENTATION", "RAD"
            e = c["ORIENTATION_SIGN"] * (given.reference[0] - m.phi)
            errors, extra = [e, -e], [0.0, 0.0]
        channels = [
            self._channel(i, stem, unit, error, added, decided)
            for i, (error, added) in enumerate(zip(errors, extra, strict=True))
        ]
        flags = channels[0][1] | channels[1][1]
        if flags & (SATURATED[0] | SATURATED[1]):
            self._count("saturated")
        return (channels[0][0], channels[1][0]), flags, max(undecided for *_, undecided in channels)

    def _channel(
        self, i: int, stem: str, unit: str, e: float, added: float, decided: int | None
    ) -> tuple[float, int, float]:
        """Command of a bellows, flags, and how far off its limit a decision was that went otherwise [PWM]."""
        c, m, flags = self.c, self.memory, 0
        Kd_h, half = c[f"{stem}_KD_PER_DT_PWM_PER_{unit}"], c[f"{stem}_KI_HALF_DT_PWM_PER_{unit}"]
        Kpd, low, high = c[f"{stem}_KPDI_PWM_PER_{unit}"] - half, c["PUMP_LOW_PWM"], c["PUMP_HIGH_PWM"]
        e1 = m.error[i]
        u, more = Kpd * e - Kd_h * e1 + m.sum[i], half * (e + e1)
        whole = u + more
        clamp = bool(c[f"{stem}_CLAMPING"]) and half != 0.0 and not low <= whole <= high
        clamp, undecided = decide(clamp, decided, CLAMPED[i], min(abs(whole - low), abs(whole - high)))
        if clamp:
            flags |= CLAMPED[i]
        else:
            m.sum[i] += more
            u = whole
        m.error[i] = e
        u += added
        off = min(abs(u - low), abs(u - high))
        saturated, off = decide(not low <= u <= high, decided, SATURATED[i], off)
        if saturated:
            flags |= SATURATED[i]
            m.sum[i] += c[f"{stem}_BACK"] * (min(max(u, low), high) - u)
        return min(max(u, low), high), flags, max(undecided, off)

    def _estimate(self, given: Inputs, decided: int | None) -> tuple[int, Pair, Pair, float]:
        """Flags, head, lengths, and how far a decision that went otherwise was from its limit [m]."""
        c, m = self.c, self.memory
        del decided
        flags, phi = self._angle(given), m.phi
        seen, afresh = self._marker(given)
        flags |= seen
        if m.marker_age == _NEVER:
            head, turned = (0.0, c["REST_LENGTH_M"]), c["BELLOWS_RADIUS_M"] * phi
            q = (c["REST_LENGTH_M"] + turned, c["REST_LENGTH_M"] - turned)
        else:
            then = self._angle_at_exposure(given)
            d = c["MARKER_OFFSET_M"]
            x, y = m.marker[0] - d * math.sin(then), m.marker[1] - d * math.cos(then)
            head = (self._lowpass(0, x, afresh), self._lowpass(1, y, afresh))
            q = self.bellows(*head, phi, then)
        m.past = [*m.past[1:], phi]
        return flags, head, q, 0.0

    def step(self, given: Inputs, decided: int | None = None) -> Wanted:
        """One tick.

        Parameters
        ----------
        given : values that binary32 holds; NaN and infinity are allowed.
        decided : flags of the firmware for this tick, whose decisions on the limits are then taken over.
        """
        flags, head, q, undecided_m = self._estimate(given, decided)
        m = self.memory
        pwm, driven, undecided = self._control(given, q, decided)
        return Wanted(m.phi, m.marker, head, q, pwm, flags | driven, undecided, undecided_m)


# ----------------------------------------------------------------------
# The tick with the fused estimator in float64, what CALIB_FUSED 1 is held against.
#
# As above: the header's constants, exact functions, the order of decisions of
# `calib_pipeline.h`. Rest or motion, and a picture left out or not, are taken from the firmware's flags where
# they are given, with the distance of the reference's own value from the limit where it would have decided
# otherwise.


@dataclass
class _Fused:
    """What the estimator remembers beside the angles; `chord` is that of the time of the picture."""

    length: float
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


def sinc(h: float) -> float:
    """sin h / h, the chord over the arc at twice the angle."""
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
        self.fused = _Fused(self.c["REST_LENGTH_M"])

    def _turn(self, given: Inputs) -> tuple[int, bool, float, float]:
        """Flags, whether the IMU's sample is used, and gravity along and across the head."""
        c, m, f = self.c, self.memory, self.fused
        A = B = turned = 0.0
        flags, sampled = 0, self._usable_sample(given)
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
                turned = half + before + f.bias
                m.phi += turned
            elif flags:
                sampled = False
            else:
                m.phi = clip(math.atan2(B, A), c["PHI_LIMIT_RAD"])
                m.past = [0.0] * len(m.past)
            f.half = half
        if sampled:
            m.imu_age = 0
        else:
            m.imu_age = older(m.imu_age)
            self._count("imu")
            flags |= IMU_HELD
        m.past = [*m.past[1:], turned]
        return flags, sampled, A, B

    def _angle_at_exposure(self, given: Inputs) -> float:
        m, delay = self.memory, self.c["FUSED_DELAY_TICKS"] + late(given)
        line = m.phi - np.cumsum([0.0, *reversed(m.past)])
        return clip(float(np.interp(delay, np.arange(len(line)), line)), self.c["PHI_LIMIT_RAD"])

    def _picture(
        self, then: float, age: int, afresh: bool, sampled: bool, decided: int | None
    ) -> tuple[int, float, bool, float]:
        """Flags, correction of the angle, whether it stands alone, and what was undecided [m]."""
        c, m, f, flags = self.c, self.memory, self.fused, 0
        sh, ch, d = math.sin(0.5 * then), math.cos(0.5 * then), c["MARKER_OFFSET_M"]
        X, Y = m.marker
        across, along = X * ch - (Y + d) * sh, X * sh + (Y - d) * ch
        if afresh or f.rejected >= c["FUSED_PATIENCE"]:
            f.chord, f.length, f.rate, f.slow, f.rejected = along, along / sinc(0.5 * then), 0.0, 0.0, 0
            f.boost, f.moving = int(c["FUSED_BOOST_TICKS"]), int(c["FUSED_MOVING_TICKS"])
        e = along - f.chord
        if f.boost:
            f.boost -= 1
            f.follow(c["FUSED_BOOST"] * e)
            return 0, clip(c["FUSED_BOOST_PHI_PER_M"] * across, c["FUSED_BOOST"]), True, 0.0
        far = max(abs(across), abs(e)) - c["FUSED_GATE_M"]
        rejected, undecided = decide(far > 0.0, decided, REJECTED, abs(far))
        if rejected:
            f.rejected += 1
            f.rate *= c["FUSED_RATE_DECAY"]
            m.marker_age = older(age)
            self._count("rejected")
            return REJECTED, 0.0, False, undecided
        f.rejected = 0
        f.slow += c["FUSED_SLOW"] * (e - f.slow)
        over = max(abs(f.slow) - c["FUSED_MOVING_M"], abs(f.rate) - c["FUSED_STILL_M"])
        moves, off = decide(over > 0.0, decided, MOVING, abs(over))
        undecided = max(undecided, off)
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
        then = self._angle_at_exposure(given)
        correction = 0.0
        if sampled and not flags & ACCEL_WEAK:
            whole = c["FUSED_ACCEL_GAIN"]
            pull = B * math.cos(then) - A * math.sin(then) - whole * (m.phi - then)
            correction = clip(pull, whole)
        f.length += f.rate
        f.chord = sinc(0.5 * then) * (f.length - (c["FUSED_DELAY_TICKS"] + late(given)) * f.rate)
        if flags & MARKER_HELD:
            f.rate *= c["FUSED_RATE_DECAY"]
        else:
            told, more, alone, undecided = self._picture(then, age, afresh, sampled, decided)
            flags |= told
            correction = more if alone else correction + more
        if sampled and not f.boost:
            f.bias = clip(f.bias + c["FUSED_BIAS"] * correction, c["MM_INTEGRAL_LIMIT_RAD"])
        m.phi += correction
        flags |= self._limit_angle()
        turned = c["BELLOWS_RADIUS_M"] * m.phi
        head = (f.chord * math.sin(0.5 * then), f.chord * math.cos(0.5 * then))
        return flags, head, (f.length + turned, f.length - turned), undecided


def make_reference(
    values: Mapping[str, float], undistort: bool | None = None, fused: bool = False, mean_rate: bool = False
) -> Reference:
    """The reference for CALIB_FUSED and CALIB_RATE_IS_MEAN."""
    return FusedReference(values, undistort, mean_rate) if fused else Reference(values, undistort)

"""Test vectors that a board checks itself with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.core.errors import BadInputError
from calib.io.serial import MODE_OFF, MODE_ORIENTATION, MODE_POSITION, Inputs, Outputs
from calib.stages.actuator.kinematics import inverse
from calib.stages.estimator.sensors import GRAVITY_MPS2
from calib.stages.firmware.conformance import (
    MARKER_HELD,
    REFERENCE_LIMIT,
    Reference,
    binary32,
    late,
    make_reference,
    sinc,
)

# ----------------------------------------------------------------------
# Golden vectors: a short run that drives every constant, with what the reference makes of it.
#
# The angle goes to +-1.3 rad, where the series and the angle filter have all their terms; the marker
# crosses the picture; the wanted lengths sweep the feed-forward from its dead zone to its limit, and both
# controllers meet both limits. A lost marker, a lost IMU and a refused reference are among the ticks.

TOLERANCE = {"phi_rad": 2e-6, "marker_m": 2e-7, "q_m": 2e-6, "pwm": 0.01}
"""What a board may differ by from float64 where the marker is near."""

_HALF_BITS = 4.0
"""Half bits of each term in a tolerance. On rigs tilted by up to 70 degrees, 1 m long, or with a fisheye lens
the sum of a tick's outputs was off by up to 13; the self-test allows four tolerances."""


def tolerance(rounding_m: float) -> dict[str, float]:
    """`TOLERANCE` for a marker of which half a bit is `rounding_m`, see `Reference.rounding_m`."""
    more = max(1.0, _HALF_BITS * rounding_m / TOLERANCE["marker_m"])
    return {name: value if name == "phi_rad" else more * value for name, value in TOLERANCE.items()}


FUSED_TICKS = 72
"""Golden vectors of the fused estimator: pictures until it runs, a swing, a new start, rest."""


_SHAKEN_RAD = (1.96, 2.75)
_LATE_STEP, _LATE_FROM, _LATE_KINDS = 0.25, -0.25, 8
"""Lateness of pictures among the ticks, what is refused included: whole multiples, as three bits hold."""


MOST_TIMES = 256
"""That a tick comes in a vector; a board that ticks faster holds a sensor for longer."""


@dataclass(frozen=True)
class Vector:
    """One tick, or `times` of them that are alike: what goes in, and what has to come out of the last.

    `counts` are the counters after it, in the order of `conformance.COUNTERS`.
    """

    given: Inputs
    wanted: Outputs
    times: int
    counts: tuple[int, ...]


def directed(constants: Mapping[str, float], ticks: int) -> list[Inputs]:
    """Ticks that reach every part of the pipeline.

    Parameters
    ----------
    constants : of a header, by name.
    """
    width, height = (constants.get(f"CALIB_CAMERA_GREATEST_{axis}_PX", 0.0) for axis in "UV")
    mount, rest = constants["CALIB_IMU_MOUNT_ANGLE_RAD"], constants["CALIB_REST_LENGTH_M"]
    bias = constants["CALIB_IMU_GYRO_BIAS_RADPS"]
    made = []
    for k in range(ticks):
        share = k / max(ticks - 1, 1)
        turn = 2.0 * math.pi * share
        phi = 1.3 * math.sin(3.0 * turn + 1.2)
        # Now and then the specific force is shaken to where the head never is.
        felt = math.copysign(_SHAKEN_RAD[k // 11 % 2], -phi) if k % 11 == 7 else phi
        mode = (MODE_POSITION, MODE_ORIENTATION)[(4 * k // ticks) % 2]
        sweep = rest * (0.98 + 0.45 * abs(math.sin(2.0 * turn)))
        reference = (
            (sweep, 2.43 * rest - sweep) if mode == MODE_POSITION else (0.4 * math.cos(5.0 * turn), 0.0)
        )
        given = Inputs(
            u_px=0.5 * width * (1.0 + 0.8 * math.cos(2.0 * turn)),
            v_px=0.5 * height * (1.0 + 0.8 * math.sin(3.0 * turn)),
            ax_mps2=GRAVITY_MPS2 * math.cos(felt + mount) + 0.8 * math.sin(11.0 * turn),
            ay_mps2=GRAVITY_MPS2 * math.sin(felt + mount) + 0.8 * math.cos(13.0 * turn),
            gz_radps=bias + 2.5 * math.sin(7.0 * turn),
            reference=reference,
            mode=mode,
            late_ticks=_lateness(k),
        )
        made.append(binary32(spoil(given, k)))
    return made


_TO_LIMIT = 30


def _lateness(k: int) -> float:
    return _LATE_FROM + _LATE_STEP * ((3 * k + 2) % _LATE_KINDS)


def _weak(c: Mapping[str, float], factor: float, fused: bool) -> dict[str, Any]:
    """Readings at a factor of the specific force below which there is none to go by."""
    rows, limit = np.eye(2), c["CALIB_IMU_ACCEL_WEAK_MPS2"]
    offset = np.array([c["CALIB_IMU_ACCEL_BIAS_X_MPS2"], c["CALIB_IMU_ACCEL_BIAS_Y_MPS2"]])
    if fused:
        rows = np.array([[c[f"CALIB_FUSED_ACCEL_{i}{j}"] for j in (1, 2)] for i in (1, 2)])
        offset = np.array([c["CALIB_FUSED_ACCEL_1"], c["CALIB_FUSED_ACCEL_2"]])
        limit = c["CALIB_FUSED_ACCEL_WEAK"]
    ax, ay = np.linalg.solve(rows, offset + np.array([factor * limit, 0.0])).tolist()
    return {"ax_mps2": c["CALIB_IMU_SIGN_AX"] * ax, "ay_mps2": c["CALIB_IMU_SIGN_AY"] * ay}


def _limits(constants: Mapping[str, float], still: Inputs, fused: bool) -> list[tuple[Inputs, int]]:
    """Ticks on either side of what is refused, with how often each comes: losses, NaN, readings beyond.

    Parameters
    ----------
    still : a sound tick.
    """
    rest = constants["CALIB_REST_LENGTH_M"]
    still = replace(still, gz_radps=0.0, mode=MODE_POSITION, reference=(1.1 * rest, 1.12 * rest))
    steady = replace(still, gz_radps=constants["CALIB_IMU_GYRO_BIAS_RADPS"], mode=MODE_OFF)
    made = [
        *_losses(constants, still),
        *_refused(constants, still, fused),
        *_rests(constants, steady, fused),
        *_held_integral(constants, steady),
        *_fast_turns(constants, still),
    ]
    return [(binary32(given), times) for given, times in made]


def _losses(constants: Mapping[str, float], still: Inputs) -> list[tuple[Inputs, int]]:
    """Sensors that fall silent for as long as is held, and longer."""
    hold = int(constants["CALIB_HOLD_TICKS"])
    made: list[tuple[Inputs, int]] = []
    for silent in (replace(still, marker_seen=False), replace(still, imu_read=False)):
        made += [(still, 2), (silent, hold), (silent, 1), (still, 1)]
    # The angle begins anew in the very tick in which its controller does.
    near = (Reference(constants).step(still).phi_rad + 0.05, 0.0)
    silent = replace(still, marker_seen=False, imu_read=False, mode=MODE_ORIENTATION, reference=near)
    made += [(silent, hold + 1), (replace(silent, imu_read=True), 1)]
    # A picture that is left out is none, and the pumps do not go on for it.
    boost = int(constants.get("CALIB_FUSED_BOOST_TICKS", 0))
    away = replace(still, u_px=_pixels_away(still.u_px))
    lost = replace(still, marker_seen=False, mode=MODE_OFF)
    return [*made, (still, boost + 2), (lost, hold - 1), (away, 2), (still, 1)]


def _refused(constants: Mapping[str, float], still: Inputs, fused: bool) -> list[tuple[Inputs, int]]:
    """Readings, references and a mode that are refused, and those that are just not."""
    nan = math.nan
    edge = constants.get("CALIB_CAMERA_GREATEST_U_PX", 0.0), constants.get("CALIB_CAMERA_GREATEST_V_PX", 0.0)
    changes: list[dict[str, Any]] = [
        *({name: nan} for name in ("u_px", "v_px", "ax_mps2", "ay_mps2", "gz_radps")),
        *({name: value} for name in ("u_px", "v_px") for value in (-0.51, -0.49)),
        {"u_px": edge[0] + 0.01},
        {"v_px": edge[1] + 0.01},
        {"u_px": edge[0] - 0.01, "v_px": edge[1] - 0.01},
        *({name: 158.0} for name in ("ax_mps2", "ay_mps2")),
        *({"gz_radps": value} for value in (-35.1, 35.1)),
        *({"reference": pair} for pair in ((nan, 0.08), (6.31, 0.08), (0.08, -6.31))),
        *(_weak(constants, factor, fused) for factor in (0.995, 1.005)),
        {"mode": 7},
    ]
    made: list[tuple[Inputs, int]] = []
    for k, change in enumerate(changes):
        made += [(replace(still, **change), 1), *[(still, 1)] * (k % 3 == 2)]
    return made


def _rests(constants: Mapping[str, float], steady: Inputs, fused: bool) -> list[tuple[Inputs, int]]:
    """At rest, and then a little beside: told from a motion."""
    made = [(steady, 150)]
    if fused:
        # Not yet a motion, for about as long as the gain at rest takes.
        made.append((_farther(constants, steady, 0.8 * constants["CALIB_FUSED_MOVING_M"]), 110))
    return [*made, (replace(steady, v_px=steady.v_px + 0.5), 3)]


def _held_integral(c: Mapping[str, float], steady: Inputs) -> list[tuple[Inputs, int]]:
    """The integral comes to the limit within `_TO_LIMIT` ticks, and is left out from there."""
    half = c["CALIB_ORIENTATION_KI_HALF_DT_PWM_PER_RAD"]
    if not (half > 0.0 and c["CALIB_ORIENTATION_CLAMPING"]):
        return []
    proportional = c["CALIB_ORIENTATION_KPDI_PWM_PER_RAD"] - half
    proportional -= c["CALIB_ORIENTATION_KD_PER_DT_PWM_PER_RAD"]
    e = c["CALIB_PUMP_HIGH_PWM"] / (proportional + 2 * _TO_LIMIT * half)
    bias = (c[f"CALIB_IMU_ACCEL_BIAS_{axis}_MPS2"] for axis in "XY")
    ax, ay = (value - by for value, by in zip((steady.ax_mps2, steady.ay_mps2), bias, strict=True))
    phi = math.atan2(c["CALIB_IMU_ACCEL_RATIO"] * ay, ax) - c["CALIB_IMU_MOUNT_ANGLE_RAD"]
    return [(replace(steady, reference=(phi + e, 0.0), mode=MODE_ORIENTATION), _TO_LIMIT + 10)]


def _fast_turns(constants: Mapping[str, float], still: Inputs) -> list[tuple[Inputs, int]]:
    """The head turns through both limits of its angle, by a third of a radian in a tick."""
    made, per_60hz = [], constants["CALIB_TICK_RATE_HZ"] / 60.0
    fast = 20.0 * min(per_60hz, 1.0)
    for rate, ticks in ((-fast, 8), (fast, 14)):
        turns = replace(still, gz_radps=rate, reference=(0.3, 0.0), mode=MODE_ORIENTATION)
        made.append((replace(turns, marker_seen=False), math.ceil(ticks * max(per_60hz, 1.0))))
    # From there it is nearer to the accelerometer's angle the other way round.
    return [*made, (replace(still, ax_mps2=-9.07, ay_mps2=3.74, gz_radps=-fast), 1)]


def _farther(constants: Mapping[str, float], still: Inputs, by_m: float) -> Inputs:
    """The tick with the marker farther out; as it is where it is not seen."""
    reference = Reference(constants)
    seen = reference.step(still)
    if seen.flags & MARKER_HELD:
        return still
    (X, Y), out = seen.marker_m, 1.0 + by_m / math.hypot(*seen.marker_m)
    u, v = find_pixel(reference, out * X, out * Y, (still.u_px, still.v_px))
    return binary32(replace(still, u_px=u, v_px=v))


def _bent(constants: Mapping[str, float], run: list[Inputs]) -> list[tuple[Inputs, int]]:
    """The run's most bent tick for long, which adds up what the accelerometer's biases leave, and then the
    marker farther out by less than the gate, whose mean residual is a motion.
    """
    bent = max(run, key=lambda one: abs(one.ay_mps2))
    still = binary32(replace(bent, gz_radps=constants["CALIB_IMU_GYRO_BIAS_RADPS"], mode=MODE_OFF))
    return [(still, 150), (_farther(constants, still, 0.8 * constants["CALIB_FUSED_GATE_M"]), 3)]


def vectors(
    constants: Mapping[str, float], ticks: int = 48, fused: bool = False, limits: bool = False
) -> list[Vector]:
    """Golden vectors for the constants of a header, by name.

    Parameters
    ----------
    fused : for CALIB_FUSED 1. limits : with all that a tick has to refuse.

    Raises `BadInputError` for a lens that the constants do not undo all over the picture.
    """
    reference = make_reference(constants, fused=fused)
    run = directed_fused(constants, ticks, period=ticks) if fused else directed(constants, ticks)
    still = run[0]
    # What is known first is that the head is bent, and turns.
    bias, both = constants["CALIB_IMU_GYRO_BIAS_RADPS"], [one.marker_seen and one.imu_read for one in run]
    bent = max(range(ticks), key=lambda k: both[k] * abs(run[k].ay_mps2 * (run[k].gz_radps - bias)))
    run = [*run[bent:], *run[:bent]]
    given = [(one, 1) for one in run]
    if limits:
        silent = replace(still, marker_seen=False, imu_read=False)
        weightless = binary32(replace(silent, imu_read=True, ax_mps2=0.1, ay_mps2=-0.1))
        # The angle is known before the first picture.
        unseen = replace(run[0], marker_seen=False)
        given = [(silent, 1), (weightless, 1), (unseen, 1), *given, *_limits(constants, still, fused)]
        if fused:
            given += _bent(constants, coherent(constants, ticks, period=ticks))
    made = []
    for one, times in given:
        for done in range(0, times, MOST_TIMES):
            more = min(times - done, MOST_TIMES)
            out = [reference.step(one) for _ in range(more)][-1]
            if not all(map(math.isfinite, out.numbers)):
                raise BadInputError(
                    f"camera: what undoes its lens is without bound at pixel ({one.u_px:.0f}, "
                    f"{one.v_px:.0f}), expected a place of every pixel; run calib intrinsics on pictures of "
                    "the board up to the edges, or with a simpler --model"
                )
            made.append(Vector(one, out, more, tuple(reference.count.values())))
    return made


_NAN = 3e38
"""Stands for NaN in the rows."""
_UNEVEN = (1.0, 1.2, 1.4, 1.1, 1.3, 1.5, 1.7, 1.6, 1.8)
_NUMBERS = ("phi_rad", *["marker_m"] * 2, *["q_m"] * 4, *["pwm"] * 2)
_TOGETHER = 4.0
"""Tolerances by which a tick's weighted sum may be off. What binary32 leaves, adding up included, is 0.6."""


def _row(vector: Vector, weights: list[float]) -> list[float]:
    """Inputs and the weighted sum of what a tick gives; zero for what is too small for a normal float."""
    inputs = [_NAN if math.isnan(value) else value for value in vector.given.numbers[:-1]]
    row = [*inputs, float(np.dot(weights, vector.wanted.numbers))]
    return [float(v) if abs(v) > 1e-30 else 0.0 for v in row]


def _points(constants: Mapping[str, float]) -> list[list[float]]:
    """Points in front of the base with the lengths that bring the head there, and what is refused."""
    rest, radius, refused = (
        constants["CALIB_REST_LENGTH_M"],
        constants["CALIB_BELLOWS_RADIUS_M"],
        2.0 * REFERENCE_LIMIT,
    )
    rows = []
    for share in (1.0, -0.6):
        x = float(np.float32(share * rest))
        rows.append([x, rest, *inverse(np.array([x, rest, 2.0 * math.atan2(x, rest)]), radius).tolist()])
    beyond = ((1.01 * rest, rest), (0.0, -rest), (0.0, 6.31), (0.0, _NAN))
    return rows + [[x, y, refused, refused] for x, y in beyond]


def _words(made: list[Vector]) -> list[int]:
    """What came with the inputs, mode, repetitions and lateness, and flags, two for each tick."""
    words = []
    for one in made:
        kind = round((one.given.late_ticks - _LATE_FROM) / _LATE_STEP)
        words += [one.given.sensors + 4 * one.given.mode + 32 * (one.times - 1) + 8192 * kind]
        words += [one.wanted.flags]
    return words


def selftest_rows(constants: Mapping[str, float]) -> dict[str, Any]:
    """What calib_selftest.h is made of: tables for CALIB_FUSED 0 and 1, and CALIB_UNDISTORT."""
    fused = vectors(constants, FUSED_TICKS, fused=True, limits=True) if constants["CALIB_HAS_FUSED"] else []
    plain = vectors(constants, limits=True)
    reference = Reference(constants)
    seen = [one.given for one in (*plain, *fused) if not one.wanted.flags & MARKER_HELD]
    allowed = tolerance(max((reference.rounding_m(one.u_px, one.v_px) for one in seen), default=0.0))
    weights = [float(np.float32(k / allowed[name])) for k, name in zip(_UNEVEN, _NUMBERS, strict=True)]
    return {
        "points": _points(constants),
        "undistort": int(constants["CALIB_HAS_PLANE"] and reference.undistort),
        "rows": [_row(one, weights) for one in plain],
        "fused_rows": [_row(one, weights) for one in fused],
        "words": _words(plain),
        "fused_words": _words(fused),
        "counts": plain[-1].counts,
        "fused_counts": fused[-1].counts if fused else plain[-1].counts,
        "tolerance": allowed,
        "weights": weights,
        "late": (_LATE_STEP, _LATE_FROM),
        "limit": _TOGETHER,
    }


# ----------------------------------------------------------------------
# A run that drives the fused estimator: readings of one motion, so that the pictures fit the angle.
#
# Every `PERIOD` ticks the head swings through +-1.2 rad while its length changes, creeps by less than what
# the estimator counts as a motion, and rests. The marker is where the head was CALIB_FUSED_DELAY_TICKS
# earlier. Pictures of something else, one by one and enough of them in a row for a new start, lost markers,
# lost samples of the IMU, free fall and refused references are among the ticks.

PERIOD = 240
_SWING = 0.55
"""Share of a period in which the head swings; for half of the rest it creeps, then it stands still."""

_STEP = 1e-4


def find_pixel(
    reference: Reference, X: float, Y: float, near: tuple[float, float] | None = None
) -> tuple[float, float]:
    """The pixel that the header's own constants take to the place (X, Y) [m] in the plane, to 1e-6 px.

    Parameters
    ----------
    near : where to begin, the middle of the picture by default.

    Raises `BadInputError` for a place that they give no pixel.
    """
    c = reference.c

    def place(u: float, v: float) -> np.ndarray:
        a, b, w = reference.on_plane(u, v)
        return np.array([a / w - X, b / w - Y])

    u, v = near or (0.5 * c["CAMERA_GREATEST_U_PX"], 0.5 * c["CAMERA_GREATEST_V_PX"])
    for _ in range(40):
        here = place(u, v)
        slope = np.stack([place(u + _STEP, v) - here, place(u, v + _STEP) - here], axis=1) / _STEP
        step = np.linalg.solve(slope, here)
        # No farther than the picture's fifth, the lens' polynomial ends beyond its edge.
        step /= max(1.0, float(np.abs(step).max()) / (0.2 * c["CAMERA_GREATEST_U_PX"]))
        u, v = u - float(step[0]), v - float(step[1])
        if float(np.abs(step).max()) < 1e-6:
            return u, v
    raise BadInputError(f"plane: no pixel shows the place ({X:.3g}, {Y:.3g}) m")


class Motion:
    """Angle [rad] and length [m] at a time in ticks.

    Parameters
    ----------
    rest_m : rest length. period : ticks. creep_m : per tick, while the head creeps.
    """

    def __init__(self, rest_m: float, period: int, creep_m: float) -> None:
        self.rest, self.period, self.creep = rest_m, period, creep_m

    def at(self, k: float) -> tuple[float, float]:
        """Angle and length."""
        share = k / self.period - math.floor(k / self.period)
        swung = min(share / _SWING, 1.0)
        phi = 1.2 * math.sin(4.0 * math.pi * swung) * math.sin(math.pi * swung)
        length = self.rest * (1.15 - 0.15 * math.cos(2.0 * math.pi * swung))
        crept = min(max(share - _SWING, 0.0), 0.5 * (1.0 - _SWING)) * self.period
        # Down again in the next swing.
        back = 1.0 - swung if share < _SWING else 0.0
        return phi, length + self.creep * (crept + back * 0.5 * (1.0 - _SWING) * self.period)

    def rate(self, k: float) -> float:
        """Change of the angle in a tick."""
        return (self.at(k + 1e-3)[0] - self.at(k - 1e-3)[0]) / 2e-3


def _readings(c: Mapping[str, float], phi: float, rate: float) -> tuple[float, float, float]:
    """What the IMU reads at rest at an angle, turning by a rate per tick, by the header's constants."""
    rows = np.array([[c[f"FUSED_ACCEL_{i}{j}"] for j in (1, 2)] for i in (1, 2)])
    offset = np.array([c["FUSED_ACCEL_1"], c["FUSED_ACCEL_2"]])
    gravity = c["FUSED_ACCEL_GAIN"] * np.array([math.cos(phi), math.sin(phi)])
    ax, ay = np.linalg.solve(rows, gravity + offset).tolist()
    gz = (c["FUSED_HALF_BIAS_RAD"] - 0.5 * rate) / c["FUSED_HALF_DT_S"]
    return c["IMU_SIGN_AX"] * ax, c["IMU_SIGN_AY"] * ay, c["IMU_SIGN_GZ"] * gz


def coherent(
    constants: Mapping[str, float],
    ticks: int,
    undistort: bool | None = None,
    period: int = PERIOD,
    lateness: Callable[[int], float] = _lateness,
) -> list[Inputs]:
    """Readings of one motion, in either mode of control.

    Parameters
    ----------
    constants : of a header that has the estimator, by name. undistort : CALIB_UNDISTORT.
    lateness : of a tick's picture [ticks].
    """
    reference = Reference(constants, undistort)
    c = reference.c
    creep = 0.5 * c["FUSED_REST_LENGTH"] * c["FUSED_MOVING_M"]
    motion, d, made = Motion(c["REST_LENGTH_M"], period, creep), c["MARKER_OFFSET_M"], []
    last: tuple[float, float] | None = None
    for k in range(ticks):
        given = Inputs(0.0, 0.0, 0.0, 0.0, 0.0, late_ticks=lateness(k))
        phi, length = motion.at(k - c["FUSED_DELAY_TICKS"] - late(given))
        chord = length * sinc(0.5 * phi)
        X = chord * math.sin(0.5 * phi) + d * math.sin(phi)
        Y = chord * math.cos(0.5 * phi) + d * math.cos(phi)
        u, v = last = find_pixel(reference, X, Y, last)
        angle, rate = motion.at(k)[0], motion.rate(k)
        ax, ay, gz = _readings(c, angle, rate)
        shaken = 0.8 if k % period < _SWING * period else 0.02
        mode = (MODE_POSITION, MODE_ORIENTATION)[(3 * k // period) % 2]
        wanted = motion.at(k)[1] * (1.0 + 0.05 * math.sin(0.11 * k))
        noisy = 0.3 * (k % period < _SWING * period)
        given = replace(
            given,
            u_px=u + noisy * math.sin(1.7 * k),
            v_px=v + noisy * math.cos(2.3 * k),
            ax_mps2=ax + shaken * math.sin(0.9 * k),
            ay_mps2=ay + shaken * math.cos(1.1 * k),
            gz_radps=gz + 0.01,
            reference=(wanted, wanted) if mode == MODE_POSITION else (angle + 0.1 * math.cos(0.07 * k), 0.0),
            mode=mode,
        )
        made.append(binary32(given))
    return made


def directed_fused(
    constants: Mapping[str, float], ticks: int, undistort: bool | None = None, period: int = PERIOD
) -> list[Inputs]:
    """`coherent` readings with all that can go wrong: every part of estimator and controllers is reached."""
    given = coherent(constants, ticks, undistort, period)
    return [binary32(_disturb(one, k, period)) for k, one in enumerate(given)]


def spoil(given: Inputs, k: int) -> Inputs:
    """Tick `k` as it comes: without marker, IMU or command every now and then, the reference out of reach."""
    if k % 29 == 17:
        given = replace(given, marker_seen=False)
    if k % 31 == 19:
        given = replace(given, imu_read=False)
    if k % 37 == 23:
        given = replace(given, reference=(7.0, 7.0))
    if k % 41 == 40:
        given = replace(given, mode=MODE_OFF)
    return given


def _pixels_away(u_px: float) -> float:
    """Where something else than the marker is in the picture."""
    return u_px + (25.0 if u_px < 150.0 else -25.0)


def _disturb(given: Inputs, k: int, period: int) -> Inputs:
    at = k % period
    given = spoil(given, k)
    if k % 43 == 33:
        given = replace(given, ax_mps2=0.1, ay_mps2=-0.1)
    if k % 23 == 14 or 3 * period // 10 <= at < 3 * period // 10 + 8:
        given = replace(given, u_px=_pixels_away(given.u_px))
    return given

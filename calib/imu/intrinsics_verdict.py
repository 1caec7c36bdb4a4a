"""What an IMU's intrinsics are worth: a verdict, reasons in plain words, and poses that would help.

- unidentifiable: the poses or turns do not tell the parameters at all;
- inconsistent: they are told, but contradict each other or what an IMU is (another unit, another g,
  axes of the gyroscope that are not the accelerometer's);
- poor: known less well than `LIMITS`, or poses missing on one side;
- ok otherwise.

A scale and a bias of an axis are told apart by rests with the axis up and with it down. A side lacks where
no rest has the axis within 60 degrees of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.imu.accelerometer import ANGLES, LEAST_SPAN, Accelerometer
from calib.imu.gyroscope import GYRO_ANGLES, Gyroscope
from calib.imu.intrinsics import Intrinsics

__all__ = ["LIMITS", "IntrinsicsJudgement", "judge_intrinsics", "protocol"]

LIMITS = {"scale": 0.005, "bias_g": 0.005, "angle_rad": math.radians(0.5), "gyro": 0.01}
"""Largest standard deviations: relative scale, bias in g, misalignment, and those of the gyroscope."""

_USELESS = 20.0
_NEAR = 0.5
_LARGEST_RMS_G = 0.01
_OFF_SCALE = 0.15
_OFF_ANGLE_RAD = math.radians(15.0)
_ROUGH_TURNS_RAD, _WRONG_TURNS_RAD = 0.03, 0.2
_TIMES_OTHERS = 6.0
_LEAST_TRAVEL_RAD = 0.3
_MOST_MISSING = 0.02


@dataclass(frozen=True)
class IntrinsicsJudgement:
    """Verdict "ok", "poor", "unidentifiable" or "inconsistent", with sentences."""

    verdict: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    advice: tuple[str, ...]


class _Notes:
    """Sentences as they are found, and the worst verdict among them."""

    _ORDER = ("ok", "poor", "unidentifiable", "inconsistent")

    def __init__(self) -> None:
        self.verdict = "ok"
        self.reasons: list[str] = []
        self.remarks: list[str] = []
        self.advice: list[str] = []

    def because(self, verdict: str, sentence: str, advice: str = "") -> None:
        self.verdict = max(self.verdict, verdict, key=self._ORDER.index)
        self.reasons.append(sentence)
        if advice and advice not in self.advice:
            self.advice.append(advice)


def protocol(planar: bool) -> str:
    """How to record a log for this verb, in a sentence."""
    if planar:
        return (
            "stand the plane upright, wait 10 s, then tilt about z by 45 degrees at a time through the whole "
            "circle and back, each tilt held still for 3 s"
        )
    return (
        "let it lie for 30 s, then put it down in 24 poses or more, each axis up and down and both ways at "
        "45 degrees between two axes, each held still for 3 s, turning about another axis every time"
    )


def _sides(accel: Accelerometer, notes: _Notes) -> None:
    u = accel.directions
    for k, axis in enumerate("xyz"[: u.shape[1]]):
        for sign, word in ((1.0, "up"), (-1.0, "down")):
            best = float((sign * u[:, k]).max())
            if best < _NEAR:
                nearest = math.degrees(math.acos(max(-1.0, best)))
                notes.because(
                    "poor",
                    f"no rest with the {axis} axis {word}: the nearest is {nearest:.0f} degrees from it",
                    f"add rests with the {axis} axis {word}",
                )


def _name(accel: Accelerometer, place: int) -> str:
    d = len(accel.bias)
    if place < d:
        return f"bias of {'xyz'[place]}"
    if place < 2 * d:
        return f"scale of {'xyz'[place - d]}"
    return f"misalignment {ANGLES[d][place - 2 * d]}"


def _of_accelerometer(result: Intrinsics, accel: Accelerometer, notes: _Notes) -> None:
    d, g = len(accel.bias), result.gravity_mps2
    if result.log.accel_unit == "m/s2" or accel.span >= LEAST_SPAN:
        _sides(accel, notes)
    if accel.span < LEAST_SPAN:
        mixed = np.flatnonzero(np.abs(accel.weakest) > 0.3).tolist()
        words = [_name(accel, place) for place in mixed]
        names = " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
        notes.because("unidentifiable", f"the poses do not tell {names} apart", protocol(result.planar))
        return
    size = np.concatenate([g * accel.scale, accel.scale, np.ones(len(accel.angles))])
    limit = np.repeat([LIMITS["bias_g"], LIMITS["scale"], LIMITS["angle_rad"]], [d, d, len(accel.angles)])
    relative = accel.sigma / size / limit
    for place in range(len(relative) if accel.skewed else 2 * d):
        if relative[place] > 1.0:
            value = accel.sigma[place] / size[place]
            shown = (
                f"{value:.2g} g" if place < d else f"{value:.2g} rad" if place >= 2 * d else f"{value:.2%}"
            )
            notes.because(
                "unidentifiable" if relative[place] > _USELESS else "poor",
                f"accelerometer, {_name(accel, place)}: known to {shown} only",
                protocol(result.planar),
            )
    if not accel.skewed:
        notes.remarks.append("the poses do not tell the accelerometer's misalignment; it is taken to be zero")
        notes.advice.append("rests with two axes both at 45 degrees would show the misalignment")
    if accel.dof <= 0:
        notes.because(
            "poor",
            f"{len(result.rests)} rests for as many parameters: nothing is left to check them by, and sigma "
            "is that of the noise alone",
            protocol(result.planar),
        )
    elif accel.rms_mps2 > _LARGEST_RMS_G * g:
        notes.because(
            "inconsistent",
            f"the rests disagree by {accel.rms_mps2:.3g} m/s^2, more than a bias, a scale and angles explain",
            "hold each pose still, far from what vibrates",
        )
    r = np.abs(accel.residual_mps2)
    others = 1.4826 * float(np.median(r))
    worst = int(np.argmax(r))
    if accel.dof >= 6 and r[worst] > max(_TIMES_OTHERS * others, 1e-3 * g):
        rest = result.rests[worst]
        notes.because(
            "poor",
            f"the rest from {rest.from_s:.1f} to {rest.to_s:.1f} s is off by {r[worst]:.2g} m/s^2, "
            f"{r[worst] / max(others, 1e-12):.0f} times what the others are",
            "look at that rest: something pushed the sensor, or it crept",
        )
    if result.log.accel_unit == "m/s2":
        off = float(np.abs(accel.scale - 1.0).max())
        if off > _OFF_SCALE:
            notes.because(
                "inconsistent",
                f"a scale comes out as {accel.scale[int(np.argmax(np.abs(accel.scale - 1.0)))]:.3g}, so the "
                "readings are not in the unit that was named, or gravity is another",
                "check --acc-unit and --gravity",
            )
    if accel.skewed and float(np.abs(accel.angles).max(initial=0.0)) > _OFF_ANGLE_RAD:
        notes.because(
            "inconsistent",
            f"two axes come out {math.degrees(float(np.abs(accel.angles).max())):.0f} degrees from a right "
            "angle",
        )


def _swapped(P: FloatArray) -> str:
    """Which column measures which axis, for P with w = P x."""
    words = []
    for column in range(3):
        row = int(np.argmax(np.abs(P[:, column])))
        words.append(f"g{'xyz'[column]} measures {'-' if P[row, column] < 0 else ''}{'xyz'[row]}")
    return ", ".join(words)


def _of_gyroscope(result: Intrinsics, gyro: Gyroscope, notes: _Notes) -> None:
    if result.foreign is not None:
        mirror = "; that mirrors it" if np.linalg.det(result.foreign) < 0.0 else ""
        notes.because(
            "inconsistent",
            f"the gyroscope's axes are not the accelerometer's: {_swapped(result.foreign)}{mirror}",
            "put the gyroscope's columns into the accelerometer's order and signs",
        )
        return
    if gyro.rms_rad > _WRONG_TURNS_RAD:
        notes.because(
            "inconsistent",
            f"the turns miss gravity's direction by {math.degrees(gyro.rms_rad):.0f} degrees: the rates are "
            "not in the unit that was named, or gyroscope and accelerometer do not belong together",
            "check --gyro-unit and the signs of the gyroscope",
        )
        return
    if gyro.rms_rad > _ROUGH_TURNS_RAD:
        notes.because(
            "poor",
            f"the turns miss gravity's direction by {math.degrees(gyro.rms_rad):.2g} degrees",
            "turn more slowly, in a second or two, and log at 100 Hz or more",
        )
    used = np.isfinite(gyro.scale)
    off = gyro.scale[used][int(np.argmax(np.abs(gyro.scale[used] - 1.0)))]
    if result.log.gyro_unit == "rad/s" and abs(off - 1.0) > _OFF_SCALE:
        notes.because(
            "inconsistent",
            f"a scale of the gyroscope comes out as {off:.3g}, so its readings are not in the unit that was "
            "named",
            "check --gyro-unit",
        )
    for k in np.flatnonzero(used).tolist():
        travel = float(gyro.travel_rad[k])
        if travel < _LEAST_TRAVEL_RAD:
            notes.because(
                "poor",
                f"hardly a turn about the {'xyz'[k]} axis: {math.degrees(travel):.0f} degrees",
                f"turn by 90 degrees or more about the {'xyz'[k]} axis between rests",
            )
    names = [f"scale of g{axis}" for axis in "xyz"] + [f"misalignment {name}" for name in GYRO_ANGLES]
    sigma = np.concatenate([gyro.scale_sigma / np.abs(gyro.scale), gyro.angle_sigma])
    unknown = [name for name, one in zip(names, sigma.tolist(), strict=True) if one == math.inf]
    if unknown:
        notes.because(
            "unidentifiable",
            f"{len(gyro.turns_s)} turn(s) do not tell the gyroscope's {len(unknown)} parameters",
            protocol(result.planar),
        )
    for name, one in zip(names, sigma.tolist(), strict=True):
        if LIMITS["gyro"] < one < math.inf:
            shown = f"{one:.2%}" if name.startswith("scale") else f"{one:.2g} rad"
            notes.because(
                "unidentifiable" if one > _USELESS * LIMITS["gyro"] else "poor",
                f"gyroscope, {name}: known to {shown} only",
                protocol(result.planar),
            )
    if gyro.bias.sensitivity is not None:
        notes.remarks.append(
            "the gyroscope's bias follows the pose; its sensitivity to the specific force is fitted as well"
        )


def _of_log(result: Intrinsics, notes: _Notes) -> None:
    s = result.sampling
    for gap in s.gaps:
        if gap.split:
            notes.remarks.append(f"split at a gap of {gap.duration_s:.4g} s after {gap.at_s:.2f} s")
    short = [gap for gap in s.gaps if not gap.split]
    if short:
        longest = max(short, key=lambda gap: gap.duration_s)
        sentence = (
            f"{s.missing} samples missing in {len(short)} gap(s), the longest {1e3 * longest.duration_s:.3g} "
            f"ms after {longest.at_s:.2f} s; filled by straight lines"
        )
        if s.missing > _MOST_MISSING * s.samples:
            notes.because("poor", sentence)
        else:
            notes.remarks.append(sentence)
    if s.repeated_rows:
        share = s.repeated_rows / (s.samples + s.repeated_rows)
        notes.remarks.append(f"{s.repeated_rows} rows ({share:.2%}) repeat the one before; dropped")
    if result.turns_lost:
        notes.remarks.append(f"{result.turns_lost} turn(s) not used: readings are missing in them")
    for axis, count in zip(result.log.axes, s.at_limit.tolist(), strict=True):
        if count and result.log.accel_unit == "m/s2" and result.log.gyro_unit == "rad/s":
            notes.because("poor", f"{axis} is at the end of its range in {count} samples")
    if result.quiet.initial_s == 0.0 and result.has_gyro:
        notes.because(
            "poor",
            "the log does not begin at rest; the gyroscope's bias is that of its longest rest",
            "let the sensor lie still for 30 s at the start",
        )


def judge_intrinsics(result: Intrinsics) -> IntrinsicsJudgement:
    """Verdict of a calibration of an IMU."""
    notes = _Notes()
    _of_log(result, notes)
    if result.planar and not result.asked:
        notes.remarks.append("all poses lie in the plane of x and y: ax, ay and gz alone are calibrated")
    if result.planar:
        lean = "" if math.isnan(result.lean_rad) else (
            f"; by az it leans by {math.degrees(result.lean_rad):.1f} degrees at most, which would make the "
            f"scales {1.0 - math.cos(result.lean_rad):.2g} too small"
        )  # fmt: skip
        notes.remarks.append("the plane is taken to stand upright" + lean)
    if result.accel is None:
        needed = 4 if result.planar else 6
        notes.because(
            "unidentifiable",
            f"{len(result.rests)} rest(s) in {result.poses} pose(s) are fewer than the {needed} that bias "
            "and scale need",
            protocol(result.planar),
        )
    else:
        _of_accelerometer(result, result.accel, notes)
    if result.gyro is not None:
        _of_gyroscope(result, result.gyro, notes)
    elif not result.has_gyro:
        needed_axes = "gz" if result.planar else "gx, gy and gz"
        notes.remarks.append(f"without {needed_axes} the gyroscope is not calibrated")
    elif result.accel is not None and result.accel.span >= LEAST_SPAN:
        notes.because("unidentifiable", "no turn between two rests is there to calibrate the gyroscope by")
    return IntrinsicsJudgement(notes.verdict, tuple(notes.reasons), tuple(notes.remarks), tuple(notes.advice))

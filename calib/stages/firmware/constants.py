"""Numbers of calib_constants.h that do not stand in rig.yaml as the firmware wants them.

Their names, units and comments are the template's, `templates/calib_constants.h.j2`; here is what they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography, box_grid, in_picture
from calib.core.result import Result
from calib.core.rig import VERBS, Rig
from calib.stages.actuator.kinematics import MARKER_OFFSET_M, inverse_coefficients
from calib.stages.actuator.parameters import LONGEST_ELONGATION_M, Plant
from calib.stages.actuator.pump import PWM_MAX, ElongationForce
from calib.stages.camera.pose import homography_with_lens, plane_pixels
from calib.stages.control.laws import ANGLE_PIDS, LENGTHS_PD, FeedForward, Pid
from calib.stages.control.rig_model import PWM_MIN
from calib.stages.control.section import OrientationGains, StaticMap
from calib.stages.estimator import constant_gain
from calib.stages.estimator.constant_gain import MOST_DELAY_TICKS, SHAKING_RADPS2, TickNoise
from calib.stages.estimator.section import EstimatorGain
from calib.stages.estimator.sensors import GRAVITY_MPS2
from calib.stages.firmware.section import Envelope
from calib.stages.imu.levelling import Levelling, settled
from calib.stages.imu.levelling import gains as gains_of
from calib.stages.lowpass.filters import Design, design_lowpass, state_variable_gains

# ----------------------------------------------------------------------
# Values of rig.yaml by their keys, with the nominal actuator's where the file has none.


class Lookup:
    """Numbers of a rig by dotted keys, such as `align.accel_bias_mps2.0`.

    Attributes
    ----------
    source : the file's name for messages.
    missing : keys that took defaults, in the order of their use.
    """

    def __init__(self, rig: Rig, source: str) -> None:
        self.rig, self.source = rig, source
        self._standing = rig.standing
        self.missing: dict[str, None] = {}

    def find(self, key: str) -> Any:
        """What stands at a key, None for nothing."""
        name, *parts = key.split(".")
        if name in self._standing and parts:
            value, _ = self._standing[name].get(parts[0], (None, None))
            return value
        node = getattr(self.rig, name)
        for part in parts:
            if node is None:
                return None
            node = node[int(part)] if isinstance(node, list) else getattr(node, part)
        return node

    def number(self, key: str, default: float, least: float = -math.inf, most: float = math.inf) -> float:
        """The number at a key, the default where there is none.

        Raises `BadInputError` for one beyond what the firmware can run with.
        """
        value = self.find(key)
        if value is None:
            self.missing[key] = None
            return default
        if not least <= value <= most:
            raise BadInputError(
                f"{self.source}: {key} is {value:g}, expected {least:g} to {most:g} for the firmware"
                + "".join(f"; {why}" for why in self.senseless(key.split(".")[0]))
            )
        return float(value)

    def senseless(self, name: str) -> Iterator[str]:
        """What is to be said of a section's number where its data do not determine it."""
        section = getattr(self.rig, name)
        if isinstance(section, Result) and (word := section.verdict.word) not in ("ok", "poor"):
            yield f"{name} is {word}, so that its numbers mean nothing: run calib {VERBS[name]} on other data"


# ----------------------------------------------------------------------
# The plane.
#
# A marker goes through one of two homographies of (2.11):
#
#     CALIB_UNDISTORT 1   pixels -> normalised -> lens undone -> A^-1 K
#     CALIB_UNDISTORT 0   pixels -> a homography fitted to the pixels as the lens shows them
#
# The second neglects the lens as the source does, and spreads what that costs over the workspace. Both are
# scaled so that the denominator, 1/s of (2.12), is the reciprocal depth in 1/m and positive wherever the
# marker can be; at a tenth of its least value there the marker counts as lost behind the horizon.

_HORIZON_SHARE = 0.1


@dataclass(frozen=True)
class PlaneConstants:
    """The plane's three homographies (3, 3) and the least denominators.

    Attributes
    ----------
    ideal : undistorted pixels to metres, A^-1. normalised : undistorted normalised coordinates to metres,
        A^-1 K. raw : pixels as the camera reports them to metres; None where the camera sees too little of
        the workspace to fit it.
    least, raw_least : least denominators of the last two in the workspace, times a tenth [1/m].
    raw_error_m : largest distance that `raw` is off in the workspace.
    verdict : of the plane.
    """

    ideal: FloatArray
    normalised: FloatArray
    raw: FloatArray | None
    least: float
    raw_least: float
    raw_error_m: float
    verdict: str


def _depths(A: FloatArray, world: FloatArray) -> FloatArray:
    return np.asarray(world @ A[2, :2] + A[2, 2])


def plane_constants(rig: Rig, source: str) -> PlaneConstants | None:
    """The plane's homographies for a marker in the workspace, without the shift and stretch of an alignment.

    The calibrated plane shows P at P + shift + stretch (P - `Rig.middle_m`). None for a rig without a plane.

    Raises `BadInputError` for a workspace behind the camera.
    """
    known = rig.current_plane(source)
    if known is None or rig.camera is None:
        return None
    camera, R, t = rig.camera.optics, np.array(known.R_CW), np.array(known.t_CW_m)
    grid = box_grid(rig.workspace_m, 9, 7).reshape(-1, 2)
    # The denominator is the reciprocal depth when A's depth is in metres.
    A_inverse = np.array(known.A_inverse)
    A = np.asarray(np.linalg.inv(A_inverse), dtype=np.float64)
    scale = (R[2, 0] * grid[0, 0] + R[2, 1] * grid[0, 1] + t[2]) / _depths(A, grid[:1])[0]
    ideal = A_inverse / scale
    depth = _depths(A * scale, grid)
    if not depth.min() > 0.0:
        raise BadInputError("plane: the workspace reaches behind the camera, so no marker can be mapped")
    raw, raw_least, error = None, 0.0, 0.0
    H = homography_with_lens(camera, R, t, rig.workspace_m)
    if H is not None:
        centre = np.array([rig.middle_m])
        H = H * (float((centre @ R[2, :2] + t[2])[0]) / _depths(H, centre)[0])
        raw = np.asarray(np.linalg.inv(H))
        raw_least = _HORIZON_SHARE / float(_depths(H, grid).max())
        pixels = plane_pixels(camera, R, t, grid)
        back = apply_homography(raw, pixels) - grid
        error = float(np.linalg.norm(back[in_picture(pixels, camera.image_size_px)], axis=1).max())
    right = np.eye(3)
    if rig.align is not None:
        shrink, (across, along) = 1.0 / (1.0 + rig.align.plane_stretch), rig.align.plane_shift_m
        x, y = rig.middle_m
        right[:2] = [[shrink, 0.0, x - shrink * (x + across)], [0.0, shrink, y - shrink * (y + along)]]
    return PlaneConstants(
        right @ ideal,
        right @ ideal @ camera.K,
        None if raw is None else right @ raw,
        _HORIZON_SHARE / float(depth.max()),
        raw_least,
        error,
        known.verdict.word,
    )


# ----------------------------------------------------------------------
# From sensors to the bellows' lengths: tick, IMU, angle filter, marker offset, low-pass, kinematics.
#
# The tick's period is folded into the gains of the angle filter (2.3), whose integral is kept as an angle
# per tick J = I dt:
#
#     J   += (Ki dt^2) e                       e = atan2(ay, ax) - mount - phi, wrapped to half a turn
#     phi += (Kp dt) e + J - dt gz,                J = bias dt at the start
#
# The levelling filter takes V of `calib.stages.imu.levelling` as a sum of angles over ticks, S = V / dt. Its
# gains stand in a table for the ticks at which they change, the last for ever.
#
#     phi += J - dt (gz + gz of the tick before) / 2,   S += e
#     phi += A S,   J += B S,   S -= C S
#
# A section of the low-pass of order one, b0 (1 + z^-1) / (1 + a1 z^-1), runs in the trapezoidal form
# v = b0 (x - s), y = s + v, s' = y + v: one product, and y = x exactly at rest. A section of order two runs
# as a state-variable filter whose gains `calib.stages.lowpass.filters` derives, at rest as exact.

MOST_EARLY_TICKS = 1.0
"""Pictures that are earlier than the IMU by less count as of its time."""

_WHOLE = 1e-6
_SAME_TICK = 1e-5
"""A share; a period typed with five digits is meant exactly."""
_LEVELLING_STEPS = 17


def _delay_ticks(lookup: Lookup, rate_hz: float) -> float:
    """Ticks from the exposure of a picture to the tick that reads it; 0 for pictures that seem early."""
    delay = lookup.number("align.time_offset_s", 0.0) * rate_hz
    if not -MOST_EARLY_TICKS <= delay <= MOST_DELAY_TICKS:
        advice = next(lookup.senseless("align"), None) or (
            "take a faster camera, or tick more slowly: calib lowpass --rate "
            f"{max(math.floor(MOST_DELAY_TICKS * rate_hz / delay), 1)}Hz"
            if delay > 0.0
            else "record camera and IMU by one clock and align again: no picture comes before its motion"
        )
        raise BadInputError(
            f"{lookup.source}: align.time_offset_s is {delay / rate_hz:g} s, {delay:.3g} ticks; "
            f"expected pictures that are {-MOST_EARLY_TICKS:g} to {MOST_DELAY_TICKS} ticks late; {advice}"
        )
    return max(delay, 0.0)


def _imu(lookup: Lookup, rate_hz: float) -> dict[str, Any]:
    """Biases, ratio of the scales, mount angle; the gyroscope's bias, and dt over its scale."""
    bias, scales, scale = [0.0, 0.0], [1.0, 1.0], 1.0
    if lookup.find("align") is not None:
        mount = math.remainder(lookup.number("align.mount_angle_rad", 0.0), 2.0 * math.pi)
        bias = [lookup.number(f"align.accel_bias_mps2.{i}", 0.0) for i in range(2)]
        scales = [1.0 + lookup.number(f"align.accel_scale.{i}", 0.0) for i in range(2)]
        gyro = lookup.number("align.gyro_bias_radps", 0.0)
        scale += lookup.number("align.gyro_scale", 0.0)
    else:
        mount = lookup.number("align.rest_angle_rad", 0.0)
        gyro = lookup.number("imu.gyro_bias_radps.2", 0.0)
        if lookup.find("imu_intrinsics.accel.unit") == "m/s2":
            bias = [lookup.number(f"imu_intrinsics.accel.bias.{i}", 0.0) for i in range(2)]
    ratio, dt = scales[0] / scales[1], 1.0 / (rate_hz * scale)
    return {"bias": bias, "scales": scales, "ratio": ratio, "mount": mount, "gyro_bias": gyro, "gyro_dt": dt}


def _levelling(lookup: Lookup, rate_hz: float) -> dict[str, Any] | None:
    """Gains of the levelling filter from the first tick on, constant over stretches that grow."""
    if lookup.find("orientation_filter.filter") != "levelling":
        return None
    tau_s = lookup.number("orientation_filter.tau_s", Levelling.tau_s, 2.0 / rate_hz, 100.0)
    velocity = lookup.number("orientation_filter.velocity_mps", Levelling.velocity_mps, 1e-4, 100.0)
    filter_ = Levelling(tau_s, velocity)
    dt, last = 1.0 / rate_hz, min(round(3.0 * filter_.bias_tau_s * rate_hz), 0xFFFF)
    edges = np.unique(np.round(np.geomspace(1.0, last, _LEVELLING_STEPS))).astype(int)
    gains = gains_of(filter_, dt, last)
    rows = [gains[a - 1 : b - 1].mean(axis=0) for a, b in pairwise(edges.tolist())]
    table = np.array([*rows, settled(filter_, dt)]) * [1.0, dt, dt * dt]
    names = ("sum", "angle", "bias")
    return {
        "tau_s": tau_s,
        "velocity_mps": velocity,
        "until": [*map(float, edges[1:] - 1), 0.0],
        **dict(zip(names, table.T.tolist(), strict=True)),
    }


def _lowpass(lookup: Lookup) -> list[dict[str, Any]]:
    """Sections b (3,), a (2,) and gains of the state-variable form; those of order one come last."""
    if lookup.rig.lowpass is None:
        lookup.number("lowpass.cutoff_hz", 1.0)
        # Rounded so that the gain at rest is one, as the sections of rig.yaml are.
        a1 = float(np.float32(design_lowpass(Design(1.0, lookup.rig.tick_hz)).exact[0, 4]))
        sections = [([0.5 * (1.0 + a1), 0.5 * (1.0 + a1), 0.0], [a1, 0.0])]
    else:
        sections = [(one.b, one.a[1:]) for one in lookup.rig.lowpass.sections]
    made = []
    for index, (b, a) in enumerate(sorted(sections, key=lambda section: section[1][1] == 0.0), start=1):
        pair: list[float] = []
        if a[1] != 0.0:
            if b[0] != b[2]:
                where = f"{lookup.source}: lowpass.sections.{index - 1}.b"
                raise BadInputError(f"{where} is {b}, expected its last as its first, as calib lowpass does")
            pair = state_variable_gains(a[0], a[1], b[0])
        made.append({"index": index, "b": b, "a": a, "pair": pair, "zeros": any(pair[3:])})
    return made


# ----------------------------------------------------------------------
# Controllers of chapter 4 for the firmware: gains with the tick folded in, feed-forward, pump limits.
#
# (4.4) summed from a history of zeros is, term by term and clamped ticks included,
#
#     u_k = (Kp + Kd / dt) e_k - Kd / dt e_(k-1) + S_k,   S_k = S_(k-1) + Ki dt / 2 (e_k + e_(k-1)),
#
# where a tick whose u_k lies outside the limits leaves S as it was and takes u_k without the new summand.
# These are the values of the incremental form, but what rounding does to a PD controller's output does not
# add up from tick to tick. The pipeline keeps P_k = S_k + Ki dt / 2 e_k, which saves it a product:
#
#     u_k = (Kp + Kd / dt + Ki dt / 2) e_k + (P_(k-1) - Kd / dt e_(k-1)),   P_k = P_(k-1) + Ki dt e_k.

_TABLE_STEP_M = 0.002


def _pid(lookup: Lookup, name: str, word: str, default: Pid, rate_hz: float) -> dict[str, Any]:
    Kp = lookup.number(f"controller.{name}.Kp_pwm_per_{word}", default.Kp)
    Ki = lookup.number(f"controller.{name}.Ki_pwm_per_{word}_s", default.Ki)
    Kd = lookup.number(f"controller.{name}.Kd_pwm_s_per_{word}", default.Kd)
    gains = {"Kp": Kp, "Ki": Ki, "Kd": Kd, "derivative": Kd * rate_hz, "half": 0.5 * Ki / rate_hz}
    tuned = lookup.find(f"controller.{name}")
    if not isinstance(tuned, OrientationGains):
        return {**gains, "clamping": default.clamping, "back": 0.0, "falling_share": None}
    # Without an integral there is none to follow the limits.
    back = 1.0 / (rate_hz * tuned.back_calculation_s) if Ki else 0.0
    return {**gains, "clamping": False, "back": back, "falling_share": tuned.falling_share}


def _nominal_table() -> tuple[float, list[float]]:
    """First length and PWM values of the steady elongation of both bellows together (2.13)."""
    pump = ElongationForce()
    pwm = np.linspace(pump.dead_zone_V / pump.supply_V * PWM_MAX, PWM_MAX, 2000)
    eps = 1e-3 * np.polyval(pump.elongation_mm, pump.supply_V * pwm / PWM_MAX)
    rising = np.maximum.accumulate(np.maximum(eps, 0.0))
    lengths = np.arange(0.0, float(rising[-1]) + _TABLE_STEP_M, _TABLE_STEP_M)
    keep = np.concatenate([[True], np.diff(rising) > 0.0])
    return Plant().rest_length_m, np.interp(lengths, rising[keep], pwm[keep]).tolist()


def _tuned_table(map_: StaticMap, low_pwm: float) -> tuple[float, list[float]]:
    """First length and PWM values that hold the straight actuator at lengths, by the rig's static map."""
    force, pwm = np.array(map_.force_pwm).T
    lengths = np.arange(0.0, LONGEST_ELONGATION_M + 1e-9, _TABLE_STEP_M)
    wanted = np.polyval(map_.stiffness_N_per_m[::-1], lengths) * lengths / np.mean(map_.strength)
    held = np.where(wanted < force[0], low_pwm, np.interp(wanted, force, pwm))
    last = int(np.searchsorted(wanted, force[-1])) + 1
    return map_.rest_length_m, held[: max(last, 2)].tolist()


def _feed(lookup: Lookup, low_pwm: float) -> dict[str, Any]:
    tuned = lookup.find("controller.feedforward")
    own = isinstance(tuned, StaticMap)
    first, pwm = _tuned_table(tuned, low_pwm) if own else _nominal_table()
    return {"use_table": own, "line": FeedForward(), "first_m": first, "step_m": _TABLE_STEP_M, "pwm": pwm}


def _limits(lookup: Lookup) -> tuple[float, float]:
    low = lookup.number("controller.pwm_low", PWM_MIN)
    high = lookup.number("controller.pwm_high", PWM_MAX)
    # The guard's self-test commands 1 for a pump that is not at full power.
    if not low < high or high < 2.0 or high != round(high) or low != round(low):
        raise BadInputError(
            f"{lookup.source}: controller.pwm_low and pwm_high are {low:g} and {high:g}, "
            "expected whole numbers, the second at least 2 and above the first"
        )
    return low, high


_SHORTEST_M, _LONGEST_M = 0.5 * LONGEST_ELONGATION_M, 1.25 * LONGEST_ELONGATION_M
"""By how much a bellows may be shorter and longer than at rest."""
_FILLED_LAGS = 4.0
"""Lags of the pump after which its force is 2 % from where it settles."""


def _envelope(
    lookup: Lookup, rate_hz: float, pwm: tuple[float, float], feed: dict[str, Any], radius: float, rest: float
) -> dict[str, Any]:
    """Limits of the guard, from the actuator's rest length and radius where a person states none."""

    def limit(name: str, default: float | None = None, *bounds: float) -> float:
        if default is None:
            default = float(getattr(Envelope(), name))
        return lookup.number(f"envelope.{name}", default, *bounds)

    least = limit("least_length_m", max(rest - _SHORTEST_M, 0.1 * rest))
    greatest = limit("greatest_length_m", rest + _LONGEST_M)
    if not least < greatest:
        raise BadInputError(
            f"{lookup.source}: envelope.least_length_m is {least:g}, expected less than the greatest, "
            f"{greatest:g}"
        )
    # The command that holds both bellows at the greatest length, the pumps' greatest where none does.
    reached = feed["first_m"] + _TABLE_STEP_M * np.arange(len(feed["pwm"]))
    held = min(max(float(np.interp(greatest, reached, feed["pwm"], right=PWM_MAX)), 1.0), pwm[1])

    def ticks(name: str, least_s: float = 0.0) -> int:
        # The guard's self-test needs three.
        time_s = limit(name, max(float(getattr(Envelope(), name)), least_s))
        return min(max(round(time_s * rate_hz), 3), 65000)

    lag_s = lookup.find("pump.lag_s") or 0.0

    return {
        "least_length_m": least,
        "greatest_length_m": greatest,
        "angle_rad": limit("angle_rad", min(_LONGEST_M / (2.0 * radius), 1.5)),
        "rate_mps": limit("rate_mps"),
        "full_ticks": ticks("full_power_s", _FILLED_LAGS * lag_s),
        "open_ticks": ticks("open_loop_s"),
        "open_loop_pwm": float(math.floor(limit("open_loop_pwm", held, *pwm))),
        "apart_m": limit("apart_m"),
    }


# ----------------------------------------------------------------------
# Constants of the fused estimator, from `align` and `estimator.constant_gain` of rig.yaml.
#
# The tick is that of `calib.stages.estimator.constant_gain`. Its calibration of the IMU is folded into one
# affine map: with f = ((a_x - b_x) / (1 + s_x), (a_y - b_y) / (1 + s_y)), the mount alpha and k = K_a / g,
#
#     A = k ( f_x cos alpha + f_y sin alpha),   B = k (-f_x sin alpha + f_y cos alpha),
#
# so that K_a e_a = B cos(phi_D) - A sin(phi_D) - K_a (phi - phi_D). D is the age
# of a picture in ticks.

_WEAK_MPS2 = 1.0


def _designed(
    lookup: Lookup, rate_hz: float, delay: float, plane: PlaneConstants, rest: float
) -> EstimatorGain:
    """Gains for the noise that the alignment has found, at the head's rest; a tracker of whole pixels."""
    d = lookup.number("align.marker_offset_m", 0.0)
    # How places of the marker change with a pixel there, by the undistorted plane.
    H = np.linalg.inv(plane.ideal)
    at = H @ np.array([0.0, rest + d, 1.0])
    by_place = (H[:2, :2] - np.outer(at[:2] / at[2], H[2, :2])) / at[2]
    pixel = math.hypot(lookup.number("align.jitter_px", 0.3), math.sqrt(1.0 / 12.0))
    across, along = pixel * np.linalg.norm(np.linalg.inv(by_place), axis=1)
    lever = 0.5 * rest + d
    reach = 0.5 * rest + lookup.number("align.imu_lever_m", 0.0)
    shaken = math.hypot(lookup.number("align.accel_noise_mps2.0", 0.0), SHAKING_RADPS2 * reach)
    gyro = lookup.number("align.gyro_noise_radps", 0.0)
    noise = TickNoise(float(across) / lever, float(along), gyro, shaken / GRAVITY_MPS2)
    return constant_gain.design(noise, rate_hz, delay / rate_hz, lever)


def _fused(
    lookup: Lookup,
    rate_hz: float,
    delay: float,
    plane: PlaneConstants | None,
    imu: dict[str, Any],
    rest: float,
) -> dict[str, Any]:
    """Those of the estimator, or what rig.yaml lacks for it.

    The gains are those of `estimator.constant_gain`, or for the noise in `align` where there are none of this
    tick.
    """
    if plane is None or lookup.rig.align is None:
        return {
            "lacks": " and ".join([*["plane"] * (plane is None), *["align"] * (lookup.rig.align is None)])
        }
    tuned = lookup.find("estimator.constant_gain")
    if isinstance(tuned, EstimatorGain) and abs(tuned.rate_hz / rate_hz - 1.0) <= 1e-6:
        gain, source = tuned, "Gains of estimator.constant_gain."
    else:
        gain, source = _designed(lookup, rate_hz, delay, plane, rest), "Gains for the noise in align."
        if tuned is not None:
            source += " Those of estimator.constant_gain are for another tick."
    k = gain.accel_phi / GRAVITY_MPS2
    ca, sa = k * math.cos(imu["mount"]), k * math.sin(imu["mount"])
    rows = np.array([[ca, sa], [-sa, ca]]) / imu["scales"]
    return {
        "lacks": "",
        "source": source,
        "delay": delay,
        "accel": np.column_stack([rows, rows @ imu["bias"]]),
        "gain": gain,
        "weak": k * _WEAK_MPS2,
        "estimator": constant_gain,
    }


def constants(lookup: Lookup, plane: PlaneConstants | None) -> dict[str, Any]:
    """All that the template wants of motion and control, by its names.

    Raises `BadInputError` for values of rig.yaml that the firmware cannot run with, by their key.
    """
    nominal = Plant()
    # The control loop runs at the rate of the low-pass.
    rate_hz = lookup.number("lowpass.rate_hz", lookup.rig.tick_hz, 1.0, 1000.0)
    radius = lookup.number("actuator.bellows_radius_m", nominal.bellows_radius_m)
    rest = lookup.number("actuator.rest_length_m", nominal.rest_length_m)
    tick_s = lookup.number("controller.tick_s", 1.0 / rate_hz)
    if abs(tick_s * rate_hz - 1.0) > _SAME_TICK:
        raise BadInputError(
            f"{lookup.source}: controller.tick_s is {tick_s:g} s, but the low-pass runs at {rate_hz:g} Hz; "
            "expected the same tick for both, run calib control tune again"
        )
    imu, pwm = _imu(lookup, rate_hz), _limits(lookup)
    feed = _feed(lookup, pwm[0])
    delay = _delay_ticks(lookup, rate_hz)
    ticks = math.ceil(delay - _WHOLE)
    return {
        "rate_hz": rate_hz,
        "offset_ticks": ticks,
        "offset_part": max(ticks - delay, 0.0),
        "imu": imu,
        "imu_sign": lookup.find("geometry.imu_sign") or [1, 1, 1],
        "levelling": _levelling(lookup, rate_hz),
        "mahony": {
            "Kp": lookup.number("orientation_filter.Kp_per_s", 3.0, 0.0, rate_hz),
            "Ki": lookup.number("orientation_filter.Ki_per_s2", 3.0, 0.0, rate_hz * rate_hz),
        },
        "marker_offset_m": lookup.number("align.marker_offset_m", MARKER_OFFSET_M),
        "lowpass": _lowpass(lookup),
        "bellows_radius_m": radius,
        "rest_length_m": rest,
        "series": [float(c) for c in inverse_coefficients()],
        "fused": _fused(lookup, rate_hz, delay, plane, imu, rest),
        "pwm": pwm,
        "orientation": _pid(lookup, "orientation", "rad", ANGLE_PIDS["clamping"], rate_hz),
        "orientation_sign": round(lookup.number("controller.orientation.sign", 1)),
        "position": _pid(lookup, "position", "m", LENGTHS_PD, rate_hz),
        "feed": feed,
        "envelope": _envelope(lookup, rate_hz, pwm, feed, radius, rest),
        "defaults": list(lookup.missing),
    }

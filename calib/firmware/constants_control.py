"""Controllers of chapter 4 for the firmware: gains with the tick folded in, feed-forward, pump limits.

(4.4) summed from a history of zeros is, term by term and clamped ticks included,

    u_k = (Kp + Kd / dt) e_k - Kd / dt e_(k-1) + S_k,   S_k = S_(k-1) + Ki dt / 2 (e_k + e_(k-1)),

where a tick whose u_k lies outside the limits leaves S as it was and takes u_k without the new summand.
These are the values of the incremental form, but what rounding does to a PD controller's output does not
add up from tick to tick. The pipeline keeps P_k = S_k + Ki dt / 2 e_k, which saves it a product:

    u_k = (Kp + Kd / dt + Ki dt / 2) e_k + (P_(k-1) - Kd / dt e_(k-1)),   P_k = P_(k-1) + Ki dt e_k.
"""

from __future__ import annotations

import numpy as np

from calib.actuator.parameters import LONGEST_ELONGATION_M, Plant
from calib.actuator.pump import PWM_MAX, ElongationForce
from calib.control.feedforward import FeedForward
from calib.control.pid import PWM_MIN, Pid
from calib.errors import BadInputError
from calib.firmware.known import Known
from calib.firmware.literals import Constant, Group, Table, Whole
from calib.rig_controller import StaticMap

__all__ = ["control_groups"]

_ORIENTATION = Pid(1000.0, 1000.0, 10.0, clamping=True)
_POSITION = Pid(15000.0, 0.0, 150.0)
_TABLE_STEP_M = 0.002
_LARGEST_GAIN = 1e7


def _pid_group(
    known: Known, name: str, title: str, units: tuple[str, str], default: Pid, rate_hz: float
) -> Group:
    stem, key, (unit, words) = f"CALIB_{name.upper()}", f"controller.{name}", units

    def gain(which: str, value: float) -> float:
        return known.number(f"{key}.{which}", value, -_LARGEST_GAIN, _LARGEST_GAIN)

    Kp = gain(f"Kp_pwm_per_{words}", default.Kp)
    Ki = gain(f"Ki_pwm_per_{words}_s", default.Ki)
    Kd = gain(f"Kd_pwm_s_per_{words}", default.Kd)
    if known.node(f"{key}.falling_share") is not None:
        title += " falling_share is left out: the lower limit is CALIB_PUMP_LOW_PWM."
    back_s = known.node(f"{key}.back_calculation_s")
    back = 0.0
    clamping = int(default.clamping)
    if back_s is not None:
        clamping, back = 0, 1.0 / (rate_hz * known.number(f"{key}.back_calculation_s", 1.0, 1e-6, 1e6))
    derivative, half = Kd * rate_hz, 0.5 * Ki / rate_hz
    per = f"PWM_PER_{unit}"
    return Group(
        (
            title,
            f"Kp = {Kp:.9g}, Ki = {Ki:.9g}, Kd = {Kd:.9g}, error in {words}. The pipeline sums (4.4) up:",
            "u = KPDI e_k + (P - KD_PER_DT e_(k-1)), P += 2 KI_HALF_DT e_k; E0, E1, E2 are the factors of",
            "e_k, e_(k-1), e_(k-2) in the incremental form u_k = u_(k-1) + ..., (4.4) and (D.9).",
        ),
        (
            Constant(f"{stem}_KPDI_{per}", Kp + derivative + half, f"Kp + Kd / dt + Ki dt / 2, PWM/{words}"),
            Constant(f"{stem}_KD_PER_DT_{per}", derivative, f"Kd / dt, PWM/{words}"),
            Constant(f"{stem}_KI_HALF_DT_{per}", half, f"Ki dt / 2, PWM/{words}"),
            Whole(f"{stem}_HAS_KI", int(Ki != 0.0), "for #if"),
            Whole(f"{stem}_CLAMPING", clamping, "1: no integration beyond the limits (4.1.1)"),
            Whole(f"{stem}_HAS_BACK", int(back != 0.0), "1: back-calculation, P += BACK (limited - u)"),
            Constant(f"{stem}_BACK", back, "dt / time constant of the back-calculation, dimensionless"),
            Constant(f"{stem}_E0_{per}", Kp + half + derivative, f"Kp + Ki dt / 2 + Kd / dt, PWM/{words}"),
            Constant(
                f"{stem}_E1_{per}", half - Kp - 2.0 * derivative, f"-Kp + Ki dt / 2 - 2 Kd / dt, PWM/{words}"
            ),
            Constant(f"{stem}_E2_{per}", derivative, f"Kd / dt, PWM/{words}"),
        ),
        known.told(),
    )


def _nominal_table() -> tuple[float, tuple[float, ...]]:
    """First length and PWM values of the steady elongation of both bellows together (2.13)."""
    pump = ElongationForce()
    pwm = np.linspace(pump.dead_zone_V / pump.supply_V * PWM_MAX, PWM_MAX, 2000)
    eps = 1e-3 * np.polyval(pump.elongation_mm, pump.supply_V * pwm / PWM_MAX)
    rising = np.maximum.accumulate(np.maximum(eps, 0.0))
    lengths = np.arange(0.0, float(rising[-1]) + _TABLE_STEP_M, _TABLE_STEP_M)
    keep = np.concatenate([[True], np.diff(rising) > 0.0])
    return Plant().rest_length_m, tuple(float(v) for v in np.interp(lengths, rising[keep], pwm[keep]))


def _tuned_table(map_: StaticMap, low_pwm: float) -> tuple[float, tuple[float, ...]]:
    """First length and PWM values that hold the straight actuator at lengths, by the rig's static map."""
    force, pwm = np.array(map_.force_pwm).T
    first = map_.rest_length_m
    lengths = np.arange(0.0, LONGEST_ELONGATION_M + 1e-9, _TABLE_STEP_M)
    wanted = np.polyval(map_.stiffness_N_per_m[::-1], lengths) * lengths / np.mean(map_.strength)
    held = np.where(wanted < force[0], low_pwm, np.interp(wanted, force, pwm))
    last = int(np.searchsorted(wanted, force[-1])) + 1
    return first, tuple(float(v) for v in held[: max(last, 2)])


def _feedforward_group(known: Known, low_pwm: float) -> Group:
    line = FeedForward()
    at, offset, slope, limit = line.from_m, line.offset_pwm, line.slope_pwm_per_m, line.limit_pwm
    first, values = _nominal_table()
    tuned = known.node("controller.feedforward")
    if isinstance(tuned, StaticMap):
        first, values = _tuned_table(tuned, low_pwm)
        told = "The table: controller.feedforward at phi = 0, without bending; the line: (4.6)."
    else:
        told = "Defaults, not in rig.yaml: the line (4.6), and the table of (2.13)."
    table, step = int(isinstance(tuned, StaticMap)), _TABLE_STEP_M
    return Group(
        (
            "Feed-forward: the line (4.6), 0 below FROM, else min(LIMIT, OFFSET + SLOPE (q_ref - FROM)), or",
            "the table of steady lengths: linear between entries, the last one beyond, 0 before the first.",
        ),
        (
            Whole("CALIB_FF_USE_TABLE", table, "0: the line, 1: the table"),
            Constant("CALIB_FF_FROM_M", at, "shortest bellows that needs pressure, m"),
            Constant("CALIB_FF_OFFSET_PWM", offset, "value there, PWM"),
            Constant("CALIB_FF_SLOPE_PWM_PER_M", slope, "PWM/m"),
            Constant("CALIB_FF_MINUS_PWM", slope * at - offset, "SLOPE FROM - OFFSET, PWM"),
            Constant("CALIB_FF_LIMIT_PWM", limit, "largest value, PWM"),
            Constant("CALIB_FF_TABLE_FROM_M", first, "length of the first entry, m"),
            Constant("CALIB_FF_TABLE_PER_STEP", 1.0 / step, "entries per metre, 1/m"),
            Whole("CALIB_FF_TABLE_SIZE", len(values), "entries"),
            Table(
                "calib_ff_table_pwm",
                values,
                f"PWM that holds a bellows at FROM + {step:.9g} m times the index",
            ),
        ),
        told,
    )


def _limits(known: Known) -> tuple[float, float]:
    low = known.number("controller.pwm_low", PWM_MIN, 0.0, PWM_MAX)
    high = known.number("controller.pwm_high", PWM_MAX, 0.0, PWM_MAX)
    if not low < high or high != round(high) or low != round(low):
        raise BadInputError(
            f"{known.source}: controller.pwm_low and pwm_high are {low:g} and {high:g}, "
            "expected rising whole numbers"
        )
    return low, high


def _pump_group(known: Known, low: float, high: float) -> Group:
    pump = ElongationForce()
    supply = known.number("pump.supply_V", pump.supply_V, 1.0, 100.0)
    dead = known.number("pump.dead_zone_V", pump.dead_zone_V, 0.0, supply)
    return Group(
        ("Pumps.",),
        (
            Constant("CALIB_PUMP_LOW_PWM", low, "least command and limit of the clamping, PWM"),
            Constant("CALIB_PUMP_HIGH_PWM", high, "greatest command and limit of the clamping, PWM"),
            Whole("CALIB_PUMP_HIGH", round(high), "the same, for #if"),
            Constant(
                "CALIB_PUMP_DEAD_ZONE_PWM", PWM_MAX * dead / supply, "no pressure below, PWM, for information"
            ),
            Constant("CALIB_PUMP_SUPPLY_V", supply, "at PWM 255, V, for information"),
        ),
        known.told(),
    )


def control_groups(known: Known, rate_hz: float) -> tuple[Group, ...]:
    """Groups of the header for both controllers, the feed-forward and the pumps.

    Raises `BadInputError` for values of rig.yaml that the firmware cannot run with.
    """
    tick_s = known.number("controller.tick_s", 1.0 / rate_hz)
    if abs(tick_s * rate_hz - 1.0) > 1e-6:
        raise BadInputError(
            f"{known.source}: controller.tick_s is {tick_s:g} s, but the low-pass runs at {rate_hz:g} Hz; "
            "expected the same tick for both"
        )
    low, high = _limits(known)
    pumps = _pump_group(known, low, high)
    angle = _pid_group(
        known, "orientation", "Control of the angle, PID (4.1), (4.4).", ("RAD", "rad"), _ORIENTATION, rate_hz
    )
    sign = known.choice("controller.orientation.sign", 1, (1, -1))
    crossed = Group(
        ("Which bellows a positive error of the angle drives (4.1).",),
        (Whole("CALIB_ORIENTATION_SIGN", sign, "1: bellows 1; -1: the hoses are crossed"),),
        known.told(),
    )
    lengths = _pid_group(
        known, "position", "Control of both lengths, PD (4.5), (4.8).", ("M", "m"), _POSITION, rate_hz
    )
    return pumps, angle, crossed, lengths, _feedforward_group(known, low)

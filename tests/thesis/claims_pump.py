"""Claims about the pumps (2.3, 3.5)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calib.stages.actuator.pump import PWM_MAX, ElongationForce, PolynomialForce, static_force_N
from calib.twin.scenarios import elongation_mm
from thesis.outcome import Finding, Outcome, claim, exactly, near, on_twin
from thesis.runs import PRINTED_RATE, nominal, printed_plant, tried, with_plant, with_pump

__all__ = ["DYNAMIC", "STATIC"]

_THRESHOLD_V, _SUPPLY_V = 4.7, 12.0
_PRINTED = (-0.1493, 3.376, -25.87, 54.13)
"""Coefficients of (2.13) as printed, in millimetres."""


@claim("pump.threshold", "2.3", "no elongation below this voltage", "4.7 V (PWM 100)", "data", basis="chosen")
def threshold() -> Finding:
    pump = nominal().pump
    pwm = np.arange(0.0, PWM_MAX + 1.0)
    first = float(pwm[np.nonzero(static_force_N(pump, pwm) > 0.0)[0][0]])
    roots = np.roots(ElongationForce().elongation_mm)
    real = roots[np.abs(roots.imag) < 1e-9].real
    zero = float(real[np.argmin(np.abs(real - _THRESHOLD_V))])
    return Finding(
        f"PWM {first:.0f}; the corrected polynomial is zero at {zero:.3f} V",
        Outcome.UNMEASURED,
        "first whole PWM value that stretches the simulated rig, which takes the threshold from the text; "
        "that the cubic of (2.13), with 3.756 for 3.376, crosses zero there too is evidence of its own",
        {"first_pwm": first, "zero_of_polynomial_V": zero},
        simulated=True,
    )


@claim(
    "pump.poly",
    "2.13",
    "steady elongation as a cubic of the voltage from 4.7 to 12 V",
    "-0.1493 u3 + 3.376 u2 - 25.87 u + 54.13",
    basis="printed",
)
def poly() -> Finding:
    low, high = (float(np.polyval(_PRINTED, u)) for u in (_THRESHOLD_V, _SUPPLY_V))
    right = [float(np.polyval(ElongationForce().elongation_mm, u)) for u in (_THRESHOLD_V, _SUPPLY_V)]
    return Finding(
        f"{low:.1f} mm at 4.7 V, {high:.1f} mm at 12 V",
        exactly(abs(low) < 1.0 and near(high, 26.0)),
        "as printed the actuator would shrink; with 3.756 in place of 3.376 it is "
        f"{right[0]:.2f} and {right[1]:.2f} mm, as the text says; that it is a typing error is inferred",
        {"at_4p7V_mm": low, "at_12V_mm": high, "corrected_4p7V_mm": right[0], "corrected_12V_mm": right[1]},
    )


@claim("pump.range", "4.2", "lengths that the pumps reach", "65 - 91 mm", "plant", basis="chosen")
def reach() -> Finding:
    inflated = tried("deflate")[1]["inflated_mm"] or math.nan
    rest = 1e3 * nominal().plant.rest_length_m
    return Finding(
        f"{rest:.0f} - {rest + inflated:.1f} mm",
        on_twin(near(inflated, 26.0)),
        "simulated rig with both pumps at 12 V for 5 s",
        {"shortest_mm": rest, "longest_mm": rest + inflated},
        simulated=True,
    )


@claim(
    "pump.g",
    "3.49",
    "steady force as a polynomial of the PWM value, without a unit",
    "as printed",
    basis="printed",
)
def force_polynomial() -> Finding:
    law = PolynomialForce()
    pwm = np.arange(0.0, PWM_MAX + 1.0)
    raw = np.polyval((*law.force_mN, 0.0), pwm)
    dead = pwm < law.dead_zone_pwm
    bump, at = float(raw[dead].max()), float(pwm[dead][np.argmax(raw[dead])])
    full = float(raw[-1])
    spring = 1e3 * float(ElongationForce().force_N(np.array(PWM_MAX)))
    return Finding(
        f"{full:.0f} at 255, {bump:.0f} at PWM {at:.0f}",
        exactly(bump < 0.01 * full),
        f"the spring holds the elongation at 12 V with {spring:.0f} mN, so the unit is mN; the force within "
        "the dead zone of (2.13) contradicts it, and has to be cut below PWM 100",
        {"full_mN": full, "spring_at_12V_mN": spring, "bump_mN": bump, "bump_at_pwm": at},
    )


@claim("pump.tau", "3.5", "time constant of the pumps", "0.7 s", "plant", basis="chosen")
def tau() -> Finding:
    run, _ = tried("deflate")
    mm = elongation_mm(run)[: round(5.0 / run.tick_s)]
    two_thirds = float(np.nonzero(mm > (1.0 - math.exp(-1.0)) * mm[-1])[0][0] * run.tick_s)
    return Finding(
        f"63 % of the length after {two_thirds:.2f} s",
        Outcome.UNMEASURED,
        "simulated rig stepped to 12 V; its pumps have the printed lag and a dead time of two ticks, so this "
        "shows what a log would look like and not that the lag is right",
        {"time_to_63_percent_s": two_thirds},
        simulated=True,
    )


@claim(
    "pump.fall",
    "3.5",
    "the force falls at this rate at most, from a deflation of 5 s",
    "-2 N/s",
    basis="twin",
)
def fall() -> Finding:
    quick = tried("deflate", rig=with_pump(PRINTED_RATE))[1]["deflation_s"]
    slow = tried("deflate")[1]["deflation_s"]
    force = float(static_force_N(nominal().pump, np.array(PWM_MAX)))
    return Finding(
        f"deflated in {quick:.2f} s",
        exactly(near(quick, 5.0)),
        f"simulated deflation from 12 V to 5 % with a limit of 2 N/s; 0.4 N/s takes {slow:.2f} s. In the "
        f"unit of (3.49), mN/s, it would take {force / (1e-3 * PRINTED_RATE) / 60.0:.0f} min",
        {"deflation_s": quick or math.nan, "with_0p4_s": slow or math.nan},
        simulated=True,
    )


@claim(
    "pump.deflation",
    "Fig. 3.24",
    "deflation takes this long, about twice the inflation",
    "5 s",
    "plant",
    basis="chosen",
)
def deflation() -> Finding:
    run, figures = tried("deflate")
    mm, seconds = elongation_mm(run), figures["deflation_s"]
    up = float(np.nonzero(mm > 0.95 * mm[round(5.0 / run.tick_s)])[0][0] * run.tick_s)
    return Finding(
        f"{seconds:.2f} s, inflation {up:.2f} s",
        on_twin(near(seconds, 5.0)),
        "simulated rig at 12 V for 5 s, then off; to 5 % and to 95 % of the elongation, which is "
        f"{(seconds or math.nan) / up:.1f} times as long. The limit of the rate was chosen to give this time",
        {"deflation_s": seconds or math.nan, "inflation_s": up},
        simulated=True,
    )


@claim(
    "pump.overshoot",
    "Fig. 3.24",
    "the simulated deflation overshoots at 10 s because of the creep",
    "-",
    "plant",
    basis="twin",
)
def overshoot() -> Finding:
    least = {}
    for name, rig in (
        ("with creep", nominal()),
        ("without", with_plant(creep=None)),
        ("at -2 N/s", with_pump(PRINTED_RATE)),
        ("printed", replace(nominal(), plant=printed_plant())),
    ):
        mm = elongation_mm(tried("deflate", 20.0, rig=rig)[0])
        least[name] = float(mm[300:].min())
    below = max(-least["with creep"], 0.0)
    return Finding(
        f"{below:.2f} mm below the rest length",
        on_twin(below > 0.1),
        "simulated rig with passive creep, which returns from above and never overshoots, at either rate; "
        f"with all of Table 3.2 the length stays {least['printed']:.0f} mm above and more",
        {f"least_mm_{name.replace(' ', '_')}": value for name, value in least.items()},
        simulated=True,
    )


@claim("pump.pwm6v", "3.5", "PWM value of 6 V", "127.5", basis="printed")
def pwm6v() -> Finding:
    value = 6.0 / _SUPPLY_V * PWM_MAX
    return Finding(f"{value:g}", exactly(value == 127.5), "6 V of 12 V, 255 in full", {"pwm": value})


STATIC = (threshold, poly, reach)
"""Of section 2.3, in the order of the source."""

DYNAMIC = (force_polynomial, tau, fall, deflation, overshoot, pwm6v)
"""Of section 3.5, in the order of the source."""

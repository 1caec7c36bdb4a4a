"""Claims about the improved model and its fitted parameters (3.4)."""

from __future__ import annotations

import math

import numpy as np

from calib.stages.actuator.parameters import PRINTED_CREEP, growth_rate_per_s
from calib.stages.actuator.pump import PWM_MAX, PolynomialForce
from thesis.claims_dynamics import lateral_damping, model_errors
from thesis.outcome import Finding, claim, exactly
from thesis.runs import (
    PRINTED_C_DMP,
    PRINTED_C_SPR,
    PRINTED_K_BND,
    first_model,
    nominal,
    printed_plant,
)

__all__ = ["CLAIMS"]

_MEASURED_ZETA = 0.0513
_REACHED_RAD = 0.7
_NORMS = {"q1": (17.8, 13.1, 0.1, 26.2), "q2": (23.2, 15.0, 0.1, 35.3), "phi": (1.40, 0.629, 0.01, 55.0)}
"""Table 3.3: original, improved, last digit of the original, improvement in percent."""


@claim(
    "fit.lambda", "Table 3.2", "fitted parameters of the creep", "-0.1047, -14.98, -1.854", basis="printed"
)
def creep() -> Finding:
    plant = printed_plant()
    growth = growth_rate_per_s(plant)
    return Finding(
        f"grows at {growth:.2f} /s",
        exactly(growth <= 0.0),
        f"roots of the linearised model with all of Table 3.2, whose fastest grows at {growth:.2f} /s: "
        f"dz/dt = {-PRINTED_CREEP[0]:+g} z grows by itself, and lambda2 lambda3 > 0 gives energy instead of "
        "taking it",
        {"growth_per_s": growth, "lambda2_lambda3_N_per_m": PRINTED_CREEP[1] * PRINTED_CREEP[2]},
    )


@claim("fit.k_bnd", "Table 3.2", "bending stiffness and its unit", "169.49 kg m s-2", basis="printed")
def bending() -> Finding:
    force = float(PolynomialForce().force_N(np.array(PWM_MAX)))
    newton, milli = (math.sqrt(force / (2.0 * k)) for k in (PRINTED_K_BND, 1e-3 * PRINTED_K_BND))
    return Finding(
        f"at most {newton:.3f} rad with newton, {milli:.2f} rad with millinewton",
        exactly(newton > _REACHED_RAD),
        f"greatest force of one pump by (3.49) in mN, {force:.2f} N, against the bending moment alone: F "
        "= 2 k phi^2 without "
        "any spring; the experiments reach 0.7 rad, so the unit has to be mN",
        {"largest_angle_newton_rad": newton, "largest_angle_millinewton_rad": milli},
    )


@claim(
    "fit.scales",
    "Table 3.2",
    "scales of stiffness and damping are close to 1, so both were measured well",
    "0.9102, 1.0369",
    "plant",
    basis="printed",
)
def scales() -> Finding:
    printed = lateral_damping(printed_plant())
    without = lateral_damping(first_model().free_plant)
    needed = _MEASURED_ZETA / without
    return Finding(
        f"c_dmp = {needed:.1f} for the measured decay",
        exactly(abs(printed / _MEASURED_ZETA - 1.0) < 0.1),
        f"roots of the linearised model: with c_spr = {PRINTED_C_SPR}, c_dmp = {PRINTED_C_DMP} and the "
        f"printed creep the lateral damping is {printed:.3f} instead of {_MEASURED_ZETA}",
        {"zeta_printed": printed, "needed_c_dmp": needed},
    )


@claim(
    "fit.norms",
    "Table 3.3",
    "error norms of original and improved model, and by how much they shrink",
    "17.8 -> 13.1 mm, 23.2 -> 15.0 mm, 1.40 -> 0.629 rad: 26.2, 35.3, 55.0 %",
    "data",
    basis="printed",
)
def norms() -> Finding:
    inside, shrunk = True, {}
    for name, (before, after, digit, percent) in _NORMS.items():
        last = 0.001 if name == "phi" else digit
        low = 100.0 * (1.0 - (after + 0.5 * last) / (before - 0.5 * digit))
        high = 100.0 * (1.0 - (after - 0.5 * last) / (before + 0.5 * digit))
        inside = inside and low <= percent <= high
        shrunk[name] = 100.0 * (1.0 - after / before)
    twin = np.linalg.norm(model_errors(), axis=0) * [1e3, 1e3, 1.0]
    return Finding(
        ", ".join(f"{value:.1f}" for value in shrunk.values()) + " %",
        exactly(inside),
        "the percentages follow from the printed norms within their digits; the norms themselves need the "
        f"measurements. First model against the simulated rig, 5 s at 60 Hz: {twin[0]:.0f} mm, {twin[1]:.0f} "
        f"mm, {twin[2]:.2f} rad, which depend on the number of samples",
        {
            **{f"{name}_percent": value for name, value in shrunk.items()},
            "twin_q1_mm": float(twin[0]),
            "twin_q2_mm": float(twin[1]),
            "twin_phi_rad": float(twin[2]),
        },
    )


@claim(
    "fit.out_of_plane",
    "Fig. 3.21",
    "bending out of the plane by these angles moves the head by these distances",
    "-3.3 .. 4.7 deg, -1.9 .. 2.6 mm",
    basis="printed",
)
def out_of_plane() -> Finding:
    length = nominal().plant.rest_length_m

    def moved(degrees: float) -> float:
        angle = math.radians(degrees)
        return 1e3 * length * (1.0 - math.cos(angle)) / angle

    def fits(degrees: float, mm: float) -> bool:
        return moved(degrees - 0.05) < mm + 0.05 and moved(degrees + 0.05) > mm - 0.05

    marker = [moved(a) + 15.0 * math.sin(math.radians(a)) for a in (-3.3, 4.7)]
    return Finding(
        f"{moved(-3.3):.2f} .. {moved(4.7):.2f} mm",
        exactly(fits(3.3, 1.9) and fits(4.7, 2.6)),
        "end of a circular arc of 65 mm; within the digits printed. For the marker, 15 mm further out, it is "
        f"{marker[0]:.1f} .. {marker[1]:.1f} mm, which is what a camera sees",
        {
            "least_mm": moved(-3.3),
            "greatest_mm": moved(4.7),
            "marker_least_mm": marker[0],
            "marker_greatest_mm": marker[1],
        },
    )


CLAIMS = (creep, bending, scales, norms, out_of_plane)
"""In the order of the source."""

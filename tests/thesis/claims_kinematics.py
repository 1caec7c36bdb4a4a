"""Claims about the kinematics (3.1)."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.kinematics import (
    H13_ORDER,
    H13_error_m,
    H23_error_m,
    f_error,
    forward,
    inverse,
    inverse_coefficients,
    pose_from_configuration,
    transform,
)
from thesis.outcome import Finding, Outcome, claim, exactly

__all__ = ["CLAIMS"]

_RADIUS_M, _LENGTH_M = 0.0126, 0.065
_HARDLY_VISIBLE = 1e-3
"""Share of the length that a line in a plot is wide."""


@claim(
    "kin.limits", "3.9", "limits of the head's coordinates at zero curvature", "0 and l", basis="equations"
)
def limits() -> Finding:
    at = pose_from_configuration(np.array([[0.0, _LENGTH_M], [1e-9, _LENGTH_M], [-1e-9, _LENGTH_M]]))
    error = float(np.abs(at[:, :2] - [0.0, _LENGTH_M]).max())
    return Finding(
        f"0 and l to {error:.0e} m",
        exactly(error < 1e-10),
        "head at curvatures of 0 and +-1e-9 per metre",
        {"error_m": error},
    )


@claim(
    "kin.series_H",
    "3.10, Figs. 3.2, 3.3",
    "from order 7 on the truncation is hardly visible, for a length of 0.065 m",
    "order 7",
    basis="equations",
)
def series_H() -> Finding:
    bend = np.array([0.5 * np.pi])
    x = float(np.abs(H13_error_m(bend, _LENGTH_M))[0])
    y = float(np.abs(H23_error_m(bend, _LENGTH_M))[0])
    before = float(np.abs(H13_error_m(bend, _LENGTH_M, H13_ORDER - 2))[0])
    return Finding(
        f"{1e6 * x:.1f} um in x, {1e6 * y:.1f} um in y",
        exactly(max(x, y) < _HARDLY_VISIBLE * _LENGTH_M),
        f"truncated at the powers 7 and 6 of the angle, at pi / 2; at power 5 it is {1e6 * before:.0f} um",
        {"error_x_m": x, "error_y_m": y, "error_x_order5_m": before},
    )


@claim("kin.rotation", "3.6", "rotation block of the head's frame", "[[c, -s], [s, c]]", basis="equations")
def rotation() -> Finding:
    phi = 0.7
    kappa = phi / _LENGTH_M
    # The end of the backbone a little further along the same arc.
    along = pose_from_configuration(np.array([[kappa, _LENGTH_M - 1e-6], [kappa, _LENGTH_M + 1e-6]]))
    tangent = (along[1, :2] - along[0, :2]) / 2e-6
    c, s = np.cos(phi), np.sin(phi)
    printed = float(np.abs(np.array([-s, c]) - tangent).max())
    ours = float(np.abs(transform(np.array(phi), np.array(_LENGTH_M))[:2, 1] - tangent).max())
    return Finding(
        f"off by {printed:.2f} at 0.7 rad; transposed by {ours:.0e}",
        exactly(printed < 1e-6),
        "the head's y axis has to be the arc's tangent, found by differences along the arc: (sin, cos) as in "
        "(A.1), so the block has to turn the other way, [[c, s], [-s, c]]",
        {"printed_error": printed, "transposed_error": ours},
    )


def _bellows() -> FloatArray:
    q1, q2 = np.meshgrid(np.linspace(0.065, 0.09, 6), np.linspace(0.065, 0.09, 6))
    return np.stack([q1.ravel(), q2.ravel()], axis=1)


@claim("kin.inverse", "3.11, 3.12", "inverse kinematics", "exact", basis="equations")
def inverse_kinematics() -> Finding:
    q = _bellows()
    error = float(np.abs(inverse(forward(q, _RADIUS_M), _RADIUS_M) - q).max())
    return Finding(
        f"exact to {error:.0e} m",
        exactly(error < 1e-12),
        "forward and back over the workspace, the straight actuator with it",
        {"error_m": error},
    )


@claim(
    "kin.series_f", "3.14", "coefficients of the series of f", "2, 1/12, 7/2880, 31/483840", basis="equations"
)
def series_f() -> Finding:
    ours = inverse_coefficients(6)
    printed = (Fraction(2), Fraction(1, 12), Fraction(7, 2880), Fraction(31, 483840))
    return Finding(
        ", ".join(map(str, ours)),
        exactly(ours == printed),
        "recursion for the series of u / sin u in exact fractions",
        {f"c{2 * k}": float(c) for k, c in enumerate(ours)},
    )


@claim(
    "kin.series_f_error",
    "3.1",
    "error of the series up to the power 6 at pi / 2",
    "4.45e-5",
    basis="equations",
)
def series_f_error() -> Finding:
    at, nearer = (float(abs(f_error(np.array([phi]))[0])) for phi in (0.5 * np.pi, 1.5))
    return Finding(
        f"{at:.2e}",
        exactly(abs(at - 4.45e-5) < 5e-8),
        f"exact function minus series at pi / 2; printed is nearly the error at 1.5 rad, {nearer:.2e}",
        {"error": at, "error_at_1p5_rad": nearer},
    )


@claim(
    "kin.fem",
    "Fig. 2.2",
    "the curvature is nearly constant along the actuator at 40 kPa",
    "-",
    "data",
    basis="chosen",
)
def fem() -> Finding:
    s = np.linspace(0.005, _LENGTH_M, 60)
    points = pose_from_configuration(np.stack([np.full_like(s, 0.7 / _LENGTH_M), s], axis=1))[:, :2]
    turn = np.diff(np.unwrap(np.arctan2(*np.diff(points, axis=0).T)))
    spread = float(np.ptp(turn) / turn.mean())
    return Finding(
        f"constant to {spread:.0e} by construction",
        Outcome.UNMEASURED,
        "the model bends along a circle and cannot test this; it takes the finite elements of the source",
        {"spread": spread},
        simulated=True,
    )


CLAIMS = (limits, series_H, rotation, inverse_kinematics, series_f, series_f_error, fem)
"""In the order of the source."""

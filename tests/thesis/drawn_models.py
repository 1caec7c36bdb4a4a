"""Figures of the kinematics, the energies and the springs: 3.2 to 3.5, 3.7 to 3.10."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.dynamics import kinetic_energy_J
from calib.stages.actuator.identify import StiffnessFit, fit_stiffness
from calib.stages.actuator.kinematics import H13_error_m, f_error, f_series
from thesis.drawn import Curve, Plot, drawn
from thesis.runs import nominal, tried

__all__ = ["FIGURES", "weighed"]

_LENGTH_M = 0.065
_ORDERS = (1, 3, 5, 7, 9)
_F_ORDERS = (0, 2, 4, 6)
_G = 9.81
_READING_M = 2e-4
_FLOOR = 1e-17
"""Errors below are rounding; a logarithmic axis ends there."""


def _kappa() -> FloatArray:
    return np.linspace(-0.5 * np.pi, 0.5 * np.pi, 201) / _LENGTH_M


@drawn("3.2", "series_of_the_heads_x", "Error of the head's x by its truncated series, over the curvature")
def series_error() -> Plot:
    kappa = _kappa()[101:]
    errors = {n: 1e3 * np.abs(H13_error_m(kappa * _LENGTH_M, _LENGTH_M, n)) for n in _ORDERS}
    return Plot(
        "curvature (1/m)",
        "exact less series, size (mm)",
        tuple(
            Curve(f"order {n}", kappa, np.maximum(e, _FLOOR), colour=k)
            for k, (n, e) in enumerate(errors.items())
        ),
        "the exact arc against (3.10), length 65 mm, from the equations alone; the error is odd in the "
        "curvature",
        f"At 90 deg: {', '.join(f'{e[-1]:.2g} mm of order {n}' for n, e in errors.items())}.",
        numbers={f"order_{n}_mm": float(e[-1]) for n, e in errors.items()},
        log_y=True,
        y_limits=(1e-9, 30.0),
    )


@drawn("3.3", "norm_of_the_series_error", "Size of that error over the order of the series")
def series_norm() -> Plot:
    phi = _kappa() * _LENGTH_M
    orders = np.array([1, 3, 5, 7, 9, 11])
    rms = np.array([np.sqrt(np.mean(H13_error_m(phi, _LENGTH_M, int(n)) ** 2)) for n in orders])
    largest = np.array([np.abs(H13_error_m(phi, _LENGTH_M, int(n))).max() for n in orders])
    return Plot(
        "order of the series",
        "error (mm)",
        (
            Curve("largest", orders, 1e3 * largest, "points", 1),
            Curve("", orders, 1e3 * largest, "dotted", 1),
            Curve("RMS", orders, 1e3 * rms, "points", 0),
            Curve("", orders, 1e3 * rms, "dotted", 0),
        ),
        "the curves of Fig. 3.2, curvatures up to 90 deg of bending",
        "Each further term gains more than an order of magnitude; a pixel of the camera is about a "
        "millimetre.",
        numbers={f"rms_{n}_mm": float(1e3 * v) for n, v in zip(orders.tolist(), rms, strict=True)},
        log_y=True,
    )


@drawn("3.4", "inverse_function_and_series", "The function f of the inverse kinematics and its series")
def inverse_function() -> Plot:
    phi = np.linspace(-np.pi, np.pi, 201)
    exact = f_series(phi) + f_error(phi)
    curves = [Curve("exact", phi, exact, "line", -1)]
    curves += [Curve(f"order {n}", phi, f_series(phi, n), "dashed", k) for k, n in enumerate(_F_ORDERS)]
    return Plot(
        "angle (rad)",
        "f",
        tuple(curves),
        "f = phi / sin(phi / 2) against (3.14), from the equations alone",
        f"f rises from 2 to {exact[-1]:.4f} at pi.",
        numbers={"at_0": float(exact[100]), "at_pi": float(exact[-1])},
    )


@drawn("3.5", "inverse_series_error", "Error of the series of f")
def inverse_error() -> Plot:
    phi = np.linspace(0.05, np.pi, 200)
    curves = [
        Curve(f"order {n}", phi, np.maximum(np.abs(f_error(phi, n)), _FLOOR), colour=k)
        for k, n in enumerate(_F_ORDERS)
    ]
    at = float(f_error(np.array([0.5 * np.pi]))[0])
    printed = float(f_error(np.array([1.5]))[0])
    curves.append(Curve("pi / 2", np.array([0.5 * np.pi]), np.array([at]), "points", -1))
    return Plot(
        "angle (rad)",
        "exact less series",
        tuple(curves),
        "f = phi / sin(phi / 2) against (3.14), from the equations alone",
        f"Order 6 at pi / 2: {at:.2e}. The text prints 4.45e-5, which is nearly the error at 1.5 rad, "
        f"{printed:.2e}.",
        numbers={"at_half_pi": at, "at_1p5": printed},
        log_y=True,
        y_limits=(1e-13, 3.0),
    )


def _energies() -> tuple[FloatArray, FloatArray, FloatArray]:
    run, _ = tried("swing")
    nodes = run.trajectory.nodes
    t = run.trajectory.node_s * np.arange(len(nodes), dtype=np.float64)
    moving, turning = kinetic_energy_J(run.plant, nodes[:, :2], nodes[:, 2:4])
    some = t <= 2.0
    return t[some], moving[some], turning[some]


@drawn("3.7", "kinetic_energies", "Kinetic energy of a free swing: of the moving and of the turning mass")
def kinetic_energies() -> Plot:
    t, moving, turning = _energies()
    ratio = float(turning.sum() / moving.sum())
    return Plot(
        "time (s)",
        "kinetic energy (mJ)",
        (
            Curve("moving", t, 1e3 * moving, colour=0),
            Curve("turning", t, 1e3 * turning, colour=1),
        ),
        "swing of the simulated rig from 0.5 rad, hoses off; mass and inertia of Table 3.1",
        f"Over the swing the turning energy is {ratio:.2f} times the moving one.",
        numbers={"ratio": ratio, "greatest_moving_mJ": float(1e3 * moving.max())},
    )


@drawn("3.8", "share_of_the_rotation", "Share of the rotation in the kinetic energy of that swing")
def share_of_rotation() -> Plot:
    t, moving, turning = _energies()
    whole = moving + turning
    # Where the head all but stands still a share says nothing.
    some = whole > 0.01 * whole.max()
    share = np.where(some, turning / np.where(some, whole, 1.0), np.nan)
    mean = float(turning.sum() / whole.sum())
    plant = nominal().plant
    straight = plant.inertia_kgm2 / (0.25 * plant.mass_kg * plant.rest_length_m**2 + plant.inertia_kgm2)
    span = t[[0, -1]]
    return Plot(
        "time (s)",
        "share of the rotation (%)",
        (
            Curve("at each moment", t, 100.0 * share, colour=0),
            Curve("over the swing", span, np.full(2, 100.0 * mean), "dashed", -1),
            Curve("in the text", span, np.full(2, 20.0), "dotted", 1),
        ),
        "the energies of Fig. 3.7; moments with less than 1 % of the greatest energy are left out",
        f"{100.0 * mean:.0f} % over the swing, {100.0 * straight:.0f} % through the straight shape by Table "
        "3.1. The text says about 20 %.",
        numbers={"share": mean, "share_straight": straight},
        y_limits=(0.0, 105.0),
    )


@lru_cache(maxsize=1)
def weighed() -> tuple[FloatArray, FloatArray, tuple[StiffnessFit, ...]]:
    """Elongations [m] and forces [N] of hanging weights, with readings to 0.2 mm, and the fitted laws."""
    law = nominal().plant.stiffness
    mass_g = np.array([0.0, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 350, 400])
    force = 1e-3 * _G * mass_g
    eps = np.linspace(0.0, 0.05, 5001)
    pull = 2.0 * np.array([law.secant(e) * e for e in eps.tolist()])
    hangs = np.interp(force, pull, eps)
    read = hangs + _READING_M * np.random.default_rng(3).standard_normal(len(hangs))
    read[0] = 0.0
    fits, _ = fit_stiffness("weights", read, force)
    return read, force, tuple(fits)


@drawn("3.9", "hanging_weights", "Hanging weights: displacement and force, with laws fitted to them")
def hanging_weights() -> Plot:
    eps, force, fits = weighed()
    fine = np.linspace(0.0, float(eps.max()) * 1.03, 120)
    names = ("linear", "second order", "third order")
    curves = [Curve("simulated weights", 1e3 * eps, force, "points", -1)]
    curves += [
        Curve(name, 1e3 * fine, fit.force_N(fine), colour=k)
        for k, (name, fit) in enumerate(zip(names, fits, strict=True))
    ]
    return Plot(
        "displacement (mm)",
        "force on the actuator (N)",
        tuple(curves),
        "weights of up to 400 g on the springs of the simulated rig, read to 0.2 mm; zero force at zero",
        "Left out in turn: "
        + ", ".join(
            f"{name} {1e3 * fit.left_out_rms_N:.0f} mN" for name, fit in zip(names, fits, strict=True)
        )
        + ".",
        numbers={f"left_out_{k + 1}_N": fit.left_out_rms_N for k, fit in enumerate(fits)},
    )


@drawn("3.10", "stiffness_over_displacement", "Stiffness k of those laws, force over displacement")
def stiffness_curves() -> Plot:
    eps, force, fits = weighed()
    fine = np.linspace(0.0, float(eps.max()) * 1.03, 120)
    curves = [Curve("force over displacement", 1e3 * eps[1:], force[1:] / eps[1:], "points", -1)]
    for k, (name, fit) in enumerate(zip(("linear", "second order", "third order"), fits, strict=True)):
        law_k = np.asarray(np.polyval(fit.coefficients[::-1], fine))
        curves.append(Curve(name, 1e3 * fine, law_k, colour=k))
    law = nominal().plant.stiffness
    true = 2.0 * np.array([law.secant(e) for e in fine.tolist()])
    curves.append(Curve("truth", 1e3 * fine, true, "dotted", -1))
    second = fits[1]
    return Plot(
        "displacement (mm)",
        "stiffness (N/m)",
        tuple(curves),
        "the laws of Fig. 3.9",
        f"Second order: {second.coefficients[0]:.1f} +- {second.sigma[0]:.1f} N/m at rest, "
        f"{1e-3 * second.coefficients[1]:.2f} +- {1e-3 * second.sigma[1]:.2f} N/m per mm.",
        numbers={"k0_N_per_m": float(second.coefficients[0]), "k1_N_per_m2": float(second.coefficients[1])},
    )


FIGURES = (
    series_error,
    series_norm,
    inverse_function,
    inverse_error,
    kinetic_energies,
    share_of_rotation,
    hanging_weights,
    stiffness_curves,
)
"""In the order of the source."""

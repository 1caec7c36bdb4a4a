"""Kinematics, dynamics, the fitted model and the pumps (chapter 3, and 2.3 for the pumps' steady elongation).

A function `kin_limits` computes what the claim `kin.limits` of thesis.yaml is judged by; `figure_3_2` the
curves of Fig. 3.2 and the values in the sentence under it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
from source_model import PRINTED_CREEP, PolynomialForce, kinetic_energy_J, pose_from_configuration, transform

from calib.core.arrays import FloatArray
from calib.core.plot import Band, Plot
from calib.stages.actuator.dynamics import coriolis_matrix, linearised, mass_matrix
from calib.stages.actuator.identify import Solution, Track, fit_tracks, made
from calib.stages.actuator.kinematics import (
    chord_ratio,
    forward,
    forward_jacobian,
    inverse,
    inverse_coefficients,
)
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import Plant, growth_rate_per_s
from calib.stages.actuator.pump import PWM_MAX, ElongationForce, static_force_N
from calib.stages.actuator.simulate import STATE
from calib.stages.actuator.springs import StiffnessFit, fit_stiffness
from calib.stages.actuator.swing import decrement
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import at_rest, elongation_mm, fall_time_s, tick_times
from calib.twin.sensors import normal, stream
from calib.twin.simulate import Run, simulate
from thesis.plot import curve
from thesis.runs import (
    PRINTED_C_DMP,
    PRINTED_C_SPR,
    PRINTED_K_BND,
    PRINTED_RATE,
    Values,
    figure,
    first_model,
    leaking_rig,
    lengths_m,
    nominal,
    once,
    other_rig,
    printed_plant,
    printed_rate,
    printed_table,
    share_of_way_s,
    tried,
    without_creep,
)
from thesis.sensing import T_OF_TWO, seen_elongation_mm

_PLANT = Plant()
_R, _LENGTH_M = _PLANT.bellows_radius_m, _PLANT.rest_length_m
_MEASURED_ZETA = 0.0513

# Kinematics (3.1)


def kin_limits() -> Values:
    kappa = np.array([0.0, 1e-9, -1e-9])
    head = pose_from_configuration(np.stack([kappa, np.full(3, _LENGTH_M)], axis=1))[:, :2]
    return {"error_m": float(np.abs(head - [0.0, _LENGTH_M]).max())}


def _head_error_mm(phi: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Exact less truncated x and y of the head [mm] by (3.10), kept up to a power of phi (...) [rad].

    y + i x = l S(phi) exp(i phi / 2) = l sum_k (i phi)^k / (k + 1)!.
    """
    series = sum((1j * phi) ** k / math.factorial(k + 1) for k in range(order + 1))
    error = 1e3 * _LENGTH_M * (chord_ratio(phi) * np.exp(0.5j * phi) - series)
    return error.imag, error.real


def kin_series_H() -> Values:
    bend = np.array(0.5 * np.pi)
    (x, y), (before, _) = _head_error_mm(bend, 7), _head_error_mm(bend, 5)
    x_um, y_um, before_um = (float(1e3 * np.abs(error)) for error in (x, y, before))
    share = max(x_um, y_um) / (1e6 * _LENGTH_M)
    return {"error_x_um": x_um, "error_y_um": y_um, "error_x_order5_um": before_um, "share_of_length": share}


def kin_rotation() -> Values:
    phi = 0.7
    # The end of the backbone a little further along the same arc.
    arc = np.array([[phi / _LENGTH_M, _LENGTH_M + step] for step in (-1e-6, 1e-6)])
    tangent = np.diff(pose_from_configuration(arc)[:, :2], axis=0)[0] / 2e-6
    printed = np.array([-math.sin(phi), math.cos(phi)])
    ours = transform(np.array(phi), np.array(_LENGTH_M))[:2, 1]
    return {
        "printed_error": float(np.abs(printed - tangent).max()),
        "transposed_error": float(np.abs(ours - tangent).max()),
    }


def kin_inverse() -> Values:
    q = np.stack(np.meshgrid(*[np.linspace(0.065, 0.09, 6)] * 2), axis=-1).reshape(-1, 2)
    return {"error_m": float(np.abs(inverse(forward(q, _R), _R) - q).max())}


def kin_series_f() -> Values:
    ours: tuple[Fraction, ...] = inverse_coefficients(6)
    return {"fractions": ", ".join(map(str, ours))} | {f"c{2 * k}": float(c) for k, c in enumerate(ours)}


def _f_series(phi: FloatArray, order: int = 6) -> FloatArray:
    """f by (3.14) up to a power of phi (...) [rad]."""
    return np.polyval([float(c) for c in reversed(inverse_coefficients(order))], phi**2)


def _f_error(phi: FloatArray, order: int = 6) -> FloatArray:
    """Exact less truncated f."""
    return 2.0 / chord_ratio(phi) - _f_series(phi, order)


def kin_series_f_error() -> Values:
    at, nearer = np.abs(_f_error(np.array([0.5 * np.pi, 1.5]))).tolist()
    return {"error": at, "error_at_1p5_rad": nearer}


def kin_fem() -> Values:
    s = np.linspace(0.005, _LENGTH_M, 60)
    points = pose_from_configuration(np.stack([np.full_like(s, 0.7 / _LENGTH_M), s], axis=1))[:, :2]
    turn = np.diff(np.unwrap(np.arctan2(*np.diff(points, axis=0).T)))
    return {"spread": float(np.ptp(turn) / turn.mean())}


_TINY = 1e-17
"""Errors below are rounding; a logarithmic axis ends there."""


def figure_3_2() -> tuple[Plot, Values]:
    kappa = np.linspace(0.0, 0.5 * np.pi, 101)[1:] / _LENGTH_M
    errors = {n: np.abs(_head_error_mm(kappa * _LENGTH_M, n)[0]) for n in (1, 3, 5, 7, 9)}
    curves = [
        curve(f"order {n}", kappa, np.maximum(e, _TINY), colour=k) for k, (n, e) in enumerate(errors.items())
    ]
    labels = "curvature (1/m)", "exact less series, size (mm)"
    plot = Plot(*labels, tuple(curves), log="y", y_limits=(1e-9, 30.0))
    return plot, {f"order_{n}_mm": float(e[-1]) for n, e in errors.items()}


def figure_3_3() -> tuple[Plot, Values]:
    phi, orders = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 201), (1, 3, 5, 7, 9, 11)
    errors = np.array([_head_error_mm(phi, n)[0] for n in orders])
    rms, largest, x = np.sqrt(np.mean(errors**2, axis=1)), np.abs(errors).max(axis=1), np.array(orders, float)
    curves = (
        curve("largest", x, largest, "points", 1),
        curve("", x, largest, "dotted", 1),
        curve("RMS", x, rms, "points", 0),
        curve("", x, rms, "dotted", 0),
    )
    values: Values = {f"rms_{n}_mm": float(v) for n, v in zip(orders, rms, strict=True)}
    return Plot("order of the series", "error (mm)", curves, log="y"), values


def figure_3_4() -> tuple[Plot, Values]:
    phi = np.linspace(-np.pi, np.pi, 201)
    exact = 2.0 / chord_ratio(phi)
    curves = [curve(f"order {n}", phi, _f_series(phi, n), "dashed", k) for k, n in enumerate((0, 2, 4, 6))]
    plot = Plot("angle (rad)", "f", (curve("exact", phi, exact, "line", -1), *curves))
    return plot, {"at_0": float(exact[100]), "at_pi": float(exact[-1])}


def figure_3_5() -> tuple[Plot, Values]:
    phi = np.linspace(0.05, np.pi, 200)
    curves = [
        curve(f"order {n}", phi, np.maximum(np.abs(_f_error(phi, n)), _TINY), colour=k)
        for k, n in enumerate((0, 2, 4, 6))
    ]
    at, nearer = _f_error(np.array([0.5 * np.pi, 1.5])).tolist()
    curves.append(curve("pi / 2", np.array([0.5 * np.pi]), np.array([at]), "points", -1))
    plot = Plot("angle (rad)", "exact less series", tuple(curves), log="y", y_limits=(1e-13, 3.0))
    return plot, {"at_half_pi": at, "at_1p5": nearer}


# Equations of motion and the first model (3.2, 3.3)

_STATES = [
    (np.array(bellows), np.array(rates))
    for bellows, rates in (
        ((0.065, 0.065), (0.05, -0.03)),
        ((0.080, 0.066), (-0.2, 0.1)),
        ((0.067, 0.088), (0.15, 0.25)),
        ((0.090, 0.072), (-0.05, -0.3)),
    )
]
"""Bellows [m] and their rates [m/s] at which identities are tried, the straight rest among them."""


def _slope(function: Callable[[float], FloatArray | float], step: float) -> FloatArray:
    """Derivative at zero by central differences."""
    return np.asarray((function(step) - function(-step)) / (2.0 * step))


def dyn_identity() -> Values:
    worst = 0.0
    for q, dq in _STATES:

        def velocity(rates: FloatArray, q: FloatArray = q) -> FloatArray:
            return _slope(lambda t: forward(q + t * rates, _R)[:2], 1e-5)

        for i, e in enumerate(np.eye(2)):
            by_rate = _slope(lambda v, e=e, dq=dq: velocity(dq + v * e), 0.1)
            worst = max(worst, float(np.abs(by_rate - forward_jacobian(q, _R)[:2, i]).max()))
    return {"error": worst}


def dyn_rotational() -> Values:
    J, dq, ddq, worst = _PLANT.inertia_kgm2, np.array([0.1, -0.2]), np.array([3.0, -7.0]), 0.0

    def energy(rates: FloatArray) -> float:
        return 0.5 * J * float((rates[0] - rates[1]) / (2.0 * _R)) ** 2

    for sign, e in zip((1.0, -1.0), np.eye(2), strict=True):

        def momentum(t: float, e: FloatArray = e) -> FloatArray:
            return _slope(lambda v: energy(dq + t * ddq + v * e), 1e-3)

        printed = J / (4.0 * _R**2) * sign * (ddq[0] - ddq[1])
        worst = max(worst, abs(float(_slope(momentum, 1e-4)) / printed - 1.0))
    return {"relative_error": worst}


def dyn_mass() -> Values:
    q = np.stack(np.meshgrid(*[np.linspace(0.06, 0.095, 8)] * 2), axis=-1).reshape(-1, 2)
    M = mass_matrix(_PLANT, q)
    asymmetry, least = float(np.abs(M - np.swapaxes(M, 1, 2)).max()), float(np.linalg.eigvalsh(M).min())
    return {"least_eigenvalue_g": 1e3 * least, "asymmetry_share": asymmetry / least}


def _kinetic(q: FloatArray, dq: FloatArray) -> float:
    moving, turning = kinetic_energy_J(_PLANT, q, dq)
    return float(moving + turning)


def dyn_coriolis() -> Values:
    ddq, worst = np.array([4.0, -6.0]), 0.0
    for q, dq in _STATES:
        ours = mass_matrix(_PLANT, q) @ ddq + coriolis_matrix(_PLANT, q, dq) @ dq
        for i, e in enumerate(np.eye(2)):

            def momentum(t: float, q: FloatArray = q, dq: FloatArray = dq, e: FloatArray = e) -> FloatArray:
                at, rates = q + t * dq + 0.5 * t * t * ddq, dq + t * ddq
                return _slope(lambda v: _kinetic(at, rates + v * e), 1e-2)

            by_place = _slope(lambda d, q=q, dq=dq, e=e: _kinetic(q + d * e, dq), 1e-4)
            off = _slope(momentum, 1e-4) - by_place - ours[i]
            worst = max(worst, abs(float(off)) / float(np.abs(ours).max()))
    return {"relative_error": worst}


def dyn_spring_sign() -> Values:
    k = _PLANT.stiffness.secant(0.0)
    squares = np.linalg.eigvals(np.linalg.solve(mass_matrix(_PLANT, np.full(2, _LENGTH_M)), k * np.eye(2)))
    growth = float(np.sqrt(squares).max())
    return {"growth_per_s": growth, "doubles_in_ms": 1e3 * math.log(2.0) / growth}


def dyn_constants() -> Values:
    plant = nominal().plant
    return {
        "mass_kg": plant.mass_kg,
        "inertia_kgm2": plant.inertia_kgm2,
        "rest_length_m": plant.rest_length_m,
        "bellows_radius_m": plant.bellows_radius_m,
        "radius_of_gyration_mm": 1e3 * math.sqrt(_PLANT.inertia_kgm2 / _PLANT.mass_kg),
        "swing_hz": figure("frequency_hz", "swing"),
    }


def _rotational_share(q: FloatArray, dq: FloatArray) -> float:
    moving, turning = kinetic_energy_J(_PLANT, q, dq)
    return float(np.sum(turning) / np.sum(moving + turning))


def dyn_ke_share() -> Values:
    run, J = tried("swing"), _PLANT.inertia_kgm2
    arm = 0.5 * _LENGTH_M + 0.015
    return {
        "percent": 100.0 * _rotational_share(np.full(2, _LENGTH_M), np.array([0.1, -0.1])),
        "of_swing_percent": 100.0 * _rotational_share(run.states[:, 0:2], run.states[:, 2:4]),
        "at_marker_percent": 100.0 * J / (J + _PLANT.mass_kg * arm**2),
    }


def dyn_damping_ratio() -> Values:
    return {"zeta": figure("damping_ratio", "swing")}


def _lateral_damping(plant: Plant) -> float:
    """Damping ratio of the slowest swing about the straight rest, which is the lateral one."""
    roots = np.linalg.eigvals(linearised(plant, np.full(2, plant.rest_length_m)))
    swings = roots[roots.imag > 1e-6]
    slowest = swings[np.argmin(np.abs(swings))]
    return float(-slowest.real / abs(slowest))


def dyn_damping_lateral() -> Values:
    zeta = _lateral_damping(first_model().free_plant)
    share = zeta / _PLANT.damping_ratio
    return {"zeta": zeta, "share": share, "needed_c_dmp": 1.0 / share}


def _columns(run: Run) -> FloatArray:
    """q1, q2 [m] and phi [rad] (n, 3) at the ticks."""
    return np.column_stack([lengths_m(run), run.phi_rad])


def _model_errors() -> FloatArray:
    """q1, q2 [m] and phi [rad] (n, 3) of the simulated rig less those of the first model, over a swing."""
    return _columns(tried("swing")) - _columns(tried("swing", rig=first_model))


def dyn_error_band() -> Values:
    q = 1e3 * _model_errors()[:, :2]
    return {"least_mm": float(q.min()), "greatest_mm": float(q.max())}


def dyn_static_error() -> Values:
    last = lengths_m(tried("swing", 20.0))[-60:]
    return {"left_mm": float(1e3 * np.abs(last - nominal().plant.rest_length_m).max())}


def _energies_mJ() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times [s], and kinetic energies of the moving and of the turning mass in the first 2 s of a swing."""
    run = tried("swing")
    nodes = run.trajectory.nodes
    t = run.trajectory.node_s * np.arange(len(nodes), dtype=np.float64)
    moving, turning = kinetic_energy_J(run.plant, nodes[:, :2], nodes[:, 2:4])
    early = t <= 2.0
    return t[early], 1e3 * moving[early], 1e3 * turning[early]


def figure_3_7() -> tuple[Plot, Values]:
    t, moving, turning = _energies_mJ()
    curves = (curve("moving", t, moving, colour=0), curve("turning", t, turning, colour=1))
    values: Values = {
        "ratio": float(turning.sum() / moving.sum()), "greatest_moving_mJ": float(moving.max())
    }  # fmt: skip
    return Plot("time (s)", "kinetic energy (mJ)", curves), values


def figure_3_8() -> tuple[Plot, Values]:
    t, moving, turning = _energies_mJ()
    whole = moving + turning
    some = whole > 0.01 * whole.max()
    percent = np.where(some, 100.0 * turning / np.where(some, whole, 1.0), np.nan)
    mean, span = float(100.0 * turning.sum() / whole.sum()), t[[0, -1]]
    curves = (
        curve("at each moment", t, percent, colour=0),
        curve("over the swing", span, np.full(2, mean), "dashed", -1),
        curve("in the text", span, np.full(2, 20.0), "dotted", 1),
    )
    plot = Plot("time (s)", "share of the rotation (%)", curves, y_limits=(0.0, 105.0))
    return plot, {"percent": mean, "straight_percent": dyn_ke_share()["percent"]}


_LAWS = ("linear", "second order", "third order")


@once
def _weighed() -> tuple[FloatArray, FloatArray, tuple[StiffnessFit, ...]]:
    """Elongations [m] and forces [N] of hanging weights, with readings to 0.2 mm, and the fitted laws."""
    law = nominal().plant.stiffness
    force = 1e-3 * 9.81 * np.array([0.0, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 350, 400])
    eps = np.linspace(0.0, 0.05, 5001)
    hangs = np.interp(force, [2.0 * law.secant(e) * e for e in eps.tolist()], eps)
    read = hangs + 2e-4 * np.random.default_rng(3).standard_normal(len(hangs))
    read[0] = 0.0
    return read, force, tuple(fit_stiffness("weights", read, force)[0])


def figure_3_9() -> tuple[Plot, Values]:
    eps, force, fits = _weighed()
    fine = np.linspace(0.0, float(eps.max()) * 1.03, 120)
    curves = [
        curve(name, 1e3 * fine, fit.force_N(fine), colour=k)
        for k, (name, fit) in enumerate(zip(_LAWS, fits, strict=True))
    ]
    measured = curve("simulated weights", 1e3 * eps, force, "points", -1)
    values: Values = {f"left_out_{k + 1}_mN": 1e3 * fit.left_out_rms_N for k, fit in enumerate(fits)}
    return Plot("displacement (mm)", "force on the actuator (N)", (measured, *curves)), values


def figure_3_10() -> tuple[Plot, Values]:
    eps, force, fits = _weighed()
    fine, law = np.linspace(0.0, float(eps.max()) * 1.03, 120), nominal().plant.stiffness
    curves = [curve("force over displacement", 1e3 * eps[1:], force[1:] / eps[1:], "points", -1)]
    curves += [
        curve(name, 1e3 * fine, np.asarray(np.polyval(fit.coefficients[::-1], fine)), colour=k)
        for k, (name, fit) in enumerate(zip(_LAWS, fits, strict=True))
    ]
    truth = 2.0 * np.array([law.secant(e) for e in fine.tolist()])
    curves.append(curve("truth", 1e3 * fine, truth, "dotted", -1))
    (k0, k1), (sigma_k0, sigma_k1) = fits[1].coefficients.tolist(), fits[1].sigma.tolist()
    return Plot("displacement (mm)", "stiffness (N/m)", tuple(curves)), {
        "k0_N_per_m": k0, "sigma_k0_N_per_m": sigma_k0,
        "k1_N_per_m_per_mm": 1e-3 * k1, "sigma_k1_N_per_m_per_mm": 1e-3 * sigma_k1,
    }  # fmt: skip


# The improved model (3.4), fitted to three swings of another rig


def fit_lambda() -> Values:
    return {
        "growth_per_s": growth_rate_per_s(printed_plant()),
        "minus_lambda1_per_s": -PRINTED_CREEP[0],
        "lambda2_lambda3_N_per_m": PRINTED_CREEP[1] * PRINTED_CREEP[2],
    }


def fit_k_bnd() -> Values:
    force = float(PolynomialForce().force_N(np.array(PWM_MAX)))
    newton, milli = (math.sqrt(force / (2.0 * k)) for k in (PRINTED_K_BND, 1e-3 * PRINTED_K_BND))
    return {"greatest_force_N": force, "in_newton_rad": newton, "in_millinewton_rad": milli}


def fit_scales() -> Values:
    return {
        "zeta_printed": _lateral_damping(printed_plant()),
        "needed_c_dmp": _MEASURED_ZETA / _lateral_damping(first_model().free_plant),
        "printed_c_spr": PRINTED_C_SPR,
        "printed_c_dmp": PRINTED_C_DMP,
    }


def fit_norms() -> Values:
    norms = {"q1": (17.8, 13.1), "q2": (23.2, 15.0), "phi": (1.40, 0.629)}
    q1, q2, phi = np.linalg.norm(_model_errors(), axis=0).tolist()
    shrunk = {f"{name}_percent": 100.0 * (1.0 - after / before) for name, (before, after) in norms.items()}
    return {**shrunk, "twin_q1_mm": 1e3 * q1, "twin_q2_mm": 1e3 * q2, "twin_phi_rad": phi}


def fit_out_of_plane() -> Values:
    least, greatest = np.radians([-3.3, 4.7]).tolist()

    def moved_mm(angle: float) -> float:
        return 1e3 * _LENGTH_M * (1.0 - math.cos(angle)) / angle

    return {
        "least_mm": moved_mm(least),
        "greatest_mm": moved_mm(greatest),
        "marker_least_mm": moved_mm(least) + 15.0 * math.sin(least),
        "marker_greatest_mm": moved_mm(greatest) + 15.0 * math.sin(greatest),
    }


_SIGMA = np.array([0.004, 0.0003])
"""Noise of angle [rad] and length [m] by the camera alone."""
_FITTED_RAD, _SHOWN_RAD = (0.5, 0.42, -0.46), 0.55


def _swing(rig: Callable[[], SimulatedRig], phi_rad: float = _SHOWN_RAD) -> Run:
    return tried("swing", 4.0, rig=rig, phi_rad=str(phi_rad))


@once
def _seen_swing(phi_rad: float = _SHOWN_RAD) -> FloatArray:
    """Angle [rad] and length [m] (n, 2) of a swing of the other rig, with the camera's noise."""
    at = _columns(_swing(other_rig, phi_rad))
    head = np.column_stack([at[:, 2], 0.5 * (at[:, 0] + at[:, 1])])
    bits = stream(_FITTED_RAD.index(phi_rad) if phi_rad in _FITTED_RAD else 9, 30)
    return np.asarray(head + _SIGMA * normal(bits, len(head), 2))


def _track(phi_rad: float) -> Track:
    run, head = _swing(other_rig, phi_rad), _seen_swing(phi_rad)
    W = np.broadcast_to(np.diag(1.0 / _SIGMA), (len(head), 2, 2)).copy()
    return Track(f"swing from {phi_rad:g} rad", run.tick_s, run.pwm, False, run.t_s, head, W)


@once
def fitted() -> Solution:
    """The improved model: the parameters of Table 3.2 from three swings, of which none is shown."""
    return fit_tracks(Machine(), [_track(phi) for phi in _FITTED_RAD], delay_s=0.0)


def fitted_rig() -> SimulatedRig:
    """The nominal rig with the fitted plant."""
    plant, _ = made(Machine(), fitted().values, False, nominal().pump.tick_s)
    return replace(nominal(), plant=plant, free_damping_scale=plant.damping_scale)


def _seen_column(column: int) -> FloatArray:
    """Length of a bellows [mm], or the angle [rad], of the shown swing as the camera shows it."""
    phi, length = _seen_swing().T
    return np.asarray(phi if column == 2 else 1e3 * (length + _R * (1.0, -1.0)[column] * phi))


def _frequency_hz(rig: Callable[[], SimulatedRig]) -> float:
    return decrement(_swing(rig).t_s, _swing(rig).phi_rad, _SIGMA[0]).frequency_hz


def figure_3_11() -> tuple[Plot, Values]:
    t, phi = _swing(other_rig).t_s, _seen_column(2)
    decay = decrement(t, phi, _SIGMA[0])
    curves = (
        curve("as the camera shows it", t, phi, colour=0),
        curve("peaks that are used", decay.peak_at_s, decay.peak, "points", 1),
    )
    return Plot("time (s)", "angle (rad)", curves), {
        "zeta": decay.zeta, "sigma_zeta": decay.sigma, "frequency_hz": decay.frequency_hz
    }  # fmt: skip


def figure_3_12() -> tuple[Plot, Values]:
    t, q1, rest = _swing(other_rig).t_s, _seen_column(0), 1e3 * nominal().plant.rest_length_m
    curves = (
        curve("as the camera shows it", t, q1, colour=0),
        curve("rest length", t[[0, -1]], np.full(2, rest), "dotted", -1),
    )
    values: Values = {"first_mm": float(q1[:3].mean()), "last_mm": float(q1[-30:].mean())}
    return Plot("time (s)", "length of bellows 1 (mm)", curves), values


def _against(rig: Callable[[], SimulatedRig], column: int) -> tuple[Plot, Values]:
    """A quantity of the shown swing against that of a model."""
    t, seen, scale = _swing(other_rig).t_s, _seen_column(column), 1.0 if column == 2 else 1e3
    model, true = (scale * _columns(_swing(one))[:, column] for one in (rig, other_rig))
    norm = float(np.linalg.norm(model - seen))
    name, colour = ("original model", 1) if rig is first_model else ("improved model", 0)
    curves = (curve("simulated rig", t, seen, "points", -1), curve(name, t, model, colour=colour))
    label = "angle (rad)" if column == 2 else f"length of bellows {column + 1} (mm)"
    return Plot("time (s)", label, curves), {
        "samples": len(t),
        "norm": norm,
        "rms": norm / math.sqrt(len(t)),
        "largest": float(np.abs(model - true).max()),
        "rig_hz": _frequency_hz(other_rig),
        "model_hz": _frequency_hz(rig),
    }


figure_3_13 = partial(_against, first_model, 0)
figure_3_14 = partial(_against, first_model, 1)
figure_3_15 = partial(_against, first_model, 2)
figure_3_18 = partial(_against, fitted_rig, 0)
figure_3_19 = partial(_against, fitted_rig, 1)
figure_3_20 = partial(_against, fitted_rig, 2)

# Pumps (2.3, 3.5)

_THRESHOLD_V, _SUPPLY_V = 4.7, 12.0
_PRINTED_MM = (-0.1493, 3.376, -25.87, 54.13)
"""Coefficients of (2.13) as printed, in millimetres."""


def pump_threshold() -> Values:
    pwm = np.arange(0.0, PWM_MAX + 1.0)
    roots = np.roots(ElongationForce().elongation_mm)
    real = roots[np.abs(roots.imag) < 1e-9].real
    return {
        "first_pwm": float(pwm[static_force_N(nominal().pump, pwm) > 0.0][0]),
        "zero_of_polynomial_V": float(real[np.argmin(np.abs(real - _THRESHOLD_V))]),
    }


def pump_poly() -> Values:
    laws = {"": _PRINTED_MM, "corrected_": ElongationForce().elongation_mm}
    volts = {"4p7V": _THRESHOLD_V, "12V": _SUPPLY_V}
    return {
        f"{law}at_{name}_mm": float(np.polyval(cubic, u))
        for law, cubic in laws.items()
        for name, u in volts.items()
    }


def pump_range() -> Values:
    rest, inflated = 1e3 * nominal().plant.rest_length_m, figure("inflated_mm", "deflate")
    return {"shortest_mm": rest, "longest_mm": rest + inflated, "elongation_mm": inflated}


def pump_g() -> Values:
    law, pwm = PolynomialForce(), np.arange(0.0, PWM_MAX + 1.0)
    raw = np.polyval((*law.force_mN, 0.0), pwm)
    dead = pwm < law.dead_zone_pwm
    bump, full = float(raw[dead].max()), float(raw[-1])
    return {
        "full_mN": full,
        "spring_at_12V_mN": 1e3 * float(ElongationForce().force_N(np.array(PWM_MAX))),
        "bump_mN": bump,
        "bump_at_pwm": float(pwm[dead][np.argmax(raw[dead])]),
        "bump_percent": 100.0 * bump / full,
    }


def _inflated_mm() -> tuple[Run, FloatArray]:
    """The run at 12 V for 5 s, then off, and its elongations [mm] up to there."""
    run = tried("deflate")
    return run, elongation_mm(run)[: round(5.0 / run.tick_s) + 1]


def pump_tau() -> Values:
    run, mm = _inflated_mm()
    return {"time_to_63_percent_s": share_of_way_s(run, mm[:-1], 1.0 - math.exp(-1.0))}


def pump_fall() -> Values:
    force = float(static_force_N(nominal().pump, np.array(PWM_MAX)))
    return {
        "deflation_s": figure("deflation_s", "deflate", rig=printed_rate),
        "with_0p4_s": figure("deflation_s", "deflate"),
        "in_millinewton_min": force / (1e-3 * PRINTED_RATE) / 60.0,
    }


def pump_deflation() -> Values:
    down, up = figure("deflation_s", "deflate"), share_of_way_s(*_inflated_mm(), 0.95)
    return {"deflation_s": down, "inflation_s": up, "ratio": down / up}


def pump_overshoot() -> Values:
    rigs = {"creep": nominal, "no_creep": without_creep, "rate": printed_rate, "printed": printed_table}
    least = {
        name: float(elongation_mm(tried("deflate", 20.0, rig=rig))[300:].min()) for name, rig in rigs.items()
    }
    return {"below_mm": max(-least["creep"], 0.0)} | {f"least_{name}_mm": v for name, v in least.items()}


def pump_pwm6v() -> Values:
    return {"pwm": 6.0 / _SUPPLY_V * PWM_MAX}


@once
def _bent_runs() -> tuple[FloatArray, tuple[Run, ...]]:
    """Voltages, and the simulated rig with one pump at each of them, the other off, for 8 s."""
    rig, volts, ticks, runs = nominal(), np.arange(5.0, 13.0), round(8.0 / nominal().pump.tick_s), []
    for volt in volts.tolist():
        pwm = np.zeros((ticks, 2))
        pwm[tick_times(rig, ticks) >= 0.5, 0] = PWM_MAX * volt / _SUPPLY_V
        runs.append(simulate(rig, at_rest(rig), pwm, ticks, 0, "truth"))
    return volts, tuple(runs)


def figure_3_16() -> tuple[Plot, Values]:
    volts, runs = _bent_runs()
    rows = []
    for run in runs:
        acc, t = (
            np.arctan2(run.sensors.accel_mps2[:, 1], run.sensors.accel_mps2[:, 0]),
            run.sensors.imu.taken_s,
        )
        rows.append([acc[(t >= begin) & (t < begin + 1.0)].mean() for begin in (5.0, 6.0, 7.0)])
    seen, true = np.array(rows), np.array([run.phi_rad[-1] for run in runs])
    mean, spread = seen.mean(axis=1), T_OF_TWO * seen.std(axis=1, ddof=1) / math.sqrt(3)
    curves = (
        curve("mean of three seconds, 95 %", volts, mean, "points", -1, spread),
        curve("truth", volts, true, "line", 0),
    )
    values: Values = {"at_12V_rad": float(true[-1]), "bias_mrad": float(1e3 * np.mean(mean - true))}
    return Plot("motor input (V)", "angle (rad)", curves), values


def figure_3_17() -> tuple[Plot, Values]:
    plant, ends = nominal().plant, np.array([run.states[-1] for run in _bent_runs()[1]])
    phi = np.array([run.phi_rad[-1] for run in _bent_runs()[1]])
    eps = ends[:, :2] - plant.rest_length_m
    force = np.array([[plant.stiffness.secant(e) * e for e in row] for row in eps.tolist()])
    bending = plant.bending_N_per_rad2 * phi * np.abs(phi)
    pump = ends[:, STATE.index("force1_N")]
    curves = (
        curve("spring of the driven bellows (3.38)", phi, force[:, 0], colour=0),
        curve("spring of the other", phi, force[:, 1], "points", 1),
        curve("k phi^2 of (3.44)", phi, bending, "dashed", 2),
        curve("driving pump", phi, pump, "points", -1),
    )
    last = {"phi_rad": phi, "spring_N": force[:, 0], "bending_N": bending, "pump_N": pump}
    return Plot("angle (rad)", "force (N)", curves), {name: float(v[-1]) for name, v in last.items()}


def figure_3_23() -> tuple[Plot, Values]:
    curves, values = [], {}
    for k, volt in enumerate(("6.0", "8.0", "10.0", "12.0")):
        other, model = (tried("deflate", 8.0, rig=r, volt=volt, off_at_s="100") for r in (other_rig, nominal))
        name = f"{float(volt):g}"
        curves.append(curve(f"{name} V", other.t_s, seen_elongation_mm(other), "line", k))
        curves.append(curve("", model.t_s, elongation_mm(model), "dashed", k))
        values[f"off_{name}V_mm"] = float(elongation_mm(model)[-1] - elongation_mm(other)[-1])
    return Plot("time (s)", "elongation (mm)", tuple(curves)), values


def figure_3_24() -> tuple[Plot, Values]:
    other, limited, printed = (tried("deflate", 14.0, rig=r) for r in (leaking_rig, nominal, printed_rate))
    curves = (
        curve("rig with an orifice", other.t_s, seen_elongation_mm(other), "points", -1),
        curve("falling limit of 0.4 N/s", limited.t_s, elongation_mm(limited), colour=0),
        curve("printed limit of 2 N/s", printed.t_s, elongation_mm(printed), "dashed", 1),
    )
    on = Band("x", 0.0, 5.0, "motors on")
    plot = Plot("time (s)", "elongation (mm)", (on, *curves), y_limits=(-1.5, 31.0))
    return plot, {
        f"deflation_{name}_s": fall_time_s(run.tick_s, elongation_mm(run)[300:]) or math.nan
        for name, run in (("orifice", other), ("0p4", limited), ("2", printed))
    }

"""Claims about the equations of motion and the first model (3.2, 3.3)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.dynamics import coriolis_matrix, kinetic_energy_J, linearised, mass_matrix
from calib.stages.actuator.kinematics import forward, forward_jacobian
from calib.stages.actuator.parameters import Plant
from thesis.outcome import Finding, Outcome, claim, exactly
from thesis.runs import first_model, nominal, tried

__all__ = ["CLAIMS", "lateral_damping", "model_errors"]

_PLANT = Plant()
_R = _PLANT.bellows_radius_m
_STEP = 1e-5
_STATES = (
    ((0.065, 0.065), (0.05, -0.03)),
    ((0.080, 0.066), (-0.2, 0.1)),
    ((0.067, 0.088), (0.15, 0.25)),
    ((0.090, 0.072), (-0.05, -0.3)),
)
"""Bellows [m] and their rates [m/s] at which identities are tried, the straight rest among them."""


def _velocity(q: FloatArray, dq: FloatArray) -> FloatArray:
    """Velocity (2,) of the head by differences of the forward kinematics."""
    return np.asarray((forward(q + _STEP * dq, _R) - forward(q - _STEP * dq, _R))[:2] / (2.0 * _STEP))


@claim(
    "dyn.identity",
    "3.23, C",
    "derivatives by the coordinates and of the rates by the rates agree",
    basis="equations",
)
def identity() -> Finding:
    worst = 0.0
    for bellows, rates in _STATES:
        q, dq = np.array(bellows), np.array(rates)
        for i in range(2):
            e = np.zeros(2)
            e[i] = 0.1
            by_rate = (_velocity(q, dq + e) - _velocity(q, dq - e)) / 0.2
            worst = max(worst, float(np.abs(by_rate - forward_jacobian(q, _R)[:2, i]).max()))
    return Finding(
        f"equal to {worst:.0e}",
        exactly(worst < 1e-6),
        "derivative of the head's velocity by the bellows' rates, by differences, against the Jacobian",
        {"error": worst},
    )


@claim(
    "dyn.rotational",
    "3.25",
    "rotational part of the inertia",
    "J / (4 r_B^2) (ddq_i - ddq_j)",
    basis="equations",
)
def rotational() -> Finding:
    J, worst = _PLANT.inertia_kgm2, 0.0
    for i in range(2):
        sign = 1.0 - 2.0 * i
        dq, ddq, h = np.array([0.1, -0.2]), np.array([3.0, -7.0]), 1e-4

        def momentum(t: float, i: int = i, dq: FloatArray = dq, ddq: FloatArray = ddq) -> float:
            def energy(rates: FloatArray) -> float:
                return 0.5 * J * float((rates[0] - rates[1]) / (2.0 * _R)) ** 2

            e = np.zeros(2)
            e[i] = 1e-3
            rates = dq + t * ddq
            return (energy(rates + e) - energy(rates - e)) / 2e-3

        found = (momentum(h) - momentum(-h)) / (2.0 * h)
        wanted = J / (4.0 * _R**2) * sign * float(ddq[0] - ddq[1])
        worst = max(worst, abs(found / wanted - 1.0))
    return Finding(
        f"equal to {worst:.0e}",
        exactly(worst < 1e-6),
        "rate of the rotational momentum by differences, for both bellows",
        {"relative_error": worst},
    )


@claim("dyn.mass", "3.34", "mass matrix", "symmetric, positive definite", basis="equations")
def mass() -> Finding:
    q1, q2 = np.meshgrid(np.linspace(0.06, 0.095, 8), np.linspace(0.06, 0.095, 8))
    M = mass_matrix(_PLANT, np.stack([q1.ravel(), q2.ravel()], axis=1))
    skew = float(np.abs(M - np.swapaxes(M, 1, 2)).max())
    least = float(np.linalg.eigvalsh(M).min())
    return Finding(
        f"eigenvalues of at least {1e3 * least:.2f} g",
        exactly(skew < 1e-12 * least and least > 0.0),
        "over the workspace; regular also without any inertia J, as det M = m (m l^2 / 4 + J) / (4 r_B^2) at "
        "the straight shape",
        {"least_eigenvalue_kg": least, "asymmetry_kg": skew},
    )


def _kinetic(q: FloatArray, dq: FloatArray) -> float:
    moving, turning = kinetic_energy_J(_PLANT, q, dq)
    return float(moving + turning)


@claim("dyn.coriolis", "3.35", "Coriolis matrix, against Euler and Lagrange", basis="equations")
def coriolis() -> Finding:
    ddq, worst = np.array([4.0, -6.0]), 0.0
    for bellows, rates in _STATES:
        q, dq = np.array(bellows), np.array(rates)
        ours = mass_matrix(_PLANT, q) @ ddq + coriolis_matrix(_PLANT, q, dq) @ dq
        for i in range(2):
            e, h, d = np.zeros(2), 1e-4, 1e-4
            e[i] = 1.0

            def momentum(
                t: float,
                q: FloatArray = q,
                dq: FloatArray = dq,
                e: FloatArray = e,
            ) -> float:
                at, rate = q + t * dq + 0.5 * t * t * ddq, dq + t * ddq
                return (_kinetic(at, rate + 1e-2 * e) - _kinetic(at, rate - 1e-2 * e)) / 2e-2

            by_time = (momentum(h) - momentum(-h)) / (2.0 * h)
            by_place = (_kinetic(q + d * e, dq) - _kinetic(q - d * e, dq)) / (2.0 * d)
            worst = max(worst, abs(by_time - by_place - float(ours[i])) / float(np.abs(ours).max()))
    return Finding(
        f"equal to {worst:.0e}",
        exactly(worst < 1e-4),
        "M ddq + C dq against d/dt dT/ddq - dT/dq by differences of the kinetic energy",
        {"relative_error": worst},
    )


@claim("dyn.spring_sign", "3.36, 3.38", "springs enter the left-hand side as k (l0 - q)", basis="equations")
def spring_sign() -> Finding:
    k = _PLANT.stiffness.secant(0.0)
    rates = np.sqrt(np.linalg.eigvals(np.linalg.solve(mass_matrix(_PLANT, np.full(2, 0.065)), k * np.eye(2))))
    growth = float(np.max(rates))
    return Finding(
        f"grows at {growth:.0f} /s",
        exactly(growth <= 0.0),
        "small motion about rest, M ddq + k (l0 - q) = 0: deviations double in "
        f"{1e3 * math.log(2.0) / growth:.0f} ms; with k (q - l0) they swing",
        {"growth_per_s": growth},
    )


@claim(
    "dyn.constants",
    "Table 3.1",
    "mass, inertia, rest length and radius of the bellows",
    "0.0166 kg, 1.27e-5 kg m2, 0.065 m, 0.0126 m",
    basis="chosen",
)
def constants() -> Finding:
    gyration = math.sqrt(_PLANT.inertia_kgm2 / _PLANT.mass_kg)
    hertz = tried("swing")[1]["frequency_hz"] or math.nan
    return Finding(
        f"radius of gyration {1e3 * gyration:.1f} mm; a swing of {hertz:.2f} Hz",
        Outcome.UNMEASURED,
        "weights and drawings are not published; the values fit each other as far as can be seen: the radius "
        "of gyration lies within the half actuator, and the simulated rig made with them swings as the "
        "figures do",
        {"radius_of_gyration_m": gyration, "swing_hz": hertz},
        simulated=True,
    )


@claim(
    "dyn.ke_share",
    "Fig. 3.8",
    "share of the rotation in the kinetic energy of a swing",
    "about 20 %",
    basis="printed",
)
def ke_share() -> Finding:
    def share(q: FloatArray, dq: FloatArray) -> float:
        moving, turning = kinetic_energy_J(_PLANT, q, dq)
        return float(np.sum(turning) / np.sum(moving + turning))

    straight = share(np.full(2, 0.065), np.array([0.1, -0.1]))
    run, _ = tried("swing")
    whole = share(run.states[:, 0:2], run.states[:, 2:4])
    arm = 0.5 * _PLANT.rest_length_m + 0.015
    at_marker = _PLANT.inertia_kgm2 / (_PLANT.inertia_kgm2 + _PLANT.mass_kg * arm**2)
    return Finding(
        f"{100.0 * straight:.0f} %",
        exactly(abs(straight - 0.20) < 0.05),
        "J / (m l0^2 / 4 + J) with the values of Table 3.1, for pure bending through the straight shape; "
        f"over a whole simulated swing it is {100.0 * whole:.0f} %, and with the marker's radius in place of "
        f"the head's {100.0 * at_marker:.0f} %",
        {"share": straight, "share_of_swing": whole, "share_at_marker": at_marker},
    )


@claim(
    "dyn.damping_ratio",
    "3.40",
    "damping ratio of a free swing by its decrement",
    "0.0513",
    "data",
    basis="chosen",
)
def damping_ratio() -> Finding:
    zeta = tried("swing")[1]["damping_ratio"] or math.nan
    return Finding(
        f"{zeta:.4f}",
        Outcome.UNMEASURED,
        "swing of the simulated rig from 0.5 rad, whose damping was chosen to come near the printed figure",
        {"zeta": zeta},
        simulated=True,
    )


def lateral_damping(plant: Plant) -> float:
    """Damping ratio of the slowest swing about the straight rest, which is the lateral one."""
    roots = np.linalg.eigvals(linearised(plant, np.full(2, plant.rest_length_m)))
    swings = roots[roots.imag > 1e-6]
    slowest = swings[np.argmin(np.abs(swings))]
    return float(-slowest.real / abs(slowest))


@claim(
    "dyn.damping_lateral",
    "3.41",
    "the measured ratio, put into 3.41, gives the lateral decay back",
    basis="printed",
)
def damping_lateral() -> Finding:
    zeta = lateral_damping(first_model().free_plant)
    share = zeta / _PLANT.damping_ratio
    return Finding(
        f"{share:.3f} of it",
        exactly(abs(share - 1.0) < 0.05),
        "roots of the linearised first model: 3.41 is the relation of the axial mode, where the mass moves "
        f"with both bellows; laterally 0.0513 becomes {zeta:.4f}, and c_dmp = {1.0 / share:.1f} is needed",
        {"zeta": zeta, "share": share, "needed_c_dmp": 1.0 / share},
    )


@lru_cache(maxsize=1)
def model_errors() -> FloatArray:
    """q1, q2 [m] and phi [rad] (n, 3) of the simulated rig less those of the first model, over a swing."""
    truth, _ = tried("swing")
    first, _ = tried("swing", rig=first_model())
    q = truth.states[:, :2] - first.states[:, :2]
    return np.column_stack([q, truth.phi_rad - first.phi_rad])


@claim(
    "dyn.error_band",
    "3.3",
    "error of the first model's bellows in a free swing",
    "-1 .. 1 cm",
    "data",
    basis="twin",
)
def error_band() -> Finding:
    q = 1e3 * model_errors()[:, :2]
    low, high = float(q.min()), float(q.max())
    return Finding(
        f"{low:.1f} .. {high:.1f} mm",
        Outcome.UNMEASURED,
        "first model against the simulated rig, which has bending and creep, from the same 0.5 rad",
        {"least_mm": low, "greatest_mm": high},
        simulated=True,
    )


@claim(
    "dyn.static_error",
    "3.3",
    "error that is left when the swing has died away",
    "0.5 mm",
    "data",
    basis="twin",
)
def static_error() -> Finding:
    run, _ = tried("swing", 20.0)
    rest = nominal().plant.rest_length_m
    left = 1e3 * float(np.abs(run.states[-60:, :2] - rest).max())
    return Finding(
        f"{left:.0e} mm",
        Outcome.UNMEASURED,
        "distance from the rest length in the last second of 20 s of a simulated swing: the model has none, "
        "which agrees with the source's own blame on its sensors",
        {"left_mm": left},
        simulated=True,
    )


CLAIMS = (
    identity,
    rotational,
    mass,
    coriolis,
    spring_sign,
    constants,
    ke_share,
    damping_ratio,
    damping_lateral,
    error_band,
    static_error,
)
"""In the order of the source."""

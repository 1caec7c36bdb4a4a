"""Equations of motion: against Euler-Lagrange in sympy, invariants, energies, and the hot path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import sympy
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator import dynamics as dyn
from calib.actuator import kinematics as kin
from calib.actuator.kernel import derivative
from calib.actuator.parameters import Creep, Plant, Stiffness, pumps_connected
from calib.arrays import FloatArray

BELLOWS = st.floats(0.045, 0.095)
GRAVITY = Plant(gravity_mps2=(1.3, 9.81))
PLANTS = [
    Plant(),
    pumps_connected(),
    GRAVITY,
    Plant(force_projection="head"),
    Plant(force_projection="head", gravity_mps2=(-2.0, 9.81), creep=None),
    Plant(stiffness=Stiffness((40.0, 500.0, -2e4, 3e5)), stiffness_scale=0.9102),
    Plant(stiffness=Stiffness((55.0,)), inertia_kgm2=0.0, bending_N_per_rad2=0.0),
]


def random_motion(seed: int, count: int) -> tuple[FloatArray, ...]:
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.045, 0.095, (count, 2))
    return q, rng.normal(0, 0.3, (count, 2)), rng.normal(0, 0.3, (count, 2)), rng.uniform(0, 2, (count, 2))


@lru_cache(maxsize=1)
def lagrange() -> tuple[Callable[..., FloatArray], Callable[..., FloatArray], Callable[..., FloatArray]]:
    """M, the terms quadratic in dq, and dU/dq of the stretched bellows (eps >= 0, phi > 0), by sympy.

    From (3.3), the arc's end point and the energies alone.
    """
    q = sympy.symbols("q1 q2", positive=True)
    v = sympy.symbols("v1 v2", real=True)
    m, J, r, l0, k0, k1, kb, gx, gy = sympy.symbols("m J r l0 k0 k1 kb gx gy", real=True)
    phi, ell = (q[0] - q[1]) / (2 * r), (q[0] + q[1]) / 2
    p = sympy.Matrix([ell * (1 - sympy.cos(phi)) / phi, ell * sympy.sin(phi) / phi])
    dp = p.jacobian(q) * sympy.Matrix(v)
    dphi = (v[0] - v[1]) / (2 * r)
    T = m * (dp.T * dp)[0] / 2 + J * dphi**2 / 2
    springs = sum(k0 * (x - l0) ** 2 / 2 + k1 * (x - l0) ** 3 / 3 for x in q)
    U = springs + sympy.Rational(2, 3) * r * kb * phi**3 - m * (gx * p[0] + gy * p[1])
    momentum = sympy.Matrix([sympy.diff(T, x) for x in v])
    M = momentum.jacobian(v)
    swept = momentum.jacobian(q) * sympy.Matrix(v) - sympy.Matrix([sympy.diff(T, x) for x in q])
    pull = sympy.Matrix([sympy.diff(U, x) for x in q])
    arguments = (*q, *v, m, J, r, l0, k0, k1, kb, gx, gy)
    return tuple(sympy.lambdify(arguments, e, "numpy", cse=True) for e in (M, swept, pull))


def symbols_of(plant: Plant, q: FloatArray, dq: FloatArray) -> tuple[float, ...]:
    c = dyn.coefficients(plant)
    return (*q, *dq, c.m, c.J, c.r, c.l0, c.k0, c.k1, c.bending, c.gx, c.gy)


def test_against_euler_lagrange() -> None:
    M, swept, pull = lagrange()
    plant = replace(GRAVITY, damping_ratio=0.0)
    rng = np.random.default_rng(4)
    for _ in range(30):
        q2 = rng.uniform(0.066, 0.09)
        q = np.array([q2 + rng.uniform(0.004, 0.02), q2])
        dq = rng.normal(0, 0.5, 2)
        at = symbols_of(plant, q, dq)
        assert dyn.mass_matrix(plant, q) == pytest.approx(M(*at), rel=1e-9)
        C = dyn.coriolis_matrix(plant, q, dq)
        assert C @ dq == pytest.approx(swept(*at)[:, 0], rel=1e-7, abs=1e-11)
        assert dyn.resisting_forces(plant, q, dq) == pytest.approx(pull(*at)[:, 0], rel=1e-9)


def test_mass_matrix_at_rest_and_its_determinant() -> None:
    """det M(phi = 0) = m (m l^2 / 4 + J) / (4 r_B^2), also for J = 0."""
    for plant in (Plant(), Plant(inertia_kgm2=0.0)):
        m, J, r = plant.mass_kg, plant.inertia_kgm2, plant.bellows_radius_m
        for length in (0.05, 0.065, 0.09):
            det = float(np.linalg.det(dyn.mass_matrix(plant, np.array([length, length]))))
            assert det == pytest.approx(m * (m * length**2 / 4 + J) / (4 * r**2), rel=1e-10)


@given(BELLOWS, BELLOWS)
def test_mass_matrix_is_positive_definite(q1: float, q2: float) -> None:
    """Everywhere in the workspace, with det M = m S^2 (m l^2 S^2 / 4 + J) / (4 r_B^2)."""
    plant, q = Plant(), np.array([q1, q2])
    M = dyn.mass_matrix(plant, q)
    assert pytest.approx(M.T, rel=1e-12) == M
    assert np.linalg.eigvalsh(M)[0] > 0.0
    m, J, r = plant.mass_kg, plant.inertia_kgm2, plant.bellows_radius_m
    S = float(np.sinc(kin.angle(q, r) / (2 * np.pi)))
    expected = m * S**2 * (m * float(kin.length(q)) ** 2 * S**2 / 4 + J) / (4 * r**2)
    assert float(np.linalg.det(M)) == pytest.approx(expected, rel=1e-9)


def test_rotational_inertia_of_325() -> None:
    """J / (4 r_B^2) (ddq_i - ddq_j) is the rotational part of M ddq."""
    q = np.array([0.08, 0.066])
    heavy, light = Plant(), Plant(inertia_kgm2=0.0)
    part = dyn.mass_matrix(heavy, q) - dyn.mass_matrix(light, q)
    scale = heavy.inertia_kgm2 / (4 * heavy.bellows_radius_m**2)
    assert part == pytest.approx(scale * np.array([[1, -1], [-1, 1]]), rel=1e-10)


def test_coriolis_matrix_of_335() -> None:
    """dM/dt - 2 C is skew-symmetric, so C does no work beyond the change of inertia."""
    plant, h = Plant(), 1e-6
    for q, dq in zip(*random_motion(1, 10)[:2], strict=True):
        rate = (dyn.mass_matrix(plant, q + h * dq) - dyn.mass_matrix(plant, q - h * dq)) / (2 * h)
        C = dyn.coriolis_matrix(plant, q, dq)
        skew = rate - 2 * C
        assert skew + skew.T == pytest.approx(np.zeros((2, 2)), abs=1e-8 * np.abs(rate).max() + 1e-9)
        swept = C @ dq
        assert dq @ swept == pytest.approx(0.5 * dq @ rate @ dq, rel=1e-5, abs=1e-10)


def test_head_projection_at_07_rad() -> None:
    """The printed projection: the identity straight, [[1.25, 0.25], [-0.33, 0.67]] at 0.7 rad."""
    plant = Plant(force_projection="head")
    bent = kin.bellows_from_configuration(np.array([0.7 / 0.065, 0.065]), plant.bellows_radius_m)
    assert dyn.force_map(plant, bent) == pytest.approx(np.array([[1.25, 0.25], [-0.33, 0.67]]), abs=0.005)
    assert dyn.force_map(plant, np.array([0.07, 0.07])) == pytest.approx(np.eye(2), abs=1e-15)
    assert dyn.force_map(Plant(), bent) == pytest.approx(np.eye(2))


def test_head_projection_against_the_bellows_ends() -> None:
    """P[r, i] = t . d r_Bi / dq_r with r_Bi from the homogeneous transform (3.32)."""
    plant, h = Plant(force_projection="head"), 1e-6
    r = plant.bellows_radius_m

    def ends(q: FloatArray) -> FloatArray:
        H = kin.transform(kin.angle(q, r), kin.length(q))
        return np.stack([(H @ np.array([side, 0.0, 1.0]))[:2] for side in (-r, r)])

    q = np.array([0.085, 0.06])
    phi = float(kin.angle(q, r))
    tangent = np.array([np.sin(phi), np.cos(phi)])
    for row, step in enumerate(np.eye(2) * h):
        moved = (ends(q + step) - ends(q - step)) / (2 * h)
        assert dyn.force_map(plant, q)[row] == pytest.approx(moved @ tangent, abs=1e-8)


@pytest.mark.parametrize("plant", PLANTS)
def test_hot_path_is_the_reference(plant: Plant) -> None:
    """The closed form in (l, phi), compiled and in Python, against M, C, N and tau."""
    c = dyn.coefficients(plant)
    r = c.r
    for q, dq, z, force in zip(*random_motion(2, 60), strict=True):
        expected = dyn.acceleration(plant, q, dq, z, force)
        rate = derivative(c, np.concatenate([q, dq, z]), *force)
        assert rate[2:4] == pytest.approx(expected, rel=1e-10, abs=1e-9)
        assert rate[:2] == pytest.approx(dq)
        l1, l2, _ = plant.creep_rates
        assert rate[4:] == pytest.approx(-l1 * z + l2 * dq, rel=1e-12, abs=1e-14)
        half = (q.mean(), (q[0] - q[1]) / (2 * r), dq.mean(), (dq[0] - dq[1]) / (2 * r))
        ddl, ddphi, _, _ = dyn.rates(c, *half, z.sum(), z[0] - z[1], *force)
        assert [ddl + r * ddphi, ddl - r * ddphi] == pytest.approx(expected, rel=1e-10, abs=1e-9)


def test_printed_spring_sign_flies_away() -> None:
    """k (l0 - q) on the left-hand side pushes a stretched bellows further."""
    q = np.array([0.07, 0.07])
    pull = dyn.resisting_forces(Plant(), q, np.zeros(2))
    assert np.all(pull > 0.0)
    assert np.all(dyn.acceleration(Plant(), q, np.zeros(2), np.zeros(2), np.zeros(2)) < 0.0)


def test_scales_of_347_and_348() -> None:
    """c_spr scales the spring alone, c_dmp the damper alone."""
    q, dq = np.array([0.075, 0.07]), np.array([0.2, -0.1])
    base = Plant(bending_N_per_rad2=0.0)

    def parts(plant: Plant) -> tuple[FloatArray, FloatArray]:
        spring = dyn.resisting_forces(plant, q, np.zeros(2))
        return spring, dyn.resisting_forces(plant, q, dq) - spring

    spring, damper = parts(base)
    softer = parts(replace(base, stiffness_scale=0.9102))
    assert softer[0] == pytest.approx(0.9102 * spring)
    assert softer[1] == pytest.approx(damper)
    tougher = parts(replace(base, damping_scale=2 * base.damping_scale))
    assert tougher[0] == pytest.approx(spring)
    assert tougher[1] == pytest.approx(2 * damper)


def test_bending_of_344() -> None:
    """k_bnd phi |phi| with opposite signs on the bellows, restoring either way."""
    soft, stiff = Plant(bending_N_per_rad2=0.0), Plant()
    for phi in (0.5, -0.5):
        q = kin.bellows_from_configuration(np.array([phi / 0.065, 0.065]), stiff.bellows_radius_m)
        moment = dyn.resisting_forces(stiff, q, np.zeros(2)) - dyn.resisting_forces(soft, q, np.zeros(2))
        assert moment == pytest.approx(0.1695 * phi * abs(phi) * np.array([1, -1]))


@pytest.mark.parametrize("plant", [Plant(), GRAVITY, PLANTS[5]])
def test_energies_belong_to_the_forces(plant: Plant) -> None:
    """N at rest is the gradient of U, and dE/dt = F dq - dissipation along any motion."""
    h = 1e-7
    for q, dq, z, force in zip(*random_motion(3, 20), strict=True):
        gradient = [
            (dyn.potential_energy_J(plant, q + e) - dyn.potential_energy_J(plant, q - e)) / (2 * h)
            for e in np.eye(2) * h
        ]
        assert dyn.resisting_forces(plant, q, np.zeros(2)) == pytest.approx(gradient, rel=1e-5, abs=1e-7)
        rate = derivative(dyn.coefficients(plant), np.concatenate([q, dq, z]), *force)
        ends = [
            float(dyn.energy_J(plant, q + s * rate[:2], dq + s * rate[2:4], z + s * rate[4:]))
            for s in (-h, h)
        ]
        power = force @ dq - float(dyn.dissipation_W(plant, q, dq, z))
        assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(power, rel=1e-4, abs=1e-5)
        assert dyn.dissipation_W(plant, q, dq, z) >= 0.0


def test_creep_energy() -> None:
    z = np.array([0.3, -0.1])
    assert float(dyn.creep_energy_J(Plant(), z)) == pytest.approx(0.5 * 0.1 * (0.09 + 0.01))
    assert float(dyn.creep_energy_J(Plant(creep=None), z)) == 0.0
    assert float(dyn.creep_energy_J(Plant(creep=Creep(1.0, 20.0, 1.0)), z)) == 0.0


@pytest.mark.parametrize("plant", [Plant(), GRAVITY, PLANTS[5], PLANTS[6]])
@pytest.mark.parametrize("q", [(0.07, 0.07), (0.085, 0.066), (0.06, 0.08)])
def test_linearised_plant_against_differences(plant: Plant, q: tuple[float, float]) -> None:
    """About a rest that the pumps hold."""
    c, at = dyn.coefficients(plant), np.array(q)
    hold = dyn.resisting_forces(plant, at, np.zeros(2))
    state, h = np.concatenate([at, np.zeros(4)]), 1e-7
    assert derivative(c, state, *hold)[2:4] == pytest.approx(np.zeros(2), abs=1e-9)
    A = dyn.linearised(plant, at)
    for j, step in enumerate(np.eye(6) * h):
        column = (derivative(c, state + step, *hold) - derivative(c, state - step, *hold)) / (2 * h)
        assert A[:, j] == pytest.approx(column, rel=1e-5, abs=2e-3)


def test_rotational_share_of_a_swing() -> None:
    """About 42 % with Table 3.1, not the 20 % of the text; 25 % at the marker's radius."""
    plant = Plant()
    q, dq = np.array([0.065, 0.065]), np.array([0.1, -0.1])
    moving, turning = dyn.kinetic_energy_J(plant, q, dq)
    assert float(turning / (moving + turning)) == pytest.approx(0.42, abs=0.005)
    wide = 0.5 * plant.mass_kg * ((0.0325 + 0.015) * 0.1 / plant.bellows_radius_m) ** 2
    assert float(turning) / (wide + float(turning)) == pytest.approx(0.25, abs=0.005)


def test_shapes() -> None:
    plant = Plant()
    q, dq, z, force = (a.reshape(2, 3, 2) for a in random_motion(5, 6))
    assert dyn.mass_matrix(plant, q).shape == (2, 3, 2, 2)
    assert dyn.acceleration(plant, q, dq, z, force).shape == (2, 3, 2)
    assert dyn.energy_J(plant, q, dq, z).shape == (2, 3)

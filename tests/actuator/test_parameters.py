"""Parameters: the nominal plant, laws, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.dynamics import linearised
from calib.actuator.parameters import (
    PRINTED_CREEP,
    Creep,
    Plant,
    StandardLinearSolid,
    Stiffness,
    UnstablePlantWarning,
    free_swing,
    growth_rate_per_s,
    pumps_connected,
)
from calib.errors import BadInputError


def test_nominal_values() -> None:
    plant = free_swing()
    assert (plant.mass_kg, plant.inertia_kgm2) == (0.0166, 1.27e-5)
    assert (plant.bellows_radius_m, plant.rest_length_m) == (0.0126, 0.065)
    assert plant.stiffness.coefficients == (47.7, 1092.9)
    assert (plant.damping_ratio, plant.damping_scale) == (0.0513, 3.3)
    assert pumps_connected().damping_scale == 16.0
    assert plant.bending_N_per_rad2 == 0.1695
    assert plant.creep_rates == (3.0, 10.0, -1.0)
    assert plant.gravity_mps2 == (0.0, 0.0)
    assert plant.force_projection == "virtual_work"


def test_damping_of_341() -> None:
    """c sqrt(k) is 2 c_dmp zeta sqrt(m k / 2)."""
    plant = pumps_connected()
    c = plant.damping_Ns_per_sqrt_N_per_m * math.sqrt(47.7)
    assert c == pytest.approx(2 * 16.0 * 0.0513 * math.sqrt(0.5 * 0.0166 * 47.7), rel=1e-14)


@pytest.mark.parametrize("law", [Stiffness(), Stiffness((60.0,)), Stiffness((40.0, 500.0, -2e4, 3e5))])
def test_stiffness_law_is_consistent(law: Stiffness) -> None:
    """Secant, tangent and energy belong to one force."""
    for eps in (-0.01, 1e-4, 0.01, 0.0266, 0.039):
        h = 1e-6
        force = [law.secant(e) * e for e in (eps - h, eps, eps + h)]
        assert law.tangent(eps) == pytest.approx((force[2] - force[0]) / (2 * h), rel=1e-5)
        slope = (law.energy(eps + h) - law.energy(eps - h)) / (2 * h)
        assert slope == pytest.approx(force[1], rel=1e-6)
    assert law.secant(-0.02) == law.coefficients[0]


def test_linear_and_actuator_laws() -> None:
    linear = Stiffness((50.0,))
    assert linear.secant(0.02) == linear.secant(-0.02) == linear.tangent(0.01) == 50.0
    assert Stiffness.of_actuator(100.0, 2000.0).coefficients == (50.0, 1000.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass_kg": 0.0}, "mass: found 0"),
        ({"mass_kg": math.nan}, "mass: found nan, expected a finite number"),
        ({"inertia_kgm2": -1e-6}, "inertia"),
        ({"bellows_radius_m": -0.0126}, "bellows radius: found -0.0126, expected a positive number"),
        ({"rest_length_m": -0.065}, "rest length: found -0.065"),
        ({"stiffness_scale": 0.0}, "scale of the stiffness"),
        ({"damping_ratio": -0.1}, "damping ratio"),
        ({"damping_scale": -1.0}, "scale of the damping"),
        ({"bending_N_per_rad2": -0.1}, "bending stiffness"),
        ({"force_projection": "tail"}, "force projection: found 'tail', expected virtual_work or head"),
        ({"gravity_mps2": (0.0, 9810.0)}, "gravity: found 9810"),
    ],
)
def test_refused_values(change: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        replace(Plant(), **change)


@pytest.mark.parametrize(
    ("coefficients", "words"),
    [
        ((), "found 0 coefficients"),
        ((1.0,) * 5, "found 5 coefficients"),
        ((50.0, -2000.0), "expected a positive law"),
        ((math.inf,), "finite"),
    ],
)
def test_refused_stiffness(coefficients: tuple[float, ...], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Stiffness(coefficients)


def test_printed_creep_is_refused_with_its_growth_rate() -> None:
    """lambda2 lambda3 = 27.8 N/m takes so much of k0 that z grows at 0.1047 / (1 - 27.8 / 47.7)."""
    with pytest.raises(BadInputError, match=r"leaves rest at 0\.25 1/s \(e-fold in 4 s\)"):
        Plant(creep=Creep(*PRINTED_CREEP))
    slow = 0.1047 / (1 - 14.98 * 1.854 / 47.7)
    with pytest.warns(UnstablePlantWarning, match="unstable"):
        kept = Plant(creep=Creep(*PRINTED_CREEP), allow_unstable=True)
    assert growth_rate_per_s(kept) == pytest.approx(slow, rel=0.01)


@pytest.mark.parametrize(
    "creep", [Creep(*PRINTED_CREEP), Creep(), Creep(1.0, 20.0, 1.0), Creep(2.0, 60.0, 1.0), None]
)
@pytest.mark.filterwarnings("ignore::calib.actuator.parameters.UnstablePlantWarning")
def test_growth_rate_against_the_linearised_plant(creep: Creep | None) -> None:
    plant = Plant(creep=creep, allow_unstable=True)
    roots = np.linalg.eigvals(linearised(plant, np.array([0.065, 0.065])))
    expected = max(float(roots.real.max()), 0.0)
    assert growth_rate_per_s(plant) == pytest.approx(expected, rel=1e-9, abs=1e-7)


def test_undamped_plant_is_not_called_unstable() -> None:
    assert growth_rate_per_s(Plant(damping_ratio=0.0, creep=None)) == 0.0
    assert growth_rate_per_s(Plant(damping_ratio=0.0, inertia_kgm2=0.0, creep=None)) == 0.0


def test_passivity() -> None:
    assert Creep().passive
    assert not Creep(*PRINTED_CREEP).passive
    assert not Creep(1.0, 20.0, 1.0).passive
    assert not Creep(-1.0, 10.0, -1.0).passive
    assert Creep(1.0, 0.0, 1.0).passive


@given(st.floats(0.0, 1e3), st.floats(1e-2, 1e2))
def test_standard_linear_solid_is_passive_and_stable(branch: float, relaxation: float) -> None:
    solid = StandardLinearSolid(branch, relaxation)
    assert solid.passive
    assert Creep(*solid.rates).passive
    assert growth_rate_per_s(Plant(creep=solid)) == 0.0


def test_nominal_creep_is_the_standard_linear_solid() -> None:
    assert StandardLinearSolid().rates == pytest.approx(Creep().rates)


@pytest.mark.parametrize(("branch", "relaxation"), [(-1.0, 1.0), (1.0, 0.0), (1.0, -2.0), (math.nan, 1.0)])
def test_standard_linear_solid_refuses_the_rest(branch: float, relaxation: float) -> None:
    with pytest.raises(BadInputError, match="creep branch"):
        StandardLinearSolid(branch, relaxation)

"""Parameters as a rig: what goes in comes out, the static map in both forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.actuator.identify_parameters import (
    KNOTS_V,
    PARAMETERS,
    Nominal,
    candidates,
    elongation_polynomial,
    made,
    values_of,
)
from calib.actuator.parameters import Creep, Plant
from calib.actuator.pump import PWM_MAX, Orifice, PolynomialForce, Pump, static_force_N
from calib.errors import BadInputError


def test_the_nominal_values_make_the_nominal_rig() -> None:
    nominal = Nominal()
    plant, pump = made(nominal, values_of(nominal), True, nominal.pump.tick_s)
    assert plant == nominal.plant
    pwm = np.array([[0.0, 100.0], [150.0, 255.0]])
    assert np.allclose(static_force_N(pump, pwm), static_force_N(nominal.pump, pwm))
    free, _ = made(nominal, {}, False, nominal.pump.tick_s)
    assert free.damping_scale == nominal.free_damping_scale


def test_every_parameter_changes_something() -> None:
    nominal = replace(Nominal(), pump=Pump(deflation=Orifice()))
    for start in (Nominal(), nominal):
        base = values_of(start)
        for hoses in (False, True):
            for name in candidates(start, not hoses, hoses, static_map=True):
                changed = made(start, {name: 1.1 * base[name]}, hoses, 1.0 / 60.0)
                assert changed != made(start, {}, hoses, 1.0 / 60.0), name


def test_strengths_scale_the_force_of_their_own_pump() -> None:
    _, pump = made(Nominal(), {"strength1": 1.2, "strength2": 0.9}, True, 1.0 / 60.0)
    pwm = np.full((3, 2), 200.0)
    ratio = static_force_N(pump, pwm) / static_force_N(Pump(), pwm)
    assert np.allclose(ratio, [[1.2, 0.9]] * 3)


def test_the_cubic_goes_through_its_knots() -> None:
    mm = [1.9, 11.1, 21.7, 26.6]
    assert np.allclose(np.polyval(elongation_polynomial(mm), KNOTS_V), mm)
    _, pump = made(Nominal(), {"elongation_10V_mm": 22.0}, True, 1.0 / 60.0)
    force = static_force_N(pump, np.full((1, 2), PWM_MAX * 10.0 / 12.0))
    k = Plant().stiffness.coefficients
    assert force[0, 0] == pytest.approx((k[0] + k[1] * 0.022) * 0.022)


def test_candidates_follow_the_logs() -> None:
    free = candidates(Nominal(), True, False, False)
    assert set(free) == {name for name, spec in PARAMETERS.items() if spec.acts in ("all", "free")}
    assert "strength1" not in candidates(Nominal(), False, True, True)
    assert "elongation_6V_mm" not in candidates(Nominal(), False, True, False)


def test_rigs_that_cannot_be_searched_from_are_refused() -> None:
    with pytest.raises(BadInputError, match="not passive"):
        Nominal(plant=replace(Plant(), creep=Creep(0.0, 10.0, -1.0)))
    with pytest.raises(BadInputError, match="polynomial of the force"):
        Nominal(pump=Pump(static=PolynomialForce()))

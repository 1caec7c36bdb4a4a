"""Sections of rig.yaml: the rig that a search starts from, and what an identification writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identifytrials import track

from calib.actuator.dynamics import coefficients
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_stiffness import fit_stiffness
from calib.actuator.pump import Orifice
from calib.actuatorsections import (
    Identified,
    nominal_of,
    plain_section,
    sections_from,
    stiffness_section,
    with_sections,
)
from calib.errors import BadInputError
from calib.identification import identify_logs
from calib.identifying import TrackSource
from calib.rig import Rig, read_rig, write_rig
from calib.twin.rig import SimulatedRig, rig_from_file

PATH = Path("rig.yaml")


@pytest.fixture(scope="module")
def found() -> Identified:
    tracks = [track("prbs", duration_s=6.0, noise=0.3), track("free", duration_s=4.0, noise=0.3)]
    return identify_logs(Nominal(), [TrackSource(t, "test", 0.025, ()) for t in tracks])


def test_an_empty_file_is_the_nominal_rig() -> None:
    nominal, rig = nominal_of(Rig(), PATH), SimulatedRig()
    assert nominal.plant == rig.plant
    assert nominal.pump == rig.pump
    assert nominal.free_damping_scale == rig.free_damping_scale


def test_a_file_is_read_as_the_simulation_reads_it() -> None:
    rig = Rig.model_validate(
        {
            "actuator": {
                "mass_kg": 0.02,
                "k0_N_per_m": 50.0,
                "lambda1_per_s": 2.0,
                "damping_scale_free_swing": 4.0,
            },
            "pump": {
                "deflation": "orifice",
                "laminar_s": 0.9,
                "elongation_mm": [-0.15, 3.7, -25.0, 54.0],
                "strength": [1.1, 0.9],
            },
        }
    )
    nominal, twin = nominal_of(rig, PATH), rig_from_file(rig, "rig.yaml")
    assert nominal.plant == twin.plant
    assert nominal.pump == twin.pump
    assert isinstance(nominal.pump.deflation, Orifice)
    assert (nominal.strength, nominal.free_damping_scale) == (twin.pump_strength, 4.0)


def test_creep_that_grows_is_not_searched_from() -> None:
    rig = Rig.model_validate(
        {"actuator": {"lambda1_per_s": -0.1047, "lambda2_N_per_m": -14.98, "lambda3": -1.854}}
    )
    assert nominal_of(rig, PATH).plant.creep_rates == Nominal().plant.creep_rates
    with pytest.raises(BadInputError, match=r"actuator\.mass_g"):
        nominal_of(Rig.model_validate({"actuator": {"mass_g": 16.6}}), PATH)


def test_what_is_written_is_what_the_simulation_gets(found: Identified, tmp_path: Path) -> None:
    before = Rig.model_validate({"actuator": {"mass_kg": 0.0166}})
    sections = sections_from(found, before, PATH)
    path = tmp_path / "rig.yaml"
    write_rig(path, with_sections(before, sections), {})
    twin = rig_from_file(read_rig(path), str(path))
    values = found.solution.values
    assert twin.plant.stiffness_scale == pytest.approx(values["stiffness_scale"])
    assert twin.free_damping_scale == pytest.approx(values["damping_scale_free_swing"])
    assert twin.pump.lag_s == pytest.approx(values["lag_s"])
    assert twin.pump_strength[1] == pytest.approx(values["strength2"])
    assert twin.pump.delay_ticks == 2
    again = nominal_of(read_rig(path), path)
    assert coefficients(again.plant) == coefficients(twin.plant)
    plain = plain_section(sections["actuator"])
    assert list(plain)[-1] in ("remarks", "advice")
    assert plain["sigma"]["lambda1_per_s"] > 0.0


def test_springs_of_an_actuator_are_two_bellows() -> None:
    eps = np.linspace(0.002, 0.026, 10)
    fits, best = fit_stiffness("w", eps, 2.0 * (47.7 + 1092.9 * eps) * eps)
    section = stiffness_section(fits[best], True, Rig(), PATH)
    assert section.k0_N_per_m == pytest.approx(47.7)
    assert section.k1_N_per_m2 == pytest.approx(1092.9)
    whole = stiffness_section(fits[best], False, Rig(), PATH)
    assert whole.k0_N_per_m == pytest.approx(95.4)

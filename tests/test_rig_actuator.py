"""The schemas of `actuator` and `pump`: what a file may say, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import BadInputError
from calib.rig import Rig
from calib.rig_actuator import Actuator, PumpSection, section_of

PATH = Path("rig.yaml")


def test_sections_of_a_file_are_read() -> None:
    rig = Rig.model_validate(
        {"actuator": {"mass_kg": 0.02, "sigma": {"mass_kg": 1e-4}}, "pump": {"delay_ticks": 3}}
    )
    assert section_of(rig, "actuator", Actuator, PATH).mass_kg == 0.02
    assert section_of(rig, "pump", PumpSection, PATH).delay_ticks == 3
    assert section_of(Rig(), "pump", PumpSection, PATH) == PumpSection()


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"actuator": {"mass_g": 16.6}}, "actuator.mass_g is not a key that is known here"),
        ({"actuator": {"mass_kg": "heavy"}}, "actuator.mass_kg is 'heavy', expected a number"),
        ({"actuator": 3}, "actuator is 3, expected keys with values"),
        ({"actuator": {"mass_kg": -1.0}}, "actuator.mass_kg is -1.0"),
    ],
)
def test_what_is_wrong_is_named(section: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError) as error:
        section_of(Rig.model_validate(section), "actuator", Actuator, PATH)
    assert words in str(error.value)


def test_ticks_are_whole() -> None:
    with pytest.raises(BadInputError, match="whole number of ticks"):
        section_of(Rig.model_validate({"pump": {"delay_ticks": 1.5}}), "pump", PumpSection, PATH)

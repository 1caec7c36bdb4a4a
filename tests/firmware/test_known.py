"""Values by key: sections that are models, sections that are carried along, lists, and what is refused."""

from __future__ import annotations

import pytest
from firmware_rigs import rig

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.firmware.constants import Known


def test_models_mappings_and_lists_are_asked_alike() -> None:
    known = Known(rig("full"), "rig.yaml")
    assert known.number("orientation_filter.Kp_per_s", 3.0) == 2.2
    assert known.number("actuator.bellows_radius_m", 0.0126) == 0.0131
    assert known.numbers("lowpass.sections.0.b", (), 3, 3)[0] > 0.0
    assert known.told() == ""


def test_what_is_missing_takes_its_default_and_is_told_once() -> None:
    known = Known(Rig(), "rig.yaml")
    assert known.number("actuator.bellows_radius_m", 0.0126) == 0.0126
    assert known.choice("controller.orientation.sign", 1, (1, -1)) == 1
    assert known.numbers("lowpass.sections.7.b", (1.0,), 1, 3) == (1.0,)
    told = known.told()
    assert "actuator.bellows_radius_m" in told
    assert "controller.orientation.sign" in told
    assert known.told() == ""


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("wide", r"rig\.yaml: actuator\.bellows_radius_m is 'wide', expected a number"),
        (True, r"is True, expected a number"),
        (float("nan"), r"is nan, expected a number"),
        (12.6, r"is 12\.6, expected 0\.001 to 0\.2 for the firmware"),
    ],
)
def test_other_values_are_refused_by_key(value: object, sentence: str) -> None:
    known = Known(Rig.model_validate({"actuator": {"bellows_radius_m": value}}), "rig.yaml")
    with pytest.raises(BadInputError, match=sentence):
        known.number("actuator.bellows_radius_m", 0.0126, 1e-3, 0.2)


def test_choices_and_lists_are_refused_by_key() -> None:
    known = Known(Rig.model_validate({"twin": {"sign": 2, "row": [1.0, "x"]}}), "rig.yaml")
    with pytest.raises(BadInputError, match=r"twin\.sign is 2, expected 1 or -1"):
        known.choice("twin.sign", 1, (1, -1))
    with pytest.raises(BadInputError, match=r"twin\.row is .*, expected 1 to 3 numbers"):
        known.numbers("twin.row", (), 1, 3)

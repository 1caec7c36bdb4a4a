"""rig.yaml: round trips, the same bytes, sentences for what is wrong in it, and two of them side by side."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from calib.core.errors import BadInputError
from calib.core.options import options_of
from calib.core.result import CovarianceTable, identity, section_json
from calib.core.rig import KINDS, Geometry, Rig, kind_of
from calib.core.schema import validated
from calib.core.stage import Files
from calib.runner.work import carry_out
from calib.stages import stage
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import Orifice, static_force_N
from calib.stages.arm.model import Assembly
from calib.stages.camera.section import Camera

CAMERA = Camera(
    model="radial2",
    image_size_px=[316, 208],
    fx_px=273.4,
    fy_px=272.6,
    cx_px=160.7,
    cy_px=101.9,
    sigma={"fx_px": 0.4, "fy_px": None},
    verdict="ok",
)


def test_round_trip_and_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    Rig(camera=CAMERA).save(path, {"camera": {"b.png": "2", "a.png": "1"}})
    first = path.read_bytes()
    again = Rig.load(path)
    assert again.camera == CAMERA
    again.save(path, {"camera": {"a.png": "1", "b.png": "2"}})
    assert path.read_bytes() == first
    assert identity(CAMERA) == identity(again.camera or CAMERA)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("fx_px: 273.4", "fx_px: 273px"), r"camera\.fx_px is '273px', expected a number"),
        (("fx_px: 273.4", "fx_mm: 3.0"), r"camera\.fx_px is missing"),
        (("[316, 208]", "[316]"), r"camera\.image_size_px"),
        (("fx_px: 273.4", "fx_px: 273e0"), r"camera\.fx_px is '273e0', expected a number \(without quotes"),
        (("[316, 208]", "[316, 208.0]"), r"camera\.image_size_px\.1 is 208\.0, expected a whole number"),
        (("verdict: ok", "verdict: 1"), r"camera\.verdict is 1, expected 'ok'"),
        (("fx_px: 273.4", f"fx_px: {'9' * 390}"), r"camera\.fx_px is 9+\.\.\., expected at most 1e\+40"),
    ],
)
def test_wrong_values_name_file_key_value_and_what_was_expected(
    tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    path = tmp_path / "rig.yaml"
    text = Rig(camera=CAMERA).text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(BadInputError, match=says) as caught:
        Rig.load(path)
    assert "rig.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "compose.yaml"
    path.write_text("services: {web: {image: nginx}}\n")
    for wrong in (Rig.load, Rig(camera=CAMERA).save):
        with pytest.raises(BadInputError, match=r"is not a rig\.yaml: it has 'services'"):
            wrong(path)
    assert path.read_text().startswith("services")


def test_a_link_to_no_file_is_an_empty_rig(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").symlink_to("gone.yaml")
    assert Rig.load(tmp_path / "rig.yaml", missing_ok=True) == Rig()


K = np.array([[273.4, 0.0, 160.7], [0.0, 272.6, 101.9], [0.0, 0.0, 1.0]])
T_M = np.array([0.004, -0.061, 0.272])


def _rig(path: Path, shift_m: float = 0.0, sigma_mm: float | None = 0.01, **camera: Any) -> Rig:
    t = T_M + np.array([shift_m, 0.0, 0.0])
    A = K @ np.column_stack([np.eye(3)[:, :2], t])
    told: dict[str, Any] = {
        "camera": {
            "model": "radial2", "image_size_px": [316, 208], "fx_px": 273.4, "fy_px": 272.6, "cx_px": 160.7,
            "cy_px": 101.9, "distortion": {"k1": -0.22, "k2": 0.549}, "views": 17, "verdict": "ok",
            "sigma": {"fx_px": 0.03, "k1": 0.0003}, **camera,
        },
        "plane": {
            "R_CW": np.eye(3).tolist(), "t_CW_m": t.tolist(), "A_px_per_m": A.tolist(),
            "A_inverse": np.linalg.inv(A).tolist(), "rms_px": 0.01, "rms_mm": 0.01, "verdict": "ok",
            "sigma": {"tx_m": 1e-5}, "sigma_marker_mm": {"calibration_max": sigma_mm},
        },
        "geometry": {"workspace_m": [-0.05, 0.05, 0.05, 0.1]},
    }  # fmt: skip
    return Rig.of(told, path)


def test_a_rig_and_itself(tmp_path: Path) -> None:
    rig = _rig(tmp_path / "a.yaml")
    found = rig.diff(rig)
    assert found.changes == () and not found.significant
    assert found.plane is not None and found.plane.largest_mm < 1e-6
    assert found.compared > 20
    # What a notebook shows of it.
    words = [line.split() for line in repr(rig).splitlines()]
    assert ["geometry", "stated"] in words and ["plane", "ok"] in words
    assert "<td>plane</td><td>ok</td>" in rig._repr_html_()


def test_difference_in_standard_deviations_of_both(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml")
    b = _rig(
        tmp_path / "b.yaml", fx_px=273.4 + 0.2, sigma={"fx_px": 0.04, "k1": 0.0003}, verdict="poor", views=9
    )
    found = a.diff(b)
    (change,) = found.changes
    assert change.name == "fx_px" and change.sigma == pytest.approx(0.05)
    assert change.sigmas == pytest.approx(4.0) and change.significant and found.significant
    assert found.verdicts == ({"section": "camera", "before": "ok", "after": "poor"},)


def test_shift_of_the_plane_is_read_in_millimetres(tmp_path: Path) -> None:
    found = _rig(tmp_path / "a.yaml").diff(_rig(tmp_path / "b.yaml", shift_m=2e-4))
    plane = found.plane
    assert plane is not None
    assert plane.mean_mm == pytest.approx(0.2, rel=1e-6) and plane.largest_mm == pytest.approx(0.2, rel=1e-6)
    assert plane.sigma_mm == pytest.approx(math.hypot(0.01, 0.01)) and plane.significant


def test_without_error_bars_nothing_is_called_significant(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml", sigma_mm=None, sigma={})
    found = a.diff(_rig(tmp_path / "b.yaml", shift_m=1e-3, sigma_mm=None, sigma={}, fx_px=280.0))
    assert not found.significant
    assert found.plane is not None and found.plane.significant is None


def test_all_of_a_rig_is_compared(tmp_path: Path) -> None:
    """Choices, deviations, what a person states and single keys, not the constants alone."""
    a, b = _rig(tmp_path / "a.yaml"), _rig(tmp_path / "b.yaml", model="brown5", sigma={"fx_px": 0.06})
    assert b.geometry is not None
    b.geometry.marker_offset_m = 0.02
    found = a.diff(b)
    assert [(c.section, c.name) for c in found.changes] == [("geometry", "marker_offset_m")]
    assert found.others == {"camera": ("model", "sigma")}
    assert a.diff(a).others == {}


def _places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in parts:
        yield from _places(part, (*place, key))
    if isinstance(value, float):
        yield place


@pytest.mark.few(1)
@pytest.mark.parametrize("value", [math.nan, 1e300])
def test_no_number_of_a_whole_rig_may_be_endless(project_root: Path, value: float) -> None:
    whole = yaml.safe_load((project_root / "tests" / "goldens" / "twin_run" / "rig.yaml").read_text())
    del whole["schema"], whole["provenance"]
    # One of each list will do.
    alike = {tuple("#" if isinstance(key, int) else key for key in place): place for place in _places(whole)}
    assert len(alike) > 200
    for section, *keys, last in alike.values():
        part = whole[section]
        for key in keys:
            part = part[key]
        kept, part[last] = part[last], value
        with pytest.raises(BadInputError, match=rf"rig\.yaml: {section}\."):
            validated(kind_of(section), whole[section], "rig.yaml", section)
        part[last] = kept


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e300, -1.0])
def test_what_cannot_be_read_back_is_not_written(tmp_path: Path, value: float) -> None:
    path = tmp_path / "rig.yaml"
    rig = _rig(path)
    rig.save(path)
    before = path.read_bytes()
    assert rig.camera is not None
    rig.camera.fx_px = value
    with pytest.raises(BadInputError, match=r"rig\.yaml: camera\.fx_px is "):
        rig.save(path)
    assert path.read_bytes() == before


def test_a_value_in_force_is_known_or_estimated_or_nominal() -> None:
    rig = Rig.of(
        {
            "schema": 2,
            "known": {
                "actuator": {
                    "mass_kg": 0.02, "bending_N_per_rad2": 0.2, "sigma": {"bending_N_per_rad2": 0.1},
                },
                "pump": {"strength": [1.0, 0.9]},
            },
            "actuator": {
                "mass_kg": 0.03, "bending_N_per_rad2": 0.25, "stiffness_scale": 1.1, "k0_N_per_m": 80.0,
                "damping_scale_free_swing": 3.0, "damping_scale_pumps_connected": 12.0, "lambda1_per_s": 2.0,
                "gravity_mps2": [0, 9.81], "verdict": "poor",
            },
            "pump": {
                "lag_s": 0.5, "delay_ticks": 3, "deflation": "orifice", "laminar_s": 0.9, "verdict": "ok",
                "elongation_mm": [-0.1493, 3.756, -25.87, 54.13],
            },
        },
        "rig.yaml",
    )  # fmt: skip
    plant, nominal = rig.plant, Plant()
    assert plant.mass_kg == 0.02  # stated
    assert plant.bending_N_per_rad2 == 0.25  # estimated with the prior
    assert (plant.stiffness_scale, plant.damping_scale) == (1.1, 12.0)
    assert plant.inertia_kgm2 == nominal.inertia_kgm2
    assert plant.stiffness.padded == (80.0, 1092.9, 0.0, 0.0)
    assert plant.creep_rates == (2.0, *nominal.creep_rates[1:])
    assert plant.gravity_mps2 == (0.0, 9.81)
    machine = rig.machine
    assert machine.plant == plant and machine.free_plant.damping_scale == 3.0
    assert (machine.pump.lag_s, machine.pump.delay_ticks, machine.strength) == (0.5, 3, (1.0, 0.9))
    assert machine.pump.deflation == Orifice(0.9)
    # A measured elongation is reached with the rig's own springs.
    eps = 0.0265636
    assert static_force_N(machine.pump, np.array(255.0)) == pytest.approx((80 + 1092.9 * eps) * eps, rel=1e-4)
    assert Rig().machine == Machine()


def test_a_file_of_schema_1_is_parted() -> None:
    old = {
        "actuator": {
            "mass_kg": 0.018, "stiffness_scale": 1.08, "lambda1_per_s": 3.1, "lambda2_N_per_m": 9.5,
            "lambda3": -1.0, "sigma": {"stiffness_scale": 0.002, "lambda1_per_s": 0.2}, "verdict": "ok",
        },
        "pump": {"lag_s": 0.6, "deflation": "orifice"},
    }  # fmt: skip
    rig = Rig.of(old, "rig.yaml")
    assert rig.schema == 1 and rig.pump is None
    assert rig.known is not None and rig.actuator is not None
    assert rig.values()["known"] == {"actuator": {"mass_kg": 0.018}, "pump": old["pump"]}
    assert rig.actuator.mass_kg is None
    assert (rig.actuator.stiffness_scale, rig.actuator.lambda3) == (1.08, -1.0)
    again = Rig.of(yaml.safe_load(rig.text()), "rig.yaml")
    assert again == rig and again.schema == 2 and again.text() == rig.text()
    # A verb has written the springs, whose section has no verdict; the provenance says so.
    springs = {"k0_N_per_m": 48.0, "k1_N_per_m2": 0.0, "sigma": {"k0_N_per_m": 0.1}}
    rig = Rig.of({"actuator": springs, "provenance": {"inputs": {"actuator": {"w.csv": "1"}}}}, "rig.yaml")
    assert rig.known is None and rig.actuator is not None and rig.actuator.k0_N_per_m == 48.0


def _values(part: dict[str, Any], whole: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Values that a JSON schema allows, within a range that every range overlaps."""
    if "$ref" in part:
        return _values(whole["$defs"][part["$ref"].rpartition("/")[2]], whole)
    if "anyOf" in part:
        return st.one_of([_values(one, whole) for one in part["anyOf"]])
    if "enum" in part or "const" in part:
        return st.sampled_from(part.get("enum", [part.get("const")]))
    if "pattern" in part:
        return st.sampled_from(re.findall(r"\w+", part["pattern"]))
    kind = part.get("type")
    if kind == "object" and "properties" in part:
        needed = {key: _values(one, whole) for key, one in part["properties"].items()}
        return st.fixed_dictionaries(
            {key: one for key, one in needed.items() if key in part.get("required", ())},
            optional={key: one for key, one in needed.items() if key not in part.get("required", ())},
        )
    if kind == "object":
        names = st.sampled_from(["a", "b c", "view 1.png"])
        return st.dictionaries(names, _values(part.get("additionalProperties", {}), whole), max_size=2)
    if kind == "array":
        low = part.get("minItems", 0)
        return st.lists(_values(part["items"], whole), min_size=low, max_size=part.get("maxItems", low + 2))
    least = part.get("minimum", part.get("exclusiveMinimum", -1e6))
    most = part.get("maximum", part.get("exclusiveMaximum", 1e6))
    return {
        "number": st.floats(
            least, most, exclude_min="exclusiveMinimum" in part, exclude_max="exclusiveMaximum" in part,
            allow_subnormal=False,
        ),
        "integer": st.integers(int(least), int(most)),
        "string": st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=8),
        "boolean": st.booleans(),
        "null": st.none(),
    }[kind or "null"]  # fmt: skip


_ONE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
ARM = Assembly(("valve", "segment", "chord"))
CONSISTENT: dict[str, dict[str, Any]] = {
    "camera": {"model": "rational8"},
    "plane": {"R_CW": _ONE, "t_CW_m": [0.0, 0.0, 1.0], "A_px_per_m": _ONE, "A_inverse": _ONE},
    "controller": {
        "feedforward": {
            "rest_length_m": 0.065,
            "bellows_radius_m": 0.0126,
            "stiffness_N_per_m": [48.0, 1092.9, 0.0, 0.0],
            "bending_N_per_rad2": 0.2,
            "strength": [1.0, 0.9],
            "force_pwm": [[0.0, 128.0], [3.5, 255.0]],
        },
    },
    "arm": {"parts": list(ARM.parts), "parameters": dict.fromkeys(ARM.names, 1.0)},
    "lowpass": {"order": 1, "sections": [{"b": [0.5, 0.5, 0.0], "a": [1.0, 0.0, 0.0]}]},
}
"""Values that a section's own rules tie together."""


@pytest.mark.parametrize("name", [name for name in KINDS if name != "provenance"])
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(data=st.data())
def test_every_section_comes_back_from_the_file_as_it_was(name: str, data: st.DataObject) -> None:
    kind = kind_of(name)
    schema = kind.model_json_schema()
    values = data.draw(_values(schema, schema))
    values = {key: value for key, value in values.items() if key not in ("sigma", "covariance")}
    values |= CONSISTENT.get(name, {})
    try:
        section = kind.model_validate(values)
    except ValidationError:
        assume(False)
    text = Rig().with_sections({name: section}).text()
    document = yaml.safe_load(text)
    back = validated(kind, document["actuator" if name == "arm" else name], "rig.yaml", name)
    assert section_json(back) == section_json(section)
    assert Rig().with_sections({name: back}).text() == text


def _floats(schema: Any) -> Iterator[dict[str, Any]]:
    """Every schema of a float inside of a pydantic core schema."""
    if isinstance(schema, dict):
        if schema.get("type") == "float":
            yield schema
        for part in schema.values():
            yield from _floats(part)
    elif isinstance(schema, list | tuple):
        for part in schema:
            yield from _floats(part)


@pytest.mark.parametrize("name", KINDS)
def test_every_number_is_finite(name: str) -> None:
    kind = kind_of(name)
    kind.model_rebuild(force=True)
    numbers = list(_floats(kind.__pydantic_core_schema__))
    assert all(one.get("allow_inf_nan") is False for one in numbers)
    assert numbers or name == "provenance"


@pytest.mark.parametrize(
    "values",
    [
        [[1.0, 0.2], [0.1, 1.0]],
        [[1.0, 1.2], [1.2, 1.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[0.0, 0.1], [0.1, 1.0]],
        [[1.0, 0.0]],
        [[1.0, math.nan], [math.nan, 1.0]],
    ],
)
def test_what_is_no_covariance_is_refused(values: list[list[float]]) -> None:
    with pytest.raises(ValidationError):
        CovarianceTable(order=["a", "b"], values=values)


def test_sections_that_follow_from_an_earlier_one_are_told(tmp_path: Path, project_root: Path) -> None:
    """Once the plane is another one all that saw through it is of the earlier one."""
    path = tmp_path / "rig.yaml"
    path.write_text((project_root / "tests/goldens/twin_run/rig.yaml").read_text(encoding="utf-8"))
    rig = Rig.load(path)
    through = rig.identities("camera", "plane", "align")
    inputs = dict.fromkeys(("lens", "lowpass", "orientation_filter", "actuator", "pump"), through)
    of_align = rig.identities("camera", "plane")
    rig.save(path, {**inputs, "align": of_align, "plane": rig.identities("camera"), "controller": {}})
    rig = Rig.load(path)
    assert rig.outdated() == []
    assert rig.plane is not None
    rig.plane.t_CW_m[2] += 1e-3
    told = rig.outdated()
    for name, verb in (("align", "align"), ("actuator", "identify"), ("lens", "distortion")):
        assert f"{name} in the file is of an earlier plane; run calib {verb} again" in told
    assert not any(one.startswith(("imu", "camera")) for one in told)
    assert [one for one in told if one.startswith("plane")] == [CHANGED_PLANE]


CHANGED_PLANE = (
    "plane in the file was changed after calib had written it, so that its verdict is of other values; "
    "run calib extrinsics again"
)


@pytest.mark.few(0, 4)
@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("camera", "\n  fx_px: 2", "\n  fx_px: 3"),
        ("lens", "radial: [", "radial: [1"),
        ("align", "gyro_scale: 0.0", "gyro_scale: 0.2"),
        ("pump", "verdict: unidentifiable", "verdict: ok"),
        ("controller", "Kp_pwm_per_rad: 3", "Kp_pwm_per_rad: 3000"),
    ],
)
def test_a_section_that_a_person_changed_is_told_until_its_verb_has_run_again(
    tmp_path: Path, project_root: Path, name: str, old: str, new: str
) -> None:
    path = tmp_path / "rig.yaml"
    Rig.load(project_root / "tests/goldens/twin_run/rig.yaml").save(path)
    whole = path.read_text(encoding="utf-8")
    assert not any("was changed" in one for one in Rig.load(path).outdated())
    before, after = whole.split(f"\n{name}:", 1)
    path.write_text(f"{before}\n{name}:{after.replace(old, new, 1)}", encoding="utf-8")
    Rig.load(path).save(path)
    rig = Rig.load(path)
    told = [one for one in rig.outdated() if "was changed" in one]
    assert [one.split(" in the file")[0] for one in told] == [name]
    assert told[0] in rig.doubts([name]) and not rig.outdated(["imu"])
    fresh = type(getattr(rig, name)).model_validate(section_json(getattr(rig, name)))
    rig.with_sections({name: fresh}).save(path)
    assert not any("was changed" in one for one in Rig.load(path).outdated())


def test_what_a_person_states_later_is_told(project_root: Path) -> None:
    """Stated, changed and taken back; but nothing, or the defaults, state nothing."""
    rig = Rig.load(project_root / "tests/goldens/twin_run/rig.yaml")
    rig.provenance.inputs = {"align": {"geometry": ""}, "actuator": {"known": ""}}
    for nothing in ({}, {"marker_offset_m": 0.015}):
        rig.geometry = validated(kind_of("geometry"), nothing, "rig.yaml", "geometry")
        rig.known = validated(kind_of("known"), {"actuator": {}} if nothing else {}, "rig.yaml", "known")
        assert rig.outdated() == []
    rig.geometry = validated(kind_of("geometry"), {"marker_offset_m": 0.016}, "rig.yaml", "geometry")
    assert rig.outdated() == ["align in the file is older than geometry; run calib align again"]
    rig.provenance.inputs["align"] = rig.identities("geometry")
    assert rig.outdated() == []
    rig.geometry = None
    assert rig.outdated() == ["align in the file is older than geometry; run calib align again"]


def test_what_follows_from_a_poor_section_is_no_better(project_root: Path) -> None:
    rig = Rig.load(project_root / "tests/goldens/twin_run/rig.yaml")
    assert rig.camera is not None and rig.actuator is not None
    rig.provenance.inputs.clear()
    assert rig.doubts(["camera", "plane", "view01.png"]) == []
    rig.camera.doubt(["the board was bent"])
    assert rig.camera.verdict.word == "poor" and rig.camera.verdict.reasons == ["the board was bent"]
    assert rig.doubts(["camera", "actuator"])[0] == (
        "camera is poor, actuator is unidentifiable; what follows from it is no better"
    )
    rig.actuator.doubt(["no better"])
    assert rig.actuator.verdict.word == "unidentifiable"


@pytest.mark.parametrize("key", ["fx_px", "t_CW_m"])
def test_a_plane_that_its_own_pose_does_not_give_is_refused(project_root: Path, key: str) -> None:
    rig = Rig.load(project_root / "tests/goldens/shipped/rig.yaml")
    rig.provenance.inputs.clear()
    assert rig.camera is not None and rig.plane is not None
    assert rig.current_plane("rig.yaml") is rig.plane
    if key == "fx_px":
        rig.camera.fx_px *= 1.01
    else:
        rig.plane.t_CW_m[0] += 1e-3
    with pytest.raises(BadInputError, match=r"rig\.yaml: plane\.A_px_per_m is .* px off from what camera"):
        rig.current_plane("rig.yaml")


def test_what_was_written_while_a_verb_worked_stays(tmp_path: Path) -> None:
    """By a person or by another verb; the file that this one began with is older."""
    path, made = tmp_path / "rig.yaml", stage("lowpass")

    def meanwhile(*given: Any) -> Any:
        Rig(geometry=Geometry(marker_offset_m=0.02)).save(path)
        return made.solve(*given)

    options = options_of(made.options, {"cutoff_hz": "2Hz"})
    carry_out(replace(made, solve=meanwhile), Files(rig_path=path), options, path)
    both = Rig.load(path)
    assert both.lowpass is not None and both.geometry == Geometry(marker_offset_m=0.02)

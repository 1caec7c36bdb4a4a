"""rig.yaml: the one file that holds what was learnt about a rig."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from calib import __version__
from calib.core.errors import BadInputError
from calib.core.files import one_line, read_yaml_mapping, shown, write_atomically
from calib.core.result import Section, identity, section_json

# ----------------------------------------------------------------------
# rig.yaml: the one file that holds what was learnt about a rig.
#
# Each verb reads the sections that it needs and writes its own. Every key carries its unit, every
# estimated value has its standard deviation under `sigma`, and `provenance` names the inputs by their
# SHA-256, so that the same inputs give the same bytes. A standard deviation that the data do not
# bound is null.

if TYPE_CHECKING:
    from calib.stages.align.section import Align
    from calib.stages.camera.section import Camera, Lens, Plane
    from calib.stages.control.section import Controller
    from calib.stages.estimator.section import Estimator
    from calib.stages.imu.section import Imu, ImuIntrinsics, OrientationFilter
    from calib.stages.lowpass.section import LowPass
else:
    # Their schemas take a tenth of a second to build and are loaded where a file has these sections.
    Align = Camera = Controller = Estimator = Imu = ImuIntrinsics = Any
    Lens = LowPass = OrientationFilter = Plane = Any


SECTIONS = (
    "geometry",
    "camera",
    "plane",
    "lens",
    "imu",
    "imu_intrinsics",
    "orientation_filter",
    "lowpass",
    "align",
    "actuator",
    "pump",
    "estimator",
    "controller",
    "twin",
    "provenance",
)
"""Sections in the order of the file."""

_LATER = {
    "camera": ("calib.stages.camera.section", "Camera"),
    "plane": ("calib.stages.camera.section", "Plane"),
    "lens": ("calib.stages.camera.section", "Lens"),
    "imu": ("calib.stages.imu.section", "Imu"),
    "imu_intrinsics": ("calib.stages.imu.section", "ImuIntrinsics"),
    "orientation_filter": ("calib.stages.imu.section", "OrientationFilter"),
    "lowpass": ("calib.stages.lowpass.section", "LowPass"),
    "align": ("calib.stages.align.section", "Align"),
    "estimator": ("calib.stages.estimator.section", "Estimator"),
    "controller": ("calib.stages.control.section", "Controller"),
}
"""Sections with modules of their own, and what they are there."""

Metres = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False, strict=True)]


class Geometry(Section):
    """What a person knows of the rig. Defaults: the nominal actuator."""

    workspace_m: Annotated[list[Metres], Field(min_length=4, max_length=4)] = [-0.06, 0.04, 0.06, 0.11]
    """Where the marker can be, world metres: least x, least y, greatest x, greatest y."""

    marker_offset_m: Metres = 0.015
    marker_offset_sigma_m: Annotated[Metres, Field(gt=0.0)] = 5e-5
    """Marker beyond the head along its tangent (A.1), and how well a drawing or a caliper tells it."""

    @field_validator("workspace_m")
    @classmethod
    def _ordered(cls, value: list[float]) -> list[float]:
        if value[0] >= value[2] or value[1] >= value[3]:
            raise ValueError("expected [least x, least y, greatest x, greatest y]")
        return value


class Provenance(Section):
    """Version and the SHA-256 of each input by section and name."""

    version: str = __version__
    inputs: dict[str, dict[str, str]] = {}


class Rig(BaseModel):
    """The whole file. Sections of later versions are kept as they are."""

    model_config = ConfigDict(extra="allow", defer_build=True)

    geometry: Geometry | None = None
    camera: Camera | None = None
    plane: Plane | None = None
    lens: Lens | None = None
    imu: Imu | None = None
    imu_intrinsics: ImuIntrinsics | None = None
    orientation_filter: OrientationFilter | None = None
    lowpass: LowPass | None = None
    align: Align | None = None
    estimator: Estimator | None = None
    controller: Controller | None = None
    provenance: Provenance = Provenance()

    @field_validator(*_LATER, mode="plain")
    @classmethod
    def _loaded(cls, value: Any, info: ValidationInfo) -> BaseModel | None:
        module, name = _LATER[str(info.field_name)]
        kind: type[BaseModel] = getattr(importlib.import_module(module), name)
        return None if value is None else kind.model_validate(value)

    def current_plane(self, source: Path | str) -> Plane | None:
        """The plane; `BadInputError` where it was calibrated with another camera than the rig's."""
        if self.plane is None or self.camera is None:
            return None
        known = self.provenance.inputs.get("plane", {}).get("camera")
        if known is not None and known != identity(self.camera):
            raise BadInputError(
                f"{shown(source)}: plane was calibrated with another camera than the one in camera; "
                "run calib extrinsics again"
            )
        return self.plane

    def outdated(self) -> list[str]:
        """Sentences for sections that were computed from others than the rig now has."""
        now = {
            name: identity(section)
            for name, section in (("camera", self.camera), ("plane", self.plane))
            if section is not None
        }
        sentences = []
        for name, verb in (("plane", "extrinsics"), ("lens", "distortion")):
            known = self.provenance.inputs.get(name, {})
            changed = [other for other in now if other in known and known[other] != now[other]]
            if getattr(self, name) is not None and changed:
                sentences.append(
                    f"{name} in the file is of an earlier {' and '.join(changed)}; run calib {verb} again"
                )
        return sentences


_EXPECTED = {
    "bool_type": "true or false",
    "dict_type": "keys with values",
    "finite_number": "a finite number",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "list_type": "a list",
    "model_attributes_type": "keys with values",
    "model_type": "keys with values",
    "string_type": "text",
}
"""What pydantic's kinds of error ask for, in words."""


def validation_sentence(path: Path, error: ValidationError) -> str:
    """One sentence for the first thing that is wrong: file, key, value, and what was expected."""
    first = error.errors()[0]
    kind, value = first["type"], first.get("input")
    key = one_line(".".join(str(part) for part in first["loc"]))
    if kind == "missing":
        return f"{shown(path)}: {key} is missing"
    if kind == "extra_forbidden":
        return f"{shown(path)}: {key} is not a key that is known here"
    message = first["msg"]
    expected = message[0].lower() + message[1:]
    expected = (
        expected.removeprefix("value error, ").removeprefix("input should be ").removeprefix("expected ")
    )
    expected = _EXPECTED.get(kind, expected)
    if kind in ("too_short", "too_long"):
        limit = first["ctx"].get("min_length", first["ctx"].get("max_length"))
        expected = f"{limit} values"
    hint = ""
    if isinstance(value, str) and kind in ("float_type", "int_type") and _reads_as_number(value):
        hint = " (without quotes, and in YAML an exponent needs a point and a sign, as 2.0e-2)"
    return f"{shown(path)}: {key} is {_short(value)}, expected {expected}{hint}"


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _short(value: Any) -> str:
    text = one_line(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def read_rig(path: Path) -> Rig:
    """The rig in this file, an empty one where there is no file.

    Raises `BadInputError`, also for a file of another kind (it would be written over) and for values
    that contradict each other.
    """
    if not path.exists():
        return Rig()
    document = read_yaml_mapping(path)
    if not any(name in document for name in SECTIONS):
        found = ", ".join(_short(name) for name in list(document)[:3]) or "nothing"
        raise BadInputError(
            f"{shown(path)}: is not a rig.yaml: it has {found}, expected sections as camera or provenance"
        )
    try:
        rig = Rig.model_validate(document)
    except ValidationError as error:
        raise BadInputError(validation_sentence(path, error)) from error
    if rig.camera is not None:
        _check_camera(path, rig.camera)
    if rig.plane is not None:
        _check_plane(path, rig.plane)
    return rig


def _check_camera(path: Path, camera: Camera) -> None:
    from calib.stages.camera.model import COEFFICIENTS, MODELS

    for name in COEFFICIENTS:
        value = getattr(camera.distortion, name)
        if value != 0.0 and name not in MODELS[camera.model]:
            raise BadInputError(
                f"{shown(path)}: camera.distortion.{name} is {value:g}, but {camera.model} has no {name}"
            )


def _check_plane(path: Path, plane: Plane) -> None:
    import numpy as np

    R, A, A_inverse = np.array(plane.R_CW), np.array(plane.A_px_per_m), np.array(plane.A_inverse)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        raise BadInputError(f"{shown(path)}: plane.R_CW is not a rotation")
    if not any(plane.t_CW_m):
        raise BadInputError(f"{shown(path)}: plane.t_CW_m is zero, expected the way from camera to plane")
    if not np.allclose(A_inverse @ A, np.eye(3), atol=1e-6):
        raise BadInputError(f"{shown(path)}: plane.A_inverse is not the inverse of plane.A_px_per_m")


def _plain(rig: Rig) -> dict[str, Any]:
    extra = rig.model_extra or {}
    out: dict[str, Any] = {}
    for name in SECTIONS:
        section = getattr(rig, name, None)
        if isinstance(section, BaseModel):
            out[name] = section_json(section)
        elif name in extra:
            out[name] = extra[name]
    for name, section in extra.items():
        out.setdefault(name, section)
    # The provenance comes last.
    out["provenance"] = out.pop("provenance")
    return out


def rig_text(rig: Rig) -> str:
    """The file's text; the same rig gives the same text."""
    return yaml.safe_dump(
        _plain(rig), sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )


def write_rig(path: Path, rig: Rig, inputs: dict[str, dict[str, str]]) -> Rig:
    """Replace the file atomically; `inputs` holds the SHA-256 of each input by section and name."""
    merged = {**rig.provenance.inputs, **inputs}
    ordered = {section: dict(sorted(merged[section].items())) for section in sorted(merged)}
    rig = rig.model_copy(update={"provenance": Provenance(inputs=ordered)})
    write_atomically(path, rig_text(rig))
    return rig

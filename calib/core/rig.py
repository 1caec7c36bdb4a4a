"""rig.yaml: the one file that holds what was learnt about a rig."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from calib import __version__
from calib.core.errors import BadInputError
from calib.core.files import file_sha256, one_line, read_yaml_mapping, sha256, shown, write_atomically

# ----------------------------------------------------------------------
# What the sections of rig.yaml are made of: kinds of numbers, short lists, covariance matrices.

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=0, strict=True)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Row3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
PerAxis = Annotated[list[Number | None], Field(min_length=3, max_length=3)]
"""x, y, z; null for what was not measured or cannot be told."""
Sizes = Annotated[list[NotNegative | None], Field(min_length=3, max_length=3)]
"""As `PerAxis`, of what is not negative."""


class Section(BaseModel):
    """A section or a part of one: keys that it does not know are refused."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


class CovarianceTable(Section):
    """A covariance matrix with the names of its rows."""

    order: list[str]
    values: list[list[Number]]

    @model_validator(mode="after")
    def _square(self) -> CovarianceTable:
        if len(self.values) != len(self.order) or any(len(row) != len(self.order) for row in self.values):
            raise ValueError(f"expected {len(self.order)} rows and columns, as many as names in order")
        return self


# ----------------------------------------------------------------------
# rig.yaml: the one file that holds what was learnt about a rig.
#
# Each verb reads the sections that it needs and writes its own. Every key carries its unit, every
# estimated value has its standard deviation under `sigma`, and `provenance` names the inputs by their
# SHA-256, so that the same inputs give the same bytes. A standard deviation that the data do not
# bound is null.

if TYPE_CHECKING:
    from calib.stages.align.section import Align
    from calib.stages.control.section import Controller
    from calib.stages.estimator.section import Estimator
    from calib.stages.imu.section import Imu, ImuIntrinsics, OrientationFilter
    from calib.stages.lowpass.section import LowPass
else:
    # Their schemas take a tenth of a second to build and are loaded where a file has these sections.
    Align = Controller = Estimator = OrientationFilter = Imu = ImuIntrinsics = LowPass = Any


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
    "imu": ("calib.stages.imu.section", "Imu"),
    "imu_intrinsics": ("calib.stages.imu.section", "ImuIntrinsics"),
    "orientation_filter": ("calib.stages.imu.section", "OrientationFilter"),
    "lowpass": ("calib.stages.lowpass.section", "LowPass"),
    "align": ("calib.stages.align.section", "Align"),
    "estimator": ("calib.stages.estimator.section", "Estimator"),
    "controller": ("calib.stages.control.section", "Controller"),
}
"""Sections with modules of their own, and what they are there."""

Verdict = Annotated[str, Field(pattern="^(ok|poor|unidentifiable|inconsistent)$")]
Model = Annotated[str, Field(pattern="^(pinhole|radial2|radial3|brown5|rational8)$")]
Focal = Annotated[float, Field(ge=1e-3, le=1e7, allow_inf_nan=False, strict=True)]
Pixels = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False, strict=True)]
Coefficient = Annotated[float, Field(ge=-1e30, le=1e30, allow_inf_nan=False, strict=True)]
Metres = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False, strict=True)]
Side = Annotated[int, Field(ge=1, le=100_000, strict=True)]
Sigma = dict[str, NotNegative | None]


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


class Distortion(Section):
    """Coefficients of `calib.stages.camera.model`; absent ones are zero."""

    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    p1: Coefficient = 0.0
    p2: Coefficient = 0.0
    k3: Coefficient = 0.0
    k4: Coefficient = 0.0
    k5: Coefficient = 0.0
    k6: Coefficient = 0.0


class Camera(Section):
    """Intrinsics, what they are worth, and why."""

    model: Model
    image_size_px: Annotated[list[Side], Field(min_length=2, max_length=2)]
    fx_px: Focal
    fy_px: Focal
    skew_px: Pixels = 0.0
    cx_px: Pixels
    cy_px: Pixels
    distortion: Distortion = Distortion()
    sigma: Sigma = {}
    covariance: CovarianceTable | None = None
    rms_px: NotNegative | None = None
    mean_error_px: NotNegative | None = None
    projection_sigma_px: Sigma = {}
    views: Count = 0
    points: Count = 0
    board: str | None = None
    loss: str | None = None
    termination: str | None = None
    rejected: list[str] = []
    verdict: Verdict
    reasons: list[str] = []
    remarks: list[str] = []
    advice: list[str] = []


class Plane(Section):
    """The actuator's plane seen by the camera: A maps world metres to pixels (2.9 with K)."""

    R_CW: Matrix3
    t_CW_m: Row3
    A_px_per_m: Matrix3
    A_inverse: Matrix3
    sigma: Sigma = {}
    rms_px: NotNegative
    rms_mm: NotNegative
    sigma_marker_mm: Sigma = {}
    without_intrinsics: dict[str, Number] = {}
    pictures: Count = 0
    points: Count = 0
    orientation: str = ""
    verdict: Verdict
    reasons: list[str] = []


class InverseLens(Section):
    """The polynomial of `calib.stages.camera.lens`."""

    radial: list[Number]
    decentering_steps: Count
    max_error_px: NotNegative | None
    covered: Annotated[float, Field(ge=0, le=1)]


class Lens(Section):
    """What lens distortion does over the picture and costs on the plane."""

    kind: str
    max_px: Number
    mean_px: Number
    region_px: Annotated[list[Number], Field(min_length=4, max_length=4)]
    region_max_px: Number
    region_mean_px: Number
    region_sigma_px: Number | None = None
    monotonic: bool
    plane_max_mm: Number | None = None
    plane_mean_mm: Number | None = None
    refitted_max_mm: Number | None = None
    refitted_mean_mm: Number | None = None
    inverse: InverseLens
    verdict: Literal["negligible", "matters"]
    reasons: list[str] = []


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


def section_json(section: BaseModel) -> dict[str, Any]:
    """A section as plain values, unset optional parts left out."""
    return {
        key: value
        for key, value in section.model_dump(mode="json").items()
        if value is not None
        and value != {}
        and not (key in ("rejected", "remarks", "advice") and value == [])
    }


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


def identity(section: BaseModel) -> str:
    """SHA-256 of a section's values, to tell later whether something was computed from them."""
    return sha256(yaml.safe_dump(section_json(section), sort_keys=True).encode())


def write_rig(path: Path, rig: Rig, inputs: dict[str, dict[str, str]]) -> Rig:
    """Replace the file atomically; `inputs` holds the SHA-256 of each input by section and name."""
    merged = {**rig.provenance.inputs, **inputs}
    ordered = {section: dict(sorted(merged[section].items())) for section in sorted(merged)}
    rig = rig.model_copy(update={"provenance": Provenance(inputs=ordered)})
    write_atomically(path, rig_text(rig))
    return rig


def finite_or_none(value: float) -> float | None:
    """A standard deviation for the file: null where the data do not bound it."""
    return float(value) if math.isfinite(value) else None


def hash_of(path: Path) -> str:
    """SHA-256 of a file of any size, or of the names and files in a bag's folder."""
    if (path / "metadata.yaml").is_file():
        files = sorted(item for item in path.iterdir() if item.is_file())
        return sha256("".join(f"{item.name!a} {file_sha256(item)}\n" for item in files).encode())
    return file_sha256(path)

"""rig.yaml: the one file that holds what is known of a rig and what was learnt about it.

Each verb reads the sections that it needs and writes its own. Every key carries its unit, every estimated
value has its standard deviation under `sigma`, and `provenance` names the inputs by their SHA-256, so that
the same inputs give the same bytes. A standard deviation that the data do not bound is null.

`schema` is the version of the file. In schema 1, which files without it have, a person's word and an
estimate share the sections `actuator` and `pump`; they are parted when such a file is read.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, field_validator

from calib.core import __version__
from calib.core.arguments import checked, taken
from calib.core.errors import BadInputError, NoSectionError, UsageError
from calib.core.files import one_line, quoted, read_yaml_mapping, sha256, shown
from calib.core.result import Number, Result, Section, identity, section_json
from calib.core.schema import validated
from calib.core.words import Block, InWords, Table, nearest
from calib.core.writing import Kind, head, write_atomically

if TYPE_CHECKING:
    from calib.core.diff import RigDiff
    from calib.stages.actuator.machine import Machine
    from calib.stages.actuator.parameters import Plant
    from calib.stages.actuator.section import Actuator, Known, PumpSection, Standing
    from calib.stages.align.section import Align
    from calib.stages.arm.section import Arm
    from calib.stages.camera.section import Camera, Lens, Plane
    from calib.stages.control.section import Controller
    from calib.stages.estimator.section import Estimator
    from calib.stages.firmware.section import Envelope
    from calib.stages.imu.section import Imu, ImuIntrinsics, OrientationFilter
    from calib.stages.lowpass.section import LowPass
    from calib.twin.section import Twin

SCHEMA = 2
"""Version of the files that are written."""

KINDS = {
    "known": "calib.stages.actuator.section.Known",
    "geometry": "calib.core.rig.Geometry",
    "envelope": "calib.stages.firmware.section.Envelope",
    "camera": "calib.stages.camera.section.Camera",
    "plane": "calib.stages.camera.section.Plane",
    "lens": "calib.stages.camera.section.Lens",
    "imu": "calib.stages.imu.section.Imu",
    "imu_intrinsics": "calib.stages.imu.section.ImuIntrinsics",
    "orientation_filter": "calib.stages.imu.section.OrientationFilter",
    "lowpass": "calib.stages.lowpass.section.LowPass",
    "align": "calib.stages.align.section.Align",
    "actuator": "calib.stages.actuator.section.Actuator",
    "pump": "calib.stages.actuator.section.PumpSection",
    "arm": "calib.stages.arm.section.Arm",
    "estimator": "calib.stages.estimator.section.Estimator",
    "controller": "calib.stages.control.section.Controller",
    "twin": "calib.twin.section.Twin",
    "provenance": "calib.core.rig.Provenance",
}
"""Sections in the order of the file and what they are. A schema takes a tenth of a second to build, so each
is loaded where a file has its section."""

_MOST_ASIDE_M = 3e-4
"""Deviation of a marker across the head, that was put there by eye."""
ARM_KIND = "pressure_arm"
"""Kind of an actuator whose section is that of an arm."""


def _holds_sections(path: Path) -> bool:
    names = {name.decode() for name in re.findall(rb"^([A-Za-z_]\w*):", head(path), re.MULTILINE)}
    if not names:
        with contextlib.suppress(BadInputError):
            names = set(read_yaml_mapping(path))
    return bool(names) and names <= {"schema", *KINDS}


SECTIONS = Kind("sections of a rig", (".yaml", ".yml"), _holds_sections, merged=True)
"""The file itself, for those who write it."""

Metres = Annotated[Number, Field(ge=-10.0, le=10.0)]
Offset = Annotated[Number, Field(ge=-0.5, le=0.5)]


class Geometry(Section):
    """What a person knows of the rig. Defaults: the nominal actuator."""

    workspace_m: Annotated[list[Metres], Field(min_length=4, max_length=4)] = [-0.06, 0.04, 0.06, 0.11]
    """Where the marker can be, world metres: least x, least y, greatest x, greatest y."""

    marker_offset_m: Offset = 0.015
    marker_offset_sigma_m: Annotated[Offset, Field(gt=0.0)] = 5e-5
    """Marker beyond the head along its tangent (A.1), and how well a drawing or a caliper tells it."""

    imu_sign: Annotated[list[Literal[-1, 1]], Field(min_length=3, max_length=3)] | None = None
    """Signs by which the board multiplies ax, ay and gz as its IMU gives them, of one that is mirrored."""

    imu_delay_s: Annotated[Number, Field(ge=0.0, le=0.1)] = 0.0
    """Age of the IMU's readings, as of its low-pass: of a second order .225 over its bandwidth."""

    @field_validator("workspace_m")
    @classmethod
    def _ordered(cls, value: list[float]) -> list[float]:
        if value[0] >= value[2] or value[1] >= value[3]:
            raise ValueError("expected [least x, least y, greatest x, greatest y]")
        return value


class Provenance(Section):
    """Version, SHA-256 of each input by section and name, and of each section as its verb wrote it."""

    version: str = __version__
    inputs: dict[str, dict[str, str]] = {}
    written: dict[str, str] = {}


@lru_cache(maxsize=64)
def _section_text(name: str, document: str) -> str:
    """The lines of a section in the file. A run writes most sections two dozen times."""
    return str(
        yaml.safe_dump(
            {name: json.loads(document)},
            sort_keys=False,
            default_flow_style=None,
            width=110,
            allow_unicode=True,
        )
    )


@dataclass(repr=False)
class Rig(InWords):
    """The whole file, its sections as attributes; None for one that it has not.

    `schema` is the version of the file that it was read from.
    """

    known: Known | None = None
    geometry: Geometry | None = None
    envelope: Envelope | None = None
    camera: Camera | None = None
    plane: Plane | None = None
    lens: Lens | None = None
    imu: Imu | None = None
    imu_intrinsics: ImuIntrinsics | None = None
    orientation_filter: OrientationFilter | None = None
    lowpass: LowPass | None = None
    align: Align | None = None
    actuator: Actuator | None = None
    pump: PumpSection | None = None
    arm: Arm | None = None
    estimator: Estimator | None = None
    controller: Controller | None = None
    twin: Twin | None = None
    provenance: Provenance = field(default_factory=Provenance)
    schema: int = field(default=SCHEMA, compare=False)

    def __setattr__(self, name: str, value: Any) -> None:
        """Raises `UsageError` for what would not be in the file, or could not be read from it again."""
        if name != "schema" and name not in KINDS:
            raise UsageError(f"rig.{name}: there is no such section{nearest(name, KINDS)}")
        kinds = [f"{one.__module__}.{one.__name__}" for one in type(value).__mro__]
        if name != "schema" and value is not None and KINDS[name] not in kinds:
            expected = KINDS[name].rpartition(".")[2]
            raise UsageError(f"rig.{name}: found a value of type {type(value).__name__}, expected {expected}")
        object.__setattr__(self, name, value)

    @staticmethod
    @checked
    def load(path: Path | str, missing_ok: bool = False) -> Rig:
        """The rig in this file; with `missing_ok` an empty one where there is no file.

        Raises `BadInputError`, also for a file of another kind (it would be written over), for sections and
        keys that are not known, and for values that contradict each other.
        """
        file = Path(path)
        if not file.exists():
            if missing_ok:
                return Rig()
            rigs = sorted(shown(one.name) for one in file.parent.glob("*.y*ml") if SECTIONS.ours(one))
            hint = nearest(file.name, rigs)
            raise BadInputError(f"{shown(file)}: cannot be read: there is no such file{hint}")
        return Rig.of(read_yaml_mapping(file), file)

    @staticmethod
    def of(document: Mapping[str, Any], source: Path | str) -> Rig:
        """The rig of a file's contents; `source` is its name for sentences. Raises as `load`."""
        schema = _schema_of(document, source)
        unknown = [name for name in document if name not in KINDS and name != "schema"]
        hint = nearest(str(unknown[0]), KINDS) if unknown else ""
        if not hint and "schema" not in document and len(unknown) == len(document):
            has = ", ".join(quoted(name) for name in unknown[:3]) or "nothing"
            raise BadInputError(
                f"{shown(source)}: is not a rig.yaml: it has {has}, expected sections as camera or provenance"
            )
        if unknown:
            name = one_line(str(unknown[0]))
            raise BadInputError(f"{shown(source)}: {name} is not a section that is known here{hint}")
        sections = {name: document[name] for name in KINDS if document.get(name) is not None}
        # The arm is one kind of actuator, and has a section of its own beside another.
        bends = isinstance(sections.get("actuator"), dict) and sections["actuator"].get("kind") == ARM_KIND
        if bends and "arm" in sections:
            raise BadInputError(
                f"{shown(source)}: actuator is a {ARM_KIND} and there is an arm; expected one"
            )
        if bends:
            sections["arm"] = sections.pop("actuator")
        rig = Rig(schema=schema)
        for name, values in sections.items():
            identified = schema > 1 and name in ("actuator", "pump")
            if identified and isinstance(values, dict) and "verdict" not in values:
                raise BadInputError(
                    f"{shown(source)}: {name} has no verdict, so it is not of calib identify; what you know "
                    f"belongs under known: {{{name}: ...}}"
                )
            if schema > 1 or name not in ("actuator", "pump"):
                where = "actuator" if bends and name == "arm" else name
                setattr(rig, name, validated(kind_of(name), values, source, where))
        # What is a section's identity may change with the version.
        if rig.provenance.version == __version__:
            for name, one in rig.sections.items():
                if isinstance(one, Result) and name in rig.provenance.written:
                    one.sealed(rig.provenance.written[name])
        if schema == 1 and ("actuator" in sections or "pump" in sections):
            from calib.stages.actuator.section import parted

            learnt = rig.provenance.inputs
            old = {name: (sections.get(name), name in learnt) for name in ("actuator", "pump")}
            rig.actuator, rig.pump, rig.known = parted(old, rig.known, source)
        if rig.known or rig.actuator or rig.pump:
            rig._check(source)
        return rig

    def _check(self, source: Path | str) -> None:
        """Refuse values of actuator and pumps that no rig can have together."""
        from calib.stages.actuator.parameters import SUPPLY_V
        from calib.stages.actuator.section import plant_from

        parts = self.standing
        try:
            plant_from({key: value for key, (value, _) in parts["actuator"].items()})
        except BadInputError as error:
            raise BadInputError(f"{shown(source)}: actuator: {error}") from error
        strength, _ = parts["pump"].get("strength", ([1.0], None))
        if min(strength) <= 0.0:
            raise BadInputError(f"{shown(source)}: pump.strength is {strength}, expected both above 0")
        supply, _ = parts["pump"].get("supply_V", (SUPPLY_V, None))
        dead, _ = parts["pump"].get("dead_zone_V", (0.0, None))
        if dead > supply:
            raise BadInputError(
                f"{shown(source)}: pump.dead_zone_V is {dead:g}, expected at most the supply's {supply:g} V"
            )

    def values(self) -> dict[str, Any]:
        """Sections as plain values, in the order of the file."""
        sections = {name: getattr(self, name) for name in KINDS}
        return {name: section_json(one) for name, one in sections.items() if one is not None}

    def text(self) -> str:
        """The file's text, the same for the same rig."""
        sections = (
            _section_text(self.name_in_file(name), json.dumps(one)) for name, one in self.values().items()
        )
        return "".join([f"schema: {SCHEMA}\n", *sections])

    def name_in_file(self, section: str) -> str:
        """What the file calls a section: an arm is its actuator unless there is another."""
        return "actuator" if section == "arm" and self.actuator is None else section

    @property
    def inputs(self) -> dict[str, Mapping[str, str]]:
        """SHA-256 of each input by section and name: those of the file, and those that results carry."""
        sections = {one.name: getattr(self, one.name) for one in fields(self)}
        carried = {
            name: one.inputs for name, one in sections.items() if isinstance(one, Result) and one.inputs
        }
        return {**self.provenance.inputs, **carried}

    @checked
    def save(self, path: Path | str, inputs: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Replace the file atomically. Raises `BadInputError`, as `load` where something else is there.

        Parameters
        ----------
        inputs : SHA-256 of each input by section and name, beside those that results carry.
        """
        file = Path(path)
        if file.is_file() and file.stat().st_size:
            # A verb has read it before; a program may name a picture.
            Rig.load(file)
        write_atomically(file, self.file_text(file, inputs), SECTIONS)

    def file_text(self, path: Path | str, inputs: Mapping[str, Mapping[str, str]] | None = None) -> str:
        """What `save` writes."""
        merged = {**self.inputs, **(inputs or {})}
        ordered = {name: dict(sorted(merged[name].items())) for name in sorted(merged)}
        written = {name: one.sealed() for name, one in self.sections.items() if isinstance(one, Result)}
        self.provenance, self.schema = Provenance(inputs=ordered, written=written), SCHEMA
        # What a program has set may be anything, and a file that cannot be read back helps nobody.
        Rig.of({"schema": SCHEMA, **self.values()}, path)
        return self.text()

    def with_sections(self, sections: Mapping[str, Any]) -> Rig:
        """The same rig with other sections, by name."""
        return replace(self, **sections)

    @property
    def sections(self) -> dict[str, Any]:
        """The sections that are there, by name, without the provenance."""
        found = {name: getattr(self, name) for name in KINDS if name != "provenance"}
        return {name: one for name, one in found.items() if one is not None}

    def blocks(self) -> list[Block]:
        """Sections and their verdicts; each section shows its own values."""
        rows = [
            (name, one.verdict.word if isinstance(one, Result) else "stated")
            for name, one in self.sections.items()
        ]
        return [Table(("section", "verdict"), tuple(rows))]

    def only(self, names: Iterable[str]) -> Rig:
        """The sections of these names, and what they were learnt from."""
        kept = {name: one for name, one in self.sections.items() if name in set(names)}
        inputs = {name: one for name, one in self.provenance.inputs.items() if name in set(names)}
        return Rig(**kept, provenance=Provenance(inputs=inputs))

    def joined(self, other: Rig) -> Rig:
        """The sections of both; the other's where both have one."""
        inputs = {**self.provenance.inputs, **other.provenance.inputs}
        return replace(self, **other.sections, provenance=Provenance(inputs=inputs))

    @property
    def simulated(self) -> bool:
        """Whether constants come from a simulated rig or from rendered pictures."""
        optics = (one for one in (self.camera, self.plane) if one is not None)
        return self.twin is not None or any(one.simulated for one in optics)

    def diff(self, other: Rig) -> RigDiff:
        """What differs in a later calibration, in standard deviations and on the plane."""
        from calib.core.diff import compared, plane_change

        taken(other, Rig, "calib.Rig.diff: other")
        plane = None
        # Pictures of two sizes have no pixels in common.
        alike = self.picture_px == other.picture_px
        if self.camera and other.camera and self.plane and other.plane and alike:
            seen, read = (self.plane, self.camera), (other.plane, other.camera)
            plane = plane_change(
                lambda world_m: seen[0].to_pixels(world_m, seen[1]),
                lambda pixels: read[0].to_world(pixels, read[1]),
                (other if other.geometry else self).workspace_m,
                [one.sigma_marker_mm.get("calibration_max") for one in (self.plane, other.plane)],
            )
        return compared(self.values(), other.values(), plane)

    @property
    def workspace_m(self) -> tuple[float, float, float, float]:
        """Where the marker can be: least x, least y, greatest x, greatest y."""
        x0, y0, x1, y1 = (self.geometry or Geometry()).workspace_m
        return x0, y0, x1, y1

    @property
    def marker_offset_m(self) -> float:
        """Marker beyond the head along its tangent (A.1), as drawn."""
        return (self.geometry or Geometry()).marker_offset_m

    @property
    def shift_sigma_m(self) -> tuple[float, float] | None:
        """Deviations of the marker's shift in the plane along x and y; None without a plane.

        That along y is the calibration's alone. Across the head a marker is as far from its drawing as along
        it, though not by more than one that was put there by eye.
        """
        largest = self.plane.sigma_marker_mm.get("calibration_max") if self.plane is not None else None
        if largest is None:
            return None
        shift = 1e-3 * largest / math.sqrt(2.0)
        aside = min((self.geometry or Geometry()).marker_offset_sigma_m, _MOST_ASIDE_M)
        return math.hypot(shift, aside), shift

    @property
    def imu_delay_s(self) -> float:
        """Age of the IMU's readings."""
        return (self.geometry or Geometry()).imu_delay_s

    @property
    def middle_m(self) -> tuple[float, float]:
        """The middle of the workspace, about which an alignment's stretch magnifies."""
        x0, y0, x1, y1 = self.workspace_m
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)

    @property
    def picture_px(self) -> tuple[int, int] | None:
        """Width and height of the camera's pictures, in which a log's marker lies; None without a camera."""
        if self.camera is None:
            return None
        width, height = self.camera.image_size_px
        return width, height

    @property
    def standing(self) -> dict[str, Standing]:
        """What is in force of the sections `actuator` and `pump`: value and standard deviation by key."""
        from calib.stages.actuator.section import Known, in_force

        known = self.known or Known()
        return {"actuator": in_force(self.actuator, known.actuator), "pump": in_force(self.pump, known.pump)}

    @property
    def tick_hz(self) -> float:
        """Rate of the board's loop: that of the low-pass, else of the pumps' commands, else 60 Hz."""
        from calib.stages.actuator.parameters import TICK_S

        if self.lowpass is not None:
            return self.lowpass.rate_hz
        tick_s, _ = self.standing["pump"].get("tick_s", (TICK_S, ""))
        return 1.0 / float(tick_s)

    @property
    def plant(self) -> Plant:
        """The plant: nominal values, over them what was estimated, over it what is known.

        Raises `BadInputError` for values that no plant can have together.
        """
        from calib.stages.actuator.section import plant_from

        return plant_from({key: value for key, (value, _) in self.standing["actuator"].items()})

    @property
    def machine(self) -> Machine:
        """The plant with its pumps, by the same rule."""
        from calib.stages.actuator.machine import machine_from

        values = self.standing
        return machine_from(*({k: v for k, (v, _) in values[name].items()} for name in ("actuator", "pump")))

    def needed(self, name: str, source: Path | str, why: str = "") -> Any:
        """A section. Raises `BadInputError`, which says the verb that makes it, where there is none."""
        section = getattr(self, name)
        if section is None:
            raise NoSectionError(f"{shown(source)}: has no {name} yet{why}; run calib {VERBS[name]} first")
        return section

    def current_plane(self, source: Path | str) -> Plane | None:
        """The plane; `BadInputError` where it was calibrated with another camera than the rig's."""
        if self.plane is None or self.camera is None:
            return None
        known = self.inputs.get("plane", {}).get("camera")
        if known is not None and known != identity(self.camera):
            raise BadInputError(
                f"{shown(source)}: plane was calibrated with another camera than the one in camera; "
                "run calib extrinsics again"
            )
        off_px = self.plane.off_px(self.camera, self.workspace_m)
        if not off_px < _MOST_OFF_PX:
            raise BadInputError(
                f"{shown(source)}: plane.A_px_per_m is {off_px:.3g} px off from what camera, R_CW and t_CW_m "
                "give; run calib extrinsics again"
            )
        return self.plane

    def identities(self, *names: str) -> dict[str, str]:
        """SHA-256 of these sections to note what was computed from them; empty for one that there is not."""
        found = {name: getattr(self, name) for name in names}
        own = {name: _said if name in _STATED else identity for name in names}
        return {name: "" if section is None else own[name](section) for name, section in found.items()}

    def outdated(self, names: Iterable[str] | None = None) -> list[str]:
        """Sentences for sections of these, or of all, that do not say what their verb would say now.

        They were computed from others than the rig has now, or were changed after the verb wrote them.
        """
        asked = set(VERBS if names is None else names)
        # In the order of the file, in which verbs follow from each other.
        there = [name for name in KINDS if name in asked and isinstance(getattr(self, name), Result)]
        known = {name: self.inputs.get(name, {}) for name in there}
        now = self.identities(*(name for name in KINDS if any(name in inputs for inputs in known.values())))
        sentences = []
        for name, inputs in known.items():
            what, again = name.replace("_", " "), f"run calib {VERBS[name]} again"
            changed = [
                # A result that is not here may only not have been handed over.
                other.replace("_", " ")
                for other in now
                if (now[other] or other in _STATED) and inputs.get(other, now[other]) != now[other]
            ]
            earlier = [other for other in changed if other not in _STATED]
            if earlier:
                sentences.append(f"{what} in the file is of an earlier {' and '.join(earlier)}; {again}")
            elif changed:
                sentences.append(f"{what} in the file is older than {' and '.join(changed)}; {again}")
            sentences += self.retyped([name])
        return sentences

    def retyped(self, names: Iterable[str]) -> list[str]:
        """Sentences for sections of these that were changed after their verb wrote them."""
        return [
            f"{name.replace('_', ' ')} in the file was changed after calib had written it, so that its "
            f"verdict is of other values; run calib {VERBS[name]} again"
            for name in names
            if isinstance(one := getattr(self, name), Result) and one.changed
        ]

    def doubts(self, names: Iterable[str]) -> list[str]:
        """Sentences for sections of these that nothing computed from them can be better than."""
        sections = {name: getattr(self, name) for name in names if name in VERBS}
        poor = [
            f"{name.replace('_', ' ')} is {one.verdict.word}"
            for name, one in sections.items()
            if isinstance(one, Result) and not one.verdict.ok
        ]
        no_better = [f"{', '.join(poor)}; what follows from it is no better"] if poor else []
        return [*no_better, *self.outdated(sections)]


def _said(section: BaseModel) -> str:
    """SHA-256 of what a person states beyond the defaults; empty for nothing."""

    def pruned(values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        kept = {key: pruned(value) for key, value in values.items()}
        return {key: value for key, value in kept.items() if value is not None and value != {}}

    values = pruned(section.model_dump(mode="json", exclude_defaults=True))
    return sha256(json.dumps(values, sort_keys=True).encode()) if values else ""


_MOST_OFF_PX = 0.01
_STATED = ("known", "geometry")
"""What a person states."""
VERBS = {
    "camera": "intrinsics", "plane": "extrinsics", "lens": "distortion", "imu": "imu static",
    "imu_intrinsics": "imu intrinsics", "orientation_filter": "imu tune", "lowpass": "lowpass",
    "align": "align", "actuator": "identify", "pump": "identify", "arm": "identify arm",
    "estimator": "replay --tune", "controller": "control tune",
}  # fmt: skip
"""Verb that computes a section."""


def kind_of(name: str) -> type[BaseModel]:
    """The schema of a section."""
    module, _, kind = KINDS[name].rpartition(".")
    found: type[BaseModel] = getattr(importlib.import_module(module), kind)
    return found


def _schema_of(document: Mapping[str, Any], source: Path | str) -> int:
    schema = document.get("schema", 1)
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise BadInputError(f"{shown(source)}: schema is {quoted(schema)}, expected 1 or {SCHEMA}")
    if schema > SCHEMA:
        raise BadInputError(
            f"{shown(source)}: schema is {schema}, and this version of calib reads files up to {SCHEMA}; "
            "it was written by a later one, which reads it"
        )
    return schema

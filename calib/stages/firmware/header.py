"""calib_constants.h: every constant of rig.yaml that firmware needs, and the files around it.

The text is a template's; here are the order of the groups, the provenance, and the guards' numbers. The
same rig gives the same bytes: no time and no path goes in.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

from calib import __version__
from calib.core.result import identity
from calib.core.verdict import Finding, Verdict
from calib.core.writing import Kind, begins, make_folder, write_atomically
from calib.stages.camera.lens import fit_inverse
from calib.stages.camera.model import COEFFICIENTS, MODELS
from calib.stages.camera.section import InverseLens
from calib.stages.firmware.constants import (
    CameraConstants,
    Lookup,
    PlaneConstants,
    camera_groups,
    control_groups,
    fused_group,
    motion_groups,
    plane_constants,
    put_right,
    tick_rate_hz,
    trust_group,
)
from calib.stages.firmware.literals import (
    Constant,
    Group,
    Macro,
    Table,
    Whole,
    comment_text,
    literals,
    values,
)

if TYPE_CHECKING:
    from calib.core.rig import Rig
    from calib.stages.camera.section import Camera

SCHEMA = 5
"""Raised when a constant changes its name, unit or meaning."""

VERBATIM = ("calib_pipeline.h", "calib_guard.h", "calib_link.h", "calib_i2c.h", "calib_bno055.h",
            "calib_mpu6050.h", "calib_pixy2.h")  # fmt: skip
"""Files that are the same for every rig."""

FLASHED = ("camera", "plane", "imu", "orientation_filter", "lowpass", "align", "controller")
"""Sections whose verdicts say whether the header can be flashed."""
_UNREAD = "see CALIB_CAMERA_OK and CALIB_PLANE_OK, do not flash it unread"

_INVERSE_PX = 0.1
_INVERSE_SHARE = 0.9
"""A header is marked when its polynomial undoes the lens worse than this, or in less of the picture."""


@dataclass(frozen=True)
class Header:
    """What goes into calib_constants.h, and the files around it.

    Attributes
    ----------
    camera : intrinsics, lens and plane, None for a rig without.
    groups : all constants in the order of the file.
    inputs : SHA-256 of each input by name.
    verdict : of the sections that the constants come from.
    """

    camera: CameraConstants | None
    groups: tuple[Group, ...]
    inputs: Mapping[str, str]
    verdict: Verdict

    @cached_property
    def literals(self) -> dict[str, str]:
        """Every value as it stands in the file, by name. Raises `BadInputError` for what no float holds."""
        return literals(self.groups)

    @cached_property
    def values(self) -> Mapping[str, float]:
        """Every value as a compiler reads it, by name."""
        return MappingProxyType(values(self.literals))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of schema and values; its first eight digits are CALIB_ID."""
        canonical = "\n".join(f"{name} {literal}" for name, literal in self.literals.items())
        return hashlib.sha256(f"{SCHEMA}\n{canonical}\n".encode()).hexdigest()

    @property
    def identity(self) -> int:
        """CALIB_ID."""
        return int(self.digest[:8], 16)

    @property
    def text(self) -> str:
        """calib_constants.h."""
        plane = self.camera.plane if self.camera else None
        return rendered(
            "calib_constants.h.j2",
            header=self,
            camera=self.camera,
            plane_verdict=plane.verdict if plane else "",
            digest=self.digest,
            groups=[
                {
                    "notes": [*group.notes, *([group.defaults] if group.defaults else [])],
                    "lines": _lines(group, self.literals),
                }
                for group in self.groups
            ],
            inputs=dict(sorted(self.inputs.items())),
        )

    @staticmethod
    def sketch(folder: Path) -> str:
        """Name of the sketch in a folder: the Arduino IDE wants it to bear the folder's."""
        return f"{folder.resolve().name or 'calib_example'}.ino"

    def write(self, folder: Path | str) -> list[Path]:
        """Write the header with pipeline, self-test, drivers and sketch; the files written.

        A sketch that is there and says something else is left as it is: it is an example to be changed.

        Raises `BadInputError` where the folder cannot be written.
        """
        from calib.stages.firmware.vectors import selftest_text

        where = Path(folder)
        texts = {name: verbatim(name) for name in VERBATIM}
        texts |= {"calib_constants.h": self.text, "calib_selftest.h": selftest_text(self)}
        texts[self.sketch(where)] = verbatim("calib_example.ino")
        make_folder(where)
        written = []
        for name, text in texts.items():
            path = where / name
            if name.endswith(".ino") and path.is_file() and path.read_bytes() != text.encode():
                continue
            write_atomically(path, text, HEADER)
            written.append(path)
        return written

    def __str__(self) -> str:
        return self.text


HEADER = Kind("a source of the firmware", (".h", ".ino"), begins(b"/*\n * calib_"))


def rendered(template: str, header: Header, **more: Any) -> str:
    """Text in C of a template; `comment` makes text safe inside a comment."""
    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(verbatim),
        undefined=jinja2.StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["comment"] = comment_text
    common = {"schema": SCHEMA, "version": __version__, "identity": f"{header.identity:08X}"}
    return made.get_template(template).render(**common, **more)


def verbatim(name: str) -> str:
    """Text of a file in `templates`."""
    return resources.files("calib.stages.firmware").joinpath("templates", name).read_text("utf-8")


def _inverse(whole: Rig, camera: Camera) -> InverseLens:
    """The polynomial of the section lens where that is of this camera, else a new one."""
    if whole.lens is not None and whole.inputs.get("lens", {}).get("camera") == identity(camera):
        return whole.lens.inverse
    return InverseLens.of(fit_inverse(camera.optics))


def _undone(inverse: InverseLens) -> bool:
    return (
        inverse.max_error_px is not None
        and inverse.max_error_px <= _INVERSE_PX
        and inverse.covered >= _INVERSE_SHARE
    )


def _camera_constants(whole: Rig, source: str) -> CameraConstants | None:
    from calib.core.rig import Geometry

    section = whole.camera
    if section is None:
        return None
    camera = section.optics
    inverse = _inverse(whole, section)
    named = dict(zip(COEFFICIENTS, camera.distortion.tolist(), strict=True))
    intrinsics = {
        "fx_px": section.fx_px,
        "fy_px": section.fy_px,
        "skew_px": section.skew_px,
        "cx_px": section.cx_px,
        "cy_px": section.cy_px,
        **{name: named[name] for name in MODELS[section.model]},
    }
    plane: PlaneConstants | None = None
    align = whole.align
    known = whole.current_plane(source)
    if known is not None:
        x0, y0, x1, y1 = (whole.geometry or Geometry()).workspace_m
        plane = plane_constants(
            camera,
            np.array(known.R_CW),
            np.array(known.t_CW_m),
            np.array(known.A_inverse),
            (x0, y0, x1, y1),
            known.verdict.word,
        )
        if align is not None:
            x, y = align.plane_shift_m
            plane = put_right(plane, (x, y), align.plane_stretch)
    verdict = section.verdict.word if _undone(inverse) or not section.verdict.ok else "poor"
    return CameraConstants(camera.image_size_px, section.model, verdict, intrinsics, inverse, plane)


def _judge(whole: Rig, camera: CameraConstants | None) -> Verdict:
    """As bad as the worst of the sections that the constants come from, and as the lens is undone."""
    findings = []
    for name in FLASHED:
        section = getattr(whole, name)
        # With an alignment the header takes nothing from a log at rest.
        if section is None or (name == "imu" and whole.align is not None):
            continue
        word = section.verdict.word
        if word != "ok":
            advice = _UNREAD if name in ("camera", "plane") else ""
            findings.append(Finding(word, f"{name} is {word}", advice))
    inverse = camera.inverse if camera else None
    if inverse is not None and not _undone(inverse):
        error = "without bound" if inverse.max_error_px is None else f"to {inverse.max_error_px:.3g} px only"
        text = f"the lens is undone {error}, over {inverse.covered:.0%} of the picture"
        findings.append(Finding("poor", text, _UNREAD))
    if camera is None or camera.plane is None:
        lacks, verb = ("camera", "intrinsics") if camera is None else ("plane", "extrinsics")
        text = f"no {lacks} yet: the sketch records, and controls nothing"
        findings.append(Finding("remark", text, f"run calib {verb}"))
    if _simulated(whole):
        text = "the rig is a simulated one: for a board its constants compile only with CALIB_I_KNOW"
        findings.append(Finding("remark", text))
    return Verdict.of(findings)


def _simulated(whole: Rig) -> bool:
    """Whether constants come from a simulated rig or from rendered pictures."""
    optics = (one for one in (whole.camera, whole.plane) if one is not None)
    return whole.twin is not None or any(one.simulated for one in optics)


def header_of(whole: Rig, source: str) -> Header:
    """The header of a rig; one without a camera or plane makes a sketch that records.

    A lens that the firmware could not undo makes the camera's verdict in the header poor.

    Parameters
    ----------
    source : the file's name for messages.

    Raises `BadInputError` for values that the firmware cannot run with, by their key.
    """
    camera = _camera_constants(whole, source)
    lookup = Lookup(whole, source)
    rate_hz = tick_rate_hz(lookup)
    lookup.defaults()
    plane = camera.plane if camera else None
    motion = (*motion_groups(lookup), fused_group(lookup, rate_hz, plane))
    verdict = _judge(whole, camera)
    groups = (
        trust_group(verdict.ok, _simulated(whole)),
        *camera_groups(camera),
        *motion,
        *control_groups(lookup, rate_hz),
    )
    inputs = {
        f"{section}/{name}": digest
        for section, named in whole.inputs.items()
        for name, digest in named.items()
        # Sections that name others as inputs; only files are inputs of the header.
        if name not in ("camera", "plane") and (section != "plane" or plane is not None)
    }
    return Header(camera, groups, inputs, verdict)


def _lines(group: Group, literal: Mapping[str, str]) -> list[str]:
    lines = []
    for item in group.items:
        note = comment_text(item.comment)
        if isinstance(item, Constant | Whole):
            lines.append(f"#define {item.name} {literal[item.name]} /* {note} */")
        elif isinstance(item, Macro):
            lines.append(f"#define {item.name} {item.body} /* {note} */")
        elif isinstance(item, Table):
            lines.append(f"/* {note} */")
            entries = [literal[f"{item.name}[{i}]"] for i in range(len(item.values))]
            lines.append(f"static const float {item.name}[{len(entries)}] CALIB_IN_FLASH = {{")
            lines += [f"    {', '.join(entries[i : i + 6])}," for i in range(0, len(entries), 6)]
            lines.append("};")
    return lines

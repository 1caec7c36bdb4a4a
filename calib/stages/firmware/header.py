"""calib_constants.h: every constant of rig.yaml that firmware needs, and the files around it.

The text is a template's; here are the order of the groups, the provenance, and the guards' numbers. The
same rig gives the same bytes: no time and no path goes in.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING

import jinja2
import numpy as np

from calib import __version__
from calib.stages.camera.lens import fit_inverse
from calib.stages.camera.model import COEFFICIENTS, MODELS
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
)
from calib.stages.firmware.literals import Constant, Group, Macro, Table, Whole, comment_text, literals

if TYPE_CHECKING:
    from calib.core.rig import Rig

SCHEMA = 3
"""Raised when a constant changes its name, unit or meaning."""

_INVERSE_PX = 0.1
_INVERSE_SHARE = 0.9
"""A header is marked when its polynomial undoes the lens worse than this, or in less of the picture."""


@dataclass(frozen=True)
class Header:
    """What goes into calib_constants.h.

    Attributes
    ----------
    camera : intrinsics, lens and plane.
    groups : all constants in the order of the file.
    inputs : SHA-256 of each input by name.
    """

    camera: CameraConstants
    groups: tuple[Group, ...]
    inputs: Mapping[str, str]

    @property
    def literals(self) -> dict[str, str]:
        """Every value as it stands in the file, by name."""
        return literals(self.groups)


def environment() -> jinja2.Environment:
    """Templates of C text; `comment` makes text safe inside a comment."""
    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(verbatim),
        undefined=jinja2.StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["comment"] = comment_text
    return made


def verbatim(name: str) -> str:
    """Text of a file in `templates`."""
    return resources.files("calib.stages.firmware").joinpath("templates", name).read_text("utf-8")


def identity_of(header: Header) -> str:
    """SHA-256 of schema and values; its first eight digits are CALIB_ID."""
    canonical = "\n".join(f"{name} {literal}" for name, literal in header.literals.items())
    return hashlib.sha256(f"{SCHEMA}\n{canonical}\n".encode()).hexdigest()


def _camera_constants(whole: Rig, source: str) -> CameraConstants:
    from calib.core.rig import Geometry

    section = whole.camera
    assert section is not None
    camera = section.optics
    inverse = fit_inverse(camera)
    undone = inverse.max_error_px <= _INVERSE_PX and inverse.covered >= _INVERSE_SHARE
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
    verdict = section.verdict.word if undone or not section.verdict.ok else "poor"
    return CameraConstants(camera.image_size_px, section.model, verdict, intrinsics, inverse, plane)


def header_of(whole: Rig, source: str) -> Header:
    """The header of a rig that has a camera.

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
    motion = (*motion_groups(lookup), fused_group(lookup, rate_hz, camera.plane))
    groups = (*camera_groups(camera), *motion, *control_groups(lookup, rate_hz))
    inputs = {
        f"{section}/{name}": digest
        for section, named in whole.provenance.inputs.items()
        for name, digest in named.items()
        # Sections that name others as inputs; only files are inputs of the header.
        if name not in ("camera", "plane") and (section != "plane" or camera.plane is not None)
    }
    return Header(camera, groups, inputs)


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


def header_text(header: Header) -> str:
    """calib_constants.h. Raises `BadInputError` for a value that a float cannot hold."""
    literal = header.literals
    digest = identity_of(header)
    groups = [
        {
            "notes": [*group.notes, *([group.defaults] if group.defaults else [])],
            "lines": _lines(group, literal),
        }
        for group in header.groups
    ]
    return (
        environment()
        .get_template("calib_constants.h.j2")
        .render(
            schema=SCHEMA,
            version=__version__,
            digest=digest,
            identity=digest[:8].upper(),
            camera=header.camera,
            plane_verdict=header.camera.plane.verdict if header.camera.plane else "",
            groups=groups,
            inputs=dict(sorted(header.inputs.items())),
        )
    )

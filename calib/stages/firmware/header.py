"""calib_constants.h and the files around it, and whether a rig's constants may be flashed.

The text is the template's, and what stands in it is read off it again: digest, values for Python, self-test.
The same rig gives the same bytes: no time and no path goes in.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

from calib.core import __version__
from calib.core.errors import BadInputError
from calib.core.result import identity
from calib.core.rig import KINDS, VERBS
from calib.core.verdict import Finding, Verdict
from calib.core.words import Block, InWords, Line, of_verdict
from calib.core.writing import Kind, begins, make_folder, write_atomically
from calib.stages.camera.lens import fit_inverse
from calib.stages.camera.model import COEFFICIENTS, MODELS
from calib.stages.camera.section import InverseLens
from calib.stages.firmware.constants import Lookup, constants, plane_constants
from calib.stages.firmware.section import Envelope
from calib.stages.firmware.vectors import selftest_rows

if TYPE_CHECKING:
    from calib.core.rig import Rig

# ----------------------------------------------------------------------
# Numbers as literals of C, text that cannot leave a comment, and the values that stand in a header.
#
# Literals have nine significant digits, which is enough for any binary32.

_SMALLEST_NORMAL = 1.1754943508222875e-38
_CONSTANT = re.compile(
    r"^#define (CALIB_\w+) (\S+) /\*|^static const float (\w+)\[\d+\] CALIB_IN_FLASH = \{([^}]*)\}", re.M
)


def float_literal(value: float) -> str:
    """A C literal that a compiler reads back as the binary32 nearest to `value`."""
    with np.errstate(over="ignore"):
        # No sign on zero: -0.0 would tell two headers of the same rig apart.
        text = f"{float(np.float32(value)) + 0.0:.9g}"
    if not any(c in text for c in ".en"):
        text += ".0"
    elif "e" in text and "." not in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}.0e{exponent}"
    return text + "f"


def comment_text(text: str) -> str:
    """Text that cannot end a C comment or start a trigraph, whatever it was: one line of ASCII."""
    plain = text.encode("unicode_escape").decode("ascii")
    # A backslash would continue a line or, with trigraphs, mean something else.
    return plain.replace("\\", "|").replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def literals(header: str) -> dict[str, str]:
    """Every number in the text of a header by name, entries of a table as NAME[i].

    Raises `BadInputError` for one that a float of C holds only as subnormal or not at all.
    """
    found: dict[str, str] = {}
    for name, literal, table, entries in _CONSTANT.findall(header):
        rows = [text.strip() for text in entries.split(",") if text.strip()]
        found |= {f"{table}[{i}]": text for i, text in enumerate(rows)} if table else {name: literal}
    for name, value in values(found).items():
        if not math.isfinite(value) or 0.0 < abs(value) < _SMALLEST_NORMAL:
            raise BadInputError(
                f"{name} is {value:.3g}, which no normal float of C can hold; set it to zero, or repair it"
            )
    return found


def values(literal: Mapping[str, str]) -> dict[str, float]:
    """What a compiler makes of the literals: binary32 values as Python floats."""
    return {
        name: float(np.float32(text[:-1])) if text.endswith("f") else float(int(text))
        for name, text in literal.items()
    }


# ----------------------------------------------------------------------
# The header, and the files around it.

VERBATIM = ("calib_pipeline.h", "calib_guard.h", "calib_link.h", "calib_i2c.h", "calib_bno055.h",
            "calib_mpu6050.h", "calib_pixy2.h")  # fmt: skip
"""Files that are the same for every rig."""

FLASHED = ("camera", "plane", "imu", "orientation_filter", "lowpass", "align", "controller")
"""Sections whose verdicts say whether the header can be flashed."""
_UNREAD = "see CALIB_CAMERA_OK and CALIB_PLANE_OK, do not flash it unread"

_UNTUNED = (
    "no controller yet: gains and feed-forward are those of the nominal actuator, and compile for a board "
    "only with CALIB_I_KNOW"
)
_INVERSE_PX = 0.1
_INVERSE_SHARE = 0.9
"""A header is marked when its polynomial undoes the lens worse than this, or in less of the picture."""


@dataclass(frozen=True, repr=False)
class Header(InWords):
    """calib_constants.h, and the files around it.

    Attributes
    ----------
    text : calib_constants.h.
    literals : every number as it stands there, by name. digest : SHA-256 of them; its first eight digits are
        CALIB_ID.
    verdict : of the sections that the constants come from.
    """

    text: str
    literals: Mapping[str, str]
    digest: str
    verdict: Verdict

    def blocks(self) -> list[Block]:
        return [Line(f"{len(self.literals)} constants"), *of_verdict(self.verdict)]

    @cached_property
    def values(self) -> Mapping[str, float]:
        """Every value as a compiler reads it, by name."""
        return values(self.literals)

    @property
    def identity(self) -> int:
        """CALIB_ID."""
        return int(self.digest[:8], 16)

    @property
    def selftest(self) -> str:
        """calib_selftest.h."""
        identity = f"{self.identity:08X}"
        return rendered("calib_selftest.h.j2", identity=identity, **selftest_rows(self.values))

    @staticmethod
    def sketch(folder: Path) -> str:
        """Name of the sketch in a folder: the Arduino IDE wants it to bear the folder's."""
        return f"{folder.resolve().name or 'calib_example'}.ino"

    def write(self, folder: Path | str) -> list[Path]:
        """Write the header with pipeline, self-test, drivers and sketch; the files written.

        A sketch that is there and says something else is left as it is: it is an example to be changed.

        Raises `BadInputError` where the folder cannot be written.
        """
        where = Path(folder)
        texts = {name: verbatim(name) for name in VERBATIM}
        texts |= {"calib_constants.h": self.text, "calib_selftest.h": self.selftest}
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


HEADER = Kind("a source of the firmware", (".h", ".ino"), begins(b"/*\n * calib_"))


def rendered(template: str, **context: Any) -> str:
    """Text in C of a template, floats as literals; `comment` makes text safe inside a comment."""
    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(verbatim),
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: float_literal(value) if isinstance(value, float) else value,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["comment"] = comment_text
    return made.get_template(template).render(version=__version__, **context)


def verbatim(name: str) -> str:
    """Text of a file in `templates`."""
    return resources.files("calib.stages.firmware").joinpath("templates", name).read_text("utf-8")


def _inverse_lens(rig: Rig) -> InverseLens | None:
    """The polynomial of the section lens where that is unchanged and of this camera, else a new one."""
    if rig.camera is None:
        return None
    lens, known = rig.lens, rig.inputs.get("lens", {})
    if lens is not None and not lens.changed and known.get("camera") == identity(rig.camera):
        return lens.inverse
    return fit_inverse(rig.camera.optics)


def _undoes_lens(inverse: InverseLens) -> bool:
    error = inverse.max_error_px
    return error is not None and error <= _INVERSE_PX and inverse.covered >= _INVERSE_SHARE


_LEAST_PICTURES = 0.8
"""Pictures per tick; where fewer come the guard's count of lost ones runs full."""
_WIDE = 4.0
"""Times the default from which on a limit of the envelope is remarked on."""
_DEFAULTED = ("align", "actuator", "pump")
"""Sections for which the header has defaults."""
_MOUNTED_RAD = 0.1
"""Angle of an IMU at rest that the board may take for bending: 1.3 mm of the nominal bellows' lengths."""


def _judge(rig: Rig, inverse: InverseLens | None) -> Iterator[Finding]:
    """Findings on the sections that the constants come from, and on how the lens is undone."""
    # With an alignment the header takes nothing from a log at rest.
    taken = [name for name in FLASHED if name != "imu" or rig.align is None]
    yield from _poor_sections(rig, taken)
    if inverse is not None and not _undoes_lens(inverse):
        error = "without bound" if inverse.max_error_px is None else f"to {inverse.max_error_px:.3g} px only"
        text = f"the lens is undone {error}, over {inverse.covered:.0%} of the picture"
        yield Finding("poor", text, _UNREAD)
    yield from _no_control(rig) or _defaults(rig, [*taken, "actuator", "pump"])
    yield from _pictures_and_ticks(rig)
    if rig.simulated:
        text = "the rig is a simulated one: for a board its constants compile only with CALIB_I_KNOW"
        yield Finding("remark", text)


def _poor_sections(rig: Rig, taken: Sequence[str]) -> Iterator[Finding]:
    """Sections that are not ok, or older than what they were computed from."""
    for name in taken:
        section = getattr(rig, name)
        if section is not None and not section.verdict.ok:
            advice = _UNREAD if name in ("camera", "plane") else ""
            word = section.verdict.word
            yield Finding(word, f"{name.replace('_', ' ')} is {word}", advice)
    # A lens of another camera, or one that was changed, is not taken but undone anew.
    stale = rig.outdated([*(name for name in taken if name != "lens"), "actuator", "pump"])
    yield from (Finding("poor", sentence) for sentence in stale)


def _no_control(rig: Rig) -> list[Finding]:
    """What a rig lacks to be controlled; empty for none."""
    if rig.camera is None or rig.plane is None:
        lacks, verb = ("camera", "intrinsics") if rig.camera is None else ("plane", "extrinsics")
        text = f"no {lacks} yet: the sketch records, and controls nothing"
        return [Finding("remark", text, f"run calib {verb}")]
    if rig.controller is None:
        return [Finding("remark", _UNTUNED, "run calib identify and calib control tune")]
    return []


def _defaults(rig: Rig, taken: Sequence[str]) -> Iterator[Finding]:
    """Defaults of a rig that controls: in place of sections that are gone, and of the IMU's mount."""
    for gone in _DEFAULTED:
        with_it = [name for name in taken if rig.inputs.get(name, {}).get(gone)]
        if getattr(rig, gone) is None and with_it:
            text = f"{gone}, with which {with_it[0]} was computed, is not there: the header has defaults"
            yield Finding("poor", text, f"run calib {VERBS[gone]} again")
    if rig.align is None and rig.imu is None:
        text = "neither imu nor align: the board's angle comes from an IMU that nobody has measured"
        yield Finding("poor", text, "run calib imu static and calib align")
    elif rig.align is None and rig.imu is not None:
        signs = (rig.geometry and rig.geometry.imu_sign) or (1, 1, 1)
        ax, ay = ((rig.imu.accel_mean_mps2[i] or 0.0) * signs[i] for i in range(2))
        rest_rad = math.atan2(ay, ax)
        if abs(rest_rad) > _MOUNTED_RAD:
            text = f"no align: the IMU reads {rest_rad:.2f} rad at rest, which the board takes for bending"
            yield Finding("poor", text, "run calib align")


def _pictures_and_ticks(rig: Rig) -> Iterator[Finding]:
    """Pictures that come more seldom than ticks, or earlier than the IMU's samples."""
    logs = [] if rig.align is None else rig.align.logs
    rates_hz = [one.camera_rate_hz for one in logs if one.camera_rate_hz]
    pictures_hz = median(rates_hz) if rates_hz else rig.tick_hz
    if pictures_hz < _LEAST_PICTURES * rig.tick_hz:
        yield Finding(
            "poor",
            f"the camera gives {pictures_hz:.3g} pictures a second and the board ticks at {rig.tick_hz:g} "
            "Hz: the guard takes a tick without a picture for a lost marker, and stops the pumps",
            f"let the board tick at the camera's rate: calib lowpass --rate {pictures_hz:.0f}Hz",
        )
    if rig.align is not None and rig.align.time_offset_s < 0.0:
        early_ms = -1e3 * rig.align.time_offset_s
        text = f"pictures are {early_ms:.1f} ms earlier than the IMU's samples, and count as of their time"
        yield Finding("remark", text)


def _judge_envelope(stated: Envelope, allowed: Mapping[str, Any], rest_m: float) -> list[Finding]:
    """Findings on an envelope that a person states: it stops a rig that rests, or hardly any."""
    least, greatest = allowed["least_length_m"], allowed["greatest_length_m"]
    if not least < rest_m < greatest:
        text = f"the envelope, {least:g} to {greatest:g} m, does not hold the rest length, {rest_m:g} m"
        return [Finding("poor", f"{text}: the guard stops the pumps of a rig that rests")]
    default = Envelope()
    names = ("rate_mps", "full_power_s", "open_loop_s", "apart_m")
    wide = [name for name in names if getattr(stated, name) > _WIDE * getattr(default, name)]
    wide += ["greatest_length_m"] if greatest > _WIDE * rest_m else []
    text = f"the envelope allows much more than by default, so that the guard acts late: {', '.join(wide)}"
    return [Finding("remark", text)] if wide else []


def make_header(rig: Rig, source: str) -> Header:
    """The header of a rig; one without a camera or plane makes a sketch that records.

    A lens that the firmware could not undo makes the camera's verdict in the header poor.

    Parameters
    ----------
    source : the file's name for messages.

    Raises `BadInputError` for values that the firmware cannot run with, by their key.
    """
    camera, inverse, plane = rig.camera, _inverse_lens(rig), plane_constants(rig, source)
    context = constants(Lookup(rig, source), plane)
    if camera is not None and inverse is not None:
        named = dict(zip(COEFFICIENTS, camera.optics.distortion.tolist(), strict=True))
        context |= {
            "lens": {name: named[name] for name in MODELS[camera.model]},
            "has_lens": camera.optics.fisheye or any(named.values()),
            "camera_verdict": camera.verdict.word
            if _undoes_lens(inverse) or not camera.verdict.ok
            else "poor",
        }
    inputs = {
        f"{section}/{name}": digest
        for section, names in rig.inputs.items()
        for name, digest in names.items()
        # Sections that name others as inputs; only files are inputs of the header.
        if name not in KINDS and (section != "plane" or plane is not None)
    }
    findings = [*_judge(rig, inverse)]
    if rig.envelope is not None:
        findings += _judge_envelope(rig.envelope, context["envelope"], context["rest_length_m"])
    verdict = Verdict.of(findings)
    text = rendered(
        "calib_constants.h.j2",
        camera=camera,
        inverse=inverse,
        plane=plane,
        rig_ok=verdict.ok and (plane is None or rig.controller is not None),
        simulated=rig.simulated,
        inputs=dict(sorted(inputs.items())),
        **context,
    )
    found = literals(text)
    canonical = "\n".join(f"{name} {literal}" for name, literal in found.items())
    digest = hashlib.sha256(f"{canonical}\n".encode()).hexdigest()
    text = text.replace("@SHA256@", digest).replace("@ID@", digest[:8].upper())
    return Header(text, found, digest, verdict)

"""calib_constants.h: every constant of rig.yaml that firmware needs, as float literals of C.

The text is a template's; here are the numbers, their literals, and what keeps text from a rig.yaml
from leaving a comment. The same rig gives the same bytes: no time and no path goes in.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from importlib import resources

import jinja2
import numpy as np

from calib import __version__
from calib.arrays import FloatArray
from calib.camera.undistortion import InversePolynomial
from calib.errors import BadInputError

__all__ = [
    "SCHEMA",
    "CameraConstants",
    "Constant",
    "camera_constants",
    "comment_text",
    "float_literal",
    "header_text",
]

SCHEMA = 1
"""Raised when a constant changes its name, unit or meaning."""

_SMALLEST_NORMAL = 1.1754943508222875e-38
_LARGEST = 3.4028234663852886e38


@dataclass(frozen=True)
class Constant:
    """One macro: its name, value, and what a reader has to know (unit, range, source)."""

    name: str
    value: float
    comment: str


@dataclass(frozen=True)
class CameraConstants:
    """What the header says of the camera.

    Attributes
    ----------
    image_size_px : width and height.
    model, verdict : of the camera.
    intrinsics : pinhole and distortion.
    inverse_lens, inverse : coefficients of the polynomial that undistorts, and all about it.
    plane : inverse homography of (2.11) and (2.12), row by row; empty without a plane.
    """

    image_size_px: tuple[int, int]
    model: str
    verdict: str
    intrinsics: tuple[Constant, ...]
    inverse_lens: tuple[Constant, ...]
    inverse: InversePolynomial
    plane: tuple[Constant, ...]
    plane_verdict: str


def float_literal(value: float, key: str) -> str:
    """A C literal that a compiler reads back as the binary32 nearest to `value`.

    Nine significant digits are enough for any binary32. Raises `BadInputError` for NaN, infinity,
    and magnitudes that binary32 holds only as subnormal or not at all; `key` names the value.
    """
    if not math.isfinite(value) or abs(value) > _LARGEST:
        raise BadInputError(f"{key} is {value!r}, which no float constant of C can hold")
    if value != 0.0 and abs(value) < _SMALLEST_NORMAL:
        raise BadInputError(f"{key} is {value!r}, too small for a normal float; set it to zero")
    text = f"{float(np.float32(value)):.9g}"
    if not any(c in text for c in ".e"):
        text += ".0"
    elif "." not in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}.0e{exponent}"
    return text + "f"


def comment_text(text: str) -> str:
    """Text that cannot end a C comment or start a trigraph, whatever it was: one line of ASCII."""
    plain = text.encode("unicode_escape").decode("ascii")
    # A backslash would continue a line or, with trigraphs, mean something else.
    return plain.replace("\\", "|").replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def camera_constants(
    image_size_px: tuple[int, int],
    model: str,
    verdict: str,
    intrinsics: dict[str, float],
    inverse: InversePolynomial,
    A_inverse: FloatArray | None,
    plane_verdict: str,
) -> CameraConstants:
    """Names, values and comments of the camera's constants.

    Parameters
    ----------
    intrinsics : by the names of rig.yaml (fx_px ... k1 ...).
    inverse : polynomial that undoes the lens.
    A_inverse : (3, 3) of (2.11), ideal pixels to metres.
    """
    what = {
        "fx_px": "focal length along u, px; sigma_mu of (2.5)",
        "fy_px": "focal length along v, px; sigma_nu of (2.5)",
        "skew_px": "skew, px; gamma of (2.5)",
        "cx_px": "principal point, px from the centre of the left column; mu_0 of (2.5)",
        "cy_px": "principal point, px from the centre of the top row; nu_0 of (2.5)",
    }
    rows = [
        Constant(
            f"CALIB_CAMERA_{name.upper()}",
            value,
            what.get(name, "lens, dimensionless, OpenCV's order and signs"),
        )
        for name, value in intrinsics.items()
    ]
    radial = [
        Constant(
            f"CALIB_LENS_INVERSE_C{i}",
            value,
            f"coefficient of r2^{i}, dimensionless",
        )
        for i, value in enumerate(inverse.radial, start=1)
    ]
    plane = (
        []
        if A_inverse is None
        else [
            Constant(
                f"CALIB_PLANE_INVERSE_{i + 1}{j + 1}",
                float(A_inverse[i, j]),
                "entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12)",
            )
            for i in range(3)
            for j in range(3)
        ]
    )
    return CameraConstants(
        image_size_px, model, verdict, tuple(rows), tuple(radial), inverse, tuple(plane), plane_verdict
    )


def _environment() -> jinja2.Environment:
    source = resources.files("calib.firmware").joinpath("templates/calib_constants.h.j2").read_text("utf-8")
    return jinja2.Environment(
        loader=jinja2.DictLoader({"calib_constants.h": source}),
        undefined=jinja2.StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def header_text(camera: CameraConstants, inputs: dict[str, str]) -> str:
    """The header; `inputs` holds the SHA-256 of each input by name."""
    constants = [*camera.intrinsics, *camera.inverse_lens, *camera.plane]
    literals = {c.name: float_literal(c.value, c.name) for c in constants}
    canonical = "\n".join(f"{name} {literal}" for name, literal in literals.items())
    digest = hashlib.sha256(f"{SCHEMA}\n{camera.image_size_px}\n{canonical}\n".encode()).hexdigest()
    environment = _environment()
    environment.filters["comment"] = comment_text
    return environment.get_template("calib_constants.h").render(
        schema=SCHEMA,
        version=__version__,
        digest=digest,
        identity=digest[:8].upper(),
        camera=camera,
        literals=literals,
        inputs=dict(sorted(inputs.items())),
    )

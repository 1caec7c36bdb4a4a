"""Golden vectors: a short run that drives every constant, with what the reference makes of it.

The angle goes to +-1.3 rad, where the series and the angle filter have all their terms; the marker
crosses the picture; the wanted lengths sweep the feed-forward from its dead zone to its limit, and both
controllers meet both limits. A lost marker, a lost IMU and a refused reference are among the ticks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from calib.firmware.conformance import (
    MODE_ORIENTATION,
    MODE_POSITION,
    Inputs,
    Outputs,
    Reference,
    binary32,
)
from calib.firmware.conformance_fused import reference_of
from calib.firmware.header import SCHEMA, Header, environment, identity_of
from calib.firmware.literals import float_literal, values
from calib.firmware.vectors_fused import directed_fused, spoilt

__all__ = ["TOLERANCE", "Vector", "binary32", "directed", "selftest_text", "vectors"]

TOLERANCE = {"phi_rad": 2e-6, "marker_m": 2e-7, "q_m": 2e-6, "pwm": 0.01}
"""What a board may differ by from float64."""

FUSED_TICKS = 72
"""Golden vectors of the fused estimator: pictures until it runs, a swing, a new start, rest."""


@dataclass(frozen=True)
class Vector:
    """One tick: what goes in and what has to come out."""

    given: Inputs
    wanted: Outputs


def directed(constants: Mapping[str, float], ticks: int) -> list[Inputs]:
    """Ticks that reach every part of the pipeline.

    Parameters
    ----------
    constants : of a header, by name.
    """
    width, height = constants["CALIB_CAMERA_GREATEST_U_PX"], constants["CALIB_CAMERA_GREATEST_V_PX"]
    mount, rest = constants["CALIB_IMU_MOUNT_ANGLE_RAD"], constants["CALIB_REST_LENGTH_M"]
    bias = constants["CALIB_IMU_GYRO_BIAS_RADPS"]
    made = []
    for k in range(ticks):
        share = k / max(ticks - 1, 1)
        turn = 2.0 * math.pi * share
        phi = 1.3 * math.sin(3.0 * turn + 1.2)
        mode = (MODE_POSITION, MODE_ORIENTATION)[(4 * k // ticks) % 2]
        sweep = rest * (0.98 + 0.45 * abs(math.sin(2.0 * turn)))
        reference = (
            (sweep, 2.43 * rest - sweep) if mode == MODE_POSITION else (0.4 * math.cos(5.0 * turn), 0.0)
        )
        given = Inputs(
            u_px=0.5 * width * (1.0 + 0.8 * math.cos(2.0 * turn)),
            v_px=0.5 * height * (1.0 + 0.8 * math.sin(3.0 * turn)),
            ax_mps2=9.81 * math.cos(phi + mount) + 0.8 * math.sin(11.0 * turn),
            ay_mps2=9.81 * math.sin(phi + mount) + 0.8 * math.cos(13.0 * turn),
            gz_radps=bias + 2.5 * math.sin(7.0 * turn),
            reference=reference,
            mode=mode,
        )
        made.append(binary32(spoilt(given, k)))
    return made


def vectors(header: Header, ticks: int = 48, fused: bool = False) -> list[Vector]:
    """Golden vectors of a header that has a plane; `fused` for CALIB_FUSED 1."""
    constants = values(header.literals)
    reference = reference_of(constants, fused=fused)
    given = directed_fused(constants, ticks, period=ticks) if fused else directed(constants, ticks)
    return [Vector(one, reference.step(one)) for one in given]


def _lines(vector: Vector) -> list[str]:
    given, wanted = vector.given, vector.wanted
    sensors = int(given.marker_seen) + 2 * int(given.imu_read)
    into = [given.u_px, given.v_px, given.ax_mps2, given.ay_mps2, given.gz_radps, *given.reference]
    out = [wanted.phi_rad, *wanted.marker_m, *wanted.head_m, *wanted.q_m, *wanted.pwm]

    def row(numbers: list[float]) -> str:
        # Zero where a value is too small for a normal float.
        return ", ".join(float_literal(v if abs(v) > 1e-30 else 0.0, "calib_selftest_rows") for v in numbers)

    return [row([*into, float(sensors), float(given.mode)]), row(out), row([float(wanted.flags)])]


def selftest_text(header: Header) -> str:
    """calib_selftest.h of a header that has a plane."""
    from calib import __version__

    fused = header.literals["CALIB_HAS_FUSED"] == "1"

    return (
        environment()
        .get_template("calib_selftest.h.j2")
        .render(
            version=__version__,
            schema=SCHEMA,
            identity=identity_of(header)[:8].upper(),
            undistort=int(Reference(values(header.literals)).undistort),
            rows=[_lines(vector) for vector in vectors(header)],
            fused_rows=[_lines(vector) for vector in vectors(header, FUSED_TICKS, fused=True)]
            if fused
            else [],
            tolerance=TOLERANCE,
        )
    )

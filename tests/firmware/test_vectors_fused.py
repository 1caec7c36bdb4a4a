"""Directed ticks of the fused estimator: coherent, and they reach what they are there for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from firmware_rigs import header

from calib.core.errors import BadInputError
from calib.stages.firmware.conformance import (
    ACCEL_WEAK,
    BAD_REFERENCE,
    IMU_HELD,
    MARKER_HELD,
    MOVING,
    REJECTED,
    SATURATED,
    FusedReference,
    Reference,
)
from calib.stages.firmware.literals import values
from calib.stages.firmware.vectors import (
    FUSED_TICKS,
    PERIOD,
    Motion,
    coherent,
    pixel_of,
    selftest_text,
    vectors,
)


@pytest.mark.parametrize("kind", ["fused", "full"])
def test_they_reach_every_branch(kind: str) -> None:
    seen, resting = 0, 0
    for vector in vectors(header(kind), FUSED_TICKS, fused=True):
        seen |= vector.wanted.flags
        resting += not vector.wanted.flags & (MOVING | MARKER_HELD)
    for flag in (MARKER_HELD, IMU_HELD, ACCEL_WEAK, REJECTED, MOVING, BAD_REFERENCE, *SATURATED):
        assert seen & flag, hex(flag)
    assert resting > 10


@pytest.mark.parametrize("kind", ["fused", "full"])
def test_the_estimator_follows_the_motion(kind: str) -> None:
    """Pictures, gyroscope and accelerometer tell one story: the estimate is near the motion they are of."""
    constants = values(header(kind).literals)
    reference = FusedReference(constants)
    motion = Motion(constants["CALIB_REST_LENGTH_M"], PERIOD, 0.0)
    off = []
    for k, given in enumerate(coherent(constants, 2 * PERIOD)):
        out = reference.step(given)
        phi, length = motion.at(k)
        off.append((out.phi_rad - phi, 0.5 * sum(out.q_m) - length))
    worst = np.abs(np.array(off)[PERIOD // 2 :]).max(axis=0)
    assert worst[0] < 0.05
    # A steady acceleration a leaves the length a / K_v behind; here 0.15 l0 (2 pi / ticks)^2.
    behind = 0.15 * constants["CALIB_REST_LENGTH_M"] * (2.0 * np.pi / (0.55 * PERIOD)) ** 2
    assert worst[1] < behind / constants["CALIB_FUSED_MOVING_RATE"]


@pytest.mark.parametrize("undistort", [False, True])
def test_a_pixel_is_that_of_its_place(undistort: bool) -> None:
    reference = Reference(values(header("full").literals), undistort)
    given = vectors(header("full"))[0].given
    for X, Y in ((0.0, 0.08), (-0.05, 0.06), (0.04, 0.11)):
        u, v = pixel_of(reference, X, Y)
        reference.step(replace(given, u_px=u, v_px=v))
        assert reference.memory.marker == pytest.approx((X, Y), abs=1e-8)
    with pytest.raises(BadInputError, match="no pixel shows"):
        pixel_of(reference, 5.0, -9.0)


def test_the_self_test_has_both_sets_where_the_rig_has_both() -> None:
    assert "#if CALIB_FUSED\n    " in selftest_text(header("fused"))
    assert selftest_text(header()).count("#if CALIB_FUSED") == 1

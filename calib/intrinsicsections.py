"""An IMU's intrinsics as the section `imu_intrinsics` of rig.yaml."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from calib.arrays import FloatArray
from calib.imu.accelerometer import ANGLES, LEAST_SPAN
from calib.imu.gyroscope import GYRO_ANGLES, Gyroscope
from calib.imu.intrinsics import Intrinsics
from calib.imu.intrinsics_verdict import IntrinsicsJudgement
from calib.rig import finite_or_none
from calib.rig_imu_intrinsics import (
    AccelIntrinsics,
    GyroIntrinsics,
    GyroSigma,
    ImuIntrinsics,
    IntrinsicsSigma,
)

__all__ = ["intrinsics_section"]

_NONE: list[float | None] = [None, None, None]


def _three(values: FloatArray) -> list[float | None]:
    """x, y, z with null for what is not finite or not there."""
    out = [finite_or_none(value) for value in values.tolist()]
    return out + [None] * (3 - len(out))


def _named(names: Sequence[str], values: FloatArray) -> dict[str, float | None]:
    return {
        name: finite_or_none(value)
        for name, value in zip(names, values.tolist(), strict=True)
        if not math.isnan(value)
    }


def _padded(matrix: FloatArray) -> list[list[float]]:
    """A matrix (r, c) as rows of three, zero where there is nothing."""
    out = np.zeros((3, 3))
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    rows: list[list[float]] = out.tolist()
    return rows


def _accel(result: Intrinsics) -> AccelIntrinsics:
    unit: Literal["m/s2", "counts"] = "counts" if result.log.accel_unit == "counts" else "m/s2"
    accel = result.accel
    if accel is None:
        unknown = IntrinsicsSigma(bias=_NONE, scale=_NONE)
        return AccelIntrinsics(unit=unit, bias=_NONE, scale=_NONE, sigma=unknown)
    d = len(accel.bias)
    told = accel.span >= LEAST_SPAN
    nothing = np.full(d, math.inf)
    sigma = accel.sigma if told else np.full(len(accel.sigma), math.inf)
    names = ANGLES[d] if accel.skewed and told else ()
    k = len(names)
    return AccelIntrinsics(
        unit=unit,
        bias=_three(accel.bias if told else nothing),
        scale=_three(accel.scale if told else nothing),
        misalignment_rad=_named(names, accel.angles[:k]),
        sigma=IntrinsicsSigma(
            bias=_three(sigma[:d]),
            scale=_three(sigma[d : 2 * d]),
            misalignment_rad=_named(names, sigma[2 * d : 2 * d + k]),
        ),
        matrix=_padded(accel.matrix) if told else None,
        rms_mps2=accel.rms_mps2 if told else None,
        disagreement_mps2=accel.tau_mps2 if told else None,
    )


def _gyro(result: Intrinsics, gyro: Gyroscope) -> GyroIntrinsics:
    unit: Literal["rad/s", "counts"] = "counts" if result.log.gyro_unit == "counts" else "rad/s"
    used = np.isfinite(gyro.scale)
    told = np.isfinite(gyro.scale_sigma) & used & (result.foreign is None)
    angle_told = np.isfinite(gyro.angle_sigma) & (result.foreign is None)
    scale, angles = np.where(told, gyro.scale, math.nan), np.where(angle_told, gyro.angles, math.nan)
    bias, names = gyro.bias, tuple(GYRO_ANGLES)
    return GyroIntrinsics(
        unit=unit,
        bias=_three(np.where(used, bias.bias, math.nan)),
        scale=_three(scale),
        misalignment_rad=_named(names, angles),
        sigma=GyroSigma(
            bias=_three(np.where(used, bias.sigma, math.nan)),
            scale=_three(np.where(told, gyro.scale_sigma, math.nan)),
            misalignment_rad=_named(names, np.where(angle_told, gyro.angle_sigma, math.nan)),
            sensitivity=None if bias.sensitivity_sigma is None else _padded(bias.sensitivity_sigma),
        ),
        matrix=_padded(gyro.matrix) if told[used].all() else None,
        start_bias=_three(np.where(used, gyro.initial_bias, math.nan)),
        sensitivity=None if bias.sensitivity is None else _padded(bias.sensitivity),
        rms_rad=gyro.rms_rad,
        turns=len(gyro.turns_s),
    )


def intrinsics_section(result: Intrinsics, judgement: IntrinsicsJudgement) -> ImuIntrinsics:
    """The `imu_intrinsics` section of a calibration; what the log does not tell is null."""
    return ImuIntrinsics(
        gravity_mps2=result.gravity_mps2,
        planar=result.planar,
        rate_hz=result.sampling.rate_hz,
        rests=len(result.rests),
        poses=result.poses,
        rest_s=sum(rest.duration_s for rest in result.rests),
        degrees_of_freedom=None if result.accel is None else result.accel.dof,
        initial_rest_s=result.quiet.initial_s,
        threshold=result.multiple,
        thresholds={f"{trial.multiple:g}": finite_or_none(trial.rms_mps2) for trial in result.trials},
        accel=_accel(result),
        gyro=None if result.gyro is None else _gyro(result, result.gyro),
        verdict=judgement.verdict,  # type: ignore[arg-type]  # pydantic checks the word
        reasons=list(judgement.reasons),
        remarks=list(judgement.remarks),
        advice=list(judgement.advice),
    )

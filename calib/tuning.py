"""`calib replay --tune`: the section `estimator` of rig.yaml from logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from calib.errors import BadInputError
from calib.estimator.constant_gain import tick_noise
from calib.estimator.gains import MOST_DELAY_TICKS, design
from calib.estimator.noise import tune
from calib.estimator.setup import Setup
from calib.files import shown
from calib.replay import Progress, prepared
from calib.replaying import rows_of
from calib.rig import Rig
from calib.rig_estimator import Estimator, EstimatorGain, EstimatorLevel
from calib.smoothing import joined

__all__ = ["gain_section", "tuned_section"]

_MOST_ROWS = 20_000


_TICK_HZ = 60.0


def gain_section(setup: Setup, rate_hz: float) -> EstimatorGain | None:
    """Constant gains at a rate of ticks; None without pictures, or where they are more than 8 ticks late."""
    delay_s = max(float(setup.start.sensor[7]), 0.0)
    if delay_s * rate_hz > MOST_DELAY_TICKS or not setup.view.any():
        return None
    lever_m = 0.5 * float(setup.start.head[1]) + float(setup.start.sensor[6])
    return EstimatorGain(**asdict(design(tick_noise(setup), rate_hz, delay_s, lever_m)))


def tuned_section(
    logs: Sequence[Path],
    rig: Rig,
    rig_path: Path,
    progress: Progress | None = None,
    topics: Path | None = None,
) -> Estimator:
    """Noise by maximum likelihood on the first 20,000 rows of each log.

    Raises `BadInputError` for logs that cannot be used, or without camera and IMU.
    """
    every, first = [], None
    for path in logs:
        setup, found, stream, _ = prepared(path, rig.model_copy(update={"estimator": None}), rig_path, topics)
        if not (found.camera and found.imu):
            raise BadInputError(f"{shown(path)}: tuning needs camera and IMU, and the log lacks one")
        parts, count = [], 0
        for log in stream:
            parts.append(rows_of(log, found.ticks))
            count += len(log)
            if count >= _MOST_ROWS:
                break
        every.append(joined(parts))
        first = setup if first is None else first
    if first is None:
        raise BadInputError("LOG: none given, expected at least one")
    found_noise = tune(first, every, progress)
    sigma = {"jitter_px": found_noise.jitter_px.sigma}
    sigma |= {name: factor.sigma for name, factor in found_noise.factors.items()}
    reasons = []
    if found_noise.jitter_px.sigma is None:
        reasons.append("the logs do not bound the tracker's jitter")
    else:
        sigma["jitter_px"] = found_noise.jitter_px.sigma * found_noise.jitter_px.value
    return Estimator(
        jitter_px=found_noise.jitter_px.value,
        sigma=sigma,
        levels=[
            EstimatorLevel(
                name=level.name,
                accel_phi_radps2=level.accel_phi_radps2,
                accel_length_mps2=level.accel_length_mps2,
                memory_s=level.memory_s,
                friction_s=level.friction_s,
                walk_phi_rad_per_sqrt_s=level.walk_phi,
                walk_length_m_per_sqrt_s=level.walk_length,
            )
            for level in found_noise.setup.process.levels
        ],
        constant_gain=gain_section(found_noise.setup, rig.lowpass.rate_hz if rig.lowpass else _TICK_HZ),
        gain_per_row=(found_noise.after - found_noise.before) / max(found_noise.rows, 1),
        logs=[shown(path.name) for path in logs],
        verdict="poor" if reasons else "ok",
        reasons=reasons,
    )

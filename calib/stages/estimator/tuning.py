"""`calib replay --tune`: the section `estimator` of rig.yaml from logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.result import judged
from calib.core.rig import Rig
from calib.core.stage import ProgressCall
from calib.core.verdict import Finding, Verdict
from calib.stages.estimator.constant_gain import MOST_DELAY_TICKS, design, tick_noise
from calib.stages.estimator.driven import Drive
from calib.stages.estimator.kinematic import Rows, Setup
from calib.stages.estimator.noise import tune
from calib.stages.estimator.read import drive_from_rig, noise_at_rest, rows_of
from calib.stages.estimator.replay import opened
from calib.stages.estimator.section import Estimator, EstimatorDriven, EstimatorGain

_MOST_ROWS = 20_000
_MOST_DRIVEN_ROWS = 6_000


def gain_section(setup: Setup, rate_hz: float) -> EstimatorGain | None:
    """Constant gains at a rate of ticks; None without pictures, or where they are more than 8 ticks late."""
    if setup.delay_s * rate_hz > MOST_DELAY_TICKS or not setup.view.any():
        return None
    lever_m = 0.5 * float(setup.start.head[1]) + float(setup.start.sensor[6])
    return design(tick_noise(setup), rate_hz, setup.delay_s, lever_m)


def _driven_section(
    setup: Setup, drive: Drive, logs: Sequence[Rows], progress: ProgressCall | None
) -> tuple[EstimatorDriven | None, dict[str, float | None]]:
    """Walks of the driven model from the first 6,000 rows of the logs with commands, and their deviations."""
    from calib.stages.estimator.noise import tune_driven

    short = [rows[:_MOST_DRIVEN_ROWS] for rows in logs if np.isfinite(rows.commands).all(axis=1).any()]
    if not short:
        return None, {}
    found, factors = tune_driven(setup, drive, short, progress)
    turning, growing = found.walk_rates
    section = EstimatorDriven(
        walk_disturbance_N_per_sqrt_s=found.walk_disturbance,
        walk_turning_radps_per_sqrt_s=turning,
        walk_growing_mps_per_sqrt_s=growing,
        walk_forces_N_per_sqrt_s=found.walk_forces,
    )
    return section, {f"driven_{name}": factor.sigma for name, factor in factors.items()}


def tuned_section(
    logs: Sequence[Path],
    rig: Rig,
    rig_path: Path,
    progress: ProgressCall | None = None,
    options: LogOptions = NOTHING_STATED,
) -> Estimator:
    """Noise by maximum likelihood on the first 20,000 rows of each log, of both models where commands are.

    Raises `BadInputError` for logs that cannot be used, or without camera and IMU.
    """
    every, setups, rests = [], [], []
    bare = replace(rig, estimator=None)
    drive = drive_from_rig(bare)
    for path in logs:
        source = opened(path, bare, rig_path, options)
        if not source.both or source.periods.pose:
            raise BadInputError(f"{shown(path)}: tuning needs camera and IMU, and the log lacks one")
        parts, count = [], 0
        for log in source.stream:
            parts.append(rows_of(log, source.periods))
            count += len(log)
            if count >= _MOST_ROWS:
                break
        every.append(Rows.joined(parts))
        setups.append(source.setup)
        rests.append(noise_at_rest(bare, source.periods))
    found_noise = tune(setups[0], every, progress)
    sigma = {"jitter_px": found_noise.jitter_px.sigma}
    sigma |= {name: factor.sigma for name, factor in found_noise.factors.items()}
    driven, more = _driven_section(found_noise.setup, replace(drive, imu_noise=rests[0]), every, progress)
    sigma |= more
    findings = []
    if found_noise.jitter_px.sigma is None:
        findings.append(Finding("poor", "the logs do not bound the tracker's jitter"))
    else:
        sigma["jitter_px"] = found_noise.jitter_px.sigma * found_noise.jitter_px.value
    return Estimator(
        jitter_px=found_noise.jitter_px.value,
        sigma=sigma,
        levels=list(found_noise.setup.process.levels),
        driven=driven,
        constant_gain=gain_section(found_noise.setup, rig.tick_hz),
        gain_per_row=(found_noise.after - found_noise.before) / max(found_noise.rows, 1),
        logs=[shown(path.name) for path in logs],
        **judged(Verdict.of(findings)),
    )

"""What logs at rest are worth: a verdict, the reasons for it, and remarks that do not change it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.imu.static import AxisNoise, Static, StaticLog

__all__ = ["Judgement", "judge"]

_MOST_MISSING = 0.02
_MOST_REPEATED = 0.02
_MOST_SIGMA_OF_N = 0.10
_LEAST_REST_S = 10.0
_LEAST_CHANCE = 1e-4


@dataclass(frozen=True)
class Judgement:
    """Verdict "ok" or "poor", with sentences."""

    verdict: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    advice: tuple[str, ...]


def _of_log(log: StaticLog, axes: tuple[str, ...]) -> tuple[list[str], list[str]]:
    s = log.sampling
    reasons = [
        f"{log.source}: moves from {motion.from_s:.1f} to {motion.to_s:.1f} s, seen most in "
        f"{axes[motion.axis]}; that stretch is left out"
        for motion in log.motions[:3]
    ]
    remarks = [
        f"{log.source}: split at a gap of {gap.duration_s:.4g} s after {gap.at_s:.2f} s"
        for gap in s.gaps
        if gap.split
    ]
    if len(log.motions) > 3:
        reasons.append(f"{log.source}: moves {len(log.motions) - 3} more times")
    for axis, count in zip(axes, s.at_limit.tolist(), strict=True):
        if count:
            reasons.append(f"{log.source}: {axis} is at the end of its range in {count} samples")
    short = [gap for gap in s.gaps if not gap.split]
    if short:
        longest = max(short, key=lambda gap: gap.duration_s)
        sentence = (
            f"{log.source}: {s.missing} samples missing in {len(short)} gap(s), the longest "
            f"{1e3 * longest.duration_s:.3g} ms after {longest.at_s:.2f} s; filled by straight lines"
        )
        (reasons if s.missing > _MOST_MISSING * s.samples else remarks).append(sentence)
    if s.repeated_rows:
        share = s.repeated_rows / (s.samples + s.repeated_rows)
        sentence = f"{log.source}: {s.repeated_rows} rows ({share:.2%}) repeat the one before; dropped"
        (reasons if share > _MOST_REPEATED else remarks).append(sentence)
    if s.repeated_stamps:
        share = s.repeated_stamps / s.samples
        remarks.append(
            f"{log.source}: {s.repeated_stamps} time stamps ({share:.2%}) repeat the one before with "
            "other readings; counted as samples of their own"
        )
    return reasons, remarks


def _of_axis(noise: AxisNoise) -> tuple[list[str], list[str]]:
    if noise.allan is None:
        return [
            f"{noise.axis} never changes: it is stuck at {noise.bias:.6g}, or its step hides all noise"
        ], []
    reasons, remarks, N = [], [], noise.allan.N
    if not N.sigma <= _MOST_SIGMA_OF_N * N.value:
        share = N.sigma / N.value if N.value > 0.0 else math.inf
        reasons.append(f"{noise.axis}: the white noise is known to {share:.0%} only; the log is too short")
    if noise.allan.chance < _LEAST_CHANCE:
        reasons.append(f"{noise.axis}: its deviation is not that of white noise, flicker and a random walk")
    elif noise.allan.fit_s[0] > 1.5 * float(noise.allan.tau_s[0]):
        remarks.append(
            f"{noise.axis}: below {noise.allan.fit_s[0]:.3g} s the deviation is not that of white noise "
            "(a filter in the sensor, or its step); the fit begins there"
        )
    return reasons, remarks


def judge(result: Static) -> Judgement:
    """Verdict of an analysis of logs at rest."""
    reasons: list[str] = []
    remarks: list[str] = []
    for log in result.logs:
        more, said = _of_log(log, result.axes)
        reasons += more
        remarks += said
    for noise in result.noise:
        more, said = _of_axis(noise)
        reasons += more
        remarks += said
    unsupported = [n.axis for n in result.noise if n.allan is not None and not n.allan.K.supported]
    longest = max(log.rest_s for log in result.logs)
    if longest < _LEAST_REST_S:
        reasons.append(
            f"{longest:.3g} s at rest are too short to tell a bias from noise, expected {_LEAST_REST_S:g} s"
        )
    advice = []
    if unsupported:
        remarks.append(
            f"{longest:.4g} s do not show a random walk of {', '.join(unsupported)}; an upper bound is given"
        )
        advice.append("a log of several hours at rest would show the random walk of the bias")
    if any(log.motions for log in result.logs):
        advice.append("log again with the rig untouched, on a table that does not shake")
    return Judgement("poor" if reasons else "ok", tuple(reasons), tuple(remarks), tuple(advice))

"""The drift comparison as plain values for the JSON document, and as sentences about the sampling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from calib.imu.drift import NOT_A_RANKING, LogDrift, Measures, spread_of
from calib.imu.mahony import Mahony
from calib.imu.tracks import Tuned
from calib.rig import Rig

__all__ = ["drift_document", "sampling_remarks", "tuned_filter"]

_LEAST_UPRIGHT = 0.1

_ABOUT = {
    "truth": "error against true_phi_rad; slope, offset and Allan deviation without the first seconds",
    "rest": "angle in the stretches at rest, without their first seconds; the offset is against the "
    "accelerometer's mean angle",
    "nothing": "the log never rests and has no true_phi_rad, so that it shows no drift",
}


def tuned_filter(rig: Rig) -> Tuned | None:
    """What the section orientation_filter recommends, None where the rig has none."""
    section = rig.orientation_filter
    if section is None:
        return None
    return Tuned(Mahony(section.Kp_per_s, section.Ki_per_s2), section.rate_of_angle == "up vector")


def sampling_remarks(log: LogDrift) -> list[str]:
    """Sentences about gaps and repeated rows of a log, and about a sensor that lies flat."""
    s = log.sampling
    said = [
        f"{log.source}: split at a gap of {gap.duration_s:.4g} s after {gap.at_s:.2f} s"
        for gap in s.gaps
        if gap.split
    ]
    short = [gap for gap in s.gaps if not gap.split]
    if short:
        longest = max(short, key=lambda gap: gap.duration_s)
        said.append(
            f"{log.source}: {s.missing} samples missing in {len(short)} gap(s), the longest "
            f"{1e3 * longest.duration_s:.3g} ms after {longest.at_s:.2f} s; filled by straight lines"
        )
    if s.repeated_rows:
        share = s.repeated_rows / (s.samples + s.repeated_rows)
        said.append(f"{log.source}: {s.repeated_rows} rows ({share:.2%}) repeat the one before; dropped")
    if s.repeated_stamps:
        said.append(
            f"{log.source}: {s.repeated_stamps} time stamps ({s.repeated_stamps / s.samples:.2%}) repeat the "
            "one before with other readings; counted as samples of their own"
        )
    if log.upright < _LEAST_UPRIGHT:
        tilt = math.degrees(math.acos(math.sqrt(log.upright)))
        said.append(
            f"{log.source}: gravity is {tilt:.0f} degrees out of the sensor's x-y plane, where the angle "
            "atan2(ay, ax) is hardly defined; noise and drift of all methods are large for that reason"
        )
    return said


def _method(m: Measures) -> dict[str, Any]:
    degrees = math.degrees
    return {
        "offset_deg": degrees(m.offset_rad),
        "slope_degps": degrees(m.slope.value),
        "sigma_degps": degrees(m.slope.sigma),
        "interval_degps": [degrees(m.slope.low), degrees(m.slope.high)],
        "allan_1s_deg": degrees(m.allan_1s_rad),
        "allan_100s_deg": degrees(m.allan_100s_rad),
        "rmse_deg": degrees(m.rmse_rad),
        "lag_ms": 1e3 * m.lag_s,
    }


def _log(log: LogDrift) -> dict[str, Any]:
    s = log.sampling
    return {
        "name": log.source,
        "duration_s": s.duration_s,
        "rate_hz": s.rate_hz,
        "jitter_s": s.jitter_s,
        "missing": s.missing,
        "gaps": sum(not gap.split for gap in s.gaps),
        "splits": sum(gap.split for gap in s.gaps),
        "repeated_rows": s.repeated_rows,
        "repeated_stamps": s.repeated_stamps,
        "against": log.against,
        "about": _ABOUT[log.against],
        "judged_s": log.judged_s,
        "moving_s": log.moving_s,
        "methods": {m.name: _method(m) for m in log.measures},
        "skipped": list(log.skipped),
        "remarks": sampling_remarks(log),
    }


def drift_document(
    logs: Sequence[LogDrift], hashes: dict[str, str], tuned: Tuned | None, remarks: Sequence[str] = ()
) -> dict[str, Any]:
    """The document's section `drift`; what a log does not show is not finite.

    Parameters
    ----------
    hashes : SHA-256 of each log by name.
    remarks : about reading the logs.
    """
    out: dict[str, Any] = {
        "note": NOT_A_RANKING,
        "logs": [_log(log) for log in logs],
        "methods": {
            one.name: {
                "mean_degps": math.degrees(one.mean_radps),
                "spread_degps": math.degrees(one.spread_radps),
                "logs": one.logs,
            }
            for one in spread_of(logs)
        },
        "remarks": list(remarks),
        "provenance": {"inputs": hashes},
    }
    if tuned is not None:
        out["tuned"] = {
            "Kp_per_s": tuned.gains.Kp,
            "Ki_per_s2": tuned.gains.Ki,
            "rate_of_angle": "up vector" if tuned.up_vector else "-gz",
        }
    return out

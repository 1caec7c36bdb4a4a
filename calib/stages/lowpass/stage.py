"""The low-pass of a rig: the positions in its logs, and its section of rig.yaml."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography
from calib.io.logs import check_time, read_log
from calib.stages.camera.model import Camera, undistort
from calib.stages.lowpass.filters import (
    Filter,
    Spectrum,
    Ticks,
    cutoff_hz,
    dc_delay_s,
    dead_band_binary32,
    decibels,
    digital_poles,
    fixed_point,
    frequency_response,
    grid_step,
    group_delay_s,
    jitter_after,
    motion_lost,
    noise_gain,
    on_ticks,
    quantisation_hz,
    sampling_rate_hz,
    spectrum,
    step_response,
)
from calib.stages.lowpass.section import LowPass, LowPassAxis, LowPassLog, LowPassSection

_RATE_OFF = 0.05
_CUTOFF_OFF = 0.01
_TOO_MUCH_CHANGED = 0.5
_STICKS_MM = 0.01
"""A tenth of what a pixel of the rig's camera leaves after averaging; more would be seen."""
_TIMES_CUTOFF = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_PARTS_OF_RATE = (0.1, 0.25, 0.45)


@dataclass(frozen=True)
class Positions:
    """Where a log's camera saw the marker.

    Attributes
    ----------
    source : name for messages.
    unit : "m" on the plane where the rig has one, "px" otherwise.
    names : of the two coordinates.
    rate_hz : of the log.
    ticks : the coordinates (n, 2).
    pixels : the same in pixels, for the grid that they lie on.
    spectra : of each coordinate, over the longest piece.
    """

    source: str
    unit: str
    names: tuple[str, str]
    rate_hz: float
    ticks: Ticks
    pixels: Ticks
    spectra: tuple[Spectrum, Spectrum]


def positions_from_log(
    path: Path, rate_hz: float | None, camera: Camera | None, A_inverse: FloatArray | None
) -> Positions:
    """The marker in a log, one position per tick.

    Parameters
    ----------
    rate_hz : of the filter; None takes the log's own.
    camera, A_inverse : of the rig; without both the positions stay in pixels.

    Raises `BadInputError` for a log without camera, with too few samples, whose time runs backwards,
    whose marker lies beyond the plane's horizon, or of another rate.
    """
    log = read_log(path)
    check_time(log)
    rows = log.sampled("u_px", "v_px")
    if any(name not in log.columns for name in ("u_px", "v_px")):
        raise BadInputError(f"{log.source}: has no columns u_px and v_px, expected a log with the camera")
    if len(rows) < 2:
        count = "one row" if len(rows) else "no row"
        raise BadInputError(
            f"{log.source}: has {count} in which the camera saw the marker, expected a series"
        )
    t = log.t_s[rows]
    pixels = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
    values, unit, names = pixels, "px", ("u", "v")
    if camera is not None and A_inverse is not None:
        rays = undistort(camera, pixels)
        ideal = np.column_stack([rays, np.ones(len(rays))]) @ camera.K[:2].T
        values, unit, names = apply_homography(A_inverse, ideal), "m", ("x", "y")
        lost = np.nonzero(np.isnan(values).any(axis=1))[0]
        if len(lost):
            u, v = pixels[lost[0]]
            raise BadInputError(
                f"{log.source}, line {log.lines[rows[lost[0]]]}: the marker at ({u:g}, {v:g}) px is not on "
                "the rig's plane, expected a log of this rig's camera"
            )
    try:
        own = sampling_rate_hz(t)
        rate = own if rate_hz is None else rate_hz
        if abs(own / rate - 1.0) > _RATE_OFF:
            raise BadInputError(
                f"has {own:.4g} camera samples/s, expected the {rate:g} Hz that the filter is designed for"
            )
        ticks = on_ticks(t, values, rate)
        piece = ticks.longest.values
        spectra = (spectrum(piece[:, 0], rate), spectrum(piece[:, 1], rate))
    except BadInputError as error:
        raise BadInputError(f"{log.source}: {error}") from error
    return Positions(log.source, unit, names, own, ticks, on_ticks(t, pixels, rate), spectra)


def _log_section(filter_: Filter, seen: Positions) -> LowPassLog:
    scale = 1e3 if seen.unit == "m" else 1.0
    delay_s = dc_delay_s(filter_.sections, seen.ticks.rate_hz)
    axes = {}
    for i, (name, of) in enumerate(zip(seen.names, seen.spectra, strict=True)):
        # The grid is the picture's: u for x and v for y, which a camera that looks along the normal shows so.
        pixels = seen.pixels.longest.values[:, i]
        f = np.full(3, np.nan)
        if of.motion_hz > 0.0:
            f = quantisation_hz(pixels, grid_step(pixels), seen.ticks.rate_hz)
        known = bool(np.isfinite(f).all())
        H = frequency_response(filter_.sections, f[: 3 * known], seen.ticks.rate_hz)
        axes[name] = LowPassAxis(
            jitter_before=scale * of.jitter,
            jitter_after=scale * jitter_after(of, filter_.sections),
            motion_hz=of.motion_hz,
            motion_changed=motion_lost(of, filter_.sections, delay_s),
            quantisation_hz=f[: 3 * known].tolist(),
            quantisation_db=decibels(H).tolist(),
        )
    return LowPassLog(
        name=Path(seen.source).name,
        unit="mm" if seen.unit == "m" else "px",
        rate_hz=seen.rate_hz,
        ticks=sum(len(piece.t_s) for piece in seen.ticks.pieces),
        held=seen.ticks.held,
        dropped=seen.ticks.dropped,
        pieces=len(seen.ticks.pieces),
        axes=axes,
    )


def lowpass_section(
    filter_: Filter, workspace_m: Sequence[float], seen: Positions | None = None, wanted: float | None = None
) -> LowPass:
    """The `lowpass` section of a filter.

    Parameters
    ----------
    workspace_m : where the marker can be; the smallest power of two beyond it is full scale in Q15.
    seen : the log to judge the filter on.
    wanted : jitter that was asked for, in the log's unit.
    """
    design, sections = filter_.design, filter_.sections
    rate = design.rate_hz
    rounded = cutoff_hz(sections, rate)
    band = np.linspace(0.0, design.cutoff_hz, 201)
    answer = step_response(sections, rate)
    f = sorted(
        {c for c in (k * design.cutoff_hz for k in _TIMES_CUTOFF) if c < 0.5 * rate}
        | {k * rate for k in _PARTS_OF_RATE}
    )
    largest = max(abs(value) for value in workspace_m)
    full_scale_m = 2.0 ** math.ceil(math.log2(largest)) if largest > 0.0 else 1.0
    step_mm = 1e3 * full_scale_m / 32768.0
    integer = fixed_point(filter_)
    float_mm = 1e3 * largest * dead_band_binary32(filter_)
    reasons, remarks = _judged(filter_, rounded, seen)
    if float_mm > _STICKS_MM:
        reasons.append(f"In single precision the output comes to rest up to {float_mm:.2g} mm away.")
    return LowPass(
        family=cast("Literal['butterworth', 'bessel', 'critical']", design.family),
        order=design.order,
        cutoff_hz=design.cutoff_hz,
        rate_hz=rate,
        sections=[LowPassSection(b=row[:3].tolist(), a=row[3:].tolist()) for row in sections],
        rounded_cutoff_hz=rounded,
        pole_radius=filter_.pole_radius,
        poles=[[float(p.real), float(p.imag)] for p in digital_poles(sections)],
        dc_delay_s=dc_delay_s(sections, rate),
        largest_delay_s=float(group_delay_s(sections, band, rate).max()),
        step={"rise_s": answer.rise_s, "settling_s": answer.settling_s, "overshoot": answer.overshoot},
        attenuation_db={
            f"{c:.4g}Hz": float(d)
            for c, d in zip(f, decibels(frequency_response(sections, np.array(f), rate)), strict=True)
        },
        noise_gain=noise_gain(sections),
        dead_band_mm={
            "q15_step": step_mm,
            "q15": step_mm * integer.dead_band if integer.usable else None,
            "q15_seen": step_mm * integer.stuck if integer.usable else None,
            "float": float_mm,
        },
        wanted_jitter=wanted if wanted is None or seen is None or seen.unit == "px" else 1e3 * wanted,
        log=None if seen is None else _log_section(filter_, seen),
        verdict="poor" if reasons else "ok",
        reasons=reasons,
        remarks=remarks,
    )


def _judged(filter_: Filter, rounded_hz: float, seen: Positions | None) -> tuple[list[str], list[str]]:
    """Reasons why the filter is poor, and remarks that do not make it so."""
    design = filter_.design
    reasons: list[str] = []
    remarks: list[str] = []
    if abs(rounded_hz / design.cutoff_hz - 1.0) > _CUTOFF_OFF:
        reasons.append(
            f"Rounded to single precision it cuts at {rounded_hz:.4g} Hz, not at {design.cutoff_hz:g} Hz."
        )
    if seen is None:
        return reasons, remarks
    unsure = [name for name, of in zip(seen.names, seen.spectra, strict=True) if not of.flat]
    if unsure:
        reasons.append(
            f"The spectrum of {' and '.join(unsure)} does not fall to a floor: motion and jitter cannot "
            "be told apart; use a log at rest."
        )
    delay_s = dc_delay_s(filter_.sections, design.rate_hz)
    changed = max(motion_lost(of, filter_.sections, delay_s) for of in seen.spectra)
    if changed > _TOO_MUCH_CHANGED:
        remarks.append(
            f"{changed:.0%} of this log's motion does not come through unchanged; it reaches "
            f"{max(of.motion_hz for of in seen.spectra):.3g} Hz."
        )
    outliers = max(of.outliers for of in seen.spectra)
    if outliers:
        remarks.append(
            f"{outliers} outliers are not counted as jitter; the filter passes them on, smeared out."
        )
    total = sum(len(piece.t_s) for piece in seen.ticks.pieces)
    if seen.ticks.held > 0.05 * total:
        remarks.append(
            f"{seen.ticks.held} of {total} ticks have no sample of their own and hold the one before."
        )
    if len(seen.ticks.pieces) > 1:
        remarks.append(f"Gaps split the log into {len(seen.ticks.pieces)} pieces; the longest was used.")
    return reasons, remarks

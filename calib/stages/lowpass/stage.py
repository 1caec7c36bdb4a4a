"""The stage of the low-pass: a design, or the filter of least delay for a log, and what it costs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from calib.core.errors import BadInputError, UsageError
from calib.core.options import LogOptions, option
from calib.core.stage import Files, Stage, later
from calib.core.units import parse_frequency_hz, parse_jitter
from calib.core.verdict import Finding, Verdict
from calib.core.words import Block, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from calib.core.arrays import FloatArray
    from calib.core.rig import Rig
    from calib.io.logs import Log
    from calib.stages.lowpass.filters import Filter
    from calib.stages.lowpass.jitter import Positions, Suggestion
    from calib.stages.lowpass.section import Family, LowPass, LowPassLog

_RATE_OFF = 0.05
_CUTOFF_OFF = 0.01
_TOO_MUCH_CHANGED = 0.5
_STICKS_MM = 0.01
"""A tenth of what a pixel of the rig's camera leaves after averaging; more would be seen."""
_TIMES_CUTOFF = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_PARTS_OF_RATE = (0.1, 0.25, 0.45)
_SHOWN = 5
"""Candidates beside the filter that was chosen."""


@dataclass(frozen=True)
class Options(LogOptions):
    """What filter is designed, or chosen, and for which log."""

    cutoff_hz: float | None = option(
        None,
        "Frequency at which half the power is left. [default: 1Hz]",
        flag="cutoff",
        metavar="FREQUENCY",
        parse=parse_frequency_hz,
    )
    rate_hz: float | None = option(
        None,
        "Rate at which the firmware runs the filter, its tick. [default: the rig's, else 60Hz; "
        "where the log's camera has another, the camera's]",
        flag="rate",
        metavar="FREQUENCY",
        parse=parse_frequency_hz,
    )
    order: int | None = option(None, "1 to 8. [default: 1; with --suggest the one of least delay]")
    family: Literal["butterworth", "bessel", "critical", "chebyshev1", "chebyshev2", "elliptic"] | None = (
        option(None, "Of the filter. [default: butterworth; with --suggest the best of the first three]")
    )
    suggest: Path | None = option(
        None, "Choose the filter of least delay from this log's own spectrum.", metavar="LOG"
    )
    jitter: tuple[float, str] | None = option(
        None,
        "Jitter that --suggest may leave (standard deviation), as 0.1mm or 0.3px. [default: what the filter "
        "of --cutoff leaves]",
        metavar="LENGTH",
        parse=parse_jitter,
    )
    log: Path | None = option(None, "Log to show the filter on. [default: that of --suggest]", metavar="LOG")


@dataclass(frozen=True)
class Evidence:
    """What a low-pass is drawn from."""

    filter: Filter
    positions: Positions | None
    choice: Suggestion | None


def positions_from_log(
    log: Log,
    rate_hz: float,
    on_plane: Callable[[FloatArray], FloatArray] | None = None,
    set_by_hand: bool = True,
) -> Positions:
    """The marker in a log, one position per tick.

    Parameters
    ----------
    rate_hz : of the filter. set_by_hand : whether it has to stay; a log of another rate sets it otherwise.
    on_plane : from pixels (n, 2) to metres (n, 2) in the rig's plane; without, positions stay in pixels.

    Raises `BadInputError` for a log without camera, with too few samples, whose time runs backwards,
    whose marker lies beyond the plane's horizon, or of another rate.
    """
    import numpy as np

    from calib.stages.lowpass.jitter import Positions, resample_to_ticks, spectrum

    signals = log.signals("u_px", "v_px")
    pixels = signals.values
    values, unit, names = pixels, "px", ("u", "v")
    if on_plane is not None:
        values, unit, names = on_plane(pixels), "m", ("x", "y")
        lost = np.nonzero(np.isnan(values).any(axis=1))[0]
        if len(lost):
            u, v = pixels[lost[0]]
            raise BadInputError(
                f"{log.source}, line {signals.lines[lost[0]]}: the marker at ({u:g}, {v:g}) px is not on "
                "the rig's plane, expected a log of this rig's camera"
            )
    try:
        if not signals.axis.period_s > 0.0:
            raise BadInputError("has no two pictures of the marker at different times, expected a series")
        own = signals.axis.rate_hz
        if abs(own / rate_hz - 1.0) > _RATE_OFF:
            if set_by_hand:
                raise BadInputError(
                    f"has {own:.4g} camera samples/s, expected the {rate_hz:g} Hz that the filter is "
                    "designed for"
                )
            rate_hz = signals.axis.nominal_hz
        ticks = resample_to_ticks(signals.t_s, values, rate_hz)
        piece = ticks.longest.values
        spectra = (spectrum(piece[:, 0], rate_hz), spectrum(piece[:, 1], rate_hz))
    except BadInputError as error:
        raise BadInputError(f"{log.source}: {error}") from error
    return Positions(
        log.source, unit, names, own, ticks, resample_to_ticks(signals.t_s, pixels, rate_hz), spectra
    )


def _read(files: Files, rig: Rig, options: Options) -> tuple[Any, ...]:
    from calib.io.logs import read_log
    from calib.stages.lowpass.filters import Design, design_lowpass

    if options.jitter is not None and options.suggest is None:
        raise UsageError("--jitter: is for --suggest, which chooses the filter")
    if options.jitter is not None and options.cutoff_hz is not None:
        raise UsageError("--cutoff: does not go with --jitter, from which the cut-off follows")
    plane, camera = rig.current_plane(files.rig_path), rig.camera
    on_plane = None
    if plane is not None and camera is not None and (options.log or options.suggest):
        on_plane = partial(plane.to_world, camera=camera)
        files.hashes |= rig.identities("camera", "plane")

    rate_hz, set_by_hand = options.rate_hz or rig.tick_hz, options.rate_hz is not None

    def positions(path: Path | None) -> Positions | None:
        nonlocal rate_hz, set_by_hand
        if path is None:
            return None
        log = read_log(path, options, files.remarks, rig.picture_px)
        read = positions_from_log(log, rate_hz, on_plane, set_by_hand)
        # A second log has to fit the first.
        rate_hz, set_by_hand = read.ticks.rate_hz, True
        files.taken(path)
        return read

    suggest = positions(options.suggest)
    shown = suggest if options.log in (None, options.suggest) else positions(options.log)
    try:
        order = 1 if options.order is None else options.order
        design = Design(options.cutoff_hz or 1.0, rate_hz, order, options.family or "butterworth")
        made = design_lowpass(design)
    except BadInputError as error:
        raise UsageError(str(error)) from error
    wanted = None if options.jitter is None else _jitter_in(suggest, *options.jitter)
    orders = () if options.order is None else (options.order,)
    families = () if options.family is None else (options.family,)
    return made, rig.workspace_m, shown, suggest, wanted, orders, families


def _jitter_in(positions: Positions | None, jitter: float, unit: str) -> float:
    """A jitter that is asked for, in the positions' unit. Raises `UsageError` for another unit."""
    if positions is not None and unit != positions.unit:
        asked = f"{1e3 * jitter:g}mm" if unit == "m" else f"{jitter:g}px"
        has = "millimetres" if positions.unit == "m" else "pixels, without a plane in the rig's file"
        raise UsageError(f"--jitter: {asked!r} does not fit positions in {has}")
    return jitter


def solve(
    made: Filter,
    workspace_m: Sequence[float],
    positions: Positions | None = None,
    suggest: Positions | None = None,
    wanted: float | None = None,
    orders: tuple[int, ...] = (),
    families: tuple[str, ...] = (),
) -> LowPass:
    """Design or choose the filter, judge it, and assemble the section.

    Parameters
    ----------
    made : as asked for.
    workspace_m : where the marker can be.
    positions : of the log to judge the filter on.
    suggest : of the log to choose the filter by, among `orders` and `families` (all where empty).
    wanted : jitter that the chosen filter may leave, in the positions' unit; None for that of `made`.

    Raises `BadInputError` where no filter leaves so little jitter, or none is needed.
    """
    from calib.core.result import judged
    from calib.stages.lowpass import filters, jitter
    from calib.stages.lowpass.section import LowPass, LowPassSection

    choice = None
    if suggest is not None:
        if wanted is None:
            wanted = max(jitter.jitter_after(of, made.sections) for of in suggest.spectra)
        try:
            choice = jitter.suggest(suggest.spectra, wanted, orders, families, suggest.unit)
        except BadInputError as error:
            raise BadInputError(f"{suggest.source}: {error}") from error
        made = choice.best.filter
    design, sections, rate = made.design, made.sections, made.design.rate_hz
    rounded = filters.cutoff_hz(sections, rate)
    answer = filters.step_response(sections, rate)
    largest = max(abs(value) for value in workspace_m)
    float_mm = 1e3 * largest * filters.rest_error_binary32(made)
    log = None if positions is None else _log_section(made, positions)
    findings = [*_rounding_findings(made, rounded, float_mm)]
    if positions is not None and log is not None:
        findings += _log_findings(log, positions, choice is not None)
    return LowPass(
        family=cast("Family", design.family),
        order=design.order,
        cutoff_hz=design.cutoff_hz,
        rate_hz=rate,
        sections=[LowPassSection(b=row[:3].tolist(), a=row[3:].tolist()) for row in sections],
        rounded_cutoff_hz=rounded,
        pole_radius=made.pole_radius,
        poles=[[float(p.real), float(p.imag)] for p in filters.digital_poles(sections)],
        dc_delay_s=filters.dc_delay_s(sections, rate),
        largest_delay_s=_largest_delay_s(made),
        step={"rise_s": answer.rise_s, "settling_s": answer.settling_s, "overshoot": answer.overshoot},
        attenuation_db=_attenuation_db(made),
        noise_gain=filters.noise_gain(sections),
        dead_band_mm={"float": float_mm},
        wanted_jitter=wanted if wanted is None or positions is None else positions.scale * wanted,
        log=log,
        **judged(Verdict.of(findings)),
    ).with_evidence(Evidence(made, positions, choice))


def _largest_delay_s(made: Filter) -> float:
    """Largest group delay [s] up to the cut-off."""
    import numpy as np

    from calib.stages.lowpass.filters import group_delay_s

    band_hz = np.linspace(0.0, made.design.cutoff_hz, 201)
    return float(group_delay_s(made.sections, band_hz, made.design.rate_hz).max())


def _attenuation_db(made: Filter) -> dict[str, float]:
    """Gain [dB] at multiples of the cut-off and parts of the rate, by the frequency in words."""
    import numpy as np

    from calib.stages.lowpass.filters import decibels, frequency_response

    rate = made.design.rate_hz
    multiples = {k * made.design.cutoff_hz for k in _TIMES_CUTOFF}
    hz = sorted({f for f in multiples if f < 0.5 * rate} | {k * rate for k in _PARTS_OF_RATE})
    gains = decibels(frequency_response(made.sections, np.array(hz), rate))
    return {f"{f:.4g}Hz": gain for f, gain in zip(hz, gains.tolist(), strict=True)}


def _log_section(made: Filter, positions: Positions) -> LowPassLog:
    from calib.stages.lowpass import filters, jitter
    from calib.stages.lowpass.section import LowPassAxis, LowPassLog

    scale, ticks = positions.scale, positions.ticks
    delay_s = filters.dc_delay_s(made.sections, ticks.rate_hz)
    axes = {}
    for i, (name, of) in enumerate(zip(positions.names, positions.spectra, strict=True)):
        # The grid is the picture's: u for x and v for y, which a camera that looks along the normal shows so.
        pixels = positions.pixels.longest.values[:, i]
        step_px = jitter.grid_step(pixels) if of.motion_hz > 0.0 else 0.0
        f = jitter.quantisation_hz(pixels, step_px, ticks.rate_hz)
        axes[name] = LowPassAxis(
            jitter_before=scale * of.jitter,
            jitter_after=scale * jitter.jitter_after(of, made.sections),
            motion_hz=of.motion_hz,
            motion_changed=jitter.motion_lost(of, made.sections, delay_s),
            quantisation_hz=f.tolist(),
            quantisation_db=filters.decibels(
                filters.frequency_response(made.sections, f, ticks.rate_hz)
            ).tolist(),
        )
    return LowPassLog(
        name=Path(positions.source).name,
        unit="px" if positions.unit == "px" else "mm",
        rate_hz=positions.rate_hz,
        ticks=sum(len(piece.t_s) for piece in ticks.pieces),
        held=ticks.held,
        dropped=ticks.dropped,
        pieces=len(ticks.pieces),
        axes=axes,
    )


def _rounding_findings(made: Filter, rounded_hz: float, float_mm: float) -> Iterator[Finding]:
    """Findings on what single precision makes of the filter."""
    asked_hz = made.design.cutoff_hz
    if abs(rounded_hz / asked_hz - 1.0) > _CUTOFF_OFF:
        yield Finding(
            "poor", f"Rounded to single precision it cuts at {rounded_hz:.4g} Hz, not at {asked_hz:g} Hz."
        )
    if float_mm > _STICKS_MM:
        yield Finding("poor", f"In single precision the output comes to rest up to {float_mm:.2g} mm away.")


def _log_findings(log: LowPassLog, positions: Positions, chosen: bool) -> Iterator[Finding]:
    """Findings on what the filter does to a log; whether it was chosen by its jitter."""
    unsure = [name for name, of in zip(positions.names, positions.spectra, strict=True) if not of.flat]
    if unsure:
        yield Finding(
            "poor" if chosen else "remark",
            f"The spectrum of {' and '.join(unsure)} does not fall to a floor: motion and jitter cannot "
            "be told apart; use a log at rest.",
        )
    changed = max(axis.motion_changed for axis in log.axes.values())
    if changed > _TOO_MUCH_CHANGED:
        yield Finding(
            "remark",
            f"{changed:.0%} of this log's motion does not come through unchanged; it reaches "
            f"{max(axis.motion_hz for axis in log.axes.values()):.3g} Hz.",
        )
    outliers = max(of.outliers for of in positions.spectra)
    if outliers:
        yield Finding(
            "remark",
            f"{outliers} outliers are not counted as jitter; the filter passes them on, smeared out.",
        )
    if log.held > 0.05 * log.ticks:
        yield Finding(
            "remark", f"{log.held} of {log.ticks} ticks have no sample of their own and hold the one before."
        )
    if log.pieces > 1:
        yield Finding("remark", f"Gaps split the log into {log.pieces} pieces; the longest was used.")


def _words(result: LowPass) -> list[Block]:
    """The filters that a log leaves to choose from."""
    evidence: Evidence = result.evidence
    choice = evidence.choice
    if choice is None:
        return []
    rows = tuple(
        (
            f"{one.filter.design.family} {one.filter.design.order}",
            f"{one.filter.design.cutoff_hz:g}",
            f"{one.delay_s:.4f}",
            f"{one.motion_lost:.0%}",
            "taken" if one is choice.best else "",
        )
        for one in choice.candidates[:_SHOWN]
    )
    head = ("filter", "cut-off, Hz", "delay, s", "motion changed", "")
    unit = "" if result.log is None else result.log.unit
    title = f"least delay for a jitter of {result.wanted_jitter:.3g} {unit}; the same jitter with others"
    return [Table(head, rows, title)]


lowpass = Stage(
    "lowpass",
    "Low-pass",
    """Design the low-pass of the positions, with its delay, and write the section lowpass.

    Uses the sections camera and plane of the rig's file for millimetres; without them jitter is in
    pixels. Exits 1 when the verdict is not ok.
    """,
    _read,
    solve,
    Options,
    writes=("lowpass",),
    uses=("camera", "plane"),
    words=_words,
    plots=later("calib.stages.lowpass.plots", "plots"),
)

"""`calib lowpass`: the filter of the positions, and what it costs in delay."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, say, table
from calib.core.errors import EXIT_POOR, BadInputError, UsageError

if TYPE_CHECKING:
    from calib.stages.lowpass.filters import Suggestion
    from calib.stages.lowpass.section import LowPass

__all__ = ["lowpass"]

_SHOWN = 5


def lowpass(
    cutoff: Annotated[
        str | None, typer.Option(help="Frequency at which half the power is left. [default: 1Hz]")
    ] = None,
    rate: Annotated[str, typer.Option(help="Rate at which the firmware runs the filter.")] = "60Hz",
    order: Annotated[
        int | None, typer.Option(help="1 to 8. [default: 1; with --suggest the one of least delay]")
    ] = None,
    family: Annotated[
        str | None,
        typer.Option(help="butterworth, bessel or critical. [default: butterworth; with --suggest the best]"),
    ] = None,
    suggest: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Choose the filter of least delay from this log's own spectrum."),
    ] = None,
    jitter: Annotated[
        str | None,
        typer.Option(
            help="Jitter that --suggest may leave (standard deviation), as 0.1mm or 0.3px. [default: what "
            "the filter of --cutoff leaves]"
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Log to show the filter on. [default: that of --suggest]"),
    ] = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Design the low-pass of the positions, with its delay, and write the section lowpass.

    Uses the sections camera and plane of the rig's file for millimetres; without them jitter is in
    pixels. Exits 1 when the verdict is not ok.
    """
    from calib.core.files import check_folder, check_writable, hash_of
    from calib.core.result import identity, section_json
    from calib.core.rig import Geometry, read_rig, write_rig
    from calib.core.units import parse_frequency_hz, parse_jitter
    from calib.stages.lowpass.filters import Design, design_lowpass, jitter_after
    from calib.stages.lowpass.filters import suggest as choose
    from calib.stages.lowpass.stage import lowpass_section, positions_from_log

    if jitter is not None and suggest is None:
        raise UsageError("--jitter: is for --suggest, which chooses the filter")
    if jitter is not None and cutoff is not None:
        raise UsageError("--cutoff: does not go with --jitter, from which the cut-off follows")
    wanted, unit = (None, "") if jitter is None else parse_jitter(jitter)
    rate_hz = parse_frequency_hz(rate, "--rate")
    cutoff_hz = parse_frequency_hz(cutoff or "1Hz", "--cutoff")
    try:
        design = Design(cutoff_hz, rate_hz, 1 if order is None else order, family or "butterworth")
        made = design_lowpass(design)
    except BadInputError as error:
        raise UsageError(str(error)) from error
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    plane = before.current_plane(str(rig))
    camera = None if before.camera is None or plane is None else before.camera.optics
    A_inverse = None
    hashes: dict[str, str] = {}
    if plane is not None and before.camera is not None and (log or suggest):
        import numpy as np

        A_inverse = np.array(plane.A_inverse)
        hashes = {"camera": identity(before.camera), "plane": identity(plane)}
    seen = choice = None
    if suggest is not None:
        seen = positions_from_log(suggest, rate_hz, camera, A_inverse)
        hashes[suggest.name] = hash_of(suggest)
        if wanted is None:
            wanted = max(jitter_after(of, made.sections) for of in seen.spectra)
        elif unit != seen.unit:
            has = "millimetres" if seen.unit == "m" else "pixels, without a plane in the rig's file"
            raise UsageError(f"--jitter: {jitter!r} does not fit positions in {has}")
        try:
            choice = choose(
                seen.spectra, wanted, [order] if order else [], [family] if family else [], seen.unit
            )
        except BadInputError as error:
            raise BadInputError(f"{seen.source}: {error}") from error
        made = choice.best.filter
    if log is not None:
        seen = positions_from_log(log, rate_hz, camera, A_inverse)
        hashes[log.name] = hash_of(log)
    workspace_m = (before.geometry or Geometry()).workspace_m
    section = lowpass_section(made, workspace_m, seen, wanted)
    write_rig(rig, before.model_copy(update={"lowpass": section}), {"lowpass": hashes})
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.lowpass.plots import plots

        write_figures(figures, plots(made, section, seen))
        narrate(f"figures in {figures}")
    narrate(f"lowpass written to {rig}")
    if as_json:
        document("lowpass", {"lowpass": section_json(section)})
    else:
        _tell(section)
        if choice is not None:
            _tell_choice(choice, section)
        _tell_verdict(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def _tell(section: LowPass) -> None:
    say(f"{section.family}, order {section.order}: {section.cutoff_hz:g} Hz at {section.rate_hz:g} Hz")
    for i, part in enumerate(section.sections, start=1):
        say(f"  b{i} = {', '.join(f'{value:.9g}' for value in part.b)}")
        say(f"  a{i} = {', '.join(f'{value:.9g}' for value in part.a)}")
    say(
        f"delay: {section.dc_delay_s:.4f} s for slow motion, at most {section.largest_delay_s:.4f} s up to "
        "the cut-off"
    )
    step = section.step
    say(
        f"step: rises in {step['rise_s']:.3f} s, within 2 % after {step['settling_s']:.3f} s, overshoots by "
        f"{step['overshoot']:.1%}"
    )
    gains = "  ".join(f"{name} {value:.1f} dB" for name, value in section.attenuation_db.items())
    say(f"gain: {gains}")
    say(
        f"rounded to float: gain 1 at rest exactly, cut-off {section.rounded_cutoff_hz:.5g} Hz, poles within "
        f"{section.pole_radius:.5f}, stable; comes to rest within {section.dead_band_mm['float']:.2g} mm"
    )
    band, size = section.dead_band_mm["q15"], section.dead_band_mm["q15_step"]
    sticks = "cannot hold this filter" if band is None else f"would stick up to {band:.2g} mm away"
    say(f"16-bit integers (steps of {size:.2g} mm) {sticks}; the header uses float")
    if section.log is None:
        return
    told, unit = section.log, section.log.unit
    rows = [
        [
            name,
            f"{axis.jitter_before:.4f}",
            f"{axis.jitter_after:.4f}",
            f"{axis.motion_hz:.2f}",
            f"{axis.motion_changed:.0%}",
            " ".join(f"{f:.1f}" for f in axis.quantisation_hz) or "-",
            " ".join(f"{gain:.0f}" for gain in axis.quantisation_db) or "-",
        ]
        for name, axis in told.axes.items()
    ]
    say(f"{told.name}: {told.ticks} ticks, {told.held} held, {told.dropped} dropped")
    head = ["", f"jitter, {unit}", "filtered", "motion to Hz", "changed", "grid at Hz", "gain dB"]
    for line in table(head, rows):
        say(line)


def _tell_choice(choice: Suggestion, section: LowPass) -> None:
    unit = section.log.unit if section.log else ""
    say(f"least delay for a jitter of {section.wanted_jitter:.3g} {unit}; the same jitter with others:")
    rows = [
        [
            f"{one.filter.design.family} {one.filter.design.order}",
            f"{one.filter.design.cutoff_hz:g}",
            f"{one.delay_s:.4f}",
            f"{one.motion_lost:.0%}",
            "taken" if one is choice.best else "",
        ]
        for one in choice.candidates[:_SHOWN]
    ]
    for line in table(["filter", "cut-off, Hz", "delay, s", "motion changed", ""], rows):
        say(line)


def _tell_verdict(section: LowPass) -> None:
    say(f"verdict: {section.verdict}")
    for sentence in [*section.reasons, *section.remarks]:
        say(f"  - {sentence}")

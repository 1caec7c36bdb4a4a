"""`calib track`: the centre of a coloured marker in a video or before a camera, as a log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import JsonOption, RigOption, answer, narrate, progress_bar, refuse_recorded
from calib.cli.interrupts import Interrupts
from calib.core.errors import EXIT_POOR, BadInputError, UsageError
from calib.core.files import shown
from calib.core.units import parse_duration_s, parse_length_m, parse_pixel
from calib.core.writing import check_writable, write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.core.arrays import AnyArray, FloatArray
    from calib.stages.camera.marker import Disc, Tracker
    from calib.stages.camera.section import Camera, Plane

_GATE = 0.9
"""Share of the frames that must show the marker."""


def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="VIDEO|CAMERA", help="A video, the number of a camera, or the address of a stream."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Log to write, .csv.")],
    colour: Annotated[
        str | None,
        typer.Option(
            metavar="COLOUR", help="The marker's: a name, #rrggbb, or a hue, as 24deg. [default: orange]"
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="U,V",
            help="Where the marker is in the first frame, px; its colour is taken from there.",
        ),
    ] = None,
    pixy: Annotated[
        bool, typer.Option("--pixy", help="Whole pixels of the middle of the blob's box, as a Pixy2 tells.")
    ] = False,
    diameter: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Of the marker, as 12mm: gives the disc's centre in the rig's plane.",
        ),
    ] = None,
    duration: Annotated[
        str | None, typer.Option(metavar="TIME", help="How long, such as 20s; a camera else until Ctrl-C.")
    ] = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Make a log of a coloured disc from a video or a camera: its centre below a pixel, and how sure that is.

    A frame in which the marker is not seen, or not told apart from another disc, has no row. Exits 1 when
    fewer than 90 of 100 frames have one, when the rig's camera was calibrated at another size, and when
    times that had to be counted contradict the file's.
    """
    from calib.core.rig import Rig
    from calib.io.frames import timed_frames
    from calib.stages.camera.marker import (
        TRACK,
        TRACK_COLUMNS,
        Colour,
        Tracker,
        colour_at,
        parse_colour,
        track_rows,
        track_text,
    )

    start = None if at is None else parse_pixel(at, "--at")
    limit_s = None if duration is None else parse_duration_s(duration, "--duration")
    wanted = None if colour is None else parse_colour(colour)
    if pixy and diameter is not None:
        raise UsageError("--diameter: does not go with --pixy, which tells the middle of the blob's box")
    disc = None if diameter is None else _DiscOnPlane.of(rig, parse_length_m(diameter, "--diameter"))
    where = int(source) if source.isdecimal() else source if "://" in source else Path(source)
    check_writable(output, TRACK)
    calibrated_px = Rig.load(rig, missing_ok=True).picture_px
    size_px: tuple[int, int] | None = None
    times, frames = timed_frames(where)
    if times.arrival:
        refuse_recorded(output)
    if times.arrival and limit_s is None:
        narrate("following the marker; Ctrl-C ends it")
    tracker: Tracker | None = None
    found: list[Disc | None] = []
    try:
        with progress_bar("following the marker") as progress:
            for frame in frames:
                if limit_s is not None and times.stamps_s[-1] - times.stamps_s[0] > limit_s:
                    times.stamps_s.pop()
                    break
                if size_px not in (None, frame.shape[1::-1]):
                    narrate(f"from here on frames have {frame.shape[1]}x{frame.shape[0]} px: the log ends")
                    times.stamps_s.pop()
                    break
                if tracker is None:
                    size_px = frame.shape[1], frame.shape[0]
                    if disc is not None:
                        disc.refuse_frame(frame, source)
                    learnt: Colour | None = wanted
                    if learnt is None:
                        learnt = parse_colour("orange") if start is None else colour_at(frame, start)
                    if learnt is None:
                        raise BadInputError(
                            f"{shown(source)}: there is no colour at {at} of the first frame, expected the "
                            "marker"
                        )
                    tracker = Tracker(learnt, start)
                found.append(tracker.follow(frame))
                tracker.take_back(found)
                if start is not None and found[0] is None:
                    raise BadInputError(
                        f"{shown(source)}: no disc of its colour is at {at} of the first frame, expected the "
                        "marker"
                    )
                progress(len(found), 0)
    except KeyboardInterrupt:
        if not times.arrival:
            raise
        Interrupts.settle()
    seen = sum(one is not None for one in found)
    if tracker is None or not seen:
        raise BadInputError(f"{shown(source)}: {_why(tracker, start is not None)}")
    if disc is not None:
        disc.refuse_size([one for one in found if one is not None])
    at_s = times.settled_s()
    rows = track_rows(at_s, found, pixy, None if disc is None else disc.centre)
    write_atomically(output, f"{','.join(TRACK_COLUMNS)}\n{track_text(rows, pixy)}", TRACK)
    told: dict[str, Any] = {
        "frames": len(found),
        "found": seen,
        "lost": len(found) - seen,
        "doubled": tracker.doubled,
        "elsewhere_s": [float(at_s[k]) for k in tracker.elsewhere],
        "sigma_px": sorted(row[3] for row in rows)[len(rows) // 2],
        "times": times.words(),
    }
    lines = [
        f"marker in {seen} of {len(found)} frames, written to {shown(output)}; {len(found) - seen} lost",
        f"another disc of its colour in {tracker.doubled} frames" if tracker.doubled else "",
        tracker.doubt(at_s),
        f"sigma of the centre {told['sigma_px']:.2f} px",
        told["times"],
    ]
    answer(as_json, "track", {"track": told}, *filter(None, lines))
    other_size = calibrated_px not in (None, size_px)
    if other_size:
        narrate(_other_size(source, size_px, rig, calibrated_px))
    if other_size or times.astray_s() or seen < _GATE * len(found):
        raise typer.Exit(EXIT_POOR)


def _why(tracker: Tracker | None, stated: bool) -> str:
    if tracker is None:
        return "holds no frame that can be decoded"
    if tracker.doubled and not stated:
        several = f"{tracker.doubled} of {tracker.frames} frames show several discs of this colour"
        if not tracker.first:
            return f"{several} and the first shows none; begin the video with the marker in sight"
        at = " and ".join("{:.0f},{:.0f}".format(*one.centre_px) for one in tracker.first[:_MOST_TOLD])
        return f"{several}; say with --at where the marker is in the first frame, which has them at {at} px"
    return (
        f"no disc of hue {tracker.colour.hue_deg:.0f} degrees in any of {tracker.frames} frames; give its "
        "colour with --colour or --at"
    )


def _other_size(
    source: str, size_px: tuple[int, int] | None, rig: Path, calibrated_px: tuple[int, int] | None
) -> str:
    assert size_px is not None and calibrated_px is not None
    seen, known = (f"{width}x{height} px" for width, height in (size_px, calibrated_px))
    return (
        f"{shown(source)}: is {seen}, but the camera in {shown(rig)} was calibrated at {known}, and reads "
        "these pixels wrongly; film the board as the marker was filmed, and calibrate on that video"
    )


@dataclass(frozen=True)
class _DiscOnPlane:
    """A disc of a diameter in the plane of the rig."""

    diameter_m: float
    camera: Camera
    plane: Plane

    @staticmethod
    def of(path: Path, diameter_m: float) -> _DiscOnPlane:
        """Of the rig's camera and plane. Raises `BadInputError` where there are none."""
        from calib.core.rig import Rig

        known = Rig.load(path, missing_ok=True)
        camera, _ = (known.needed(name, path, ", which --diameter needs") for name in ("camera", "plane"))
        plane = known.current_plane(path)
        assert plane is not None
        return _DiscOnPlane(diameter_m, camera, plane)

    def refuse_frame(self, frame: AnyArray, source: str) -> None:
        """Raise `BadInputError` for pictures of another size than the camera's."""
        size, known = frame.shape[1::-1], tuple(self.camera.image_size_px)
        if size != known:
            raise BadInputError(
                f"{shown(source)}: is {size[0]}x{size[1]} px, expected {known[0]}x{known[1]} px, for which "
                "the rig's camera holds; leave --diameter out, or calibrate the camera at this size"
            )

    def refuse_size(self, found: Sequence[Disc]) -> None:
        """Raise `BadInputError` where discs of this diameter would look much larger or smaller."""
        import numpy as np

        middle = sorted(found, key=lambda one: one.radius_px)[len(found) // 2]
        place = self.plane.to_world(middle.centre_px[None], self.camera)
        ends = place + 1e-3 * np.eye(2)
        px_per_mm = np.hypot(*(self.plane.to_pixels(ends, self.camera) - middle.centre_px).T)
        seen, expected = middle.radius_px, 0.5e3 * self.diameter_m * float(np.sqrt(px_per_mm.prod()))
        if not (1.0 / _TIMES_SEEN < expected / seen < _TIMES_SEEN or abs(expected - seen) < _SEEN_PX):
            raise BadInputError(
                f"--diameter: the disc is seen {2.0 * seen:.0f} px wide, one of {1e3 * self.diameter_m:g} mm "
                f"on the rig's plane would be {2.0 * expected:.0f} px; expected about "
                f"{1e3 * self.diameter_m * seen / expected:.0f} mm"
            )

    def centre(self, ellipse_px: FloatArray) -> FloatArray:
        """The disc's centre from that of the ellipse."""
        from calib.stages.camera.marker import disc_centre

        return disc_centre(
            ellipse_px,
            0.5 * self.diameter_m,
            lambda pixels: self.plane.to_world(pixels, self.camera),
            lambda places: self.plane.to_pixels(places, self.camera),
        )


_MOST_TOLD = 4
"""Discs whose places are told."""
_TIMES_SEEN, _SEEN_PX = 1.5, 2.0
"""A threshold of colour and a blur take or add a pixel or two of a disc's edge."""

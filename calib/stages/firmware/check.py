"""What a board printed against float64: the log of `calib record` computed again, tick by tick.

The reference starts from nothing, as the board does, so a log has to begin with sequence number 0
(opening the port restarts the usual boards). Where frames are missing the board went on from what is not
known here; the comparison ends there. Tolerances are those of the self-test, larger from the first marker on
that was far away.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.core.errors import BadInputError
from calib.core.files import read_bytes, shown
from calib.core.verdict import Finding, Verdict
from calib.core.words import Block, InWords, Line, Table, counted, of_verdict
from calib.io.serial import BOARD_COLUMNS, FAULTS, GUARD_RUN, Frame, Outputs, frame_from_row
from calib.stages.firmware import conformance
from calib.stages.firmware.conformance import Reference, Wanted
from calib.stages.firmware.header import Header
from calib.stages.firmware.vectors import TOLERANCE, tolerance

_CLAMP_BITS = conformance.CLAMPED[0] | conformance.CLAMPED[1]
_UNDECIDED_M = 1e-6
"""What rounding makes of the fused estimator's residuals after a long rest."""


@dataclass(frozen=True, repr=False)
class Check(InWords):
    """How far a board was from the reference.

    Attributes
    ----------
    ticks : that were compared. missing_after : ticks before the first lost frame, None without one.
    worst : largest difference by quantity of `vectors.TOLERANCE`. allowed : tolerances at the end.
    flags_differ : ticks whose flags were others.
    first_bad : the first tick beyond a tolerance, with the quantity; None where there is none.
    faults : of the guard, with the first tick of each.
    """

    ticks: int
    missing_after: int | None
    worst: dict[str, float]
    allowed: dict[str, float]
    flags_differ: int
    first_bad: tuple[int, str] | None
    faults: dict[int, int]

    def blocks(self) -> list[Block]:
        rows = tuple(
            (name, f"{worst:.2g}", f"{self.allowed[name]:.2g}") for name, worst in self.worst.items()
        )
        head = ("", "differs at most", "allowed")
        return [Line(f"{counted(self.ticks, 'tick')} compared"), Table(head, rows), *of_verdict(self.verdict)]

    @property
    def verdict(self) -> Verdict:
        """Poor for a board that computes something else."""
        findings = []
        if self.first_bad is not None:
            tick, what = self.first_bad
            findings.append(Finding("poor", f"tick {tick} is the first that differs, in {what}"))
        if self.missing_after is not None:
            text = f"a frame is missing after tick {self.missing_after - 1}; what follows was not compared"
            findings.append(Finding("remark", text))
        for fault, tick in self.faults.items():
            text = f"from tick {tick} on the guard held the pumps off: {FAULTS.get(fault, f'fault {fault}')}"
            findings.append(Finding("remark", text))
        return Verdict.of(findings)


def read_frames(path: Path) -> list[Frame]:
    """Frames of a log as `calib record` writes it.

    Raises `BadInputError` for another file, by its line.
    """
    text = read_bytes(path).decode("utf-8-sig", "replace")
    if "\0" in text:
        raise BadInputError(f"{shown(path)}: has a zero byte, expected a log of calib record")
    reader = csv.DictReader(text.splitlines())
    frames = []
    try:
        missing = [name for name in BOARD_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise BadInputError(f"{shown(path)}: has no column {missing[0]}, expected a log of calib record")
        # Rows of a picture alone are no ticks.
        frames += [frame_from_row(row) for row in reader if row["sequence"] != ""]
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise BadInputError(
            f"{shown(path)}: line {reader.line_num} is no tick of a board ({error})"
        ) from error
    if not frames:
        raise BadInputError(f"{shown(path)}: holds no tick of a board")
    return frames


def _pumps_follow(frame: Frame) -> bool:
    """Whether the pumps got what the tick commanded, or nothing where the guard says so."""
    if frame.guard is None:
        return True
    wanted = frame.out.pwm if frame.guard.state == GUARD_RUN else (0.0, 0.0)
    return all(abs(duty - pwm) <= 0.5 for duty, pwm in zip(frame.guard.duty, wanted, strict=True))


def _differences(out: Outputs, wanted: Outputs) -> dict[str, float]:
    off = [abs(a - b) for a, b in zip(out.numbers, wanted.numbers, strict=True)]
    found = {"phi_rad": off[0], "marker_m": max(off[1:3]), "q_m": max(off[3:7]), "pwm": max(off[7:])}
    # NaN of a board is no small difference.
    return {name: value if math.isfinite(value) else math.inf for name, value in found.items()}


def _reference_for(header: Header, first: Frame, source: str) -> Reference:
    """The reference as the board runs it, told by its first frame. Raises as `check_frames`."""
    if first.identity != header.identity:
        raise BadInputError(
            f"{source}: the board runs the constants {first.identity:08X}, rig.yaml gives "
            f"{header.identity:08X}; write and flash the header again"
        )
    if first.sequence != 0:
        raise BadInputError(
            f"{source}: begins with tick {first.sequence}, expected 0: record from the board's start"
        )
    flags = first.out.flags
    fused, mean_rate = bool(flags & conformance.BY_FUSED), bool(flags & conformance.BY_MEAN_RATE)
    if fused and not header.values["CALIB_HAS_FUSED"]:
        raise BadInputError(f"{source}: the board runs the fused estimator, for which rig.yaml has no gains")
    return conformance.make_reference(header.values, fused=fused, mean_rate=mean_rate)


def check_frames(header: Header, frames: Sequence[Frame], source: str) -> Check:
    """Compare the ticks of a board with the reference.

    Parameters
    ----------
    source : the log's name for messages.

    CALIB_UNDISTORT is the header's; CALIB_FUSED and CALIB_RATE_IS_MEAN are told by the board's flags.

    Raises `BadInputError` for a board with another header and for a log that does not begin at the start.
    """
    reference = _reference_for(header, frames[0], source)
    worst, allowed, rounding_m = dict.fromkeys(TOLERANCE, 0.0), TOLERANCE, 0.0
    flags_differ, first_bad, missing_after = 0, None, None
    faults: dict[int, int] = {}
    for tick, frame in enumerate(frames):
        if frame.sequence != tick & 0xFFFF:
            missing_after = tick
            break
        wanted = reference.step(frame.given, frame.out.flags)
        if not wanted.flags & conformance.MARKER_HELD:
            # Low-pass and controller remember it.
            rounding_m = max(rounding_m, reference.rounding_m(frame.given.u_px, frame.given.v_px))
            allowed = tolerance(rounding_m)
        off = _differences(frame.out, wanted)
        worst = {name: max(worst[name], value) for name, value in off.items()}
        flags_differ += _flags_differ(frame, wanted)
        wrong = [name for name, value in off.items() if value > allowed[name]]
        wrong += _wrong_decisions(frame, wanted, allowed)
        if wrong and first_bad is None:
            first_bad = (tick, wrong[0])
        if frame.guard is not None and frame.guard.fault:
            faults.setdefault(frame.guard.fault, tick)
    ticks = len(frames) if missing_after is None else missing_after
    return Check(ticks, missing_after, worst, allowed, flags_differ, first_bad, faults)


def _flags_differ(frame: Frame, wanted: Wanted) -> bool:
    return bool((frame.out.flags ^ wanted.flags) & ~_CLAMP_BITS)


def _wrong_decisions(frame: Frame, wanted: Wanted, allowed: Mapping[str, float]) -> Iterator[str]:
    """Decisions of a tick that are not the reference's, beyond what rounding explains."""
    if _flags_differ(frame, wanted):
        yield "flags"
    if wanted.undecided_pwm > allowed["pwm"]:
        yield "the decision to clamp"
    if wanted.undecided_m > _UNDECIDED_M:
        yield "the decision on rest, motion or a marker to leave out"
    if not _pumps_follow(frame):
        yield "what drives the pumps"

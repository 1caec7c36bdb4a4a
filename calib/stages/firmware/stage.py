"""The stage of the firmware: the header with its pipeline out, or a board's log held against it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.core.files import shown
from calib.core.options import option
from calib.core.stage import Files, Output, Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.core.rig import Rig
    from calib.io.serial import Frame
    from calib.stages.firmware.check import Check
    from calib.stages.firmware.header import Header


@dataclass(frozen=True)
class FirmwareOptions:
    """Whether a board is checked."""

    check: Path | None = option(
        None, "Compare a log of calib record with this rig instead of writing.", metavar="LOG"
    )


def _read(files: Files, rig: Rig, options: FirmwareOptions) -> tuple[Rig, str, Sequence[Frame] | None, str]:
    source = shown(files.rig_path)
    if options.check is None:
        return rig, source, None, ""
    from calib.stages.firmware.check import read_frames

    log = Path(options.check)
    rig.needed("plane", files.rig_path, ", so no board can run it")
    return rig, source, read_frames(log), shown(log)


def _solve(rig: Rig, source: str, frames: Sequence[Frame] | None, log: str) -> Header | Check:
    """From a rig with its file's name, and the frames of a board with the name of their log."""
    from calib.stages.firmware.check import check_frames
    from calib.stages.firmware.header import make_header

    header = make_header(rig, source)
    return header if frames is None else check_frames(header, frames, log)


def _write(files: Files, outcome: Header | Check) -> list[Path]:
    from calib.stages.firmware.header import Header

    if files.output is None or not isinstance(outcome, Header):
        return []
    written = outcome.write(files.output)
    sketch = files.output / outcome.sketch(files.output)
    if sketch.exists() and sketch not in written:
        files.narrate(f"{shown(sketch)}: was changed since calib wrote it, and is left as it is")
        if b'#include "calib_guard.h"' not in sketch.read_bytes():
            files.narrate(
                f"{shown(sketch)}: has no guard, so that nothing stops the pumps when a sensor fails; move "
                "it away, run this again, and carry your changes over"
            )
    return written


def _document(outcome: Header | Check) -> dict[str, Any]:
    from calib.stages.firmware.header import Header

    verdict = outcome.verdict
    judged = {"gate": verdict.reasons or "passed", "remarks": verdict.remarks, "advice": verdict.advice}
    if isinstance(outcome, Header):
        return {"constants": len(outcome.literals), **judged}
    return {
        "check": {
            "ticks": outcome.ticks,
            "lost_after": outcome.missing_after,
            "worst": outcome.worst,
            "tolerance": outcome.allowed,
            "flags_differ": outcome.flags_differ,
            **judged,
        }
    }


firmware = Stage(
    "firmware",
    "Firmware",
    """Write the header, the pipeline in C, its self-test and an Arduino sketch, or check a board's log.

    Exits 1 when the verdict of a section that the constants come from is not ok (all is written and says so),
    or when a board computes something else.
    """,
    _read,
    _solve,
    FirmwareOptions,
    uses=("camera", "plane", "lens", "imu", "imu_intrinsics", "orientation_filter", "lowpass", "align",
          "actuator", "pump", "estimator", "controller"),
    output=Output(
        "Folder to write into.", _write, default=Path("firmware_constants"), folder=True
    ),
    document=_document,
)  # fmt: skip

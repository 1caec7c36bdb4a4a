"""`calib join`: the log of a camera and that of a board with an IMU as one log, on one clock."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from calib.cli.common import JsonOption, RigOption, answer, check_log_name, narrate
from calib.cli.verbs import of_logs
from calib.core.command import note_inputs
from calib.core.errors import UsageError
from calib.core.files import shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.writing import check_writable


@of_logs
def join(
    camera: Annotated[Path, typer.Argument(help="Log with the marker, as calib track writes it.")],
    board: Annotated[Path, typer.Argument(help="Log with the IMU, and what else a board records.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Log to write, .csv or .parquet.")],
    offset: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="To add to the pictures' times, as other logs of these clocks told; nothing is looked for.",
        ),
    ] = None,
    same_clock: Annotated[bool, typer.Option("--same-clock", help="--offset 0.")] = False,
    stated: LogOptions = NOTHING_STATED,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Write the log of a camera and that of an IMU as one, with the pictures' times on the IMU's clock.

    Finds how the clocks stand to each other by the motion that both saw, whatever the offset. With camera and
    plane in the rig's file the marker's way is an angle, and one swing suffices; without, move unevenly.
    Begin both recordings before the first motion. With --same-clock or --offset any two logs are joined, as
    those of a phone that writes a file for each of its sensors.
    """
    from calib.core.rig import Rig
    from calib.io.logs import LOG, companion_files, read_log, write_log
    from calib.stages.align.join import DRIFT_S, joined

    if same_clock and offset is not None:
        raise UsageError("--offset: does not go with --same-clock, which is --offset 0")
    if offset is not None and not math.isfinite(offset):
        raise UsageError(f"--offset: is {offset}, expected seconds")
    check_log_name(output)
    note_inputs([camera, board, *companion_files(camera), *companion_files(board), *stated.files])
    check_writable(output, LOG)
    known = Rig.load(rig, missing_ok=True)
    given = 0.0 if same_clock else offset
    remarks: list[str] = []
    marker = read_log(camera, stated, remarks, known.picture_px)
    felt = read_log(board, stated, remarks)
    # Before what may be refused for a column that was not read.
    for remark in remarks:
        narrate(remark)
    log, clocks, outside = joined(marker, felt, known, shown(rig), given)
    write_log(output, log, LOG)
    told: dict[str, Any] = {"log": shown(output), "rows": len(log), "outside": outside}
    lines = [f"{len(log)} rows written to {shown(output)}: t_s, {', '.join(log.columns)}"]
    if clocks is not None:
        told |= {"offset_s": clocks.offset_s, "drift_s": clocks.drift_s, "left": clocks.left}
        told["next_left"] = clocks.next_left
        left = f"leaves {clocks.left:.0%} of the motion, the next best {clocks.next_left:.0%}"
        lines.insert(0, f"pictures' clock and {clocks.offset_s:.3f} s is the IMU's: it {left}")
        lines.append("calib align finds the rest of the offset")
    answer(as_json, "join", {"join": told}, *lines)
    if outside:
        narrate(f"rows of {shown(camera)} outside the time of {shown(board)}, which are left out: {outside}")
    if clocks is not None and clocks.drift_s is not None and abs(clocks.drift_s) > DRIFT_S:
        narrate(
            f"the clocks drift by {1e3 * clocks.drift_s:.0f} ms between the halves; join shorter recordings"
        )

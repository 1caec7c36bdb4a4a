"""`calib imu drift`: the same logs through every way of getting the angle, and how each drifts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import (
    AccUnitOption,
    FiguresOption,
    GyroUnitOption,
    JsonOption,
    RigOption,
    document,
    narrate,
    say,
    table,
)

if TYPE_CHECKING:
    from calib.imu.drift import LogDrift
    from calib.imu.tracks import DriftLog

__all__ = ["drift"]


def _cell(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else "-"


def _tell(section: dict[str, Any]) -> None:
    head = ["offset, deg", "slope, deg/s", "+- 95 %", "Allan 1 s", "100 s, deg", "RMSE, deg", "lag, ms"]
    for log in section["logs"]:
        say(
            f"{log['name']}: {log['duration_s']:.5g} s at {log['rate_hz']:.5g} Hz, {log['judged_s']:.5g} s "
            f"judged, {log['moving_s']:.5g} s in motion; {log['about']}"
        )
        rows = []
        for name, m in log["methods"].items():
            low, high = m["interval_degps"]
            rows.append(
                [
                    name,
                    _cell(m["offset_deg"]),
                    _cell(m["slope_degps"]),
                    _cell(0.5 * (high - low), 2),
                    _cell(m["allan_1s_deg"]),
                    _cell(m["allan_100s_deg"]),
                    _cell(m["rmse_deg"]),
                    _cell(m["lag_ms"]) if abs(m["lag_ms"]) >= 0.05 or math.isnan(m["lag_ms"]) else "0.0",
                ]
            )
        for line in table(["", *head], rows):
            say(line)
        for sentence in (*log["skipped"], *log["remarks"]):
            say(f"  - {sentence}")
    if len(section["logs"]) > 1:
        rows = [
            [name, _cell(one["mean_degps"], 4), _cell(one["spread_degps"]), str(one["logs"])]
            for name, one in section["methods"].items()
        ]
        for line in table(["slope over the logs, deg/s", "mean", "spread", "logs"], rows):
            say(line)
    for sentence in section["remarks"]:
        say(f"  - {sentence}")
    say(
        "intervals allow for errors that hang together in time (white noise on a process of order one or a "
        "random walk, by restricted likelihood); RMSE is in motion, without the constant mount offset; a "
        "positive lag is late"
    )
    say(f"note: {section['note']}")


def drift(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig, at rest or in motion.")
    ],
    figures: FiguresOption = None,
    peers: Annotated[
        bool, typer.Option("--peers/--no-peers", help="Run the filters of the extra peers as well.")
    ] = True,
    acc_unit: AccUnitOption = "m/s2",
    gyro_unit: GyroUnitOption = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Compare how the angle drifts by the chip, the sensors alone, the MM filter and filters of others.

    Tuned gains are read from the rig's file, to which nothing is written.
    """
    from calib.driftlogs import read_drift_log
    from calib.driftsections import drift_document, tuned_filter
    from calib.files import check_folder, shown
    from calib.imu.drift import analyse_drift
    from calib.rig import hash_of, read_rig

    if figures is not None:
        check_folder(figures)
    tuned = tuned_filter(read_rig(rig))
    hashes: dict[str, str] = {}
    remarks: list[str] = []
    read: list[DriftLog] = []
    for path in logs:
        log, said = read_drift_log(path, acc_unit, gyro_unit)
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        read.append(replace(log, source=name))
        hashes[name] = hash_of(path)
        remarks += said
    results: list[LogDrift] = [analyse_drift(log, tuned, peers, narrate) for log in read]
    if figures is not None:
        from calib.report.drift_figures import write_drift_figures

        write_drift_figures(figures, results)
        narrate(f"figures in {shown(figures)}")
    section = drift_document(results, hashes, tuned, remarks)
    if as_json:
        document("imu drift", {"drift": section})
    else:
        _tell(section)

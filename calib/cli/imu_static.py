"""`calib imu static`: logs of an IMU at rest in, its bias, noise and drift out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from calib.errors import EXIT_POOR

if TYPE_CHECKING:
    from calib.rig_imu import Imu

__all__ = ["static"]


def _cells(
    values: list[float | None], sigma: list[float | None] | None, below: list[float | None] | None
) -> list[str]:
    cells = []
    for k, value in enumerate(values):
        limit = None if below is None else below[k]
        deviation = None if sigma is None else sigma[k]
        if value is None:
            cells.append("-" if limit is None else f"< {limit:.2g}")
        else:
            cells.append(f"{value:.4g}" + ("" if deviation is None else f" +- {deviation:.1g}"))
    return cells


def _tell(section: Imu) -> None:
    rows = []
    for name, key in (
        ("gyro bias, rad/s", "gyro_bias_radps"),
        ("gyro noise N, rad/s/sqrt(Hz)", "gyro_noise_radps_per_sqrt_Hz"),
        ("gyro instability B, rad/s", "gyro_instability_radps"),
        ("gyro random walk K, rad/s^2/sqrt(Hz)", "gyro_walk_radps2_per_sqrt_Hz"),
        ("accel mean, m/s^2", "accel_mean_mps2"),
        ("accel noise N, m/s^2/sqrt(Hz)", "accel_noise_mps2_per_sqrt_Hz"),
        ("accel instability B, m/s^2", "accel_instability_mps2"),
        ("accel random walk K, m/s^3/sqrt(Hz)", "accel_walk_mps3_per_sqrt_Hz"),
    ):
        rows.append([name, *_cells(getattr(section, key), section.sigma.get(key), section.below.get(key))])
    for line in table([f"{section.rate_hz:.5g} Hz", "x", "y", "z"], rows):
        say(line)
    say("+- is one standard deviation; < is a 95 % bound where the logs are too short for an estimate")
    say("accel mean holds gravity: one pose does not tell it from a bias")
    sampled, drifts = [], []
    for log in section.logs:
        sampled.append(
            [
                log.name,
                f"{log.rest_s:.5g} of {log.duration_s:.5g}",
                f"{log.rate_hz:.5g}",
                f"{1e3 * log.jitter_s:.3g}",
                str(log.missing),
                str(log.splits),
                f"{log.repeated_rows} / {log.repeated_stamps}",
            ]
        )
        pairs = ((log.gyro_degps, log.gyro_sigma_degps), (log.onchip_degps, log.onchip_sigma_degps))
        drifts.append([log.name, *(_cells([value], [deviation], None)[0] for value, deviation in pairs)])
    head = ["log", "at rest, s", "rate, Hz", "jitter, ms", "missing", "split", "repeated rows / stamps"]
    for line in table(head, sampled):
        say(line)
    found = [section.drift.get(name) for name in ("gyro", "onchip")]
    drifts.append(["mean", *("-" if one is None else f"{one.mean_degps:.4g}" for one in found)])
    drifts.append(
        [
            "spread from log to log",
            *("-" if one is None or one.spread_degps is None else f"{one.spread_degps:.2g}" for one in found),
        ]
    )
    for line in table(["drift of the angle, deg/s", "gyroscope, -gz", "on the chip"], drifts):
        say(line)
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks, *section.advice):
        say(f"  - {sentence}")


def static(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig at rest.")],
    figures: FiguresOption = None,
    imu_yaml: Annotated[
        Path | None, typer.Option("--imu-yaml", help="Kalibr's imu.yaml to write as well.")
    ] = None,
    acc_unit: AccUnitOption = "m/s2",
    gyro_unit: GyroUnitOption = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find bias, noise densities and drift of an IMU from logs at rest, and whether they were at rest.

    Writes the section imu of the rig's file. Exits 1 when the verdict is not ok.
    """
    from calib.files import check_folder, check_writable, shown, write_atomically
    from calib.imu.static import RestLog, analyse_static
    from calib.imu.static_verdict import judge
    from calib.imulogs import read_rest_log
    from calib.imusections import imu_section, kalibr_imu
    from calib.rig import hash_of, read_rig, section_json, write_rig

    for path in (rig, imu_yaml):
        if path is not None:
            check_writable(path)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    read: list[RestLog] = []
    hashes: dict[str, str] = {}
    for path in logs:
        log, said = read_rest_log(path, acc_unit, gyro_unit)
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        # What is written to the rig's file does not depend on the folder.
        read.append(replace(log, source=name))
        hashes[name] = hash_of(path)
        for sentence in said:
            narrate(sentence)
    result = analyse_static(read)
    section = imu_section(result, judge(result))
    write_rig(rig, before.model_copy(update={"imu": section}), {"imu": hashes})
    narrate(f"imu written to {shown(rig)}")
    if imu_yaml is not None:
        write_atomically(imu_yaml, kalibr_imu(section))
        narrate(f"Kalibr's imu.yaml written to {shown(imu_yaml)}")
    if figures is not None:
        from calib.report.imu_figures import write_imu_figures

        write_imu_figures(figures, result, section.verdict)
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu static", {"imu": section_json(section)})
    else:
        _tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)

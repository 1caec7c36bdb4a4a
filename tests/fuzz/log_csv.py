"""Logs, references, tables of pumps and logs of a board: all that is read from comma-separated rows."""

from __future__ import annotations

import csv
import math
from pathlib import Path

MODULES = (
    "calib.io.logs",
    "calib.io.tables",
    "calib.io.columns",
    "calib.io.inferred_units",
    "calib.io.sensor_faults",
    "calib.stages.actuator.read",
    "calib.stages.control.read",
    "calib.stages.firmware.check",
    "calib.runner.folder",
)

WORDS = (
    b"t_s", b"u_px", b"v_px", b"ax_mps2", b"ay_mps2", b"gz_radps", b"pwm1", b"pwm2", b"true_phi_rad",
    b"q1_m", b"q2_m", b"x_m", b"y_m", b"phi_rad", b"time_s", b"pwm", b"pressure_kPa", b"force_N", b"sequence",
    b"rate_mhz", b"calib_id", b"marker_seen", b"imu_read", b"mode", b"#", b",", b",,", b"\r\n", b"\"\"\"",
    b"1,2,3", b"123456789012345678", b"1234567890123456789", b"9007199254740993", b"1e22", b"1e23",
    b".", b"1.",
    b".5e1", b"+", b"1e", b"\xd9\xa1",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """What is read is what Python's `float` makes of each cell, in blocks of any length."""
    from calib.core.errors import BadInputError
    from calib.runner.folder import read_folder
    from calib.stages.actuator.read import read_pump_table
    from calib.stages.control.read import _series
    from calib.stages.firmware.check import read_frames

    (folder / "logs").mkdir(exist_ok=True)
    path = folder / "logs" / "log.csv"
    path.write_bytes(data)
    assert read_folder(folder).logs[0].slug == "log"
    for read in (read_frames, read_pump_table, _series):
        try:
            read(path)
        except BadInputError as error:
            refusal = str(error)
            assert refusal and "\n" not in refusal and refusal.isprintable(), repr(refusal)
    _log(data, path)


def _log(data: bytes, path: Path) -> None:
    import numpy as np

    from calib.core.errors import BadInputError
    from calib.io import tables
    from calib.io.columns import kind_of
    from calib.io.logs import log_text, read_log

    try:
        log = read_log(path)
    finally:
        before, tables._BLOCK_BYTES = tables._BLOCK_BYTES, 48
        try:
            parts, refusal = read_log(path), ""
        except BadInputError as error:
            parts, refusal = None, str(error)
        finally:
            tables._BLOCK_BYTES = before
    if parts is None:
        # Only a line longer than two blocks may be refused where the whole is not.
        assert "does not end" in refusal, refusal
    else:
        assert np.array_equal(parts.t_s, log.t_s) and parts.passed.truncated == log.passed.truncated
        assert np.array_equal(parts.lines, log.lines) and parts.passed.not_finite == log.passed.not_finite
        for name, values in log.columns.items():
            assert np.array_equal(values, parts.columns[name], equal_nan=True)
    lines = data.split(b"\n")
    marked = [line.lstrip(b"\xef\xbb\xbf") for line in lines]
    header = next(k for k, line in enumerate(marked) if line.strip() and not line.startswith(b"#"))
    names = [name.strip() for name in next(csv.reader([lines[header].decode("utf-8-sig").rstrip("\r\n")]))]
    for row, number in enumerate(log.lines.tolist()):
        line = lines[number - 1].decode("utf-8", "replace").rstrip("\r")
        try:
            cells = next(csv.reader([line]))
        except csv.Error:
            # A carriage return within a cell of a column that is not read.
            continue
        for name, cell in zip(names, cells, strict=True):
            if name == "t_s" or name in log.columns:
                got = float((log.t_s if name == "t_s" else log.columns[name])[row])
                wanted = float(cell) if cell.strip() else math.nan
                wanted = wanted if math.isfinite(wanted) else math.nan
                blank = math.isnan(wanted) or (
                    log.passed.implausible > 0
                    and kind_of(name) in ("accel", "gyro", "pixel")
                    and abs(wanted) > 1e2
                )
                same = got == wanted or (math.isnan(got) and blank)
                assert same, f"line {number}: {name} is {got!r}, not {wanted!r}"
    path.write_text(log_text(log), encoding="utf-8")
    assert log_text(read_log(path)) == log_text(log)

"""Tables of a pump: columns of many names, settled values by mode, and what is wrong with a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from outside import outside

from calib.errors import BadInputError
from calib.pumptables import read_pump_table


def _write(path: Path, head: str, rows: np.ndarray) -> Path:
    lines = [",".join("" if c != c else f"{c:.6g}" for c in row) for row in rows.tolist()]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def _rows(n: int = 100) -> np.ndarray:
    t = 0.02 * np.arange(n)
    return np.stack([t, np.where(t > 0.1, 255.0, 0.0), 30.0 * -np.expm1(-t)], axis=1)


@pytest.mark.parametrize(
    ("head", "unit"),
    [
        ("Time,PWM,Pressure", "kPa"),
        ("t_s,pwm,pressure_kPa", "kPa"),
        ("Timestamp_s,PWM_Main,Feedback_kPa", "kPa"),
        ("t_s,pwm1,force_N", "N"),
    ],
)
def test_columns_are_recognised(tmp_path: Path, head: str, unit: str) -> None:
    table = read_pump_table(_write(tmp_path / "a.csv", head, _rows()))
    assert table.unit == unit
    assert table.record is not None
    assert np.allclose(table.record.value, _rows()[:, 2], atol=1e-4)


def test_settled_values_are_taken_apart_by_mode(tmp_path: Path) -> None:
    path = tmp_path / "static.csv"
    rows = [
        f"{mode},{100 + 10 * k},{sign * k},{3 * k}"
        for mode, sign in (("in", 1), ("out", -1))
        for k in range(8)
    ]
    rows = [f"{r.rsplit(',', 1)[0]},{3 * i}" for i, r in enumerate(rows)]
    path.write_text("mode,pwm_input,pressure_kpa,timestamp\n" + "\n".join(rows) + "\n")
    table = read_pump_table(path)
    assert table.record is None
    assert [s.name for s in table.settled] == ["static.csv, in", "static.csv, out"]
    assert table.settled[1].value[-1] == -7.0


def test_real_tables(shared_data: Path) -> None:
    folder = outside(shared_data / "softbot")
    for path in sorted(folder.glob("sweep_*.csv")):
        record = read_pump_table(path).record
        assert record is not None
        assert record.pwm.max() == 255.0
    parts = read_pump_table(next(folder.glob("calibration_raw*.csv"))).settled
    assert [len(s.pwm) for s in parts] == [30, 30]


def _broken(kind: str) -> np.ndarray:
    rows = _rows()
    if kind == "back":
        rows[50:, 0] -= 0.5
    elif kind == "jump":
        rows[50:, 0] += 100.0
    elif kind == "range":
        rows[10, 1] = 400.0
    elif kind == "nan":
        rows[10:30, 2] = np.nan
    elif kind == "short":
        rows = rows[:8]
    return rows


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("back", "line 52: time goes back"),
        ("jump", "line 52: time jumps from 0.98 to 101 s"),
        ("range", "line 12: PWM is 400, expected 0 to 255"),
        ("nan", "20 of 100 rows have a blank or nan, the first in line 12"),
        ("short", "has 8 rows over 0.14 s"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, kind: str, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        read_pump_table(_write(tmp_path / "a.csv", "t_s,pwm,pressure_kPa", _broken(kind)))

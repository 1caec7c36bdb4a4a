"""Rows in Parquet: all columns of all outcomes, nulls where a rig has none, in blocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.fleet import rows
from calib.fleet.outcome import Outcome
from calib.fleet.rows import Table, column, texts, with_columns, write_outcomes

pa = pytest.importorskip("pyarrow")


def _outcomes() -> dict[str, Outcome]:
    a = Outcome(
        "a", "1", "/a", "ok", 0, kind="camera", stages={"intrinsics": "ok"},
        values={"camera.fx_px": (273.0, 0.5)}, seconds=1.0, peak_MB=100.0,
    )  # fmt: skip
    b = Outcome(
        "b", "", "/b", "poor", 1, "weak", reasons=("x", "y"), stages={"lowpass": "poor"},
        values={"camera.fx_px": (280.0, None), "imu.rate_hz": (100.0, None)},
    )  # fmt: skip
    return {"a": a, "b": b, "c": Outcome("c", "", "/c", "failed", 3, "gone")}


def test_each_outcome_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "_BLOCK", 2)
    path, known = tmp_path / "x.parquet", _outcomes()
    write_outcomes(path, ["a", "b", "nobody", "c"], known.get)
    with Table(path) as table:
        assert table.rows == 3
        assert texts(table, "name") == ["a", "b", "c"]
        assert texts(table, "verdict") == ["ok", "poor", "failed"]
        assert texts(table, "reasons") == ["", "x\ny", ""]
        assert texts(table, "verdict.intrinsics") == ["ok", "", ""]
        np.testing.assert_equal(column(table, "camera.fx_px"), [273.0, 280.0, np.nan])
        np.testing.assert_equal(column(table, "camera.fx_px.sigma"), [0.5, np.nan, np.nan])
        np.testing.assert_equal(column(table, "imu.rate_hz"), [np.nan, 100.0, np.nan])
        np.testing.assert_equal(column(table, "not there"), [np.nan] * 3)
        np.testing.assert_equal(column(table, "code"), [0.0, 1.0, 3.0])
    final = tmp_path / "y.parquet"
    with_columns(path, final, {"z": pa.array([1.0, 2.0, None])})
    with Table(final) as table:
        assert table.names[-1] == "z" and texts(table, "name") == ["a", "b", "c"]
        np.testing.assert_equal(column(table, "z"), [1.0, 2.0, np.nan])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.parquet", "y.parquet"]


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="cannot be written"):
        write_outcomes(tmp_path / "none" / "x.parquet", ["a"], _outcomes().get)

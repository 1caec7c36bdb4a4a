"""`calib convert` from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import readings, write_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.io.logs import MEASURED, Log, read_log, write_log

Run = Callable[..., Any]


def test_a_bag_becomes_a_table(calib: Run, tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path, "folder", readings(np.random.default_rng(0))), tmp_path / "log.csv"
    topics = tmp_path / "mine.yaml"
    topics.write_text("topics:\n  /imu/data: imu\n")
    ended = calib("convert", bag, "-o", out, "--topics", topics, "--json")
    assert ended.code == 0
    told = json.loads(ended.out)["convert"]
    assert told["rows"] == 100 and told["left_out"] == ["/marker", "/pwm"] and not told["truncated"]
    assert list(read_log(out).columns) == told["columns"] == list(MEASURED[2:8])
    assert "left out: /marker, /pwm" in calib("convert", bag, "-o", out, "--topics", topics).err


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_table_comes_back(
    calib: Run, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """CSV to Parquet and back gives the same bytes."""
    count = data.draw(st.integers(1, 8))
    names = data.draw(st.lists(st.sampled_from(MEASURED), unique=True, max_size=4))
    cell = st.one_of(st.just(float("nan")), st.floats(-1e6, 1e6, allow_subnormal=False))
    columns = {name: np.array(data.draw(st.lists(cell, min_size=count, max_size=count))) for name in names}
    t_s = np.cumsum(data.draw(st.lists(st.integers(0, 10**7), min_size=count, max_size=count))) * 1e-6
    folder = tmp_path_factory.mktemp("convert")
    first, table, last = folder / "a.csv", folder / "b.parquet", folder / "c.csv"
    write_log(first, Log("x", t_s, columns, np.arange(count)))
    assert calib("convert", first, "-o", table).code == 0
    assert calib("convert", table, "-o", last).code == 0
    assert first.read_bytes() == last.read_bytes()


@pytest.mark.parametrize(
    ("text", "name", "code", "words"),
    [
        ("t_s,gz_radps\n", "out.csv", 3, "has a header but no rows"),
        ("t_s,gz_radps\n0,1\n", "out.mcap", 2, "expected a name that ends in .csv or .parquet"),
        ("t_s,gz_radps\n0,x\n", "out.csv", 3, "line 2: gz_radps is 'x', expected a number"),
    ],
)
def test_what_cannot_be_converted(
    calib: Run, tmp_path: Path, text: str, name: str, code: int, words: str
) -> None:
    log = tmp_path / "log.csv"
    log.write_text(text)
    ended = calib("convert", log, "-o", tmp_path / name)
    assert ended.code == code and words in ended.err
    assert [item.name for item in tmp_path.iterdir()] == ["log.csv"]


def test_nothing_of_the_input_but_numbers_reaches_the_table(calib: Run, tmp_path: Path) -> None:
    """Names of columns and cells that a spreadsheet would take for formulas stay behind."""
    log, out = tmp_path / "log.csv", tmp_path / "out.csv"
    log.write_text('t_s,"=cmd|\' /C calc\'!A0",@SUM(A1),gz_radps,\t+1\n0,=1+1,-2,-0.5,"=HYPERLINK(1)"\n')
    assert calib("convert", log, "-o", out).code == 0
    assert out.read_text() == "t_s,gz_radps\n0.000000,-0.5\n"
    for cell in ("=1", "@1", "+1+1", "'1"):
        log.write_text(f"t_s,gz_radps\n0,{cell}\n")
        assert calib("convert", log, "-o", out).code == 3

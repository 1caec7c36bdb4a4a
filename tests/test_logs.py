"""Logs: what is read and written, and one clear sentence for what is not."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import calib.io.logs as logs
from calib.core.errors import BadInputError
from calib.io.logs import Log, iter_log, log_text, read_log, write_log

SMALL = (
    "t_s,u_px,v_px,ax_mps2,gz_radps,pwm1\n"
    "0.000,160,104,,,128\n"
    "0.004,,,9.81,0.01,\n"
    "0.014,,,9.79,-0.02,\n"
    "0.017,161,104,,,130\n"
)


@pytest.fixture
def write(tmp_path: Path):
    def _write(content: str | bytes, name: str = "log.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return _write


def test_rows_of_two_rates_interleave(write) -> None:
    log = read_log(write(SMALL))
    assert log.t_s.tolist() == [0.0, 0.004, 0.014, 0.017]
    assert log.sampled("u_px", "v_px").tolist() == [0, 3]
    assert log.sampled("ax_mps2").tolist() == [1, 2]
    assert log.columns["gz_radps"][log.sampled("gz_radps")].tolist() == [0.01, -0.02]
    assert log.sampled("gy_radps").tolist() == []
    assert log.sampled().tolist() == []
    assert list(log.columns) == ["u_px", "v_px", "ax_mps2", "gz_radps", "pwm1"]
    assert (log.unknown, log.not_finite, log.truncated, len(log)) == ((), 0, False, 4)


def test_nan_and_infinite_cells_count_as_blank(write) -> None:
    log = read_log(write("t_s,ax_mps2,gz_radps\n0,nan,1\n1,-inf,NaN\n2,3,Infinity\n"))
    assert log.not_finite == 4
    assert log.sampled("ax_mps2").tolist() == [2]
    assert log.sampled("gz_radps").tolist() == [0]


def test_a_line_that_is_still_being_written_is_left_out(write) -> None:
    log = read_log(write(SMALL + "0.02,16"))
    assert log.truncated
    assert len(log) == 4


def test_blocks_give_the_same_as_the_whole(write, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    rows = "".join(
        f"{0.01 * i:.6f},{v:.9g},{'' if i % 3 else i}\n" for i, v in enumerate(rng.normal(size=500))
    )
    path = write("t_s,ax_mps2,pwm1\n" + rows)
    whole = read_log(path)
    for size in (7, 64, 1000):
        monkeypatch.setattr(logs, "_BLOCK_BYTES", max(size, 40))
        pieces = list(iter_log(path))
        assert len(pieces) > 5
        assert all(len(piece) for piece in pieces)
        joined = read_log(path)
        assert np.array_equal(joined.t_s, whole.t_s)
        assert np.array_equal(joined.lines, whole.lines)
        assert np.array_equal(joined.columns["pwm1"], whole.columns["pwm1"], equal_nan=True)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.one_of(st.just(math.nan), st.floats(-1e6, 1e6, allow_subnormal=False))] * 3),
        min_size=1,
        max_size=30,
    )
)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]
) -> None:
    values = np.array(rows)
    t = 0.01 * np.arange(len(rows))
    names = ("u_px", "ax_mps2", "true_q1_m")
    columns = {name: values[:, k].copy() for k, name in enumerate(names)}
    log = Log("made", t, columns, np.arange(len(rows)))
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    write_log(path, log)
    back = read_log(path)
    assert np.allclose(back.t_s, t, rtol=0.0, atol=1e-6)
    for name in names:
        assert np.allclose(back.columns[name], columns[name], rtol=1e-8, atol=0.0, equal_nan=True)
    # And once more: nine digits are nine digits.
    assert log_text(back) == path.read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "log.csv: is empty, expected a header and rows"),
        ("\n\n# nothing\n", "log.csv: is empty"),
        ("t_s,ax_mps2\n", "log.csv: has a header but no rows"),
        ("time,ax\n1,2\n", "line 1: has no column t_s, found 'time, ax'"),
        ("t_s;ax_mps2\n1;2\n", "has no column t_s.*separated by commas"),
        ("t_s,ax_mps2,ax_mps2\n1,2,3\n", "line 1: has the column ax_mps2 twice"),
        ("t_s,t_s\n1,2\n", "line 1: has the column t_s twice"),
        ("t_s,ax_mps2\n0,1\n1,abc\n", "line 3: ax_mps2 is 'abc', expected a number"),
        ("# c\nt_s,ax_mps2\n\n0,1\n1,1_0\n", "line 5: ax_mps2 is '1_0', expected a number"),
        ("t_s,ax_mps2\n0,1\n,2\n", "line 3: has no time t_s, expected a number"),
        ("t_s,ax_mps2\n0,1\nnan,2\n", "line 3: has no time t_s"),
        ("t_s,ax_mps2\n0,1\ninf,2\n", "line 3: has no time t_s"),
        ("t_s,ax_mps2\n0,1\n1\n2,3\n", "line 3: has 1 cells, expected 2 as in the header"),
        ("t_s,ax_mps2\n0,1,2\n", "line 2: has 3 cells, expected 2"),
        ('t_s,ax_mps2\n0,"1\n', "line 2: is not comma-separated"),
        (b"t_s,\xff\n0,1\n", "line 1: is not UTF-8 text"),
        (b"t_s,a\0b\n0,1\n", "line 1: has a zero byte"),
        (b"t_s," + b"a" * 70000 + b"\n", "line 1: has more than 65536 characters"),
        ("t_s," + ",".join(f"c{i}" for i in range(2000)) + "\n", "line 1: has 2001 columns"),
    ],
)
def test_one_sentence_for_what_is_wrong(write, text: str | bytes, words: str) -> None:
    with pytest.raises(BadInputError, match=words) as found:
        read_log(write(text))
    assert "\n" not in str(found.value)


def test_a_line_without_an_end_is_not_read_into_memory(write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "_BLOCK_BYTES", 1000)
    with pytest.raises(BadInputError, match="line 3: does not end"):
        read_log(write("t_s,ax_mps2\n0,1\n" + "7" * 5000))


def test_a_log_beyond_the_memory_is_refused_while_it_is_read(write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("t_s,u_px\n" + "".join(f"{k},1\n" for k in range(4000)))
    monkeypatch.setattr(logs, "_BLOCK_BYTES", 1000)
    monkeypatch.setattr(logs, "_MOST_CELLS", 6000)
    with pytest.raises(BadInputError, match="million cells, which is more than is read at once"):
        read_log(path)
    assert sum(len(block) for block in iter_log(path)) == 4000


@pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow (extra logs) is not installed"
)
def test_parquet_holds_the_same_as_csv(tmp_path: Path, write) -> None:
    import pyarrow
    import pyarrow.parquet

    log = read_log(write(SMALL))
    write_log(tmp_path / "log.parquet", log)
    back = read_log(tmp_path / "log.parquet")
    assert log_text(back) == log_text(log)
    table = pyarrow.table({"t_s": [0.0, 1.0], "ax_mps2": [1, None], "note": ["a", "b"]})
    pyarrow.parquet.write_table(table, tmp_path / "other.parquet")
    other = read_log(tmp_path / "other.parquet")
    assert other.unknown == ("note",)
    assert other.sampled("ax_mps2").tolist() == [0]
    pyarrow.parquet.write_table(pyarrow.table({"t_s": ["a"]}), tmp_path / "words.parquet")
    with pytest.raises(BadInputError, match="t_s holds string, expected numbers"):
        read_log(tmp_path / "words.parquet")
    with pytest.raises(BadInputError, match="is not a Parquet file"):
        read_log(write(b"not parquet", "log.parquet"))

"""Logs and states: what is written is read, numbers bit for bit, one clear sentence for what is not."""

from __future__ import annotations

import importlib
import importlib.util
import io
import json
import math
import struct
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.io import logs, tables
from calib.io.columns import STATES
from calib.io.logs import Log, check_time, iter_log, log_text, read_log, write_log
from calib.io.states import ENDINGS, states_writer
from calib.io.tables import GENERAL, TIME, WHOLE, read_cells, table_bytes

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
    assert (log.unknown, log.passed.not_finite, log.passed.truncated, len(log)) == ((), 0, False, 4)


def test_nan_and_infinite_cells_count_as_blank(write) -> None:
    log = read_log(write("t_s,ax_mps2,gz_radps\n0,nan,1\n1,-inf,NaN\n2,3,Infinity\n"))
    assert log.passed.not_finite == 4
    assert log.sampled("ax_mps2").tolist() == [2]
    assert log.sampled("gz_radps").tolist() == [0]


@pytest.mark.parametrize("blank", ["NA", "null", "None", "n/a", "#N/A", '""'])
def test_what_programs_write_for_nothing_is_blank(write, blank: str) -> None:
    text = f"t_s,u_px\n0,1\n1,{blank}\n2,3\n"
    for form in (text, text + '3,"4 "\n'):
        read = read_log(write(form)).columns["u_px"][:3]
        np.testing.assert_array_equal(read, [1.0, np.nan, 3.0])


def test_a_line_that_is_still_being_written_is_left_out(write) -> None:
    log = read_log(write(SMALL + "0.02,16"))
    assert log.passed.truncated
    assert len(log) == 4


def test_blocks_give_the_same_as_the_whole(write, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    rows = "".join(
        f"{0.01 * i:.6f},{v:.9g},{'' if i % 3 else i}\n" for i, v in enumerate(rng.normal(size=500))
    )
    path = write("t_s,ax_mps2,pwm1\n" + rows)
    whole = read_log(path)
    for size in (7, 64, 1000):
        monkeypatch.setattr(tables, "_BLOCK_BYTES", max(size, 40))
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
        st.tuples(*[st.one_of(st.just(math.nan), st.floats(-4e3, 4e3, allow_subnormal=False))] * 3),
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
        ("t_s,ax_mps2\n", "log.csv: has a header but no rows"),
        ("t_s,q1_m,q2_m,dq1_mps,dq2_mps,phi_rad\n0,1,1,0,0,0\n", "log.csv: holds states that calib replay"),
        ("a;ax_mps2\n1;2\n", "line 1: has no column t_s, found 'a, ax_mps2'.*the line t_s: {column: NAME"),
        ("t_s,ax_mps2\n0,1\n1,abc\n", "line 3: ax_mps2 is 'abc', expected a number"),
        ("t_s,ax_mps2\n0,1\n,2\n", "line 3: has no time t_s, expected a number"),
        ("t_s,ax_mps2\n0,1\ninf,2\n", "line 3: has no time t_s"),
        ('t_s,ax_mps2\n0,"1\n', "line 2: is not comma-separated"),
        (b"t_s,a\0b\n0,1\n", "line 1: has a zero byte"),
        ("t_s," + ",".join(f"c{i}" for i in range(2000)) + "\n", "line 1: has 2001 columns"),
    ],
)
def test_one_sentence_for_what_is_wrong(write, text: str | bytes, words: str) -> None:
    with pytest.raises(BadInputError, match=words) as found:
        read_log(write(text))
    assert "\n" not in str(found.value)


def test_few_damaged_lines_are_left_out_and_told_and_many_refuse_the_log(write) -> None:
    rows = [f"{k / 100:.2f},{k % 7}.5" for k in range(1000)]
    damaged = rows.copy()
    damaged[40], damaged[300], damaged[999] = "0.40,1.5,2.5", "3.0", "9.99,4.\x005"
    log = read_log(write("\n".join(["t_s,gz_radps", *damaged, ""])))
    assert len(log) == 997 and not set(log.lines) & {42, 302, 1001}
    assert log.passed.sentences == [
        "3 lines came damaged and are left out, the first line 42: has 3 cells, expected 2 as in the header"
    ]
    for k in range(500, 503):
        damaged[k] = "5"
    with pytest.raises(BadInputError, match="line 42: has 3 cells"):
        read_log(write("\n".join(["t_s,gz_radps", *damaged, ""])))


def test_numbers_and_dates_as_people_write_them(write) -> None:
    rows = ["24.10.2026 13:45:07.25,\N{MINUS SIGN}0.5,-", "24.10.2026 13:45:08,2,--"]
    log = read_log(write("\n".join(["timestamp,gz_radps,ax_mps2", *rows, ""])))
    assert log.t_s[1] - log.t_s[0] == pytest.approx(0.75)
    assert log.columns["gz_radps"].tolist() == [-0.5, 2.0] and np.isnan(log.columns["ax_mps2"]).all()


def test_a_line_without_an_end_is_not_read_into_memory(write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_BLOCK_BYTES", 1000)
    with pytest.raises(BadInputError, match="line 3: does not end"):
        read_log(write("t_s,ax_mps2\n0,1\n" + "7" * 5000))


def test_a_log_beyond_the_memory_is_refused_while_it_is_read(write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("t_s,u_px\n" + "".join(f"{k / 100},1\n" for k in range(4000)))
    monkeypatch.setattr(tables, "_BLOCK_BYTES", 1000)
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


def _bits(value: float) -> bytes:
    return struct.pack("<d", value)


@settings(deadline=None)
@given(
    st.floats(allow_nan=False, allow_infinity=False, width=64),
    st.sampled_from(["r", ".9g", ".6f", ".3e", "+"]),
)
@example(-0.0, "r")
@example(9007199254740993.0, "r")
@example(5e-324, "r")
def test_what_it_reads_has_the_bits_of_float(value: float, form: str) -> None:
    text = repr(value) if form == "r" else format(value, form)
    (log,) = logs.iter_rows(io.BytesIO(f"t_s,pwm1\n1,{text}\n".encode()), "log.csv")
    # What is beyond the largest double counts as infinite, and so as blank.
    assert _bits(log.columns["pwm1"][0]) == _bits(float(text) if math.isfinite(float(text)) else math.nan)


@settings(deadline=None)
@given(
    st.lists(
        st.lists(st.sampled_from(["", " ", "1", "-2.5", "nan", '"3"']), min_size=2, max_size=2),
        min_size=1,
        max_size=20,
    )
)
def test_blank_cells_are_nan_and_blank_lines_no_rows(rows: list[list[str]]) -> None:
    text = "t_s,pwm1,pwm2\n" + "".join(
        f"{i}," + ",".join(row) + ("\r\n" if i % 2 else "\n\n") for i, row in enumerate(rows)
    )
    (log,) = logs.iter_rows(io.BytesIO(text.encode()), "log.csv")
    words = [[cell.strip(' "') for cell in row] for row in rows]
    expected = np.array([[float(c) if c else math.nan for c in row] for row in words])
    found = np.stack([log.columns["pwm1"], log.columns["pwm2"]], axis=1)
    assert np.array_equal(found, expected, equal_nan=True)
    assert log.passed.not_finite == sum(row.count("nan") for row in rows)
    lines = text.split("\n")
    assert [lines[line - 1].split(",")[0] for line in log.lines] == [str(i) for i in range(len(rows))]


def test_cells_are_short_blank_for_nan_and_read_back_to_nine_digits() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=(9000, 3)) * 10.0 ** rng.uniform(-40, 20, (9000, 1))
    values[:, 0], values[:, 2] = 0.0025 * np.arange(9000), rng.integers(0, 128, 9000)
    values[rng.random(9000) < 0.3, 1] = np.nan
    values[:2, 1] = -0.0, 123456789.5
    text = table_bytes(values, [TIME, GENERAL, WHOLE]).decode()
    rows = [line.split(",") for line in text.splitlines()]
    assert [row[0] for row in rows[:2]] == ["0.000000", "0.002500"]
    assert [row[1] for row in rows[:2]] == ["-0", "123456790"]
    assert all(row[2].isdigit() for row in rows)
    read = np.array([[float(cell or "nan") for cell in row] for row in rows])
    np.testing.assert_allclose(read, values, rtol=5e-9, atol=0.0, equal_nan=True)


def test_an_interrupted_file_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "states.csv"
    old = ",".join(STATES) + "\n"
    path.write_text(old)

    def broken() -> None:
        with states_writer(path) as add:
            add(np.zeros((1, len(STATES))))
            raise ValueError

    with pytest.raises(ValueError):
        broken()
    assert path.read_text() == old
    assert [item.name for item in tmp_path.iterdir()] == ["states.csv"]


def _rows(count: int = 40) -> np.ndarray:
    """Rows of `STATES` with blanks, counts and weights of every size."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(count, len(STATES))) * 10.0 ** rng.uniform(-9, 3, (count, len(STATES)))
    values[:, 0] = 1e-6 * np.cumsum(rng.integers(1, 20000, count))
    for k, name in enumerate(STATES):
        if name.startswith("gated"):
            values[:, k] = rng.choice([0.0, 1.0, np.nan], count)
        elif name == "flags":
            values[:, k] = rng.integers(0, 128, count)
        elif name.startswith("nis"):
            values[rng.random(count) < 0.5, k] = np.nan
    return values


def _same(one: np.ndarray, other: np.ndarray, rtol: float = 0.0) -> None:
    assert one.shape == other.shape
    np.testing.assert_allclose(one, other, rtol=rtol, atol=0.0, equal_nan=True)


def _written(path: Path, values: np.ndarray) -> Path:
    with states_writer(path) as add:
        for begin in range(0, len(values), 7):
            add(values[begin : begin + 7])
    return path


def test_parquet_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    rows = 1_000_000
    table = pyarrow.table({name: np.zeros(rows) for name in ("t_s", "gz_radps", "other")})
    with parquet.ParquetWriter(tmp_path / "log.parquet", table.schema) as writer:
        for _ in range(20):
            writer.write_table(table)
    assert (tmp_path / "log.parquet").stat().st_size < 1_000_000
    # The column that is not read does not count.
    with pytest.raises(BadInputError, match=r"has 20000000 rows, which unpack to 320 MB .* at most 268"):
        next(iter_log(tmp_path / "log.parquet"))


def test_parquet_holds_the_rows_bit_for_bit(tmp_path: Path) -> None:
    from pyarrow import parquet

    values = _rows()
    table = parquet.read_table(_written(tmp_path / "states.parquet", values))
    assert tuple(table.column_names) == STATES
    assert str(table.schema.field("flags").type) == "int64"
    _same(np.stack([column.cast("float64").to_numpy() for column in table.columns], axis=1), values)


def test_mcap_holds_states_and_poses(tmp_path: Path) -> None:
    """The package's own reader finds an index, schemas and every message."""
    from mcap.reader import make_reader

    values = _rows()
    path = _written(tmp_path / "states.mcap", values)
    with pytest.raises(BadInputError, match="holds states that calib replay has written, expected a log"):
        read_log(path)
    read, poses = [], []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 2 * len(values)
        names = {schema.name: json.loads(schema.data) for schema in summary.schemas.values()}
        for _, channel, message in reader.iter_messages():
            body = json.loads(message.data)
            stamp = body["timestamp"]["sec"] * 10**9 + body["timestamp"]["nsec"]
            assert message.log_time == message.publish_time == stamp
            (read if channel.topic == "/states" else poses).append(body)
    assert set(names) == {"calib.States", "foxglove.PoseInFrame"}
    assert list(names["calib.States"]["properties"]) == ["timestamp", *STATES]
    found = np.array([[np.nan if body[name] is None else body[name] for name in STATES] for body in read])
    _same(found, values, rtol=5.1e-9)
    for body, row in zip(poses, values, strict=True):
        assert body["frame_id"] == "world"
        place, turn = body["pose"]["position"], body["pose"]["orientation"]
        x, y, phi = (row[STATES.index(name)] for name in ("x_m", "y_m", "phi_rad"))
        assert (place["x"], place["y"]) == pytest.approx((x, y), rel=1e-8)
        # The turned y axis is the arc's tangent at the head, (sin phi, cos phi).
        w, z = turn["w"], turn["z"]
        assert (-2 * w * z, w * w - z * z) == pytest.approx((math.sin(phi), math.cos(phi)), abs=1e-8)


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_rows_give_the_same_bytes(ending: str, tmp_path: Path) -> None:
    one, other = (_written(tmp_path / f"{name}{ending}", _rows()) for name in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("ending", [".parquet", ".mcap"])
def test_an_interrupted_binary_file_leaves_nothing(ending: str, tmp_path: Path) -> None:
    def broken() -> None:
        with states_writer(tmp_path / f"states{ending}") as add:
            add(_rows())
            raise KeyError

    with pytest.raises(KeyError):
        broken()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_one_sentence(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"states{ending}"
    path.symlink_to("/dev/full")
    rows = np.tile(_rows(), (500, 1))
    rows[:, 0] = np.arange(len(rows))
    with pytest.raises(BadInputError) as caught:
        _written(path, rows)
    assert str(caught.value) == f"{path}: cannot be written: No space left on device"


@pytest.mark.parametrize(
    ("bits", "name", "low"),
    [
        (16, "millis", 0),
        (32, "millis", 0),
        (32, "micros", 0),
        (32, "micros", -(2**31)),
        (16, "millis", -(2**15)),
    ],
)
def test_a_time_that_begins_again_is_counted_on(
    write, monkeypatch: pytest.MonkeyPatch, bits: int, name: str, low: int
) -> None:
    step, unit_s = (10, 1e-3) if name == "millis" else (10_000, 1e-6)
    counts = low + 2**bits - 3000 + step * np.arange(20_000)
    rows = "".join(f"{t},{k % 7}\n" for k, t in enumerate((counts - low) % 2**bits + low))
    path = write(f"{name},u_px\n{rows}")
    for size in (1 << 20, 1000):
        monkeypatch.setattr(tables, "_BLOCK_BYTES", size)
        log = read_log(path)
        assert np.allclose(log.t_s, unit_s * counts, rtol=1e-12)
        assert log.passed.wraps == (4 if bits == 16 else 1)
    assert "begins again" in log.remarks()[-1]


def test_rows_of_writers_that_take_turns_are_sorted(write) -> None:
    """Camera and IMU each in order, merged as threads come or one below the other; else rows stay."""
    camera = [f"{0.02 * k + 0.001:.3f},{k},1,\n" for k in range(50)]
    imu = [f"{0.01 * k:.2f},,,{k}\n" for k in range(100)]
    turns = [row for k in range(50) for row in (*imu[2 * k : 2 * k + 2], camera[k])]
    for rows in (turns, camera + imu):
        log = read_log(write("t_s,u_px,v_px,p1_kpa\n" + "".join(rows)))
        assert (np.diff(log.t_s) >= 0.0).all()
        assert log.columns["p1_kpa"][log.sampled("p1_kpa")].tolist() == list(range(100))
        assert log.columns["u_px"][log.sampled("u_px")].tolist() == list(range(50))
        assert rows[log.lines[7] - 2].startswith(f"{log.t_s[7]:.3f}".rstrip("0"))
        assert "below a later one, each sensor's own in order; sorted" in log.remarks()[-1]
    again = read_log(write("t_s,u_px,v_px,p1_kpa\n" + "".join([*imu, *imu])))
    with pytest.raises(BadInputError, match="line 102: t_s goes back"):
        check_time(again)
    assert again.passed.reordered == 0


@pytest.mark.parametrize("falls_to", [0, 20_000])
def test_a_board_that_was_started_again_is_no_counter(write, falls_to: int) -> None:
    counts = np.concatenate([30_000 + 10 * np.arange(100), falls_to + 10 * np.arange(100)])
    log = read_log(write("millis,u_px\n" + "".join(f"{t},1\n" for t in counts)))
    with pytest.raises(BadInputError, match="line 102: t_s goes back"):
        check_time(log)


@pytest.mark.parametrize(
    ("form", "mark", "zone"),
    [
        ("%Y-%m-%dT%H:%M:%S.%f", ",", "Z"),
        ("%Y-%m-%d %H:%M:%S.%f", ",", ""),
        ("%Y-%m-%dT%H:%M:%S.%f", ",", "+05:30"),
        ("%Y-%m-%d %H:%M:%S,%f", ";", ""),
    ],
)
def test_times_may_be_dates(write, form: str, mark: str, zone: str) -> None:
    start = datetime(2024, 2, 29, 23, 59, 58, 250_000)
    dates = [(start + timedelta(milliseconds=20 * k)).strftime(form) + zone for k in range(500)]
    path = write(f"timestamp{mark}u_px\n" + "".join(f"{date}{mark}{k}\n" for k, date in enumerate(dates)))
    log = read_log(path)
    assert np.allclose(log.t_s - log.t_s[0], 0.02 * np.arange(500), atol=1e-6, rtol=0.0)
    since = datetime.fromisoformat(f"2024-02-29T23:59:58.250000{zone or 'Z'}").timestamp()
    assert log.t_s[0] == pytest.approx(since, abs=1e-6)
    assert log.map is not None and "time in s from `timestamp` (dates)" in log.map.narration
    # A row that only Python's reader takes makes no difference to the others.
    path.write_text(path.read_text().replace(f"{mark}7\n", f'{mark}"7 "\n'))
    assert np.array_equal(read_log(path).t_s, log.t_s)
    with pytest.raises(BadInputError, match=r"line 502: t_s is '1', expected a date such as"):
        read_log(write(path.read_text() + 3 * f"1{mark}1\n"))
    with pytest.raises(BadInputError, match=r"line 3: t_s is '2024.*a number, or in all rows a date"):
        read_log(write(f"t_s{mark}u_px\n1{mark}1\n{dates[0]}{mark}1\n"))


@pytest.mark.parametrize("mark", [".", ":"])
def test_times_of_day_run_on_past_midnight(write, monkeypatch: pytest.MonkeyPatch, mark: str) -> None:
    start = datetime(2024, 2, 29, 23, 59, 58, 250_000)
    times = [(start + timedelta(milliseconds=20 * k)).strftime(f"%H:%M:%S{mark}%f")[:-3] for k in range(500)]
    path = write("time,u_px\n" + "".join(f"{time},{k}\n" for k, time in enumerate(times)))
    for size in (1 << 20, 1000):
        monkeypatch.setattr(tables, "_BLOCK_BYTES", size)
        log = read_log(path)
        assert np.allclose(log.t_s, 86398.25 + 0.02 * np.arange(500), atol=1e-6, rtol=0.0)
        assert log.passed.wraps == 1
    with pytest.raises(BadInputError, match="line 3: t_s goes back"):
        check_time(read_log(write("time,u_px\n12:00:01.0,1\n11:00:00,1\n11:00:01,2\n")))


def test_what_a_serial_monitor_adds_is_passed_over(write) -> None:
    """Its time before each line, what the board says between its rows, and the header once more."""
    rows = [f"{10 * k},{k},1" for k in range(100)]
    wanted = read_log(write("\n".join(["millis,u_px,v_px", *rows]) + "\n"))
    said = ["millis,u_px,v_px", *rows[:40], "Pixy: no blocks, again", *rows[40:], "millis,u_px,v_px"]
    log = read_log(write("".join(f"12:03:{k % 60:02d}.250 -> {line}\r\n" for k, line in enumerate(said))))
    assert np.array_equal(log.t_s, wanted.t_s)
    assert np.array_equal(log.columns["u_px"], wanted.columns["u_px"])
    assert log.lines[39:41].tolist() == [41, 43]
    assert "2 lines between the rows hold words and no number" in log.remarks()[-1]
    with pytest.raises(BadInputError, match="line 102: has 2 cells, expected 3"):
        read_log(write("\n".join(["millis,u_px,v_px", *rows, "lost 3 blocks,7"]) + "\n"))


def test_dates_in_parquet(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    times = pyarrow.array([1_709_251_198_250_000 + 20_000 * k for k in range(200)], pyarrow.timestamp("us"))
    path = tmp_path / "log.parquet"
    table = pyarrow.table({"time": times, "u_px": pyarrow.array(np.arange(200.0))})
    importlib.import_module("pyarrow.parquet").write_table(table, path)
    log = read_log(path)
    assert log.t_s[0] == pytest.approx(1_709_251_198.25, abs=1e-6)
    assert np.allclose(np.diff(log.t_s), 0.02, atol=1e-6)


def test_texts_in_parquet_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    """A text of 50 MB in a thousand rows is a file of a kilobyte."""
    pyarrow = pytest.importorskip("pyarrow")
    texts = pyarrow.DictionaryArray.from_arrays(pyarrow.array([0] * 1000, "int32"), ["x" * 50_000_000])
    path = tmp_path / "log.parquet"
    table = pyarrow.table({"t_s": np.arange(1000.0), "gz_radps": texts})
    importlib.import_module("pyarrow.parquet").write_table(table, path, compression="zstd")
    with pytest.raises(BadInputError, match=r"gz_radps holds dictionary<.*, expected numbers"):
        read_log(path)


@pytest.mark.parametrize("text", ["# a\nx;y\n0,5;1e-1\n;2\n", "x\ty\n0.5\t0,1\n\t2\n", "x,y\n0.5,0.1\n,2\n"])
def test_small_tables_as_spreadsheets_save_them(write, text: str) -> None:
    cells = read_cells(write(text))
    assert cells.header == ["x", "y"]
    np.testing.assert_array_equal(cells.numbers(0, 1), [[0.5, 0.1], [np.nan, 2.0]])

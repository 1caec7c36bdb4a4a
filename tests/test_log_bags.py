"""Bags as logs: every format gives the same rows, and one clear sentence for what does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import KINDS_OF_FORMAT, NAMES, START_NS, Message, readings, write_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.io.logs import read_log

COLUMNS = {
    "imu": ("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps"),
    "marker": ("u_px", "v_px"),
    "pwm": ("pwm1", "pwm2"),
}


@pytest.mark.parametrize("form", KINDS_OF_FORMAT)
def test_every_format_gives_the_same_log(form: str, tmp_path: Path) -> None:
    messages = readings(np.random.default_rng(0))
    log = read_log(write_bag(tmp_path, form, messages))
    assert len(log) == 160 and log.unknown == () and not log.truncated and log.not_finite == 0
    assert np.all(np.diff(log.t_s) > 0.0) and log.t_s[0] == 0.0
    for kind, columns in COLUMNS.items():
        rows = log.sampled(*columns)
        wanted = [message for message in messages if message[0] == kind]
        assert len(rows) == len(wanted)
        # A double of some seconds holds nanoseconds.
        assert np.allclose(log.t_s[rows], [(m[1] - START_NS) * 1e-9 for m in wanted], rtol=0, atol=5e-10)
        for k, name in enumerate(columns):
            assert log.columns[name][rows].tolist() == [m[2][k] for m in wanted]


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["imu", "marker", "pwm"]),
            st.integers(0, 400_000_000),
            st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6),
        ),
        min_size=1,
        max_size=12,
        unique_by=lambda item: item[:2],
    ),
    st.sampled_from(["ros1", "folder", "json"]),
)
def test_no_reading_is_lost_or_changed(
    tmp_path_factory: pytest.TempPathFactory, items: list[tuple[str, int, list[float]]], form: str
) -> None:
    messages: list[Message] = sorted(
        ((kind, START_NS + at, tuple(values[: len(COLUMNS[kind])])) for kind, at, values in items),
        key=lambda message: message[1],
    )
    log = read_log(write_bag(tmp_path_factory.mktemp("bag"), form, messages))
    assert np.all(np.diff(log.t_s) > 0.0), "readings of one time make one row"
    start = messages[0][1]
    for kind, columns in COLUMNS.items():
        wanted = [message for message in messages if message[0] == kind]
        if not wanted:
            assert all(not len(log.sampled(name)) for name in columns)
            continue
        rows = log.sampled(*columns)
        assert np.allclose(log.t_s[rows], [(m[1] - start) / 1e9 for m in wanted], rtol=0, atol=1e-9)
        for k, name in enumerate(columns):
            assert log.columns[name][rows].tolist() == [m[2][k] for m in wanted]


def test_what_arrives_late_is_put_where_it_belongs(tmp_path: Path) -> None:
    """Stamps within the window come sorted; the time of reception does not count."""
    messages: list[Message] = [
        ("imu", START_NS + 10_000_000 * k, (float(k), 0.0, 0.0, 0.0, 0.0, 0.0)) for k in range(50)
    ]
    late = [*messages[:10], *messages[20:30], *messages[10:20], *messages[30:]]
    path = write_bag(tmp_path, "sqlite", late, delay_ns=0)
    # Reception in the order of the file.
    import sqlite3

    with sqlite3.connect(next(path.glob("*.db3"))) as base:
        base.execute("update messages set timestamp = id")
    base.close()
    log = read_log(path)
    assert log.columns["ax_mps2"].tolist() == list(range(50))
    (path / "topics.yaml").write_text("time: received\ntopics:\n  /imu/data: imu\n")
    received = read_log(path)
    assert received.columns["ax_mps2"].tolist() == [m[2][0] for m in late]


def test_a_file_beside_the_bag_says_what_is_where(tmp_path: Path) -> None:
    names = {"imu": "/left/imu", "marker": "/blob", "pwm": "/valves"}
    path = write_bag(tmp_path, "folder", readings(np.random.default_rng(2)), names)
    (tmp_path / "log.topics.yaml").write_text(
        "topics:\n  /blob:\n    u_px: point.y\n    v_px: {field: point.x, factor: 2}\n"
        "  /valves: {pwm2: 'data[0]'}\n"
    )
    log = read_log(path)
    assert list(log.columns) == ["u_px", "v_px", "pwm2"]
    assert log.unknown == ("/left/imu",)
    other = tmp_path / "other.yaml"
    other.write_text("topics:\n  /left/imu: imu\n")
    assert list(read_log(path, other).columns) == list(COLUMNS["imu"])


def test_nan_in_a_message_is_a_blank_cell(tmp_path: Path) -> None:
    messages: list[Message] = [
        ("marker", START_NS, (float("nan"), 2.0)),
        ("marker", START_NS + 10**7, (float("inf"), 3.0)),
    ]
    log = read_log(write_bag(tmp_path, "mcap", messages))
    assert log.sampled("u_px").tolist() == [] and log.columns["v_px"].tolist() == [2.0, 3.0]
    assert log.not_finite == 1


def test_an_mcap_that_is_still_written_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "json", readings(np.random.default_rng(3), 8.0))
    whole = read_log(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 5])
    part = read_log(path)
    assert part.truncated and 0 < len(part) < len(whole)
    assert np.array_equal(part.t_s, whole.t_s[: len(part)])


def _refused(path: Path, topics: Path | None = None) -> str:
    with pytest.raises(BadInputError) as caught:
        read_log(path, topics)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_without_a_topic_that_is_known(tmp_path: Path) -> None:
    names = {**NAMES, "marker": "/blob"}
    path = write_bag(tmp_path, "ros1", readings(np.random.default_rng(0))[1:2], names)
    said = _refused(path)
    assert "has no topic that is known by itself, found /blob (geometry_msgs/PointStamped)" in said
    assert "log.topics.yaml" in said


@pytest.mark.parametrize("form", KINDS_OF_FORMAT)
def test_damaged_bytes_are_refused_or_read_never_raised(form: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, form, readings(np.random.default_rng(0), 0.2))
    file = path if path.is_file() else next(item for item in path.iterdir() if item.suffix != ".yaml")
    whole = file.read_bytes()
    rng = np.random.default_rng(4)
    refused = 0
    for _ in range(20):
        broken = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            broken[at] = rng.integers(256)
        file.write_bytes(broken if rng.random() < 0.7 else broken[: rng.integers(len(whole))])
        try:
            read_log(path)
        except BadInputError as error:
            refused += 1
            assert str(error).startswith(str(tmp_path))
    assert refused > 3


def test_a_bag_that_is_not_there_and_one_that_is_a_pipe(tmp_path: Path) -> None:
    import os

    assert "cannot be read: No such file" in _refused(tmp_path / "none.mcap")
    pipe = tmp_path / "pipe.bag"
    os.mkfifo(pipe)
    assert "is a pipe" in _refused(pipe)


@pytest.mark.parametrize("packing", ["ZSTD", "LZ4", "NONE"])
@pytest.mark.parametrize("index", [True, False])
def test_a_chunk_that_unpacks_to_too_much_is_refused(
    packing: str, index: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=10**6, compression=CompressionType[packing])
        writer.start()
        channel = writer.register_channel("/imu", "json", writer.register_schema("imu", "jsonschema", b"{}"))
        for k in range(2000):
            writer.add_message(channel, k, b'{"gz_radps": 0.0}' + b" " * 100, k)
        writer.finish()
    if not index:
        path.write_bytes(path.read_bytes()[: -(path.stat().st_size // 20)])
    (tmp_path / "topics.yaml").write_text("topics:\n  /imu: {gz_radps: gz_radps}\n")
    if index:
        assert len(read_log(path)) == 2000
    monkeypatch.setattr("calib.io.unpacking.MOST_BYTES", 100_000)
    said = _refused(path)
    assert "a chunk unpacks to" in said or "exceeds" in said


def test_the_hash_of_a_folder_is_that_of_its_files(tmp_path: Path) -> None:
    from calib.core.files import hash_of

    path = write_bag(tmp_path, "sqlite", readings(np.random.default_rng(0), 0.2))
    before = hash_of(path)
    assert before == hash_of(path) and len(before) == 64
    copy = path.rename(tmp_path / "elsewhere")
    assert hash_of(copy) == before
    base = next(copy.glob("*.db3"))
    base.write_bytes(base.read_bytes() + b"x")
    assert hash_of(copy) != before

"""Bags as logs: every format gives the same rows; topics, order and bounds on what is unpacked."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bags import KINDS, KINDS_OF_FORMAT, NAMES, START_NS, Message, _ros, readings, write_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.core.options import LogOptions
from calib.io import unpacking
from calib.io.bag_topics import Field, Topic, TopicMap, field_reader, topic_map
from calib.io.bags import WINDOW_S, rows_from_messages
from calib.io.logs import iter_log, read_log
from calib.io.unpacking import BoundedFile, BoundedPath

COLUMNS = {
    "imu": ("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps"),
    "marker": ("u_px", "v_px"),
    "pwm": ("pwm1", "pwm2"),
}


@pytest.mark.parametrize("form", KINDS_OF_FORMAT)
def test_every_format_gives_the_same_log(form: str, tmp_path: Path) -> None:
    messages = readings(np.random.default_rng(0))
    log = read_log(write_bag(tmp_path, form, messages))
    assert len(log) == 160 and log.unknown == () and not log.passed.truncated and log.passed.not_finite == 0
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
    # Any number, those beyond any sensor too.
    blocks = list(iter_log(write_bag(tmp_path_factory.mktemp("bag"), form, messages), as_it_is=True))
    joined = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    log = replace(blocks[0], t_s=np.concatenate([block.t_s for block in blocks]), columns=joined)
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
        ("imu", START_NS + 10_000_000 * k, (9.0 + 0.01 * k, 0.0, 0.0, 0.0, 0.0, 0.0)) for k in range(50)
    ]
    late = [*messages[:10], *messages[20:30], *messages[10:20], *messages[30:]]
    path = write_bag(tmp_path, "sqlite", late, delay_ns=0)
    # Reception in the order of the file.
    import sqlite3

    with sqlite3.connect(next(path.glob("*.db3"))) as base:
        base.execute("update messages set timestamp = id * 10000000")
    base.close()
    log = read_log(path)
    assert log.columns["ax_mps2"].tolist() == [m[2][0] for m in messages]
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
    assert list(read_log(path, LogOptions(topics=other)).columns) == list(COLUMNS["imu"])


def test_nan_in_a_message_is_a_blank_cell(tmp_path: Path) -> None:
    messages: list[Message] = [
        ("marker", START_NS, (float("nan"), 2.0)),
        ("marker", START_NS + 10**7, (float("inf"), 3.0)),
    ]
    log = read_log(write_bag(tmp_path, "mcap", messages))
    assert log.sampled("u_px").tolist() == [] and log.columns["v_px"].tolist() == [2.0, 3.0]
    assert log.passed.not_finite == 1


def test_an_mcap_that_is_still_written_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "json", readings(np.random.default_rng(3), 8.0))
    whole = read_log(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 5])
    part = read_log(path)
    assert part.passed.truncated and 0 < len(part) < len(whole)
    assert np.array_equal(part.t_s, whole.t_s[: len(part)])


def _refused(path: Path, topics: Path | None = None) -> str:
    with pytest.raises(BadInputError) as caught:
        read_log(path, LogOptions(topics=topics))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ("ros1", "rosbag reindex"),
        ("mcap", "mcap recover"),
        ("sqlite", r"\.recover"),
        ("folder", "ros2 bag reindex"),
    ],
)
def test_a_recording_that_was_cut_is_told_what_mends_it(form: str, said: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, form, readings(np.random.default_rng(3), 0.5))
    if form == "folder":
        (path / "metadata.yaml").unlink()
    else:
        file = path if path.is_file() else next(path.glob("*.db3"))
        file.write_bytes(file.read_bytes()[: file.stat().st_size * 3 // 5])
    assert re.search(said, _refused(path))


@pytest.mark.few(0, 3, 4)
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
            writer.add_message(channel, 10**7 * k, b'{"gz_radps": 0.0}' + b" " * 100, 10**7 * k)
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


MAP = TopicMap("x.yaml", {"/a": (Field("u_px", "u"), Field("v_px", "v")), "/b": (Field("gz_radps", "g"),)})


class Messages:
    """A bag in memory: topic, stamp and body."""

    truncated = False
    topics = (Topic("/a", "A"), Topic("/b", "B"), Topic("/c", "C"))

    def __init__(self, items: Iterable[tuple[str, int, dict[str, Any]]]) -> None:
        self._items = list(items)

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = set(names)
        return iter([item for item in self._items if item[0] in wanted])


def rows(
    items: Iterable[tuple[str, int, dict[str, Any]]], topics: TopicMap = MAP
) -> tuple[np.ndarray, list[Any]]:
    blocks = list(rows_from_messages("log", Messages(items), topics))
    names = ("t_s", *topics.columns)
    return np.column_stack([np.concatenate([one.cells[name] for one in blocks]) for name in names]), blocks


@pytest.mark.parametrize(
    ("body", "seconds"),
    [
        ({"header": {"stamp": {"sec": 2, "nanosec": 500_000_000}}}, 2.5),
        ({"timestamp": {"sec": 0, "nsec": 0}}, 4.0),
        ({"timestamp": {"sec": "2"}}, 4.0),
        ({}, 4.0),
    ],
)
def test_the_stamp_of_a_message_or_its_reception(body: dict[str, Any], seconds: float) -> None:
    found, _ = rows([("/b", 4_000_000_000, {"g": 1.0, **body})])
    assert found[0, 0] == seconds
    received = TopicMap(MAP.source, MAP.topics, stamped=False)
    assert rows([("/b", 4_000_000_000, {"g": 1.0, **body})], received)[0][0, 0] == 4.0


@pytest.mark.parametrize(
    ("sec", "said"),
    [
        (3.997, ""),
        (2.0, "/a has stamps 2.000 s before their reception, /b 0.000 s, as of two clocks"),
        (0.0, "2 messages of /a have no stamp in their header; taken when they were received"),
        (0.5, "/a has stamps 3.500 s before their reception, /b 0.000 s: two clocks with no time in common"),
    ],
)
def test_stamps_by_two_clocks_and_none(sec: float, said: str) -> None:
    def marker(received: int) -> tuple[str, int, Any]:
        stamp = round(sec * 1e9) + received - 4 * 10**9 if sec else 0
        header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9))
        return ("/a", received, SimpleNamespace(header=header, u=1.0, v=received / 1e9))

    rates = [("/b", second * 10**9, {"g": 1.0}) for second in (2, 4)]
    items = [*rates, marker(4 * 10**9), marker(5 * 10**9)]
    if "no time" in said:
        with pytest.raises(BadInputError, match=said):
            rows(items)
        rows(items, TopicMap(MAP.source, MAP.topics, stamped=False))
    else:
        assert rows(items)[1][-1].passed.odd_times == said


def test_a_message_that_two_bags_hold_counts_once() -> None:
    items = [("/a", 1, {"u": 1.0, "v": 2.0}), ("/b", 1, {"g": 3.0}), ("/b", 2, {"g": 4.0})]
    found, blocks = rows([*items, *items])
    assert np.array_equal(found, rows(items)[0], equal_nan=True)
    assert sum(block.passed.repeated for block in blocks) == 2


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 40)), max_size=60),
    st.integers(1, 9),
    st.randoms(use_true_random=False),
)
def test_blocks_of_any_size_give_the_same_rows(items: list[tuple[str, int]], size: int, random: Any) -> None:
    """Messages that are late by less than the window come in order, however they are cut."""
    step = int(1e9 * WINDOW_S / 50)
    messages = [
        (name, (10 * (k // 2) + at) * step, {"u": k, "v": -k, "g": k}) for k, (name, at) in enumerate(items)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calib.io.bags._ROWS", size)
        cut, blocks = rows(messages)
    whole, _ = rows(messages)
    assert np.array_equal(np.sort(cut[:, 0]), cut[:, 0])
    assert np.concatenate([block.lines for block in blocks]).tolist() == list(range(1, len(cut) + 1))
    assert np.array_equal(cut, whole, equal_nan=True)


TOPICS = (
    Topic("/imu", "sensor_msgs/Imu"),
    Topic("/marker", "geometry_msgs/PointStamped"),
    Topic("/pwm", "std_msgs/UInt16MultiArray"),
    Topic("/log", "rcl_interfaces/Log"),
    Topic("/own", "calib.Row", ("t_s", "true_q1_m", "colour")),
)


def _map(text: str, tmp_path: Path, topics: tuple[Topic, ...] = TOPICS):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    return topic_map(tmp_path / "log.bag", topics, file)


def test_namespaces_and_topics_without_messages(tmp_path: Path) -> None:
    spaced = tuple(replace(one, name=f"/rig1{one.name}") for one in TOPICS)
    unused = Topic("/imu/raw", "sensor_msgs/Imu", used=False)
    for text in ("time: received\n", "time: stamp\n"):
        found = _map(text, tmp_path, (*spaced, unused))
        assert list(found.topics) == ["/rig1/imu", "/rig1/marker", "/rig1/pwm", "/rig1/own"]
        assert found.stamped is (text == "time: stamp\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("topic: {}\n", "topic is not known, expected time or topics"),
        ("topics: {/no: imu}\n", "the topic '/no' is not in"),
        ("topics: {/log: marker}\n", "expected geometry_msgs/PointStamped"),
        ("topics: {/imu: {t_s: x}}\n", "'t_s' is no column, expected one of u_px"),
        ("topics: {/imu: {u_px: {field: x, factor: .nan}}}\n", "the factor is nan, expected a number"),
        ("[1, 2]\n", "holds a list, expected keys with values"),
    ],
)
def test_a_file_that_is_wrong(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        _map(text, tmp_path)
    said = str(caught.value)
    assert words in said and said.startswith(str(tmp_path / "mine.yaml")) and "\n" not in said


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.sampled_from("ab"), inner)),
    max_leaves=6,
)


@settings(deadline=None)
@given(json_values, st.sampled_from(["a", "a.b", "a[0]", "a[1].b", "b.a[0][1]"]))
def test_any_message_gives_a_number_or_a_sentence(message: object, path: str) -> None:
    try:
        value = field_reader("log", "/t", Field("u_px", path))(message)
    except BadInputError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(value, float)


def test_nothing_that_was_detected_is_a_blank() -> None:
    read = field_reader("log", "/t", Field("u_px", "detections[0].x"))
    assert math.isnan(read({"detections": []}))
    assert read({"detections": [{"x": 7}]}) == 7.0
    with pytest.raises(BadInputError, match="1 elements there"):
        field_reader("log", "/t", Field("u_px", "data[1]"))({"data": [7]})


MOST = 100_000


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpacking, "MOST_BYTES", MOST)


def _ros1(path: Path, packing: str, count: int) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, writer = get_typestore(Stores.ROS1_NOETIC), Writer(path)
    writer.set_compression(Writer.CompressionFormat[packing])
    with writer:
        connection = writer.add_connection(NAMES["marker"], KINDS["marker"], typestore=store)
        for k in range(count):
            message = _ros(store, "marker", START_NS + k * 10**7, (1.0, 2.0), True)
            writer.write(connection, START_NS + k * 10**7, store.serialize_ros1(message, KINDS["marker"]))
    return path


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("packing", ["BZ2", "LZ4"])
def test_chunks_of_a_ros_1_bag(packing: str, tmp_path: Path) -> None:
    assert len(read_log(_ros1(tmp_path / "log.bag", packing, 50))) == 50
    with pytest.raises(BadInputError, match=r"log\.bag: .* unpacks to more than"):
        read_log(_ros1(tmp_path / "big-log.bag", packing, 4000))


def _ros2(folder: Path, mode: str, padding: int) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(NAMES["marker"], KINDS["marker"], typestore=store)
        for k in range(5):
            message = _ros(store, "marker", START_NS + k * 10**7, (1.0, float(k)), False)
            message.header.frame_id = "x" * padding
            writer.write(connection, START_NS + k * 10**7, store.serialize_cdr(message, KINDS["marker"]))
    return folder


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_ros_2_bags_that_are_packed(mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = read_log(_ros2(tmp_path / "log", mode, 1))
    assert log.columns["v_px"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    if mode == "MESSAGE":
        alone = read_log(next((tmp_path / "log").glob("*.db3")))
        assert np.array_equal(alone.columns["v_px"], log.columns["v_px"])
    monkeypatch.setattr(unpacking, "MOST_BYTES", MOST)
    monkeypatch.setattr(unpacking, "_MOST_GROWTH", 3)
    with pytest.raises(BadInputError, match="unpacks to more than"):
        read_log(_ros2(tmp_path / "big", mode, 2 * MOST))


def test_no_room_is_made_for_what_a_file_does_not_hold(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 3_000_000)
    with BoundedFile(path) as stream:
        assert stream.read(10) == b"x" * 10
        # More than any machine has.
        assert len(stream.read(1 << 60)) == 3_000_000 - 10
        assert stream.read(1 << 60) == b""
        stream.seek(-2, 2)
        assert stream.read() == b"xx"
    with BoundedPath(path).open("rb") as again:
        assert isinstance(again, BoundedFile)
    assert BoundedPath(path).read_text() == path.read_text()

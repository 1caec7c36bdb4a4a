"""Topics to columns: what the file beside a bag may say, and one sentence for what it may not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import BadInputError
from calib.log_topics import IMU, Field, Topic, find_topics, reader_of, topic_map
from calib.logs import COLUMNS

TOPICS = (
    Topic("/imu", "sensor_msgs/Imu"),
    Topic("/marker", "geometry_msgs/PointStamped"),
    Topic("/pwm", "std_msgs/UInt16MultiArray"),
    Topic("/log", "rcl_interfaces/Log"),
    Topic("/own", "calib.Row", ("t_s", "true_q1_m", "colour")),
)


@dataclass
class Vector:
    x: float
    data: np.ndarray


@dataclass
class Message:
    vector: Vector
    name: str


def _map(text: str, tmp_path: Path, topics: tuple[Topic, ...] = TOPICS):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    return topic_map(tmp_path / "log.bag", topics, file)


def test_what_is_known_by_itself(tmp_path: Path) -> None:
    found = topic_map(tmp_path / "log.bag", TOPICS)
    assert {name: tuple(f.path for f in fields) for name, fields in found.topics.items()} == {
        "/imu": tuple(IMU.values()),
        "/marker": ("point.x", "point.y"),
        "/pwm": ("data[0]", "data[1]"),
        "/own": ("true_q1_m",),
    }
    assert found.stamped and found.columns == tuple(name for name in COLUMNS if name in found.columns)


def test_presets_columns_and_factors(tmp_path: Path) -> None:
    found = _map(
        "time: received\ntopics:\n  /imu: imu\n  /own:\n    u_px: a.b[2].c\n"
        "    pwm1: {field: x, factor: -2.5}\n",
        tmp_path,
    )
    assert not found.stamped
    assert found.topics["/own"] == (Field("u_px", "a.b[2].c"), Field("pwm1", "x", -2.5))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("topic: {}\n", "topic is not known, expected time or topics"),
        ("time: now\ntopics: {/imu: imu}\n", "time is 'now', expected stamp or received"),
        ("time: stamp\n", "topics is None, expected topics with their columns"),
        ("topics: []\n", "topics is [], expected"),
        ("topics: {/no: imu}\n", "the topic '/no' is not in"),
        ("topics: {1: imu}\n", "the topic 1 is not in"),
        ("topics: {/imu: wheel}\n", "topics./imu is 'wheel', expected imu, marker, pwm or columns"),
        ("topics: {/log: imu}\n", "topics./log is of type rcl_interfaces/Log, expected sensor_msgs/Imu"),
        ("topics: {/log: marker}\n", "expected geometry_msgs/PointStamped"),
        ("topics: {/log: pwm}\n", "expected std_msgs/Float32MultiArray"),
        ("topics: {/imu: {}}\n", "topics./imu is {}, expected"),
        ("topics: {/imu: {t_s: x}}\n", "'t_s' is no column, expected one of u_px"),
        ("topics: {/imu: {u_px: 'x; y'}}\n", "topics./imu.u_px is 'x; y', expected a field such as point.x"),
        ("topics: {/imu: {u_px: {field: x, times: 2}}}\n", "u_px is {'field': 'x', 'times': 2}, expected"),
        ("topics: {/imu: {u_px: {factor: 2}}}\n", "u_px is None, expected a field"),
        ("topics: {/imu: {u_px: {field: x, factor: .nan}}}\n", "the factor is nan, expected a number"),
        ("topics: {/imu: {u_px: {field: x, factor: yes}}}\n", "the factor is True, expected a number"),
        ("topics: {/imu: imu, /own: {gz_radps: x}}\n", "gz_radps comes from two topics, /imu and /own"),
        ("topics: {/imu: {u_px: a..b}}\n", "u_px is 'a..b', expected a field"),
        ("[1, 2]\n", "holds a list, expected keys with values"),
    ],
)
def test_a_file_that_is_wrong(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        _map(text, tmp_path)
    said = str(caught.value)
    assert words in said and said.startswith(str(tmp_path / "mine.yaml")) and "\n" not in said


def test_two_imus_have_to_be_told_apart(tmp_path: Path) -> None:
    two = (*TOPICS, Topic("/imu\n2", "sensor_msgs/Imu"))
    with pytest.raises(BadInputError) as caught:
        topic_map(tmp_path / "log.bag", two)
    assert "has 2 topics of sensor_msgs/Imu: /imu (sensor_msgs/Imu), /imu\\n2 (" in str(caught.value)
    assert "log.topics.yaml" in str(caught.value)
    assert len(_map('topics: {"/imu\\n2": imu}\n', tmp_path, two).topics) == 1


def test_a_long_list_of_topics_is_cut(tmp_path: Path) -> None:
    many = tuple(Topic(f"/t{k}", "a/B") for k in range(50))
    with pytest.raises(BadInputError, match=r"/t7 \(a/B\) and 42 others"):
        topic_map(tmp_path / "log.bag", many)


def test_where_the_file_is_looked_for(tmp_path: Path) -> None:
    bag, folder = tmp_path / "log.bag", tmp_path / "rec"
    folder.mkdir()
    assert find_topics(bag) is None and find_topics(folder) is None
    (tmp_path / "topics.yaml").touch()
    assert find_topics(bag) == find_topics(folder) == tmp_path / "topics.yaml"
    (tmp_path / "log.topics.yaml").touch()
    (tmp_path / "rec.topics.yaml").touch()
    assert find_topics(bag) == tmp_path / "log.topics.yaml"
    assert find_topics(folder) == tmp_path / "rec.topics.yaml"
    (folder / "topics.yaml").touch()
    assert find_topics(folder) == folder / "topics.yaml"


MESSAGES = (
    Message(Vector(1.5, np.array([2, 3], dtype=np.uint16)), "n"),
    {"vector": {"x": 1.5, "data": [2, 3]}, "name": "n", "none": None, "true": True, "huge": 10**400},
)


@pytest.mark.parametrize("message", MESSAGES, ids=["object", "json"])
def test_values_of_fields(message: object) -> None:
    assert reader_of("log", "/t", Field("u_px", "vector.x", 2.0))(message) == 3.0
    assert reader_of("log", "/t", Field("u_px", "vector.data[1]"))(message) == 3.0


@pytest.mark.parametrize("message", MESSAGES, ids=["object", "json"])
@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("point.x", "log: /t: point.x (for u_px) is not in the message, which has vector, name"),
        ("vector.y", "vector.y (for u_px) is not in the message, which has x, data"),
        ("vector.data[2]", "is not in the message, which has 2 elements there"),
        ("vector.x.y", "is not in the message, which has 1.5 there"),
        ("name", "name (for u_px) is 'n', expected a number"),
        ("vector", "expected a number"),
        ("vector.data", "expected a number"),
    ],
)
def test_fields_that_are_not_there(message: object, path: str, words: str) -> None:
    with pytest.raises(BadInputError) as caught:
        reader_of("log", "/t", Field("u_px", path))(message)
    assert words in str(caught.value) and len(str(caught.value)) < 300


def test_null_and_numbers_beyond_a_double() -> None:
    assert math.isnan(reader_of("log", "/t", Field("u_px", "none"))(MESSAGES[1]))
    with pytest.raises(BadInputError, match="expected a number"):
        reader_of("log", "/t", Field("u_px", "huge"))(MESSAGES[1])


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.sampled_from("ab"), inner)),
    max_leaves=6,
)


@settings(deadline=None)
@given(json_values, st.sampled_from(["a", "a.b", "a[0]", "a[1].b", "b.a[0][1]"]))
def test_any_message_gives_a_number_or_a_sentence(message: object, path: str) -> None:
    try:
        value = reader_of("log", "/t", Field("u_px", path))(message)
    except BadInputError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(value, float)

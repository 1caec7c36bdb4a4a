"""Topics to columns: what the file beside a bag may say, and one sentence for what it may not."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.io.bags import Field, Topic, reader_of, topic_map

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

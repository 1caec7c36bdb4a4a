"""Which field of which topic of a bag is which column of a log.

A bag holds messages by topic; `calib.io.logs` knows columns. What goes where stands in a YAML file,
`NAME.topics.yaml` beside the bag, or `topics.yaml` in its folder:

    time: stamp                # header.stamp where a message has one (default), or received
    topics:
      /imu/data: imu           # accelerations and rates of sensor_msgs/Imu
      /camera/marker:          # any message: column and path of the field
        u_px: point.x
        v_px: point.y
      /command:
        pwm1: data[0]
        gz_radps: {field: rates.z, factor: 0.017453292519943295}

Without `topics` the only topic of sensor_msgs/Imu is the IMU, `marker` (a point) the marker and `pwm` (an
array) the commands, in whatever namespace; fields of JSON messages that bear a column's name are that
column. Topics without messages are passed over.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calib.core.errors import BadInputError
from calib.core.files import one_line, quoted, read_yaml_mapping, shown
from calib.core.words import several
from calib.io.columns import COLUMNS

IMU = {
    "ax_mps2": "linear_acceleration.x",
    "ay_mps2": "linear_acceleration.y",
    "az_mps2": "linear_acceleration.z",
    "gx_radps": "angular_velocity.x",
    "gy_radps": "angular_velocity.y",
    "gz_radps": "angular_velocity.z",
}
"""Fields of sensor_msgs/Imu."""

_POINTS = {
    "geometry_msgs/PointStamped": "point.",
    "geometry_msgs/Point": "",
    "geometry_msgs/Vector3Stamped": "vector.",
    "geometry_msgs/Vector3": "",
}
_ARRAY = re.compile(r"std_msgs/(Float|U?Int)(8|16|32|64)MultiArray")
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d{1,6}\])*)")
_PRESETS = ("imu", "marker", "pwm")
_SHOWN = 8


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, its type as package/Name, the fields of its JSON schema, whether it has any
    messages."""

    name: str
    kind: str
    fields: tuple[str, ...] = ()
    used: bool = True


def used_topics(topics: Sequence[Topic]) -> Sequence[Topic]:
    """Those that have messages; all where none has."""
    return [topic for topic in topics if topic.used] or topics


@dataclass(frozen=True)
class Field:
    """Where a column comes from: path of the field, and what it is multiplied by."""

    column: str
    path: str
    factor: float = 1.0


@dataclass(frozen=True)
class TopicMap:
    """Fields by topic; `stamped` whether the time is the message's own, `source` for messages."""

    source: str
    topics: Mapping[str, tuple[Field, ...]]
    stamped: bool = True

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns that come out, in the order of `calib.io.logs.COLUMNS`."""
        named = {field.column for fields in self.topics.values() for field in fields}
        return tuple(name for name in COLUMNS if name in named)


def find_topics(path: Path) -> Path | None:
    """The file of topics that lies beside a bag, or in it if it is a folder; None without."""
    places = [path.with_name(f"{path.stem}.topics.yaml"), path.with_name("topics.yaml")]
    if path.is_dir():
        places = [path / "topics.yaml", path.with_name(f"{path.name}.topics.yaml"), places[1]]
    return next((place for place in places if place.is_file()), None)


def topic_map(bag: Path, topics: Sequence[Topic], given: Path | None = None) -> TopicMap:
    """What is read of a bag: as `given` says, as the file beside it says, or the defaults.

    Raises `BadInputError` naming the key for what is wrong, the topics of the bag for one it lacks.
    """
    place = find_topics(bag) if given is None else given
    return _defaults(bag, topics) if place is None else _read_topics_file(place, bag, topics)


def _listed(topics: Sequence[Topic]) -> str:
    named = [f"{one_line(topic.name)[:80]} ({one_line(topic.kind)[:60]})" for topic in topics]
    return several(named, _SHOWN) or "none"


def _preset(kind: str, topic: Topic) -> dict[str, str] | None:
    """Columns and paths of what is expected of a topic, None where its type has none."""
    if kind == "imu":
        return dict(IMU) if topic.kind == "sensor_msgs/Imu" else None
    if kind == "marker" and topic.kind in _POINTS:
        return {"u_px": _POINTS[topic.kind] + "x", "v_px": _POINTS[topic.kind] + "y"}
    if kind == "pwm" and _ARRAY.fullmatch(topic.kind):
        return {"pwm1": "data[0]", "pwm2": "data[1]"}
    return None


_EXPECTED = {
    "imu": "sensor_msgs/Imu",
    "marker": "geometry_msgs/PointStamped, Point, Vector3Stamped or Vector3",
    "pwm": "std_msgs/Float32MultiArray or another array of numbers",
}


def _fields(columns: Mapping[str, str]) -> tuple[Field, ...]:
    return tuple(Field(column, path) for column, path in columns.items())


def _defaults(bag: Path, topics: Sequence[Topic]) -> TopicMap:
    source = shown(bag)
    found: dict[str, tuple[Field, ...]] = {}
    topics = used_topics(topics)
    imus = [topic for topic in topics if topic.kind == "sensor_msgs/Imu"]
    hint = f"say which in {shown(bag.stem)}.topics.yaml beside it"
    if len(imus) > 1:
        raise BadInputError(f"{source}: has {len(imus)} topics of sensor_msgs/Imu: {_listed(imus)}; {hint}")
    for topic in topics:
        named = topic.name.rsplit("/", 1)[-1]
        kind = "imu" if topic in imus else named if named in ("marker", "pwm") else ""
        columns = _preset(kind, topic) if kind else None
        if columns is None:
            columns = {name: name for name in topic.fields if name in COLUMNS}
        if columns:
            found[topic.name] = _fields(columns)
    if not found:
        from calib.io.states import HEAD, STATES_TOPIC

        if {STATES_TOPIC, HEAD} <= {topic.name for topic in topics}:
            raise BadInputError(f"{source}: holds states that calib replay has written, expected a log")
        raise BadInputError(
            f"{source}: has no topic that is known by itself, found {_listed(topics)}; {hint}"
        )
    return _check_columns_once(TopicMap(source, found))


def _read_topics_file(place: Path, bag: Path, topics: Sequence[Topic]) -> TopicMap:
    source, document = shown(place), read_yaml_mapping(place)
    for key in document:
        if key not in ("time", "topics"):
            raise BadInputError(f"{source}: {one_line(key)[:60]} is not known, expected time or topics")
    time = document.get("time", "stamp")
    if time not in ("stamp", "received"):
        raise BadInputError(f"{source}: time is {quoted(time)}, expected stamp or received")
    if "topics" not in document:
        return replace(_defaults(bag, topics), stamped=time == "stamp")
    listed = document["topics"]
    if not isinstance(listed, dict) or not listed:
        raise BadInputError(f"{source}: topics is {quoted(listed)}, expected topics with their columns")
    there = {topic.name: topic for topic in topics}
    found = {}
    for name, wanted in listed.items():
        if name not in there:
            raise BadInputError(
                f"{source}: the topic {quoted(name)} is not in {shown(bag)}, which has {_listed(topics)}"
            )
        found[name] = _parse_fields(f"{source}: topics.{one_line(name)[:80]}", wanted, there[name])
    return _check_columns_once(TopicMap(source, found, time == "stamp"))


def _parse_fields(where: str, wanted: Any, topic: Topic) -> tuple[Field, ...]:
    """The fields that one entry of the file asks for."""
    known = wanted in _PRESETS if isinstance(wanted, str) else isinstance(wanted, dict) and wanted
    if not known:
        raise BadInputError(f"{where} is {quoted(wanted)}, expected {', '.join(_PRESETS)} or columns")
    if isinstance(wanted, str):
        columns = _preset(wanted, topic)
        if columns is None:
            raise BadInputError(
                f"{where} is of type {one_line(topic.kind)[:60]}, expected {_EXPECTED[wanted]}"
            )
        return _fields(columns)
    fields = []
    for column, path in wanted.items():
        if column not in COLUMNS:
            raise BadInputError(
                f"{where}: {quoted(column)} is no column, expected one of {', '.join(COLUMNS)}"
            )
        entry: dict[str, Any] = (
            path if isinstance(path, dict) and set(path) <= {"field", "factor"} else {"field": path}
        )
        path, factor = entry.get("field"), entry.get("factor", 1.0)
        if not isinstance(path, str) or not all(_STEP.fullmatch(step) for step in path.split(".")):
            raise BadInputError(
                f"{where}.{column} is {quoted(path)}, expected a field such as point.x or data[0]"
            )
        if isinstance(factor, bool) or not isinstance(factor, int | float) or not math.isfinite(factor):
            raise BadInputError(f"{where}.{column}: the factor is {quoted(factor)}, expected a number")
        fields.append(Field(column, path, float(factor)))
    return tuple(fields)


def _check_columns_once(found: TopicMap) -> TopicMap:
    """The map, if no column comes from two topics."""
    origin: dict[str, str] = {}
    for topic, fields in found.topics.items():
        for field in fields:
            if field.column in origin:
                names = f"{one_line(origin[field.column])[:80]} and {one_line(topic)[:80]}"
                raise BadInputError(f"{found.source}: {field.column} comes from two topics, {names}")
            origin[field.column] = topic
    return found


def field_reader(source: str, topic: str, field: Field) -> Callable[[Any], float]:
    """A function from a message to a column's value; NaN for a null.

    The function raises `BadInputError` where the message has no such field or it is no number.
    """
    steps: list[str | int] = [
        name if name else int(index) for name, index in re.findall(r"([A-Za-z_]\w*)|\[(\d+)\]", field.path)
    ]
    where = f"{source}: {one_line(topic)[:80]}: {field.path} (for {field.column})"
    factor = field.factor

    def found(message: Any) -> Any:
        value = message
        for step in steps:
            if isinstance(step, int) and isinstance(value, Sequence) and not value:
                # Nothing was detected.
                return None
            try:
                value = (
                    value[step] if isinstance(step, int) or isinstance(value, dict) else getattr(value, step)
                )
            except (AttributeError, KeyError, IndexError, TypeError):
                raise BadInputError(
                    f"{where} is not in the message, which has {_named(value, step)}"
                ) from None
        return value

    named = [step for step in steps if isinstance(step, str)]
    quick = operator.attrgetter(field.path) if len(named) == len(steps) else found

    def read(message: Any) -> float:
        try:
            value = found(message) if isinstance(message, dict) else quick(message)
        except AttributeError:
            value = found(message)
        if isinstance(value, float):
            return value * factor
        if value is None:
            return math.nan
        try:
            if isinstance(value, str | bytes | bytearray):
                raise TypeError
            return float(value) * factor
        except (TypeError, ValueError, OverflowError):
            raise BadInputError(f"{where} is {quoted(value)}, expected a number") from None

    return read


def _named(value: Any, step: str | int) -> str:
    """What stands where a field was looked for in vain."""
    if isinstance(step, int):
        try:
            return f"{len(value)} elements there"
        except TypeError:
            return f"{quoted(value)} there"
    names = list(value) if isinstance(value, dict) else list(getattr(value, "__dataclass_fields__", ()))
    names = [one_line(str(name))[:40] for name in names if not str(name).startswith("__")]
    return ", ".join(names[:_SHOWN]) if names else f"{quoted(value)} there"

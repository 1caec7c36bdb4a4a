"""Bags for tests: the same readings as ROS 1, ROS 2 (sqlite and MCAP) and JSON in MCAP."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_123_456_789
DELAY_NS = 3_000_000
"""By how much messages are received after their stamp."""

Message = tuple[str, int, tuple[float, ...]]
"""Kind ("imu", "marker", "pwm"), stamp [ns] and values."""

NAMES = {"imu": "/imu/data", "marker": "/marker", "pwm": "/pwm"}
KINDS = {
    "imu": "sensor_msgs/msg/Imu",
    "marker": "geometry_msgs/msg/PointStamped",
    "pwm": "std_msgs/msg/Float64MultiArray",
}
KINDS_OF_FORMAT = ("ros1", "sqlite", "folder", "mcap", "json")


def readings(rng: np.random.Generator, seconds: float = 1.0) -> list[Message]:
    """IMU at 100 Hz, marker and commands at 60 Hz."""
    out: list[Message] = [
        ("imu", START_NS + 10_000_000 * k, (9.81, *rng.normal(size=5).tolist()))
        for k in range(int(100 * seconds))
    ]
    for k in range(int(60 * seconds)):
        stamp = START_NS + 2_000_000 + 16_666_667 * k
        out.append(("marker", stamp, tuple(rng.uniform(0, 300, 2).tolist())))
        out.append(("pwm", stamp, tuple(rng.uniform(0, 255, 2).tolist())))
    return sorted(out, key=lambda message: message[1])


def _ros(store: Any, kind: str, stamp: int, values: Sequence[float], first: bool) -> Any:
    types = store.types
    extra = {"seq": 0} if first else {}
    time = types["builtin_interfaces/msg/Time"](stamp // 1_000_000_000, stamp % 1_000_000_000)
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="", **extra)
    if kind == "imu":
        vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        nothing = np.zeros(9)
        return types[KINDS[kind]](
            header=header,
            orientation=quaternion(0.0, 0.0, 0.0, 1.0),
            orientation_covariance=nothing,
            angular_velocity=vector(*values[3:]),
            angular_velocity_covariance=nothing,
            linear_acceleration=vector(*values[:3]),
            linear_acceleration_covariance=nothing,
        )
    if kind == "marker":
        return types[KINDS[kind]](header=header, point=types["geometry_msgs/msg/Point"](*values, 0.0))
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return types[KINDS[kind]](layout=layout, data=np.array(values))


def write_bag(
    folder: Path,
    form: str,
    messages: Iterable[Message],
    names: dict[str, str] = NAMES,
    delay_ns: int = DELAY_NS,
) -> Path:
    """A bag of one of `KINDS_OF_FORMAT`; commands, which have no stamp, are received without delay.

    It has a topic without messages as well.
    """
    if form == "json":
        return _write_json(folder / "log.mcap", messages, names, delay_ns)
    first = form == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    path = folder / ("log.bag" if first else "log")
    plugin = StoragePlugin.SQLITE3 if form == "sqlite" else StoragePlugin.MCAP
    with Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        writer.add_connection("/imu/unused", KINDS["imu"], typestore=store)
        for kind, stamp, values in messages:
            if kind not in connections:
                connections[kind] = writer.add_connection(names[kind], KINDS[kind], typestore=store)
            message = _ros(store, kind, stamp, values, first)
            put = store.serialize_ros1 if first else store.serialize_cdr
            received = stamp if kind == "pwm" else stamp + delay_ns
            writer.write(connections[kind], received, put(message, KINDS[kind]))
    if form == "mcap":
        path = next(path.glob("*.mcap")).rename(folder / "log.mcap")
    return path


_JSON = {
    "imu": ("ax_mps2", "ay_mps2", "az_mps2", "gx_radps", "gy_radps", "gz_radps"),
    "marker": ("u_px", "v_px"),
    "pwm": ("pwm1", "pwm2"),
}


def _write_json(path: Path, messages: Iterable[Message], names: dict[str, str], delay_ns: int) -> Path:
    with path.open("wb") as stream:
        # Small chunks, so that a file that ends early has some.
        writer = McapWriter(stream, chunk_size=20_000)
        writer.start()
        channels = {}
        for kind, columns in _JSON.items():
            described = {"type": "object", "properties": {name: {"type": "number"} for name in columns}}
            schema = writer.register_schema(kind, "jsonschema", json.dumps(described).encode())
            channels[kind] = writer.register_channel(names[kind], "json", schema)
        writer.register_channel("/imu/unused", "json", schema)
        for kind, stamp, values in messages:
            time = {"sec": stamp // 1_000_000_000, "nsec": stamp % 1_000_000_000}
            body = {"timestamp": time, **dict(zip(_JSON[kind], values, strict=True))}
            received = stamp + delay_ns
            writer.add_message(channels[kind], received, json.dumps(body).encode(), received)
        writer.finish()
    return path

"""ROS 1 bags, up to the rows of a log."""

from __future__ import annotations

from pathlib import Path

from fuzz.bagbytes import check_bag, damage

MODULES = ("calib.io.bags", "calib.io.bag_topics", "calib.io.unpacking")

mutate = damage

MOST_BYTES = 12_000

WORDS = (
    b"#ROSBAG V2.0\n", b"op=", b"conn=", b"topic=", b"/imu", b"/marker", b"/pwm", b"compression=none",
    b"compression=bz2", b"compression=lz4", b"size=", b"count=", b"ver=", b"type=sensor_msgs/Imu",
    b"float64 x\n", b"Header header\n", b"float64[] data", b"string s", b"time stamp", b"uint8[1000000000] x",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Rows with a time, or a refusal."""
    path = folder / "log.bag"
    path.write_bytes(data)
    check_bag(path)

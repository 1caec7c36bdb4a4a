"""ROS 1 bags, up to the rows of a log."""

from __future__ import annotations

import random
import sys
from pathlib import Path

MODULES = ("calib.io.bags", "calib.io.bags", "calib.io.bags", "calib.io.bags")

MOST_BYTES = 12_000

WORDS = (
    b"#ROSBAG V2.0\n", b"op=", b"conn=", b"topic=", b"/imu", b"/marker", b"/pwm", b"compression=none",
    b"compression=bz2", b"compression=lz4", b"size=", b"count=", b"ver=", b"type=sensor_msgs/Imu",
    b"float64 x\n", b"Header header\n", b"float64[] data", b"string s", b"time stamp", b"uint8[1000000000] x",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Rows with a time, or a refusal."""
    from fuzz.bagbytes import check_bag

    path = folder / "log.bag"
    path.write_bytes(data)
    check_bag(path)


def mutate(data: bytes, dice: random.Random) -> bytes:
    """Numbers and parts of the bytes."""
    from fuzz.bagbytes import damage

    return damage(data, dice)


if __name__ == "__main__":
    from harness import main

    main(sys.modules[__name__])

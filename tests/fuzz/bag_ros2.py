"""ROS 2 bags: a `.db3`, or a folder of metadata.yaml and a database or an MCAP file."""

from __future__ import annotations

import random
import shutil
import sys
import tempfile
from pathlib import Path
from unittest import mock

MODULES = ("calib.io.bags", "calib.io.bags", "calib.io.bags", "calib.io.bags")

MOST_BYTES = 40_000

RULE = b"\n== bag ==\n"
"""Between metadata.yaml and the bag; a database by itself has none."""

WORDS = (
    b"rosbag2_bagfile_information:", b"version: 9", b"storage_identifier: mcap",
    b"storage_identifier: sqlite3",
    b"relative_file_paths:", b"- log.db3", b"- ../../x", b"compression_format: zstd",
    b"compression_mode: FILE",
    b"compression_mode: MESSAGE", b"message_count: 0", b"nanoseconds: -1", b"serialization_format: cdr",
    b"topics_with_message_count: []", b"name: /imu/data", b"type: sensor_msgs/msg/Imu", RULE,
    b"CREATE TABLE", b"CREATE VIEW", b"messages", b"topics", b"float64 x\n",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Rows with a time, or a refusal."""
    from fuzz.bagbytes import check_bag

    metadata, rule, body = data.partition(RULE)
    if not rule:
        path = folder / "log.db3"
        path.write_bytes(data)
        check_bag(path)
        return
    path = folder / "log"
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    (path / "metadata.yaml").write_bytes(metadata)
    for name in ("log.db3", "log.mcap", "log.db3.zstd"):
        (path / name).write_bytes(body)
    # A bag that is packed as a whole is unpacked where temporary files go.
    with mock.patch.object(tempfile, "tempdir", str(folder)):
        check_bag(path)


def mutate(data: bytes, dice: random.Random) -> bytes:
    """Numbers and parts of the metadata or of the bag."""
    from fuzz.bagbytes import damage, mutate_parts

    return mutate_parts(data, RULE, dice) if RULE in data else damage(data, dice)


if __name__ == "__main__":
    from harness import main

    main(sys.modules[__name__])

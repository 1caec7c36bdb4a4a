"""ROS 2 bags: a `.db3`, or a folder of metadata.yaml and a database or an MCAP file."""

from __future__ import annotations

import shutil
import tempfile
from functools import partial
from pathlib import Path
from unittest import mock

from fuzz.bagbytes import check_bag, damage

MODULES = ("calib.io.bags", "calib.io.bag_topics", "calib.io.unpacking")

MOST_BYTES = 40_000

RULE = b"\n== bag ==\n"
"""Between metadata.yaml and the bag; a database by itself has none."""

mutate = partial(damage, rule=RULE)

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

"""MCAP files with messages of ROS or in JSON, and the file beside them that says what is where."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from fuzz.bagbytes import check_bag, damage

MODULES = ("calib.io.bags", "calib.io.bag_topics", "calib.io.unpacking")

MOST_BYTES = 12_000

RULE = b"\n== topics ==\n"
"""Between the bag and topics.yaml, where there is one."""

mutate = partial(damage, rule=RULE)

WORDS = (
    b"\x89MCAP0\r\n", b"json", b"jsonschema", b"ros2msg", b"ros2idl", b"ros1msg", b"cdr", b"ros1", b"zstd",
    b"lz4", b"{\"properties\": {\"gz_radps\": {}}}", b"gz_radps", b"\"timestamp\"", b"{\"sec\": 1}", b"NaN",
    b"null", b"1e400", b"[" * 2000, b"float64 x\n", b"float64[] data\n", RULE, b"time: received", b"topics:",
    b"/imu/data: imu", b"u_px: 'data[0]'", b"data[999999]", b"{field: x, factor: 2}", b"a.b.c",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Rows with a time, or a refusal."""
    body, rule, topics = data.partition(RULE)
    path, beside = folder / "log.mcap", folder / "topics.yaml"
    path.write_bytes(body)
    beside.unlink(missing_ok=True)
    if rule:
        beside.write_bytes(topics)
    check_bag(path)

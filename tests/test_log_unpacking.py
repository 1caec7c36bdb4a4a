"""Bags that would unpack to more than there is room for, and files that say more than they hold."""

from __future__ import annotations

import bz2
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from bags import KINDS, NAMES, START_NS, _ros

from calib.core.errors import BadInputError
from calib.io import unpacking as log_unpacking
from calib.io.logs import read_log
from calib.io.unpacking import BoundedFile, BoundedPath, unpacked

MOST = 100_000


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_unpacking, "MOST_BYTES", MOST)


def _packed(packing: str, data: bytes) -> bytes:
    if packing == "bz2":
        return bz2.compress(data)
    return bytes(lz4.frame.compress(data) if packing == "lz4" else log_unpacking._zstd().compress(data))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("packing", ["bz2", "lz4", "zstd"])
def test_up_to_a_bound(packing: str) -> None:
    data = np.random.default_rng(0).bytes(MOST)
    assert unpacked(packing, _packed(packing, data)) == data
    with pytest.raises(ValueError, match="a part of it unpacks to more than 0 MB"):
        unpacked(packing, _packed(packing, b"\0" * (MOST + 1)))


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
    monkeypatch.setattr(log_unpacking, "MOST_BYTES", MOST)
    monkeypatch.setattr(log_unpacking, "_MOST_GROWTH", 3)
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

"""The states file."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.io.states import ENDINGS, STATES, states_writer


def test_an_interrupted_file_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "states.csv"
    path.write_text("old\n")

    def broken() -> None:
        with states_writer(path) as states:
            states.add(np.zeros((1, len(STATES))))
            raise ValueError

    with pytest.raises(ValueError):
        broken()
    assert path.read_text() == "old\n"
    assert [item.name for item in tmp_path.iterdir()] == ["states.csv"]


def _rows(count: int = 40) -> np.ndarray:
    """Rows of `STATES` with blanks, counts and weights of every size."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(count, len(STATES))) * 10.0 ** rng.uniform(-9, 3, (count, len(STATES)))
    values[:, 0] = 1e-6 * np.cumsum(rng.integers(1, 20000, count))
    for k, name in enumerate(STATES):
        if name.startswith("gated"):
            values[:, k] = rng.choice([0.0, 1.0, np.nan], count)
        elif name == "flags":
            values[:, k] = rng.integers(0, 128, count)
        elif name.startswith("nis"):
            values[rng.random(count) < 0.5, k] = np.nan
    return values


def _same(one: np.ndarray, other: np.ndarray, rtol: float = 0.0) -> None:
    assert one.shape == other.shape
    np.testing.assert_allclose(one, other, rtol=rtol, atol=0.0, equal_nan=True)


def _written(path: Path, values: np.ndarray) -> Path:
    with states_writer(path) as states:
        for begin in range(0, len(values), 7):
            states.add(values[begin : begin + 7])
    return path


def test_parquet_holds_the_rows_bit_for_bit(tmp_path: Path) -> None:
    from pyarrow import parquet

    values = _rows()
    table = parquet.read_table(_written(tmp_path / "states.parquet", values))
    assert tuple(table.column_names) == STATES
    assert str(table.schema.field("flags").type) == "int64"
    _same(np.stack([column.cast("float64").to_numpy() for column in table.columns], axis=1), values)


def test_mcap_holds_states_and_poses(tmp_path: Path) -> None:
    """The package's own reader finds an index, schemas and every message."""
    from mcap.reader import make_reader

    values = _rows()
    path = _written(tmp_path / "states.mcap", values)
    read, poses = [], []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 2 * len(values)
        names = {schema.name: json.loads(schema.data) for schema in summary.schemas.values()}
        for _, channel, message in reader.iter_messages():
            body = json.loads(message.data)
            stamp = body["timestamp"]["sec"] * 10**9 + body["timestamp"]["nsec"]
            assert message.log_time == message.publish_time == stamp
            (read if channel.topic == "/states" else poses).append(body)
    assert set(names) == {"calib.States", "foxglove.PoseInFrame"}
    assert list(names["calib.States"]["properties"]) == ["timestamp", *STATES]
    found = np.array([[np.nan if body[name] is None else body[name] for name in STATES] for body in read])
    _same(found, values, rtol=5.1e-9)
    for body, row in zip(poses, values, strict=True):
        assert body["frame_id"] == "world"
        place, turn = body["pose"]["position"], body["pose"]["orientation"]
        x, y, phi = (row[STATES.index(name)] for name in ("x_m", "y_m", "phi_rad"))
        assert (place["x"], place["y"]) == pytest.approx((x, y), rel=1e-8)
        # The turned y axis is the arc's tangent at the head, (sin phi, cos phi).
        w, z = turn["w"], turn["z"]
        assert (-2 * w * z, w * w - z * z) == pytest.approx((math.sin(phi), math.cos(phi)), abs=1e-8)


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_rows_give_the_same_bytes(ending: str, tmp_path: Path) -> None:
    one, other = (_written(tmp_path / f"{name}{ending}", _rows()) for name in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("ending", [".parquet", ".mcap"])
def test_an_interrupted_binary_file_leaves_nothing(ending: str, tmp_path: Path) -> None:
    def broken() -> None:
        with states_writer(tmp_path / f"states{ending}") as states:
            states.add(_rows())
            raise KeyError

    with pytest.raises(KeyError):
        broken()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_one_sentence(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"states{ending}"
    path.symlink_to("/dev/full")
    rows = np.tile(_rows(), (500, 1))
    rows[:, 0] = np.arange(len(rows))
    with pytest.raises(BadInputError) as caught:
        _written(path, rows)
    assert str(caught.value) == f"{path}: cannot be written: No space left on device"

"""The states file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.statesfile import STATES, states_writer

NAMES = ("t_s", "q1_m", "gated_camera")


def test_blocks_are_written_and_nan_is_a_blank(tmp_path: Path) -> None:
    path = tmp_path / "states.csv"
    with states_writer(path, NAMES) as states:
        states.add(np.array([[0.0, 0.065, np.nan]]))
        states.add(np.zeros((0, 3)))
        states.add(np.array([[0.0166667, 0.0650001234567, 1.0]]))
    assert path.read_text() == "t_s,q1_m,gated_camera\n0.000000,0.065,\n0.016667,0.0650001235,1\n"
    assert [item.name for item in tmp_path.iterdir()] == ["states.csv"]


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


def test_a_place_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError), states_writer(tmp_path / "none" / "states.csv"):
        pass

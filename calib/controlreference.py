"""What a recorded log shows, as a reference: lengths by the estimator, smoothed over the whole log.

The estimator is the kinematic one: the commands in the log are those of another controller.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np

from calib.control.inverse_model import Model
from calib.control.references import Reference, from_lengths, resampled
from calib.errors import BadInputError
from calib.files import shown
from calib.referencefile import reference_of
from calib.rig import Rig

__all__ = ["is_recorded", "recorded_reference", "wanted_reference"]

_OWN = ("q1_m", "true_q1_m", "x_m", "phi_rad")
_FEWEST = 3


def is_recorded(path: Path) -> bool:
    """Whether a file is a log of pictures without a reference of its own in it."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as stream:
            header = next(csv.reader(io.StringIO(stream.readline())), [])
    except OSError:
        return False
    names = {name.strip() for name in header}
    return {"t_s", "u_px", "v_px"} <= names and not names & set(_OWN)


def recorded_reference(path: Path, rig: Rig, rig_path: Path, model: Model) -> Reference:
    """The lengths that a log of camera and IMU shows, at the model's ticks.

    Raises `BadInputError` as `calib.replay.prepared`, and where the estimator knows too little.
    """
    from calib.replay import prepared
    from calib.smoothing import first_rows

    setup, found, stream, _ = prepared(path, rig, rig_path)
    rows = first_rows(setup, found, stream, math.inf)
    rows = rows[np.isfinite(rows[:, :3]).all(axis=1)]
    rows = rows[np.concatenate([[True], np.diff(rows[:, 0]) > 0.0])] if len(rows) else rows
    if len(rows) < _FEWEST:
        raise BadInputError(f"{shown(path)}: shows no lengths to follow, expected camera and IMU in motion")
    return from_lengths(model, shown(path), resampled(rows[:, 0], rows[:, 1:3], model.tick_s))


def wanted_reference(
    text: str, model: Model, duration_s: float | None, rig: Rig, rig_path: Path
) -> Reference:
    """A reference by name, from a table, or from a recorded log. Raises `BadInputError`."""
    path = Path(text)
    if duration_s is None and path.is_file() and is_recorded(path):
        return recorded_reference(path, rig, rig_path, model)
    return reference_of(text, model, duration_s)

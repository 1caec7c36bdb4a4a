"""References from files and from recorded logs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.rig import Rig
from calib.core.words import several
from calib.core.writing import Kind, column_names, write_atomically
from calib.io.logs import read_column_names
from calib.io.tables import read_cells
from calib.stages.actuator.kinematics import inverse
from calib.stages.control import references
from calib.stages.control.rig_model import Model

# ----------------------------------------------------------------------
# References from files: a table of lengths, angles or head positions, or a recorded log.
#
# A CSV with `t_s` and one of
#
#     q1_m, q2_m               lengths, as `calib replay` writes them
#     true_q1_m, true_q2_m     those of a simulated log
#     x_m, y_m                 the head in the plane
#     phi_rad                  the angle alone
#
# The first of these that the header has is taken. Other columns are passed over. Every row needs finite
# values and a time not before that of the row before; of rows with the same time the last one counts.

_KINDS = (("q1_m", "q2_m"), ("true_q1_m", "true_q2_m"), ("x_m", "y_m"), ("phi_rad",))
_FEWEST = 3


def _series(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Names of the columns taken, times (n,) and values (n, len(names))."""
    source = shown(path)
    cells = read_cells(path)
    header = cells.header
    if "t_s" not in header:
        raise BadInputError(
            f"{source}: has no column t_s, found {several(header, 8)}; expected a reference with times in "
            "seconds"
        )
    names = next((kind for kind in _KINDS if all(name in header for name in kind)), None)
    if names is None:
        raise BadInputError(
            f"{source}: has no reference in it, found {several(header, 8)}; expected in metres q1_m and q2_m "
            "or x_m and y_m, or in radians phi_rad; of a recorded log calib replay writes them"
        )
    at = [header.index(name) for name in ("t_s", *names)]
    table = cells.numbers(*at)
    for row, k in np.argwhere(~np.isfinite(table)).tolist():
        raise BadInputError(
            f"{source}, line {cells.lines[row]}: {header[at[k]]} is blank or nan, expected a number"
        )
    for row, k in np.argwhere(np.abs(table) > [math.inf, *(_most(name) for name in names)]).tolist():
        unit = "degrees" if names[k - 1].endswith("_rad") else "millimetres"
        raise BadInputError(
            f"{source}, line {cells.lines[row]}: {names[k - 1]} is {table[row, k]:g}, expected at most "
            f"{_most(names[k - 1]):.3g}; is it in {unit}?"
        )
    t = table[:, 0]
    for row in (np.nonzero(np.diff(t) < 0.0)[0] + 1).tolist():
        raise BadInputError(
            f"{source}, line {cells.lines[row]}: t_s is {t[row]:g} after {t[row - 1]:g}, expected rising "
            "times"
        )
    # Loggers stamp samples that waited in a buffer alike; the last one is the newest.
    newest = np.append(np.diff(t) > 0.0, True)
    return names, t[newest], table[newest, 1:]


def _most(name: str) -> float:
    """What an angle [rad] or a length [m] of a reference may be."""
    return math.pi if name.endswith("_rad") else 1.0


def read_reference(path: Path, model: Model) -> references.Reference:
    """The reference in a file, at the model's ticks.

    Raises `BadInputError` with file and line for what is none, values that are not finite and times that
    run backwards, and for one that is too short or too long.
    """
    source = shown(path)
    names, t, values = _series(path)
    h = model.tick_s
    span = float(t[-1] - t[0]) if len(t) else 0.0
    if len(t) < _FEWEST or span < _FEWEST * h:
        raise BadInputError(
            f"{source}: has {len(t)} rows over {span:.3g} s, expected at least {_FEWEST} rows and "
            f"{_FEWEST * h:.3g} s"
        )
    if span > references.LONGEST_S:
        raise BadInputError(
            f"{source}: lasts {span:g} s, expected at most {references.LONGEST_S:g} s; is t_s in ms?"
        )
    ticks = references.resampled(t, values, h)
    if names == ("phi_rad",):
        try:
            return references.from_angles(model, source, ticks[:, 0])
        except BadInputError as error:
            raise BadInputError(f"{source}: {error}") from error
    if names == ("x_m", "y_m"):
        turned = 2.0 * np.arctan2(ticks[:, 0], ticks[:, 1])
        return references.from_lengths(
            model, source, inverse(np.column_stack([ticks, turned]), model.plant.bellows_radius_m)
        )
    return references.from_lengths(model, source, ticks)


_HEAD = ("t_s", "q1_m", "q2_m", "phi_rad")
REFERENCE = Kind("a reference", (".csv",), lambda path: column_names(path) == _HEAD)


def write_reference(path: Path, reference: references.Reference) -> None:
    """Write time, lengths and angle. Raises `BadInputError` where the place cannot be written."""
    rows = [",".join(_HEAD)]
    for t, q1, q2, phi in np.column_stack([reference.t_s, reference.q_m, reference.phi_rad]).tolist():
        rows.append(f"{t:.6f},{q1:.9f},{q2:.9f},{phi:.9f}")
    write_atomically(path, "\n".join(rows) + "\n", REFERENCE)


# ----------------------------------------------------------------------
# What a recorded log shows, as a reference: lengths by the estimator, smoothed over the whole log.
#
# The estimator is the kinematic one: the commands in the log are those of another controller.

_OWN = ("q1_m", "true_q1_m", "x_m", "phi_rad")


def is_recorded(path: Path) -> bool:
    """Whether a file is a log of pictures without a reference of its own in it."""
    return {"u_px", "v_px"} <= set(read_column_names(path) or ()) and not set(column_names(path)) & set(_OWN)


def recorded_reference(path: Path, rig: Rig, rig_path: Path, model: Model) -> references.Reference:
    """The lengths that a log of camera and IMU shows, at the model's ticks.

    Raises `BadInputError` as `calib.stages.estimator.replay.opened`, and where the estimator knows too
    little.
    """
    from calib.stages.estimator.replay import opened, smoothed_rows

    rows = smoothed_rows(opened(path, rig, rig_path), math.inf)
    rows = rows[np.isfinite(rows[:, :3]).all(axis=1)]
    rows = rows[np.concatenate([[True], np.diff(rows[:, 0]) > 0.0])] if len(rows) else rows
    for k in np.flatnonzero(np.diff(rows[:, 0]) <= 0.0).tolist():
        before_s, then_s = rows[k : k + 2, 0].tolist()
        raise BadInputError(
            f"{shown(path)}: time goes back from {before_s:.3f} to {then_s:.3f} s, expected rising times"
        )
    if len(rows) < _FEWEST:
        raise BadInputError(f"{shown(path)}: shows no lengths to follow, expected camera and IMU in motion")
    return references.from_lengths(
        model, shown(path), references.resampled(rows[:, 0], rows[:, 1:3], model.tick_s)
    )


def wanted_reference(
    text: str, model: Model, duration_s: float | None, rig: Rig, rig_path: Path
) -> references.Reference:
    """A reference by name, from a table, or from a recorded log.

    Raises `BadInputError`, also where a file is given a duration.
    """
    if text in references.BUILT_IN:
        return references.built_in(model, text, duration_s)
    path = Path(text)
    if not path.exists():
        raise BadInputError(
            f"{shown(text)}: is no such file and none of the references {', '.join(references.BUILT_IN)}"
        )
    if duration_s is not None:
        raise BadInputError(
            f"{shown(text)}: a file has its own duration, --duration is for {', '.join(references.BUILT_IN)}"
        )
    if path.is_file() and is_recorded(path):
        return recorded_reference(path, rig, rig_path, model)
    return read_reference(path, model)

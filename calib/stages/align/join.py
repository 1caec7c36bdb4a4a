"""One log of two recordings of a motion: the pictures' times on the IMU's clock, whatever both clocks are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.io.logs import Log
from calib.solve.delay import Clocks, clocks
from calib.stages.actuator.kinematics import angle_from_marker
from calib.stages.align.solve import TURNING

_MARKER = ("u_px", "v_px")
_LONGEST_S = 6.0 * 3600.0
DRIFT_S = 0.004
"""Between the halves of a recording, beyond which it is told."""

_MIRRORED = 0.25
"""What the next best offset leaves of a motion that is mirrored, at least; the end of a swing, half a period
off, is mirrored as well, and its next best leaves 0.13."""


def _ways(camera: Log, rig: Rig, rig_name: str) -> Iterator[tuple[FloatArray, FloatArray, bool]]:
    """Times, what the marker shows of a turn, and whether that is an angle.

    By camera and plane, where the rig has them, the angle of a head that bends; then, for what turns
    otherwise, the way along the marker's main direction.
    """
    pictures = camera.signals("u_px", "v_px")
    plane = rig.current_plane(rig_name)
    if plane is not None and rig.camera is not None:
        phi = angle_from_marker(plane.to_world(pictures.values, rig.camera), rig.marker_offset_m)
        fine = np.isfinite(phi)
        yield pictures.t_s[fine], phi[fine], True
    moved = pictures.values - pictures.values.mean(axis=0)
    yield pictures.t_s, moved @ np.linalg.svd(moved, full_matrices=False)[2][0], False


def joined(
    camera: Log, board: Log, rig: Rig, rig_name: str, offset_s: float | None = None
) -> tuple[Log, Clocks | None, int]:
    """The board's log with the camera's marker in it, how the clocks stand, and rows that are left out.

    Parameters
    ----------
    rig : whose camera and plane, where it has them, make an angle of the marker.
    offset_s : to be added to the pictures' times, where it is known; then any two logs can be joined, the
        first with all columns that the board's has not.

    Raises `BadInputError` for logs without pictures or gyroscope, and for motion that tells no offset.
    """
    for log in (camera, board):
        if float(np.ptp(log.t_s)) > _LONGEST_S:
            raise BadInputError(
                f"{log.source}: lasts {np.ptp(log.t_s):.0f} s, expected {_LONGEST_S:.0f} s at most"
            )
    found, own = None, [name for name in camera.columns if name in _MARKER or name not in board.columns]
    if not own:
        raise BadInputError(f"{camera.source}: has no column that {board.source} has not")
    if offset_s is None:
        for log, names, what in ((camera, _MARKER, "pictures"), (board, ("gz_radps",), "gyroscope")):
            if not len(log.sampled(*names)):
                raise BadInputError(f"{log.source}: has no {what}, expected {' and '.join(names)}")
        own = list(_MARKER)
        gyro = board.signals("gz_radps")
        for camera_s, way, scaled in _ways(camera, rig, rig_name):
            found = clocks(camera_s, way, gyro.t_s, gyro["gz_radps"], scaled)
            if found is not None:
                break
            other = clocks(camera_s, -way, gyro.t_s, gyro["gz_radps"], scaled) if scaled else None
            if other is not None and other.next_left > _MIRRORED:
                raise BadInputError(
                    f"{camera.source}: turns the other way round than gz_radps of {board.source}, {TURNING}"
                )
        if found is None:
            raise BadInputError(
                f"{camera.source}: its motion and that of {board.source} do not tell one offset of their "
                "clocks, expected quick turns of different sizes at uneven times, or with camera and plane "
                "in rig.yaml a swing, that both recorded from the beginning; where the offset is known say "
                "--offset, where both have one clock --same-clock"
            )
        offset_s = found.offset_s
    rows = np.flatnonzero(np.logical_or.reduce([np.isfinite(camera.columns[name]) for name in own]))
    moved = camera.t_s[rows] + offset_s
    inside = (moved >= board.t_s[0]) & (moved <= board.t_s[-1])
    if not inside.any():
        raise BadInputError(f"{camera.source}: none of its rows is within the time of {board.source}")
    rows, moved = rows[inside], moved[inside]
    carried = [name for name in board.columns if name not in own]
    t = np.concatenate([moved, board.t_s])
    order = np.argsort(t, kind="stable")
    blank = {"camera": np.full(len(moved), np.nan), "board": np.full(len(board), np.nan)}
    columns = {name: np.concatenate([camera.columns[name][rows], blank["board"]])[order] for name in own}
    columns |= {name: np.concatenate([blank["camera"], board.columns[name]])[order] for name in carried}
    log = Log(board.source, t[order], columns, np.arange(len(t)))
    return log, found, int((~inside).sum())

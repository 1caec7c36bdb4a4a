"""The simulated rig: actuator, pumps, camera and sensors with all that is true of them.

By default it is the nominal plant in front of the camera that took the shipped pictures. A rig.yaml
changes it: `camera` and `plane` as calibrated, `known`, `actuator` and `pump` as in
`calib.stages.actuator.section`, and errors of the sensors as in `calib.twin.section`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.machine import Machine
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.section import Imu, Tracker, Twin
from calib.twin.sensors import View

if TYPE_CHECKING:
    from calib.core.rig import Rig


def nominal_view() -> View:
    """Camera and plane of the shipped pictures."""
    return View(CAMERA, PLANE.R_CW, PLANE.t_m)


@dataclass(frozen=True)
class SimulatedRig(Machine):
    """All that is true of a rig: of its actuator and pumps, and of its sensors `view`, `tracker`, `imu`."""

    view: View = field(default_factory=nominal_view)
    tracker: Tracker = field(default_factory=Tracker)
    imu: Imu = field(default_factory=Imu)


def workspace_homography(view: View) -> FloatArray:
    """H (3, 3), metres to pixels, of a rig that was calibrated without a lens model (2.9).

    It is fitted to where the lens shows a grid over the workspace, so that it spreads the error of
    neglecting distortion as a calibration does.

    Raises `BadInputError` where the camera does not see the workspace.
    """
    from calib.stages.estimator.baseline import undistorting_nothing
    from calib.stages.estimator.sensors import view_coefficients

    numbers = view_coefficients(view.camera, view.R_CW, view.t_CW_m)
    to_plane = undistorting_nothing(numbers, (-0.06, 0.05, 0.06, 0.11), view.camera.image_size_px)
    return np.asarray(np.linalg.inv(to_plane))


def rig_from_file(rig: Rig) -> SimulatedRig:
    """The nominal rig with what a rig.yaml says of it."""
    made, machine = SimulatedRig(), rig.machine
    view = made.view
    if rig.camera is not None:
        view = replace(view, camera=rig.camera.optics)
    if rig.plane is not None:
        view = replace(view, R_CW=np.array(rig.plane.R_CW), t_CW_m=np.array(rig.plane.t_CW_m))
    twin = rig.twin or Twin()
    tracker = twin.tracker
    if rig.geometry is not None and tracker.marker_offset_m == Tracker.marker_offset_m:
        tracker = replace(tracker, marker_offset_m=rig.geometry.marker_offset_m)
    return SimulatedRig(
        machine.plant,
        machine.free_damping_scale,
        machine.pump,
        machine.strength,
        view,
        tracker,
        twin.imu,
    )

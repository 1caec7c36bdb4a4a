"""The simulated rig: actuator, pumps, camera and sensors with all that is true of them.

By default it is the nominal plant in front of the camera that took the shipped pictures. A rig.yaml
changes it: `camera` and `plane` as calibrated, `known`, `actuator` and `pump` as in
`calib.stages.actuator.section`, and errors of the sensors as in `calib.twin.section`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

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


def rig_from_file(rig: Rig) -> SimulatedRig:
    """The nominal rig with what a rig.yaml says of it."""
    view = nominal_view()
    if rig.camera is not None:
        view = replace(view, camera=rig.camera.optics)
    if rig.plane is not None:
        view = replace(view, R_CW=np.array(rig.plane.R_CW), t_CW_m=np.array(rig.plane.t_CW_m))
    twin = rig.twin or Twin()
    tracker = twin.tracker
    if rig.geometry is not None and tracker.marker_offset_m == Tracker.marker_offset_m:
        tracker = replace(tracker, marker_offset_m=rig.geometry.marker_offset_m)
    return SimulatedRig(**vars(rig.machine), view=view, tracker=tracker, imu=twin.imu)

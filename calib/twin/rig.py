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
from calib.core.errors import BadInputError
from calib.stages.actuator.parameters import DAMPING_SCALE_FREE, Plant, pumps_connected
from calib.stages.actuator.pump import Pump
from calib.stages.camera.model import project
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.section import Imu, Tracker, Twin
from calib.twin.sensors import View

if TYPE_CHECKING:
    from calib.core.rig import Rig


def nominal_view() -> View:
    """Camera and plane of the shipped pictures."""
    return View(CAMERA, PLANE.R_CW, PLANE.t_m)


@dataclass(frozen=True)
class SimulatedRig:
    """All that is true of a rig.

    Attributes
    ----------
    plant : with the pumps connected.
    free_damping_scale : c_dmp with the hoses off, for a free swing.
    pump, pump_strength : both pumps, and factors on their static forces.
    view, tracker, imu : the sensors.
    """

    plant: Plant = field(default_factory=pumps_connected)
    free_damping_scale: float = DAMPING_SCALE_FREE
    pump: Pump = field(default_factory=Pump)
    pump_strength: tuple[float, float] = (1.0, 1.0)
    view: View = field(default_factory=nominal_view)
    tracker: Tracker = field(default_factory=Tracker)
    imu: Imu = field(default_factory=Imu)

    @property
    def free_plant(self) -> Plant:
        """The plant with the hoses off."""
        return replace(self.plant, damping_scale=self.free_damping_scale)


def workspace_homography(view: View) -> FloatArray:
    """H (3, 3), metres to pixels, of a rig that was calibrated without a lens model (2.9).

    It is fitted to where the lens shows a grid over the workspace, so that it spreads the error of
    neglecting distortion as a calibration does.

    Raises `BadInputError` where the camera does not see the workspace.
    """
    from calib.core.geometry import fit_homography

    x, y = np.meshgrid(np.linspace(-0.06, 0.06, 9), np.linspace(0.05, 0.11, 7))
    world = np.stack([x.ravel(), y.ravel()], axis=1)
    points = world @ view.R_CW[:, :2].T + view.t_CW_m
    width, height = view.camera.image_size_px
    pixels = project(view.camera, np.where(points[:, 2:] > 0.0, points, 1.0))
    inside = (pixels >= -0.5) & (pixels <= np.array([width - 0.5, height - 0.5]))
    seen = inside.all(axis=1) & (points[:, 2] > 0.0)
    if seen.sum() < 12:
        raise BadInputError("plane: the camera does not see the actuator's workspace")
    return fit_homography(world[seen], pixels[seen], np.arange(int(seen.sum()))).H


def rig_from_file(rig: Rig) -> SimulatedRig:
    """The nominal rig with what a rig.yaml says of it."""
    made, machine = SimulatedRig(), rig.machine
    view = made.view
    if rig.camera is not None:
        view = replace(view, camera=rig.camera.optics)
    if rig.plane is not None:
        view = replace(view, R_CW=np.array(rig.plane.R_CW), t_CW_m=np.array(rig.plane.t_CW_m))
    twin = rig.twin or Twin()
    return SimulatedRig(
        machine.plant,
        machine.free_damping_scale,
        machine.pump,
        machine.strength,
        view,
        twin.tracker,
        twin.imu,
    )

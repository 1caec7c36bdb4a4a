"""The simulated rig: actuator, pumps, camera and sensors with all that is true of them.

By default it is the nominal plant in front of the camera that took the shipped pictures. A rig.yaml
changes it: `camera` and `plane` as calibrated, and

    actuator: {mass_kg, inertia_kgm2, bellows_radius_m, rest_length_m, k0_N_per_m, k1_N_per_m2,
               k2_N_per_m3, k3_N_per_m4, stiffness_scale, damping_ratio, damping_scale_free_swing,
               damping_scale_pumps_connected, bending_N_per_rad2, lambda1_per_s, lambda2_N_per_m,
               lambda3, gravity_mps2, force_projection}
    pump:     {lag_s, delay_ticks, tick_s, supply_V, dead_zone_V, elongation_mm, deflation,
               falling_N_per_s, laminar_s, turbulent_s2_per_N, strength}
    twin:     {tracker: {...}, imu: {...}}       as in `Tracker` and `Imu`

`deflation` is rate_limit or orifice. `strength` holds factors on the static forces of both pumps, which
are never quite alike. `elongation_mm` was measured on the rig, so where it is given its forces follow
from the rig's own springs, otherwise from the nominal ones.

A number that no actuator of this kind has is refused with the unit that was expected: mostly it was
typed in another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.stages.actuator.parameters import (
    DAMPING_SCALE_FREE,
    DAMPING_SCALE_PUMPS,
    Creep,
    Plant,
    Stiffness,
    pumps_connected,
)
from calib.stages.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.stages.camera.model import Camera, project
from calib.twin.pictures import CAMERA, PLANE
from calib.twin.sensors import Imu, Tracker, View

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

    def __post_init__(self) -> None:
        if not all(0.0 <= value <= 10.0 for value in self.pump_strength):
            raise BadInputError(f"pump strength: found {self.pump_strength}, expected factors near 1")

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


# What each key may be: least, greatest, and the unit in words.
_ACTUATOR: dict[str, tuple[float, float, str]] = {
    "mass_kg": (1e-4, 10.0, "kilograms"),
    "inertia_kgm2": (0.0, 0.1, "kg m^2"),
    "bellows_radius_m": (1e-3, 0.2, "metres"),
    "rest_length_m": (5e-3, 1.0, "metres"),
    "k0_N_per_m": (0.1, 1e5, "N/m"),
    "k1_N_per_m2": (-1e7, 1e7, "N/m^2"),
    "k2_N_per_m3": (-1e10, 1e10, "N/m^3"),
    "k3_N_per_m4": (-1e13, 1e13, "N/m^4"),
    "stiffness_scale": (0.01, 100.0, "a factor"),
    "damping_ratio": (0.0, 10.0, "a ratio"),
    "damping_scale_free_swing": (0.0, 1e3, "a factor"),
    "damping_scale_pumps_connected": (0.0, 1e3, "a factor"),
    "bending_N_per_rad2": (0.0, 20.0, "N/rad^2"),
    "lambda1_per_s": (-1e4, 1e4, "1/s"),
    "lambda2_N_per_m": (-1e5, 1e5, "N/m"),
    "lambda3": (-1e3, 1e3, "a factor"),
}
_PUMP: dict[str, tuple[float, float, str]] = {
    "lag_s": (1e-3, 60.0, "seconds"),
    "delay_ticks": (0.0, 1000.0, "ticks"),
    "tick_s": (1e-3, 0.1, "seconds"),
    "supply_V": (1.0, 100.0, "volt"),
    "dead_zone_V": (0.0, 100.0, "volt"),
    "falling_N_per_s": (1e-3, 1e3, "N/s"),
    "laminar_s": (1e-3, 60.0, "seconds"),
    "turbulent_s2_per_N": (0.0, 1e3, "s^2/N"),
}
_THOUSANDTHS = {
    "metres": "millimetres",
    "kilograms": "grams",
    "N/rad^2": "mN/rad^2",
    "seconds": "milliseconds",
}
_REMARKS = ("sigma", "covariance", "verdict", "reasons", "remarks", "advice", "identified")

Section = TypeVar("Section")


@dataclass(frozen=True)
class _Keys:
    """A section of a file, taken apart key by key with sentences for what is wrong."""

    source: str
    name: str
    values: Mapping[str, Any]

    def refuse_unknown(self, known: tuple[str, ...]) -> None:
        for key in self.values:
            if key not in known and key not in _REMARKS:
                stem = key.rsplit("_", 1)[0]
                near = next((k for k in known if k.startswith(f"{stem}_")), None)
                hint = f"; expected {near}" if near else ""
                raise BadInputError(f"{self.source}: {self.name}.{key} is not a key that is known here{hint}")

    def number(self, key: str, bounds: tuple[float, float, str]) -> float | None:
        if key not in self.values:
            return None
        value, (least, most, unit) = self.values[key], bounds
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BadInputError(f"{self.source}: {self.name}.{key} is {value!r}, expected a number ({unit})")
        if not least <= value <= most:
            other = _THOUSANDTHS.get(unit)
            hint = f"; is it in {other}?" if other and value > most and least <= value / 1e3 <= most else ""
            raise BadInputError(
                f"{self.source}: {self.name}.{key} is {value:g}, expected {unit} "
                f"between {least:g} and {most:g}{hint}"
            )
        return float(value)

    def numbers(self, key: str, count: int) -> tuple[float, ...] | None:
        if key not in self.values:
            return None
        value = self.values[key]
        if not isinstance(value, list) or len(value) != count or not all(_is_number(v) for v in value):
            raise BadInputError(f"{self.source}: {self.name}.{key} is {value!r}, expected {count} numbers")
        return tuple(float(v) for v in value)

    def made(self, make: Callable[[], Section]) -> Section:
        """What `make` returns; its complaints get the section's name in front."""
        try:
            return make()
        except BadInputError as error:
            raise BadInputError(f"{self.source}: {self.name}: {error}") from error


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _plant(keys: _Keys, nominal: SimulatedRig) -> SimulatedRig:
    keys.refuse_unknown((*_ACTUATOR, "gravity_mps2", "force_projection"))
    given = {key: keys.number(key, bounds) for key, bounds in _ACTUATOR.items()}
    plant, creep = nominal.plant, Creep()

    def pick(key: str, default: float) -> float:
        value = given[key]
        return default if value is None else value

    names = ("k0_N_per_m", "k1_N_per_m2", "k2_N_per_m3", "k3_N_per_m4")
    law = tuple(pick(key, default) for key, default in zip(names, plant.stiffness.padded, strict=True))
    gravity = keys.numbers("gravity_mps2", 2) or plant.gravity_mps2
    made = keys.made(
        lambda: Plant(
            mass_kg=pick("mass_kg", plant.mass_kg),
            inertia_kgm2=pick("inertia_kgm2", plant.inertia_kgm2),
            bellows_radius_m=pick("bellows_radius_m", plant.bellows_radius_m),
            rest_length_m=pick("rest_length_m", plant.rest_length_m),
            stiffness=Stiffness(law),
            stiffness_scale=pick("stiffness_scale", plant.stiffness_scale),
            damping_ratio=pick("damping_ratio", plant.damping_ratio),
            damping_scale=pick("damping_scale_pumps_connected", DAMPING_SCALE_PUMPS),
            bending_N_per_rad2=pick("bending_N_per_rad2", plant.bending_N_per_rad2),
            creep=Creep(
                pick("lambda1_per_s", creep.lambda1_per_s),
                pick("lambda2_N_per_m", creep.lambda2_N_per_m),
                pick("lambda3", creep.lambda3),
            ),
            gravity_mps2=(gravity[0], gravity[1]),
            force_projection=str(keys.values.get("force_projection", plant.force_projection)),
        )
    )
    return replace(
        nominal, plant=made, free_damping_scale=pick("damping_scale_free_swing", nominal.free_damping_scale)
    )


def _pumps(keys: _Keys, rig: SimulatedRig) -> SimulatedRig:
    keys.refuse_unknown((*_PUMP, "elongation_mm", "deflation", "strength"))
    given = {key: keys.number(key, bounds) for key, bounds in _PUMP.items()}
    law = keys.values.get("deflation", "rate_limit")
    if law not in ("rate_limit", "orifice"):
        raise BadInputError(
            f"{keys.source}: {keys.name}.deflation is {law!r}, expected 'rate_limit' or 'orifice'"
        )
    ticks = given["delay_ticks"]
    if ticks is not None and ticks != math.floor(ticks):
        raise BadInputError(f"{keys.source}: {keys.name}.delay_ticks is {ticks:g}, expected a whole number")

    def some(**wanted: str) -> dict[str, Any]:
        return {name: given[key] for name, key in wanted.items() if given[key] is not None}

    elongation = keys.numbers("elongation_mm", 4)
    static = some(supply_V="supply_V", dead_zone_V="dead_zone_V")
    if elongation is not None:
        static |= {"elongation_mm": elongation, "stiffness": rig.plant.stiffness}
    pump = some(lag_s="lag_s", tick_s="tick_s")
    if ticks is not None:
        pump["delay_ticks"] = int(ticks)
    strength = keys.numbers("strength", 2) or rig.pump_strength

    def make() -> SimulatedRig:
        deflation = (
            Orifice(**some(laminar_s="laminar_s", turbulent_s2_per_N="turbulent_s2_per_N"))
            if law == "orifice"
            else RateLimit(**some(falling_N_per_s="falling_N_per_s"))
        )
        pumps = Pump(static=ElongationForce(**static), deflation=deflation, **pump)
        return replace(rig, pump=pumps, pump_strength=(strength[0], strength[1]))

    return keys.made(make)


def _frozen(value: object) -> object:
    """Lists as tuples, all the way down, and whole numbers as the floats that they stand for."""
    if isinstance(value, list):
        return tuple(_frozen(item) for item in value)
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _changed(keys: _Keys, nominal: Section) -> Section:
    """A sensor with the values of a section; each must be of the default's kind."""
    defaults: dict[str, Any] = {f.name: getattr(nominal, f.name) for f in fields(nominal)}  # type: ignore[arg-type]  # a dataclass
    keys.refuse_unknown(tuple(defaults))
    values: dict[str, Any] = {}
    for key, value in keys.values.items():
        frozen = _frozen(value)
        if key in defaults:
            if type(frozen) is not type(defaults[key]) or not _all_finite(frozen):
                kind = {bool: "true or false", float: "a number", tuple: "a list of numbers"}[
                    type(defaults[key])
                ]
                raise BadInputError(f"{keys.source}: {keys.name}.{key} is {value!r}, expected {kind}")
            values[key] = frozen
    return keys.made(lambda: type(nominal)(**{**defaults, **values}))


def _all_finite(value: object) -> bool:
    if isinstance(value, tuple):
        return all(_all_finite(item) for item in value)
    return isinstance(value, bool) or (isinstance(value, float) and math.isfinite(value))


def _mapping(source: str, name: str, value: object) -> _Keys:
    if not isinstance(value, dict):
        raise BadInputError(f"{source}: {name} is {value!r}, expected keys with values")
    return _Keys(source, name, value)


def rig_from_file(rig: Rig, path: str, camera: Camera | None = None) -> SimulatedRig:
    """The nominal rig with what a rig.yaml says of it.

    Parameters
    ----------
    path : of the file, for messages.
    camera : that of its `camera` section, the nominal one without.

    Raises `BadInputError` for keys that are not known, values in another unit or out of all
    proportion, and parameters that describe an unstable plant.
    """
    source, extra = shown(path), rig.model_extra or {}
    made = SimulatedRig()
    view = made.view
    if camera is not None:
        view = replace(view, camera=camera)
    if rig.plane is not None:
        view = replace(view, R_CW=np.array(rig.plane.R_CW), t_CW_m=np.array(rig.plane.t_CW_m))
    made = replace(made, view=view)
    if "actuator" in extra:
        made = _plant(_mapping(source, "actuator", extra["actuator"]), made)
    if "pump" in extra:
        made = _pumps(_mapping(source, "pump", extra["pump"]), made)
    if "twin" in extra:
        twin = _mapping(source, "twin", extra["twin"])
        twin.refuse_unknown(("tracker", "imu"))
        if "tracker" in twin.values:
            tracker = _changed(_mapping(source, "twin.tracker", twin.values["tracker"]), made.tracker)
            made = replace(made, tracker=tracker)
        if "imu" in twin.values:
            made = replace(made, imu=_changed(_mapping(source, "twin.imu", twin.values["imu"]), made.imu))
    return made

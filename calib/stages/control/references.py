"""References to follow, and the set-points behind them (4.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator.kinematics import angle, forward, inverse, marker_from_head
from calib.stages.control.rig_model import Model, bent_rest

# ----------------------------------------------------------------------
# Set-points: constant angle and jump (4.1), polynomial elongation (4.7), ellipse (4.9).
#
# Every set-point is a frozen dataclass with one method that takes times [s], a number or an array, and
# returns the reference at these times.
#
# Departures from print:
#
# - (4.7) peaks at t = 5 s with 90 mm and falls to -25 mm at t = 10 s. It is held from 5 s on, as the
#   figures show it.
# - (4.9) is drawn with y upward and y_offset < 0; the model's y points down to the head, so
#   y = -(printed y).
# - (4.9c) prints phi_ref = -tan(x / y). It has to be the arc tangent, and under constant curvature the
#   chord from the base to the head points at phi / 2, not at phi. `chord="exact"` sets
#   phi_ref = 2 atan(x / y), and then the forward kinematics of q_ref give the drawn ellipse back.
#   `chord="thesis"` keeps phi_ref = atan(x / y): the head then travels 7.5 mm to each side where 15 mm
#   are drawn.


@dataclass(frozen=True)
class PolynomialElongation:
    """Both bellows on q_ref = c0 + c2 t^2 + c3 t^3, held from `hold_s` on (4.7).

    Attributes
    ----------
    c0_m, c2_m_per_s2, c3_m_per_s3 : coefficients.
    hold_s : time of the last value, by default that of the peak [s].
    """

    c0_m: float = 0.0670
    c2_m_per_s2: float = 0.00276
    c3_m_per_s3: float = -0.000368
    hold_s: float = 5.0

    def bellows_m(self, t_s: FloatArray) -> FloatArray:
        """q_ref (..., 2) [m] at the times (...) [s]."""
        t = np.clip(np.asarray(t_s, dtype=np.float64), 0.0, self.hold_s)
        q = self.c0_m + t * t * (self.c2_m_per_s2 + t * self.c3_m_per_s3)
        return np.stack([q, q], axis=-1)


@dataclass(frozen=True)
class Ellipse:
    """The head on an ellipse, starting at its end nearest to the base (4.9).

    Attributes
    ----------
    x_m, y_m : half axes alpha and beta [m].
    centre_y_m : distance of the centre from the base, -y_offset [m].
    period_s : time of one turn [s].
    chord : "exact" or "thesis", see above.
    """

    x_m: float = 0.015
    y_m: float = 0.010
    centre_y_m: float = 0.078
    period_s: float = 20.0
    chord: str = "exact"

    def pose(self, t_s: FloatArray) -> FloatArray:
        """x_ref, y_ref, phi_ref (..., 3) [m, m, rad] at the times (...) [s], y towards the head."""
        turn = 2.0 * np.pi * np.asarray(t_s, dtype=np.float64) / self.period_s
        x = -self.x_m * np.sin(turn)
        y = self.centre_y_m - self.y_m * np.cos(turn)
        chord_angle = np.arctan2(x, y)
        return np.stack([x, y, 2.0 * chord_angle if self.chord == "exact" else chord_angle], axis=-1)

    def bellows_m(self, t_s: FloatArray, bellows_radius_m: float) -> FloatArray:
        """q_ref (..., 2) [m] at the times (...) [s] by (3.12)."""
        return inverse(self.pose(t_s), bellows_radius_m)


# ----------------------------------------------------------------------
# References at the controller's ticks: the set-points of chapter 4, and series of lengths or angles.
#
# A reference always has both lengths and angle. One that was given as an angle alone gets the lengths at
# which one pump bends the actuator to it and the other idles (`rig_model.bent_rest`).

BUILT_IN = ("elongation", "step", "jump", "ellipse")
"""(4.7) held after 5 s, 0.7 rad from rest, 0.7 then 0.3 rad at 5 s, (4.9)."""

LONGEST_S = 7200.0
_SHORTEST = 3
_DURATION_S = {"elongation": 10.0, "step": 5.0, "jump": 10.0, "ellipse": 20.0}
_STEP_RAD, _JUMP_RAD, _JUMP_AT_S = 0.7, 0.3, 5.0


@dataclass(frozen=True)
class Reference:
    """A reference at the ticks.

    Attributes
    ----------
    name : for people.
    kind : "angle" or "lengths", what it was given as.
    tick_s : period.
    q_m, phi_rad : (n, 2) lengths [m] and (n,) angle [rad].
    judged_from_s : errors count from here on; the way from rest to its start is not the controller's fault.
    jump_s : time at which it jumps after its start, None without.
    from_rest : whether its start is a step from rest; otherwise it begins where the actuator is brought to.
    """

    name: str
    kind: str
    tick_s: float
    q_m: FloatArray
    phi_rad: FloatArray
    judged_from_s: float = 0.0
    jump_s: float | None = None
    from_rest: bool = False

    @property
    def t_s(self) -> FloatArray:
        """Times (n,) [s]."""
        return self.tick_s * np.arange(len(self.q_m), dtype=np.float64)

    @property
    def duration_s(self) -> float:
        """Ticks times period."""
        return self.tick_s * len(self.q_m)

    def path_m(self, rest_length_m: float) -> FloatArray:
        """Lengths (n, 2) [m] that the pumps have to follow: with a step from rest in the first tick."""
        if not self.from_rest:
            return self.q_m
        q = self.q_m.copy()
        q[0] = rest_length_m
        return q


def _ticks(duration_s: float, tick_s: float) -> int:
    if not _SHORTEST * tick_s <= duration_s <= LONGEST_S:
        raise BadInputError(
            f"reference: lasts {duration_s:g} s, expected {_SHORTEST * tick_s:.3g} s to {LONGEST_S:g} s"
        )
    return round(duration_s / tick_s)


def from_lengths(model: Model, name: str, q_m: FloatArray, judged_from_s: float = 0.0) -> Reference:
    """A reference of lengths (n, 2) [m] at the ticks."""
    q = np.asarray(q_m, dtype=np.float64)
    _ticks(len(q) * model.tick_s, model.tick_s)
    return Reference(name, "lengths", model.tick_s, q, angle(q, model.plant.bellows_radius_m), judged_from_s)


def from_angles(model: Model, name: str, phi_rad: FloatArray) -> Reference:
    """A reference of angles (n,) [rad] at the ticks, one pump alone.

    Raises `BadInputError` for an angle at which nothing is at rest.
    """
    phi = np.asarray(phi_rad, dtype=np.float64)
    _ticks(len(phi) * model.tick_s, model.tick_s)
    values, where = np.unique(phi, return_inverse=True)
    if len(values) > 400:
        # Between 400 rests a straight line is exact to a micrometre.
        known = np.linspace(values[0], values[-1], 400)
        if values[0] < 0.0 < values[-1]:
            # The pumps change over there.
            known = np.union1d(known, [0.0])
        rests = np.array([bent_rest(model, float(value)) for value in known])
        q = np.stack([np.interp(phi, known, rests[:, i]) for i in range(2)], axis=1)
    else:
        q = np.array([bent_rest(model, float(value)) for value in values])[where]
    return Reference(name, "angle", model.tick_s, q, phi)


def built_in(model: Model, name: str, duration_s: float | None = None) -> Reference:
    """One of `BUILT_IN` on the model's ticks.

    Raises `BadInputError` for a time that is none.
    """
    duration = _DURATION_S[name] if duration_s is None else duration_s
    if not math.isfinite(duration):
        raise BadInputError(f"reference: lasts {duration} s, expected a time")
    h = model.tick_s
    t = h * np.arange(_ticks(duration, h), dtype=np.float64)
    if name == "elongation":
        return from_lengths(model, name, PolynomialElongation().bellows_m(t))
    if name == "ellipse":
        return from_lengths(model, name, Ellipse().bellows_m(t, model.plant.bellows_radius_m), 2.0)
    if name == "step":
        return replace(from_angles(model, name, np.full(len(t), _STEP_RAD)), from_rest=True)
    jump_s = _JUMP_AT_S if t[-1] > _JUMP_AT_S else None
    made = from_angles(model, name, np.where(t + 1e-9 < _JUMP_AT_S, _STEP_RAD, _JUMP_RAD))
    return replace(made, from_rest=True, jump_s=jump_s)


def resampled(t_s: FloatArray, values: FloatArray, tick_s: float) -> FloatArray:
    """Values (m, ...) at the ticks from values (n, ...) at rising times (n,) [s], the first at the tick 0.

    Piecewise cubic that overshoots nowhere (Fritsch and Carlson), so that rates exist and steps stay steps.
    """
    from scipy.interpolate import PchipInterpolator

    t = np.asarray(t_s, dtype=np.float64) - float(t_s[0])
    count = math.floor(float(t[-1]) / tick_s + 1e-3) + 1
    ticks = np.minimum(tick_s * np.arange(count, dtype=np.float64), t[-1])
    return np.asarray(PchipInterpolator(t, values, axis=0)(ticks))


def check_workspace(
    model: Model, reference: Reference, workspace_m: tuple[float, float, float, float]
) -> None:
    """Raise `BadInputError` unless the marker stays in the box (least x, least y, greatest x and y) [m]."""
    q = reference.q_m
    short = np.flatnonzero(q.min(axis=1) <= 0.0)
    if len(short):
        k = int(short[0])
        raise BadInputError(
            f"{reference.name}: at {k * reference.tick_s:.3f} s a bellows would be {1e3 * q[k].min():.3g} mm "
            "long, expected a positive length"
        )
    pose = forward(q, model.plant.bellows_radius_m)
    marker = marker_from_head(pose[:, :2], pose[:, 2])
    x0, y0, x1, y1 = workspace_m
    slack = 1e-9
    outside = (marker < np.array([x0, y0]) - slack) | (marker > np.array([x1, y1]) + slack)
    bad = np.flatnonzero(outside.any(axis=1))
    if len(bad):
        k = int(bad[0])
        x, y = (1e3 * marker[k]).tolist()
        raise BadInputError(
            f"{reference.name}: at {k * reference.tick_s:.3f} s the marker would be at ({x:.1f}, {y:.1f}) "
            f"mm, outside the workspace, expected x {1e3 * x0:g} to {1e3 * x1:g} mm and y {1e3 * y0:g} to "
            f"{1e3 * y1:g} mm"
        )

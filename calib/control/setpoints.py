"""Set-points: constant angle and jump (4.1), polynomial elongation (4.7), ellipse (4.9).

Every set-point is a frozen dataclass with one method that takes times [s], a number or an array, and
returns the reference at these times.

Departures from print:

- (4.7) peaks at t = 5 s with 90 mm and falls to -25 mm at t = 10 s. It is held from 5 s on, as the
  figures show it.
- (4.9) is drawn with y upward and y_offset < 0; the model's y points down to the head, so
  y = -(printed y).
- (4.9c) prints phi_ref = -tan(x / y). It has to be the arc tangent, and under constant curvature the
  chord from the base to the head points at phi / 2, not at phi. `chord="exact"` sets
  phi_ref = 2 atan(x / y), and then the forward kinematics of q_ref give the drawn ellipse back.
  `chord="thesis"` keeps phi_ref = atan(x / y): the head then travels 7.5 mm to each side where 15 mm
  are drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.actuator.kinematics import inverse
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["CHORDS", "AngleSteps", "Ellipse", "PolynomialElongation"]

CHORDS = ("exact", "thesis")


def _finite(what: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value):
            raise BadInputError(f"{what}: found {value}, expected finite numbers")


@dataclass(frozen=True)
class AngleSteps:
    """Piecewise constant angle of the head; with one value a constant, with two the jump of Fig. 4.7.

    Attributes
    ----------
    angles_rad : values in turn [rad].
    at_s : times at which the second and later values begin [s], rising.

    Raises `BadInputError` when the numbers do not fit together.
    """

    angles_rad: tuple[float, ...] = (0.7,)
    at_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _finite("set-point", *self.angles_rad, *self.at_s)
        if len(self.angles_rad) != len(self.at_s) + 1:
            raise BadInputError(
                f"set-point: found {len(self.angles_rad)} angles and {len(self.at_s)} times, "
                "expected one time between two angles"
            )
        if any(b <= a for a, b in zip(self.at_s, self.at_s[1:], strict=False)):
            raise BadInputError("set-point: the times of the steps do not rise")

    def angle_rad(self, t_s: FloatArray) -> FloatArray:
        """phi_ref (...) [rad] at the times (...) [s]; a step counts from its own time on."""
        index = np.searchsorted(np.array(self.at_s), np.asarray(t_s, dtype=np.float64), side="right")
        return np.asarray(np.array(self.angles_rad)[index])


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

    def __post_init__(self) -> None:
        _finite("elongation set-point", self.c0_m, self.c2_m_per_s2, self.c3_m_per_s3, self.hold_s)

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

    Raises `BadInputError` for half axes, a centre or a period that are not positive, for an ellipse
    around the base, and for another chord.
    """

    x_m: float = 0.015
    y_m: float = 0.010
    centre_y_m: float = 0.078
    period_s: float = 20.0
    chord: str = "exact"

    def __post_init__(self) -> None:
        _finite("ellipse", self.x_m, self.y_m, self.centre_y_m, self.period_s)
        for name in ("x_m", "y_m", "centre_y_m", "period_s"):
            if getattr(self, name) <= 0.0:
                raise BadInputError(
                    f"ellipse {name}: found {getattr(self, name):g}, expected a positive number"
                )
        if self.y_m >= self.centre_y_m:
            raise BadInputError(
                f"ellipse: a half axis of {self.y_m:g} m around {self.centre_y_m:g} m reaches the base"
            )
        if self.chord not in CHORDS:
            raise BadInputError(f"chord: found {self.chord!r}, expected one of {', '.join(CHORDS)}")

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

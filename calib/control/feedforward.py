"""Feed-forward from the steady elongation of the bellows (4.6, Fig. 4.11).

    u_ff = 0                                        for q_ref <  0.067 m
    u_ff = min(255, 5498.1 (q_ref - 0.067) + 110)   for q_ref >= 0.067 m

The straight line is a fit to the steady elongation with both motors at the same voltage, so it
holds for stretching without bending. It jumps from 0 to 110 at 0.067 m, where the dead zone of the
pumps ends, reaches 242 at 91 mm and saturates at 93.4 mm.

Its value is added to the output of the feedback controller before saturation and is no part of that
controller's memory (see `calib.control.pid`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.errors import BadInputError

__all__ = ["FeedForward", "feed_forward"]


@dataclass(frozen=True)
class FeedForward:
    """The line of (4.6).

    Attributes
    ----------
    from_m : shortest length of a bellows that needs any pressure [m].
    offset_pwm : value there [PWM].
    slope_pwm_per_m : increase with the length [PWM/m].
    limit_pwm : largest value [PWM].

    Raises `BadInputError` for values that are not finite or a length that is not positive.
    """

    from_m: float = 0.067
    offset_pwm: float = 110.0
    slope_pwm_per_m: float = 5498.1
    limit_pwm: float = 255.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise BadInputError(f"feed-forward {name}: found {value}, expected a finite number")
        if self.from_m <= 0.0:
            raise BadInputError(f"feed-forward from_m: found {self.from_m:g} m, expected a positive length")

    @property
    def saturates_at_m(self) -> float:
        """Length of a bellows from which the limit holds [m]."""
        return self.from_m + (self.limit_pwm - self.offset_pwm) / self.slope_pwm_per_m


def feed_forward(parameters: FeedForward, q_ref_m: float) -> float:
    """u_ff [PWM] of the wanted length of one bellows [m] (4.6)."""
    if q_ref_m < parameters.from_m:
        return 0.0
    return min(
        parameters.limit_pwm,
        parameters.slope_pwm_per_m * (q_ref_m - parameters.from_m) + parameters.offset_pwm,
    )

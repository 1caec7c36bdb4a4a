"""The static map of a pump from settled values: dead zone, saturation, and what scatters about them.

    y(u) = Y (1 - exp(-(u - u0) / S)) / (1 - exp(-(255 - u0) / S)) for u > u0, else 0

with the value Y at PWM 255, the dead zone u0 and the scale S of the saturation; the map has reached 95 %
of its end at u0 + 3 S at most. Least squares with soft L1 loss on the magnitudes; standard deviations from
the scatter of the settled values about the map, those that lie far off counted as outliers and named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calib.actuator.identify_pump_models import Shape
from calib.actuator.pump import PWM_MAX
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["StaticMap", "fit_static_map"]

_FEWEST = 5
_FAR = 4.0


@dataclass(frozen=True)
class StaticMap:
    """A fitted static map.

    Attributes
    ----------
    name : of the table or the part of it. end : Y with its sign. shape : dead zone and scale.
    sigma : of end, dead_pwm, scale_pwm. saturates_pwm : where 95 % of the end are reached.
    scatter : robust standard deviation of the settled values about the map.
    pwm, value : (n,) what was fitted. outliers : (m,) PWM values that lie more than four scatters off.
    """

    name: str
    end: float
    shape: Shape
    sigma: dict[str, float]
    saturates_pwm: float
    scatter: float
    pwm: FloatArray
    value: FloatArray
    outliers: tuple[float, ...]

    def of(self, pwm: FloatArray) -> FloatArray:
        """Settled value of PWM values (n,)."""
        return np.asarray(self.end * self.shape.of(pwm))


def fit_static_map(name: str, pwm: FloatArray, value: FloatArray) -> StaticMap:
    """Fit the map to settled values (n,) at PWM values (n,), all of one sign.

    Raises `BadInputError` for fewer than five levels of PWM or values that are all alike.
    """
    u, y = np.asarray(pwm, dtype=np.float64), np.asarray(value, dtype=np.float64)
    if len(np.unique(u)) < _FEWEST:
        raise BadInputError(f"{name}: has {len(np.unique(u))} levels of PWM, expected at least {_FEWEST}")
    sign = -1.0 if float(np.median(y)) < 0.0 else 1.0
    size = sign * y
    top = float(np.quantile(size, 0.9))
    if not top > 0.0:
        raise BadInputError(f"{name}: the settled values are all zero, expected the pump's effect")

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray((x[0] * Shape(float(x[1]), float(x[2])).of(u) - size) / (0.02 * top))

    low, high = np.array([0.1 * top, 0.0, 3.0]), np.array([5.0 * top, float(u.max()) - 5.0, 400.0])
    best = None
    for dead in (0.3 * float(u.min()), 0.9 * float(u.min())):
        for scale in (15.0, 60.0, 200.0):
            found = least_squares(
                residual,
                np.clip([top, dead, scale], low * 1.01 + 1e-9, high * 0.99),
                bounds=(low, high),
                x_scale=[top, 50.0, 50.0],
                loss="soft_l1",
            )
            if best is None or found.cost < best.cost:
                best = found
    assert best is not None
    end, dead, scale = (float(v) for v in best.x)
    error = residual(best.x)
    scatter = max(1.4826 * float(np.median(np.abs(error))), 1e-6)
    far = np.abs(error) > _FAR * scatter
    J = np.asarray(best.jac)[~far]
    inside = [k for k in range(3) if low[k] * 1.001 < best.x[k] < high[k] * 0.999]
    sigma = {"end": math.inf, "dead_pwm": math.inf, "scale_pwm": math.inf}
    weight = error[~far]
    noise = float(np.sqrt(np.sum(weight**2) / max(len(weight) - len(inside), 1)))
    H = J[:, inside].T @ J[:, inside]
    if len(J) > len(inside) and np.linalg.cond(H) < 1e14:
        spread = noise * np.sqrt(np.diag(np.linalg.inv(H)))
        for k, s in zip(inside, spread.tolist(), strict=True):
            sigma[("end", "dead_pwm", "scale_pwm")[k]] = s
    reach = -scale * math.log1p(0.95 * math.expm1(-(PWM_MAX - dead) / scale))
    return StaticMap(
        name,
        sign * end,
        Shape(dead, scale),
        sigma,
        dead + reach,
        scatter * 0.02 * top,
        u,
        y,
        tuple(sorted(u[far].tolist())),
    )

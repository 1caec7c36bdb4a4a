"""Lengths, rates, creep and disturbing forces from PWM, marker and gyroscope, on the identified model.

    x = (q, dq, z, d, b):  the plant of `calib.actuator.dynamics` driven by the pumps' forces plus d,
                           dd/dt = noise,  db/dt = noise
    marker  m = p(q) + offset (sin phi, cos phi), exposed one latency before the tick         (A.1)
    gyro   -gz = dphi + b

The prediction is the nonlinear model, the correction a constant gain L: that of the stationary Kalman
filter of the model linearised at one point, sampled at the ticks. The marker's innovation is taken
against the prediction at the time of the exposure and turned into lengths by the Jacobian there. A
marker farther away than the gate is not believed.

d takes up what the model does not explain, at rest all of it, which is what makes a controller that
subtracts it free of static error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calib.actuator.arc import chord_decay_w, chord_ratio_w
from calib.actuator.dynamics import Coefficients, coefficients, linearised, mass_matrix
from calib.actuator.integrate import largest_step_s
from calib.actuator.kernel import derivative
from calib.actuator.kinematics import MARKER_OFFSET_M
from calib.arrays import FloatArray
from calib.control.inverse_model import Model
from calib.control.pump_model import PumpEstimate, ahead, pumps_at_rest, push
from calib.errors import BadInputError

__all__ = [
    "Observer",
    "ObserverNoise",
    "ObserverState",
    "correct",
    "design_observer",
    "look_ahead",
    "marker_jacobian",
    "marker_of",
    "predict",
    "start_observer",
]

STATES = 9


@dataclass(frozen=True)
class ObserverNoise:
    """What the gain is designed for.

    Attributes
    ----------
    marker_m : standard deviation of the marker along each axis [m].
    gyro_radps : of the mean of a tick's samples [rad/s].
    force_N_per_sqrt_s : walk of d. bias_radps_per_sqrt_s : walk of b.
    accel_mps2_per_sqrt_Hz : density of what pushes the head unseen.

    Raises `BadInputError` for values that are not positive.
    """

    marker_m: float = 2.5e-4
    gyro_radps: float = 0.003
    force_N_per_sqrt_s: float = 0.03
    bias_radps_per_sqrt_s: float = 3e-3
    accel_mps2_per_sqrt_Hz: float = 0.05

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < math.inf:
                raise BadInputError(f"observer {name}: found {value:g}, expected a positive number")


@dataclass(frozen=True)
class Observer:
    """An observer with its gain.

    Attributes
    ----------
    model : the identified rig.
    gain : (9, 3) L, columns q1, q2 [m] and the gyroscope [rad/s].
    latency_s : from the exposure to the tick that reads the marker.
    marker_offset_m, gate_m : offset of (A.1), and the largest innovation that is believed.
    """

    model: Model
    gain: FloatArray
    latency_s: float = 0.025
    marker_offset_m: float = MARKER_OFFSET_M
    gate_m: float = 4e-3


class ObserverState(NamedTuple):
    """Estimate at a tick.

    Attributes
    ----------
    y : (6,) q, dq, z. d_N : (2,). bias_radps : b.
    pumps : state of the pumps.
    past_q : lengths at this tick and those before, the newest first.
    refused : markers in a row that were not believed.
    """

    y: FloatArray
    d_N: FloatArray
    bias_radps: float
    pumps: PumpEstimate
    past_q: tuple[FloatArray, ...]
    refused: int = 0


def marker_of(q1: float, q2: float, r: float, offset_m: float) -> tuple[float, float]:
    """The marker (x, y) [m] of the lengths [m] (3.6), (A.1)."""
    phi, l = (q1 - q2) / (2.0 * r), 0.5 * (q1 + q2)  # noqa: E741  the source's symbol
    chord = l * chord_ratio_w(phi * phi)
    return (
        chord * math.sin(0.5 * phi) + offset_m * math.sin(phi),
        chord * math.cos(0.5 * phi) + offset_m * math.cos(phi),
    )


def marker_jacobian(q1: float, q2: float, r: float, offset_m: float) -> FloatArray:
    """d(x, y) / d(q1, q2), shape (2, 2), of `marker_of`."""
    phi, l = (q1 - q2) / (2.0 * r), 0.5 * (q1 + q2)  # noqa: E741  the source's symbol
    S, S1 = chord_ratio_w(phi * phi), -phi * chord_decay_w(phi * phi)
    s, c = math.sin(0.5 * phi), math.cos(0.5 * phi)
    x_l, y_l = S * s, S * c
    x_phi = l * (S1 * s + 0.5 * S * c) + offset_m * math.cos(phi)
    y_phi = l * (S1 * c - 0.5 * S * s) - offset_m * math.sin(phi)
    a, b = 0.5 / r * x_phi, 0.5 / r * y_phi
    return np.array([[0.5 * x_l + a, 0.5 * x_l - a], [0.5 * y_l + b, 0.5 * y_l - b]])


def design_observer(
    model: Model,
    noise: ObserverNoise | None = None,
    at_q_m: tuple[float, float] | None = None,
    latency_s: float = 0.025,
    marker_offset_m: float = MARKER_OFFSET_M,
) -> Observer:
    """The observer whose gain is the stationary Kalman filter's at the lengths `at_q_m` [m].

    By default at 12 mm of elongation, in the middle of the workspace. Raises `BadInputError` where no
    stationary filter exists.
    """
    from scipy.linalg import LinAlgError, expm, solve_discrete_are

    noise = noise or ObserverNoise()
    plant, h = model.plant, model.tick_s
    q = np.full(2, plant.rest_length_m + 0.012) if at_q_m is None else np.array(at_q_m)
    A = np.zeros((STATES, STATES))
    A[:6, :6] = linearised(plant, q)
    inverse = np.linalg.inv(mass_matrix(plant, q))
    A[2:4, 6:8] = inverse
    pushed = np.zeros(STATES)
    pushed[2:4] = noise.accel_mps2_per_sqrt_Hz**2
    pushed[6:8] = noise.force_N_per_sqrt_s**2
    pushed[8] = noise.bias_radps_per_sqrt_s**2
    # Van Loan's block gives transition and noise of a tick together.
    block = expm(h * np.block([[-A, np.diag(pushed)], [np.zeros_like(A), A.T]]))
    Phi = block[STATES:, STATES:].T
    Q = Phi @ block[:STATES, STATES:]
    r = plant.bellows_radius_m
    H = np.zeros((3, STATES))
    H[0, 0] = H[1, 1] = 1.0
    H[2, 2], H[2, 3], H[2, 8] = 0.5 / r, -0.5 / r, 1.0
    to_q = np.linalg.inv(marker_jacobian(float(q[0]), float(q[1]), r, marker_offset_m))
    R = np.zeros((3, 3))
    R[:2, :2] = noise.marker_m**2 * to_q @ to_q.T
    R[2, 2] = noise.gyro_radps**2
    try:
        P = solve_discrete_are(Phi.T, H.T, 0.5 * (Q + Q.T), R)
    except (LinAlgError, ValueError) as error:
        raise BadInputError(f"observer: has no stationary gain for this plant ({error})") from error
    L = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return Observer(model, np.asarray(L), latency_s, marker_offset_m)


def start_observer(observer: Observer) -> ObserverState:
    """Straight at rest with the pumps off."""
    rest = observer.model.plant.rest_length_m
    y = np.array([rest, rest, 0.0, 0.0, 0.0, 0.0])
    kept = 2 + math.ceil(observer.latency_s / observer.model.tick_s)
    return ObserverState(y, np.zeros(2), 0.0, pumps_at_rest(observer.model), (y[:2],) * kept)


def _substeps(model: Model) -> int:
    return max(4, math.ceil(1.5 * model.tick_s / largest_step_s(model.plant)))


def _advance(
    c: Coefficients, y: FloatArray, start: FloatArray, end: FloatArray, tick_s: float, steps: int
) -> FloatArray:
    """Plant after a tick in which the forces go in a straight line from `start` to `end`."""
    h = tick_s / steps
    for i in range(steps):
        a, b = start + (end - start) * (i / steps), start + (end - start) * ((i + 1) / steps)
        m = 0.5 * (a + b)
        k1 = derivative(c, y, a[0], a[1])
        k2 = derivative(c, y + 0.5 * h * k1, m[0], m[1])
        k3 = derivative(c, y + 0.5 * h * k2, m[0], m[1])
        k4 = derivative(c, y + h * k3, b[0], b[1])
        y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return y


def predict(observer: Observer, state: ObserverState, pwm: tuple[float, float]) -> ObserverState:
    """State at the next tick after a command, without new readings."""
    model = observer.model
    pumps = push(model, state.pumps, pwm)
    start, end = np.array(state.pumps.force_N) + state.d_N, np.array(pumps.force_N) + state.d_N
    y = _advance(coefficients(model.plant), state.y, start, end, model.tick_s, _substeps(model))
    return state._replace(y=y, pumps=pumps, past_q=(y[:2], *state.past_q[:-1]))


def look_ahead(observer: Observer, state: ObserverState) -> tuple[FloatArray, PumpEstimate]:
    """Plant (6,) and pumps at the tick at which the next command arrives."""
    model = observer.model
    c, steps, y = coefficients(model.plant), _substeps(model), state.y
    pumps = ahead(model, state.pumps)
    for a, b in pairwise(pumps):
        forces = np.array(a.force_N) + state.d_N, np.array(b.force_N) + state.d_N
        y = _advance(c, y, *forces, model.tick_s, steps)
    return y, pumps[-1]


def _exposed(observer: Observer, state: ObserverState) -> FloatArray:
    late = observer.latency_s / observer.model.tick_s
    i = min(int(late), len(state.past_q) - 2)
    part = late - i
    return np.asarray((1.0 - part) * state.past_q[i] + part * state.past_q[i + 1])


def correct(
    observer: Observer,
    state: ObserverState,
    marker_m: tuple[float, float],
    minus_gz_radps: float,
) -> ObserverState:
    """State with a tick's readings.

    Parameters
    ----------
    marker_m : in the plane [m], NaN where nothing was found.
    minus_gz_radps : mean of the tick's samples, NaN without.
    """
    plant, innovation = observer.model.plant, np.zeros(3)
    r, offset, refused = plant.bellows_radius_m, observer.marker_offset_m, state.refused
    if not math.isnan(marker_m[0] + marker_m[1]):
        q1, q2 = _exposed(observer, state).tolist()
        x_m, y_m = marker_of(q1, q2, r, offset)
        away = np.array([marker_m[0] - x_m, marker_m[1] - y_m])
        # Ten in a row are no outliers: the estimate itself is off.
        if float(np.hypot(*away)) <= observer.gate_m or refused >= 10:
            innovation[:2] = np.linalg.solve(marker_jacobian(q1, q2, r, offset), away)
            refused = 0
        else:
            refused += 1
    if not math.isnan(minus_gz_radps):
        dphi = 0.5 * float(state.y[2] - state.y[3]) / r
        innovation[2] = minus_gz_radps - dphi - state.bias_radps
    step = observer.gain @ innovation
    y = state.y + step[:6]
    moved = tuple(q + step[:2] for q in state.past_q)
    return ObserverState(
        y, state.d_N + step[6:8], state.bias_radps + float(step[8]), state.pumps, moved, refused
    )

"""The observer: lengths, rates, creep and disturbing forces from PWM, marker and gyroscope, on the model.

    x = (q, dq, z, d, b):  the plant of `calib.stages.actuator.dynamics` driven by the pumps' forces plus d,
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
from itertools import pairwise

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator import dynamics, kinematics
from calib.stages.actuator.simulate import derivative, largest_step_s
from calib.stages.control.rig_model import Model, Pair, PumpEstimate, ahead, pumps_at_rest, push

STATES = 9


_MARKER_M, _GYRO_RADPS = 2.5e-4, 0.003
"""Standard deviations of the marker along each axis, and of the mean of a tick's rates."""
_FORCE_N_PER_SQRT_S, _BIAS_RADPS_PER_SQRT_S, _ACCEL_MPS2_PER_SQRT_HZ = 0.03, 3e-3, 0.05
"""Walks of d and b, and density of what pushes the head unseen."""
_GATE_M = 4e-3
"""Largest innovation of a marker that is believed."""
_AT_M = 0.012
"""Elongation at which the gain is designed, in the middle of the workspace."""


class Observer:
    """An observer with its memory, straight at rest with the pumps off at the start.

    Attributes
    ----------
    model : the identified rig.
    gain : (9, 3) L, columns q1, q2 [m] and the gyroscope [rad/s].
    latency_s : from the exposure to the tick that reads the marker. marker_offset_m : of (A.1).
    y : (6,) q, dq, z. d_N : (2,). bias_radps : b.
    pumps : their state.
    """

    def __init__(self, model: Model, gain: FloatArray, latency_s: float, marker_offset_m: float) -> None:
        self.model, self.gain = model, gain
        self.latency_s, self.marker_offset_m = latency_s, marker_offset_m
        self.y = np.array([model.plant.rest_length_m] * 2 + [0.0] * 4)
        self.d_N, self.bias_radps, self.pumps = np.zeros(2), 0.0, pumps_at_rest(model)
        # Lengths at this tick and those before, the newest first.
        self._past_q = np.tile(self.y[:2], (2 + math.ceil(latency_s / model.tick_s), 1))
        self._refused = 0

    def _advanced(self, y: FloatArray, before: PumpEstimate, after: PumpEstimate) -> FloatArray:
        """Plant (6,) after a tick in which the pumps' forces go in a straight line."""
        c, tick_s = dynamics.coefficients(self.model.plant), self.model.tick_s
        steps = max(4, math.ceil(1.5 * tick_s / largest_step_s(self.model.plant)))
        h, d = tick_s / steps, self.d_N
        start, end = np.array(before.force_N) + d, np.array(after.force_N) + d
        for i in range(steps):
            a, b = start + (end - start) * (i / steps), start + (end - start) * ((i + 1) / steps)
            m = 0.5 * (a + b)
            k1 = derivative(c, y, a[0], a[1])
            k2 = derivative(c, y + 0.5 * h * k1, m[0], m[1])
            k3 = derivative(c, y + 0.5 * h * k2, m[0], m[1])
            k4 = derivative(c, y + h * k3, b[0], b[1])
            y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return y

    def predict(self, pwm: Pair) -> None:
        """Go on to the next tick after a command, without new readings."""
        pumps = push(self.model, self.pumps, pwm)
        self.y, self.pumps = self._advanced(self.y, self.pumps, pumps), pumps
        self._past_q = np.vstack([self.y[:2], self._past_q[:-1]])

    def look_ahead(self) -> tuple[FloatArray, PumpEstimate]:
        """Plant (6,) and pumps at the tick at which the next command arrives."""
        y, pumps = self.y, ahead(self.model, self.pumps)
        for before, after in pairwise(pumps):
            y = self._advanced(y, before, after)
        return y, pumps[-1]

    def _exposed(self) -> FloatArray:
        late = self.latency_s / self.model.tick_s
        i = min(int(late), len(self._past_q) - 2)
        return np.asarray((1.0 - (late - i)) * self._past_q[i] + (late - i) * self._past_q[i + 1])

    def correct(self, marker_m: Pair, minus_gz_radps: float) -> None:
        """Take a tick's readings.

        Parameters
        ----------
        marker_m : in the plane [m], NaN where nothing was found.
        minus_gz_radps : mean of the tick's samples, NaN without.
        """
        r, offset, innovation = self.model.plant.bellows_radius_m, self.marker_offset_m, np.zeros(3)
        if not math.isnan(marker_m[0] + marker_m[1]):
            q = self._exposed()
            away = np.array(marker_m) - marker_position(q, r, offset)
            # Ten in a row are no outliers: the estimate itself is off.
            if float(np.hypot(*away)) <= _GATE_M or self._refused >= 10:
                innovation[:2] = np.linalg.solve(marker_jacobian(q, r, offset), away)
                self._refused = 0
            else:
                self._refused += 1
        if not math.isnan(minus_gz_radps):
            dphi = 0.5 * float(self.y[2] - self.y[3]) / r
            innovation[2] = minus_gz_radps - dphi - self.bias_radps
        step = self.gain @ innovation
        self.y, self.d_N = self.y + step[:6], self.d_N + step[6:8]
        self.bias_radps += float(step[8])
        self._past_q = self._past_q + step[:2]


def marker_position(q_m: FloatArray, bellows_radius_m: float, offset_m: float) -> FloatArray:
    """The marker (2,) [m] of the lengths (2,) [m] (3.6), (A.1)."""
    head = kinematics.forward(q_m, bellows_radius_m)
    return kinematics.marker_from_head(head[:2], head[2], offset_m)


def marker_jacobian(q_m: FloatArray, bellows_radius_m: float, offset_m: float) -> FloatArray:
    """d(x, y) / d(q1, q2), shape (2, 2), of `marker_position`."""
    phi, J = (
        float(kinematics.angle(q_m, bellows_radius_m)),
        kinematics.forward_jacobian(q_m, bellows_radius_m),
    )
    return np.asarray(J[:2] + offset_m * np.outer([math.cos(phi), -math.sin(phi)], J[2]))


def design_observer(
    model: Model, latency_s: float = 0.025, marker_offset_m: float = kinematics.MARKER_OFFSET_M
) -> Observer:
    """The observer whose gain is the stationary Kalman filter's in the middle of the workspace.

    Raises `BadInputError` where no stationary filter exists.
    """
    from scipy.linalg import LinAlgError, expm, solve_discrete_are

    plant, h = model.plant, model.tick_s
    q = np.full(2, plant.rest_length_m + _AT_M)
    A = np.zeros((STATES, STATES))
    A[:6, :6] = dynamics.linearised(plant, q)
    inverse = np.linalg.inv(dynamics.mass_matrix(plant, q))
    A[2:4, 6:8] = inverse
    pushed = np.zeros(STATES)
    pushed[2:4] = _ACCEL_MPS2_PER_SQRT_HZ**2
    pushed[6:8] = _FORCE_N_PER_SQRT_S**2
    pushed[8] = _BIAS_RADPS_PER_SQRT_S**2
    # Van Loan's block gives transition and noise of a tick together.
    block = expm(h * np.block([[-A, np.diag(pushed)], [np.zeros_like(A), A.T]]))
    Phi = block[STATES:, STATES:].T
    Q = Phi @ block[:STATES, STATES:]
    r = plant.bellows_radius_m
    H = np.zeros((3, STATES))
    H[0, 0] = H[1, 1] = 1.0
    H[2, 2], H[2, 3], H[2, 8] = 0.5 / r, -0.5 / r, 1.0
    to_q = np.linalg.inv(marker_jacobian(q, r, marker_offset_m))
    R = np.zeros((3, 3))
    R[:2, :2] = _MARKER_M**2 * to_q @ to_q.T
    R[2, 2] = _GYRO_RADPS**2
    try:
        P = solve_discrete_are(Phi.T, H.T, 0.5 * (Q + Q.T), R)
    except (LinAlgError, ValueError) as error:
        raise BadInputError(f"observer: has no stationary gain for this plant ({error})") from error
    L = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return Observer(model, np.asarray(L), latency_s, marker_offset_m)

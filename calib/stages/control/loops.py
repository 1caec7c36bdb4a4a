"""Loops for small motion about a rest, in discrete time, with their gain, phase and delay margins.

At a rest the plant is `dynamics.linearised` with the slope of the pump's static map as its input,

    x = (q, dq, z, F),   dF/dt = (g'(u0) u - F) / tau,

held over a tick (zero-order hold, exact by the matrix exponential) and delayed by whole ticks. The limit
on the falling rate is no part of it: it does not act on small motion. Controllers are (D.6). What the
firmware makes of its sensors may be in between: the length from the camera, one latency late and
low-passed, the angle as it is (the gyroscope carries its fast part).

Everything here is a `System`, x' = A x + B u, y = C x + D u with a period; `response` gives its
frequency response.

Margins. A loop with several channels is broken at one of them with the others closed,

    L_i = L_ii - L_io (I + L_oo)^-1 L_oi,

o the others. What acts on all channels alike, as the supply of both pumps or softer springs, is another
matter: with a factor s on all of them det(I + s L) is the product of 1 + s l over the eigenvalues l of L,
so that each of these loci is a scalar loop as well (MacFarlane and Postlethwaite 1977). At the nominal
rests 54 % more of both pumps are as much as 109 % more of one. Margins are read off the frequency response
between zero and half the sampling rate:

    gain margin    least factor, above or below 1, at which L passes -1: 1 / |L| where L is real
                   and negative
    phase margin   least angle between L and -1 where |L| = 1
    delay margin   phase margin over frequency, least
    Ms             largest |1 / (1 + L)|, the sensitivity

Crossings are refined on a straight line between two frequencies. Whether the closed loop is stable at
all is asked of its eigenvalues and not of these curves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from calib.core.arrays import ComplexArray, FloatArray
from calib.stages.actuator.dynamics import linearised, mass_matrix
from calib.stages.control import laws
from calib.stages.control.rig_model import Model, force_of_pwm, holding_force, pwm_of_force

_CUTOFF_HZ = 1.0
"""Of the firmware's usual low-pass."""


@dataclass(frozen=True)
class System:
    """A discrete linear system with matrices A (n, n), B (n, m), C (p, n), D (p, m)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    tick_s: float


def gain(matrix: FloatArray, tick_s: float) -> System:
    """A system without memory."""
    D = np.atleast_2d(np.asarray(matrix, dtype=np.float64))
    p, m = D.shape
    return System(np.zeros((0, 0)), np.zeros((0, m)), np.zeros((p, 0)), D, tick_s)


def series(first: System, second: System) -> System:
    """`second` after `first`."""
    A = np.block([[first.A, np.zeros((len(first.A), len(second.A)))], [second.B @ first.C, second.A]])
    B, C = np.vstack([first.B, second.B @ first.D]), np.hstack([second.D @ first.C, second.C])
    return System(A, B, C, second.D @ first.D, first.tick_s)


def side_by_side(one: System, other: System) -> System:
    """Both with inputs and outputs of their own."""
    from scipy.linalg import block_diag

    A, B, C, D = (block_diag(getattr(one, name), getattr(other, name)) for name in "ABCD")
    return System(A, B, C, D, one.tick_s)


def delay(ticks: int, tick_s: float) -> System:
    """One channel, some ticks late."""
    if ticks == 0:
        return gain(np.eye(1), tick_s)
    A = np.eye(ticks, k=-1)
    B, C = np.zeros((ticks, 1)), np.zeros((1, ticks))
    B[0, 0] = C[0, -1] = 1.0
    return System(A, B, C, np.zeros((1, 1)), tick_s)


def response(system: System, omega: FloatArray) -> ComplexArray:
    """Frequency response (k, p, m) at angular frequencies (k,) [rad/s]."""
    z = np.exp(1j * np.asarray(omega) * system.tick_s)
    n = len(system.A)
    if n == 0:
        return np.broadcast_to(system.D.astype(np.complex128), (len(z), *system.D.shape)).copy()
    inner = np.linalg.solve(
        z[:, None, None] * np.eye(n) - system.A, np.broadcast_to(system.B, (len(z), *system.B.shape))
    )
    return np.asarray(system.C @ inner + system.D, dtype=np.complex128)


def closed_loop(loop: System) -> System:
    """From the reference to the output of a square loop with negative feedback."""
    back = np.linalg.inv(np.eye(len(loop.D)) + loop.D)
    return System(loop.A - loop.B @ back @ loop.C, loop.B @ back, back @ loop.C, back @ loop.D, loop.tick_s)


def spectral_radius(system: System) -> float:
    """Largest magnitude of the eigenvalues; below 1 the system is stable."""
    return float(np.abs(np.linalg.eigvals(system.A)).max()) if len(system.A) else 0.0


def pid_system(pid: laws.Pid) -> System:
    """(D.6) as a system: the sum of the past errors times h, and the last error, each where it is used."""
    h, I, D = pid.tick_s, pid.Ki != 0.0, pid.Kd != 0.0  # noqa: E741  the field's letters
    used = [i for i, wanted in enumerate((I, D)) if wanted]
    A, B = np.diag([1.0, 0.0]), np.array([[h], [1.0]])
    C = np.array([[pid.Ki, -pid.Kd / h]])
    whole = np.array([[pid.Kp + 0.5 * h * pid.Ki + pid.Kd / h]])
    return System(A[np.ix_(used, used)], B[used], C[:, used], whole, h)


def pump_slope(model: Model, q_m: FloatArray) -> FloatArray:
    """dg/du (2,) [N/PWM] of the static maps where they hold the lengths (2,); 0 outside their limits."""
    force = holding_force(model.plant, q_m)
    pwm = pwm_of_force(model, force)
    step = 1.0
    low, high = np.maximum(pwm - step, model.low_pwm), np.minimum(pwm + step, model.high_pwm)
    slope = (force_of_pwm(model, high) - force_of_pwm(model, low)) / (high - low)
    held = (force > 1e-9) & (force <= force_of_pwm(model, np.full(2, model.high_pwm)))
    return np.asarray(np.where(held, slope, 0.0))


def rig_system(model: Model, q_m: FloatArray) -> System:
    """From PWM (2,) to lengths (2,) [m] about the rest at the lengths (2,) [m]."""
    from scipy.linalg import expm

    plant, h = model.plant, model.tick_s
    q = np.asarray(q_m, dtype=np.float64)
    A, B = np.zeros((8, 8)), np.zeros((8, 2))
    A[:6, :6] = linearised(plant, q)
    A[2:4, 6:] = np.linalg.inv(mass_matrix(plant, q))
    per_s = 1.0 / np.array(model.pump.lags_s)
    A[6:, 6:] = -np.diag(per_s)
    B[6:] = np.diag(per_s * pump_slope(model, q))
    block = np.zeros((10, 10))
    block[:8, :8], block[:8, 8:] = A, B
    held = expm(h * block)
    C = np.zeros((2, 8))
    C[0, 0] = C[1, 1] = 1.0
    late = delay(model.pump.delay_ticks, h)
    return series(side_by_side(late, late), System(held[:8, :8], held[:8, 8:], C, np.zeros((2, 2)), h))


_SLACK = 0.01
"""Of a tick, by which pictures may be later than whole ticks: the time offset is hardly known better."""


def firmware_sensing(model: Model) -> System:
    """Lengths (2,) as the firmware sees them: their mean late and low-passed, their difference at once."""
    from scipy.signal import butter

    h = model.tick_s
    length = delay(math.ceil(model.latency_s / h - _SLACK), h)
    sections = model.lowpass or butter(1, _CUTOFF_HZ, fs=1.0 / h, output="sos")
    for b0, b1, b2, _, a1, a2 in sections:
        A, B = np.array([[-a1, -a2], [1.0, 0.0]]), np.array([[1.0], [0.0]])
        section = System(A, B, np.array([[b1 - b0 * a1, b2 - b0 * a2]]), np.array([[b0]]), h)
        length = series(length, section)
    apart = gain(np.array([[0.5, 0.5], [0.5, -0.5]]), h)
    together = gain(np.array([[1.0, 1.0], [1.0, -1.0]]), h)
    return series(series(apart, side_by_side(length, gain(np.eye(1), h))), together)


@dataclass(frozen=True)
class Margins:
    """Margins of one loop; infinite where nothing is crossed.

    Attributes
    ----------
    stable : of the closed loop.
    gain : factor on the loop up to the limit of stability; gain_down the one below 1, 0 without.
    phase_rad, delay_s : at the crossing of |L| = 1 that gives the least.
    crossover_hz : highest frequency with |L| = 1, 0 without.
    sensitivity : Ms.
    """

    stable: bool
    gain: float
    gain_down: float
    phase_rad: float
    delay_s: float
    crossover_hz: float
    sensitivity: float


def frequencies(tick_s: float, count: int = 2000) -> FloatArray:
    """Angular frequencies (count,) [rad/s] from far below the pumps' lag up to half the sampling rate."""
    top = math.pi / tick_s
    return np.geomspace(1e-4 * top, top, count)


def margins_of_response(omega: FloatArray, L: ComplexArray, stable: bool) -> Margins:
    """Margins of a loop's frequency response (k,) at rising angular frequencies (k,) [rad/s]."""
    crossed = []
    for i in np.flatnonzero(np.diff(np.signbit(L.imag))):
        a, b = L[i], L[i + 1]
        crossed.append(a.real + (b.real - a.real) * (a.imag / (a.imag - b.imag)))
    # At half the rate L is real by itself.
    if abs(L[-1].imag) < 1e-9 * abs(L[-1]):
        crossed.append(L[-1].real)
    factors = [float(-1.0 / real) for real in crossed if real < -1e-300]
    up = min((factor for factor in factors if factor >= 1.0), default=math.inf)
    down = max((factor for factor in factors if factor < 1.0), default=0.0)
    phase, late, crossover = math.inf, math.inf, 0.0
    size = np.log(np.maximum(np.abs(L), 1e-300))
    for i in np.flatnonzero(np.diff(np.signbit(size))):
        s = float(size[i] / (size[i] - size[i + 1]))
        w = float(omega[i] + s * (omega[i + 1] - omega[i]))
        turn = np.angle(L[i + 1] / L[i])
        angle = float(np.angle(L[i]) + s * turn + math.pi)
        angle = (angle + math.pi) % (2.0 * math.pi) - math.pi
        phase = min(phase, abs(angle))
        # A delay turns L clockwise: what is ahead of -1 by this much comes there after so long.
        late = min(late, (angle % (2.0 * math.pi)) / w)
        crossover = max(crossover, w / (2.0 * math.pi))
    sensitivity = float(np.max(1.0 / np.maximum(np.abs(1.0 + L), 1e-300)))
    return Margins(stable, up, down, phase, late, crossover, sensitivity)


def break_at(L: ComplexArray, channel: int) -> ComplexArray:
    """Scalar loop (k,) at one channel of a loop (k, n, n) with the others closed."""
    n = L.shape[1]
    others = [i for i in range(n) if i != channel]
    own: ComplexArray = L[:, channel, channel]
    if not others:
        return own
    rest = np.linalg.solve(np.eye(n - 1) + L[:, others][:, :, others], L[:, others, channel][..., None])
    return np.asarray(own - (L[:, channel, None][:, :, others] @ rest)[:, 0, 0], dtype=np.complex128)


def loci(L: ComplexArray) -> ComplexArray:
    """Eigenvalues (k, n) of a loop (k, n, n), each followed from frequency to frequency; none of n = 1."""
    if L.shape[1] == 1:
        return L[:, 0, :0]
    found = np.linalg.eigvals(L)
    orders = [list(order) for order in permutations(range(L.shape[1]))]
    for before, now in pairwise(found):
        now[:] = now[min(orders, key=lambda order: float(np.abs(now[order] - before).sum()))]
    return np.asarray(found, dtype=np.complex128)


def scalar_loops(L: ComplexArray, together: ComplexArray) -> list[ComplexArray]:
    """The loops (k,) that have to keep margins: each channel of L (k, n, n), then its `loci`."""
    return [*(break_at(L, i) for i in range(L.shape[1])), *together.T]


def loop_margins(loop: System) -> list[Margins]:
    """Margins of each channel of a square loop, negative feedback, then those of all channels together."""
    w = frequencies(loop.tick_s)
    L = response(loop, w)
    stable = spectral_radius(closed_loop(loop)) < 1.0
    return [margins_of_response(w, one, stable) for one in scalar_loops(L, loci(L))]

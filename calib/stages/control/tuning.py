"""Gains chosen on the model: the loops for small motion and their margins, what is in reach, the search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from calib.core.arrays import BoolArray, ComplexArray, FloatArray, rms
from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import linearised, mass_matrix
from calib.stages.actuator.kinematics import angle, forward
from calib.stages.control import laws
from calib.stages.control.references import Reference
from calib.stages.control.section import ControllerCriterion

# ----------------------------------------------------------------------
# The loops for small motion about a rest: plant, pumps, delay, hold and controller in discrete time.
#
# At a rest the plant is `dynamics.linearised` with the slope of the pump's static map as its input,
#
#     x = (q, dq, z, F),   dF/dt = (g'(u0) u - F) / tau,
#
# held over a tick (zero-order hold, exact by the matrix exponential) and delayed by whole ticks. The limit
# on the falling rate is no part of it: it does not act on small motion. Controllers are (D.6). What the
# firmware makes of its sensors may be in between: the length from the camera, one latency late and
# low-passed, the angle as it is (the gyroscope carries its fast part).
#
# Everything here is a `System`, x' = A x + B u, y = C x + D u with a period; `response` gives its
# frequency response.


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


def pump_slope(model: laws.Model, q_m: FloatArray) -> FloatArray:
    """dg/du (2,) [N/PWM] of the static maps where they hold the lengths (2,); 0 outside their limits."""
    force = laws.holding_force(model.plant, q_m)
    pwm = laws.pwm_of_force(model, force)
    step = 1.0
    low, high = np.maximum(pwm - step, model.low_pwm), np.minimum(pwm + step, model.high_pwm)
    slope = (laws.force_of_pwm(model, high) - laws.force_of_pwm(model, low)) / (high - low)
    held = (force > 1e-9) & (force <= laws.force_of_pwm(model, np.full(2, model.high_pwm)))
    return np.asarray(np.where(held, slope, 0.0))


def rig_system(model: laws.Model, q_m: FloatArray) -> System:
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


_HAIR = 0.01
"""Of a tick, by which pictures may be later than whole ticks: the time offset is hardly known better."""


def firmware_sensing(model: laws.Model) -> System:
    """Lengths (2,) as the firmware sees them: their mean late and low-passed, their difference at once."""
    from scipy.signal import butter

    h = model.tick_s
    length = delay(math.ceil(model.latency_s / h - _HAIR), h)
    sections = model.lowpass or butter(1, _CUTOFF_HZ, fs=1.0 / h, output="sos")
    for b0, b1, b2, _, a1, a2 in sections:
        A, B = np.array([[-a1, -a2], [1.0, 0.0]]), np.array([[1.0], [0.0]])
        section = System(A, B, np.array([[b1 - b0 * a1, b2 - b0 * a2]]), np.array([[b0]]), h)
        length = series(length, section)
    apart = gain(np.array([[0.5, 0.5], [0.5, -0.5]]), h)
    together = gain(np.array([[1.0, 1.0], [1.0, -1.0]]), h)
    return series(series(apart, side_by_side(length, gain(np.eye(1), h))), together)


# ----------------------------------------------------------------------
# Gain, phase and delay margins of discrete loops, and the least distance from -1.
#
# A loop with several channels is broken at one of them with the others closed,
#
#     L_i = L_ii - L_io (I + L_oo)^-1 L_oi,
#
# o the others. What acts on all channels alike, as the supply of both pumps or softer springs, is another
# matter: with a factor s on all of them det(I + s L) is the product of 1 + s l over the eigenvalues l of L,
# so that each of these loci is a scalar loop as well (MacFarlane and Postlethwaite 1977). At the nominal
# rests 54 % more of both pumps are as much as 109 % more of one. Margins are read off the frequency response
# between zero and half the sampling rate:
#
#     gain margin    least factor, above or below 1, at which L passes -1: 1 / |L| where L is real and
# negative
#     phase margin   least angle between L and -1 where |L| = 1
#     delay margin   phase margin over frequency, least
#     Ms             largest |1 / (1 + L)|, the sensitivity
#
# Crossings are refined on a straight line between two frequencies. Whether the closed loop is stable at
# all is asked of its eigenvalues and not of these curves.


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


# ----------------------------------------------------------------------
# What the pumps can follow: reachable lengths, rates of inflation and deflation, and references.
#
# At rest the forces that hold q have to lie between zero and the pumps' greatest (`holding_force`); the
# lengths for which they do are the reachable set. In motion the forces are those of `moving_force`, and
# from tick to tick they can rise no faster than the lag with the pump at its limit, and fall no faster
# than the air leaves,
#
#     F_(k+1) <= G + (F_k - G) exp(-h / tau),    F_(k+1) >= F_k - h R(F_k)     (or the lag's own fall).
#
# `follow` takes the nearest forces that obey both and turns what is missing into lengths by the static
# stiffness. A reference is followed while less than a tolerance is missing. It starts on the reference:
# the way there from rest is not part of it, its time is told.
#
# Slowing down. Along the path q(s) the force is that of the rest there, and each piece ds needs
#
#     dt >= tau dF / (G - F)  rising,    dt >= -dF / R(F)  falling.
#
# `slowed` stretches the pieces that need it, rounds the corners that this leaves by a running mean, and
# tries again a little slower until `follow` agrees.

TOLERANCE_M = 2.5e-4
"""Lengths that may be missing: half of what a pixel of the rig's camera shows."""

CLOSE_M = 1e-3
"""Lengths that are brought in before a reference counts as out of reach: a pixel of the rig's camera."""

_SHARE = 0.9
"""Of the pumps' rates that a slowed reference uses at first."""
_PIECE_M = 2e-4
_JUMP_M = 2e-3
"""In a tick; no pump moves a bellows a tenth as far."""
_SPREAD_S = 0.15
_TRIES = 40
_NEWTON = 6
_LONGEST_TICKS = 432_000


def reachable(model: laws.Model, q_m: FloatArray) -> BoolArray:
    """Whether the pumps can hold the lengths (..., 2) [m], shape (...)."""
    F, q = laws.holding_force(model.plant, q_m), np.asarray(q_m)
    slack = 1e-9
    held = (-slack <= F) & (laws.largest_force_N(model) + slack >= F) & (q > 0.0)
    return np.asarray(held.all(axis=-1))


def longest_m(model: laws.Model) -> float:
    """Greatest length [m] at which both bellows can be held alike."""
    from scipy.optimize import brentq

    plant, most = model.plant, float(laws.largest_force_N(model).min())
    low, high = plant.rest_length_m, 4.0 * plant.rest_length_m

    def over(q: float) -> float:
        return float(laws.holding_force(plant, np.array([q, q]))[0]) - most

    return float(brentq(over, low, high)) if over(high) > 0.0 else high


def largest_angle(model: laws.Model, pump: int = 0) -> float:
    """Greatest angle [rad] that one pump alone can hold, to its side: below zero for the second."""
    low, high, most = 0.0, 1.5 * math.pi, float(laws.largest_force_N(model)[pump])
    side = 1.0 if pump == 0 else -1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        try:
            held = float(laws.holding_force(model.plant, laws.bent_rest(model, side * middle))[pump]) <= most
        except BadInputError:
            held = False
        low, high = (middle, high) if held else (low, middle)
    return side * low


_ALIKE = 0.01
"""Between the pumps' strengths or lags: less moves a margin by less than rounding gains does (`_slack`)."""


def unlike(model: laws.Model) -> bool:
    """Whether the pumps differ so much that each side counts by itself."""
    ratios = model.strength[1] / model.strength[0], model.pump.lag_ratio
    return any(abs(math.log(ratio)) > _ALIKE for ratio in ratios)


def approach_s(model: laws.Model, q_m: FloatArray) -> float:
    """Time [s] with the pumps at their limit until the forces that hold the lengths (2,) are there."""
    F = np.maximum(laws.holding_force(model.plant, q_m), 0.0)
    share = F / laws.largest_force_N(model)
    if np.any(share >= 1.0):
        return math.inf
    filled_s = -np.array(model.pump.lags_s) * np.log1p(-share)
    return float(filled_s.max()) + model.pump.delay_ticks * model.tick_s


@dataclass(frozen=True)
class Following:
    """How far the pumps can follow a reference.

    Attributes
    ----------
    possible : whether less than the tolerance is missing all the time.
    at_s : first time at which more is, None if never.
    reason : one sentence for that time, empty if never.
    missing_m : (n, 2) lengths that are missing at the ticks.
    wanted_N, given_N : (n, 2) forces that the reference needs and the nearest that the pumps can give.
    fastest_rise_N_per_s, fastest_fall_N_per_s : of the wanted forces, of either bellows.
    approach_s : time to get to its start from rest.
    """

    possible: bool
    at_s: float | None
    reason: str
    missing_m: FloatArray
    wanted_N: FloatArray
    given_N: FloatArray
    fastest_rise_N_per_s: float
    fastest_fall_N_per_s: float
    approach_s: float

    @property
    def missing_mm(self) -> float:
        """The most that is missing of either bellows."""
        return 1e3 * float(np.abs(self.missing_m).max())


def _fallen(model: laws.Model, force_N: FloatArray) -> FloatArray:
    """The least that forces (2,) can be a tick later, by what leaves and by the lag."""
    h, F = model.tick_s, force_N
    lag = F * np.exp(-h / np.array(model.pump.lags_s))
    return np.maximum(lag, F - h * laws.falling_rate(model, F))


def _nearest(model: laws.Model, wanted: FloatArray) -> FloatArray:
    h, most = model.tick_s, laws.largest_force_N(model)
    a = np.exp(-h / np.array(model.pump.lags_s))
    given = np.empty_like(wanted)
    given[0] = np.clip(wanted[0], 0.0, most)
    for k in range(1, len(wanted)):
        F = given[k - 1]
        given[k] = np.clip(wanted[k], np.minimum(_fallen(model, F), most), most + (F - most) * a)
    return given


def _reason(
    model: laws.Model, q: FloatArray, wanted: FloatArray, given: FloatArray, k: int, missing: FloatArray
) -> str:
    i = int(np.argmax(np.abs(missing[k])))
    jumps = np.abs(np.diff(q[max(k - 1, 0) : k + 3], axis=0))
    if float(jumps.max()) > _JUMP_M:
        j = int(np.argmax(jumps.max(axis=0)))
        return f"the reference of bellows {j + 1} jumps by {1e3 * jumps[:, j].max():.3g} mm within a tick"
    F, most = float(wanted[k, i]), float(laws.largest_force_N(model)[i])
    name = f"bellows {i + 1}"
    if most < F:
        return f"{name} needs {F:.3g} N to be that long, its pump gives at most {most:.3g} N"
    if F < 0.0:
        return f"{name} would have to be pulled together with {-F:.3g} N, pumps only push"
    early = max(k - 6, 0)
    rate = float(wanted[k, i] - wanted[early, i]) / ((k - early) * model.tick_s) if k else 0.0
    if missing[k, i] > 0.0:
        return f"{name} would have to inflate at {rate:.3g} N/s, which its pump's lag does not allow"
    fastest = float((given[k - 1] - _fallen(model, given[k - 1]))[i]) / model.tick_s
    return f"{name} would have to deflate at {-rate:.3g} N/s, its air leaves at {fastest:.3g} N/s"


def follow(model: laws.Model, q_m: FloatArray) -> Following:
    """How far the pumps can follow lengths (n, 2) [m] at the ticks, three at least."""
    wanted = laws.wanted_motion(model, q_m).force_N
    given, h = _nearest(model, wanted), model.tick_s
    short = wanted - given
    missing = np.zeros_like(short)
    for k in np.flatnonzero(np.any(short != 0.0, axis=1)):
        missing[k] = np.linalg.solve(laws.static_stiffness(model.plant, q_m[k]), short[k])
    bad = np.flatnonzero(np.max(np.abs(missing), axis=1) > TOLERANCE_M)
    rates = np.diff(wanted, axis=0) / h
    at = int(bad[0]) if len(bad) else None
    return Following(
        at is None,
        None if at is None else at * h,
        "" if at is None else _reason(model, np.asarray(q_m), wanted, given, at, missing),
        missing,
        wanted,
        given,
        max(float(rates.max()), 0.0),
        max(float(-rates.min()), 0.0),
        math.inf if at == 0 else approach_s(model, np.asarray(q_m)[0]),
    )


def brought_in(model: laws.Model, q_m: FloatArray) -> tuple[FloatArray, float]:
    """Lengths (n, 2) [m] with those just outside of the reachable set on its edge, and the longest way there.

    The edge is found by Newton's method on the forces that hold them, cut to what the pumps can give. Lengths
    that are farther than `CLOSE_M` from it stay as they are.
    """
    q = np.array(q_m, dtype=np.float64)
    moved = 0.0
    for k in np.flatnonzero(~reachable(model, q)):
        wanted = np.clip(laws.holding_force(model.plant, q[k]), 0.0, laws.largest_force_N(model))
        at = q[k].copy()
        for _ in range(_NEWTON):
            short = wanted - laws.holding_force(model.plant, at)
            at = at + np.linalg.solve(laws.static_stiffness(model.plant, at), short)
            if np.abs(at - q[k]).max() > 2.0 * CLOSE_M:
                break
        way = float(np.abs(at - q[k]).max())
        if way <= CLOSE_M:
            q[k], moved = at, max(moved, way)
    return q, moved


def _path(q: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Points (m, 2) no farther apart than a piece, and the time (m - 1,) of each of them."""
    steps = np.maximum(np.ceil(np.abs(np.diff(q, axis=0)).max(axis=1) / _PIECE_M).astype(int), 1)
    points, times = [q[:1]], []
    for a, b, n in zip(q[:-1], q[1:], steps, strict=True):
        s = np.arange(1, n + 1)[:, None] / n
        points.append(a + s * (b - a))
        times.append(np.full(n, h / n))
    return np.concatenate(points), np.concatenate(times)


def _least_times(model: laws.Model, points: FloatArray) -> FloatArray:
    """Least time (m - 1,) [s] of each piece between the points (m, 2) for forces at rest."""
    F = np.maximum(laws.holding_force(model.plant, points), 0.0)
    most = laws.largest_force_N(model)
    dF, middle = np.diff(F, axis=0), 0.5 * (F[1:] + F[:-1])
    up = np.array(model.pump.lags_s) * dF / np.maximum(most - middle, 1e-3 * most)
    down = -dF / np.maximum(laws.falling_rate(model, middle), 1e-9)
    return np.asarray(np.max(np.maximum(up, down), axis=1))


def slowed(model: laws.Model, q_m: FloatArray) -> tuple[FloatArray, float]:
    """Lengths (m, 2) [m] at the ticks along the same path, slow enough for the pumps, and how far it moved.

    Jumps become the fastest way along the straight line between their ends. Lengths that lie outside of the
    reachable set by less than `CLOSE_M`, as those of a recorded run with its noise, are brought in first.
    Raises `BadInputError` for a path that leaves the set by more, which no slowness brings back, and one that
    would take longer than two hours.
    """
    h = model.tick_s
    q, moved = brought_in(model, q_m)
    points, times = _path(q, h)
    outside = np.flatnonzero(~reachable(model, points))
    if len(outside):
        q1, q2 = (1e3 * points[outside[0]]).tolist()
        raise BadInputError(
            f"reference: lengths of {q1:.2f} and {q2:.2f} mm cannot be held by the pumps at any speed, "
            "expected a path inside the reachable set"
        )
    least = _least_times(model, points)
    for attempt in range(_TRIES):
        need = np.maximum(times, least / _SHARE * 1.06**attempt)
        t = np.concatenate([[0.0], np.cumsum(need)])
        count = math.ceil(t[-1] / h) + 1
        if count > _LONGEST_TICKS:
            break
        ticks = h * np.arange(max(count, 3))
        slow = np.stack([np.interp(ticks, t, points[:, i]) for i in range(2)], axis=1)
        slow = _rounded(slow, h, 1.0 + attempt * 0.5)
        if follow(model, slow).possible:
            return slow, moved
    raise BadInputError("reference: no speed was found at which the pumps follow it")


def _rounded(q: FloatArray, h: float, wide: float) -> FloatArray:
    """Lengths (n, 2) without corners in time: a running mean that keeps both ends."""
    half = max(round(0.5 * wide * _SPREAD_S / h), 1)
    padded = np.concatenate([np.tile(q[:1], (2 * half, 1)), q, np.tile(q[-1:], (2 * half, 1))])
    window = np.ones(2 * half + 1) / (2 * half + 1)
    return np.stack([np.convolve(padded[:, i], window, mode="valid") for i in range(2)], axis=1)


# ----------------------------------------------------------------------
# Figures of a controlled motion: errors, overshoot, settling, saturation.
#
# All take evenly sampled truth, (n, ...), at the ticks.

_BAND = 0.02


@dataclass(frozen=True)
class Tracking:
    """How well a reference was followed.

    Attributes
    ----------
    rms_mm : (q1, q2). head_rms_mm : of the head's place. angle_rms_rad, largest_mm, largest_rad.
    rms_from_start_mm : (q1, q2) with the way from rest to the reference.
    rise_s, reach_s : time to 95 % of the first step and to all of it; None where there is none or never.
    overshoot_rad : beyond the step's end in its direction. settling_s : into 2 % of the step for good.
    jump_overshoot_rad, jump_settling_s : the same after the jump, 2 % of it.
    saturation : share of the ticks in which a command is at a limit, per pump.
    changes_pwm : mean change of a command from tick to tick.
    """

    rms_mm: tuple[float, float]
    head_rms_mm: float
    angle_rms_rad: float
    largest_mm: float
    largest_rad: float
    rms_from_start_mm: tuple[float, float]
    rise_s: float | None
    reach_s: float | None
    overshoot_rad: float | None
    settling_s: float | None
    jump_overshoot_rad: float | None
    jump_settling_s: float | None
    saturation: tuple[float, float]
    changes_pwm: float


def saturation_share(pwm: FloatArray, low: float, high: float) -> tuple[float, float]:
    """Share of the ticks in which each of two commands (n, 2) is at a limit."""
    at = ((pwm <= low) | (pwm >= high)).mean(axis=0)
    return float(at[0]), float(at[1])


def settling_s(tick_s: float, error: FloatArray, band: float) -> float | None:
    """Time after which errors (n,) stay within a band for good; None when the last one is outside."""
    outside = np.flatnonzero(np.abs(error) > band)
    last = int(outside[-1]) + 1 if len(outside) else 0
    return last * tick_s if last < len(error) else None


def _first(tick_s: float, hit: BoolArray) -> float | None:
    found = np.flatnonzero(hit)
    return float(found[0]) * tick_s if len(found) else None


def _pair(error: FloatArray) -> tuple[float, float]:
    return rms(error[:, 0]), rms(error[:, 1])


def _step(tick_s: float, phi: FloatArray, before: float, wanted: float) -> tuple[float, float | None]:
    """Overshoot [rad] of angles (n,) after a step between two, and when they settle."""
    over = float(np.max(np.sign(wanted - before) * (phi - wanted)))
    return max(over, 0.0), settling_s(tick_s, phi - wanted, _BAND * abs(wanted - before))


def tracking(
    reference: Reference, q_m: FloatArray, pwm: FloatArray, bellows_radius_m: float, low: float, high: float
) -> Tracking:
    """Figures of true lengths (n, 2) [m] and commands (n, 2) against a reference of n ticks.

    Of a reference given as an angle the lengths are free, and their errors are NaN.
    """
    h, t = reference.tick_s, reference.t_s
    phi = angle(q_m, bellows_radius_m)
    judged = t >= reference.judged_from_s - 1e-9
    if not judged.any():
        judged[:] = True
    free = reference.kind == "angle"
    wanted_m = np.full_like(q_m, np.nan) if free else reference.q_m
    error = 1e3 * (wanted_m - q_m)
    turned = reference.phi_rad - phi
    head = forward(q_m, bellows_radius_m)[:, :2] - forward(wanted_m, bellows_radius_m)[:, :2]
    rise = reach = over = settle = jump_over = jump_settle = None
    if free and len(np.unique(reference.phi_rad)) <= 2 and reference.phi_rad[0] != 0.0:
        jump = len(phi) if reference.jump_s is None else round(reference.jump_s / h)
        wanted, first = float(reference.phi_rad[0]), phi[:jump]
        along = np.sign(wanted) * first
        rise, reach = (_first(h, along >= share * abs(wanted)) for share in (0.95, 1.0))
        over, settle = _step(h, first, 0.0, wanted)
        if jump < len(phi):
            jump_over, jump_settle = _step(h, phi[jump:], wanted, float(reference.phi_rad[-1]))
    return Tracking(
        _pair(error[judged]),
        rms(1e3 * np.linalg.norm(head[judged], axis=1)),
        rms(turned[judged]),
        float(np.abs(error[judged]).max()),
        float(np.abs(turned[judged]).max()),
        _pair(error),
        rise,
        reach,
        over,
        settle,
        jump_over,
        jump_settle,
        saturation_share(pwm, low, high),
        float(np.abs(np.diff(pwm, axis=0)).mean()) if len(pwm) > 1 else 0.0,
    )


# ----------------------------------------------------------------------
# Gains from the model: the strongest controller whose margins hold at every operating point.
#
# Orientation, PID on one pump (4.1), (4.4). Of all gains with
#
#     gain margin >= GM,  phase margin >= PM,  Ms <= M
#
# at every operating point, the one with the largest Ki: after a step of an unknown force the integral of
# the error is proportional to 1 / Ki, so this is the fastest recovery (Astrom and Hagglund's criterion).
#
# Position, PD on both bellows beside a feed-forward (4.5), (4.8): the largest Kp under the same margins,
# since what the feed-forward leaves is divided by 1 + Kp times the slope. The camera's latency and the
# firmware's low-pass are in the loop.
#
# The ratios Ki / Kp and Kd / Kp come from a grid; for each the largest gain is found by bisection on the
# frequency responses, which are computed once, and the winner is checked by eigenvalues.

_INTEGRAL_S = np.concatenate([np.geomspace(0.01, 0.1, 6), np.geomspace(0.15, 4.0, 10)])
"""Behind pumps that fill faster than the head swings the gain at its resonance is the limit, and an integral
far stronger than the gain is what stays below."""
_LEAST = 1e-5
"""Of the largest gain: angles are no worse held without a controller."""
_DERIVATIVE_S = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2])
_BISECTIONS = 16


@dataclass(frozen=True)
class Point:
    """Margins at an operating point, the least of its channels and of all together."""

    q_m: tuple[float, float]
    margins: Margins


@dataclass(frozen=True)
class Tuned:
    """Gains and their margins at every operating point."""

    pid: laws.Pid
    points: tuple[Point, ...]


def operating_angles(model: laws.Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 15, 40, 65 and 90 % of the greatest angle, one pump alone.

    To both sides where the pumps are unlike.
    """
    most = [largest_angle(model, pump) for pump in range(1 + unlike(model))]
    rests = (laws.bent_rest(model, share * one) for one in most for share in (0.15, 0.4, 0.65, 0.9))
    return tuple((float(q[0]), float(q[1])) for q in rests)


def operating_lengths(model: laws.Model) -> tuple[tuple[float, float], ...]:
    """Rests (q1, q2) [m] at 10 to 95 % of the greatest elongation, and two that are bent.

    These to both sides where the pumps are unlike.
    """
    rest = model.plant.rest_length_m
    span = longest_m(model) - rest
    found = [(rest + s * span, rest + s * span) for s in (0.1, 0.35, 0.65, 0.95)]
    bent = [(rest + a * span, rest + b * span) for a, b in ((0.75, 0.25), (0.9, 0.5))]
    found += bent + [(b, a) for a, b in bent if unlike(model)]
    return tuple(q for q in found if bool(reachable(model, np.array(q))))


def orientation_loop(model: laws.Model, pid: laws.Pid, q_m: tuple[float, float]) -> System:
    """Loop of (4.1) about a rest: error of the angle, both controllers, rig, angle."""
    return series(pid_system(pid), _angle_rig(model, q_m))


def _angle_rig(model: laws.Model, q_m: tuple[float, float]) -> System:
    half, h = 0.5 / model.plant.bellows_radius_m, model.tick_s
    rig = rig_system(model, np.array(q_m))
    return series(gain(np.array([[1.0], [-1.0]]), h), series(rig, gain(np.array([[half, -half]]), h)))


def position_loop(model: laws.Model, pid: laws.Pid, q_m: tuple[float, float]) -> System:
    """Loop of (4.5) about a rest: errors of the lengths, both controllers, rig, lengths as seen."""
    return series(both_channels(pid), _position_rig(model, q_m))


def both_channels(pid: laws.Pid) -> System:
    """A controller for each bellows."""
    return side_by_side(pid_system(pid), pid_system(pid))


def _position_rig(model: laws.Model, q_m: tuple[float, float]) -> System:
    return series(rig_system(model, np.array(q_m)), firmware_sensing(model))


def holds(criterion: ControllerCriterion, margins: Margins) -> bool:
    """Whether margins satisfy the criterion; stability is part of it."""
    return (
        margins.stable
        and margins.gain >= criterion.gain_margin
        and margins.gain_down <= 1.0 / criterion.gain_margin
        and margins.phase_rad >= criterion.phase_margin_rad
        and margins.sensitivity <= criterion.sensitivity
    )


def _worst(margins: Sequence[Margins]) -> Margins:
    return Margins(
        all(m.stable for m in margins),
        min(m.gain for m in margins),
        max(m.gain_down for m in margins),
        min(m.phase_rad for m in margins),
        min(m.delay_s for m in margins),
        max(m.crossover_hz for m in margins),
        max(m.sensitivity for m in margins),
    )


def _strongest(
    criterion: ControllerCriterion,
    shape: ComplexArray,
    rigs: Sequence[tuple[ComplexArray, ComplexArray]],
    omega: FloatArray,
    most: float,
) -> float:
    """Largest factor on a controller's response (k,) that keeps the margins at rigs; 0 if none.

    `rigs` are responses (k, n, n), each with its loci (k, n).
    """

    def good(factor: float) -> bool:
        C = factor * shape
        return all(
            holds(criterion, margins_of_response(omega, one, True))
            for rig, together in rigs
            for one in scalar_loops(C[:, None, None] * rig, C[:, None] * together)
        )

    low, high = _LEAST * most, most
    if not good(low):
        return 0.0
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _tuning_rounded(value: float) -> float:
    """Down to two significant digits: nobody types more, and the margins hold."""
    if value == 0.0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 1)
    return float(f"{math.floor(value / unit + 1e-9) * unit:.12g}")


def _searched(
    model: laws.Model,
    criterion: ControllerCriterion,
    at: Sequence[tuple[float, float]],
    rigs: Sequence[System],
    controllers: Callable[[laws.Pid], System],
    integrals_s: Sequence[float],
    most: float,
    merit: Callable[[laws.Pid], float],
) -> Tuned:
    omega = frequencies(model.tick_s, 400)
    seen = [(L, loci(L)) for L in (response(rig, omega) for rig in rigs)]
    best: list[laws.Pid] = []
    for Ti in integrals_s:
        for Td in _DERIVATIVE_S.tolist():
            unit = laws.Pid(1.0, 0.0 if math.isinf(Ti) else 1.0 / Ti, Td, tick_s=model.tick_s)
            Kp = _strongest(criterion, response(pid_system(unit), omega)[:, 0, 0], seen, omega, most)
            if Kp > 0.0:
                Kp = _tuning_rounded(Kp)
                gains = (_tuning_rounded(Kp * unit.Ki), _tuning_rounded(Kp * Td))
                best.append(laws.Pid(Kp, *gains, tick_s=model.tick_s))
    for pid in sorted(best, key=merit, reverse=True):
        worst = [_worst(loop_margins(series(controllers(pid), rig))) for rig in rigs]
        if all(holds(_slack(criterion), one) for one in worst):
            return Tuned(pid, tuple(map(Point, at, worst)))
    raise BadInputError(_hopeless(criterion, at, rigs))


def _hopeless(
    criterion: ControllerCriterion, at: Sequence[tuple[float, float]], rigs: Sequence[System]
) -> str:
    """Why not even weak gains keep margins."""
    for q_m, rig in zip(at, rigs, strict=True):
        if (radius := spectral_radius(rig)) >= 1.0:
            q1, q2 = (1e3 * q for q in q_m)
            grows_s = rig.tick_s / max(math.log(radius), 1e-9)
            return (
                f"controller: at lengths of {q1:.1f} and {q2:.1f} mm the head does not come to rest by "
                f"itself but goes away, 2.7 times as far in {grows_s:.2g} s, expected an actuator that does; "
                "look at mass_kg, gravity_mps2 and the creep of the actuator in rig.yaml"
            )
    phase = f"{math.degrees(criterion.phase_margin_rad):.3g} deg"
    return (
        f"controller: no gains reach a gain margin of {criterion.gain_margin:g}, a phase margin of {phase} "
        f"and a sensitivity of {criterion.sensitivity:g} at every operating point, expected a lower demand"
    )


def _slack(criterion: ControllerCriterion) -> ControllerCriterion:
    """The criterion less what rounding the gains to two digits may cost."""
    return ControllerCriterion(
        gain_margin=1.0 + 0.98 * (criterion.gain_margin - 1.0),
        phase_margin_rad=0.98 * criterion.phase_margin_rad,
        sensitivity=1.02 * criterion.sensitivity,
    )


def tune_orientation(model: laws.Model, criterion: ControllerCriterion) -> Tuned:
    """PID of the angle with the largest Ki [PWM/rad/s].

    Raises `BadInputError` where no gains hold the margins.
    """
    at = operating_angles(model)
    rigs = [_angle_rig(model, q) for q in at]
    return _searched(model, criterion, at, rigs, pid_system, _INTEGRAL_S.tolist(), 2e4, lambda pid: pid.Ki)


def tune_position(model: laws.Model, criterion: ControllerCriterion) -> Tuned:
    """PD of the lengths with the largest Kp [PWM/m], the firmware's filters in the loop.

    Raises `BadInputError` where no gains hold the margins.
    """
    at = operating_lengths(model)
    rigs = [_position_rig(model, q) for q in at]
    return _searched(model, criterion, at, rigs, both_channels, [math.inf], 4e5, lambda pid: pid.Kp)

"""What the pumps can follow: reachable lengths, rates of inflation and deflation, and references.

At rest the forces that hold q have to lie between zero and the pumps' greatest (`holding_force`); the
lengths for which they do are the reachable set. In motion the forces are those of `moving_force`, and
from tick to tick they can rise no faster than the lag with the pump at its limit, and fall no faster
than the air leaves,

    F_(k+1) <= G + (F_k - G) exp(-h / tau),    F_(k+1) >= F_k - h R(F_k)     (or the lag's own fall).

`follow` takes the nearest forces that obey both and turns what is missing into lengths by the static
stiffness. A reference is followed while less than a tolerance is missing. It starts on the reference:
the way there from rest is not part of it, its time is told.

Slowing down. Along the path q(s) the force is that of the rest there, and each piece ds needs

    dt >= tau dF / (G - F)  rising,    dt >= -dF / R(F)  falling.

`slowed` stretches the pieces that need it, rounds the corners that this leaves by a running mean, and
tries again a little slower until `follow` agrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray
from calib.core.errors import BadInputError
from calib.stages.control import laws
from calib.stages.control.rig_model import (
    Model,
    bent_rest,
    falling_rate,
    holding_force,
    largest_force_N,
    static_stiffness,
)

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


def reachable(model: Model, q_m: FloatArray) -> BoolArray:
    """Whether the pumps can hold the lengths (..., 2) [m], shape (...)."""
    F, q = holding_force(model.plant, q_m), np.asarray(q_m)
    slack = 1e-9
    held = (-slack <= F) & (largest_force_N(model) + slack >= F) & (q > 0.0)
    return np.asarray(held.all(axis=-1))


def longest_m(model: Model) -> float:
    """Greatest length [m] at which both bellows can be held alike."""
    from scipy.optimize import brentq

    plant, most = model.plant, float(largest_force_N(model).min())
    low, high = plant.rest_length_m, 4.0 * plant.rest_length_m

    def over(q: float) -> float:
        return float(holding_force(plant, np.array([q, q]))[0]) - most

    return float(brentq(over, low, high)) if over(high) > 0.0 else high


def largest_angle(model: Model, pump: int = 0) -> float:
    """Greatest angle [rad] that one pump alone can hold, to its side: below zero for the second."""
    low, high, most = 0.0, 1.5 * math.pi, float(largest_force_N(model)[pump])
    side = 1.0 if pump == 0 else -1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        try:
            held = float(holding_force(model.plant, bent_rest(model, side * middle))[pump]) <= most
        except BadInputError:
            held = False
        low, high = (middle, high) if held else (low, middle)
    return side * low


_ALIKE = 0.01
"""Between the pumps' strengths or lags: less moves a margin by less than rounding gains does (`_slack`)."""


def unlike(model: Model) -> bool:
    """Whether the pumps differ so much that each side counts by itself."""
    ratios = model.strength[1] / model.strength[0], model.pump.lag_ratio
    return any(abs(math.log(ratio)) > _ALIKE for ratio in ratios)


def approach_s(model: Model, q_m: FloatArray) -> float:
    """Time [s] with the pumps at their limit until the forces that hold the lengths (2,) are there."""
    F = np.maximum(holding_force(model.plant, q_m), 0.0)
    share = F / largest_force_N(model)
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


def _fallen(model: Model, force_N: FloatArray) -> FloatArray:
    """The least that forces (2,) can be a tick later, by what leaves and by the lag."""
    h, F = model.tick_s, force_N
    lag = F * np.exp(-h / np.array(model.pump.lags_s))
    return np.maximum(lag, F - h * falling_rate(model, F))


def _nearest(model: Model, wanted: FloatArray) -> FloatArray:
    h, most = model.tick_s, largest_force_N(model)
    a = np.exp(-h / np.array(model.pump.lags_s))
    given = np.empty_like(wanted)
    given[0] = np.clip(wanted[0], 0.0, most)
    for k in range(1, len(wanted)):
        F = given[k - 1]
        given[k] = np.clip(wanted[k], np.minimum(_fallen(model, F), most), most + (F - most) * a)
    return given


def _reason(
    model: Model, q: FloatArray, wanted: FloatArray, given: FloatArray, k: int, missing: FloatArray
) -> str:
    i = int(np.argmax(np.abs(missing[k])))
    jumps = np.abs(np.diff(q[max(k - 1, 0) : k + 3], axis=0))
    if float(jumps.max()) > _JUMP_M:
        j = int(np.argmax(jumps.max(axis=0)))
        return f"the reference of bellows {j + 1} jumps by {1e3 * jumps[:, j].max():.3g} mm within a tick"
    F, most = float(wanted[k, i]), float(largest_force_N(model)[i])
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


def follow(model: Model, q_m: FloatArray) -> Following:
    """How far the pumps can follow lengths (n, 2) [m] at the ticks, three at least."""
    wanted = laws.wanted_motion(model, q_m).force_N
    given, h = _nearest(model, wanted), model.tick_s
    short = wanted - given
    missing = np.zeros_like(short)
    for k in np.flatnonzero(np.any(short != 0.0, axis=1)):
        missing[k] = np.linalg.solve(static_stiffness(model.plant, q_m[k]), short[k])
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


def move_into_reach(model: Model, q_m: FloatArray) -> tuple[FloatArray, float]:
    """Lengths (n, 2) [m] with those just outside of the reachable set on its edge, and the longest way there.

    The edge is found by Newton's method on the forces that hold them, cut to what the pumps can give. Lengths
    that are farther than `CLOSE_M` from it stay as they are.
    """
    q = np.array(q_m, dtype=np.float64)
    moved = 0.0
    for k in np.flatnonzero(~reachable(model, q)):
        wanted = np.clip(holding_force(model.plant, q[k]), 0.0, largest_force_N(model))
        at = q[k].copy()
        for _ in range(_NEWTON):
            short = wanted - holding_force(model.plant, at)
            at = at + np.linalg.solve(static_stiffness(model.plant, at), short)
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


def _least_times(model: Model, points: FloatArray) -> FloatArray:
    """Least time (m - 1,) [s] of each piece between the points (m, 2) for forces at rest."""
    F = np.maximum(holding_force(model.plant, points), 0.0)
    most = largest_force_N(model)
    dF, middle = np.diff(F, axis=0), 0.5 * (F[1:] + F[:-1])
    up = np.array(model.pump.lags_s) * dF / np.maximum(most - middle, 1e-3 * most)
    down = -dF / np.maximum(falling_rate(model, middle), 1e-9)
    return np.asarray(np.max(np.maximum(up, down), axis=1))


def slowed(model: Model, q_m: FloatArray) -> tuple[FloatArray, float]:
    """Lengths (m, 2) [m] at the ticks along the same path, slow enough for the pumps, and how far it moved.

    Jumps become the fastest way along the straight line between their ends. Lengths that lie outside of the
    reachable set by less than `CLOSE_M`, as those of a recorded run with its noise, are brought in first.
    Raises `BadInputError` for a path that leaves the set by more, which no slowness brings back, and one that
    would take longer than two hours.
    """
    h = model.tick_s
    q, moved = move_into_reach(model, q_m)
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

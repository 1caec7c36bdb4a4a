"""Which views and points a camera is calibrated from: those that agree with the others.

Each view is asked what the others say without it. About a fit, view i costs (see `checks.evidence`)

    c_i(d) = c_i + 2 b_i' d + d' S_i d

when the camera moves by d and the view's pose follows. The others alone put the camera at

    d_-i = -(sum_j S_j)^-1 sum_j b_j,   j over the core without i,

one step that a refit without the view confirms. There the view's own wish is the score
beta_i = b_i + S_i d_-i. With A = sum_j S_j = L L' and L^-1 S_i L^-T = Q diag(lambda) Q', its components
y = Q' L^-1 beta_i are independent, of variance sigma_i^2 lambda + phi^2 sigma^2 lambda^2: noise of the
view, and of the others. So

    T_i = sum_k y_k^2 / (lambda_k (r_i^2 + lambda_k) phi^2 sigma^2)

is chi-squared with as many degrees of freedom as the view tells components about. r_i = sigma_i / sigma is
the view's noise over a typical view's, from what is left when the view has a camera of its own, and phi^2 is
the median of the core's T_i over its expectation: real views disagree more than white noise of their
corners would make them, and what is normal among them makes no outlier.

A view leaves where it is odd and where that matters: not one of the two alone. A single view far off moves
the fit towards itself and makes others look odd. So the first core are the six tenths of the views that
agree best among themselves (concentration steps, as for least trimmed squares); the camera is then fitted
to those that do not leave, and all views are asked again until nothing changes. A view may return.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, evenly
from calib.core.words import several
from calib.solve.chance import tail_of_f
from calib.solve.information import scaled_inverse
from calib.stages.camera import checks
from calib.stages.camera.bundle import Calibration, joint_jacobian, minimise, poses_with_camera, refitted
from calib.stages.camera.model import Block, LeftOut, Observations, project, scale_of
from calib.stages.camera.verdict import Limits, far_points, quiet_rms

_LEAST_VIEWS = 5
"""Views below which none can be told to disagree with the others."""
_CORE_SHARE = 0.6
_CONCENTRATION_STEPS = 8
_ODD_STARTS = 6
_SCALE = 1.6
"""Scatter of all views over that of a core of them from which on the core is believed. Views of one camera
reach it in one set of fifty, half of the sets with a skew that the model lacks."""
_ROUNDS = 8
_CHANCE = 1e-3
"""Probability of T_i by chance below which a view is odd."""
_ODD_NOISE, _ODD_NOISE_PX = 3.0, 0.03
"""Noise of a view over a typical view's above which it is odd, and in pixels at up to 1000 pixels' width:
corners of a small or steep board are less sure than those of a large one, in pictures without a flaw."""
_MOVED_SIGMAS = 1.0
_MOVED_PX = 0.02
"""A view matters that moves a parameter, and a direction in the picture, by more than this; pixels at up to
1000 pixels' width."""
_NEAR_FLOOR_PX = 0.06
"""How far from where the others put it a point is at least that is to blame for its view, in pixels at up to
1000 pixels' width."""
_FEW_POINTS = 0.1
"""Most of a view's points, as a share, that may be to blame for it."""
_MEDIAN_CHI2 = 0.87
"""Median of chi-squared over its degrees of freedom, for four to eight of them."""


@dataclass(frozen=True)
class Agreement:
    """How each of N views agrees with a core of them.

    Attributes
    ----------
    shift : (N, G) by which the free intrinsics move when the view is left out, or joins the core.
    moved : (N,) largest of these in standard deviations of the core's, overdispersion included.
    moved_px : (N,) farthest that a direction among those seen moves in the picture.
    chance : (N,) probability of so much disagreement by chance.
    noise_px, noise : (N,) standard deviation of a coordinate in the view with a camera of its own, and
        over a typical view's.
    rms_px : (N,) of the view seen by the camera of the fit.
    misfit : (N,) the same over that of the quieter half of the core.
    sigma : (G,) standard deviation of the free intrinsics from the core.
    scale_px : standard deviation phi sigma by which the core's views disagree.
    """

    shift: FloatArray
    moved: FloatArray
    moved_px: FloatArray
    chance: FloatArray
    noise_px: FloatArray
    noise: FloatArray
    rms_px: FloatArray
    misfit: FloatArray
    sigma: FloatArray
    scale_px: float

    def leaving(self, scale: float) -> BoolArray:
        """Views that are odd, and matter, in a picture with this `scale_of`."""
        noisy = (self.noise > _ODD_NOISE) & (self.noise_px > _ODD_NOISE_PX * scale)
        odd = (self.chance < _CHANCE) | noisy
        moves = (self.moved > _MOVED_SIGMAS) & (self.moved_px > _MOVED_PX * scale)
        misfits = (self.misfit > Limits.view_bad) & (self.rms_px > Limits.point_floor_px)
        return np.asarray(odd & moves | misfits)


@dataclass(frozen=True)
class _Disagreement:
    """T_i over its degrees of freedom and what else follows from it, for N views and a core."""

    S_core: FloatArray
    d: FloatArray
    score: FloatArray
    freedom: IntArray
    ratio: FloatArray
    variance: FloatArray
    typical: float
    phi2: float

    def chance(self, core: BoolArray) -> FloatArray:
        """Probability (N,) of so large a T_i by chance."""
        # The median of few views is uncertain; about a third of their components fix it.
        second = max(float(self.freedom[core].sum()) / 3, 2.0)
        found = tail_of_f(np.maximum(self.freedom, 1), second, self.ratio)
        return np.where(self.freedom > 0, found, 1.0)


def _scaled(found: checks.Evidence, whole: FloatArray) -> tuple[checks.Evidence, FloatArray]:
    """The evidence in units in which the diagonal of `whole` (G, G) is one, and these units (G,)."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    return replace(found, S=found.S * unit[:, None] * unit, b=found.b * unit), unit


def _disagreement(found: checks.Evidence, core: BoolArray) -> _Disagreement:
    """T_i of every view against the core without it, from `_scaled` evidence."""
    S, b = found.S, found.b
    G = b.shape[1]
    inside = core[:, None].astype(np.float64)
    S_core, b_core = S[core].sum(axis=0), b[core].sum(axis=0)
    # A direction that the core leaves free is held by next to nothing, so that the view decides it alone.
    A = S_core - inside[..., None] * S + 1e-9 * np.trace(S_core) / G * np.eye(G)
    d = -np.linalg.solve(A, (b_core - inside * b)[..., None])[..., 0]
    score = b + np.einsum("ngh,nh->ng", S, d)
    values, vectors = np.linalg.eigh(A)
    root = vectors / np.sqrt(np.maximum(values, 1e-15 * values[:, -1:]))[:, None]
    told, y2, counts = checks.components(S, score, root)
    freedom = counts.sum(axis=1)
    there = found.cost + 2 * (b * d).sum(axis=1) + np.einsum("ng,ngh,nh->n", d, S, d)
    own = there - (y2 / told).sum(axis=1)
    variance = np.maximum(own, 0.0) / np.maximum(found.measured - 6 - freedom, 1)
    typical = max(float(np.median(variance[core])), 1e-12)
    white = (y2 / (told * (1 + told))).sum(axis=1) / np.maximum(freedom, 1) / typical
    phi2 = max(float(np.median(white[core])) / _MEDIAN_CHI2, 1.0)
    r2 = np.clip(variance / typical, 1.0, _ODD_NOISE**2)[:, None]
    T = (y2 / (told * (r2 + told))).sum(axis=1) / (typical * phi2)
    return _Disagreement(S_core, d, score, freedom, T / np.maximum(freedom, 1), variance, typical, phi2)


def _first_core(found: checks.Evidence) -> BoolArray:
    """The six tenths of the views that fit one camera best, (N,).

    Concentration starts from all views and from those without one or two that would gain most by a camera of
    their own: a single view that tells much draws the fit so far that the others look odd.
    """
    S, b, N = found.S, found.b, len(found.b)
    size = min(max(int(np.ceil(_CORE_SHARE * N)), 4), N)
    every = np.ones(N, dtype=np.bool_)
    whole = S.sum(axis=0)
    others = whole - S + 1e-9 * np.trace(whole) / len(whole) * np.eye(len(whole))
    gains = np.einsum("ng,ng->n", b, np.linalg.solve(others, b[..., None])[..., 0])
    odd = np.argsort(-gains)[:_ODD_STARTS]
    starts = [every, *(every & (np.arange(N) != i) for i in odd)]
    starts += [every & ~np.isin(np.arange(N), pair) for pair in combinations(odd, 2)]
    best, least = every, np.inf
    for core in starts:
        for _ in range(_CONCENTRATION_STEPS):
            order = np.argsort(_disagreement(found, core).ratio, kind="stable")
            new = np.isin(np.arange(N), order[:size])
            if np.array_equal(new, core):
                break
            core = new
        some = found.of(core)
        there = some.cost_at(some.solved().step).sum() / some.measured.sum()
        if there < least:
            best, least = core, there
    return best


def agreement(calibration: Calibration, core: BoolArray | None = None) -> Agreement:
    """How the views agree with the core (N,), by default with the views that agree best among themselves.

    Parameters
    ----------
    calibration : camera of the core, with the poses of all views; the target rigid, without robust loss.
    """
    found = checks.evidence(calibration)
    found, unit = _scaled(found, found.S.sum(axis=0))
    if core is None:
        core = _first_core(found)
    one = _disagreement(found, core)
    cov = scaled_inverse(one.S_core) * one.typical * one.phi2
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    # Leaving the core moves the camera from the core's solution to d; joining it, by one step to the view.
    centre = found.of(core).solved().step
    joined = np.linalg.solve(one.S_core + found.S + 1e-12 * np.eye(len(sigma)), one.score[..., None])[..., 0]
    shift = np.where(core[:, None], one.d - centre, joined)
    rms = np.sqrt(found.cost / np.maximum(found.measured / 2, 1))
    noise = np.sqrt(one.variance)
    return Agreement(
        shift=shift * unit,
        moved=np.max(np.abs(shift) / np.maximum(sigma, 1e-300), axis=1, initial=0.0),
        moved_px=_moved_px(calibration, shift * unit),
        chance=one.chance(core),
        noise_px=noise,
        noise=noise / np.sqrt(one.typical),
        rms_px=rms,
        misfit=rms / max(quiet_rms(rms[core]), 1e-12),
        sigma=sigma * unit,
        scale_px=float(np.sqrt(one.typical * one.phi2)),
    )


def _moved_px(calibration: Calibration, shift: FloatArray) -> FloatArray:
    """Farthest that changes (N, G) of the intrinsics move one of the directions that were seen, (N,)."""
    used = checks.points_C(calibration)
    some = used[:: max(1, len(used) // 300)]
    J = joint_jacobian(calibration, some)[:, :, : shift.shape[1]]
    return np.asarray(np.linalg.norm(np.einsum("mcg,ng->nmc", J, shift), axis=2).max(axis=1))


# ----------------------------------------------------------------------
# Views that were turned or mirrored after the camera took them.
#
# A picture that is turned by half a turn is as large as before, and a board in it is found. It is a view by
# the camera rho(theta) whose principal point is mirrored at the picture's middle and whose p1 and p2 have
# the other sign. With rho(theta_0 + d) = theta_0 + F d + g, F = diag(+-1), such a view costs c_i(F d + g).
# Which views these are and the camera that all share follow in turn from each other, from several starts.

_TURNS = {
    "turned by half a turn": ("cx_px", "cy_px", "p1", "p2"),
    "mirrored left to right": ("cx_px", "skew_px", "p2"),
    "mirrored top to bottom": ("cy_px", "skew_px", "p1"),
}
"""Intrinsics that change: the centre to the other side of the picture's middle, the others their sign."""
_LEAST_TURNED = 8
"""Views below which none can be told to be turned."""
_TURN_SIGMAS = 4.0
"""Standard deviations, the views' overdispersion included, by which a view is turned: in three sets as taken
the most is 2.6, where views are turned 5 to 55."""
_TURN_ALSO = 2.0
"""The same for a view beside one that is."""
_TURN_EXCESS = 0.25
"""Disagreement of a turned view with the others over that of the view as it is, at most."""
_TURN_PX = 0.3
"""Change of directions by the turn below which it does not matter; pixels at up to 1000 pixels' width."""
_TURN_WORSE = 1.05
"""Cost of a reading with views turned over that without the one view whose leaving lowers it most, from which
on that view is odd and none was turned: .27 to .99 where views are turned, 1.26 beside another camera's."""
_TURN_STARTS, _TURN_STEPS = 8, 10


def turned_views(calibration: Calibration) -> list[LeftOut]:
    """Views that agree with the others once they are turned or mirrored, a minority.

    Parameters
    ----------
    calibration : of all views, the target rigid, without robust loss.
    """
    N = calibration.observations.views
    if N < _LEAST_TURNED:
        return []
    try:
        found = checks.evidence(calibration)
    except ValueError:
        return []
    best: tuple[float, str, BoolArray, FloatArray] | None = None
    most = _TURN_WORSE * _without_one(found) * float(found.measured.sum())
    for how, names in _TURNS.items():
        flip, offset = _reflection(calibration, names)
        b = flip * (found.b + found.S @ offset)
        other = replace(found, S=flip[:, None] * found.S * flip, b=b, cost=found.cost_at(offset))
        turned, d, total = _parted(found, other)
        if not turned.any() or total > most:
            continue
        there, read = (found.cost_at(d), other.cost_at(d)), _read(found, other, turned)
        sigma_px = np.sqrt(max(total, 0.0) / max(calibration.degrees_of_freedom, 1))
        at_d = replace(read, b=read.b + read.S @ d, sigma_px=float(sigma_px))
        least = found.cost - checks.gain(found.S, found.b)
        least_gain = (_TURN_SIGMAS * checks.overdispersion(at_d) * sigma_px) ** 2
        # Where they explain it alike a picture was turned: that happens more often.
        if best is not None and total > best[0] - least_gain:
            continue
        by = there[0] - there[1]
        clear = turned & (by > least_gain)
        clear &= there[1] - least < _TURN_EXCESS * (there[0] - least)
        if clear.any():
            agree, odd = _agree_turned(found, other, turned)
            clear &= agree & odd
            # Where one was turned others may have been that say less.
            if clear.any():
                clear |= turned & agree & (by > least_gain * (_TURN_ALSO / _TURN_SIGMAS) ** 2)
        best = total, how, clear, (flip - 1.0) * d + offset
    if best is None or not best[2].any():
        return []
    _, how, which, difference = best
    moved_px = checks.apart_px(calibration, difference)
    if moved_px < _TURN_PX * scale_of(calibration.camera.image_size_px):
        return []
    why = (
        f"agrees with the camera of the {N - int(which.sum())} others if it was {how} after it was taken, "
        f"and not as it is, where directions are off by {moved_px:.2g} px"
    )
    return [LeftOut(calibration.observations.names[i], why, "view") for i in np.flatnonzero(which)]


def _without_one(found: checks.Evidence) -> float:
    """Least cost of a reading of all views but one, with the camera that suits these."""
    S, b = found.S.sum(axis=0) - found.S, found.b.sum(axis=0) - found.b
    cost = found.cost.sum() - found.cost - checks.gain(S, b)
    return float((cost / (found.measured.sum() - found.measured)).min())


def _read(found: checks.Evidence, other: checks.Evidence, turned: BoolArray) -> checks.Evidence:
    """The views as they are, and those that are turned as they are then."""
    of = turned[:, None]
    return replace(
        found,
        S=np.where(of[..., None], other.S, found.S),
        b=np.where(of, other.b, found.b),
        cost=np.where(turned, other.cost, found.cost),
    )


def _agree_turned(
    found: checks.Evidence, other: checks.Evidence, turned: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Which views (N,) agree with those that agree best when these are turned, and which are odd as they are.

    Another view that is odd may make some look turned.
    """
    whole, every = found.S.sum(axis=0), np.arange(len(turned))
    read = _scaled(_read(found, other, turned), whole)[0]
    core = _first_core(read)
    agree = _disagreement(read, core).chance(core) > _CHANCE
    odd = np.zeros(len(turned), dtype=np.bool_)
    for i in np.flatnonzero(agree & turned):
        others = core & (every != i)
        now = _scaled(_read(found, other, turned & (every != i)), whole)[0]
        odd[i] = _disagreement(now, others).chance(others)[i] < _CHANCE
    return agree, odd


def _reflection(calibration: Calibration, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """F (G,) and g (G,) of the free intrinsics when these change."""
    changes = np.isin(calibration.free_names, names)
    middle = dict(zip(("cx_px", "cy_px"), calibration.camera.image_size_px, strict=True))
    full = np.array([middle.get(name, 1) - 1.0 for name in calibration.free_names])
    now = calibration.block.intrinsics[calibration.free]
    return np.where(changes, -1.0, 1.0), np.where(changes, full - 2.0 * now, 0.0)


def _parted(found: checks.Evidence, other: checks.Evidence) -> tuple[BoolArray, FloatArray, float]:
    """Which views (N,) are turned, the step d (G,) to the camera that all then share, and their cost.

    Parameters
    ----------
    found, other : of the views as they are, and turned.
    """
    whole = found.S.sum(axis=0)
    (found, unit), (other, _) = _scaled(found, whole), _scaled(other, whole)
    N, G = found.b.shape
    weak = 1e-3 * found.S.sum(axis=0) / N + 1e-9 * np.eye(G)
    best, least = (np.zeros(N, dtype=np.bool_), np.zeros(G)), np.inf
    for start in (None, *evenly(N, _TURN_STARTS)):
        d = np.zeros(G) if start is None else -np.linalg.solve(found.S[start] + weak, found.b[start])
        turned = np.zeros(N, dtype=np.bool_)
        for step in range(_TURN_STEPS):
            before, turned = turned, other.cost_at(d) < found.cost_at(d)
            if step and np.array_equal(turned, before):
                break
            read = _read(found, other, turned)
            d = read.solved().step
        total = float(read.cost.sum() + read.b.sum(axis=0) @ d)
        if 2 * turned.sum() <= N and total < least:
            best, least = (turned, d), total
    return best[0], best[1] * unit, least


# ----------------------------------------------------------------------
# The search: fit, ask, leave out, until nothing changes.


@dataclass(frozen=True)
class Triage:
    """What is left of a set of views.

    Attributes
    ----------
    calibration : from the views and points that are left.
    everything : from all of them.
    left_out : a sentence for each view that leaves, and for each with points that do.
    """

    calibration: Calibration
    everything: Calibration
    left_out: tuple[LeftOut, ...]
    scale_px: float = 0.0

    @staticmethod
    def of_all(calibration: Calibration) -> Triage:
        """Nothing leaves."""
        return Triage(calibration, calibration, ())


def triage(calibration: Calibration) -> Triage:
    """Leave out views and points that do not agree with the others.

    The search begins with all views, and with the core that agrees best, which a few bad views among few
    cannot hide from. Where the two end differently the one that keeps more is taken, unless the other's
    views agree much better.

    Parameters
    ----------
    calibration : of all views by the model that is used, the target rigid, without robust loss.
    """
    whole = _settled(calibration, False)
    core = _settled(calibration, True)
    if len(core.left_out) > len(whole.left_out) and whole.scale_px < _SCALE * core.scale_px:
        return whole
    return core


def _settled(calibration: Calibration, robust: bool) -> Triage:
    """The search from all views, or from the core that agrees best."""
    everything = calibration.observations
    views = everything.views
    scale = scale_of(calibration.camera.image_size_px)
    kept, far = np.ones(views, dtype=np.bool_), np.zeros(everything.present.shape, dtype=np.bool_)
    floor_px = np.full(views, Limits.point_floor_px)
    reasons: dict[int, str] = {}
    scale_px = 0.0
    fit = calibration
    for turn in range(_ROUNDS):
        whole, seen = _with_all(fit, kept, everything, far)
        distance = np.linalg.norm(whole.residuals_px, axis=2)
        there = np.isfinite(distance)
        typical = float(np.median(distance[there & kept[:, None]]))
        new_far = far_points(distance, there, typical, floor_px)
        nowhere = "no pose of the board explains it with the other views' camera"
        why = {int(i): nowhere for i in np.flatnonzero(~seen)}
        if views - len(why) >= _LEAST_VIEWS:
            usable = np.flatnonzero([i not in why for i in range(views)])
            part = replace(
                whole, observations=whole.observations.select(usable), block=whole.block.part(usable)
            )
            asked = agreement(part, None if robust and turn < 2 else kept[usable])
            scale_px = asked.scale_px
            # A view is asked again without its far points before it leaves for them.
            fresh = kept & (new_far & ~far).any(axis=1)
            leaves = asked.leaving(scale) & ~fresh[usable]
            # Nor for a few corners that something lies over, which are far off for this view alone.
            doubted = usable[leaves]
            floor_px[doubted] = np.minimum(floor_px[doubted], _NEAR_FLOOR_PX * scale)
            nearer = far_points(distance, there, typical, floor_px) & ~new_far
            few = nearer.any(axis=1) & ((nearer | new_far).mean(axis=1) < _FEW_POINTS)
            new_far |= nearer & few[:, None]
            leaves &= ~few[usable]
            why |= {
                int(usable[k]): _sentence(asked, int(k), part, int((~leaves).sum()))
                for k in np.flatnonzero(leaves)
            }
        reasons |= why
        new = np.array([i not in why for i in range(views)])
        # Two views that take turns both leave.
        new &= kept if turn > _ROUNDS // 2 else True
        new_far &= new[:, None]
        if np.array_equal(new, kept) and np.array_equal(new_far, far):
            break
        if new.sum() < min(_LEAST_VIEWS - 1, views):
            return Triage.of_all(calibration)
        kept, far = new, new_far
        fit = refitted(replace(whole, observations=everything.without(far)), np.flatnonzero(kept))
    left = [LeftOut(everything.names[i], reasons[int(i)], "view") for i in np.flatnonzero(~kept)]
    return Triage(fit, calibration, (*left, *_of_points(distance, everything, far)), scale_px)


def _with_all(
    fit: Calibration, kept: BoolArray, everything: Observations, far: BoolArray
) -> tuple[Calibration, BoolArray]:
    """The fit with the poses of all views fitted to its camera, and which views (N,) that was possible for.

    Residuals are those of all points, the far ones included.
    """
    near = everything.without(far)
    R_CT, t_CT_m = np.tile(np.eye(3), (len(kept), 1, 1)), np.tile(fit.block.t_CT_m[:1], (len(kept), 1))
    R_CT[kept], t_CT_m[kept] = fit.block.R_CT, fit.block.t_CT_m
    seen = kept.copy()
    others = np.flatnonzero(~kept)
    if len(others):
        starts = poses_with_camera(fit.camera, near.select(others))
        for k in np.flatnonzero(starts.posed):
            # One by one: a view that ends behind the camera must not stop the others.
            i = others[k]
            found = minimise(starts.part([int(k)]), near.select([i]), np.zeros(0, dtype=np.int64))
            seen[i] = found.at is not None
            R_CT[i], t_CT_m[i] = found.block.R_CT[0], found.block.t_CT_m[0]
    points = everything.target_m @ R_CT.transpose(0, 2, 1) + t_CT_m[:, None]
    residuals = project(fit.camera, points) - everything.pixels
    residuals[~everything.present | ~seen[:, None]] = np.nan
    block = Block.of(fit.camera, R_CT, t_CT_m)
    return replace(fit, observations=near, block=block, residuals_px=residuals), seen


def _sentence(asked: Agreement, i: int, calibration: Calibration, others: int) -> str:
    """Why a view leaves."""
    names = calibration.free_names
    k = int(np.argmax(np.abs(asked.shift[i]) / np.maximum(asked.sigma, 1e-300)))
    name, unit = names[k].removesuffix("_px"), " px" if names[k].endswith("_px") else ""
    moved = (
        f"it alone would move {name} by {abs(asked.shift[i, k]):.3g}{unit}, {asked.moved[i]:.1f} standard "
        f"deviations, and directions in the picture by up to {asked.moved_px[i]:.2g} px"
    )
    if asked.chance[i] < _CHANCE:
        return (
            f"shows another camera than the {others} views that agree (zoom, focus, a picture that a program "
            f"turned, rolling shutter or a bent board); {moved}"
        )
    if asked.noise[i] > _ODD_NOISE:
        return (
            f"its corners scatter by {asked.noise_px[i]:.2g} px, {asked.noise[i]:.1f} times as much as those "
            f"of a typical view (motion, blur or another board); {moved}"
        )
    return (
        f"its RMS by the camera of the other views is {asked.rms_px[i]:.2f} px, {asked.misfit[i]:.0f} times "
        "that of the quieter ones"
    )


def _of_points(distance: FloatArray, everything: Observations, far: BoolArray) -> list[LeftOut]:
    """A sentence for each view that loses points."""
    out = []
    for i in np.flatnonzero(far.any(axis=1)):
        lost = np.flatnonzero(far[i])
        where = several(
            [
                f"{j} at ({u:.1f}, {v:.1f})"
                for j, (u, v) in zip(lost, everything.pixels[i, lost], strict=True)
            ],
            4,
        )
        why = (
            f"without {len(lost)} of its points, up to {np.max(distance[i, lost]):.2f} px from where the "
            f"others put them: {where}"
        )
        out.append(LeftOut(everything.names[i], why, "points"))
    return out

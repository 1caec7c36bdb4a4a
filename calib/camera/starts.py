"""Whether the minimum that was found is the minimum: other starts, and the profile over focal length.

The local covariance of a calibration is a statement about the bottom of one valley. Two things it
cannot see: another valley as deep, and a valley that is flat and curved, along which the focal length
runs away. Both are looked for by minimising again.

The profile is the cost as a function of fx with everything else minimised. The interval of fx in
which it rises by less than 3.84 sigma^2 holds the truth with 95 % probability (Wilks) however
lopsided it is.

The rational model comes here `conditioned`: its denominator trades with the numerator at next to no
cost, and the searches would never end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.bundle import Calibration, calibrate
from calib.camera.levenberg import minimise
from calib.camera.projection import INTRINSICS, Block, camera_from_vector, free_intrinsics
from calib.camera.zhang import homographies, poses_from_homographies, poses_with_camera

__all__ = [
    "FocalInterval",
    "Start",
    "best_of_starts",
    "conditioned",
    "focal_interval",
    "held",
    "other_starts",
    "resolved",
]

FOCAL_STARTS = (0.4, 0.7, 1.1, 1.8, 4.0)
"""Focal lengths of the starts, over the longer side of the image."""

_CHI2_95 = 3.84
_MAX_ITERATIONS = 60
_MAX_VIEWS = 60
_NEARLY = 1.02
"""Cost of five coefficients over that of the rational model below which they do."""


@dataclass(frozen=True)
class Start:
    """Where one start ended.

    Attributes
    ----------
    focal_px : focal length that it began with.
    block : where it ended.
    cost : sum of squared residuals there, pixels squared.
    termination : as `Calibration.termination`.
    """

    focal_px: float
    block: Block
    cost: float
    termination: str


def resolved(calibration: Calibration, index: IntArray) -> Calibration:
    """The calibration from some of its views only, same model and loss, started where it is."""
    camera, block = calibration.camera, calibration.block
    start = Block(block.intrinsics, block.R_CT[index], block.t_CT_m[index], block.deformation)
    return calibrate(
        calibration.observations.select(index),
        camera.image_size_px,
        camera.model,
        skew=INTRINSICS.index("skew_px") in calibration.free,
        fixed=held(calibration),
        basis=calibration.basis,
        loss=calibration.loss,
        start=start,
    )


def held(calibration: Calibration) -> tuple[str, ...]:
    """Names of intrinsics that the model has and the calibration does not estimate."""
    every = free_intrinsics(calibration.camera.model, True)
    return tuple(INTRINSICS[i] for i in every if i not in calibration.free)


def conditioned(calibration: Calibration) -> Calibration:
    """The same views without the freedom of the rational model's denominator; other models as they are.

    The denominator trades with the numerator at next to no cost, so that what it leaves undetermined
    says nothing about the camera. Where five coefficients do nearly as well they take its place, else
    the denominator is held at its values.
    """
    loose = [INTRINSICS.index(name) for name in ("k4", "k5", "k6")]
    kept = np.flatnonzero(~np.isin(calibration.free, loose))
    if len(kept) == len(calibration.free):
        return calibration
    if all(name in calibration.free_names for name in ("k1", "k2", "p1", "p2", "k3")):
        block, camera = calibration.block, calibration.camera
        intrinsics = block.intrinsics.copy()
        intrinsics[INTRINSICS.index("k1") :] = 0.0
        simpler = calibrate(
            calibration.observations,
            camera.image_size_px,
            "brown5",
            skew="skew_px" in calibration.free_names,
            fixed=tuple(name for name in held(calibration) if name != "skew_px"),
            start=replace(block, intrinsics=intrinsics),
            max_iterations=_MAX_ITERATIONS,
        )
        if simpler.converged and simpler.squared_sum < _NEARLY * calibration.squared_sum:
            return simpler
    rows = np.concatenate([kept, np.arange(len(calibration.free), calibration.normal.shape[1])])
    normal = calibration.normal[:, rows][:, :, rows]
    return replace(calibration, free=calibration.free[kept], normal=normal)


def other_starts(calibration: Calibration, seed: int = 0) -> list[Start]:
    """Minima reached from focal lengths of 0.4 to 4 image widths and principal points about the centre."""
    rng = np.random.default_rng(seed)
    observations, camera = calibration.observations, calibration.camera
    width, height = camera.image_size_px
    H = homographies(observations)
    free = calibration.free
    ends = []
    for share in FOCAL_STARTS:
        focal = share * max(width, height)
        jitter = rng.uniform(-0.08, 0.08, 2) * (width, height)
        guess = calibration.block.intrinsics.copy()
        guess[calibration.free] = 0.0
        for name, value in zip(
            ("fx_px", "fy_px", "cx_px", "cy_px"),
            (focal, focal, 0.5 * (width - 1) + jitter[0], 0.5 * (height - 1) + jitter[1]),
            strict=True,
        ):
            index = INTRINSICS.index(name)
            if index in free:
                guess[index] = value
        K = np.array([[guess[0], guess[4], guess[2]], [0.0, guess[1], guess[3]], [0.0, 0.0, 1.0]])
        R_CT, t_CT_m = poses_from_homographies(K, H)
        if not (np.all(np.isfinite(R_CT)) and np.all(np.isfinite(t_CT_m))):
            continue
        start = Block(guess, R_CT, t_CT_m, np.zeros(0))
        found = minimise(start, observations, free, max_iterations=_MAX_ITERATIONS)
        if found.at is not None:
            ends.append(Start(focal, found.block, found.at.cost, found.reason))
    return ends


def best_of_starts(calibration: Calibration) -> Calibration:
    """The calibration, or the one that another start leads to if its cost is lower by more than chance.

    More than chance: by more than 3.84 times the residuals' variance. Above 60 views the starts are
    tried on an even sample of them. A robust loss or a deformed target is returned as it is.
    """
    if calibration.basis is not None or calibration.loss != "none":
        return calibration
    some, views = calibration, calibration.observations.views
    chance = _CHI2_95 * calibration.sigma_px**2
    if views > _MAX_VIEWS:
        index = np.unique(np.linspace(0, views - 1, _MAX_VIEWS).astype(np.int64))
        some = _part(calibration, index)
        # On a sample the fit to all views is not the best, by about its number of parameters.
        chance *= len(calibration.free)
    ends = other_starts(some)
    if not ends:
        return calibration
    best = min(ends, key=lambda end: end.cost)
    if best.cost > _cost(some) - chance:
        return calibration
    camera, start = calibration.camera, best.block
    if some is not calibration:
        found = camera_from_vector(camera.model, camera.image_size_px, start.intrinsics)
        R_CT, t_CT_m = poses_with_camera(found, calibration.observations)
        if not (np.all(np.isfinite(R_CT)) and np.all(np.isfinite(t_CT_m))):
            return calibration
        start = Block(start.intrinsics, R_CT, t_CT_m, np.zeros(0))
    better = calibrate(
        calibration.observations,
        camera.image_size_px,
        camera.model,
        skew=INTRINSICS.index("skew_px") in calibration.free,
        fixed=held(calibration),
        start=start,
    )
    return better if _cost(better) < _cost(calibration) - _CHI2_95 * better.sigma_px**2 else calibration


def _part(calibration: Calibration, index: IntArray) -> Calibration:
    """Some views of a calibration as they are, not fitted anew."""
    block = calibration.block
    return replace(
        calibration,
        observations=calibration.observations.select(index),
        block=replace(block, R_CT=block.R_CT[index], t_CT_m=block.t_CT_m[index]),
        residuals_px=calibration.residuals_px[index],
        weights=calibration.weights[index],
        normal=calibration.normal[index],
    )


def _cost(calibration: Calibration) -> float:
    """Sum of squared residuals, infinite where the fit has none."""
    return calibration.squared_sum if np.all(np.isfinite(calibration.normal)) else float("inf")


@dataclass(frozen=True)
class FocalInterval:
    """Interval of fx that the data allow.

    Attributes
    ----------
    low_px, high_px : ends; 0 and infinity where the cost does not rise enough.
    fx_px : where the minimum lies.
    lower_cost : a cost below the minimum was met on the way.
    """

    low_px: float
    high_px: float
    fx_px: float
    lower_cost: bool

    @property
    def bounded(self) -> bool:
        """Whether both ends were found."""
        return self.low_px > 0.0 and bool(np.isfinite(self.high_px))

    @property
    def half_width_share(self) -> float:
        """Half the width over fx; infinite where the interval is unbounded."""
        if not self.bounded:
            return float("inf")
        return 0.5 * (self.high_px - self.low_px) / self.fx_px


def focal_interval(calibration: Calibration, sigma_fx_px: float, inflation: float) -> FocalInterval:
    """95 % interval of fx from the profile of the cost.

    Parameters
    ----------
    sigma_fx_px : standard deviation of fx from the covariance, without inflation; sets the first step.
    inflation : factor on standard deviations for residuals that are not white.
    """
    fx = calibration.camera.fx_px
    own = calibration.squared_sum
    target = _CHI2_95 * (inflation * calibration.sigma_px) ** 2
    free = calibration.free
    free = free[free != INTRINSICS.index("fx_px")]
    first = min(1.96 * sigma_fx_px * inflation, 0.15 * fx) if np.isfinite(sigma_fx_px) else 0.1 * fx
    first = max(first, 1e-9 * fx)
    lower = False
    ends = []
    for sign in (-1.0, 1.0):
        at, block, rise, here = 0.0, calibration.block, 0.0, first
        end = np.inf
        for _ in range(8):
            trial = fx + sign * here
            if not 0.15 * fx < trial < 7.0 * fx:
                break
            moved = _with_fx(block, trial, INTRINSICS.index("fy_px") in free)
            found = minimise(moved, calibration.observations, free, max_iterations=30)
            if found.at is None or not np.isfinite(found.at.cost):
                break
            now = found.at.cost - own
            if now < -0.1 * target:
                lower = True
                break
            if now >= target:
                # The rise is close to a parabola between two points of its root.
                root_at, root_now = np.sqrt(max(rise, 0.0)), np.sqrt(now)
                end = at + (here - at) * (np.sqrt(target) - root_at) / max(root_now - root_at, 1e-300)
                break
            at, block, rise = here, found.block, now
            # Where the parabola would reach the target, at least a tenth and at most three times on.
            here *= float(np.clip(1.05 * np.sqrt(target / max(now, 1e-3 * target)), 1.1, 3.0))
        ends.append(fx + sign * end)
    return FocalInterval(max(ends[0], 0.0), ends[1], fx, lower)


def _with_fx(block: Block, fx_px: float, with_fy: bool) -> Block:
    """Another fx, with distances and fy following it, which keeps the pictures nearly the same."""
    ratio = fx_px / block.intrinsics[0]
    intrinsics: FloatArray = block.intrinsics.copy()
    intrinsics[: 2 if with_fy else 1] *= ratio
    # The boards' distances are proportional to the focal length.
    t = block.t_CT_m * np.array([1.0, 1.0, ratio])
    return replace(block, intrinsics=intrinsics, t_CT_m=t)

"""Made-up sets of views, good ones and ones that cannot support an answer, for tests of the verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.camera.checks import image_outline
from calib.stages.camera.model import FISHEYE, Board, Camera, View, project, undistort
from calib.stages.camera.pose import fit_pose
from calib.twin.scene import rotation

__all__ = ["BAD", "SIZES", "SPOILS", "Recipe", "camera_of", "good_set", "sheared", "take"]

SIZES = ((316, 208), (320, 240), (640, 480), (752, 480), (1280, 720), (1280, 960), (1920, 1080))
_SMALL = Board(7, 5, 0.020)

Maker = Callable[[np.random.Generator], tuple[list[View], Camera]]


@dataclass(frozen=True)
class Recipe:
    """How views are taken.

    Attributes
    ----------
    noise_px : standard deviation of one coordinate.
    tilt_deg : range of tilts.
    azimuth_deg : direction of the tilt, or None for any.
    roll_deg : largest turn of the board in its plane.
    fill : range of the board's diagonal over the picture's.
    spread : how far from the picture's middle the board's middle may lie, over its sides.
    aspect, bow_m : of the real board, as in `twin.sheet.PrintedBoard`, the bow along x.
    """

    noise_px: float = 0.1
    tilt_deg: tuple[float, float] = (8.0, 40.0)
    azimuth_deg: float | None = None
    roll_deg: float = 180.0
    fill: tuple[float, float] = (0.35, 0.7)
    spread: float = 0.35
    aspect: float = 1.0
    bow_m: float = 0.0


def camera_of(
    size_px: tuple[int, int] = (640, 480),
    field_deg: float = 62.0,
    lens: tuple[float, ...] = (-0.2, 0.1),
    model: str = "radial2",
    off_centre_px: tuple[float, float] = (4.0, -3.0),
) -> Camera:
    """A camera by its horizontal field of view."""
    width, height = size_px
    half = np.radians(field_deg) / 2
    focal = 0.5 * width / (half if model == FISHEYE else np.tan(half))
    coefficients = np.zeros(8)
    coefficients[: len(lens)] = lens
    cx, cy = 0.5 * (width - 1) + off_centre_px[0], 0.5 * (height - 1) + off_centre_px[1]
    return Camera(model, size_px, focal, focal, 0.0, cx, cy, coefficients)


def take(
    rng: np.random.Generator,
    camera: Camera,
    count: int,
    target_m: FloatArray | None = None,
    recipe: Recipe = Recipe(),
    prefix: str = "v",
) -> list[View]:
    """Views of a target, all of it inside the picture."""
    target = _SMALL.points_m() if target_m is None else target_m
    low, high = target.min(axis=0), target.max(axis=0)
    width, height = camera.image_size_px
    flat = target - 0.5 * (low + high)
    bend = recipe.bow_m * (1.0 - (2 * flat[:, 0] / (high - low)[0]) ** 2)
    real = np.column_stack([flat[:, 0], flat[:, 1] * recipe.aspect, bend])
    diagonal = float(np.linalg.norm(high - low))
    views: list[View] = []
    while len(views) < count:
        azimuth = rng.uniform(0, 360) if recipe.azimuth_deg is None else recipe.azimuth_deg
        roll = rng.uniform(-recipe.roll_deg, recipe.roll_deg)
        R = rotation(np.radians(rng.uniform(*recipe.tilt_deg)), np.radians(azimuth), np.radians(roll))
        distance = camera.fx_px * diagonal / (rng.uniform(*recipe.fill) * np.hypot(width, height))
        offset = rng.uniform(-recipe.spread, recipe.spread, 2) * (width, height)
        ray = undistort(camera, np.array([0.5 * width, 0.5 * height]) + offset)
        points = real @ R.T + distance * np.array([*ray, 1.0])
        if not points[:, 2].min() > 0.05 * distance:
            continue
        pixels = project(camera, points)
        inside = (pixels > 0).all() and (pixels < [width - 1, height - 1]).all()
        # A barrel lens folds far rays back into the picture.
        seen = np.abs(undistort(camera, pixels) - points[:, :2] / points[:, 2:]).max() if inside else np.inf
        if not seen < 1e-6:
            continue
        noise = recipe.noise_px * rng.standard_normal(pixels.shape)
        views.append(View(f"{prefix}{len(views):02d}", target, pixels + noise))
    return views


def _lens(rng: np.random.Generator, model: str, reach: float) -> tuple[float, ...]:
    """Coefficients of a lens whose corners lie at the undistorted radius `reach`."""
    if model == "pinhole":
        return ()
    if model == FISHEYE:
        k1, k2, k3, k4 = rng.uniform(-0.04, 0.04), *rng.uniform(-0.01, 0.01, 2), 0.0
        return k1, k2, 0.0, 0.0, k3, k4
    k1, k2 = rng.uniform(-0.18, 0.05) / reach**2, rng.uniform(0.0, 0.06) / reach**4
    if model == "radial2":
        return k1, k2
    p1, p2 = rng.normal(0.0, 8e-4, 2) if model != "radial3" else (0.0, 0.0)
    k3 = rng.normal(0.0, 0.01) / reach**6
    if model != "rational8":
        return k1, k2, p1, p2, k3
    return k1, k2, p1, p2, k3, rng.uniform(0.0, 0.2) / reach**2, rng.uniform(0.0, 0.05) / reach**4, 0.0


def _disturbed(rng: np.random.Generator, view: View, noise_px: float) -> View:
    """Errors that are smooth over a view, more noise in some views, and one point in a hundred far off."""
    pixels = view.pixels
    q = (pixels - pixels.mean(axis=0)) / pixels.std()
    smooth = np.stack([np.ones(len(q)), *q.T, q[:, 0] * q[:, 1], *(q**2).T], axis=1)
    pixels = pixels + smooth @ rng.normal(0.0, 0.15 * noise_px, (6, 2))
    pixels = pixels + rng.uniform(0.0, 1.2 * noise_px) * rng.standard_normal(pixels.shape)
    far = rng.random(len(pixels)) < 0.01
    pixels[far] += 3 * noise_px * rng.standard_normal((int(far.sum()), 2))
    return replace(view, pixels=pixels)


def good_set(seed: int, model: str, count: int | None = None) -> tuple[list[View], Camera]:
    """A seeded set that deserves to be blessed: any camera, board, noise, disturbed in half of the cases."""
    rng = np.random.default_rng([seed, 20])
    size = SIZES[rng.integers(len(SIZES))]
    fields = {"pinhole": (35.0, 75.0), "radial2": (35.0, 75.0), FISHEYE: (100.0, 150.0)}
    field = rng.uniform(*fields.get(model, (50.0, 100.0)))
    while True:
        lens = _lens(rng, model, 1.25 * np.tan(np.radians(field / 2)))
        off = tuple(rng.normal(0.0, 0.012, 2) * size[0])
        camera = camera_of(size, field, lens, model, (float(off[0]), float(off[1])))
        if np.isfinite(undistort(camera, image_outline(camera))).all():
            break
    boards = (Board(7, 5, 0.02), Board(9, 6, 0.025), Board(8, 6, 0.0254), Board(11, 8, 0.02))
    kind = int(rng.integers(len(boards) + 1))
    target = boards[kind].points_m() if kind < len(boards) else rng.uniform(0, 1, (256, 2)) * [0.2, 0.15]
    noise = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4 if size[0] > 400 else 0.2))))
    recipe = Recipe(
        noise,
        tilt_deg=(5.0, rng.uniform(30, 45)),
        roll_deg=float(rng.choice([15.0, 180.0])),
        fill=(0.35, 0.75),
        bow_m=float(rng.choice([0.0, 0.002]) * np.ptp(target, axis=0).max() * rng.uniform(-1, 1)),
    )
    views = take(rng, camera, count or int(rng.integers(10, 41)), target, recipe)
    if rng.random() < 0.5:
        views = [_disturbed(rng, view, noise) for view in views]
    return views, camera


def _other(camera: Camera, zoom: float, shift_px: float = 0.0) -> Camera:
    return replace(
        camera,
        fx_px=camera.fx_px * zoom,
        fy_px=camera.fy_px * zoom,
        cx_px=camera.cx_px - shift_px,
        cy_px=camera.cy_px + shift_px,
    )


def _any(rng: np.random.Generator) -> Camera:
    size = ((316, 208), (640, 480), (1280, 720))[rng.integers(3)]
    return camera_of(size, rng.uniform(50, 75), (rng.uniform(-0.25, 0.0), rng.uniform(0.0, 0.1)))


def _shot(count: int = 17, **recipe: Any) -> Maker:
    def made(rng: np.random.Generator) -> tuple[list[View], Camera]:
        camera = _any(rng)
        return take(rng, camera, count, recipe=Recipe(**recipe)), camera

    return made


def _two(zoom: float, shift_px: float, counts: tuple[int, int], mixed: bool) -> Maker:
    def made(rng: np.random.Generator) -> tuple[list[View], Camera]:
        camera = camera_of()
        views = take(rng, camera, counts[0]) + take(
            rng, _other(camera, zoom, shift_px), counts[1], prefix="w"
        )
        order = rng.permutation(len(views)) if mixed else np.arange(len(views))
        return [views[i] for i in order], camera

    return made


def _changed(change: Callable[[int, FloatArray, np.random.Generator], FloatArray]) -> Maker:
    """Good views whose list of pixels was changed, view by view."""

    def made(rng: np.random.Generator) -> tuple[list[View], Camera]:
        camera = _any(rng)
        views = take(rng, camera, 17)
        return [replace(v, pixels=change(i, v.pixels, rng)) for i, v in enumerate(views)], camera

    return made


def _copies(rng: np.random.Generator) -> tuple[list[View], Camera]:
    camera = _any(rng)
    view = take(rng, camera, 1)[0]
    return [replace(view, name=f"copy{i:02d}") for i in range(17)], camera


def _noisy_copies(rng: np.random.Generator) -> tuple[list[View], Camera]:
    views, camera = _copies(rng)
    return [replace(v, pixels=v.pixels + 0.1 * rng.standard_normal(v.pixels.shape)) for v in views], camera


def _resized(size_px: tuple[int, int]) -> Maker:
    def made(rng: np.random.Generator) -> tuple[list[View], Camera]:
        camera = camera_of()
        return take(rng, camera, 17), replace(camera, image_size_px=size_px)

    return made


def _grid(pixels: FloatArray) -> FloatArray:
    return pixels.reshape(_SMALL.rows, _SMALL.columns, 2)


def _outliers(_: int, pixels: FloatArray, rng: np.random.Generator) -> FloatArray:
    far = rng.random((len(pixels), 1)) < 0.05
    return np.asarray(pixels + far * rng.uniform(-9, 9, pixels.shape))


_NO = "unidentifiable"
_CONTRADICTS = "inconsistent"
BAD: dict[str, tuple[Maker, tuple[str, ...]]] = {
    "parallel to the picture, 0 degrees": (_shot(tilt_deg=(0.0, 0.1)), (_NO,)),
    "parallel to the picture, 3 degrees": (_shot(tilt_deg=(0.0, 3.0)), (_NO, "poor")),
    "parallel to the picture, 3 degrees, little noise": (
        _shot(tilt_deg=(0.0, 3.0), noise_px=0.02),
        (_NO, "poor"),
    ),
    "parallel to the picture, 5 degrees": (_shot(tilt_deg=(0.0, 5.0)), (_NO, "poor")),
    "parallel to each other": (
        _shot(tilt_deg=(25.0, 26.0), azimuth_deg=70.0, roll_deg=1.0),
        (_NO, "poor"),
    ),
    "two cameras, focal length 3 %": (_two(1.03, 0.0, (9, 9), True), (_CONTRADICTS,)),
    "two cameras, few of the second": (_two(1.05, 0.0, (13, 4), True), (_CONTRADICTS,)),
    "two cameras, centre 15 px": (_two(1.007, 15.0, (13, 13), True), (_CONTRADICTS,)),
    "refocused by 2 % half-way": (_two(1.02, 0.0, (10, 8), False), (_CONTRADICTS,)),
    "refocused by 3 % late": (_two(1.03, 0.0, (14, 5), False), (_CONTRADICTS,)),
    "squares 5 % too high": (_shot(aspect=1.05), (_CONTRADICTS,)),
    "squares 5 % too high, board upright": (_shot(aspect=1.05, roll_deg=5.0), (_CONTRADICTS,)),
    "squares 5 % too high, board never turned": (_shot(aspect=1.05, roll_deg=0.0), (_CONTRADICTS, "poor")),
    "board curved by 3 mm": (_shot(bow_m=0.003), (_CONTRADICTS,)),
    "board curved by 3 mm to the other side": (_shot(bow_m=-0.003), (_CONTRADICTS,)),
    "one view seventeen times": (_copies, (_NO,)),
    "one place seventeen times": (_noisy_copies, (_NO,)),
    "one view": (_shot(1), (_NO,)),
    "two views": (_shot(2), (_NO, "poor")),
    "three views": (_shot(3), (_NO, "poor")),
    "tiny in the middle": (_shot(fill=(0.06, 0.1), spread=0.05), (_NO, "poor")),
    "small in the middle": (_shot(fill=(0.2, 0.25), spread=0.05), (_NO, "poor")),
    "noise of 3 px": (_shot(noise_px=3.0), (_CONTRADICTS, "poor", _NO)),
    "some views mirrored": (
        _changed(lambda i, p, _: _grid(p)[:, ::-1].reshape(-1, 2) if i % 4 == 0 else p),
        (_CONTRADICTS,),
    ),
    "some views transposed": (
        _changed(lambda i, p, _: _grid(p).transpose(1, 0, 2).reshape(-1, 2) if i % 4 == 0 else p),
        (_CONTRADICTS, _NO),
    ),
    "one view's points shuffled": (
        _changed(lambda i, p, rng: rng.permutation(p) if i == 5 else p),
        (_CONTRADICTS, _NO),
    ),
    "one view's rows shuffled": (
        _changed(lambda i, p, _: _grid(p)[[1, 0, 2, 4, 3]].reshape(-1, 2) if i == 5 else p),
        (_CONTRADICTS, _NO),
    ),
    "u and v swapped": (_changed(lambda i, p, _: p[:, ::-1].copy()), (_CONTRADICTS, "poor", _NO)),
    "outliers": (_changed(_outliers), (_CONTRADICTS, "poor")),
    "image size too large": (_resized((1280, 960)), ("poor",)),
}
"""Sets that must not be blessed: how to make them, and the verdicts that are right."""


# ----------------------------------------------------------------------
# One view of a good set spoilt: its pixels as another camera, a moved board or a bad picture would give them.

Spoil = Callable[[View, Camera, np.random.Generator], FloatArray]


def _zoomed(factor: float) -> Spoil:
    def spoilt(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
        middle = 0.5 * (np.array(camera.image_size_px) - 1)
        return (view.pixels - middle) * factor + middle

    return spoilt


def sheared(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
    return view.pixels + np.outer(view.pixels[:, 1] / camera.image_size_px[1], [8.0, 0.0])


def _wavy(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
    return view.pixels + 2.0 * np.sin(2 * np.pi * view.pixels[:, ::-1] / 120)


def _mirrored(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
    """The picture mirrored, its columns listed as the detector does."""
    mirrored = np.array([camera.image_size_px[0] - 1.0, 0.0]) + view.pixels * [-1.0, 1.0]
    return mirrored.reshape(5, 7, 2)[:, ::-1].reshape(-1, 2)


def _of_another(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
    seen = fit_pose(camera, view.target_m, view.pixels)
    points = np.column_stack([view.target_m, np.zeros(len(view.target_m))]) @ seen.R_CW.T + seen.t_CW_m
    return project(replace(camera, fx_px=1.06 * camera.fx_px, cx_px=camera.cx_px + 12.0), points)


def _blurred(view: View, camera: Camera, rng: np.random.Generator) -> FloatArray:
    return view.pixels + rng.normal(0.0, 1.0, view.pixels.shape)


SPOILS: dict[str, Spoil] = {
    "blur": _blurred, "shear 8 px": sheared, "zoom 0.9": _zoomed(0.9), "zoom 0.97": _zoomed(0.97),
    "wavy 2 px": _wavy, "mirrored": _mirrored, "another camera": _of_another,
}  # fmt: skip

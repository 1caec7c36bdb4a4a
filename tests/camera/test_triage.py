"""One bad picture: it leaves, it is named, no innocent one is, and the camera is as without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from sets import SIZES, SPOILS, Recipe, camera_of, sheared, take

from calib.core.arrays import FloatArray, GrayImage
from calib.io.pictures import list_pictures, read_picture, usual_size
from calib.stages.camera.bundle import calibrate, covariance, projection_sigma_px, refitted
from calib.stages.camera.checks import alone_px, drift, evidence, overdispersion
from calib.stages.camera.corners import detect
from calib.stages.camera.intrinsics import Intrinsics, calibrate_camera
from calib.stages.camera.model import Board, Camera, View, pack
from calib.stages.camera.options import Choices
from calib.stages.camera.pose import fit_pose
from calib.stages.camera.triage import agreement, triage, turned_views
from calib.twin.scene import Pose, PrintedBoard, render

SIZE = (640, 480)


def _sigma(fit: Intrinsics) -> FloatArray:
    """Standard deviations of the free intrinsics, the views' overdispersion included."""
    spread = overdispersion(evidence(fit.calibration))
    return spread * np.array(list(fit.covariance.sigma().values()))


def _views_left(fit: Intrinsics) -> set[str]:
    return {one.name for one in fit.left_out if one.kind == "view"}


def _faults(clean: Intrinsics, fit: Intrinsics, bad: Sequence[str], most: float = 1.0) -> list[str]:
    """What is not as it would be without the bad pictures."""
    faults = []
    if fit.verdict.word != clean.verdict.word:
        faults.append(f"{clean.verdict.word} became {fit.verdict.word}")
    if innocent := _views_left(fit) - set(bad) - _views_left(clean):
        faults.append(f"blames {sorted(innocent)}")
    before, after = clean.calibration, fit.calibration
    moved = np.abs(after.block.intrinsics - before.block.intrinsics)
    if moved[0] > 2 * _sigma(clean)[0]:
        faults.append(f"fx off by {moved[0] / _sigma(clean)[0]:.1f} sigma")
    if not set(bad) <= _views_left(fit):
        same = before.camera.model == after.camera.model
        share = (moved[before.free] / _sigma(clean)).max() if same else moved[0] / _sigma(clean)[0]
        if share > most:
            faults.append(f"not named, moves {share:.1f} sigma")
    return faults


def test_one_step_without_a_view_agrees_with_a_fit_without_it() -> None:
    rng = np.random.default_rng(4)
    camera = camera_of()
    views = take(rng, camera, 12)
    views[3] = replace(views[3], pixels=sheared(views[3], camera, rng))
    fit = calibrate(pack(views), SIZE, "radial2")
    asked = agreement(fit, np.ones(12, dtype=np.bool_))
    for i in range(12):
        without = refitted(fit, np.setdiff1d(np.arange(12), [i]))
        true = (without.block.intrinsics - fit.block.intrinsics)[fit.free]
        np.testing.assert_allclose(asked.shift[i] / asked.sigma, true / asked.sigma, atol=0.05, rtol=0.05)
    # The view that is left out and asked how it would move the others answers with the same step.
    rest = np.arange(12) != 3
    asked = agreement(fit, rest)
    true = (fit.block.intrinsics - refitted(fit, np.flatnonzero(rest)).block.intrinsics)[fit.free]
    assert np.argmax(asked.moved) == 3
    assert asked.chance[3] < 1e-6 < asked.chance[rest].min()
    assert asked.moved[3] == pytest.approx(np.max(np.abs(true) / asked.sigma), rel=0.1)


def test_a_lens_that_warms_up_is_in_sigma() -> None:
    """One percent of the focal length from the first picture to the last."""
    z = []
    for seed in range(3):
        camera, rng, views = camera_of(), np.random.default_rng(seed), list[View]()
        recipe = Recipe(0.03)
        good = take(rng, camera, 18, recipe=recipe)
        assert drift(calibrate(pack(good), SIZE, "radial2")) is None
        # One view through another zoom at an end is no change either.
        middle = np.array([camera.cx_px, camera.cy_px])
        for end in (0, 17):
            zoomed = list(good)
            zoomed[end] = replace(good[end], pixels=middle + 0.9 * (good[end].pixels - middle))
            assert drift(calibrate(pack(zoomed), SIZE, "radial2")) is None
        for k in range(18):
            focal_px = camera.fx_px * (0.995 + 0.01 * k / 17)
            other = replace(camera, fx_px=focal_px, fy_px=focal_px)
            views += take(rng, other, 1, recipe=recipe, prefix=f"{k:02d}")
        found = calibrate_camera(views, SIZE, Choices())
        sigma = found.covariance.sigma()["fx_px"]
        assert sigma > 0.002 * camera.fx_px
        z.append((found.calibration.camera.fx_px - camera.fx_px) / sigma)
    assert np.abs(z).max() < 3.0


@pytest.mark.parametrize("kind", SPOILS)
@pytest.mark.parametrize(("count", "seed"), [pytest.param(14, 3, marks=pytest.mark.slow), (6, 8)])
def test_a_bad_view_leaves(kind: str, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = camera_of()
    views = take(rng, camera, count, recipe=Recipe(tilt_deg=(15.0, 40.0)))
    clean = calibrate_camera(views[1:], SIZE, Choices("radial2"))
    bad = replace(views[0], name="bad", pixels=SPOILS[kind](views[0], camera, rng))
    fit = calibrate_camera([*views[1:], bad], SIZE, Choices("radial2"))
    # Five others are too few to tell less than three standard deviations from chance.
    assert _faults(clean, fit, ["bad"], 1.0 if count > 6 else 3.0) == []
    kept = calibrate_camera([*views[1:], bad], SIZE, Choices("radial2", keep_all=True))
    assert kept.calibration.observations.views == count
    assert kept.verdict.word == ("inconsistent" if "bad" in _views_left(fit) else "ok")
    if "bad" in _views_left(fit):
        assert kept.verdict.reasons[0].startswith("bad does not agree with the others: ")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "kinds", [("zoom 0.9", "zoom 0.9"), ("shear 8 px", "mirrored"), ("blur", "wavy 2 px")]
)
def test_two_bad_views_leave(kinds: tuple[str, str]) -> None:
    rng = np.random.default_rng(1)
    camera = camera_of()
    views = take(rng, camera, 14, recipe=Recipe(tilt_deg=(15.0, 40.0)))
    clean = calibrate_camera(views[2:], SIZE, Choices("radial2"))
    bad = [
        replace(views[i], name=f"bad{i}", pixels=SPOILS[kind](views[i], camera, rng))
        for i, kind in enumerate(kinds)
    ]
    fit = calibrate_camera([*views[2:], *bad], SIZE, Choices("radial2"))
    assert _faults(clean, fit, ["bad0", "bad1"]) == []


def _turned(view: View, how: str) -> View:
    """The view as found in the picture after it was turned or mirrored, where corners have another order."""
    last = np.array(SIZE) - 1.0
    sides = {"turned by half a turn": [True, True], "mirrored left to right": [True, False]}[how]
    pixels = np.where(sides, last - view.pixels, view.pixels)
    # A board of 7 x 5 is not mirrored when it is found: its rows then run the other way.
    order = np.arange(35).reshape(5, 7)[:, :: 1 if all(sides) else -1].ravel()
    return replace(view, pixels=pixels[order])


@pytest.mark.few(0)
@pytest.mark.parametrize(
    ("how", "count", "bad"),
    [
        ("turned by half a turn", 13, 4),
        ("mirrored left to right", 13, 4),
        ("mirrored left to right", 13, 1),
        ("turned by half a turn", 30, 14),
    ],
)
def test_turned_pictures_are_named(how: str, count: int, bad: int) -> None:
    """The centre is off by 12 px: all are named and no other, and what is left is the camera without them."""
    rng = np.random.default_rng(5)
    camera = camera_of(off_centre_px=(12.0, 8.0))
    views = take(rng, camera, count, recipe=Recipe(tilt_deg=(15.0, 40.0)))
    clean = calibrate_camera(views[bad:], SIZE, Choices("radial2"))
    fit = calibrate_camera([*(_turned(one, how) for one in views[:bad]), *views[bad:]], SIZE, Choices())
    named = {one.name: one.why for one in fit.left_out if one.kind == "view"}
    assert set(named) - _views_left(clean) == {one.name for one in views[:bad]}
    assert all(f"if it was {how}" in named[one.name] for one in views[:bad])
    assert fit.calibration.camera.cx_px == pytest.approx(camera.cx_px, abs=1.0)
    assert fit.verdict.word == ("inconsistent" if bad > 0.2 * count else clean.verdict.word)


@pytest.mark.parametrize("off_centre_px", [(4.0, -3.0), (0.0, 0.0), (25.0, 10.0)])
def test_views_as_taken_are_not_turned(off_centre_px: tuple[float, float]) -> None:
    for seed in range(8):
        camera = camera_of(off_centre_px=off_centre_px)
        views = take(np.random.default_rng(seed), camera, (5, 13)[seed % 2])
        assert turned_views(calibrate(pack(views), SIZE, "radial2")) == []


@pytest.mark.few(1)
@pytest.mark.parametrize("bow", [0.005, 0.01])
def test_pictures_of_a_bent_board_are_not_turned(bow: float) -> None:
    """The bow pulls the centre to one side or the other with the tilt, as turning a picture would."""
    suspected = 0
    for seed in range(4):
        views = take(np.random.default_rng(seed), camera_of(), 14, recipe=Recipe(bow_m=bow * 0.2))
        suspected += bool(turned_views(calibrate(pack(views), SIZE, "radial2")))
        rigid = calibrate_camera(views, SIZE, Choices("radial2"))
        assert not any("if it was" in one.why for one in rigid.left_out)
        assert any("not flat" in text for text in (*rigid.verdict.reasons, *rigid.verdict.remarks))
    assert suspected


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(0.03, aspect=1.005),
        pytest.param(Recipe(0.03, bow_m=5e-4), marks=pytest.mark.slow),
        pytest.param(Recipe(0.03, aspect=0.998), marks=pytest.mark.slow),
    ],
)
def test_a_board_that_is_not_as_described_blames_no_view_and_is_in_sigma(recipe: Recipe) -> None:
    """Half a percent, as printers stretch: it moves fx by up to five of the deviations of its corners."""
    z = []
    for seed in range(3):
        camera = camera_of()
        views = take(np.random.default_rng(seed), camera, 18, recipe=recipe)
        found = calibrate_camera(views, SIZE, Choices())
        assert not _views_left(found)
        sigma = found.covariance.sigma()
        z += [(found.calibration.camera.fx_px - camera.fx_px) / sigma["fx_px"]]
        z += [(found.calibration.camera.cx_px - camera.cx_px) / sigma["cx_px"]]
        # The poses take up most of what the intrinsics move by: 3 to 10 px of a centre.
        at = np.array([[200.0, 150.0], [320.0, 240.0], [440.0, 330.0]])
        assert np.max(projection_sigma_px(found.calibration, found.covariance, at)) < 0.5
    assert np.abs(z).max() < 3.0


@pytest.mark.parametrize("kind", SPOILS)
def test_beside_a_bad_view_no_other_looks_turned(kind: str) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        camera = camera_of()
        views = take(rng, camera, (8, 14)[seed % 2], recipe=Recipe(tilt_deg=(15.0, 40.0)))
        bad = replace(views[0], name="bad", pixels=SPOILS[kind](views[0], camera, rng))
        found = turned_views(calibrate(pack([bad, *views[1:]]), SIZE, "radial2"))
        assert {one.name for one in found} <= {"bad"}


def test_one_bad_view_is_no_change_of_all() -> None:
    for seed in range(3):
        rng, camera = np.random.default_rng(seed), camera_of()
        views = take(rng, camera, 12, recipe=Recipe(0.03))
        views[0] = replace(views[0], pixels=sheared(views[0], camera, rng))
        fit = calibrate(pack(views), SIZE, "radial2")
        alone, together = alone_px(fit)
        assert fit.sigma_px > 1.5 * alone
        assert together < 1.25 * alone


def test_two_covered_corners_leave_without_their_view() -> None:
    views = take(
        np.random.default_rng(3), camera_of(), 12, recipe=Recipe(noise_px=0.01, tilt_deg=(15.0, 40.0))
    )
    pixels = views[4].pixels.copy()
    pixels[[0, 9]] += [[0.3, -0.2], [0.1, 0.35]]
    views[4] = replace(views[4], pixels=pixels)
    found = triage(calibrate(pack(views), SIZE, "radial2"))
    assert [(one.name, one.kind) for one in found.left_out] == [("v04", "points")]
    assert found.left_out[0].why.startswith("without 2 of its points, up to 0.37 px from")


def test_more_than_a_fifth_leaving_is_a_finding() -> None:
    rng = np.random.default_rng(2)
    camera = camera_of()
    views = take(rng, camera, 12, recipe=Recipe(tilt_deg=(15.0, 40.0)))
    for i in range(3):
        views[i] = replace(views[i], pixels=sheared(views[i], camera, rng))
    verdict = calibrate_camera(views, SIZE, Choices("radial2")).verdict
    assert verdict.word == "inconsistent"
    assert verdict.reasons[0].startswith(
        "3 of 12 pictures are left out for disagreeing with the others: v00, v01, v02"
    )


def _clean_set(seed: int, least: int = 8) -> tuple[list[View], Camera]:
    """A good set: noise that differs from view to view and grows with the tilt; every other with skew."""
    rng = np.random.default_rng([seed, 77])
    size = SIZES[rng.integers(len(SIZES))]
    count = int(rng.integers(least, 41))
    camera = camera_of(size, rng.uniform(45, 80), (rng.uniform(-0.25, 0), rng.uniform(0, 0.1)))
    if seed % 2:
        camera = replace(camera, skew_px=float(rng.normal(0.0, 0.002)) * camera.fx_px)
    noise = float(np.exp(rng.uniform(np.log(0.03), np.log(0.3))))
    views = []
    for view in take(rng, camera, count, recipe=Recipe(noise_px=0.0, tilt_deg=(5.0, 42.0))):
        extent = np.linalg.svd(view.pixels - view.pixels.mean(axis=0), compute_uv=False)
        lean = float(np.clip(extent[0] / extent[1] / 1.5, 1.0, 2.5)) ** 0.5
        own = noise * lean * float(np.exp(rng.normal(0.0, 0.3)))
        views.append(replace(view, pixels=view.pixels + own * rng.standard_normal(view.pixels.shape)))
    return views, camera


def _false_alarms(seeds: range, skew: bool) -> tuple[int, int, list[float]]:
    """Views, those that leave, and by how many standard deviations fx then moves."""
    total, left, cost = 0, 0, []
    for seed in seeds:
        views, camera = _clean_set(seed)
        fit = calibrate(pack(views), camera.image_size_px, "radial2", skew=skew)
        with np.errstate(all="ignore"):
            found = triage(fit)
        total += len(views)
        if found.left_out:
            left += sum(one.kind == "view" for one in found.left_out)
            fx = found.calibration.camera.fx_px
            cost.append(abs(fx - fit.camera.fx_px) / covariance(fit).sigma()["fx_px"])
    return total, left, cost


def test_views_of_a_good_set_stay() -> None:
    total, left, _ = _false_alarms(range(1000, 1020), True)
    assert total > 300
    assert left <= 0.01 * total


@pytest.mark.slow
@pytest.mark.parametrize("skew", [True, False])
def test_false_alarms_over_many_good_sets(skew: bool) -> None:
    total, left, cost = _false_alarms(range(400), skew)
    print(
        f"\nskew {'estimated' if skew else 'ignored'}: {left} of {total} views leave ({left / total:.2%})",
        end="",
    )
    print(f", fx moves by {np.median(cost or [0]):.1f} sigma (median), {max(cost, default=0):.1f} at most")
    assert left <= 0.01 * total


# ----------------------------------------------------------------------
# Bad pictures among real and rendered ones.


def _remapped(picture: GrayImage, u: FloatArray, v: FloatArray) -> GrayImage:
    moved = cv2.remap(picture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=1)
    return np.asarray(moved, dtype=np.uint8)


def _spoilt(picture: GrayImage, kind: str) -> GrayImage:
    height, width = picture.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = u - width / 2, v - height / 2
    if kind.startswith("blur"):
        length = int(kind.split()[1])
        return np.asarray(cv2.blur(picture, (length, 1)), dtype=np.uint8)
    if kind.startswith("zoom"):
        factor = float(kind.split()[1])
        return _remapped(picture, x / factor + width / 2, y / factor + height / 2)
    if kind == "shear 8 px":
        return _remapped(picture, u + 8 * (v / height - 0.5), v)
    if kind == "wavy 2 px":
        wave = 8 * np.pi / np.array([width, height])
        return _remapped(picture, u + 2 * np.sin(wave[1] * v), v + 2 * np.sin(wave[0] * u))
    if kind == "mirrored":
        return picture[:, ::-1].copy()
    if kind == "half occluded":
        hidden = picture.copy()
        hidden[:, : width // 2] = 90
        return hidden
    assert kind == "another camera"
    x, y = (x - 12) / width, (y + 9) / width
    factor = (1 + 0.05 * (x**2 + y**2)) / 1.06 * width
    return _remapped(picture, x * factor + width / 2, y * factor + height / 2)


KINDS = (
    "blur 9", "blur 21", "shear 8 px", "zoom 0.9", "zoom 0.97", "wavy 2 px", "mirrored", "another camera",
    "half occluded",
)  # fmt: skip
SETS = ("shipped", "rendered", "opencv_left", "gloworm_qvga", "udacity_lane")


def _rendered() -> tuple[list[GrayImage], tuple[int, int]]:
    rng = np.random.default_rng(6)
    camera, printed = camera_of(), PrintedBoard(Board(7, 5, 0.020))
    poses = take(rng, camera, 14, recipe=Recipe(noise_px=0.0, tilt_deg=(15.0, 40.0)))
    seen = [fit_pose(camera, view.target_m, view.pixels) for view in poses]
    return [render(camera, printed, Pose(s.R_CW, s.t_CW_m), seed=i) for i, s in enumerate(seen)], (7, 5)


def _pictures(name: str, request: pytest.FixtureRequest) -> tuple[list[GrayImage], tuple[int, int]]:
    if name == "rendered":
        return _rendered()
    if name == "shipped":
        folder, corners = request.getfixturevalue("project_root") / "images", (7, 5)
    else:
        folder = request.getfixturevalue("shared_data") / name
        corners = {"opencv_left": (9, 6), "gloworm_qvga": (8, 6), "udacity_lane": (9, 6)}[name]
    pictures = [read_picture(path) for path in list_pictures([folder])]
    size = usual_size(pictures)
    return [one.gray for one in pictures if one.size_px == size], corners


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_a_bad_picture_among_good_ones(name: str, request: pytest.FixtureRequest) -> None:
    """Prints a table: what happens to each kind of bad picture, made of three pictures of the set in turn."""
    pictures, corners = _pictures(name, request)
    size = (pictures[0].shape[1], pictures[0].shape[0])
    target = Board(*corners, 0.02).points_m()

    def view_of(picture: GrayImage, name: str) -> View | None:
        seen = detect(picture, *corners)
        return None if seen is None else View(name, target, seen.pixels, seen.refined)

    good = [view for i, one in enumerate(pictures) if (view := view_of(one, f"{i:02d}"))]
    faults: list[str] = []
    print(f"\n{name}: {len(good)} of {len(pictures)} pictures")
    for base in good[1 :: max(1, len(good) // 3)][:3]:
        others = [view for view in good if view is not base]
        clean = calibrate_camera(others, size)
        for kind in KINDS:
            bad = view_of(_spoilt(pictures[int(base.name)], kind), "bad")
            if bad is None:
                print(f"  {base.name} {kind:15} board not recognised")
                continue
            fit = calibrate_camera([*others, bad], size)
            wrong = _faults(clean, fit, ["bad"])
            fx = abs(fit.calibration.camera.fx_px - clean.calibration.camera.fx_px) / _sigma(clean)[0]
            named = "named" if "bad" in _views_left(fit) else "stays"
            print(f"  {base.name} {kind:15} {named}, fx {fx:.2f} sigma off {'; '.join(wrong)}")
            faults += [f"{base.name} {kind}: {one}" for one in wrong]
    # A tenth of them may stay that moves some parameter by little more than a standard deviation.
    serious = [one for one in faults if "not named" not in one]
    assert serious == []
    assert len(faults) <= 3


def test_two_views_of_another_crop_leave_and_are_no_second_camera_with_a_third() -> None:
    rng, camera = np.random.default_rng(1), camera_of()
    views = take(rng, camera, 10, recipe=Recipe(0.02, tilt_deg=(15.0, 45.0)))
    views = [replace(one, pixels=one.pixels - 30.0 * (i in (2, 5))) for i, one in enumerate(views)]
    found = calibrate_camera(views, SIZE, Choices("radial2"))
    assert _views_left(found) == {"v02", "v05"}
    assert found.verdict.word == "ok"
    assert found.calibration.rms_px < 0.04


@pytest.mark.parametrize(("moved_px", "word"), [(6.0, "poor"), (0.0, "ok")])
def test_a_board_that_moves_before_a_rolling_shutter_is_said(moved_px: float, word: str) -> None:
    """Up to so many pixels from the picture's first row to its last: fx is 2 % off."""
    rng, camera = np.random.default_rng(5), camera_of()
    views = take(rng, camera, 10, recipe=Recipe(0.02, tilt_deg=(15.0, 45.0)))
    for i, one in enumerate(views):
        moved = moved_px * rng.uniform(-1.0, 1.0, 2) * (one.pixels[:, 1:] / SIZE[1] - 0.5)
        views[i] = replace(one, pixels=one.pixels + moved)
    found = calibrate_camera(views, SIZE, Choices("radial2")).verdict
    assert found.word == word
    assert any("changes from picture to picture" in one for one in found.reasons) == (moved_px > 0.0)


def test_a_lens_that_focuses_anew_for_each_picture_is_said() -> None:
    """By up to 4 %. Distance takes up most of that: .09 px are left, six times the corners' noise."""
    rng, camera = np.random.default_rng(6), camera_of()
    views = take(rng, camera, 10, recipe=Recipe(0.01, tilt_deg=(15.0, 45.0)))
    middle = np.array([camera.cx_px, camera.cy_px])
    views = [
        replace(one, pixels=middle + (1.0 + 0.04 * rng.uniform(-1.0, 1.0)) * (one.pixels - middle))
        for one in views
    ]
    found = calibrate_camera(views, SIZE, Choices("radial2"))
    assert found.verdict.word == "poor"
    assert any("changes from picture to picture" in one for one in found.verdict.reasons)

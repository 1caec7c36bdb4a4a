"""Finding boards: every board of the real sets, the truth of rendered ones, and none where there is none."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.core.arrays import FloatArray, GrayImage
from calib.io.pictures import list_pictures, read_picture
from calib.stages.camera import refine
from calib.stages.camera.bundle import calibrate
from calib.stages.camera.corners import Detection, detect, find_size
from calib.stages.camera.model import Board, Camera, View, pack
from calib.stages.camera.read import find_boards
from calib.stages.camera.refine import frames_of
from calib.twin.scene import PrintedBoard, Sensor, corner_pixels, pose_facing, render

LENS = np.array([-0.22, 0.12, 0, 0, 0, 0, 0, 0.0])
VGA = Camera("radial2", (640, 480), 545.0, 545.0, 0.0, 323.3, 237.9, LENS)
PIXY = Camera("radial2", (316, 208), 270.0, 270.0, 0.0, 161.3, 101.9, LENS)


def _picture(
    camera: Camera, board: Board, seed: int, roll_rad: float | None = None, **sensor: float
) -> tuple[GrayImage, FloatArray]:
    rng = np.random.default_rng(seed)
    width, height = camera.image_size_px
    printed = PrintedBoard(board)
    pose = pose_facing(
        camera,
        printed,
        (width * rng.uniform(0.45, 0.55), height * rng.uniform(0.45, 0.55)),
        (board.columns + 2) * board.square_m * camera.fx_px / width * rng.uniform(1.25, 1.7),
        tilt_rad=rng.uniform(0, 0.6),
        azimuth_rad=rng.uniform(0, 2 * np.pi),
        roll_rad=rng.uniform(-0.4, 0.4) if roll_rad is None else roll_rad,
    )
    chosen = {"blur_px": 0.7, "noise_grey": 2.0, "gamma": 1.3} | sensor
    image = render(camera, printed, pose, sensor=Sensor(**chosen), background=0.4, seed=seed)
    return image, corner_pixels(camera, printed, pose)


@pytest.mark.few(0)
@pytest.mark.parametrize(
    ("folder", "size", "rms_px"), [("opencv_left", (9, 6), 0.170), ("gloworm_qvga", (8, 6), 0.068)]
)
def test_every_board_of_the_real_sets(
    shared_data: Path, folder: str, size: tuple[int, int], rms_px: float
) -> None:
    pictures = [read_picture(path) for path in list_pictures([shared_data / folder])]
    board = Board(*size, 0.025)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda p: detect(p.gray, *size), pictures))
    views = [
        View(p.name, board.points_m(), d.pixels, d.refined)
        for p, d in zip(pictures, found, strict=True)
        if d is not None
    ]
    assert len(views) == len(pictures)
    assert calibrate(pack(views), pictures[0].size_px, "radial2").rms_px <= rms_px


def _opencv_classic(gray: GrayImage, size: tuple[int, int]) -> FloatArray | None:
    found, corners = cv2.findChessboardCorners(gray, size)
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    return cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), ends).reshape(-1, 2) if found else None


def _opencv_sb(gray: GrayImage, size: tuple[int, int], flags: int = 0) -> FloatArray | None:
    found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_ACCURACY | flags)
    return corners.reshape(-1, 2) if found else None


def _opencv_exhaustive(gray: GrayImage, size: tuple[int, int]) -> FloatArray | None:
    return _opencv_sb(gray, size, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE)


def _unsharp(radius_px: float, gain: float) -> Callable[[GrayImage], GrayImage]:
    def sharpened(gray: GrayImage) -> GrayImage:
        picture = gray.astype(np.float32)
        halo = gain * (picture - cv2.GaussianBlur(picture, (0, 0), radius_px))
        return np.clip(picture + halo, 0, 255).astype(np.uint8)

    return sharpened


def _otsu(gray: GrayImage) -> GrayImage:
    return np.asarray(cv2.threshold(gray, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[1])


def _jpeg(gray: GrayImage) -> GrayImage:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, 10])[1], 0))


def _gamma(power: float) -> Callable[[GrayImage], GrayImage]:
    return lambda gray: np.asarray(255 * (gray / 255) ** power).astype(np.uint8)


VARIANTS: dict[str, Callable[[GrayImage], GrayImage]] = {
    "as taken": lambda gray: gray,
    "sharpened 1 px": _unsharp(1.0, 3.0),
    "sharpened 2 px": _unsharp(2.0, 2.0),
    "sharpened 3 px": _unsharp(3.0, 4.0),
    "two tones": _otsu,
    "JPEG 10": _jpeg,
    "bright": _gamma(0.4),
    "dark": _gamma(2.5),
    "overexposed": lambda gray: np.clip(1.6 * gray + 40, 0, 255).astype(np.uint8),
    "blurred": lambda gray: np.asarray(cv2.GaussianBlur(gray, (0, 0), 2.0)),
    "median": lambda gray: np.asarray(cv2.medianBlur(gray, 5)),
    "half": lambda gray: np.asarray(cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)),
    "double": lambda gray: np.asarray(cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)),
    "pale": lambda gray: (100 + 0.15 * gray).astype(np.uint8),
}


@pytest.mark.few(0)
@pytest.mark.parametrize(
    ("folder", "size", "variant"),
    [
        ("gloworm_qvga", (8, 6), "sharpened 1 px"),
        ("gloworm_qvga", (8, 6), "sharpened 3 px"),
        ("opencv_left", (9, 6), "two tones"),
        ("opencv_left", (9, 6), "overexposed"),
    ],
)
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_sharpened_boards_are_found(
    shared_data: Path, folder: str, size: tuple[int, int], variant: str, every: int
) -> None:
    for path in list_pictures([shared_data / folder])[::every]:
        found = detect(VARIANTS[variant](read_picture(path).gray), *size)
        assert found is not None, path.name
        assert found.refined.mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("folder", "size"),
    [("opencv_left", (9, 6)), ("gloworm_qvga", (8, 6)), ("udacity_lane", (9, 6)), ("ocam_fish2", (8, 6))],
)
def test_as_many_boards_as_the_best_of_opencvs_finders(
    shared_data: Path, folder: str, size: tuple[int, int], variant: str
) -> None:
    grays = [VARIANTS[variant](read_picture(path).gray) for path in list_pictures([shared_data / folder])]
    finders = (_opencv_classic, _opencv_sb, _opencv_exhaustive)
    theirs = [sum(find(gray, size) is not None for gray in grays) for find in finders]
    assert sum(detect(gray, *size) is not None for gray in grays) >= max(theirs)


@pytest.mark.few(1)
@pytest.mark.parametrize(("camera", "most_px"), [(VGA, 0.02), (PIXY, 0.025)], ids=["640x480", "316x208"])
def test_error_against_rendered_truth_is_below_opencvs(camera: Camera, most_px: float) -> None:
    board = Board(9, 6, 0.025)
    finders: dict[str, Callable[[GrayImage], FloatArray | None]] = {
        "ours": lambda gray: detection.pixels if (detection := detect(gray, 9, 6)) else None,
        "classic": lambda gray: _opencv_classic(gray, (9, 6)),
        "sb": lambda gray: _opencv_sb(gray, (9, 6)),
    }
    errors: dict[str, list[float]] = {name: [] for name in finders}
    for seed in range(4):
        gray, truth = _picture(camera, board, seed)
        for name, find in finders.items():
            corners = find(gray)
            assert corners is not None or name != "ours"
            if corners is not None:
                squared = min(float(np.mean((c - truth) ** 2)) for c in (corners, corners[::-1]))
                errors[name].append(squared)
    rmse = {name: float(np.sqrt(np.mean(values))) for name, values in errors.items() if values}
    assert rmse["ours"] <= most_px
    assert all(rmse["ours"] < value for name, value in rmse.items() if name != "ours"), rmse


PARALLEL = 0.04
"""Roll of a board whose edges run almost along the pixels, rad."""
LARGE = Camera("pinhole", (1280, 960), 1100.0, 1100.0, 0.0, 640.3, 478.9, np.zeros(8))


def _error(detection: Detection | None, truth: FloatArray) -> FloatArray:
    assert detection is not None
    pixels = detection.pixels
    return min((pixels - truth, pixels[::-1] - truth), key=lambda error: float(np.sum(error**2)))


@pytest.mark.few(0, 2)
@pytest.mark.parametrize(
    ("camera", "size", "roll_rad", "blur_px", "after"),
    [
        (PIXY, (9, 6), PARALLEL, 0.3, "as taken"),
        (VGA, (9, 6), PARALLEL, 0.3, "as taken"),
        # Squares of 200 px, which are averaged over blocks where edges are blurred.
        pytest.param(LARGE, (4, 3), PARALLEL, 0.3, "as taken", marks=pytest.mark.slow),
        pytest.param(LARGE, (4, 3), PARALLEL, 0.7, "as taken", marks=pytest.mark.slow),
        pytest.param(LARGE, (4, 3), None, 3.0, "as taken", marks=pytest.mark.slow),
        (VGA, (9, 6), None, 0.7, "sharpened 1 px"),
        (VGA, (9, 6), PARALLEL, 0.7, "sharpened 2 px"),
        (VGA, (9, 6), None, 0.7, "sharpened 2 px"),
    ],
)
def test_sharp_edges_are_placed_to_a_hundredth_of_a_pixel(
    camera: Camera, size: tuple[int, int], roll_rad: float | None, blur_px: float, after: str
) -> None:
    """RMSE of at most .012 px, or what the noise allows, and an honest sigma."""
    errors, sigmas = [], []
    for seed in range(4):
        gray, truth = _picture(camera, Board(*size, 0.025), seed, roll_rad, blur_px=blur_px, gamma=1.0)
        detection = detect(VARIANTS[after](gray), *size)
        errors.append(_error(detection, truth))
        sigmas.append(detection.sigma_px)
    rmse, sigma = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(sigmas)))
    assert rmse < max(0.012, 1.2 * sigma)
    assert rmse < 1.6 * sigma
    assert np.max(np.abs(errors)) < 0.1


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("camera", "moved"),
    [(PIXY, np.eye(9)), (PIXY, np.eye(9)[::-1]), (VGA, np.eye(21))],
    ids=["316x208 down", "316x208 up", "640x480 down"],
)
def test_boards_that_moved_aslant_are_placed_as_where_they_were_in_the_middle(
    camera: Camera, moved: FloatArray
) -> None:
    """By half to all of a square, which leaves each corner two places beside the true one."""
    for seed in range(2):
        gray, truth = _picture(camera, Board(9, 6, 0.025), seed)
        detection = detect(cv2.filter2D(gray, -1, moved / moved.sum()), 9, 6)
        error = _error(detection, truth)
        assert np.sqrt(np.mean(error**2)) < 0.05
        assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean(detection.sigma_px**2))


def test_boards_whose_white_bleeds_into_black_are_found() -> None:
    for seed in range(3):
        gray, truth = _picture(PIXY, Board(9, 6, 0.025), seed)
        lit = 1.8 * gray.astype(np.float32)
        shine = cv2.GaussianBlur(np.maximum(lit - 160, 0), (0, 0), 3.0)
        detection = detect(np.clip(lit + shine, 0, 255).astype(np.uint8), 9, 6)
        assert np.abs(_error(detection, truth)).max() < 0.1


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("lit", "share"),
    [
        pytest.param(lambda u, v: 1.0, 0.75, id="even"),
        pytest.param(lambda u, v: 0.4 + 0.6 * u, 0.75, id="from a side"),
        pytest.param(lambda u, v: 1 / (1 + 5 * ((u - 0.2) ** 2 + (v - 0.3) ** 2)), 0.85, id="by a lamp"),
        pytest.param(lambda u, v: 0.55 + 0.45 * (u + 0.6 * v > 0.8), 1.05, id="with a hard shadow"),
        pytest.param(
            lambda u, v: 0.8 + 0.15 * np.sin(2 * np.pi * u / 0.17) * np.cos(2 * np.pi * v / 0.2),
            1.15,
            id="with ripples of two squares",
        ),
    ],
)
def test_the_light_at_the_other_corners_places_a_blurred_one(
    monkeypatch: pytest.MonkeyPatch, lit: Callable[[FloatArray, FloatArray], FloatArray], share: float
) -> None:
    """RMSE with the light's gradient from the corners beside, over that with one from its own window."""
    height, width = PIXY.image_size_px[::-1]
    v, u = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
    shown = []
    for seed in range(4):
        gray, truth = _picture(PIXY, Board(9, 6, 0.025), seed, blur_px=2.5, gamma=1.0, noise_grey=0.0)
        noise = np.random.default_rng(seed).normal(0.0, 2.0, gray.shape)
        shown.append((np.clip(np.rint(gray * lit(u, v) + noise), 0, 255).astype(np.uint8), truth))

    def rmse() -> float:
        return float(np.sqrt(np.mean([_error(detect(gray, 9, 6), truth) ** 2 for gray, truth in shown])))

    ours = rmse()
    monkeypatch.setattr(refine, "frames_of", lambda points, tones=None: frames_of(points))
    assert ours < share * rmse()


@pytest.mark.few(0)
@pytest.mark.parametrize("size", [(7, 5), (9, 6), (4, 4), (5, 4)])
def test_indices_keep_their_corners_at_every_angle(size: tuple[int, int]) -> None:
    board = Board(*size, 0.02)
    for step in range(12):
        roll = np.deg2rad(30 * step + 7)
        gray, truth = _picture(PIXY, board, 3, roll_rad=roll)
        detection = detect(gray, *size)
        assert detection is not None, np.rad2deg(roll)
        grid = truth.reshape(size[1], size[0], 2)
        turns = range(4) if size[0] == size[1] else (0, 2)
        off = [float(np.abs(np.rot90(grid, t).reshape(-1, 2) - detection.pixels).max()) for t in turns]
        assert min(off) < 0.5
        found = detection.pixels.reshape(size[1], size[0], 2)
        along, across = found[:, -1].mean(0) - found[:, 0].mean(0), found[-1].mean(0) - found[0].mean(0)
        # Never mirrored: rows run clockwise from columns.
        assert along[0] * across[1] - along[1] * across[0] > 0
        if (size[0] + size[1]) % 2 == 0 and size[0] != size[1]:
            assert along[0] > 0
        if (size[0] + size[1]) % 2 == 1:
            # The square outward of corner (0, 0) is dark.
            u, v = 1.5 * found[0, 0] - 0.5 * found[1, 1]
            bright = 1.5 * found[0, -1] - 0.5 * found[1, -2]
            assert gray[round(v), round(u)] < gray[round(bright[1]), round(bright[0])]


@pytest.mark.few(1, 3)
@pytest.mark.parametrize(
    ("what", "sensor"),
    [
        ("blurred", {"blur_px": 1.6}),
        ("noisy", {"noise_grey": 10.0}),
        ("dark response", {"gamma": 2.2}),
        ("shaken", {"motion_px": (2.0, 1.0)}),
    ],
)
def test_hard_pictures_are_found_and_honest(what: str, sensor: dict[str, float]) -> None:
    gray, truth = _picture(VGA, Board(9, 6, 0.025), 5, **sensor)
    detection = detect(gray, 9, 6)
    assert detection is not None, what
    error = min(np.sqrt(np.mean((c - truth) ** 2)) for c in (detection.pixels, detection.pixels[::-1]))
    assert error < 0.08
    assert detection.refined.mean() > 0.9
    # Sigma from the fits themselves covers the error.
    assert error < 4 * np.median(detection.sigma_px) + 0.01


@pytest.mark.parametrize("frame", ["014", "016", "020", "028"])
def test_interlaced_and_sharpened_boards_are_found(shared_data: Path, frame: str) -> None:
    """Squares of 16 px whose edges are jagged by a pixel; OpenCV's classic finder finds three of them."""
    gray = read_picture(shared_data / "sks_charuco_left" / f"Frame_{frame}.jpg").gray
    found = detect(gray, 13, 8)
    assert found is not None
    assert found.refined.all()


def test_a_board_that_moves_between_two_fields_is_found_at_their_mean_moment(tmp_path: Path) -> None:
    """The first field alone shows it up to 2 px beside, and every other row errs by .02 px and more."""
    board, at = Board(9, 6, 0.025), (316.0, 236.0)
    poses = [
        pose_facing(VGA, PrintedBoard(board), (at[0] + moved, at[1]), 0.35, 0.5, 0.7, PARALLEL)
        for moved in (-2.0, 0.0, 2.0)
    ]
    light = Sensor(blur_px=0.7, noise_grey=1.0)
    fields = [render(VGA, PrintedBoard(board), pose, sensor=light, background=0.4) for pose in poses[::2]]
    fields[0][1::2] = fields[1][1::2]
    cv2.imwrite(str(tmp_path / "woven.png"), fields[0])
    view = find_boards([tmp_path / "woven.png"], (9, 6), 0.025).views[0]
    truth = corner_pixels(VGA, PrintedBoard(board), poses[1])
    error = min((view.pixels - truth, view.pixels[::-1] - truth), key=lambda off: float(np.sum(off**2)))
    assert np.sqrt(np.mean(error**2)) < 0.008
    assert view.measured is None or view.measured.all()


def _shaded(gray: GrayImage, share: float) -> GrayImage:
    """A shadow with a soft edge over the left half, with so much of the light."""
    v, u = np.indices(gray.shape)
    inside = 1.0 / (1.0 + np.exp((u - 0.5 * gray.shape[1] - 0.2 * v) / 6.0))
    return np.asarray(gray * (1.0 - (1.0 - share) * inside)).astype(np.uint8)


def _lit(gray: GrayImage, corners: FloatArray) -> GrayImage:
    """A lamp's reflection over one square."""
    v, u = np.indices(gray.shape)
    side = np.linalg.norm(corners[1] - corners[0])
    away = np.hypot(u - corners[20, 0] - 0.5 * side, v - corners[20, 1] - 0.5 * side)
    return np.clip(gray + 255.0 * np.exp(-((away / (0.8 * side)) ** 4)), 0, 255).astype(np.uint8)


def test_boards_in_light_through_blinds_are_found() -> None:
    """Bars as wide as squares, with a third of the light, cross them all."""
    for seed in range(4):
        gray, truth = _picture(PIXY, Board(9, 6, 0.025), seed)
        v, u = np.indices(gray.shape)
        phase = 2.0 * np.pi * (0.98 * v + 0.2 * u) / 20.8
        barred = gray * (0.35 + 0.65 / (1.0 + np.exp(-2.2 * np.sin(phase))))
        error = _error(detect(barred.astype(np.uint8), 9, 6), truth)
        # OpenCV's classic finder with cornerSubPix: .43 to .55 px.
        assert np.sqrt(np.mean(error**2)) < 0.4, seed


@pytest.mark.few(1)
@pytest.mark.parametrize("camera", [VGA, PIXY], ids=["640x480", "316x208"])
def test_boards_in_uneven_light_are_found(camera: Camera) -> None:
    for seed in range(4):
        gray, truth = _picture(camera, Board(9, 6, 0.025), seed)
        assert np.sqrt(np.mean(_error(detect(_shaded(gray, 0.1), 9, 6), truth) ** 2)) < 0.03, seed
        error = np.linalg.norm(_error(detect(_lit(gray, truth), 9, 6), truth), axis=1)
        # The reflection moves the corners of the square that it lies on, and those beside it.
        assert np.sum(error > 0.05) <= 12 and np.median(error) < 0.02, seed


def test_boards_whose_white_is_clipped_are_found() -> None:
    """Most of the light squares' brightness is missing, and the fit's amplitude goes on beyond white."""
    for seed in range(4):
        gray, truth = _picture(VGA, Board(9, 6, 0.02), seed)
        clipped = np.clip(2.5 * gray + 40, 0, 255).astype(np.uint8)
        assert np.mean(clipped == 255) > 0.7
        assert np.sqrt(np.mean(_error(detect(clipped, 9, 6), truth) ** 2)) < 0.05


def test_a_board_whose_screen_shows_its_pixels_is_found() -> None:
    """Dark lines between its pixels, 16 of them along a square's side."""
    tones = np.pad(np.where(np.indices((6, 9)).sum(axis=0) % 2, 220.0, 30.0), 1, constant_values=220.0)
    screen = np.kron(tones, np.ones((64, 64)))
    y, x = np.indices(screen.shape)
    screen[(y % 4 == 0) | (x % 4 == 0)] *= 0.3
    corners = np.array([[0, 0], [704, 0], [704, 512], [0, 512]], dtype=np.float32)
    shown = np.array([[80, 60], [960, 110], [900, 700], [140, 640]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(corners, shown)
    picture = cv2.warpPerspective(screen, H, (1040, 760), flags=cv2.INTER_AREA, borderValue=90)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
    found = detect(np.clip(picture, 0, 255).astype(np.uint8), 8, 5)
    assert found is not None
    i, j = np.meshgrid(np.arange(2, 10) * 64 - 0.5, np.arange(2, 7) * 64 - 0.5)
    truth = cv2.perspectiveTransform(np.stack([i, j], axis=-1).reshape(-1, 1, 2), H.astype(np.float64))
    apart = np.linalg.norm(found.pixels[:, None] - truth.reshape(1, -1, 2), axis=-1).min(axis=1)
    assert apart.max() < 0.6


def test_the_same_on_any_number_of_threads() -> None:
    grays = [_picture(PIXY, Board(7, 5, 0.02), seed)[0] for seed in range(4)]
    alone = [detect(gray, 7, 5) for gray in grays]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda gray: detect(gray, 7, 5), grays))
    for a, b in zip(alone, together, strict=True):
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a.pixels, b.pixels)


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (7, 7), (30, 40)])
def test_tiny_and_constant_pictures_hold_no_board(
    shape: tuple[int, int], capfd: pytest.CaptureFixture[str]
) -> None:
    for level in (0, 128, 255):
        assert detect(np.full(shape, level, dtype=np.uint8), 7, 5) is None
        assert find_size(np.full(shape, level, dtype=np.uint8)) is None
    assert capfd.readouterr() == ("", "")


WIDTH, HEIGHT = 320, 240


def _grid(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    angle, u, v = rng.uniform(0, np.pi), *np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.cos(angle) * u + np.sin(angle) * v, -np.sin(angle) * u + np.cos(angle) * v


def _noise(rng: np.random.Generator) -> np.ndarray:
    image = rng.normal(128, 60, (HEIGHT, WIDTH))
    blur = rng.uniform(0.5, 6)
    smooth = cv2.GaussianBlur(image, (0, 0), blur)
    return 128 + (smooth - 128) * blur * 2


def _stripes(rng: np.random.Generator) -> np.ndarray:
    x, _ = _grid(rng)
    return 128 + 90 * np.sign(np.sin(x * rng.uniform(0.1, 0.8)))


def _grating(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid(rng)
    f, g = rng.uniform(0.1, 0.6, 2)
    return 128 + 50 * np.sin(f * x) + 50 * np.sin(g * y)


def _tiles(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid(rng)
    size, joint = rng.uniform(12, 40), rng.uniform(1.5, 4)
    return np.where((x % size < joint) | (y % size < joint), 60.0, 190.0)


def _bricks(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid(rng)
    size = rng.uniform(12, 30)
    row = np.floor(y / size)
    return np.where((y % size < 2.5) | ((x + row * size) % (2 * size) < 2.5), 190.0, 90.0)


def _dots(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid(rng)
    size = rng.uniform(12, 30)
    near = np.hypot(x % size - size / 2, y % size - size / 2) < size * rng.uniform(0.2, 0.45)
    return np.where(near, 40.0, 210.0)


def _text(rng: np.random.Generator) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH), 230, dtype=np.uint8)
    for line in range(rng.integers(5, 14)):
        letters = "".join(rng.choice(list("HEFTLXI#+=%MW8 "), 28))
        scale = float(rng.uniform(0.4, 1.0))
        cv2.putText(image, letters, (5, 20 + 20 * line), cv2.FONT_HERSHEY_SIMPLEX, scale, 20, 2)
    return image.astype(np.float64)


def _endless_board(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid(rng)
    size = rng.uniform(10, 22)
    return np.where((np.floor(x / size) + np.floor(y / size)) % 2 == 0, 50.0, 200.0)


def _cut_board(rng: np.random.Generator) -> np.ndarray:
    size = int(rng.integers(18, 30))
    image = np.full((HEIGHT, WIDTH), 200.0)
    for j in range(6):
        for i in range(8):
            if (i + j) % 2 == 0:
                image[j * size - 2 * size : (j + 1) * size - 2 * size or None, i * size : (i + 1) * size] = (
                    40.0
                )
    return np.roll(image, int(rng.integers(-3, 4)), axis=1) if rng.random() < 0.5 else image[:, ::-1]


def _windows(rng: np.random.Generator) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH), 180.0)
    width, height = rng.integers(12, 30, 2)
    for v in range(5, HEIGHT - height, int(height * 1.6)):
        for u in range(5, WIDTH - width, int(width * 1.6)):
            image[v : v + height, u : u + width] = rng.uniform(30, 90)
    return image


def _seen(target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A flat target on a grey table, from a random side."""
    height, width = target.shape
    middle, half = np.array([WIDTH, HEIGHT]) / 2, np.array([WIDTH, HEIGHT]) * rng.uniform(0.3, 0.42)
    corners = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) + rng.uniform(-14, 14, (4, 2))
    flat = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    shape = cv2.getPerspectiveTransform(flat, corners.astype(np.float32))
    image = cv2.warpPerspective(
        target, shape, (WIDTH, HEIGHT), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=150
    )
    return image.astype(np.float64)


def _circles(rng: np.random.Generator) -> np.ndarray:
    columns, rows, pitch = 9, 6, 40
    target = np.full((pitch * (rows + 1), pitch * (columns + 1)), 235, dtype=np.uint8)
    shift = pitch // 2 * int(rng.random() < 0.5)
    for j in range(rows):
        for i in range(columns):
            centre = (pitch * (i + 1) + shift * (j % 2) - shift // 2, pitch * (j + 1))
            cv2.circle(target, centre, int(pitch * rng.uniform(0.25, 0.3)), 30, -1)
    return _seen(target, rng)


def _spots(radius: float, square_px: float, blur_px: float, dark: bool, shape: str = "disc") -> np.ndarray:
    """Discs of a radius in squares, or squares, where a board of 10 x 7 corners has its dark squares."""
    fine = 8
    pitch = square_px * fine
    target = np.full((round(11 * pitch), round(14 * pitch)), 220, dtype=np.uint8)
    for i, j in np.argwhere(np.indices((11, 8)).sum(axis=0) % 2 == 0):
        centre = np.array([i + 2, j + 2]) * pitch
        if shape == "disc":
            cv2.circle(target, centre.astype(int).tolist(), int(radius * pitch), 30, -1)
        else:
            low, high = (np.rint(centre + side * pitch / 2).astype(int) for side in (-1, 1))
            target[low[1] : high[1], low[0] : high[0]] = 30
    height, width = target.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 7, 1)
    turned = cv2.warpAffine(target, turn, (width, height), borderValue=220)
    small = cv2.resize(turned, None, fx=1 / fine, fy=1 / fine, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), blur_px)
    noisy = blurred + np.random.default_rng(0).normal(0, 1.5, blurred.shape)
    picture = np.clip(noisy, 0, 255).astype(np.uint8)
    return picture if dark else 255 - picture


@pytest.mark.few(0)
@pytest.mark.parametrize("square_px", [8, pytest.param(11, marks=pytest.mark.slow)])
@pytest.mark.parametrize("blur_px", [0.5, 1.0])
def test_grids_of_round_spots_are_no_boards(square_px: float, blur_px: float) -> None:
    """Spots that nearly touch look like corners of a board; what tells them is that their edges bulge."""
    for dark in (True, False):
        assert detect(_spots(0.5, square_px, blur_px, dark, "square"), 10, 7) is not None
        for radius in (0.5, 0.56, 0.6):
            assert detect(_spots(radius, square_px, blur_px, dark), 10, 7) is None, (radius, dark)


def _markers(rng: np.random.Generator) -> np.ndarray:
    kinds = (cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_6X6_250, cv2.aruco.DICT_APRILTAG_36h11)
    dictionary = cv2.aruco.getPredefinedDictionary(kinds[int(rng.integers(len(kinds)))])
    gap = float(rng.uniform(0.1, 0.5))
    board = cv2.aruco.GridBoard((6, 4), 1.0, gap, dictionary)
    return _seen(board.generateImage((600, 420), marginSize=15), rng)


def _charuco(rng: np.random.Generator) -> np.ndarray:
    # Its squares hold markers: a plain board it is not.
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 1.0, float(rng.choice([0.65, 0.7, 0.8])), dictionary)
    return _seen(board.generateImage((580, 420), marginSize=10), rng)


@pytest.mark.few(1)
@pytest.mark.parametrize("share", [0.4, 0.5, 0.65])
def test_boards_with_markers_are_not_read_as_plain_ones(share: float) -> None:
    """Markers of half the square's side begin at its quarters, smaller ones further in."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 1.0, share, dictionary)
    target = board.generateImage((580, 420), marginSize=10)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        assert detect(_finished(_seen(target, rng), rng), 6, 4) is None, seed
        # Blur takes the markers' contrast away and leaves the squares'.
        blurred = cv2.GaussianBlur(_seen(target, rng), (0, 0), 2.5)
        assert detect(_finished(blurred, rng), 6, 4) is None, seed


KINDS = [
    _noise,
    _stripes,
    _grating,
    _tiles,
    _bricks,
    _dots,
    _text,
    _endless_board,
    _cut_board,
    _windows,
    _circles,
    _markers,
    _charuco,
]


def _finished(image: np.ndarray, rng: np.random.Generator) -> GrayImage:
    blurred = cv2.GaussianBlur(np.ascontiguousarray(image, dtype=np.float64), (0, 0), rng.uniform(0.5, 1.2))
    return np.clip(blurred + rng.normal(0, 2, blurred.shape), 0, 255).astype(np.uint8)


@pytest.fixture
def one_thread():
    """OpenCV's finders on one thread, as `find_boards` runs them."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__.strip("_"))
def test_no_board_is_found_where_there_is_none(kind, one_thread) -> None:
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        gray = _finished(kind(rng), rng)
        size = ((7, 5), (9, 6))[seed % 2]
        found += [(seed, size)] if detect(gray, *size) is not None else []
        # What is left of a cut board can be a whole board of fewer squares.
        if kind is not _cut_board and seed % 4 == 0:
            found += [(seed, "any")] if find_size(gray) is not None else []
    assert found == []

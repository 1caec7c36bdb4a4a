"""All figures of all stages: legible whatever a result came to, and true to their numbers."""

from __future__ import annotations

import base64
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from figure_checks import complaints, complaints_of, drawn_texts, words_of
from hypothesis import given
from hypothesis import strategies as st
from imu_poses import G, Sensor, pose_log, sphere_poses, tilts
from matplotlib.quiver import Quiver
from scipy.spatial.transform import Rotation

from calib.core.arrays import FloatArray
from calib.core.plot import Arrows, Bars, Curve, Figure, Plot, Text, magnified, short
from calib.core.verdict import Verdict, Word
from calib.io.logs import Log, read_log, write_log
from calib.show.charts import chart
from calib.show.draw import draw, plain, write_figures
from calib.stages import function, stage
from calib.stages.actuator.identify_pump import PumpFound, fit_static_map
from calib.stages.actuator.plots import pump_plots
from calib.stages.actuator.section import SettledRuns
from calib.stages.camera.bundle import Calibration, calibrate, covariance, rotation_exp
from calib.stages.camera.checks import cell_means
from calib.stages.camera.intrinsics import Candidate, Intrinsics
from calib.stages.camera.lens import (
    PlaneView,
    analyse_distortion,
    radial_displacement,
    radial_sigma,
)
from calib.stages.camera.model import Camera, View, pack, project
from calib.stages.camera.plane import Plane, calibrate_plane
from calib.stages.camera.plots import _comparison, lens_plots, picture, plane_plots
from calib.stages.camera.plots import plots as camera_plots
from calib.stages.imu.intrinsics import solve_intrinsics
from calib.stages.imu.plots import intrinsics_plots, static_plots
from calib.stages.imu.sampling import Readings
from calib.stages.imu.static import solve_static
from calib.stages.lowpass.filters import Design, design_lowpass
from calib.stages.lowpass.jitter import Positions
from calib.stages.lowpass.plots import plots as lowpass_plots
from calib.stages.lowpass.stage import positions_from_log
from calib.stages.lowpass.stage import solve as solve_lowpass
from synthetic import CAMERA, views_of


@given(st.text(st.characters(codec=None), max_size=60), st.integers(8, 40))
def test_any_text_becomes_a_label_of_drawable_signs(text: str, most: int) -> None:
    label = short(text, most)
    assert len(label) <= most
    assert label.isprintable() and plain(label).isprintable()
    # Nothing is lost where nothing had to change.
    ordinary = "view-01_(a)$b$.png"
    assert plain(short(ordinary, 18)) == ordinary


def test_the_checks_see_what_is_wrong() -> None:
    marks = (Text(0.5, 0.5, "one thing"), Text(0.51, 0.5, "another"), Text(3.0, 0.0, "off"))
    panel = Plot("x", "y", (Curve(np.zeros(2), np.ones(2)), *marks), x_limits=(0.0, 1.0), y_limits=(0.0, 1.0))
    figure = Figure("A title", "A note", (panel, Plot("x", "y")), 2.0, columns=2)
    drawing = draw(figure)
    for text in drawing.axes[0].texts:
        text.set_in_layout(False)
    drawing.axes[0].title.set(text="tiny", fontsize=4)
    found = " ".join([*complaints(figure), *complaints_of(drawing)])
    assert "'one thing' lies on 'another'" in found
    assert "'tiny' is too small" in found
    assert "'off' runs off the sheet" in found
    assert "panel 2 is empty" in found


def result_of(
    views: list[View],
    size: tuple[int, int] = (640, 480),
    model: str = "radial2",
    fixed: tuple[str, ...] = (),
    verdict: Word = "ok",
) -> Intrinsics:
    """A calibration with everything the figures need, without judging it."""
    fit = calibrate(pack(views), size, model, fixed=fixed)
    return Intrinsics(fit, covariance(fit), Verdict.stored(verdict), (), (), "rigid", (), {})


def _tilted(tilt_rad: float, count: int) -> Intrinsics:
    return result_of(views_of(count, noise_px=0.1, tilt_rad=tilt_rad), verdict="unidentifiable")


def _one_view() -> Intrinsics:
    return result_of(
        views_of(1, noise_px=0.1), model="pinhole", fixed=("cx_px", "cy_px"), verdict="unidentifiable"
    )


def _many_views() -> Intrinsics:
    camera = replace(CAMERA, image_size_px=(1920, 1080), fx_px=1500.0, fy_px=1502.0, cx_px=965.0, cy_px=533.0)
    views = views_of(40, noise_px=0.2, camera=camera)
    again = [replace(v, name=f"IMG_2024_11_{k}_{v.name}.jpg") for k in range(10) for v in views]
    return result_of(again, (1920, 1080))


def _no_distortion_and_odd_names() -> Intrinsics:
    camera = Camera("pinhole", (316, 208), 270.0, 271.0, 0.0, 160.0, 101.0)
    odd = [
        "a$b$c.png",
        "$\\frac{.png",
        "\u5199\u771f.png",
        "x" * 200,
        "line\nbreak\t.png",
        "\udcff.png",
        "_^{}%.png",
    ]
    views = views_of(len(odd), noise_px=0.05, camera=camera)
    return result_of([replace(v, name=n) for v, n in zip(views, odd, strict=True)], (316, 208), "pinhole")


def _upright() -> Intrinsics:
    camera = replace(CAMERA, image_size_px=(480, 640), cx_px=236.0, cy_px=325.0)
    return result_of(views_of(6, noise_px=0.1, camera=camera), (480, 640), "rational8")


def _unbounded() -> Intrinsics:
    result = _one_view()
    size = len(result.covariance.names)
    found = replace(
        result.covariance,
        intrinsics=np.diag(np.full(size, np.inf)),
        joint=np.diag(np.full(size + 6, np.inf)),
    )
    return replace(result, covariance=found)


def _failed() -> Intrinsics:
    """What a fit that ended behind the camera leaves: no residuals, no covariance."""
    result = _unbounded()
    fit = result.calibration
    nothing = replace(
        fit,
        residuals_px=np.full_like(fit.residuals_px, np.nan),
        normal=np.full_like(fit.normal, np.nan),
        termination="behind the camera",
    )
    return replace(result, calibration=nothing)


def _not_finite() -> Intrinsics:
    result = _failed()
    fit = result.calibration
    camera = replace(fit.camera, fx_px=np.nan, fy_px=np.nan, cx_px=np.nan, cy_px=np.nan)
    block = replace(fit.block, R_CT=np.full_like(fit.block.R_CT, np.nan))
    return replace(result, calibration=replace(fit, camera=camera, block=block))


def _exact() -> Intrinsics:
    return result_of(views_of(4), verdict="poor")


def _precise() -> Intrinsics:
    """So precise that the principal point needs many digits."""
    camera = replace(CAMERA, image_size_px=(316, 208), fx_px=273.4, fy_px=272.6, cx_px=160.67, cy_px=101.87)
    return result_of(views_of(17, noise_px=0.007, camera=camera), (316, 208))


def _outliers() -> Intrinsics:
    views = views_of(5, noise_px=0.05)
    views[2].pixels[7] += [40.0, -25.0]
    fit = calibrate(pack(views), (640, 480), "radial2", loss="cauchy")
    return Intrinsics(fit, covariance(fit), Verdict.stored("poor"), (), (), "rigid", (), {})


BROWN = Camera(
    "brown5", (316, 208), 273.0, 272.0, 0.4, 160.0, 102.0, np.array([-0.22, 0.55, 2e-3, -3e-3, 0.05, 0, 0, 0])
)
FOLDING = replace(CAMERA, distortion=np.array([-0.9, 0.1, 0, 0, 0, 0, 0, 0.0]))
PINHOLE = Camera("pinhole", (1920, 1080), 1500.0, 1500.0, 0.0, 960.0, 540.0)
UPRIGHT = replace(CAMERA, image_size_px=(480, 640), cx_px=240.0, cy_px=320.0)


def test_the_band_is_the_spread_of_repeated_calibrations() -> None:
    radius = np.array([100.0, 200.0, 300.0])
    clean = pack(views_of(8))
    rng = np.random.default_rng(2)
    curves = []
    for _ in range(120):
        noisy = replace(clean, pixels=clean.pixels + 0.1 * rng.standard_normal(clean.pixels.shape))
        fit = calibrate(noisy, (640, 480), "radial2")
        curves.append(radial_displacement(fit.camera, radius))
    reported = radial_sigma(fit.camera, covariance(fit, 0.01), radius)
    # 120 samples give a standard deviation to 6.5 %.
    np.testing.assert_allclose(np.std(curves, axis=0, ddof=1), reported, rtol=0.2)


FISHEYE = Camera(
    "fisheye4", (640, 480), 200.0, 201.0, 0.5, 322.0, 236.0, np.array([0.03, -0.01, 0, 0, 4e-3, -1e-3, 0, 0])
)


WORKSPACE = (-0.06, 0.04, 0.06, 0.11)
R_CW = rotation_exp(np.array([[0.35, -0.2, 0.1]]))[0]
t_CW_m = np.array([0.0, -0.07, 0.25])


def plane_of(
    camera: Camera = CAMERA,
    names: tuple[str, ...] = ("plane01.png",),
    workspace_m: tuple[float, float, float, float] = WORKSPACE,
    covariance: FloatArray | None = None,
    points: int = 35,
    noise_px: float = 0.1,
) -> Plane:
    """A plane fitted to made-up pictures of a board that covers the workspace."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-0.058, 0.062, 7), np.linspace(0.03, 0.11, 5)), -1).reshape(-1, 2)
    world = grid[:: max(1, 35 // points)][:points] if points != 4 else grid[[0, 6, 28, 34]]
    seen = project(camera, world @ R_CW[:, :2].T + t_CW_m)
    views = [View(name, world, seen + noise_px * rng.standard_normal(seen.shape)) for name in names]
    return calibrate_plane(camera, covariance, views, workspace_m=workspace_m)


def _known() -> FloatArray:
    return np.diag([0.3, 0.3, 0.2, 0.2, 0.0, 1e-3, 1e-2, *np.zeros(6)]) ** 2


def _tiny() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, image_size_px=(316, 208), fx_px=270.0, fy_px=270.0, cx_px=160.0, cy_px=101.0)
    return camera, plane_of(camera, covariance=_known())


def _wide() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, image_size_px=(1920, 1080), fx_px=1500.0, fy_px=1500.0, cx_px=965.0, cy_px=533.0)
    return camera, plane_of(camera, names=("a$b$.png", "$\\frac{.png", "\u5199\u771f.png"))


def _ideal() -> tuple[Camera, Plane]:
    camera = replace(CAMERA, model="pinhole", distortion=np.zeros(8))
    return camera, plane_of(camera, noise_px=0.0)


def _positions(folder: Path, still: bool = False, n: int = 3000) -> Positions:
    t = np.arange(n) / 60.0
    noise = (0.0 if still else 1.0) * np.random.default_rng(0).normal(size=(2, n))
    u = np.round(150 + 30 * np.sin(0.4 * t) * (t > 20) + 0.4 * noise[0])
    v = np.round(90 + 0.4 * noise[1])
    write_log(folder / "log.csv", Log("log.csv", t, {"u_px": u, "v_px": v}, np.arange(n)))
    return positions_from_log(read_log(folder / "log.csv"), 60.0)


def _lens(camera: Camera) -> dict[str, Figure]:
    plane = PlaneView(np.eye(3), np.array([0.0, -0.07, 0.3]), WORKSPACE, 0.05)
    return lens_plots(analyse_distortion(camera, plane=plane))


def _low_pass(cutoff: float, order: int, family: str, folder: Path, still: bool = False) -> dict[str, Figure]:
    made, seen = design_lowpass(Design(cutoff, 60.0, order, family)), _positions(folder, still)
    return lowpass_plots(solve_lowpass(made, WORKSPACE, seen))


def _control(verb: str, *sources: str, **options: Any) -> dict[str, Figure]:
    plots = stage(f"control {verb}").plots
    assert plots is not None
    return plots(function(f"control {verb}")(*sources, **options))


def _at_rest(axes: tuple[str, ...], stuck: bool = False) -> dict[str, Figure]:
    """An IMU at rest that is moved once; without a chip's own angle."""
    values = 1e-2 * np.random.default_rng(3).standard_normal((6000, len(axes))) + np.arange(len(axes))
    values[2000:2100, 0] += 0.5 * np.sin(0.1 * np.arange(100))
    values[:, -1] = 0.25 if stuck else values[:, -1]
    log = Readings("log.csv", axes, 0.01 * np.arange(6000), values)
    return static_plots(solve_static([log]))


def _posed(poses: list[Rotation], planar: bool = False) -> dict[str, Figure]:
    return intrinsics_plots(solve_intrinsics(pose_log(poses, Sensor()), G, planar))


def _settled() -> dict[str, Figure]:
    """A pump's table of settled values with an outlier, and runs that settle elsewhere."""
    pwm = np.linspace(0.0, 255.0, 18)
    value = 26.0 * np.clip(pwm - 40.0, 0.0, None) / 215.0
    value[9] += 8.0
    groups = (
        SettledRuns(value=12.0, spread=0.2, pwm=[120.0, 180.0], files=["a", "b"]),
        SettledRuns(value=24.0, spread=0.2, pwm=[240.0, 240.0], files=["c"]),
    )
    maps = (fit_static_map("settled.csv", pwm, value),)
    found = PumpFound("kPa", (), {}, {}, {}, {}, maps, groups, (), (), ())
    return pump_plots(SimpleNamespace(evidence=found, verdict=Verdict()))


CASES: dict[str, Callable[[Path], dict[str, Figure]]] = {
    "camera: one view": lambda _: camera_plots(_one_view()),
    "camera: 400 views": lambda _: camera_plots(_many_views()),
    "camera: no distortion, odd names": lambda _: camera_plots(_no_distortion_and_odd_names()),
    "camera: upright picture": lambda _: camera_plots(_upright()),
    "camera: sigma not bounded": lambda _: camera_plots(_unbounded()),
    "camera: no tilt": lambda _: camera_plots(_tilted(0.0, 4)),
    "camera: failed fit": lambda _: camera_plots(_failed()),
    "camera: not finite": lambda _: camera_plots(_not_finite()),
    "camera: no residuals": lambda _: camera_plots(_exact()),
    "camera: outliers": lambda _: camera_plots(_outliers()),
    "camera: precise": lambda _: camera_plots(_precise()),
    "lens: usual": lambda _: _lens(CAMERA),
    "lens: Brown": lambda _: _lens(BROWN),
    "lens: folding": lambda _: _lens(FOLDING),
    "lens: pinhole": lambda _: _lens(PINHOLE),
    "lens: upright": lambda _: _lens(UPRIGHT),
    "plane: 316x208": lambda _: plane_plots(*_tiny()),
    "plane: 1920x1080, three pictures, odd names": lambda _: plane_plots(*_wide()),
    "plane: no distortion, no noise": lambda _: plane_plots(*_ideal()),
    "plane: part of the workspace": lambda _: plane_plots(
        CAMERA, plane_of(workspace_m=(-0.2, 0.0, 0.2, 0.3), covariance=_known())
    ),
    "plane: nothing of the workspace": lambda _: plane_plots(
        CAMERA, plane_of(workspace_m=(1.0, 1.0, 1.1, 1.1))
    ),
    "plane: upright workspace": lambda _: plane_plots(CAMERA, plane_of(workspace_m=(-0.01, 0.0, 0.02, 0.12))),
    "plane: four corners": lambda _: plane_plots(CAMERA, plane_of(points=4, covariance=_known())),
    "plane: twelve pictures": lambda _: plane_plots(
        CAMERA, plane_of(names=tuple(f"{k}.png" for k in range(12)))
    ),
    "IMU: three axes move": lambda _: _at_rest(("gz", "ax", "ay")),
    "IMU: an axis is stuck": lambda _: _at_rest(("gx", "gy", "gz", "ax", "ay", "az"), stuck=True),
    "IMU: poses all around": lambda _: _posed(sphere_poses(24)),
    "IMU: poses in a plane": lambda _: _posed(tilts(np.radians(np.arange(0, 720, 45))), planar=True),
    "IMU: one pose": lambda _: _posed(tilts(np.zeros(2))),
    "pump: settled values": lambda _: _settled(),
    "low-pass: order 1": lambda folder: _low_pass(1.0, 1, "butterworth", folder),
    "low-pass: still log": lambda folder: _low_pass(1.0, 8, "butterworth", folder, still=True),
    "low-pass: fast Bessel": lambda folder: _low_pass(20.0, 4, "bessel", folder),
    "low-pass: slow critical": lambda folder: _low_pass(0.1, 3, "critical", folder),
    "low-pass: very slow": lambda folder: _low_pass(0.01, 2, "butterworth", folder),
    "control: an angle run": lambda _: _control("run", "jump", feedback="truth"),
    "control: lengths run": lambda _: _control("run", "ellipse", duration_s=4.0),
    "control: a jump checked": lambda _: _control("check", "jump"),
    "control: an ellipse checked": lambda _: _control("check", "ellipse", duration_s=8.0),
    "control: tuned": lambda _: _control("tune"),
}


@cache
def figures_of(name: str) -> dict[str, Figure]:
    """The figures of a case, worked out once."""
    with tempfile.TemporaryDirectory() as folder:
        return CASES[name](Path(folder))


def _decoded(entry: list[Any]) -> FloatArray:
    """Numbers of an array of a chart, as the page's script reads them."""
    kind, text, *scale = entry
    raw = np.frombuffer(base64.b64decode(text), f"<{kind}").astype(np.float64)
    return raw if kind == "f4" else np.where(raw == -32768.0, np.nan, scale[0] + (raw + 32767.0) * scale[1])


def _check_chart(figure: Figure) -> None:
    """A chart is JSON of a figure's words, panels and numbers, these to a step of 16 bits."""
    whole = json.loads(json.dumps(chart(figure), allow_nan=False))
    assert whole["title"] == figure.title and len(whole["panels"]) == len(figure.panels)
    arrays = [_decoded(entry) for entry in whole["arrays"]]
    for plot, panel in zip(figure.panels, whole["panels"], strict=True):
        curves = (mark for mark in plot.marks if isinstance(mark, Curve) and not plot.linear_within)
        # Of the traces these alone are told by a pointer and have a mode.
        drawn = [one for one in panel["traces"] if "mode" in one and not {"hoverinfo", "text"} & set(one)]
        for curve, trace in zip(curves, drawn, strict=False):
            for axis, values in (("x", curve.x), ("y", curve.y)):
                known = np.asarray(values, dtype=np.float64)[: len(arrays[trace[axis]["$"]])]
                known = known[np.isfinite(known)]
                if 0 < len(known) < 250 and len(known) == np.isfinite(values).sum():
                    shown, room = (
                        arrays[trace[axis]["$"]],
                        np.ptp(known) / 65534.0 + 1e-6 * np.abs(known).max(),
                    )
                    assert np.nanmin(shown) == pytest.approx(known.min(), abs=room)
                    assert np.nanmax(shown) == pytest.approx(known.max(), abs=room)


QUICK = (
    "camera: sigma not bounded",
    "lens: Brown",
    "plane: nothing of the workspace",
    "control: a jump checked",
)


@pytest.mark.parametrize(
    "name", [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in CASES]
)
def test_all_figures_are_legible(name: str) -> None:
    figures = figures_of(name)
    assert figures
    for stem, figure in figures.items():
        assert complaints(figure) == [], stem
        _check_chart(figure)


def test_files_are_the_same_bytes_again(tmp_path: Path) -> None:
    figures = figures_of("low-pass: order 1")
    first, again = (write_figures(tmp_path / name, figures) for name in ("a", "b"))
    assert [path.name for path in first] == [f"{name}.png" for name in figures]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(first, again, strict=True))


@pytest.mark.few(0, 3, 4, 7, 9, 11, 12)
@pytest.mark.parametrize(
    ("name", "stem", "words"),
    [
        ("camera: sigma not bounded", "camera_sigma", "not bounded"),
        ("camera: sigma not bounded", "camera_coverage", "not estimated"),
        ("camera: sigma not bounded", "camera_poses", "verdict: unidentifiable"),
        ("lens: pinhole", "lens_displacement", "no distortion"),
        ("lens: folding", "lens_displacement", "folds over"),
        ("lens: Brown", "lens_displacement", "; it matters"),
        ("plane: twelve pictures", "plane_sigma", "covariance of the intrinsics is not known"),
        ("plane: nothing of the workspace", "plane_difference", "No part of the workspace is in the picture"),
        ("plane: nothing of the workspace", "plane_sigma", "verdict: poor"),
        ("IMU: an axis is stuck", "imu_allan", "never changes"),
        ("IMU: an axis is stuck", "imu_drift", "not logged, or the logs move"),
        ("low-pass: still log", "lowpass_log", "v never changes"),
        ("control: a jump checked", "control_check", "verdict: poor"),
    ],
)
def test_what_is_not_known_is_said(name: str, stem: str, words: str) -> None:
    assert words in words_of(figures_of(name)[stem])


FIT = calibrate(pack(views_of(12, noise_px=0.1)), (640, 480), "radial2")


def _with_residuals(residuals: np.ndarray) -> Calibration:
    return replace(FIT, residuals_px=residuals)


def _outside(fit: Calibration) -> tuple[int, int]:
    at = fit.observations.pixels.reshape(-1, 2)
    means = cell_means(fit, at, fit.residuals_px.reshape(-1, 2), fit.weights.ravel())
    return int(means.outside.sum()), len(means.at)


def test_chance_leaves_one_disc_in_twenty() -> None:
    rng = np.random.default_rng(5)
    counts = []
    for _ in range(150):
        noise = rng.standard_normal(FIT.residuals_px.shape) * 0.1
        # The spread is estimated from the residuals with the fit's degrees of freedom; undo that here.
        noise *= np.sqrt(FIT.degrees_of_freedom / (2 * FIT.observations.points))
        fit = _with_residuals(noise)
        counts.append(_outside(fit))
    outside, cells = np.sum(counts, axis=0)
    # 150 sets of about 40 cells: the share of 5 % is known to 0.3 %; the fit's freedom takes part of it.
    assert 0.03 < outside / cells < 0.06


def test_arrows_have_the_length_that_they_claim() -> None:
    at = np.array([[10.0, 20.0], [50.0, 60.0], [np.nan, 1.0]])
    vectors = np.array([[0.5, -0.25], [-1.0, 0.0], [1.0, 1.0]])
    times = magnified(8.0, 0.98)
    figure = Figure("title", "", (picture((100, 80), (Arrows(at, vectors, times, "px"),)),), 3.0)
    drawing = draw(figure)
    assert "1 px" in [text.get_text() for text in drawn_texts(drawing)], "the key"
    (axes,) = drawing.axes
    quiver = next(artist for artist in axes.get_children() if isinstance(artist, Quiver))
    assert times == pytest.approx(8.1, abs=0.15)
    assert len(quiver.U) == 2, "a vector that is not finite is left out"
    # The tips of the polygons, in the data's units.
    pixels_per_unit = axes.transData.transform([1.0, 0.0])[0] - axes.transData.transform([0.0, 0.0])[0]
    for polygon, vector in zip(quiver.get_paths(), vectors, strict=False):
        shape = quiver.get_transform().transform(polygon.vertices)
        tip = shape[np.argmax(np.linalg.norm(shape, axis=1))]
        expected = times * vector * [1.0, -1.0] * pixels_per_unit
        np.testing.assert_allclose(tip, expected, atol=0.02 * np.linalg.norm(expected) + 0.5)


def test_counts_have_ticks_at_whole_numbers_alone() -> None:
    """Between few of them there were ticks at halves, under the numbers of their neighbours."""
    for most, step in ((3.0, 1), (40.0, None)):
        bars = Bars(np.array([0.1, 0.2]), np.array([1.0, most]), 0.1)
        (panel,) = chart(Figure("t", "", (Plot("x", "views", (bars,), whole="y"),), 2.0))["panels"]
        assert panel["y"].get("dtick") == step and "dtick" not in panel["x"]


def test_a_model_that_is_far_off_has_its_figure_in_its_row() -> None:
    rms = {"pinhole": (0.19, 0.2), "radial2": (0.01, 0.0101), "radial3": (0.0099, 0.0102)}
    found = [Candidate(name, 4, *pair, np.zeros(0), 3) for name, pair in rms.items()]
    (panel,) = _comparison("lens model", found, "radial2").panels
    assert panel.x_limits is not None
    inside = [m for m in panel.marks if isinstance(m, Text) and m.x <= panel.x_limits[1]]
    assert [(mark.y, mark.words.strip()) for mark in inside] == [(0, "from 0.19 px on")]

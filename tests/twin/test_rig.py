"""The simulated rig from a rig.yaml, and whole rig folders: one sentence for a wrong unit, truth found."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography
from calib.core.rig import Rig
from calib.io.logs import check_time, read_log
from calib.io.pictures import list_pictures
from calib.stages.camera.model import Camera, project
from calib.stages.camera.read import read_board_file
from calib.stages.estimator.baseline import undistorting_nothing
from calib.twin.folder import LOGS, write_rig_folder
from calib.twin.rig import SimulatedRig, nominal_view, rig_from_file
from calib.twin.sensors import View
from calib.twin.simulate import WORKSPACE_M


@pytest.fixture
def rig(tmp_path: Path):
    def _rig(text: str) -> SimulatedRig:
        path = tmp_path / "rig.yaml"
        path.write_text(text)
        return rig_from_file(Rig.load(path))

    return _rig


def test_a_calibrated_camera_and_plane_are_taken_over(rig) -> None:
    view = nominal_view()
    A = view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m])
    made = rig(
        "camera: {model: pinhole, image_size_px: [640, 480], fx_px: 500.0, fy_px: 500.0, cx_px: 320.0,\n"
        "  cy_px: 240.0, verdict: ok}\n"
        f"plane: {{R_CW: {view.R_CW.tolist()}, t_CW_m: {view.t_CW_m.tolist()}, A_px_per_m: {A.tolist()},\n"
        f"  A_inverse: {np.linalg.inv(A).tolist()}, rms_px: 0.1, rms_mm: 0.1, verdict: ok}}\n"
    )
    assert made.view.camera.image_size_px == (640, 480)
    assert made.view.camera.fx_px == 500.0
    assert np.array_equal(made.view.R_CW, view.R_CW)


def _without_lens(view: View) -> np.ndarray:
    return np.linalg.inv(undistorting_nothing(view.camera, view.R_CW, view.t_CW_m, WORKSPACE_M))


def test_the_homography_without_a_lens_model_is_the_nearest() -> None:
    view = nominal_view()
    x, y = np.meshgrid(np.linspace(-0.04, 0.04, 7), np.linspace(0.08, 0.105, 5))
    world = np.stack([x.ravel(), y.ravel()], axis=1)
    pixels = project(view.camera, world @ view.R_CW[:, :2].T + view.t_CW_m)
    fitted = np.linalg.norm(apply_homography(_without_lens(view), world) - pixels, axis=1)
    A = view.camera.K @ np.column_stack([view.R_CW[:, :2], view.t_CW_m])
    naive = np.linalg.norm(apply_homography(A, world) - pixels, axis=1)
    assert fitted.max() < 0.2 < 0.5 < naive.max()
    ideal = View(Camera("pinhole", (316, 208), 273.4, 272.6, 0.0, 160.7, 101.9), view.R_CW, view.t_CW_m)
    H = _without_lens(ideal)
    assert np.allclose(H / H[2, 2], A / A[2, 2], rtol=1e-8, atol=1e-9)


RIG = SimulatedRig()


def _hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
def test_the_folder_holds_pictures_plane_and_logs(tmp_path: Path, project_root: Path) -> None:
    done: list[tuple[int, int]] = []
    logs = write_rig_folder(tmp_path / "rig", RIG, progress=lambda i, n: done.append((i, n)))
    assert done[-1] == (len(LOGS), len(LOGS))
    assert [path.stem for path in logs] == list(LOGS)
    assert len(list_pictures([tmp_path / "rig" / "images"])) == 17
    assert len(list_pictures([tmp_path / "rig" / "images" / "plane"])) == 1
    # The nominal camera's pictures are the shipped ones.
    shipped = _hashes(project_root / "images")
    assert shipped == _hashes(tmp_path / "rig" / "images")
    assert any(path.name.startswith("static") for path in logs)
    for path in logs:
        log = read_log(path)
        check_time(log)
        assert log.unknown == ()
        assert len(log.sampled("u_px", "v_px")) > 0.9 * len(log.sampled("pwm1"))
        assert len(log.sampled("true_phi_rad")) == len(log)
        at_rest = np.ptp(log.columns["true_q1_m"]) == 0.0
        assert at_rest == path.name.startswith("static")
    truth = json.loads((tmp_path / "rig" / "truth.json").read_text())
    assert truth["tracker"]["latency_s"] == RIG.tracker.latency_s
    assert truth["plant"]["mass_kg"] == RIG.plant.mass_kg
    assert truth["view"]["camera"]["fx_px"] == RIG.view.camera.fx_px
    again = tmp_path / "again"
    write_rig_folder(again, RIG)
    assert _hashes(again) == _hashes(tmp_path / "rig")
    write_rig_folder(tmp_path / "other", RIG, seed=1)
    both = [
        {path: one for path, one in _hashes(tmp_path / name).items() if path.endswith((".png", ".csv"))}
        for name in ("rig", "other")
    ]
    assert both[0].keys() == both[1].keys()
    assert not set(both[0].values()) & set(both[1].values())


@pytest.mark.slow
def test_another_cameras_pictures_show_the_board_where_it_says(tmp_path: Path) -> None:
    from calib.stages.camera.read import find_boards

    nominal = nominal_view()
    camera = Camera(
        "brown5",
        (640, 480),
        520.0,
        522.0,
        0.0,
        325.0,
        236.0,
        np.array([-0.1, 0.05, 1e-3, -5e-4, 0.0, 0.0, 0.0, 0.0]),
    )
    rig = replace(RIG, view=View(camera, nominal.R_CW, nominal.t_CW_m))
    write_rig_folder(tmp_path, rig)
    told = read_board_file(tmp_path / "images" / "plane")
    assert told.corners and told.square_m and told.first_corner_m
    found = find_boards(list_pictures([tmp_path / "images"]), (7, 5), told.square_m)
    assert len(found.views) == 17
    assert found.image_size_px == (640, 480)
    plane = find_boards(list_pictures([tmp_path / "images" / "plane"]), (7, 5), told.square_m)
    turn, (x0, y0) = told.angle_rad or 0.0, told.first_corner_m
    i, j = np.meshgrid(np.arange(7), np.arange(5))
    bx, by = told.square_m * i.ravel(), told.square_m * j.ravel()
    world = np.stack(
        [x0 + np.cos(turn) * bx - np.sin(turn) * by, y0 + np.sin(turn) * bx + np.cos(turn) * by], axis=1
    )
    expected = project(camera, world @ nominal.R_CW[:, :2].T + nominal.t_CW_m)
    corners = plane.views[0].pixels
    nearest = np.linalg.norm(corners[:, None] - expected[None], axis=2).min(axis=1)
    assert nearest.max() < 0.3


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(BadInputError, match="is there already, expected a new or an empty folder"):
        write_rig_folder(tmp_path, RIG)
    with pytest.raises(BadInputError, match="is there already"):
        write_rig_folder(tmp_path / "mine.txt", RIG)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_rig_that_is_cut_off_leaves_nothing(tmp_path: Path) -> None:
    """A part would be taken for a whole rig, and the folder refused the next time."""

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_rig_folder(tmp_path / "new" / "rig", RIG, progress=stop)
    assert not list((tmp_path / "new").iterdir())

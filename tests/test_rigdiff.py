"""Two calibrations side by side: in standard deviations, and in millimetres on the plane."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calib.show.diff import diff_rigs

K = np.array([[273.4, 0.0, 160.7], [0.0, 272.6, 101.9], [0.0, 0.0, 1.0]])
T_M = np.array([0.004, -0.061, 0.272])


def _rig(path: Path, shift_m: float = 0.0, sigma_mm: float | None = 0.01, **camera: Any) -> Path:
    t = T_M + np.array([shift_m, 0.0, 0.0])
    A = K @ np.column_stack([np.eye(3)[:, :2], t])
    told: dict[str, Any] = {
        "camera": {
            "model": "radial2", "image_size_px": [316, 208], "fx_px": 273.4, "fy_px": 272.6, "cx_px": 160.7,
            "cy_px": 101.9, "distortion": {"k1": -0.22, "k2": 0.549}, "views": 17, "verdict": "ok",
            "sigma": {"fx_px": 0.03, "k1": 0.0003}, **camera,
        },
        "plane": {
            "R_CW": np.eye(3).tolist(), "t_CW_m": t.tolist(), "A_px_per_m": A.tolist(),
            "A_inverse": np.linalg.inv(A).tolist(), "rms_px": 0.01, "rms_mm": 0.01, "verdict": "ok",
            "sigma": {"tx_m": 1e-5}, "sigma_marker_mm": {"calibration_max": sigma_mm},
        },
        "geometry": {"workspace_m": [-0.05, 0.05, 0.05, 0.1]},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(told))
    return path


def test_a_rig_and_itself(tmp_path: Path) -> None:
    path = _rig(tmp_path / "a.yaml")
    found = diff_rigs(path, path)
    assert found.changes == () and not found.significant
    assert found.plane is not None and found.plane.largest_mm < 1e-6
    assert found.compared > 20


def test_difference_in_standard_deviations_of_both(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml")
    b = _rig(
        tmp_path / "b.yaml", fx_px=273.4 + 0.2, sigma={"fx_px": 0.04, "k1": 0.0003}, verdict="poor", views=9
    )
    found = diff_rigs(a, b)
    (change,) = found.changes
    assert change.name == "fx_px" and change.sigma == pytest.approx(0.05)
    assert change.sigmas == pytest.approx(4.0) and change.significant and found.significant
    assert found.verdicts == (("camera", "ok", "poor"),)


def test_shift_of_the_plane_is_read_in_millimetres(tmp_path: Path) -> None:
    found = diff_rigs(_rig(tmp_path / "a.yaml"), _rig(tmp_path / "b.yaml", shift_m=2e-4))
    plane = found.plane
    assert plane is not None
    assert plane.mean_mm == pytest.approx(0.2, rel=1e-6) and plane.largest_mm == pytest.approx(0.2, rel=1e-6)
    assert plane.sigma_mm == pytest.approx(math.hypot(0.01, 0.01)) and plane.significant


def test_without_error_bars_nothing_is_called_significant(tmp_path: Path) -> None:
    a = _rig(tmp_path / "a.yaml", sigma_mm=None, sigma={})
    found = diff_rigs(a, _rig(tmp_path / "b.yaml", shift_m=1e-3, sigma_mm=None, sigma={}, fx_px=280.0))
    assert not found.significant
    assert found.plane is not None and found.plane.significant is None

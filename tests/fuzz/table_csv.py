"""Tables of correspondences, up to the views that a calibration starts from."""

from __future__ import annotations

from pathlib import Path

MODULES = ("calib.stages.camera.read",)

WORDS = (
    b"view", b"x_m", b"y_m", b"u_px", b"v_px", b"view,x_m,y_m,u_px,v_px", b",", b"\"a,b\"", b"#", b"1e5",
    b"640", b"-1.5", b"1e-7", b"\"", b"a,0,0,1,1", b"b",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Views of finite numbers with four points at least, each once, inside the picture."""
    import numpy as np

    from calib.stages.camera.options import Told
    from calib.stages.camera.read import read_table, read_views

    path = folder / "points.csv"
    path.write_bytes(data)
    views = read_table(path)
    assert len({view.name for view in views}) == len(views) > 0
    for view in views:
        assert len(view.pixels) == len(view.target_m) >= 4
        assert np.isfinite(view.pixels).all() and np.isfinite(view.target_m).all()
        assert len(np.unique(view.target_m, axis=0)) == len(view.target_m)
    given = read_views([path], Told(image_size_px=(640, 480)))
    for view in given.views:
        assert (view.pixels >= -1).all() and (view.pixels <= [640, 480]).all()
        assert np.abs(view.target_m).max() <= 2e4

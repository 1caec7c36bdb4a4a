"""Corner files of mrgingham and mrcal, up to the views that a calibration starts from."""

from __future__ import annotations

from pathlib import Path

MODULES = ("calib.stages.camera.read",)

WORDS = (
    b"# filename x y level", b"# filename x y weight", b"# x y filename", b"filename", b"level",
    b"-", b"- - -",
    b"##", b"#!", b"-1", b"a.png", b"b.png", b"a.png 1 2 0", b"640", b"1e9",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Views of at most the board's corners, all finite."""
    import numpy as np

    from calib.stages.camera.options import Told
    from calib.stages.camera.read import read_views, read_vnl

    path = folder / "corners.vnl"
    path.write_bytes(data)
    views = read_vnl(path, 3, 3, 0.02)
    assert len({view.name for view in views}) == len(views) > 0
    for view in views:
        assert 4 <= len(view.pixels) == len(view.target_m) <= 9
        assert np.isfinite(view.pixels).all() and np.isfinite(view.target_m).all()
    read_views([path], Told((3, 3), image_size_px=(640, 480)))

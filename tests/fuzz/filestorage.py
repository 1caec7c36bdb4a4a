"""Cameras in the files of other tools: OpenCV's FileStorage, ROS's camera_info, Kalibr's camchain."""

from __future__ import annotations

from pathlib import Path

MODULES = ("calib.stages.camera.formats", "calib.core.bounded_yaml")

WORDS = (
    b"%YAML:1.0\n---\n", b"!!opencv-matrix", b"camera_matrix:", b"distortion_coefficients:", b"image_width:",
    b"rows:", b"cols:", b"dt:", b"d", b"f", b"u", b"3d", b"r", b"data:", b"fisheye_model:",
    b"<?xml version=\"1.0\"?>",
    b"<opencv_storage>", b"</opencv_storage>", b"type_id=\"opencv-matrix\"",
    b"\"type_id\": \"opencv-matrix\"",
    b"base64", b"$base64$", b"!!binary |", b"100000", b"-3", b"2147483647", b"4294967296",
    b"!!opencv-sparse-matrix",
    b"!!opencv-nd-matrix", b"sizes:", b"distortion_model:", b"plumb_bob", b"rational_polynomial", b"cam0:",
    b"camera_model:", b"pinhole", b"radtan", b"none", b"intrinsics:", b"distortion_coeffs:", b"resolution:",
    b"[" * 50, b"{a: " * 50, b"<a>" * 50, b"<!ENTITY a 'b'>", b"<!-- ", b"-->", b"&lt;", b"Str",
    b"!!map", b"!!seq",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """A camera that can be written and read again, or a refusal."""
    import numpy as np

    from calib.core.errors import BadInputError
    from calib.core.files import as_text
    from calib.stages.camera.formats import from_kalibr, from_opencv, from_ros, to_opencv

    if len(data) > 200_000:
        return
    text = as_text(folder / "camera", data)
    for read in (from_opencv, from_ros, from_kalibr):
        try:
            camera = read(text)
        except BadInputError as error:
            refusal = str(error)
            assert refusal and "\n" not in refusal and len(refusal) < 2000, repr(refusal)
            continue
        assert np.isfinite(camera.K).all() and min(camera.image_size_px) > 0
        again = from_opencv(to_opencv(camera))
        assert np.array_equal(again.K, camera.K) and np.array_equal(again.distortion, camera.distortion)

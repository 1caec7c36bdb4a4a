"""mrcal on views of one board: read as .npz from the file named first, seconds and answer as JSON.

Run by the interpreter that has mrcal (Debian installs it for the system's Python), not by ours. The
steps are those of mrcal-calibrate-cameras with an opencv4 lens and no deformed board: seed, then
geometry, then the intrinsics' core, then everything.
"""

import json
import sys
import time

import mrcal
import numpy as np


def main(path: str) -> None:
    """Solve and print."""
    given = np.load(path)
    pixels, square_m = given["pixels"], float(given["square_m"])
    views = len(pixels)
    sizes = given["image_size_px"].reshape(1, 2).astype(np.int32)
    observations = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
    frame_camera = np.stack([np.arange(views), np.zeros(views)], axis=1).astype(np.int32)
    began = time.perf_counter()
    intrinsics, _, frames = mrcal.seed_stereographic(
        imagersizes=sizes,
        focal_estimate=float(sizes.max()),
        indices_frame_camera=frame_camera,
        observations=observations,
        object_spacing=square_m,
    )
    lens = "LENSMODEL_OPENCV4"
    values = np.zeros((1, 8))
    values[:, :4] = intrinsics
    problem = {
        "lensmodel": lens,
        "intrinsics": values,
        "imagersizes": sizes,
        "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": frames,
        "points": None,
        "observations_board": observations.copy(),
        "indices_frame_camintrinsics_camextrinsics": np.stack(
            [np.arange(views), np.zeros(views), -np.ones(views)], axis=1
        ).astype(np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "calibration_object_spacing": square_m,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "do_optimize_calobject_warp": False,
        "verbose": False,
    }
    for core, distortion in ((False, False), (True, False), (True, True)):
        found = mrcal.optimize(
            **problem,
            do_optimize_intrinsics_core=core,
            do_optimize_intrinsics_distortions=distortion,
            do_optimize_extrinsics=True,
            do_optimize_frames=True,
        )
    seconds = time.perf_counter() - began
    print(
        json.dumps({"seconds": seconds, "fx_px": values[0, 0], "rms_px": found["rms_reproj_error__pixels"]})
    )


main(sys.argv[1])

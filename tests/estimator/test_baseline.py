"""The source's pipeline: what the simulated firmware makes of the same log."""

from __future__ import annotations

import numpy as np
from estimatorlogs import rows_from, setup_for, simulated

from calib.estimator.baseline import BASELINE, Baseline, BaselineSetup, undistorting_nothing
from calib.estimator.setup import Rows
from calib.twin.feedback import Firmware, FirmwareState, add_frame, add_imu
from calib.twin.rig import workspace_homography


def test_it_is_the_firmware_of_the_simulated_rig() -> None:
    rig, log = simulated("ellipse", 1)
    to_plane = np.linalg.inv(workspace_homography(rig.view))
    rows = rows_from(log)
    made = Baseline(BaselineSetup(to_plane, rig.plant.bellows_radius_m, rig.plant.rest_length_m)).run(rows)
    firmware = Firmware(to_plane, rig.plant.bellows_radius_m, rig.plant.rest_length_m, 0.015, 100.0)
    state = FirmwareState()
    for i in range(600):
        u, v, ax, ay, gz = rows.readings[i].tolist()
        if rows.kinds[i] == 2:
            state = add_imu(firmware, state, ax, ay, gz)
            continue
        state, seen = add_frame(firmware, state, u, v)
        assert np.allclose(made[i, 1:4], [*seen.q_m, seen.phi_rad], rtol=0, atol=1e-12)


def test_blocks_make_no_difference() -> None:
    rig, log = simulated("swing")
    rows = rows_from(log)
    setup = BaselineSetup(np.linalg.inv(workspace_homography(rig.view)), rig.plant.bellows_radius_m)
    whole, cut = Baseline(setup).run(rows), Baseline(setup)
    parts = [
        cut.run(Rows(rows.t_s[s], rows.readings[s], rows.kinds[s])) for s in (slice(0, 33), slice(33, None))
    ]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert whole.shape[1] == len(BASELINE) and np.isfinite(whole).all()


def test_homography_takes_the_lens_for_ideal() -> None:
    rig, _ = simulated("static")
    setup = setup_for(rig)
    found = undistorting_nothing(setup.view, (-0.06, 0.05, 0.06, 0.11), rig.view.camera.image_size_px)
    expected = np.linalg.inv(workspace_homography(rig.view))
    np.testing.assert_allclose(found / found[2, 2], expected / expected[2, 2], rtol=2e-2, atol=1e-4)

"""Logs for tuning: grid, references, densities, and what is said about them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armlogs import swung, write
from scipy.spatial.transform import Rotation

from calib.errors import BadInputError
from calib.imu.gains import DATA_SHEET
from calib.rig import Rig
from calib.tunelogs import Reading, read_tune_log, sensor_noise


def test_reads_angles_rates_and_truth(tmp_path: Path) -> None:
    arm = swung(0)
    log = read_tune_log(write(tmp_path / "a.csv", arm), Reading())
    (piece,) = log.pieces
    assert (log.reference, log.lag_s, log.said) == ("truth", 0.0, ())
    assert np.allclose(piece.phi_acc_rad, arm.phi_acc, atol=1e-6)
    assert np.allclose(piece.rate_radps, -arm.gz, atol=1e-6)
    assert piece.reference_rad is not None
    assert np.allclose(piece.reference_rad, arm.phi, atol=1e-6)
    assert read_tune_log(tmp_path / "a.csv", Reading(reference="none")).pieces[0].reference_rad is None


@pytest.mark.parametrize(
    ("how", "words"),
    [
        (Reading(reference="truth"), "has no column true_phi_rad"),
        (Reading(reference="camera"), "has no columns u_px and v_px"),
        (Reading(reference="onchip"), "has no column onchip_phi_rad"),
        (Reading(tilted=True), "has no readings of gx, gy, az, expected all six axes for --rate up"),
    ],
)
def test_what_was_asked_for_has_to_be_there(tmp_path: Path, how: Reading, words: str) -> None:
    path = write(tmp_path / "a.csv", swung(0), truth=False)
    with pytest.raises(BadInputError, match=words):
        read_tune_log(path, how)


def test_densities_come_from_rests_or_a_data_sheet(tmp_path: Path) -> None:
    resting = read_tune_log(write(tmp_path / "a.csv", swung(0, rest_s=12.0)), Reading())
    noise, told = sensor_noise(Rig(), [resting])
    assert noise.gyro == pytest.approx(np.radians(0.01), rel=0.2)
    assert told == "the logs' rests, a data sheet's walk of the bias"
    moving = read_tune_log(write(tmp_path / "b.csv", swung(0, rest_s=-9.0)), Reading())
    assert sensor_noise(Rig(), [moving]) == (DATA_SHEET, "a data sheet")


def test_a_chips_angle_is_late(tmp_path: Path) -> None:
    arm = swung(3)
    path = write(tmp_path / "a.csv", arm, truth=False)
    late = np.interp(arm.t_s - 0.03, arm.t_s, arm.phi)
    lines = path.read_text().splitlines()
    rows = [lines[0] + ",onchip_phi_rad", *(f"{a},{b:.6f}" for a, b in zip(lines[1:], late, strict=True))]
    path.write_text("\n".join(rows) + "\n")
    log = read_tune_log(path, Reading(reference="onchip"))
    assert log.lag_s == pytest.approx(0.03, abs=0.004)


def test_a_sensor_that_tilts_is_noticed(tmp_path: Path) -> None:
    t = 0.01 * np.arange(3000)
    head = "t_s,ax_mps2,ay_mps2,az_mps2,gx_radps,gy_radps,gz_radps"
    rng = np.random.default_rng(0)
    for swing, flat in ((0.0, True), (0.8, False)):
        tilt = swing * np.sin(1.3 * t)
        R_WS = Rotation.from_euler("ZY", np.stack([0.5 * np.sin(2.0 * t), tilt], axis=1))
        turn = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() / 0.01
        gyro = np.concatenate([turn[:1], turn]) + 1e-3 * rng.normal(size=(3000, 3))
        force = R_WS.inv().apply([9.81, 0.0, 0.0]) + 0.02 * rng.normal(size=(3000, 3))
        table = np.column_stack([t, force, gyro])
        path = tmp_path / "a.csv"
        path.write_text(head + "\n" + "\n".join(",".join(f"{x:.7g}" for x in row) for row in table) + "\n")
        log = read_tune_log(path, Reading())
        assert log.pieces[0].in_plane is flat
        assert any("--rate up" in sentence for sentence in log.said) is not flat
        assert read_tune_log(path, Reading(tilted=True)).pieces[0].in_plane

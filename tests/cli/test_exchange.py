"""`calib export` and `calib import`: there and back, and files that are something else."""

from __future__ import annotations

import json

import pytest
import yaml

FORMATS = ("ros", "opencv", "kalibr")


@pytest.mark.parametrize("form", FORMATS)
def test_there_and_back(calib, rig, tmp_path, form: str) -> None:
    file, other = tmp_path / f"{form}.yaml", tmp_path / "other.yaml"
    assert calib("export", form, "--rig", rig, "-o", file).code == 0
    assert calib("export", form, "--rig", rig).out == file.read_text().rstrip("\n") + "\n"
    document = json.loads(calib("export", form, "--rig", rig, "--json").out)
    assert document["text"] == file.read_text()
    ended = calib("import", form, file, "--rig", other)
    assert ended.code == 0
    assert "without error bars" in ended.out
    before, after = (yaml.safe_load(path.read_text())["camera"] for path in (rig, other))
    for key in ("fx_px", "fy_px", "cx_px", "cy_px", "image_size_px"):
        assert after[key] == before[key]
    assert after["distortion"]["k1"] == before["distortion"]["k1"]
    assert after["verdict"] == "poor"
    assert list(yaml.safe_load(other.read_text())["provenance"]["inputs"]["camera"]) == [file.name]


def test_a_poor_camera_is_exported_with_a_word(calib, rig) -> None:
    rig.write_text(rig.read_text().replace("verdict: ok", "verdict: poor", 1).split("\nplane:")[0] + "\n")
    ended = calib("export", "ros", "--rig", rig)
    assert ended.code == 0
    assert "verdict is poor; the format cannot say so" in ended.err


def test_an_import_leaves_the_plane_behind(calib, rig, tmp_path) -> None:
    calib("export", "opencv", "--rig", rig, "-o", tmp_path / "camera.yml")
    ended = calib("import", "opencv", tmp_path / "camera.yml", "--rig", rig, "--json")
    assert json.loads(ended.out)["camera"]["verdict"] == "poor"
    assert "plane in the file is of an earlier camera" in ended.err


BAD = {
    "empty": b"",
    "binary": bytes(range(256)),
    "a list": b"- 1\n",
    "other keys": b"services: {}\n",
    "cut off": b"image_width: [1, 2\n",
    "deep": b"[" * 5000,
    "xml": b'<?xml version="1.0"?><opencv_storage></opencv_storage>',
    "large": b"a: 1\n" * 100_000,
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("what", BAD)
def test_other_files(calib, rig, tmp_path, form: str, what: str) -> None:
    file, before = tmp_path / "camera.yaml", rig.read_bytes()
    file.write_bytes(BAD[what])
    ended = calib("import", form, file, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(f"{file}: ")
    assert rig.read_bytes() == before


def test_no_file(calib, tmp_path) -> None:
    for source, says in (
        (tmp_path, "is a folder, expected a file"),
        (tmp_path / "gone", "cannot be read: No such file"),
        ("/dev/zero", "is a pipe or a device"),
    ):
        ended = calib("import", "opencv", source, "--rig", tmp_path / "rig.yaml")
        assert ended.code == 3
        assert says in ended.sentence
    ended = calib("export", "ros", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert "has no camera yet" in ended.sentence


def test_places_that_cannot_be_written(calib, rig, tmp_path) -> None:
    for place, says in ((tmp_path, "is a folder"), (tmp_path / "no" / "x.yaml", "there is no folder")):
        ended = calib("export", "ros", "--rig", rig, "-o", place)
        assert ended.code == 3
        assert says in ended.sentence


def test_a_name_of_several_lines_stays_one_value(calib, rig) -> None:
    text = calib("export", "ros", "--rig", rig, "--name", "left: x\nimage_width: 5").out
    assert yaml.safe_load(text)["image_width"] == 316


IMU = (
    "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    "gyroscope_noise_density: 1.6968e-04\ngyroscope_random_walk: 1.9393e-05\n"
    "rostopic: /imu0\nupdate_rate: 200.0\n"
)


def test_the_noise_of_an_imu_there_and_back(calib, rig, tmp_path) -> None:
    file, again = tmp_path / "imu.yaml", tmp_path / "again.yaml"
    assert calib("export", "kalibr-imu", "--rig", rig).code == 3
    file.write_text(IMU)
    ended = calib("import", "kalibr-imu", file, "--rig", rig)
    assert ended.code == 0 and "verdict is poor until" in ended.out
    section = yaml.safe_load(rig.read_text())["imu"]
    assert section["gyro_walk_radps2_per_sqrt_Hz"] == [1.9393e-05] * 3 and section["rate_hz"] == 200.0
    ended = calib("export", "kalibr-imu", "--rig", rig, "-o", again, "--name", "/imu0")
    assert ended.code == 0 and "the IMU's verdict is poor" in ended.err
    assert yaml.safe_load(again.read_text()) == yaml.safe_load(IMU)
    assert calib("export", "kalibr-imu", "--rig", rig, "--name", "x: 1\ny").code == 2
    assert json.loads(calib("import", "kalibr-imu", again, "--rig", rig, "--json").out)["imu"] == section


@pytest.mark.parametrize("what", BAD)
def test_other_files_for_an_imu(calib, rig, tmp_path, what: str) -> None:
    file, before = tmp_path / "imu.yaml", rig.read_bytes()
    file.write_bytes(BAD[what])
    ended = calib("import", "kalibr-imu", file, "--rig", rig)
    assert ended.code == 3 and ended.err.count("\n") == 1 and str(file) in ended.err
    assert rig.read_bytes() == before

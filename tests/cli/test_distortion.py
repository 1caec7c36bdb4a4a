"""`calib distortion`: what it says, and what it makes of strange cameras and regions."""

from __future__ import annotations

import json

import pytest
import yaml


def test_the_shipped_camera(calib, rig) -> None:
    ended = calib("distortion", "--rig", rig)
    assert ended.code == 0
    assert "mustache distortion, radial2" in ended.out
    assert "verdict: matters" in ended.out
    whole = yaml.safe_load(rig.read_text())
    assert whole["lens"]["inverse"]["max_error_px"] < 0.01
    assert set(whole["provenance"]["inputs"]["lens"]) == {"camera", "plane"}
    assert json.loads(calib("distortion", "--rig", rig, "--json").out)["lens"] == whole["lens"]


def test_a_camera_has_to_be_there_first(calib, tmp_path) -> None:
    ended = calib("distortion", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert "has no camera yet; run calib intrinsics first" in ended.sentence


def test_a_region(calib, rig) -> None:
    ended = calib("distortion", "--rig", rig, "--region", "10,20,30,40.5")
    assert ended.code == 0
    assert yaml.safe_load(rig.read_text())["lens"]["region_px"] == [10.0, 20.0, 30.0, 40.5]
    for region in ("0,0,316,208", "-5,0,10,10"):
        ended = calib("distortion", "--rig", rig, f"--region={region}")
        assert ended.code == 3
        assert "is not a box [u0, v0, u1, v1] inside the picture of 316x208 px" in ended.sentence


@pytest.mark.parametrize("k1", ["-50.0", "1.0e+5", "1.0e+30", "-1.0"])
def test_a_lens_that_cannot_be_undone(calib, rig, k1: str) -> None:
    camera = yaml.safe_load(rig.read_text())["camera"]
    camera["distortion"]["k1"] = float(k1)
    rig.write_text(yaml.safe_dump({"camera": camera}))
    ended = calib("distortion", "--rig", rig)
    assert ended.code == 0
    assert "verdict: matters" in ended.out
    ended = calib("firmware", "--rig", rig, "-o", rig.parent)
    assert ended.code == 1
    assert "the lens is undone to" in ended.err
    assert "#define CALIB_CAMERA_OK 0" in (rig.parent / "calib_constants.h").read_text()


def test_a_covariance_that_is_none(calib, rig) -> None:
    whole = yaml.safe_load(rig.read_text())
    table = whole["camera"]["covariance"]
    del whole["plane"]
    for change, says in (
        (
            {"order": ["fx_px", *table["order"][:-1]]},
            "camera.covariance.order has 'fx_px', expected intrinsics, each once",
        ),
        ({"order": ["f", *table["order"][1:]]}, "camera.covariance.order has 'f'"),
        ({"values": table["values"][1:]}, "expected 6 rows and columns"),
        ({"values": [[-9.0, *table["values"][0][1:]], *table["values"][1:]]}, "is not a covariance matrix"),
    ):
        whole["camera"]["covariance"] = table | change
        rig.write_text(yaml.safe_dump(whole))
        ended = calib("distortion", "--rig", rig)
        assert ended.code == 3
        assert says in ended.sentence
    whole["camera"]["covariance"] = {"order": [], "values": []}
    rig.write_text(yaml.safe_dump(whole))
    assert calib("distortion", "--rig", rig).code == 0

"""Sections of rig.yaml: what is outdated, what is not a section, and verdicts that are handed on."""

from __future__ import annotations

import numpy as np
import pytest

from calib import rig
from calib.camera.model import Camera
from calib.errors import BadInputError
from calib.sections import (
    camera_covariance,
    camera_from_section,
    image_grid,
    imported_camera_section,
    outdated,
)

CAMERA = Camera(
    "radial2", (316, 208), 273.4, 272.6, 0.0, 160.7, 101.9, np.array([-0.22, 0.55, 0, 0, 0, 0, 0, 0])
)


def test_there_and_back() -> None:
    section = imported_camera_section(CAMERA, "ros")
    again = camera_from_section(section)
    assert (again.model, again.image_size_px, again.fx_px) == ("radial2", (316, 208), 273.4)
    np.testing.assert_array_equal(again.distortion, CAMERA.distortion)
    assert camera_covariance(section, "rig.yaml") is None


def test_the_grid_reaches_the_borders() -> None:
    grid = image_grid((316, 208))
    assert grid.min(axis=0).tolist() == [0, 0]
    assert grid.max(axis=0).tolist() == [315, 207]


def test_values_that_no_camera_has_end_in_a_sentence() -> None:
    wild = Camera("pinhole", (316, 208), 1e9, 272.6, 0.0, 160.7, 101.9, np.zeros(8))
    with pytest.raises(BadInputError, match=r"no useful answer follows .* fx_px came out as 1000000000\.0"):
        imported_camera_section(wild, "ros")


def test_what_is_outdated() -> None:
    camera = imported_camera_section(CAMERA, "ros")
    known = {"plane": {"camera": rig.identity(camera)}, "lens": {"camera": "another"}}
    whole = rig.Rig.model_construct(
        camera=camera, plane=camera, lens=camera, provenance=rig.Provenance(inputs=known)
    )
    assert outdated(whole) == ["lens in the file is of an earlier camera; run calib distortion again"]
    whole.provenance.inputs["plane"]["camera"] = "another"
    assert [sentence.split()[0] for sentence in outdated(whole)] == ["plane", "lens"]
    assert outdated(rig.Rig()) == []

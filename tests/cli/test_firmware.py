"""`calib firmware`: the header is written, marked where the calibration is poor, and always whole."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest
import yaml
from firmware_build import need

from calib.stages.firmware.header import VERBATIM

UNTUNED = (
    "no controller yet: gains and feed-forward are those of the nominal actuator, and compile for a board "
    "only with CALIB_I_KNOW"
)


def test_the_header(calib, rig) -> None:
    ended = calib("firmware", "--rig", rig, "-o", rig.parent / "new" / "out")
    path = rig.parent / "new" / "out" / "calib_constants.h"
    files = [*VERBATIM, "calib_constants.h", "calib_selftest.h", "out.ino"]
    names = sorted(files)
    told = "the rig is a simulated one: for a board its constants compile only with CALIB_I_KNOW"
    words = f"147 constants\nverdict: ok\n  (remark) {UNTUNED}\n  (remark) {told}\n"
    assert (ended.code, ended.out) == (0, f"{words}  next: run calib identify and calib control tune\n")
    assert ended.err == f"{', '.join(files)} written to {path.parent}\n"
    assert sorted(p.name for p in path.parent.iterdir()) == names
    text = path.read_text("ascii")
    assert "#define CALIB_CAMERA_OK 1" in text
    assert "#define CALIB_RIG_OK 0" in text
    assert str(rig.parent) not in text
    assert "input plane/board.yaml: " in text
    if compiler := shutil.which("cc"):
        subprocess.run([compiler, "-fsyntax-only", "-Wall", "-Werror", "-x", "c", str(path)], check=True)


@pytest.mark.parametrize("which", ["camera", "plane", "both"])
def test_a_poor_rig_is_written_and_marked(calib, rig, which: str) -> None:
    text = rig.read_text()
    head, tail = text[: text.index("\nplane:")], text[text.index("\nplane:") :]
    if which != "plane":
        head = head.replace("verdict: ok", "verdict: poor")
        # The plane belongs to this camera all the same.
        tail = tail[: tail.index("\nprovenance:")] + "\n"
    if which != "camera":
        tail = tail.replace("verdict: ok", "verdict: poor").split("\n  written:")[0] + "\n"
    rig.write_text(head + tail)
    ended = calib("firmware", "--rig", rig, "-o", rig.parent, "--json")
    assert ended.code == 1
    weak = ["camera", "plane"] if which == "both" else [which]
    told = json.loads(ended.out)
    assert told["gate"] == [f"{name} is poor" for name in weak]
    assert UNTUNED in told["remarks"]
    assert "run calib identify and calib control tune" in told["advice"]
    text = (rig.parent / "calib_constants.h").read_text()
    for name in ("camera", "plane"):
        assert f"#define CALIB_{name.upper()}_OK {int(name not in weak)}" in text


def test_another_section_that_is_poor(calib, rig) -> None:
    assert calib("lowpass", "--rig", rig).code == 0
    document = yaml.safe_load(rig.read_text())
    document["lowpass"]["verdict"] = "poor"
    rig.write_text(yaml.safe_dump(document))
    ended = calib("firmware", "--rig", rig, "-o", rig.parent)
    assert ended.code == 1
    assert "verdict: poor\n  - lowpass is poor\n" in ended.out


def test_the_polynomial_of_the_lens_section_is_used(calib, rig) -> None:
    """That of `calib distortion`, where it is of this camera and as written; else it is fitted anew."""
    assert calib("distortion", "--rig", rig).code == 0
    document = yaml.safe_load(rig.read_text())
    document["lens"]["inverse"]["radial"][0] = 0.125
    its, seal = document["provenance"]["inputs"]["lens"]["camera"], document["provenance"].pop("written")
    for camera, written, used in ((its, {}, True), ("0" * 64, {}, False), (its, seal, False)):
        document["provenance"]["inputs"]["lens"]["camera"] = camera
        document["provenance"]["written"] = written
        rig.write_text(yaml.safe_dump(document))
        assert calib("firmware", "--rig", rig, "-o", rig.parent).code == 0
        text = (rig.parent / "calib_constants.h").read_text()
        assert ("#define CALIB_LENS_INVERSE_C1 0.125f " in text) == used


def test_places_that_are_no_folder(calib, rig) -> None:
    for place in (rig, rig / "out"):
        ended = calib("firmware", "--rig", rig, "-o", place)
        assert ended.code == 3
        assert ended.sentence == f"{place}: cannot be made a folder: {rig} is a file"
    (rig.parent / "out" / "calib_constants.h").mkdir(parents=True)
    ended = calib("firmware", "--rig", rig, "-o", rig.parent / "out")
    assert ended.code == 3
    assert "calib_constants.h: is a folder, expected a file to write" in ended.sentence


def test_a_rig_without_a_plane(calib, rig) -> None:
    text = rig.read_text()
    rig.write_text(text[: text.index("\nplane:")] + "\n")
    ended = calib("firmware", "--rig", rig, "-o", rig.parent)
    assert ended.code == 0
    assert "116 constants\n" in ended.out and "no plane yet" in ended.out
    text = (rig.parent / "calib_constants.h").read_text()
    assert "#define CALIB_HAS_PLANE 0" in text
    assert "CALIB_PLANE_INVERSE" not in text


@pytest.mark.parametrize(
    ("verb", "name", "hint"),
    [
        (("firmware", "-o", "out"), "rigg.yaml", "; did you mean rig.yaml?"),
        (("firmware", "-o", "out"), "my_rgi/rig.yaml", ""),
        # These write into the rig's file, and live on what is in it.
        (("control", "tune"), "rigg.yaml", "; did you mean rig.yaml?"),
        (("distortion",), "rigg.yaml", "; did you mean rig.yaml?"),
    ],
)
def test_a_rig_whose_name_is_mistyped_is_no_bare_board(calib, rig, verb, name: str, hint: str) -> None:
    ended = calib(*verb, "--rig", name, cwd=rig.parent)
    assert ended.code == 3
    assert ended.sentence == f"{name}: cannot be read: there is no such file{hint}"
    assert not (rig.parent / "out").exists() and not (rig.parent / name).exists()


def test_a_number_that_no_float_holds(calib, rig) -> None:
    text = rig.read_text()
    text = text[: text.index("\nplane:")]
    rig.write_text(text.replace("skew_px: 0.0", "skew_px: 1.0e-42") + "\n")
    ended = calib("firmware", "--rig", rig, "-o", rig.parent / "out")
    assert ended.code == 3
    assert "CALIB_CAMERA_SKEW_PX is 1e-42, which no normal float of C can hold" in ended.sentence
    assert not (rig.parent / "out").exists()


def test_a_sketch_without_the_guard_is_named_and_does_not_compile(calib, rig, tmp_path) -> None:
    out = tmp_path / "out"
    assert calib("firmware", "--rig", rig, "-o", out).code in (0, 1)
    sketch = out / "out.ino"
    old = sketch.read_text().replace('#include "calib_guard.h"\n', "").replace("SCHEMA 5", "SCHEMA 3")
    sketch.write_text(old)
    told = calib("firmware", "--rig", rig, "-o", out).err
    assert "left as it is" in told and "has no guard, so that nothing stops the pumps" in told
    assert sketch.read_text() == old
    need("gcc")
    words = ["gcc", "-fsyntax-only", "-x", "c", "-DCALIB_EXPECT_SCHEMA=3", str(out / "calib_constants.h")]
    compiled = subprocess.run(words, capture_output=True, text=True, check=False)
    assert compiled.returncode != 0 and "schema" in compiled.stderr

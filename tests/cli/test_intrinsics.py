"""`calib intrinsics` from pictures, tables and corner files: what it writes, says, and refuses."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml

SIZE = ("--image-size", "640x480")
RADIAL2 = ("--model", "radial2")


def _camera(rig) -> dict:
    return yaml.safe_load(rig.read_text())["camera"]


def test_the_shipped_pictures(calib, project_root, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", project_root / "images", "--rig", rig)
    assert ended.code == 0
    assert "verdict: ok" in ended.out
    assert "models compared" in ended.out
    assert ended.err.splitlines() == ["board found in 17 of 17 pictures", f"camera written to {rig}"]
    truth = json.loads((project_root / "tests" / "truth" / "pictures.json").read_text())["camera"]
    camera = _camera(rig)
    assert camera["model"] == "radial2"
    assert camera["fx_px"] == pytest.approx(truth["fx_px"], abs=5 * camera["sigma"]["fx_px"])
    whole = yaml.safe_load(rig.read_text())
    assert set(whole["provenance"]) == {"version", "inputs"}
    inputs = whole["provenance"]["inputs"]["camera"]
    assert len(inputs) == 18
    assert "board.yaml" in inputs
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in inputs.values())
    assert all("/" not in name for name in inputs)


def test_the_size_of_an_unknown_board_is_found_and_a_turned_one_is_the_same(
    calib, pictures, tmp_path
) -> None:
    folder, rig = pictures(4), tmp_path / "rig.yaml"
    ended = calib("intrinsics", folder, *RADIAL2, "--rig", rig)
    assert "found a board with 7x5 inner corners" in ended.err
    assert "the square's length is not given" in ended.err
    found = _camera(rig)
    calib("intrinsics", folder, *RADIAL2, "--rig", rig, "--corners", "5x7", "--square", "20mm")
    assert _camera(rig)["fx_px"] == pytest.approx(found["fx_px"], rel=1e-6)


def test_a_wrong_size_is_answered_with_what_was_found(calib, pictures, tmp_path) -> None:
    folder = pictures(4, "corners: [8, 6]\nsquare_m: 0.03\n")
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == (
        "view01.png ... view04.png: no board with 8x6 inner corners found in any of 4 pictures, "
        "but one with 7x5 was"
    )
    assert not rig.exists()
    ended = calib("intrinsics", folder, *RADIAL2, "--rig", rig, "--corners", "7x5", "--square", "2cm")
    assert ended.code in (0, 1)
    assert "--corners: 7x5 is used, not 8x6 of board.yaml" in ended.err
    assert "--square: 0.02 m is used, not 0.03 m of board.yaml" in ended.err


def test_a_picture_size_that_the_pictures_have_not(calib, pictures, tmp_path) -> None:
    folder, rig = pictures(2), tmp_path / "rig.yaml"
    assert calib("intrinsics", folder, *RADIAL2, "--image-size", "316x208", "--rig", rig).code == 1
    ended = calib("intrinsics", folder, *RADIAL2, *SIZE, "--rig", rig)
    assert ended.code == 3
    assert "are 316x208 px, expected 640x480 px" in ended.sentence


def test_few_views(calib, pictures, tmp_path) -> None:
    rig = ("--rig", tmp_path / "rig.yaml")
    two, one = pictures(2, name="two"), pictures(1, name="one")
    ended = calib("intrinsics", two, *rig, "--skew")
    assert ended.code == 3
    assert ended.sentence == "a camera with skew needs at least 3 views, found 2"
    assert not (tmp_path / "rig.yaml").exists()
    ended = calib("intrinsics", one, *rig)
    assert ended.code == 1
    assert "verdict: unidentifiable" in ended.out
    assert "verdict: unidentifiable" in (tmp_path / "rig.yaml").read_text()
    assert calib("intrinsics", one, *rig, "--board", "released").code == 3


def test_a_new_camera_tells_what_it_leaves_behind(calib, rig, points) -> None:
    assert calib("distortion", "--rig", rig).code == 0
    ended = calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    assert "plane in the file is of an earlier camera; run calib extrinsics again" in ended.err
    assert "lens in the file is of an earlier camera; run calib distortion again" in ended.err


def test_a_table(calib, points, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", points, *SIZE, *RADIAL2, "--skew", "--rig", rig)
    assert "640x480 px, 6 views, 324 points" in ended.out
    camera = _camera(rig)
    assert camera["fx_px"] == pytest.approx(530.0, abs=5 * camera["sigma"]["fx_px"])
    assert "skew_px" in camera["sigma"]
    assert list(yaml.safe_load(rig.read_text())["provenance"]["inputs"]["camera"]) == ["points.csv"]


def _swapped(text: str) -> str:
    order = (3, 1, 4, 0, 2)
    return "\n".join(",".join(line.split(",")[i] for i in order) for line in text.splitlines())


SAME = {
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "a byte-order mark": lambda text: "\ufeff" + text,
    "blank lines": lambda text: text.replace("\n", "\n\n") + "  \n\t\n",
    "quotes": lambda text: "\n".join(
        ",".join(f'"{c}"' for c in line.split(",")) for line in text.splitlines()
    ),
    "more columns": lambda text: "".join(
        f'{line},"a, b",\n' if i else f"{line},c,d\n" for i, line in enumerate(text.splitlines())
    ),
    "another order": _swapped,
    "a distant origin": lambda text: re.sub(
        r"(?m)^(view\d+),([^,]*)", lambda m: f"{m[1]},{float(m[2]) + 1000!r}", text
    ),
}


@pytest.mark.parametrize("form", SAME)
def test_tables_of_other_form_say_the_same(calib, points, table_text, tmp_path, form: str) -> None:
    rig = tmp_path / "rig.yaml"
    calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    expected = _camera(rig)
    points.write_bytes(SAME[form](table_text).encode())
    calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    assert _camera(rig)["fx_px"] == pytest.approx(expected["fx_px"], rel=1e-7)
    assert _camera(rig)["points"] == 324


def _with(text: str, column: int, value: str) -> str:
    lines = text.splitlines()
    cells = lines[5].split(",")
    cells[column] = value
    return "\n".join([*lines[:5], ",".join(cells), *lines[6:]]) + "\n"


WRONG = {
    "nan": (lambda t: _with(t, 3, "nan"), "line 6: u_px is 'nan', expected a finite number"),
    "1e400": (lambda t: _with(t, 4, "1e400"), "line 6: v_px is '1e400', expected a finite number"),
    "text": (lambda t: _with(t, 1, "x"), "line 6: x_m is 'x', expected a finite number"),
    "blank": (lambda t: _with(t, 2, ""), "line 6: y_m is empty, expected a finite number"),
    "decimal comma": (lambda t: _with(t, 3, "1,5"), "line 6: has 6 values, expected 5 as in the header"),
    "outside": (
        lambda t: _with(t, 3, "700"),
        "1 of 54 points lie outside a picture of 640x480 px, as (700, ",
    ),
    "far": (lambda t: _with(t, 1, "1e308"), "its target lies 1e+308 m away, expected metres"),
    "twice": (lambda t: t + t.splitlines()[5] + "\n", "was given in line 6"),
    "header only": (lambda t: t.splitlines()[0], "has a header but no points"),
    "no header": (lambda t: t.split("\n", 1)[1], "line 1: the header lacks view"),
    "semicolons": (lambda t: t.replace(",", ";"), "separated by commas, found 'view;x_m"),
    "three points": (lambda t: "\n".join(t.splitlines()[:4]), "has 3 points, expected at least 4"),
    "one line": (lambda t: "\n".join(t.splitlines()[:10]), "all its points lie on one line on the target"),
    "empty": (lambda t: "", "is empty; expected a header"),
    "binary": (lambda t: t[:99] + "\0" + t[99:], "has a zero byte; expected a text file"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_table(calib, points, table_text, rig, what: str) -> None:
    make, says = WRONG[what]
    before = rig.read_bytes()
    points.write_text(make(table_text))
    ended = calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    assert ended.code == 3
    assert says in ended.sentence
    assert ended.out == ""
    assert rig.read_bytes() == before


def test_options_that_do_not_go_with_a_table(calib, points, project_root, tmp_path) -> None:
    rig = ("--rig", tmp_path / "rig.yaml")
    for words, says in (
        ([points], "a table does not tell the size of the pictures; give --image-size"),
        ([points, *SIZE, "--corners", "9x6"], "--corners and --square do not go with it"),
        ([points, *SIZE, "--square", "25mm"], "--corners and --square do not go with it"),
        ([points, points, *SIZE], "a table is given alone"),
        ([project_root / "images", points, *SIZE], "a table is given alone"),
    ):
        ended = calib("intrinsics", *words, *rig)
        assert ended.code == 2
        assert says in ended.sentence
    ended = calib("intrinsics", points, "--image-size", "320x240", *rig)
    assert ended.code == 3
    assert "outside a picture of 320x240 px" in ended.sentence


def _vnl(table: str) -> str:
    rows = [line.split(",") for line in table.splitlines()[1:]]
    return "# filename x y level\n" + "".join(f"{name}.jpg {u} {v} 0\n" for name, _, _, u, v in rows)


def test_a_corner_file(calib, table_text, points, tmp_path) -> None:
    file, rig = tmp_path / "corners.vnl", tmp_path / "rig.yaml"
    file.write_text(_vnl(table_text))
    calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    expected = _camera(rig)["fx_px"]
    board = ("--corners", "9x6", "--square", "25mm")
    assert calib("intrinsics", file, *board, *SIZE, *RADIAL2, "--rig", rig).code in (0, 1)
    assert _camera(rig)["fx_px"] == pytest.approx(expected, rel=1e-9)
    assert (
        "the square's length is not given"
        in calib("intrinsics", file, *board[:2], *SIZE, *RADIAL2, "--rig", rig).err
    )
    for words, code, says in (
        ([*SIZE], 2, "a .vnl file does not tell the board; give --corners and --square"),
        ([*board], 2, "give --image-size"),
        ([*SIZE, "--corners", "8x6"], 3, "line 2: view01.jpg has 54 corners, expected 8x6 = 48"),
    ):
        ended = calib("intrinsics", file, *words, "--rig", rig)
        assert ended.code == code
        assert says in ended.sentence


def test_points_without_noise_come_to_an_end(calib, tmp_path) -> None:
    from calib.stages.camera.model import Camera
    from synthetic import views_of

    camera = Camera("pinhole", (640, 480), 600.0, 600.0, 0.0, 320.0, 240.0, np.zeros(8))
    rows = [
        f"{view.name},{x!r},{y!r},{u!r},{v!r}\n"
        for view in views_of(6, camera=camera)
        for (x, y), (u, v) in zip(view.target_m.tolist(), view.pixels.tolist(), strict=True)
    ]
    file, rig = tmp_path / "points.csv", tmp_path / "rig.yaml"
    file.write_text("view,x_m,y_m,u_px,v_px\n" + "".join(rows))
    ended = calib("intrinsics", file, *SIZE, "--rig", rig)
    assert ended.code in (0, 1)
    assert _camera(rig)["fx_px"] == pytest.approx(600.0, rel=1e-6)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "rational8"])
def test_points_that_belong_to_no_camera(calib, table_text, tmp_path, model: str) -> None:
    rng = np.random.default_rng(0)
    rows = [line.split(",")[:3] for line in table_text.splitlines()[1:]][:108]
    pixels = rng.uniform(0, 400, (len(rows), 2)).tolist()
    file, rig = tmp_path / "points.csv", tmp_path / "rig.yaml"
    lines = [",".join([*row, repr(u), repr(v)]) for row, (u, v) in zip(rows, pixels, strict=True)]
    file.write_text("view,x_m,y_m,u_px,v_px\n" + "\n".join(lines))
    ended = calib("intrinsics", file, *SIZE, "--model", model, "--rig", rig)
    if ended.code == 3:
        assert ended.sentence.startswith(("no camera fits these views", "no useful answer follows"))
        assert not rig.exists()
    else:
        assert ended.code == 1
        assert _camera(rig)["verdict"] != "ok"


@pytest.mark.slow
def test_a_table_of_many_rows_is_read_with_little_memory(tmp_path) -> None:
    import tracemalloc

    from calib.stages.camera.read import read_table

    rng = np.random.default_rng(0)
    file = tmp_path / "points.csv"
    rows = [f"v{i % 100},{x!r},{y!r},1.5,2.5\n" for i, (x, y) in enumerate(rng.random((40_000, 2)).tolist())]
    file.write_text("view,x_m,y_m,u_px,v_px\n" + "".join(rows))
    size = file.stat().st_size
    del rows
    tracemalloc.start()
    views = read_table(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(len(view.pixels) for view in views) == 40_000
    assert peak < 3 * size

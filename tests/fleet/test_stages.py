"""One rig in this process: the same bytes as the verbs that a person types, and what a folder may be."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from calib.core.errors import BadInputError
from calib.runner.graph import Command, run_here
from calib.runner.task import kind_of, rig_folder, run_stages


def _verbs(tmp_path: Path, *commands: tuple[str, ...]) -> bytes:
    rig, said = tmp_path / "single.yaml", tmp_path / "said.txt"
    for words in commands:
        assert run_here(Command("x", (*words, "--rig", str(rig)), said, said)) == 0, said.read_text()
    return rig.read_bytes()


@pytest.mark.slow
def test_the_bytes_are_those_of_single_verbs(tmp_path: Path, project_root: Path) -> None:
    root = tmp_path / "rig"
    shutil.copytree(project_root / "images", root / "images")
    folder = rig_folder(root)
    assert kind_of(folder) == "camera"
    ended = run_stages(folder, "camera", (("model", "radial2"),), tmp_path / "out")
    assert ended.code == 0 and set(ended.stages.values()) == {"ok"} and ended.reasons == ()
    images = str(root / "images")
    single = _verbs(
        tmp_path,
        ("intrinsics", images, "--model", "radial2"),
        ("extrinsics", f"{images}/plane"),
        ("distortion",),
    )
    assert (ended.out / "rig.yaml").read_bytes() == single


@pytest.mark.slow
def test_pictures_alone_and_a_page(tmp_path: Path, project_root: Path) -> None:
    root = tmp_path / "rig"
    root.mkdir()
    for path in (project_root / "images").iterdir():
        if path.is_file():
            shutil.copy(path, root)
    ended = run_stages(rig_folder(root), "camera", (), tmp_path / "out", page=True)
    assert ended.code == 0 and ended.stages["extrinsics"] == "skipped"
    assert (ended.out / "rig.yaml").read_bytes() == _verbs(
        tmp_path, ("intrinsics", str(root)), ("distortion",)
    )
    assert "report.html" in ended.files and "view17.png" in (ended.out / "report.html").read_text()


def test_what_a_rig_folder_holds(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInputError, match="holds no images/, no logs/ and no pictures"):
        rig_folder(tmp_path / "empty")
    logs = tmp_path / "with" / "logs"
    logs.mkdir(parents=True)
    (logs / "a.csv").write_text("t_s\n")
    assert kind_of(rig_folder(tmp_path / "with")) == "run"
    flat = tmp_path / "flat"
    flat.mkdir()
    (tmp_path / "secret.png").write_bytes(b"x")
    (flat / "a.png").write_bytes(b"x")
    (flat / "b.png").symlink_to(tmp_path / "secret.png")
    assert [path.name for path in rig_folder(flat).pictures] == ["a.png"]

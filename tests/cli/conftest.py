"""Running `calib` inside the test's process or as one of its own, on the shipped pictures."""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints
from fleet_processes import COMMAND

from calib.core.plot import Figure
from synthetic import views_of


@dataclass(frozen=True)
class Ended:
    """How a run ended: exit code, stdout and stderr."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """What was said of a failure: one line, after narration."""
        assert "Traceback" not in self.err
        said = [line for line in self.err.splitlines() if line.startswith("calib: ")]
        assert len(said) == 1
        assert self.err.endswith(said[0] + "\n")
        return said[0].removeprefix("calib: ")


Run = Callable[..., Ended]


@pytest.fixture(scope="session")
def calib() -> Run:
    """Runs `main` with these words in this process, where a Python warning is an error.

    Figures that it draws must be legible.
    """
    from calib.cli.main import main
    from calib.show import draw

    def run(*words: str | Path, cwd: Path | None = None) -> Ended:
        out, err = io.StringIO(), io.StringIO()
        illegible: dict[str, list[str]] = {}

        def save(figure: Figure, path: Path) -> Path:
            if found := complaints(figure):
                illegible[path.name] = found
            return saved(figure, path)

        saved = draw.save
        with (
            pytest.MonkeyPatch.context() as patch,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            contextlib.chdir(cwd or Path.cwd()),
        ):
            patch.setattr(sys, "argv", ["calib", *map(str, words)])
            patch.setattr(sys, "warnoptions", ["error"])
            patch.setattr(draw, "save", save)
            with pytest.raises(SystemExit) as left:
                main()
        assert not illegible
        assert isinstance(left.value.code, int)
        return Ended(left.value.code, out.getvalue(), err.getvalue())

    return run


@pytest.fixture(scope="session")
def environment(project_root: Path) -> dict[str, str]:
    """Environment for a process of its own that finds this checkout."""
    return {**os.environ, "PYTHONPATH": str(project_root)}


@pytest.fixture(scope="session")
def process(environment: dict[str, str]) -> Run:
    """Runs the command as a process of its own."""

    def run(*words: str | Path, cwd: Path | None = None, **variables: str) -> Ended:
        done = subprocess.run(
            [*COMMAND, *map(str, words)],
            cwd=cwd,
            env=environment | variables,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=120,
        )
        return Ended(done.returncode, done.stdout, done.stderr)

    return run


Shell = Callable[[str, Path], subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def shell(environment: dict[str, str]) -> Shell:
    """Runs a script of bash in a folder, in which `calib` is the command."""

    def run(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", "-c", script.replace("calib ", f"{shlex.join(COMMAND)} ")],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )

    return run


Start = Callable[[str], subprocess.Popen[str]]


@pytest.fixture
def python(environment: dict[str, str], tmp_path: Path) -> Start:
    """Starts a script of Python as a process in the test's folder."""

    def start(script: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", script],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


@pytest.fixture
def pictures(tmp_path: Path, project_root: Path) -> Callable[..., Path]:
    """Makes a folder with some of the shipped pictures, and board.yaml if one is given."""

    def make(count: int = 4, board: str | None = None, name: str = "views") -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for path in sorted((project_root / "images").glob("view*.png"))[:count]:
            shutil.copy(path, folder)
        if board is not None:
            (folder / "board.yaml").write_text(board)
        return folder

    return make


@pytest.fixture(scope="session")
def rig_text(calib: Run, project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """rig.yaml with a camera and a plane of the shipped pictures."""
    rig = tmp_path_factory.mktemp("rig") / "rig.yaml"
    assert calib("intrinsics", project_root / "images", "--model", "radial2", "--rig", rig).code == 0
    assert calib("extrinsics", project_root / "images" / "plane", "--rig", rig).code == 0
    return rig.read_text()


@pytest.fixture
def rig(rig_text: str, tmp_path: Path) -> Path:
    """A copy of that file."""
    path = tmp_path / "rig.yaml"
    path.write_text(rig_text)
    return path


@pytest.fixture(scope="session")
def table_text() -> str:
    """A table of six synthetic views of a 9x6 board, 640x480 px."""
    rows = ["view,x_m,y_m,u_px,v_px"]
    for view in views_of(6, noise_px=0.05, seed=3):
        for (x, y), (u, v) in zip(view.target_m.tolist(), view.pixels.tolist(), strict=True):
            rows.append(f"{view.name},{x!r},{y!r},{u!r},{v!r}")
    return "\n".join(rows) + "\n"


@pytest.fixture
def points(table_text: str, tmp_path: Path) -> Path:
    """That table as a file."""
    path = tmp_path / "points.csv"
    path.write_text(table_text)
    return path


@pytest.fixture(scope="session")
def noise() -> Callable[[int, int], np.ndarray]:
    """Makes grey noise without a board."""

    def make(width: int, height: int) -> np.ndarray:
        return np.random.default_rng(0).integers(0, 255, (height, width)).astype(np.uint8)

    return make

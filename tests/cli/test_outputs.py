"""No output takes the place of an input, of a calibration or of a file of somebody else."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from calib.core.files import sha256


@pytest.fixture(scope="session")
def swing(calib, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("swing") / "swing.csv"
    assert calib("simulate", "swing", "--duration", "4s", "-o", path).code == 0
    return path.read_bytes()


@pytest.fixture
def place(swing: bytes, rig: Path, project_root: Path) -> Path:
    """A folder with a rig, a log and pictures."""
    folder = rig.parent
    (folder / "in.csv").write_bytes(swing)
    (folder / "images").mkdir()
    for path in sorted((project_root / "images").glob("view0*.png"))[:6]:
        shutil.copy(path, folder / "images")
    (folder / "photo.pdf").write_bytes(b"%PDF-1.4 a thesis")
    (folder / "recorded.csv").write_text("t_s,gz_radps\n0,0.1\n")
    (folder / "table.csv").write_text("name,price\nbolt,3\n")
    shutil.copy(folder / "rig.yaml", folder / "other.yaml")
    (folder / "fleet.csv").write_text("name,path\na,.\n")
    (folder / "sweep.yaml").write_text("base: {scenario: swing}\ngrid: {scenario.phi_rad: [0.1]}\n")
    return folder


def _bytes(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256(path.read_bytes()) for path in files}


REFUSED = {
    "replay in.csv -o in.csv": "in.csv: is an input of this command, expected another name for states",
    "replay in.csv -o ./images/../in.csv": "is an input of this command",
    "replay in.csv -o rig.yaml": "rig.yaml: is an input of this command",
    "control check in.csv --slow rig.yaml": "rig.yaml: holds the sections of a rig",
    "replay in.csv -o new/rig.yaml": "rig.yaml: holds the sections of a rig",
    "replay in.csv -o table.csv": "table.csv: is there, and is not states that calib wrote",
    "replay in.csv -o states.yaml": "states.yaml: ends in .yaml, expected .csv, .parquet or .mcap for states",
    "convert in.csv -o in.csv": "in.csv: is an input of this command",
    "convert in.csv -o table.csv": "table.csv: is there, and is not a log that calib wrote",
    "convert in.csv -o recorded.csv": "recorded.csv: is there and says something else, which may be a record",
    "convert in.csv -o out.csv --save-columns rig.yaml": "rig.yaml: ",
    "convert in.csv -o out.csv --save-columns out.csv": "out.csv: would hold a log and a columns.yaml",
    "export ros -o rig.yaml": "rig.yaml: ",
    "export ros -o in.csv": "in.csv: ends in .csv, expected .yaml or .yml for a camera_info of ROS",
    "simulate swing --duration 1s -o rig.yaml": "rig.yaml: ",
    "simulate swing --duration 1s -o table.csv": "table.csv: is there, and is not a simulated log that",
    "board -o images/view01.png": "view01.png: ends in .png, expected .pdf for a board to print",
    "board -o board.svg": "board.svg: ends in .svg, expected .pdf for a board to print",
    "board -o photo.pdf": "photo.pdf: is there, and is not a board to print that calib wrote",
    "report rig.yaml -o rig.yaml": "rig.yaml: is an input of this command",
    "report rig.yaml -o table.csv": "table.csv: ends in .csv",
    "intrinsics images --figures images": "images: holds pictures that are read",
    "imu static in.csv --imu-yaml rig.yaml": "rig.yaml: would hold sections of a rig and an imu",
    "run . -o images/out": "images/out: lies in the folder that is read",
    "run . -o logs": "logs: lies in the folder that is read",
    "run . -o taken": "taken/rig.yaml: is there, and is not the work of calib run",
    "diff rig.yaml other.yaml -o other.yaml": "other.yaml: is an input of this command",
    "track images/view01.png -o in.csv": "in.csv: is there, and is not a track that calib wrote",
    "fleet fleet.csv -o .": ".: lies in the folder of a",
    "sweep sweep.yaml -o sweep.yaml": "sweep.yaml: cannot be made a folder",
    "simulate rig -o images": "images: is there already, expected a new or an empty folder",
    "align in.csv --rig table.csv": "table.csv: ",
    "record /dev/null -o in.csv": "in.csv: is there, and a recording cannot be made again",
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_there_is_not_lost(calib, place: Path, words: str) -> None:
    (place / "new").mkdir()
    (place / "taken").mkdir()
    shutil.copy(place / "rig.yaml", place / "taken")
    before = _bytes(place)
    ended = calib(*words.split(), cwd=place)
    assert ended.code == 3
    assert REFUSED[words] in ended.sentence
    assert _bytes(place) == before


@pytest.mark.parametrize("link", ["hard", "symbolic", "folder"])
def test_links_to_an_input_are_the_input(calib, place: Path, link: str) -> None:
    other = place / "other.csv"
    if link == "hard":
        other.hardlink_to(place / "in.csv")
    elif link == "symbolic":
        other.symlink_to("in.csv")
    else:
        (place / "again").symlink_to(".")
        other = place / "again" / "in.csv"
    before = _bytes(place)
    ended = calib("convert", "in.csv", "-o", other, cwd=place)
    assert ended.code == 3
    assert "is an input of this command" in ended.sentence
    assert _bytes(place) == before


AGAIN = {
    "replay in.csv -o {}": ("states.csv", "states.parquet", "states.mcap", "states.txt", "states"),
    "convert in.csv -o {}": ("log.csv", "log.parquet"),
    "convert in.csv -o copy.csv --save-columns {}": ("columns.yml",),
    "simulate swing --duration 1s -o {}": ("log.csv", "log.parquet"),
    "export ros -o {}": ("camera.yaml",),
    "export opencv -o {}": ("camera.yml",),
    "export kalibr -o {}": ("camchain.yaml",),
    "board --charuco --corners 11x8 --square 10mm -o {}": ("board.pdf",),
    "report rig.yaml -o {}": ("page.html",),
    "firmware -o {}": ("firmware",),
    "docs -o {}": ("manual",),
}


@pytest.mark.parametrize(
    ("words", "name"), [(words, name) for words, names in AGAIN.items() for name in names]
)
def test_what_calib_wrote_before_is_replaced(calib, place: Path, words: str, name: str) -> None:
    filled = words.format(name).split()
    codes = [calib(*filled, cwd=place).code for _ in range(2)]
    assert codes[0] == codes[1] in (0, 1)
    assert not list(place.rglob("*.tmp"))


def test_a_sketch_that_was_changed_stays(calib, place: Path) -> None:
    sketch = place / "sketch" / "sketch.ino"
    assert calib("firmware", "-o", sketch.parent, cwd=place).code == 0
    mine = sketch.read_text() + "\n// mine\n"
    sketch.write_text(mine)
    ended = calib("firmware", "-o", sketch.parent, cwd=place)
    assert ended.code == 0
    assert "sketch.ino: was changed since calib wrote it, and is left as it is" in ended.err
    assert sketch.read_text() == mine


def test_states_go_through_pipes(calib, shell, place: Path) -> None:
    """Alone on stdout, so that another program can read them; words go to stderr."""
    assert calib("replay", "in.csv", "-o", "states.csv", cwd=place).code in (0, 1)
    wanted = (place / "states.csv").read_text()
    done = shell("mkfifo pipe; (cat pipe) & calib replay in.csv -o pipe >&2; wait", place)
    assert done.stdout == wanted
    assert "verdict" in done.stderr
    done = shell("set -o pipefail; calib replay in.csv -o - | head -1", place)
    assert (done.returncode, done.stdout) == (141, wanted.split("\n", 1)[0] + "\n")


@pytest.mark.few(2, 3)
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("how", ["SIGTERM", "SIGHUP", "SIGINT", "SIGKILL"])
def test_a_write_that_is_ended_leaves_nothing(python, tmp_path: Path, how: str) -> None:
    """A killed process leaves what the next write into the folder removes; one at work keeps its own."""
    script = (
        "import signal, sys, time\n"
        # Tests under nohup inherit a signal that is not heard.
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "from calib.io import states\n"
        "def slow(values, kinds):\n"
        "    print('writing', flush=True); time.sleep(60)\n"
        "states.table_bytes = slow\n"
        "from calib.cli.main import main\n"
        "sys.argv = ['calib', 'convert', 'log.csv', '-o', 'out.csv']\n"
        "main()\n"
    )
    (tmp_path / "log.csv").write_text("t_s,u_px,v_px\n0,7,7\n")

    def begun() -> subprocess.Popen[str]:
        started = python(script)
        assert started.stdout is not None
        assert started.stdout.readline() == "writing\n"
        return started

    ended, other = begun(), begun()
    began = time.monotonic()
    ended.send_signal(getattr(signal, how))
    _, err = ended.communicate(timeout=30)
    assert time.monotonic() - began < 10.0
    left = [path.name for path in tmp_path.iterdir() if path.suffix == ".tmp"]
    if how == "SIGKILL":
        assert len(left) == 2
        again = begun()
        again.kill()
        again.communicate()
        assert len([path for path in tmp_path.iterdir() if path.suffix == ".tmp"]) == 2
    else:
        assert ended.returncode == 130
        assert err == "calib: interrupted; files that were there before are unchanged or whole\n"
        assert len(left) == 1
    other.terminate()
    other.communicate(timeout=30)
    assert not (tmp_path / "out.csv").exists()


def test_there_is_one_way_to_write(project_root: Path) -> None:
    """All files of the package but those of a process's own are written by `calib.core.writing`."""
    own = {"core/writing.py", "core/compilation.py", "runner/doctor.py", "runner/cache.py", "runner/fleet.py"}
    means = re.compile(
        r"write_(bytes|text)\(|copyfile\(|mkstemp\(|open\([^)]*['\"][wax]b?['\"]|savefig\(|imwrite\("
    )
    package = project_root / "calib"
    found = {
        f"{path.relative_to(package).as_posix()}: {line.strip()}"
        for path in package.rglob("*.py")
        if path.relative_to(package).as_posix() not in own
        for line in path.read_text().splitlines()
        if means.search(line) and "os." not in line and "closefd=False" not in line
    }
    assert not found

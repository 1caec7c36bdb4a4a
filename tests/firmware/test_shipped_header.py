"""What is in `firmware_constants/` is what the shipped pictures give."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path


def _calib(*words: str, cwd: Path) -> None:
    call = [sys.executable, "-c", "from calib.cli.main import main; main()", *words]
    done = subprocess.run(call, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_shipped_pictures_give_the_shipped_firmware(tmp_path: Path, project_root: Path) -> None:
    rig = str(tmp_path / "rig.yaml")
    _calib("intrinsics", "images", "--rig", rig, cwd=project_root)
    _calib("extrinsics", "images/plane", "--rig", rig, cwd=project_root)
    made = tmp_path / "firmware_constants"
    _calib("firmware", "-o", str(made), "--rig", rig, cwd=project_root)
    folder = project_root / "firmware_constants"
    assert sorted(p.name for p in made.iterdir()) == sorted(p.name for p in folder.iterdir())
    for path in made.iterdir():
        assert (folder / path.name).read_bytes() == path.read_bytes(), path.name
    shipped = folder / "calib_constants.h"
    text = shipped.read_text()
    focal = re.search(r"CALIB_CAMERA_FX_PX (\S+)f", text)
    assert focal is not None
    # The truth is in tests/truth/pictures.json: 273.4; sigma is 0.043.
    assert abs(float(focal.group(1)) - 273.4) < 0.2

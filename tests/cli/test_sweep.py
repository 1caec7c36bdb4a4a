"""`calib sweep` as a person types it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed")

COMMAND = (sys.executable, "-c", "from calib.cli.main import main; main()")


def test_what_is_no_sweep(calib: Callable[..., Any], tmp_path: Path) -> None:
    spec = tmp_path / "s.yaml"
    spec.write_text("base: {controller: pid, reference: jump}\n")
    ended = calib("sweep", spec, "-o", tmp_path / "out")
    assert ended.code == 3
    assert "nothing to sweep over" in ended.sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_controllers_over_plants(environment: dict[str, str], tmp_path: Path) -> None:
    spec, out = tmp_path / "s.yaml", tmp_path / "out"
    spec.write_text(
        "base: {scenario: orientation, feedback: truth, duration: 3s}\n"
        "grid: {scenario.controller: [p, pid], actuator.mass_kg: [0.05, 5000]}\n"
        "draws: {count: 3, actuator.stiffness_scale: {uniform: [0.9, 1.1]}}\nmeasure: [peak_rad]\nnear: 0.7\n"
    )
    words = [*COMMAND, "sweep", str(spec), "-o", str(out), "--workers", "1", "--json"]
    first = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert first.returncode == 1, first.stderr
    found = json.loads(first.stdout)["sweep"]
    # Half of the cases have a mass that no actuator has.
    assert (found["cases"], found["failed"], found["as_before"]) == (12, 6, 0)
    assert "actuator.mass_kg is 5000" in found["why"]
    assert found["best"][0]["parameters"] == {"scenario.controller": "pid", "actuator.mass_kg": 0.05}
    assert found["best"][0]["draws"] == 3 and abs(found["best"][0]["median"] - 0.7) < 0.1
    assert "Sweep of scenario orientation" in (out / "sweep.html").read_text()
    again = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    told = json.loads(again.stdout)["sweep"]
    assert told["as_before"] == 12 and told["best"] == found["best"]

"""`calib doctor` from the command line."""

from __future__ import annotations

import json

import pytest
import typer

from calib.cli.doctor import doctor
from calib.runner.doctor import Check


def test_whole_installation(capsys: pytest.CaptureFixture[str]) -> None:
    doctor(quick=True)
    said = capsys.readouterr().out
    assert "numpy" in said and said.endswith("verdict: ok\n")


def test_missing_library_ends_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [Check("numpy", True, False, "-", "sums"), Check("avr-gcc", False, False, "-", "")]
    monkeypatch.setattr("calib.runner.doctor.examine", lambda quick: checks)
    with pytest.raises(typer.Exit) as left:
        doctor(as_json=True)
    assert left.value.exit_code == 1
    told = json.loads(capsys.readouterr().out)
    assert told["gate"] == ["numpy"]

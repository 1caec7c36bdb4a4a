"""`calib report` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pages import finished_run

from calib.cli.report import report
from calib.core.errors import BadInputError


def test_page_beside_the_rig_and_elsewhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = finished_run(tmp_path)
    report(rig)
    page = rig.with_name("report.html")
    assert page.read_text().startswith("<!doctype html>")
    assert "report.html: " in capsys.readouterr().out
    report(rig, tmp_path / "other.html", as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["verb"] == "report" and told["bytes"] == page.stat().st_size
    assert (tmp_path / "other.html").read_bytes() == page.read_bytes()


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no such file"):
        report(tmp_path / "rig.yaml")
    with pytest.raises(BadInputError, match="no folder"):
        report(tmp_path / "rig.yaml", tmp_path / "none" / "page.html")

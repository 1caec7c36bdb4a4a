"""`calib diff` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calib.cli.diff import diff

RIG = """camera: {{model: pinhole, image_size_px: [316, 208], fx_px: {fx}, fy_px: 272.6, cx_px: 160.7,
  cy_px: 101.9, sigma: {{fx_px: 0.03}}, verdict: ok}}
"""


def test_table_and_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    a.write_text(RIG.format(fx=273.4))
    b.write_text(RIG.format(fx=273.5))
    diff(a, b)
    said = capsys.readouterr().out
    assert "camera.fx_px" in said and "not significant" in said and "2.4" in said
    assert "nothing beyond the error bars" in said
    diff(a, b, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["significant"] is False and told["plane"] is None
    assert told["changes"][0]["sigmas"] == pytest.approx(0.1 / (0.03 * 2**0.5))


def test_long_lists_are_cut_short_unless_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    for path, value in ((a, 1.0), (b, 2.0)):
        keys = ", ".join(f"k{i}_m: {value + i}" for i in range(40))
        path.write_text(f"actuator: {{{keys}}}\n{RIG.format(fx=273.4)}")
    diff(a, b)
    assert "20 more (--all shows them)" in capsys.readouterr().out
    diff(a, b, every=True)
    assert "k39_m" in capsys.readouterr().out

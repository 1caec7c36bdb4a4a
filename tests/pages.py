"""A small finished run for tests of the page, with names that try to break out of it."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from calib.core.plot import Arrows, Band, Bars, Curve, Field, Figure, Plot, Ribbon, Rule, Shape, Text
from calib.core.words import Block, Line, Table
from calib.runner.cache import BLOCKS, store
from calib.show.charts import chart
from calib.show.page import keep_pictures

__all__ = ["EVIL", "finished_run"]

EVIL = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>\"'&{{7*7}}.png"

_CAMERA = """camera:
  model: radial2
  image_size_px: [316, 208]
  fx_px: 273.41
  fy_px: 272.6
  cx_px: 160.67
  cy_px: 101.87
  distortion: {k1: -0.22, k2: 0.549}
  sigma: {fx_px: 0.0435, fy_px: 0.044, cx_px: 0.0197, cy_px: 0.0285, k1: 0.00036, k2: 0.00117}
  rms_px: 0.0098
  mean_error_px: 0.0086
  views: 3
  points: 12
  verdict: ok
  advice: ['take <b>one</b> more']
"""


def _png(width: int, height: int, seed: int) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 255, (height // 8, width // 8), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).resize((width, height), Image.Resampling.NEAREST).save(buffer, format="png")
    return buffer.getvalue()


def _chart(title: str) -> bytes:
    """A figure with all kinds of marks, on plain, logarithmic and other axes."""
    x = np.linspace(0.0, 10.0, 2000)
    y = np.where((x > 4.0) & (x < 5.0), np.nan, np.sin(x))
    dots = Curve(x, 2.0 * y, kind="points", colour=x / 10.0)
    values = np.add.outer(np.arange(5.0), np.arange(7.0)) ** 3 + 1.0
    field = Field(np.arange(7.0), np.arange(5.0), values, "px", "error (px)")
    panels = (
        Plot("", "left (mm)", (Ribbon(x, y - 0.1, y + 0.1, "band"), Curve(x, y, EVIL), Rule("y", 0.0))),
        Plot(
            "time (s)",
            "right (mm)",
            (dots, Band("x", 1.0, 2.0, EVIL)),
        ),
        Plot(
            "x",
            "y",
            (field,),
            equal=True,
            down=True,
        ),
        Plot("x", "y", (Arrows(np.zeros((2, 2)), np.eye(2), 3.0, "px"), Text(0.5, 0.5, EVIL, bold=True))),
        Plot("f (Hz)", "", (Curve(x[1:], x[1:], spread=0.1 * x[1:], kind="squares"),), log="xy", title=EVIL),
        Plot("n", "", (Bars(np.arange(3), np.arange(3), across=True),), names=("one", "two", EVIL)),
        Plot("x", "y", (Shape(np.eye(3)[:, :2], "ochre", opacity=0.5),), bare=True),
        Plot("x", "y", empty="nothing was seen"),
    )
    figure = Figure(title, "In plain words.", panels, 9.0, "poor", 2)
    return json.dumps(chart(figure), allow_nan=False).encode()


def _job(name: str, stage: str, title: str, status: str, **more: Any) -> dict[str, Any]:
    common = {
        "verb": stage,
        "command": ["calib", stage],
        "log": None,
        "inputs": [],
        "writes": [],
        "flashed": False,
        "reason": "",
    }
    return {"name": name, "stage": stage, "title": title, "status": status, **common, **more}


def _result(
    out: Path, name: str, document: dict[str, Any], words: list[Block], figures: dict[str, bytes], said: str
) -> None:
    work, stages = out / ".calib" / "work" / name, out / ".calib" / "stages"
    (work / "figures").mkdir(parents=True)
    stages.mkdir(exist_ok=True)
    (work / "document.json").write_text(json.dumps(document))
    (work / "words.json").write_bytes(BLOCKS.dump_json(words))
    (work / "messages.txt").write_text(said)
    for figure, data in figures.items():
        (work / "figures" / figure).write_bytes(data)
    store(work, stages / name, "key", 0, out / ".calib" / "work" / f"old-{name}")


def finished_run(root: Path) -> Path:
    """Make the folder and return its rig.yaml."""
    out, images = root / "out", root / "images"
    images.mkdir(parents=True)
    (out / ".calib").mkdir(parents=True)
    names = ["view1.png", "view2.png", EVIL.replace("/", "")]
    for seed, name in enumerate(names):
        (images / name).write_bytes(_png(316, 208, seed))
    keep_pictures(sorted(images.iterdir()), out / ".calib" / "pictures")
    rng = np.random.default_rng(1)
    seen = [
        {
            "view": name,
            "points": 4,
            "rms_px": 0.01 * (k + 1),
            "points_px": [[50.0, 50.0], [150.0, 50.0], [50.0, 120.0], [150.0, 120.0]],
            "residuals_px": rng.normal(0, 0.01, (4, 2)).tolist(),
        }
        for k, name in enumerate(names)
    ]
    words: list[Block] = [
        Table(("model", EVIL), (("radial2", "0.01"), (EVIL, "0.2 ± 0.1")), EVIL),
        Line(EVIL),
        Line(EVIL, EVIL),
        Line("said elsewhere", "reason"),
    ]
    figures = {"camera_errors.json": _chart("Errors"), "camera_sigma.json": _chart(EVIL)}
    _result(out, "intrinsics", {"per_view": seen}, words, figures, f"found {EVIL}\n")
    for log in ("one", "two"):
        charts = {f"replay_{log}_states.json": _chart(f"States of {log}")}
        sensors = Table(("sensor", "NIS", "gated"), (("camera", "2.0", "0"),))
        _result(out, f"replay-{log}", {}, [sensors, Line(f"{log} is weak", "reason")], charts, "")
    jobs = [
        _job("intrinsics", "intrinsics", "Camera", "ok", writes=["camera"], flashed=True, inputs=names),
        _job("align", "align", "Together", "failed", reason=f"log {EVIL} is empty", flashed=True),
        _job("replay-one", "replay", "States", "ok", log="one.csv"),
        _job("replay-two", "replay", "States", "poor", log=EVIL, reason="the IMU is silent"),
        _job("firmware", "firmware", "Firmware", "blocked", reason="needs camera"),
    ]  # fmt: skip
    summary = {"schema": 1, "simulated": False, "pictures": 3, "logs": [], "left_out": [EVIL], "jobs": jobs}
    (out / ".calib" / "run.json").write_text(json.dumps(summary))
    inputs = f"provenance:\n  inputs:\n    camera: {{{json.dumps(EVIL)}: {'a' * 64}}}\n"
    (out / "rig.yaml").write_text(_CAMERA + inputs)
    return out / "rig.yaml"

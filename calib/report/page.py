"""The page of a calibration: one HTML file that needs no network, from rig.yaml and what lies beside it.

    rig.yaml            the constants
    .calib/run.json     how each stage ended          .calib/stages/   what the stages said and drew
    .calib/pictures/    small copies of the views

A rig.yaml without the rest gives a page of verdicts and constants. Everything that was read is escaped,
and a policy in the page lets no script run but its own. Nothing of time or place goes in: the same
inputs give the same bytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib import __version__
from calib.errors import BadInputError
from calib.files import read_yaml_mapping, shown, write_atomically
from calib.report.page_pictures import data_uri, kept_picture, size_of, small_figure
from calib.report.page_stages import Table, caption, facts, tables
from calib.report.page_verdict import decide
from calib.report.rendering import render
from calib.rig import read_rig
from calib.rig_actuator import Actuator, PumpSection, section_of
from calib.rigvalues import constants, digits
from calib.running.cache import Result, load
from calib.running.runner import HIDDEN
from calib.running.summaryfile import read_summary

__all__ = ["MOST_BYTES", "page_text", "write_page"]

MOST_BYTES = 5_000_000
"""A page is never larger; figures that do not fit are named instead."""
_AIM_BYTES = 4_350_000
"""What a page should take: beyond this, of several logs only the first figure of each is shown."""
_NARROW_PX = 640
"""Width of those where even they are too many."""
_VIEWS_BYTES = 1_000_000
_ROOM_BYTES = 400_000
"""What is kept for words, tables and numbers."""
_MOST_COUNTED = 6
"""Figures of one kind for each log that a stage shows, so that there is room for the states of all logs."""
_STATUS = {
    "ok": "ok",
    "poor": "poor",
    "failed": "failed",
    "blocked": "not run",
    "skipped": "no data",
    "missing": "not available",
}
_STAGE_OF = {
    "camera": ("intrinsics", "Camera"),
    "plane": ("extrinsics", "Plane of motion"),
    "lens": ("distortion", "Lens"),
    "imu": ("imu-static", "IMU at rest"),
    "imu_intrinsics": ("imu-intrinsics", "IMU in poses"),
    "orientation_filter": ("imu-tune", "Angle filter"),
    "lowpass": ("lowpass", "Low-pass"),
    "align": ("align", "Camera and IMU together"),
    "actuator": ("identify", "Model of the actuator"),
    "pump": ("identify", "Model of the actuator"),
    "estimator": ("estimator", "Noise of the estimator"),
    "controller": ("control", "Controllers"),
}
_FLASHED = ("camera", "plane", "imu", "orientation_filter", "lowpass", "align", "controller")


@dataclass
class _Budget:
    """Bytes that may still go into the page."""

    left: int

    def takes(self, text: str) -> bool:
        if len(text) > self.left:
            return False
        self.left -= len(text)
        return True


def write_page(rig: Path, output: Path | None = None) -> Path:
    """Write the page of a rig.yaml, `report.html` beside it by default. Raises `BadInputError`."""
    target = rig.parent / "report.html" if output is None else output
    text = page_text(rig)
    write_atomically(target, text)
    return target


def page_text(rig: Path) -> str:
    """The whole page. Raises `BadInputError` for a rig.yaml that is not there or cannot be read."""
    if not rig.exists():
        raise BadInputError(f"{shown(rig)}: cannot be read: there is no such file")
    whole = read_rig(rig)
    for name, kind in (("actuator", Actuator), ("pump", PumpSection)):
        section_of(whole, name, kind, rig)
    sections = read_yaml_mapping(rig)
    provenance = sections.pop("provenance", None) or {}
    hidden = rig.parent / HIDDEN
    told = read_summary(hidden / "run.json") or _summary_of(sections)
    budget = _Budget(MOST_BYTES - _ROOM_BYTES)
    views = _views(hidden, _Budget(_VIEWS_BYTES))
    budget.left -= sum(len(view["image"]) for view in views)
    stages = _stages(told, sections, hidden, budget)
    return render(
        "page.html.j2",
        ("page.css",),
        ("common.js", "page.js"),
        decision=decide(told, sections),
        told=told,
        stages=stages,
        views=views,
        views_json=_as_script(views),
        constants=[
            {
                "section": c.section,
                "name": c.name,
                "value": c.value,
                "text": digits(c.value, c.sigma),
                "unit": c.unit,
                "sigma": c.sigma,
                "share": c.share,
            }
            for c in constants(sections)
        ],
        inputs=[
            (section, name, digest)
            for section, files in (provenance.get("inputs") or {}).items()
            for name, digest in files.items()
        ],
        version=provenance.get("version", __version__),
    )


def _as_script(value: Any) -> str:
    """JSON that no element of a page can end."""
    text = json.dumps(value, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _summary_of(sections: Mapping[str, Any]) -> dict[str, Any]:
    """A summary for a rig.yaml that no run has made: each section is a stage."""
    jobs = []
    for name, values in sections.items():
        if name in _STAGE_OF and isinstance(values, dict):
            stage, title = _STAGE_OF[name]
            poor = values.get("verdict", "ok") in ("poor", "unidentifiable", "inconsistent")
            reasons = values.get("reasons") or [f"its verdict is {values.get('verdict')}"]
            job: dict[str, Any] = {
                "name": stage,
                "stage": stage,
                "title": title,
                "verb": "",
                "log": None,
                "inputs": [],
            }
            state = {"status": "poor" if poor else "ok", "reason": str(reasons[0]) if poor else ""}
            jobs.append({**job, "writes": [name], "flashed": name in _FLASHED, **state})
    return {"simulated": False, "pictures": 0, "logs": [], "left_out": [], "jobs": jobs, "alone": True}


def _views(hidden: Path, budget: _Budget) -> list[dict[str, Any]]:
    """Each view with its picture and its residuals, the worst first where not all fit."""
    result = load(hidden / "stages" / "intrinsics")
    seen = [] if result is None else result.document().get("per_view") or []
    out = []
    for view in sorted(seen, key=lambda one: -(one.get("rms_px") or 0.0)):
        picture = kept_picture(str(view.get("view")), hidden / "pictures")
        image = "" if picture is None else data_uri(picture.data)
        if picture is None or not view.get("points_px") or not budget.takes(image):
            continue
        out.append(
            {
                "name": picture.name,
                "width": picture.width_px,
                "height": picture.height_px,
                "image": image,
                "rms_px": view.get("rms_px"),
                "points": view.get("points_px"),
                "residuals": view.get("residuals_px"),
            }
        )
    order = {str(view.get("view")): k for k, view in enumerate(seen)}
    return sorted(out, key=lambda one: order[one["name"]])


def _stages(
    told: Mapping[str, Any], sections: Mapping[str, Any], hidden: Path, budget: _Budget
) -> list[dict[str, Any]]:
    """A part of the page for each stage, with all its jobs; figures first of stages that run once."""
    grouped: dict[str, list[dict[str, Any]]] = {}
    for job in told["jobs"]:
        grouped.setdefault(job["stage"], []).append(job)
    made: dict[str, dict[str, Any]] = {}
    for several in (False, True):
        for name, jobs in grouped.items():
            if (len(jobs) > 1) == several:
                made[name] = _stage(name, jobs, sections, hidden, budget)
    return [made[name] for name in grouped]


def _stage(
    name: str,
    jobs: list[dict[str, Any]],
    sections: Mapping[str, Any],
    hidden: Path,
    budget: _Budget,
) -> dict[str, Any]:
    section = _merged([sections.get(n) for job in jobs for n in job["writes"]])
    logs = [str(log.get("name")) for log in section.get("logs") or () if isinstance(log, dict)]
    ran = [job["status"] not in ("skipped", "missing", "blocked") for job in jobs]
    results = [
        load(hidden / "stages" / str(job["name"])) if one else None
        for job, one in zip(jobs, ran, strict=True)
    ]
    shown, width_px = _chosen(results, hidden / "figures", budget)
    parts = []
    for job, result in zip(jobs, results, strict=True):
        document = {} if result is None else result.document()
        figures, dropped = _figures(result, shown, logs)
        parts.append(
            {
                "job": job,
                "status": _STATUS.get(job["status"], job["status"]),
                "document": document,
                "figures": figures,
                "dropped": dropped,
                "messages": [] if result is None else result.messages(),
                "command": _command(job),
            }
        )
    status = _worst([job["status"] for job in jobs])
    document = parts[0]["document"] if len(parts) == 1 else {}
    coarse = f"of {len(jobs)} logs the figures are {width_px} px wide here, to keep this page small"
    return {
        "name": name,
        "title": jobs[0]["title"],
        "status": _STATUS.get(status, status),
        "kind": status,
        "facts": facts(name, section, document) if status in ("ok", "poor") else [],
        "reasons": list(section.get("reasons") or ()),
        "remarks": [
            *(section.get("remarks") or ()),
            *(section.get("advice") or ()),
            *([coarse] if width_px else ()),
        ],
        "parts": parts,
        "tables": _replay_tables(parts) if len(parts) > 1 or name == "replay" else tables(document),
        "several": len(parts) > 1,
        "flashed": bool(jobs[0]["flashed"]),
    }


def _merged(sections: list[Any]) -> dict[str, Any]:
    """The sections of a stage as one; reasons and the like of all of them."""
    whole: dict[str, Any] = {}
    for section in sections:
        for key, value in (section if isinstance(section, dict) else {}).items():
            if isinstance(value, list) and key in ("reasons", "remarks", "advice"):
                whole[key] = [*whole.get(key, ()), *value]
            elif isinstance(value, dict) and key == "sigma":
                whole[key] = {**whole.get(key, {}), **value}
            else:
                whole.setdefault(key, value)
    return whole


def _worst(statuses: list[str]) -> str:
    order = ("failed", "blocked", "poor", "ok", "skipped", "missing")
    return min(statuses, key=order.index)


def _chosen(
    results: list[Result | None], folder: Path, budget: _Budget
) -> tuple[dict[Path, tuple[str, int, int]], int]:
    """Address, width and height of the figures that are shown, and to what width in px they were narrowed.

    Of several logs the first figure of each comes before the second of any, as far as the page is no larger
    than it should be; the first ones may be narrowed, else the width is 0.
    """
    ordered = [[] if result is None else sorted(result.figures(), key=_place) for result in results]
    listed = sorted(
        (k, job, path) for job, paths in enumerate(ordered) for k, path in enumerate(paths) if _counts(path)
    )
    room = budget.left - (MOST_BYTES - _AIM_BYTES if len(results) > 1 else 0)
    first = [data_uri(small_figure(path, folder)) for k, _, path in listed if k == 0]
    width_px = _NARROW_PX if len(results) > 1 and sum(map(len, first)) > room else 0
    shown = {}
    for k, _, path in listed:
        image = small_figure(path, folder, width_px)
        address = data_uri(image)
        if (k == 0 or len(address) <= room) and budget.takes(address):
            shown[path] = (address, *size_of(image))
            room -= len(address)
    return shown, width_px


def _counts(path: Path) -> bool:
    """Whether a figure is one of the first of its kind."""
    counted = re.search(r"_(\d+)$", path.stem)
    return counted is None or int(counted.group(1)) <= _MOST_COUNTED


def _figures(
    result: Result | None, shown: Mapping[Path, tuple[str, int, int]], logs: list[str]
) -> tuple[list[dict[str, Any]], list[str]]:
    figures, dropped = [], []
    for path in sorted([] if result is None else result.figures(), key=_place):
        words = caption(path.stem, logs)
        if path in shown:
            image, width, height = shown[path]
            figures.append({"image": image, "caption": words, "width": width, "height": height})
        else:
            dropped.append(words)
    return figures, dropped


def _place(path: Path) -> tuple[object, ...]:
    """States come first, then by name with numbers in their order."""
    parts = re.split(r"(\d+)", path.stem)
    return (
        not path.stem.endswith("_states"),
        [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)],
    )


def _command(job: Mapping[str, Any]) -> str:
    """The command; of many files the first two stand for all."""
    words, inputs = [str(word) for word in job.get("command") or ()], {str(name) for name in job["inputs"]}
    files = [word for word in words if word in inputs]
    if len(files) > 3:
        first = words.index(files[2])
        rest = [word for word in words[first:] if word not in inputs]
        words = [*words[:first], f"\N{HORIZONTAL ELLIPSIS} ({len(files)} files)", *rest]
    return " ".join(words)


def _replay_tables(parts: list[dict[str, Any]]) -> list[Table]:
    """One table over all logs of a stage that runs for each."""
    records = []
    for part in parts:
        logs = (part["document"].get("replay") or {}).get("logs") or []
        for log in logs:
            other = (log.get("compared") or {}).get("baseline") or {}
            error = log.get("rmse") or {}
            row = {
                "log": part["job"]["log"],
                "verdict": log.get("verdict"),
                "duration_s": log.get("duration_s"),
            }
            row |= {"mean q error_mm": error.get("mean_q_mm"), "baseline_mm": other.get("mean_q_mm")}
            row |= {"phi error_deg": error.get("phi_deg"), "baseline phi_deg": other.get("phi_deg")}
            row |= {"NEES (2)": error.get("nees")}
            for sensor, check in (log.get("sensors") or {}).items():
                row[f"NIS {sensor} ({check.get('degrees')})"] = check.get("nis")
            records.append(row)
    return tables({"": {"logs": records}}) if records else []

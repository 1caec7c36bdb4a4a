"""The page of a calibration: one HTML file that needs no network."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from calib.core import __version__
from calib.core.constants import constants
from calib.core.errors import BadInputError
from calib.core.files import read_bytes, read_text, sha256
from calib.core.plot import HUES, Figure
from calib.core.rig import Rig
from calib.core.verdict import POOR, WORDS, Verdict
from calib.core.words import Block, Table, facts, number
from calib.core.writing import Kind, holds, make_folder, write_atomically
from calib.runner.cache import Result, load
from calib.runner.decision import decide, read_summary
from calib.runner.graph import HIDDEN, STEPS
from calib.show.charts import chart, library

# ----------------------------------------------------------------------
# Pages from their templates: each is one file, with its style and its script in it.


def render(
    template: str, style: tuple[str, ...], script: tuple[str, ...], charts: bool, **values: Any
) -> str:
    """A template of this package with what else goes into a page.

    Parameters
    ----------
    style, script : names of files that are put one behind the other.
    charts : whether there are figures, which are drawn by plotly.js. The page's policy lets no script run
        but it and `script`.
    values : what the template asks for beside them; all of it is escaped.
    """
    import jinja2

    hues = {look: {name: pair[k] for name, pair in HUES.items()} for k, look in enumerate(("light", "dark"))}
    drawn = f"const HUES = {json.dumps(hues)};\n{_resource('charts.js')}" if charts else ""
    words = "".join(_resource(name) for name in script) + drawn
    drawing = library() if charts else ""
    hashes = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in (words, drawing)]
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_resource),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["numeric"] = _numeric
    text = environment.get_template(template).render(
        style="".join(_resource(name) for name in style),
        script=words,
        library=drawing,
        script_hash="' '".join(f"sha256-{digest}" for digest in hashes),
        **values,
    )
    # A file's name may hold halves of characters, which no page can show.
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _resource(name: str) -> str:
    return (resources.files("calib.show") / "templates" / name).read_text(encoding="utf-8")


def _as_script(value: Any) -> str:
    """JSON that no element of a page can end."""
    text = json.dumps(value, ensure_ascii=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def embedded(figure: Figure) -> dict[str, str]:
    """A figure as the templates' macro `chart` takes it."""
    words = {"title": figure.title, "note": figure.note, "verdict": figure.verdict}
    return {**words, "chart": _as_script(chart(figure))}


# ----------------------------------------------------------------------
# Pictures small enough for one page: views as JPEG.
#
# What was made once is kept beside the run by the hash of its source, so that a page is rebuilt quickly
# and without the pictures themselves.

_WIDEST_PX = 640
_QUALITY = 72
_MOST_PICTURES = 120


@dataclass(frozen=True)
class Embedded:
    """A picture in the page: its own size in px, and the data of a smaller copy."""

    name: str
    width_px: int
    height_px: int
    data: bytes


def _key(name: str) -> str:
    return sha256(name.encode("utf-8", "surrogateescape"))[:24]


def keep_pictures(paths: Sequence[Path], folder: Path) -> None:
    """Keep small copies of pictures, by name; pictures that cannot be read are passed over.

    A copy is named by the picture's name and begins with a line of the picture's hash and size and of its
    own hash.
    """
    make_folder(folder)
    wanted = {f"{_key(path.name)}.view": path for path in paths[:_MOST_PICTURES]}
    for path in folder.iterdir():
        if path.name not in wanted:
            with contextlib.suppress(OSError):
                path.unlink()
    for name, path in wanted.items():
        with contextlib.suppress(BadInputError):
            raw = read_bytes(path)
            digest = sha256(raw)
            place = folder / name
            if kept_picture(path.name, folder) and place.read_bytes()[:64] == digest.encode():
                continue
            made = _small_picture(path)
            if made is not None:
                width, height, data = made
                write_atomically(place, f"{digest} {width} {height} {sha256(data)}\n".encode() + data)


def _small_picture(path: Path) -> tuple[int, int, bytes] | None:
    import cv2

    from calib.io.pictures import read_picture

    gray = read_picture(path).gray
    height, width = gray.shape
    if width > _WIDEST_PX:
        size = (_WIDEST_PX, max(1, round(height * _WIDEST_PX / width)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(gray.dtype)
    done, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return (width, height, data.tobytes()) if done else None


def kept_picture(name: str, folder: Path) -> Embedded | None:
    """The small copy of a picture by its name, None where there is none."""
    with contextlib.suppress(OSError, ValueError):
        head, data = (folder / f"{_key(name)}.view").read_bytes().split(b"\n", 1)
        _, width, height, own = head.split()
        if data.startswith(b"\xff\xd8") and own == sha256(data).encode():
            return Embedded(name, int(width), int(height), data)
    return None


# ----------------------------------------------------------------------
# The page of a calibration: one HTML file that needs no network, from rig.yaml and what lies beside it.
#
#     rig.yaml            the constants
#     .calib/run.json     how each stage ended          .calib/stages/   what the stages said and drew
#     .calib/pictures/    small copies of the views
#
# A rig.yaml without the rest gives a page of verdicts and constants. Everything that was read is escaped,
# and a policy in the page lets no script run but its own. Nothing of time or place goes in: the same
# inputs give the same bytes.

MOST_BYTES = 2_000_000
"""A page is never larger, the charts' library not counted; figures that do not fit are named instead."""
_VIEWS_BYTES = 1_000_000
_ROOM_BYTES = 500_000
"""What is kept for words, tables and numbers."""
_MOST_COUNTED = 3
"""Figures of one kind for each log that a stage shows, so that there is room for the states of all logs."""
_STATUS = {"blocked": "not run", "skipped": "no data"}
_ORDER = ("failed", "blocked", *reversed(WORDS), "skipped")


@dataclass
class _Budget:
    """Bytes that may still go into the page."""

    left: int

    def takes(self, text: str) -> bool:
        if len(text) > self.left:
            return False
        self.left -= len(text)
        return True


PAGE = Kind("a page", (".html", ".htm"), holds(b'<p class="brand">calib', most=1 << 20))


def write_page(rig: Path, output: Path | None = None) -> Path:
    """Write the page of a rig.yaml, `report.html` beside it by default. Raises `BadInputError`."""
    target = rig.parent / "report.html" if output is None else output
    text = page_text(rig)
    write_atomically(target, text, PAGE)
    return target


def page_text(rig: Path) -> str:
    """The whole page. Raises `BadInputError` for a rig.yaml that is not there or cannot be read."""
    whole = Rig.load(rig)
    sections = whole.values()
    provenance = sections.pop("provenance")
    hidden = rig.parent / HIDDEN
    told = read_summary(hidden / "run.json") or _summary_of(whole)
    budget = _Budget(MOST_BYTES - _ROOM_BYTES)
    views, unseen = _views(hidden, _Budget(_VIEWS_BYTES))
    budget.left -= sum(len(view["image"]) for view in views)
    stages = _stages(told, whole, hidden, budget)
    return render(
        "page.html.j2",
        ("page.css",),
        ("common.js", "page.js"),
        any(part["figures"] for one in stages for part in one["parts"]),
        decision=decide(told, sections),
        told=told,
        stages=stages,
        views=views,
        unseen=unseen,
        views_json=_as_script(views),
        constants=[(c, number(c.value, c.sigma)) for c in constants(sections)],
        inputs=[
            (section, name, digest)
            for section, files in (provenance.get("inputs") or {}).items()
            for name, digest in files.items()
        ],
        version=provenance.get("version", __version__),
    )


def _summary_of(rig: Rig) -> dict[str, Any]:
    """A summary for a rig.yaml that no run has made: each section is a stage."""
    jobs = []
    steps = [(name, step) for step in STEPS for name in step.writes]
    for name, step in steps:
        section = rig.sections.get(name)
        if section is not None:
            verdict = getattr(section, "verdict", Verdict())
            reasons = verdict.reasons or [f"its verdict is {verdict.word}"]
            jobs.append(
                {
                    "name": step.name,
                    "stage": step.name,
                    "title": step.title,
                    "verb": "",
                    "log": None,
                    "inputs": [],
                    "writes": [name],
                    "flashed": step.flashed,
                    "status": verdict.word,
                    "reason": "" if verdict.ok else reasons[0],
                }
            )
    told = {"simulated": rig.simulated, "pictures": 0, "logs": [], "left_out": []}
    return {**told, "jobs": jobs, "alone": True}


def _views(hidden: Path, budget: _Budget) -> tuple[list[dict[str, Any]], int]:
    """Each view with its picture and its residuals, the worst first where not all fit; how many do not."""
    result = load(hidden / "stages" / "intrinsics")
    seen = [] if result is None else result.document().get("per_view") or []
    out = []
    for view in sorted(seen, key=lambda one: -(one.get("rms_px") or 0.0)):
        picture = kept_picture(str(view.get("view")), hidden / "pictures")
        if picture is None or not view.get("points_px"):
            continue
        # An address that needs no network.
        image = f"data:image/jpeg;base64,{base64.b64encode(picture.data).decode('ascii')}"
        if not budget.takes(image):
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
    return sorted(out, key=lambda one: order[one["name"]]), len(seen) - len(out)


def _stages(told: Mapping[str, Any], rig: Rig, hidden: Path, budget: _Budget) -> list[dict[str, Any]]:
    """A part of the page for each stage, with all its jobs; figures first of stages that run once."""
    grouped: dict[str, list[dict[str, Any]]] = {}
    for job in told["jobs"]:
        grouped.setdefault(job["stage"], []).append(job)
    made: dict[str, dict[str, Any]] = {}
    for several in (False, True):
        for name, jobs in grouped.items():
            if (len(jobs) > 1) == several:
                made[name] = _stage(name, jobs, rig, hidden, budget)
    return [made[name] for name in grouped]


def _stage(name: str, jobs: list[dict[str, Any]], rig: Rig, hidden: Path, budget: _Budget) -> dict[str, Any]:
    names = dict.fromkeys(str(name) for job in jobs for name in job["writes"])
    sections = [rig.sections[name] for name in names if name in rig.sections]
    verdict = Verdict.of(
        finding for one in sections for finding in getattr(one, "verdict", Verdict()).findings
    )
    listed = (one.logs for one in sections if isinstance(getattr(one, "logs", None), list))
    logs = [str(getattr(log, "name", log)) for log in next(listed, [])]
    ran = [job["status"] not in ("skipped", "blocked") for job in jobs]
    results = [
        load(hidden / "stages" / str(job["name"])) if one else None
        for job, one in zip(jobs, ran, strict=True)
    ]
    shown = _chosen(results, budget)
    parts = []
    for job, result in zip(jobs, results, strict=True):
        document = {} if result is None else result.document()
        figures, dropped = _figures(result, shown, logs)
        parts.append(
            {
                "job": job,
                "status": _STATUS.get(job["status"], job["status"]),
                "document": document,
                "blocks": _blocks(result, bool(job["writes"]) and bool(sections)),
                "figures": figures,
                "dropped": dropped,
                "messages": [] if result is None else result.messages(),
                "command": _command(job),
            }
        )
    status = min((job["status"] for job in jobs), key=_ORDER.index)
    document = parts[0]["document"] if len(parts) == 1 else {}
    return {
        "name": name,
        "title": jobs[0]["title"],
        "status": _STATUS.get(status, status),
        "kind": "poor" if status in POOR else status,
        "facts": _facts(sections, document) if status in WORDS else [],
        "reasons": verdict.reasons,
        "remarks": [*verdict.remarks, *verdict.advice],
        "parts": parts,
        "tables": _over_all(parts) if len(parts) > 1 else [],
        "several": len(parts) > 1,
        "flashed": bool(jobs[0]["flashed"]) and status in WORDS,
    }


def _facts(sections: Sequence[Any], document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The few values at the head of a stage: those of its sections, or what the firmware's verb counts."""
    out = [fact for section in sections for fact in facts(section)]
    if "constants" in document and "files" in document:
        out.append(("constants", str(document["constants"])))
        out.append(("files", ", ".join(str(name) for name in document["files"] or ())))
    return out


def _chosen(results: list[Result | None], budget: _Budget) -> dict[Path, str]:
    """Charts that are shown, as JSON; of several logs the first of each comes before the second of any."""
    ordered = [[] if result is None else sorted(result.figures(), key=_place) for result in results]
    listed = sorted(
        (k, job, path) for job, paths in enumerate(ordered) for k, path in enumerate(paths) if _counts(path)
    )
    shown = {}
    for _, _, path in listed:
        with contextlib.suppress(BadInputError, ValueError):
            text = _as_script(json.loads(read_text(path)))
            if budget.takes(text):
                shown[path] = text
    return shown


def _counts(path: Path) -> bool:
    """Whether a figure is one of the first of its kind."""
    counted = re.search(r"_(\d+)$", path.stem)
    return counted is None or int(counted.group(1)) <= _MOST_COUNTED


def _figures(
    result: Result | None, shown: Mapping[Path, str], logs: list[str]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Charts with their words, and the names of those that are left out; a number counts the stage's logs."""
    figures, dropped = [], []
    for path in sorted([] if result is None else result.figures(), key=_place):
        if path in shown:
            told = json.loads(shown[path])
            words = {name: told[name] for name in ("title", "note", "verdict")}
            figures.append({"chart": shown[path], **words})
        else:
            parts = path.stem.split("_")
            if parts[-1].isdigit() and 1 <= int(parts[-1]) <= len(logs):
                parts[-1] = logs[int(parts[-1]) - 1]
            dropped.append(" ".join(parts))
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


_KINDS = ("", "remark", "reason", "advice")
_ROWS = 200


def _blocks(result: Result | None, judged: bool) -> list[Block]:
    """What a stage said in words, but for a verdict that the page has from its sections already."""
    kinds = _KINDS[:1] if judged else _KINDS
    told = [] if result is None else result.words()
    return [
        replace(one, rows=one.rows[:_ROWS]) if isinstance(one, Table) else one
        for one in told
        if isinstance(one, Table) or one.kind in kinds
    ]


def _over_all(parts: list[dict[str, Any]]) -> list[Table]:
    """Tables of one kind of all logs as one, with the log in front."""
    rows: dict[tuple[str, tuple[str, ...]], list[tuple[str, ...]]] = {}
    for part in parts:
        for one in part["blocks"]:
            if isinstance(one, Table) and len(one.head) > 2:
                log = str(part["job"]["log"])
                rows.setdefault((one.title, one.head), []).extend((log, *row) for row in one.rows)
    return [Table(("log", *head), tuple(some), title) for (title, head), some in rows.items()]


def _numeric(cell: str) -> bool:
    """Whether a cell is a number, or one with its deviation, and is sorted by it."""
    return bool(re.match(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?( ±|$)", cell))

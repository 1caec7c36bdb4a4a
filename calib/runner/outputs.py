"""What a run leaves in its folder: rig.yaml, states/, firmware/, and a summary for the page."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.core.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_POOR, BadInputError
from calib.core.files import one_line, read_text, shown
from calib.core.rig import Rig
from calib.core.stage import NOTHING_STATED, LogOptions
from calib.core.workers import processors
from calib.core.writing import make_folder, replacing, write_atomically
from calib.io.columns import read_columns_file
from calib.runner.cache import key_of, load, remove, store
from calib.runner.folder import Folder, digest_of, read_folder
from calib.runner.graph import HIDDEN, Done, Job, Pool, Runner, opened

# ----------------------------------------------------------------------
# What a run leaves in its folder: rig.yaml, states/, firmware/, and a summary for the page.
#
# Each file is replaced in one step, only where it differs. Files that an earlier run has left and this one
# does not (of a log that is gone) are removed; files of other origin are not touched.

_LIST = "outputs.json"


def summary(runner: Runner, ended: Sequence[Done], simulated: bool) -> dict[str, Any]:
    """What the page tells of a run: nothing of time or place, so that the same inputs give the same."""
    jobs = []
    for done in ended:
        job = done.job
        planned = job.planned
        jobs.append(
            {
                "name": job.name,
                "stage": job.step.name,
                "title": job.step.title,
                "verb": job.step.verb,
                "log": None if job.log is None else one_line(job.log.path.name),
                "inputs": [] if planned is None else [_named(runner.folder, path) for path in planned.inputs],
                "command": _command(runner.folder, job),
                "writes": list(job.step.writes),
                "flashed": job.step.flashed,
                "status": done.status,
                "reason": done.reason,
            }
        )
    return {
        "schema": 1,
        "simulated": simulated,
        "pictures": len(runner.folder.pictures),
        "logs": [one_line(log.path.name) for log in runner.folder.logs],
        "left_out": list(runner.folder.left_out),
        "jobs": jobs,
    }


def _command(folder: Folder, job: Job) -> list[str]:
    """Words of the command as a person would type them in the folder."""
    words: list[str] = []
    if job.planned is not None:
        words += [folder.name_of(path) for path in job.planned.paths]
        for name, value in job.planned.options.items():
            flag = name.replace("_", "-")
            if isinstance(value, bool):
                words.append(f"--{flag}" if value else f"--no-{flag}")
            else:
                words += [f"--{flag}", folder.name_of(value) if isinstance(value, Path) else str(value)]
    return ["calib", *job.step.verb.split(), *map(one_line, words)]


def _named(folder: Folder, path: Path) -> str:
    return one_line(folder.name_of(path))


def publish(runner: Runner, ended: Sequence[Done], told: dict[str, Any]) -> list[str]:
    """Write all but the page; returns the names of the files relative to the output folder."""
    out = runner.out
    wanted: dict[str, Path] = {}
    for done in ended:
        if done.result is None or done.status not in ("ok", "poor"):
            continue
        output = done.job.step.output
        if done.job.log is not None and output in done.result.files:
            wanted[f"states/{done.job.log.slug}{Path(output).suffix}"] = done.result.folder / output
        elif output:
            for name in done.result.files:
                if name.startswith(f"{output}/"):
                    wanted[name] = done.result.folder / name
    if told["simulated"]:
        # What was calibrated lies where one sees it.
        root = runner.folder.root
        files = (path for path in root.rglob("*") if path.is_file())
        wanted |= {f"rig/{path.relative_to(root).as_posix()}": path for path in files}
    names = sorted(wanted)
    before = _listed(out)
    # Named first and written then: a file of ours is never forgotten.
    _list(out, sorted({*before, *names}))
    for name in names:
        _copy(wanted[name], out / name)
    left = [name for name in sorted(set(before) - set(names)) if not _removed(out, out / name)]
    gone, kept = ({place for name in some for place in Path(name).parents} for some in (before, names))
    for folder in sorted(gone - kept, reverse=True):
        with contextlib.suppress(OSError):
            (out / folder).rmdir()
    # One that could not be removed is tried again by the next run.
    _list(out, sorted({*names, *left}))
    _write(out / "rig.yaml", runner.sections().text(out / "rig.yaml"))
    _write(out / HIDDEN / "run.json", json.dumps(told, indent=1, ensure_ascii=True) + "\n")
    return ["rig.yaml", *names]


def _removed(out: Path, path: Path) -> bool:
    """Remove a file that an earlier run has left; whether nothing of ours is there any more."""
    if not path.parent.resolve().is_relative_to(out.resolve()):
        return True
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return False
    return True


def _listed(out: Path) -> list[str]:
    """Names that an earlier run has left, as far as they are such as a run leaves."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        found = json.loads((out / HIDDEN / _LIST).read_text(encoding="utf-8"))
        return [name for name in found if _is_ours(name)]
    return []


def _is_ours(name: object) -> bool:
    parts = Path(name).parts if isinstance(name, str) else ()
    kinds = {"states": (2,), "firmware": (2,), "rig": (2, 3, 4)}
    return ".." not in parts and bool(parts) and len(parts) in kinds.get(parts[0], ())


def _list(out: Path, names: list[str]) -> None:
    _write(out / HIDDEN / _LIST, json.dumps(names, indent=1) + "\n")


def _write(path: Path, text: str) -> None:
    raw = text.encode("utf-8", "backslashreplace")
    with contextlib.suppress(OSError):
        if not path.is_symlink() and path.is_file() and path.read_bytes() == raw:
            return
    write_atomically(path, raw)


def _copy(source: Path, target: Path) -> None:
    """Copy a file of any size into place in one step."""
    make_folder(target.parent)
    if target.is_symlink() or (target.exists() and not target.is_file()):
        raise BadInputError(f"{shown(target)}: is no file of a run, and was not replaced")
    if target.is_file() and digest_of(target) == digest_of(source):
        return
    with replacing(target) as stream, source.open("rb") as whole:
        shutil.copyfileobj(whole, stream)


# ----------------------------------------------------------------------
# run.json: what a run tells the page, read from a folder that may come from anywhere.

_MOST_BYTES = 10_000_000
Count = Annotated[int, Field(ge=0, strict=True)]
Text = Annotated[str, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]


class _Job(BaseModel):
    model_config = ConfigDict(extra="ignore")

    name: Text
    stage: Text
    title: Text
    verb: Text
    log: Text | None
    inputs: list[Text]
    command: list[Text]
    writes: list[Text]
    flashed: Flag
    status: Literal["ok", "poor", "failed", "blocked", "skipped"]
    reason: Text


class _Summary(BaseModel):
    model_config = ConfigDict(extra="ignore")

    simulated: Flag
    pictures: Count
    logs: list[Text]
    left_out: list[Text]
    jobs: list[_Job]


def read_summary(path: Path) -> dict[str, Any] | None:
    """The summary that `outputs.publish` has written; None where there is none, or something else."""
    with contextlib.suppress(BadInputError, ValueError, RecursionError, ValidationError):
        return _Summary.model_validate(json.loads(read_text(path, _MOST_BYTES))).model_dump()
    return None


# ----------------------------------------------------------------------
# Whether a calibration can be flashed, what is weak about it, and what to record next.
#
# The answer is one of
#
#     yes         every stage whose result the firmware uses is ok, and nothing else speaks against it; the
#                 folder's pictures alone are the calibration of a camera
#     with care   those are, but something beside them is poor or has failed
#     not yet     a result that the firmware uses is poor or lacking
#     no          such a stage has failed, or its numbers mean nothing, or there is no firmware

_MEANINGLESS = ("unidentifiable", "inconsistent")
_RECORD = {
    "intrinsics": "15 to 25 pictures of a checkerboard into images/, with images/board.yaml",
    "extrinsics": "a picture of the board lying in the plane of motion into images/plane/",
    "imu-static": "the rig at rest for a minute or more, logs/static1.csv; hours show how the bias drifts",
    "imu-tune": "the rig in motion, with the IMU at its full rate, as logs/NAME.csv",
    "align": "camera and IMU in one log: a free swing, then slow motion to large angles",
    "replay": "logs of camera and IMU as logs/NAME.csv",
}
"""What a stage wants that had nothing to work with."""
_SHOWN = 4


@dataclass(frozen=True)
class Decision:
    """The answer with its reasons, not yet escaped; `failed` when any stage has failed."""

    answer: str
    headline: str
    weak: tuple[str, ...]
    record: tuple[str, ...]
    failed: bool = False

    def as_json(self) -> dict[str, Any]:
        """For the document."""
        return {
            "answer": self.answer,
            "headline": self.headline,
            "weak": list(self.weak),
            "record_next": list(self.record),
        }

    @property
    def exit_code(self) -> int:
        """3 when a stage has failed, 0 when the answer is yes, else 1."""
        if self.failed:
            return EXIT_BAD_INPUT
        return EXIT_DONE if self.answer == "yes" else EXIT_POOR


def decide(told: Mapping[str, Any], sections: Mapping[str, Any]) -> Decision:
    """The decision on a run: `told` is its summary, `sections` those of its rig.yaml."""
    jobs: Sequence[Mapping[str, Any]] = told.get("jobs", ())
    answer, headline = _answer(jobs, sections, camera_only=not told.get("logs"))
    if told.get("simulated"):
        headline = f"{headline}; the rig is a simulated one, so these numbers are for no real machine"
    failed = any(job["status"] in ("failed", "blocked") for job in jobs)
    return Decision(answer, headline, tuple(_weak(jobs, sections)), tuple(_record(jobs, sections)), failed)


def _verdict(job: Mapping[str, Any], sections: Mapping[str, Any]) -> str:
    for name in job.get("writes", ()):
        section = sections.get(name)
        if isinstance(section, dict) and section.get("verdict"):
            return str(section["verdict"])
    return ""


def _answer(
    jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any], camera_only: bool
) -> tuple[str, str]:
    used = [job for job in jobs if job["flashed"]]
    broken = [job for job in used if job["status"] in ("failed", "blocked")]
    if broken:
        return "no", f"{_titles(broken)} failed"
    senseless = [job for job in used if _verdict(job, sections) in _MEANINGLESS]
    if senseless:
        return "no", f"the data do not support {_titles(senseless, plain=True)}"
    made = [job for job in jobs if job["stage"] == "firmware"]
    if not made or made[0]["status"] not in ("ok", "poor"):
        why = made[0]["reason"] if made else "it was not asked for"
        return "no", f"there is no firmware: {why}"
    poor = [job for job in used if job["status"] == "poor"]
    if poor:
        return "not yet", f"{_titles(poor)} too weak"
    # Pictures alone are the calibration of a camera; whoever has logs wants states from them.
    optics = {name for name in ("camera", "plane") if name not in sections}
    if camera_only and optics == {"plane"}:
        return "yes", "the camera is calibrated; the header holds it alone, without a plane and logs"
    lacking = [job for job in used if optics & set(job["writes"])]
    if lacking:
        return "not yet", f"{_titles(lacking)} not known"
    if made[0]["status"] == "poor":
        return "not yet", str(made[0]["reason"])
    others = [job for job in jobs if job["status"] in ("poor", "failed", "blocked")]
    if others:
        return "with care", f"what the firmware uses is sound, but look at {_titles(others, plain=True)}"
    return "yes", "every stage that had data passed its own quality gate"


def _titles(jobs: Sequence[Mapping[str, Any]], plain: bool = False) -> str:
    names = list(dict.fromkeys(f"“{job['title']}”" for job in jobs))
    text = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    if plain:
        return text
    return f"{text} {'is' if len(names) == 1 else 'are'}" if jobs[0]["status"] == "poor" else text


def _weak(jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any]) -> list[str]:
    grouped: dict[tuple[str, str], list[str]] = {}
    for job in jobs:
        if job["status"] not in ("poor", "failed", "blocked"):
            continue
        reasons = [str(job["reason"])]
        for name in job["writes"]:
            section = sections.get(name)
            if job["status"] == "poor" and isinstance(section, dict) and section.get("reasons"):
                reasons = [str(reason) for reason in section["reasons"]]
        for reason in reasons:
            grouped.setdefault((str(job["title"]), reason), []).append(str(job["log"] or ""))
    out = []
    for (title, reason), logs in grouped.items():
        names = [log for log in logs if log]
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        where = f" ({', '.join(names[:_SHOWN])}{more})" if names else ""
        out.append(f"{title}{where}: {reason}")
    return out


def _record(jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any]) -> list[str]:
    out = []
    for job in jobs:
        wanted = _RECORD.get(str(job["stage"]))
        if job["status"] == "skipped" and wanted and job["log"] is None:
            out.append(f"{job['title']}: {wanted}")
    for job in jobs:
        for name in job["writes"]:
            section = sections.get(name)
            if isinstance(section, dict):
                out += [f"{job['title']}: {advice}" for advice in section.get("advice") or ()]
    return list(dict.fromkeys(out))


# ----------------------------------------------------------------------
# A whole rig: a folder in; its results, a page and the decision out.


@dataclass(frozen=True)
class Calibrated:
    """A run that has ended.

    Attributes
    ----------
    out : its folder. decision : whether it can be flashed, and why not.
    told : its summary. ended : how each step ended. files : what it has written, by name relative to `out`.
    """

    out: Path
    decision: Decision
    told: dict[str, Any]
    ended: Sequence[Done]
    files: tuple[str, ...]

    @property
    def rig(self) -> Rig:
        """The rig's sections."""
        return Rig.load(self.out / "rig.yaml")


def calibrate(
    folder: str | Path | None = None,
    output: str | Path = "calibration",
    *,
    fresh: bool = False,
    follow_links: bool = False,
    stated: LogOptions = NOTHING_STATED,
    jobs: int | None = None,
    narrate: Callable[[str], None] = lambda sentence: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Calibrated:
    """Calibrate a whole rig: every stage from pictures and logs to the firmware and a page to read.

    Parameters
    ----------
    folder : with images/, images/plane/, logs/ and rig.yaml; without one a simulated rig is calibrated.
    output : folder for the results; a later run goes on from it.
    fresh : do all stages again. follow_links : take files that are links out of the folder as well.
    stated : what a person states of the logs. jobs : stages at a time, by default one per processor.
    narrate : takes sentences for the person who watches. progress : stages that have ended, and all.

    Raises
    ------
    BadInputError for a folder without anything to work on, and for an output folder that is not ours.
    """
    from calib.show.page import keep_pictures, write_page

    out = Path(output)
    if stated.columns is not None:
        read_columns_file(stated.columns)
    root = None if folder is None else Path(folder)
    seen = None if root is None else read_folder(root, follow_links, stated)
    with opened(out, root) as interrupted, Pool(jobs or processors()) as pool:
        if interrupted is not None:
            narrate("the last run here was interrupted; going on where it stopped")
        if seen is None:
            narrate("no folder given: a simulated rig is calibrated, not a real one")
            seen = _simulated(out)
        for sentence in seen.left_out:
            narrate(sentence)
        runner = Runner(seen, out, pool, narrate, progress, fresh=fresh)
        ended = runner.run()
        told = summary(runner, ended, root is None)
        files = publish(runner, ended, told)
        keep_pictures(seen.pictures, out / HIDDEN / "pictures")
        write_page(out / "rig.yaml")
    return Calibrated(out, decide(told, runner.sections().values), told, ended, (*files, "report.html"))


def _simulated(output: Path) -> Folder:
    """The folder of a simulated rig, made beside the results unless this program has made it before."""
    from calib.twin.folder import write_rig_folder
    from calib.twin.rig import SimulatedRig

    hidden = output / HIDDEN
    place, key = hidden / "stages" / "simulate", key_of(("simulate", "rig"), {}, "")
    if load(place, key) is None:
        work = hidden / "work" / "simulate"
        remove(work)
        make_folder(work)
        write_rig_folder(work / "rig", SimulatedRig())
        store(work, place, key, EXIT_DONE, hidden / "work" / "old-simulate")
    return read_folder(place / "rig")

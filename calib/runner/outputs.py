"""What a run leaves in its folder: rig.yaml, states/, firmware/, and a summary for the page."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from calib.core.errors import EXIT_DONE, BadInputError
from calib.core.files import VIDEOS, file_sha256, one_line, sha256, shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.rig import Rig
from calib.core.words import Block, InWords, Line
from calib.core.workers import processors
from calib.core.writing import make_folder, replacing, write_atomically
from calib.io.columns import read_columns_file
from calib.runner.cache import key_of, load, remove, store
from calib.runner.decision import Decision, decide
from calib.runner.folder import Folder, read_folder
from calib.runner.graph import HIDDEN, Job, Runner, opened_run
from calib.runner.processes import local
from calib.show.page import keep_pictures, write_page

# ----------------------------------------------------------------------
# What a run leaves in its folder: rig.yaml, states/, firmware/, and a summary for the page.
#
# Each file is replaced in one step, only where it differs. Files that an earlier run has left and this one
# does not (of a log that is gone) are removed; files of other origin are not touched.

_LIST = "outputs.json"


def summary(runner: Runner, ended: Sequence[Job], simulated: bool) -> dict[str, Any]:
    """What the page tells of a run: nothing of time or place, so that the same inputs give the same."""
    jobs = [
        {
            "name": job.name,
            "stage": job.step.name,
            "title": job.step.title,
            "verb": job.step.verb,
            "log": None if job.log is None else one_line(job.log.path.name),
            "inputs": [one_line(runner.folder.name_of(path)) for path in job.inputs],
            "command": _command(runner.folder, job),
            "writes": list(job.step.writes),
            "flashed": job.step.flashed,
            "status": job.status,
            "reason": job.reason,
        }
        for job in ended
    ]
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
    words = [folder.name_of(path) for path in job.paths]
    for name, value in job.options.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", folder.name_of(value) if isinstance(value, Path) else str(value)]
    return ["calib", *job.step.verb.split(), *map(one_line, words)]


def publish(runner: Runner, ended: Sequence[Job], told: dict[str, Any], rig: Rig, twin: bool) -> list[str]:
    """Write all but the page; returns the names of the files relative to the output folder.

    `twin` says that what was calibrated was made by the run itself, and is to be shown beside the results.
    """
    out = runner.out
    wanted: dict[str, Path] = {}
    for job in ended:
        if job.result is None or job.status == "failed":
            continue
        output = job.step.output
        if job.log is not None and output in job.result.files:
            wanted[f"states/{job.log.slug}{Path(output).suffix}"] = job.result.folder / output
        elif output:
            for name in job.result.files:
                if name.startswith(f"{output}/"):
                    wanted[name] = job.result.folder / name
    if twin:
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
    _write(out / "rig.yaml", rig.file_text(out / "rig.yaml"))
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


def _write(target: Path, text: str) -> None:
    raw = text.encode("utf-8", "backslashreplace")
    if not target.is_symlink() and target.is_file() and file_sha256(target) == sha256(raw):
        return
    write_atomically(target, raw)


def _copy(source: Path, target: Path) -> None:
    """Copy a file of any size into place in one step."""
    make_folder(target.parent)
    if target.is_symlink() or (target.exists() and not target.is_file()):
        raise BadInputError(f"{shown(target)}: is no file of a run, and was not replaced")
    if target.is_file() and file_sha256(target) == file_sha256(source):
        return
    with replacing(target) as stream, source.open("rb") as whole:
        shutil.copyfileobj(whole, stream)


# ----------------------------------------------------------------------
# A whole rig: a folder in; its results, a page and the decision out.


@dataclass(frozen=True, repr=False)
class Calibrated(InWords):
    """A run that has ended.

    Attributes
    ----------
    out : its folder. decision : whether it can be flashed, and why not.
    told : its summary. ended : its jobs. files : what it has written, by name relative to `out`.
    """

    out: Path
    decision: Decision
    told: dict[str, Any]
    ended: Sequence[Job]
    files: tuple[str, ...]

    def blocks(self) -> list[Block]:
        return [
            Line(f"can it be flashed? {self.decision.answer}: {self.decision.headline}"),
            *(Line(sentence, "reason") for sentence in self.decision.weak),
            *(Line(sentence, "advice") for sentence in self.decision.record),
        ]

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
    out = Path(output)
    files: dict[str, Any] = {
        name: value.absolute() for name, value in asdict(stated).items() if isinstance(value, Path)
    }
    stated = replace(stated, **files)
    if stated.columns is not None:
        read_columns_file(stated.columns)
    root = None if folder is None else Path(folder)
    seen = None if root is None else read_folder(root, follow_links, stated)
    with opened_run(out, root) as interrupted, local(jobs or processors()) as pool:
        if interrupted is not None:
            narrate("the last run here was interrupted; going on where it stopped")
        if seen is None:
            narrate("no folder given: a simulated rig is calibrated, not a real one")
            seen = _simulated(out)
        for sentence in seen.left_out:
            narrate(sentence)
        runner = Runner(seen, out, pool, narrate, progress, fresh=fresh)
        return run_folder(runner, twin=root is None)


def run_folder(runner: Runner, twin: bool = False, page: bool = True) -> Calibrated:
    """Run the jobs of a folder and write all that is for a person, in an output folder that is open."""
    out, ended = runner.out, runner.run()
    rig = runner.rig()
    told = summary(runner, ended, twin or rig.simulated)
    files = publish(runner, ended, told, rig, twin)
    if page:
        pictures = [path for path in runner.folder.pictures if path.suffix.lower() not in VIDEOS]
        keep_pictures(pictures, out / HIDDEN / "pictures")
        write_page(out / "rig.yaml")
        files.append("report.html")
    return Calibrated(out, decide(told, rig.values()), told, ended, tuple(files))


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

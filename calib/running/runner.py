"""The run itself: every stage as soon as what it reads is known, old results where nothing has changed.

Each stage works in a folder of its own under `.calib/work` and its result appears under `.calib/stages`
in one step, so that a run can be killed between any two writes: what is whole is used by the next run,
all else is made again, and the end is the same.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from calib.errors import EXIT_DONE, EXIT_POOR, BadInputError
from calib.files import check_folder, make_folder, one_line, shown, write_atomically
from calib.running.cache import Result, key_of, load, remove, store
from calib.running.folder import Folder, folder_digests
from calib.running.lock import held
from calib.running.pool import Command, Runs
from calib.running.sections import Sections, sections_of
from calib.running.stages import STAGES, Job, Stage, jobs_of, urgency

__all__ = ["HIDDEN", "Done", "Runner", "opened"]

HIDDEN = ".calib"
_USABLE = (EXIT_DONE, EXIT_POOR)

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Done:
    """How a job ended.

    Attributes
    ----------
    status : "ok", "poor", "failed"; "blocked" by one that failed; "skipped" where the folder has nothing
        for it; "missing" where this version has no such verb.
    reason : one sentence for all but "ok".
    result : None where nothing was run.
    """

    job: Job
    status: str
    reason: str = ""
    result: Result | None = None
    reused: bool = False


@contextmanager
def opened(out: Path, folder: Path | None) -> Iterator[int | None]:
    """Make and lock the output folder; yields the process whose run was interrupted there, or None.

    Raises `BadInputError` when another run is at work there, when it is the folder that is read, and for
    links that would lead a write out of it.
    """
    if folder is not None and os.path.realpath(out) in (
        os.path.realpath(folder), os.path.realpath(folder / "images"),
        os.path.realpath(folder / "images" / "plane"), os.path.realpath(folder / "logs"),
    ):  # fmt: skip
        raise BadInputError(f"{shown(out)}: is the folder that is read, expected another one for the results")
    check_folder(out)
    hidden = out / HIDDEN
    ours = [hidden / name for name in ("work", "stages", "pictures", "figures")]
    public = [out / name for name in ("states", "firmware", "rig.yaml", "report.html")]
    for path in (hidden, *ours, *public):
        if path.is_symlink():
            raise BadInputError(f"{shown(path)}: is a symbolic link, expected a place in the output folder")
    make_folder(hidden)
    with held(hidden / "lock", out) as interrupted:
        remove(hidden / "work")
        _sweep(out)
        make_folder(hidden / "work")
        make_folder(hidden / "stages")
        yield interrupted


def _sweep(out: Path) -> None:
    """Remove what an interrupted write has left beside the file that it was about."""
    hidden = out / HIDDEN
    left = [path for name in ("rig.yaml", "report.html") for path in out.glob(f".{name}.*.tmp")]
    for folder in (hidden, hidden / "pictures", hidden / "figures"):
        left += folder.glob(".*.tmp")
    for path in left:
        with contextlib.suppress(OSError):
            path.unlink()


def _stamp(path: Path) -> tuple[int, int, int]:
    try:
        status = path.stat()
    except OSError:
        return (-1, 0, 0)
    return status.st_size, status.st_mtime_ns, status.st_ino


@dataclass
class Runner:
    """A run of a folder into an opened output folder.

    Parameters
    ----------
    runs : what runs commands.
    available : whether this version has a verb.
    tell : gets a line for each stage that has ended; `progress` how many there are.
    fresh : whether old results are left aside.
    """

    folder: Folder
    out: Path
    runs: Runs
    available: Callable[[tuple[str, ...]], bool]
    tell: Tell = lambda _: None
    progress: Callable[[int, int], None] = lambda _done, _total: None
    stages: tuple[Stage, ...] = STAGES
    fresh: bool = False
    done: dict[str, Done] = field(default_factory=dict)
    _base: Sections = field(default_factory=Sections)
    _sections: dict[str, Sections] = field(default_factory=dict)
    _digests: dict[Path, str] = field(default_factory=dict)
    _before: dict[Path, tuple[int, int, int]] = field(default_factory=dict)
    _began: dict[str, float] = field(default_factory=dict)

    def run(self) -> list[Done]:
        """Run all jobs; returns how they ended, in the table's order."""
        jobs = list(jobs_of(self.folder, self.stages))
        self._before = {path: _stamp(path) for path in self.folder.files()}
        self._digests = folder_digests(self.folder)
        if self.folder.rig is not None:
            told = sections_of(self.folder.rig)
            asked = [job for job in jobs if job.planned is not None and self.available(job.stage.verb)]
            learnt = {name for job in asked for name in job.stage.writes}
            self._base = told.without(learnt)
        urgent = urgency(self.stages)
        waiting = sorted(jobs, key=lambda job: -urgent[job.stage.name])
        running: dict[str, tuple[Job, str, Path]] = {}
        while waiting or running:
            waiting = [job for job in waiting if not self._settled(job)]
            for job in list(waiting):
                if not self.runs.free:
                    break
                if self._ready(job, waiting, running):
                    waiting.remove(job)
                    started = self._start(job)
                    if started is not None:
                        running[job.name] = started
            if running and (not self.runs.free or not self._any_ready(waiting, running)):
                for name, code in self.runs.finished():
                    job, key, work = running.pop(name)
                    self._end(job, key, work, code)
            self.progress(len(self.done), len(jobs))
        return [self.done[job.name] for job in jobs]

    def sections(self) -> Sections:
        """All that is known at the end: what the person told and what the stages have learnt."""
        whole = self._base
        for stage in self.stages:
            for name, part in self._sections.items():
                if self.done[name].job.stage is stage:
                    whole = whole.joined(part)
        return whole

    def _any_ready(self, waiting: list[Job], running: dict[str, tuple[Job, str, Path]]) -> bool:
        return any(self._ready(job, waiting, running) for job in waiting)

    def _settled(self, job: Job) -> bool:
        """Whether a job has ended without being run; it is then among `done`."""
        stage = job.stage
        if not self.available(stage.verb):
            self._finish(Done(job, "missing", f"this version has no calib {' '.join(stage.verb)}"))
            return True
        if job.planned is None:
            self._finish(Done(job, "skipped", job.reason))
            return True
        return False

    def _ready(self, job: Job, waiting: list[Job], running: dict[str, tuple[Job, str, Path]]) -> bool:
        read = {*job.stage.needs, *job.stage.uses}
        others = [*(other for other in waiting if other is not job), *(one for one, _, _ in running.values())]
        return not any(read & set(other.stage.writes) for other in others)

    def _known(self, job: Job) -> Sections:
        """The sections that a job may see."""
        whole = self.sections()
        return whole.only({*self._base.values, *job.stage.needs, *job.stage.uses}).without(job.stage.writes)

    def _start(self, job: Job) -> tuple[Job, str, Path] | None:
        """Start a job, or end it at once: blocked, or with the result that is there."""
        assert job.planned is not None
        known = self._known(job)
        lacking = next((name for name in job.stage.needs if name not in known.values), None)
        if lacking is not None:
            self._finish(self._blocked(job, lacking))
            return None
        inputs = {self.folder.name_of(path): self._digests[path] for path in job.planned.inputs}
        names = {str(path): self.folder.name_of(path) for path in job.planned.inputs}
        root = str(self.folder.root) + os.sep
        words = tuple(names.get(word, word.removeprefix(root)) for word in job.planned.arguments)
        key = key_of((*job.stage.verb, *words), inputs, known.canonical())
        kept = None if self.fresh else load(self.out / HIDDEN / "stages" / job.name, key)
        if kept is not None and kept.code in _USABLE:
            self._finish(self._judged(job, kept, reused=True))
            return None
        work = self.out / HIDDEN / "work" / job.name
        remove(work)
        make_folder(work)
        write_atomically(work / "rig.yaml", known.text(self.folder.rig or self.out / "rig.yaml"))
        arguments = [*job.stage.verb, "--json", "--rig", str(work / "rig.yaml")]
        if job.stage.figures:
            arguments += ["--figures", str(work / "figures")]
        if job.stage.output:
            arguments += ["-o", str(work / job.stage.output)]
        # Names that begin with a dash are no options: all paths here begin with a slash.
        arguments += job.planned.arguments
        self._began[job.name] = time.monotonic()
        self.runs.start(Command(job.name, tuple(arguments), work / "document.json", work / "messages.txt"))
        return job, key, work

    def _blocked(self, job: Job, section: str) -> Done:
        for done in self.done.values():
            if section in done.job.stage.writes:
                if done.status in ("failed", "blocked"):
                    return Done(job, "blocked", f"needs {section}, and {done.job.stage.title} has failed")
                return Done(job, "skipped", f"needs {section}: {done.reason}")
        return Done(job, "skipped", f"needs {section}, which the folder's rig.yaml has not")

    def _end(self, job: Job, key: str, work: Path, code: int) -> None:
        assert job.planned is not None
        changed = next((path for path in job.planned.inputs if _stamp(path) != self._before[path]), None)
        if changed is not None:
            name = one_line(self.folder.name_of(changed))
            self._finish(Done(job, "failed", f"{name} changed while it was read; run it again"))
            return
        self._tidy(work)
        hidden = self.out / HIDDEN
        result = store(work, hidden / "stages" / job.name, key, code, hidden / "work" / f"old-{job.name}")
        self._finish(self._judged(job, result, reused=False))

    def _tidy(self, work: Path) -> None:
        """Leave nothing in a result that differs from run to run: durations, places."""
        document, messages = work / "document.json", work / "messages.txt"
        with contextlib.suppress(OSError, ValueError):
            told = json.loads(document.read_text(encoding="utf-8"))
            if isinstance(told, dict):
                told.pop("seconds", None)
                write_atomically(document, json.dumps(told, indent=1) + "\n")
        with contextlib.suppress(OSError):
            text = messages.read_text(encoding="utf-8", errors="replace")
            root, place = str(self.folder.root) + os.sep, str(work)
            kept = [line.replace(root, "") for line in text.splitlines() if place not in line]
            if not any(line.startswith("calib: ") for line in kept):
                # What the verb ended with is told even where it names our place.
                kept += [
                    line.replace(place + os.sep, "").replace(root, "")
                    for line in text.splitlines() if line.startswith("calib: ")
                ]  # fmt: skip
            write_atomically(messages, "".join(f"{line}\n" for line in kept))

    def _judged(self, job: Job, result: Result, reused: bool) -> Done:
        if result.code not in _USABLE:
            said = result.messages()
            words = said[-1].removeprefix("calib: ") if said else f"ended with exit code {result.code}"
            return Done(job, "failed", words, result)
        part = Sections()
        if job.stage.writes:
            try:
                part = sections_of(result.folder / "rig.yaml").only(job.stage.writes)
            except BadInputError as error:
                return Done(job, "failed", str(error), result)
            if not part.values:
                return Done(job, "failed", f"has written no {' and no '.join(job.stage.writes)}", result)
        self._sections[job.name] = part
        if result.code == EXIT_DONE:
            return Done(job, "ok", "", result, reused)
        return Done(job, "poor", _reason(job, part, result), result, reused)

    def _finish(self, done: Done) -> None:
        self.done[done.job.name] = done
        words = {"missing": "not available", "blocked": "not run"}.get(done.status, done.status)
        of = "" if done.job.log is None else f" of {one_line(done.job.log.path.stem)}"
        began = self._began.pop(done.job.name, None)
        how = "" if began is None else f", {time.monotonic() - began:.1f} s"
        how = ", as before" if done.reused else how
        why = f" ({done.reason})" if done.reason else ""
        self.tell(f"{done.job.stage.title}{of}: {words}{how}{why}")


def _reason(job: Job, part: Sections, result: Result) -> str:
    """The first reason that a stage gives for a poor result."""
    for name in job.stage.writes:
        reasons = part.values.get(name, {}).get("reasons")
        if reasons:
            return str(reasons[0])
    for value in result.document().values():
        logs = value.get("logs") if isinstance(value, dict) else None
        for log in logs if isinstance(logs, list) else []:
            if isinstance(log, dict) and log.get("reasons"):
                return str(log["reasons"][0])
    said = result.messages()
    return said[-1] if said else "fails its quality gate"

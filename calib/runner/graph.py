"""A run: every stage as soon as what it reads is known, old results where nothing has changed."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from calib.core.errors import EXIT_DONE, EXIT_INTERNAL, EXIT_POOR, BadInputError
from calib.core.files import VIDEOS, file_sha256, inside, one_line, shown
from calib.core.result import Result as StageResult
from calib.core.rig import Rig
from calib.core.verdict import worst
from calib.core.words import Line
from calib.core.workers import Failure, Processes, Task
from calib.core.writing import make_folder
from calib.runner.cache import Result, key_of, load, opened, remove, store
from calib.runner.folder import Folder, LogFile, folder_digests, with_beside
from calib.runner.work import perform, stamp
from calib.stages import stage

# ----------------------------------------------------------------------
# The steps of a run: each is a stage, what it does with a folder, and what a run asks beyond it.
#
# A step sees only the sections of the rig's file that its stage names (and what the person wrote into the
# folder's own rig.yaml), so that what it does cannot depend on anything else, and gives back those that it
# writes. What a run knows in the end is put together from these in the table's order.

_IMU = ("ax_mps2", "ay_mps2", "gz_radps")
_CAMERA = ("u_px", "v_px")
_PUMP = ("pwm1", "pwm2")


Plan = Callable[["Folder", "Job"], "Job"]


@dataclass(frozen=True)
class Step:
    """A stage in a run.

    Attributes
    ----------
    name : of its folder and anchor. title : its heading. verb : words of its stage.
    plan : a job with what it reads in a folder, or with the reason why it has nothing to do.
    each_log : whether there is a job for each log. options : of the stage, beside what the plan adds.
    writes : sections of the rig's file. needs : sections without which it cannot run. uses : sections that
        it reads where they are.
    output : name of what it writes beside rig.yaml, "" for nothing. figures : whether it draws.
    flashed : whether its result goes into the firmware.
    seconds : about how long it takes, by which the runner begins what holds up most.
    """

    name: str
    title: str
    verb: str
    plan: Plan
    each_log: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    writes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    output: str = ""
    figures: bool = True
    flashed: bool = False
    seconds: float = 1.0


@dataclass(frozen=True)
class Job:
    """A step with its part of the folder, and how it ended.

    Attributes
    ----------
    name : unique, and safe as a path: that of the step, or step and log.
    log : of a step that has a job for each log.
    paths, options : what the stage reads and its options. inputs : all files that it depends on.
    status : the word of its verdict, or "failed"; "blocked" by one that failed; "skipped" where the folder
        has nothing for it; "" before the end.
    reason : one sentence for all but "ok". result : None where nothing was run; reused : by an earlier run.
    instead : what is done where this fails.
    """

    name: str
    step: Step
    log: LogFile | None = None
    paths: tuple[Path, ...] = ()
    inputs: tuple[Path, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    status: str = ""
    reason: str = ""
    result: Result | None = None
    reused: bool = False
    instead: Job | None = None

    @property
    def label(self) -> str:
        """The step's heading, and of which log."""
        return self.step.title if self.log is None else f"{self.step.title} of {one_line(self.log.path.stem)}"

    def skipped(self, reason: str) -> Job:
        """This job, which has nothing to do."""
        return replace(self, options={}, status="skipped", reason=reason)

    def reading(self, logs: tuple[Path, ...], lacking: str) -> Job:
        """This job with logs that it reads, or skipped where there are none."""
        return replace(self, paths=logs, inputs=with_beside(logs)) if logs else self.skipped(lacking)


def _logs(folder: Folder, kind: str, *columns: str) -> tuple[Path, ...]:
    return tuple(log.path for log in folder.logs if log.kind == kind and log.has(*columns))


def _linked(folder: Folder, start: str) -> str:
    """What was left out of a folder, or of a file's place, that a stage would read."""
    told = (one for one in folder.left_out if one.startswith(start) and not one.startswith(f"{start}:"))
    return next(told, "")


def _intrinsics(folder: Folder, job: Job) -> Job:
    if not folder.pictures:
        return job.skipped("no pictures and no videos in images/")
    if linked := _linked(folder, "images/board.yaml"):
        return job.skipped(linked)
    board = () if folder.board is None else (folder.board,)
    return replace(job, paths=folder.pictures, inputs=(*folder.pictures, *board))


def _extrinsics(folder: Folder, job: Job) -> Job:
    if not folder.plane:
        return job.skipped("no pictures and no video in images/plane/")
    if linked := _linked(folder, "images/plane/"):
        return job.skipped(linked)
    board = () if folder.plane_board is None else (folder.plane_board,)
    # A video is given by itself, of pictures their folder.
    video = folder.plane[0].suffix.lower() in VIDEOS
    paths = folder.plane if video else (folder.root / "images" / "plane",)
    return replace(job, paths=paths, inputs=(*folder.plane, *board))


def _reading(kind: str, columns: tuple[str, ...], lacking: str, most: int | None = None) -> Plan:
    """A plan that reads the logs of a kind with these columns, or the first few of them."""

    def plan(folder: Folder, job: Job) -> Job:
        return job.reading(_logs(folder, kind, *columns)[:most], lacking)

    return plan


def _drift(folder: Folder, job: Job) -> Job:
    logs = (*_logs(folder, "rest", *_IMU), *_logs(folder, "motion", *_IMU)[:1])
    return job.reading(logs, "no logs of an IMU in logs/")


def _lowpass(folder: Folder, job: Job) -> Job:
    # The log is shown, and the first that can be used will do.
    for log in reversed(_logs(folder, "motion", *_CAMERA)):
        job = replace(job, inputs=with_beside([log]), options={"log": log}, instead=job)
    return job


def _control(folder: Folder, job: Job) -> Job:
    # A rig.yaml may tell of the actuator; without one nothing but these logs does.
    if folder.rig is None and not _logs(folder, "motion", *_CAMERA, *_PUMP):
        return job.skipped("no logs with camera and PWM in logs/, and no rig.yaml that tells of the actuator")
    return job


def _replay(_: Folder, job: Job) -> Job:
    log = job.log
    if log is None or not (log.has(*_CAMERA) or log.has(*_IMU)):
        return job.skipped("the log has neither a camera nor an IMU")
    if log.kind != "motion" and not log.has(*_CAMERA):
        # Of an IMU alone, at rest or turned by hand, nobody wants the states of an actuator.
        return job.skipped("an IMU without motion and without pictures")
    return job.reading((log.path,), "")


_OPTICS = ("camera", "plane")
_resting = _reading("rest", _IMU, "no logs of an IMU at rest, logs/static*.csv")
_poses = _reading("poses", _IMU, "no log of rests in different poses, logs/poses*.csv", 1)
_moving = _reading("motion", _IMU, "no logs of an IMU in motion in logs/")
_both = _reading("motion", (*_IMU, *_CAMERA), "no logs of camera and IMU in motion in logs/")
_driven = _reading("motion", (*_CAMERA, *_PUMP), "no logs with camera and PWM in logs/")


def _step(verb: str, plan: Plan, needs: tuple[str, ...] = (), **beyond: Any) -> Step:
    """The step of a stage; `needs` are what a run demands beyond it."""
    made = stage(verb)
    # What is written on request is not asked for.
    writes = () if made.on_request else made.writes
    return Step(
        beyond.pop("name", verb.replace(" ", "-")),
        made.title,
        verb,
        plan,
        writes=writes,
        needs=(*made.needs, *needs),
        # Its own last answer is nothing to start from.
        uses=tuple(name for name in made.uses if name not in writes),
        figures=made.plots is not None,
        **beyond,
    )


STEPS: tuple[Step, ...] = (
    _step("intrinsics", _intrinsics, flashed=True, seconds=5.0),
    _step("extrinsics", _extrinsics, flashed=True, seconds=3.0),
    _step("distortion", lambda folder, job: job),
    _step("imu static", _resting, flashed=True, seconds=4.0),
    _step("imu intrinsics", _poses),
    _step("imu tune", _moving, flashed=True, seconds=4.0),
    # What is installed beside calib must not change the page.
    _step("imu drift", _drift, options={"peers": False}, seconds=2.0),
    _step("lowpass", _lowpass, flashed=True, seconds=3.0),
    _step("align", _both, flashed=True, seconds=9.0),
    # A fit without each log in turn takes as many times as long, and is left to the verb.
    _step("identify logs", _driven, _OPTICS, name="identify", options={"hold_back": False}, seconds=9.0),
    _step("replay", _replay, _OPTICS, each_log=True, output="states.csv", seconds=2.0),
    _step("control tune", _control, name="control", flashed=True, seconds=3.0),
    _step("validate", _driven, _OPTICS, seconds=8.0),
    _step("firmware", lambda folder, job: job, output="firmware"),
)
"""All steps, each after those whose sections it reads."""


def urgency(steps: tuple[Step, ...] = STEPS) -> dict[str, float]:
    """Seconds from the start of each step to the end of all that waits for it, by name."""
    out: dict[str, float] = {}
    for step in reversed(steps):
        waits = [out[other.name] for other in steps if other.name in out
                 and {*other.needs, *other.uses} & set(step.writes)]  # fmt: skip
        out[step.name] = step.seconds + max(waits, default=0.0)
    return out


def jobs_of(folder: Folder, steps: tuple[Step, ...] = STEPS) -> Iterator[Job]:
    """The work that a folder asks for, in the table's order."""
    for step in steps:
        if not step.each_log:
            yield step.plan(folder, Job(step.name, step, options=step.options))
        elif not folder.logs:
            yield Job(step.name, step).skipped("no logs in logs/")
        else:
            for log in folder.logs:
                yield step.plan(folder, Job(f"{step.name}-{log.slug}", step, log, options=step.options))


# ----------------------------------------------------------------------
# The run itself: every stage as soon as what it reads is known, old results where nothing has changed.
#
# Each stage works in a folder of its own under `.calib/work` and its result appears under `.calib/stages`
# in one step, so that a run can be killed between any two writes: what is whole is used by the next run,
# all else is made again, and the end is the same.

HIDDEN = ".calib"
_USABLE = (EXIT_DONE, EXIT_POOR)


@contextmanager
def opened_run(out: Path, folder: Path | None) -> Iterator[int | None]:
    """Make and lock the output folder of a run, see `opened`; it must not be the folder that is read."""
    if folder is not None and (
        os.path.realpath(out) == os.path.realpath(folder)
        or any(inside(out, folder / name) for name in ("images", "logs"))
    ):
        raise BadInputError(
            f"{shown(out)}: lies in the folder that is read, expected another one for the results"
        )
    public = ("states", "firmware", "rig.yaml", "report.html")
    with opened(out, out / HIDDEN, "calib run", public, ("stages", "pictures"), "work") as interrupted:
        yield interrupted


@dataclass
class Runner:
    """A run of a folder into an opened output folder.

    Parameters
    ----------
    processes : what carries out the stages.
    tell : gets a line for each job that has ended; `progress` how many there are.
    fresh : whether old results are left aside.
    """

    folder: Folder
    out: Path
    processes: Processes
    tell: Callable[[str], None] = lambda _: None
    progress: Callable[[int, int], None] = lambda _done, _total: None
    steps: tuple[Step, ...] = STEPS
    fresh: bool = False
    ended: dict[str, Job] = field(default_factory=dict)
    _base: Rig = field(default_factory=Rig)
    _learnt: dict[str, Rig] = field(default_factory=dict)
    _digests: dict[Path, str] = field(default_factory=dict)
    _before: dict[Path, tuple[int, int, int] | None] = field(default_factory=dict)
    _began: dict[str, float] = field(default_factory=dict)

    def run(self) -> list[Job]:
        """Run all jobs; returns how they ended, in the table's order."""
        jobs = list(jobs_of(self.folder, self.steps))
        self._before = {path: stamp(path) for path in self.folder.files()}
        self._digests = folder_digests(self.folder)
        if self._of_others():
            self.tell(f"{shown(self.out)}: held the results of other pictures and logs, which these replace")
        if self.folder.rig is not None:
            learnt = {name for job in jobs if not job.status for name in job.step.writes}
            base = Rig.load(self.folder.rig)
            self._base = base.only(set(base.sections) - learnt)
        urgent = urgency(self.steps)
        waiting = sorted((job for job in jobs if not job.status), key=lambda job: -urgent[job.step.name])
        for job in jobs:
            if job.status:
                self._end(job)
        running: dict[str, tuple[Job, str]] = {}
        while waiting or running:
            first = next((job for job in waiting if self._ready(job, waiting, running)), None)
            if first is not None and self.processes.free:
                waiting.remove(first)
                if key := self._start(first):
                    running[first.name] = first, key
            else:
                for task, code in self.processes.finished():
                    job, key = running.pop(task.name)
                    job = self._stored(job, key, EXIT_INTERNAL if isinstance(code, Failure) else code)
                    if job.status == "failed" and job.instead is not None:
                        waiting.insert(0, job.instead)
                    else:
                        self._end(job)
            self.progress(len(self.ended), len(jobs))
        return [self.ended[job.name] for job in jobs]

    def _of_others(self) -> bool:
        """Whether results are there, and none of the files that are read now has gone into them."""
        try:
            before = (self.out / "rig.yaml").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False
        return "inputs:" in before and not any(
            digest in before for path, digest in self._digests.items() if path.suffix != ".yaml"
        )

    def rig(self) -> Rig:
        """All that is known: what the person told and what the stages have learnt."""
        whole = self._base
        for step in self.steps:
            for name, part in self._learnt.items():
                if self.ended[name].step is step:
                    whole = whole.joined(part)
        return whole

    @staticmethod
    def _ready(job: Job, waiting: list[Job], running: Mapping[str, tuple[Job, str]]) -> bool:
        read = {*job.step.needs, *job.step.uses}
        others = [*(other for other in waiting if other is not job), *(one for one, _ in running.values())]
        return not any(read & set(other.step.writes) for other in others)

    def _start(self, job: Job) -> str:
        """Start a job and return its key; "" where it has ended at once: blocked, or with an old result."""
        seen = {*self._base.sections, *job.step.needs, *job.step.uses} - {*job.step.writes}
        known = self.rig().only(seen)
        lacking = next((name for name in job.step.needs if name not in known.sections), None)
        if lacking is not None:
            self._end(self._blocked(job, lacking))
            return ""
        inputs = {self.folder.name_of(path): self._digests[path] for path in job.inputs}
        named = [self.folder.name_of(path) for path in job.paths]
        chosen = {**self._stated(job), **job.options}
        options = {name: self._said(value) for name, value in chosen.items()}
        command = (*job.step.verb.split(), *named, json.dumps(options, sort_keys=True))
        key = key_of(command, inputs, json.dumps(known.values(), sort_keys=True))
        kept = None if self.fresh else load(self.out / HIDDEN / "stages" / job.name, key)
        if kept is not None and kept.code in _USABLE:
            self._end(self._judged(job, kept, reused=True))
            return ""
        work = self._work(job.name)
        remove(work)
        make_folder(work)
        known.save(work / "rig.yaml")
        self._began[job.name] = time.monotonic()
        step = job.step
        words = (step.verb, self.folder.root, work, job.paths, chosen, step.figures, step.output)
        self.processes.start(Task(job.name, perform, words))
        return key

    def _work(self, name: str) -> Path:
        return self.out / HIDDEN / "work" / name

    def _stated(self, job: Job) -> dict[str, Any]:
        """What a person states of logs, for a stage that reads some."""
        logs = {log.path for log in self.folder.logs}
        stated = asdict(self.folder.options) if logs & set(job.inputs) else {}
        return {name: value for name, value in stated.items() if value is not None}

    def _said(self, value: Any) -> Any:
        """An option's value, the same wherever the folder lies; of a file elsewhere what it holds."""
        if not isinstance(value, Path):
            return value
        return self.folder.name_of(value) if value.is_relative_to(self.folder.root) else file_sha256(value)

    def _blocked(self, job: Job, section: str) -> Job:
        for other in self.ended.values():
            if section in other.step.writes:
                if other.status in ("failed", "blocked"):
                    why = f"needs {section}, and {other.step.title} has failed"
                    return replace(job, status="blocked", reason=why)
                return replace(job, status="skipped", reason=f"needs {section}: {other.reason}")
        why = f"needs {section}, which the folder's rig.yaml has not"
        return replace(job, status="skipped", reason=why)

    def _stored(self, job: Job, key: str, code: int) -> Job:
        """A job that has come to its end, its result kept."""
        changed = next((path for path in job.inputs if stamp(path) != self._before[path]), None)
        if changed is not None:
            name = one_line(self.folder.name_of(changed))
            return replace(job, status="failed", reason=f"{name} changed while it was read; run it again")
        place, trash = self.out / HIDDEN / "stages" / job.name, self._work(f"old-{job.name}")
        return self._judged(job, store(self._work(job.name), place, key, code, trash), reused=False)

    def _judged(self, job: Job, result: Result, reused: bool) -> Job:
        job = replace(job, status="failed", result=result)
        if result.code not in _USABLE:
            said = result.messages()
            words = said[-1].removeprefix("calib: ") if said else f"ended with exit code {result.code}"
            return replace(job, reason=words)
        part = Rig()
        if job.step.writes:
            try:
                part = Rig.load(result.folder / "rig.yaml").only(job.step.writes)
            except BadInputError as error:
                return replace(job, reason=str(error))
            if not part.sections:
                return replace(job, reason=f"has written no {' and no '.join(job.step.writes)}")
        self._learnt[job.name] = part
        if result.code == EXIT_DONE:
            return replace(job, status="ok", reused=reused)
        found = (one.verdict.word for one in part.sections.values() if isinstance(one, StageResult))
        return replace(job, status=worst(("poor", *found)), reason=_reason(part, result), reused=reused)

    def _end(self, job: Job) -> None:
        self.ended[job.name] = job
        words = "not run" if job.status == "blocked" else job.status
        began = self._began.pop(job.name, None)
        how = "" if began is None else f", {time.monotonic() - began:.1f} s"
        how = ", as before" if job.reused else how
        why = f" ({job.reason})" if job.reason else ""
        self.tell(f"{job.label}: {words}{how}{why}")


def _reason(part: Rig, result: Result) -> str:
    """The first reason of a section that is poor, or all of a stage that writes none."""
    for section in part.sections.values():
        if isinstance(section, StageResult) and section.verdict.reasons:
            return section.verdict.reasons[0]
    given = [one.text for one in result.words() if isinstance(one, Line) and one.kind == "reason"]
    return ", ".join(given) or next(reversed(result.messages()), "fails its quality gate")

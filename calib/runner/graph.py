"""A run: every stage as soon as what it reads is known, old results where nothing has changed."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

from calib.core.errors import EXIT_DONE, EXIT_POOR, BadInputError
from calib.core.files import inside, one_line, shown
from calib.core.rig import SCHEMA, Rig
from calib.core.writing import check_folder, make_folder, sweep, write_atomically
from calib.runner.cache import Result, held, key_of, load, remove, store
from calib.runner.folder import Folder, LogFile, digest_of, folder_digests, with_beside
from calib.runner.work import Work, perform
from calib.stages import stage

# ----------------------------------------------------------------------
# Sections of the rig's file, handed from stage to stage.
#
# A stage gets a file of its own with the sections that its row names, and gives back those that it writes.
# What a run knows in the end is put together from these parts in the order of the file, whatever the order
# in which the stages came to an end.


@dataclass
class Sections:
    """Sections by name as plain values, and the hashes of what each was learnt from."""

    values: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)

    def only(self, names: Iterable[str]) -> Sections:
        """Those of these names."""
        wanted = set(names)
        return Sections(
            {name: value for name, value in self.values.items() if name in wanted},
            {name: value for name, value in self.inputs.items() if name in wanted},
        )

    def without(self, names: Iterable[str]) -> Sections:
        """All but those of these names."""
        return self.only(set(self.values) - set(names))

    def joined(self, other: Sections) -> Sections:
        """Both; the other's where both have one."""
        return Sections({**self.values, **other.values}, {**self.inputs, **other.inputs})

    def canonical(self) -> str:
        """All of it as one line, the same for the same sections; quicker to make than the file's text."""
        return json.dumps([self.values, self.inputs], sort_keys=True, ensure_ascii=True, default=str)

    def text(self, source: Path) -> str:
        """Text of a rig's file with these sections; `source` is named should they not be valid."""
        inputs = {name: dict(sorted(self.inputs[name].items())) for name in sorted(self.inputs)}
        return Rig.of({"schema": SCHEMA, **self.values, "provenance": {"inputs": inputs}}, source).text()


def sections_of(path: Path) -> Sections:
    """Sections of a rig's file. Raises `BadInputError` as `Rig.load` does."""
    rig = Rig.load(path)
    values = rig.values()
    del values["provenance"]
    return Sections(values, rig.provenance.inputs)


# ----------------------------------------------------------------------
# The steps of a run: each is a stage, what it does with a folder, and what a run asks beyond it.
#
# A step sees only the sections of the rig's file that its stage names (and what the person wrote into the
# folder's own rig.yaml), so that what it does cannot depend on anything else.

_IMU = ("ax_mps2", "ay_mps2", "gz_radps")
_CAMERA = ("u_px", "v_px")
_PUMP = ("pwm1", "pwm2")


@dataclass(frozen=True)
class Planned:
    """What a stage reads and its options, and all files that it depends on."""

    paths: tuple[Path, ...]
    inputs: tuple[Path, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


Plan = Callable[[Folder], Planned | str]
"""What a stage does with a folder, or why it has nothing to do."""


@dataclass(frozen=True)
class Step:
    """A stage in a run.

    Attributes
    ----------
    name : of its folder and anchor. title : its heading. verb : words of its stage.
    plan : arguments and inputs for a folder; `plan_log` instead for a step that runs once for each log.
    writes : sections of the rig's file. needs : sections without which it cannot run. uses : sections that
        it reads where they are.
    output : name of what it writes beside rig.yaml, "" for nothing. figures : whether it draws.
    flashed : whether its result goes into the firmware.
    seconds : about how long it takes, by which the runner begins what holds up most.
    """

    name: str
    title: str
    verb: str
    plan: Plan | None = None
    plan_log: Callable[[LogFile], Planned | str] | None = None
    writes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    output: str = ""
    figures: bool = True
    flashed: bool = False
    seconds: float = 1.0


@dataclass(frozen=True)
class Job:
    """A stage with its part of the folder: what to run, or why not.

    Attributes
    ----------
    name : unique, and safe as a path: that of the step, or step and log.
    log : of a step that runs for each log.
    planned : None where `reason` says why there is nothing to do.
    """

    name: str
    step: Step
    log: LogFile | None
    planned: Planned | None
    reason: str = ""


def _given(paths: tuple[Path, ...], **options: Any) -> Planned:
    return Planned(paths, with_beside(paths), options)


def _logs(folder: Folder, kind: str, *columns: str) -> tuple[Path, ...]:
    return tuple(log.path for log in folder.logs if log.kind == kind and log.has(*columns))


def _linked(folder: Folder, start: str) -> str:
    return next((sentence for sentence in folder.left_out if sentence.startswith(start)), "")


def _intrinsics(folder: Folder) -> Planned | str:
    if not folder.pictures:
        return "no pictures in images/"
    linked = _linked(folder, "images/board.yaml")
    board = () if folder.board is None else (folder.board,)
    return linked or Planned(folder.pictures, (*folder.pictures, *board))


def _extrinsics(folder: Folder) -> Planned | str:
    if not folder.plane:
        return "no pictures in images/plane/"
    if linked := _linked(folder, "images/plane/"):
        return linked
    board = () if folder.plane_board is None else (folder.plane_board,)
    return Planned((folder.root / "images" / "plane",), (*folder.plane, *board))


def _static(folder: Folder) -> Planned | str:
    logs = _logs(folder, "rest", *_IMU)
    return _given(logs) if logs else "no logs of an IMU at rest, logs/static*.csv"


def _poses(folder: Folder) -> Planned | str:
    logs = _logs(folder, "poses", *_IMU)
    return _given(logs[:1]) if logs else "no log of rests in different poses, logs/poses*.csv"


def _moving(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_IMU)
    return _given(logs) if logs else "no logs of an IMU in motion in logs/"


def _drift(folder: Folder) -> Planned | str:
    logs = (*_logs(folder, "rest", *_IMU), *_logs(folder, "motion", *_IMU)[:1])
    # What is installed beside calib must not change the page.
    return _given(logs, peers=False) if logs else "no logs of an IMU in logs/"


def _lowpass(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA)
    if not logs:
        return Planned((), ())
    return Planned((), with_beside(logs[:1]), {"log": logs[0]})


def _both(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_IMU, *_CAMERA)
    return _given(logs) if logs else "no logs of camera and IMU in motion in logs/"


def _identify(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA, *_PUMP)
    # A fit without each log in turn takes as many times as long, and is left to the verb.
    return _given(logs, hold_back=False) if logs else "no logs with camera and PWM in logs/"


def _driven(folder: Folder) -> Planned | str:
    logs = _logs(folder, "motion", *_CAMERA, *_PUMP)
    return _given(logs) if logs else "no logs with camera and PWM in logs/"


def _nothing(_: Folder) -> Planned | str:
    return Planned((), ())


def _replay(log: LogFile) -> Planned | str:
    if not (log.has(*_CAMERA) or log.has(*_IMU)):
        return "the log has neither a camera nor an IMU"
    return Planned((log.path,), with_beside([log.path]))


_OPTICS = ("camera", "plane")


def _step(verb: str, plan: Plan | None, name: str = "", needs: tuple[str, ...] = (), **beyond: Any) -> Step:
    """The step of a stage; `needs` are what a run demands beyond it."""
    made = stage(verb)
    # What is written on request is not asked for.
    writes = () if made.on_request else made.writes
    return Step(
        name or verb.replace(" ", "-"),
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
    _step("distortion", _nothing),
    _step("imu static", _static, flashed=True, seconds=4.0),
    _step("imu intrinsics", _poses),
    _step("imu tune", _moving, flashed=True, seconds=4.0),
    _step("imu drift", _drift, seconds=2.0),
    _step("lowpass", _lowpass, flashed=True, seconds=3.0),
    _step("align", _both, flashed=True, seconds=9.0),
    _step("identify logs", _identify, "identify", _OPTICS, seconds=9.0),
    _step("replay", None, needs=_OPTICS, plan_log=_replay, output="states.csv", seconds=2.0),
    _step("control tune", _nothing, "control", flashed=True, seconds=3.0),
    _step("validate", _driven, needs=_OPTICS, seconds=8.0),
    _step("firmware", _nothing, output="firmware"),
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
        if step.plan_log is not None:
            if not folder.logs:
                yield Job(step.name, step, None, None, "no logs in logs/")
            for log in folder.logs:
                yield _job(f"{step.name}-{log.slug}", step, log, step.plan_log(log))
        elif step.plan is not None:
            yield _job(step.name, step, None, step.plan(folder))


def _job(name: str, step: Step, log: LogFile | None, planned: Planned | str) -> Job:
    if isinstance(planned, str):
        return Job(name, step, log, None, planned)
    return Job(name, step, log, planned)


# ----------------------------------------------------------------------
# Processes in which verbs run, one at a time in each, as if they had been typed.
#
# A process is kept for many verbs: starting Python and its libraries takes longer than most verbs do. A
# verb that brings its process down (out of memory, a fault in a library) fails alone.

_PR_SET_PDEATHSIG = 1
_LOOK_UP_S = 0.2
_LOST = 70
"""Exit code for a verb whose process has died."""
_LIBRARIES = (
    "calib.cli.main",
    "calib.cli.app",
    "calib.core.rig",
    "scipy.optimize",
    "scipy.signal",
    "numba",
    "calib.show.draw",
)
"""What most verbs need and takes long to load; the first of them sets up the others."""

_Process = tuple[multiprocessing.process.BaseProcess, Connection]


class Runs(Protocol):
    """What carries out works: `start` while `free`, then names and exit codes of `finished` ones."""

    @property
    def free(self) -> bool:
        """Whether another work can start."""

    def start(self, work: Work) -> None:
        """Start a work."""

    def finished(self) -> Iterator[tuple[str, int]]:
        """Wait until at least one has ended."""


def _serve(channel: Connection, parent: int, ahead: bool) -> None:
    """Life of a process: works in, exit codes out, until the other end closes.

    One that is started `ahead` of its first work loads meanwhile what most of them need.
    """
    # Ctrl-C reaches all processes of a terminal; the first one answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)
    for name in _LIBRARIES if ahead else ():
        # The verb that needs it says so.
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    while True:
        try:
            work = channel.recv()
        except EOFError:
            return
        code = perform(work)
        try:
            channel.send(code)
        except OSError:
            return


class Pool:
    """A few processes that carry out works; use with `with`."""

    def __init__(self, count: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._count = max(1, count)
        self._idle: list[_Process] = []
        self._busy: dict[str, _Process] = {}

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for process, channel in (*self._idle, *self._busy.values()):
            channel.close()
            process.kill()
        for process, _channel in (*self._idle, *self._busy.values()):
            process.join()

    @property
    def free(self) -> bool:
        """Whether another work can start."""
        return len(self._busy) < self._count

    def start(self, work: Work) -> None:
        """Hand a work to an idle process, or to a new one; with the first, another is made ready."""
        first = not (self._idle or self._busy)
        process, channel = self._idle.pop() if self._idle else self._made(ahead=False)
        self._busy[work.name] = process, channel
        with contextlib.suppress(OSError):
            channel.send(work)
        if first and self._count > 1:
            self._idle.append(self._made(ahead=True))

    def _made(self, ahead: bool) -> _Process:
        channel, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, os.getpid(), ahead))
        process.start()
        theirs.close()
        return process, channel

    def finished(self) -> Iterator[tuple[str, int]]:
        """Names and exit codes of works that have ended; waits for at least one."""
        ready: list[object] = []
        while not ready and self._busy:
            # The wait is a short one, again and again, so that Ctrl-C is answered.
            ready = list(wait([channel for _, channel in self._busy.values()], timeout=_LOOK_UP_S))
        for name, (process, channel) in list(self._busy.items()):
            if channel not in ready:
                continue
            del self._busy[name]
            try:
                code = int(channel.recv())
                self._idle.append((process, channel))
            except (EOFError, OSError):
                process.kill()
                process.join()
                channel.close()
                code = _LOST
            yield name, code


# ----------------------------------------------------------------------
# The run itself: every stage as soon as what it reads is known, old results where nothing has changed.
#
# Each stage works in a folder of its own under `.calib/work` and its result appears under `.calib/stages`
# in one step, so that a run can be killed between any two writes: what is whole is used by the next run,
# all else is made again, and the end is the same.

HIDDEN = ".calib"
_USABLE = (EXIT_DONE, EXIT_POOR)

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Done:
    """How a job ended.

    Attributes
    ----------
    status : "ok", "poor", "failed"; "blocked" by one that failed; "skipped" where the folder has nothing
        for it.
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
    if folder is not None and (
        os.path.realpath(out) == os.path.realpath(folder)
        or any(inside(out, folder / name) for name in ("images", "logs"))
    ):
        raise BadInputError(
            f"{shown(out)}: lies in the folder that is read, expected another one for the results"
        )
    check_folder(out)
    hidden = out / HIDDEN
    ours = [hidden / name for name in ("work", "stages", "pictures", "figures")]
    public = [out / name for name in ("states", "firmware", "rig.yaml", "report.html")]
    for path in (hidden, *ours, *public):
        if path.is_symlink():
            raise BadInputError(f"{shown(path)}: is a symbolic link, expected a place in the output folder")
    for path in public:
        if path.exists() and not hidden.exists():
            raise BadInputError(
                f"{shown(path)}: is there, and is not the work of calib run; expected another output folder"
            )
    make_folder(hidden)
    with held(hidden / "lock", out) as interrupted:
        remove(hidden / "work")
        for place in (out, hidden, hidden / "pictures", hidden / "figures"):
            sweep(place)
        make_folder(hidden / "work")
        make_folder(hidden / "stages")
        yield interrupted


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
    tell : gets a line for each stage that has ended; `progress` how many there are.
    fresh : whether old results are left aside.
    """

    folder: Folder
    out: Path
    runs: Runs
    tell: Tell = lambda _: None
    progress: Callable[[int, int], None] = lambda _done, _total: None
    steps: tuple[Step, ...] = STEPS
    fresh: bool = False
    done: dict[str, Done] = field(default_factory=dict)
    _base: Sections = field(default_factory=Sections)
    _sections: dict[str, Sections] = field(default_factory=dict)
    _digests: dict[Path, str] = field(default_factory=dict)
    _before: dict[Path, tuple[int, int, int]] = field(default_factory=dict)
    _began: dict[str, float] = field(default_factory=dict)

    def run(self) -> list[Done]:
        """Run all jobs; returns how they ended, in the table's order."""
        jobs = list(jobs_of(self.folder, self.steps))
        self._before = {path: _stamp(path) for path in self.folder.files()}
        self._digests = folder_digests(self.folder)
        if self.folder.rig is not None:
            told = sections_of(self.folder.rig)
            learnt = {name for job in jobs if job.planned is not None for name in job.step.writes}
            self._base = told.without(learnt)
        urgent = urgency(self.steps)
        waiting = sorted(jobs, key=lambda job: -urgent[job.step.name])
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
        for step in self.steps:
            for name, part in self._sections.items():
                if self.done[name].job.step is step:
                    whole = whole.joined(part)
        return whole

    def _any_ready(self, waiting: list[Job], running: dict[str, tuple[Job, str, Path]]) -> bool:
        return any(self._ready(job, waiting, running) for job in waiting)

    def _settled(self, job: Job) -> bool:
        """Whether a job has ended without being run; it is then among `done`."""
        if job.planned is None:
            self._finish(Done(job, "skipped", job.reason))
            return True
        return False

    def _ready(self, job: Job, waiting: list[Job], running: dict[str, tuple[Job, str, Path]]) -> bool:
        read = {*job.step.needs, *job.step.uses}
        others = [*(other for other in waiting if other is not job), *(one for one, _, _ in running.values())]
        return not any(read & set(other.step.writes) for other in others)

    def _known(self, job: Job) -> Sections:
        """The sections that a job may see."""
        whole = self.sections()
        return whole.only({*self._base.values, *job.step.needs, *job.step.uses}).without(job.step.writes)

    def _start(self, job: Job) -> tuple[Job, str, Path] | None:
        """Start a job, or end it at once: blocked, or with the result that is there."""
        assert job.planned is not None
        known = self._known(job)
        lacking = next((name for name in job.step.needs if name not in known.values), None)
        if lacking is not None:
            self._finish(self._blocked(job, lacking))
            return None
        inputs = {self.folder.name_of(path): self._digests[path] for path in job.planned.inputs}
        named = [self.folder.name_of(path) for path in job.planned.paths]
        chosen = {**self._stated(job.planned), **job.planned.options}
        options = {name: self._said(value) for name, value in chosen.items()}
        key = key_of(
            (*job.step.verb.split(), *named, json.dumps(options, sort_keys=True)), inputs, known.canonical()
        )
        kept = None if self.fresh else load(self.out / HIDDEN / "stages" / job.name, key)
        if kept is not None and kept.code in _USABLE:
            self._finish(self._judged(job, kept, reused=True))
            return None
        work = self.out / HIDDEN / "work" / job.name
        remove(work)
        make_folder(work)
        write_atomically(work / "rig.yaml", known.text(self.folder.rig or self.out / "rig.yaml"))
        self._began[job.name] = time.monotonic()
        step = job.step
        self.runs.start(
            Work(
                job.name,
                step.verb,
                self.folder.root,
                work,
                job.planned.paths,
                chosen,
                step.figures,
                step.output,
            )
        )
        return job, key, work

    def _stated(self, planned: Planned) -> dict[str, Any]:
        """What a person states of logs, for a stage that reads some."""
        logs = {log.path for log in self.folder.logs}
        stated = asdict(self.folder.options) if logs & set(planned.inputs) else {}
        return {name: value for name, value in stated.items() if value is not None}

    def _said(self, value: Any) -> Any:
        """An option's value, the same wherever the folder lies; of a file elsewhere what it holds."""
        if not isinstance(value, Path):
            return value
        return self.folder.name_of(value) if value.is_relative_to(self.folder.root) else digest_of(value)

    def _blocked(self, job: Job, section: str) -> Done:
        for done in self.done.values():
            if section in done.job.step.writes:
                if done.status in ("failed", "blocked"):
                    return Done(job, "blocked", f"needs {section}, and {done.job.step.title} has failed")
                return Done(job, "skipped", f"needs {section}: {done.reason}")
        return Done(job, "skipped", f"needs {section}, which the folder's rig.yaml has not")

    def _end(self, job: Job, key: str, work: Path, code: int) -> None:
        assert job.planned is not None
        changed = next((path for path in job.planned.inputs if _stamp(path) != self._before[path]), None)
        if changed is not None:
            name = one_line(self.folder.name_of(changed))
            self._finish(Done(job, "failed", f"{name} changed while it was read; run it again"))
            return
        hidden = self.out / HIDDEN
        result = store(work, hidden / "stages" / job.name, key, code, hidden / "work" / f"old-{job.name}")
        self._finish(self._judged(job, result, reused=False))

    def _judged(self, job: Job, result: Result, reused: bool) -> Done:
        if result.code not in _USABLE:
            said = result.messages()
            words = said[-1].removeprefix("calib: ") if said else f"ended with exit code {result.code}"
            return Done(job, "failed", words, result)
        part = Sections()
        if job.step.writes:
            try:
                part = sections_of(result.folder / "rig.yaml").only(job.step.writes)
            except BadInputError as error:
                return Done(job, "failed", str(error), result)
            if not part.values:
                return Done(job, "failed", f"has written no {' and no '.join(job.step.writes)}", result)
        self._sections[job.name] = part
        if result.code == EXIT_DONE:
            return Done(job, "ok", "", result, reused)
        return Done(job, "poor", _reason(job, part, result), result, reused)

    def _finish(self, done: Done) -> None:
        self.done[done.job.name] = done
        words = "not run" if done.status == "blocked" else done.status
        of = "" if done.job.log is None else f" of {one_line(done.job.log.path.stem)}"
        began = self._began.pop(done.job.name, None)
        how = "" if began is None else f", {time.monotonic() - began:.1f} s"
        how = ", as before" if done.reused else how
        why = f" ({done.reason})" if done.reason else ""
        self.tell(f"{done.job.step.title}{of}: {words}{how}{why}")


def _reason(job: Job, part: Sections, result: Result) -> str:
    """The first reason that a stage gives for a poor result."""
    for name in job.step.writes:
        reasons = part.values.get(name, {}).get("reasons")
        if reasons:
            return str(reasons[0])
    for value in result.document().values():
        logs = value.get("logs") if isinstance(value, dict) else None
        for log in logs if isinstance(logs, list) else []:
            if isinstance(log, dict) and log.get("reasons"):
                return str(log["reasons"][0])
    gate, said = result.document().get("gate"), result.messages()
    if isinstance(gate, list):
        return ", ".join(str(one) for one in gate)
    return said[-1] if said else "fails its quality gate"

"""Small stages for tests of the runner: verbs that take no time, run in this process."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from calib.core.errors import BadInputError
from calib.core.files import sha256
from calib.core.rig import Rig
from calib.core.workers import Task
from calib.core.writing import write_atomically
from calib.runner.decision import decide
from calib.runner.folder import Folder, read_folder
from calib.runner.graph import HIDDEN, Job, Runner, Step, opened_run
from calib.runner.outputs import run_folder
from calib.runner.processes import Here
from calib.runner.work import DOCUMENT, FIGURES, MESSAGES, RIG
from calib.stages.estimator.section import Estimator
from calib.twin.section import Tracker, Twin

__all__ = ["CALLS", "STEPS", "Inline", "make_folder", "run_small"]

CALLS: list[str] = []
"""Names of the commands that were run, in their order."""

Act = Callable[[list[str], Path], int]


class Inline(Here):
    """Carries out a work at once; `codes` holds exit codes by its name, 0 for the others."""

    def __init__(
        self, codes: dict[str, int] | None = None, during: Callable[[str], None] | None = None
    ) -> None:
        super().__init__()
        self.codes, self.during = codes or {}, during

    def start(self, task: Task) -> None:
        super().start(replace(task, function=self._done, arguments=(task.name, *task.arguments)))

    def _done(self, name: str, *words: Any) -> int:
        names = ("verb", "root", "folder", "paths", "options", "figures", "output")
        work = SimpleNamespace(**dict(zip(names, words, strict=True)))
        CALLS.append(name)
        code = self.codes.get(name, 0)
        if code in (0, 1):
            code = self._guarded(work, code)
        else:
            (work.folder / MESSAGES).write_text(f"calib: {name} cannot\n")
        if self.during is not None:
            self.during(name)
        return code

    def _guarded(self, work: SimpleNamespace, code: int) -> int:
        """As the command line ends a verb that cannot write."""
        try:
            self._work(work, code)
            return code
        except (OSError, BadInputError) as error:
            with contextlib.suppress(OSError):
                (work.folder / MESSAGES).write_text(f"calib: {error}\n")
            return 3

    def _work(self, work: SimpleNamespace, code: int) -> None:
        rig_path = work.folder / RIG
        rig = Rig.load(rig_path)
        inputs = list(work.paths)
        digest = sha256(
            b"".join(path.read_bytes() for path in inputs if path.parent.name in ("logs", "images"))
        )
        if work.verb == "first":
            rig.estimator = Estimator(
                jitter_px=1e-6 + int(digest[:6], 16) * 1e-6,
                verdict="poor" if code else "ok",
                reasons=["it is weak"] if code else [],
            )
            rig.save(rig_path, {"estimator": {path.name: digest for path in inputs}})
        elif work.verb == "second":
            assert rig.estimator is not None
            rig.twin = Twin(tracker=Tracker(jitter_px=2.0 * rig.estimator.jitter_px))
            rig.save(rig_path, {"twin": {}})
        output = work.folder / work.output if work.output else None
        if output is not None and output.suffix:
            write_atomically(output, f"t_s\n{digest}\n")
        elif output is not None:
            output.mkdir()
            write_atomically(output / "header.h", f"// {sorted(rig.values().items())}\n")
        if work.figures:
            figures = work.folder / FIGURES
            figures.mkdir(exist_ok=True)
            write_atomically(figures / "some_figure.svg", "<svg xmlns='http://www.w3.org/2000/svg'/>")
        (work.folder / DOCUMENT).write_text(json.dumps({"schema": 1, "verb": work.verb}))
        (work.folder / MESSAGES).write_text(f"said by {work.verb}\n")


def _pictures(folder: Folder, job: Job) -> Job:
    return replace(job, paths=folder.pictures, inputs=folder.pictures)


def _nothing(_: Folder, job: Job) -> Job:
    return job


def _log(_: Folder, job: Job) -> Job:
    assert job.log is not None
    return job.reading((job.log.path,), "")


STEPS = (
    Step("first", "First", "first", _pictures, writes=("estimator",), flashed=True),
    Step("second", "Second", "second", _nothing, writes=("twin",), needs=("estimator",)),
    Step("lone", "Lone", "lone", _nothing),
    Step("each", "Each", "each", _log, each_log=True, needs=("estimator",), output="states.csv"),
    Step("firmware", "Firmware", "firmware", _nothing, needs=("estimator",),
          uses=("twin",), output="firmware", figures=False),
)  # fmt: skip


def make_folder(root: Path) -> Path:
    """A folder with two pictures and two logs, by their names alone."""
    (root / "images").mkdir(parents=True)
    (root / "logs").mkdir()
    for name in ("a.png", "b.png"):
        (root / "images" / name).write_bytes(name.encode())
    for name in ("one.csv", "two.csv"):
        (root / "logs" / name).write_text(f"t_s,u_px,v_px\n0,1,{len(name)}\n")
    return root


def run_small(
    root: Path, out: Path, runs: Inline | None = None, follow_links: bool = False, fresh: bool = False
) -> Sequence[Job]:
    """A whole run with the small stages."""
    folder = read_folder(root, follow_links)
    with opened_run(out, root):
        return run_folder(Runner(folder, out, runs or Inline(), steps=STEPS, fresh=fresh), page=False).ended


def exit_code(out: Path) -> int:
    """Exit code of the run that left its results here."""
    told = json.loads((out / HIDDEN / "run.json").read_text(encoding="utf-8"))
    return decide(told, yaml.safe_load((out / "rig.yaml").read_text(encoding="utf-8"))).exit_code

"""A fleet from its manifest to its outcomes: what still holds is left alone, all else is done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from calib.errors import EXIT_INTERNAL
from calib.fleet.cluster import Cluster
from calib.fleet.engine import LIMIT_S, Broken, Lost, Task, run_tasks
from calib.fleet.manifest import Manifest, RigSpec, without_secrets
from calib.fleet.outcome import SAME, Outcome
from calib.fleet.store import Store
from calib.fleet.task import Answer, FleetOptions, calibrate_rig
from calib.fleet.worker import Overdue

__all__ = ["Counts", "run_fleet"]

Progress = Callable[[int, int], None]


@dataclass
class Counts:
    """How many rigs were done now, by how they ended, and how many were done before."""

    by_status: Counter[str] = field(default_factory=Counter)
    as_before: int = 0

    @property
    def done(self) -> int:
        """All of them."""
        return self.as_before + sum(self.by_status.values())


def run_fleet(
    store: Store,
    cluster: Cluster,
    manifest: Manifest,
    options: FleetOptions,
    retries: int,
    progress: Progress = lambda done, total: None,
    tell: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> Counts:
    """Run all rigs whose results are not there, each in `limit_s` seconds at most.

    Raises `BadInputError` as `run_tasks` and `Store.keep`.
    """
    counts, total = Counts(), len(manifest.rigs)
    scratch = "" if cluster.address else str(store.scratch)

    def tasks() -> Iterator[Task]:
        for spec in manifest.rigs:
            yield Task(spec.name, (spec, options, store.known(spec.name), scratch))

    def done(task: Task, result: Any) -> None:
        answer = _answer(task.arguments[0], result)
        if answer.outcome.status == SAME:
            counts.as_before += 1
        else:
            store.keep(answer)
            counts.by_status[answer.outcome.status] += 1
            if answer.outcome.status != "ok":
                tell(f"{answer.outcome.name}: {answer.outcome.status} ({answer.outcome.sentence})")
        progress(counts.done, total)

    progress(0, total)
    run_tasks(cluster, calibrate_rig, tasks(), done, retries, limit_s, tell)
    return counts


def _answer(spec: RigSpec, result: Any) -> Answer:
    if isinstance(result, Answer):
        return result
    if isinstance(result, Lost):
        status = "lost"
        sentence = (
            f"each of the {result.tries} processes that tried it died: out of memory, or a fault in a library"
        )
    elif isinstance(result, Overdue):
        status, sentence = "lost", f"was not done after {result.limit_s:g} s, which is the --timeout of a rig"
    else:
        words = result.words if isinstance(result, Broken) else type(result).__name__
        status, sentence = "broken", f"internal error: {words}"
    blank = Outcome(spec.name, spec.serial, without_secrets(spec.source), status, EXIT_INTERNAL, sentence)
    return Answer(blank, {})

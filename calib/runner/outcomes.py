"""Many tasks of one kind, the rigs of a fleet or the cases of a sweep: how each has ended, kept and tabled.

The output folder of such a run:

    rigs/NAME/                    results of a rig, as a single run leaves them
    .VERB/outcomes/NAME.json      how it ended; written last, so that what it tells of is there
    .VERB/lock                    one run at a time
    .VERB/scratch/                temporary files of this machine's processes, gone at the end

All is written by one process, the one that was started by a person: workers need not see this folder. What it
writes is not forced onto the disk: a file that a loss of power has damaged is not what its hash says, and is
made again.
"""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict

from calib.core.arrays import FloatArray
from calib.core.errors import EXIT_DONE, EXIT_INTERNAL, BadInputError, end_of
from calib.core.files import file_sha256, one_line, sha256, shown
from calib.core.workers import Failure, Processes, Task, run_tasks
from calib.core.writing import check_writable, make_folder, replacing, write_atomically
from calib.runner.cache import opened

Progress = Callable[[int, int], None]
LIMIT_S = 3600.0
"""Time that a task has."""
SAME = "same"
"""Status of a task whose earlier result still holds; nothing else of its outcome means anything."""
TIMINGS = "timings.csv"
_MOST_TEXT = 2000
_MOST_BYTES = 5_000_000
_BLOCK = 512

Sentence = Annotated[str, AfterValidator(lambda text: one_line(text)[:_MOST_TEXT])]


class Outcome(BaseModel):
    """How a task has ended, as it is kept in a file of its own.

    Attributes
    ----------
    status : "ok", "poor", "failed" (bad input or a stage that failed), "broken" (a fault of the program),
        "lost" (its time ran out, or every process that tried it died), or `SAME`.
    code : exit code that a single run would have had.
    sentence : why, in one sentence; "" for "ok".
    key : of all that the result follows from, "" where that is not known.
    kind : of a rig "run" for all stages, "camera" for those of a camera.
    reasons : of stages that are not ok. left_out : sentences on files that were not taken.
    stages : outcome of each stage by its name.
    simulated : whether constants come from a simulated rig or from rendered pictures.
    values : numbers with their standard deviations by name; null for what did not happen.
    seconds, peak_MB : spent on it, and the process's largest memory meanwhile.
    files : SHA-256 of its results by name.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    status: str = "ok"
    code: int = EXIT_DONE
    sentence: Sentence = ""
    key: str = ""
    kind: str = ""
    reasons: tuple[Sentence, ...] = ()
    left_out: tuple[Sentence, ...] = ()
    stages: dict[str, str] = {}
    simulated: bool = False
    values: Mapping[str, tuple[float | None, float | None]] = {}
    seconds: float = 0.0
    peak_MB: float | None = None
    files: dict[str, str] = {}


@dataclass(frozen=True)
class Answer:
    """An outcome with the results that belong to it."""

    outcome: Outcome
    files: dict[str, bytes] = field(default_factory=dict)


class Store:
    """An output folder that is ours while it is open."""

    def __init__(self, out: Path, hidden: Path) -> None:
        self.out, self.scratch, self._outcomes = out, hidden / "scratch", hidden / "outcomes"

    def outcome(self, name: str) -> Outcome | None:
        """How a task has ended, None where that is not known."""
        path = self._outcomes / f"{name}.json"
        with contextlib.suppress(OSError, ValueError):
            if path.stat().st_size <= _MOST_BYTES:
                found = Outcome.model_validate_json(path.read_bytes())
                return found if found.name == name else None
        return None

    def known(self, name: str) -> str:
        """Key of a task's result, "" where there is none or its files are not what they were."""
        found = self.outcome(name)
        if found is None or not found.key:
            return ""
        for file, digest in found.files.items():
            path = self.out / "rigs" / name / file
            try:
                if path.is_symlink() or file_sha256(path) != digest:
                    return ""
            except BadInputError:
                return ""
        return found.key

    def keep(self, answer: Answer) -> None:
        """Write a task's results, then its outcome."""
        outcome = answer.outcome
        place = self.out / "rigs" / outcome.name
        if place.is_symlink():
            raise BadInputError(f"{shown(place)}: is a symbolic link, expected a place in the output folder")
        path = self._outcomes / f"{outcome.name}.json"
        with contextlib.suppress(OSError):
            # What is about to be replaced must not count as a result any more.
            path.unlink()
        shutil.rmtree(place, ignore_errors=True)
        for name, data in answer.files.items():
            parts = PurePosixPath(name).parts
            if len(parts) > 2 or ".." in parts or name.startswith("/") or sha256(data) != outcome.files[name]:
                raise BadInputError(f"{outcome.name}: a worker has sent {name[:80]!r}, which is no result")
            make_folder((place / name).parent)
            write_atomically(place / name, data, durable=False)
        write_atomically(path, outcome.model_dump_json(indent=1) + "\n", durable=False)


@contextmanager
def opened_store(out: Path, verb: str, outputs: tuple[str, ...]) -> Iterator[tuple[Store, bool]]:
    """Make and lock an output folder; yields it, and whether the last run there was interrupted.

    Parameters
    ----------
    outputs : names of the files that will be written in it at the end.

    Raises `BadInputError` when it cannot be written or another process is at work there.
    """
    hidden = out / f".{verb.split()[-1]}"
    with opened(out, hidden, verb, ("rigs", *outputs), ("outcomes",), "scratch") as interrupted:
        for name in outputs:
            check_writable(out / name)
        yield Store(out, hidden), interrupted is not None
        shutil.rmtree(hidden / "scratch", ignore_errors=True)


# ----------------------------------------------------------------------
# All tasks: what still holds is left alone, all else is done.


def run_all(
    store: Store,
    processes: Processes,
    tasks: Iterable[Task],
    total: int,
    what: str,
    progress: Progress = lambda done, total: None,
    tell: Callable[[str], None] = lambda _: None,
) -> Counter[str]:
    """Run tasks that give an `Answer` and keep what comes of them; how many have ended with each status.

    `what` a task is, for sentences. A status of `SAME` was done before.

    Raises `BadInputError` as `run_tasks` and `Store.keep`.
    """
    counts = Counter[str]()
    progress(0, total)
    for task, result in run_tasks(processes, tasks):
        answer = Answer(_lost(task, result, what)) if isinstance(result, Failure) else result
        outcome = answer.outcome
        counts[outcome.status] += 1
        if outcome.status != SAME:
            store.keep(answer)
        if outcome.status not in (SAME, "ok"):
            tell(f"{outcome.name}: {outcome.status} ({outcome.sentence})")
        for sentence in outcome.left_out:
            tell(f"{outcome.name}: {sentence}")
        progress(counts.total(), total)
    return counts


def _lost(task: Task, failure: Failure, what: str) -> Outcome:
    sentence = {
        "died": "each process that tried it died: out of memory, or a fault in a library",
        "over": f"was not done after {task.limit_s:g} s, which is the --timeout of a {what}",
    }.get(failure.how) or end_of(failure.error or RuntimeError())[1]
    status = "broken" if failure.how == "raised" else "lost"
    return Outcome(name=task.name, status=status, code=EXIT_INTERNAL, sentence=sentence)


# ----------------------------------------------------------------------
# Rows as a table on the disk, and what each has taken in a file of its own: the same inputs give the same
# bytes in the table.


def arrow_table(rows: Iterable[Mapping[str, Any]], first: Sequence[str] = ()) -> Any:
    """Rows as an Arrow table, with nulls where a row has no such value; `first` are columns without rows."""
    import pyarrow as pa

    blocks, left = [pa.table({name: pa.array([], pa.null()) for name in first})], iter(rows)
    while block := list(islice(left, _BLOCK)):
        names = dict.fromkeys(name for row in block for name in row)
        blocks.append(pa.table({name: [row.get(name) for row in block] for name in names}))
    return pa.concat_tables(blocks, promote_options="permissive")


def typed(table: Any, names: Sequence[str], kinds: Mapping[str, str]) -> Any:
    """Some columns of a table as `kinds` says by name, all others as float64."""
    import pyarrow as pa

    fields = [(name, pa.type_for_alias(kinds.get(name, "float64"))) for name in names]
    return table.select(names).cast(pa.schema(fields))


def column(table: Any, name: str) -> FloatArray:
    """Numbers (n,) of a column, NaN for nulls and for a column that is not there."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table[name].to_numpy(), dtype=np.float64)


def texts(table: Any, name: str) -> list[str]:
    """Texts of a column, "" for nulls."""
    return [value or "" for value in table[name].to_pylist()]


def write_table(path: Path, table: Any) -> None:
    """Write a table as Parquet. Raises `BadInputError` when it cannot be written."""
    import pyarrow.parquet

    with replacing(path) as stream:
        pyarrow.parquet.write_table(table, stream, compression="zstd")


def write_timings(out: Path, head: str, rows: Iterable[Sequence[Any]]) -> None:
    """Write what each task has taken, as CSV. Raises `BadInputError` when it cannot be written."""
    lines = (",".join(map(str, row)) + "\n" for row in rows)
    write_atomically(out / TIMINGS, f"{head}\n{''.join(lines)}")

"""A sweep from its specification to a table: cases in bundles, each bundle kept as soon as it is done."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import one_line, sha256, write_atomically
from calib.fleet.cluster import Cluster
from calib.fleet.engine import LIMIT_S, Broken, Lost, Task, run_tasks
from calib.fleet.extra import needed
from calib.fleet.rows import Table, column, texts, write_table
from calib.fleet.store import HIDDEN, Store
from calib.fleet.sweepspec import Case, SweepSpec, cases
from calib.fleet.sweeptask import CaseResult, run_cases
from calib.fleet.task import program
from calib.fleet.worker import Overdue

__all__ = ["Point", "SweepSummary", "run_sweep", "summarise_sweep"]

BUNDLE = 8
_MOST_SHOWN = 10
_MOST_POINTS = 400

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Point:
    """A point of the grid, or a case where there is no grid: the first measure over its draws.

    Attributes
    ----------
    median : of the measure. worst : of its draws. loss : what points are ranked by, the less the better.
    """

    number: int
    values: tuple[tuple[str, Any], ...]
    median: float
    worst: float
    loss: float
    draws: int
    measures: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class SweepSummary:
    """All that is told of a sweep.

    Attributes
    ----------
    cases, failed, as_before : how many. why : the first failure's sentence.
    measure : that decides. measures : all of them.
    best, worst : points, by the median over the draws of the measure, or of its distance from `near`.
    clouds : of each parameter with numbers up to 400 pairs of its value and the measure.
    """

    cases: int
    failed: int
    as_before: int
    why: str
    measure: str
    measures: tuple[str, ...]
    best: tuple[Point, ...]
    worst: tuple[Point, ...]
    clouds: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]


def _digest(spec: SweepSpec) -> str:
    return sha256(json.dumps([program(), asdict(spec)], sort_keys=True, default=str).encode())


def _file(store: Store, bundle: int) -> Path:
    return store.out / HIDDEN / "outcomes" / f"bundle{bundle:07d}.json"


def _kept(store: Store, bundle: int, digest: str, final: bool = False) -> list[CaseResult] | None:
    """Results of a bundle; with `final` only where none of them came of the processes that did the work."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        told = json.loads(_file(store, bundle).read_text(encoding="utf-8"))
        if told["digest"] == digest and not (final and told["lost"]):
            return [CaseResult(**one) for one in told["results"]]
    return None


def _bundles(spec: SweepSpec) -> Iterator[tuple[int, tuple[Case, ...]]]:
    every, number = cases(spec), 0
    while bundle := tuple(islice(every, BUNDLE)):
        yield number, bundle
        number += 1


def run_sweep(
    store: Store,
    cluster: Cluster,
    spec: SweepSpec,
    retries: int,
    progress: Progress = lambda done, total: None,
    tell: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> int:
    """Run all bundles of cases that are not there, each case in `limit_s` seconds at most.

    A bundle that is lost, or overdue, is done again case by case: one of them may be at fault, and the others
    are not. Returns how many cases were there. Raises as `run_tasks`.
    """
    digest, scratch = _digest(spec), "" if cluster.address else str(store.scratch)
    before = done_now = 0
    apart: list[tuple[int, tuple[Case, ...]]] = []

    def task(some: tuple[Case, ...]) -> Task:
        return Task(f"{some[0].number}-{len(some)}", (spec.base, some, spec.seed, scratch))

    def tasks() -> Iterator[Task]:
        nonlocal before
        for number, bundle in _bundles(spec):
            if _kept(store, number, digest, final=True) is not None:
                before += len(bundle)
                continue
            yield task(bundle)

    def keep(number: int, results: list[CaseResult], lost: bool) -> None:
        nonlocal done_now
        told = {"digest": digest, "lost": lost, "results": [asdict(one) for one in results]}
        write_atomically(_file(store, number), json.dumps(told) + "\n")
        done_now += len(results)
        progress(before + done_now, spec.cases)

    def done(task: Task, result: Any) -> None:
        bundle, number = task.arguments[1], task.arguments[1][0].number // BUNDLE
        if isinstance(result, Lost | Overdue) and len(bundle) > 1:
            apart.append((number, bundle))
        else:
            keep(number, *_results(bundle, result))

    def one_by_one(number: int, bundle: tuple[Case, ...]) -> None:
        found: dict[int, CaseResult] = {}
        lost = False

        def one(task: Task, result: Any) -> None:
            nonlocal lost
            results, fault = _results(task.arguments[1], result)
            found[results[0].number] = results[0]
            lost = lost or fault

        alone = (task((case,)) for case in bundle)
        run_tasks(cluster, run_cases, alone, one, retries, limit_s, tell)
        keep(number, [found[case.number] for case in bundle], lost)

    progress(0, spec.cases)
    run_tasks(cluster, run_cases, tasks(), done, retries, BUNDLE * limit_s, tell)
    for number, bundle in apart:
        one_by_one(number, bundle)
    progress(spec.cases, spec.cases)
    return before


def _results(some: tuple[Case, ...], result: Any) -> tuple[list[CaseResult], bool]:
    """What came of some cases, and whether that was the processes' fault."""
    if isinstance(result, Overdue):
        words = f"was not done after {result.limit_s:g} s, which is the --timeout of a case"
    elif isinstance(result, Lost):
        words = "each process that tried it died"
    elif isinstance(result, Broken):
        words = result.words
    else:
        return result, False
    return [CaseResult(case.number, {}, words, 0.0) for case in some], True


def _rows(store: Store, spec: SweepSpec, measures: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    digest = _digest(spec)
    for number, bundle in _bundles(spec):
        results = {one.number: one for one in _kept(store, number, digest) or []}
        for case in bundle:
            one = results.get(case.number)
            row: dict[str, Any] = {"case": case.number, "point": case.point, "draw": case.draw}
            for name, value in case.values:
                row[name] = value if _numeric(spec, name) else str(value)
            found = {} if one is None else one.measures
            row |= {name: found.get(name) for name in measures}
            row["sentence"] = "was not run" if one is None else one_line(one.sentence)
            row["seconds"] = None if one is None else one.seconds
            yield row


def _numeric(spec: SweepSpec, name: str) -> bool:
    values = dict(spec.grid).get(name, (0.0,))
    return all(isinstance(value, float) for value in values)


def _measured(store: Store, spec: SweepSpec) -> tuple[str, ...]:
    """Names of all that was measured in any case; those asked for come first."""
    digest, found = _digest(spec), dict[str, None]()
    for number, _ in _bundles(spec):
        for one in _kept(store, number, digest) or []:
            found |= dict.fromkeys(one.measures)
    unknown = next((name for name in spec.measures if found and name not in found), None)
    if unknown is not None:
        raise BadInputError(
            f"measure: {one_line(unknown)} was not measured, expected some of {', '.join(found)}"
        )
    return spec.measures or tuple(found)


def summarise_sweep(store: Store, spec: SweepSpec, as_before: int) -> SweepSummary:
    """Write sweep.parquet and return the summary. Raises `BadInputError` for a measure that there is not."""
    pa = needed("pyarrow")
    measures = _measured(store, spec)
    fields = [pa.field(name, pa.int64()) for name in ("case", "point", "draw")]
    fields += [pa.field(name, pa.float64() if _numeric(spec, name) else pa.string()) for name in spec.names]
    fields += [pa.field(name, pa.float64()) for name in (*measures, "seconds")]
    fields.append(pa.field("sentence", pa.string()))
    path = store.out / "sweep.parquet"
    write_table(path, pa.schema(fields), _rows(store, spec, measures))
    with Table(path) as table:
        said = texts(table, "sentence")
        failed = [sentence for sentence in said if sentence]
        deciding = measures[0] if measures else ""
        y = column(table, deciding) if deciding else np.full(table.rows, np.nan)
        points = _points(table, spec, y, measures)
        ranked = sorted((p for p in points if math.isfinite(p.loss)), key=lambda p: p.loss)
        clouds = tuple((name, _cloud(column(table, name), y)) for name in spec.names if _numeric(spec, name))
    why = failed[0] if failed else ""
    best, worst = tuple(ranked[:_MOST_SHOWN]), tuple(reversed(ranked[_MOST_SHOWN:][-_MOST_SHOWN:]))
    return SweepSummary(spec.cases, len(failed), as_before, why, deciding, measures, best, worst, clouds)


def _points(table: Table, spec: SweepSpec, y: FloatArray, measures: tuple[str, ...]) -> list[Point]:
    """Points of the grid; the draws themselves where there is no grid."""
    by_point = bool(spec.grid)
    group = column(table, "point" if by_point else "case").astype(np.int64)
    others = {name: column(table, name) for name in measures}
    listed: dict[str, Any] = {
        name: column(table, name) if _numeric(spec, name) else texts(table, name) for name in spec.names
    }
    shown = [name for name, _ in spec.grid] if by_point else list(spec.names)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    loss = y if spec.near is None else np.abs(y - spec.near)
    out = []
    for first, rows in zip(starts.tolist(), np.split(order, starts[1:]), strict=True):
        i = int(order[first])
        medians = tuple((name, _median(values[rows])) for name, values in others.items())
        values = tuple((name, listed[name][i]) for name in shown)
        known = rows[np.isfinite(loss[rows])]
        worst = float(y[known[np.argmax(loss[known])]]) if len(known) else math.nan
        out.append(
            Point(int(group[i]), values, _median(y[rows]), worst, _median(loss[rows]), len(known), medians)
        )
    return out


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _cloud(x: FloatArray, y: FloatArray) -> tuple[tuple[float, float], ...]:
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(known) > _MOST_POINTS:
        known = np.random.default_rng(0).choice(known, _MOST_POINTS, replace=False)
    return tuple((float(x[i]), float(y[i])) for i in np.sort(known))

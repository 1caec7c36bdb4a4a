"""Many rigs: rows, spread, drift over serial numbers, outliers, results on the disk."""

from __future__ import annotations

import contextlib
import heapq
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import EXIT_INTERNAL, BadInputError
from calib.core.files import check_folder, check_writable, make_folder, sha256, shown, write_atomically
from calib.core.result import CovarianceTable
from calib.core.rig import Rig, read_rig, rig_text
from calib.runner.cache import held
from calib.runner.engine import LIMIT_S, Broken, Cluster, Lost, Overdue, Task, run_tasks
from calib.runner.folder import digest_of
from calib.runner.task import (
    SAME,
    Answer,
    FleetOptions,
    Manifest,
    Outcome,
    RigSpec,
    calibrate_rig,
    from_json,
    is_url,
    needed,
    serial_number,
    to_json,
    without_secrets,
)
from calib.show.values import unit_of
from calib.stages.camera.section import Camera

# ----------------------------------------------------------------------
# Outcomes as rows of a Parquet file, in blocks, and one column of it at a time.
#
# Columns: name, serial, source, kind, verdict, code, sentence, reasons, seconds, peak_MB, `verdict.STAGE`
# for
# each stage, `SECTION.NAME` and `SECTION.NAME.sigma` for each constant, and at last outlier_z and
# outlier_of,
# the constant that stands out most against the fleet. A rig without a number has a null there.

_TEXTS = ("name", "serial", "source", "kind", "verdict", "sentence", "reasons")
_BLOCK = 512
_MOST_COLUMNS = 4000


class Table:
    """A Parquet file that is read a column at a time."""

    def __init__(self, path: Path) -> None:
        self._file = needed("pyarrow.parquet").ParquetFile(path)
        self.rows = int(self._file.metadata.num_rows)
        self.names = tuple(str(name) for name in self._file.schema_arrow.names)

    def __enter__(self) -> Table:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, name: str) -> Any:
        """A column as an Arrow array."""
        return self._file.read(columns=[name]).column(0)

    def blocks(self) -> Iterator[Any]:
        """The rows in blocks."""
        yield from self._file.iter_batches(_BLOCK)


def column(table: Table, name: str) -> FloatArray:
    """Numbers (n,) of a column, NaN for nulls and for a column that is not there."""
    if name not in table.names:
        return np.full(table.rows, np.nan)
    return np.asarray(table.read(name).to_numpy(zero_copy_only=False), dtype=np.float64)


def texts(table: Table, name: str) -> list[str]:
    """Texts of a column, "" for nulls."""
    return [value or "" for value in table.read(name).to_pylist()]


def write_outcomes(path: Path, names: Sequence[str], outcome: Callable[[str], Outcome | None]) -> None:
    """Write a row for each name; `outcome` is asked twice for each, for the columns and for the rows.

    Raises `BadInputError` when the file cannot be written.
    """
    pa = needed("pyarrow")
    stages: dict[str, None] = {}
    values: dict[str, None] = {}
    for name in names:
        found = outcome(name)
        if found is not None and len(values) < _MOST_COLUMNS:
            stages |= dict.fromkeys(found.stages)
            values |= dict.fromkeys(found.values)
    fields = [pa.field(name, pa.string()) for name in _TEXTS]
    fields.insert(5, pa.field("code", pa.int16()))
    fields += [pa.field("seconds", pa.float64()), pa.field("peak_MB", pa.float64())]
    fields += [pa.field(f"verdict.{stage}", pa.string()) for stage in stages]
    for value in values:
        fields += [pa.field(value, pa.float64()), pa.field(f"{value}.sigma", pa.float64())]

    def rows() -> Iterator[dict[str, Any]]:
        for name in names:
            found = outcome(name)
            if found is not None:
                yield _row(found)

    write_table(path, pa.schema(fields), rows())


def _row(outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": outcome.name,
        "serial": outcome.serial,
        "source": outcome.source,
        "kind": outcome.kind,
        "verdict": outcome.status,
        "code": outcome.code,
        "sentence": outcome.sentence,
        "reasons": "\n".join(outcome.reasons),
        "seconds": outcome.seconds,
        "peak_MB": outcome.peak_MB,
    }
    row |= {f"verdict.{stage}": status for stage, status in outcome.stages.items()}
    for name, (value, sigma) in outcome.values.items():
        row[name], row[f"{name}.sigma"] = value, sigma
    return row


def write_table(path: Path, schema: Any, rows: Iterable[dict[str, Any]]) -> None:
    """Write rows in blocks; the file appears under its name when it is whole.

    Raises `BadInputError` when it cannot be written.
    """
    pa = needed("pyarrow")

    def blocks() -> Iterator[Any]:
        left = iter(rows)
        while block := list(islice(left, _BLOCK)):
            yield pa.RecordBatch.from_pylist(block, schema=schema)

    _write(path, schema, blocks())


def with_columns(source: Path, path: Path, added: dict[str, Any]) -> None:
    """Copy a table with columns added, each an Arrow array of as many rows, block by block."""
    pa = needed("pyarrow")
    with Table(source) as table:
        schema = table._file.schema_arrow
        for name, values in added.items():
            schema = schema.append(pa.field(name, values.type))

        def blocks() -> Iterator[Any]:
            at = 0
            for block in table.blocks():
                parts = [values.slice(at, block.num_rows) for values in added.values()]
                yield pa.RecordBatch.from_arrays([*block.columns, *parts], schema=schema)
                at += block.num_rows

        _write(path, schema, blocks())


def _write(path: Path, schema: Any, blocks: Iterator[Any]) -> None:
    between = path.with_name(f".{path.name}.tmp")
    try:
        with between.open("wb") as stream:
            with needed("pyarrow.parquet").ParquetWriter(stream, schema, compression="zstd") as writer:
                for block in blocks:
                    writer.write_batch(block)
            stream.flush()
            os.fsync(stream.fileno())
        between.replace(path)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            between.unlink()


# ----------------------------------------------------------------------
# How one constant is spread over a fleet, and which rigs stand out.
#
# With m the median and s = 1.4826 MAD of the values x_i, the spread between rigs is tau^2 = max(s^2 -
# median(sigma_i^2), 0), since the standard deviations sigma_i of the calibrations have widened s, and
#
#     z_i = (x_i - m) / sqrt(tau^2 + sigma_i^2)
#
# is what a rig is judged by: a value that is poorly known does not stand out by that alone. When more than
# half of the values are equal, s is 0 and 1.2533 times the mean absolute deviation takes its place
# (Iglewicz and Hoaglin 1993, 3.4).
#
# Of a fleet without outliers some z is large by chance. The limit is such that in n rigs times k constants
# one is beyond it with a probability of 5 %. The MAD is known from n rigs about as well as a standard
# deviation from 0.37 n (its efficiency, Rousseeuw and Croux 1993), hence Student's t of so many degrees.

FEWEST = 8
"""Fewer rigs say nothing about what is usual."""

_TO_SIGMA = 1.482602218505602
_MEAN_TO_SIGMA = 1.2533141373155001
_EFFICIENCY = 0.37
_CHANCE = 0.05
_LEAST_LIMIT = 3.5
_NOISE = 1e-12


@dataclass(frozen=True)
class Spread:
    """Of one constant over the rigs.

    Attributes
    ----------
    count : rigs that have it. median, low, high : and the least and greatest value.
    scale : robust standard deviation of the values. between : of it what the calibrations do not explain.
    own : median of the rigs' own standard deviations, NaN where none is known.
    """

    count: int
    median: float
    low: float
    high: float
    scale: float
    between: float
    own: float


def spread_of(x: FloatArray, sigma: FloatArray) -> Spread:
    """Spread of values (n,) with standard deviations (n,), NaN where not known."""
    known = np.isfinite(x)
    x, sigma = x[known], sigma[known]
    if len(x) == 0:
        nan = float("nan")
        return Spread(0, nan, nan, nan, nan, nan, nan)
    m = float(np.median(x))
    off = np.abs(x - m)
    s = _TO_SIGMA * float(np.median(off))
    if s <= _NOISE * abs(m):
        s = _MEAN_TO_SIGMA * float(off.mean())
    if s <= _NOISE * abs(m):
        s = 0.0
    bars = sigma[np.isfinite(sigma)]
    own = float(np.median(bars)) if len(bars) else float("nan")
    between = float(np.sqrt(max(s**2 - (own**2 if len(bars) else 0.0), 0.0)))
    return Spread(len(x), m, float(x.min()), float(x.max()), s, between, own)


def robust_z(x: FloatArray, sigma: FloatArray, spread: Spread) -> FloatArray:
    """z (n,) of values, NaN where there is none, 0 where nothing differs."""
    own = np.where(np.isfinite(sigma), sigma, 0.0)
    # Without a spread between rigs their own standard deviations alone are no measure: they may be zero.
    scale = np.sqrt(spread.between**2 + own**2)
    scale = np.where(scale > 0.0, scale, spread.scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (x - spread.median) / scale
    return np.where(np.isfinite(x), np.nan_to_num(z, nan=0.0, posinf=0.0, neginf=0.0), np.nan)


def limit_of(rigs: int, constants: int) -> float:
    """|z| beyond which a rig stands out."""
    from scipy.special import stdtrit

    degrees = max(_EFFICIENCY * (rigs - 1), 1.0)
    tail = 0.5 * _CHANCE / max(rigs * constants, 1)
    return max(_LEAST_LIMIT, -float(stdtrit(degrees, tail)))


# ----------------------------------------------------------------------
# Whether a constant drifts over the serial numbers of a fleet: a robust straight line with its sigma.
#
# x_i = a + b t_i + noise, with Huber's estimate: residuals beyond 1.345 standard deviations count as such
# of
# that size, so that rigs that stand out do not turn the line. With the residuals r_i over their own scales
# c_i = sqrt(tau^2 + sigma_i^2), psi Huber's function and psi' its derivative, the covariance of (a, b) is
#
#     s^2 K^2 [n / (n - 2) mean(psi^2) / mean(psi')^2] (X' X)^-1,    K = 1 + 2 / n (1 - mean(psi')) /
# mean(psi')
#
# with X the rows (1, t_i) / c_i (Huber and Ronchetti 2009, eqs. 7.83 and 7.84).

_HUBER = 1.345
_STEPS = 200
_DRIFT_CHANCE = 0.05
_DRIFT_TO_SIGMA = 1.482602218505602


@dataclass(frozen=True)
class Drift:
    """A line over the serial numbers.

    Attributes
    ----------
    slope, sigma : change of the constant per number. at_middle, middle : value there. count : rigs.
    """

    slope: float
    sigma: float
    at_middle: float
    middle: float
    count: int

    @property
    def z(self) -> float:
        """Slope over its standard deviation; 0 without one."""
        return self.slope / self.sigma if self.sigma > 0.0 else 0.0


def drift_of(serial: FloatArray, x: FloatArray, sigma: FloatArray, spread: Spread) -> Drift | None:
    """The line through values (n,) with standard deviations (n,) over numbers (n,), NaN where not known.

    None with too few rigs, or where serial numbers or values do not differ.
    """
    known = np.isfinite(serial) & np.isfinite(x)
    t, x, own = serial[known], x[known], np.nan_to_num(sigma[known])
    if len(x) < FEWEST or np.ptp(t) <= 0.0 or np.ptp(x) <= 0.0:
        return None
    middle = float(np.median(t))
    c = np.sqrt(spread.between**2 + own**2)
    usual = spread.scale if spread.scale > 0.0 else float(np.ptp(x))
    c = np.where(c > 1e-6 * usual, c, usual)
    # Numbers and values of order one: the sums keep their digits.
    reach = float(np.abs(t - middle).max())
    X = np.stack([np.ones_like(t), (t - middle) / reach], axis=1) / c[:, None]
    y = (x - spread.median) / c
    theta: FloatArray = np.zeros(2)
    s = _scale(y)
    for _ in range(_STEPS):
        r = y - X @ theta
        s = _scale(r)
        if s <= 0.0:
            break
        w = np.minimum(1.0, _HUBER * s / np.maximum(np.abs(r), 1e-300))
        new: FloatArray = np.asarray(
            np.linalg.lstsq(X * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0], dtype=np.float64
        )
        moved = float(np.abs((new - theta) * X.mean(axis=0)).max() / s)
        theta = new
        if moved < 1e-9:
            break
    covariance = _covariance(X, y - X @ theta, s)
    if covariance is None:
        return None
    return Drift(
        float(theta[1]) / reach,
        math.sqrt(covariance[1, 1]) / reach,
        float(theta[0]) + spread.median,
        middle,
        len(x),
    )


def _scale(r: FloatArray) -> float:
    """Robust standard deviation of residuals about zero; two of them are spent on the line."""
    ordered = np.sort(np.abs(r))
    return _DRIFT_TO_SIGMA * float(np.median(ordered[2:] if len(ordered) > 4 else ordered))


def _covariance(X: FloatArray, r: FloatArray, s: float) -> FloatArray | None:
    n = len(r)
    information = X.T @ X
    if s <= 0.0 or np.linalg.cond(information) > 1e12:
        return None
    u = r / s
    psi, slope = np.clip(u, -_HUBER, _HUBER), (np.abs(u) <= _HUBER).mean()
    if slope <= 0.0:
        return None
    K = 1.0 + 2.0 / n * (1.0 - slope) / slope
    variance = (s * K) ** 2 * (n / (n - 2) * float((psi**2).mean())) / slope**2
    return np.asarray(variance * np.linalg.inv(information))


def drift_limit(rigs: int, constants: int) -> float:
    """|slope| over its sigma beyond which a constant drifts, by chance in 5 % of all fleets."""
    from scipy.special import stdtrit

    return -float(stdtrit(max(rigs - 2, 1), 0.5 * _DRIFT_CHANCE / max(constants, 1)))


# ----------------------------------------------------------------------
# A fleet in a bounded number of figures: how its rigs ended, how its constants are spread, whom to look at.
#
# One column is in memory at a time, and of the rigs one number each.

_BINS = 36
_REACH = 6.0
"""Robust standard deviations that a histogram shows on each side of the median."""
_MOST_POINTS = 240
_MOST_LOOKS = 200
_MOST_STANDING_OUT = 20
_ORDER = {"broken": 0, "lost": 0, "failed": 1, "poor": 3, "ok": 4}
_MATRIX = re.compile(r"\[\d+\]\[\d+\]$")
_SETTINGS = ("image_size_px[", ".views", ".points", ".pictures", "lens.region_px[", "distance_m")


@dataclass(frozen=True)
class ConstantSummary:
    """One constant over the fleet.

    Attributes
    ----------
    counts : (bins,) of rigs from `low` to `high`; `below`, `above` : rigs outside of that.
    limit : |z| beyond which a rig stands out, NaN where there are too few to tell.
    out : the rigs that do, as (name, value, z), the farthest first, no more than twenty.
    standing_out : how many do.
    drift : None where there are no serial numbers. drifts : whether it is more than chance.
    points : (m, 2) serial numbers and values for a picture, thinned.
    """

    name: str
    unit: str
    spread: Spread
    low: float
    high: float
    counts: tuple[int, ...]
    below: int
    above: int
    limit: float
    standing_out: int
    out: tuple[tuple[str, float, float], ...]
    drift: Drift | None
    drifts: bool
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Look:
    """A rig to look at, and why."""

    name: str
    serial: str
    verdict: str
    why: str
    z: float | None


@dataclass(frozen=True)
class FleetSummary:
    """All that is told of a fleet.

    Attributes
    ----------
    verdicts : rigs by verdict. stages : of each stage the rigs by verdict.
    constants : in the order of the file. looks : the rigs to look at, the worst first, no more than 200.
    to_look_at : how many there are. seconds, longest_s, peak_MB : of all rigs, of one, of a process.
    numbered : rigs whose serial has a number. limit : |z| beyond which one stands out, NaN for too few rigs.
    """

    rigs: int
    verdicts: dict[str, int]
    stages: dict[str, dict[str, int]]
    constants: tuple[ConstantSummary, ...]
    looks: tuple[Look, ...]
    to_look_at: int
    seconds: float
    longest_s: float
    peak_MB: float
    numbered: int
    limit: float


def judged_names(names: tuple[str, ...]) -> list[str]:
    """Constants that rigs are compared by: not the elements of matrices, and not what a person has chosen."""
    given = set(names)
    return [
        name
        for name in names
        if f"{name}.sigma" in given
        and not _MATRIX.search(name)
        and not any(part in name for part in _SETTINGS)
    ]


def summarise(path: Path) -> tuple[FleetSummary, FloatArray, list[str | None]]:
    """The summary of a Parquet file, with the largest |z| (n,) of each rig and the constant that it is of."""
    with Table(path) as table:
        names = texts(table, "name")
        serials = texts(table, "serial")
        numbers = np.array([_or_nan(serial_number(serial)) for serial in serials], dtype=np.float64)
        wanted = judged_names(table.names)
        values = {name: None for name in wanted if _varies(column(table, name))}
        worst, of = np.full(table.rows, np.nan), np.full(table.rows, -1, dtype=np.int32)
        limit = limit_of(table.rows, len(values)) if table.rows >= FEWEST else float("nan")
        constants = []
        for index, name in enumerate(values):
            x, sigma = column(table, name), column(table, f"{name}.sigma")
            one, z = _constant(name, x, sigma, numbers, names, limit, len(values))
            constants.append(one)
            size = np.abs(z)
            larger = np.isfinite(size) & ~(size <= worst)
            worst[larger], of[larger] = size[larger], index
        listed = list(values)
        which = [listed[i] if i >= 0 else None for i in of.tolist()]
        verdicts = texts(table, "verdict")
        seconds, peak = column(table, "seconds"), column(table, "peak_MB")
        stages = {
            name.removeprefix("verdict."): dict(Counter(v for v in texts(table, name) if v))
            for name in table.names
            if name.startswith("verdict.")
        }
        looks, to_look_at = _looks(names, serials, verdicts, texts(table, "sentence"), worst, which, limit)
        summary = FleetSummary(
            table.rows,
            dict(sorted(Counter(verdicts).items(), key=lambda pair: _ORDER.get(pair[0], 2))),
            stages,
            tuple(constants),
            looks,
            to_look_at,
            float(np.nansum(seconds)),
            _largest(seconds),
            _largest(peak),
            int(np.isfinite(numbers).sum()),
            limit,
        )
    return summary, worst, which


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _largest(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else float("nan")


def _varies(values: FloatArray) -> bool:
    known = values[np.isfinite(values)]
    return len(known) > 0 and bool(known.max() > known.min() or len(known) == 1)


def _constant(
    name: str,
    x: FloatArray,
    sigma: FloatArray,
    numbers: FloatArray,
    names: list[str],
    limit: float,
    constants: int,
) -> tuple[ConstantSummary, FloatArray]:
    spread = spread_of(x, sigma)
    judged = spread.count >= FEWEST and limit == limit
    z = robust_z(x, sigma, spread) if judged else np.full(len(x), np.nan)
    size = np.where(np.isfinite(z), np.abs(z), 0.0)
    standing = np.flatnonzero(size > limit) if judged else np.zeros(0, dtype=np.int64)
    first = sorted(standing.tolist(), key=lambda i: -size[i])[:_MOST_STANDING_OUT]
    drift = drift_of(numbers, x, sigma, spread)
    low, high, counts, below, above = _histogram(x, spread)
    summary = ConstantSummary(
        name,
        unit_of(re.sub(r"\[\d+\]$", "", name)),
        spread,
        low,
        high,
        counts,
        below,
        above,
        limit if judged else float("nan"),
        len(standing),
        tuple((names[i], float(x[i]), float(z[i])) for i in first),
        drift,
        drift is not None and abs(drift.z) > drift_limit(drift.count, constants),
        _points(numbers, x) if drift is not None else (),
    )
    return summary, z


def _histogram(x: FloatArray, spread: Spread) -> tuple[float, float, tuple[int, ...], int, int]:
    """Bins around the median, so that one rig far off does not squeeze all others into one of them."""
    x = x[np.isfinite(x)]
    if len(x) == 0:
        return 0.0, 0.0, (), 0, 0
    least = max(1e-9 * abs(spread.median), 1e-12)
    reach = max(_REACH * spread.scale if spread.scale > 0.0 else spread.high - spread.low, least)
    low, high = max(spread.low, spread.median - reach), min(spread.high, spread.median + reach)
    if not high - low >= least:
        low, high = low - 0.5 * reach, high + 0.5 * reach
    counts, _ = np.histogram(x, bins=_BINS, range=(low, high))
    return low, high, tuple(counts.tolist()), int((x < low).sum()), int((x > high).sum())


def _points(numbers: FloatArray, x: FloatArray) -> tuple[tuple[float, float], ...]:
    """Values over serial numbers; of many, evenly spaced ones in the order of their numbers."""
    known = np.flatnonzero(np.isfinite(numbers) & np.isfinite(x))
    known = known[np.argsort(numbers[known], kind="stable")]
    if len(known) > _MOST_POINTS:
        known = known[np.linspace(0, len(known) - 1, _MOST_POINTS).astype(np.int64)]
    return tuple((float(numbers[i]), float(x[i])) for i in known)


def _looks(
    names: list[str],
    serials: list[str],
    verdicts: list[str],
    sentences: list[str],
    worst: FloatArray,
    which: list[str | None],
    limit: float,
) -> tuple[tuple[Look, ...], int]:
    heap: list[tuple[Any, ...]] = []
    total = 0
    for i, verdict in enumerate(verdicts):
        z = float(worst[i]) if np.isfinite(worst[i]) else None
        stands = z is not None and z > limit
        if verdict == "ok" and not stands:
            continue
        total += 1
        rank = min(_ORDER.get(verdict, 2), 2 if stands else 9)
        heap.append((rank, -(z or 0.0), i))
        if len(heap) > 4 * _MOST_LOOKS:
            heap = heapq.nsmallest(_MOST_LOOKS, heap)
    looks = []
    for _, _, i in heapq.nsmallest(_MOST_LOOKS, heap):
        z = float(worst[i]) if np.isfinite(worst[i]) else None
        why = [sentences[i]] if sentences[i] else []
        if z is not None and z > limit:
            why.append(f"{which[i]} is {z:.1f} standard deviations from the fleet's median")
        looks.append(Look(names[i], serials[i], verdicts[i], "; ".join(why), z))
    return tuple(looks), total


# ----------------------------------------------------------------------
# The output folder of a fleet: what is kept of each rig, and which of it still holds.
#
#     rigs/NAME/               results of a rig, as a single run leaves them
#     .fleet/outcomes/NAME.json    how it ended; written last, so that what it tells of is there
#     .fleet/lock              one fleet at a time
#     .fleet/scratch/          of a local cluster, gone at the end
#
# All is written by one process, the one that was started by a person: workers need not see this folder.

HIDDEN = ".fleet"
_MOST_BYTES = 5_000_000


class Store:
    """An output folder that is ours while it is open."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.scratch = out / HIDDEN / "scratch"

    def _file(self, name: str) -> Path:
        return self.out / HIDDEN / "outcomes" / f"{name}.json"

    def outcome(self, name: str) -> Outcome | None:
        """How a rig has ended, None where that is not known."""
        path = self._file(name)
        with contextlib.suppress(OSError, ValueError):
            if path.stat().st_size <= _MOST_BYTES:
                found = from_json(path.read_text(encoding="utf-8"))
                return found if found is not None and found.name == name else None
        return None

    def known(self, name: str) -> str:
        """Key of a rig's result, "" where there is none or its files are not what they were."""
        found = self.outcome(name)
        if found is None or not found.key:
            return ""
        for file, digest in found.files.items():
            path = self.out / "rigs" / name / file
            try:
                if path.is_symlink() or digest_of(path) != digest:
                    return ""
            except BadInputError:
                return ""
        return found.key

    def keep(self, answer: Answer) -> None:
        """Write a rig's results, then its outcome."""
        outcome = answer.outcome
        place = self.out / "rigs" / outcome.name
        if place.is_symlink():
            raise BadInputError(f"{shown(place)}: is a symbolic link, expected a place in the output folder")
        with contextlib.suppress(OSError):
            # What is about to be replaced must not count as a result any more.
            self._file(outcome.name).unlink()
        shutil.rmtree(place, ignore_errors=True)
        for name, data in answer.files.items():
            parts = PurePosixPath(name).parts
            if len(parts) > 2 or ".." in parts or name.startswith("/") or sha256(data) != outcome.files[name]:
                raise BadInputError(f"{outcome.name}: a worker has sent {name[:80]!r}, which is no result")
            make_folder((place / name).parent)
            write_atomically(place / name, data)
        write_atomically(self._file(outcome.name), to_json(outcome))

    def result(self, name: str, file: str) -> Path:
        """Path of one of a rig's results."""
        return self.out / "rigs" / name / file


def check_apart(out: Path, rigs: Iterable[RigSpec]) -> None:
    """Raise `BadInputError` where results would be written into a rig's folder, or over one."""
    place = Path(os.path.realpath(out))
    for rig in rigs:
        if is_url(rig.source):
            continue
        source = Path(os.path.realpath(rig.source))
        if place.is_relative_to(source):
            raise BadInputError(f"{shown(out)}: lies in the folder of {rig.name}, expected another one")
        if source.is_relative_to(place / "rigs") or source.is_relative_to(place / HIDDEN):
            raise BadInputError(
                f"{shown(rig.source)}: the folder of {rig.name} is where results are written, expected "
                "another output folder"
            )


@contextmanager
def opened_store(out: Path, verb: str, outputs: tuple[str, ...]) -> Iterator[tuple[Store, bool]]:
    """Make and lock an output folder; yields it, and whether the last run there was interrupted.

    Parameters
    ----------
    outputs : names of the files that will be written in it at the end.

    Raises `BadInputError` when it cannot be written or another process is at work there.
    """
    check_folder(out)
    hidden = out / HIDDEN
    for path in (hidden, out / "rigs", hidden / "outcomes", hidden / "scratch"):
        if path.is_symlink():
            raise BadInputError(f"{shown(path)}: is a symbolic link, expected a place in the output folder")
    if (out / "rigs").exists() and not hidden.exists():
        raise BadInputError(
            f"{shown(out / 'rigs')}: is there, and is not the work of {verb}; expected another output folder"
        )
    make_folder(hidden / "outcomes")
    for name in outputs:
        check_writable(out / name)
    with held(hidden / "lock", out, verb) as interrupted:
        told = hidden / "verb.json"
        before = _verb(told)
        if before not in ("", verb):
            raise BadInputError(f"{shown(out)}: holds the results of {before}, expected another folder")
        write_atomically(told, json.dumps({"verb": verb}) + "\n")
        for folder in (out, hidden / "outcomes", hidden):
            for left in folder.glob(".*.tmp"):
                with contextlib.suppress(OSError):
                    left.unlink()
        yield Store(out), interrupted is not None
        shutil.rmtree(hidden / "scratch", ignore_errors=True)


def _verb(path: Path) -> str:
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return str(json.loads(path.read_text(encoding="utf-8"))["verb"])
    return ""


# ----------------------------------------------------------------------
# What a fleet says of a rig that it has not seen: the distribution of its cameras, and what a rig borrows.
#
# The constants of rig i are theta_i ~ N(mu, T), its calibration gives x_i ~ N(theta_i, V_i). By the method
# of
# moments T = S - mean(V_i), with S the covariance of the x_i over the rigs, made positive semi-definite in
# the
# coordinates in which mean(V_i) is the identity; then mu by generalised least squares, C = (sum W_i)^-1 and
# W_i = (T + V_i)^-1 (DerSimonian and Laird 1986, for vectors Jackson, White and Thompson 2010). A new rig
# with
# x and V has, with P = T + D + C,
#
#     theta | x ~ N(mu + G (x - mu), P - G P),    G = P (P + V)^-1
#
# (Carlin and Louis 2000, 3.3). D is two standard errors of T, 2 lambda_j sqrt(2 / (n - 1)) for the
# eigenvalue
# lambda_j of S in those coordinates: a T that came out too small would make rigs too sure of themselves (by
# simulation the mean of e' Cov^-1 e is then 2.9 of 3 with 20 rigs, 2.7 with 200). A group needs more than
# two
# rigs for each constant. A rig for which (x - mu)' (P + V)^-1 (x - mu) is larger than chance is not one of
# this fleet, and does not borrow.

_BESIDE = 2
_SURE = 2.0
_PRIOR_CHANCE = 1e-3


@dataclass(frozen=True)
class Group:
    """Cameras of one lens model and picture size.

    Attributes
    ----------
    order : names of the k constants. mean : mu (k,). rigs : how many.
    between, slack, of_mean : T, D and C, each (k, k).
    """

    order: tuple[str, ...]
    mean: FloatArray
    between: FloatArray
    slack: FloatArray
    of_mean: FloatArray
    rigs: int


@dataclass(frozen=True)
class Posterior:
    """What a rig has after borrowing.

    Attributes
    ----------
    mean, covariance : (k,) and (k, k). chance : of a rig of this fleet to lie as far off or farther.
    """

    mean: FloatArray
    covariance: FloatArray
    chance: float

    @property
    def belongs(self) -> bool:
        """Whether the rig may be one of the fleet."""
        return self.chance >= _PRIOR_CHANCE


Kind = tuple[str, tuple[int, ...], tuple[str, ...]]


@dataclass(frozen=True)
class Prior:
    """A fleet as a prior.

    Attributes
    ----------
    groups : by model, picture size and names of the constants. members : fingerprints of its rigs' inputs.
    digest : SHA-256 of all of it. remarks : on what could not be used.
    """

    groups: dict[Kind, Group]
    members: frozenset[str]
    digest: str
    remarks: tuple[str, ...]


def constants_of(camera: Camera) -> tuple[Kind, FloatArray, FloatArray] | None:
    """Kind of a camera, its constants (k,) and their covariance (k, k); None without a covariance."""
    known = camera.covariance
    if known is None or not known.order:
        return None
    values = {**camera.model_dump(), **camera.distortion.model_dump()}
    order = tuple(known.order)
    if any(not isinstance(values.get(name), float) for name in order):
        return None
    V = np.array(known.values, dtype=np.float64)
    x = np.array([values[name] for name in order], dtype=np.float64)
    return (camera.model, tuple(camera.image_size_px), order), x, 0.5 * (V + V.T)


def fingerprint(rig: Rig) -> str:
    """SHA-256 of the pictures that a rig's camera was calibrated from; two of the same are one rig."""
    inputs = rig.provenance.inputs.get("camera", {})
    return sha256("\n".join(sorted(inputs.values())).encode())


def group_of(order: tuple[str, ...], x: FloatArray, V: FloatArray) -> Group | None:
    """The distribution behind rigs with constants (n, k) and covariances (n, k, k), None for too few."""
    n, k = x.shape
    if n < _BESIDE * k + 2:
        return None
    S, usual = np.atleast_2d(np.cov(x, rowvar=False)), V.mean(axis=0)
    scale = np.sqrt(np.diag(usual))
    try:
        L = scale[:, None] * np.linalg.cholesky(usual / scale / scale[:, None])
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.solve(L, np.linalg.solve(L, S).T)
    eigenvalues, Q = np.linalg.eigh(0.5 * (half + half.T))
    root = L @ Q
    T = (root * np.maximum(eigenvalues - 1.0, 0.0)) @ root.T
    D = (root * _SURE * np.maximum(eigenvalues, 0.0) * math.sqrt(2.0 / (n - 1))) @ root.T
    W = _inverse(T + V, scale)
    C = _inverse(W.sum(axis=0)[None] * scale * scale[:, None], np.ones(k))[0] * scale * scale[:, None]
    mu = C @ np.einsum("nij,nj->i", W, x)
    return Group(order, mu, T, D, 0.5 * (C + C.T), n)


def _inverse(A: FloatArray, scale: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, k, k), constants of very different size brought to one first."""
    normal = A / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(normal, hermitian=True) / scale / scale[:, None])


def posterior(group: Group, x: FloatArray, V: FloatArray) -> Posterior:
    """What follows for a rig with constants x (k,) and their covariance V (k, k)."""
    from scipy.special import chdtrc

    P = group.between + group.slack + group.of_mean
    scale = np.sqrt(np.diag(P + V))
    inverse = _inverse((P + V)[None], scale)[0]
    off = x - group.mean
    G = P @ inverse
    covariance = P - G @ P
    return Posterior(
        group.mean + G @ off,
        0.5 * (covariance + covariance.T),
        float(chdtrc(len(x), max(float(off @ inverse @ off), 0.0))),
    )


def read_prior(folder: Path) -> Prior:
    """The prior in the results of an earlier fleet: of its rigs that are ok and do not stand out.

    Raises `BadInputError` where there is no such fleet, or too few rigs of any kind.
    """
    path = folder / "fleet.parquet"
    if not path.is_file():
        raise BadInputError(f"{shown(folder)}: has no fleet.parquet, expected the results of calib fleet")
    try:
        with Table(path) as table:
            names, verdicts = texts(table, "name"), texts(table, "verdict")
            standing = table.read("stands_out").to_pylist()
    except (OSError, ValueError, KeyError) as error:
        raise BadInputError(f"{shown(path)}: is no table of a fleet: {error}") from error
    gathered: dict[Kind, list[tuple[FloatArray, FloatArray]]] = {}
    members: set[str] = set()
    for name, verdict, out in zip(names, verdicts, standing, strict=True):
        rig = read_rig(folder / "rigs" / name / "rig.yaml") if verdict in ("ok", "poor") else Rig()
        if rig.camera is None:
            continue
        members.add(fingerprint(rig))
        found = constants_of(rig.camera)
        if verdict == "ok" and rig.camera.verdict.ok and not out and found is not None:
            gathered.setdefault(found[0], []).append(found[1:])
    groups, remarks = {}, []
    for kind, rigs in gathered.items():
        made = group_of(kind[2], np.array([x for x, _ in rigs]), np.array([V for _, V in rigs]))
        if made is None:
            few = f"{len(rigs)} rigs with {kind[0]} are too few for {len(kind[2])} constants"
            remarks.append(f"{shown(folder)}: {few}; nothing is borrowed from them")
        else:
            groups[kind] = made
    if not groups:
        why = remarks[0] if remarks else f"{shown(folder)}: has no cameras that are ok"
        raise BadInputError(f"{why}; this fleet is no prior")
    digest = sha256("\n".join(sorted(members)).encode())
    return Prior(groups, frozenset(members), digest, tuple(remarks))


# ----------------------------------------------------------------------
# Rigs that borrow from a prior: each gets a camera-prior.yaml beside its own rig.yaml, which stays as it
# is.
#
# The verdict is the one that the rig's own pictures gave; what was borrowed is said in the file.

BORROWED = "camera-prior.yaml"
_MOST_NAMED = 50


@dataclass(frozen=True)
class Borrowing:
    """What came of a prior.

    Attributes
    ----------
    borrowed : rigs that did. shrunk : median over them of sigma after over sigma before, by constant.
    refused : rigs that did not, with the reason; no more than fifty of `not_borrowed`.
    fleet : rigs behind the prior.
    """

    borrowed: int
    shrunk: dict[str, float]
    refused: tuple[tuple[str, str], ...]
    not_borrowed: int
    fleet: int

    def as_json(self) -> dict[str, Any]:
        """For the document."""
        return {
            "rigs_of_the_prior": self.fleet,
            "borrowed": self.borrowed,
            "sigma_after_over_before": self.shrunk,
            "not_borrowed": self.not_borrowed,
            "refused": [{"name": name, "why": why} for name, why in self.refused],
        }

    def sentences(self) -> list[str]:
        """For people."""
        whole = self.borrowed + self.not_borrowed
        out = [
            f"{self.borrowed} of {whole} rigs borrowed from a prior of {self.fleet} rigs: {BORROWED} beside "
            "rig.yaml; verdicts are those without it"
        ]
        out += [f"{name} did not borrow: {why}" for name, why in self.refused[:5]]
        return out


def borrowed_camera(camera: Camera, group: Group, found: Posterior) -> Camera:
    """A camera with what it has after borrowing; what its own fit said of it stays, and it says so."""
    values = dict(zip(group.order, found.mean.tolist(), strict=True))
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    lens = {name: value for name, value in values.items() if name in type(camera.distortion).model_fields}
    others = {name: value for name, value in values.items() if name not in lens}
    remark = (
        f"Borrowed: these constants are shrunk to the distribution of {group.rigs} rigs of a fleet "
        "(empirical Bayes) and are not those of this rig's pictures alone; RMS, verdict and reasons are of "
        "the fit without it."
    )
    return camera.model_copy(
        update={
            **others,
            "distortion": camera.distortion.model_copy(update=lens),
            "sigma": {**camera.sigma, **dict(zip(group.order, sigma.tolist(), strict=True))},
            "covariance": CovarianceTable(order=list(group.order), values=found.covariance.tolist()),
            "projection_sigma_px": {},
            "remarks_": [*camera.verdict.remarks, remark],
        }
    )


def borrow(store: Store, manifest: Manifest, prior: Prior) -> Borrowing:
    """Write a `BORROWED` for each rig that may have one, and remove one that it may not have any more."""
    refused: list[tuple[str, str]] = []
    ratios: dict[str, list[float]] = {}
    borrowed = not_borrowed = 0
    for spec in manifest.rigs:
        why = _borrow(store, spec.name, prior, ratios)
        if not why:
            borrowed += 1
            continue
        not_borrowed += 1
        store.result(spec.name, BORROWED).unlink(missing_ok=True)
        if len(refused) < _MOST_NAMED:
            refused.append((spec.name, why))
    shrunk = {name: float(np.median(values)) for name, values in ratios.items()}
    rigs = sum(group.rigs for group in prior.groups.values())
    return Borrowing(borrowed, shrunk, tuple(refused), not_borrowed, rigs)


def _borrow(store: Store, name: str, prior: Prior, ratios: dict[str, list[float]]) -> str:
    """Why a rig does not borrow, "" when it has."""
    outcome = store.outcome(name)
    if outcome is None or "rig.yaml" not in outcome.files:
        return "it has no result"
    rig = read_rig(store.result(name, "rig.yaml"))
    if rig.camera is None:
        return "it has no camera"
    if fingerprint(rig) in prior.members:
        return "it is itself one of the prior's rigs"
    found = constants_of(rig.camera)
    if found is None:
        return "its camera has no covariance"
    kind, x, V = found
    group = prior.groups.get(kind)
    if group is None:
        size = "x".join(str(side) for side in kind[1])
        return f"the prior has no rigs enough with {kind[0]} and pictures of {size} px"
    after = posterior(group, x, V)
    if not after.belongs:
        return f"it is not like the prior's rigs (a chance of {after.chance:.1e})"
    camera = borrowed_camera(rig.camera, group, after)
    inputs = {"camera": {**rig.provenance.inputs.get("camera", {}), "fleet prior": prior.digest}}
    provenance = rig.provenance.model_copy(update={"inputs": inputs})
    text = rig_text(Rig(geometry=rig.geometry, camera=camera, provenance=provenance))
    write_atomically(store.result(name, BORROWED), text)
    for i, constant in enumerate(group.order):
        if V[i, i] > 0.0:
            ratios.setdefault(constant, []).append(
                math.sqrt(max(float(after.covariance[i, i]), 0.0) / float(V[i, i]))
            )
    return ""


# ----------------------------------------------------------------------
# A fleet from its manifest to its outcomes: what still holds is left alone, all else is done.

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

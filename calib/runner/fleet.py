"""A fleet: rows of its rigs, spread and drift of their constants, who stands out."""

from __future__ import annotations

import heapq
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.plot import every
from calib.core.units import unit_of
from calib.core.workers import Processes, Task
from calib.runner.outcomes import (
    LIMIT_S,
    Outcome,
    Progress,
    Store,
    arrow_table,
    column,
    run_all,
    texts,
    typed,
    write_table,
    write_timings,
)
from calib.runner.rigs import (
    FleetOptions,
    Manifest,
    RigSpec,
    calibrate_rig,
    is_url,
    serial_number,
    without_secrets,
)

# ----------------------------------------------------------------------
# A fleet from its manifest to its outcomes: what still holds is left alone, all else is done.


def run_fleet(
    store: Store,
    processes: Processes,
    manifest: Manifest,
    options: FleetOptions,
    progress: Progress = lambda done, total: None,
    tell: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> Counter[str]:
    """Run all rigs whose results are not there, each in `limit_s` seconds at most. Raises as `run_all`."""
    tasks = (
        Task(spec.name, calibrate_rig, (spec, options, store.known(spec.name)), limit_s)
        for spec in manifest.rigs
    )
    return run_all(store, processes, tasks, len(manifest.rigs), "rig", progress, tell)


def check_apart(out: Path, rigs: Iterable[RigSpec]) -> None:
    """Raise `BadInputError` where results would be written into a rig's folder, or over one."""
    place = Path(os.path.realpath(out))
    for rig in rigs:
        if is_url(rig.source):
            continue
        source = Path(os.path.realpath(rig.source))
        if place.is_relative_to(source):
            raise BadInputError(f"{shown(out)}: lies in the folder of {rig.name}, expected another one")
        if source.is_relative_to(place / "rigs") or source.is_relative_to(place / ".fleet"):
            raise BadInputError(
                f"{shown(rig.source)}: the folder of {rig.name} is where results are written, expected "
                "another output folder"
            )


def finish(store: Store, manifest: Manifest) -> FleetSummary:
    """Write fleet.parquet and the timings, and return the summary.

    Raises `BadInputError` when a file cannot be written.
    """
    import pyarrow as pa

    times: list[tuple[str, float, float | None]] = []

    def kept() -> Iterator[tuple[RigSpec, Outcome]]:
        for rig in manifest.rigs:
            if (found := store.outcome(rig.name)) is not None:
                times.append((found.name, found.seconds, found.peak_MB))
                yield rig, found

    table = table_of(kept())
    write_timings(store.out, "name,seconds,peak_MB", times)
    summary, worst, which = summarise(table)
    known = np.isfinite(worst)
    table = table.append_column("outlier_z", pa.array(worst, mask=~known))
    table = table.append_column("outlier_of", pa.array(which, type=pa.string()))
    table = table.append_column("stands_out", pa.array(known & (worst > summary.limit)))
    write_table(store.out / "fleet.parquet", table)
    return summary


# Columns: name, serial, source, kind, verdict, code, sentence, reasons, `verdict.STAGE` for each stage,
# `SECTION.NAME` and `SECTION.NAME.sigma` for each constant, and at last outlier_z and outlier_of, the
# constant that stands out most against the fleet. A rig without a number has a null there.

_FIRST = ("name", "serial", "source", "kind", "verdict", "code", "sentence", "reasons")
_MOST_COLUMNS = 8000


def table_of(rigs: Iterable[tuple[RigSpec, Outcome]]) -> Any:
    """Rigs with their outcomes as an Arrow table, a row for each."""
    whole = arrow_table((_row_of(rig, outcome) for rig, outcome in rigs), _FIRST)
    verdicts = [name for name in whole.column_names if name.startswith("verdict.")]
    constants = [name for name in whole.column_names if name not in (*_FIRST, *verdicts)]
    kinds = dict.fromkeys([*_FIRST, *verdicts], "string") | {"code": "int16"}
    return typed(whole, [*_FIRST, *verdicts, *constants[:_MOST_COLUMNS]], kinds)


def _row_of(rig: RigSpec, outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": rig.name,
        "serial": rig.serial,
        "source": without_secrets(rig.source),
        "kind": outcome.kind,
        "verdict": outcome.status,
        "code": outcome.code,
        "sentence": outcome.sentence,
        "reasons": "\n".join(outcome.reasons),
    }
    row |= {f"verdict.{stage}": status for stage, status in outcome.stages.items()}
    for name, (value, sigma) in outcome.values.items():
        row[name], row[f"{name}.sigma"] = value, sigma
    return row


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
    to_look_at : how many there are.
    numbered : rigs whose serial has a number. limit : |z| beyond which one stands out, NaN for too few rigs.
    """

    rigs: int
    verdicts: dict[str, int]
    stages: dict[str, dict[str, int]]
    constants: tuple[ConstantSummary, ...]
    looks: tuple[Look, ...]
    to_look_at: int
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


def summarise(table: Any) -> tuple[FleetSummary, FloatArray, list[str | None]]:
    """The summary of a table, with the largest |z| (n,) of each rig and the constant that it is of."""
    names, serials, verdicts = (texts(table, name) for name in ("name", "serial", "verdict"))
    numbers = np.array([_or_nan(serial_number(serial)) for serial in serials], dtype=np.float64)
    wanted = judged_names(tuple(table.column_names))
    listed = [name for name in wanted if _varies(column(table, name))]
    rigs = len(names)
    worst, of = np.full(rigs, np.nan), np.full(rigs, -1, dtype=np.int32)
    limit = limit_of(rigs, len(listed)) if rigs >= FEWEST else float("nan")
    constants = []
    for index, name in enumerate(listed):
        x, sigma = column(table, name), column(table, f"{name}.sigma")
        one, z = _constant(name, x, sigma, numbers, names, limit, len(listed))
        constants.append(one)
        size = np.abs(z)
        larger = np.isfinite(size) & ~(size <= worst)
        worst[larger], of[larger] = size[larger], index
    which = [listed[i] if i >= 0 else None for i in of.tolist()]
    stages = {
        name.removeprefix("verdict."): dict(Counter(v for v in texts(table, name) if v))
        for name in table.column_names
        if name.startswith("verdict.")
    }
    looks, to_look_at = _looks(names, serials, verdicts, texts(table, "sentence"), worst, which, limit)
    summary = FleetSummary(
        rigs,
        dict(sorted(Counter(verdicts).items(), key=lambda pair: _ORDER.get(pair[0], 2))),
        stages,
        tuple(constants),
        looks,
        to_look_at,
        int(np.isfinite(numbers).sum()),
        limit,
    )
    return summary, worst, which


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


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
    known = every(known, _MOST_POINTS)
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
    ranked = []
    for i, verdict in enumerate(verdicts):
        size = float(np.nan_to_num(worst[i]))
        if verdict != "ok" or size > limit:
            ranked.append((min(_ORDER.get(verdict, 2), 2 if size > limit else 9), -size, i))
    looks = []
    for _, _, i in heapq.nsmallest(_MOST_LOOKS, ranked):
        z = float(worst[i]) if np.isfinite(worst[i]) else None
        why = [sentences[i]] if sentences[i] else []
        if z is not None and z > limit:
            why.append(f"{which[i]} is {z:.1f} standard deviations from the fleet's median")
        looks.append(Look(names[i], serials[i], verdicts[i], "; ".join(why), z))
    return tuple(looks), len(ranked)

"""A fleet in a bounded number of figures: how its rigs ended, how its constants are spread, whom to look at.

One column is in memory at a time, and of the rigs one number each.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import FloatArray
from calib.fleet.drift import Drift, drift_limit, drift_of
from calib.fleet.manifest import serial_number
from calib.fleet.rows import Table, column, texts
from calib.fleet.spread import FEWEST, Spread, limit_of, robust_z, spread_of
from calib.rigvalues import unit_of

__all__ = ["ConstantSummary", "FleetSummary", "Look", "judged_names", "summarise"]

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

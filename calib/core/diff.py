"""Two calibrations side by side: which constants differ, by how many standard deviations, and by how much
in millimetres on the plane.

A difference is judged against the standard deviations of both, taken as independent. Two calibrations from
the same pictures share their errors, so that there the real significance is larger than what is said.

On the plane the whole chain is compared: points of the workspace are put into the picture by one
calibration and read by the other. Its standard deviation is that of both calibrations, without that of
whole pixels, which is no property of a calibration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.constants import Constant, constants
from calib.core.geometry import box_grid
from calib.core.result import OF_VERDICT
from calib.core.words import Block, InWords, Line, Table, number, several

Sections = Mapping[str, Mapping[str, Any]]

SIGNIFICANT = 3.0
"""Standard deviations from which on a difference is called significant."""
_SAME = 1e-12
_NOT_LEARNT = ("views", "points", "rms_px", "mean_error_px", "rms_mm", "pictures")
_EVIDENCE = ("log.", "sigma_", "projection_sigma_", "drift.", "anti_windup.")
"""Keys, and beginnings of keys, that describe a calibration and are no constants."""
_SIZE = "image_size_px"
_GRID = (13, 9)


@dataclass(frozen=True)
class Change:
    """A constant in two calibrations; a side that lacks it is None.

    Attributes
    ----------
    sigmas : difference over the standard deviation of the difference, None where that is not known.
    significant : whether that is much.
    """

    section: str
    name: str
    unit: str
    before: float | None
    after: float | None
    sigma: float | None = None
    sigmas: float | None = None
    significant: bool | None = None


@dataclass(frozen=True)
class PlaneChange:
    """Differences of position over the workspace: mean, largest, and their standard deviation, mm.

    `significant` says whether the largest is, None where no standard deviation does.
    """

    mean_mm: float
    largest_mm: float
    at_m: tuple[float, float]
    sigma_mm: float | None
    significant: bool | None


_SHOWN = 20
"""Constants, and names in a sentence, that the words tell unless asked for all."""


@dataclass(frozen=True, repr=False)
class RigDiff(InWords):
    """All that differs between two calibrations.

    Attributes
    ----------
    changes : constants that differ, by significance; those of one side only come last.
    pictures_px : width and height of both cameras' pictures, where they differ.
    plane : None where a side has no camera or plane, or the pictures differ in size.
    verdicts : "section", verdict "before" and "after", where they differ.
    only_before, only_after : sections of one side.
    others : keys by section that differ and hold no constants: choices, deviations, evidence.
    other_inputs : sections learnt from other inputs.
    compared : how many constants both have.
    significant : whether anything has changed by more than its standard deviation explains.
    """

    changes: tuple[Change, ...]
    pictures_px: tuple[tuple[int, ...], tuple[int, ...]] | None
    plane: PlaneChange | None
    verdicts: tuple[dict[str, str], ...]
    only_before: tuple[str, ...]
    only_after: tuple[str, ...]
    others: dict[str, tuple[str, ...]]
    other_inputs: tuple[str, ...]
    compared: int
    significant: bool

    def blocks(self, every: bool = False) -> Iterator[Block]:
        """In words: the foremost constants that differ, or every one."""
        both = [c for c in self.changes if c.before is not None and c.after is not None]
        yield Line(f"{self.compared} constants are in both, {len(both)} of them differ")
        rows = [_row(change) for change in (both if every else both[:_SHOWN])]
        if rows:
            yield Table(("constant", "before", "after", "difference", "unit", "in sigma", ""), tuple(rows))
        if len(rows) < len(both):
            yield Line(f"  {len(both) - len(rows)} more (--all shows them)")
        alone = [
            c
            for c in self.changes
            if c.section.partition(".")[0] not in (*self.only_before, *self.only_after)
        ]
        for words, names in (
            (
                "only before",
                [*self.only_before, *(f"{c.section}.{c.name}" for c in alone if c.after is None)],
            ),
            ("only after", [*self.only_after, *(f"{c.section}.{c.name}" for c in alone if c.before is None)]),
            ("also different", [f"{section} ({', '.join(keys)})" for section, keys in self.others.items()]),
            ("learnt from other inputs", self.other_inputs),
        ):
            if names:
                yield Line(f"{words}: {several(names, len(names) if every else _SHOWN)}")
        for one in self.verdicts:
            yield Line("verdict of {section}: {before} before, {after} after".format(**one))
        plane = self.plane
        if self.pictures_px is not None:
            before, after = ("x".join(map(str, size)) for size in self.pictures_px)
            yield Line(
                f"the cameras have pictures of two sizes, {before} px before and {after} px after: "
                "their pixels are not compared, so that there is no difference in millimetres"
            )
        elif plane is None:
            yield Line(
                "no plane in both, or none of the workspace in the picture: no difference in millimetres"
            )
        else:
            bar = "" if not plane.sigma_mm else f", sigma {plane.sigma_mm:.4f} mm"
            yield Line(
                f"a marker in the workspace is read {plane.mean_mm:.4f} mm elsewhere on average, "
                f"{plane.largest_mm:.4f} mm at most{bar}: {_judged(plane.significant)}"
            )
        bare = sum(change.significant is None for change in both)
        also = f"; {bare} without error bars differ{'s' * (bare == 1)}" if bare else ""
        yield Line(f"in all: {'significant' if self.significant else 'nothing beyond the error bars'}{also}")


def _row(change: Change) -> tuple[str, ...]:
    assert change.before is not None and change.after is not None
    return (
        f"{change.section}.{change.name}",
        number(change.before, change.sigma),
        number(change.after, change.sigma),
        f"{change.after - change.before:+.3g}",
        change.unit,
        "-" if change.sigmas is None else f"{change.sigmas:.1f}",
        _judged(change.significant),
    )


def _judged(significant: bool | None) -> str:
    return "no error bars" if significant is None else "significant" if significant else "not significant"


def compared(a: Sections, b: Sections, plane: PlaneChange | None) -> RigDiff:
    """Compare two rigs by the plain values of their files; `plane` is what differs there."""
    inputs = [one.get("provenance", {}).get("inputs", {}) for one in (a, b)]
    a, b = ({name: values for name, values in one.items() if name != "provenance"} for one in (a, b))
    left, right = _by_name(a), _by_name(b)
    changes = [_change(left.get(key), right.get(key)) for key in dict.fromkeys([*left, *right])]
    differ = [change for change in changes if change is not None]
    differ.sort(key=lambda c: (c.before is None or c.after is None, -_rank(c)))
    sizes = [tuple(one.get("camera", {}).get(_SIZE, ())) for one in (a, b)]
    verdicts = [
        {"section": name, "before": str(one.get("verdict", "-")), "after": str(b[name].get("verdict", "-"))}
        for name, one in a.items()
        if name in b and one.get("verdict") != b[name].get("verdict")
    ]
    return RigDiff(
        tuple(differ),
        (sizes[0], sizes[1]) if all(sizes) and sizes[0] != sizes[1] else None,
        plane,
        tuple(verdicts),
        tuple(name for name in a if name not in b),
        tuple(name for name in b if name not in a),
        _others(a, b, {f"{section}.{name}" for section, name in left.keys() | right.keys()}),
        tuple(name for name, one in inputs[0].items() if name in inputs[1] and inputs[1][name] != one),
        len(left.keys() & right.keys()),
        any(one.significant for one in (*differ, plane) if one is not None),
    )


def _rank(change: Change) -> float:
    return math.inf if change.significant and change.sigmas is None else change.sigmas or 0.0


def _by_name(sections: Mapping[str, Any]) -> dict[tuple[str, str], Constant]:
    return {
        (c.section, c.name): c
        for c in constants(sections)
        if c.name not in _NOT_LEARNT and not c.name.startswith(_EVIDENCE)
    }


def _others(a: Mapping[str, Any], b: Mapping[str, Any], compared: set[str]) -> dict[str, tuple[str, ...]]:
    """Keys of sections on both sides below which something else than the constants `compared` differs."""
    out: dict[str, tuple[str, ...]] = {}
    for section in (name for name in a if name in b):
        here, there = dict(_leaves(a[section], section)), dict(_leaves(b[section], section))
        differ = [
            leaf for leaf in dict.fromkeys([*here, *there])
            if leaf not in compared and here.get(leaf, _NONE) != there.get(leaf, _NONE)
        ]  # fmt: skip
        keys = dict.fromkeys(re.split(r"[.[]", leaf)[1] for leaf in differ)
        if found := tuple(key for key in keys if key not in OF_VERDICT):
            out[section] = found
    return out


_NONE = object()


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Single values with the names that constants have."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _leaves(part, f"{name}.{key}")
    elif isinstance(value, list):
        for i, part in enumerate(value):
            yield from _leaves(part, f"{name}[{i}]")
    else:
        yield name, value


def _change(before: Constant | None, after: Constant | None) -> Change | None:
    one = before or after
    assert one is not None
    if before is None or after is None:
        old, new = (None if side is None else side.value for side in (before, after))
        return Change(one.section, one.name, one.unit, old, new)
    difference = abs(after.value - before.value)
    if difference <= _SAME * max(abs(before.value), abs(after.value)):
        return None
    known = before.sigma is not None and after.sigma is not None
    sigma = math.hypot(before.sigma or 0.0, after.sigma or 0.0) if known else None
    sigmas = difference / sigma if sigma else None
    significant = None if sigmas is None else sigmas >= SIGNIFICANT
    if one.name.startswith(_SIZE):
        # Counted, not estimated: it needs no error bar.
        significant = True
    return Change(one.section, one.name, one.unit, before.value, after.value, sigma, sigmas, significant)


def plane_change(
    to_pixels: Callable[[FloatArray], FloatArray],
    to_world: Callable[[FloatArray], FloatArray],
    workspace_m: Sequence[float],
    sigmas_mm: Sequence[float | None],
) -> PlaneChange | None:
    """What differs on the plane; None where nothing of the workspace is seen.

    Parameters
    ----------
    to_pixels : of one calibration, from places (n, 2) in metres. to_world : of the other, back.
    workspace_m : least x, least y, greatest x, greatest y. sigmas_mm : of both calibrations, None where not
        known.
    """
    world = grid_m(workspace_m).reshape(-1, 2)
    apart = 1e3 * np.linalg.norm(to_world(to_pixels(world)) - world, axis=1)
    if not np.isfinite(apart).any():
        return None
    worst = int(np.nanargmax(apart))
    known = [bar for bar in sigmas_mm if bar is not None]
    sigma = math.hypot(*known) if len(known) == 2 else None
    at = (float(world[worst, 0]), float(world[worst, 1]))
    largest = float(apart[worst])
    significant = largest >= SIGNIFICANT * sigma if sigma else None
    return PlaneChange(float(np.nanmean(apart)), largest, at, sigma, significant)


def grid_m(workspace_m: Sequence[float]) -> FloatArray:
    """Places (rows, columns, 2) at which the plane is compared."""
    return box_grid(workspace_m, *_GRID)

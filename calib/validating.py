"""Model against log: what a model shows from a log's commands and start alone, beside what was measured.

The commands are played to the plant and the pumps from the head's measured start; nothing is fitted on
the way. Errors are measured less simulated, of q1, q2 and phi, and of each

    norm   the un-normalised L2 norm over the rows, as in Table 3.3; it grows with their number
    RMS    the norm over the square root of the number of rows
    fit    100 (1 - norm / norm of the measured values about their mean) in percent

Two models are compared: the original one, with its nominal parameters, and the improved one, with those
of the sections `actuator` and `pump`. Rows that stand away from their neighbours are replaced by them
first, as single wrong pictures would decide over an L2 norm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.actuator.identify_decrement import without_outliers
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_tracks import Track, heads_of
from calib.actuatorsections import nominal_of
from calib.arrays import FloatArray
from calib.identifying import TrackSource, read_track
from calib.rig import Rig

__all__ = [
    "IMPROVED",
    "ORIGINAL",
    "QUANTITIES",
    "Comparison",
    "Error",
    "compare",
    "errors_of",
    "models_of",
    "validate_log",
]

ORIGINAL, IMPROVED = "original", "improved"

QUANTITIES = ("q1", "q2", "phi")
"""What errors are told of: two lengths in metres and an angle in radians."""


@dataclass(frozen=True)
class Error:
    """Error of one quantity [m or rad]; NaN where the model's motion ends before the log does."""

    norm: float
    rms: float
    fit_percent: float


@dataclass(frozen=True)
class Comparison:
    """One log and what the models show in its place.

    Attributes
    ----------
    name, how : the log, and where its pose comes from: "pictures", "states" or "truth".
    hoses : whether the pumps are connected. replaced : rows that stood away from their neighbours.
    t_s : (n,) times. measured : (n, 3) q1, q2 [m] and phi [rad].
    simulated : the same of each model. errors : of each model by quantity.
    """

    name: str
    how: str
    hoses: bool
    replaced: int
    t_s: FloatArray
    measured: FloatArray
    simulated: Mapping[str, FloatArray]
    errors: Mapping[str, Mapping[str, Error]]

    def improvement_percent(self, quantity: str) -> float | None:
        """By how much the improved model's norm is smaller; None without that model."""
        if IMPROVED not in self.errors:
            return None
        before = self.errors[ORIGINAL][quantity].norm
        after = self.errors[IMPROVED][quantity].norm
        return 100.0 * (1.0 - after / before) if before > 0.0 else math.nan


def errors_of(measured: FloatArray, simulated: FloatArray) -> dict[str, Error]:
    """Errors of the columns (n, 3) by quantity."""
    norms = np.linalg.norm(measured - simulated, axis=0)
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    share = np.divide(norms, spread, out=np.full(norms.shape, np.nan), where=spread > 0.0)
    values = zip(norms.tolist(), (norms / math.sqrt(len(measured))).tolist(), share.tolist(), strict=True)
    return {
        name: Error(norm, rms, 100.0 * (1.0 - part))
        for name, (norm, rms, part) in zip(QUANTITIES, values, strict=True)
    }


def _columns(head: FloatArray, bellows_radius_m: float) -> FloatArray:
    """q1, q2 and phi (n, 3) of angle and length (n, 2)."""
    turned = bellows_radius_m * head[:, 0]
    return np.column_stack([head[:, 1] + turned, head[:, 1] - turned, head[:, 0]])


def _cleaned(track: Track) -> tuple[Track, int]:
    """The track with single wrong rows replaced by what is around them, and how many."""
    head, wrong = track.head.copy(), np.zeros(len(track.head), dtype=np.bool_)
    for column in range(2):
        head[:, column], _ = without_outliers(track.head[:, column])
        wrong |= head[:, column] != track.head[:, column]
    return replace(track, head=head), int(wrong.sum())


def compare(source: TrackSource, models: Mapping[str, Nominal], bellows_radius_m: float) -> Comparison:
    """A log against models by name, each simulated from the log's start.

    Parameters
    ----------
    bellows_radius_m : that measured angles and lengths become bellows with.
    """
    track, replaced = _cleaned(source.track)
    measured = _columns(track.head, bellows_radius_m)
    simulated = {}
    for name, nominal in models.items():
        head, _ = heads_of(track, nominal, [{}], [track.start], source.delay_s, threads=1)
        simulated[name] = _columns(head[0], nominal.plant.bellows_radius_m)
    errors = {name: errors_of(measured, curves) for name, curves in simulated.items()}
    return Comparison(
        track.name, source.source, track.hoses, replaced, track.t_s, measured, simulated, errors
    )


def models_of(rig: Rig, rig_path: Path) -> dict[str, Nominal]:
    """The original model, and the improved one where the file has a section actuator or pump."""
    models = {ORIGINAL: Nominal()}
    extra = rig.model_extra or {}
    if any(getattr(rig, name, None) is not None or name in extra for name in ("actuator", "pump")):
        models[IMPROVED] = nominal_of(rig, rig_path)
    return models


def validate_log(
    path: Path,
    rig: Rig,
    rig_path: Path,
    states: Path | None = None,
    truth: bool = False,
    no_pwm: bool = False,
) -> tuple[Comparison, Sequence[str]]:
    """A log against the original and the improved model, and sentences about how it was read.

    Parameters
    ----------
    states, truth, no_pwm : as in `calib.identifying.read_track`.

    Raises
    ------
    BadInputError as `read_track`, and for sections that no rig has.
    """
    models = models_of(rig, rig_path)
    radius = models.get(IMPROVED, models[ORIGINAL]).plant.bellows_radius_m
    source = read_track(path, rig, rig_path, radius, states, truth, no_pwm)
    return compare(source, models, radius), source.said

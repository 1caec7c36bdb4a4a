"""Model against log: what a model shows from a log's commands and start alone, beside what was measured.

The commands are played to the plant and the pumps from the head's state at the start, which is that of the
kinematic estimator, smoothed over the first seconds: it knows camera and IMU and none of the models.
Without both sensors it is the median of the first readings. A log that begins at rest has no rates; one that
begins in motion has the estimator's, and pumps that just hold the head. Nothing is fitted on the way.
Errors are measured less simulated, of q1, q2 and phi, and of each

    norm   the un-normalised L2 norm over the rows, as in Table 3.3; it grows with their number
    RMS    the norm over the square root of the number of rows
    fit    100 (1 - norm / norm of the measured values about their mean) in percent

Three models are compared: the original one of 3.3, without bending and creep and with the damping of (3.41);
the improved one of 3.4 with nominal parameters; and, where the rig's file knows or estimates an actuator or a
pump, the improved one with those. Rows that stand away from their neighbours are replaced by them
first, as single wrong pictures would decide over an L2 norm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.options import LogOptions, PoseOptions
from calib.core.rig import Rig
from calib.stages.actuator.identify import Start, Track, heads_of, made
from calib.stages.actuator.kinematics import angle_and_length, bellows
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import Creep, Plant
from calib.stages.actuator.read import held_by_pumps, read_track
from calib.stages.actuator.swing import without_outliers

if TYPE_CHECKING:
    from calib.core.stage import Files

ORIGINAL, NOMINAL, IMPROVED = "original", "nominal", "improved"
CALLED = {ORIGINAL: "without bending and creep", NOMINAL: "nominal", IMPROVED: "this rig's"}
"""What a person reads."""
_SECONDS = 2.0
"""Of a log that the estimator looks at for the start."""

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
    start : where the models' start comes from: "estimator" or the same as `how`.
    hoses : whether the pumps are connected. replaced : rows that stood away from their neighbours.
    t_s : (n,) times. measured : (n, 3) q1, q2 [m] and phi [rad].
    simulated : the same of each model. errors : of each model by quantity.
    """

    name: str
    how: str
    start: str
    hoses: bool
    replaced: int
    t_s: FloatArray
    measured: FloatArray
    simulated: Mapping[str, FloatArray]
    errors: Mapping[str, Mapping[str, Error]]

    def improvement_percent(self, quantity: str, model: str = IMPROVED) -> float | None:
        """By how much a model's norm is smaller than the original's; None without one of them."""
        if model not in self.errors or ORIGINAL not in self.errors:
            return None
        before = self.errors[ORIGINAL][quantity].norm
        after = self.errors[model][quantity].norm
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
    return np.column_stack([bellows(head[:, 0], head[:, 1], bellows_radius_m), head[:, 0]])


def _cleaned(track: Track) -> tuple[Track, int]:
    """The track with single wrong rows replaced by what is around them, and how many."""
    head, wrong = track.head.copy(), np.zeros(len(track.head), dtype=np.bool_)
    for column in range(2):
        head[:, column], _ = without_outliers(track.head[:, column])
        wrong |= head[:, column] != track.head[:, column]
    return replace(track, head=head), int(wrong.sum())


def estimated_start(
    path: Path, rig: Rig, rig_path: Path, begin_s: float, options: LogOptions
) -> Start | None:
    """Angle, length and their rates at a time of a log [s] by the estimator; None where it lacks a sensor.

    Raises `BadInputError` as `calib.stages.estimator.replay.opened`.
    """
    from calib.stages.estimator.replay import opened, smoothed_rows

    log = opened(path, rig, rig_path, options)
    if not log.both:
        return None
    rows = smoothed_rows(log, begin_s + _SECONDS)
    t, q, dq = rows[:, 0], rows[:, 1:3], rows[:, 3:5]
    known = np.isfinite(rows[:, :5]).all(axis=1)
    if not known.any():
        return None
    k = int(np.argmin(np.where(known, np.abs(t - begin_s), np.inf)))
    # From the row's own time to the beginning.
    states = np.array([q[k] + (begin_s - t[k]) * dq[k], dq[k]])
    return Start(*angle_and_length(states, log.setup.bellows_radius_m).ravel().tolist())


def _begun(track: Track, start: Start, nominal: Machine) -> Track:
    """The track begun as a start says: with its rates and forces where it is in motion, else at rest."""
    if track.moving is None:
        return track
    return replace(track, moving=held_by_pumps(start, nominal.plant) if track.hoses else start)


def compare(track: Track, models: Mapping[str, Machine], start: Start | None = None) -> Comparison:
    """A log against models by name, each simulated from the log's start.

    Parameters
    ----------
    models : of which the last gives the radius that measured angles and lengths become bellows with.
    start : the estimator's, the track's own without.
    """
    track, replaced = _cleaned(track)
    begin = track.start if start is None else start
    if track.moving is None:
        begin = Start(begin.phi_rad, begin.length_m)
    measured = _columns(track.head, list(models.values())[-1].plant.bellows_radius_m)
    simulated = {}
    for name, nominal in models.items():
        begun = _begun(track, begin, nominal)
        at = begin if begun.moving is None else begun.moving
        pair = made(nominal, {}, begun.hoses, begun.tick_s)
        head, _ = heads_of(begun, [pair], [at], track.delay_s)
        simulated[name] = _columns(head[0], nominal.plant.bellows_radius_m)
    errors = {name: errors_of(measured, curves) for name, curves in simulated.items()}
    return Comparison(
        track.name,
        track.source,
        track.source if start is None else "estimator",
        track.hoses,
        replaced,
        track.t_s,
        measured,
        simulated,
        errors,
    )


def models_of(rig: Rig) -> dict[str, Machine]:
    """The original model, the nominal one, and last the improved one where the rig has an actuator or a pump.

    Mass, lengths and springs of the original model are the nominal ones.
    """
    first = replace(Plant(), damping_scale=1.0, bending_N_per_rad2=0.0, creep=Creep(1.0, 0.0, -1.0))
    models = {ORIGINAL: Machine(plant=first, free_damping_scale=1.0), NOMINAL: Machine()}
    if rig.actuator or rig.pump or rig.known:
        models[IMPROVED] = rig.machine
    return models


def begun_track(
    files: Files, path: Path, rig: Rig, options: PoseOptions, states: Path | None = None
) -> tuple[Track, Start | None]:
    """A log's track, and the estimator's start where its pose comes from pictures; both as `read_track`."""
    track = read_track(files, path, rig, list(models_of(rig).values())[-1], options, states)
    if track.source != "pictures":
        return track, None
    return track, estimated_start(path, rig, files.rig_path, track.begin_s, options)

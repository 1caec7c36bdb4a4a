"""The whole identification of a rig from its logs, and of a pump from its tables, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.actuator.identify_decrement import Decrement, decrement
from calib.actuator.identify_fit import Progress, Solution, fit_tracks
from calib.actuator.identify_next import prospects
from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_problem import starts_of
from calib.actuator.identify_pump import Held, PumpFit, cross_validate, fit_pump, rms_ahead, rms_of
from calib.actuator.identify_pump_findings import Departure, Group, departures, jumps, settled_groups
from calib.actuator.identify_pump_models import LAG, MODELS, ORIFICE, PumpRecord, Shape
from calib.actuator.identify_sigma import colour_of, held_back, rms_by_track, uncertainty
from calib.actuator.identify_static_map import StaticMap, fit_static_map
from calib.actuator.identify_tracks import heads_of
from calib.actuator.identify_verdict import judge
from calib.actuatorsections import Identified
from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.identifying import TrackSource
from calib.pumptables import PumpTable

__all__ = ["PumpFound", "identify_logs", "identify_pump", "simulated_heads"]


def simulated_heads(solution: Solution) -> list[FloatArray]:
    """Angle [rad] and length [m] (m, 2) of the identified rig at each log's poses, the offsets with them."""
    problem = solution.problem
    layout, starts = problem.layout, starts_of(problem, solution.x)
    out = []
    for k, track in enumerate(problem.tracks):
        delay = float(solution.x[layout.delay + layout.delays[k]])
        head, _ = heads_of(
            track, problem.nominal, [problem.values(solution.x)], [starts[k]], delay, problem.threads
        )
        out.append(np.asarray(head[0] + solution.x[layout.offset : layout.delay]))
    return out


def _decrements(solution: Solution) -> dict[str, tuple[Decrement, float | None]]:
    """Damping of the free swings by peaks, and that of the fitted swing by the same rule."""
    out: dict[str, tuple[Decrement, float | None]] = {}
    for track, head in zip(solution.problem.tracks, simulated_heads(solution), strict=True):
        if track.hoses:
            continue
        noise = float(np.median(np.sqrt(np.sum(np.linalg.inv(track.whitening)[:, 0] ** 2, axis=1))))
        try:
            seen = decrement(track.t_s, track.head[:, 0], noise)
        except BadInputError:
            continue
        try:
            fitted = decrement(track.t_s, head[:, 0], noise).zeta
        except BadInputError:
            fitted = None
        out[track.name] = (seen, fitted)
    return out


def identify_logs(
    nominal: Nominal,
    sources: Sequence[TrackSource],
    static_map: bool = False,
    hold_back: bool = True,
    progress: Progress | None = None,
) -> Identified:
    """Parameters of the actuator and the pumps from logs, with all that says what they are worth.

    Raises `BadInputError` where the logs can tell nothing.
    """
    delay_s = float(np.median([source.delay_s for source in sources]))
    tracks = [source.track for source in sources]
    solution = fit_tracks(nominal, tracks, static_map, delay_s, progress=progress)
    known = uncertainty(solution)
    colours = colour_of(solution)
    held = held_back(solution) if hold_back else []
    ahead = prospects(solution, known)
    return Identified(
        solution,
        known,
        colours,
        tuple(rms_by_track(solution.problem, solution.residual)),
        tuple(held),
        ahead,
        _decrements(solution),
        {source.track.name: source.source for source in sources},
        judge(solution, known, colours, held, ahead),
    )


@dataclass(frozen=True)
class PumpFound:
    """Everything that `calib identify pump` has found.

    Attributes
    ----------
    unit : of the values. records : recordings over time.
    fits, held : by model. asked : errors on recordings that were kept out on purpose, by model.
    maps : static maps. groups, departs, leaps : what is not explained.
    """

    unit: str
    records: tuple[PumpRecord, ...]
    fits: dict[str, PumpFit]
    held: dict[str, list[Held]]
    asked: dict[str, list[Held]]
    maps: tuple[StaticMap, ...]
    groups: tuple[Group, ...]
    departs: tuple[Departure, ...]
    leaps: tuple[tuple[str, float, float], ...]
    said: tuple[str, ...]

    @property
    def main_group(self) -> Group | None:
        """The largest group of runs, None where all settle alike or too few do."""
        if len(self.groups) < 2:
            return None
        return max(self.groups, key=lambda g: len(g.names))

    def held_rms(self, model: str, names: Sequence[str] | None = None) -> float | None:
        """RMS over recordings that were not fitted, each counting alike; None without any."""
        some = [h.rms for h in self.held[model] if names is None or h.name in names]
        return float(np.sqrt(np.mean(np.square(some)))) if some else None

    @property
    def better(self) -> str | None:
        """The model with the smaller error on recordings not fitted; None without recordings."""
        if not self.fits:
            return None
        return min(self.fits, key=lambda m: self.held_rms(m) or self.fits[m].rms)


def _chosen_shape(records: Sequence[PumpRecord], maps: Sequence[StaticMap]) -> Shape:
    """The static map's shape that lets the plain lag fit best: a straight line, or one of the tables'."""
    rising = [m for m in maps if m.end * float(np.median([r.value[-1] for r in records])) > 0.0]
    shapes = [Shape(), *(m.shape for m in rising)]
    if len(shapes) == 1:
        return shapes[0]
    # Judged by the model that a drop of the PWM can tell anything about.
    costs = [fit_pump(records, LAG, shape).cost for shape in shapes]
    return shapes[int(np.argmin(costs))]


def identify_pump(
    tables: Sequence[PumpTable], kept_out: Sequence[PumpTable] = (), progress: Progress | None = None
) -> PumpFound:
    """Dead time, lag, static map and flow of a pump, both models compared on recordings not fitted.

    Parameters
    ----------
    kept_out : tables that are predicted and not fitted.

    Raises
    ------
    BadInputError for tables of different units, and where nothing changes in any.
    """
    units = {table.unit for table in (*tables, *kept_out)}
    if len(units) != 1:
        raise BadInputError(f"pump: found tables in {' and '.join(sorted(units))}, expected one unit")
    said = [sentence for table in tables for sentence in table.said]
    records = []
    for table in tables:
        record = table.record
        if record is None:
            continue
        if not np.ptp(record.pwm) and float(np.ptp(record.value)) < 1e-9:
            said.append(f"{record.name}: neither PWM nor value ever changes; left out")
            continue
        records.append(record)
    settled = [part for table in tables for part in table.settled]
    maps = [fit_static_map(part.name, part.pwm, part.value) for part in settled]
    if not records and not maps:
        raise BadInputError("pump: neither PWM nor value ever changes in these tables, expected steps")
    fits: dict[str, PumpFit] = {}
    held: dict[str, list[Held]] = {}
    asked: dict[str, list[Held]] = {}
    if records:
        shape = _chosen_shape(records, maps)
        for done, model in enumerate(MODELS):
            if progress is not None:
                progress(done, len(MODELS))
            fits[model] = fit_pump(records, model, shape)
            held[model] = cross_validate(fits[model], records)
            outside = [table.record for table in kept_out if table.record is not None]
            asked[model] = [Held(r.name, rms_of(fits[model], r), rms_ahead(fits[model], r)) for r in outside]
    return PumpFound(
        units.pop(),
        tuple(records),
        fits,
        held,
        asked,
        tuple(maps),
        settled_groups(records) if records else (),
        departures(fits[ORIFICE], records) if records else (),
        jumps(records),
        tuple(said),
    )

"""What an identification is worth in words: verdict, reasons, remarks and advice.

- unidentifiable: the logs cannot tell a parameter that they should.
- poor: the model does not explain the logs (residuals far above the noise, a held-back log predicted much
  worse than fitted), a parameter lies at a bound, or an important one is vague.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.verdict import Finding, Verdict
from calib.solve.information import tied_groups
from calib.stages.actuator.identify import (
    NO_CREEP,
    PARAMETERS,
    STEP,
    Colour,
    Problem,
    Solution,
    at_bounds,
    head_of,
    heads_of,
    residuals,
    start_of,
    values_of,
    whitened,
)
from calib.stages.actuator.section import STRENGTHS, label_of
from calib.stages.actuator.uncertainty import HeldLog, Prospect, Uncertainty, rms_by_track

_MOST_SCALE = 2.5
_MOST_INFLATION = 8.0
_MOST_HELD, _LEAST_CHANCE = 1.5, 0.01
_MOST_RELATIVE = 0.25
_MOST_SCATTER = 1.5
_SLOW = 1.5
"""Periods of a loop for which a log's commands stand, beyond which it may have sent others in between."""
_STRONG = 0.95
_FAR_ROWS = 0.05
_EXPLAINED = 3e-3, 1.5e-4
"""Angle [rad] and length [m]: a model that misses by less, half a Pixy2's pixel, explains logs of a camera
that sees more as well."""
_MOST_APART_S = 0.04
_PUMPS_APART_S = 0.01
_APART_SIGMA = 5.0


def _of_fit(solution: Solution, known: Uncertainty, colours: Sequence[Colour]) -> list[Finding]:
    advice = "look at what known states: the mass, gravity and the bellows' radius are in all forces"
    out = [Finding("poor", text, advice) for text in at_bounds(solution)]

    def poor(text: str) -> None:
        out.append(Finding("poor", text))

    def remark(text: str) -> None:
        out.append(Finding("remark", text))

    missed = rms_by_track(solution.problem, solution.residual, math.inf)
    unlike = remark if (np.array(missed) < _EXPLAINED).all() else poor
    if known.scale > _MOST_SCALE:
        unlike(
            f"the residuals are {known.scale:.1f} times what the sensor's noise explains; the model misses "
            "something, or the camera's jitter is larger than the rig's file says"
        )
    worst = max(known.inflation, key=lambda n: known.inflation[n])
    if known.inflation[worst] > _MOST_INFLATION:
        poor(
            f"the residuals are so coloured that the deviation of {label_of(worst)} had to be raised "
            f"{known.inflation[worst]:.1f} times"
        )
    slow = _slowly_commanded(solution.problem)
    for colour in colours:
        if not colour.white:
            remark(
                f"{colour.name}: residuals are not white ({100.0 * colour.outside:.0f} % of the lags outside "
                f"the 95 % band, {max(colour.first, key=abs):+.2f} from row to row); deviations are raised"
            )
        if colour.name in slow and not colour.white:
            every = f"{1e3 * slow[colour.name]:.3g} ms"
            text = f"{colour.name}: its commands come every {every}; what the pumps got in between is missing"
            advice = "write each command into the log when it is sent, or state known: {pump: {tick_s: ...}}"
            out.append(Finding("remark", text, advice))
        if colour.share_far > _FAR_ROWS:
            unlike(f"{colour.name}: {100.0 * colour.share_far:.0f} % of the poses are far off")
    labels = [label_of(name) for name in solution.problem.names]
    groups = tied_groups(known.correlation, _STRONG)
    if groups:
        texts = "; ".join(", ".join(labels[k] for k in group) for group in groups)
        remark(f"hardly told apart, with correlations beyond {_STRONG:g}: {texts}")
    if solution.starts > 1 and solution.agreeing == 1:
        remark(f"one of {solution.starts} starts alone came to this minimum; there may be others")
    return out


def _slowly_commanded(problem: Problem) -> dict[str, float]:
    """Periods [s] of the commands of logs that hold fewer of them than the pumps are known to get."""
    loop_s = problem.nominal.pump.tick_s
    pumped = [track for track in problem.tracks if track.hoses]
    return {track.name: track.tick_s for track in pumped if track.tick_s > _SLOW * loop_s}


def _one_more(solution: Solution, columns: Iterable[FloatArray]) -> Iterator[tuple[float, float] | None]:
    """What one unknown more would be and its deviation, for derivatives (rows,) of the residuals by it.

    One step of Gauss and Newton in which all other unknowns follow. None where they can make up for it.
    """
    r, w, WJ, inverse = solution.residual, solution.weights, solution.weighted, solution.inverse
    for column in columns:
        b, whole = WJ.T @ column, float(column @ (w * column))
        own = whole - float(b @ inverse @ b)
        slope = float(column @ (w * r) - b @ inverse @ (WJ.T @ r))
        yield (-slope / own, 1.0 / math.sqrt(own)) if own > 1e-6 * whole and own > 0.0 else None


def own_delays(solution: Solution) -> list[tuple[str, float, float]]:
    """By how much each log's rows come later than those of the others [s], and the deviation of that.

    Only of logs that share a delay. Columns that are late in one log alone are otherwise taken for a delay
    between, and for a damping and a creep that are not there.
    """
    problem, J = solution.problem, solution.J
    delays, spans = problem.unknowns.delays, problem.spans
    shared = [k for k, at in enumerate(delays) if delays.count(at) > 1]
    columns = []
    for k in shared:
        column = np.zeros(len(J))
        column[spans[k]] = J[spans[k], delays[k]]
        columns.append(column)
    found = zip(shared, _one_more(solution, columns), strict=True)
    return [(problem.tracks[k].name, *one) for k, one in found if one is not None]


def pump_delay(solution: Solution) -> tuple[float, float] | None:
    """By how much the commands of pump 1 come later than those of pump 2 [s], and the deviation of that.

    None without pumps. A column that is late is otherwise taken for a damping that is not there.
    """
    problem, x = solution.problem, solution.x
    column = np.zeros(len(solution.residual))
    for k, (track, span) in enumerate(zip(problem.tracks, problem.spans, strict=True)):
        if track.hoses:
            n, ends = len(track.pwm), []
            for shift in (1, -1):
                pwm = track.pwm.copy()
                pwm[:, 0] = track.pwm[np.clip(np.arange(n) + shift, 0, n - 1), 0]
                ends.append(head_of(problem, x, k, replace(track, pwm=pwm)))
            slope = (ends[0] - ends[1]) / (2.0 * track.tick_s)
            column[span] = -whitened(track, slope).reshape(-1)
    return next(iter(_one_more(solution, [column]))) if np.isfinite(column).all() and column.any() else None


@dataclass(frozen=True)
class Moved:
    """A shift of all poses of a log from a time on: by angle [rad] and length [m], in deviations.

    Attributes
    ----------
    from_s : time in the log; zero for all of it. readings : the shift over the noise of one reading.
    """

    name: str
    from_s: float
    phi_rad: float
    length_m: float
    readings: float
    deviations: float


def moved_camera(solution: Solution) -> Moved | None:
    """The clearest shift of a log's pictures from some time on, alike in pixels: of a camera that moved."""
    problem, r, w = solution.problem, solution.residual, solution.weights
    WJ, inverse, found = solution.weighted, solution.inverse, list[Moved]()
    pull = inverse @ (WJ.T @ r)
    for track, span in zip(problem.tracks, problem.spans, strict=True):
        # Sums from each row on, over both whitened readings: of pictures they are u and v.
        by, slope, power = (
            np.cumsum(rows[span].reshape(len(track.t_s), 2, -1)[::-1], axis=0)[::-1]
            for rows in (WJ, w * r, w)
        )
        ends = np.linspace(0.0, len(track.t_s), _MOMENTS + 1)[:-1].astype(int)
        for k in ends if len(problem.tracks) > 1 else ends[1:]:
            own = np.diag(power[k, :, 0]) - by[k] @ inverse @ by[k].T
            size, axes = np.linalg.eigh(own)
            if size[0] > 1e-6 * power[k].max():
                g = slope[k, :, 0] - by[k] @ pull
                shift = -axes @ ((axes.T @ g) / size)
                phi, length = np.linalg.solve(track.whitening[k], shift).tolist()
                at = float(track.t_s[k]) if k else 0.0
                far = math.sqrt(max(float(-shift @ g), 0.0))
                found.append(Moved(track.name, at, phi, length, float(np.linalg.norm(shift)), far))
    return max(found, key=lambda one: one.deviations, default=None)


def by_logs(solution: Solution) -> dict[str, tuple[float, float]]:
    """What logs make of each value that is stated without a deviation, to first order, and the deviation."""
    problem, values = solution.problem, values_of(solution.problem.nominal)
    exact = [name for name, sigma in problem.stated.items() if not sigma and name not in problem.names]
    columns: dict[str, FloatArray] = {}
    for name in exact:
        step = STEP * max(abs(values[name]), PARAMETERS[name].scale)
        up, down = (
            residuals(replace(problem, held={**problem.held, name: value}), solution.x[None])[0]
            for value in (values[name] + step, values[name] - step)
        )
        if np.any(up != down):
            columns[name] = (up - down) / (2.0 * step)
    found = zip(columns, _one_more(solution, columns.values()), strict=True)
    return {name: (values[name] + one[0], one[1]) for name, one in found if one is not None}


_MOMENTS = 20
_LEAST_READINGS = 0.5
"""Moments of a log at which a camera may have moved; noises of a reading, .2 px, below which it has not."""
_MOVED_RAD, _MOVED_M = math.radians(0.1), 1e-4
"""Turn and growth of the head up to which, before a fine camera, its move does no harm."""
_STATED_OFF = 0.02
_CROSSED, _BENDS_RAD = -0.5, 0.05
_UNLIKE = 1.15
"""Factor by which one of two pumps may be stronger, and the other weaker, than it should."""


def crossed(solution: Solution) -> dict[str, float]:
    """Correlation of angles with those of the model from which the fit began, by the name of a log.

    Only of logs whose pumps push apart. The fit itself makes pumps weak that bend the rig the other way.
    A controller pushes against what unlike pumps bend, so the largest correlation is taken of a model with
    pumps alike and with either one stronger.
    """
    problem, found = solution.problem, {}
    alike = dict(zip(STRENGTHS, problem.nominal.strength, strict=True))
    one, other = STRENGTHS
    for k, track in enumerate(problem.tracks):
        if track.hoses:
            delay_s, start = float(solution.x[problem.unknowns.delays[k]]), start_of(problem, solution.x, k)
            pairs = [
                problem.pair(track, {one: more * alike[one], other: alike[other] / more})
                for more in (1.0, _UNLIKE, 1.0 / _UNLIKE)
            ]
            heads, _ = heads_of(track, pairs, [start] * len(pairs), delay_s)
            both = [np.stack([head[:, 0], track.head[:, 0]]) for head in heads]
            if np.isfinite(both).all() and np.ptp(both[0], axis=1).min() > _BENDS_RAD:
                found[track.name] = max(float(np.corrcoef(pair)[0, 1]) for pair in both)
    return found


def _apart(solution: Solution, known: Uncertainty) -> Iterator[Finding]:
    """What logs contradict: what is known, where the camera is, when rows come, which pump pushes where."""
    raised = known.scale * max(known.inflation.values(), default=1.0)
    stated = values_of(solution.problem.nominal)
    for name, (value, sigma) in by_logs(solution).items():
        off = abs(value - stated[name])
        if off > max(_APART_SIGMA * raised * sigma, _STATED_OFF * abs(stated[name])):
            label, spec = label_of(name), PARAMETERS[name]
            # Far away the first order says no more than that it is another.
            about = (
                f"about {value:.4g} +- {raised * sigma:.2g}" if spec.low <= value <= spec.high else "another"
            )
            text = (
                f"{label} is {stated[name]:.4g} {spec.unit}".rstrip() + f" in known, and {about} by the logs"
            )
            advice = "measure it and the mass again, or state its standard deviation under known"
            yield Finding("inconsistent", text, advice)
    # Logs move what is known beforehand by its deviation or two; a fit that ended beside the rig, or a wrong
    # number, by ten.
    unknowns = solution.problem.unknowns
    for name, value, mean, sigma in zip(
        solution.problem.names, solution.x, unknowns.mean, unknowns.sigma, strict=False
    ):
        if abs(value - mean) > _APART_SIGMA * sigma:
            unit = f" {PARAMETERS[name].unit}".rstrip()
            before, after = f"{mean:.4g} +- {sigma:.2g}{unit}", f"{value:.4g}{unit}"
            text = (
                f"{label_of(name)} is {before} beforehand, and {after} by the fit: another rig's number, or "
                "a fit that ended beside the rig"
            )
            advice = (
                "measure it and the mass again, and look at the stated gravity; where they are right, "
                "identify with some logs left out"
            )
            yield Finding("inconsistent", text, advice)
    moved, slow = moved_camera(solution), _slowly_commanded(solution.problem)
    if (
        moved is not None
        and moved.name not in slow
        and moved.readings > _LEAST_READINGS
        and (abs(moved.phi_rad) > _MOVED_RAD or abs(moved.length_m) > _MOVED_M)
        and moved.deviations > _APART_SIGMA * raised
    ):
        when, then = f"from about {moved.from_s:.1f} s on", "cut the log there, and"
        if not moved.from_s:
            when, then = "against those of the other logs", "keep it apart, and"
        text = (
            f"{moved.name}: its pictures are shifted {when}, as if the head had turned by "
            f"{math.degrees(moved.phi_rad):+.1f} degrees and grown by {1e3 * moved.length_m:+.1f} mm; the "
            "camera, or the marker on the head, has moved, or a pump answers otherwise"
        )
        advice = (
            f"{then} calibrate the plane anew (calib extrinsics) for the pictures after that; where calib "
            "replay finds that pictures and IMU agree, look at the pumps, their hoses and the commands' unit"
        )
        yield Finding("inconsistent", text, advice)
    for name, alike in crossed(solution).items():
        if alike < _CROSSED:
            text = f"{name}: the head bends away from the pump that pushes, correlation {alike:.2f}"
            advice = "look whether pwm1 and pwm2, or the hoses, are swapped, or the pictures are mirrored"
            yield Finding("inconsistent", text, advice)
    far = [
        (abs(late) / sigma, name, late)
        for name, late, sigma in own_delays(solution)
        if abs(late) > max(_MOST_APART_S, _APART_SIGMA * raised * sigma)
    ]
    if far:
        _, name, late = max(far)
        when = "later" if late > 0.0 else "earlier"
        text = (
            f"{name}: its pictures come {1e3 * abs(late):.0f} ms {when} after its commands than those of the "
            "other logs"
        )
        yield Finding("inconsistent", text, "compare the clocks of camera and commands, log by log")
    late, sigma = pump_delay(solution) or (0.0, 1.0)
    if abs(late) > max(_PUMPS_APART_S, _APART_SIGMA * raised * sigma):
        one, other = ("pwm1", "pwm2") if late > 0.0 else ("pwm2", "pwm1")
        text = (
            f"{one} comes about {1e3 * abs(late):.0f} ms after {other}, as the rig answers them; the model "
            "has one dead time for both pumps, so damping and lags are not the rig's"
        )
        yield Finding("inconsistent", text, "check the times of both columns, and hoses and valves")


def _told(solution: Solution, known: Uncertainty) -> Iterator[Finding]:
    """Which parameters logs do not tell, or hardly, and which a person states."""
    for name, why in solution.fixed.items():
        if "enter only" in why:
            yield Finding("remark", why)
        elif NO_CREEP in why:
            yield Finding("remark", f"{label_of(name)}: {why}")
        else:
            text = f"{label_of(name)} is not identifiable from these logs: {why}"
            yield Finding("unidentifiable", text)
    most = max((float(track.pwm.max()) for track in solution.problem.tracks if track.hoses), default=0.0)
    if 0.0 < most <= 100.0 and {*STRENGTHS} <= solution.fixed.keys():
        unit = "unit: percent" if most > 1.0 else "factor: 255"
        text = f"no command exceeds {most:.3g} of 255, below which the pumps give no force"
        said = f"of other units, say pwm1: {{column: pwm1, {unit}}} in columns.yaml, and pwm2 so"
        yield Finding("unidentifiable", text, said)
    fixed = [label_of(name) for name, sigma in solution.problem.stated.items() if not sigma]
    if fixed:
        yield Finding("remark", f"not estimated, for known states it: {', '.join(fixed)}")
    priors = [label_of(name) for name in solution.problem.names if solution.problem.stated.get(name)]
    if priors:
        yield Finding("remark", f"known with a standard deviation, which went in: {', '.join(priors)}")
    for name, value in solution.values.items():
        relative = known.sigma[name] / max(abs(value), 1e-12)
        if relative > _MOST_RELATIVE:
            so = f"known to {100.0 * relative:.0f} % only"
            if relative > 1.0:
                so = f"{value:.3g} +- {known.sigma[name]:.2g}: these logs do not tell it from zero"
            if known.scatter[name] > _MOST_SCATTER:
                times = f"{known.scatter[name]:.1f} times"
                so += f"; stretches of the logs disagree on it, which raised its deviation {times}"
            yield Finding("poor", f"{label_of(name)} is {so}")


def _of_logs(solution: Solution, held: Sequence[HeldLog], next_ones: Sequence[Prospect]) -> Iterator[Finding]:
    """How logs are met that were held back, the law of the pumps, and what to record next."""
    for log in held:
        # A log that alone tells a parameter is predicted badly by the others, who say nothing against it.
        if log.held_phi_rad > _MOST_HELD * log.fitted_phi_rad + 1e-4 and log.chance < _LEAST_CHANCE:
            text = (
                f"{log.name}: held back, its angle is predicted to {1e3 * log.held_phi_rad:.3g} mrad, "
                f"fitted to {1e3 * log.fitted_phi_rad:.3g} mrad, by parameters that the other logs contradict"
            )
            yield Finding("poor", text)
    if solution.law:
        yield Finding("remark", solution.law)
    if not held and len(solution.problem.tracks) == 1:
        yield Finding("remark", "one log alone: nothing is left to check the parameters on")
    if next_ones:
        best = next_ones[0]
        advice = (
            f"calib record PORT -o {best.name}.csv --do {best.name} ({best.what}) would leave "
            f"{label_of(best.worst)} as the least known, to {100.0 * best.worst_relative:.2g} %"
        )
        yield Finding("remark", "", advice)


def judge(
    solution: Solution,
    known: Uncertainty,
    colours: Sequence[Colour],
    held: Sequence[HeldLog],
    next_ones: Sequence[Prospect],
) -> Verdict:
    """Judge an identification from what was computed of it."""
    told, apart = _told(solution, known), _apart(solution, known)
    fit, logs = _of_fit(solution, known, colours), _of_logs(solution, held, next_ones)
    return Verdict.of([*told, *fit, *apart, *logs])

"""One log through an estimator: states written, errors and consistency summed, a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import FloatArray
from calib.driving import drive_from_rig, has_commands, pwm_of
from calib.errors import BadInputError
from calib.estimator.baseline import BASELINE, Baseline
from calib.estimator.consistency import SENSORS, Tally
from calib.estimator.driven_setup import Drive
from calib.estimator.filter import Filter
from calib.estimator.noise import jitter_px
from calib.estimator.setup import FLAGS, OUT, Rows, Setup
from calib.files import shown
from calib.logs import Log, passed_over
from calib.relay import ahead, behind
from calib.replaying import (
    baseline_setup,
    blocks,
    noise_at_rest,
    periods,
    rows_of,
    setup_from_rig,
    truth_of,
)
from calib.rig import Rig
from calib.statesfile import STATES, StatesFile, states_writer
from calib.warming import driven_elsewhere, warm

__all__ = ["MODELS", "Replayed", "Trace", "drive_for", "estimator_of", "prepared", "replay_log"]

MODELS = ("auto", "kinematic", "driven")

_JITTER_ROWS = 6000
_MOST_POINTS = 6000
_NIS_FACTOR = 2.0
_GATED_SHARE = 0.05
_INSIDE_SHARE = 0.7
_CORRELATED = 0.6
_SMOOTHED_ROWS = 1_000_000
"""The smoother keeps 1.6 kB for each row with the kinematic model alone."""

Progress = Callable[[int, int], None]


@dataclass
class Trace:
    """Rows for figures: every row of a short log, every k-th of a longer one."""

    rows: list[FloatArray] = field(default_factory=list)
    step: int = 1
    _count: int = 0
    _next: int = 0

    def add(self, values: FloatArray) -> None:
        """Rows (n, columns) that follow."""
        at = np.arange(self._next - self._count, len(values), self.step)
        if len(at):
            self.rows.append(values[at])
            self._next = self._count + int(at[-1]) + self.step
        self._count += len(values)
        while sum(len(part) for part in self.rows) > 2 * _MOST_POINTS:
            # Rows that are kept lie `step` apart from the first on.
            whole = np.concatenate(self.rows)
            self._next = (len(whole) + len(whole) % 2) * self.step
            self.rows, self.step = [whole[::2]], 2 * self.step

    @property
    def values(self) -> FloatArray:
        """All rows kept."""
        return np.concatenate(self.rows) if self.rows else np.zeros((0, 0))


@dataclass(frozen=True)
class Replayed:
    """What a log has come to.

    Attributes
    ----------
    source, rows, duration_s, estimator : of the log.
    rmse, others : errors against the truth by `Tally.rmse`, of this estimator and of another.
    sensors : consistency by sensor. flags : rows by flag. jitter_px : that was used.
    driven_share : of the rows, in which the driven model spoke; None where there was none.
    trace : rows for figures: `setup.OUT`, then q1, q2, phi of the baseline, then the truth.
    """

    source: str
    rows: int
    duration_s: float
    estimator: str
    rmse: dict[str, float]
    others: dict[str, dict[str, float]]
    sensors: dict[str, dict[str, float]]
    flags: dict[str, int]
    jitter_px: float | None
    verdict: str
    reasons: list[str]
    remarks: list[str]
    trace: FloatArray
    driven_share: float | None = None

    def as_json(self) -> dict[str, Any]:
        """For the document."""
        names = (
            "source", "rows", "duration_s", "estimator", "rmse", "sensors", "flags", "jitter_px", "verdict",
            "reasons", "remarks", "driven_share",
        )  # fmt: skip
        out = {name: getattr(self, name) for name in names}
        return out | {"compared": self.others}


def prepared(
    path: Path, rig: Rig, rig_path: Path, topics: Path | None = None
) -> tuple[Setup, Any, Iterator[Log], list[str]]:
    """Set-up, periods, all blocks of the log, and sentences on what is assumed."""
    stream = blocks(path, topics)
    first = next(stream)
    found = periods(first)
    setup, said = setup_from_rig(rig, rig_path, found)
    if rig.estimator is None and found.camera:
        head = rows_of(first, found.ticks)
        count = min(len(head), _JITTER_ROWS)
        part = replace(head, t_s=head.t_s[:count], readings=head.readings[:count], kinds=head.kinds[:count])
        noise = setup.noise.copy()
        noise[0] = jitter_px(setup, [part]).value
        setup = replace(setup, noise=noise)
    return setup, found, chain([first], stream), said


def replay_log(
    path: Path,
    rig: Rig,
    rig_path: Path,
    estimator: str = "fused",
    smooth: bool = False,
    output: Path | None = None,
    progress: Progress | None = None,
    traced: bool = False,
    model: str = "auto",
    topics: Path | None = None,
) -> Replayed:
    """Run one log, block by block, and write its states; `smooth` needs the whole log in memory.

    `model` is one of `MODELS`: driven by the commands or kinematic, "auto" both where the log has commands,
    camera and IMU, each speaking where it is the better.

    Raises `BadInputError` for a log or a rig that cannot be used.
    """
    with driven_elsewhere(estimator == "fused" and model != "kinematic", smooth):
        setup, found, stream, said = prepared(path, rig, rig_path, topics)
        warm(setup, smooth)
    if estimator == "baseline" and not (found.camera and found.imu):
        raise BadInputError(f"{shown(path)}: the baseline needs camera and IMU, and the log lacks one")
    tally, trace = Tally(setup.bellows_radius_m), Trace()
    baseline_tally = Tally(setup.bellows_radius_m)
    baseline = Baseline(baseline_setup(setup, rig, rig_path, found)) if found.camera and found.imu else None
    first = next(stream)
    stream = chain([first], stream)
    drive = drive_for(model, first, found, rig, path, rig_path)
    estimate = estimator_of(setup, drive, model)
    shares = Shares()
    parts = path.iterdir() if path.is_dir() else (path,)
    size = sum(part.stat().st_size for part in parts)

    def run(states: StatesFile | None) -> None:
        done = 0

        def finish(item: tuple[Log, Rows, FloatArray]) -> None:
            log, rows, out = item
            truth = truth_of(log)
            shares.add(out)
            tally.add(out, truth)
            other = np.full((len(log), 3), np.nan) if traced else None
            if baseline is not None and (truth is not None or traced or estimator == "baseline"):
                held = baseline.run(rows)
                other = held[:, 1:4]
                baseline_tally.add(_as_out(held), truth)
                if estimator == "baseline" and states is not None:
                    states.add(held)
            if estimator == "fused" and states is not None:
                states.add(out[:, _COLUMNS])
            if traced:
                known = np.full((len(log), 3), np.nan) if truth is None else truth
                trace.add(np.concatenate([out, other, known], axis=1))

        with behind(finish) as hand:
            for log in ahead(_told(stream, said)):
                rows = rows_of(log, found.ticks)
                hand((log, rows, estimate(rows, log)))
                done += len(log)
                if progress is not None:
                    progress(min(done * 80, size), size)

    if smooth:
        from calib.smoothing import smooth_log

        after, before, traces = smooth_log(setup, found, _bounded(_told(stream, said)), output, drive)
        shares.add(traces[0])
        result = _result(path, "smoothed", setup, found, after, before, said, traces[0], True)
        result = replace(result, driven_share=shares.value)
        return replace(result, others={"filter": _errors(before, True)} if before.scored else {})
    if output is None:
        run(None)
    else:
        with states_writer(output, STATES if estimator == "fused" else BASELINE) as states:
            run(states)
    result = _result(
        path, estimator, setup, found, tally, baseline_tally, said, trace.values, baseline is not None
    )
    return replace(result, driven_share=shares.value)


@dataclass
class Shares:
    """In how many rows the driven model has spoken."""

    rows: int = 0
    driven: int = 0

    def add(self, out: FloatArray) -> None:
        """Rows of `setup.OUT` that follow."""
        weight = out[:, OUT.index("driven_weight")]
        self.rows += int(np.isfinite(weight).sum())
        self.driven += int(np.count_nonzero(weight >= 0.5))

    @property
    def value(self) -> float | None:
        """Their share, None without a driven model."""
        return self.driven / self.rows if self.rows else None


def drive_for(model: str, first: Log, found: Any, rig: Rig, path: Path, rig_path: Path) -> Drive | None:
    if model == "kinematic":
        return None
    told = has_commands(first)
    if told and found.camera and found.imu:
        return replace(drive_from_rig(rig, rig_path), imu_noise=noise_at_rest(rig, found))
    if model == "driven":
        lacks = "commands (pwm1, pwm2)" if not told else "pictures" if not found.camera else "IMU samples"
        raise BadInputError(
            f"{shown(path)}: the driven model needs commands, camera and IMU, found no {lacks}"
        )
    return None


def estimator_of(setup: Setup, drive: Drive | None, model: str) -> Callable[[Rows, Log], FloatArray]:
    """The estimator as a function of rows and the log that they come from."""
    if drive is None:
        fused = Filter(setup)
        return lambda rows, log: fused.run(rows)
    if model == "driven":
        from calib.estimator.driven_filter import DrivenFilter

        alone = DrivenFilter(setup, drive)
        return lambda rows, log: alone.run(rows, pwm_of(log))
    from calib.estimator.driven_handover import Handover

    both = Handover(setup, drive)
    return lambda rows, log: both.run(rows, pwm_of(log))


def _told(stream: Iterator[Log], said: list[str]) -> Iterator[Log]:
    """The blocks, and at their end sentences on what was passed over in them."""
    cells, truncated = 0, False
    for log in stream:
        cells += log.not_finite
        truncated = log.truncated
        yield log
    said.extend(passed_over(cells, truncated))


def _bounded(stream: Iterator[Log]) -> Iterator[Log]:
    """The blocks of a log that may be held in memory as a whole."""
    rows = 0
    for log in stream:
        rows += len(log)
        if rows > _SMOOTHED_ROWS:
            raise BadInputError(
                f"{log.source}: has more than {_SMOOTHED_ROWS} rows, which smoothing would hold in memory; "
                "leave --smooth out or cut the log"
            )
        yield log


_COLUMNS = [OUT.index(name) for name in STATES]


def _as_out(held: FloatArray) -> FloatArray:
    """The baseline's columns in the places of the fused filter's, for the sums."""
    out = np.full((len(held), len(OUT)), np.nan)
    out[:, 0], out[:, 1], out[:, 2], out[:, 5] = held[:, 0], held[:, 1], held[:, 2], held[:, 3]
    out[:, 10:13] = 1.0
    out[:, OUT.index("flags")] = 0.0
    return out


def _errors(tally: Tally, own: bool) -> dict[str, float]:
    rmse = tally.rmse()
    return rmse if own else {k: rmse[k] for k in ("q1_mm", "q2_mm", "mean_q_mm", "phi_deg") if k in rmse}


def _checks(tally: Tally) -> dict[str, dict[str, float]]:
    out = {}
    for name, degrees in SENSORS.items():
        check = tally.check(name)
        if check is not None:
            out[name] = {
                "degrees": degrees,
                "readings": check.count,
                "gated": check.gated,
                "nis": check.nis,
                "low": check.low,
                "high": check.high,
                "inside": check.inside,
                "correlation": check.correlation,
                "correlation_bound": check.bound,
            }
    return out


def judged(
    checks: dict[str, dict[str, float]], flags: dict[str, int], rows: int
) -> tuple[list[str], list[str]]:
    """Reasons why a result is poor, and remarks."""
    reasons, remarks = [], []
    for name, check in checks.items():
        ratio = check["nis"] / check["degrees"]
        if not 1.0 / (2.0 * _NIS_FACTOR) <= ratio <= _NIS_FACTOR:
            reasons.append(
                f"the innovations of the {name} are {ratio:.2g} times what the covariance expects; "
                "calib replay --tune learns the noise of this rig"
            )
        share = check["gated"] / max(check["readings"] + check["gated"], 1)
        if share > _GATED_SHARE:
            reasons.append(f"{100.0 * share:.0f} % of the {name}'s readings were gated out")
        if check["inside"] < _INSIDE_SHARE:
            reasons.append(
                f"only {100.0 * check['inside']:.0f} % of the {name}'s innovations lie in their 95 % band"
            )
        if abs(check["correlation"]) > _CORRELATED:
            remarks.append(
                f"the innovations of the {name} are not white: {check['correlation']:.2f} with the one before"
            )
    for name, sentence in (
        ("camera_silent", "the camera is silent"),
        ("imu_silent", "the IMU is silent"),
        ("held_by_prior", "no sensor bounds length or angle, the prior does"),
        ("not_started", "nothing is known yet"),
    ):
        if flags.get(name, 0) > 0.05 * rows:
            reasons.append(f"{sentence} in {100.0 * flags[name] / rows:.0f} % of the rows")
    if flags.get("time_jump"):
        reasons.append(f"the time jumps {flags['time_jump']} times; the filter starts again after each")
    if flags.get("restarted"):
        remarks.append(f"the filter started again {flags['restarted']} times after rejecting all readings")
    if flags.get("late"):
        remarks.append(f"{flags['late']} readings came too late to be used")
    return reasons, remarks


def _result(
    path: Path, estimator: str, setup: Setup, found: Any, tally: Tally, baseline: Tally, said: list[str],
    trace: FloatArray, compared: bool,
) -> Replayed:  # fmt: skip
    checks = _checks(tally)
    flags = {name: tally.flags.get(bit, 0) for name, bit in FLAGS.items() if tally.flags.get(bit, 0)}
    own = estimator != "baseline"
    reasons, remarks = judged(checks, flags, max(tally.rows, 1)) if own else ([], [])
    if own and not found.camera:
        reasons.insert(0, "the log has no pictures")
    if own and not found.imu:
        reasons.insert(0, "the log has no IMU samples")
    first, second = (tally, baseline) if own else (baseline, tally)
    others = {}
    if compared and second.scored:
        others["baseline" if own else "fused"] = _errors(second, not own)
    duration = tally.end_s - tally.start_s
    return Replayed(
        shown(path.name), tally.rows, duration if math.isfinite(duration) else 0.0, estimator,
        _errors(first, own), others, checks if own else {}, flags if own else {},
        float(setup.noise[0]) if found.camera else None, "poor" if reasons else "ok", reasons,
        [*said, *remarks], trace,
    )  # fmt: skip

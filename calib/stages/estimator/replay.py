"""Logs through an estimator: states written, errors and consistency summed, a verdict."""

from __future__ import annotations

import contextlib
import math
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import on_compiling
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.rig import Rig
from calib.io.logs import Log, passed_over
from calib.io.states import STATES, StatesFile, states_writer
from calib.stages.estimator.baseline import BASELINE, Baseline
from calib.stages.estimator.consistency import SENSORS, Tally
from calib.stages.estimator.driven import Drive
from calib.stages.estimator.kinematic import FLAGS, NOISE, OUT, Filter, Rows, Setup, Start
from calib.stages.estimator.noise import jitter_px
from calib.stages.estimator.read import (
    Periods,
    baseline_setup,
    blocks,
    drive_from_rig,
    has_commands,
    noise_at_rest,
    periods,
    pwm_of,
    rows_of,
    setup_from_rig,
    truth_of,
)
from calib.stages.estimator.sensors import SENSOR
from calib.stages.estimator.smoother import smooth

# ----------------------------------------------------------------------
# Stages of a stream in threads of their own: what is read ahead, and what is left for another to finish.
#
# Compiled loops and file operations let go of the interpreter's lock, so reading, filtering and writing a
# long log keep two cores busy. Items come and go in their order, a few at a time, so neither the results
# nor
# the memory depend on the threads. An error of one stage ends the others and is raised to the caller.

T = TypeVar("T")

_DEPTH = 4
_WAIT_S = 0.1
_END = object()


def _put(items: queue.Queue[Any], item: Any, over: threading.Event) -> bool:
    """Add an item; False when the other side has ended."""
    while not over.is_set():
        with contextlib.suppress(queue.Full):
            items.put(item, timeout=_WAIT_S)
            return True
    return False


def ahead(source: Iterable[T], depth: int = _DEPTH) -> Iterator[T]:
    """The items of a source that another thread goes through, at most `depth` of them ahead."""
    items: queue.Queue[Any] = queue.Queue(depth)
    over = threading.Event()
    failed: list[BaseException] = []

    def produce() -> None:
        try:
            for item in source:
                if not _put(items, item, over):
                    return
        except BaseException as error:  # it is raised again where the items are taken
            failed.append(error)
        _put(items, _END, over)

    thread = threading.Thread(target=produce, daemon=True)
    thread.start()
    try:
        while (item := items.get()) is not _END:
            yield item
        if failed:
            raise failed[0]
    finally:
        over.set()
        thread.join()


@contextmanager
def behind(finish: Callable[[T], None], depth: int = _DEPTH) -> Iterator[Callable[[T], None]]:
    """A function that hands items to another thread, which finishes them in their order.

    All are finished when the block ends. An error in `finish` is raised by the next item or at the end.
    """
    items: queue.Queue[Any] = queue.Queue(depth)
    over = threading.Event()
    failed: list[BaseException] = []

    def consume() -> None:
        try:
            while (item := items.get()) is not _END:
                finish(item)
        except BaseException as error:  # it is raised again where the items come from
            failed.append(error)
            over.set()

    thread = threading.Thread(target=consume, daemon=True)
    thread.start()

    def hand(item: T) -> None:
        if not _put(items, item, over):
            raise failed[0]

    try:
        yield hand
    finally:
        # After an error, too, the thread ends before what it writes to is closed.
        _put(items, _END, over)
        thread.join()
    if failed:
        raise failed[0]


# ----------------------------------------------------------------------
# Compiling the estimator's functions at their first use, half of them in a process of its own.
#
# Numba holds a lock while it compiles, so threads gain nothing. What another process has compiled is found
# in
# numba's cache on disk. Where there is none, or no second processor, everything is compiled here.

_LONGEST_S = 600.0
_COMMAND = (
    "import sys; sys.path[:] = {path!r}; from calib.stages.estimator.replay import serve; serve({smoothed})"
)


def _few() -> Rows:
    """Three samples of an IMU at rest, enough for every function to be called."""
    readings = np.full((3, 5), np.nan)
    readings[:, 2:] = 9.81, 0.0, 0.0
    return Rows(np.array([0.0, 0.01, 0.02]), readings, np.full(3, 2))


def _nominal() -> Setup:
    """Any set-up: what is compiled depends on the types alone."""
    start = Start(np.zeros(len(SENSOR)), np.ones(len(SENSOR)))
    return Setup(np.ones(24), np.ones(len(NOISE)), start, 0.02)


def warm(setup: Setup, smoothed: bool = False) -> None:
    """Have the kinematic filter's functions, and with `smoothed` its smoother's, before the first row."""
    rows = _few()
    out = Filter(setup).run(rows)
    if smoothed:
        smooth(setup, rows, out)


@contextmanager
def driven_elsewhere(wanted: bool, smoothed: bool = False) -> Iterator[None]:
    """Compile the driven model's functions in another process when anything is compiled in this block.

    It has ended when the block ends. Where all is in numba's cache nothing is started.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command = _COMMAND.format(path=sys.path, smoothed=smoothed)
        with contextlib.suppress(OSError):
            started.append(
                subprocess.Popen(
                    [sys.executable, "-c", command],
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                )
            )  # fmt: skip

    try:
        with on_compiling(start) if wanted else contextlib.nullcontext():
            yield
        for other in started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                other.wait(_LONGEST_S)
    finally:
        for other in started:
            other.kill()
            other.wait()


def serve(smoothed: bool) -> None:
    """Compile what the driven model needs, in a process of its own."""
    from calib.stages.estimator.driven import DrivenFilter, smooth_driven

    rows, pwm, setup, drive = _few(), np.full((3, 2), np.nan), _nominal(), Drive()
    out = DrivenFilter(setup, drive).run(rows, pwm)
    if smoothed:
        smooth_driven(setup, drive, rows, pwm, out)


# ----------------------------------------------------------------------
# A whole log through filter and smoother; the states written are those of the smoother.


def joined(parts: list[Rows]) -> Rows:
    """Rows of a log in one piece."""
    return Rows(
        np.concatenate([part.t_s for part in parts]),
        np.concatenate([part.readings for part in parts]),
        np.concatenate([part.kinds for part in parts]),
    )


def first_rows(setup: Setup, found: Periods, stream: Iterable[Log], until_s: float) -> np.ndarray:
    """Rows (n, len(OUT)) of the kinematic smoother up to a time of the log [s], which may be its end."""
    parts = []
    for log in stream:
        rows = rows_of(log, found.ticks)
        some = rows.t_s <= until_s
        parts.append(Rows(rows.t_s[some], rows.readings[some], rows.kinds[some]))
        if not some.all():
            break
    whole = joined(parts)
    return np.asarray(smooth(setup, whole, Filter(setup).run(whole)))


def smooth_log(
    setup: Setup, found: Periods, stream: Iterable[Log], output: Path | None, drive: Drive | None = None
) -> tuple[Tally, Tally, list[np.ndarray]]:
    """Sums of the smoother and of the filter, and for figures its rows with the truth, block by block.

    With a `drive` both models are smoothed and weighed.

    Raises `BadInputError` where `output` cannot be written.
    """
    fused, parts, outs, truths = Filter(setup), [], [], []
    both, pwm, driven, kinematic = None, [], [], []
    if drive is not None:
        from calib.stages.estimator.driven import Handover, blended, smooth_both

        both = Handover(setup, drive)
    for log in stream:
        rows, truth = rows_of(log, found.ticks), truth_of(log)
        parts.append(rows)
        if both is None:
            outs.append(fused.run(rows))
        else:
            pwm.append(pwm_of(log))
            one, other, weight = both.run_each(rows, pwm[-1])
            outs.append(blended(one, other, weight))
            driven.append(one)
            kinematic.append(other)
        truths.append(np.full((len(log), 3), np.nan) if truth is None else truth)
    whole, filtered, truth = joined(parts), np.concatenate(outs), np.concatenate(truths)
    if drive is None:
        smoothed = smooth(setup, whole, filtered)
    else:
        smoothed = smooth_both(
            setup, drive, whole, np.concatenate(pwm), np.concatenate(driven), np.concatenate(kinematic)
        )
    before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
    before.add(filtered, truth)
    after.add(smoothed, truth)
    if output is not None:
        with states_writer(output) as states:
            states.add(smoothed[:, [OUT.index(name) for name in STATES]])
    traced = np.concatenate([smoothed, np.full((len(whole), 3), np.nan), truth], axis=1)
    return after, before, [traced]


# ----------------------------------------------------------------------
# One log through an estimator: states written, errors and consistency summed, a verdict.

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
    drive = drive_for(model, first, found, rig, path)
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


def drive_for(model: str, first: Log, found: Any, rig: Rig, path: Path) -> Drive | None:
    if model == "kinematic":
        return None
    told = has_commands(first)
    if told and found.camera and found.imu:
        return replace(drive_from_rig(rig), imu_noise=noise_at_rest(rig, found))
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
        from calib.stages.estimator.driven import DrivenFilter

        alone = DrivenFilter(setup, drive)
        return lambda rows, log: alone.run(rows, pwm_of(log))
    from calib.stages.estimator.driven import Handover

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

"""One log through an estimator, block by block: states written, errors and consistency summed, a verdict.

A log of a day has millions of rows, so nothing here grows with its length but what a caller asks to keep.
Smoothing alone needs the whole log in memory.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain, pairwise, product
from pathlib import Path
from typing import TypeVar

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import on_compiling
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.result import finite_or_none, judged
from calib.core.rig import Rig
from calib.core.stage import ProgressCall
from calib.core.units import unit_of
from calib.core.verdict import Finding, Severity, Verdict
from calib.core.words import counted
from calib.io.columns import BASELINE, STATES
from calib.io.logs import Log
from calib.io.sensor_faults import Watch
from calib.io.states import states_writer
from calib.io.tables import Passed
from calib.solve.clock import clock_step_s
from calib.stages.estimator.baseline import Baseline
from calib.stages.estimator.consistency import SENSORS, SETTLED_S, Tally
from calib.stages.estimator.driven import (
    Drive,
    DrivenFilter,
    Handover,
    blended,
    smooth_both,
    smooth_driven,
)
from calib.stages.estimator.event import NOISE
from calib.stages.estimator.kinematic import OUT, Filter, Rows, Setup, Start, starting_state
from calib.stages.estimator.noise import jitter_px, with_jitter
from calib.stages.estimator.read import (
    READINGS,
    Periods,
    baseline_setup,
    bend_apart_rad,
    blocks,
    drive_from_rig,
    has_commands,
    noise_at_rest,
    periods,
    rows_of,
    scored_by_pose,
    seen_by,
    setup_from_rig,
    stuck_place,
    truth_of,
)
from calib.stages.estimator.section import Errors, Held, Replayed, SensorCheck
from calib.stages.estimator.sensors import QUANTITIES, SENSOR, rest_reading
from calib.stages.estimator.smoother import smooth

T = TypeVar("T")

# ----------------------------------------------------------------------
# Reading ahead and writing behind, each in a thread of its own.
#
# Compiled loops and file operations let go of the interpreter's lock, so reading, filtering and writing a
# long log keep two cores busy. Items come and go in their order, a few at a time, so neither the results nor
# the memory depend on the threads.

_DEPTH = 4


def ahead(source: Iterable[T]) -> Iterator[T]:
    """The items of a source that another thread goes through, a few of them ahead."""
    iterator = iter(source)
    with ThreadPoolExecutor(1) as pool:
        waiting = deque(pool.submit(next, iterator, None) for _ in range(_DEPTH))
        try:
            while (item := waiting.popleft().result()) is not None:
                waiting.append(pool.submit(next, iterator, None))
                yield item
        finally:
            for one in waiting:
                one.cancel()


@contextmanager
def behind(finish: Callable[[T], None]) -> Iterator[Callable[[T], None]]:
    """A function that hands items to another thread, which finishes them in their order.

    All are finished when the block ends. An error in `finish` is raised by a later item or at the end.
    """
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(1) as pool:

        def hand(item: T) -> None:
            if len(waiting) >= _DEPTH:
                waiting.popleft().result()
            waiting.append(pool.submit(finish, item))

        yield hand
        for one in waiting:
            one.result()


# ----------------------------------------------------------------------
# Compiling at the first use, half of it in a process of its own: numba holds a lock while it compiles, so
# threads gain nothing. What another process has compiled is in numba's cache on disk.

_LONGEST_S = 600.0
_COMMAND = (
    "import sys; sys.path[:] = {path!r}; "
    "from calib.stages.estimator.replay import compile_filters; compile_filters(True, {smoothed})"
)


def compile_filters(driven: bool, smoothed: bool) -> None:
    """Have the functions of the kinematic or of the driven filter compiled, with `smoothed` its smoother's.

    What is compiled depends on types alone, so three samples of an IMU at rest and any set-up will do.
    """
    readings = np.full((3, 5), np.nan)
    readings[:, 2:] = 9.81, 0.0, 0.0
    rows = Rows(np.array([0.0, 0.01, 0.02]), readings, np.full(3, 2))
    start = Start(np.zeros(len(SENSOR)), np.ones(len(SENSOR)))
    setup = Setup(np.ones(25), np.ones(len(NOISE)), start, 0.02)
    if driven:
        out = DrivenFilter(setup, Drive()).run(rows)
        if smoothed:
            smooth_driven(setup, Drive(), rows, out)
    else:
        out = Filter(setup).run(rows)
        if smoothed:
            smooth(setup, rows, out)


@contextmanager
def _compiling_both(smoothed: bool) -> Iterator[None]:
    """When anything is compiled in this block, compile the driven filter in another process meanwhile.

    It has ended when the block ends. Where all is in numba's cache nothing is started.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command = [sys.executable, "-c", _COMMAND.format(path=sys.path, smoothed=smoothed)]
        quiet = subprocess.DEVNULL
        with contextlib.suppress(OSError):
            started.append(subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet))

    try:
        with on_compiling(start):
            yield
        for other in started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                other.wait(_LONGEST_S)
    finally:
        for other in started:
            other.kill()
            other.wait()


# ----------------------------------------------------------------------
# A log that is open, with the set-up that its beginning and the rig ask for.

MODELS = ("auto", "kinematic", "driven")
_JITTER_ROWS = 6000


@dataclass
class OpenLog:
    """A log and how to filter it.

    Attributes
    ----------
    stream : all its blocks. first : the first of them.
    remarks : on what is assumed, and once the stream has ended on what was passed over.
    """

    path: Path
    setup: Setup
    periods: Periods
    first: Log
    stream: Iterator[Log]
    remarks: list[str]

    @property
    def both(self) -> bool:
        """Whether it has pictures and IMU samples."""
        return bool(self.periods.camera and self.periods.imu)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        parts = self.path.iterdir() if self.path.is_dir() else (self.path,)
        return sum(part.stat().st_size for part in parts)


def opened(path: Path, rig: Rig, rig_path: Path, options: LogOptions = NOTHING_STATED) -> OpenLog:
    """A log with its set-up; the tracker's jitter comes from its beginning where neither estimator nor
    alignment says it.

    Raises `BadInputError` for a log or a rig that cannot be used.
    """
    stream = blocks(path, options, rig.picture_px, rig.plant.rest_length_m)
    first = next(stream)
    found = periods(first)
    setup, remarks = setup_from_rig(rig, rig_path, found)
    if first.map is not None and first.map.narration:
        remarks.append(first.map.narration)
    stated = rig.estimator is not None or (rig.align is not None and rig.align.jitter_px > 0.0)
    if found.camera and (found.pose or not stated):
        part = rows_of(first, found)[:_JITTER_ROWS]
        setup = with_jitter(setup, jitter_px(setup, [part]).value)
    return OpenLog(path, setup, found, first, _noted(chain([first], stream), remarks), remarks)


def _noted(stream: Iterator[Log], remarks: list[str]) -> Iterator[Log]:
    """The blocks, and at their end sentences on what was passed over in them."""
    passed = Passed()
    for log in stream:
        passed += log.passed
        yield log
    remarks.extend(passed.sentences)


def drive_for(log: OpenLog, rig: Rig, model: str) -> Drive | None:
    """The driven model, None where it is not wanted or, with "auto", where the log lacks what it needs.

    Raises `BadInputError` where "driven" is asked for and the log lacks it.
    """
    if model == "kinematic":
        return None
    commands = has_commands(log.first)
    if commands and log.both:
        return replace(drive_from_rig(rig), imu_noise=noise_at_rest(rig, log.periods))
    if model == "driven":
        found = log.periods
        lacks = "commands (pwm1, pwm2)" if not commands else "pictures" if not found.camera else "IMU samples"
        raise BadInputError(
            f"{shown(log.path)}: the driven model needs commands, camera and IMU, found no {lacks}"
        )
    return None


def estimator_for(setup: Setup, drive: Drive | None, model: str) -> Filter | DrivenFilter | Handover:
    """The filter of a model, with both where "auto" has a `drive`."""
    if drive is None:
        return Filter(setup)
    return DrivenFilter(setup, drive) if model == "driven" else Handover(setup, drive)


# ----------------------------------------------------------------------
# A whole log through filter and smoother.

_SMOOTHED_ROWS = 1_000_000
"""The smoother keeps 1.6 kB for each row with the kinematic model alone."""
_FILTERPY_ROWS = 100_000
"""Filterpy's filter keeps 13 kB for each row and takes two minutes for so many."""


def smoothed_rows(log: OpenLog, until_s: float) -> FloatArray:
    """Rows (n, len(OUT)) of the kinematic smoother up to a time of the log [s], which may be its end."""
    parts = []
    for block in log.stream:
        rows = rows_of(block, log.periods)
        some = rows.t_s <= until_s
        parts.append(rows[some])
        if not some.all():
            break
    whole = Rows.joined(parts)
    return smooth(log.setup, whole, Filter(log.setup).run(whole))


@dataclass(frozen=True)
class Smoothed:
    """Rows of `OUT` of a whole log by the filter and by the smoother, the truth (n, 3), and what the filter
    has come to say of the sensors (14,) and of the rest length."""

    filtered: FloatArray
    out: FloatArray
    truth: FloatArray
    sensor: FloatArray
    longer_m: tuple[float, float] | None


def _whole(setup: Setup, found: Periods, stream: Iterable[Log]) -> tuple[Rows, FloatArray]:
    """Rows of a log in one piece, and the truth (n, 3), NaN where it is not known."""
    parts, truths = [], []
    for block in stream:
        parts.append(rows_of(block, found))
        truth = truth_of(block, setup)
        truths.append(np.full((len(block), 3), np.nan) if truth is None else truth)
    return Rows.joined(parts), np.concatenate(truths)


def filterpy_log(log: OpenLog, stream: Iterable[Log]) -> tuple[FloatArray, FloatArray, Finding]:
    """Rows of `OUT` by filterpy's extended filter, the truth (n, 3), and how far ours is away."""
    from calib.stages.estimator.reference import replayed

    rows, truth = _whole(log.setup, log.periods, stream)
    out, apart = replayed(log.setup, rows)
    text = f"the compiled filter with the same one level of noise is at most {apart:.0e} sigma away"
    return out, truth, Finding("remark", text)


def smooth_log(setup: Setup, found: Periods, stream: Iterable[Log], drive: Drive | None = None) -> Smoothed:
    """A log filtered and smoothed as a whole; with a `drive` both models are weighed."""
    rows, truth = _whole(setup, found, stream)
    if drive is None:
        fused = Filter(setup)
        filtered = fused.run(rows)
        return Smoothed(filtered, smooth(setup, rows, filtered), truth, fused.sensor, None)
    both = Handover(setup, drive)
    driven, kinematic, weight = both.run_each(rows)
    out = smooth_both(setup, drive, rows, driven, kinematic)
    return Smoothed(blended(driven, kinematic, weight), out, truth, both.sensor, both.longer_m)


def _watched(stream: Iterator[Log], watch: Watch, most: int, option: str) -> Iterator[Log]:
    """The blocks of a log that may be held in memory as a whole, with a watch over its sensors."""
    rows = 0
    for log in stream:
        watch.add(log)
        rows += len(log)
        if rows > most:
            raise BadInputError(
                f"{log.source}: has more than {most} rows, which {option} would hold in memory; "
                f"leave {option} out or cut the log"
            )
        yield log


# ----------------------------------------------------------------------
# Sums over the blocks of a log.

_MOST_POINTS = 6000


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


@dataclass
class Sums:
    """What is summed over the rows of `OUT` of a log.

    Attributes
    ----------
    fused, baseline : errors and consistency. watch : over the sensors. trace : None where no figure is
    wanted. weighed, driven : rows with two models, and those in which the driven one speaks.
    """

    fused: Tally
    baseline: Tally
    watch: Watch
    trace: Trace | None = None
    weighed: int = 0
    driven: int = 0

    def add(
        self,
        out: FloatArray,
        truth: FloatArray | None,
        held: FloatArray | None = None,
        marker_px: FloatArray | None = None,
    ) -> None:
        """Rows that follow, with the truth (n, 3), rows of the baseline and readings (n, 2) of the camera
        where there are any.
        """
        weight = out[:, OUT.index("driven_weight")]
        self.weighed += int(np.isfinite(weight).sum())
        self.driven += int(np.count_nonzero(weight >= 0.5))
        self.fused.add(out, truth, marker_px)
        if held is not None:
            self.baseline.add(_as_out(held), truth)
        if self.trace is not None:
            blank = np.full((len(out), 3), np.nan)
            parts = (out, blank if held is None else held[:, 1:4], blank if truth is None else truth)
            self.trace.add(np.concatenate(parts, axis=1))


def _as_out(held: FloatArray) -> FloatArray:
    """The baseline's columns in the places of the fused filter's, for the sums."""
    out = np.full((len(held), len(OUT)), np.nan)
    out[:, 0], out[:, 1], out[:, 2], out[:, 5] = held[:, 0], held[:, 1], held[:, 2], held[:, 3]
    out[:, 10:13] = 1.0
    out[:, OUT.index("flags")] = 0.0
    return out


# ----------------------------------------------------------------------
# Rules.

_NIS_FACTOR = 2.0
_WIDE = 1.5
"""Sigma that is too large by less is not told."""
_GATED_SHARE = 0.05
_OF_CAMERA, _FEWEST = 0.4, 100
"""Pictures are whole pixels with a jitter of their own: on 108 good logs of nine plants, wrong ones among
them, the correlation stayed within .22; where a column was not what it said it was .56 to 1."""
_AWAY = 3.2
"""Deviations: one of seven quantities is off by as much in one of a hundred logs at most."""
_PLACES = {"camera": "pictures", "pose": "poses"}
"""Names of what sees the place, and words for its readings."""
_CALIBRATED = {
    "gyro_bias_radps": 1e-3,
    "gyro_scale": 0.005,
    "time_offset_s": 1e-3,
    "accel_scale_x": 0.01,
    "accel_scale_y": 0.01,
}
_REST_RAD, _REST_MPS2 = math.radians(0.15), 0.03
"""What a log may tell better than the calibration did, and from which difference on that matters: a
hundredth of gravity or half of one of the motion, a millisecond; last the angle and the size of what the
accelerometer reads at rest, of which 47 sound logs of ten rigs have 0.03 degrees and 0.004 m/s^2 at most,
and logs whose pictures are two pixels aside 0.2 degrees and more."""
_FLAGGED_SHARE = _LATE_SHARE = 0.05


def sampled(watch: Watch) -> Iterator[Finding]:
    """Findings on sensors that are not there, do not move, or contradict each other."""
    sensors = watch.names[:2], watch.names[4:], watch.names[2:4]
    camera, gyro, accel = (watch.has(*names) for names in sensors)
    if not camera:
        yield Finding("poor", "the log has no pictures: the length is known from the prior alone")
    if not (gyro or accel):
        what = "the camera" if sensors[0] == READINGS[:2] else "the tip's place"
        yield Finding("poor", f"the log has no IMU samples: angle and length come from {what} alone")
    elif not gyro:
        yield Finding("poor", "the log has no gyroscope (gz_radps)")
    elif not accel:
        yield Finding("poor", "the log has no accelerometer (ax_mps2, ay_mps2)")
    yield from (one for one in watch.findings() if one.severity == "inconsistent")


def consistent(
    checks: Mapping[str, SensorCheck], flags: Mapping[str, int], rows: int, repeating: float | None = None
) -> Iterator[Finding]:
    """Findings on innovations that contradict their covariance, and on stretches without a sensor.

    Parameters
    ----------
    repeating : correlation of the camera's innovations as far as it counts, of whole pixels.
    """
    for name, check in checks.items():
        if check.nis is not None and check.correlation is not None:
            ratio = check.nis / check.degrees
            if not 1.0 / _WIDE**2 <= ratio <= _NIS_FACTOR:
                # Of a sensor quieter than expected no state is given away for better than it is.
                wide = f": its sigma, and that of the states, is up to {ratio**-0.5:.1f} times too large"
                yield Finding(
                    "remark" if ratio < 1.0 else "poor",
                    f"the innovations of the {name} are {ratio:.2g} times what the covariance expects"
                    + (wide if ratio < 1.0 else "")
                    + ("" if name == "pose" else "; calib replay --tune learns the noise of this rig"),
                )
            correlation = check.correlation if name != "camera" or repeating is None else repeating
            repeats = name in _PLACES and check.readings >= _FEWEST
            if repeats and abs(correlation) > _OF_CAMERA:
                yield Finding(
                    "poor",
                    f"the {_PLACES[name]} contradict the IMU: their innovations repeat, "
                    f"{correlation:.2f} with the one before",
                    "check the columns of this log: their order, signs, units and times"
                    + (", and where the base is" if name == "pose" else ""),
                )
        if not check.readings:
            yield Finding("poor", f"all {check.gated} readings of the {name} were gated out")
        elif check.gated > _GATED_SHARE * (check.readings + check.gated):
            share = f"{100.0 * check.gated / (check.readings + check.gated):.0f} % of the {name}'s readings"
            yield Finding("poor", f"{share} were gated out")
    # A sensor that is not in the log has a sentence of its own.
    for flag, sentence, here in (
        ("camera_silent", "the camera is silent", "camera" in checks),
        ("camera_silent", "the motion capture is silent", "pose" in checks),
        ("imu_silent", "the IMU is silent", bool({"accel", "gyro"} & set(checks))),
        ("held_by_prior", "no sensor bounds length or angle, the prior does", True),
        ("not_started", "nothing is known yet", True),
    ):
        if here and flags.get(flag, 0) > _FLAGGED_SHARE * rows:
            yield Finding("poor", f"{sentence} in {100.0 * flags[flag] / rows:.0f} % of the rows")
    if flags.get("time_jump"):
        yield Finding("poor", f"jumps of the time: {flags['time_jump']}; the filter starts again after each")
    if flags.get("restarted"):
        text = f"the filter started again {counted(flags['restarted'], 'time')} after rejecting all readings"
        yield Finding("remark", text)
    if late := flags.get("late"):
        severity: Severity = "poor" if late > _LATE_SHARE * rows else "remark"
        yield Finding(severity, f"{counted(late, 'reading')} came too late to be used")


def contradicting(
    setup: Setup, sensor: FloatArray, duration_s: float, place: str = "pictures"
) -> Iterator[Finding]:
    """Findings on what the log says of the sensors against what their calibration does.

    The calibration's error and the sensor's walk over the log bound how far the two may be apart, however
    much the log knows. A column that is not what it says turns what the camera, gravity and the gyroscope
    have to agree on.

    Parameters
    ----------
    sensor : (14,) of `Filter.sensor`. duration_s : of the log.
    """
    (before, *_), (P, *_), _ = starting_state(setup)
    V = P[6:, 6:] + np.diag(np.square(setup.process.sensor_walk)) * max(duration_s, 0.0)
    each = np.eye(len(SENSOR))
    compared = [
        (QUANTITIES[name].words, unit_of(name), least, sensor[k] - before[6 + k], each[k])
        for k, name, least in ((SENSOR.index(name), name, least) for name, least in _CALIBRATED.items())
    ]
    (angle, size), by = rest_reading(before[6:])
    new_angle, new_size = rest_reading(sensor)[0]
    turned = math.remainder(new_angle - angle, math.tau)
    compared.append(("the angle that the accelerometer reads at rest", "rad", _REST_RAD, turned, by[0]))
    compared.append(("gravity by the accelerometer", "m/s²", _REST_MPS2, new_size - size, by[1]))
    for words, unit, least, away, gradient in compared:
        sigma = math.sqrt(float(gradient @ V @ gradient))
        if not abs(away) <= max(_AWAY * sigma, least):
            of = f" of the {place}" if unit == "s" else ""
            yield Finding(
                "poor",
                f"{words}{of} is {away:+.2g}{f' {unit}' if unit else ''} away from its calibration, "
                f"{abs(away) / sigma:.1f} times its sigma",
                "check the columns of this log; or the camera, the IMU or the rig has moved since its "
                "calibration: find the plane again (calib extrinsics), and run calib align again",
            )


_JUMPED = 7.0
"""140 simulated logs of ten kinds have 6.4 at most, wrong calibrations 5; 3 px along the actuator 8 to 12."""


def jumped(tally: Tally) -> Iterator[Finding]:
    """A finding where the pictures jump and the IMU does not."""
    size, at_s = tally.jump
    if size > _JUMPED:
        yield Finding(
            "inconsistent",
            f"at {at_s:.1f} s the marker jumps in the pictures, by {size:.1f} deviations, and the IMU does "
            "not: the camera or the marker has moved",
            "cut the log there, and calibrate the plane anew (calib extrinsics) for what comes after",
        )


_LONGER_M = 5e-4
"""Other rest length that is told. Logs of sound rigs, one of an orifice and one without creep, have .2 mm at
most; pictures two pixels along the actuator .8 to 2, with q1 and q2 as far off."""


def grown(longer_m: float, sigma_m: float) -> Iterator[Finding]:
    """A finding where the actuator is longer, or shorter, than commands and its identification say.

    Parameters
    ----------
    longer_m, sigma_m : of `DrivenFilter.longer_m`.
    """
    if abs(longer_m) > max(_LONGER_M, _AWAY * sigma_m):
        yield Finding(
            "poor",
            f"the actuator rests {1e3 * abs(longer_m):.1f} mm {'longer' if longer_m > 0 else 'shorter'} than "
            f"identified, {abs(longer_m) / sigma_m:.1f} times its sigma: the camera has moved along it, or "
            "it has changed",
            "find the plane again (calib extrinsics); if that is as it was, measure the rest length again, "
            "where known states it, and run calib identify again",
        )


_NO_ARC_RAD = math.radians(3.0)
"""A tip that is 1 mm beside its place turns the arc of 65 mm by 1.8 degrees."""


def captured(first: Log, pose: bool) -> Iterator[Finding]:
    """Findings where the tip's angle is not that of the arc from the base to its place, and where that, or
    the marker, stands still while the gyroscope turns; `pose` where it stands for pictures.
    """
    apart = bend_apart_rad(first)
    if apart > _NO_ARC_RAD:
        yield Finding(
            "poor" if pose else "remark",
            f"tip_phi_rad is {math.degrees(apart):.1f} degrees (RMS) off the arc from the base to tip_x_m, "
            "tip_y_m",
            "look at their order, signs and units: x and phi grow to one side, y from the base along the "
            "straight actuator",
        )
    stuck = stuck_place(first) if pose else stuck_place(first, READINGS[:2])
    if stuck is not None and stuck[2] > _NO_ARC_RAD:
        what, lost = ("tip", "motion capture") if pose else ("marker", "tracker")
        yield Finding(
            "inconsistent",
            f"the {what}'s place stays the same to the digit from {stuck[0]:.1f} to {stuck[1]:.1f} s, in "
            f"which the gyroscope turns by {math.degrees(stuck[2]):.0f} degrees to and fro",
            f"the {lost} has lost the {what}: leave these cells blank",
        )


_COARSE_S, _SHARED = 0.02, 1.5
"""Steps of a clock from which on states are off by more than their sigma, and samples in a step."""


def coarse(log: OpenLog) -> Iterator[Finding]:
    """A finding where a clock's steps are so long that several readings of a sensor bear one stamp."""
    step, periods = clock_step_s(log.first.t_s), (log.periods.camera_s, log.periods.imu_s)
    if step > max(_COARSE_S, _SHARED * float(np.nanmin([*periods, math.inf]))):
        yield Finding(
            "poor",
            f"t_s comes in steps of {1e3 * step:.3g} ms, each of which several readings share",
            "write t_s with six decimals, as each reading is taken",
        )


_SEARCHED_ROWS, _SEARCHED = 2000, 6
"""Rows that are searched for a delay at once, and how many such stretches."""
_SHIFTS, _LATEST = (-4, -1, 1, 4), 50
_TURNING_RADPS = 0.05
_REPEATING = 0.08
_GAIN = 60.0
"""Of the logarithm of the likelihood, over no delay and over the opposite one: in 176 moving logs of 16 rigs
of six kinds, wrong models among them, a delay that was none gained 7 at most, in those of the demo 12; one
sample's of one column gains 100 to 500."""
_PART_ROWS, _MOST_OF_PART = 25, 5.0
"""Rows of a part of a stretch, and the gain or loss of it that counts at most. Of delays the parts gain 1.1
to 8 of their deviations together; where some rows of a pump's jerks gain hundreds -.8 to -.2."""
_TOGETHER = {
    ("ay_mps2",): "ay_mps2 comes {} the other readings",
    ("gz_radps",): "gz_radps comes {} the other readings",
    READINGS[2:]: "the IMU comes {} the pictures, other than in the logs of its alignment",
}
"""Columns that may be late as one, and how that is said. A delay of ax alone does states no harm."""


def _moving(setup: Setup, rows: Rows) -> list[Rows]:
    """The stretches that are searched for delays: equal ones that turn, those that turn most first.

    A clock that steps midway is right in the others.
    """
    ends = np.linspace(0, len(rows), math.ceil(len(rows) / _SEARCHED_ROWS) + 1).astype(int).tolist()
    bias = setup.start.sensor[SENSOR.index("gyro_bias_radps")]
    turning = {
        (a, b): float(np.mean(np.nan_to_num(rows.readings[a:b, 4] - bias) ** 2)) for a, b in pairwise(ends)
    }
    moving = [
        ab for ab in sorted(turning, key=turning.__getitem__, reverse=True) if turning[ab] > _TURNING_RADPS**2
    ]
    return [rows[a:b] for a, b in moving[:_SEARCHED]]


def untimely(setup: Setup, rows: Rows, place: str = "pictures") -> Iterator[Finding]:
    """A finding where other times of some column make a stretch of the log much likelier.

    Each of `_TOGETHER` is moved by some samples, and the kinematic filter runs again; a move that gains goes
    on while it does. One column's delay looks like the opposite one of the others: what gains nearly as much
    as the best is named beside it. A delay in a log at rest shows nothing. Other faults look like delays, but
    in each stretch like another one.
    """
    found: list[tuple[dict[str, int], str]] = []
    sure = False
    for stretch in _moving(setup, rows):
        late, gains_throughout = _late(setup, stretch)
        if late:
            sure |= gains_throughout
            a, b = stretch.t_s[[0, -1]].tolist()
            period_ms = 1e3 * float(np.median(np.diff(stretch.taken_s[stretch.kinds >= 2])))
            words = ", or ".join(
                text.format(f"{abs(shift) * period_ms:.0f} ms {'after' if shift > 0 else 'before'}")
                for text, shift in late.items()
            ).replace("pictures", place)
            between = f"from {a:.1f} to {b:.1f} s " if len(stretch) < len(rows) else ""
            found.append((late, between + words))
        if len(found) == 2:
            break
    if not found:
        return
    texts = [text for _, text in found]
    first, last = found[0][0], found[-1][0]
    same = [first[text] for text in first.keys() & last.keys() if abs(last[text] - first[text]) < 2]
    if any(abs(shift) < _LATEST for shift in same):
        advice = "check how the log gets its times, or run calib align on logs of the same recorder"
        if sure:
            yield Finding("inconsistent", texts[0], advice)
    else:
        yield Finding(
            "inconsistent",
            f"the readings contradict each other, by no one delay: as if {', but '.join(texts)}",
            "check the columns of this log: their order, signs and units, and the pictures' resolution; or "
            "the camera or the IMU has moved since the alignment",
        )


def throughout(gained: FloatArray) -> bool:
    """Whether rows (n,) gain likelihood by a delay wherever the head turns, as of a sensor that is late.

    Where the filter cannot follow the jerks of a pump a few rows gain much, and most lose.
    """
    parts = np.add.reduceat(gained, np.arange(0, len(gained), _PART_ROWS))
    parts = np.clip(parts, -_MOST_OF_PART, _MOST_OF_PART)
    return bool(parts.sum() > np.linalg.norm(parts))


def _late(setup: Setup, rows: Rows) -> tuple[dict[str, int], bool]:
    """Samples by which columns come late in a stretch, by what is said of it, the likeliest first.

    Second whether one of them gains throughout.
    """
    at = OUT.index("log_likelihood")

    @cache
    def each(names: tuple[str, ...], shift: int) -> FloatArray:
        moved = replace(rows, readings=rows.readings.copy())
        for column in map(READINGS.index, names):
            sampled = np.flatnonzero(np.isfinite(rows.readings[:, column]))
            taken = np.clip(np.arange(len(sampled)) + shift, 0, len(sampled) - 1)
            moved.readings[sampled, column] = rows.readings[sampled[taken], column]
        return np.nan_to_num(Filter(setup).run(moved)[:, at])

    def likelihood(names: tuple[str, ...], shift: int) -> float:
        return float(each(names, shift).sum())

    def gains(names: tuple[str, ...], shift: int) -> bool:
        known, nearest = likelihood((), 0), max(likelihood(names, -1), likelihood(names, 1))
        if nearest < known - _GAIN:
            return False
        return likelihood(names, shift) > max(known, likelihood(names, -shift)) + _GAIN

    sensed = {name for k, name in enumerate(READINGS) if np.isfinite(rows.readings[:, k]).any()}
    # Readings are late against others.
    searched = [names for names in _TOGETHER if sensed.intersection(names) and sensed.difference(names)]
    found: dict[tuple[str, ...], tuple[float, int]] = {}
    for names, shift in product(searched, _SHIFTS):
        if gains(names, shift):
            step = 1 if shift > 0 else -1
            while abs(shift) < _LATEST and likelihood(names, shift + step) > likelihood(names, shift):
                shift += step
            found[names] = max(found.get(names, (-math.inf, 0)), (likelihood(names, shift), shift))
    best = max((value for value, _ in found.values()), default=0.0)
    likely = {
        names: shift
        for names, (value, shift) in sorted(found.items(), key=lambda item: -item[1][0])
        if value > best - _GAIN
    }
    late = {_TOGETHER[names]: shift for names, shift in likely.items()}
    return late, any(throughout(each(*move) - each((), 0)) for move in likely.items())


# ----------------------------------------------------------------------
# The whole of it.

_COLUMNS = [OUT.index(name) for name in STATES]


def replay_log(
    path: Path,
    rig: Rig,
    rig_path: Path,
    estimator: str = "fused",
    model: str = "auto",
    smoothed: bool = False,
    options: LogOptions = NOTHING_STATED,
    output: Path | None = None,
    progress: ProgressCall | None = None,
    figures: bool = False,
    keep: bool = False,
) -> Replayed:
    """Run one log and write its states.

    Parameters
    ----------
    estimator : "fused", "baseline" for the low-pass pipeline that it replaces, or "filterpy".
    model : one of `MODELS`: driven by the commands or kinematic, "auto" both where the log has commands,
        camera and IMU, each speaking where it is the better.
    smoothed : look at the whole log, forward and backward.
    options : what a person states of the log.
    output : file for the states. keep : hold them in memory where there is none.
    figures : keep a trace of the rows for figures.

    Raises `BadInputError` for a log or a rig that cannot be used.
    """
    driven = estimator == "fused" and model != "kinematic"
    with _compiling_both(smoothed) if driven else contextlib.nullcontext():
        compile_filters(False, smoothed)
        log = opened(path, rig, rig_path, options)
    fused = estimator != "baseline"
    if not fused and (not log.both or log.periods.pose):
        raise BadInputError(f"{shown(path)}: the baseline needs camera and IMU, and the log lacks one")
    drive = drive_for(log, rig, model)
    log = replace(log, setup=replace(log.setup, process=log.setup.process.beside(hand=drive is None)))
    radius_m = log.setup.bellows_radius_m
    watch = Watch(seen_by(log.first))
    sums = Sums(Tally(radius_m), Tally(radius_m), watch, trace=Trace() if figures else None)
    columns = STATES if fused else BASELINE
    kept: list[FloatArray] = []
    compared: dict[str, Errors] = {}
    sensor: FloatArray | None = None
    longer_m: tuple[float, float] | None = None
    findings = _unstated(rig) if has_commands(log.first) or rig.standing["actuator"] else []
    with _states_to(output, columns, kept.append if keep else None) as write:
        if estimator == "filterpy":
            stream = _watched(log.stream, sums.watch, _FILTERPY_ROWS, "--estimator filterpy")
            out, truth, apart = filterpy_log(log, stream)
            findings.append(apart)
            sums.add(out, truth)
            write(out[:, _COLUMNS])
        elif smoothed:
            stream = _watched(log.stream, sums.watch, _SMOOTHED_ROWS, "--smooth")
            whole = smooth_log(log.setup, log.periods, stream, drive)
            sums.add(whole.out, whole.truth)
            sensor, longer_m = whole.sensor, whole.longer_m
            filtered = Tally(radius_m)
            filtered.add(whole.filtered, whole.truth)
            if filtered.scored:
                compared["filter"] = filtered.rmse()
            write(whole.out[:, _COLUMNS])
        else:
            pictures = log.both and not log.periods.pose
            baseline = Baseline(baseline_setup(log.setup, rig, rig_path, log.periods)) if pictures else None
            estimate = estimator_for(log.setup, drive, model)
            _stream(log, estimate.run, baseline, fused, sums, write, progress)
            sensor, longer_m = estimate.sensor, estimate.longer_m
            if fused and sums.baseline.scored:
                compared["baseline"] = _lengths_and_angle(sums.baseline)
            elif not fused and sums.fused.scored:
                compared["fused"] = sums.fused.rmse()
    states = np.concatenate(kept) if kept else None
    trace = sums.trace.values if sums.trace is not None else np.zeros((0, 0))
    name = estimator if not smoothed else "smoothed"
    # An actuator that its logs do not bear out is a model that errs, which moves the rest length as well.
    if fused and longer_m is not None and rig.actuator is not None and rig.actuator.verdict.ok:
        findings += grown(*longer_m)
    result = _replayed(log, name, sums, compared, sensor, findings)
    result.doubt(rig.doubts(_taken(log, drive is not None)))
    return result.with_evidence(Held(trace, columns, states))


def _unstated(rig: Rig) -> list[Finding]:
    """A remark on the radius, which no log tells."""
    if "bellows_radius_m" in rig.standing["actuator"]:
        return []
    text = (
        f"nobody has stated the bellows' radius: with {1e3 * rig.plant.bellows_radius_m:g} mm for it, each "
        "millimetre that it is off moves q1 and q2 by half a millimetre at 30 degrees"
    )
    advice = "measure the bellows' radius, and state it as known: {actuator: {bellows_radius_m: ...}}"
    return [Finding("remark", text, advice)]


def _taken(log: OpenLog, driven: bool) -> list[str]:
    """Sections that states of this log follow from."""
    optics = ["camera", "plane"] if log.periods.camera and not log.periods.pose else []
    inertial = ["imu", "align"] if log.periods.imu else []
    return [*optics, *inertial, *(["actuator", "pump"] if driven else []), "estimator"]


@contextmanager
def _states_to(
    output: Path | None, columns: tuple[str, ...], keep: Callable[[FloatArray], None] | None
) -> Iterator[Callable[[FloatArray], None]]:
    """Where states go: into a file, to a caller, or nowhere."""
    if output is not None:
        with states_writer(output, columns) as add:
            yield add
    else:
        yield keep or (lambda rows: None)


def _stream(
    log: OpenLog,
    estimate: Callable[[Rows], FloatArray],
    baseline: Baseline | None,
    fused: bool,
    sums: Sums,
    write: Callable[[FloatArray], None],
    progress: ProgressCall | None,
) -> None:
    """Filter block by block, reading ahead and summing and writing behind."""
    done, size = 0, log.size

    def finish(item: tuple[Log, Rows, FloatArray]) -> None:
        block, rows, out = item
        truth, held = truth_of(block, log.setup), None
        if baseline is not None and (truth is not None or sums.trace is not None or not fused):
            held = baseline.run(rows)
        sums.watch.add(block)
        sums.add(out, truth, held, rows.readings[:, :2])
        if fused or held is None:
            write(out[:, _COLUMNS])
        else:
            write(held)

    with behind(finish) as hand:
        for block in ahead(log.stream):
            rows = rows_of(block, log.periods)
            hand((block, rows, estimate(rows)))
            done += len(block)
            if progress is not None:
                progress(min(done * 80, size), size)


def _lengths_and_angle(tally: Tally) -> Errors:
    rmse = tally.rmse()
    return {key: rmse[key] for key in ("q1_mm", "q2_mm", "mean_q_mm", "phi_deg") if key in rmse}


def _replayed(
    log: OpenLog, estimator: str, sums: Sums, compared: dict[str, Errors], sensor: FloatArray | None,
    findings: list[Finding],
) -> Replayed:  # fmt: skip
    """Judge, and put together what is shown."""
    tally, own = sums.fused, estimator != "baseline"
    camera = "pose" if log.periods.pose else "camera"
    place = _PLACES[camera]
    named = {name: camera if name == "camera" else name for name in SENSORS}
    checks = {named[name]: check for name in SENSORS if (check := tally.check(name)) is not None}
    share = sums.driven / sums.weighed if own and sums.weighed else None
    if own:
        seen = [*sampled(sums.watch), *captured(log.first, log.periods.pose)]
        findings = [*seen, *findings]
        # What is stuck or mirrored seems late, and to jump; innovations that are white hide no delay.
        sound = all(one.severity != "inconsistent" for one in seen)
        repeats = any((check.correlation or 0.0) > _REPEATING for check in checks.values())
        if repeats and sound:
            findings += untimely(log.setup, rows_of(log.first, log.periods), place)
        findings += coarse(log)
        if log.both and not log.periods.pose:
            findings += jumped(tally) if sound else []
        repeating = tally.repeating() if log.periods.grid_px > 0.0 else None
        findings += consistent(checks, tally.flags, max(tally.rows, 1), repeating)
        if not tally.end_s - tally.start_s >= SETTLED_S:
            text = f"the log is too short: innovations are judged from {SETTLED_S:g} s on"
            findings.append(Finding("poor", text))
        if sensor is not None:
            findings += contradicting(log.setup, sensor, tally.end_s - tally.start_s, place)
    assumed = [Finding("remark", text) for text in log.remarks]
    rmse = tally.rmse() if own else _lengths_and_angle(sums.baseline)
    if scored_by_pose(log.first):
        rmse.pop("nees", None)
        text = "errors are against the tip's pose and hold its noise and delay"
        none = "the tip's pose is nowhere within reach, in m and rad from the base: nothing was scored"
        assumed.append(Finding("remark", text if rmse else none))
    return Replayed(
        source=shown(log.path.name),
        rows=tally.rows,
        duration_s=finite_or_none(tally.end_s - tally.start_s) or 0.0,
        estimator=estimator,
        driven_share=share,
        jitter_px=None if log.periods.pose or not log.periods.camera else float(log.setup.noise[0]),
        pose_noise_mm=float(log.setup.noise[0]) if log.periods.pose else None,
        rmse=rmse,
        compared=compared,
        sensors=checks if own else {},
        flags={name: count for name, count in tally.flags.items() if count and own},
        **judged(Verdict.of([*assumed, *findings])),
    )

"""From logs, tables and a rig to what an identification takes."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.core.arrays import FloatArray, robust_sigma
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.options import PoseOptions
from calib.core.rig import Rig
from calib.io.columns import is_arm_log
from calib.io.logs import Log, check_time, read_log
from calib.io.tables import read_cells
from calib.solve.clock import clock_step_s
from calib.stages.actuator.identify import Start, Track
from calib.stages.actuator.identify_pump import PumpRecord, PumpTable, Settled
from calib.stages.actuator.kinematics import angle_and_length, bellows
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import TICK_S, Plant
from calib.stages.actuator.swing import without_outliers
from calib.stages.control.rig_model import holding_force
from calib.stages.estimator.read import periods, setup_from_rig
from calib.stages.estimator.sensors import GRAVITY_MPS2, SIZE, heads_seen, marker

if TYPE_CHECKING:
    from calib.core.stage import Files

# ----------------------------------------------------------------------
# Tables of a pump's recordings: time, PWM, and pressure or force, in columns of whatever name.
#
# A CSV with a header. The columns are those that are asked for, else the first whose name is known:
#
#     time        t_s, time, time_s, timestamp, timestamp_s, t
#     PWM         pwm, pwm1, pwm_input, pwm_main
#     value       pressure_kpa, feedback_kpa, pressure, force_n, force
#
# upper or lower case. Values are kPa unless the name says newton. Rows more than `STATIC_S` apart, each
# with a PWM of its own, are settled values; a column `mode` then tells parts that do not belong together,
# as inflation and suction. Other rows are a recording over time.

STATIC_S = 0.9
_TIME = ("t_s", "time", "time_s", "timestamp", "timestamp_s", "t")
_PWM = ("pwm", "pwm1", "pwm_input", "pwm_main")
_VALUE = ("pressure_kpa", "feedback_kpa", "pressure", "force_n", "force")
_KPA = (1.0, 2000.0)
"""What the pressure of a pump is at most."""
_AIR_KPA = (80.0, 110.0)
"""Pressure of the air, from 2000 m above the sea down to it."""
_OTHER_UNITS = {
    "ms", "us", "ns", "percent", "pct", "%", "psi", "bar", "mbar", "pa", "hpa", "mpa", "atm", "mmhg", "mn",
    "kn", "lbf",
}  # fmt: skip
_MOST_BAD = 0.05
_FEWEST = 20
_SHORTEST_S = 0.5
_JUMP = 20.0


def read_pump_table(
    path: Path,
    time: str | None = None,
    pwm: str | None = None,
    value: str | None = None,
    unit: str | None = None,
) -> PumpTable:
    """A table of a pump.

    Parameters
    ----------
    time, pwm, value : names of the columns, recognised by default. unit : "kPa" or "N".

    Raises
    ------
    BadInputError for missing columns, text for a number, PWM outside 0 .. 255 or as a share of the full duty,
    time that runs back or jumps, and tables that are too short.
    """
    cells, what = read_cells(path), "pressure or force"
    header, rows, lines = cells.header, cells.rows, cells.lines
    at = [cells.column(*one) for one in ((time, _TIME, "time"), (pwm, _PWM, "PWM"), (value, _VALUE, what))]
    table = cells.numbers(*at)
    said = []
    good = np.asarray(np.isfinite(table).all(axis=1))
    if not good.all():
        bad = int((~good).sum())
        if bad > max(_MOST_BAD * len(table), 1.0) or bad == len(table):
            first = lines[int(np.nonzero(~good)[0][0])]
            raise BadInputError(
                f"{shown(path)}: {bad} of {len(table)} rows have a blank or nan, the first in line {first}, "
                f"expected numbers"
            )
        said.append(f"{shown(path)}: {bad} rows with a blank or nan are left out")
    table, kept = table[good], [k for k in range(len(rows)) if good[k]]
    t, u, y = table.T
    name = shown(path.name)
    words = [re.findall("[a-z%]+", header[k].lower()) for k in at]
    expected = ("seconds", "0 to 255", "kPa or N") if unit is None else ("seconds", "0 to 255")
    for k, mine, right in zip(at, words, expected, strict=False):
        for word in _OTHER_UNITS.intersection(mine):
            raise BadInputError(
                f"{shown(path)}: {header[k]} is in {word} by its name, expected {right}; convert the column"
            )
    assumed = unit is None and "force" not in words[2] and "kpa" not in words[2]
    if unit is None:
        unit = "N" if "force" in words[2] else "kPa"
        if assumed:
            said.append(f"takes the column {header[at[2]]} for kPa")
    outside = np.nonzero((u < 0.0) | (u > 255.0))[0]
    if len(outside):
        line = lines[kept[int(outside[0])]]
        raise BadInputError(f"{shown(path)}, line {line}: PWM is {u[outside[0]]:g}, expected 0 to 255")
    said += _duty(shown(path), "PWM is", u, "multiply the column by {}")
    back = np.nonzero(np.diff(t) < 0.0)[0]
    if len(back):
        line = lines[kept[int(back[0]) + 1]]
        raise BadInputError(
            f"{shown(path)}, line {line}: time goes back from {t[back[0]]:g} to {t[back[0] + 1]:g} s"
        )
    static = len(t) > 1 and float(np.median(np.diff(t))) >= STATIC_S
    settled = _settled(name, header, [rows[k] for k in kept], u, y) if static else ()
    record = None if static else _record(path, name, t, u, y, [lines[k] for k in kept])
    most, column = float(np.abs(y).max()), header[at[2]]
    if assumed and not _KPA[0] <= most <= _KPA[1]:
        raise BadInputError(
            f"{shown(path)}: {column} is {most:.4g} at most, expected {_KPA[0]:g} to {_KPA[1]:g} kPa; of "
            "another unit? One that is in kPa is taken with --unit kPa"
        )
    if unit == "kPa" and _AIR_KPA[0] < y.min() < _AIR_KPA[1] and not u[y.argmin()]:
        raise BadInputError(
            f"{shown(path)}: {column} is {y.min():.4g} kPa with the pump off, as one that counts from "
            "vacuum; subtract the pressure of the air"
        )
    return PumpTable(unit, record, settled, tuple(said))


def _duty(source: str, name: str, pwm: FloatArray, remedy: str) -> list[str]:
    """A sentence where PWM may be a percentage.

    Raises `BadInputError` for shares of the full duty and surely percentages; `remedy` takes the factor.
    """
    most = float(pwm.max())
    found = f"{name} {most:.3g} at most"
    if 0.0 < most <= 1.0:
        also = "expected 0 to 255; where that is a share of the full duty"
        raise BadInputError(f"{source}: {found}, {also}, {remedy.format(255)}")
    if abs(most - 100.0) > 1e-6:
        return []
    if np.any(pwm % 1.0):
        also = "and not whole, as a percentage, expected 0 to 255"
        raise BadInputError(f"{source}: {found} {also}; {remedy.format(2.55)}")
    return [f"{source}: {found}, taken for 100 of 255; where that is a percentage, {remedy.format(2.55)}"]


def _settled(
    name: str, header: list[str], rows: list[list[str]], u: FloatArray, y: FloatArray
) -> tuple[Settled, ...]:
    low = [column.lower() for column in header]
    if "mode" not in low:
        return (Settled(name, u, y),)
    modes = [row[low.index("mode")].strip() for row in rows]
    out = []
    for mode in dict.fromkeys(modes):
        mine = np.array([m == mode for m in modes])
        out.append(Settled(f"{name}, {shown(mode)}", u[mine], y[mine]))
    return tuple(out)


def _record(
    path: Path, name: str, t: FloatArray, u: FloatArray, y: FloatArray, lines: list[int]
) -> PumpRecord:
    new = np.concatenate([[True], np.diff(t) > 0.0])
    t, u, y = t[new], u[new], y[new]
    kept = [line for line, keep in zip(lines, new.tolist(), strict=True) if keep]
    if len(t) < _FEWEST or t[-1] - t[0] < _SHORTEST_S:
        span = float(t[-1] - t[0]) if len(t) else 0.0
        raise BadInputError(
            f"{shown(path)}: has {len(t)} rows over {span:.3g} s, expected at least {_FEWEST} rows and "
            f"{_SHORTEST_S:g} s"
        )
    steps = np.diff(t)
    far = np.nonzero(steps > max(_JUMP * float(np.median(steps)), 0.5))[0]
    if len(far):
        k = int(far[0])
        raise BadInputError(
            f"{shown(path)}, line {kept[k + 1]}: time jumps from {t[k]:g} to {t[k + 1]:g} s; "
            "cut the table there"
        )
    return PumpRecord(name, t, u, y)


# ----------------------------------------------------------------------
# Whether a log begins in motion, and a first guess of the state there.
#
# Hoses off. Angle and rate at the beginning are those of a damped swing fitted to the first second,
#
#     phi(t) = m + exp(-zeta w t) (a cos w t + b sin w t),
#
# linear in m, a, b for each w and zeta of a grid, which is finer about the best of a coarse one. A swing
# that is let go has hardly any rate at its beginning; one that is cut out of a longer log has.
#
# Pumps connected. A log whose head is away from the straight rest at its beginning is taken to be in
# motion, slowly: rates by straight lines, forces as they would hold the head.

_FIRST_S = 1.0
_SLOW_S = 0.25
_HERTZ = np.geomspace(1.0, 10.0, 70)
_NEAR = np.linspace(0.96, 1.04, 17)
_ZETA = (0.02, 0.035, 0.05, 0.07, 0.1, 0.15)
_IDENTIFYSTART_FEWEST = 12
_SHARE = 0.3
_SURE = 6.0
_LEAST_RADPS = 0.2
_AWAY_RAD = 0.06
_AWAY_M = 0.004


def _swing(t: FloatArray, phi: FloatArray, w: float, zeta: float) -> tuple[float, float, float, float, float]:
    """Sum of squares, and what `swing_at_beginning` returns, of one w [rad/s] and zeta."""
    decay = np.exp(-zeta * w * t)
    A = np.stack([np.ones_like(t), decay * np.cos(w * t), decay * np.sin(w * t)], axis=1)
    # A second of readings tells the three apart, so the normal equations do.
    inverse = np.linalg.solve(A.T @ A, A.T)
    m, a, b = (inverse @ phi).tolist()
    residual = phi - A @ np.array([m, a, b])
    noise = float(np.linalg.norm(residual)) / math.sqrt(max(len(t) - 5, 1))
    by = w * (inverse[2] - zeta * inverse[1])
    return (
        float(residual @ residual),
        m + a,
        w * (b - zeta * a),
        noise * float(np.linalg.norm(by)),
        w * math.hypot(a, b),
    )


def swing_at_beginning(t_s: FloatArray, phi_rad: FloatArray) -> tuple[float, float, float, float]:
    """Angle [rad], rate [rad/s], the rate's standard deviation and w times the amplitude, at t = 0.

    The times (n,) begin at 0 or shortly after; a second of them is used, single wrong readings replaced.
    """
    some = t_s <= _FIRST_S
    t, phi = t_s[some], without_outliers(phi_rad[some])[0]
    tried = [(_swing(t, phi, w, zeta), w) for w in (2.0 * math.pi * _HERTZ).tolist() for zeta in _ZETA]
    middle = min(tried)[1]
    near = [middle * share for share in _NEAR.tolist()]
    best = min(_swing(t, phi, w, zeta) for w in near for zeta in _ZETA)
    return best[1:]


def held_by_pumps(start: Start, plant: Plant) -> Start:
    """The start with pumps that just hold the head."""
    q = bellows(start.phi_rad, start.length_m, plant.bellows_radius_m)
    F1, F2 = np.maximum(holding_force(plant, q), 0.0).tolist()
    return replace(start, force1_N=F1, force2_N=F2)


def start_in_motion(
    t_s: FloatArray, head: FloatArray, hoses: bool, plant: Plant, rest_noise_rad: float
) -> Start | None:
    """A guess of the start of a log that begins in motion; None for one that begins at rest.

    Parameters
    ----------
    t_s, head : (n,) times from the beginning [s] and (n, 2) angle [rad] and length [m].
    rest_noise_rad : standard deviation of a reading of the angle.
    """
    if len(t_s) < _IDENTIFYSTART_FEWEST:
        return None
    phi, length = np.median(head[:5], axis=0).tolist()
    if hoses:
        away = max(_AWAY_RAD, _SURE * rest_noise_rad)
        if abs(phi) < away and abs(length - plant.rest_length_m) < _AWAY_M:
            return None
        some = t_s <= max(_SLOW_S, float(t_s[4]))
        rates = np.polyfit(t_s[some], head[some], 1)[0].tolist()
        return held_by_pumps(Start(phi, length, *rates), plant)
    at_0, rate, sigma, fastest = swing_at_beginning(t_s, head[:, 0])
    if abs(rate) < max(_SHARE * fastest, _SURE * sigma, _LEAST_RADPS):
        return None
    return Start(at_0, length, rate)


# ----------------------------------------------------------------------
# From a log and a rig.yaml to what an identification takes: commands by ticks, and the head's pose.
#
# The pose comes from the log's own pictures, marker by marker
# (`calib.stages.estimator.sensors.invert_marker`), from a states file of `calib replay`, or, for tests of
# the method, from the simulated rig's true columns. The errors of pictures are independent of each other,
# those of filtered states are not and tell less than they seem to.

LONGEST_S = 120.0
_IDENTIFYING_SHORTEST_S = 1.0
_IDENTIFYING_FEWEST = 40
_GAP_S = 0.5
_HELD_S, _HELD_FEWEST = 0.25, 20
_BRIEFLY_HELD_S, _FEW = 0.1, 5
_OF_SWING = 0.1
_BEFORE_RELEASE_S = 0.03
_MOST_TICKS = 10_000_000
_LONGEST_TICK_S = 0.1
"""No loop that drives a pump is slower."""
_LATE_S = 0.01
_SPOILT = 0.01
"""Share of commands up to which those out of range are cells that were spoilt on their way."""
_SHARED = 0.25
"""Share of pictures whose time is that of the one before, where a clock's steps could not be followed."""
_TRUE_SIGMA = (1e-4, 1e-5)
_LENGTH_SIGMA_M = 2e-4

Head = tuple[FloatArray, FloatArray, FloatArray]


def states_beside(path: Path) -> Path | None:
    """The states file that `calib replay` writes for a log, where it lies beside it."""
    beside = (path.with_name(f"{path.stem}{end}") for end in ("_states.csv", ".states.csv"))
    return next((one for one in beside if one.is_file()), None)


def _from_pictures(log: Log, rig: Rig, rig_path: Path, rest: float) -> tuple[Head, float]:
    if not len(log.sampled("u_px", "v_px")):
        raise BadInputError(
            f"{log.source}: has no marker, expected u_px and v_px, or the states of calib replay beside it"
            + log.where_else("u_px", "v_px")
        )
    pictures = log.signals("u_px", "v_px")
    found = periods(log)
    setup, _ = setup_from_rig(rig, rig_path, found)
    sensor = setup.start.sensor.copy()
    delay_s = float(sensor[7])
    state, by_u, by_v = np.zeros(SIZE), np.empty(SIZE), np.empty(SIZE)
    state[6:] = sensor
    state[13] = 0.0
    sigma = math.sqrt(float(setup.noise[0]) ** 2 + float(setup.noise[1]) ** 2 / 12.0)
    seen = heads_seen(setup.view, sensor, pictures.values, rest)
    if float(np.mean(np.diff(pictures.t_s) == 0.0)) > _SHARED:
        step = clock_step_s(log.t_s)
        raise BadInputError(
            f"{log.source}: {len(pictures)} pictures have {len(np.unique(pictures.t_s))} time stamps, "
            + (f"in steps of {1e3 * step:.3g} ms, " if step else "")
            + "expected one for each; write t_s with six decimals, as each picture is taken"
        )
    found_at = np.isfinite(seen[:, 0])
    t, heads, whitening = pictures.t_s[found_at], seen[found_at], np.empty((int(found_at.sum()), 2, 2))
    for k, head in enumerate(heads):
        state[:2] = head
        marker(setup.view, state, by_u, by_v)
        whitening[k] = by_u[:2] / sigma, by_v[:2] / sigma
    if len(t) < _IDENTIFYING_FEWEST:
        raise BadInputError(
            f"{log.source}: {len(t)} of {len(pictures)} pictures show the marker where it can be, "
            f"expected at least {_IDENTIFYING_FEWEST}"
        )
    return (t, heads, whitening), delay_s


def _from_states(path: Path) -> Head:
    cells, of_lengths = read_cells(path), ("sigma_q1_m", "sigma_q2_m")
    names = ("t_s", "phi_rad", "length_m", "sigma_phi_rad")
    table = cells.numbers(*(cells.column(name, (), name) for name in names))
    spread = np.full(len(table), _LENGTH_SIGMA_M)
    if {*of_lengths} <= {name.lower() for name in cells.header}:
        both = cells.numbers(*(cells.column(name, (), name) for name in of_lengths))
        spread = np.sqrt(np.mean(both**2, axis=1))
    good = np.isfinite(table).all(axis=1) & np.isfinite(spread) & (spread > 0.0) & (table[:, 3] > 0.0)
    # States come at every row of camera and IMU; more than one per tick says the same again.
    table, spread = table[good], spread[good]
    # Stamps of whole microseconds are a hair beside the ticks.
    tick = np.floor((table[:, 0] - table[:1, 0]) / TICK_S + 0.01)
    first = np.diff(tick, prepend=-1.0) > 0.0
    table, spread = table[first], spread[first]
    W = np.zeros((len(table), 2, 2))
    W[:, 0, 0], W[:, 1, 1] = 1.0 / table[:, 3], 1.0 / spread
    return table[:, 0], table[:, 1:3], W


def _from_truth(log: Log, bellows_radius_m: float) -> Head:
    rows = log.sampled("true_q1_m", "true_q2_m")
    if not len(rows):
        raise BadInputError(f"{log.source}: has no true_q1_m and true_q2_m, which --truth needs")
    q = np.stack([log.columns["true_q1_m"][rows], log.columns["true_q2_m"][rows]], axis=1)
    W = np.broadcast_to(np.diag(1.0 / np.array(_TRUE_SIGMA)), (len(rows), 2, 2)).copy()
    return log.t_s[rows], angle_and_length(q, bellows_radius_m), W


def _check_clock(log: Log) -> None:
    check_time(log)
    steps = np.diff(log.t_s)
    far = np.nonzero(steps > _GAP_S)[0]
    if len(far):
        k = int(far[0])
        raise BadInputError(
            f"{log.source}, line {log.lines[k + 1]}: the clock jumps from {log.t_s[k]:.3f} to "
            f"{log.t_s[k + 1]:.3f} s; cut the log there"
        )


def _commands(log: Log, no_pwm: bool, said: list[str]) -> tuple[float, float, FloatArray]:
    """Time of the first tick, tick and commands (n, 2) held to an even grid; adds sentences to `said`."""
    end = float(log.t_s[-1])
    if not len(log.sampled("pwm1", "pwm2")):
        if not no_pwm:
            meant = (
                "it has those of an arm: identify it by calib identify arm"
                if is_arm_log(tuple(log.columns))
                else "a pump's table is for calib identify pump"
                if not log.columns
                else "for a swing with the hoses off give --no-pwm"
            )
            raise BadInputError(f"{log.source}: has no commands, expected pwm1 and pwm2; {meant}")
        begin = float(log.t_s[0])
        return begin, TICK_S, np.zeros((max(math.ceil((end - begin) / TICK_S) + 1, 2), 2))
    commands = log.signals("pwm1", "pwm2")
    t, pwm = commands.t_s, commands.values
    wrong = ((pwm < 0.0) | (pwm > 255.0)).any(axis=1)
    if wrong.any():
        k, count = int(np.argmax(wrong)), int(wrong.sum())
        found = f"{log.source}, line {commands.lines[k]}: pwm is {pwm[k].tolist()}, expected 0 to 255"
        if count > _SPOILT * len(pwm):
            raise BadInputError(found)
        said.append(f"{found}; {count} of {len(pwm)} commands are such and are left out")
        t, pwm = t[~wrong], pwm[~wrong]
    remedy = "columns.yaml takes them: `pwm1: {{column: pwm1, factor: {}}}`, and pwm2 so"
    said += _duty(log.source, "pwm1 and pwm2 are", pwm, remedy)
    # A nominal rate that the stamps only scatter about is exact.
    tick_s = 1.0 / commands.axis.nominal_hz if len(t) > 2 else TICK_S
    # Some loggers write a command where it changes; it holds until the next one.
    if tick_s > _LONGEST_TICK_S or (len(t) > 2 and np.ptp(t) > 2.0 * (len(t) - 1) * np.median(np.diff(t))):
        tick_s = TICK_S
    if not tick_s * _MOST_TICKS > end - float(t[0]):
        raise BadInputError(
            f"{log.source}: its commands are {tick_s:g} s apart, over {end - float(t[0]):g} s; "
            "expected ticks of some milliseconds"
        )
    n = max(math.ceil((end - float(t[0])) / tick_s) + 1, 2)
    ticks = float(t[0]) + tick_s * np.arange(n, dtype=np.float64)
    latest = np.clip(np.searchsorted(t, ticks + 0.5 * tick_s, side="right") - 1, 0, len(t) - 1)
    return float(t[0]), tick_s, pwm[latest]


def let_go(t_s: FloatArray, away: FloatArray, noise: float | None) -> int | None:
    """Reading at which a head that is held for a while is first seen to swing; None where it swings at once.

    This reading and the next are away from the held ones, by more than noise and by a share of what the
    swing reaches: the tremor of a hand and the flicker of a pixel are no swing.

    Parameters
    ----------
    t_s, away : (n,) times [s], and angle or rate of the head.
    noise : standard deviation of a reading; None where the held ones tell it.
    """
    for held_s in (_HELD_S, _BRIEFLY_HELD_S):
        held = t_s <= t_s[0] + held_s
        off = away - np.median(away[held])
        first, apart = off[held], np.abs(off)
        both = np.minimum(apart[:-1], apart[1:])
        least = _OF_SWING * both.max(initial=0.0)
        sure = _SURE * (robust_sigma(first) if noise is None else noise)
        # A head that swings at once moves in so short a time, too: it has to be still beside its swing.
        if held_s < _HELD_S and (len(first) < _FEW or max(sure, np.abs(first).max()) > least):
            return None
        swings = np.nonzero(both > max(sure, least))[0]
        if len(swings) and not held[swings[0]]:
            return int(swings[0])
    return None


def release_s(log: Log, t_s: FloatArray, phi: FloatArray, noise_rad: float) -> float | None:
    """Time of the log at which a free swing begins that is held before; None where it begins at once.

    A gyroscope tells it from the rate, which rises from nothing; without one the pictures' angles do.

    Parameters
    ----------
    t_s, phi : (n,) stamps of the pictures [s] and their angles. noise_rad : deviation of one of them.
    """
    if len(log.sampled("gz_radps")) <= _HELD_FEWEST:
        k = let_go(t_s, phi, noise_rad)
        return None if k is None else float(t_s[k]) - _BEFORE_RELEASE_S
    gyro = log.signals("gz_radps")
    rate = gyro.values[:, 0]
    k = let_go(gyro.t_s, rate, None)
    if k is None:
        return None
    rate = rate - np.median(rate[: min(k, int(np.searchsorted(gyro.t_s, gyro.t_s[0] + _HELD_S, "right")))])
    rise = rate[k + 1] - rate[k]
    since = rate[k] / rise * (gyro.t_s[k + 1] - gyro.t_s[k]) if rise * rate[k] > 0.0 else 0.0
    return float(gyro.t_s[k] - min(since, gyro.t_s[k] - gyro.t_s[k - 1]))


def read_track(
    files: Files, path: Path, rig: Rig, nominal: Machine, options: PoseOptions, states: Path | None = None
) -> Track:
    """A log as a track.

    Parameters
    ----------
    files : notes what is read, and gets sentences about it.
    nominal : the machine as it is known; its radius makes an angle of true lengths, its springs hold the head
        at the start of a log that begins in motion.
    options : where the pose comes from, and what a person states of the log.
    states : states file to take the pose from; without pictures one beside the log is looked for.

    Raises
    ------
    BadInputError for a log that is too short, jumps in time, has no commands or commands out of range,
    no marker, or a rig without camera or plane where the pictures are needed.
    """
    said = files.remarks
    log = read_log(path, options, said, rig.picture_px)
    _check_clock(log)
    begin, tick_s, pwm = _commands(log, options.no_pwm, said)
    delay_s = 0.0
    if states is None and not options.truth and not len(log.sampled("u_px", "v_px")):
        states = states_beside(path)
    files.taken(path, log.beginning)
    if options.truth:
        (t, head, W), how = _from_truth(log, nominal.plant.bellows_radius_m), "truth"
    elif states is not None:
        (t, head, W), how = _from_states(states), "states"
        files.taken(states)
        said.append(f"{log.source}: takes the pose from {shown(states)}")
    else:
        (t, head, W), delay_s = _from_pictures(log, rig, files.rig_path, nominal.plant.rest_length_m)
        how = "pictures"
    hoses = bool(pwm.any())
    spread = np.linalg.inv(W[:20])
    noise = float(np.median(np.linalg.norm(spread[:, 0], axis=1)))
    if not hoses and len(t) > _HELD_FEWEST:
        at = release_s(log, t, head[:, 0], noise)
        if at is not None:
            begin, pwm = at, np.zeros((max(math.ceil((t[-1] - at) / tick_s) + 1, 2), 2))
            said.append(f"{log.source}: let go at {at:.2f} s; what is before is left out")
    inside = (t >= begin - 0.5 * tick_s) & (t <= begin + LONGEST_S)
    if t[-1] > begin + LONGEST_S:
        said.append(f"{log.source}: only the first {LONGEST_S:g} s are used")
    t, head, W = t[inside] - begin, head[inside], W[inside]
    pwm = pwm[: math.ceil(LONGEST_S / tick_s) + 1]
    if len(t) < _IDENTIFYING_FEWEST or t[-1] - t[0] < _IDENTIFYING_SHORTEST_S:
        span = float(t[-1] - t[0]) if len(t) else 0.0
        raise BadInputError(
            f"{log.source}: too short: {len(t)} poses over {span:.3g} s, expected at least "
            f"{_IDENTIFYING_FEWEST} and {_IDENTIFYING_SHORTEST_S:g} s"
        )
    t = np.maximum(t, 0.0)
    # What a picture shows was so one delay earlier.
    seen_s = t - delay_s
    known = seen_s >= 0.0
    moving, phi = start_in_motion(seen_s[known], head[known], hoses, nominal.plant, noise), None
    if moving is not None:
        said.append(
            f"{log.source}: begins in motion ({moving.phi_rad:.3f} rad, {moving.dphi_radps:+.2f} rad/s); its "
            "start is estimated too"
        )
        # The first pictures show the head before the first tick.
        late = t >= delay_s + _LATE_S
        t, head, W = t[late], head[late], W[late]
    elif not hoses and np.count_nonzero(known) >= _IDENTIFYSTART_FEWEST:
        # Five pictures of a slow camera are more than half of a swing.
        phi = swing_at_beginning(seen_s[known], head[known, 0])[0]
    return Track(shown(path.name), tick_s, pwm, hoses, t, head, W, moving, how, delay_s, begin, phi)


_MOST_M = 1.0
"""Elongation beyond which a table is in another unit."""
_LENGTHS = {"elongation_mm": 1e-3, "displacement_mm": 1e-3, "elongation_m": 1.0, "displacement_m": 1.0}
_LOADS = {"force_n": 1.0, "force_mn": 1e-3, "mass_kg": GRAVITY_MPS2, "mass_g": 1e-3 * GRAVITY_MPS2}


def read_displacements(path: Path) -> tuple[FloatArray, FloatArray]:
    """Elongations [m] and forces [N], each (n,), of a table of hanging weights or steady elongations.

    Columns are any of elongation or displacement in mm or m, and force_N, force_mN, mass_g or mass_kg.
    """
    cells = read_cells(path)
    x, y = cells.column(None, tuple(_LENGTHS), "elongation"), cells.column(None, tuple(_LOADS), "force")
    table = cells.numbers(x, y)
    bad = np.nonzero(~np.isfinite(table).all(axis=1))[0]
    if len(bad):
        line = cells.lines[int(bad[0])]
        raise BadInputError(f"{shown(path)}, line {line}: has a blank or nan, expected numbers")
    scales = (_LENGTHS[cells.header[x].lower()], _LOADS[cells.header[y].lower()])
    for row in np.nonzero(np.abs(table[:, 0]) * scales[0] > _MOST_M)[0].tolist():
        where, most = f"{shown(path)}, line {cells.lines[row]}", _MOST_M / scales[0]
        raise BadInputError(
            f"{where}: {cells.header[x]} is {table[row, 0]:g}, expected at most {most:g}; of another unit?"
        )
    return table[:, 0] * scales[0], table[:, 1] * scales[1]

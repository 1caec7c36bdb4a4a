"""From a log and a rig.yaml to what an identification takes: commands by ticks, and the head's pose.

The pose comes from the log's own pictures, marker by marker (`calib.estimator.sensors.invert_marker`), from
a states file of `calib replay`, or, for tests of the method, from the simulated rig's true columns. The
errors of pictures are independent of each other, those of filtered states are not and tell less than they
seem to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.actuator.identify_tracks import Track
from calib.actuator.pump import TICK_S
from calib.actuatorsections import nominal_of
from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.estimator.sensors import SIZE, invert_marker, marker
from calib.files import shown
from calib.identifystart import start_in_motion
from calib.logs import Log, check_time, read_log
from calib.pumptables import find_column, number, read_columns
from calib.replaying import periods, setup_from_rig
from calib.rig import Rig

__all__ = ["LONGEST_S", "TrackSource", "read_displacements", "read_track", "states_beside"]

LONGEST_S = 120.0
_SHORTEST_S = 1.0
_FEWEST = 40
_GAP_S = 0.5
_BEFORE_RELEASE_S = 0.03
_MOST_TICKS = 10_000_000
_LATE_S = 0.01
_TRUE_SIGMA = (1e-4, 1e-5)
_LENGTH_SIGMA_M = 2e-4
_GRAVITY_MPS2 = 9.81

Head = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class TrackSource:
    """A track, how its pose was found, what is known of its delay, and sentences about it.

    `begin_s` is the time of the log at which the track begins.
    """

    track: Track
    source: str
    delay_s: float
    said: tuple[str, ...]
    states: Path | None = None
    begin_s: float = 0.0


def states_beside(path: Path) -> Path | None:
    """The states file that `calib replay` writes for a log, where it lies beside it."""
    for name in (f"{path.stem}_states.csv", f"{path.stem}.states.csv"):
        if path.with_name(name).is_file():
            return path.with_name(name)
    return None


def _whitening(by: FloatArray, sigma: FloatArray) -> FloatArray:
    return np.asarray(by / sigma[..., None])


def _from_pictures(log: Log, rig: Rig, rig_path: Path) -> tuple[Head, float]:
    rows = log.sampled("u_px", "v_px")
    if not len(rows):
        raise BadInputError(
            f"{log.source}: has no marker, expected u_px and v_px, or the states of calib replay beside it"
        )
    found = periods(log)
    setup, _ = setup_from_rig(rig, rig_path, found)
    sensor = setup.start.sensor.copy()
    delay_s = float(sensor[7])
    state, by_u, by_v = np.zeros(SIZE), np.empty(SIZE), np.empty(SIZE)
    state[6:] = sensor
    state[13] = 0.0
    rest = float(setup.start.head[1])
    sigma = math.sqrt(float(setup.noise[0]) ** 2 + float(setup.noise[1]) ** 2 / 12.0)
    guess = (0.0, rest)
    t, heads, whitening = [], [], []
    pixels = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
    for at, (u, v) in zip(log.t_s[rows].tolist(), pixels.tolist(), strict=True):
        for phi, length in (guess, (0.0, rest)):
            phi, length, good = invert_marker(setup.view, sensor, u, v, phi, length)
            if good:
                break
        if not good:
            continue
        guess = phi, length
        state[0], state[1] = phi, length
        marker(setup.view, state, by_u, by_v)
        t.append(at)
        heads.append(guess)
        whitening.append([by_u[:2] / sigma, by_v[:2] / sigma])
    if len(t) < _FEWEST:
        raise BadInputError(
            f"{log.source}: {len(t)} of {len(rows)} pictures show the marker where it can be, "
            f"expected at least {_FEWEST}"
        )
    return (np.array(t), np.array(heads), np.array(whitening)), delay_s


def _from_states(path: Path) -> Head:
    header, rows, lines = read_columns(path)
    names = ("t_s", "phi_rad", "length_m", "sigma_phi_rad")
    at = [find_column(path, header, name, (name,), name) for name in names]
    table = np.array(
        [[number(row[k], path, line, header[k]) for k in at] for row, line in zip(rows, lines, strict=True)]
    )
    low = [name.lower() for name in header]
    spread = np.full(len(table), _LENGTH_SIGMA_M)
    if "sigma_q1_m" in low and "sigma_q2_m" in low:
        both = [
            [number(row[low.index(n)], path, line, n) for n in ("sigma_q1_m", "sigma_q2_m")]
            for row, line in zip(rows, lines, strict=True)
        ]
        spread = np.sqrt(np.mean(np.array(both) ** 2, axis=1))
    good = np.isfinite(table).all(axis=1) & np.isfinite(spread) & (spread > 0.0) & (table[:, 3] > 0.0)
    # States come at every row of camera and IMU; more than one per tick says the same again.
    table, spread = table[good], spread[good]
    tick = np.floor((table[:, 0] - table[0, 0]) / TICK_S) if len(table) else np.zeros(0)
    first = np.concatenate([[True], np.diff(tick) > 0.0]) if len(table) else np.zeros(0, dtype=bool)
    table, spread = table[first], spread[first]
    W = np.zeros((len(table), 2, 2))
    W[:, 0, 0], W[:, 1, 1] = 1.0 / table[:, 3], 1.0 / spread
    return table[:, 0], table[:, 1:3], W


def _from_truth(log: Log, bellows_radius_m: float) -> Head:
    rows = log.sampled("true_q1_m", "true_q2_m")
    if not len(rows):
        raise BadInputError(f"{log.source}: has no true_q1_m and true_q2_m, which --truth needs")
    q1, q2 = log.columns["true_q1_m"][rows], log.columns["true_q2_m"][rows]
    head = np.stack([(q1 - q2) / (2.0 * bellows_radius_m), 0.5 * (q1 + q2)], axis=1)
    W = np.broadcast_to(np.diag(1.0 / np.array(_TRUE_SIGMA)), (len(rows), 2, 2)).copy()
    return log.t_s[rows], head, W


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


def _commands(log: Log, no_pwm: bool) -> tuple[float, float, FloatArray]:
    """Time of the first tick, tick and commands (n, 2) held to an even grid."""
    rows = log.sampled("pwm1", "pwm2")
    end = float(log.t_s[-1])
    if not len(rows):
        if not no_pwm:
            raise BadInputError(
                f"{log.source}: has no commands, expected pwm1 and pwm2; for a swing with the hoses off give "
                "--no-pwm"
            )
        begin = float(log.t_s[0])
        return begin, TICK_S, np.zeros((max(math.ceil((end - begin) / TICK_S) + 1, 2), 2))
    t = log.t_s[rows]
    pwm = np.stack([log.columns["pwm1"][rows], log.columns["pwm2"][rows]], axis=1)
    wrong = np.nonzero(((pwm < 0.0) | (pwm > 255.0)).any(axis=1))[0]
    if len(wrong):
        k = int(wrong[0])
        raise BadInputError(
            f"{log.source}, line {log.lines[rows[k]]}: pwm is {pwm[k].tolist()}, expected 0 to 255"
        )
    tick_s = float(np.median(np.diff(t))) if len(t) > 2 else TICK_S
    # A nominal rate that the stamps only scatter about is exact.
    tick_s = TICK_S if abs(tick_s / TICK_S - 1.0) < 0.01 else tick_s
    if not tick_s * _MOST_TICKS > end - float(t[0]):
        raise BadInputError(
            f"{log.source}: its commands are {tick_s:g} s apart in the median, over {end - float(t[0]):g} s; "
            "expected ticks of some milliseconds"
        )
    n = max(math.ceil((end - float(t[0])) / tick_s) + 1, 2)
    ticks = float(t[0]) + tick_s * np.arange(n, dtype=np.float64)
    latest = np.clip(np.searchsorted(t, ticks + 0.5 * tick_s, side="right") - 1, 0, len(t) - 1)
    return float(t[0]), tick_s, pwm[latest]


def _release(t: FloatArray, phi: FloatArray) -> float | None:
    """Time shortly before a swing that is held for a while is let go; None where it begins at once."""
    noise = float(np.median(np.abs(np.diff(phi[:20])))) + 1e-6
    away = np.abs(phi - np.median(phi[:5])) > max(6.0 * noise, 0.02)
    moving = np.nonzero(away[:-1] & away[1:])[0]
    if len(moving) and t[moving[0]] - t[0] > 0.25:
        return float(t[moving[0]]) - _BEFORE_RELEASE_S
    return None


def read_track(
    path: Path,
    rig: Rig,
    rig_path: Path,
    bellows_radius_m: float,
    states: Path | None = None,
    truth: bool = False,
    no_pwm: bool = False,
) -> TrackSource:
    """A log as a track.

    Parameters
    ----------
    states : states file to take the pose from; without pictures one beside the log is looked for.
    truth : take the true columns.
    no_pwm : logs without commands are swings with the hoses off.

    Raises
    ------
    BadInputError for a log that is too short, jumps in time, has no commands or commands out of range,
    no marker, or a rig without camera or plane where the pictures are needed.
    """
    log = read_log(path)
    said = log.passed_over()
    _check_clock(log)
    begin, tick_s, pwm = _commands(log, no_pwm)
    delay_s = 0.0
    if states is None and not truth and not len(log.sampled("u_px", "v_px")):
        states = states_beside(path)
    if truth:
        (t, head, W), how = _from_truth(log, bellows_radius_m), "truth"
    elif states is not None:
        (t, head, W), how = _from_states(states), "states"
        said.append(f"{log.source}: takes the pose from {shown(states)}")
    else:
        (t, head, W), delay_s = _from_pictures(log, rig, rig_path)
        how = "pictures"
    hoses = bool(pwm.any())
    if not hoses and len(t) > 20:
        let_go = _release(t, head[:, 0])
        if let_go is not None:
            begin, pwm = let_go, np.zeros((max(math.ceil((t[-1] - let_go) / tick_s) + 1, 2), 2))
            said.append(f"{log.source}: let go at {let_go:.2f} s; what is before is left out")
    inside = (t >= begin - 0.5 * tick_s) & (t <= begin + LONGEST_S)
    if t[-1] > begin + LONGEST_S:
        said.append(f"{log.source}: only the first {LONGEST_S:g} s are used")
    t, head, W = t[inside] - begin, head[inside], W[inside]
    pwm = pwm[: math.ceil(LONGEST_S / tick_s) + 1]
    if len(t) < _FEWEST or t[-1] - t[0] < _SHORTEST_S:
        span = float(t[-1] - t[0]) if len(t) else 0.0
        raise BadInputError(
            f"{log.source}: too short: {len(t)} poses over {span:.3g} s, expected at least {_FEWEST} and "
            f"{_SHORTEST_S:g} s"
        )
    t = np.maximum(t, 0.0)
    spread = np.linalg.inv(W[:20])
    noise = float(np.median(np.linalg.norm(spread[:, 0], axis=1)))
    # What a picture shows was so one delay earlier.
    seen_s = t - delay_s
    known = seen_s >= 0.0
    moving = start_in_motion(seen_s[known], head[known], hoses, nominal_of(rig, rig_path).plant, noise)
    if moving is not None:
        said.append(
            f"{log.source}: begins in motion ({moving.phi_rad:.3f} rad, {moving.dphi_radps:+.2f} rad/s); its "
            "start is estimated too"
        )
        # The first pictures show the head before the first tick.
        late = t >= delay_s + _LATE_S
        t, head, W = t[late], head[late], W[late]
    track = Track(shown(path.name), tick_s, pwm, hoses, t, head, W, moving)
    return TrackSource(track, how, delay_s, tuple(said), states, begin)


_LENGTHS = {"elongation_mm": 1e-3, "displacement_mm": 1e-3, "elongation_m": 1.0, "displacement_m": 1.0}
_LOADS = {"force_n": 1.0, "force_mn": 1e-3, "mass_kg": _GRAVITY_MPS2, "mass_g": 1e-3 * _GRAVITY_MPS2}


def read_displacements(path: Path) -> tuple[FloatArray, FloatArray]:
    """Elongations [m] and forces [N], each (n,), of a table of hanging weights or steady elongations.

    Columns are any of elongation or displacement in mm or m, and force_N, force_mN, mass_g or mass_kg.
    """
    header, rows, lines = read_columns(path)
    x = find_column(path, header, None, tuple(_LENGTHS), "elongation")
    y = find_column(path, header, None, tuple(_LOADS), "force")
    table = np.array(
        [
            [number(row[k], path, line, header[k]) for k in (x, y)]
            for row, line in zip(rows, lines, strict=True)
        ]
    )
    bad = np.nonzero(~np.isfinite(table).all(axis=1))[0]
    if len(bad):
        raise BadInputError(f"{shown(path)}, line {lines[int(bad[0])]}: has a blank or nan, expected numbers")
    return table[:, 0] * _LENGTHS[header[x].lower()], table[:, 1] * _LOADS[header[y].lower()]

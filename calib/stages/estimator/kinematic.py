"""The kinematic filter: a bank of noise levels over camera and IMU, event by event."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.stages.estimator.event import (
    CAMERA,
    IMU,
    LOG_LIKELIHOOD,
    REPORT,
    absorb,
    camera_terms,
    chi_squares,
    imu_terms,
    judge,
    stamp_variance,
    tell,
    update,
)
from calib.stages.estimator.section import EstimatorLevel
from calib.stages.estimator.sensors import QUANTITIES, SIZE, head_position, invert_marker

# ----------------------------------------------------------------------
# The kinematic process: how the head moves when nothing is known of what drives it.
#
# Angle and length each follow
#
#     dp = v dt + dw_p,   dv = (a - v / T_v) dt,   da = -a / T_a dt + dw_a
#
# with white noise w_p, w_a: an acceleration that forgets after T_a and a rate that dies after T_v
# (Singer 1970 with friction). One level of noise cannot serve rest and swing, so a bank of levels runs side
# by side as an interacting multiple model (Blom and Bar-Shalom 1988): before each event a level i starts
# from the mixture of all levels j with the weights of j having turned into i. The sensors' quantities
# are constant but for a slow random walk.
#
# A step of more than `LARGEST_STEP_S` is taken in parts, so that the series for the transition,
# I + A h + A^2 h^2 / 2 + A^3 h^3 / 6, and that for its noise hold.

LARGEST_STEP_S = 0.02


LEVELS = (
    EstimatorLevel("rest", 1.0, 3e-4, 0.04, 0.08, 5e-6, 1.5e-5),
    EstimatorLevel("drift", 1.0, 8e-3, 0.04, 7.5, 5e-6, 3e-6),
    EstimatorLevel("move", 20.0, 0.05, 0.02, 1.0, 1.3e-4, 2.6e-5),
    EstimatorLevel("swing", 120.0, 0.8, 0.05, 50.0, 7e-4, 6e-5),
)
"""From rest over the slow and quick motion of the pumps to a free swing.

Found by a random search for the least errors on simulated rigs whose parameters vary. Rest and drift have
the same angle, so that the gyroscope has no say in which of them it is: ten times as fast as the camera,
it would outvote the pictures, which alone see a slow change of length.
"""
PUSH = EstimatorLevel("push", 2.0, 0.1, 0.4, 50.0, 5e-6, 1e-5)
"""A hand that moves the head along, in logs that do not say what moves it.

With the angle of rest, a longer memory or a smaller acceleration it would take heads at rest as well, whose
length then jitters by 0.2 mm.
"""
JUMP = EstimatorLevel("jump", 120.0, 8.0, 0.03, 50.0, 7e-4, 6e-5)
"""Pumps that fill within three tenths of a second, and throw the head at up to the acceleration of gravity.

No other level expects that: for half a second all accelerations and pictures would be rejected.
"""


@dataclass(frozen=True)
class Kinematic:
    """Parameters of the process.

    Attributes
    ----------
    levels : the bank.
    switch_hz : rate at which one level turns into another.
    sensor_walk : (14,) densities of the walk of `sensors.SENSOR`, unit per sqrt(s).
    """

    levels: tuple[EstimatorLevel, ...] = LEVELS
    switch_hz: float = 0.1
    sensor_walk: tuple[float, ...] = tuple(one.walk for one in QUANTITIES.values())

    def beside(self, hand: bool) -> Kinematic:
        """With what tuning does not see: jumps, and where no model says what moves the head a `hand`."""
        *levels, swing = self.levels
        return replace(self, levels=(*levels, *([PUSH] if hand else []), JUMP, swing))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Levels (M, 8) and squared walks (14,) for the compiled functions."""
        return np.array([level.numbers() for level in self.levels]), np.array(self.sensor_walk) ** 2


@kernel(arrays=False, inlined=True)
def axis_transition(c: float, b: float, h: float) -> tuple[float, float, float, float, float]:
    """Entries f01, f02, f11, f12, f22 of the transition of (p, v, a) over h [s]; c = 1/T_a, b = 1/T_v."""
    h2, h3 = 0.5 * h * h, h * h * h / 6.0
    return (
        h - b * h2 + b * b * h3,
        h2 - (b + c) * h3,
        1.0 - b * h + b * b * h2 - b * b * b * h3,
        h - (b + c) * h2 + (b * b + b * c + c * c) * h3,
        1.0 - c * h + c * c * h2 - c * c * c * h3,
    )


@kernel(arrays=False, inlined=True)
def axis_noise(q: float, walk: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Entries pp, pv, pa, vv, va, aa of the noise over h [s] for the densities q of w_a, walk of w_p."""
    h2 = h * h
    h3 = h2 * h
    return (
        walk * h + q * h2 * h3 / 20.0,
        q * h2 * h2 / 8.0,
        q * h3 / 6.0,
        q * h3 / 3.0,
        q * h2 / 2.0,
        q * h,
    )


# ----------------------------------------------------------------------
# The bank: states (slots, M, 24) and covariances (slots, M, 20, 24) of its M levels, carried on and mixed. A
# slot holds the levels of one moment. Of the 24 places of a row 20 are used and the rest are zero: whole
# registers take half the time.

WIDTH = 24

_NEGLIGIBLE = 1e-6
"""A share of a mixture that is left out."""


def banked(
    x: FloatArray, P: FloatArray, w: FloatArray, slots: int = 2
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A bank whose slots all hold states (M, 20), covariances and weights, and its weights (slots, M + 1)."""
    wide_x, wide_P = np.zeros((slots, len(x), WIDTH)), np.zeros((slots, len(x), SIZE, WIDTH))
    wide_x[:, :, :SIZE], wide_P[..., :SIZE] = x, P
    return wide_x, wide_P, np.tile(np.append(w, 0.0), (slots, 1))


@kernel(arrays=False)
def copy_state(to_x: FloatArray, to_P: FloatArray, x: FloatArray, P: FloatArray) -> None:
    """Copy a state and its covariance."""
    for i in range(x.shape[0]):
        to_x[i] = x[i]
    to_flat, flat = to_P.reshape(-1), P.reshape(-1)
    for i in range(flat.shape[0]):
        to_flat[i] = flat[i]


@kernel(arrays=False)
def _step(x: FloatArray, P: FloatArray, level: FloatArray, walk: FloatArray, h: float) -> None:
    for axis in range(2):
        c, b, q, w = level[4 * axis], level[4 * axis + 1], level[4 * axis + 2], level[4 * axis + 3]
        f01, f02, f11, f12, f22 = axis_transition(c, b, h)
        p, v, a = axis, axis + 2, axis + 4
        x[p] += f01 * x[v] + f02 * x[a]
        x[v], x[a] = f11 * x[v] + f12 * x[a], f22 * x[a]
        for j in range(WIDTH):
            by_v, by_a = P[v, j], P[a, j]
            P[p, j] += f01 * by_v + f02 * by_a
            P[v, j] = f11 * by_v + f12 * by_a
            P[a, j] = f22 * by_a
        for i in range(6):
            by_v, by_a = P[i, v], P[i, a]
            P[i, p] += f01 * by_v + f02 * by_a
            P[i, v] = f11 * by_v + f12 * by_a
            P[i, a] = f22 * by_a
        pp, pv, pa, vv, va, aa = axis_noise(q, w, h)
        P[p, p] += pp
        P[v, p] += pv
        P[a, p] += pa
        P[v, v] += vv
        P[a, v] += va
        P[a, a] += aa
    for i in range(6):
        for j in range(i + 1, 6):
            P[i, j] = P[j, i]
        for j in range(6, SIZE):
            P[j, i] = P[i, j]
    for i in range(6, SIZE):
        P[i, i] += walk[i - 6] * h


@kernel(arrays=False)
def predict(x: FloatArray, P: FloatArray, level: FloatArray, walk: FloatArray, dt: float) -> None:
    """Carry a state (20,) and its covariance on by dt >= 0 [s], in place.

    Parameters
    ----------
    level : (8,) row of `Kinematic.arrays`. walk : (14,) squared densities of the sensors' walk.
    """
    if not dt > 0.0:
        return
    parts = max(math.ceil(dt / LARGEST_STEP_S - 1e-9), 1)
    for _ in range(parts):
        _step(x, P, level, walk, dt / parts)


@kernel(arrays=False)
def mix(bank_x: FloatArray, bank_P: FloatArray, weights: FloatArray, old: int, new: int, turn: float) -> None:
    """Let the levels start from their mixtures.

    As any level turns into each other one alike, a mixture is that of a level itself and of all together.

    Parameters
    ----------
    weights : (slots, M + 1) of the levels in each slot; `old` is read, `new` written.
    turn : probability of turning into each one of the others.
    """
    count, whole = bank_x.shape[1], 0.0
    stay = 1.0 - (count - 1) * turn
    for i in range(count):
        whole += weights[old, i]
    # All together stand in the last level, which is the last to be written.
    all_x, all_P = bank_x[new, count - 1], bank_P[new, count - 1]
    for j in range(WIDTH):
        all_x[j] = 0.0
    for i in range(count):
        x, part = bank_x[old, i], weights[old, i] / whole
        for j in range(WIDTH):
            all_x[j] += part * x[j]
    for i in range(count):
        x, P, part = bank_x[old, i], bank_P[old, i], weights[old, i] / whole
        for r in range(SIZE):
            apart, keep = x[r] - all_x[r], 1.0 if i > 0 else 0.0
            for j in range(WIDTH):
                all_P[r, j] = keep * all_P[r, j] + part * (P[r, j] + apart * (x[j] - all_x[j]))
    for m in range(count):
        own = (stay - turn) * weights[old, m]
        total = own + turn * whole
        weights[new, m] = total
        x, P, to_x, to_P = bank_x[old, m], bank_P[old, m], bank_x[new, m], bank_P[new, m]
        part = turn * whole / total
        if part < _NEGLIGIBLE:
            copy_state(to_x, to_P, x, P)
            continue
        own /= total
        for r in range(SIZE):
            apart = own * part * (x[r] - all_x[r])
            for j in range(WIDTH):
                to_P[r, j] = own * P[r, j] + (part * all_P[r, j] + apart * (x[j] - all_x[j]))
        for r in range(SIZE):
            to_x[r] = own * x[r] + part * all_x[r]


@kernel(arrays=False)
def settle_weights(weights: FloatArray, slot: int, log_likelihood: FloatArray, place: int) -> float:
    """Weights of a slot after an event, in place; returns the log likelihood of the event.

    No weight falls below 1e-6, so that a level can come back.

    Parameters
    ----------
    weights : (slots, M + 1). log_likelihood : (M, n), of which the column `place` counts.
    """
    count = weights.shape[1] - 1
    best = -math.inf
    for j in range(count):
        best = max(best, log_likelihood[j, place])
    total = 0.0
    for j in range(count):
        weights[slot, j] *= math.exp(log_likelihood[j, place] - best)
        total += weights[slot, j]
    if not total > 0.0:
        for j in range(count):
            weights[slot, j] = 1.0 / count
        return best
    floored = 0.0
    for j in range(count):
        weights[slot, j] = max(weights[slot, j] / total, 1e-6)
        floored += weights[slot, j]
    for j in range(count):
        weights[slot, j] /= floored
    return best + math.log(total)


# ----------------------------------------------------------------------
# Time stamps made even: a causal clock for each sensor that samples at a steady rate.
#
# A sensor's k-th sample was taken at o + k T; its stamp has jitter, waits in buffers and is sometimes that of
# the sample before. A Kalman filter on (time of this sample, period) with a period that wanders a little is a
# line fitted with forgetting: its gains fall as in a fit of a line and end at about one in a hundred.
#
# A stamp that comes a number of periods late says that samples are missing, and they are counted where that
# is likelier than jitter by what a missing sample is rarer; each late stamp in a row adds its evidence. One
# is taken back where the next stamp is early by as much. A stamp that is off by less, or early, is not
# believed; the sample gets the time that was due. When ten in a row are not believed the clock starts again
# from the stamp, as it does where time jumps.

_WANDER = 2e-6
_JITTER_S = 5e-4
_GATE = 5.0
_RARE = 7.0
"""Logarithm of how much rarer a missing sample is than one that is there."""
_MOST_MISTRUST = 10


def new_clock(period_s: float) -> FloatArray:
    """A clock for a sensor that samples about every `period_s` [s]; NaN: stamps are taken as they are.

    Its entries are: running, time, period, P_tt, P_tT, P_TT, jitter variance, unbelieved in a row, nominal,
    count, and how many samples were last counted as missing, until a stamp is believed again.
    """
    clock = np.zeros(11)
    clock[8] = period_s
    clock[6] = _JITTER_S**2
    return clock


@kernel(arrays=False)
def restart(clock: FloatArray) -> None:
    """Forget the time, but neither the nominal period nor the jitter."""
    clock[0] = 0.0
    clock[7] = 0.0


@kernel(arrays=False)
def advance(clock: FloatArray, stamp: float) -> float:
    """Time of the sample that came with this stamp [s]."""
    nominal = clock[8]
    if not nominal > 0.0:
        return float(stamp)
    if clock[0] == 0.0:
        if clock[9] == 0.0:
            clock[2] = nominal
        clock[9] += 1.0
        return float(advance_again(clock, stamp))
    T = clock[2]
    time = clock[1] + T
    steps = 1.0
    error = stamp - time
    recently, clock[10] = clock[10], 0.0
    if error > 0.5 * T or (recently > 0.0 and error < -0.5 * T):
        missed = math.floor(error / T + 0.5) if error > 0.0 else -1.0
        # A period is not known well enough to count over a long gap.
        if missed * math.sqrt(clock[5]) > 0.1 * T:
            return float(advance_again(clock, stamp))
        left, spread = error - missed * T, clock[3] + clock[6]
        # Only where the stamp then fits: a sample that waited half a period is late, none is missing.
        fits = abs(left) < _GATE * math.sqrt(spread) + 0.01 * T
        if fits and error * error - left * left > 2.0 * spread * _RARE / (1.0 + clock[7]):
            steps += missed
            time += missed * T
            error = left
            clock[10] = max(missed, 0.0)
    wander = (_WANDER * nominal) ** 2 * steps
    tt = clock[3] + 2.0 * steps * clock[4] + steps * steps * clock[5]
    tT = clock[4] + steps * clock[5]
    TT = clock[5] + wander
    limit = _GATE * math.sqrt(tt + clock[6])
    clock[1], clock[3], clock[4], clock[5] = time, tt, tT, TT
    clock[9] += 1.0
    if abs(error) > min(limit, 0.45 * nominal):
        clock[7], clock[10] = clock[7] + 1.0, recently
        if clock[7] >= _MOST_MISTRUST:
            return float(advance_again(clock, stamp))
        return float(time)
    clock[7] = 0.0
    S = tt + clock[6]
    clock[1] += tt / S * error
    clock[2] += tT / S * error
    clock[5] = TT - tT * tT / S
    clock[4] = tT - tT * tt / S
    clock[3] = tt - tt * tt / S
    clock[6] += 0.01 * (max(error * error, 1e-10) - clock[6])
    return float(clock[1])


@kernel(arrays=False)
def advance_again(clock: FloatArray, stamp: float) -> float:
    """Start from this stamp with the period as it was."""
    clock[0], clock[1], clock[7] = 1.0, stamp, 0.0
    clock[3], clock[4], clock[5] = clock[6], 0.0, (1e-3 * clock[8]) ** 2
    return stamp


@kernel()
def even_times(clock: FloatArray, stamps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and their variances of samples with these stamps (n,) [s], from the stamps up to each."""
    out, variance = np.empty(len(stamps)), np.empty(len(stamps))
    for i in range(len(stamps)):
        out[i] = advance(clock, stamps[i])
        variance[i] = clock[3]
    return out, variance


# ----------------------------------------------------------------------
# One event of the fused filter: a picture or an IMU sample, for all levels of the bank.
#
# The noise of an accelerometer grows with the head's acceleration by a share, for errors of scale, those of
# gyroscope and marker by what an error of the time stamps makes of the motion (`event`). What calibration and
# alignment say of the geometry (lever, marker offset, shift and stretch of the plane) is considered and not
# learnt: a single log does not change it.

CONSIDERED = (11, 12, 14, 15, 16, 19)
"""Entries of the state that readings do not change."""

_LEARNT = np.array([0.0 if k in CONSIDERED else 1.0 for k in range(WIDTH)])

MIXED_S = 0.015
"""The levels are mixed at each picture, without pictures after so long: their turns take seconds."""

WORK = (11, WIDTH)
"""Scratch of each level: gradients (3), predictions with variances, innovations, P H' (3), places (3)."""

TRACE = 2 * SIZE + 2
"""What a reading leaves for the smoother, see `event.leave`."""


@kernel(arrays=False)
def mixes(kind: int, since: float) -> bool:
    """Whether the levels are mixed before an event of this kind, so long after they last were [s]."""
    return bool(kind == CAMERA or (kind != 0 and since > MIXED_S))


@kernel(arrays=False)
def bank_event(
    bank_x: FloatArray, bank_P: FloatArray, weights: FloatArray, old: int, new: int, kind: int, z: FloatArray,
    dt: float, switch_hz: float, levels: FloatArray, walk: FloatArray, view: FloatArray,
    noise: FloatArray, work: FloatArray, told: FloatArray, again: bool,
    report: FloatArray, gated: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """Carry the bank on to an event and update it.

    Parameters
    ----------
    bank_x, bank_P : of which slot `old` is read and `new` written; of one level they may be the same.
    weights : (slots, M + 1) weights of the levels, and the time since they were last mixed [s].
    kind, z, dt : `CAMERA`, `IMU` or 0 for none; (4,) readings and variance of their time [s^2]; time since
        the event before [s].
    switch_hz, levels, walk : of `Kinematic`, (M, 8) levels.
    view, noise : camera (25,), `NOISE` (11,).
    work, told : (M, *`WORK`) and (M, 7) scratch.
    again : whether the event is done once more; then `gated` (3,) holds.
    report : (12,) of `REPORT`, written to.
    trace : (3, `TRACE`) what each reading of the last level did, for the smoother; (0, `TRACE`) for nothing.
    """
    count = bank_x.shape[1]
    since = weights[old, count] + max(dt, 0.0)
    if count > 1 and mixes(kind, since):
        mix(bank_x, bank_P, weights, old, new, (1.0 - math.exp(-count * switch_hz * since)) / count)
        since = 0.0
    elif old != new:
        for m in range(count):
            copy_state(bank_x[new, m], bank_P[new, m], bank_x[old, m], bank_P[old, m])
            weights[new, m] = weights[old, m]
    weights[new, count] = since
    if not again:
        for k in range(12):
            report[k] = math.nan
    report[11] = 0.0
    for k in range(trace.shape[0]):
        trace[k, TRACE - 1] = 0.0
    stamp = stamp_variance(kind, noise, z)
    for m in range(count):
        x, P, out = bank_x[new, m], bank_P[new, m], work[m, 3]
        predict(x, P, levels[m], walk, dt)
        if kind == CAMERA:
            camera_terms(view, noise, stamp, x, P, work[m], out)
        elif kind == IMU:
            imu_terms(noise, stamp, x, P, work[m], out)
        if kind != 0:
            chi_squares(
                kind, P, work[m], z, out, noise, work[m, 4], work[m, 5:8], work[m, 8:], told[m], int(WIDTH)
            )  # fmt: skip
    if kind == 0:
        return
    if not again:
        judge(kind, z, told, noise, kind == IMU, gated, report)
    for m in range(count):
        told[m, LOG_LIKELIHOOD] = absorb(
            kind, bank_x[new, m], bank_P[new, m], work[m], work[m, 4], work[m, 3], noise, gated, _LEARNT,
            work[m, 5:8], work[m, 8:], trace, int(WIDTH),
        )  # fmt: skip
    report[11] = told[0, LOG_LIKELIHOOD]
    if count > 1:
        report[11] = settle_weights(weights, new, told, int(LOG_LIKELIHOOD))
    if not again:
        tell(kind, weights[new], told, report)


# ----------------------------------------------------------------------
# What goes into the fused filter and what comes out: set-up, rows, columns and flags.

FLAGS = {
    "restarted": 1,
    "camera_silent": 2,
    "imu_silent": 4,
    "held_by_prior": 8,
    "late": 16,
    "time_jump": 32,
    "not_started": 64,
}
"""Bits of the column `flags`."""

OUT = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", *REPORT, "flags", "swing_weight", "rest_weight",
    "driven_weight", "let_go_s",
)  # fmt: skip
"""Columns of the output; the last is the time at which somebody let go of the head, in the row that told."""


@dataclass(frozen=True)
class Start:
    """What is known before the first reading.

    Attributes
    ----------
    head, head_sigma : (6,) of `sensors.HEAD`.
    sensor, sensor_sigma : (14,) of `sensors.SENSOR`.
    sensor_covariance : (14, 14) in place of the deviations, where the quantities are not independent.
    """

    sensor: FloatArray
    sensor_sigma: FloatArray
    head: FloatArray = field(default_factory=lambda: np.array([0.0, 0.068, 0.0, 0.0, 0.0, 0.0]))
    head_sigma: FloatArray = field(default_factory=lambda: np.array([0.4, 0.015, 2.0, 0.1, 100.0, 2.0]))
    sensor_covariance: FloatArray | None = None

    def covariance(self) -> FloatArray:
        """Covariance (20, 20) of head and sensors."""
        P = np.diag(np.concatenate([self.head_sigma, self.sensor_sigma]) ** 2)
        if self.sensor_covariance is not None:
            P[6:, 6:] = self.sensor_covariance
        return np.asarray(P)


@dataclass(frozen=True)
class Setup:
    """Everything that stays the same over a log.

    Attributes
    ----------
    view : (25,) of `sensors.view_coefficients`; without a camera any.
    noise : (11,) of `event.NOISE`.
    start : prior. `sensor[7]`, the time offset, is the delay of the pictures.
    bellows_radius_m : r_B.
    process : bank of levels.
    camera_period_s, imu_period_s : nominal; NaN takes the stamps as they are.
    command_period_s : of the commands; NaN where each holds until the next, however long.
    imu_delay_s : age of the IMU's readings. waits_s : how long readings wait for those of their burst.
    """

    view: FloatArray
    noise: FloatArray
    start: Start
    bellows_radius_m: float
    process: Kinematic = field(default_factory=Kinematic)
    camera_period_s: float = math.nan
    imu_period_s: float = math.nan
    command_period_s: float = math.nan
    imu_delay_s: float = 0.0
    waits_s: float = 0.0

    @property
    def delay_s(self) -> float:
        """Delay of the pictures, which come from no future."""
        return max(float(self.start.sensor[7]), 0.0)

    @property
    def ring(self) -> int:
        """How many of the last events a filter keeps: those since the exposure of a late picture."""
        period = self.imu_period_s if self.imu_period_s > 0.0 else 0.002
        late_s = max(self.delay_s, self.imu_delay_s + self.waits_s)
        return min(max(16, math.ceil(2.0 * (late_s + 0.02) / period) + 8), 512)


@dataclass(frozen=True)
class Rows:
    """Rows of a log, NaN where nothing was sampled.

    Attributes
    ----------
    t_s : (n,) stamps.
    readings : (n, 5) u, v [px], a_x, a_y [m/s^2], g_z [rad/s].
    kinds : (n,) 1 for the camera's tick, with or without a marker, 2 for an IMU sample, 3 for both.
    waited_s : (n,) how long before their stamp readings were taken, for those that come in bursts; or (0,).
    pwm : (n, 2) commands of the pumps; or (0, 2).
    """

    t_s: FloatArray
    readings: FloatArray
    kinds: IntArray
    waited_s: FloatArray = field(default_factory=lambda: np.empty(0))
    pwm: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def taken_s(self) -> FloatArray:
        """What the clocks take for stamps (n,) [s]."""
        return self.t_s - self.waited_s if len(self.waited_s) else self.t_s

    @property
    def commands(self) -> FloatArray:
        """Commands (n, 2), NaN in rows without."""
        return self.pwm if len(self.pwm) else np.full((len(self), 2), math.nan)

    def __len__(self) -> int:
        return len(self.t_s)

    def __getitem__(self, part: slice | BoolArray | IntArray) -> Rows:
        return Rows(*(values[part] if len(values) else values for values in vars(self).values()))

    @staticmethod
    def joined(parts: Sequence[Rows]) -> Rows:
        """Rows of a log in one piece."""
        return Rows(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


# ----------------------------------------------------------------------
# Columns 1 to 12 of the output: lengths, rates, pose, bias and deviations from states and covariances.

_JUMP_S = (-0.1, 2.0)


@kernel(arrays=False)
def begin_row(
    stamp: float, last: float, camera_clock: FloatArray, imu_clock: FloatArray, out: FloatArray, row: int
) -> bool:
    """Blank a row but for its stamp; whether time jumps there from the last one, where clocks start again."""
    out[row] = math.nan
    out[row, 0] = stamp
    step = stamp - last
    jumps = step < _JUMP_S[0] or step > _JUMP_S[1]
    if jumps:
        restart(camera_clock)
        restart(imu_clock)
    return bool(jumps)


@kernel(arrays=False)
def finish_row(
    phi: float, length: float, dphi: float, dl: float, bias: float, pp: float, ll: float, pl: float, r: float,
    out: FloatArray, row: int,
) -> None:  # fmt: skip
    """Means and variances into columns 1 to 12 of a row."""
    out[row, 1], out[row, 2] = length + r * phi, length - r * phi
    out[row, 3], out[row, 4] = dl + r * dphi, dl - r * dphi
    out[row, 5], out[row, 6] = phi, length
    out[row, 7], out[row, 8] = head_position(phi, length)
    out[row, 9] = bias
    out[row, 10] = math.sqrt(max(ll + r * r * pp + 2.0 * r * pl, 1e-18))
    out[row, 11] = math.sqrt(max(ll + r * r * pp - 2.0 * r * pl, 1e-18))
    out[row, 12] = math.sqrt(max(pp, 1e-18))


class Bank(NamedTuple):
    """States (slots, M, 20), covariances and weights (slots, M + 1) of the levels, as in `bank_event`."""

    x: FloatArray
    P: FloatArray
    weights: FloatArray


@kernel(arrays=False)
def write_bank(
    bank: Bank, slot: int, dt: float, levels: FloatArray, radius: float, out: FloatArray, row: int
) -> None:
    """Means and deviations of the bank a short time dt after its last event into columns 1 to 12."""
    count = bank.weights.shape[1] - 1
    phi = length = dphi = dl = bias = pp = ll = pl = 0.0
    # Second moments about the first level: what cancels is no more than the levels are apart.
    phi_0 = length_0 = 0.0
    for m in range(count):
        x, P = bank.x[slot, m], bank.P[slot, m]
        a01, a02, a11, a12, _ = axis_transition(levels[m, 0], levels[m, 1], dt)
        b01, b02, b11, b12, _ = axis_transition(levels[m, 4], levels[m, 5], dt)
        phi_m = x[0] + a01 * x[2] + a02 * x[4]
        length_m = x[1] + b01 * x[3] + b02 * x[5]
        if m == 0:
            phi_0, length_0 = phi_m, length_m
        phi_m, length_m = phi_m - phi_0, length_m - length_0
        var_p = (
            P[0, 0] + a01 * a01 * P[2, 2] + a02 * a02 * P[4, 4]
            + 2.0 * (a01 * P[0, 2] + a02 * P[0, 4] + a01 * a02 * P[2, 4])
        )  # fmt: skip
        var_l = (
            P[1, 1] + b01 * b01 * P[3, 3] + b02 * b02 * P[5, 5]
            + 2.0 * (b01 * P[1, 3] + b02 * P[1, 5] + b01 * b02 * P[3, 5])
        )  # fmt: skip
        cross = P[0, 1] + b01 * P[0, 3] + b02 * P[0, 5]
        cross += a01 * (P[2, 1] + b01 * P[2, 3] + b02 * P[2, 5])
        cross += a02 * (P[4, 1] + b01 * P[4, 3] + b02 * P[4, 5])
        if dt > 0.0:
            var_p += axis_noise(levels[m, 2], levels[m, 3], dt)[0]
            var_l += axis_noise(levels[m, 6], levels[m, 7], dt)[0]
        w = bank.weights[slot, m]
        phi += w * phi_m
        length += w * length_m
        dphi += w * (a11 * x[2] + a12 * x[4])
        dl += w * (b11 * x[3] + b12 * x[5])
        bias += w * x[6]
        pp += w * (var_p + phi_m * phi_m)
        ll += w * (var_l + length_m * length_m)
        pl += w * (cross + phi_m * length_m)
    finish_row(
        phi_0 + phi, length_0 + length, dphi, dl, bias, pp - phi * phi, ll - length * length,
        pl - phi * length, radius, out, row,
    )  # fmt: skip


@kernel(arrays=False)
def write_columns(
    x: FloatArray, P: FloatArray, bias: int, rows: IntArray, radius: float, out: FloatArray
) -> None:
    """States (k, n) and covariances (k, n, n) into columns 1 to 12 of these rows (k,) of `out`.

    `bias` is the place of the gyroscope's bias in a state.
    """
    for k in range(len(rows)):
        finish_row(
            x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, bias], P[k, 0, 0], P[k, 1, 1], P[k, 0, 1], radius, out,
            rows[k],
        )  # fmt: skip


# ----------------------------------------------------------------------
# The fused filter, row by row: what is known of the head at the time of each row of a log.
#
# A picture arrives `time_offset` after it was exposed, when newer IMU samples have been used already. The
# last events are kept with the state after each; an event that belongs between them is put there and
# those after it are done again. So each row's output rests on all that had arrived by then, and on nothing
# else. Time stamps go through the clocks first.
#
# What goes wrong is said in `flags`: a picture or a sample that was gated; a sensor that is silent; a restart
# after half a second of rejected pictures, at a jump of the time, or from a state that no rig has; an angle
# or length that no sensor sees, which the prior then holds.

NEWEST, COUNT = 0, 1
"""Where a filter's integers tell the place of the newest of the last events, and how many there are."""

FASTEST_MPS = 1.0
"""No rig's bellows change their lengths faster: a swing from 0.7 rad reaches a quarter of it."""
_SILENT_S = 0.5
_LOCKED_OUT_S = 0.5
_KNOWN_M = 0.012
"""A length with a larger deviation than this is as good as unknown: the prior holds it within 12 to 23 mm."""
_LAST, _CAMERA_SEEN, _IMU_SEEN, _REJECTED_SINCE, _GYRO_REJECTED_SINCE = range(5)
_CAMERA_STARTED, _PENDING = 2, 3
_PHI, _LENGTH = 0, 1
_ALL = np.ones(WIDTH)


@kernel(arrays=False)
def _clear(P: FloatArray, i: int, variance: float) -> None:
    """Make a state independent of all others."""
    for j in range(P.shape[0]):
        P[i, j], P[j, i] = 0.0, 0.0
    P[i, i] = variance


@kernel(arrays=False)
def _reset_head(bank: Bank, slot: int, head: FloatArray, sigma: FloatArray) -> None:
    """Forget the head's motion; what is known of the sensors stays."""
    count = bank.x.shape[1]
    for m in range(count):
        for i in range(6):
            bank.x[slot, m, i] = head[i]
            _clear(bank.P[slot, m], i, sigma[i] * sigma[i])
        bank.weights[slot, m] = 1.0 / count


@kernel(arrays=False)
def _place_head(bank: Bank, slot: int, phi: float, length: float) -> None:
    for m in range(bank.x.shape[1]):
        bank.x[slot, m, 0], bank.x[slot, m, 1] = phi, length


@kernel(arrays=False)
def _hold(x: FloatArray, P: FloatArray, k: int, middle: float, sigma: float, p: FloatArray) -> None:
    """Use the prior of one quantity of the head as a reading; p (20,) is scratch."""
    for j in range(p.shape[0]):
        p[j] = P[k, j]
    update(x, P, middle - x[k], P[k, k] + sigma * sigma, p, _ALL)


@kernel(arrays=False)
def _mend(
    bank: Bank, slot: int, head: FloatArray, head_sigma: FloatArray, radius: float, p: FloatArray
) -> int:
    """Whether the state is still one that a rig can have, and what is done where it is not: flags."""
    flags = 0
    for m in range(bank.x.shape[1]):
        x, P = bank.x[slot, m], bank.P[slot, m]
        if P[0, 0] > 1.0:
            _hold(x, P, int(_PHI), head[0], 0.7, p)
        if P[1, 1] > 2.25 * head_sigma[1] * head_sigma[1]:
            _hold(x, P, int(_LENGTH), head[1], head_sigma[1], p)
        bad = not (abs(x[0]) < 3.0 and 1e-3 < x[1] < 1.0)
        for i in range(SIZE):
            bad = bad or not (abs(x[i]) < 1e6 and P[i, i] > 0.0)
        # Faster than a rig: where it is stays, as unsure as the prior, and its motion is not known.
        fast = not abs(x[3]) + radius * abs(x[2]) < FASTEST_MPS
        if not (bad or fast):
            continue
        flags |= 1
        for i in range(SIZE if bad else 6):
            if bad or i >= 2:
                x[i] = head[i]
            # A level that has left the model starts again from the prior, all of it.
            _clear(P, i, head_sigma[i] ** 2)
    return flags


class Events(NamedTuple):
    """The last events, in a ring.

    Attributes
    ----------
    t : (size,) times [s]. z, gated : (size, 4) and (size, 3) as in `bank_event`. kind : (size,).
    let_go : (size,) time before it at which the head was let go, NaN for none; or empty.
    """

    t: FloatArray
    z: FloatArray
    kind: IntArray
    gated: FloatArray
    let_go: FloatArray


def no_events(size: int, let_go: FloatArray) -> Events:
    """A ring of this size without events."""
    return Events(
        np.zeros(size),
        np.zeros((size, 4)),
        np.zeros(size, dtype=np.int64),
        np.zeros((size, 3)),
        let_go,
    )


@kernel(arrays=False)
def count_first(events: Events, whole: IntArray, when: float) -> None:
    """Let the ring of events begin where it is empty."""
    if whole[COUNT] == 0:
        events.t[whole[NEWEST]], events.kind[whole[NEWEST]] = when, 0
        whole[COUNT] = 1


@kernel(arrays=False)
def make_room(events: Events, whole: IntArray, kind: int, when: float) -> int:
    """Put an event among the last ones, by its time; how many are after it, -1 where it is older than all.

    Its readings are the caller's to write. What is only known to be older than the oldest of a ring that is
    not full goes right after that one.
    """
    t, z, kinds, gated, let_go = events.t, events.z, events.kind, events.gated, events.let_go
    size, newest, back = t.shape[0], whole[NEWEST], 0
    while back < whole[COUNT] - 1 and t[(newest - back) % size] > when:
        back += 1
    if t[(newest - back) % size] > when:
        if whole[COUNT] == size:
            return -1
        when = t[(newest - back) % size]
    for i in range(back):
        to, since = (newest + 1 - i) % size, (newest - i) % size
        t[to], kinds[to] = t[since], kinds[since]
        for k in range(z.shape[1]):
            z[to, k] = z[since, k]
        for k in range(3):
            gated[to, k] = gated[since, k]
        if let_go.shape[0]:
            let_go[to] = let_go[since]
    own = (newest + 1 - back) % size
    t[own], kinds[own] = when, kind
    return int(back)


@kernel(arrays=False)
def settle_event(whole: IntArray, size: int, report: FloatArray, out: FloatArray, row: int) -> None:
    """The ring has one event more; what it says of itself goes into its row."""
    whole[NEWEST] = (whole[NEWEST] + 1) % size
    whole[COUNT] = min(whole[COUNT] + 1, size)
    if not math.isnan(out[row, 24]) and not math.isnan(report[11]):
        report[11] += out[row, 24]
    for k in range(12):
        if not math.isnan(report[k]):
            out[row, 13 + k] = report[k]


class _Memory(NamedTuple):
    """What the filter remembers beside bank and events: (4,) from `NEWEST`, (5,) from `_LAST` on, clocks."""

    whole: IntArray
    real: FloatArray
    camera_clock: FloatArray
    imu_clock: FloatArray


class _Model(NamedTuple):
    """What does not change, as in `bank_event`; prior (20,) of head and sensors and its deviations, radius
    of a bellows, delays of pictures and of the IMU's readings [s].
    """

    switch_hz: float
    levels: FloatArray
    walk: FloatArray
    camera: FloatArray
    noise: FloatArray
    prior: FloatArray
    prior_sigma: FloatArray
    radius: float
    delay: float
    imu_delay: float


class _Room(NamedTuple):
    """Scratch: that of `bank_event`, a second report, and a trace of no rows."""

    work: FloatArray
    told: FloatArray
    report: FloatArray
    spare: FloatArray
    untraced: FloatArray


@kernel(arrays=False)
def _begin_at(u: float, v: float, bank: Bank, slot: int, memory: _Memory, model: _Model) -> int:
    """Begin at a picture where it shows a head that a rig can have; flags."""
    x, rest, flags = bank.x[slot, 0], model.prior[1], 0
    phi, length, found = 0.0, 0.0, False
    for attempt in range(2):
        if not found:
            angle = x[0] if attempt == 0 else 0.0
            phi, length, found = invert_marker(model.camera, x[6:], u, v, angle, rest)
    if found and 0.2 * rest < length < 3.0 * rest:
        if memory.whole[_CAMERA_STARTED] == 1:
            flags = 1
        _reset_head(bank, slot, model.prior, model.prior_sigma)
        _place_head(bank, slot, phi, length)
        memory.whole[_CAMERA_STARTED], memory.whole[_PENDING] = 1, 0
    return flags


@kernel(arrays=False)
def _after_rejections(
    kind: int, stamp: float, report: FloatArray, bank: Bank, memory: _Memory, model: _Model
) -> int:
    """What follows from a sensor that has been rejected for `_LOCKED_OUT_S`; flags."""
    real = memory.real
    since, gate = (_REJECTED_SINCE, 8) if kind == CAMERA else (_GYRO_REJECTED_SINCE, 10)
    if report[gate] == 0.0:
        real[since] = math.nan
    elif report[gate] == 1.0 and math.isnan(real[since]):
        real[since] = stamp
    elif report[gate] == 1.0 and stamp - real[since] > _LOCKED_OUT_S:
        real[since] = math.nan
        if kind == CAMERA:
            memory.whole[_PENDING] = 1
            return 0
        here = memory.whole[NEWEST]
        phi, length = bank.x[here, 0, 0], bank.x[here, 0, 1]
        _reset_head(bank, here, model.prior, model.prior_sigma)
        _place_head(bank, here, phi, length)
        return 1
    return 0


@kernel(arrays=False)
def _write_ahead(
    ahead: float, bank: Bank, memory: _Memory, model: _Model, room: _Room, out: FloatArray, row: int
) -> int:
    """The bank so long after its last event into a row; flags. The last slot of the bank is scratch."""
    here, slot, levels = memory.whole[NEWEST], bank.x.shape[0] - 1, model.levels
    if abs(ahead) <= 0.02:
        write_bank(bank, here, ahead, levels, model.radius, out, row)
        if max(abs(out[row, 3]), abs(out[row, 4])) < FASTEST_MPS:
            return 0
    for m in range(levels.shape[0]):
        bank.weights[slot, m] = bank.weights[here, m]
        x, P = bank.x[slot, m], bank.P[slot, m]
        copy_state(x, P, bank.x[here, m], bank.P[here, m])
        predict(x, P, levels[m], model.walk, ahead)
    flags = _mend(bank, slot, model.prior, model.prior_sigma, model.radius, room.work[0, 5])
    write_bank(bank, slot, 0.0, levels, model.radius, out, row)
    return int(flags)


@kernel(arrays=False)
def run_filter(
    t: FloatArray, taken: FloatArray, readings: FloatArray, kinds: IntArray, bank: Bank, events: Events,
    memory: _Memory, model: _Model, room: _Room, out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n,), (n, 5), (n,) through the ring of the last events; writes `out` (n, len(OUT))."""
    whole, real, size, count = memory.whole, memory.real, events.t.shape[0], model.levels.shape[0]
    head, head_sigma, report = model.prior, model.prior_sigma, room.report
    z0 = z1 = z2 = late2 = 0.0
    for row in range(len(t)):
        stamp, flags = t[row], 0
        if begin_row(stamp, real[_LAST], memory.camera_clock, memory.imu_clock, out, row):
            _reset_head(bank, whole[NEWEST], head, head_sigma)
            whole[COUNT], whole[_CAMERA_STARTED], whole[_PENDING] = 0, 0, 0
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
            real[_REJECTED_SINCE], real[_GYRO_REJECTED_SINCE] = math.nan, math.nan
            flags |= 32
        elif math.isnan(real[_LAST]):
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
        real[_LAST] = stamp
        for kind in range(1, 3):
            if not kinds[row] & kind:
                continue
            if kind == CAMERA:
                when, late2 = advance(memory.camera_clock, taken[row]) - model.delay, memory.camera_clock[3]
                z0, z1, z2 = readings[row, 0], readings[row, 1], math.nan
                if math.isnan(z0) or math.isnan(z1):
                    continue
                real[_CAMERA_SEEN] = stamp
            else:
                when, late2 = advance(memory.imu_clock, taken[row]) - model.imu_delay, memory.imu_clock[3]
                z0, z1, z2 = readings[row, 2], readings[row, 3], readings[row, 4]
                if math.isnan(z2) and (math.isnan(z0) or math.isnan(z1)):
                    continue
                real[_IMU_SEEN] = stamp
            newest = whole[NEWEST]
            if whole[COUNT] == 0:
                count_first(events, whole, when)
                if kind == IMU and not math.isnan(z0) and math.hypot(z0, z1) > 1.0:
                    tilt = math.atan2(z1, z0) - bank.x[newest, 0, 9]
                    tilt = min(max(math.atan2(math.sin(tilt), math.cos(tilt)), -1.5), 1.5)
                    _place_head(bank, newest, tilt, bank.x[newest, 0, 1])
            back = make_room(events, whole, kind, when)
            if back < 0:
                flags |= 16
                continue
            own = (newest + 1 - back) % size
            events.z[own, 0], events.z[own, 1], events.z[own, 2], events.z[own, 3] = z0, z1, z2, late2
            if kind == CAMERA and (whole[_CAMERA_STARTED] == 0 or whole[_PENDING] == 1):
                flags |= _begin_at(z0, z1, bank, (own - 1) % size, memory, model)
            for i in range(back + 1):
                now = (own + i) % size
                before = (now - 1) % size
                bank_event(
                    bank.x, bank.P, bank.weights, before, now, events.kind[now], events.z[now],
                    events.t[now] - events.t[before], model.switch_hz, model.levels, model.walk,
                    model.camera, model.noise, room.work, room.told, i > 0, report if i == 0 else room.spare,
                    events.gated[now], room.untraced,
                )  # fmt: skip
                flags |= _mend(bank, now, head, head_sigma, model.radius, room.work[0, 5])
            settle_event(whole, size, report, out, row)
            flags |= _after_rejections(kind, stamp, report, bank, memory, model)
        if stamp - real[_CAMERA_SEEN] > _SILENT_S:
            flags |= 2
        if stamp - real[_IMU_SEEN] > _SILENT_S:
            flags |= 4
        here = whole[NEWEST]
        ahead = stamp - events.t[here] if whole[COUNT] > 0 else 0.0
        if whole[COUNT] == 0:
            flags |= 64
        flags |= _write_ahead(ahead, bank, memory, model, room, out, row)
        if max(out[row, 10], out[row, 11]) > _KNOWN_M:
            flags |= 8
        out[row, 25] = flags
        out[row, 26], out[row, 27] = bank.weights[here, count - 1], bank.weights[here, 0]


def starting_state(setup: Setup, rows: Rows | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State (M, 20), covariance and weights before the first reading.

    Parameters
    ----------
    rows : where given, the first of them that the camera can be inverted for says where the head begins.
    """
    start, count = setup.start, len(setup.process.levels)
    mean = np.concatenate([start.head, start.sensor])
    # Pictures are put at their exposure, so that what is left of the offset is zero.
    mean[13] -= setup.delay_s
    if rows is not None:
        for u, v in rows.readings[np.isfinite(rows.readings[:, :2]).all(axis=1)][:20, :2].tolist():
            phi, length, found = invert_marker(setup.view, mean[6:], u, v, 0.0, float(start.head[1]))
            if found and 0.2 * start.head[1] < length < 3.0 * start.head[1]:
                mean[0], mean[1] = phi, length
                break
    return np.tile(mean, (count, 1)), np.tile(start.covariance(), (count, 1, 1)), np.full(count, 1.0 / count)


class Filter:
    """A filter at work: rows in, estimates out, with memory of the last events only."""

    longer_m = None
    """As of `driven.DrivenFilter`, whose plant alone has a length at rest."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        levels, walk = setup.process.arrays()
        size = setup.ring
        prior, covariance, _ = starting_state(setup)
        # One slot more than the ring has, for what is only looked ahead.
        self._bank = Bank(*banked(*starting_state(setup), size + 1))
        self._events = no_events(size, np.empty(0))
        self._memory = _Memory(
            np.zeros(4, dtype=np.int64), np.full(5, np.nan), new_clock(setup.camera_period_s),
            new_clock(setup.imu_period_s),
        )  # fmt: skip
        self._model = _Model(
            setup.process.switch_hz, levels, walk, setup.view, setup.noise, prior[0],
            np.sqrt(np.diag(covariance[0])), setup.bellows_radius_m, setup.delay_s,
            setup.imu_delay_s,
        )  # fmt: skip
        self._room = _Room(
            np.empty((len(levels), *WORK)), np.zeros((len(levels), 7)), np.empty(len(REPORT)),
            np.empty(len(REPORT)), np.empty((0, TRACE)),
        )  # fmt: skip

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        out = np.empty((len(rows), len(OUT)))
        run_filter(
            rows.t_s, rows.taken_s, rows.readings, rows.kinds, self._bank, self._events, self._memory,
            self._model, self._room, out,
        )  # fmt: skip
        return out

    @property
    def sensor(self) -> FloatArray:
        """What the log has come to say of `sensors.SENSOR` (14,), as in `starting_state`."""
        x, _, weights = self.state
        return np.asarray(weights @ x[:, 6:])

    @property
    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State (M, 20), covariance (M, 20, 20) and weights (M,) after the last event."""
        here, count = int(self._memory.whole[NEWEST]), len(self._model.levels)
        x, P = self._bank.x[here, :, :SIZE], self._bank.P[here, :, :, :SIZE]
        return x.copy(), P.copy(), self._bank.weights[here, :count].copy()

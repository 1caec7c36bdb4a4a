"""Residuals of simulated against estimated motion and their derivatives, for several logs at once.

Unknowns are the parameters that are estimated, and what each log needs beside them:

    offset_phi, offset_length      of the camera's plane, the same in all logs, small by their priors
    delay                          of the measured rows; for logs with commands one for all, since there
                                   it cannot be told from the pumps' dead time, else one for each log
    phi, length                    before each log's first tick; of a log that begins in motion also rates,
                                   creep and forces there, bounded by wide priors about a first guess

The whitened residual of a row is r = W (measured - simulated(t - delay) - offset). Derivatives by
parameters and starts are central differences, which a batch of simulations gives at once; those by the
delays and offsets are exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from calib.actuator.identify_parameters import PARAMETERS, Nominal, made
from calib.actuator.identify_tracks import Start, Track, heads_of
from calib.actuator.parameters import Plant
from calib.actuator.pump import Pump
from calib.arrays import FloatArray

__all__ = ["CAMERA_DELAY_S", "FAR", "Layout", "Problem", "first_guess", "jacobian", "residuals", "starts_of"]

CAMERA_DELAY_S = 0.025
"""Usual time from the exposure to the tick that reads the result."""

FAR = 1e3
"""Residual of a row that a candidate cannot reach at all."""

_OFFSET_SIGMA = (0.005, 0.0005)
_DELAY_SIGMA_S = 0.03
_STEP = 1e-4
_START_STEP = (1e-4, 1e-5, 1e-3, *(1e-4,) * 7)
_START_SCALE = (0.01, 0.001, 0.1, 0.005, 0.02, 0.02, *(0.05,) * 4)
_START_REACH = (0.3, 0.02, 30.0, 1.0, 2.0, 2.0, *(5.0,) * 4)
"""Steps, scales and bounds by `identify_tracks.COMPONENTS`."""
_FREE_SIGMA = (3.0, 0.1, 0.2, 0.2)
_PUMPED_SIGMA = (0.5, 0.02, 0.2, 0.2, *(0.5,) * 4)
"""Priors of the same, without those of angle and length: of free swings and of logs with pumps."""
_PRIORS = ("offset_phi_rad", "offset_length_m")


@dataclass(frozen=True)
class Layout:
    """Where the unknowns are: parameters, offsets, delays, starts."""

    names: tuple[str, ...]
    delays: tuple[int, ...]
    starts: tuple[int, ...]

    @property
    def offset(self) -> int:
        return len(self.names)

    @property
    def delay(self) -> int:
        return self.offset + 2

    @property
    def start(self) -> int:
        return self.delay + max(self.delays) + 1

    @property
    def size(self) -> int:
        return self.start + sum(self.starts)

    def of_start(self, k: int) -> slice:
        """The start of log k."""
        at = self.start + sum(self.starts[:k])
        return slice(at, at + self.starts[k])

    @property
    def nuisances(self) -> int:
        return self.size - len(self.names)


@dataclass(frozen=True)
class Problem:
    """Logs and what is estimated from them.

    Attributes
    ----------
    names : parameters that are estimated. held : values of others that differ from the nominal ones.
    delay_s, delay_sigma_s : what is known of the rows' delay.
    """

    nominal: Nominal
    tracks: Sequence[Track]
    names: tuple[str, ...]
    held: Mapping[str, float]
    delay_s: float = CAMERA_DELAY_S
    delay_sigma_s: float = _DELAY_SIGMA_S
    threads: int = 2

    @property
    def layout(self) -> Layout:
        numbers, used, shared = [], 0, -1
        for track in self.tracks:
            if track.hoses:
                if shared < 0:
                    shared, used = used, used + 1
                numbers.append(shared)
            else:
                numbers.append(used)
                used += 1
        return Layout(self.names, tuple(numbers), tuple(len(track.unknown) for track in self.tracks))

    def scales(self) -> FloatArray:
        """Typical changes of all unknowns."""
        layout = self.layout
        out = np.empty(layout.size)
        out[: layout.offset] = [PARAMETERS[name].scale for name in self.names]
        out[layout.offset : layout.delay] = _OFFSET_SIGMA
        out[layout.delay : layout.start] = 0.01
        for k, count in enumerate(layout.starts):
            out[layout.of_start(k)] = _START_SCALE[:count]
        return out

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest values of all unknowns."""
        layout = self.layout
        low, high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        low[: layout.offset] = [PARAMETERS[name].low for name in self.names]
        high[: layout.offset] = [PARAMETERS[name].high for name in self.names]
        low[layout.delay : layout.start], high[layout.delay : layout.start] = -0.5, 0.5
        for k, track in enumerate(self.tracks):
            at, count = layout.of_start(k), layout.starts[k]
            begin, reach = np.array(astuple(track.start))[:count], np.array(_START_REACH)[:count]
            low[at], high[at] = begin - reach, begin + reach
        return low, high

    def values(self, x: FloatArray) -> dict[str, float]:
        """Parameters by name of a vector of unknowns."""
        return {**self.held, **dict(zip(self.names, x[: len(self.names)].tolist(), strict=True))}


def first_guess(problem: Problem, values: Mapping[str, float]) -> FloatArray:
    """Unknowns with these parameters, offsets zero, usual delays, and starts as they were measured."""
    layout = problem.layout
    x = np.zeros(layout.size)
    x[: layout.offset] = [values[name] for name in problem.names]
    x[layout.delay : layout.start] = problem.delay_s
    for k, track in enumerate(problem.tracks):
        x[layout.of_start(k)] = astuple(track.start)[: layout.starts[k]]
    return x


def starts_of(problem: Problem, x: FloatArray) -> list[Start]:
    """Starts of all logs in a vector of unknowns."""
    layout = problem.layout
    return [Start(*x[layout.of_start(k)].tolist()) for k in range(len(problem.tracks))]


def _whitened(track: Track, error: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mij,...mj->...mi", track.whitening, error))


def _start_sigma(track: Track) -> FloatArray:
    return np.array(_PUMPED_SIGMA if track.hoses else _FREE_SIGMA)


def _priors(problem: Problem, x: FloatArray) -> FloatArray:
    layout = problem.layout
    offsets = x[layout.offset : layout.delay] / np.array(_OFFSET_SIGMA)
    delays = (x[layout.delay : layout.start] - problem.delay_s) / problem.delay_sigma_s
    parts = [offsets, delays]
    for k, track in enumerate(problem.tracks):
        if track.moving is not None:
            guess = np.array(astuple(track.moving))[2 : layout.starts[k]]
            parts.append((x[layout.of_start(k)][2:] - guess) / _start_sigma(track))
    return np.concatenate(parts)


def residuals(problem: Problem, xs: FloatArray) -> FloatArray:
    """Whitened residuals (sets, rows) of vectors of unknowns (sets, size), the priors' at the end.

    The rows are those of the logs in turn, angle and length of a picture side by side (before whitening).
    """
    layout = problem.layout
    parts = []
    values = [problem.values(x) for x in xs]
    for k, track in enumerate(problem.tracks):
        starts = [starts_of(problem, x)[k] for x in xs]
        delay = layout.delay + layout.delays[k]
        # Candidates of one batch may differ in their delay; rates shift them to their own.
        middle = float(np.mean(xs[:, delay]))
        head, rate = heads_of(track, problem.nominal, values, starts, middle, problem.threads)
        if np.ptp(xs[:, delay]) > 0.0:
            head = head - rate * (xs[:, delay] - middle)[:, None, None]
        error = track.head - head - xs[:, None, layout.offset : layout.delay]
        rows = _whitened(track, error).reshape(len(xs), -1)
        parts.append(np.where(np.isfinite(rows), rows, FAR))
    parts.append(np.stack([_priors(problem, x) for x in xs]))
    return np.concatenate(parts, axis=1)


def jacobian(problem: Problem, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (rows,) and their derivatives (rows, size) at a vector of unknowns."""
    layout, scales = problem.layout, problem.scales()
    low, high = problem.bounds()
    P = len(problem.names)
    steps = _STEP * np.maximum(np.abs(x[:P]), scales[:P])
    up, down = np.minimum(x[:P] + steps, high[:P]), np.maximum(x[:P] - steps, low[:P])
    base = problem.values(x)
    moved = [base]
    for name, a, b in zip(problem.names, up.tolist(), down.tolist(), strict=True):
        moved += [{**base, name: a}, {**base, name: b}]
    # Making a plant checks it, which takes as long as a short log: once for all logs of a kind.
    alike: dict[tuple[bool, float], list[tuple[Plant, Pump]]] = {}
    blocks, errors = [], []
    for k, track in enumerate(problem.tracks):
        begin = starts_of(problem, x)[k]
        sets, starts = list(moved), [begin] * len(moved)
        kind = track.hoses, track.tick_s
        if kind not in alike:
            alike[kind] = [made(problem.nominal, values, *kind) for values in moved]
        count = layout.starts[k]
        for name, step in zip(track.unknown, _START_STEP, strict=False):
            sets += [base, base]
            starts += [replace(begin, **{name: getattr(begin, name) + s * step}) for s in (1.0, -1.0)]
        delay = layout.delay + layout.delays[k]
        pairs = [*alike[kind], *[alike[kind][0]] * (len(sets) - len(moved))]
        head, rate = heads_of(track, problem.nominal, sets, starts, float(x[delay]), problem.threads, pairs)
        W = track.whitening
        J = np.zeros((len(track.t_s), 2, layout.size))
        width = np.concatenate([up - down, 2.0 * np.array(_START_STEP)[:count]])
        slope = (head[1::2] - head[2::2]) / width[:, None, None]
        slope = -np.einsum("mij,smj->mis", W, slope)
        J[:, :, :P] = slope[:, :, :P]
        J[:, :, layout.of_start(k)] = slope[:, :, P:]
        J[:, :, layout.offset : layout.delay] = -W
        J[:, :, delay] = _whitened(track, rate[0])
        error = _whitened(track, track.head - head[0] - x[layout.offset : layout.delay])
        good = np.isfinite(error).all() and np.isfinite(J).all()
        blocks.append(J.reshape(-1, layout.size) if good else np.zeros((2 * len(track.t_s), layout.size)))
        errors.append(np.where(np.isfinite(error), error, FAR).reshape(-1))
    prior = np.zeros((2 + layout.start - layout.delay, layout.size))
    for row, sigma in enumerate(_OFFSET_SIGMA):
        prior[row, layout.offset + row] = 1.0 / sigma
    for row in range(layout.start - layout.delay):
        prior[2 + row, layout.delay + row] = 1.0 / problem.delay_sigma_s
    priors = [prior]
    for k, track in enumerate(problem.tracks):
        if track.moving is not None:
            rows = np.zeros((layout.starts[k] - 2, layout.size))
            rows[:, layout.of_start(k)][:, 2:] = np.diag(1.0 / _start_sigma(track))
            priors.append(rows)
    return np.concatenate([*errors, _priors(problem, x)]), np.vstack([*blocks, *priors])

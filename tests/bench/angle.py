"""Untuned and tuned levelling filter on simulated rigs: `python tests/bench/angle.py [COUNT]`.

For each seed `tune` sees a chirp, an ellipse and an orientation log without their truth and chooses a filter;
it is judged on four other logs, after 5 s, against the best of 28 x 25 pairs of gains of (2.3) that are
chosen on the very log with its truth. Samples are means of 60 Hz. Last come the medians of the ratios.
"""

from __future__ import annotations

import _here
import numpy as np

import calib
from calib.io.logs import Log
from calib.stages.imu.levelling import Levelling
from calib.stages.imu.mahony import filter_log, wrapped
from calib.stages.imu.read import drift_log
from calib.stages.imu.tuning import DATA_SHEET, THREE, AngleFilter, Piece, damped, tune

GRID = [damped(Kp, z) for Kp in np.geomspace(0.02, 20.0, 28) for z in np.geomspace(0.15, 10.0, 25)]
TUNED_ON, JUDGED_ON = ("chirp", "ellipse", "orientation"), ("prbs", "ellipse", "orientation", "swing")
PERIOD_S = 1.0 / 60.0


def piece(log: Log) -> tuple[Piece, np.ndarray]:
    """Means of 60 Hz of what the twin logs at 100 Hz, and the true angle in their middle."""
    read = drift_log(log)
    edges = np.arange(read.t_s[0], read.t_s[-1], PERIOD_S)
    sums = np.concatenate([np.zeros((1, len(read.axes))), np.cumsum(read.values, axis=0) * 0.01])
    ends = np.append(read.t_s, read.t_s[-1] + 0.01)
    at = np.stack([np.interp(edges, ends, one) for one in sums.T], axis=1)
    values = np.diff(at, axis=0) / PERIOD_S
    gz, ax, ay = (values[:, read.axes.index(axis)] for axis in ("gz", "ax", "ay"))
    # A reading stands for the step before its stamp's end as it does for that behind it.
    t = 0.5 * (edges[1:] + edges[:-1]) - 0.005
    truth = np.interp(t, read.true_t_s, np.unwrap(read.true_phi_rad))
    return Piece(log.source, t - t[0], np.arctan2(ay, ax), -gz), truth


def error_deg(gains: AngleFilter, one: Piece, truth: np.ndarray) -> float:
    """Standard deviation after the start: 5 s, or a second of a short log."""
    late = one.t_s > min(5.0, 0.25 * one.t_s[-1])
    off = wrapped(filter_log(gains, one.t_s, one.phi_acc_rad, one.rate_radps)[0] - truth)[late]
    return float(np.degrees(off.std()))


def main(count: int) -> None:
    """Print a line for each log and the medians."""
    ratios = []
    print("seed log             oracle       3/3 levelling    chosen, deg")
    for seed in range(1, count + 1):
        blind = [piece(calib.simulate(name, seed=seed))[0] for name in TUNED_ON]
        chosen = tune(blind, DATA_SHEET).recommended
        for name in JUDGED_ON:
            one, truth = piece(calib.simulate(name, seed=1000 + seed))
            oracle = min(error_deg(gains, one, truth) for gains in GRID)
            found = [error_deg(gains, one, truth) for gains in (THREE, Levelling(), chosen.gains)]
            words = "".join(f"{x:10.3f}" for x in (oracle, *found))
            print(f"{seed:4} {name:12}{words}  {chosen.name}")
            ratios.append([x / oracle for x in found])
    middle = np.median(ratios, axis=0)
    print(f"median of the ratios: 3/3 {middle[0]:.2f}, levelling {middle[1]:.2f}, chosen {middle[2]:.2f}")


if __name__ == "__main__":
    main(*_here.numbers(20))

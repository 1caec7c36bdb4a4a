"""Speed of the angle filter over a log: `python tests/bench/mahony.py [SAMPLES]`.

Ten million samples, beside a pure Python loop of the same filter and the filters of ahrs, imufusion and
vqf where they are installed. Slow ones get fewer samples, and their time is that for all.
"""

from __future__ import annotations

import importlib
import math

import _here
import numpy as np
from _rows import Row, fastest, print_rows

from calib.stages.imu.mahony import Mahony, MahonyState, filter_log

DT_S = 0.01


def looped(phi_acc: list[float], w: list[float], Kp: float = 3.0, Ki: float = 3.0) -> list[float]:
    """(2.3) with nothing around it."""
    phi, integral, turn, out = phi_acc[0], 0.0, 2.0 * math.pi, []
    for angle, speed in zip(phi_acc, w, strict=True):
        e = math.remainder(angle - phi, turn)
        integral += Ki * e * DT_S
        phi += (Kp * e + integral + speed) * DT_S
        out.append(phi)
    return out


def rows(n: int = 10_000_000) -> list[Row]:
    """A row for each peer."""
    rng = np.random.default_rng(0)
    t = DT_S * np.arange(n)
    w = np.tile(np.repeat(rng.normal(size=100), 100), -(-n // 10_000))[:n]
    phi = np.cumsum(w) * DT_S
    phi_acc = np.arctan2(np.sin(phi), np.cos(phi)) + 0.02 * rng.normal(size=n)
    filter_log(Mahony(), t[:10], phi_acc[:10], w[:10])
    ours = fastest(lambda: filter_log(Mahony(), t, phi_acc, w), 3)
    few = min(n, 20_000)
    # The loop's first sample has a step, that of a log has none.
    start = MahonyState(float(phi_acc[0]))
    shifted = filter_log(
        Mahony(), DT_S * np.arange(few + 1), *(np.append(x[0], x[:few]) for x in (phi_acc, w)), start
    )
    worst = np.abs(shifted[0][1:] - looped(phi_acc[:few].tolist(), w[:few].tolist())).max()
    few = min(n, 1_000_000)
    a, b = phi_acc[:few].tolist(), w[:few].tolist()
    job, loop = f"angle filter, {n:.0e} samples", fastest(lambda: looped(a, b), 3) * n / few
    found = [Row(job, "pure Python", ours, loop, 4.0, note=f"differs by {worst:.0e} rad")]
    acc = 9.81 * np.stack([np.cos(phi_acc), np.sin(phi_acc), np.zeros(n)], axis=1)
    gyr = np.stack([np.zeros(n), np.zeros(n), -w], axis=1)
    for name, most, run in (("vqf", n, _vqf), ("imufusion", 200_000, _imufusion), ("ahrs", 20_000, _ahrs)):
        try:
            module = importlib.import_module(name)
        except ImportError:
            found.append(Row(job, name, ours, None, 4.0, note="not installed"))
            continue
        few = min(n, most)
        peer = fastest(lambda r=run, m=module, k=few: r(m, gyr[:k], acc[:k]), 1) * n / few
        found.append(Row(job, name, ours, peer, 4.0))
    return found


def _vqf(module: object, gyr: np.ndarray, acc: np.ndarray) -> None:
    module.VQF(DT_S).updateBatch(np.ascontiguousarray(gyr), np.ascontiguousarray(acc))


def _imufusion(module: object, gyr: np.ndarray, acc: np.ndarray) -> None:
    filter_ = module.Ahrs()
    degrees, g = np.degrees(gyr), acc / 9.81
    for k in range(len(gyr)):
        filter_.update_no_magnetometer(degrees[k], g[k])


def _ahrs(module: object, gyr: np.ndarray, acc: np.ndarray) -> None:
    importlib.import_module("ahrs.filters").Mahony(gyr=gyr, acc=acc, frequency=1.0 / DT_S)


if __name__ == "__main__":
    print_rows(rows(*_here.numbers(10_000_000)))

"""Speed of the angle filter over a log, as a script: `python tests/bench/mahony.py [--samples N]`.

Ten million samples, beside a pure Python loop of the same filter and the filters of ahrs, imufusion and
vqf where they are installed. Slow ones get fewer samples; rates are per second.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parent)]

from _rows import Row

from calib.stages.imu.mahony import Mahony, MahonyState, filter_log

DT_S = 0.01


def rate(work: Callable[[], object], samples: int, repeats: int) -> float:
    """Samples per second of the fastest run: others may share the machine."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return samples / min(times)


def looped(phi_acc: list[float], w: list[float], Kp: float = 3.0, Ki: float = 3.0) -> list[float]:
    """(2.3) with nothing around it."""
    phi, integral, turn, out = phi_acc[0], 0.0, 2.0 * math.pi, []
    for angle, speed in zip(phi_acc, w, strict=True):
        e = math.remainder(angle - phi, turn)
        integral += Ki * e * DT_S
        phi += (Kp * e + integral + speed) * DT_S
        out.append(phi)
    return out


def measured(n: int, repeats: int) -> tuple[float, dict[str, float]]:
    """Samples a second of ours and of the peers that are here."""
    rng = np.random.default_rng(0)
    t = DT_S * np.arange(n)
    w = np.tile(np.repeat(rng.normal(size=100), 100), -(-n // 10_000))[:n]
    phi = np.cumsum(w) * DT_S
    phi_acc = np.arctan2(np.sin(phi), np.cos(phi)) + 0.02 * rng.normal(size=n)
    filter_log(Mahony(), t[:10], phi_acc[:10], w[:10])
    ours = rate(lambda: filter_log(Mahony(), t, phi_acc, w), n, repeats)
    few = min(n, 20_000)
    # The loop's first sample has a step, that of a log has none.
    start = MahonyState(float(phi_acc[0]))
    shifted = filter_log(
        Mahony(), DT_S * np.arange(few + 1), *(np.append(x[0], x[:few]) for x in (phi_acc, w)), start
    )
    worst = np.abs(shifted[0][1:] - looped(phi_acc[:few].tolist(), w[:few].tolist())).max()
    print(f"calib, {n} samples: {ours / 1e6:.1f} million samples/s (wanted: 20)")
    print(f"largest difference from (2.3) in a loop over {few} samples: {worst:.1e} rad")
    others = {}
    few = min(n, 1_000_000)
    a, b = phi_acc[:few].tolist(), w[:few].tolist()
    others["pure Python"] = rate(lambda: looped(a, b), few, repeats)
    acc = 9.81 * np.stack([np.cos(phi_acc), np.sin(phi_acc), np.zeros(n)], axis=1)
    gyr = np.stack([np.zeros(n), np.zeros(n), -w], axis=1)
    for name, samples, run in (
        ("vqf", n, _vqf),
        ("imufusion", 200_000, _imufusion),
        ("ahrs", 20_000, _ahrs),
    ):
        try:
            module = importlib.import_module(name)
        except ImportError:
            print(f"{name}: not installed, skipped")
            continue
        part = slice(0, min(n, samples))
        others[name] = rate(lambda r=run, m=module, p=part: r(m, gyr[p], acc[p]), part.stop, 1)
    return ours, others


def rows() -> list[Row]:
    """Ten million samples; the peers' time for as many."""
    n = 10_000_000
    ours, others = measured(n, 3)
    return [
        Row("angle filter, 10^7 samples", name, n / ours, n / other, 4.0) for name, other in others.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    told = parser.parse_args()
    ours, others = measured(told.samples, told.repeats)
    for name, other in others.items():
        print(f"{name}: {other / 1e6:.3f} million samples/s, {ours / other:.1f} times slower")
    print(f"fastest of the others: {ours / max(others.values()):.1f} times slower (wanted: 4)")


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
    main()

"""Processor in the loop: how many times faster than real time, beside the simulator alone in the same run.

    python tests/bench/firmware_loop.py

The simulated ATmega328P closes the loop around the simulated rig, ellipse and 0.7 rad step, with MM and
low-pass and with the fused estimator. The simulator alone has the same records one after the other, without a
plant. Wall time and processor time are told, which part from each other on a busy machine.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "firmware"))

import numpy as np
from firmware_build import avr, write
from firmware_rigs import header
from test_loop import Avr, closed, experiment


class _Recorder:
    """A processor that keeps what it was asked."""

    def __init__(self, inner: Avr) -> None:
        self.inner = inner
        self.asked: list[tuple[np.ndarray, bool, int]] = []

    def tick(self, numbers: np.ndarray, seen: bool, mode: int) -> np.ndarray:
        self.asked.append((numbers.copy(), seen, mode))
        return self.inner.tick(numbers, seen, mode)


def _replay(processor: Avr, asked: list[tuple[np.ndarray, bool, int]]) -> None:
    for one in asked:
        processor.tick(*one)


def _best(call: Callable[[], object], repeats: int = 5) -> tuple[float, float]:
    wall, own = [], []
    for _ in range(repeats):
        began, spent = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - began)
        own.append(time.process_time() - spent)
    return min(wall), min(own)


def main() -> None:
    """Print the table."""
    print(f"{'times real time':>28} {'loop, wall':>12} {'loop, CPU':>12} {'AVR, wall':>12} {'AVR, CPU':>12}")
    for kind, fused in (("nominal", False), ("twin", True)):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write(folder, header(kind))
            processor = Avr(avr(folder, *(["-DCALIB_FUSED=1"] if fused else []))[0])
            for what in ("ellipse", "step"):
                wanted, mode = experiment(what)
                recorder = _Recorder(processor)
                closed(recorder, wanted, mode)

                alone = partial(_replay, processor, recorder.asked)
                looped = partial(closed, processor, wanted, mode)
                seconds = len(wanted) / 60.0
                rates = [seconds / each for call in (looped, alone) for each in _best(call)]
                label = f"{what}, {'fused' if fused else 'MM'}"
                print(f"{label:>28}" + "".join(f" {rate:>12.0f}" for rate in rates), flush=True)


if __name__ == "__main__":
    main()

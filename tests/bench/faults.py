"""Faults injected into the sketch on the simulated ATmega328P: milliseconds until both pumps are off.

    python tests/bench/faults.py [MOMENTS] [FAULT ...]

The sketch runs on the real Arduino core in simavr, with models of BNO055 and Pixy2 and an actuator that
follows the pumps. At each of MOMENTS times, 24 by default, 3.9 ms apart and so over more than five ticks and
all bytes of the bus, the board goes on once with each fault. The board's clock begins anew in the middle of
them. Back to work: whether the pumps run again 3 s after a fault that lasted 1.5 s. The exit code is 1 when
one took longer than it may, or went on wrongly.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import _here
from firmware_build import sketch
from test_guard import FAULTS, at_many_moments, kept

STEP_MS = 3.9


def main(moments: int, faults: list[str]) -> int:
    """Print the table; the exit code."""
    bad = 0
    print(f"{'':>15} {'moments':>8} {'at least':>9} {'median':>9} {'at most':>9} {'may':>6}  back to work")
    with tempfile.TemporaryDirectory() as name:
        board = sketch(Path(name), "POSITION")
        for fault, off_ms, again in at_many_moments(board, moments, STEP_MS, faults):
            may, after = FAULTS[fault][0], sorted(off_ms)
            cells = f"{'goes on':>9} {'':>9} {'':>9} {'':>6}"
            if may is not None:
                cells = f"{after[0]:6.1f} ms {after[len(after) // 2]:6.1f} ms {after[-1]:6.1f} ms {may:6d}"
            good = kept(fault, off_ms, again)
            told = f"{'yes' if again else 'no'}{'' if good else '   NOT AS IT HAS TO BE'}"
            print(f"{fault:>15} {len(after):>8} {cells}  {told}")
            bad += not good
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(*_here.numbers(24), sys.argv[2:] or list(FAULTS)))

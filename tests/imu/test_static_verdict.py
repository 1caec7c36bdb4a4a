"""Sampling faults: remarks while they are few, reasons for a poor verdict when they are many."""

from __future__ import annotations

import numpy as np
import pytest

from calib.imu.static import RestLog, analyse_static
from calib.imu.static_verdict import Judgement, judge

N = 6000


def _judged(t: np.ndarray, rows: np.ndarray, values: np.ndarray | None = None) -> Judgement:
    rng = np.random.default_rng(0)
    if values is None:
        values = 2e-3 * rng.normal(size=(N, 2))
    log = RestLog("log.csv", ("gy", "gz"), t[rows], values[rows], np.zeros(0), np.zeros(0))
    return judge(analyse_static([log]))


@pytest.mark.parametrize(("repeated", "verdict"), [(12, "ok"), (600, "poor")])
def test_repeated_rows(repeated: int, verdict: str) -> None:
    rows = np.sort(np.concatenate([np.arange(N), np.arange(N)[:: N // repeated]]))
    judged = _judged(0.01 * np.arange(N), rows)
    said = judged.remarks if verdict == "ok" else judged.reasons
    assert judged.verdict == verdict
    assert any(
        f"{repeated} rows" in sentence and "repeat the one before; dropped" in sentence for sentence in said
    )


@pytest.mark.parametrize(("every", "verdict"), [(3000, "ok"), (20, "poor")])
def test_missing_samples(every: int, verdict: str) -> None:
    rows = np.flatnonzero((np.arange(N) % every != 7) & (np.arange(N) % every != 8))
    judged = _judged(0.01 * np.arange(N), rows)
    said = judged.remarks if verdict == "ok" else judged.reasons
    assert judged.verdict == verdict
    assert any("samples missing" in sentence and "30 ms" in sentence for sentence in said)


def test_a_long_gap_is_a_remark() -> None:
    t = 0.01 * np.arange(N)
    t[3000:] += 3600.0
    judged = _judged(t, np.arange(N))
    assert judged.verdict == "ok"
    assert "log.csv: split at a gap of 3600 s after 29.99 s" in judged.remarks


def test_readings_at_their_limit() -> None:
    values = 2e-3 * np.random.default_rng(1).normal(size=(N, 2))
    values[500:520, 1] = np.radians(250.0)
    judged = _judged(0.01 * np.arange(N), np.arange(N), values)
    assert judged.verdict == "poor"
    assert "log.csv: gz is at the end of its range in 20 samples" in judged.reasons

"""One log through an estimator: rows for figures, and the verdict."""

from __future__ import annotations

import numpy as np
import pytest

from calib.replay import Trace, judged

GOOD = {"degrees": 2, "readings": 900, "gated": 2, "nis": 2.1, "inside": 0.95, "correlation": 0.02}


@pytest.mark.parametrize(("rows", "step"), [(100, 1), (12_000, 1), (30_000, 4), (200_000, 32)])
def test_a_trace_keeps_every_k_th_row_whatever_the_blocks(rows: int, step: int) -> None:
    values = np.arange(float(rows))[:, None]
    for size in (rows, 997, 4096):
        trace = Trace()
        for begin in range(0, rows, size):
            trace.add(values[begin : begin + size])
        kept = trace.values[:, 0]
        assert len(kept) <= 12_000 + 4096
        steps = np.unique(np.diff(kept))
        assert len(steps) == 1
        if size == 997:
            assert steps[0] == step
    assert Trace().values.shape == (0, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nis": 9.0}, "the innovations of the camera are 4.5 times what the covariance expects"),
        ({"nis": 0.2}, "the innovations of the camera are 0.1 times"),
        ({"inside": 0.5}, "only 50 % of the camera's innovations lie in their 95 % band"),
        ({"gated": 300}, "25 % of the camera's readings were gated out"),
    ],
)
def test_innovations_that_contradict_their_covariance_are_poor(change: dict[str, float], words: str) -> None:
    reasons, _ = judged({"camera": {**GOOD, **change}}, {}, 1000)
    assert len(reasons) == 1 and words in reasons[0]


@pytest.mark.parametrize("correlation", [0.8, -0.8])
def test_innovations_that_are_not_white_are_remarked_on(correlation: float) -> None:
    reasons, remarks = judged({"accel": {**GOOD, "correlation": correlation}}, {}, 1000)
    assert reasons == []
    assert remarks == [f"the innovations of the accel are not white: {correlation:.2f} with the one before"]

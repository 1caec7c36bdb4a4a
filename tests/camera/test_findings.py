"""The words of the verdict and its limits hang together."""

from __future__ import annotations

from dataclasses import asdict

from calib.camera.findings import INCONSISTENT, OK, POOR, UNIDENTIFIABLE, VERDICTS, Limits, listed


def test_verdicts_from_best_to_worst() -> None:
    assert VERDICTS == (OK, POOR, INCONSISTENT, UNIDENTIFIABLE)


def test_limits_are_ordered() -> None:
    limits = Limits()
    assert all(value > 0 for value in asdict(limits).values())
    assert limits.focal_remark < limits.focal_poor < limits.focal_free
    assert limits.spread_free_deg < limits.spread_poor_deg
    assert limits.centre_remark < limits.centre_poor
    assert 1.0 < limits.view_remark < limits.view_bad
    assert limits.aspect_remark < limits.aspect_bad
    assert limits.bow_remark < limits.bow_bad
    assert limits.bow_focal_remark < limits.bow_focal


def test_long_lists_are_cut_and_counted() -> None:
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(i) for i in range(9)], 3) == "0, 1, 2 and 6 more"
    assert listed(["a", "b", "c"], 3) == "a, b, c"

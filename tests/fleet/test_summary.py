"""A fleet's summary: outliers, drift and whom to look at, in bounded size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.runner.fleet import FleetSummary, judged_names, summarise, write_outcomes
from calib.runner.task import Outcome

pytest.importorskip("pyarrow")


def _fleet(count: int, seed: int = 0) -> dict[str, Outcome]:
    """Rigs of which the 7th stands out in cx, the 3rd has failed, the 5th is poor, and fx drifts."""
    rng = np.random.default_rng(seed)
    out = {}
    for k in range(1, count + 1):
        values = {
            "camera.fx_px": (273.0 + 0.02 * k + 0.3 * rng.standard_normal(), 0.2),
            "camera.cx_px": (160.0 + 0.5 * rng.standard_normal() + 9.0 * (k == 7), 0.1),
            "camera.views": (6.0 + k % 2, None),
            "plane.R_CW[0][0]": (rng.standard_normal(), None),
            "camera.skew_px": (0.0, None),
        }
        status, code = ("failed", 3) if k == 3 else ("poor", 1) if k == 5 else ("ok", 0)
        name = f"rig{k}"
        out[name] = Outcome(
            name, f"S{k:05d}", "/x", status, code, "" if status == "ok" else f"why {k}",
            stages={"intrinsics": status}, values=values if status != "failed" else {}, seconds=float(k),
            peak_MB=100.0 + k,
        )  # fmt: skip
    return out


def _summary(tmp_path: Path, count: int) -> FleetSummary:
    known = _fleet(count)
    path = tmp_path / f"{count}.parquet"
    write_outcomes(path, list(known), known.get)
    summary, worst, which = summarise(path)
    assert worst.shape == (count,) and len(which) == count
    assert which[6] == "camera.cx_px" and worst[6] > summary.limit and np.isnan(worst[2])
    return summary


def test_outliers_drift_and_looks(tmp_path: Path) -> None:
    found = _summary(tmp_path, 120)
    by_name = {one.name: one for one in found.constants}
    assert set(by_name) == {"camera.fx_px", "camera.cx_px"}
    assert found.verdicts == {"failed": 1, "poor": 1, "ok": 118}
    assert found.stages == {"intrinsics": {"ok": 118, "failed": 1, "poor": 1}}
    fx, cx = by_name["camera.fx_px"], by_name["camera.cx_px"]
    assert fx.drifts and fx.drift is not None
    assert abs(fx.drift.slope - 0.02) < 4.0 * fx.drift.sigma
    assert not cx.drifts and cx.standing_out == 1 and cx.out[0][0] == "rig7" and fx.unit == "px"
    assert sum(cx.counts) + cx.below + cx.above == 119 and cx.above == 1
    assert [look.name for look in found.looks] == ["rig3", "rig7", "rig5"] and found.to_look_at == 3
    assert found.looks[0].why == "why 3" and "camera.cx_px is" in found.looks[1].why
    assert found.seconds == sum(range(1, 121)) and found.longest_s == 120.0 and found.peak_MB == 220.0
    assert found.numbered == 120


def test_its_size_does_not_grow_with_the_fleet(tmp_path: Path) -> None:
    for count in (40, 2000):
        found = _summary(tmp_path, count)
        assert all(len(one.points) <= 240 and len(one.counts) == 36 for one in found.constants)


def test_what_is_judged() -> None:
    names = (
        "name",
        "a.x_px",
        "a.x_px.sigma",
        "a.R[0][1]",
        "a.R[0][1].sigma",
        "a.views",
        "a.views.sigma",
        "seconds",
    )
    assert judged_names(names) == ["a.x_px"]

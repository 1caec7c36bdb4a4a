"""The decision: each answer for what it stands for, reasons by log, and what to record next."""

from __future__ import annotations

from typing import Any

import pytest

from calib.show.page import decide


def _job(stage: str, status: str = "ok", **more: Any) -> dict[str, Any]:
    writes = {"intrinsics": ["camera"], "extrinsics": ["plane"]}.get(stage, [])
    flashed = stage in ("intrinsics", "extrinsics", "imu-static")
    reason = "" if status == "ok" else "for some reason"
    return {
        "name": stage, "stage": stage, "title": stage.title(), "log": None, "writes": writes,
        "flashed": flashed, "status": status, "reason": reason, **more,
    }  # fmt: skip


def _whole(**statuses: str) -> dict[str, Any]:
    stages = ("intrinsics", "extrinsics", "imu-static", "replay", "firmware")
    return {"simulated": False, "jobs": [_job(s, statuses.get(s.replace("-", "_"), "ok")) for s in stages]}


SECTIONS = {"camera": {"verdict": "ok"}, "plane": {"verdict": "ok"}}


@pytest.mark.parametrize(
    ("statuses", "answer"),
    [
        ({}, "yes"),
        ({"imu_static": "skipped"}, "yes"),
        ({"replay": "poor"}, "with care"),
        ({"replay": "failed"}, "with care"),
        ({"imu_static": "poor"}, "not yet"),
        ({"firmware": "poor"}, "not yet"),
        ({"imu_static": "failed"}, "no"),
        ({"extrinsics": "blocked"}, "no"),
        ({"firmware": "failed"}, "no"),
        ({"firmware": "skipped"}, "no"),
    ],
)
def test_answers(statuses: dict[str, str], answer: str) -> None:
    assert decide(_whole(**statuses), SECTIONS).answer == answer


def test_without_a_plane_not_yet() -> None:
    assert decide(_whole(extrinsics="skipped"), {"camera": {"verdict": "ok"}}).answer == "not yet"


def test_weak_points_are_grouped_by_reason() -> None:
    told = _whole()
    told["jobs"] += [_job("replay", "poor", log=f"{k}.csv", reason="the IMU is silent") for k in range(6)]
    (sentence,) = decide(told, SECTIONS).weak
    assert sentence == "Replay (0.csv, 1.csv, 2.csv, 3.csv and 2 more): the IMU is silent"


def test_what_to_record_next() -> None:
    found = decide(
        _whole(imu_static="skipped"), {**SECTIONS, "camera": {"verdict": "ok", "advice": ["tilt it"]}}
    )
    assert any("at rest" in sentence for sentence in found.record)
    assert "Intrinsics: tilt it" in found.record

"""Whether a calibration can be flashed, what is weak about it, and what to record next."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.core.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_POOR, BadInputError
from calib.core.files import read_text
from calib.core.verdict import POOR, Word
from calib.core.words import all_of, several

# ----------------------------------------------------------------------
# run.json: what a run tells the page, read from a folder that may come from anywhere.

_MOST_BYTES = 10_000_000
Count = Annotated[int, Field(ge=0, strict=True)]
Text = Annotated[str, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]


class _Job(BaseModel):
    model_config = ConfigDict(extra="ignore")

    name: Text
    stage: Text
    title: Text
    verb: Text
    log: Text | None
    inputs: list[Text]
    command: list[Text]
    writes: list[Text]
    flashed: Flag
    status: Word | Literal["failed", "blocked", "skipped"]
    reason: Text


class _Summary(BaseModel):
    model_config = ConfigDict(extra="ignore")

    simulated: Flag
    pictures: Count
    logs: list[Text]
    left_out: list[Text]
    jobs: list[_Job]


def read_summary(path: Path) -> dict[str, Any] | None:
    """The summary that `outputs.publish` has written; None where there is none, or something else."""
    with contextlib.suppress(BadInputError, ValueError, RecursionError, ValidationError):
        return _Summary.model_validate(json.loads(read_text(path, _MOST_BYTES))).model_dump()
    return None


# ----------------------------------------------------------------------
# Whether a calibration can be flashed, what is weak about it, and what to record next.
#
# The answer is one of
#
#     yes         every stage whose result the firmware uses is ok, and nothing else speaks against it; the
#                 folder's pictures alone are the calibration of a camera
#     with care   those are, but something beside them is poor or has failed
#     not yet     a result that the firmware uses is poor or lacking
#     no          such a stage has failed, or its numbers mean nothing, or there is no firmware

_MEANINGLESS = ("unidentifiable", "inconsistent")
_FINE = ("ok", "skipped")
_RECORD = {
    "intrinsics": "15 to 25 pictures of a checkerboard into images/, with images/board.yaml",
    "extrinsics": "a picture of the board lying in the plane of motion into images/plane/",
    "imu-static": "the rig at rest for a minute or more, logs/static1.csv; hours show how the bias drifts",
    "imu-tune": "the rig in motion, with the IMU at its full rate, as logs/NAME.csv",
    "align": "camera and IMU in one log: a free swing, then slow motion to large angles",
    "replay": "logs of camera and IMU as logs/NAME.csv",
}
"""What a stage wants that had nothing to work with."""
_SHOWN = 4


@dataclass(frozen=True)
class Decision:
    """The answer with its reasons, not yet escaped; `failed` when any stage has failed.

    `lacking` names what the firmware cannot do without and is not known, and why; "" where all is there.
    """

    answer: str
    headline: str
    weak: tuple[str, ...]
    record: tuple[str, ...]
    failed: bool = False
    lacking: str = ""

    def as_json(self) -> dict[str, Any]:
        """For the document."""
        return {
            "answer": self.answer,
            "headline": self.headline,
            "weak": list(self.weak),
            "record_next": list(self.record),
        }

    @property
    def exit_code(self) -> int:
        """3 when a stage has failed, 0 when the answer is yes, else 1."""
        if self.failed:
            return EXIT_BAD_INPUT
        return EXIT_DONE if self.answer == "yes" else EXIT_POOR


def decide(told: Mapping[str, Any], sections: Mapping[str, Any]) -> Decision:
    """The decision on a run: `told` is its summary, `sections` those of its rig.yaml."""
    jobs: Sequence[Mapping[str, Any]] = told.get("jobs", ())
    camera_only = not told.get("logs")
    lacking = _lacking(jobs, sections, camera_only)
    answer, headline = _answer(jobs, sections, camera_only, lacking)
    if told.get("simulated"):
        headline = f"{headline}; the rig is a simulated one, so these numbers are for no real machine"
    failed = any(job["status"] in ("failed", "blocked") for job in jobs)
    weak, record = tuple(_weak(jobs, sections)), tuple(_record(jobs, sections))
    return Decision(answer, headline, weak, record, failed, lacking)


def _lacking(jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any], camera_only: bool) -> str:
    optics = {name for name in ("camera", "plane") if name not in sections}
    # Pictures alone are the calibration of a camera; whoever has logs wants states from them.
    if camera_only and optics == {"plane"}:
        return ""
    found = [job for job in jobs if job["flashed"] and optics & set(job["writes"])]
    if not found:
        return ""
    why = f": {found[0]['reason']}" if found[0]["status"] == "skipped" else ""
    return f"{_titles(found, 'not known')}{why}"


def _answer(
    jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any], camera_only: bool, lacking: str
) -> tuple[str, str]:
    used = [job for job in jobs if job["flashed"]]
    broken = [job for job in used if job["status"] in ("failed", "blocked")]
    if broken:
        # What failed mostly did so because of what came before it.
        before = [job for job in jobs[: jobs.index(broken[0])] if job["status"] in _MEANINGLESS]
        why = f"; the data do not support {_titles(before)}" if before else ""
        return "no", f"{_titles(broken)} failed{why}"
    senseless = [job for job in used if job["status"] in _MEANINGLESS]
    if senseless:
        return "no", f"the data do not support {_titles(senseless)}"
    made = [job for job in jobs if job["stage"] == "firmware"]
    if not made or made[0]["status"] not in ("ok", "poor"):
        why = made[0]["reason"] if made else "it was not asked for"
        return "no", f"there is no firmware: {why}"
    # What is poor for want of it, as controllers without an actuator, is no answer.
    if lacking:
        return "not yet", lacking
    poor = [job for job in used if job["status"] == "poor"]
    if poor:
        return "not yet", _titles(poor, "too weak")
    if camera_only and "camera" in sections and "plane" not in sections:
        return "yes", "the camera is calibrated; the header holds it alone, without a plane and logs"
    if made[0]["status"] == "poor":
        return "not yet", str(made[0]["reason"])
    others = [job for job in jobs if job["status"] not in _FINE]
    if others:
        return "with care", f"what the firmware uses is sound, but look at {_titles(others)}"
    passed = "every stage that had data passed its own quality gate"
    good = "camera and plane are calibrated" if camera_only else passed
    if "controller" not in sections:
        return "yes", f"{good}; without a controller the header compiles for a board only with CALIB_I_KNOW"
    return "yes", good


def _titles(jobs: Sequence[Mapping[str, Any]], what: str = "") -> str:
    """Headings of the jobs, as a sentence where it is said what they are."""
    names = list(dict.fromkeys(f"“{job['title']}”" for job in jobs))
    return f"{all_of(names)} {'is' if len(names) == 1 else 'are'} {what}" if what else all_of(names)


def _weak(jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any]) -> list[str]:
    """Each reason once, after the stages and the logs that it is about."""
    grouped: dict[str, tuple[list[str], list[str]]] = {}
    for job in jobs:
        if job["status"] in _FINE:
            continue
        reasons = [str(job["reason"])]
        for name in job["writes"]:
            section = sections.get(name)
            if job["status"] in POOR and isinstance(section, dict) and section.get("reasons"):
                reasons = [str(reason) for reason in section["reasons"]]
        for reason in reasons:
            titles, logs = grouped.setdefault(reason, ([], []))
            titles.append(str(job["title"]))
            logs += [str(job["log"])] if job["log"] else []
    return [
        f"{several(titles, _SHOWN)}{f' ({several(logs, _SHOWN)})' if logs else ''}: {reason}"
        for reason, (titles, logs) in grouped.items()
    ]


def _record(jobs: Sequence[Mapping[str, Any]], sections: Mapping[str, Any]) -> list[str]:
    lacking: list[str] = []
    first: list[str] = []
    then: list[str] = []
    for job in jobs:
        wanted = _RECORD.get(str(job["stage"]))
        # What the folder's own rig.yaml tells need not be recorded, nor what waits for another stage.
        there = job["inputs"] or (job["writes"] and all(name in sections for name in job["writes"]))
        if job["status"] == "skipped" and wanted and job["log"] is None and not there:
            lacking.append(f"{job['title']}: {wanted}")
        for name in job["writes"]:
            section = sections.get(name)
            if isinstance(section, dict):
                # What means nothing is recorded again before anything is added to it.
                which = first if job["status"] in _MEANINGLESS else then
                which += [f"{job['title']}: {advice}" for advice in section.get("advice") or ()]
    return list(dict.fromkeys([*first, *lacking, *then]))

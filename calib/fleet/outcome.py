"""What became of one rig: a small record that is kept in a file of its own."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Any

from calib.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERNAL, EXIT_POOR
from calib.files import one_line

__all__ = ["SAME", "Outcome", "from_json", "to_json", "verdict_of"]

SAME = "same"
"""Status of a rig whose earlier result still holds; nothing else of its outcome means anything."""

_MOST_TEXT = 2000


@dataclass(frozen=True)
class Outcome:
    """A rig's row.

    Attributes
    ----------
    name, serial, source : of the manifest.
    status : "ok", "poor", "failed" (bad input or a stage that failed), "broken" (a fault of the program),
        "lost" (its time ran out, or every process that tried it died), or `SAME`.
    code : exit code that a single run would have had.
    sentence : why, in one sentence; "" for "ok".
    key : of all that the result follows from, "" where that is not known.
    kind : "run" for all stages, "camera" for those of a camera.
    reasons : of stages that are not ok. stages : outcome of each stage by its name.
    values : constants with their standard deviations, by "section.name".
    seconds, peak_MB : spent on it, and the process's largest memory meanwhile.
    files : SHA-256 of its results by name.
    """

    name: str
    serial: str
    source: str
    status: str
    code: int
    sentence: str = ""
    key: str = ""
    kind: str = ""
    reasons: tuple[str, ...] = ()
    stages: dict[str, str] = field(default_factory=dict)
    values: dict[str, tuple[float, float | None]] = field(default_factory=dict)
    seconds: float = 0.0
    peak_MB: float | None = None
    files: dict[str, str] = field(default_factory=dict)


def verdict_of(code: int) -> str:
    """Status of a rig that came to an end by itself."""
    names = {EXIT_DONE: "ok", EXIT_POOR: "poor", EXIT_BAD_INPUT: "failed", EXIT_INTERNAL: "broken"}
    return names.get(code, "failed")


def to_json(outcome: Outcome) -> str:
    """Text of an outcome's file."""
    told = asdict(outcome)
    told["sentence"] = one_line(outcome.sentence)[:_MOST_TEXT]
    told["reasons"] = [one_line(reason)[:_MOST_TEXT] for reason in outcome.reasons]
    told["values"] = {
        name: [value, sigma if sigma is not None and math.isfinite(sigma) else None]
        for name, (value, sigma) in outcome.values.items()
        if math.isfinite(value)
    }
    return json.dumps({"schema": 1, **told}, indent=1, sort_keys=True, allow_nan=False) + "\n"


def from_json(text: str) -> Outcome | None:
    """The outcome in a file's text, None for what is not one."""
    try:
        told: dict[str, Any] = json.loads(text)
        if told.pop("schema") != 1:
            return None
        told["reasons"] = tuple(str(reason) for reason in told["reasons"])
        told["values"] = {
            str(name): (float(value), None if sigma is None else float(sigma))
            for name, (value, sigma) in told["values"].items()
        }
        told["files"] = {str(name): str(digest) for name, digest in told["files"].items()}
        return Outcome(**told)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None

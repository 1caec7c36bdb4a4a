"""run.json: what a run tells the page, read from a folder that may come from anywhere."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.errors import BadInputError
from calib.files import read_text

__all__ = ["read_summary"]

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
    status: Literal["ok", "poor", "failed", "blocked", "skipped", "missing"]
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

"""One thing that was found about a calibration, and how much it matters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["INCONSISTENT", "OK", "POOR", "REMARK", "UNIDENTIFIABLE", "VERDICTS", "Finding", "listed"]

OK = "ok"
POOR = "poor"
INCONSISTENT = "inconsistent"
UNIDENTIFIABLE = "unidentifiable"
REMARK = "remark"

VERDICTS = (OK, POOR, INCONSISTENT, UNIDENTIFIABLE)
"""From the best to the worst; the worst finding decides."""


@dataclass(frozen=True)
class Finding:
    """A sentence, its weight (one of `VERDICTS` but `OK`, or `REMARK`) and what to do about it."""

    kind: str
    text: str
    advice: str = ""


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names for a sentence, the rest counted."""
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join(names[:most]) + f" and {len(names) - most} more"

"""Values of rig.yaml by their keys, with the nominal actuator's where the file has none.

Sections that this version reads as models and those that it only carries along are asked in the same
way: `number("actuator.bellows_radius_m", 0.0126)`. What came from a default is remembered, so that the
header can say so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pydantic import BaseModel

from calib.errors import BadInputError

if TYPE_CHECKING:
    from calib.rig import Rig

__all__ = ["Known"]

_DEEPEST = 8


def _child(node: object, part: str) -> object:
    if isinstance(node, Mapping):
        return node.get(part)
    if isinstance(node, list | tuple):
        return node[int(part)] if part.isdigit() and int(part) < len(node) else None
    if isinstance(node, BaseModel):
        extra = node.model_extra or {}
        return getattr(node, part) if part in type(node).model_fields else extra.get(part)
    return None


class Known:
    """The rig's values; `defaults` collects the keys that it did not have.

    Parameters
    ----------
    rig : as read from the file.
    source : the file's name for messages.
    """

    def __init__(self, rig: Rig, source: str) -> None:
        self.rig, self.source = rig, source
        self._missing: list[str] = []

    def node(self, key: str) -> object:
        """What stands at a dotted key, None for nothing."""
        node: object = self.rig
        for part in key.split(".", _DEEPEST):
            node = _child(node, part)
            if node is None:
                return None
        return node

    def number(self, key: str, default: float, least: float = -math.inf, most: float = math.inf) -> float:
        """A finite number between `least` and `most`; null and a missing key give the default.

        Raises `BadInputError` for anything else.
        """
        value = self.node(key)
        if value is None:
            self._missing.append(key)
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BadInputError(f"{self.source}: {key} is {value!r}, expected a number")
        if not least <= value <= most:
            raise BadInputError(
                f"{self.source}: {key} is {value:g}, expected {least:g} to {most:g} for the firmware"
            )
        return float(value)

    def choice(self, key: str, default: int, of: tuple[int, ...]) -> int:
        """A whole number out of a few; true and false count as 1 and 0.

        Raises `BadInputError` for anything else.
        """
        value = self.node(key)
        if value is None:
            self._missing.append(key)
            return default
        if not isinstance(value, int) or int(value) not in of:
            words = " or ".join(map(str, of))
            raise BadInputError(f"{self.source}: {key} is {value!r}, expected {words}")
        return int(value)

    def numbers(self, key: str, default: tuple[float, ...], least: int, most: int) -> tuple[float, ...]:
        """A list of `least` to `most` finite numbers.

        Raises `BadInputError` for anything else.
        """
        value = self.node(key)
        if value is None:
            self._missing.append(key)
            return default
        listed = list(value) if isinstance(value, list | tuple) else []
        if not least <= len(listed) <= most or not all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in listed
        ):
            raise BadInputError(f"{self.source}: {key} is {value!r}, expected {least} to {most} numbers")
        return tuple(float(v) for v in listed)

    def told(self) -> str:
        """The keys that took defaults since the last call, in words; empty when there were none."""
        missing, self._missing = self._missing, []
        if not missing:
            return ""
        return f"Defaults of the nominal actuator, not in rig.yaml: {', '.join(dict.fromkeys(missing))}."

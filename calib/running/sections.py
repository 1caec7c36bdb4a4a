"""Sections of the rig's file, handed from stage to stage.

A stage gets a file of its own with the sections that its row names, and gives back those that it writes.
What a run knows in the end is put together from these parts in the order of the file, whatever the order
in which the stages came to an end.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calib.errors import BadInputError
from calib.files import read_yaml_mapping
from calib.rig import Rig, read_rig, rig_text, validation_sentence

__all__ = ["Sections", "sections_of"]


@dataclass
class Sections:
    """Sections by name as plain values, and the hashes of what each was learnt from."""

    values: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)

    def only(self, names: Iterable[str]) -> Sections:
        """Those of these names."""
        wanted = set(names)
        return Sections(
            {name: value for name, value in self.values.items() if name in wanted},
            {name: value for name, value in self.inputs.items() if name in wanted},
        )

    def without(self, names: Iterable[str]) -> Sections:
        """All but those of these names."""
        return self.only(set(self.values) - set(names))

    def joined(self, other: Sections) -> Sections:
        """Both; the other's where both have one."""
        return Sections({**self.values, **other.values}, {**self.inputs, **other.inputs})

    def canonical(self) -> str:
        """All of it as one line, the same for the same sections; quicker to make than the file's text."""
        return json.dumps([self.values, self.inputs], sort_keys=True, ensure_ascii=True, default=str)

    def text(self, source: Path) -> str:
        """Text of a rig's file with these sections; `source` is named should they not be valid."""
        inputs = {name: dict(sorted(self.inputs[name].items())) for name in sorted(self.inputs)}
        try:
            return rig_text(Rig.model_validate({**self.values, "provenance": {"inputs": inputs}}))
        except ValidationError as error:
            raise BadInputError(validation_sentence(source, error)) from error


def sections_of(path: Path) -> Sections:
    """Sections of a rig's file. Raises `BadInputError` as `read_rig` does."""
    read_rig(path)
    document = read_yaml_mapping(path)
    provenance = document.pop("provenance", None) or {}
    return Sections(document, dict(provenance.get("inputs") or {}))

"""YAML of strangers: what a small text may grow into has a bound, and so has the time to read it.

A text of a kilobyte can stand for gigabytes by aliases of aliases, numbers of half a million digits take
minutes, and the reader in C recurses without a limit. So the text is looked at first, as a stream of events.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from calib.core.errors import BadInputError

_MOST_VALUES, _MAX_DEPTH, _MAX_DIGITS = 200_000, 40, 400
_NUMBER = re.compile(r"[-+.0-9][0-9a-fA-FxXob_:.+-]*\Z")


class YamlProblem(BadInputError):
    """Why a text was not read: `said`, and the number of the `line`, None where there is none."""

    def __init__(self, said: str, line: int | None = None) -> None:
        super().__init__(said if line is None else f"line {line}: {said}")
        self.said, self.line = str(BadInputError(said)), line


def load(text: str, loader: Any = None) -> Any:
    """The value that a text stands for; `loader` is the safe one in C by default.

    Raises `YamlProblem`, also for a key that is given twice: YAML's readers would keep the last.
    """
    import yaml

    loader = loader or getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check(yaml.parse(text, Loader=loader))
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        said = getattr(error, "problem", None) or getattr(error, "reason", None) or "not readable"
        line = None if mark is None else mark.line + 1
        if mark is not None and text[mark.index : mark.index + 1] == "\t":
            said = "a tab indents the line, expected spaces"
        raise YamlProblem(f"is not YAML: {' '.join(str(said).split())}", line) from error
    except (RecursionError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise YamlProblem(f"is not YAML that can be read: {' '.join(str(error).split())[:200]}") from error


@dataclass
class _Open:
    """A mapping or a list that has not ended: values within, aliases counted where they stand, and keys."""

    anchor: str | None = None
    is_mapping: bool = False
    children: int = 0
    values: int = 0
    keys: set[str] = field(default_factory=set)


def _check(events: Any) -> None:
    """Raise `YamlProblem` for what must not be loaded."""
    within, values_of = [_Open()], dict[str | None, int]()
    for event in events:
        kind, line = type(event).__name__, event.start_mark.line + 1
        if kind in ("MappingEndEvent", "SequenceEndEvent"):
            ended = within.pop()
            values_of[ended.anchor] = ended.values
            within[-1].values += ended.values
        elif hasattr(event, "anchor"):
            over = within[-1]
            over.children += 1
            over.values += 1
            if kind == "ScalarEvent":
                if len(event.value) > _MAX_DIGITS and _NUMBER.match(event.value):
                    said = f"is not YAML that can be read: a number of {len(event.value)} characters"
                    raise YamlProblem(said, line)
                if over.is_mapping and over.children % 2 == 1:
                    if event.value in over.keys:
                        raise YamlProblem(f"the key {event.value[:60]} was given before", line)
                    over.keys.add(event.value)
            elif kind == "AliasEvent":
                itself = any(event.anchor == one.anchor for one in within)
                over.values += _MOST_VALUES if itself else values_of.get(event.anchor, 0)
            else:
                within.append(_Open(event.anchor, kind == "MappingStartEvent"))
            if len(within) > _MAX_DEPTH + 1:
                raise YamlProblem(f"is not YAML that can be read: nested more than {_MAX_DEPTH} deep", line)
        if within[-1].values > _MOST_VALUES:
            raise YamlProblem(f"expands to more than {_MOST_VALUES} values", line)

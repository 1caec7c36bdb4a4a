"""YAML of strangers: what a small text may grow into has a bound, and so has the time to read it.

A text of a kilobyte can stand for gigabytes: by aliases of aliases, by merged keys (which a reader
copies), by tags that hide lists from a count; and numbers of half a million digits take minutes. All of
this is refused while the text is still a stream of events.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from calib.core.errors import BadInputError

MAX_NODES = 200_000
_MAX_DEPTH = 40
_MAX_DIGITS = 400
_STANDARD = "tag:yaml.org,2002:"
_PLAIN_TAGS = ("str", "int", "float", "bool", "null", "map", "seq", "timestamp")
_NUMBER = re.compile(r"[-+.0-9][0-9a-fA-FxXob_:.+-]*\Z")


class YamlProblem(BadInputError):
    """Why a text was not read: `said`, and the number of the `line`, None where there is none."""

    def __init__(self, said: str, line: int | None = None) -> None:
        super().__init__(said if line is None else f"line {line}: {said}")
        self.said, self.line = str(BadInputError(said)), line


def load(text: str, tags: Iterable[str] = (), loader: Any = None) -> Any:
    """The value that a text stands for.

    Parameters
    ----------
    tags : further tags of YAML's own name space that `loader` knows, such as "binary".
    loader : the safe loader in C by default, which is ten times as fast as the one in Python.

    Raises `YamlProblem`, also for a key that is given twice: YAML's readers would keep the last.
    """
    import yaml

    loader = loader or getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    known = frozenset(_STANDARD + name for name in (*_PLAIN_TAGS, *tags))
    try:
        _check(yaml.parse(text, Loader=loader), known)
        document = yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        said = getattr(error, "problem", None) or getattr(error, "reason", None) or "not readable"
        line = None if mark is None else mark.line + 1
        raise YamlProblem(f"is not YAML: {' '.join(str(said).split())}", line) from error
    except (RecursionError, ValueError, LookupError, AttributeError) as error:
        raise YamlProblem(f"is not YAML that can be read: {' '.join(str(error).split())[:200]}") from error
    if expands_beyond(document, MAX_NODES):
        raise YamlProblem(f"expands to more than {MAX_NODES} values")
    return document


def _check(events: Any, known: frozenset[str]) -> None:
    """Raise `YamlProblem` for what must not be loaded.

    Depth has to be known before loading: the reader in C recurses without a limit.
    """
    open_keys: list[set[str] | None] = []
    expects_key: list[bool] = []
    for count, event in enumerate(events):
        kind = type(event).__name__
        line = event.start_mark.line + 1
        if count > MAX_NODES:
            raise YamlProblem(f"has more than {MAX_NODES} values before it", line)
        if kind in ("MappingEndEvent", "SequenceEndEvent"):
            open_keys.pop()
            expects_key.pop()
        if kind in ("ScalarEvent", "MappingStartEvent", "SequenceStartEvent"):
            _check_tag(event.tag, known, line)
        if kind == "ScalarEvent":
            _check_scalar(event.value, event.implicit[0], line)
        if kind in ("ScalarEvent", "AliasEvent", "MappingStartEvent", "SequenceStartEvent") and open_keys:
            keys = open_keys[-1]
            if keys is not None:
                if expects_key[-1] and kind == "ScalarEvent":
                    if event.value in keys:
                        raise YamlProblem(f"the key {event.value[:60]} was given before", line)
                    keys.add(event.value)
                expects_key[-1] = not expects_key[-1]
        if kind in ("MappingStartEvent", "SequenceStartEvent"):
            open_keys.append(set() if kind == "MappingStartEvent" else None)
            expects_key.append(kind == "MappingStartEvent")
            if len(open_keys) > _MAX_DEPTH:
                raise YamlProblem(f"is not YAML that can be read: nested more than {_MAX_DEPTH} deep", line)


def _check_tag(tag: str | None, known: frozenset[str], line: int) -> None:
    # Tags of other name spaces are unknown to the loader, which says so.
    if tag is not None and tag.startswith(_STANDARD) and ":python/" not in tag and tag not in known:
        raise YamlProblem(f"has the tag !!{tag.removeprefix(_STANDARD)[:40]}, which nothing here needs", line)


def _check_scalar(value: str, plain: bool, line: int) -> None:
    if plain and value == "<<":
        raise YamlProblem("merges keys with <<, which is not taken here; write them out", line)
    if len(value) > _MAX_DIGITS and _NUMBER.match(value):
        raise YamlProblem(f"is not YAML that can be read: a number of {len(value)} characters", line)


def expands_beyond(document: Any, most: int) -> bool:
    """Whether there are more than `most` values in a document, each alias counted where it stands."""
    waiting = [document] if isinstance(document, dict | list) else []
    while waiting:
        value = waiting.pop()
        children = value.values() if isinstance(value, dict) else value
        most -= len(children)
        if most < 0:
            return True
        waiting += [child for child in children if isinstance(child, dict | list)]
    return False

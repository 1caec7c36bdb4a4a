"""Options of a stage: the verb's on the command line, the function's keywords, a table of the manual."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from calib.core.errors import UsageError


def option(
    default: Any,
    words: str,
    *,
    flag: str = "",
    metavar: str = "",
    parse: Callable[[str], Any] | None = None,
    least: int | None = None,
) -> Any:
    """A field of a stage's options.

    Parameters
    ----------
    words : help for the command line and the manual. flag : its name there, where it is not the field's.
    parse : reads text with a unit into SI; a value that is no text is taken as it is.
    least : smallest value of a number.
    """
    meta = {"words": words, "flag": flag, "metavar": metavar, "parse": parse, "least": least}
    return field(default=default, metadata=meta)


AccUnit = Literal["m/s2", "g", "mg", "cm/s2", "counts"]
GyroUnit = Literal["rad/s", "deg/s", "mdeg/s", "counts"]


@dataclass(frozen=True)
class LogOptions:
    """What a person states of logs; a stage that takes some has these beside its own options.

    Attributes
    ----------
    acc_unit, gyro_unit : units of `calib.io.columns.UNITS`, None for what names, files or readings say.
    columns : a columns.yaml, None for the one beside the log.
    topics : what is where in a bag, see `calib.io.bags`.
    """

    acc_unit: AccUnit | None = option(None, "Unit of ax, ay, az in the logs, else as names or readings say.")
    gyro_unit: GyroUnit | None = option(
        None, "Unit of gx, gy, gz in the logs, else as names or readings say."
    )
    columns: Path | None = option(
        None, "What the columns of the logs are, else columns.yaml or NAME.columns.yaml beside them."
    )
    topics: Path | None = option(
        None, "Which topic of a bag is which column, else NAME.topics.yaml beside the bag."
    )

    @property
    def files(self) -> list[Path]:
        """Files that are read beside the logs."""
        return [path for path in (self.columns, self.topics) if path is not None]


@dataclass(frozen=True)
class PoseOptions(LogOptions):
    """Where the pose comes from."""

    states: tuple[Path, ...] | None = option(
        None, "States of calib replay to use instead of the pictures, for the logs in turn."
    )
    truth: bool = option(False, "Take the true columns of a simulated log, to test the method.")
    no_pwm: bool = option(False, "Logs without commands are swings with the hoses off.")


NOTHING_STATED = LogOptions()


@dataclass(frozen=True)
class NoOptions:
    """A stage without options."""


def options_of(kind: type[Any], values: Mapping[str, Any]) -> Any:
    """Options of this class from a verb's or a caller's values, texts parsed.

    Raises `UsageError` for a name that is none, with the nearest one, and for a number that no text could be.
    """
    known = {one.name: one for one in fields(kind)}
    hints = get_type_hints(kind)
    parsed: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            import difflib

            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]}?" if near else f", expected one of {', '.join(known)}"
            raise UsageError(f"{name} is not an option{hint}")
        choices = [part for one in (hints[name], *get_args(hints[name])) if get_origin(one) is Literal
                   for part in get_args(one)]  # fmt: skip
        if choices and value is not None and value not in choices:
            raise UsageError(f"{name} is {value!r}, expected one of {', '.join(map(str, choices))}")
        parse = known[name].metadata.get("parse") or (Path if Path in get_args(hints[name]) else None)
        unit = _UNITS.get(name.rpartition("_")[2])
        if parse and unit and isinstance(value, int | float):
            try:
                parse(f"{value!r}{unit}")
            except UsageError as error:
                _, _, why = str(error).partition("' ")
                raise UsageError(f"{name}={value!r} {why}") from error
        parsed[name] = parse(value) if parse is not None and isinstance(value, str) else value
    return kind(**parsed)


_UNITS = {"m": "m", "hz": "Hz", "kg": "kg"}
"""Units of numbers by the ending of their names."""


def name_of_flag(kind: type[Any], flag: str) -> str:
    """Name of the option that has this flag on the command line. Raises `UsageError` where there is none."""
    for one in fields(kind):
        if flag == (one.metadata["flag"] or one.name.replace("_", "-")):
            return one.name
    raise UsageError(f"--{flag} is not an option")

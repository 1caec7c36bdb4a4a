"""Options of a stage: the verb's on the command line, the function's keywords, a table of the manual."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from calib.core.arguments import taken
from calib.core.errors import UsageError
from calib.core.units import unit_of
from calib.core.words import nearest


def option(
    default: Any,
    words: str,
    *,
    flag: str = "",
    metavar: str = "",
    parse: Callable[[str, str], Any] | None = None,
    least: int | None = None,
) -> Any:
    """A field of a stage's options.

    Parameters
    ----------
    words : help for the command line and the manual. flag : its name there, where it is not the field's.
    parse : reads text with a unit into SI, and says in its errors what the text is given as.
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
    topics : what is where in a bag, see `calib.io.bag_topics`.
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
        None,
        "States of calib replay to use instead of the pictures, for the logs in turn.",
        metavar="STATES",
    )
    truth: bool = option(False, "Take the true columns of a simulated log, to test the method.")
    no_pwm: bool = option(False, "Logs without commands are swings with the hoses off.")


NOTHING_STATED = LogOptions()


@dataclass(frozen=True)
class NoOptions:
    """A stage without options."""


def options_of(kind: type[Any], values: Mapping[str, Any], function: str = "") -> Any:
    """Options of this class from a verb's or a caller's values, texts parsed.

    Parameters
    ----------
    function : whose keywords they are, for sentences; without one they are named as on the command line.

    Raises `UsageError` for a name that is none, with the nearest one, for a value of another type, and for a
    number that no text could be.
    """
    known = {one.name: one for one in fields(kind)}
    hints = get_type_hints(kind)
    parsed: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            hint = nearest(name, known) or f"; expected one of {', '.join(known)}"
            raise UsageError(f"{function}{': ' * bool(function)}{name} is not an option{hint}")
        parse, least = (known[name].metadata[key] for key in ("parse", "least"))
        flag = f"--{flag_of(known[name])}"
        what = f"{function}: {name}" if function else flag
        if parse and isinstance(value, str):
            parsed[name] = parse(value, what)
            continue
        unit = unit_of(name)
        or_words = f"{f' ({unit})' * bool(unit)} or text as for {flag}" if parse else ""
        found = parsed[name] = taken(value, hints[name], what, or_words)
        if least is not None and found < least:
            raise UsageError(f"{what} is {found}, expected at least {least}")
        if parse and found is not None:
            parse(_typed(found, unit), what)
    return kind(**parsed)


def _typed(value: float | tuple[Any, ...], unit: str) -> str:
    """A value as a person would type it, so that its parser can refuse it."""
    if not isinstance(value, tuple):
        return f"{value!r}{unit}"
    return ("" if isinstance(value[-1], str) else ",").join(map(str, value))


def flag_of(option: Field[Any]) -> str:
    """Name of an option on the command line."""
    return option.metadata["flag"] or option.name.replace("_", "-")


def name_of_flag(kind: type[Any], flag: str) -> str:
    """Name of the option that has this flag on the command line. Raises `UsageError` where there is none."""
    for one in fields(kind):
        if flag == flag_of(one):
            return one.name
    raise UsageError(f"--{flag} is not an option")

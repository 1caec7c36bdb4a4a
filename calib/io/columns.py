"""What the columns of a log are: their names, names that people give them, and units that somebody states.

A log is to have `t_s` and any of `COLUMNS`. Other names are looked up in one table (`accel_x`, `Gyroscope Z
(deg/s)`, `millis`). A unit stands in the name, or a person states it on the command line or in columns.yaml;
what nobody states is inferred from the readings (`calib.io.inferred_units`).

columns.yaml lies beside the logs; `NAME.columns.yaml` goes before it for one of them:

    names: [t_s, u_px, v_px]                        of a file without a header, in its order
    units: {time: ms, accel: g, gyro: deg/s}        of all columns of a kind
    t_s: {column: millis, unit: ms}                 of one column: its name in the file, its unit,
    gz_radps: {column: gyro_z, factor: -1}          and SI = (cell - offset) * factor * unit
    ax_mps2: {column: raw_x, unit: counts, factor: 0.0024, offset: 32768}
    rate_hz: 100                                    of rows without a time, one after the other
    separator: ";"
    decimal: ","
"""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import one_line, quoted, read_yaml_mapping, shown
from calib.core.options import LogOptions
from calib.core.units import GRAVITY_MPS2
from calib.core.words import nearest, several
from calib.core.writing import Kind, head

MEASURED = (
    "u_px",
    "v_px",
    "ax_mps2",
    "ay_mps2",
    "az_mps2",
    "gx_radps",
    "gy_radps",
    "gz_radps",
    "pwm1",
    "pwm2",
    "onchip_phi_rad",
)
"""What a rig logs; `u_px, v_px` is the marker in distorted pixels, `onchip_phi_rad` the IMU's own angle."""

TRUE = ("true_q1_m", "true_q2_m", "true_phi_rad", "true_x_m", "true_y_m")
"""What only the simulated rig knows, at the row's `t_s`; (x, y) is the head. For scoring."""

CHAMBERS = 3
PWM = MEASURED[8:10]
COMMANDED = tuple(f"p_cmd{k + 1}_kpa" for k in range(CHAMBERS))
PRESSURES = tuple(f"p{k + 1}_kpa" for k in range(CHAMBERS))
"""Commands to pressure valves, and pressures of the chambers above that of the air."""

POSITION = tuple(f"{of}_{axis}_m" for of in ("base", "tip") for axis in "xyz")
QUATERNION = tuple(f"{of}_q{part}" for of in ("base", "tip") for part in "wxyz")
POSE = (*POSITION, *QUATERNION, "tip_phi_rad")
"""Base and tip by motion capture; or the tip in the plane, as `tip_x_m, tip_y_m, tip_phi_rad`."""

COLUMNS = (*MEASURED, *COMMANDED, *PRESSURES, *POSE, *TRUE)

STATES = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", "nis_camera", "nis_accel", "nis_gyro",
    "gated_camera", "gated_accel", "gated_gyro", "flags", "rest_weight", "swing_weight",
    "driven_weight",
)  # fmt: skip
"""Columns of the states that `calib replay` writes."""

BASELINE = ("t_s", "q1_m", "q2_m", "phi_rad", "length_m", "x_m", "y_m")
"""Columns of what the published pipeline estimates."""

FOR_A_PERSON = ("sigma_px",)
"""What `calib track` writes beside the marker, which no verb reads."""

MARKER = MEASURED[:2]
ACCEL = MEASURED[2:5]
GYRO = MEASURED[5:8]
IMU = (*GYRO, *ACCEL)
IN_PLANE = ("gz_radps", "ax_mps2", "ay_mps2")
"""What the angle in the plane takes."""

_DEGREE = math.pi / 180.0

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "accel": {"m/s2": 1.0, "g": GRAVITY_MPS2, "mg": 1e-3 * GRAVITY_MPS2, "cm/s2": 0.01, "counts": 1.0},
    "gyro": {"rad/s": 1.0, "deg/s": _DEGREE, "mdeg/s": 1e-3 * _DEGREE, "counts": 1.0},
    "angle": {"rad": 1.0, "deg": _DEGREE},
    "pixel": {"px": 1.0},
    "pwm": {"pwm": 1.0, "percent": 2.55},
    "pressure": {"kPa": 1.0, "Pa": 1e-3, "bar": 100.0, "psi": 6.894757},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 0.01},
}
"""Units of each kind of column in that of the column's own name, which is the first. Counts stay counts."""

_SPELLED = {
    "s": "s sec secs second seconds", "ms": "ms msec msecs millis millisecond milliseconds",
    "us": "us µs μs usec micros microsecond microseconds", "ns": "ns nanos nanosecond nanoseconds",
    "m/s2": "m/s2 m/s^2 m/s² m/s/s ms2 mps2 m_s2 ms-2 ms^-2", "g": "g gs gee", "mg": "mg",
    "cm/s2": "cm/s2 cm/s^2 cm/s² cmps2 gal",
    "rad/s": "rad/s rads radps rad_s rad/sec", "deg/s": "deg/s °/s dps degps degs deg_s deg/sec grad/s",
    "mdeg/s": "mdps mdeg/s", "rad": "rad", "deg": "deg degree degrees °", "px": "px pixel pixels pix",
    "counts": "raw lsb count counts adc", "percent": "% percent",
    "kPa": "kpa", "Pa": "pa pascal", "bar": "bar", "psi": "psi", "m": "m", "mm": "mm", "cm": "cm",
}  # fmt: skip
_UNIT = {word: unit for unit, words in _SPELLED.items() for word in words.split()}

_ACCEL = (
    "(?:a|ac|acc|accl|accel|accelerometer|(?:total|linear)?acceleration|specificforce"
    "|beschleunigung|aceleracion|accelerazione)"
)
_GYRO = (
    "(?:g|gy|gyr|gyro|gyroscope|w|omega|angularvelocity|angularrate"
    "|gyroskop|drehrate|winkelgeschwindigkeit|vitesseangulaire|giroscopio|velocidadangular|velocitaangolare)"
)
_TIME = (
    "t|ts|time|timeboot|datetime|timestamp|timestamps|stamp|clock|elapsed|headerstamp"
    "|zeit|zeitstempel|uhrzeit|temps|horodatage|tiempo|hora|tempo|ora"
)
_TIME_BY_UNIT = {
    "millis": "ms", "micros": "us", "nanos": "ns", "ms": "ms",
    "seconds": "s", "secs": "s", "secondselapsed": "s",
}  # fmt: skip
_NAMES = (
    (f"{_ACCEL}(?:rss)?([xyz])", r"a\1_mps2"),
    ("([xyz])acc(?:l|el)?", r"a\1_mps2"),
    (f"{_GYRO}(?:rss)?([xyz])", r"g\1_radps"),
    ("([xyz])gyro", r"g\1_radps"),
    (_TIME, "t_s"),
    ("(?:pixel|px|marker|cam|camera|image|img|blob|pixy)?([uv])", r"\1_px"),
    ("(?:pixel|px|marker|blob|pixy)x", "u_px"),
    ("(?:pixel|px|marker|blob|pixy)y", "v_px"),
    ("(?:pwm|duty|valve|cmd|command|pump)([12])", r"pwm\1"),
    ("(?:onchip|chip|fused|fusion)(?:phi|angle)", "onchip_phi_rad"),
)
"""Patterns of bare names, and the columns that they mean."""
_NAMES_WITH_UNIT = (
    *_NAMES,
    ("x", "u_px"),
    ("y", "v_px"),
    (f"p([1-{CHAMBERS}])", r"p\1_kpa"),
    (f"pcmd([1-{CHAMBERS}])", r"p_cmd\1_kpa"),
    ("(base|tip)([xyz])", r"\1_\2_m"),
    ("tip(?:phi|angle)", "tip_phi_rad"),
)
"""Those of names that state a unit, too."""
_COUNTS = re.compile(r"(?:sample|packet|row|line|frame)?(?:counter|count|number|index|idx|no)")
"""A name of what counts samples."""
_DEVICES = ("imu", "bno055", "bno", "mpu6050", "mpu", "sensor", "field", "data", "msg")

_RESERVED = ("names", "units", "rate_hz", "separator", "decimal")
"""Keys of columns.yaml that are no columns."""


def kind_of(column: str) -> str:
    """The kind of a column of `COLUMNS` or of `t_s`, a key of `UNITS`; empty for quaternions and truth."""
    return _KIND.get(column, "")


_KIND = {
    "t_s": "time",
    **dict.fromkeys(ACCEL, "accel"),
    **dict.fromkeys(GYRO, "gyro"),
    **dict.fromkeys(("onchip_phi_rad", "tip_phi_rad"), "angle"),
    **dict.fromkeys(MARKER, "pixel"),
    **dict.fromkeys(PWM, "pwm"),
    **dict.fromkeys((*COMMANDED, *PRESSURES), "pressure"),
    **dict.fromkeys(POSITION, "length"),
}


def own_unit(column: str) -> str:
    """The unit of a column's own name; empty for one without."""
    return next(iter(UNITS.get(kind_of(column), {"": 1.0})))


def are_states(names: tuple[str, ...]) -> bool:
    """Whether these are the columns of a table of states."""
    return names[:6] == STATES[:6] or names == BASELINE


def is_arm_log(names: Sequence[str]) -> bool:
    """Whether columns are those of an arm that pressures drive, or a pump that no camera watches."""
    pump = {*QUATERNION} <= set(names) and not {*PWM}.isdisjoint(names) and "u_px" not in names
    return pump or bool({*COMMANDED, *PRESSURES} & set(names))


def known_name(name: str) -> tuple[str, str] | None:
    """The column that a name in a file means, and the unit that it states or ""; None for another."""
    # Headers of EuRoC and of rostopic begin as comments do.
    name = name.strip().lstrip("#% ")
    if name == "t_s" or name in COLUMNS:
        return name, own_unit(name)
    unit = ""
    if bracket := re.fullmatch(r"(.*?)[\[(]([^\])]*)[\])]", name):
        unit = _UNIT.get(re.sub(r"[\s·*]|\^-1", "", bracket[2].lower()), "")
        if not unit:
            return None
        name = bracket[1]
    plain = re.sub("[\u0300-\u036f]", "", unicodedata.normalize("NFD", name))
    words = re.findall(r"[a-zµμ°%]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain).lower())
    while len(words) > 1 and (words[0] in _DEVICES or "".join(words[:2]) in _DEVICES):
        words = words[1 if words[0] in _DEVICES else 2 :]
    if not unit:
        for last in (3, 2, 1):
            stated = _UNIT.get("".join(words[-last:])) or _UNIT.get("/".join(words[-last:]))
            if len(words) > last and stated:
                return _column("".join(words[:-last]), stated)
    return _column("".join(words), unit)


def _column(word: str, unit: str) -> tuple[str, str] | None:
    """The column that a bare name means, and its unit; None where the unit is none of its kind."""
    own = _TIME_BY_UNIT.get(word)
    if own and unit in ("", own):
        return "t_s", own
    matches = (
        (re.fullmatch(pattern, word), column) for pattern, column in (_NAMES_WITH_UNIT if unit else _NAMES)
    )
    column = next((match.expand(column) for match, column in matches if match), "")
    kind = kind_of(column)
    if not column or (unit and unit not in UNITS[kind]):
        return None
    return column, unit or (own_unit(column) if kind in ("pixel", "pwm") else "")


@dataclass(frozen=True)
class Source:
    """Where a column comes from: its name in the file, and SI = (cell - offset) * factor * unit.

    `unit` is "" until the readings were looked at; `stated` is who states it: "", "name", "file" or "option".
    """

    column: str
    unit: str = ""
    stated: str = ""
    factor: float = 1.0
    offset: float = 0.0

    def si(self, kind: str, cells: FloatArray) -> FloatArray:
        """Cells in SI."""
        scale = self.factor * UNITS[kind][self.unit] if kind else self.factor
        if self.offset:
            cells = cells - self.offset
        return cells if scale == 1.0 else np.asarray(cells * scale)


@dataclass(frozen=True)
class ColumnsFile:
    """A columns.yaml: sources by column, units by kind, names for want of a header, and the text's marks.

    `rate_hz` is that of rows without a time, 0 where it does not say.
    """

    path: Path
    sources: Mapping[str, Source]
    units: Mapping[str, str]
    names: tuple[str, ...] = ()
    rate_hz: float = 0.0
    separator: str = ""
    decimal: str = ""


def find_columns(log: Path) -> Path | None:
    """The columns.yaml of a log, None without."""
    places = (log.with_name(f"{log.stem}.columns.yaml"), log.with_name("columns.yaml"))
    return next((place for place in places if place.is_file()), None)


def columns_file(log: Path, options: LogOptions) -> ColumnsFile | None:
    """The columns.yaml that is stated for a log, or else lies beside it; None without."""
    place = options.columns or find_columns(log)
    return None if place is None else read_columns_file(place)


def read_columns_file(path: Path) -> ColumnsFile:
    """A columns.yaml. Raises `BadInputError` naming the key for what is wrong with it."""
    where, document = shown(path), read_yaml_mapping(path)
    allowed = ("t_s", *COLUMNS, *_RESERVED)
    for key in document:
        if key not in allowed:
            hint = nearest(key, allowed) or f"; expected t_s, {', '.join(MEASURED[:3])}, ..."
            raise BadInputError(f"{where}: {one_line(key)[:60]} is not known{hint}")
    names = document.get("names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadInputError(f"{where}: names is {quoted(names)}, expected a list of columns")
    units = document.get("units", {})
    if not isinstance(units, dict):
        raise BadInputError(f"{where}: units is {quoted(units)}, expected for instance {{accel: g}}")
    for kind, unit in units.items():
        if kind not in UNITS or not isinstance(unit, str) or unit not in UNITS[kind]:
            expected = ", ".join(UNITS.get(kind, UNITS))
            raise BadInputError(f"{where}: units.{_word(kind)} is {quoted(unit)}, expected one of {expected}")
    rate = document.get("rate_hz", 0.0)
    number = isinstance(rate, int | float) and not isinstance(rate, bool)
    if "rate_hz" in document and not (number and 0.0 < rate < math.inf):
        raise BadInputError(f"{where}: rate_hz is {quoted(rate)}, expected rows a second, such as 100")
    marks = {}
    for key, known in (("separator", (",", ";", "\t", " ")), ("decimal", (".", ","))):
        marks[key] = document.get(key, "")
        if marks[key] and marks[key] not in known:
            raise BadInputError(f"{where}: {key} is {quoted(marks[key])}, expected one of {known}")
    columns = [key for key in document if key not in _RESERVED]
    sources = {key: _source(f"{where}: {key}", key, document[key]) for key in columns}
    return ColumnsFile(path, sources, units, tuple(names), float(rate), marks["separator"], marks["decimal"])


def _source(where: str, column: str, entry: Any) -> Source:
    entry = {"column": entry} if isinstance(entry, str | int) else entry
    keys = ("column", "unit", "factor", "offset")
    if not isinstance(entry, dict) or any(key not in keys for key in entry):
        raise BadInputError(f"{where} is {quoted(entry)}, expected a column's name or {', '.join(keys)}")
    named = entry.get("column", column)
    if isinstance(named, bool) or not isinstance(named, str | int):
        raise BadInputError(f"{where}.column is {quoted(named)}, expected a name or a number from 1")
    kind = kind_of(column)
    unit = entry.get("unit", "")
    if unit and (not kind or unit not in UNITS[kind]):
        known = ", ".join(UNITS.get(kind, ()))
        raise BadInputError(f"{where}.unit is {quoted(unit)}, expected one of {known}")
    numbers = [entry.get("factor", 1.0), entry.get("offset", 0.0)]
    for key, value in zip(keys[2:], numbers, strict=True):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BadInputError(f"{where}.{key} is {quoted(value)}, expected a number")
    if unit == "counts" and "factor" in entry:
        # A factor makes SI of counts.
        unit = own_unit(column)
    return Source(str(named), unit, "file" if unit else "", float(numbers[0]), float(numbers[1]))


def _word(value: Any) -> str:
    return one_line(str(value))[:40]


@dataclass(frozen=True)
class ColumnMap:
    """Which column of a file is what.

    Attributes
    ----------
    source : the log's name for messages. folder : where its columns.yaml is or would be, for messages.
    names : of the file's columns. sources : by column, `t_s` among them.
    evidence : for each kind whose unit the readings tell, how.
    above : where the table begins, in words, if something else stands above it.
    rate_hz : of the rows where the number of each is its time, which then comes from no column; else 0.
    """

    source: str
    folder: str
    names: tuple[str, ...]
    sources: Mapping[str, Source]
    evidence: Mapping[str, str]
    above: str = ""
    rate_hz: float = 0.0

    @property
    def read(self) -> dict[str, str]:
        """Name in the file of each column that is read."""
        return {name: source.column for name, source in self.sources.items() if source.column}

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of the file's columns that are not read and might be meant to be."""
        read = {*self.read.values(), *FOR_A_PERSON}
        return tuple(name for name in self.names if name and name not in read)

    @property
    def narration(self) -> str:
        """A sentence on columns that are not read, or are not what their names say; empty for none."""
        words = {"time": "time", "accel": "accelerations", "gyro": "rates", "angle": "the chip's angle"}
        groups: dict[tuple[str, str], list[str]] = {}
        for column, source in self.sources.items():
            if not source.column:
                continue
            kind = kind_of(column)
            what = column if column in POSE else words.get(kind, column)
            if (
                source.column != column
                or source.unit != own_unit(column)
                or source.factor != 1.0
                or source.offset
            ):
                in_unit = f" in {source.unit}" if kind in words else ""
                groups.setdefault((kind, f"{what}{in_unit}"), []).append(source.column)
        parts = [self.above] if self.above else []
        if self.rate_hz:
            parts.append(f"times counted in rows at {self.rate_hz:g} Hz, so that none may be missing")
        for (kind, what), columns in groups.items():
            why = f" ({self.evidence[kind]})" if kind in self.evidence else ""
            parts.append(f"{what} from {', '.join(f'`{one_line(name)[:40]}`' for name in columns)}{why}")
        said = [f"read as: {'; '.join(parts)}"] if parts else []
        if self.unknown:
            said.append(f"not read: {several([one_line(name)[:40] for name in self.unknown], 12)}")
        return f"{self.source}: {'; '.join(said)}" if said else ""

    def text(self) -> str:
        """A columns.yaml that says the same."""
        lines = [f"rate_hz: {self.rate_hz!r}\n"] if self.rate_hz else []
        for column, source in self.sources.items():
            if not source.column:
                continue
            entry = [f"column: {yaml_word(source.column)}"]
            entry += [f"unit: {source.unit}"] if kind_of(column) else []
            entry += [f"factor: {source.factor!r}"] if source.factor != 1.0 else []
            entry += [f"offset: {source.offset!r}"] if source.offset else []
            lines.append(f"{column}: {{{', '.join(entry)}}}\n")
        return "".join(lines)


def _is_written(path: Path) -> bool:
    lines = head(path).splitlines()
    return all(re.fullmatch(rb"[a-z0-9_]+: \{column: .+\}|rate_hz: .+", line) for line in lines)


COLUMNS_FILE = Kind("a columns.yaml", (".yaml", ".yml"), _is_written)


def yaml_word(word: str) -> str:
    return word if re.fullmatch(r"[A-Za-z_]\w*", word) else json.dumps(word, ensure_ascii=False)


def column_map(
    source: str, log: Path, line: int, names: Sequence[str], file: ColumnsFile | None, options: LogOptions
) -> ColumnMap:
    """Which of the columns `names` of a file is what, by their names and by what a person states.

    Raises `BadInputError` for states, no time, a column that two names mean, and a name that comes twice.
    """
    where = f"{source}, line {line}"
    names = tuple(name.strip() for name in names)
    if are_states(names):
        raise BadInputError(f"{source}: holds states that calib replay has written, expected a log")
    add = shown(file.path if file else log.with_name("columns.yaml"))
    stated = file.sources if file else {}
    named = _by_column(log, names, stated)
    sources: dict[str, Source] = {}
    for column in ("t_s", *COLUMNS):
        if column in stated:
            one = _stated_source(names, column, stated[column])
        else:
            one = _named_source(where, add, column, named.get(column, []))
        if one is not None:
            sources[column] = one
    rate_hz = file.rate_hz if file else 0.0
    if rate_hz and "t_s" in sources:
        raise BadInputError(
            f"{where}: has the time `{one_line(sources['t_s'].column)[:40]}`, and {add} says rate_hz, which "
            "is for rows without; leave it out"
        )
    if rate_hz:
        sources = {"t_s": Source("", "s", "file"), **sources}
    if "t_s" not in sources:
        raise BadInputError(f"{where}: {_no_time(names, add)}")
    units = file.units if file else {}
    sources = {column: _with_stated_unit(column, one, units, options) for column, one in sources.items()}
    return ColumnMap(source, add, names, sources, {}, rate_hz=rate_hz)


def _by_column(
    log: Path, names: Sequence[str], stated: Mapping[str, Source]
) -> dict[str, list[tuple[str, str]]]:
    """Names in the file, each with the unit that it states, by the column that they mean.

    Where a column bears its own name, other names for it are passed over, and so are those that are stated to
    be another column.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        # Phones write a file for each sensor: x of Gyroscope.csv.
        known = known_name(f"{log.stem} {name}" if name in ("x", "y", "z") else name)
        if known is not None:
            found.setdefault(known[0], []).append((name, known[1]))
    if not all(name in found or name in stated for name in MARKER):
        # A u or v alone is no marker.
        found = {column: those for column, those in found.items() if column not in MARKER or column in names}
    taken = {one.column for one in stated.values()}
    return {
        column: [one for one in those if one[0] == column] or [one for one in those if one[0] not in taken]
        for column, those in found.items()
    }


def _stated_source(names: Sequence[str], column: str, stated: Source) -> Source | None:
    """The source of a column that columns.yaml states, where the file has it."""
    name = stated.column
    if name not in names:
        # By number, from 1.
        if not (name.isdigit() and 1 <= int(name) <= len(names)):
            return None
        name = names[int(name) - 1]
    known = known_name(name)
    if known and not stated.unit and known[1] in UNITS.get(kind_of(column), ()):
        stated = replace(stated, unit=known[1], stated="name")
    return replace(stated, column=name)


def _named_source(where: str, add: str, column: str, named: Sequence[tuple[str, str]]) -> Source | None:
    """The source of a column by its name in the file; None without. Raises `BadInputError` for several."""
    if column == "t_s":
        named = [one for one in named if one[1]] or named
    if not named:
        return None
    if len(named) == 1:
        name, unit = named[0]
        return Source(name, unit, "name" if unit else "")
    first, second = (one_line(name)[:40] for name, _ in named[:2])
    if named[0][0] == named[1][0]:
        raise BadInputError(f"{where}: has the column {first} twice")
    raise BadInputError(
        f"{where}: `{first}` and `{second}` may both be {column}; add to {add} which it is, such as the line "
        f"{column}: {yaml_word(named[0][0])}"
    )


def _no_time(names: Sequence[str], add: str) -> str:
    listed = one_line(", ".join(names[:6]) + (", ..." if len(names) > 6 else ""))[:200]
    count = next((n for n in names if _COUNTS.fullmatch(re.sub(r"[\W_]", "", n).lower())), "")
    word = yaml_word(count)
    counted = f"; if {word} counts samples, t_s: {{column: {word}, factor: PERIOD_S}}" if count else ""
    return (
        f"has no column t_s, found {listed!r}; if one of them is the time, add to {add} the line "
        f"t_s: {{column: NAME, unit: s}}{counted}; if every row is one sample and none is missing, "
        "rate_hz: RATE"
    )


def _with_stated_unit(column: str, source: Source, units: Mapping[str, str], options: LogOptions) -> Source:
    """The source with the unit of an option, or of columns.yaml for its kind; one with a factor is in SI."""
    kind = kind_of(column)
    option = {"accel": options.acc_unit, "gyro": options.gyro_unit}.get(kind)
    if option is not None:
        return replace(source, unit=option, stated="option")
    if source.stated != "file" and kind in units:
        return replace(source, unit=units[kind], stated="file")
    if not source.unit and source.factor != 1.0:
        return replace(source, unit=own_unit(column), stated="file")
    return source

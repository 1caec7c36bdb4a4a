"""What the columns of a log are: names that people give them, units, and the evidence for both.

A log is to have `t_s` and any of `COLUMNS`. Other names are looked up in one table (`accel_x`, `Gyroscope Z
(deg/s)`, `millis`). A unit stands in the name, or a person states it on the command line or in columns.yaml;
what nobody states is inferred from the readings, if they are evidence enough, and what contradicts them is
refused, whoever stated it:

    time           the samples come at 4 to 4000 Hz in one unit only
    accelerations  where the log is calm the specific force is g
    rates          the gyroscope turns with the accelerometer's angle, neither 57 times as far nor not at
                   all; at rest it is neither louder nor quieter than sensors are; a marker that it turns is
                   about as far from the axis as a picture is large

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
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray, IntArray, blocks, rms
from calib.core.errors import BadInputError
from calib.core.files import one_line, quoted, read_yaml_mapping, shown
from calib.core.geometry import rotation_exp
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

ACCEL = ("ax_mps2", "ay_mps2", "az_mps2")
GYRO = ("gx_radps", "gy_radps", "gz_radps")

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
    r"(?P<accel>a|ac|acc|accl|accel|accelerometer|(?:total|linear)?acceleration|specificforce"
    r"|beschleunigung|aceleracion|accelerazione)"
)
_GYRO = (
    r"(?P<gyro>g|gy|gyr|gyro|gyroscope|w|omega|angularvelocity|angularrate"
    r"|gyroskop|drehrate|winkelgeschwindigkeit|vitesseangulaire|giroscopio|velocidadangular|velocitaangolare)"
)
_AXIS = re.compile(rf"(?:{_ACCEL}|{_GYRO})(?:rss)?(?P<axis>[xyz])")
_AXIS_FIRST = re.compile(r"(?P<axis>[xyz])(?:(?P<accel>accl?|accel)|gyro)")
_TIME = re.compile(
    r"t|ts|time|timeboot|datetime|timestamp|timestamps|stamp|clock|elapsed|headerstamp"
    r"|zeit|zeitstempel|uhrzeit|temps|horodatage|tiempo|hora|tempo|ora"
)
_NAMED_BY_UNIT = {
    "millis": "ms", "micros": "us", "nanos": "ns", "ms": "ms",
    "seconds": "s", "secs": "s", "secondselapsed": "s",
}  # fmt: skip
_COUNTS = re.compile(r"(?:sample|packet|row|line|frame)?(?:counter|count|number|index|idx|no)")
"""A name of what counts samples."""
_PIXEL = re.compile(r"(?:pixel|px|marker|cam|camera|image|img|blob|pixy)?(?P<axis>[uv])")
_PIXEL_XY = re.compile(r"(?:pixel|px|marker|blob|pixy)(?P<axis>[xy])")
_PWM = re.compile(r"(?:pwm|duty|valve|cmd|command|pump)(?P<number>[12])")
_PRESSURE = re.compile(rf"p(?P<commanded>cmd)?(?P<number>[1-{CHAMBERS}])")
_POSE = re.compile(r"(?P<of>base|tip)(?P<axis>[xyz])|tip(?P<phi>phi|angle)")
_CHIP = re.compile(r"(?:onchip|chip|fused|fusion)(?:phi|angle)")
_DEVICES = ("imu", "bno055", "bno", "mpu6050", "mpu", "sensor", "field", "data", "msg")

_RESERVED = ("names", "units", "rate_hz", "separator", "decimal")
_RATES_HZ = (4.0, 4000.0)
_SLOWEST_S, _FASTEST_S = 0.9, 2e-5
"""Steps of a stated unit that are refused: no camera and no IMU samples once a second or at 50 kHz."""
_FEWEST = 20
_ABOUT_G = (0.7, 1.33)
_IN_PLANE_G = (0.85, 1.15)
"""Specific force of a calm log over g, of three axes and of two, which may lean out of the plane."""
_STRANGE_G = (0.4, 2.5)
"""Specific force over g outside of which a unit that is stated is not believed."""
_NO_GRAVITY = 0.3
_CALM, _CALM_WINDOW = 0.1, 50
_FASTEST_RADPS = 45.0
_LARGEST_BIAS_RADPS = 0.35
_LOUDEST_RADPS, _QUIETEST_RADPS = 0.02, 1.5e-4
"""Spread of a gyroscope at rest: no sensor is louder, and none of those on cheap boards is quieter."""
_ROUGH = 0.1
"""Share of a spread that its fourth differences show: 1 of white noise, 0.27 of noise that is low-passed at
2 Hz of 100, 0.04 at most of a swing with eight readings a period."""
_QUIET_RADPS = 0.005
"""Spread at rest of those on cheap boards; one that is in deg/s is quieter than that in none."""
_REST_RAD = 0.02
_FARTHER = 12.0
_LEAST_TURN_RAD, _LEAST_NOISE_RAD = 0.05, 1e-5
_AGREES = 0.3
_BLOCK_S, _BLOCK_3D_S = 1.0, 0.25
_MOMENT_S, _LATEST_S = 0.2, 0.2
_MOVES_WITH, _LEAST_MOVED_PX = 0.7, 1.0
_ARM = (0.07, 5.0)
"""Distance of the marker from the axis that it turns about, in pictures; no 57th of that, nor 57 times."""
_MOST_EVIDENCE = 100_000


def kind_of(column: str) -> str:
    """The kind of a column of `COLUMNS` or of `t_s`, a key of `UNITS`; empty for quaternions and truth."""
    return _KIND.get(column, "")


_KIND = {
    "t_s": "time",
    **dict.fromkeys(ACCEL, "accel"),
    **dict.fromkeys(GYRO, "gyro"),
    **dict.fromkeys(("onchip_phi_rad", "tip_phi_rad"), "angle"),
    **dict.fromkeys(MEASURED[:2], "pixel"),
    **dict.fromkeys(PWM, "pwm"),
    **dict.fromkeys((*COMMANDED, *PRESSURES), "pressure"),
    **dict.fromkeys(POSITION, "length"),
}


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
        return name, next(iter(UNITS.get(kind_of(name), {"": 1.0})))
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
    """The column of a bare name, where the unit is one of its kind."""
    column = ""
    if axis := _AXIS.fullmatch(word) or _AXIS_FIRST.fullmatch(word):
        column = f"a{axis['axis']}_mps2" if axis["accel"] else f"g{axis['axis']}_radps"
    elif _TIME.fullmatch(word):
        column = "t_s"
    elif word in _NAMED_BY_UNIT and unit in ("", _NAMED_BY_UNIT[word]):
        column, unit = "t_s", _NAMED_BY_UNIT[word]
    elif pixel := _PIXEL.fullmatch(word):
        column = f"{pixel['axis']}_px"
    elif (pixel := _PIXEL_XY.fullmatch(word)) or (unit == "px" and word in ("x", "y")):
        column = "u_px" if (pixel["axis"] if pixel else word) == "x" else "v_px"
    elif pwm := _PWM.fullmatch(word):
        column = f"pwm{pwm['number']}"
    elif unit and (pressure := _PRESSURE.fullmatch(word)):
        column = f"p{'_cmd' if pressure['commanded'] else ''}{pressure['number']}_kpa"
    elif unit and (pose := _POSE.fullmatch(word)):
        column = "tip_phi_rad" if pose["phi"] else f"{pose['of']}_{pose['axis']}_m"
    elif _CHIP.fullmatch(word):
        column = "onchip_phi_rad"
    if not column or (unit and unit not in UNITS[kind_of(column)]):
        return None
    if kind_of(column) in ("pixel", "pwm"):
        unit = unit or next(iter(UNITS[kind_of(column)]))
    return column, unit


@dataclass(frozen=True)
class Passed:
    """What of a log's cells and rows was not taken as it stands.

    Attributes
    ----------
    not_finite : cells that said nan or inf; in Parquet nan is a blank.
    beyond : cells that hold more than any sensor gives. first : the first of them, in words.
    clipped : readings at the end of their sensor's range. end : the first of them, in words.
    outside : pictures that put the marker outside of them or at (0, 0).
    truncated : whether the last line was cut short and left out.
    wraps : how often the counter that is the time began again.
    sorted : rows that stood below a later one, and were put where they belong.
    twice : rows that say what the one before says, at its time, and were left out.
    said : lines of words alone between the rows, as a board prints them.
    damaged : lines that are no row, few among many. damage : what is wrong with the first of them.
    times : what is odd about the times of a bag's messages, in words.
    """

    not_finite: int = 0
    beyond: int = 0
    first: str = ""
    truncated: bool = False
    wraps: int = 0
    outside: int = 0
    clipped: int = 0
    end: str = ""
    sorted: int = 0
    twice: int = 0
    said: int = 0
    damaged: int = 0
    damage: str = ""
    times: str = ""

    def __add__(self, later: Passed) -> Passed:
        both = ((getattr(self, one.name), getattr(later, one.name)) for one in fields(self))
        # Numbers add up; of words the first ones count.
        return Passed(*(a + b if type(a) is int else a or b for a, b in both))

    @property
    def sentences(self) -> list[str]:
        """One for each kind that there is."""
        blank = "and count as blank"
        kinds = (
            (self.not_finite, f"{self.not_finite} cells say nan or inf {blank}"),
            (self.beyond, f"{self.beyond} cells hold more than any sensor gives ({self.first}) {blank}"),
            (self.outside, f"{self.outside} pictures put the marker outside of them or at (0, 0) {blank}"),
            (
                self.clipped,
                f"{self.clipped} readings are at the end of a sensor's range ({self.end}) {blank}",
            ),
            (self.truncated, "the last line is cut short and left out"),
            (self.wraps, f"the time begins again {self.wraps} times, as counters and days do; counted on"),
            (self.sorted, f"{self.sorted} rows stand below a later one, each sensor's own in order; sorted"),
            (self.twice, f"{self.twice} rows are written twice; left out"),
            (self.said, f"{self.said} lines between the rows hold words and no number; passed over"),
            (self.damaged == 1, f"a line came damaged and is left out, {self.damage}"),
            (
                self.damaged > 1,
                f"{self.damaged} lines came damaged and are left out, the first {self.damage}",
            ),
        )
        return [sentence for there, sentence in (*kinds, (self.times, self.times)) if there]


ALL_TAKEN = Passed()


@dataclass(frozen=True)
class Block:
    """Cells of some rows as they are in the file, by column, `t_s` among them; NaN where one is blank.

    Attributes
    ----------
    lines : (n,) number of each row's line, or of the row in a table without lines.
    """

    cells: Mapping[str, FloatArray]
    lines: IntArray
    passed: Passed = ALL_TAKEN


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
        unit = next(iter(UNITS[kind]))
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
            own = next(iter(UNITS.get(kind, {"": 1.0})))
            what = column if column in POSE else words.get(kind, column)
            if source.column != column or source.unit != own or source.factor != 1.0 or source.offset:
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
            entry = [f"column: {_yaml(source.column)}"]
            entry += [f"unit: {source.unit}"] if kind_of(column) else []
            entry += [f"factor: {source.factor!r}"] if source.factor != 1.0 else []
            entry += [f"offset: {source.offset!r}"] if source.offset else []
            lines.append(f"{column}: {{{', '.join(entry)}}}\n")
        return "".join(lines)


def _is_written(path: Path) -> bool:
    lines = head(path).splitlines()
    return all(re.fullmatch(rb"[a-z0-9_]+: \{column: .+\}|rate_hz: .+", line) for line in lines)


COLUMNS_FILE = Kind("a columns.yaml", (".yaml", ".yml"), _is_written)


def _yaml(word: str) -> str:
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
    stated = dict(file.sources) if file else {}
    found: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        # Phones write a file for each sensor: x of Gyroscope.csv.
        known = known_name(f"{log.stem} {name}" if name in ("x", "y", "z") else name)
        if known is not None:
            found.setdefault(known[0], []).append((name, known[1]))
    pair = ("u_px", "v_px")
    if not all(name in found or name in stated for name in pair):
        found = {k: v for k, v in found.items() if k not in pair or k in names}
    sources: dict[str, Source] = {}
    for column in ("t_s", *COLUMNS):
        if column in stated:
            at, given = _named(names, stated[column].column), stated[column]
            known = known_name(at) if at is not None else None
            if at is not None and known and not given.unit and known[1] in UNITS.get(kind_of(column), ()):
                given = replace(given, unit=known[1], stated="name")
            if at is not None:
                sources[column] = replace(given, column=at)
            continue
        candidates = [(name, unit) for name, unit in found.get(column, []) if name == column] or [
            one for one in found.get(column, []) if one[0] not in {s.column for s in stated.values()}
        ]
        if column == "t_s":
            candidates = [one for one in candidates if one[1]] or candidates
        if len(candidates) > 1:
            if candidates[0][0] == candidates[1][0]:
                raise BadInputError(f"{where}: has the column {one_line(candidates[0][0])[:40]} twice")
            both = " and ".join(f"`{one_line(name)[:40]}`" for name, _ in candidates[:2])
            raise BadInputError(
                f"{where}: {both} may both be {column}; add to {add} which it is, such as the line "
                f"{column}: {_yaml(candidates[0][0])}"
            )
        if candidates:
            name, unit = candidates[0]
            sources[column] = Source(name, unit, "name" if unit else "")
    rate_hz = file.rate_hz if file else 0.0
    if rate_hz and "t_s" in sources:
        raise BadInputError(
            f"{where}: has the time `{one_line(sources['t_s'].column)[:40]}`, and {add} says rate_hz, which "
            "is for rows without; leave it out"
        )
    if rate_hz:
        sources = {"t_s": Source("", "s", "file"), **sources}
    if "t_s" not in sources:
        listed = one_line(", ".join(names[:6]) + (", ..." if len(names) > 6 else ""))[:200]
        count = next((n for n in names if _COUNTS.fullmatch(re.sub(r"[\W_]", "", n).lower())), "")
        counted = f"; if {_yaml(count)} counts samples, t_s: {{column: {_yaml(count)}, factor: PERIOD_S}}"
        raise BadInputError(
            f"{where}: has no column t_s, found {listed!r}; if one of them is the time, add to {add} "
            f"the line t_s: {{column: NAME, unit: s}}{counted if count else ''}; if every row is one sample "
            "and none is missing, rate_hz: RATE"
        )
    for column, given in sources.items():
        kind = kind_of(column)
        option = {"accel": options.acc_unit, "gyro": options.gyro_unit}.get(kind)
        if option is not None:
            sources[column] = replace(given, unit=option, stated="option")
        elif given.stated != "file" and file is not None and kind in file.units:
            sources[column] = replace(given, unit=file.units[kind], stated="file")
        elif not given.unit and given.factor != 1.0:
            sources[column] = replace(given, unit=next(iter(UNITS[kind])), stated="file")
    return ColumnMap(source, add, names, sources, {}, rate_hz=rate_hz)


def _named(names: tuple[str, ...], column: str) -> str | None:
    """The name in the file of a column that columns.yaml gives by name or by number from 1."""
    if column in names:
        return column
    return names[int(column) - 1] if column.isdigit() and 1 <= int(column) <= len(names) else None


def settled(columns: ColumnMap, cells: Mapping[str, FloatArray]) -> ColumnMap:
    """The map with all units, from what is stated and from the first readings of the log.

    Parameters
    ----------
    cells : (n,) by column, as they are in the file, NaN where a cell is blank.

    Raises
    ------
    BadInputError for a unit that the readings contradict, and for one that nobody states and that they do not
    tell either: with the line for columns.yaml.
    """
    # Rows out of order are for whoever reads the log to refuse, and no sign of another unit.
    order = np.argsort(cells["t_s"][:_MOST_EVIDENCE], kind="stable")
    cells = {name: values[order] for name, values in cells.items()}
    # Damaged files hold any number.
    with np.errstate(all="ignore"):
        for step in (_with_time, _with_accel, _with_gyro):
            columns = step(columns, cells)
    for column, source in columns.sources.items():
        if kind_of(column) and not source.unit:
            raise BadInputError(
                f"{columns.source}: {column} from `{one_line(source.column)[:40]}` has no unit; add to "
                f"{columns.folder} the line {_line(column, source, '|'.join(UNITS[kind_of(column)]))}"
            )
    return columns


def _line(column: str, source: Source, unit: str) -> str:
    return f"{column}: {{column: {_yaml(source.column)}, unit: {unit}}}"


def _of(columns: ColumnMap, names: Sequence[str]) -> list[str]:
    return [name for name in names if name in columns.sources]


def _with(columns: ColumnMap, names: Sequence[str], unit: str, why: str) -> ColumnMap:
    """The map with a unit for those of the columns that have none."""
    known = {n: replace(columns.sources[n], unit=unit) for n in names if not columns.sources[n].unit}
    evidence = {kind_of(names[0]): why} if known else {}
    return replace(columns, sources={**columns.sources, **known}, evidence={**columns.evidence, **evidence})


def _together(cells: Mapping[str, FloatArray], columns: ColumnMap, names: Sequence[str]) -> FloatArray:
    """Rows (m, names) in which all of these columns have a reading, scaled but in the file's unit."""
    values = np.stack(
        [(cells[name] - columns.sources[name].offset) * columns.sources[name].factor for name in names],
        axis=1,
    )
    return np.asarray(values[np.isfinite(values).all(axis=1)])


_ALIKE, _SECONDS_S = 4.0, 0.5
"""Rows that share a stamp, and what is between two stamps, from which on nothing tells when a reading was."""


def _with_time(columns: ColumnMap, cells: Mapping[str, FloatArray]) -> ColumnMap:
    source = columns.sources["t_s"]
    sensors = [cells[name] for name in _of(columns, (*ACCEL, *GYRO))] or [
        cells[name] for name in _of(columns, ("u_px",))
    ]
    rows = (
        np.isfinite(np.stack(sensors)).any(axis=0) if sensors else np.ones(len(cells["t_s"]), dtype=np.bool_)
    )
    steps = np.diff((cells["t_s"][rows]) * source.factor)
    steps = steps[steps > 0.0]
    units = UNITS["time"]
    each = rows.sum() / (len(steps) + 1)
    coarse_s = np.median(steps) * units.get(source.unit, 0.0) if len(steps) else 0.0
    if each >= _ALIKE and coarse_s >= _SECONDS_S:
        raise BadInputError(
            f"{columns.source}: {one_line(source.column)[:40]} comes in steps of {coarse_s:.3g} s, each of "
            f"which {each:.0f} rows share, expected the time of each reading; write it with six decimals, as "
            "each reading is taken"
        )
    step = float(np.median(steps)) if len(steps) >= _FEWEST else math.nan
    likely = [unit for unit, scale in units.items() if _RATES_HZ[0] <= 1.0 / (step * scale) < _RATES_HZ[1]]
    if source.unit:
        if source.stated == "file":
            return columns
        if step * units[source.unit] > _SLOWEST_S or step * units[source.unit] < _FASTEST_S:
            guess = likely[0] if likely else "ms"
            rate = 1.0 / (step * units[source.unit])
            raise BadInputError(
                f"{columns.source}: {one_line(source.column)[:40]} steps by {step:.6g}, in {source.unit} "
                f"that is {rate:.4g} samples/s, which no camera and no IMU of a rig has; if it is in "
                f"{guess}, add to {columns.folder} the line {_line('t_s', source, guess)}"
            )
        return columns
    if not len(steps) and rows.sum() >= _FEWEST:
        raise BadInputError(
            f"{columns.source}: the time `{one_line(source.column)[:40]}` is {cells['t_s'][rows][0]:.10g} in "
            "every row, expected it to advance; a program that saved it with few digits has to save all"
        )
    if len(likely) != 1:
        raise BadInputError(
            f"{columns.source}: cannot tell the unit of the time `{one_line(source.column)[:40]}` from "
            f"{len(steps)} steps; add to {columns.folder} the line {_line('t_s', source, 's|ms|us')}"
        )
    return _with(columns, ["t_s"], likely[0], f"{1.0 / (step * units[likely[0]]):.4g} samples/s")


def calm_windows(values: FloatArray) -> FloatArray:
    """The calmest tenth (w, size, axes) of windows of some 50 readings (n, axes), at least one."""
    windows = blocks(values, min(_CALM_WINDOW, len(values)))
    # Relative to each axis's own middle, so that units play no part.
    loud = windows.std(axis=1)
    loud = (loud / np.maximum(np.median(loud, axis=0), 1e-12)).max(axis=1)
    return windows[np.argsort(loud, kind="stable")[: max(math.ceil(_CALM * len(windows)), 1)]]


def _with_accel(columns: ColumnMap, cells: Mapping[str, FloatArray]) -> ColumnMap:
    names = _of(columns, ACCEL)
    if not names or all(columns.sources[name].unit == "counts" for name in names):
        return columns
    values = _together(cells, columns, names)
    stated = {columns.sources[name].unit for name in names} - {""}
    if names[:2] != ["ax_mps2", "ay_mps2"] or len(values) < _FEWEST or len(stated) > 1:
        return columns
    if not values.any():
        return columns
    norm = float(np.median(np.linalg.norm(calm_windows(values), axis=2)))
    bounds = _ABOUT_G if len(names) == 3 else _IN_PLANE_G
    units = UNITS["accel"]
    likely = [u for u in units if bounds[0] <= norm * units[u] / GRAVITY_MPS2 <= bounds[1] and u != "counts"]
    found = f"the specific force is {norm:.4g} where the log is calm"
    unit = next(iter(stated), "")
    if not unit and len(likely) > 1:
        # Two per cent lie between mg and cm/s^2, and more in how level a rig stands.
        raise BadInputError(
            f"{columns.source}: {found}, so it is in {' or in '.join(likely)}; "
            f"{_advice('acc', 'accel', '|'.join(likely), columns)}"
        )
    if unit in ("", *likely) and likely:
        return _with(columns, names, unit or likely[0], found)
    least = 0.0 if len(names) == 2 else _STRANGE_G[0]
    fits = bool(unit) and least <= norm * units[unit] / GRAVITY_MPS2 <= _STRANGE_G[1]
    if likely and not (fits and len(names) == 2 and columns.sources[names[0]].stated != "name"):
        advice = _advice("acc", "accel", "|".join(likely), columns)
        raise BadInputError(
            f"{columns.source}: {found}, so it is in {' or in '.join(likely)}, not in {unit}; {advice}"
        )
    if fits:
        # Two axes may be far from the vertical, and a short log be never calm.
        return columns
    if norm < _NO_GRAVITY:
        raise BadInputError(
            f"{columns.source}: {found}, so that gravity is missing, as in a linear acceleration; expected "
            "what an accelerometer feels, about 9.81 m/s^2 at rest"
        )
    what = "no unit that is known here"
    if norm > 150.0:
        what = "raw counts, which calib imu intrinsics --acc-unit counts finds the scale of"
    raise BadInputError(
        f"{columns.source}: {found} ({what}), expected about 9.81 m/s^2; for a scale add to {columns.folder} "
        f"a line for each axis, such as {names[0]}: {{column: {_yaml(columns.sources[names[0]].column)}, "
        f"factor: {GRAVITY_MPS2 / norm if norm > 0.0 else 1.0:.4g}}}"
    )


def _advice(option: str, kind: str, unit: str, columns: ColumnMap) -> str:
    return f"give --{option}-unit {unit} or add to {columns.folder} the line units: {{{kind}: {unit}}}"


@dataclass(frozen=True)
class Turning:
    """How a gyroscope turns beside the direction of the specific force.

    Attributes
    ----------
    flat : whether gravity stays in the plane of x and y.
    by_force_rad, by_gyro_rad : turn within a second, RMS in the median window, the latter in the rates' unit.
    spread_rad : of the force's direction over the log, where it stays in the plane of its angle there.
    misfit : for each factor on the rates, what it leaves of the force's turns, as a share of them.
    turned_rad : the force's turns from block to block, RMS.
    """

    flat: bool
    by_force_rad: float
    by_gyro_rad: float
    spread_rad: float
    misfit: Mapping[float, float]
    turned_rad: float


def turning(t_s: FloatArray, force: FloatArray, rates: FloatArray, factors: Sequence[float]) -> Turning:
    """Compare the turns of a gyroscope with those of the specific force.

    In the plane the force's direction is atan2(ay, ax) and turns by -gz. Blocks of a second are averaged, as
    a head that swings fast feels its own acceleration more than gravity. Out of the plane the direction u
    follows du/dt = -w x u.

    Parameters
    ----------
    t_s : (n,) times. force : (n, 2 or 3) in any unit. rates : (n,) -gz, or (n, 3) about x, y and z.
    factors : to try on the rates.
    """
    # A row that is written twice counts once.
    new = np.diff(t_s, prepend=-np.inf) > 0.0
    t_s, force, rates = t_s[new], force[new], rates[new]
    if len(t_s) < 2:
        return Turning(True, 0.0, 0.0, 0.0, dict.fromkeys(factors, 1.0), 0.0)
    phi = np.unwrap(np.arctan2(force[:, 1], force[:, 0]))
    z = -rates if rates.ndim == 1 else rates[:, 2]
    angle = np.concatenate([[0.0], np.cumsum(-z[1:] * np.diff(t_s))])
    period = max(float(np.median(np.diff(t_s))), 1e-6)
    size = min(max(round(1.0 / period), 4), len(phi))
    by_force, by_gyro = (float(np.median(blocks(x, size).std(axis=1))) for x in (phi, angle))
    unit = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    flat = rates.ndim == 1 or force.shape[1] == 2 or float(np.median(np.abs(unit[:, 2]))) < 0.35
    size = min(max(round((_BLOCK_S if flat else _BLOCK_3D_S) / period), 2), len(phi))
    edges = np.arange(0, len(phi) - size + 1, size)
    if flat:
        means = np.add.reduceat(np.exp(1j * phi), edges)[: len(edges)]
        turn = np.add.reduceat(angle, edges)[: len(edges)] / size
        turned = np.angle(means[1:] / means[:-1])
        misfit = {f: np.angle(np.exp(1j * (turned - f * np.diff(turn)))) for f in factors}
    else:
        means3 = np.add.reduceat(unit, edges, axis=0)[: len(edges)]
        means3 /= np.maximum(np.linalg.norm(means3, axis=1, keepdims=True), 1e-12)
        steps = np.concatenate([np.zeros((1, 3)), rates[1:] * np.diff(t_s)[:, None]])
        turn3 = np.diff(np.add.reduceat(np.cumsum(steps, axis=0), edges, axis=0)[: len(edges)] / size, axis=0)
        turned = np.linalg.norm(np.diff(means3, axis=0), axis=1)
        predicted = {f: (rotation_exp(-f * turn3) @ means3[:-1, :, None])[:, :, 0] for f in factors}
        misfit = {f: np.linalg.norm(means3[1:] - one, axis=1) for f, one in predicted.items()}
    whole = rms(turned) if len(turned) else 0.0
    share = {f: rms(off) / whole if whole > 0.0 else 1.0 for f, off in misfit.items()}
    spread = float(phi.std()) if flat else float(np.linalg.norm(unit.std(axis=0)))
    return Turning(flat, by_force, by_gyro, spread, share, whole)


def _with_gyro(columns: ColumnMap, cells: Mapping[str, FloatArray]) -> ColumnMap:
    names = _of(columns, GYRO)
    if not names or all(columns.sources[name].unit == "counts" for name in names):
        return columns
    stated = {columns.sources[name].unit for name in names} - {""}
    values = _together(cells, columns, names)
    if len(stated) > 1 or len(values) < _FEWEST:
        return columns
    unit, scales = next(iter(stated), ""), {u: UNITS["gyro"][u] for u in ("rad/s", "deg/s", "mdeg/s")}
    wrong = {u: _implausible(s, columns, cells, names, values) for u, s in scales.items()}
    likely = [u for u in ("rad/s", "deg/s") if not wrong[u]]
    if unit:
        if not wrong[unit]:
            return columns
        other = next((u for u in likely if u != unit), "deg/s" if unit == "rad/s" else "rad/s")
        raise BadInputError(
            f"{columns.source}: the gyroscope {wrong[unit]}, which none does in {unit}; if it is in {other}, "
            f"{_advice('gyro', 'gyro', other, columns)}"
        )
    if len(likely) == 2:
        wrong |= {u: _too_far(scales[u], columns, cells) for u in likely}
        likely = [u for u in likely if not wrong[u]] or likely
    # It makes small of nearly any readings, raw counts among them: the turns have to say so.
    if not likely and not wrong["mdeg/s"] and _agrees(scales["mdeg/s"], columns, cells, names):
        likely = ["mdeg/s"]
    if len(likely) == 1:
        others = "; ".join(f"in {u} it {wrong[u]}" for u in ("rad/s", "deg/s") if wrong[u])
        return _with(columns, names, likely[0], others)
    first = one_line(columns.sources[names[0]].column)[:40]
    if likely:
        raise BadInputError(
            f"{columns.source}: cannot tell whether `{first}` is in rad/s or in deg/s, as either is "
            f"possible; {_advice('gyro', 'gyro', 'rad/s|deg/s', columns)}"
        )
    # That of an MPU6050 at its finest range.
    scaled = f"{{column: {_yaml(columns.sources[names[0]].column)}, unit: deg/s, factor: 0.00763}}"
    raise BadInputError(
        f"{columns.source}: `{first}` is neither in rad/s nor in deg/s. Of raw counts add to {columns.folder}"
        f" a line for each axis with the data sheet's scale, such as {names[0]}: {scaled}; of mdeg/s "
        f"{_advice('gyro', 'gyro', 'mdeg/s', columns)}"
    )


def _too_far(scale: float, columns: ColumnMap, cells: Mapping[str, FloatArray]) -> str:
    """Why rates about z cannot be in a unit of this many rad/s by the marker's motion; empty where they can.

    What turns with the head moves in the picture by its distance from the axis, which is neither a small part
    of the picture nor a multiple of it.
    """
    if any(name not in columns.sources for name in ("gz_radps", "u_px", "v_px")):
        return ""
    t = cells["t_s"] * columns.sources["t_s"].factor * UNITS["time"][columns.sources["t_s"].unit]
    turns, seen = np.isfinite(cells["gz_radps"]), np.isfinite(cells["u_px"]) & np.isfinite(cells["v_px"])
    if min(turns.sum(), seen.sum()) < 2 * _CALM_WINDOW:
        return ""
    marker = np.stack([cells["u_px"][seen], cells["v_px"][seen]], axis=1)
    rates = _together(cells, columns, ["gz_radps"])[:, 0]
    angle = np.concatenate([[0.0], np.cumsum(scale * rates[1:] * np.diff(t[turns]))])
    # A constant gain and lag of the pictures play no part in what both do within a moment.
    times = np.arange(t[seen][0] + _LATEST_S, t[seen][-1] - _LATEST_S, _MOMENT_S / 4)
    moved = np.stack([np.interp(times, t[seen], axis) for axis in marker.T], axis=1)
    moved = moved[4:] - moved[:-4]
    moved -= moved.mean(axis=0)
    best, radius_px = 0.0, 0.0
    for late_s in np.arange(-_LATEST_S, _LATEST_S, 0.01):
        turned = np.interp(times - late_s, t[turns], angle)
        turned = turned[4:] - turned[:-4]
        turned -= turned.mean()
        both, power = turned @ moved, float(turned @ turned)
        share = float(both @ both) / max(power * float((moved**2).sum()), 1e-300)
        if share > best:
            best, radius_px = share, float(np.hypot(*both)) / power
    times_picture = radius_px / float(np.abs(marker).max())
    if best < _MOVES_WITH or float(moved.std()) < _LEAST_MOVED_PX or _ARM[0] < times_picture < _ARM[1]:
        return ""
    return f"turns a marker that would be {radius_px:.3g} px away from the axis"


def _turns(
    scale: float, columns: ColumnMap, cells: Mapping[str, FloatArray], names: Sequence[str]
) -> tuple[Turning, FloatArray] | None:
    """How rates in a unit of this many rad/s turn beside the specific force, and the readings (n, axes) of
    both; None where there is no force in the plane or too little of both.
    """
    accel = _of(columns, ACCEL)
    if "gz_radps" not in names or "ax_mps2" not in accel or "ay_mps2" not in accel:
        return None
    every = _together(cells, columns, ["t_s", *accel, *names])
    every = every[(scale * np.abs(every[:, 1 + len(accel) :]) <= _FASTEST_RADPS).all(axis=1)]
    if len(every) < 2 * _CALM_WINDOW:
        return None
    t = every[:, 0] * UNITS["time"][columns.sources["t_s"].unit]
    force, rates = every[:, 1 : 1 + len(accel)], every[:, 1 + len(accel) :]
    whole = len(accel) == 3 and len(names) == 3
    others = [f for u, f in UNITS["gyro"].items() if u != "counts" and not math.isclose(f, scale)]
    about = rates if whole else -rates[:, names.index("gz_radps")]
    return turning(t, force, about, [scale, -scale, *others]), every[:, 1:]


def _agrees(scale: float, columns: ColumnMap, cells: Mapping[str, FloatArray], names: Sequence[str]) -> bool:
    """Whether rates in a unit of this many rad/s turn as the specific force does."""
    found = _turns(scale, columns, cells, names)
    if found is None or not found[0].turned_rad > _LEAST_TURN_RAD:
        return False
    return min(found[0].misfit[scale], found[0].misfit[-scale]) < _AGREES


def _implausible(
    scale: float,
    columns: ColumnMap,
    cells: Mapping[str, FloatArray],
    names: Sequence[str],
    values: FloatArray,
) -> str:
    """Why rates (n, axes) cannot be in a unit of this many rad/s; empty where they can."""
    # A few wild readings are a fault, not a unit.
    few = min(max(8, values.size // 100), values.size - 1)
    sizes = scale * np.sort(np.abs(values).ravel())
    if sizes[-1 - few] > _FASTEST_RADPS:
        return f"reaches {sizes[-1]:.4g} rad/s"
    both = _turns(scale, columns, cells, names)
    if both is None:
        return ""
    found, readings = both
    mine = min(found.misfit[scale], found.misfit[-scale])
    others = [share for factor, share in found.misfit.items() if abs(factor) != scale]
    if found.turned_rad > _LEAST_TURN_RAD and mine > _AGREES and min(others, default=1.0) < _AGREES:
        return "does not turn with the accelerometer's angle"
    # An accelerometer that is stuck says nothing about the gyroscope.
    felt = found.by_force_rad > _LEAST_NOISE_RAD
    least_rad = max(_LEAST_TURN_RAD, _FARTHER * found.by_force_rad)
    calm = calm_windows(readings)[:, :, -len(names) :]
    spread = scale * np.median(calm.std(axis=1), axis=0)
    at_rest = found.spread_rad < _REST_RAD
    # At rest a gyroscope that is as quiet as one in this unit turns by its bias.
    biased = at_rest and float(spread.max()) < _QUIET_RADPS
    if felt and found.flat and not biased and scale * found.by_gyro_rad > least_rad:
        times = scale * found.by_gyro_rad / max(found.by_force_rad, 1e-6)
        # A pendulum's force hardly turns, in whatever unit: the sensor at its end feels the rod's alone.
        as_other = [times * UNITS["gyro"][unit] / scale for unit in ("rad/s", "deg/s")]
        if min(as_other) <= _FARTHER:
            return f"turns {times:.3g} times as far as the accelerometer's angle"
    if at_rest:
        bias = scale * float(np.abs(np.median(calm, axis=(0, 1))).max())
        # What goes to and fro by more is a swing of which the accelerometer feels nothing.
        if bias > max(_LARGEST_BIAS_RADPS, scale * float(values.std(axis=0).max())):
            return f"has a bias of {bias:.3g} rad/s at rest"
        # A slow swing, which an accelerometer hardly feels, is no noise: that lives in differences as well.
        rough = scale * np.median(np.diff(calm, 4, axis=1).std(axis=1), axis=0) / math.sqrt(70.0)
        if ((spread > _LOUDEST_RADPS) & (rough > _ROUGH * spread)).any():
            return f"is never quieter than {float(spread.max()):.3g} rad/s"
        if 0.0 < float(spread.max()) < _QUIETEST_RADPS and not any(
            columns.sources[name].unit for name in names
        ):
            return f"is as quiet as {float(spread.max()):.2g} rad/s"
    return ""

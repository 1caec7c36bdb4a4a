"""The units of a log's columns that nobody states, inferred from its first readings.

What is stated is held against the readings as well, and refused where they contradict it, whoever stated it:

    time           the samples come at 4 to 4000 Hz in one unit only
    accelerations  where the log is calm the specific force is g
    rates          the gyroscope turns with the accelerometer's angle, neither 57 times as far nor not at
                   all; at rest it is neither louder nor quieter than sensors are; a marker that it turns is
                   about as far from the axis as a picture is large
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import FloatArray, blocks, rms
from calib.core.errors import BadInputError
from calib.core.files import one_line
from calib.core.geometry import rotation_exp
from calib.core.units import GRAVITY_MPS2
from calib.io.columns import ACCEL, GYRO, MARKER, UNITS, ColumnMap, Source, kind_of, yaml_word

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
_ROUNDING_RADPS = 1e-12
_ROUGH = 0.1
"""Share of a spread that its fourth differences show: 1 of white noise, 0.27 of noise that is low-passed at
2 Hz of 100, 0.04 at most of a swing with eight readings a period."""
_QUIET_RADPS = 0.005
"""Spread at rest of those on cheap boards; one that is in deg/s is quieter than that in none."""
_REST_RAD = 0.02
_FARTHER = 12.0
_LEAST_TURN_RAD = 0.05
_AGREES = 0.3
_BLOCK_S, _BLOCK_3D_S = 1.0, 0.25
_MOMENT_S, _LATEST_S = 0.2, 0.2
_MOVES_WITH, _LEAST_MOVED_PX = 0.7, 1.0
_ARM = (0.07, 5.0)
"""Distance of the marker from the axis that it turns about, in pictures; no 57th of that, nor 57 times."""
_MOST_EVIDENCE = 100_000


_ALIKE, _SECONDS_S = 4.0, 0.5
"""Rows that share a stamp, and what is between two stamps, from which on nothing tells when a reading was."""


def infer_units(columns: ColumnMap, cells: Mapping[str, FloatArray]) -> ColumnMap:
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
    first = _FirstReadings(columns, {name: values[order] for name, values in cells.items()})
    # Damaged files hold any number.
    with np.errstate(all="ignore"):
        for step in (_infer_time_unit, _infer_accel_unit, _infer_gyro_unit):
            first = step(first)
    columns = first.map
    for column, source in columns.sources.items():
        if kind_of(column) and not source.unit:
            raise BadInputError(
                f"{columns.source}: {column} from `{one_line(source.column)[:40]}` has no unit; add to "
                f"{columns.folder} the line {_line(column, source, '|'.join(UNITS[kind_of(column)]))}"
            )
    return columns


def _line(column: str, source: Source, unit: str) -> str:
    """The line of columns.yaml that states a unit."""
    return f"{column}: {{column: {yaml_word(source.column)}, unit: {unit}}}"


@dataclass(frozen=True)
class _FirstReadings:
    """The columns of a log, and its first cells (n,) by column as they are in the file, in order of time."""

    map: ColumnMap
    cells: Mapping[str, FloatArray]

    def present(self, names: Sequence[str]) -> list[str]:
        """Those of the columns that the log has."""
        return [name for name in names if name in self.map.sources]

    def units(self, names: Sequence[str]) -> set[str]:
        """Units that somebody states for these columns."""
        return {self.map.sources[name].unit for name in names} - {""}

    def rows(self, names: Sequence[str]) -> FloatArray:
        """Rows (m, names) in which all of these columns have a reading, scaled but in the file's unit."""
        sources = self.map.sources
        values = np.stack(
            [(self.cells[name] - sources[name].offset) * sources[name].factor for name in names], axis=1
        )
        return np.asarray(values[np.isfinite(values).all(axis=1)])

    def with_unit(self, names: Sequence[str], unit: str, evidence: str) -> _FirstReadings:
        """The same with a unit for those of the columns that have none, and with what tells it."""
        sources = self.map.sources
        inferred = {n: replace(sources[n], unit=unit) for n in names if not sources[n].unit}
        told = {kind_of(names[0]): evidence} if inferred else {}
        known = replace(self.map, sources={**sources, **inferred}, evidence={**self.map.evidence, **told})
        return replace(self, map=known)

    def refused(self, text: str) -> BadInputError:
        """The error that names the log."""
        return BadInputError(f"{self.map.source}: {text}")

    def advice(self, option: str, kind: str, unit: str) -> str:
        """How a person states the unit of a kind of columns."""
        return f"give --{option}-unit {unit} or add to {self.map.folder} the line units: {{{kind}: {unit}}}"


def _infer_time_unit(first: _FirstReadings) -> _FirstReadings:
    source, units, cells = first.map.sources["t_s"], UNITS["time"], first.cells
    name = one_line(source.column)[:40]
    sensors = first.present((*ACCEL, *GYRO)) or first.present(("u_px",))
    rows = np.ones(len(cells["t_s"]), dtype=np.bool_)
    if sensors:
        rows = np.logical_or.reduce([np.isfinite(cells[one]) for one in sensors])
    steps = np.diff(cells["t_s"][rows] * source.factor)
    steps = steps[steps > 0.0]
    sharing = rows.sum() / (len(steps) + 1)
    coarse_s = np.median(steps) * units.get(source.unit, 0.0) if len(steps) else 0.0
    if sharing >= _ALIKE and coarse_s >= _SECONDS_S:
        raise first.refused(
            f"{name} comes in steps of {coarse_s:.3g} s, each of which {sharing:.0f} rows share, expected "
            "the time of each reading; write it with six decimals, as each reading is taken"
        )
    if source.stated == "file":
        return first
    step = float(np.median(steps)) if len(steps) >= _FEWEST else math.nan
    likely = [unit for unit, scale in units.items() if _RATES_HZ[0] <= 1.0 / (step * scale) < _RATES_HZ[1]]
    if source.unit:
        step_s = step * units[source.unit]
        if step_s > _SLOWEST_S or step_s < _FASTEST_S:
            guess = likely[0] if likely else "ms"
            raise first.refused(
                f"{name} steps by {step:.6g}, in {source.unit} that is {1.0 / step_s:.4g} samples/s, which "
                f"no camera and no IMU of a rig has; if it is in {guess}, add to {first.map.folder} the line "
                f"{_line('t_s', source, guess)}"
            )
        return first
    if not len(steps) and rows.sum() >= _FEWEST:
        raise first.refused(
            f"the time `{name}` is {cells['t_s'][rows][0]:.10g} in every row, expected it to advance; a "
            "program that saved it with few digits has to save all"
        )
    if len(likely) != 1:
        raise first.refused(
            f"cannot tell the unit of the time `{name}` from {len(steps)} steps; add to {first.map.folder} "
            f"the line {_line('t_s', source, 's|ms|us')}"
        )
    return first.with_unit(["t_s"], likely[0], f"{1.0 / (step * units[likely[0]]):.4g} samples/s")


def calm_windows(values: FloatArray) -> FloatArray:
    """The calmest tenth (w, size, axes) of windows of some 50 readings (n, axes), at least one."""
    windows = blocks(values, min(_CALM_WINDOW, len(values)))
    # Relative to each axis's own middle, so that units play no part.
    loud = windows.std(axis=1)
    loud = (loud / np.maximum(np.median(loud, axis=0), 1e-12)).max(axis=1)
    return windows[np.argsort(loud, kind="stable")[: max(math.ceil(_CALM * len(windows)), 1)]]


def _infer_accel_unit(first: _FirstReadings) -> _FirstReadings:
    names = first.present(ACCEL)
    stated = first.units(names)
    if names[:2] != ["ax_mps2", "ay_mps2"] or stated == {"counts"} or len(stated) > 1:
        return first
    values, unit = first.rows(names), next(iter(stated), "")
    if len(values) < _FEWEST or not values.any():
        return first
    force = float(np.median(np.linalg.norm(calm_windows(values), axis=2)))
    in_g = {u: force * scale / GRAVITY_MPS2 for u, scale in UNITS["accel"].items()}
    least, most = _ABOUT_G if len(names) == 3 else _IN_PLANE_G
    likely = [u for u, ratio in in_g.items() if least <= ratio <= most and u != "counts"]
    found = f"the specific force is {force:.4g} where the log is calm"
    if unit in likely or (not unit and len(likely) == 1):
        return first.with_unit(names, unit or likely[0], found)
    advice = first.advice("acc", "accel", "|".join(likely))
    if not unit and likely:
        # Two per cent lie between mg and cm/s^2, and more in how level a rig stands.
        raise first.refused(f"{found}, so it is in {' or in '.join(likely)}; {advice}")
    # Two axes may be far from the vertical, and a short log be never calm.
    flat = len(names) == 2
    fits = bool(unit) and (0.0 if flat else _STRANGE_G[0]) <= in_g[unit] <= _STRANGE_G[1]
    if likely and not (fits and flat and first.map.sources[names[0]].stated != "name"):
        raise first.refused(f"{found}, so it is in {' or in '.join(likely)}, not in {unit}; {advice}")
    if not fits:
        raise first.refused(f"{found}{_no_force(first, names[0], force)}")
    return first


def _no_force(first: _FirstReadings, name: str, force: float) -> str:
    """What is wrong with a specific force that is none in any unit, and what to do."""
    if force < _NO_GRAVITY:
        return (
            ", so that gravity is missing, as in a linear acceleration; expected what an accelerometer "
            "feels, about 9.81 m/s^2 at rest"
        )
    what = "no unit that is known here"
    if force > 150.0:
        what = "raw counts, which calib imu intrinsics --acc-unit counts finds the scale of"
    return (
        f" ({what}), expected about 9.81 m/s^2; for a scale add to {first.map.folder} a line for each axis, "
        f"such as {name}: {{column: {yaml_word(first.map.sources[name].column)}, "
        f"factor: {GRAVITY_MPS2 / force:.4g}}}"
    )


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


def _infer_gyro_unit(first: _FirstReadings) -> _FirstReadings:
    names = first.present(GYRO)
    stated = first.units(names)
    if not names or stated == {"counts"} or len(stated) > 1 or len(first.rows(names)) < _FEWEST:
        return first
    unit, scales = next(iter(stated), ""), {u: UNITS["gyro"][u] for u in ("rad/s", "deg/s", "mdeg/s")}
    wrong = {u: _implausible(first, names, scale) for u, scale in scales.items()}
    likely = [u for u in ("rad/s", "deg/s") if not wrong[u]]
    if unit:
        if not wrong[unit]:
            return first
        other = next(iter(likely), "rad/s" if unit == "deg/s" else "deg/s")
        raise first.refused(
            f"the gyroscope {wrong[unit]}, which none does in {unit}; if it is in {other}, "
            f"{first.advice('gyro', 'gyro', other)}"
        )
    if len(likely) == 2:
        wrong |= {u: _too_far(first, scales[u]) for u in likely}
        likely = [u for u in likely if not wrong[u]] or likely
    # It makes small of nearly any readings, raw counts among them: the turns have to say so.
    if not likely and not wrong["mdeg/s"] and _agrees(first, names, scales["mdeg/s"]):
        likely = ["mdeg/s"]
    if len(likely) == 1:
        others = "; ".join(f"in {u} it {wrong[u]}" for u in ("rad/s", "deg/s") if wrong[u])
        return first.with_unit(names, likely[0], others)
    column = first.map.sources[names[0]].column
    shown = one_line(column)[:40]
    if likely:
        raise first.refused(
            f"cannot tell whether `{shown}` is in rad/s or in deg/s, as either is possible; "
            f"{first.advice('gyro', 'gyro', 'rad/s|deg/s')}"
        )
    # The scale is that of an MPU6050 at its finest range.
    raise first.refused(
        f"`{shown}` is neither in rad/s nor in deg/s. Of raw counts add to {first.map.folder} a line for "
        f"each axis with the data sheet's scale, such as {names[0]}: {{column: {yaml_word(column)}, unit: "
        f"deg/s, factor: 0.00763}}; of mdeg/s {first.advice('gyro', 'gyro', 'mdeg/s')}"
    )


def _too_far(first: _FirstReadings, scale: float) -> str:
    """Why rates about z cannot be in a unit of this many rad/s by the marker's motion; empty where they can.

    What turns with the head moves in the picture by its distance from the axis, which is neither a small part
    of the picture nor a multiple of it.
    """
    cells, time = first.cells, first.map.sources["t_s"]
    if len(first.present(("gz_radps", *MARKER))) < 3:
        return ""
    t = cells["t_s"] * time.factor * UNITS["time"][time.unit]
    turns, seen = np.isfinite(cells["gz_radps"]), np.isfinite(cells["u_px"]) & np.isfinite(cells["v_px"])
    if min(turns.sum(), seen.sum()) < 2 * _CALM_WINDOW:
        return ""
    marker = np.stack([cells["u_px"][seen], cells["v_px"][seen]], axis=1)
    rates = first.rows(["gz_radps"])[:, 0]
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


def _compared_turns(
    first: _FirstReadings, names: Sequence[str], scale: float
) -> tuple[Turning, FloatArray] | None:
    """How rates in a unit of this many rad/s turn beside the specific force, and the readings (n, axes) of
    both; None where there is no force in the plane or too little of both.
    """
    accel = first.present(ACCEL)
    if "gz_radps" not in names or "ax_mps2" not in accel or "ay_mps2" not in accel:
        return None
    every = first.rows(["t_s", *accel, *names])
    every = every[(scale * np.abs(every[:, 1 + len(accel) :]) <= _FASTEST_RADPS).all(axis=1)]
    if len(every) < 2 * _CALM_WINDOW:
        return None
    t = every[:, 0] * UNITS["time"][first.map.sources["t_s"].unit]
    force, rates = every[:, 1 : 1 + len(accel)], every[:, 1 + len(accel) :]
    others = [f for u, f in UNITS["gyro"].items() if u != "counts" and not math.isclose(f, scale)]
    if len(accel) < 3 or len(names) < 3:
        rates = -rates[:, names.index("gz_radps")]
    return turning(t, force, rates, [scale, -scale, *others]), every[:, 1:]


def _agrees(first: _FirstReadings, names: Sequence[str], scale: float) -> bool:
    """Whether rates in a unit of this many rad/s turn as the specific force does."""
    compared = _compared_turns(first, names, scale)
    if compared is None or not compared[0].turned_rad > _LEAST_TURN_RAD:
        return False
    return min(compared[0].misfit[scale], compared[0].misfit[-scale]) < _AGREES


def _implausible(first: _FirstReadings, names: Sequence[str], scale: float) -> str:
    """Why rates cannot be in a unit of this many rad/s; empty where they can."""
    values = first.rows(names)
    # A few wild readings are a fault, not a unit.
    few = min(max(8, values.size // 100), values.size - 1)
    sizes = scale * np.sort(np.abs(values).ravel())
    if sizes[-1 - few] > _FASTEST_RADPS:
        return f"reaches {sizes[-1]:.4g} rad/s"
    compared = _compared_turns(first, names, scale)
    if compared is None:
        return ""
    turns, readings = compared
    calm = scale * calm_windows(readings)[:, :, -len(names) :]
    spread = np.median(calm.std(axis=1), axis=0)
    quietest = 0.0 if first.units(names) else _QUIETEST_RADPS
    swing = scale * float(values.std(axis=0).max())
    return _implausible_turns(turns, scale, spread) or (
        _implausible_at_rest(calm, spread, swing, quietest) if turns.spread_rad < _REST_RAD else ""
    )


def _implausible_turns(turns: Turning, scale: float, spread: FloatArray) -> str:
    """Why a gyroscope cannot turn so beside the specific force.

    Parameters
    ----------
    spread : (axes,) of its readings where the log is calm [rad/s].
    """
    mine = min(turns.misfit[scale], turns.misfit[-scale])
    others = [share for factor, share in turns.misfit.items() if abs(factor) != scale]
    if turns.turned_rad > _LEAST_TURN_RAD and mine > _AGREES and min(others, default=1.0) < _AGREES:
        return "does not turn with the accelerometer's angle"
    # At rest a gyroscope that is as quiet as one in this unit turns by its bias.
    biased = turns.spread_rad < _REST_RAD and float(spread.max()) < _QUIET_RADPS
    least_rad = max(_LEAST_TURN_RAD, _FARTHER * turns.by_force_rad)
    if not turns.flat or biased or not scale * turns.by_gyro_rad > least_rad:
        return ""
    times = scale * turns.by_gyro_rad / max(turns.by_force_rad, 1e-6)
    # A pendulum's force hardly turns, in whatever unit, as the sensor at its end feels the rod's alone; nor
    # does that of an accelerometer that is stuck.
    as_other = [times * UNITS["gyro"][unit] / scale for unit in ("rad/s", "deg/s")]
    return f"turns {times:.3g} times as far as the accelerometer's angle" if min(as_other) <= _FARTHER else ""


def _implausible_at_rest(calm: FloatArray, spread: FloatArray, swing: float, quietest: float) -> str:
    """Why a gyroscope at rest cannot read so.

    Parameters
    ----------
    calm : (windows, size, axes) its calm readings. spread : (axes,) theirs. swing : that of all readings.
    quietest : least spread of a gyroscope. All in rad/s.
    """
    bias = float(np.abs(np.median(calm, axis=(0, 1))).max())
    # What goes to and fro by more is a swing of which the accelerometer feels nothing.
    if bias > max(_LARGEST_BIAS_RADPS, swing):
        return f"has a bias of {bias:.3g} rad/s at rest"
    # A slow swing, which an accelerometer hardly feels, is no noise: that lives in differences as well.
    rough = np.median(np.diff(calm, 4, axis=1).std(axis=1), axis=0) / math.sqrt(70.0)
    if ((spread > _LOUDEST_RADPS) & (rough > _ROUGH * spread)).any():
        return f"is never quieter than {float(spread.max()):.3g} rad/s"
    # One that is stuck says nothing: what it leaves is rounding.
    if _ROUNDING_RADPS < float(spread.max()) < quietest:
        return f"is as quiet as {float(spread.max()):.2g} rad/s"
    return ""

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
from calib.io.columns import ACCEL, GYRO, UNITS, ColumnMap, Source, kind_of, yaml_word

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
    return f"{column}: {{column: {yaml_word(source.column)}, unit: {unit}}}"


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
        f"a line for each axis, such as {names[0]}: {{column: {yaml_word(columns.sources[names[0]].column)}, "
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
    scaled = f"{{column: {yaml_word(columns.sources[names[0]].column)}, unit: deg/s, factor: 0.00763}}"
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

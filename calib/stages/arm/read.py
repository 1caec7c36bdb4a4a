"""From logs of pressures and motion capture to trials on a regular grid, and what the recordings show.

The tip's rotation in the frame of the base turns about one axis a where the motion is planar: the direction
of the largest spread of the rotation vectors from a recording's mean pose to its others. The tip's body
may be mounted in any way, q = exp(phi a / 2) m; a turn at the start that no resting arm has is m, taken off.
The angle is the twist about the axis, 2 atan2(q . a, q_w), and grows with bending.
A quaternion that maps the world to the body instead of the body to the world turns against the chord from
base to tip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, runs
from calib.core.errors import BadInputError
from calib.core.verdict import Finding
from calib.io.columns import COMMANDED, POSITION, PRESSURES, PWM, QUATERNION
from calib.io.logs import Log, check_time
from calib.stages.arm.model import STEP_S, Trial

_PLANAR = ("tip_x_m", "tip_y_m", "tip_phi_rad")
_FEWEST_S = 5.0
_JUMP_RAD, _ALONE = math.radians(0.7), 3.0
"""A step between neighbours that is a jump, where it is so many times the usual one about it: an arm that
turns at 60 deg/s makes as large ones at 90 Hz, one after the other."""
_BACK_S, _BACK = 0.3, 0.5
"""Motion capture that jumps and jumps back within this time, to less than this share of it, was wrong."""
_MOUNTED_RAD = math.radians(60.0)
"""A turn at the start that is a body's mount: no arm rests so far bent."""
_TILTED_RAD = math.radians(5.0)
_LEAST_TURN_RAD = math.radians(0.5)
_PLANE = 5.0
"""Times its thickness that the path of a tip is wide, where it tells a plane."""
_NO_PLANE_RAD = math.radians(45.0)
_LONGEST_M, _MOST_KPA, _LEAST_KPA, _MOST_TURN_RAD = 3.0, 2000.0, 5.0, 2.0 * math.pi
"""No soft arm is so long, takes so much or rolls up twice; hardly one bends by so little a pressure."""
_AIR_KPA = (80.0, 110.0)
"""Pressure of the air, from 2000 m above the sea down to it, with what a vented chamber is off."""
_PSI = (0.08, 0.17)
"""Greatest pressure in psi over the greatest command: valves of a real arm reach .66 to .85 of it in kPa."""
_LEANS = (0.1, 1.0)
"""Turn of the chord over the tip's: a half of an arc, more with a stiff end, less with a stiff beginning."""
_JUMP_SHARE = 0.03
"""Of the chord, between neighbours."""
_STILL, _MOVES = 1e-9, 0.2
_FROZEN_S = {"pressure": 1.0, "pose": 1.0, "command": 10.0}
"""A signal that keeps its value to the digit for so long, while what it follows goes through this share of
its range, is frozen; a command may be held, while what it drives settles."""
_UNSEEN_S, _UNKNOWN_S = 0.3, 1.0
"""Gaps over which poses are not counted, and over which nobody knows the command or the pressure."""
_TURNED_OFF_RAD = math.radians(45.0)
_LEAST_SHARE = 0.1
"""Of the greatest change of a chamber, below which the change of another is noise."""
_GROWS_STEP_S, _GROWS_S = 0.1, (0.1, 1.0, 4.0)
"""Of the drive's lags, one of which the angle follows most."""
_Between = Callable[[FloatArray, FloatArray], FloatArray]
"""Distances (n,) between values (n, k)."""


@dataclass(frozen=True)
class Frame:
    """How motion capture is to be read.

    Attributes
    ----------
    axis : (3,) of the bending, in the frame of the base; None for poses in the plane.
    grows, zero_rad : sign with which the angles of poses in the plane grow with bending, and from what they
        are counted.
    mount : (3,) rotation vector of the tip's body that is taken off in the frame of the base; 0 of one that
        starts near the base's attitude.
    conjugated : whether quaternions map the world to the body.
    leans : turn of the chord over that of the tip.
    planar_deg : angle between the axis and the normal of the tip's path.
    direction : (3,) from base to tip of the straight arm, in the frame of the base.
    """

    axis: FloatArray | None
    grows: float = 1.0
    zero_rad: float = 0.0
    mount: Sequence[float] = (0.0, 0.0, 0.0)
    conjugated: bool = False
    leans: float = math.nan
    planar_deg: float = math.nan
    direction: FloatArray | None = None


@dataclass(frozen=True)
class Recording:
    """What of a log is used: rows (n,) of time, and the columns that it has.

    Attributes
    ----------
    command, pressure : (n,) kPa of the driven chamber, NaN where a cell is blank; None without. The command
        is a PWM value where `pwm`.
    turned, chord : (2, n, 4) quaternions of the tip, w last, and (2, n, 3) from base to tip [m], in the frame
        of the base: with the quaternions as they are, and conjugated. Both None for poses in the plane, or
        without motion capture.
    planar : (n, 2) angle [rad] and chord [m] in the plane, None without.
    findings : on the sensors.
    """

    name: str
    source: str
    t_s: FloatArray
    command: FloatArray | None
    pressure: FloatArray | None
    turned: FloatArray | None
    chord: FloatArray | None
    planar: FloatArray | None
    findings: tuple[Finding, ...]
    pwm: bool = False


def _poses(log: Log) -> tuple[FloatArray, FloatArray]:
    """Quaternions and chords (2, n, ...) as in `Recording`, NaN in rows without a pose or of zeros.

    Raises `BadInputError` for quaternions that are none.
    """
    from scipy.spatial.transform import Rotation

    read = {name: log.columns[name] for name in (*POSITION, *QUATERNION)}
    base, tip = (np.stack([read[f"{of}_q{k}"] for k in "wxyz"], axis=1) for of in ("base", "tip"))
    for of, q in (("base", base), ("tip", tip)):
        # So says motion capture that it has lost a body.
        q[~q.any(axis=1)] = np.nan
        norm = np.linalg.norm(q, axis=1)
        wrong = np.nonzero(np.abs(norm - 1.0) > 0.02)[0]
        if len(wrong):
            raise BadInputError(
                f"{log.source}, line {log.lines[wrong[0]]}: the quaternion {of}_qw, ... has norm "
                f"{norm[wrong[0]]:.4g}, expected 1, or blanks where the body was not seen"
            )
    seen = np.isfinite(base).all(axis=1) & np.isfinite(tip).all(axis=1)
    if not seen.any():
        raise BadInputError(f"{log.source}: no row has poses of base and tip, expected both")
    turned, chord = (np.full((2, len(tip), size), np.nan) for size in (4, 3))
    first, last = (Rotation.from_quat(q[seen][:, [1, 2, 3, 0]]) for q in (base, tip))
    apart = np.stack([read[f"tip_{k}_m"] - read[f"base_{k}_m"] for k in "xyz"], axis=1)
    for way, (a, b) in enumerate([(first, last), (first.inv(), last.inv())]):
        turned[way, seen] = (a.inv() * b).as_quat()
        chord[way, seen] = a.inv().apply(apart[seen])
    return turned, chord


def _rotations_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (n,) [rad] between quaternions (n, 4), whatever their signs."""
    away = np.minimum(np.linalg.norm(first - second, axis=-1), np.linalg.norm(first + second, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(0.5 * away, 1.0)))


def _distances_between(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(first - second, axis=-1))


def _frozen(log: Log, name: str, driven: int) -> Iterator[Finding]:
    others = [n for k, n in enumerate(PRESSURES) if k != driven and n in log.columns]
    if constant := [n for n in others if not _varies(log, n)]:
        yield Finding("remark", f"{name}: {', '.join(constant)} never change: frozen, not used")


def _varies(log: Log, name: str) -> bool:
    return _range(log.columns[name]) > 0.0


def _range(values: FloatArray) -> float:
    """Greatest less least value (n,) or column (n, k) that is there; 0 without any."""
    seen = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
    return float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0


def _driven(log: Log) -> int:
    """Number of the driven chamber from 0. Raises `BadInputError` where none or several are."""
    for names in (COMMANDED, PWM, PRESSURES):
        change = [_range(log.columns[n]) if n in log.columns else 0.0 for n in names]
        # A sensor of a chamber that nobody drives is noisy too.
        least = _LEAST_SHARE * max(change) if names is PRESSURES else 0.0
        moving = [k for k, one in enumerate(change) if one > least]
        if len(moving) == 1:
            return moving[0]
        if moving:
            raise BadInputError(
                f"{log.source}: {', '.join(names[k] for k in moving)} change, expected one driven chamber; "
                "an arm is not identified by several at once: record trials in which one is driven"
            )
    raise BadInputError(f"{log.source}: no command and no pressure changes, expected one driven chamber")


def recording_of(log: Log, name: str) -> Recording:
    """The columns of an arm's log.

    Raises `BadInputError` for time that goes back, a log of less than 5 s, quaternions that are none, and
    where not one chamber alone is driven.
    """
    check_time(log)
    t = log.t_s
    if len(t) < 2 or t[-1] - t[0] < _FEWEST_S:
        raise BadInputError(f"{log.source}: is shorter than {_FEWEST_S:g} s, expected a whole trial")
    driven = _driven(log)
    findings = [*_frozen(log, name, driven)]
    turned = chord = planar = None
    if all(one in log.columns for one in (*POSITION, *QUATERNION)):
        turned, chord = _poses(log)
        wrong, jumps = _jumps(log, name, turned[0], chord[0], _rotations_between)
        turned[:, wrong], chord[:, wrong] = np.nan, np.nan
        findings += jumps
    elif all(one in log.columns for one in _PLANAR):
        x, y, phi = (log.columns[one] for one in _PLANAR)
        apart = np.stack([x - log.columns.get("base_x_m", 0.0), y - log.columns.get("base_y_m", 0.0)], axis=1)
        planar = np.stack([phi, np.hypot(*apart.T)], axis=1)
        wrong, jumps = _jumps(log, name, np.stack([np.cos(phi), np.sin(phi)], axis=1), apart)
        planar[wrong] = np.nan
        findings += jumps
    command, pressure = (log.columns.get(names[driven]) for names in (COMMANDED, PRESSURES))
    pwm = command is None and driven < len(PWM) and PWM[driven] in log.columns
    if pwm:
        command = log.columns[PWM[driven]]
    made = Recording(name, log.source, t, command, pressure, turned, chord, planar, tuple(findings), pwm)
    return replace(made, findings=(*findings, *_in_units(made), *_stuck(made), *_unknown(made)))


def _stuck(recording: Recording) -> Iterator[Finding]:
    """Signals that keep their value while what they follow, or what follows them, moves."""
    t = recording.t_s
    poses = recording.planar
    if poses is None and recording.turned is not None:
        poses = recording.turned[0]
    signals = {"command": recording.command, "pressure": recording.pressure, "pose": poses}
    there = {name: values for name, values in signals.items() if values is not None and _range(values) > 0.0}
    for name, values in there.items():
        least_s = _FROZEN_S[name]
        others = [other for other in there if other != name and (other != "pose" or name == "command")]
        steps = np.abs(np.diff(values.reshape(len(values), -1), axis=0)).max(axis=1)
        for first, last in runs(steps <= _STILL):
            if t[last] - t[first] < least_s:
                continue
            # What moved before the signal stood still may still arrive.
            rows = slice(int(np.searchsorted(t, t[first] + 0.5 * least_s)), last + 1)
            moves = _unsettled if name == "command" else _range
            moved = [other for other in others if moves(there[other][rows]) > _MOVES * _range(there[other])]
            if moved:
                yield Finding(
                    "poor",
                    f"{recording.name}: its {name} stands still from {t[first] - t[0]:.1f} to "
                    f"{t[last] - t[0]:.1f} s while its {moved[0]} moves: frozen",
                    "leave that log out, or cut it before it freezes",
                )
                break


def _unsettled(values: FloatArray) -> float:
    """By how much values (n,) or columns (n, k) move that do not settle: go back, or move most later on."""
    columns = values.reshape(len(values), -1)
    seen = columns[np.isfinite(columns).all(axis=1)]
    if not len(seen):
        return 0.0
    falls, rises = np.maximum.accumulate(seen) - seen, seen - np.minimum.accumulate(seen)
    back = float(np.minimum(falls.max(axis=0), rises.max(axis=0)).max())
    early, late = (_range(half) for half in np.array_split(seen, 2))
    return max(back, late if late > early else 0.0)


def _unknown(recording: Recording) -> Iterator[Finding]:
    """Stretches in which nothing tells what drove the arm."""
    t = recording.t_s
    for name, values in (("command", recording.command), ("pressure", recording.pressure)):
        if values is None or not np.isfinite(values).any():
            continue
        there = np.isfinite(values)
        # What is logged where it changes, as a command, is known between.
        at = t[there] if there.mean() > 0.5 else t
        long = np.flatnonzero(np.diff(at) > _UNKNOWN_S)
        if len(long):
            first, last = at[long[0] : long[0] + 2] - t[0]
            yield Finding(
                "poor",
                f"{recording.name}: has no {name} from {first:.1f} to {last:.1f} s, which a free run needs",
                "split that log there",
            )


def _in_units(recording: Recording) -> list[Finding]:
    """What speaks of units other than metres and kPa. Raises `BadInputError` where no arm is so."""
    source, poses = recording.source, recording.chord
    chord = None if poses is None else np.linalg.norm(poses[0], axis=1)
    if recording.planar is not None:
        chord = recording.planar[:, 1]
        most = float(np.nanmax(np.abs(recording.planar[:, 0]), initial=0.0))
        if most > _MOST_TURN_RAD:
            raise BadInputError(
                f"{source}: tip_phi_rad reaches {most:.4g} rad, expected at most {_MOST_TURN_RAD:.2f}; "
                "columns.yaml takes degrees, the column with unit: deg"
            )
    if chord is not None and np.nanmedian(chord) > _LONGEST_M:
        raise BadInputError(
            f"{source}: base and tip are {float(np.nanmedian(chord)):.4g} m apart, expected at most "
            f"{_LONGEST_M:g}; columns.yaml takes millimetres, each column with factor: 0.001"
        )
    if recording.pwm:
        return []
    read = [
        one for one in (recording.command, recording.pressure) if one is not None and np.isfinite(one).any()
    ]
    most = max((float(np.nanmax(np.abs(one))) for one in read), default=math.nan)
    if most > _MOST_KPA:
        raise BadInputError(
            f"{source}: pressures reach {most:.4g} kPa, expected at most {_MOST_KPA:g}; columns.yaml takes "
            "Pa, each column with factor: 0.001, and hPa or mbar with factor: 0.1"
        )
    if recording.command is not None and recording.pressure is not None:
        (asked, greatest), (least, most) = (
            np.nanpercentile(one, (1.0, 99.0)) for one in (recording.command, recording.pressure)
        )
        # A chamber that is never vented does not rise above its command.
        if _AIR_KPA[0] < least < _AIR_KPA[1] and least - asked > _AIR_KPA[0] and most > greatest:
            text = (
                f"{recording.name}: its pressure is {least:.4g} kPa at the least, where the command goes "
                f"down to {asked:.3g} kPa, as one that counts from vacuum"
            )
            advice = "columns.yaml takes off the air's from such a column with offset: 101.3"
            return [Finding("poor", text, advice)]
        if _PSI[0] * greatest < most < _PSI[1] * greatest:
            text = (
                f"{recording.name}: its pressure is {most:.3g} kPa at most, where the command goes up to "
                f"{greatest:.3g} kPa, as psi would"
            )
            return [Finding("poor", text, "columns.yaml takes psi with factor: 6.895")]
    if 0.0 < most < _LEAST_KPA:
        text = f"{recording.name}: pressures reach {most:.3g} kPa at most, as bar would"
        return [Finding("poor", text, "look for their unit; columns.yaml takes bar with factor: 100")]
    return []


def _jumps(
    log: Log, name: str, turned: FloatArray, apart: FloatArray, turns: _Between = _distances_between
) -> tuple[BoolArray, list[Finding]]:
    """Rows (n,) between jumps of rotations (n, k) or places (n, k) [m] there and back, and findings."""
    length = float(np.nanmedian(np.linalg.norm(apart, axis=1))) if np.isfinite(apart).any() else math.inf
    wrong, findings = np.zeros(len(apart), dtype=bool), []
    for values, between, least, scale, unit in (
        (turned, turns, _JUMP_RAD, math.degrees(1.0), "deg"),
        (apart, _distances_between, _JUMP_SHARE * length, 1e3, "mm"),
    ):
        seen = np.flatnonzero(np.isfinite(values).all(axis=1))
        steps = between(values[seen[1:]], values[seen[:-1]])
        # What moves fast does so for several samples.
        far = (steps > least) & (steps > _ALONE * _medians(steps, 5)) & (np.diff(seen) == 1)
        if far.any():
            first = int(np.argmax(far))
            findings.append(
                Finding(
                    "remark",
                    f"{name}, line {log.lines[seen[first + 1]]}: motion capture jumps by "
                    f"{scale * steps[first]:.1f} {unit} from one sample to the next; {far.sum()} such jumps "
                    "in all",
                )
            )
        wrong[seen[_excursions(log.t_s[seen], values[seen], between, least)]] = True
    if wrong.any():
        findings.append(
            Finding(
                "remark",
                f"{name}: {wrong.sum()} poses are left out, as motion capture jumps there and back within "
                f"{_BACK_S:g} s",
            )
        )
    return wrong, findings


def _medians(steps: FloatArray, size: int) -> FloatArray:
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(steps, min(size, max(len(steps), 1)), mode="nearest"))


def _excursions(t: FloatArray, values: FloatArray, between: _Between, least: float) -> IntArray:
    """Rows between a jump away and one back to where values (n, k) were, within `_BACK_S`."""
    steps = between(values[1:], values[:-1])
    usual = _medians(steps, 1 + 2 * round(0.5 * len(t) / max(t[-1] - t[0], 1.0)) if len(t) else 1)
    jump = (steps > least) & (steps > _ALONE * usual)
    out, after = [np.zeros(0, dtype=np.int64)], 0
    for k in np.flatnonzero(jump).tolist():
        if k < after:
            continue
        rows = np.arange(k + 1, int(np.searchsorted(t, t[k] + _BACK_S, side="right")))
        back = (between(values[rows], values[k]) < _BACK * steps[k]) & jump[rows - 1]
        if back.any():
            after = int(rows[np.argmax(back)])
            out.append(np.arange(k + 1, after))
    return np.concatenate(out)


def frame_of(recordings: Sequence[Recording]) -> Frame:
    """The axis of bending, the quaternions' convention and the straight arm's direction.

    Of the two conventions that one is taken under which tip and chord turn the same way about the same axis.

    Raises `BadInputError` where the tip hardly turns.
    """
    planar = [one for one in recordings if one.planar is not None]
    angles = [one.planar[:, 0] for one in planar if one.planar is not None]
    sign, zero = 1.0, 0.0
    if angles:
        begin = _circular_mean(np.array([_first(one) for one in angles]))
        zero = begin if abs(begin) > _MOUNTED_RAD else 0.0
        sign = _grows(planar, [_continuous(one, zero) for one in angles])
    if all(one.turned is None for one in recordings):
        return Frame(None, sign, zero)
    frames = [_frame(recordings, conjugated) for conjugated in (False, True)]
    # A body that is mounted by half a turn looks the same either way.
    best = max(
        frames, key=lambda one: round(math.copysign(math.cos(math.radians(one.planar_deg)), one.leans), 2)
    )
    return replace(best, grows=sign, zero_rad=zero)


def _frame(recordings: Sequence[Recording], conjugated: bool) -> Frame:
    """The frame under one convention, with a negative `leans` where the tip turns against its chord."""
    from scipy.spatial.transform import Rotation

    posed = [
        (one, one.turned[int(conjugated)], one.chord[int(conjugated)])
        for one in recordings
        if one.turned is not None and one.chord is not None
    ]
    parts, starts, vectors = [], [], []
    for _, turned, chord in posed:
        seen = np.isfinite(turned).all(axis=1) & np.isfinite(chord).all(axis=1)
        parts.append((turned[seen], chord[seen]))
        rotations = Rotation.from_quat(turned[seen])
        starts.append(rotations[: max(len(rotations) // 100, 1)].mean())
        away = (rotations * rotations.mean().inv()).as_rotvec()
        vectors.append(away - away.mean(axis=0))
    values, axes = np.linalg.eigh(np.cov(np.concatenate(vectors).T))
    axis = axes[:, -1]
    if math.sqrt(values[-1]) < _LEAST_TURN_RAD:
        raise BadInputError(
            f"{recordings[0].source}: the tip turns by {math.degrees(math.sqrt(values[-1])):.2g} deg (RMS), "
            f"expected the arm to bend by {math.degrees(_LEAST_TURN_RAD):g} deg at least"
        )
    begin = Rotation.concatenate(starts).mean().as_rotvec()
    mount = begin if np.linalg.norm(begin) > _MOUNTED_RAD else np.zeros(3)
    chord = np.concatenate([one for _, one in parts])
    # About each recording's own middle, as the base's marker may be moved between days.
    wide, paths = np.linalg.eigh(np.cov(np.concatenate([one - one.mean(axis=0) for _, one in parts]).T))
    normal = paths[:, 0]
    if wide[1] < _PLANE**2 * wide[0]:
        # A path that is as good as straight lies in many planes.
        normal = axis - paths[:, 2] * (paths[:, 2] @ axis)
        normal /= np.linalg.norm(normal)
    planar = math.degrees(math.acos(min(abs(float(axis @ normal)), 1.0)))
    # Turn of the chord about the path's normal, against the tip's.
    first = np.median(chord[: max(len(chord) // 100, 1)], axis=0)
    first = first - normal * (first @ normal)
    normal = normal if normal @ axis > 0.0 else -normal
    side = np.cross(normal, first)
    heading = np.arctan2(chord @ side, chord @ first)
    angles = [_twist(one, axis, mount) for one, _ in parts]
    leans, offset = np.polyfit(np.concatenate(angles), heading, 1)
    straight = first * math.cos(offset) + side * math.sin(offset)
    return Frame(
        # The angle grows with bending, whatever way that is.
        _grows([one for one, *_ in posed], [_twist(turned, axis, mount) for _, turned, _ in posed]) * axis,
        mount=mount.tolist(),
        conjugated=conjugated,
        leans=float(leans),
        planar_deg=planar,
        direction=straight / np.linalg.norm(straight),
    )


def _twist(turned: FloatArray, axis: FloatArray, mount: FloatArray | Sequence[float]) -> FloatArray:
    """Angle (n,) [rad] about an axis (3,) of rotations (n, 4) from a mount (3,), NaN where they are."""
    from scipy.spatial.transform import Rotation

    seen = np.isfinite(turned).all(axis=1)
    q = (Rotation.from_quat(turned[seen]) * Rotation.from_rotvec(mount).inv()).as_quat()
    out = np.full(len(turned), np.nan)
    out[seen] = 2.0 * np.arctan2(q[:, :3] @ axis, q[:, 3])
    return _continuous(out)


def _circular_mean(angles_rad: FloatArray) -> float:
    return float(np.angle(np.nanmean(np.exp(1j * angles_rad))))


def _continuous(angles_rad: FloatArray, zero_rad: float = 0.0) -> FloatArray:
    """Angles (n,) from a zero, within half a turn of their mean, the first ones within half a turn of 0."""
    if not np.isfinite(angles_rad).any():
        return angles_rad
    mean = _circular_mean(angles_rad)
    out = mean - zero_rad + np.remainder(angles_rad - mean + math.pi, math.tau) - math.pi
    return np.asarray(out - math.tau * round(_first(out) / math.tau))


def _first(angles_rad: FloatArray) -> float:
    """Median of the first hundredth of the angles (n,) that are there."""
    seen = angles_rad[np.isfinite(angles_rad)]
    return float(np.median(seen[: max(len(seen) // 100, 1)])) if len(seen) else 0.0


def _grows(recordings: Sequence[Recording], angles_rad: Sequence[FloatArray]) -> float:
    """The sign with which the angles (n,) of each recording grow with what drives the arm, or a lag of it."""
    from scipy.signal import lfilter

    pairs = []
    for one, angles in zip(recordings, angles_rad, strict=True):
        grid = np.arange(one.t_s[0], one.t_s[-1], _GROWS_STEP_S)
        drive = one.command if one.pressure is None else one.pressure
        if drive is not None and np.isfinite(drive).any() and np.isfinite(angles).any():
            pairs.append(tuple(_between(grid, one.t_s, x - np.nanmean(x)) for x in (drive, angles)))
    alike = [
        sum(float(lfilter([1.0 - a], [1.0, -a], drive) @ angles) for drive, angles in pairs)
        for a in (math.exp(-_GROWS_STEP_S / lag_s) for lag_s in _GROWS_S)
    ]
    return -1.0 if max(alike, key=abs) < 0.0 else 1.0


def check_frame(recordings: Sequence[Recording], frame: Frame) -> None:
    """Raise `BadInputError` for poses that turn about another axis than that of an identified arm."""
    for one in recordings:
        if frame.axis is None or one.turned is None:
            continue
        angles = _twist(one.turned[int(frame.conjugated)], frame.axis, frame.mount)
        if _range(angles) < 4.0 * _LEAST_TURN_RAD:
            continue
        axis = _frame([one], frame.conjugated).axis
        off = 0.0 if axis is None else math.acos(min(max(float(axis @ frame.axis), -1.0), 1.0))
        if off > _TURNED_OFF_RAD:
            raise BadInputError(
                f"{one.source}: its tip turns about an axis {math.degrees(off):.0f} deg from that of the arm "
                "in the rig's file, expected the same arm and motion capture: look at the quaternions' order "
                "and convention"
            )


def frame_findings(frame: Frame) -> Iterator[Finding]:
    """What the poses show of the arm and of the motion capture, in sentences."""
    if frame.grows < 0.0:
        yield Finding(
            "remark", "tip_phi_rad falls as the arm bends; the angle is counted as it grows with bending"
        )
    mounted = max(abs(frame.zero_rad), float(np.linalg.norm(frame.mount)))
    if mounted > 0.0:
        yield Finding(
            "remark",
            f"the tip starts turned by {math.degrees(mounted):.0f} deg against the base, as it is mounted: "
            "the angle counts from there",
        )
    if frame.axis is None or frame.direction is None:
        return
    x, y, z = frame.axis
    u, v, w = frame.direction
    yield Finding(
        "remark",
        f"bends about ({x:z.2f}, {y:z.2f}, {z:z.2f}) of the base, straight it points along "
        f"({u:z.2f}, {v:z.2f}, {w:z.2f}); the chord turns by {abs(frame.leans):.2f} of the tip's angle",
    )
    stands = f"the axis of bending stands {frame.planar_deg:.0f} deg off the normal of the tip's path"
    if not _LEANS[0] < abs(frame.leans) < _LEANS[1]:
        yield Finding(
            "poor",
            f"the chord turns by {abs(frame.leans):.2f} of the tip's angle, expected about half of it",
            "look whether base and tip are swapped, and whether their quaternions are of one convention",
        )
    if math.radians(frame.planar_deg) > _NO_PLANE_RAD:
        advice = "look at the order of the quaternions, w first, and at the axes of base and tip"
        yield Finding("inconsistent", stands, advice)
    elif math.radians(frame.planar_deg) > _TILTED_RAD:
        yield Finding(
            "remark",
            f"{stands}: the tip's marker twists or base and world are tilted; the angle is the part about "
            "the axis",
        )
    if frame.conjugated:
        yield Finding(
            "remark",
            "the tip turns against its chord: quaternions look conjugated (world to body); the angle is "
            "counted as it grows with bending",
        )


def trial_of(recording: Recording, frame: Frame, day: str, load_kg: float) -> Trial:
    """The recording on the grid: commands as means over the steps, readings between their neighbours.

    Raises `BadInputError` where nothing but a command was logged.
    """
    t = recording.t_s
    grid = np.arange(t[0], t[-1] - STEP_S, STEP_S)
    none = np.zeros(0)
    pressure = none if recording.pressure is None else _between(grid, t, recording.pressure)
    angle = chord = none
    unseen = None
    if recording.turned is not None and recording.chord is not None and frame.axis is not None:
        turned = recording.turned[int(frame.conjugated)]
        angle = _between(grid, t, _twist(turned, frame.axis, frame.mount))
        chord = _between(grid, t, np.linalg.norm(recording.chord[0], axis=1))
        unseen = _gaps(grid, t, turned)
    elif recording.planar is not None:
        angles, chords = recording.planar.T
        angle = frame.grows * _between(grid, t, _continuous(angles, frame.zero_rad))
        chord = _between(grid, t, chords)
        unseen = _gaps(grid, t, recording.planar)
    command = none if recording.command is None else _means(grid, t, recording.command)
    if not len(pressure) and not len(angle):
        raise BadInputError(f"{recording.source}: has neither pressure nor pose, expected one of them")
    rest = (grid - grid[0], command, pressure, angle, chord, recording.pwm, unseen)
    return Trial(recording.name, day, load_kg, *rest)


def _gaps(grid: FloatArray, t: FloatArray, poses: FloatArray) -> BoolArray | None:
    """Places of the grid (n,) between poses (m, k) that are far apart; None without any."""
    at = t[np.isfinite(poses).all(axis=1)]
    if len(at) < 2:
        return None
    after = np.clip(np.searchsorted(at, grid), 1, len(at) - 1)
    far = (at[after] - at[after - 1] > _UNSEEN_S) | (grid < at[0]) | (grid > at[-1])
    return far if far.any() else None


def _between(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    seen = np.isfinite(values)
    return np.interp(grid, t[seen], values[seen]) if seen.any() else np.zeros(0)


def _means(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    """Means over the grid's steps of a signal that is held from sample to sample."""
    seen = np.isfinite(values)
    if not seen.any():
        return np.zeros(0)
    t, values = t[seen], values[seen]
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t))])
    edges = np.append(grid, grid[-1] + STEP_S)
    return np.asarray(np.diff(np.interp(edges, t, integral)) / STEP_S)
